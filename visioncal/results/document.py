"""Forms of calibration.json: of one camera and robot, and of a whole cell."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from visioncal.core.codec import (
    INLINE,
    REST,
    Key,
    entries,
    field_names_except,
    read,
    read_fields,
    write,
)
from visioncal.core.documents.jsons import check_schema
from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.types import Mount
from visioncal.core.version import __version__
from visioncal.results.cell import CellResult
from visioncal.results.conditions import Condition
from visioncal.results.content import CalibrationContent
from visioncal.results.edge import JointCovariance, StoredEdge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult, RayFrame
from visioncal.results.parts import (
    SCHEMA,
    NeedMet,
    RobotModel,
    SessionForm,
    SolverResult,
    StoredVerdict,
)
from visioncal.results.sections import BoardResult, CalibrationSections, RigResult
from visioncal.results.views import CellView, Rms, Validation, ViewResult, rms_of
from visioncal.session.frames import edge_names

# The estimated transforms by name.
Edges = Annotated[Mapping[str, StoredEdge], Key("transforms")]


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationForm:
    """calibration.json of one camera and one robot, without its optional sections."""

    schema: Literal[2]  # Version of the file's form.
    visioncal: str = __version__  # Version of the program.
    created: str  # Time of creation, ISO 8601.
    session: SessionForm  # The session.
    mount: Mount  # How the camera is mounted.
    edges: Edges  # Estimated transforms by name.
    joint_covariance: JointCovariance  # Joint covariance of all transforms.
    solvers: Mapping[str, SolverResult]  # Result of every solver.
    camera: CameraResult | None = None  # The camera.
    ray_frame: RayFrame | None = None  # Its transform with z along the ray of the image's centre.
    robot: RobotModel | None = None  # The nominal robot model, and the form of its poses.
    noise: Mapping[str, float]  # Estimated standard deviations per axis, by name.
    views: tuple[ViewResult, ...]  # One entry for each view of the session.
    rms: Rms  # Residuals over the used views.
    validation: Validation  # Residuals of views that were left out.
    verdict: StoredVerdict  # Verdict with its reasons.
    conditions: tuple[Condition, ...] = ()  # Conditions under which it is valid.
    need: NeedMet | None = None  # Required accuracy of picks, and the probability of meeting it.
    # Tools and fixtures by transform name.
    frames: Mapping[str, Frame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.edges:
            raise ValueError("transforms is empty")


@dataclass(frozen=True, eq=False, kw_only=True)
class CellForm:
    """calibration.json of a whole cell."""

    schema: Literal[2]  # Version of the file's form.
    visioncal: str = __version__  # Version of the program.
    created: str  # Time of creation, ISO 8601.
    session: SessionForm  # The session.
    cell: Annotated[CellResult, INLINE]  # Cameras, robots and targets by name.
    edges: Edges  # Estimated transforms by name.
    joint_covariance: JointCovariance  # Joint covariance of all transforms.
    views: tuple[CellView, ...]  # One entry for each observation.
    rms: Rms  # Residuals over the used observations.
    verdict: StoredVerdict  # Verdict with its reasons.
    conditions: tuple[Condition, ...] = ()  # Conditions under which it is valid.
    need: NeedMet | None = None  # Required accuracy of picks, and the probability of meeting it.
    validation: Validation | None = None  # Residuals of left-out observations.
    # Tools and fixtures by transform name.
    frames: Mapping[str, Frame] = field(default_factory=dict)
    # Estimated shapes of the boards by name.
    boards: Mapping[str, BoardResult] = field(default_factory=dict)
    # Estimated shapes of the rigs of points by name.
    rigs: Mapping[str, RigResult] = field(default_factory=dict)
    # Unknown sections, kept as they are.
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = {*self.cell.flanges, self.cell.reference}
        for frame, parent in self.cell.tree.items():
            if frame not in known and f"{parent}_from_{frame}" not in self.edges:
                raise ValueError(f"transforms.{parent}_from_{frame} is missing")


# Fields of the forms that a calibration, or its cell, has under the same names.
_CONVERTED = "schema visioncal session joint_covariance"
_OF_PAIR = field_names_except(CalibrationForm, f"{_CONVERTED} ray_frame conditions robot")
_OF_CELL = field_names_except(CellForm, f"{_CONVERTED} views validation conditions")


def to_document(calibration: CalibrationContent) -> dict[str, Any]:
    """Content of calibration.json; what was not computed is absent."""
    # Conditions and `ray_frame` derive from other sections, and are written for other readers.
    head: dict[str, Any] = {
        "schema": SCHEMA,
        "session": SessionForm(calibration.session_name, calibration.session_sha256),
        "joint_covariance": JointCovariance(tuple(calibration.edges), calibration.joint_covariance),
        "conditions": calibration.conditions,
    }
    cell, validation = calibration.cell, calibration.validation
    if cell is None:
        fields = {name: getattr(calibration, name) for name in _OF_PAIR}
        stated = RobotModel(calibration.robot, calibration.robot_form)
        robot = None if stated.model is None and stated.form is None else stated
        form = CalibrationForm(robot=robot, ray_frame=calibration.ray_frame, **head, **fields)
        return write(CalibrationForm, form) | write(CalibrationSections, calibration)
    whole = CellForm(
        views=tuple(CellView.of(cell.tree, view) for view in calibration.views),
        validation=validation if validation.is_of_unseen else None,
        **head,
        **{name: getattr(calibration, name) for name in _OF_CELL},
    )
    return write(CellForm, whole)


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a calibration, read from a document of `to_document`; raises DataError."""
    check_schema(document, SCHEMA, "Calibrate the session again.")
    form: CalibrationForm | CellForm
    if "tree" in document:
        form = read(CellForm, document, "")
        cell, views = form.cell, tuple(view.result(form.cell.tree) for view in form.views)
        # Derived values are not on disk.
        fields: dict[str, Any] = {"mount": cell.mount, "solvers": {}, "noise": {}, "views": views}
        fields |= {"rms": rms_of(views), "validation": form.validation or Validation.of("", views)}
        fields |= {name: getattr(form, name) for name in _OF_CELL}
    else:
        form = read(CalibrationForm, document, "")
        camera = edge_names(form.mount)[0]
        if camera not in form.edges:
            raise DataError(
                f"transforms.{camera} is missing, and mount is {form.mount!r}.",
                culprits=[f"transforms.{camera}"],
                next_step="Calibrate the session again.",
            )
        known_keys = set().union(*(entry.keys for entry in entries(CalibrationForm)))
        rest = {key: value for key, value in document.items() if key not in known_keys}
        robot = form.robot or RobotModel()
        fields = {name: getattr(form, name) for name in _OF_PAIR}
        fields |= {"robot": robot.model, "robot_form": robot.form}
        fields |= read_fields(CalibrationSections, rest, "")
    return fields | {
        # As a session's: nothing in it may steer a terminal.
        "session_name": one_line(form.session.name),
        "session_sha256": form.session.sha256,
        "joint_covariance": form.joint_covariance.matrix,
    }

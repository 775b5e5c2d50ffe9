"""calibration.json, of one camera and one robot or of a whole cell, and alignment.json."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

from visioncal.core.codec import INLINE, REST, Key, entries, names_but, read, read_fields, write
from visioncal.core.errors import DataError
from visioncal.core.types import Mount
from visioncal.core.version import __version__
from visioncal.estimation.chain import edge_names
from visioncal.results.arm import StoredRobot
from visioncal.results.cell import CellResult, Moved, Untied
from visioncal.results.edge import JointCovariance, StoredEdge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult, RayFrame
from visioncal.results.parts import (
    SCHEMA,
    NeedMet,
    SessionForm,
    SolverResult,
    StoredVerdict,
    check_schema,
)
from visioncal.results.sections import BoardResult, CalibrationSections, CellDetails, RigResult
from visioncal.results.views import CellView, Rms, Validation, ViewResult, rms_of
from visioncal.session.frames import thing_name

if TYPE_CHECKING:
    from visioncal.results.result import Calibration


# The file of a whole cell in an older form.
ALIGNMENT = "alignment.json"
# The estimated transforms by name.
Edges = Annotated[Mapping[str, StoredEdge], Key("transforms")]


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationForm:
    """calibration.json of one camera and one robot, but for its further sections.

    Attributes:
        schema: The version of this form.
        visioncal: The version of the program.
        created: When, in ISO 8601.
        session: The session.
        mount: How the camera is mounted.
        edges: The estimated transforms by name.
        joint_covariance: Their covariance together.
        solvers: What every solver made of it.
        camera: The camera.
        ray_frame: Its transform in the frame of its image's centre ray.
        robot: The nominal robot model.
        noise: Estimated standard deviations per axis, by name.
        views: One entry for each view of the session.
        rms: Residuals over the used views.
        validation: Residuals of views that were left out.
        verdict: Whether to trust it.
        need: What the task needs, and how likely picks meet it.
        frames: Tools and fixtures by the transform that places them.
    """

    schema: Literal[1]
    visioncal: str = __version__
    created: str
    session: SessionForm
    mount: Mount
    edges: Edges
    joint_covariance: JointCovariance
    solvers: Mapping[str, SolverResult]
    camera: CameraResult | None = None
    ray_frame: RayFrame | None = None
    robot: StoredRobot | None = None
    noise: Mapping[str, float]
    views: tuple[ViewResult, ...]
    rms: Rms
    validation: Validation
    verdict: StoredVerdict
    need: NeedMet | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks that there is a transform.

        Raises:
            ValueError: There is none.
        """
        if not self.edges:
            raise ValueError("transforms is empty")


@dataclass(frozen=True, eq=False, kw_only=True)
class CellForm:
    """calibration.json of a whole cell.

    Attributes:
        schema: The version of this form.
        visioncal: The version of the program.
        created: When, in ISO 8601.
        session: The session.
        cell: What it has by name.
        edges: The estimated transforms by name.
        joint_covariance: Their covariance together.
        views: One entry for each observation.
        rms: Residuals over the used ones.
        verdict: Whether to trust it.
        need: What the task needs, and how likely picks meet it.
        validation: Residuals of what was left out.
        frames: Tools and fixtures by the transform that places them.
        boards: The boards by name, as they were found to be.
        rigs: The rigs of points by name.
        further: Sections that this version does not know.
    """

    schema: Literal[1]
    visioncal: str = __version__
    created: str
    session: SessionForm
    cell: Annotated[CellResult, INLINE]
    edges: Edges
    joint_covariance: JointCovariance
    views: tuple[CellView, ...]
    rms: Rms
    verdict: StoredVerdict
    need: NeedMet | None = None
    validation: Validation | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)
    boards: Mapping[str, BoardResult] = field(default_factory=dict)
    rigs: Mapping[str, RigResult] = field(default_factory=dict)
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignmentForm:
    """alignment.json: a whole cell in an older form, with fewer sections and other names."""

    schema: Literal[1]
    visioncal: str = __version__
    created: str
    session: SessionForm
    reference: str
    tree: Annotated[Mapping[str, str], Key("frames")]
    flanges: Annotated[Mapping[str, str], Key("robots")]
    edges: Edges
    joint_covariance: JointCovariance
    lenses: Annotated[Mapping[str, CameraResult], Key("cameras")]
    noise: Mapping[str, Mapping[str, float]]
    views: Annotated[tuple[ViewResult, ...], Key("observations")]
    moved: tuple[Moved, ...]
    untied: tuple[Untied, ...]
    weakest: str
    verdict: StoredVerdict
    need: NeedMet | None = None
    details: CellDetails


# Fields that a calibration has under the same names, and those that its cell has.
_OTHERS = "schema visioncal session joint_covariance"
_OF_PAIR = names_but(CalibrationForm, f"{_OTHERS} ray_frame")
_OF_CELL = names_but(CellForm, f"{_OTHERS} views validation")
_ALIGNED = ("created", "edges", "views", "verdict", "need")
_IN_CELL = names_but(AlignmentForm, " ".join((_OTHERS, "flanges lenses", *_ALIGNED)))


def to_document(calibration: "Calibration") -> dict[str, Any]:
    """Builds the content of calibration.json; what was not computed is absent."""
    if calibration.cell is not None:
        return write(CellForm, _cell_form(calibration, calibration.cell))
    form = CalibrationForm(
        # It follows from transform and camera, and is written for other readers.
        ray_frame=calibration.ray_frame,
        **_head(calibration),
        **{name: getattr(calibration, name) for name in _OF_PAIR},
    )
    return write(CalibrationForm, form) | write(CalibrationSections, calibration)


def _cell_form(calibration: "Calibration", cell: CellResult) -> CellForm:
    validation = calibration.validation
    return CellForm(
        views=tuple(CellView.of(cell.tree, view) for view in calibration.views),
        validation=validation if validation.is_of_unseen else None,
        **_head(calibration),
        **{name: getattr(calibration, name) for name in _OF_CELL},
    )


def to_alignment(calibration: "Calibration", cell: CellResult) -> dict[str, Any]:
    """Builds the content of alignment.json of a whole cell."""
    form = AlignmentForm(
        flanges=cell.flanges,
        lenses=cell.lenses,
        **_head(calibration),
        **{name: getattr(calibration, name) for name in _ALIGNED},
        **{name: getattr(cell, name) for name in _IN_CELL},
    )
    return write(AlignmentForm, form)


def _head(calibration: "Calibration") -> dict[str, Any]:
    """What all forms have in other shapes."""
    return {
        "schema": SCHEMA,
        "session": SessionForm(calibration.session_name, calibration.session_sha256),
        "joint_covariance": JointCovariance.of(calibration.edges, calibration.joint_covariance),
    }


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the fields of a calibration from what `to_document` or `to_alignment` built.

    Raises:
        DataError: It is of another schema, or no calibration; the message names the place.
    """
    check_schema(document)
    if "tree" in document:
        return _of_cell(read(CellForm, document, ""))
    if {"reference", "transforms"} <= document.keys():
        return _of_alignment(read(AlignmentForm, document, ""))
    form = read(CalibrationForm, document, "")
    _check_camera(form)
    own = set().union(*(entry.keys for entry in entries(CalibrationForm)))
    rest = {key: value for key, value in document.items() if key not in own}
    found = {name: getattr(form, name) for name in _OF_PAIR}
    return _of_head(form) | found | read_fields(CalibrationSections, rest, "")


def _of_head(form: CalibrationForm | CellForm | AlignmentForm) -> dict[str, Any]:
    """Reads what `_head` wrote."""
    return {
        "session_name": form.session.name,
        "session_sha256": form.session.sha256,
        "joint_covariance": form.joint_covariance.matrix,
    }


def _check_camera(form: CalibrationForm) -> None:
    """Refuses a result without the transform from which all begins that looks through the camera.

    Raises:
        DataError: So it is.
    """
    camera = edge_names(form.mount)[0]
    if camera not in form.edges:
        raise DataError(
            f"transforms.{camera} is missing, and mount is {form.mount!r}.",
            culprits=[f"transforms.{camera}"],
            next_step="Calibrate the session again.",
        )


def _of_cell(form: CellForm) -> dict[str, Any]:
    views = tuple(view.result(form.cell.tree) for view in form.views)
    found = _of_head(form) | _that_follow(form.cell, views)
    if form.validation is not None:
        found["validation"] = form.validation
    return found | {name: getattr(form, name) for name in _OF_CELL}


def _of_alignment(form: AlignmentForm) -> dict[str, Any]:
    cell = CellResult(
        cameras={thing_name(name, "camera"): lens for name, lens in form.lenses.items()},
        robots={},
        targets={},
        **{name: getattr(form, name) for name in _IN_CELL},
    )
    found = _of_head(form) | _that_follow(cell, form.views)
    return found | {name: getattr(form, name) for name in _ALIGNED}


def _that_follow(cell: CellResult, views: tuple[ViewResult, ...]) -> dict[str, Any]:
    """Fields of a whole cell's calibration that need not be on disk."""
    return {
        "cell": cell,
        "mount": cell.mount,
        "solvers": {},
        "noise": {},
        "views": views,
        "rms": rms_of(views),
        "validation": Validation.of("", views),
    }

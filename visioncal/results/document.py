"""calibration.json of one camera and one robot."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

from visioncal.core.codec import names_but, read, read_fields, write
from visioncal.core.types import Mount
from visioncal.core.version import __version__
from visioncal.results.arm import StoredRobot
from visioncal.results.edge import JointCovariance, StoredEdge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult
from visioncal.results.parts import (
    SCHEMA,
    NeedMet,
    Rms,
    SessionForm,
    SolverResult,
    StoredVerdict,
    Validation,
    ViewResult,
    check_schema,
)
from visioncal.results.ray_frame import RayFrame
from visioncal.results.sections import CalibrationSections
from visioncal.results.whole import whole_document

if TYPE_CHECKING:
    from visioncal.results.result import Calibration


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationForm:
    """calibration.json of one camera and one robot, but for its further sections.

    Attributes:
        schema: The version of this form.
        visioncal: The version of the program.
        created: When, in ISO 8601.
        session: The session.
        mount: How the camera is mounted.
        transforms: The estimated transforms by name.
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
    transforms: Mapping[str, StoredEdge]
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
        if not self.transforms:
            raise ValueError("transforms is empty")


# Fields that a calibration has under the same names.
_SAME = names_but(CalibrationForm, "schema visioncal session transforms joint_covariance ray_frame")


def to_document(calibration: "Calibration") -> dict[str, Any]:
    """Builds the content of calibration.json; what was not computed is absent."""
    cell = calibration.whole_cell
    if cell is not None:
        return whole_document(cell)
    form = CalibrationForm(
        schema=SCHEMA,
        session=SessionForm(calibration.session_name, calibration.session_sha256),
        transforms=calibration.edges,
        joint_covariance=JointCovariance.of(calibration.edges, calibration.joint_covariance),
        # It follows from transform and camera, and is written for other readers.
        ray_frame=calibration.ray_frame,
        **{name: getattr(calibration, name) for name in _SAME},
    )
    return write(CalibrationForm, form) | write(CalibrationSections, calibration)


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the fields of a calibration from what `to_document` built.

    Raises:
        DataError: It is of another schema, or no calibration; the message names the place.
    """
    check_schema(document)
    form = read(CalibrationForm, document, "")
    own = {entry.name for entry in fields(CalibrationForm)}
    rest = {key: value for key, value in document.items() if key not in own}
    return {
        "session_name": form.session.name,
        "session_sha256": form.session.sha256,
        "edges": form.transforms,
        "joint_covariance": form.joint_covariance.matrix,
        **{name: getattr(form, name) for name in _SAME},
        **read_fields(CalibrationSections, rest, ""),
    }

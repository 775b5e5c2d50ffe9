"""Result of a whole cell: cameras, robots and targets by name."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

from visioncal.core.codec import KEPT
from visioncal.core.types import Mount
from visioncal.results.lens import CameraResult
from visioncal.results.parts import RobotResult
from visioncal.results.sections import CellDetails, CellJointFit, CellUncertainty
from visioncal.session.frames import (
    CELL,
    frame_of_object,
    frames_of_kind,
    object_name,
    robots_between,
)


@dataclass(frozen=True)
class Moved:
    """A frame that moved during the session.

    Attributes:
        frame: The frame; its transform in the result is the last one.
        before: Name in the result of its earlier pose.
        last_stop: Last stop at the earlier pose.
        first_stop: First stop at the last pose.
        shift_mm: Displacement of its origin [mm].
        turn_deg: Rotation angle [deg].
        rivals: Frames whose motion would explain the observations as well.
    """

    frame: str
    before: str
    last_stop: int
    first_stop: int
    shift_mm: float
    turn_deg: float
    rivals: Annotated[tuple[str, ...], KEPT] = ()


@dataclass(frozen=True)
class UnconnectedFrame:
    """A frame that no observation connects to the rest, and a remedy in a sentence."""

    frame: str
    remedy: str


@dataclass(frozen=True, eq=False, kw_only=True)
class CellResult:
    """Result of a whole cell beside its transforms and views.

    Attributes:
        reference: The frame that defines the cell's frame.
        tree: Parent of each frame, by name.
        cameras: The cameras by name; one without a name is `camera`.
        robots: The robots by name, with nominal model and arm sections; one without a name is
            `robot`.
        targets: Documents of the targets, by name.
        noise: Estimated standard deviations, by frame or robot and by name.
        moved: Frames that moved during the session.
        untied: Frames that no observation connects to the rest.
        weakest: The weakest connection, in words.
        details: Further figures.
        joint_fit: Parameters of the fit and their covariance, for verification.
        uncertainty: Uncertainty of the cell.
    """

    reference: str
    tree: Mapping[str, str]
    cameras: Mapping[str, CameraResult]
    robots: Mapping[str, RobotResult]
    targets: Mapping[str, Mapping[str, Any]]
    noise: Mapping[str, Mapping[str, float]]
    moved: tuple[Moved, ...]
    untied: tuple[UnconnectedFrame, ...]
    weakest: str
    details: CellDetails
    joint_fit: CellJointFit | None = None
    uncertainty: CellUncertainty | None = None

    @property
    def flanges(self) -> dict[str, str]:
        """Robot of each flange, by the flange's frame."""
        return {name: object_name(name, "robot") for name in frames_of_kind(self.tree, "flange")}

    @property
    def mount(self) -> Mount:
        """`eye-in-hand` where all cameras are on robots, else `eye-to-hand`."""
        cameras = frames_of_kind(self.tree, "camera")
        carried = [bool(robots_between(self.tree, camera, CELL)) for camera in cameras]
        return "eye-in-hand" if carried and all(carried) else "eye-to-hand"

    @cached_property
    def lenses(self) -> dict[str, CameraResult]:
        """Cameras by frame."""
        return {
            frame_of_object(self.tree, "camera", name): camera
            for name, camera in self.cameras.items()
        }

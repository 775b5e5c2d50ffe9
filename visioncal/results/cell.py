"""Result of a whole cell: cameras, robots and targets by name."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

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
    """A frame that moved during the session."""

    frame: str  # The frame; its transform in the result is the last one.
    before: str  # Name in the result of its earlier pose.
    last_stop: int  # Last stop at the earlier pose.
    first_stop: int  # First stop at the last pose.
    shift_mm: float  # Displacement of its origin [mm].
    turn_deg: float  # Rotation angle [deg].


@dataclass(frozen=True)
class UnconnectedFrame:
    """A frame that no observation connects to the rest, and a remedy in a sentence."""

    frame: str
    remedy: str


@dataclass(frozen=True, eq=False, kw_only=True)
class CellResult:
    """Result of a whole cell beside its transforms and views."""

    reference: str  # The frame that defines the cell's frame.
    tree: Mapping[str, str]  # Parent of each frame, by name.
    cameras: Mapping[str, CameraResult]  # The cameras by name; one without a name is `camera`.
    # The robots by name, with nominal model and arm sections; one without a name is `robot`.
    robots: Mapping[str, RobotResult]
    targets: Mapping[str, Mapping[str, Any]]  # Documents of the targets, by name.
    # Estimated standard deviations, by frame or robot and by name.
    noise: Mapping[str, Mapping[str, float]]
    moved: tuple[Moved, ...]  # Frames that moved during the session.
    untied: tuple[UnconnectedFrame, ...]  # Frames that no observation connects to the rest.
    weakest: str  # The weakest connection, in words.
    details: CellDetails  # Further figures.
    # Parameters of the fit and their covariance, for verification.
    joint_fit: CellJointFit | None = None
    uncertainty: CellUncertainty | None = None  # Uncertainty of the cell.

    def __post_init__(self) -> None:
        for name in self.tree:
            above, parent = {name}, self.tree[name]
            while parent != CELL:
                if parent in above or parent not in self.tree:
                    raise ValueError(f"tree.{name} does not lead to the cell")
                above, parent = above | {parent}, self.tree[parent]

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

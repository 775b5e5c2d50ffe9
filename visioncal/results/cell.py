"""What a result of a whole cell has by name, where one camera with one robot has one of each."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

from visioncal.core.codec import KEPT
from visioncal.core.types import Mount
from visioncal.results.lens import CameraResult
from visioncal.results.parts import RobotResult
from visioncal.results.sections import CellDetails, CellJointFit, CellUncertainty
from visioncal.session.frames import CELL, frame_called, frames_of_kind, robots_between, thing_name


@dataclass(frozen=True)
class Moved:
    """A frame that moved while the session was taken.

    Attributes:
        frame: The frame; its transform in the result is where it stood last.
        before: Its name in the result until then.
        last_stop: The last stop at which it was seen where it stood before.
        first_stop: The first stop at which it stands elsewhere.
        shift_mm: How far its origin moved [mm].
        turn_deg: How far it turned [deg].
        rivals: Frames that may have moved in its place: the session does not show which.
    """

    frame: str
    before: str
    last_stop: int
    first_stop: int
    shift_mm: float
    turn_deg: float
    rivals: Annotated[tuple[str, ...], KEPT] = ()


@dataclass(frozen=True)
class Untied:
    """A frame that nothing ties to the rest, and what would, in a sentence."""

    frame: str
    remedy: str


@dataclass(frozen=True, eq=False, kw_only=True)
class CellResult:
    """What was found of a whole cell beside its transforms and views.

    Attributes:
        reference: The frame that stands for the cell: the cell's frame is its.
        tree: What each frame hangs on, by its name.
        cameras: The cameras by name; one that has no name goes by `camera`.
        robots: The robots by name, likewise: the nominal model, and what was found of the arm.
        targets: What was printed, by name and as it is described.
        noise: Estimated standard deviations, by frame or robot and by name.
        moved: What moved while the session was taken.
        untied: Frames that nothing ties to the rest.
        weakest: The weakest link, in words.
        details: Further figures.
        joint_fit: The unknowns of the fit and their covariance, for a later check.
        uncertainty: How well the cell is known.
    """

    reference: str
    tree: Mapping[str, str]
    cameras: Mapping[str, CameraResult]
    robots: Mapping[str, RobotResult]
    targets: Mapping[str, Mapping[str, Any]]
    noise: Mapping[str, Mapping[str, float]]
    moved: tuple[Moved, ...]
    untied: tuple[Untied, ...]
    weakest: str
    details: CellDetails
    joint_fit: CellJointFit | None = None
    uncertainty: CellUncertainty | None = None

    @property
    def flanges(self) -> dict[str, str]:
        """The robot of each flange, by the flange's frame."""
        return {name: thing_name(name, "robot") for name in frames_of_kind(self.tree, "flange")}

    @property
    def mount(self) -> Mount:
        """Where the cameras are; those of which some stand still, beside the robots."""
        cameras = frames_of_kind(self.tree, "camera")
        carried = [bool(robots_between(self.tree, camera, CELL)) for camera in cameras]
        return "eye-in-hand" if carried and all(carried) else "eye-to-hand"

    @cached_property
    def lenses(self) -> dict[str, CameraResult]:
        """The cameras by their frames."""
        return {
            frame_called(self.tree, "camera", name): camera for name, camera in self.cameras.items()
        }

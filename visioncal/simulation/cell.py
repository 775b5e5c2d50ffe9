"""A simulated cell: its robots, cameras and boards, and what was seen and read in it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import Camera, Corners, FloatArray
from visioncal.session import Stream, frame_name
from visioncal.simulation.arms import DhArm
from visioncal.simulation.layout import (
    CELL,
    BoardAt,
    CameraAt,
    CellOptions,
    NetworkOptions,
    RobotAt,
)
from visioncal.simulation.sag import Payload


@dataclass(frozen=True, eq=False)
class SimulatedRobot:
    """A robot of a cell, where it stood at s stops, and what it reported.

    Attributes:
        options: What was asked for.
        arm: The nominal arm.
        true_arm: The arm as it was built.
        joints: (s, n) joint angles as reported [rad].
        base_from_flange: (s, 4, 4) poses as reported: the nominal arm at the reported joints.
        true_base_from_flange: (s, 4, 4) where the flange really stood.
        wrong_stops: Stops whose report is wrong, ascending.
        loads: What it carried, stop by stop; empty where nothing.
        approach: (s,) the side from which each stop was approached, +1 or -1; None without play.
    """

    options: RobotAt
    arm: DhArm
    true_arm: DhArm
    joints: FloatArray
    base_from_flange: FloatArray
    true_base_from_flange: FloatArray
    wrong_stops: tuple[int, ...] = ()
    loads: tuple[Payload, ...] = ()
    approach: FloatArray | None = None

    def flange_at(self, q: FloatArray, loads: Sequence[Payload] = ()) -> FloatArray:
        """Where the real arm's flange stands (k, 4, 4) at (k, n) joint angles [rad].

        With k loads, or none but its own weight; from the middle of its play.
        """
        return self.options.flange_at(self.true_arm, q, loads)

    def only(self, stops: Sequence[int]) -> "SimulatedRobot":
        """The robot at some of its stops, numbered anew."""
        kept = list(stops)
        return replace(
            self,
            joints=self.joints[kept],
            base_from_flange=self.base_from_flange[kept],
            true_base_from_flange=self.true_base_from_flange[kept],
            wrong_stops=tuple(at for at, index in enumerate(kept) if index in self.wrong_stops),
            loads=tuple(self.loads[at] for at in kept if self.loads),
            approach=None if self.approach is None else self.approach[kept],
        )


@dataclass(frozen=True, eq=False)
class SimulatedSight:
    """A camera's image of a board at a stop.

    Attributes:
        view: The number of its row.
        stop: When it was taken; -1 for an image of the camera's lens alone, and for a frame of a
            sweep after the stops.
        camera: The camera's name.
        board: The board's.
        cam_from_target: (4, 4) where the board is in the image that the row has.
        exact: Where its corners are in that image.
        corners: The same as a detector would report them; which end of a board that looks alike
            from both it takes for the first, hangs on how it lies in the image.
        stamp_s: When it was taken in a sweep, by the camera's clock [s]; None at a stop.
        at_once: Whether all rows of the image are of one moment.
    """

    view: int
    stop: int
    camera: str
    board: str
    cam_from_target: FloatArray
    exact: Corners
    corners: Corners
    stamp_s: float | None = None
    at_once: bool = True

    @property
    def is_of_lens(self) -> bool:
        """Whether it serves the camera's lens alone."""
        return self.stop < 0 and self.stamp_s is None

    def numbered(self, view: int) -> "SimulatedSight":
        """The same as another row."""
        exact, corners = (replace(corners, view=view) for corners in (self.exact, self.corners))
        return replace(self, view=view, exact=exact, corners=corners)


@dataclass(frozen=True, eq=False)
class InstrumentReading:
    """What an instrument read of a point at a stop: (4, 4) in the instrument's frame.

    The rotation counts where the instrument reads any.
    """

    view: int
    stop: int
    instrument: str
    point: str
    instrument_from_point: FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """A simulated cell of robots, cameras and boards, and what was seen in it.

    One robot, one camera and one board have no names, and the robot's base is what all stands on.

    Attributes:
        options: What was asked for.
        parents: What each frame but the flanges hangs on, by its name in a session.
        mountings: (4, 4) `parent_from_frame` of each of them, before anything is pushed.
        robots: The robots by their names.
        stated: The cameras' intrinsics as the session states them, by the cameras' names.
        sights: What cameras saw, by ascending view, and last the images of lenses alone.
        readings: What instruments read.
        pose_rows: The row with a robot's pose, for those of which no other row of their stop
            has it: (view, stop, robot).
        wrong_views: Rows with another row's image or, in a cell of one robot, with a wrong report;
            ascending.
        stamps_s: (s,) when each stop was made [s]; None where rows have no time.
        streams: Robots' states in sweeps, by the robots' names, and temperatures.
        facts: What else the truth's file says of it.
    """

    options: CellOptions | NetworkOptions
    parents: Mapping[str, str]
    mountings: Mapping[str, FloatArray]
    robots: Mapping[str, SimulatedRobot]
    stated: Mapping[str, Camera]
    sights: tuple[SimulatedSight, ...] = ()
    readings: tuple[InstrumentReading, ...] = ()
    pose_rows: tuple[tuple[int, int, str], ...] = ()
    wrong_views: tuple[int, ...] = ()
    stamps_s: FloatArray | None = None
    streams: Mapping[str, Stream] = field(default_factory=dict)
    facts: Mapping[str, object] = field(default_factory=dict)

    @property
    def layout(self) -> NetworkOptions:
        """What there is."""
        return self.options.layout

    @property
    def transforms(self) -> dict[str, FloatArray]:
        """The mountings by the names of a result's transforms, as `flange_from_cam`."""
        return {f"{self.parents[name]}_from_{name}": pose for name, pose in self.mountings.items()}

    @property
    def robot(self) -> SimulatedRobot:
        """The only robot."""
        (robot,) = self.robots.values()
        return robot

    @property
    def cam_from_target(self) -> FloatArray:
        """(m, 4, 4) where boards are in all images, by ascending view."""
        return np.array([sight.cam_from_target for sight in self.sights])

    @property
    def exact_corners(self) -> tuple[Corners, ...]:
        """Where the corners really are in all images, by ascending view."""
        return tuple(sight.exact for sight in self.sights)

    @property
    def corners(self) -> tuple[Corners, ...]:
        """What was detected in all images, by ascending view."""
        return tuple(sight.corners for sight in self.sights)

    @property
    def is_named(self) -> bool:
        """Whether its things have names: else there is one of each kind."""
        layout = self.layout
        return any(
            [*(robot.name for robot in layout.robots), *(board.name for board in layout.boards)]
        )

    def camera(self, name: str = "") -> CameraAt:
        """The camera of that name, or the only one."""
        return next(camera for camera in self.layout.cameras if camera.name == name)

    def board(self, name: str = "") -> BoardAt:
        """The board of that name, or the only one."""
        return next(board for board in self.layout.boards if board.name == name)

    def between(self, first: str, second: str) -> FloatArray:
        """(4, 4) `first_from_second` of two frames of the cell, none of which a robot moves."""
        return invert(self._in_cell(first)) @ self._in_cell(second)

    def _in_cell(self, frame: str) -> FloatArray:
        root = "base" if "base" in self.parents.values() else CELL
        if frame == root:
            return np.eye(4)
        if self.parents.get(frame) != root:
            raise DataError(f"simulation: {frame} does not stand in the cell.")
        return self.mountings[frame]

    def robot_of(self, frame: str) -> str | None:
        """The robot whose pose the rows of a camera, board or point have; None for none."""
        on = self.parents[frame]
        return next((robot for robot in self.robots if frame_name("flange", robot) == on), None)

    def seen_from(self, robot: str, camera: str, board: str) -> Callable[[FloatArray], FloatArray]:
        """Where a board (k, 4, 4) is before a camera, by (k, 4, 4) `base_from_flange`.

        The robot carries one of the two, and the other stands in the cell.
        """
        ends = frame_name("camera", camera), frame_name("target", board)
        base, flange = (frame_name(name, robot) for name in ("base", "flange"))
        cell_from_base = self.mountings.get(base, np.eye(4))

        def before(base_from_flange: FloatArray) -> FloatArray:
            cam, target = (
                cell_from_base @ base_from_flange @ self.mountings[end]
                if self.parents[end] == flange
                else self.mountings[end]
                for end in ends
            )
            return np.asarray(invert(cam) @ target)

        return before

    def only(self, views: Sequence[int]) -> "SimulatedCell":
        """The cell with some of the images and their stops, both numbered anew."""
        kept = [self.sights[view] for view in views]
        stops = list(dict.fromkeys(sight.stop for sight in kept))
        number = {stop: at for at, stop in enumerate(stops)}
        sights = tuple(
            replace(sight.numbered(view), stop=number[sight.stop])
            for view, sight in enumerate(kept)
        )
        return replace(
            self,
            robots={name: robot.only(stops) for name, robot in self.robots.items()},
            sights=sights,
            wrong_views=tuple(at for at, view in enumerate(views) if view in self.wrong_views),
            stamps_s=None if self.stamps_s is None else self.stamps_s[stops],
        )

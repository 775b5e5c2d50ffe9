"""A simulated cell: robots, cameras and boards, with observations and readings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.core.transforms import invert
from visioncal.core.types import Camera, Corners, FloatArray, chosen_rows
from visioncal.session import Stream, frame_name
from visioncal.simulation.arms import DhArm, Payload
from visioncal.simulation.layout import BoardAt, CameraAt, CellOptions, NetworkOptions, RobotAt


@dataclass(frozen=True, eq=False)
class SimulatedRobot:
    """A robot of a cell with its true and reported poses at s stops."""

    options: RobotAt  # Options of the robot.
    arm: DhArm  # Nominal arm.
    true_arm: DhArm  # Real arm.
    joints: FloatArray  # (s, n) reported joint angles [rad].
    # (s, 4, 4) reported poses: the nominal arm at the reported joints.
    base_from_flange: FloatArray
    true_base_from_flange: FloatArray  # (s, 4, 4) true poses.
    wrong_stops: tuple[int, ...] = ()  # Stops with a wrong report, ascending.
    loads: tuple[Payload, ...] = ()  # Payload of each stop; empty without payloads.
    # (s,) side from which each stop was approached, +1 or -1; None without backlash.
    approach: FloatArray | None = None

    def flange_at(self, q: FloatArray, loads: Sequence[Payload] = ()) -> FloatArray:
        """True flange poses (k, 4, 4) at (k, n) joint angles [rad].

        With k payloads, or its own weight only; in the middle of its backlash.
        """
        return self.options.flange_at(self.true_arm, q, loads)

    def only(self, stops: Sequence[int]) -> "SimulatedRobot":
        """The robot at some of its stops, renumbered."""
        wrong = tuple(stop for stop, old_stop in enumerate(stops) if old_stop in self.wrong_stops)
        return replace(chosen_rows(self, list(stops), "wrong_stops"), wrong_stops=wrong)


@dataclass(frozen=True, eq=False)
class SimulatedSight:
    """A camera's image of a board at a stop."""

    view: int  # Number of its row.
    # Stop at which it was taken; -1 for images for intrinsics only, and for frames of a sweep after
    # the stops.
    stop: int
    camera: str  # Camera name.
    board: str  # Board name.
    cam_from_target: FloatArray  # (4, 4) board pose in the row's image.
    exact: Corners  # True corners in that image.
    # Detected corners; the numbering of a symmetric board depends on its orientation in the image.
    corners: Corners
    # Time stamp in a sweep, by the camera's clock [s]; None at a stop.
    stamp_s: float | None = None
    at_once: bool = True  # Whether all rows of the image are taken at the same time.

    @property
    def is_of_lens(self) -> bool:
        """Whether the sight is for the camera's intrinsics only."""
        return self.stop < 0 and self.stamp_s is None

    def numbered(self, view: int) -> "SimulatedSight":
        """The same sight as another row."""
        exact, corners = (replace(corners, view=view) for corners in (self.exact, self.corners))
        return replace(self, view=view, exact=exact, corners=corners)


@dataclass(frozen=True, eq=False)
class InstrumentReading:
    """Reading of a point by an instrument at a stop: (4, 4) in the instrument's frame.

    The rotation is valid only if the instrument measures rotations.
    """

    view: int
    stop: int
    instrument: str
    point: str
    instrument_from_point: FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """A simulated cell of robots, cameras and boards, with its observations.

    A single robot, camera or board has no name; with a single robot, its base is the root frame.
    """

    options: CellOptions | NetworkOptions  # Options of the cell.
    parents: Mapping[str, str]  # Parent of each frame but the flanges, by its name in a session.
    # (4, 4) `parent_from_frame` of each of them, before any push.
    mountings: Mapping[str, FloatArray]
    robots: Mapping[str, SimulatedRobot]  # Robots by name.
    stated: Mapping[str, Camera]  # Intrinsics stated in the session, by camera name.
    # Camera observations by ascending view; images for intrinsics only are last.
    sights: tuple[SimulatedSight, ...] = ()
    readings: tuple[InstrumentReading, ...] = ()  # Instrument readings.
    # Rows with only a robot's pose, for stops where no other row has it: (view, stop, robot).
    pose_rows: tuple[tuple[int, int, str], ...] = ()
    # Rows with another row's image or, with one robot, with a wrong report; ascending.
    wrong_views: tuple[int, ...] = ()
    stamps_s: FloatArray | None = None  # (s,) time of each stop [s]; None if rows have no time.
    # Robots' states in sweeps, by robot name, and temperatures.
    streams: Mapping[str, Stream] = field(default_factory=dict)
    # Further content of the truth's file.
    facts: Mapping[str, object] = field(default_factory=dict)

    @property
    def layout(self) -> NetworkOptions:
        """Layout of the cell."""
        return self.options.layout

    @property
    def transforms(self) -> dict[str, FloatArray]:
        """Mountings by the names of a result's transforms, as `flange_from_cam`."""
        return {f"{self.parents[name]}_from_{name}": pose for name, pose in self.mountings.items()}

    @property
    def robot(self) -> SimulatedRobot:
        """The single robot."""
        (robot,) = self.robots.values()
        return robot

    @property
    def cam_from_target(self) -> FloatArray:
        """(m, 4, 4) board poses in all images, by ascending view."""
        return np.array([sight.cam_from_target for sight in self.sights])

    @property
    def exact_corners(self) -> tuple[Corners, ...]:
        """True corners in all images, by ascending view."""
        return tuple(sight.exact for sight in self.sights)

    @property
    def corners(self) -> tuple[Corners, ...]:
        """Detected corners in all images, by ascending view."""
        return tuple(sight.corners for sight in self.sights)

    def camera(self, name: str = "") -> CameraAt:
        """The camera of that name, or the single one."""
        return next(camera for camera in self.layout.cameras if camera.name == name)

    def board(self, name: str = "") -> BoardAt:
        """The board of that name, or the single one."""
        return next(board for board in self.layout.boards if board.name == name)

    def between(self, first: str, second: str) -> FloatArray:
        """(4, 4) `first_from_second` of two frames that stand in the cell."""
        cell_from_first, cell_from_second = (
            self.mountings.get(frame, np.eye(4)) for frame in (first, second)
        )
        return np.asarray(invert(cell_from_first) @ cell_from_second)

    def robot_of(self, frame: str) -> str | None:
        """Robot that carries a camera, board or point; None for none."""
        parent = self.parents[frame]
        return next((robot for robot in self.robots if frame_name("flange", robot) == parent), None)

    def seen_from(self, robot: str, camera: str, board: str) -> Callable[[FloatArray], FloatArray]:
        """Function from (k, 4, 4) `base_from_flange` to (k, 4, 4) `cam_from_target`.

        The robot carries camera or board, and the other one is fixed in the cell.
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
        """The cell with some of the images and their stops, both renumbered."""
        kept = [self.sights[view] for view in views]
        stops = list(dict.fromkeys(sight.stop for sight in kept))
        stop_index = {stop: index for index, stop in enumerate(stops)}
        sights = tuple(
            replace(sight.numbered(view), stop=stop_index[sight.stop])
            for view, sight in enumerate(kept)
        )
        return replace(
            self,
            robots={name: robot.only(stops) for name, robot in self.robots.items()},
            sights=sights,
            wrong_views=tuple(
                index for index, view in enumerate(views) if view in self.wrong_views
            ),
            stamps_s=None if self.stamps_s is None else self.stamps_s[stops],
        )

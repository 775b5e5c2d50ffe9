"""What simulated cells are made of, and their faults."""

from dataclasses import dataclass, field, fields
from typing import Any

from visioncal.core.arguments import check_fields
from visioncal.core.errors import DataError
from visioncal.core.types import Mount, Target
from visioncal.simulation.boards import Sheet
from visioncal.simulation.draws import DrawOptions
from visioncal.simulation.optics import fine_camera
from visioncal.simulation.options import BOARDS, CameraOptions, SweepOptions
from visioncal.simulation.poses import Motion, Viewpoints
from visioncal.simulation.sag import ArmOptions

# Where robots meet [m].
MIDDLE_M = (0.0, 0.0, 0.4)
CELL = "cell"
# An operator's pace: a stop every so many seconds [s].
_PACE_S = 4.0
# What a session calls the boards of a cell with a second one.
_TWO_BOARDS = ("first", "second")


@dataclass(frozen=True)
class RobotAt(ArmOptions):
    """A robot that stands in the cell and turns its front to the middle.

    Attributes:
        name: What the session calls it.
        place_m: Where its base stands in the cell [m].
        warms_up: Whether it is cold at the first stop, and warms up by work.
        wrong_stops: Number of stops at which its report is off by 5 to 30 mm and 1 to 5 degrees.
    """

    name: str
    place_m: tuple[float, float, float]
    robot: str = field(default="ur5e", kw_only=True)
    warms_up: bool = False
    wrong_stops: int = 0


@dataclass(frozen=True, eq=False)
class CameraAt(CameraOptions):
    """A camera on a robot's flange, or one that stands in the cell and looks at a place of it.

    Attributes:
        name: What the session calls it.
        on: The robot on whose flange it is, or `cell`.
        place_m: Where it stands in the cell, if it does [m].
        looks_at_m: The place at which one in the cell looks [m].
        at_stops: Whether it takes images at the robots' stops, and not in sweeps alone.
    """

    name: str
    on: str = CELL
    place_m: tuple[float, float, float] = (0.0, -1.0, 1.1)
    looks_at_m: tuple[float, float, float] = MIDDLE_M
    at_stops: bool = True


@dataclass(frozen=True)
class BoardAt(Sheet):
    """A board on a robot's flange, or one that lies in the cell.

    Attributes:
        name: What the session calls it.
        on: The robot on whose flange it is, or `cell`.
        place_m: Where its middle lies in the cell, if it does [m].
        tilt_rad: How far it leans towards the middle of the cell [rad].
    """

    name: str
    on: str = CELL
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt_rad: float = 0.0
    target: Target = field(default=BOARDS["charuco"], kw_only=True)


@dataclass(frozen=True)
class PointAt:
    """A point that instruments read, on a flange or in the cell.

    Attributes:
        name: What the session calls it.
        on: The robot on whose flange it is, or `cell`.
        place_m: Where it is in the frame of that flange, or of the cell [m].
    """

    name: str
    on: str
    place_m: tuple[float, float, float]


@dataclass(frozen=True)
class InstrumentAt:
    """An instrument that stands upright in the cell and reads every point at every stop.

    Where it reads the rotation of a point, too, that is a probe's, whose axes are the flange's.

    Attributes:
        name: What the session calls it.
        place_m: Where it stands [m].
        turn_rad: How far it is turned about the vertical [rad].
        sigma_m: Noise of its readings, per axis [m].
        sigma_rad: Noise of rotations that it reads, too [rad]; 0 where it reads none.
    """

    name: str
    place_m: tuple[float, float, float]
    turn_rad: float = 0.0
    sigma_m: float = 1.5e-5
    sigma_rad: float = 0.0


@dataclass(frozen=True)
class Moved:
    """Something that is pushed in the course of the recording.

    Attributes:
        frame: The frame that hangs otherwise from then on, as `target_floor` or `cam_left`.
        from_stop: The first stop after the push; None for half-way.
        shift_m: How far it is pushed, in a direction of chance [m].
        turn_rad: How far it is turned [rad].
    """

    frame: str
    from_stop: int | None = None
    shift_m: float = 0.005
    turn_rad: float = 0.01


@dataclass(frozen=True)
class Swept(SweepOptions):
    """A camera that sees a target while a robot, which carries one of the two, moves.

    Attributes:
        camera: The camera.
        robot: The robot, which goes through its stops on a smooth way.
        target: The target.
    """

    camera: str
    robot: str
    target: str
    stops: int = field(default=10, kw_only=True)
    frames_hz: float = field(default=10.0, kw_only=True)


@dataclass(frozen=True, eq=False)
class NetworkOptions(DrawOptions):
    """A simulated cell with several of a kind: two robots, two fixed cameras and three boards.

    All stand where they are said to, but for a little. Nothing hides anything else: what is in a
    camera's image is seen.

    Attributes:
        robots: The robots.
        cameras: The cameras.
        boards: The boards.
        instruments: Instruments, if there are any.
        points: The points that these read.
        stops: How often all robots stand still together.
        pace_s: Time from one stop to the next [s]; 0 for rows without a time.
        share_seen: Share of what could be seen that is recorded; the rest is left out by chance.
        lens_views: Images of each camera that are of its lens alone, as the board is held by hand.
        moved: What is pushed in the course of the recording.
        sweeps: What cameras see of robots in motion, after the stops.
        swapped_rows: Pairs of rows of one camera and board whose images are exchanged.
        stray_images: Rows whose image is from another stop.
    """

    robots: tuple[RobotAt, ...] = (
        RobotAt("a", (-0.6, 0.0, 0.0)),
        RobotAt("b", (0.6, 0.05, 0.02)),
    )
    cameras: tuple[CameraAt, ...] = (
        CameraAt("left", place_m=(0.0, -1.0, 1.1)),
        CameraAt("right", place_m=(0.15, 0.95, 1.25), camera=fine_camera()),
    )
    boards: tuple[BoardAt, ...] = (
        BoardAt("floor", place_m=(0.0, 0.0, 0.05)),
        BoardAt("plate_a", "a", target=BOARDS["checkerboard"]),
        BoardAt("plate_b", "b"),
    )
    instruments: tuple[InstrumentAt, ...] = ()
    points: tuple[PointAt, ...] = ()
    stops: int = 30
    pace_s: float = 0.0
    share_seen: float = 1.0
    lens_views: int = 0
    moved: tuple[Moved, ...] = ()
    sweeps: tuple[Swept, ...] = ()
    swapped_rows: int = 0
    stray_images: int = 0

    def __post_init__(self) -> None:
        if self.stops < 1:
            raise DataError(f"simulation: stops is {self.stops}, at least 1 is needed.")
        if any(robot.warms_up for robot in self.robots) and self.pace_s <= 0.0:
            raise DataError("simulation: a robot that warms up needs pace_s, from stop to stop.")
        for robot in self.robots:
            if robot.wrong_stops > self.stops:
                raise DataError(
                    f"simulation: wrong_stops of {robot.name} is {robot.wrong_stops}, 0 to "
                    f"{self.stops} are possible."
                )
        for moved in self.moved:
            if moved.from_stop is not None and moved.from_stop >= self.stops:
                raise DataError(
                    f"simulation: {moved.frame} is pushed before stop {moved.from_stop}; of "
                    f"{self.stops} stops the last is {self.stops - 1}."
                )
        swept = [sweep.robot for sweep in self.sweeps]
        if len(set(swept)) < len(swept):
            raise DataError("simulation: a robot moves in one sweep; in two its streams are one.")
        known = {CELL, *(robot.name for robot in self.robots)}
        on = [(camera.name, camera.on) for camera in self.cameras]
        on += [(board.name, board.on) for board in self.boards] + [
            (point.name, point.on) for point in self.points
        ]
        for name, carrier in on:
            if carrier not in known:
                raise DataError(
                    f"simulation: {name} is on {carrier!r}; there are {', '.join(sorted(known))}."
                )

    def first_pushed(self, moved: Moved) -> int:
        """The first stop after a push."""
        return self.stops // 2 if moved.from_stop is None else moved.from_stop

    @property
    def layout(self) -> "NetworkOptions":
        """What there is, as of every cell."""
        return self


@dataclass(frozen=True, kw_only=True)
class Second(Sheet):
    """A second board of a cell. Every other stop looks at it; it is seen wherever it is in view.

    Attributes:
        turn_rad: How far around the base it lies from the first (eye-in-hand), or to which side of
            the flange it leans (eye-to-hand) [rad].
        tilt_rad: How far it leans: towards the base, or aside [rad].
    """

    target: Target = BOARDS["checkerboard"]
    turn_rad: float = 1.4
    tilt_rad: float = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class CellOptions(ArmOptions, CameraOptions, DrawOptions):
    """A simulated cell of one robot and one camera, in places of chance.

    The defaults are a well-kept one.

    Attributes:
        mount: Where the camera is.
        views: Number of views.
        target: The board as its file states it.
        distance_m: Least and greatest distance of the camera from the board's centre [m]; None
            takes a range in which the board fills the image well, for a camera beside the robot
            within 0.7 to 1.2 m.
        tilt_rad: Least and greatest angle between the view and the board's normal [rad].
        roll_rad: Greatest turn about the optical axis, either way [rad].
        motion: `free`; or, too poor for hand-eye calibration, turning about `one_axis` only or
            `translation` alone.
        branches: Whether the arm takes its elbow, shoulder and wrist either way, from view to view;
            else all postures are near one another, as an operator would teach them.
        cut_views: Share of the views in which the image's edge may cut a ChArUco board.
        wrong_views: Number of views whose report is off by 5 to 30 mm and 1 to 5 degrees.
        board_scale: Printed size over stated size.
        board_bow_m: How far the board's corners are bent away from the camera [m].
        second: A second board; None for a cell with one.
        camera_moved_m: How far the camera was pushed from where it sits in this cell [m].
    """

    mount: Mount = "eye-in-hand"
    views: int = 20
    target: Target = BOARDS["charuco"]
    distance_m: tuple[float, float] | None = None
    tilt_rad: tuple[float, float] = Viewpoints.tilt_rad
    roll_rad: float = Viewpoints.roll_rad
    motion: Motion = Viewpoints.motion
    branches: bool = False
    cut_views: float = Viewpoints.cut_views
    wrong_views: int = 0
    board_scale: float = 1.0
    board_bow_m: float = 0.0
    second: Second | None = None
    camera_moved_m: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.views < 1:
            raise DataError(f"simulation: views is {self.views}, at least 1 is needed.")
        if not 0 <= self.wrong_views <= self.views:
            raise DataError(
                f"simulation: wrong_views is {self.wrong_views}, 0 to {self.views} are possible."
            )
        if not 0.0 <= self.tilt_rad[0] <= self.tilt_rad[1] < 1.5:
            raise DataError(
                f"simulation: tilt_rad is {self.tilt_rad}, an ascending range in 0 to 1.5 is "
                "needed: beyond it the camera looks at the board's edge."
            )

    @property
    def layout(self) -> NetworkOptions:
        """What there is, as of every cell: a robot, a camera and an only board have no names."""
        camera_on, board_on = ("", CELL) if self.mount == "eye-in-hand" else (CELL, "")
        sheets = [Sheet(target=self.target, scale=self.board_scale, bow_m=self.board_bow_m)]
        sheets += [self.second] if self.second else []
        names = _TWO_BOARDS if self.second else ("",)
        return NetworkOptions(
            robots=(
                RobotAt("", (0.0, 0.0, 0.0), wrong_stops=self.wrong_views, **self.part(ArmOptions)),
            ),
            cameras=(CameraAt("", camera_on, **self.part(CameraOptions)),),
            boards=tuple(
                BoardAt(name, board_on, target=sheet.target, scale=sheet.scale, bow_m=sheet.bow_m)
                for name, sheet in zip(names, sheets, strict=True)
            ),
            stops=self.views,
            pace_s=_PACE_S,
            **self.part(DrawOptions),
        )

    def part(self, kind: type[ArmOptions | CameraOptions | DrawOptions]) -> dict[str, Any]:
        """The fields of a part by their names, for options that have such a part likewise."""
        return {entry.name: getattr(self, entry.name) for entry in fields(kind)}

"""Options of simulated cells: components, faults, and independent sources of randomness."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Annotated, Any, TypeAlias

import numpy as np

from visioncal.core.arguments import check_fields
from visioncal.core.codec import (
    BY_NAME,
    Check,
    Count,
    Finite,
    Key,
    NotNegative,
    Strict,
    WrittenForm,
    within,
    wrong_value,
)
from visioncal.core.errors import DataError
from visioncal.core.types import Camera, Mount, Target
from visioncal.session import frame_name
from visioncal.session.document import NAME
from visioncal.simulation.arms import ArmOptions
from visioncal.simulation.boards import BOARDS, TARGETS, Sheet
from visioncal.simulation.optics import CAMERAS
from visioncal.simulation.poses import Motion, Viewpoints

# Centre of the cell, which robots face [m].
MIDDLE_M = (0.0, 0.0, 0.4)
CELL = "cell"
Place: TypeAlias = tuple[Finite, Finite, Finite]
Whole: TypeAlias = Annotated[int, Check("a whole number from 0 on", lambda value: value >= 0)]
ThingName: TypeAlias = Annotated[
    str,
    Check(
        f"a name of letters, digits and _ after a letter, and not {CELL!r}",
        lambda name: NAME.fullmatch(name) is not None and name != CELL,
    ),
]
# Board names in the session of a cell with two boards.
_TWO_BOARDS = ("first", "second")


class RandomStream(IntEnum):
    """Sources of randomness; those from 100 on are for cells with named things."""

    MOUNTING = 0
    POSES = 1
    ARM = 2
    ROBOT = 3
    WRONG = 4
    PIXELS = 5
    IMAGES = 6
    BACKDROP = 7
    PAIRS = 8
    LENS = 9
    SWEEP = 10
    BUMP = 11
    TOUCHES = 12
    DEPTH = 13
    MOUNTINGS = 100
    POSTURES = 101
    ARMS = 102
    ROBOTS = 103
    CORNERS = 104
    MEASURED = 105
    FAULTS = 106
    SHARE = 107
    LENS_VIEWS = 108
    READINGS = 109
    SWEEPS = 111


def _named(things: Mapping[str, object]) -> WrittenForm:
    """A thing that a file of a cell names."""

    def named(name: object, path: str) -> object:
        if name not in things:
            raise wrong_value(name, f"one of {', '.join(things)}", path)
        return things[str(name)]

    return WrittenForm(str, named)


# Sources that another recording of the same cell keeps.
_KEPT = (
    *(RandomStream.MOUNTING, RandomStream.ARM, RandomStream.LENS),
    *(RandomStream.MOUNTINGS, RandomStream.ARMS, RandomStream.LENS_VIEWS),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawOptions:
    """Random seed of a cell, and the noise of corners."""

    pixel_sigma_px: NotNegative = 0.05  # Noise of simulated detections, per axis [px].
    # Seed of everything random. Each source of randomness has its own stream, so that changing one
    # option does not change the draws of others.
    seed: Whole = 0
    # Number of the recording of the same cell and arms, with stops and noise of its own.
    recording: Whole = 0

    def stream(self, purpose: RandomStream, *index: int) -> np.random.Generator:
        """Generator of one source of randomness; `index` is of the thing or the view."""
        extra = []
        if self.recording and purpose not in _KEPT:
            # Distinguishes a recording's randomness.
            extra = [1000, self.recording]
        return np.random.default_rng([self.seed, int(purpose), *extra, *index])


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraOptions:
    """A camera with its stated intrinsics and the quality of its images."""

    camera: Annotated[Camera, _named(CAMERAS)] = CAMERAS["wide"]  # True optics.
    state_intrinsics: bool = True  # Whether the session states the intrinsics.
    # Error of the stated intrinsics, as root mean square over the image [px].
    lens_mismatch_px: NotNegative = 0.0
    blur_px: NotNegative = 0.7  # Defocus of rendered images, as a Gaussian's sigma [px].
    image_noise: NotNegative = 2.0  # Noise of rendered images [grey levels].
    vignetting: NotNegative = 0.2  # Relative loss of light in the image's corners.
    jpeg_quality: Whole | None = None  # 1 to 100; None writes lossless PNG.


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """Timing and noise of a sweep."""

    stops: Whole = 12  # Number of postures on its path.
    pace_s: NotNegative = 1.7  # Time between postures [s].
    robot_hz: NotNegative = 125.0  # Samples of the controller per second.
    frames_hz: NotNegative = 30.0  # Frames of the camera per second.
    # Time from an image's first row to its last, with the stamp at the middle [s]; 0 for a global
    # shutter.
    readout_s: NotNegative = 0.0
    # Offset of the camera's clock relative to the controller's [s].
    camera_minus_robot_s: Finite = 0.0
    jitter_s: NotNegative = 0.0  # Standard deviation of the camera's stamps [s].
    encoder_sigma_rad: NotNegative = 2e-6  # Noise of the reported joint angles [rad].

    def __post_init__(self) -> None:
        if self.stops < 2 or min(self.pace_s, self.robot_hz, self.frames_hz) <= 0.0:
            raise DataError("simulation: a sweep needs two stops, and times and rates above 0.")


@dataclass(frozen=True)
class RobotAt(Strict, ArmOptions):
    """A robot in the cell, facing the centre."""

    name: ThingName  # Name in the session.
    place_m: Place  # Position of its base in the cell [m].
    robot: str = field(default="ur5e", kw_only=True)
    warms_up: bool = False  # Whether it is cold at the first stop and warms up while it works.
    wrong_stops: Whole = 0  # Number of stops whose report is off by 5 to 30 mm and 1 to 5 degrees.


@dataclass(frozen=True, eq=False)
class CameraAt(Strict, CameraOptions):
    """A camera on a robot's flange, or fixed in the cell."""

    name: ThingName  # Name in the session.
    on: str = CELL  # The robot that carries it, or `cell`.
    place_m: Place = (0.0, -1.0, 1.1)  # Position in the cell, if fixed [m].
    looks_at_m: Place = MIDDLE_M  # Point that a fixed one looks at [m].
    at_stops: bool = True  # Whether it takes images at the robots' stops, and not only in sweeps.


@dataclass(frozen=True)
class BoardAt(Strict, Sheet):
    """A board on a robot's flange, or fixed in the cell."""

    name: ThingName  # Name in the session.
    on: str = CELL  # The robot that carries it, or `cell`.
    # Position of its centre in the cell, if fixed [m].
    place_m: Place = (0.0, 0.0, 0.0)
    tilt_rad: Finite = 0.0  # Tilt towards the centre of the cell [rad].
    target: Annotated[Target, _named(TARGETS)] = field(default=BOARDS["charuco"], kw_only=True)


@dataclass(frozen=True)
class PointAt(Strict):
    """A point read by instruments, on a flange or in the cell."""

    name: ThingName  # Name in the session.
    on: str  # The robot that carries it, or `cell`.
    place_m: Place  # Position in the frame of that flange, or of the cell [m].


@dataclass(frozen=True)
class InstrumentAt(Strict):
    """An upright instrument in the cell that reads every point at every stop.

    If it also reads rotations, points are probes, with the axes of the flange.
    """

    name: ThingName  # Name in the session.
    place_m: Place  # Position in the cell [m].
    turn_rad: Finite = 0.0  # Rotation about the vertical [rad].
    sigma_m: NotNegative = 1.5e-5  # Noise of readings, per axis [m].
    sigma_rad: NotNegative = 0.0  # Noise of rotation readings [rad]; 0 if it reads no rotations.


@dataclass(frozen=True)
class Moved(Strict):
    """A component that is pushed during the recording."""

    frame: str  # Frame that moves on its parent, as `target_floor` or `cam_left`.
    from_stop: Whole | None = None  # First stop after the push; None for half way.
    shift_m: Finite = 0.005  # Length of the displacement, in a random direction [m].
    turn_rad: Finite = 0.01  # Angle of the rotation, about a random axis [rad].
    # Whether it creeps by so much instead, evenly up to its place at the last stop.
    creeps: bool = False


@dataclass(frozen=True)
class Swept(Strict, SweepOptions):
    """A camera that observes a target during a robot's motion, which carries one of the two."""

    camera: str  # The camera.
    robot: str  # The robot, which moves smoothly through its stops.
    target: str  # The target.
    stops: Whole = field(default=10, kw_only=True)
    frames_hz: NotNegative = field(default=10.0, kw_only=True)


@dataclass(frozen=True, eq=False)
class NetworkOptions(Strict, DrawOptions):
    """A simulated cell of several robots, cameras and boards; by default two, two and three.

    All poses deviate slightly from the stated ones. There is no occlusion.
    """

    # The robots.
    robots: Annotated[tuple[RobotAt, ...], BY_NAME] = (
        RobotAt("a", (-0.6, 0.0, 0.0)),
        RobotAt("b", (0.6, 0.05, 0.02)),
    )
    # The cameras.
    cameras: Annotated[tuple[CameraAt, ...], BY_NAME] = (
        CameraAt("left", place_m=(0.0, -1.0, 1.1)),
        CameraAt("right", place_m=(0.15, 0.95, 1.25), camera=CAMERAS["fine"]),
    )
    # The boards.
    boards: Annotated[tuple[BoardAt, ...], BY_NAME, Key("targets")] = (
        BoardAt("floor", place_m=(0.0, 0.0, 0.05)),
        BoardAt("plate_a", "a", target=BOARDS["checkerboard"]),
        BoardAt("plate_b", "b"),
    )
    instruments: Annotated[tuple[InstrumentAt, ...], BY_NAME] = ()  # The instruments.
    points: Annotated[tuple[PointAt, ...], BY_NAME] = ()  # Points that these read.
    stops: Count = 30  # Number of stops, common to all robots.
    pace_s: NotNegative = 0.0  # Time between stops [s]; 0 for rows without a time.
    # Share of the possible observations that is recorded, at random.
    share_seen: Annotated[float, within(1e-6, 1.0)] = 1.0
    # Number of images of each camera for its intrinsics only, with a hand-held board.
    lens_views: Whole = 0
    moved: tuple[Moved, ...] = ()  # Components that are pushed during the recording.
    sweeps: tuple[Swept, ...] = ()  # Sweeps after the stops.
    # Number of pairs of rows of one camera and board whose images are exchanged.
    swapped_rows: Whole = 0
    stray_images: Whole = 0  # Number of rows whose image is from another stop.

    def __post_init__(self) -> None:
        check_fields(self, "simulation")
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
        carriers = [(camera.name, camera.on) for camera in self.cameras]
        carriers += [(board.name, board.on) for board in self.boards] + [
            (point.name, point.on) for point in self.points
        ]
        for name, carrier in carriers:
            if carrier not in known:
                raise DataError(
                    f"simulation: {name} is on {carrier!r}; there are {', '.join(sorted(known))}."
                )

    def first_pushed(self, moved: Moved) -> int:
        """First stop after a push."""
        return self.stops // 2 if moved.from_stop is None else moved.from_stop

    @property
    def layout(self) -> "NetworkOptions":
        """Layout of the cell, as for every cell."""
        return self

    @property
    def parents(self) -> dict[str, str]:
        """Parent of each frame but the flanges, by its name in a session."""
        parents = {frame_name("base", robot.name): CELL for robot in self.robots if robot.name}
        root = CELL if parents else "base"
        for kind, things in (
            ("camera", self.cameras),
            ("target", self.boards),
            ("point", self.points),
        ):
            for thing in things:
                parent = root if thing.on == CELL else frame_name("flange", thing.on)
                parents[frame_name(kind, thing.name)] = parent
        return parents | {frame_name("instrument", item.name): root for item in self.instruments}


@dataclass(frozen=True, kw_only=True)
class Second(Sheet):
    """A second board of a cell, at which every other stop aims; it is observed whenever in view."""

    target: Target = BOARDS["checkerboard"]
    # Angle around the base from the first board (eye-in-hand), or direction of its offset on the
    # flange (eye-to-hand) [rad].
    turn_rad: Finite = 1.4
    tilt_rad: Finite = 0.3  # Tilt: towards the base, or sideways [rad].


@dataclass(frozen=True, eq=False, kw_only=True)
class CellOptions(ArmOptions, CameraOptions, DrawOptions):
    """A simulated cell of one robot and one camera at random poses.

    The defaults are a well-maintained cell.
    """

    mount: Mount = "eye-in-hand"  # Where the camera is.
    views: Count = 20  # Number of views.
    target: Target = BOARDS["charuco"]  # Board as its file describes it.
    # Range of the camera's distance from the board's centre [m]; None for a range in which the
    # board fills the image well, limited to 0.7 to 1.2 m for a fixed camera.
    distance_m: tuple[float, float] | None = None
    # Range of the angle between view and board normal [rad].
    tilt_rad: tuple[float, float] = Viewpoints.tilt_rad
    # Largest rotation about the optical axis, either way [rad].
    roll_rad: float = Viewpoints.roll_rad
    # `free`; or, degenerate for hand-eye calibration, rotation about `one_axis` only, or
    # `translation` only.
    motion: Motion = Viewpoints.motion
    # Whether elbow, shoulder and wrist configurations vary between views; else all postures are
    # close to each other, as an operator would teach them.
    branches: bool = False
    # Share of views in which the image's edge may cut a ChArUco board.
    cut_views: float = Viewpoints.cut_views
    wrong_views: int = 0  # Number of views whose report is off by 5 to 30 mm and 1 to 5 degrees.
    board_scale: float = 1.0  # Printed size over stated size.
    # Depth of the board's corners relative to its centre, away from the camera [m].
    board_bow_m: float = 0.0
    second: Second | None = None  # Second board; None for a single board.
    camera_moved_m: float = 0.0  # Displacement of the camera from its usual pose in this cell [m].

    def __post_init__(self) -> None:
        check_fields(self, "simulation")
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
        """Layout of the cell; robot, camera and a single board have no names."""
        camera_on, board_on = ("", CELL) if self.mount == "eye-in-hand" else (CELL, "")
        sheets = [Sheet(target=self.target, scale=self.board_scale, bow_m=self.board_bow_m)]
        sheets += [self.second] if self.second else []
        names = _TWO_BOARDS if self.second else ("",)
        # At an operator's pace.
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
            pace_s=4.0,
            **self.part(DrawOptions),
        )

    def part(self, kind: type[ArmOptions | CameraOptions | DrawOptions]) -> dict[str, Any]:
        """Fields of a base class by name, for options with the same base class."""
        return {entry.name: getattr(self, entry.name) for entry in fields(kind)}

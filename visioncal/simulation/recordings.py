"""Recordings of a simulated cell: at stops, in a sweep, or while its arm warms up.

Camera and controller have separate clocks. In a sweep the joints have continuous acceleration; the
camera takes frames at its own rate, and the controller reports joints and poses at a higher one.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.transforms import apply_each, compose, invert
from visioncal.core.types import Corners, FloatArray
from visioncal.session import Stream as Recorded
from visioncal.session import frame_name
from visioncal.session.columns import POSE
from visioncal.simulation.arms import DhArm, forward
from visioncal.simulation.boards import Sheet, corners_m, detectable_in_part
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.heat import Heat, Warming, heated_flanges, warm_up
from visioncal.simulation.layout import (
    CELL,
    CameraOptions,
    CellOptions,
    NetworkOptions,
    RandomStream,
    SweepOptions,
    Swept,
)
from visioncal.simulation.observing import (
    EDGE_PX,
    detected,
    moved_cell,
    observed,
    parent_poses,
    with_detections,
    with_faults,
)
from visioncal.simulation.optics import project, sees
from visioncal.simulation.postures import mounted, mounted_single, postures_of, postures_single

# Minimum number of corners, and smallest cosine of obliqueness, of a recorded frame.
_FEWEST_OF_CELL, _FACING = 12, 0.5
# Iterations of a corner's row and its time, which converge by some thousandths each.
_ROUNDS = 5
# Minimum number of corners for a pose.
_FEWEST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class Passage:
    """A smooth joint path through a robot's stops, and its sampling times."""

    options: SweepOptions  # Options of the sweep.
    path: CubicSpline  # Joint path (k, n) [rad] over k times [s], with continuous acceleration.
    robot_s: FloatArray  # Times of the controller's reports, by its own clock [s].
    taken_s: FloatArray  # Times of the frames' middle rows, by that clock [s].

    @classmethod
    def through(cls, stops: FloatArray, options: SweepOptions) -> "Passage":
        """A path through (s, n) postures [rad], in nearest-neighbour order."""
        left, order = list(range(1, len(stops))), [0]
        while left:
            distances = [float(np.abs(stops[index] - stops[order[-1]]).max()) for index in left]
            order.append(left.pop(int(np.argmin(distances))))
        way = CubicSpline(options.pace_s * np.arange(len(stops)), stops[order], bc_type="clamped")
        end_s = options.pace_s * (len(stops) - 1)
        return cls(
            options,
            way,
            np.arange(0.0, end_s, 1.0 / options.robot_hz),
            np.arange(0.5 / options.frames_hz, end_s, 1.0 / options.frames_hz),
        )

    def reported(self, arm: DhArm, rng: np.random.Generator) -> Recorded:
        """The controller's stream, from the nominal arm and noisy encoders."""
        joints = self.path(self.robot_s)
        joints = joints + self.options.encoder_sigma_rad * rng.standard_normal(joints.shape)
        poses = forward(arm, joints)
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        # Quaternions keep their sign.
        flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
        quaternions[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
        names = [f"q{joint + 1}_rad" for joint in range(joints.shape[1])]
        values = np.hstack([self.robot_s[:, None], poses[:, :3, 3], quaternions, joints])
        return Recorded(("stamp_s", *POSE, *names), values)

    def frame(
        self,
        taken_s: float,
        before: Callable[[FloatArray], FloatArray],
        camera: CameraOptions,
        sheet: Sheet,
        view: int,
    ) -> Corners:
        """Corners of one frame, each at the time of its image row.

        `before` maps k postures (k, n) [rad] to `cam_from_target` (k, 4, 4); `taken_s` is the time
        of the middle row.
        """
        corners, optics = corners_m(sheet), camera.camera
        delays_s = np.zeros(len(corners))
        for _ in range(_ROUNDS if self.options.readout_s else 1):
            points = apply_each(before(self.path(taken_s + delays_s)), corners)
            px = project(optics, points)
            delays_s = self.options.readout_s * (px[:, 1] / (optics.resolution[1] - 1) - 0.5)
        ids = np.flatnonzero(sees(optics, points, EDGE_PX)).astype(np.int64)
        return Corners(view, ids, px[ids], camera.blur_px)


def with_sweep(cell: SimulatedCell, swept: Swept, pushed: SimulatedCell) -> SimulatedCell:
    """A cell with the frames of one camera during a sweep of one robot.

    Args:
        cell: The cell at its stops.
        swept: The sweep.
        pushed: The cell after all pushes.

    Raises:
        DataError: A component is unknown, or the robot does not move target and camera relative to
            each other.
    """
    _check(cell, swept)
    options, robot = cell.options, cell.robots[swept.robot]
    index = list(cell.robots).index(swept.robot)
    rng, stamp_noise = (
        options.stream(RandomStream.SWEEPS, index),
        options.stream(RandomStream.SWEEPS, index, 1),
    )
    passage = Passage.through(robot.joints[: swept.stops], swept)
    recorded = passage.reported(robot.arm, rng)
    camera, board = cell.camera(swept.camera), cell.board(swept.target)
    min_corners = _FEWEST_OF_CELL if detectable_in_part(board.target) else len(corners_m(board))
    seen_from = pushed.seen_from(swept.robot, swept.camera, swept.target)
    used_views = [sight.view for sight in cell.sights] + [reading.view for reading in cell.readings]
    first_view = 1 + max([*used_views, *(row[0] for row in cell.pose_rows)], default=-1)
    sights: list[SimulatedSight] = []

    def before(jitter: FloatArray, q: FloatArray) -> FloatArray:
        return seen_from(robot.flange_at(q) @ jitter)

    for taken_s in passage.taken_s.tolist():
        seen = partial(before, robot.options.jitter(1, rng))
        exact = passage.frame(taken_s, seen, camera, board, first_view + len(sights))
        middle = seen(passage.path([taken_s]))[0]
        if len(exact.ids) < min_corners or middle[2, 2] < _FACING:
            continue
        corners = detected(board, exact, options.pixel_sigma_px, rng)
        ahead_s = swept.camera_minus_robot_s + swept.jitter_s * stamp_noise.standard_normal()
        names = swept.camera, swept.target
        stamp_s, at_once = taken_s + ahead_s, not swept.readout_s
        sights.append(
            SimulatedSight(exact.view, -1, *names, middle, exact, corners, stamp_s, at_once)
        )
    streams = {**cell.streams, swept.robot: recorded}
    return replace(cell, sights=(*cell.sights, *sights), streams=streams)


def _check(cell: SimulatedCell, swept: Swept) -> None:
    """Checks that the components of a sweep exist and move relative to each other."""
    layout = cell.layout
    for kind, name, things in (
        ("robot", swept.robot, layout.robots),
        ("camera", swept.camera, layout.cameras),
        ("target", swept.target, layout.boards),
    ):
        known = [thing.name for thing in things]
        if name not in known:
            raise DataError(
                f"simulation: a sweep is of {kind} {name!r}; there are {', '.join(known)}."
            )
    ends = frame_name("camera", swept.camera), frame_name("target", swept.target)
    carriers = [cell.parents[end] for end in ends]
    if sorted(carriers) != sorted((CELL, frame_name("flange", swept.robot))):
        raise DataError(
            f"simulation: of camera {swept.camera} and target {swept.target} of a sweep, one has "
            f"to be on robot {swept.robot} and the other in the cell."
        )


def sweep(options: CellOptions, how: SweepOptions | None = None) -> SimulatedCell:
    """Simulates a sweep of a cell's robot.

    Args:
        options: The cell; `views` is set by the sweep.
        how: Options of the sweep.

    Returns:
        The cell at the frames, each of which is a view with a time; the controller's stream, with
        its own clock, is `robot`.

    Raises:
        DataError: As `simulate`; or fewer than two frames show the board.
    """
    how = how or SweepOptions()
    stops = simulate(replace(options, views=how.stops, wrong_views=0)).robot.joints
    passage = Passage.through(stops, how)
    options = replace(options, views=len(passage.taken_s), wrong_views=0)
    frames = simulate(options, passage.path(passage.taken_s))
    if how.readout_s:
        frames = _rolling_shutter(frames, passage)
    seen = [sight.view for sight in frames.sights if len(sight.exact.ids) >= _FEWEST_CORNERS]
    if len(seen) < 2:
        raise DataError(f"simulation: {len(seen)} frames of the sweep show the board.")
    taken_s = passage.taken_s[[frames.sights[view].stop for view in seen]]
    rng = options.stream(RandomStream.SWEEP)
    recorded = passage.reported(frames.robot.arm, rng)
    offsets_s = how.camera_minus_robot_s + how.jitter_s * rng.standard_normal(len(taken_s))
    kept = frames.only(seen)
    sights = zip(kept.sights, (taken_s + offsets_s).tolist(), strict=True)
    return replace(
        kept,
        options=replace(options, views=len(seen)),
        sights=tuple(replace(sight, stamp_s=stamp_s) for sight, stamp_s in sights),
        streams={"robot": recorded},
        facts={"camera_minus_robot_s": how.camera_minus_robot_s, "readout_s": how.readout_s},
    )


def _rolling_shutter(frames: SimulatedCell, passage: Passage) -> SimulatedCell:
    """The frames of a rolling shutter, with every corner at the time of its row."""
    robot = frames.robot
    jitter = invert(robot.flange_at(robot.joints)) @ robot.true_base_from_flange

    def rolled(sight: SimulatedSight) -> SimulatedSight:
        seen_from = frames.seen_from("", sight.camera, sight.board)

        def before(row_jitter: FloatArray, q: FloatArray) -> FloatArray:
            return seen_from(robot.flange_at(q) @ row_jitter)

        exact = passage.frame(
            float(passage.taken_s[sight.stop]),
            partial(before, jitter[sight.stop]),
            frames.camera(),
            frames.board(sight.board),
            sight.view,
        )
        return replace(sight, exact=exact, at_once=False)

    return with_detections(replace(frames, sights=tuple(rolled(sight) for sight in frames.sights)))


@typed
def simulate(
    options: CellOptions | NetworkOptions, postures: FloatArray | None = None
) -> SimulatedCell:
    """Builds a cell, moves its robots and observes its boards.

    Args:
        options: Options of the cell. The same options give the same cell.
        postures: (m, n) joint angles of the robot of `CellOptions`, one row per stop, whether or
            not the camera sees the board there [rad]; None draws postures with a board in the
            image.

    Returns:
        The cell with true and reported values.

    Raises:
        DataError: An arm is unknown, a camera's coefficients do not fit its model, or a robot
            cannot reach enough poses with a board in view.
    """
    if isinstance(options, CellOptions):
        placed = mounted_single(options)
        if postures is None:
            joints = postures_single(options, placed)
        else:
            joints = np.array(postures, dtype=float)
            options = replace(options, views=len(joints))
        # The camera is displaced in a random direction.
        shift = options.stream(RandomStream.BUMP).standard_normal(3)
        shift *= options.camera_moved_m / np.linalg.norm(shift)
        placed["cam"] = placed["cam"] @ compose(np.eye(3), shift)
        cell = observed(moved_cell(options, placed, {"": joints}))
        wrong = [sight.view for sight in cell.sights if sight.stop in cell.robot.wrong_stops]
        return replace(cell, wrong_views=tuple(wrong))
    if postures is not None:
        raise DataError("simulation: postures are taken by a cell of one robot alone.")
    placed = mounted(options)
    cell = with_faults(observed(moved_cell(options, placed, postures_of(options, placed))))
    pushed = replace(
        cell, mountings={name: array[-1] for name, array in parent_poses(cell).items()}
    )
    for swept in options.sweeps:
        cell = with_sweep(cell, swept, pushed)
    return cell


@dataclass(frozen=True, eq=False)
class Round:
    """Schedule of views during a warm-up."""

    first: int = 24  # Number of different views at the start, before the arm is warm.
    references: int = 6  # Number of them that are repeated.
    every_s: float = 300.0  # Time between repetitions [s].
    minutes: float = 100.0  # Duration of the repetitions [min].
    pace_s: float = 5.0  # Time between views [s].

    def schedule(self) -> tuple[FloatArray, Sequence[int]]:
        """(m,) times [s], and indices of the views."""
        stamps = list(self.pace_s * np.arange(self.first))
        shown = list(range(self.first))
        again = np.linspace(0, self.first - 1, self.references).astype(int).tolist()
        for begin in np.arange(self.every_s, 60.0 * self.minutes, self.every_s):
            stamps += list(begin + self.pace_s * np.arange(self.references))
            shown += again
        return np.array(stamps), shown


@dataclass(frozen=True, eq=False)
class WarmUpOptions:
    """Options of a cell whose arm warms up."""

    cell: CellOptions = field(default_factory=CellOptions)  # The cell.
    heat: Heat | None = None  # Thermal parameters of the arm; None draws them by the cell's seed.
    round: Round = field(default_factory=Round)  # Schedule of views.
    hours: float = 5.0  # Duration of the temperature record [h].
    temperatures: bool = True  # Whether the controller reports temperatures; otherwise currents.

    @property
    def heats(self) -> Heat:
        """Thermal parameters of the arm."""
        return self.heat or Heat.drawn(self.cell.seed)

    def warming(self) -> Warming:
        """Temperatures over the whole duration."""
        return warm_up(self.heats, self.hours, seed=self.cell.seed)


def simulate_warm_up(options: WarmUpOptions) -> SimulatedCell:
    """Observes a cell's board while its arm warms up.

    Returns:
        The views, each with the arm's temperature at its time; temperatures or currents until the
        last view are in the stream `heat`.

    Raises:
        DataError: As `simulate`.
    """
    heat, warming = options.heats, options.warming()
    stamps_s, shown = options.round.schedule()
    postures = simulate(replace(options.cell, views=options.round.first)).robot.joints
    cold = simulate(options.cell, postures[list(shown)])
    robot, links_c = cold.robot, warming.at(stamps_s)
    warm_poses = heated_flanges(
        robot.true_arm, heat, robot.joints, links_c, robot.true_base_from_flange
    )
    warm = replace(cold, robots={"": replace(robot, true_base_from_flange=warm_poses)})
    return replace(
        observed(warm),
        stamps_s=stamps_s,
        streams={
            "heat": warming.recorded(temperatures=options.temperatures, until_s=float(stamps_s[-1]))
        },
        facts={"heat": asdict(heat)},
    )

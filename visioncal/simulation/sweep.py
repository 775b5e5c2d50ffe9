"""A sweep: the robot moves without a rest, and camera and controller stamp by clocks of their own.

The flange goes through a cell's stops on a smooth way, with joints of continuous acceleration. The
camera takes frames at its rate, wherever the robot is; the controller reports its joints and poses
at a higher one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import Corners, FloatArray
from visioncal.session import Stream as Recorded
from visioncal.session import frame_name
from visioncal.simulation.arms import Arm, forward
from visioncal.simulation.boards import Sheet, corners_m, found_in_part
from visioncal.simulation.cell import (
    EDGE_PX,
    Cell,
    before_camera,
    detected,
    simulate,
)
from visioncal.simulation.draws import Stream
from visioncal.simulation.layout import CELL, Swept
from visioncal.simulation.observed_points import Network, Sight, board_named, camera_named
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CameraOptions, CellOptions, SweepOptions
from visioncal.simulation.rows import POSE
from visioncal.simulation.second import chains

# A frame that shows less of the board gives no pose.
_FEWEST_CORNERS = 8
# A frame of a whole cell that shows less of the board, or shows it more askew, is not recorded.
_FEWEST_OF_CELL, _FACING = 12, 0.5
# When a row is taken depends on where its corner is then: by a few thousandths less each time.
_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class Sweep:
    """A simulated sweep.

    Attributes:
        options: How it was made.
        cell: The cell at the m frames, each of them a view.
        frames_s: (m,) when they were taken, by the camera's clock [s].
        robot: What the controller reported: `stamp_s` by its own clock, poses and joints.
    """

    options: SweepOptions
    cell: Cell
    frames_s: FloatArray
    robot: Recorded


def sweep(options: CellOptions, how: SweepOptions | None = None) -> Sweep:
    """Sweeps a cell's robot through as many of its stops as are asked for.

    Args:
        options: The cell; `views` is set by the sweep.
        how: How it is swept.

    Raises:
        DataError: As `simulate`; or fewer than two frames show the board.
    """
    how = how or SweepOptions()
    stops = simulate(replace(options, views=how.stops, wrong_views=0)).joints
    passage = Passage.through(stops, how)
    taken_s = passage.taken_s
    options = replace(options, views=len(taken_s), wrong_views=0)
    frames = simulate(options, passage.way(taken_s))
    if how.readout_s:
        frames = _by_rows(frames, passage)
    seen = [
        at
        for at, corners_ in enumerate(frames.exact_corners)
        if len(corners_.ids) >= _FEWEST_CORNERS
    ]
    if len(seen) < 2:
        raise DataError(f"simulation: {len(seen)} frames of the sweep show the board.")
    taken_s = taken_s[seen]
    rng = options.stream(Stream.SWEEP)
    recorded = passage.reported(frames.arm, rng)
    ahead_s = how.camera_minus_robot_s + how.jitter_s * rng.standard_normal(len(taken_s))
    kept = replace(frames.only(seen), options=replace(options, views=len(seen)))
    return Sweep(how, kept, taken_s + ahead_s, recorded)


@dataclass(frozen=True, eq=False)
class Passage:
    """A smooth way of a robot's joints through its stops, and when it is sampled.

    Attributes:
        options: How the sweep is made.
        way: Joint angles (k, n) [rad] at k times [s], of continuous acceleration.
        robot_s: When the controller reports, by its own clock [s].
        taken_s: When the camera takes the middles of its frames, by that clock [s].
    """

    options: SweepOptions
    way: CubicSpline
    robot_s: FloatArray
    taken_s: FloatArray

    @classmethod
    def through(cls, stops: FloatArray, how: SweepOptions) -> "Passage":
        """The way through (s, n) postures [rad], each time to the nearest that is left."""
        way = CubicSpline(how.pace_s * np.arange(len(stops)), _in_turn(stops), bc_type="clamped")
        end_s = how.pace_s * (len(stops) - 1)
        return cls(
            how,
            way,
            np.arange(0.0, end_s, 1.0 / how.robot_hz),
            np.arange(0.5 / how.frames_hz, end_s, 1.0 / how.frames_hz),
        )

    def reported(self, arm: Arm, rng: np.random.Generator) -> Recorded:
        """The controller's stream, by the nominal arm and encoders with noise."""
        joints = self.way(self.robot_s)
        joints = joints + self.options.encoder_sigma_rad * rng.standard_normal(joints.shape)
        poses = forward(arm, joints)
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        # A quaternion does not jump to its negative.
        turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
        quaternions[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
        names = [f"q{at + 1}_rad" for at in range(joints.shape[1])]
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
        """The corners of one frame, each where it was when its row of the image was taken.

        Args:
            taken_s: When its middle row was taken [s].
            before: `cam_from_target` (k, 4, 4) at k postures (k, n) [rad].
            camera: The camera.
            sheet: The board.
            view: The frame's number.
        """
        corners, optics = corners_m(sheet), camera.camera
        late_s = np.zeros(len(corners))
        for _ in range(_ROUNDS if self.options.readout_s else 1):
            poses = before(self.way(taken_s + late_s))
            points = (poses[:, :3, :3] @ corners[:, :, None])[:, :, 0] + poses[:, :3, 3]
            px = project(optics, points)
            late_s = self.options.readout_s * (px[:, 1] / (optics.resolution[1] - 1) - 0.5)
        ids = np.flatnonzero(sees(optics, points, EDGE_PX)).astype(np.int64)
        return Corners(view, ids, px[ids], camera.blur_px)


def _by_rows(cell: Cell, passage: Passage) -> Cell:
    """The cell with every corner where it was when its row was taken."""
    options = cell.options
    jitter = invert(cell.flange_at(cell.joints)) @ cell.true_base_from_flange
    chained = [*chains(cell.transforms)]

    def before(chain: Mapping[str, FloatArray], off: FloatArray, q: FloatArray) -> FloatArray:
        return before_camera(chain, cell.flange_at(q) @ off)

    exact = [
        passage.frame(
            float(passage.taken_s[stop]),
            partial(before, chained[board], off),
            options,
            cell.sheets[board],
            view,
        )
        for view, (stop, board, off) in enumerate(
            zip(cell.shown.stops, cell.shown.boards, jitter, strict=True)
        )
    ]
    return cell.showing(exact)


def _in_turn(stops: FloatArray) -> FloatArray:
    """Orders postures so that each is the nearest to the one before of those that are left."""
    left = list(range(1, len(stops)))
    order = [0]
    while left:
        away = [float(np.abs(stops[at] - stops[order[-1]]).max()) for at in left]
        order.append(left.pop(int(np.argmin(away))))
    return stops[order]


def sweep_network(
    cell: Network, swept: Swept, transforms: Mapping[str, FloatArray], first_view: int
) -> tuple[list[Sight], Recorded]:
    """The frames of one camera while one robot goes through its stops, and the robot's stream.

    Args:
        cell: The cell at its stops.
        swept: What moves, and what is seen.
        transforms: (4, 4) where each frame hangs in its parent, once all is pushed.
        first_view: The first frame's number.

    Raises:
        DataError: There is no such thing, or that robot does not move the one before the other.
    """
    options = cell.options
    seen_from = _chain(cell, swept, transforms)
    at = [robot.name for robot in options.robots].index(swept.robot)
    robot, rng = options.robots[at], options.stream(Stream.SWEEPS, at)
    ticks = options.stream(Stream.SWEEPS, at, 1)
    passage = Passage.through(cell.joints[swept.robot][: swept.stops], swept)
    reported = passage.reported(cell.arms[swept.robot], rng)
    camera, sheet = camera_named(options, swept.camera), board_named(options, swept.target)
    fewest = _FEWEST_OF_CELL if found_in_part(sheet.target) else len(corners_m(sheet))
    sights: list[Sight] = []

    def before(off: FloatArray, q: FloatArray) -> FloatArray:
        return seen_from(robot.flange_at(cell.true_arms[swept.robot], q) @ off)

    for taken_s in passage.taken_s.tolist():
        seen = partial(before, robot.jitter(1, rng))
        exact = passage.frame(taken_s, seen, camera, sheet, first_view + len(sights))
        middle = seen(passage.way([taken_s]))[0]
        if len(exact.ids) < fewest or middle[2, 2] < _FACING:
            continue
        found = detected(exact, options.pixel_sigma_px, rng)
        ahead_s = swept.camera_minus_robot_s + swept.jitter_s * ticks.standard_normal()
        names = swept.camera, swept.target
        white = options.stream(Stream.MEASURED, exact.view).standard_normal(6)
        stamp_s = taken_s + ahead_s
        sights.append(Sight(exact.view, -1, *names, middle, exact, found, white, stamp_s))
    return sights, reported


def _chain(
    cell: Network, swept: Swept, transforms: Mapping[str, FloatArray]
) -> Callable[[FloatArray], FloatArray]:
    """Where the target (k, 4, 4) is before the camera, by (k, 4, 4) `base_from_flange`."""
    there = {
        "robot": [robot.name for robot in cell.options.robots],
        "camera": [camera.name for camera in cell.options.cameras],
        "target": [board.name for board in cell.options.boards],
    }
    for kind, name in (("robot", swept.robot), ("camera", swept.camera), ("target", swept.target)):
        if name not in there[kind]:
            raise DataError(
                f"simulation: a sweep is of {kind} {name!r}; there are {', '.join(there[kind])}."
            )
    flange = frame_name("flange", swept.robot)
    ends = frame_name("camera", swept.camera), frame_name("target", swept.target)
    on = [cell.parents[end] for end in ends]
    if sorted(on) != sorted((CELL, flange)):
        raise DataError(
            f"simulation: of camera {swept.camera} and target {swept.target} of a sweep, one has "
            f"to be on robot {swept.robot} and the other in the cell."
        )
    base = transforms[frame_name("base", swept.robot)]

    def seen_from(flanges: FloatArray) -> FloatArray:
        cam, target = (
            base @ flanges @ transforms[end] if parent == flange else transforms[end]
            for end, parent in zip(ends, on, strict=True)
        )
        return np.asarray(invert(cam) @ target)

    return seen_from

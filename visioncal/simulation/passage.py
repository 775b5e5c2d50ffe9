"""A robot's way through its stops without a rest, and the frames and reports of it.

Camera and controller stamp by clocks of their own. The joints are of continuous acceleration; the
camera takes frames at its rate, wherever the robot is; the controller reports its joints and poses
at a higher one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import apply_each
from visioncal.core.types import Corners, FloatArray
from visioncal.session import Stream as Recorded
from visioncal.session import frame_name
from visioncal.session.columns import POSE
from visioncal.simulation.arms import DhArm, forward
from visioncal.simulation.boards import Sheet, corners_m, found_in_part
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.draws import RandomStream
from visioncal.simulation.imaging import EDGE_PX, detected
from visioncal.simulation.layout import CELL, Swept
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CameraOptions, SweepOptions

# A frame of a whole cell that shows less of the board, or shows it more askew, is not recorded.
_FEWEST_OF_CELL, _FACING = 12, 0.5
# When a row is taken depends on where its corner is then: by a few thousandths less each time.
_ROUNDS = 5


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

    def reported(self, arm: DhArm, rng: np.random.Generator) -> Recorded:
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
            points = apply_each(before(self.way(taken_s + late_s)), corners)
            px = project(optics, points)
            late_s = self.options.readout_s * (px[:, 1] / (optics.resolution[1] - 1) - 0.5)
        ids = np.flatnonzero(sees(optics, points, EDGE_PX)).astype(np.int64)
        return Corners(view, ids, px[ids], camera.blur_px)


def _in_turn(stops: FloatArray) -> FloatArray:
    """Orders postures so that each is the nearest to the one before of those that are left."""
    left = list(range(1, len(stops)))
    order = [0]
    while left:
        away = [float(np.abs(stops[at] - stops[order[-1]]).max()) for at in left]
        order.append(left.pop(int(np.argmin(away))))
    return stops[order]


def with_sweep(cell: SimulatedCell, swept: Swept, pushed: SimulatedCell) -> SimulatedCell:
    """A cell with the frames of one camera while one robot goes through its stops.

    Args:
        cell: The cell at its stops.
        swept: What moves, and what is seen.
        pushed: The cell once all is pushed that is pushed in its course.

    Raises:
        DataError: There is no such thing, or that robot does not move the one before the other.
    """
    _check(cell, swept)
    options, robot = cell.options, cell.robots[swept.robot]
    at = list(cell.robots).index(swept.robot)
    rng, ticks = options.stream(RandomStream.SWEEPS, at), options.stream(RandomStream.SWEEPS, at, 1)
    passage = Passage.through(robot.joints[: swept.stops], swept)
    recorded = passage.reported(robot.arm, rng)
    camera, board = cell.camera(swept.camera), cell.board(swept.target)
    fewest = _FEWEST_OF_CELL if found_in_part(board.target) else len(corners_m(board))
    seen_from = pushed.seen_from(swept.robot, swept.camera, swept.target)
    taken = [sight.view for sight in cell.sights] + [reading.view for reading in cell.readings]
    first_view = 1 + max([*taken, *(row[0] for row in cell.pose_rows)], default=-1)
    sights: list[SimulatedSight] = []

    def before(off: FloatArray, q: FloatArray) -> FloatArray:
        return seen_from(robot.flange_at(q) @ off)

    for taken_s in passage.taken_s.tolist():
        seen = partial(before, robot.options.jitter(1, rng))
        exact = passage.frame(taken_s, seen, camera, board, first_view + len(sights))
        middle = seen(passage.way([taken_s]))[0]
        if len(exact.ids) < fewest or middle[2, 2] < _FACING:
            continue
        found = detected(board, exact, options.pixel_sigma_px, rng)
        ahead_s = swept.camera_minus_robot_s + swept.jitter_s * ticks.standard_normal()
        names = swept.camera, swept.target
        stamp_s, at_once = taken_s + ahead_s, not swept.readout_s
        sights.append(
            SimulatedSight(exact.view, -1, *names, middle, exact, found, stamp_s, at_once)
        )
    streams = {**cell.streams, swept.robot: recorded}
    return replace(cell, sights=(*cell.sights, *sights), streams=streams)


def _check(cell: SimulatedCell, swept: Swept) -> None:
    """Refuses a sweep of what there is not, or of a camera and a target that do not move so."""
    layout = cell.layout
    for kind, name, things in (
        ("robot", swept.robot, layout.robots),
        ("camera", swept.camera, layout.cameras),
        ("target", swept.target, layout.boards),
    ):
        there = [thing.name for thing in things]
        if name not in there:
            raise DataError(
                f"simulation: a sweep is of {kind} {name!r}; there are {', '.join(there)}."
            )
    ends = frame_name("camera", swept.camera), frame_name("target", swept.target)
    on = [cell.parents[end] for end in ends]
    if sorted(on) != sorted((CELL, frame_name("flange", swept.robot))):
        raise DataError(
            f"simulation: of camera {swept.camera} and target {swept.target} of a sweep, one has "
            f"to be on robot {swept.robot} and the other in the cell."
        )

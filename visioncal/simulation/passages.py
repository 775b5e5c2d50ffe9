"""Robots that pass their stops while cameras look, by clocks of their own."""

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
from visioncal.simulation.boards import EDGE_PX, LEAST_COSINE, Sheet, corners_m, detected
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.layout import CELL, CameraOptions, RandomStream, SweepOptions, Swept
from visioncal.simulation.optics import project, sees
from visioncal.vision.targets import is_seen_in_part


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
        # They converge by some thousandths each.
        for _ in range(5 if self.options.readout_s else 1):
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
    options, robot = cell.options, cell.robots[swept.robot]
    index = list(cell.robots).index(swept.robot)
    rng = options.stream(RandomStream.SWEEPS, index)
    stamp_noise = options.stream(RandomStream.SWEEPS, index, 1)
    passage = Passage.through(robot.joints[: swept.stops], swept)
    recorded = passage.reported(robot.arm, rng)
    camera, board = cell.camera(swept.camera), cell.board(swept.target)
    min_corners = 12 if is_seen_in_part(board.target) else len(corners_m(board))
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
        if len(exact.ids) < min_corners or middle[2, 2] < LEAST_COSINE:
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

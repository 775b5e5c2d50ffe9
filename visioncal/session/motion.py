"""The robot's stream: the flange's trajectory, and when it was standing still or slow."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.robot import Robot
from visioncal.robot.trajectory import Samples, Trajectory, is_repeated
from visioncal.session import Session, View
from visioncal.session.columns import POSE

ROBOT_STREAM = "robot"
# The flange is standing still, and clocks have no effect, where it stays within what arms repeat to
# for this time before and after [s].
_REST_S = 0.25
# Of many moments the slower share is used, and more where that gives too few, up to the most; each
# has to differ from the others by this [rad, m].
_SLOW_SHARE, _ENOUGH_VIEWS, _MOST_VIEWS = 0.5, 20, 200
_NEW_RAD, _NEW_M = np.deg2rad(2.0), 0.01


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Motion of a robot by its stream."""

    name: str  # The stream's name.
    flange: Trajectory  # `base_from_flange` over the robot's time.
    # Sampling times of joint angles, and (n, j) these [rad]; None where not sampled.
    joints: tuple[Samples, FloatArray] | None
    reported: bool  # Whether the poses were reported, rather than computed from the joints.

    def numbers(self, at_s: FloatArray) -> list[dict[str, float]]:
        """Values of views.csv's robot columns at (m,) covered times."""
        rows: list[dict[str, float]] = [{} for _ in at_s]
        if self.reported:
            poses = RigidTransform.from_matrix(self.flange.at(at_s))
            values = np.hstack([poses.translation, poses.rotation.as_quat()])
            rows = [dict(zip(POSE, row, strict=True)) for row in values.tolist()]
        if self.joints is not None:
            samples, q = self.joints
            # An arm at rest has the same joint angles on both sides of a gap.
            covered = samples.covers(at_s) | (samples.spans(at_s) & self.flange.rests(at_s))
            angles = samples.blend(q, at_s)
            for row, is_covered, values in zip(rows, covered, angles.tolist(), strict=True):
                if is_covered:
                    row |= {f"q{at}_rad": value for at, value in enumerate(values, start=1)}
        return rows


def lacks_robot_state(view: View) -> bool:
    """Whether a view has a time and neither a robot pose nor joint angles."""
    return view.stamp_s is not None and view.base_from_flange() is None and view.joints_rad is None


def stream_of(session: Session, robot: str) -> str:
    """The name of a robot's stream; empty where it has none.

    It is the stream of the robot's name; of a single robot also `robot`, or the only one with poses
    or joints.
    """
    moving = [name for name, stream in session.streams.items() if stream.has_robot_state]
    names = [robot or ROBOT_STREAM]
    if len(session.robots) < 2:
        names += [ROBOT_STREAM, *(moving if len(moving) == 1 else ())]
    return next((name for name in names if name in moving), "")


def motion_of(session: Session, robot: Robot | None, name: str) -> RobotMotion:
    """Reads a robot's stream; without reported poses, by the robot's model where known.

    Raises:
        DataError: It has no poses, and no joints that match the robot's model.
    """
    stream = session.streams[name]
    reported_s, poses = stream.poses()
    joints_s, q = stream.joints()
    joints = (Samples(joints_s), q) if len(joints_s) >= 2 else None
    if len(reported_s) >= 2:
        return RobotMotion(name, Trajectory(reported_s, poses), joints, reported=True)
    if joints is not None and robot is not None and robot.joint_count == q.shape[1]:
        flange = Trajectory(joints_s, robot.base_from_flange(q))
        return RobotMotion(name, flange, joints, reported=False)
    needed = "a known [robot] model" if robot is None else f"{robot.joint_count} joints a sample"
    raise DataError(
        f"streams/{name}.csv: it has {counted(len(reported_s), 'pose')} and "
        f"{counted(len(joints_s), 'row')} of "
        f"{q.shape[1]} joint angles, but must have two poses or more, or {needed}.",
        culprits=[f"streams/{name}.csv"],
        next_step="Fill in x_m to qw, or q1_rad ... and [robot] model.",
    )


def is_standing_still(flange: Trajectory, at_s: FloatArray) -> Mask:
    """Whether the flange was standing still for a while before and after each time.

    Samples are compared, and not what lies between them, so that the stream's rate does not count.
    """
    resting = flange.covers(at_s, _REST_S)
    pose = flange.poses[flange.before(at_s[resting])]
    still = np.ones(len(pose), dtype=bool)
    for offset_s in (-_REST_S, -0.5 * _REST_S, 0.0, 0.5 * _REST_S, _REST_S):
        # The sample on the far side.
        other = flange.before(at_s[resting] + offset_s) + (offset_s >= 0.0)
        still &= is_repeated(invert(pose) @ flange.poses[other])
    resting[resting] = still
    return resting


def slow_and_new(poses: FloatArray, speeds: FloatArray) -> IntArray:
    """Selects the slowest moments with distinct flange poses (m, 4, 4) [m].

    `speeds` are the flange's twists per second (m, 6) [rad/s, m/s].

    Returns:
        (k,) the moments, ascending.
    """
    speed = np.linalg.norm(speeds[:, :3], axis=1)
    # Lever that makes speeds of rotation and translation comparable [m].
    speed = speed + np.linalg.norm(speeds[:, 3:], axis=1) / 0.3
    chosen: list[int] = []
    limit = float(np.quantile(speed, _SLOW_SHARE))
    for at in np.argsort(speed, kind="stable"):
        is_enough = len(chosen) >= _ENOUGH_VIEWS and speed[at] > limit
        if is_enough or len(chosen) == _MOST_VIEWS:
            break
        difference = invert(poses[chosen]) @ poses[at]
        near = (rotation_angle(difference) < _NEW_RAD) & (
            np.linalg.norm(difference[:, :3, 3], axis=-1) < _NEW_M
        )
        if not near.any():
            chosen.append(int(at))
    return np.array(sorted(chosen), dtype=np.int64)

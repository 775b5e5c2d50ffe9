"""The robot's stream: where the flange was at any time, and when it stood still or was slow."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.trajectory import Samples, Trajectory
from visioncal.robot import Robot
from visioncal.session import Session, View
from visioncal.session.columns import POSE

ROBOT_STREAM = "robot"
# Where the flange stays within this for so long before and after [mm, deg, s], clocks do not count.
_REST_MM, _REST_DEG, _REST_S = 0.1, 0.01, 0.25
# The slower half of very many moments is taken, and more where that gives too few, each where the
# flange has turned or gone this far from the others [rad, m].
_SLOW_SHARE, _ENOUGH_VIEWS, _MOST_VIEWS = 0.5, 20, 200
_NEW_RAD, _NEW_M = np.deg2rad(2.0), 0.01
# What a rotation of 1 rad/s weighs against a speed of 1 m/s.
_ARM_M = 0.3


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """The robot's stream.

    Attributes:
        name: Its name.
        flange: `base_from_flange` over the robot's time.
        joints: When joint angles were sampled, and (n, j) these [rad]; None where they were not.
        reported: Whether the poses were reported, rather than computed of the joints.
    """

    name: str
    flange: Trajectory
    joints: tuple[Samples, FloatArray] | None
    reported: bool

    def numbers(self, at_s: FloatArray) -> list[dict[str, float]]:
        """What the columns of views.csv would have been at (m,) moments that are covered."""
        rows: list[dict[str, float]] = [{} for _ in at_s]
        if self.reported:
            poses = RigidTransform.from_matrix(self.flange.at(at_s))
            values = np.hstack([poses.translation, poses.rotation.as_quat()])
            rows = [dict(zip(POSE, row, strict=True)) for row in values.tolist()]
        if self.joints is not None:
            samples, q = self.joints
            known = samples.covers(at_s)
            angles = samples.blend(q, at_s)
            for row, there, values in zip(rows, known, angles.tolist(), strict=True):
                if there:
                    row |= {f"q{at}_rad": value for at, value in enumerate(values, start=1)}
        return rows


def is_open(view: View) -> bool:
    """Tells whether a view has a time and nothing of the robot."""
    return view.stamp_s is not None and view.base_from_flange() is None and view.joints_rad is None


def stream_of(session: Session, robot: str) -> str:
    """The name of a robot's stream; empty where it has none.

    It is the one of the robot's name; of an only robot also `robot`, or the only one with poses or
    joints.
    """
    moving = [name for name, stream in session.streams.items() if stream.has_robot_state]
    names = [robot or ROBOT_STREAM]
    if len(session.robots) < 2:
        names += [ROBOT_STREAM, *(moving if len(moving) == 1 else ())]
    return next((name for name in names if name in moving), "")


def motion_of(session: Session, robot: Robot | None, name: str) -> RobotMotion:
    """Reads a robot's stream.

    Args:
        session: One that has a stream of this name.
        robot: The robot's model, where it is known.
        name: The stream's.

    Raises:
        DataError: It has no poses, and no joints that the robot's model knows.
    """
    stream = session.streams[name]
    reported_s, poses = stream.poses()
    joints_s, q = stream.joints()
    joints = None
    if len(joints_s) >= 2:
        joints = Samples(joints_s), q
    if len(reported_s) >= 2:
        return RobotMotion(name, Trajectory(reported_s, poses), joints, reported=True)
    if joints is not None and robot is not None and robot.joint_count == q.shape[1]:
        return RobotMotion(
            name, Trajectory(joints_s, robot.base_from_flange(q)), joints, reported=False
        )
    needed = "a known [robot] model" if robot is None else f"{robot.joint_count} joints a sample"
    raise DataError(
        f"streams/{name}.csv: it has {len(reported_s)} poses and {len(joints_s)} rows of "
        f"{q.shape[1]} joint angles; two poses or more are needed, or {needed}.",
        culprits=[f"streams/{name}.csv"],
        next_step="Fill in x_m to qw, or q1_rad ... and [robot] model.",
    )


def at_rest(flange: Trajectory, at_s: FloatArray) -> Mask:
    """Whether the flange stood still for a while, before and after some moments."""
    resting = flange.covers(at_s, _REST_S)
    here = flange.at(at_s[resting])
    still = np.ones(len(here), dtype=bool)
    for away_s in (-_REST_S, -0.5 * _REST_S, 0.5 * _REST_S, _REST_S):
        moved = invert(here) @ flange.at(at_s[resting] + away_s)
        still &= 1e3 * np.linalg.norm(moved[:, :3, 3], axis=1) < _REST_MM
        still &= np.rad2deg(rotation_angle(moved)) < _REST_DEG
    resting[resting] = still
    return resting


def slow_and_new(poses: FloatArray, speeds: FloatArray) -> IntArray:
    """Chooses the slowest moments, each in a pose of its own.

    Args:
        poses: (m, 4, 4) of the flange [m].
        speeds: (m, 6) its twists a second [rad/s, m/s].

    Returns:
        (k,) the moments, ascending.
    """
    speed = np.linalg.norm(speeds[:, :3], axis=1)
    speed = speed + np.linalg.norm(speeds[:, 3:], axis=1) / _ARM_M
    chosen: list[int] = []
    limit = float(np.quantile(speed, _SLOW_SHARE))
    for at in np.argsort(speed, kind="stable"):
        enough = len(chosen) >= _ENOUGH_VIEWS and speed[at] > limit
        if enough or len(chosen) == _MOST_VIEWS:
            break
        between = invert(poses[chosen]) @ poses[at]
        near = (rotation_angle(between) < _NEW_RAD) & (
            np.linalg.norm(between[:, :3, 3], axis=-1) < _NEW_M
        )
        if not near.any():
            chosen.append(int(at))
    return np.array(sorted(chosen), dtype=np.int64)

"""Where the robot says that its flange was: poses as reported, or joints through the model."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.errors import DataError
from visioncal.estimator.closure import distances
from visioncal.figures import figure
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.transforms import invert, mean_transform, pose_difference, rotation_angle
from visioncal.types import FloatArray, Rejection

# Controllers print poses to 0.01 mm or 1e-5 rad at worst; a model of another robot, another tip or
# another convention is off by far more.
_AGREE_M, _AGREE_RAD = 1e-3, 2e-3
# The robot stands still while a stop's images are taken; controllers report it with some noise.
_ONE_STOP_MM, _ONE_STOP_DEG = 1.0, 0.1
# Beyond, the model is of another arm, or its base or its tip is another frame.
_SAME_ARM_M, _SAME_ARM_RAD = 0.05, 0.1
# Arms have at most seven joints in the models that ship; messages list no more columns than that.
_LISTED_COLUMNS = 7
# Where at least this share of the rows disagrees, it is not the rows that are wrong.
_MOST = 0.5


@dataclass(frozen=True, eq=False)
class Reported:
    """The robot's side of the session.

    Attributes:
        base_from_flange: (4, 4) by view.
        rejections: Views without a pose.
        warnings: What does not fit together, in words.
    """

    base_from_flange: Mapping[int, FloatArray]
    rejections: tuple[Rejection, ...]
    warnings: tuple[str, ...]


def reported_poses(session: Session, robot: Robot | None) -> Reported:
    """Collects `base_from_flange` of each view.

    A reported pose comes first; where a view has joints only, the robot's model gives the pose.

    Args:
        session: The session.
        robot: Its nominal robot, where it names a known one.

    Returns:
        The poses, and whether joints and poses disagree.

    Raises:
        DataError: Joints are all there is, and they are not as many as the robot's; or rows that
            are said to be of one stop lie apart.
    """
    poses: dict[int, FloatArray] = {}
    rejections = []
    for view in session.views:
        pose, joints = view.base_from_flange(), view.joints_rad
        if pose is not None:
            poses[view.number] = np.asarray(pose.as_matrix())
        elif joints is not None and robot is not None:
            poses[view.number] = _forward(robot, joints)
        elif joints is not None:
            reason = (
                "no pose of the robot: it has joint angles, but the session names no known robot"
            )
            rejections.append(Rejection(view.number, reason))
        else:
            rejections.append(Rejection(view.number, "no pose of the robot: x_m to qw are empty"))
    _check_stops(session, poses)
    return Reported(poses, tuple(rejections), tuple(_disagreement(session, robot)))


def _check_stops(session: Session, poses: Mapping[int, FloatArray]) -> None:
    """Refuses declared stops whose rows lie apart: one pose of the robot would stand for all."""
    rows = defaultdict(list)
    for view in session.views:
        if view.stop is not None and view.number in poses:
            rows[view.stop].append(view.number)
    for stop, views in rows.items():
        away = [pose_difference(poses[views[0]], poses[view]) for view in views]
        mm, deg = np.max(away, axis=0)
        if mm > _ONE_STOP_MM or deg > _ONE_STOP_DEG:
            named = ", ".join(map(str, views))
            raise DataError(
                f"views.csv: the rows of stop {stop} (views {named}) have poses of the robot up to "
                f"{mm:.4g} mm and {deg:.3g} deg apart; those of one stop lie within "
                f"{_ONE_STOP_MM:g} mm and {_ONE_STOP_DEG:g} deg.",
                culprits=[f"views.csv: view {view}" for view in views],
                next_step="Remove the stop numbers, or correct the poses.",
            )


def usable_joints(
    session: Session, robot: Robot | None, base_from_flange: Mapping[int, FloatArray]
) -> Mapping[int, FloatArray] | None:
    """Joint angles (n,) by view [rad], where they belong to the robot's model and to its poses.

    Args:
        session: The session.
        robot: Its nominal robot, where it names a known one.
        base_from_flange: (4, 4) by view.

    Returns:
        The angles of all views with a pose; None where one lacks them, or where they lead
        elsewhere than the reported poses: then the model is another robot's.
    """
    if robot is None:
        return None
    joints = {it.number: it.joints_rad for it in session.views if it.number in base_from_flange}
    known = {view: it for view, it in joints.items() if it is not None}
    if len(known) < len(joints) or any(len(it) != robot.joint_count for it in known.values()):
        return None
    for view, angles in known.items():
        away = invert(_forward(robot, angles)) @ base_from_flange[view]
        if np.linalg.norm(away[:3, 3]) > _SAME_ARM_M or rotation_angle(away) > _SAME_ARM_RAD:
            return None
    return known


def _forward(robot: Robot, joints: FloatArray) -> FloatArray:
    if len(joints) != robot.joint_count:
        columns = ", ".join(f"q{at + 1}_rad" for at in range(min(len(joints), _LISTED_COLUMNS)))
        raise DataError(
            f"views.csv: {len(joints)} joint angles ({columns}), but {robot.name} has "
            f"{robot.joint_count} joints.",
            next_step="Correct [robot] model in session.toml, or the columns.",
        )
    return np.asarray(robot.base_from_flange(joints[None])[0])


def _disagreement(session: Session, robot: Robot | None) -> Iterator[str]:
    """Compares reported poses with the model's, up to one constant tool."""
    if robot is None:
        return
    both = [
        (view.number, np.asarray(pose.as_matrix()), joints)
        for view in session.views
        if (pose := view.base_from_flange()) is not None and (joints := view.joints_rad) is not None
    ]
    if not both:
        return
    views, poses, angles = zip(*both, strict=True)
    if any(len(joints) != robot.joint_count for joints in angles):
        yield (
            f"Joint angles were not used: there are {len(angles[0])} a row, and {robot.name} has "
            f"{robot.joint_count} joints."
        )
        return
    flange_from_reported = invert(robot.base_from_flange(np.array(angles))) @ np.array(poses)
    # The most central one, which wrong rows do not move as they would move the mean.
    away_m, away_rad = min(
        (distances(flange_from_reported, it) for it in flange_from_reported),
        key=lambda away: float(np.median(away[0]) + np.median(away[1])),
    )
    apart = (away_m > _AGREE_M) | (away_rad > _AGREE_RAD)
    figures = f"{figure(1e3 * away_m.max())} mm and {figure(np.rad2deg(away_rad.max()))} deg"
    if apart.mean() >= _MOST:
        yield (
            f"Poses and joint angles disagree: through the model of {robot.name} the joints give "
            f"poses that differ by up to {figures}. The hand-eye result uses the poses. Check "
            "[robot] model and tip, and whether the base frame is the controller's."
        )
        return
    if apart.any():
        wrong = ", ".join(f"view {view}" for view, it in zip(views, apart, strict=True) if it)
        yield (
            f"Pose and joint angles disagree in {wrong}, by up to {figures}; in the other "
            "views they agree. The hand-eye result uses the poses. Correct what is wrong there."
        )
    offset_mm, turn_deg = pose_difference(np.eye(4), mean_transform(flange_from_reported[~apart]))
    if offset_mm > 1e3 * _AGREE_M or turn_deg > np.rad2deg(_AGREE_RAD):
        yield (
            f"The reported poses are of a tool frame, {offset_mm:.1f} mm and {turn_deg:.1f} deg "
            f"from the flange of {robot.name}: the camera's transform is to that frame."
        )

"""Flange poses as the robot reports them, or by the model from its joint angles."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.calibration.stages.joints import MatchedJoints, match_joints
from visioncal.core.errors import DataError
from visioncal.core.transforms import pose_difference
from visioncal.core.types import FloatArray, Rejection
from visioncal.core.verdict import Finding
from visioncal.robot import Robot
from visioncal.session import Session
from visioncal.session.observations import APART_DEG, APART_MM
from visioncal.session.table import reported_matrices


@dataclass(frozen=True, eq=False)
class RobotReport:
    """Poses and joints that a robot's rows report."""

    base_from_flange: Mapping[int, FloatArray]  # (4, 4) by view.
    rejections: tuple[Rejection, ...] = ()  # Views without a pose.
    warnings: tuple[Finding, ...] = ()  # Contradictions.
    notes: tuple[str, ...] = ()  # Remarks.
    matched: MatchedJoints | None = None  # The joints matched with the poses; None without a model.

    @cached_property
    def joints_rad(self) -> Mapping[int, FloatArray] | None:
        """(n,) joint angles by view [rad]; None where a view with a pose lacks them."""
        if self.matched is None or not self.base_from_flange:
            return None
        joints = self.matched.joints_rad
        known = {view: joints[view] for view in self.base_from_flange if view in joints}
        return known if len(known) == len(self.base_from_flange) else None


def reported_poses(session: Session, robot: Robot | None) -> RobotReport:
    """Collects `base_from_flange` of each view, and matches joints with poses.

    Reported poses are preferred; for a view with joints only, the robot's model gives the pose.

    Raises:
        DataError: There are only joints, and they are not as many as the robot's; or rows of one
            declared stop have different poses.
    """
    reported = reported_matrices(session.views)
    matched = None if robot is None else match_joints(session.views, robot)
    rejections = []
    poses: dict[int, FloatArray] = {}
    for view in session.views:
        joints = view.joints_rad
        if view.number in reported:
            poses[view.number] = reported[view.number]
        elif joints is None or matched is None or matched.misread:
            rejections.append(Rejection(view.number, _no_pose(joints, matched)))
        else:
            poses[view.number] = matched.pose(joints)
    if not session.is_network:
        # In a whole cell, such rows are separate states.
        _check_stops(session, poses)
    remarks = ((), ()) if matched is None else (matched.warnings, matched.notes)
    return RobotReport(poses, tuple(rejections), *remarks, matched)


def _no_pose(joints: FloatArray | None, matched: MatchedJoints | None) -> str:
    if joints is None:
        return "no pose of the robot: x_m to qw are empty"
    if matched is None:
        return (
            "no pose of the robot: x_m to qw are empty, joint angles need its model, and the "
            "session names no known robot: [robot] model is missing, or that of [robots.NAME]"
        )
    return "no pose of the robot: its joint angles are misread, as those of views with poses show"


def _check_stops(session: Session, poses: Mapping[int, FloatArray]) -> None:
    """Refuses declared stops whose rows differ: one pose of the robot is used for all."""
    rows = defaultdict(list)
    for view in session.views:
        if view.stop is not None and view.number in poses:
            rows[view.stop].append(view.number)
    for stop, views in rows.items():
        differences = [pose_difference(poses[views[0]], poses[view]) for view in views]
        mm, deg = np.max(differences, axis=0)
        if mm > APART_MM or deg > APART_DEG:
            named = ", ".join(map(str, views))
            raise DataError(
                f"views.csv: the rows of stop {stop} (views {named}) have poses of the robot up to "
                f"{mm:.4g} mm and {deg:.3g} deg apart; those of one stop lie within "
                f"{APART_MM:g} mm and {APART_DEG:g} deg.",
                culprits=[f"views.csv: view {view}" for view in views],
                next_step="Remove the stop numbers, or correct the poses.",
            )

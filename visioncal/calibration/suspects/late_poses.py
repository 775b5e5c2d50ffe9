"""Poses that were read at another instant than the joint angles, with which the images agree."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.guess.fit import robust_fits
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.suspect import ARM_ERRORS, UNEXPLAINED, Suspect
from visioncal.core.limits import CLEAR_RATIO, FEWEST_COMPARED
from visioncal.core.types import MOUNTS
from visioncal.core.verdict import Finding, mending
from visioncal.estimation.chain import robot_part

_KIND = "late_poses"
# Poses are those of the joint angles [m, rad].
_SAME = 1e-6


def by_joints(run: RunState) -> Iterator[Finding]:
    """The finding that the images agree with the joint angles alone; none of misread poses."""
    matched = run.reported.matched
    if run.mount not in MOUNTS or matched is None or matched.misread:
        return
    if run.misread:
        return
    seen, reported = run.poses_of_one_board, run.base_from_flange
    joints_rad = matched.joints_rad or matched.disagreeing_rad
    used = reported if run.cell_fit_or_none is None else run.used
    views = [view for view in used if view in seen and view in joints_rad]
    if len(views) <= FEWEST_COMPARED:
        return
    camera = np.array([seen[view].cam_from_target[0] for view in views])
    of_joints = [matched.pose(joints_rad[view]) for view in views]
    poses = robot_part(np.array([[reported[view] for view in views], of_joints]), run.mount)
    # Of an arm that cannot tilt, the same poses close by chance to any length along its axes.
    if np.abs(poses[1] - poses[0]).max() < _SAME:
        return
    by_report, by_angles = robust_fits(poses, np.broadcast_to(camera, poses.shape))
    if CLEAR_RATIO * by_angles.score < by_report.score:
        yield Finding(
            _KIND,
            f"The images agree with the joint angles to {by_angles.figures}, and with the "
            f"reported poses to {by_report.figures}: these were read at another instant, or are "
            "commanded ones.",
            mending(
                "the poses are those of the joint angles (next time, log both at one instant, "
                "while the arm stands)",
                "--by-joints",
            ),
            until_mm=0.0,
        )


LATE_POSES = Suspect(
    _KIND,
    by_joints,
    1e-6,
    of_chain=True,
    hides=(UNEXPLAINED, ARM_ERRORS, "stops_short", "other_arm", "wrong_views", "something_moved"),
    inflates=("robot_noise", "robot_noise_of_pick", "calibration", ARM_ERRORS),
)

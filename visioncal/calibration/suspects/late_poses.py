"""Poses that were read at another instant than the joint angles, with which the images agree."""

from collections.abc import Iterator

import numpy as np

from visioncal.calibration.guess.fit import distances as residuals_of
from visioncal.calibration.guess.fit import robust_fits
from visioncal.calibration.guess.search import relative_angles
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.moved_views import IN_MOTION
from visioncal.calibration.suspects.suspect import ARM_ERRORS, UNEXPLAINED, Suspect
from visioncal.core.limits import CLEAR_RATIO, FEWEST_COMPARED
from visioncal.core.number_format import figure, view_words
from visioncal.core.transforms import distances, exp, invert, log, robot_part
from visioncal.core.types import MOUNTS, FloatArray, IntArray
from visioncal.core.verdict import Finding, Option, calibrating, mending

_KIND = "late_poses"
# Poses are those of the joint angles, and of the flange [m, rad].
_SAME, _ROUNDED = 1e-6, 1e-4
_BY_JOINTS = mending(
    "the poses are those of the joint angles (next time, log both at one instant, while the arm "
    "stands)",
    Option("by-joints"),
)
_OF_TIP = calibrating(
    "Write the poses of these rows anew, by their joint angles and the tool of the other rows, or",
    "the other views alone.",
    "",
)

# Shares of the way to another stop that are tried.
_SHARES = np.linspace(-0.4, 0.4, 81).round(2)
# Rounds in which places between stops, by up to that share, converge to a thousandth.
_ROUNDS = 8


def by_joints(run: RunState) -> Iterator[Finding]:
    """The finding that the images agree with the joint angles alone; none of misread poses.

    In all views, or in those where angles and poses contradict each other.
    """
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
    by_model = {view: matched.pose(joints) for view, joints in joints_rad.items()}
    poses = np.array([[of[view] for view in views] for of in (reported, by_model)])
    poses = robot_part(poses, run.mount)
    by_report, by_angles = robust_fits(poses, np.broadcast_to(camera, poses.shape))
    # Of an arm that cannot tilt, the same poses close by chance to any length along its axes.
    are_same = np.abs(poses[1] - poses[0]).max() < _SAME
    if not are_same and CLEAR_RATIO * by_angles.score < by_report.score:
        yield Finding(
            _KIND,
            f"The images agree with the joint angles to {by_angles.figures}, and with the "
            f"reported poses to {by_report.figures}: these were read at another instant, or are "
            "commanded ones.",
            _BY_JOINTS,
            until_mm=0.0,
        )
        return
    # Views whose joint angles are wrong have no pose any more.
    known = reported.keys() & seen.keys() & joints_rad.keys()
    late = [view for view in matched.contradicting if view in known]
    if not late:
        return
    camera = np.array([seen[view].cam_from_target[0] for view in late])
    poses = np.array([[of[view] for view in late] for of in (reported, by_model)])
    sides, edges = robot_part(poses, run.mount), (by_angles.x, by_angles.z)
    stated, right = (residuals_of(side, camera, by_angles.lever, edges) for side in sides)
    is_right = right.residuals < CLEAR_RATIO * by_angles.score
    some = np.flatnonzero(is_right & (CLEAR_RATIO * right.residuals < stated.residuals))
    # Views whose joint angles are wrong, too, are said to be so for each.
    if len(some) == len(matched.contradicting):
        named = tuple(late[at] for at in some.tolist())
        # The command writes the flange's pose for all views.
        away = distances(np.eye(4)[None], matched.flange_from_reported[None])
        is_flange = all(part.max() < _ROUNDED for part in away)
        report, angles = (
            residuals_of(side[some], camera[some], by_angles.lever, edges).figures for side in sides
        )
        yield Finding(
            _KIND,
            f"In {view_words(named)} the image{'s agree' * (len(named) > 1) or ' agrees'} with the "
            f"joint angles to {angles}, and with the reported pose{'s' * (len(named) > 1)} to "
            f"{report}: read at another instant, with another tool, or commanded.",
            _BY_JOINTS if is_flange else _OF_TIP,
            named,
        )


def on_the_way(robot: FloatArray, camera: FloatArray, kept: IntArray) -> Finding | None:
    """The finding that poses belong to places on the way to another stop; None where none fit.

    Args:
        robot: (m, 4, 4) poses, in the order of their stops.
        camera: (p,) angles by which the camera turned between the pairs of the kept ones [rad].
        kept: Indices of the poses that are compared.
    """
    found = list[tuple[float, float, str]]()
    for which, by in (("next", 1), ("last", -1)):
        for share in _SHARES:
            stood = robot
            # Poses that were read on the way are a share of that between where the arm stood.
            for _ in range(_ROUNDS if share < 0.0 else 1):
                stood = robot @ exp(share * _way(stood, by))
            turned = stood[kept, :3, :3]
            away = float(np.median(np.abs(relative_angles(turned) - camera)))
            found.append((away, float(share), which))
    (away, share, which), none = min(found), min(one for one in found if one[1] == 0.0)[0]
    if CLEAR_RATIO * away > none:
        return None
    percent = f"{100.0 * abs(share):.0f} %"
    words, when = "The arm moved between image and pose: ", "the image was taken later than that"
    if which == "next" and share < 0.0:
        when = "the pose was read later than that, with the arm on its way to the next stop"
    elif which == "last" and share > 0.0:
        when = "the arm had not arrived there yet, as of poses that were commanded"
    towards = (
        f"{'towards' if share > 0.0 else 'away from'} the {which} stop by {percent} of the way"
    )
    words += (
        f"with each pose moved {towards}, robot and camera turn alike to "
        f"{figure(np.rad2deg(away))} deg (median of all pairs), as read to "
        f"{figure(np.rad2deg(none))} deg. So {when}."
    )
    return Finding("misread_poses", words, IN_MOTION)


def _way(poses: FloatArray, by: int) -> FloatArray:
    """(m, 6) twists from (m, 4, 4) poses to the next, or to the last by -1; none from an end."""
    others = np.clip(np.arange(len(poses)) + by, 0, len(poses) - 1)
    return log(invert(poses) @ poses[others])


LATE_POSES = Suspect(
    _KIND,
    by_joints,
    1e-6,
    of_chain=True,
    hides=(
        *(UNEXPLAINED, ARM_ERRORS, "stops_short", "other_arm", "wrong_views", "something_moved"),
        "contradicting_joints",
    ),
    inflates=("robot_noise", "robot_noise_of_pick", "calibration", ARM_ERRORS),
)

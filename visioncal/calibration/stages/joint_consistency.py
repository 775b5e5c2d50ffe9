"""Whether joint angles belong to what the camera sees."""

from collections.abc import Iterator, Mapping

import numpy as np

from visioncal.calibration.guess.fit import distances
from visioncal.calibration.guess.joints import JointReading
from visioncal.calibration.guess.misread import (
    FEWEST_JOINT_ROWS,
    FITS_SEEN,
    JointGuess,
    guess_joints,
)
from visioncal.calibration.stages.joints import ARM_AS_FOUND, Matched, zero_taken
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount, Rejection
from visioncal.core.verdict import Finding, Step
from visioncal.robot import Robot


def guess_seen_joints(
    robot: Robot, q: FloatArray, cam_from_target: FloatArray, mount: Mount
) -> JointGuess | None:
    """Compares joint angles with what the camera sees, where there are enough views.

    Args:
        robot: The model.
        q: (m, n) joint angles [rad].
        cam_from_target: (m, 4, 4) measured poses of the target.
        mount: What holds the camera.

    Returns:
        How the angles are to be taken; None where too few views show it.
    """
    if len(q) < FEWEST_JOINT_ROWS:
        return None
    return guess_joints(robot, q, _as_flange(cam_from_target, mount), FITS_SEEN)


def contradicted_joints(
    matched: Matched,
    guess: JointGuess | None,
    seen: Mapping[int, tuple[FloatArray, FloatArray]],
    mount: Mount,
) -> Iterator[Rejection]:
    """Tells of the views whose pose and angles contradict each other where the angles are wrong.

    Where the pose is, the views are left to those that look for wrong poses.

    Args:
        matched: The joints beside the poses.
        guess: How the other views' angles fit the camera; None where that is not known.
        seen: `base_from_flange` as reported, and `cam_from_target`, of these views.
        mount: What holds the camera.
    """
    for view, (pose, cam_from_target) in seen.items():
        reason = matched.contradicting[view]
        if guess is None:
            yield Rejection(view, f"{reason}, and too few views show which of them is right")
            continue
        model = guess.best.reading.poses(matched.joints_rad[view][None])[0]
        both = np.array([model, pose @ invert(matched.flange_from_reported)])
        of_poses = invert(_as_flange(np.array([cam_from_target, cam_from_target]), mount))
        fit = guess.best.fit
        by_joints, by_pose = distances(of_poses, both, fit.lever, (fit.x, fit.z)).away
        if by_pose < by_joints:
            yield Rejection(view, f"{reason}, with which the camera agrees")


def _as_flange(cam_from_target: FloatArray, mount: Mount) -> FloatArray:
    """`base_from_flange` up to the two unknown edges."""
    # It is `cam_from_target` of a camera that does not move, and its inverse where the target does
    # not.
    return invert(cam_from_target) if mount == "eye-in-hand" else cam_from_target


def misread_joints(
    guess: JointGuess, robot: Robot, *, has_poses: bool, seen: str = "what the camera sees"
) -> DataError:
    """The error of a session whose angles fit what was observed in another reading only."""
    sentence = guess.sentence(seen)
    also = " The reported poses are those of the same angles, and as wrong." if has_poses else ""
    columns = guess.best.reading.columns or range(robot.joint_count)
    return DataError(
        f"views.csv: the joint angles are not those of {robot.name} as they are recorded. "
        f"{sentence}{also}",
        culprits=[f"views.csv: q{at + 1}_rad" for at in columns],
        next_step=guess.fix,
    )


def lost_zero(guess: JointGuess, zero: JointReading, *, taken: bool) -> Finding:
    """Says which joint's zero is lost, and what becomes of it."""
    words = (
        f"The joint angles do not belong to {zero.robot.name} as they are declared. "
        f"{guess.sentence('what the camera sees')}"
    )
    if taken:
        return Finding(
            "misread_joints", f"{words} {zero_taken(zero)}", Step(zero.fix, ARM_AS_FOUND)
        )
    return Finding("misread_joints", words, Step(zero.fix))

"""Reading of the robots' reports, and the check of their joints against the observations."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from visioncal.calibration.guess.fit import distances
from visioncal.calibration.guess.joints import (
    FEWEST_JOINT_ROWS,
    FITS_SEEN,
    JointGuess,
    JointReading,
    guess_joints,
)
from visioncal.calibration.stages.joints import EXPORT_ARM, MatchedJoints, zero_taken
from visioncal.calibration.stages.motion import lacks_robot_state
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.calibration.stages.reported_poses import RobotReport, reported_poses
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount, Rejection
from visioncal.core.verdict import Finding, Remedy, remarks
from visioncal.robot import Robot
from visioncal.session import Observation, Session, frame_name
from visioncal.session.kinds import is_camera_observation, name_of

T = TypeVar("T", bound=Observed)


def read_robots(observed: T) -> T:
    """Reads the reported poses and joints of the robots.

    Raises:
        DataError: There are only joints, and they are not as many as the robot's; or rows of one
            declared stop have different poses.
    """
    session, reports = observed.timed, {}
    for name in session.robots:
        model_document = session.robot_documents.get(name)
        of_robot = tuple(
            view
            for view in session.views
            if name_of(session.declaration, "robot", view) == name
            and not (observed.clocks and lacks_robot_state(view))
        )
        model = None if model_document is None else Robot.from_document(model_document)
        reported = reported_poses(replace(session, views=of_robot), model)
        reports[name] = _with_stops(session, name, reported)
        label = _label(session, name)
        observed = observed.noting((), (warning.of(label) for warning in reported.warnings))
        notes = (remark.of(label).words for remark in remarks(reported.notes))
        observed = replace(observed, notes=(*observed.notes, *notes))
    rows = [row for row in session.observations if row.view.number not in observed.spared]
    return replace(observed, robots=reports).noting(_lost_views(session, rows, reports))


def _with_stops(session: Session, name: str, reported: RobotReport) -> RobotReport:
    """Fills in, where a row has no pose of its robot, that of another row of its stop."""
    poses, matched = dict(reported.base_from_flange), reported.matched
    joints = {} if matched is None else dict(matched.joints_rad)
    for observation in session.observations:
        view, of_stop = observation.view.number, observation.robots.get(name)
        row = None if of_stop is None else of_stop.number
        if row in poses and view not in poses:
            poses[view] = poses[row]
            joints |= {view: joints[row]} if row in joints else {}
    if matched is not None:
        matched = replace(matched, joints_rad=joints)
    return replace(reported, base_from_flange=poses, matched=matched)


def _lost_views(
    session: Session, rows: Sequence[Observation], reports: Mapping[str, RobotReport]
) -> Iterator[Rejection]:
    """Rejections of observations without the pose of a robot."""
    reasons = {
        name: {rejection.view: rejection.reason for rejection in report.rejections}
        for name, report in reports.items()
    }
    for row in rows:
        for name in (*row.missing_robots, *row.robots):
            if row.view.number in reports[name].base_from_flange:
                continue
            why = reasons[name].get(row.robots.get(name, row.view).number, "")
            of = f" ({name})" if len(session.robots) > 1 else ""
            if not why or (name in row.missing_robots and row.view.stop is not None):
                why, of = f"no row of its stop has the pose of {name or 'the robot'}", ""
            yield Rejection(row.view.number, f"{why}{of}")


def _label(session: Session, robot: str) -> str:
    """The name of the robot that findings concern; empty with a single one."""
    return f"Robot {robot}" if len(session.robots) > 1 else ""


def check_joints(observed: T, *, drops: bool, takes: bool) -> T:
    """Refuses joints that only another reading makes fit the cameras' observations.

    With `drops`, views are removed whose pose and joints contradict each other, where the joints
    are right; with `takes`, a lost zero is corrected.

    Raises:
        DataError: Joints are misread.
    """
    for name, reported in observed.robots.items():
        if reported.matched is not None:
            observed = _checked(observed, name, reported, reported.matched, (drops, takes))
    return observed


def _checked(
    observed: T,
    name: str,
    reported: RobotReport,
    matched: MatchedJoints,
    options: tuple[bool, bool],
) -> T:
    session, joints, (drops, takes) = observed.session, reported.joints_rad or {}, options
    pair = next(iter(pairs_of(observed, name)), _NO_PAIR)
    target_poses = {
        view: poses.cam_from_target[0] for view, poses in pair.poses.items() if view in joints
    }
    if not target_poses:
        return observed
    excluded = {*matched.contradicting, *observed.held_back}
    views = [view for view in target_poses if view not in excluded]
    rows = np.array([target_poses[view] for view in views])
    q = np.array([joints[view] for view in views]).reshape(len(views), matched.robot.joint_count)
    guess = _guess_seen_joints(matched.arm, q, rows, pair.mount)
    if drops:
        contradicting = {
            view: (reported.base_from_flange[view], pose)
            for view, pose in target_poses.items()
            if view in matched.contradicting
        }
        lost = tuple(_contradicted_joints(matched, guess, contradicting, pair.mount))
        reported = reported.without({rejection.view for rejection in lost})
        observed = observed.noting(lost).with_robot(name, reported)
    if guess is None or not guess.stands_out:
        return observed
    zero = guess.zero
    if zero is None:
        of_robot = [view for view in session.views if view.number in reported.base_from_flange]
        has_poses = any(view.base_from_flange() is not None for view in of_robot)
        error = misread_joints(guess, matched.robot, has_poses=has_poses)
        raise error.within(f"robot {name}") if len(session.robots) > 1 else error
    used = takes and matched.zero is None
    finding = _lost_zero_finding(guess, zero, is_used=used)
    observed = observed.noting((), (finding.of(_label(session, name)),))
    return observed.with_robot(name, reported.with_zero(zero)) if used else observed


def check_read_joints(observed: Observed, probes: Mapping[int, FloatArray]) -> None:
    """Refuses joints that only another reading makes fit an instrument's readings.

    `probes` has (4, 4) `instrument_from_probe` by view; it is empty where points do not determine
    them. A lost zero is not refused: it is estimated with the arm.

    Raises:
        DataError: Joints are misread.
    """
    for reported in observed.robots.values():
        matched, joints = reported.matched, reported.joints_rad or {}
        views = [probe for probe in probes if probe in joints and probe not in observed.held_back]
        if matched is None or not views:
            continue
        q, poses = (np.array([by_view[view] for view in views]) for by_view in (joints, probes))
        # The instrument is fixed beside the robot, as a camera may be.
        guess = _guess_seen_joints(matched.arm, q, poses, "eye-to-hand")
        if guess is not None and guess.stands_out and guess.zero is None:
            with_joints = (view for view in observed.session.views if view.number in joints)
            has_poses = any(view.base_from_flange() is not None for view in with_joints)
            source = "what the instrument reads"
            raise misread_joints(guess, matched.robot, has_poses=has_poses, seen=source)


@dataclass(frozen=True, eq=False)
class CameraTargetPair:
    """Observations of a target (poses by view) by a camera, with one robot between."""

    camera: str
    target: str
    mount: Mount
    poses: Mapping[int, ViewPoses]


_NO_PAIR = CameraTargetPair("", "", "eye-in-hand", {})


def pairs_of(observed: Observed, robot: str) -> list[CameraTargetPair]:
    """The pairs of a camera and a target with only this robot between, those of most views first.

    Poses of different pairs do not compare.
    """
    pairs: dict[tuple[str, str], dict[int, ViewPoses]] = {}
    for observation in observed.timed.observations:
        view = observation.view.number
        is_alone = [*observation.robots, *observation.missing_robots] == [robot]
        if view in observed.poses and is_camera_observation(observation.view) and is_alone:
            pairs.setdefault((observation.seer, observation.seen), {})[view] = observed.poses[view]
    flange, found_pairs = frame_name("flange", robot), []
    for camera, target in sorted(pairs, key=lambda pair: (-len(pairs[pair]), pair)):
        on_flange = observed.session.frames[camera] == flange
        mount: Mount = "eye-in-hand" if on_flange else "eye-to-hand"
        found_pairs.append(CameraTargetPair(camera, target, mount, pairs[camera, target]))
    return found_pairs


def _guess_seen_joints(
    robot: Robot, q: FloatArray, cam_from_target: FloatArray, mount: Mount
) -> JointGuess | None:
    """Searches for the right reading of joint angles, with enough views."""
    if len(q) < FEWEST_JOINT_ROWS:
        return None
    return guess_joints(robot, q, _as_flange(cam_from_target, mount), FITS_SEEN)


def _contradicted_joints(
    matched: MatchedJoints,
    guess: JointGuess | None,
    seen: Mapping[int, tuple[FloatArray, FloatArray]],
    mount: Mount,
) -> Iterator[Rejection]:
    """Rejects the views whose pose and angles contradict each other with wrong angles."""
    for view, (pose, cam_from_target) in seen.items():
        reason = matched.contradicting[view]
        if guess is None:
            yield Rejection(view, f"{reason}, and too few views show which of them is right")
            continue
        model = guess.best.reading.poses(matched.joints_rad[view][None])[0]
        both = np.array([model, pose @ invert(matched.flange_from_reported)])
        flange_from_base = invert(_as_flange(np.array([cam_from_target, cam_from_target]), mount))
        fit = guess.best.fit
        by_joints, by_pose = distances(flange_from_base, both, fit.lever, (fit.x, fit.z)).residuals
        if by_pose < by_joints:
            yield Rejection(view, f"{reason}, with which the camera agrees")


def _as_flange(cam_from_target: FloatArray, mount: Mount) -> FloatArray:
    """`base_from_flange` up to the two unknown edges."""
    # For a fixed camera it is `cam_from_target`, for a fixed target its inverse.
    return invert(cam_from_target) if mount == "eye-in-hand" else cam_from_target


def misread_joints(
    guess: JointGuess, robot: Robot, *, has_poses: bool, seen: str = "what the camera sees"
) -> DataError:
    """The error for joint angles that only another reading makes fit the observations."""
    sentence = guess.sentence(seen)
    also = " The reported poses are those of the same angles, and as wrong." if has_poses else ""
    columns = guess.best.reading.columns or range(robot.joint_count)
    return DataError(
        f"views.csv: the joint angles are not those of {robot.name} as they are recorded. "
        f"{sentence}{also}",
        culprits=[f"views.csv: q{at + 1}_rad" for at in columns],
        next_step=guess.fix,
    )


def _lost_zero_finding(guess: JointGuess, zero: JointReading, *, is_used: bool) -> Finding:
    """Reports the joint with a lost zero, and how it is used."""
    words = (
        f"The joint angles do not belong to {zero.robot.name} as they are declared. "
        f"{guess.sentence('what the camera sees')}"
    )
    if not is_used:
        return Finding("misread_joints", words, Remedy(zero.fix))
    return Finding("misread_joints", f"{words} {zero_taken(zero)}", Remedy(zero.fix, EXPORT_ARM))

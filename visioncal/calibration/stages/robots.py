"""Reading of the robots' reports, and the check of their joints against the observations."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from visioncal.calibration.guess.fit import distances
from visioncal.calibration.guess.joints import JointGuess, guess_joints
from visioncal.calibration.stages.joints import MatchedJoints
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.reported_poses import RobotReport, reported_poses
from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_COMPARED
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, Mount, Rejection
from visioncal.core.verdict import Finding, Remedy, remarks
from visioncal.robot import Robot
from visioncal.session import Observation, Session, View, frame_name
from visioncal.session.kinds import is_camera_observation, name_of
from visioncal.session.motion import lacks_robot_state
from visioncal.session.table import loads_of
from visioncal.vision.pnp import ViewPoses

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


def check_loads(rows: Sequence[View]) -> None:
    """Refuses views of one declared stop under different loads.

    Raises:
        DataError: Two views of a stop differ; it names them.
    """
    approaches = [view.text.get("approach", "") for view in rows]
    loads, first = loads_of([view.numbers for view in rows], approaches).rows, dict[int, int]()
    for at, view in enumerate(rows):
        other = at if view.stop is None else first.setdefault(view.stop, at)
        if not np.array_equal(loads[at], loads[other]):
            pair = rows[other].number, view.number
            raise DataError(
                f"views {pair[0]} and {pair[1]} are of stop {view.stop} and differ in payload, "
                "force or approach: views of one stop share the pose of the arm, which these "
                "change.",
                culprits=[f"view {number}" for number in pair],
                next_step="Give each of them a stop of its own.",
            )


def _label(session: Session, robot: str) -> str:
    """The name of the robot that findings concern; empty with a single one."""
    return f"Robot {robot}" if len(session.robots) > 1 else ""


def check_joints(observed: T, *, drops: bool) -> T:
    """Refuses joints that only another reading makes fit the cameras' observations.

    With `drops`, views are removed whose pose and joints contradict each other, where the joints
    are right. A lost zero is named.

    Raises:
        DataError: Joints are misread.
    """
    for name, reported in observed.robots.items():
        pairs, label = pairs_of(observed, name), _label(observed.session, name)
        matched, joints = reported.matched, reported.joints_rad or {}
        # `base_from_flange` up to the two unknown edges: `cam_from_target` of a fixed camera, its
        # inverse of a fixed target.
        seen = {
            view: poses.cam_from_target[0]
            for view, poses in (pairs[0].poses if pairs else {}).items()
            if view in joints
        }
        if pairs and pairs[0].mount == "eye-in-hand":
            seen = {view: invert(pose) for view, pose in seen.items()}
        if matched is None or not seen:
            continue
        guess = _guessed(matched, joints, seen, {*matched.contradicting, *observed.held_back})
        if drops:
            lost = tuple(_contradicted_joints(reported, matched, guess, seen))
            poses = dict(reported.base_from_flange)
            for rejection in lost:
                del poses[rejection.view]
            kept = {**observed.robots, name: replace(reported, base_from_flange=poses)}
            observed = replace(observed.noting(lost), robots=kept)
        if guess is None or not guess.stands_out:
            continue
        if (zero := guess.zero) is None:
            error = _misread(observed, reported, matched, guess, "what the camera sees")
            raise error.within(f"robot {name}") if label else error
        words = (
            f"The joint angles do not belong to {zero.robot.name} as they are declared. "
            f"{guess.sentence('what the camera sees')}"
        )
        level, step = "offsets" if zero.zeros.any() else "kinematics", zero.fix
        # A share of all joints is that of no joint's gear.
        if zero.columns:
            step += f" --level {level} finds it to the precision of the views."
        finding = Finding("misread_joints", words, Remedy(step))
        observed = observed.noting((), (finding.of(label),))
    return observed


def check_read_joints(observed: Observed, probes: Mapping[int, FloatArray]) -> None:
    """Refuses joints that only another reading makes fit an instrument's readings.

    `probes` has (4, 4) `instrument_from_probe` by view, or (3,) the places of one point. A small
    lost zero is not refused: it is estimated with the arm.

    Raises:
        DataError: Joints are misread.
    """
    for reported in observed.robots.values():
        matched, joints = reported.matched, reported.joints_rad or {}
        if matched is None:
            continue
        # The instrument is fixed beside the robot, as a camera may be.
        seen = {view: probe for view, probe in probes.items() if view in joints}
        guess = _guessed(matched, joints, seen, observed.held_back)
        if guess is None or not guess.stands_out:
            continue
        # Zeros that are off by less are estimated with the arm [rad]; shares of all angles are not.
        zero = guess.zero
        if zero is None or not zero.columns or np.abs(zero.zeros).max() > 0.1:
            raise _misread(observed, reported, matched, guess, "what the instrument reads")


def _guessed(
    matched: MatchedJoints,
    joints: Mapping[int, FloatArray],
    seen: Mapping[int, FloatArray],
    excluded: Collection[int],
) -> JointGuess | None:
    """Searches for the right reading of joint angles, with enough views.

    `seen` has `base_from_flange` by view, up to the two unknown edges; or the places of a point.
    """
    views = [view for view in seen if view not in excluded]
    if len(views) < FEWEST_COMPARED:
        return None
    q, poses = (np.array([by_view[view] for view in views]) for by_view in (joints, seen))
    return guess_joints(matched.robot, q, poses)


def _contradicted_joints(
    reported: RobotReport,
    matched: MatchedJoints,
    guess: JointGuess | None,
    seen: Mapping[int, FloatArray],
) -> Iterator[Rejection]:
    """Rejects the views whose pose and angles contradict each other with wrong angles."""
    for view in [view for view in seen if view in matched.contradicting]:
        reason = matched.contradicting[view]
        if guess is None:
            yield Rejection(view, f"{reason}, and too few views show which of them is right")
            continue
        model = guess.best.reading.poses(matched.joints_rad[view][None])[0]
        reported_pose = reported.base_from_flange[view]
        pose = reported_pose @ invert(matched.flange_from_reported)
        fit, flange_from_base = guess.best.fit, np.tile(invert(seen[view]), (2, 1, 1))
        compared = distances(flange_from_base, np.array([model, pose]), fit.lever, (fit.x, fit.z))
        by_joints, by_pose = compared.residuals
        if by_pose < by_joints:
            yield Rejection(view, f"{reason}, with which the camera agrees")


def _misread(
    observed: Observed, reported: RobotReport, matched: MatchedJoints, guess: JointGuess, seen: str
) -> DataError:
    """The error for joint angles that only another reading makes fit what is seen."""
    of_robot = (view for view in observed.session.views if view.number in reported.base_from_flange)
    has_poses = any(view.base_from_flange() is not None for view in of_robot)
    also = " The reported poses are those of the same angles, and as wrong." if has_poses else ""
    columns = guess.best.reading.columns or range(matched.robot.joint_count)
    return DataError(
        f"views.csv: the joint angles are not those of {matched.robot.name} as they are recorded. "
        f"{guess.sentence(seen)}{also}",
        culprits=[f"views.csv: q{at + 1}_rad" for at in columns],
        next_step=guess.fix,
    )


@dataclass(frozen=True, eq=False)
class CameraTargetPair:
    """Observations of a target (poses by view) by a camera, with one robot between."""

    camera: str
    target: str
    mount: Mount
    poses: Mapping[int, ViewPoses]


def pairs_of(observed: Observed, robot: str) -> list[CameraTargetPair]:
    """The pairs of a camera and a target with only this robot between, those of most views first.

    Poses of different pairs do not compare.
    """
    pairs: dict[tuple[str, str], dict[int, ViewPoses]] = {}
    for observation in observed.timed.observations:
        view = observation.view.number
        is_single = [*observation.robots, *observation.missing_robots] == [robot]
        if view in observed.poses and is_camera_observation(observation.view) and is_single:
            pairs.setdefault((observation.seer, observation.seen), {})[view] = observed.poses[view]
    flange, found_pairs = frame_name("flange", robot), []
    for camera, target in sorted(pairs, key=lambda pair: (-len(pairs[pair]), pair)):
        on_flange = observed.session.frames[camera] == flange
        mount: Mount = "eye-in-hand" if on_flange else "eye-to-hand"
        found_pairs.append(CameraTargetPair(camera, target, mount, pairs[camera, target]))
    return found_pairs

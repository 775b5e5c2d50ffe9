"""Check of joint angles against the robot's model and its reported poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances
from visioncal.calibration.guess.joints import JointGuess, guess_joints
from visioncal.core.errors import DataError
from visioncal.core.limits import CLEAR_RATIO, FEWEST_COMPARED
from visioncal.core.number_format import mm_and_deg
from visioncal.core.transforms import invert, mean_transform, pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Option, Remedy, mending
from visioncal.robot import Robot
from visioncal.robot.conversion import with_base
from visioncal.robot.files import robot_names
from visioncal.session import View
from visioncal.session.columns import of_other_units
from visioncal.session.table import reported_matrices

# Differences of poses and model [m, rad]: controllers print poses to 0.01 mm or 1e-5 rad at worst;
# those with their own arm's calibration differ from the nominal model by up to the second. Beyond,
# the model is of another arm.
_AGREE, _CALIBRATED = (1e-3, 2e-3), (1e-2, 2e-2)
# Half a turn of the base about its z.
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class MatchedJoints:
    """Joint angles of a session, matched with its reported poses."""

    robot: Robot  # The model, its base in the frame of the poses.
    # (n,) by view, those that belong to it [rad].
    joints_rad: Mapping[int, FloatArray] = field(default_factory=dict)
    # (4, 4) the poses' frame in the model's flange.
    flange_from_reported: FloatArray = field(default_factory=lambda: np.eye(4))
    # (n,) by view, where poses and angles disagree, which leaves none that belong to it [rad].
    disagreeing_rad: Mapping[int, FloatArray] = field(default_factory=dict)
    misread: str = ""  # The fault of the angles or the model, and the fix; empty for none.
    # The fault of the angles, unless the pose has one, by view.
    contradicting: Mapping[int, str] = field(default_factory=dict)
    warnings: tuple[Finding, ...] = ()  # Findings to be mended.
    notes: tuple[str, ...] = ()  # Remarks.

    def pose(self, joints: FloatArray) -> FloatArray:
        """(4, 4) `base_from_flange` as it would have been reported for (n,) joint angles."""
        return np.asarray(self.robot.base_from_flange(joints[None])[0] @ self.flange_from_reported)


def match_joints(rows: Sequence[View], robot: Robot) -> MatchedJoints:
    """Compares the joint angles of a robot with its reported poses.

    Poses that belong to the angles are `base_from_model @ FK(q) @ flange_from_reported` with two
    constant transforms: another base than the model's and a tool on its flange are no mistakes.

    Returns:
        The angles that belong to it, and what is wrong with the others.

    Raises:
        DataError: There are only joints, and they are not as many as the robot's.
    """
    joints = {row.number: q for row in rows if (q := row.joints_rad) is not None}
    by_view = reported_matrices([row for row in rows if row.number in joints])
    if counts := {len(joint) for joint in joints.values()} - {robot.joint_count}:
        words = f"there are {min(counts)} joint angles a row, and {robot.name} has "
        wanted = [f"q{at + 1}_rad" for at in range(min(counts), robot.joint_count)]
        unit_note = of_other_units(wanted, rows[0].text) if rows else ""
        words = f"{words}{robot.joint_count} joints{unit_note}."
        step = "Correct [robot] model in session.toml, or the columns q1_rad ... of views.csv."
        if not by_view:
            raise DataError(f"views.csv: {words}", next_step=step)
        return _misread(robot, f"Joint angles were not used: {words}", step)
    matched, guess = MatchedJoints(robot, joints), None
    if not by_view:
        return matched
    views, poses = tuple(by_view), np.array(list(by_view.values()))
    q = np.array([joints[view] for view in views])
    if len(q) >= FEWEST_COMPARED:
        guess = guess_joints(robot, q, poses)
        # A user's model may be an arm as it was built, whose controller computes with the nominal
        # one.
        is_near = np.all(_typical(guess.declared.fit) <= _CALIBRATED)
        if is_near and robot.name not in robot_names():
            guess = replace(guess, best=guess.declared, rivals=())
        if guess.stands_out:
            sentence = guess.sentence("the reported poses")
            words = f"The joint angles were not used: they are misread. {sentence}"
            return _misread(robot, words, guess.fix)
    model = robot.base_from_flange(q)
    fit = _base_and_flange(model, poses, guess)
    residuals, typical = np.array([fit.shift, fit.angle]), _typical(fit)
    # Outlier rows have residuals beyond this many medians.
    limits = np.maximum(_AGREE, 7.0 * typical)
    is_outlier = np.any(residuals > limits[:, None], axis=0)
    if np.any(typical > _CALIBRATED) or is_outlier.mean() >= 0.5:
        words = (
            f"Poses and joint angles disagree: through the model of {robot.name} the joints give "
            f"poses that differ by up to {_words(residuals.max(axis=1))}. The hand-eye result uses "
            "the poses. The joint angles were not used."
        )
        step = "Check [robot] model and tip, and whether the base frame is the controller's."
        doubt = Finding("other_arm", words, Remedy(step))
        return MatchedJoints(robot, disagreeing_rad=joints, warnings=(doubt,))
    if is_outlier.any():
        reasons = {
            view: f"its joint angles lead {_words(residual)} away from its pose"
            for view, residual, is_out in zip(views, residuals.T, is_outlier, strict=True)
            if is_out
        }
        words = (
            f"Pose and joint angles disagree in {', '.join(f'view {view}' for view in reasons)}, "
            f"by up to {_words(residuals[:, is_outlier].max(axis=1))}; in the other views they "
            "agree. The hand-eye result uses the poses."
        )
        remedy = Remedy("Correct what is wrong there in views.csv.")
        doubt = Finding("contradicting_joints", words, remedy, tuple(reasons))
        matched = replace(matched, contradicting=reasons, warnings=(doubt,))
    if not np.array_equal(fit.x, np.eye(4)):
        matched = _with_base(matched, fit.x)
    inlier_tools = invert(matched.robot.base_from_flange(q[~is_outlier])) @ poses[~is_outlier]
    matched = replace(matched, flange_from_reported=mean_transform(inlier_tools))
    return _report_tool_frame(matched, residuals[:, ~is_outlier].max(axis=1))


def _misread(robot: Robot, words: str, step: str) -> MatchedJoints:
    """The result without angles, and the reason."""
    finding = Finding("misread_joints", words, Remedy(step))
    return MatchedJoints(robot, misread=f"{words} {step}", warnings=(finding,))


def _typical(fit: Fit) -> FloatArray:
    """(2,) median residual [m, rad]."""
    return np.array([np.median(fit.shift), np.median(fit.angle)])


def _base_and_flange(model: FloatArray, poses: FloatArray, guess: JointGuess | None) -> Fit:
    """Fits the flange with the model's own base; another base where clearly better.

    The fit has x, the model's base in the poses' base, and z, its flange in the poses' flange.
    """
    flange_from_base = invert(poses)
    lever = max(float(np.median(np.linalg.norm(model[:, :3, 3], axis=1))), _AGREE[0])
    # The most central tool is robust to wrong rows; poses of one stop give the same.
    tools = np.unique(invert(invert(model) @ poses), axis=0)
    fits = [distances(flange_from_base, model, lever, (np.eye(4), tool)) for tool in tools]
    same_base = min(fits, key=lambda fit: float(np.median(fit.residuals)))
    if guess is None or np.all(_typical(same_base) <= _AGREE):
        return same_base
    ratios = _typical(same_base) / np.maximum(_typical(guess.best.fit), np.finfo(float).tiny)
    return guess.best.fit if ratios.max() > CLEAR_RATIO and ratios.min() >= 1.0 else same_base


def _with_base(matched: MatchedJoints, base: FloatArray) -> MatchedJoints:
    """Puts the arm into the frame of the poses, by the (4, 4) base of the model in it."""
    name, (away_mm, away_deg) = matched.robot.name, pose_difference(_HALF_TURN, base)
    matched = replace(matched, robot=with_base(matched.robot, base))
    if away_mm < 1e3 * _CALIBRATED[0] and away_deg < np.rad2deg(_CALIBRATED[1]):
        words = (
            f"base_link was taken for base: the reported poses are in a frame that is turned by "
            f"180 deg about z from the base of {name}, as ROS's base_link is from the controller's "
            "base. The results are in the frame of the poses, and so is the arm."
        )
        step = Remedy(
            "To have them in the controller's base, record its poses in that; to keep base_link, "
            "name a model that has it for its root."
        )
        return replace(matched, warnings=(*matched.warnings, Finding("base_link", words, step)))
    x, y, z = 1e3 * base[:3, 3]
    words = (
        f"The reported poses are in a frame in which the base of {name} is at ({x:.1f}, {y:.1f}, "
        f"{z:.1f}) mm and turned by {pose_difference(np.eye(4), base)[1]:.2f} deg. The arm was put "
        "there."
    )
    return replace(matched, notes=(words,))


def _report_tool_frame(matched: MatchedJoints, largest: FloatArray) -> MatchedJoints:
    """Reports the frame whose poses are given, and the (2,) largest inlier residual [m, rad]."""
    robot, warnings, notes = matched.robot, list(matched.warnings), list(matched.notes)
    if np.any(largest > _AGREE):
        notes.append(
            f"Through the model of {robot.name} the joint angles give poses that differ by up to "
            f"{_words(largest)} from the reported ones, as where one of model and controller has "
            "the arm's calibration, and the other has not."
        )
    offset_mm, turn_deg = pose_difference(np.eye(4), matched.flange_from_reported)
    limit_m, limit_rad = (largest + _AGREE).tolist()
    if offset_mm > 1e3 * limit_m or turn_deg > np.rad2deg(limit_rad):
        words = (
            f"The reported poses are of a tool frame, {offset_mm:.1f} mm and {turn_deg:.1f} deg "
            f"from the flange of {robot.name}: what the flange carries is placed in that frame."
        )
        step = mending(
            "the poses are the flange's by the joint angles, if the flange itself is meant (next "
            "time, set the controller's tool to zero)",
            Option("by-joints"),
        )
        warnings.append(Finding("tool_frame", words, step))
    return replace(matched, warnings=tuple(warnings), notes=tuple(notes))


def _words(residual: FloatArray) -> str:
    """A (2,) residual [m, rad] in words."""
    return mm_and_deg(1e3 * residual[0], float(np.rad2deg(residual[1])))

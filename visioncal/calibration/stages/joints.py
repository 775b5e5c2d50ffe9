"""Check of joint angles against the robot's model and its reported poses."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances
from visioncal.calibration.guess.joints import (
    FEWEST_JOINT_ROWS,
    JointGuess,
    JointReading,
    guess_joints,
)
from visioncal.calibration.guess.readings import HALF_TURN
from visioncal.core.errors import DataError
from visioncal.core.number_format import mm_and_deg
from visioncal.core.transforms import invert, mean_transform, pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, GUESS, Finding, Remedy
from visioncal.robot import Robot, robot_names, with_base, with_joint_offsets
from visioncal.session import View
from visioncal.session.table import reported_matrices

# Differences of poses and model [m, rad]: controllers print poses to 0.01 mm or 1e-5 rad at worst;
# those with their own arm's calibration differ from the nominal model by up to the second; beyond
# the third the model is of another arm.
_AGREE, _CALIBRATED, _SAME_ARM = (1e-3, 2e-3), (1e-2, 2e-2), (0.05, 0.1)
# Ratio of the model's own base's residuals to those of another base that is preferred.
_BETTER_BASE = 3.0
# Limits for a half turn of the base [mm], [deg]: nominal models err less.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# Outlier rows have residuals beyond this many medians. More are not two rows exchanged; from a half
# of all rows on, it is not the rows that are wrong.
_OUTLIER, _MOST_OUTLIERS = 7.0, 8
_LISTED_COLUMNS = 7
# Exports the calibrated arm for other programs.
EXPORT_ARM = "visioncal export OUT --to robot-urdf -o robot.urdf"


@dataclass(frozen=True, eq=False)
class MatchedJoints:
    """Joint angles of a session, matched with its reported poses."""

    robot: Robot  # The model, its base in the frame of the poses.
    # (n,) by view, those that belong to it [rad].
    joints_rad: Mapping[int, FloatArray] = field(default_factory=dict)
    # (4, 4) the poses' frame in the model's flange.
    flange_from_reported: FloatArray = field(default_factory=lambda: np.eye(4))
    # The reading with the joint whose zero is shifted, by the poses; None for none.
    zero: JointReading | None = None
    misread: str = ""  # What is wrong with the angles or the model, and the fix; empty for nothing.
    # What is wrong with the angles, unless the pose is, by view.
    contradicting: Mapping[int, str] = field(default_factory=dict)
    warnings: tuple[Finding, ...] = ()  # Findings to be mended.
    notes: tuple[str, ...] = ()  # Remarks.

    @property
    def arm(self) -> Robot:
        """The model with its zeros as the poses determine them."""
        return self.robot if self.zero is None else with_joint_offsets(self.robot, self.zero.zeros)

    def pose(self, joints: FloatArray) -> FloatArray:
        """(4, 4) `base_from_flange` as it would have been reported for (n,) joint angles.

        Raises:
            DataError: They are not as many as the robot's.
        """
        if len(joints) != self.robot.joint_count:
            columns = ", ".join(f"q{at + 1}_rad" for at in range(min(len(joints), _LISTED_COLUMNS)))
            raise DataError(
                f"views.csv: {len(joints)} joint angles ({columns}), but {self.robot.name} has "
                f"{self.robot.joint_count} joints.",
                next_step="Correct [robot] model in session.toml, or the columns.",
            )
        return np.asarray(self.arm.base_from_flange(joints[None])[0] @ self.flange_from_reported)


def match_joints(rows: Sequence[View], robot: Robot) -> MatchedJoints:
    """Compares the joint angles of a robot with its reported poses.

    Poses that belong to the angles are `base_from_model @ FK(q) @ flange_from_reported` with two
    constant transforms: another base than the model's and a tool on its flange are no mistakes.

    Returns:
        The angles that belong to it, and what is wrong with the others.
    """
    joints = {row.number: q for row in rows if (q := row.joints_rad) is not None}
    by_view = reported_matrices([row for row in rows if row.number in joints])
    counts = {len(joint) for joint in joints.values()} - {robot.joint_count}
    if counts:
        words = (
            f"Joint angles were not used: there are {min(counts)} a row, and {robot.name} has "
            f"{robot.joint_count} joints."
        )
        step = "Correct [robot] model in session.toml, or the columns q1_rad ... of views.csv."
        finding = Finding("misread_joints", words, Remedy(step))
        return MatchedJoints(robot, warnings=(finding,) if by_view else ())
    matched, guess = MatchedJoints(robot, joints), None
    if not by_view:
        return matched
    views, poses = tuple(by_view), np.array(list(by_view.values()))
    q = np.array([joints[view] for view in views])
    if len(q) >= FEWEST_JOINT_ROWS:
        guess = guess_joints(robot, q, poses)
        if _is_calibrated(robot, guess):
            guess = replace(guess, best=guess.declared, rivals=())
    if guess is not None and guess.stands_out:
        sentence, zero = guess.sentence("the reported poses"), guess.zero
        if zero is None:
            misread = f"The angles of this session are misread. {sentence} {guess.fix}"
            words = f"The joint angles were not used: they are misread. {sentence}"
            doubt = Finding("misread_joints", words, Remedy(guess.fix))
            return MatchedJoints(robot, misread=misread, warnings=(doubt,))
        words = (
            "The joint angles do not belong to the reported poses as they are declared. "
            f"{sentence} {zero_taken(zero)}"
        )
        shifted = Finding("misread_joints", words, Remedy(zero.fix, EXPORT_ARM))
        matched = replace(matched, zero=zero, warnings=(shifted,))
    model = matched.arm.base_from_flange(q)
    fit = _base_and_flange(model, poses, guess)
    residuals, typical = np.array([fit.shift, fit.angle]), _typical(fit)
    limits = np.maximum(_AGREE, _OUTLIER * typical)
    is_outlier = np.any(residuals > limits[:, None], axis=0)
    if np.any(typical > _SAME_ARM) or is_outlier.mean() >= 0.5:
        finding = _other_arm(robot, residuals.max(axis=1))
        words = f"{finding.words} The joint angles were not used."
        return MatchedJoints(robot, warnings=(replace(finding, words=words),))
    outliers = np.flatnonzero(is_outlier).tolist()
    if outliers:
        swapped = _exchanged(fit, limits, outliers, (model, poses))
        found = _contradictions(residuals, outliers, swapped, views)
        reasons = {
            views[row]: f"its joint angles lead {_words(residuals[:, row])} away from its pose"
            for row in outliers
        }
        reasons |= {
            views[row]: f"its joint angles are those of view {views[sum(swapped) - row]}"
            for row in swapped
        }
        warnings = (*matched.warnings, *found)
        matched = replace(matched, contradicting=reasons, warnings=warnings)
    if not np.array_equal(fit.x, np.eye(4)):
        matched = replace(_report_base(matched, fit.x), robot=with_base(robot, fit.x))
    inlier_tools = invert(matched.arm.base_from_flange(q[~is_outlier])) @ poses[~is_outlier]
    matched = replace(matched, flange_from_reported=mean_transform(inlier_tools))
    return _report_tool_frame(matched, residuals[:, ~is_outlier].max(axis=1), typical)


def _typical(fit: Fit) -> FloatArray:
    """(2,) median residual [m, rad]."""
    return np.array([np.median(fit.shift), np.median(fit.angle)])


def _is_calibrated(robot: Robot, guess: JointGuess) -> bool:
    """Whether the user's model is a built-in arm's except for what calibration changes.

    Its controller computes with the built-in one, which fits the poses that it reports exactly.
    """
    reading = guess.best.reading
    is_near = np.all(_typical(guess.declared.fit) <= _CALIBRATED)
    is_other = not reading.is_zero and np.array_equal(reading.mixing, np.eye(robot.joint_count))
    return bool(is_near and is_other and robot.name not in robot_names())


def _base_and_flange(model: FloatArray, poses: FloatArray, guess: JointGuess | None) -> Fit:
    """Fits the flange with the model's own base; another base where clearly better.

    The fit has x, the model's base in the poses' base, and z, its flange in the poses' flange.
    """
    flange_from_base = invert(poses)
    lever = max(float(np.median(np.linalg.norm(model[:, :3, 3], axis=1))), _AGREE[0])
    # The most central one, robust to wrong rows; those of one stop give the same.
    tools = np.unique(invert(invert(model) @ poses), axis=0)
    fits = [distances(flange_from_base, model, lever, (np.eye(4), tool)) for tool in tools]
    own = min(fits, key=lambda fit: float(np.median(fit.residuals)))
    if guess is None or np.all(_typical(own) <= _AGREE):
        return own
    ratios = _typical(own) / np.maximum(_typical(guess.best.fit), np.finfo(float).tiny)
    return guess.best.fit if ratios.max() > _BETTER_BASE and ratios.min() >= 1.0 else own


def _exchanged(
    fit: Fit, limits: FloatArray, outliers: Sequence[int], sides: tuple[FloatArray, FloatArray]
) -> tuple[int, ...]:
    """The two rows whose angles lead to each other's pose; empty for none or several."""
    (model, poses), pairs = sides, []
    for pair in combinations(outliers, 2) if len(outliers) <= _MOST_OUTLIERS else ():
        flange_from_base, crossed = invert(poses[list(pair)]), model[list(pair[::-1])]
        residuals = distances(flange_from_base, crossed, fit.lever, (fit.x, fit.z))
        if residuals.shift.max() < limits[0] and residuals.angle.max() < limits[1]:
            pairs.append(pair)
    return pairs[0] if len(pairs) == 1 else ()


def _contradictions(
    residuals: FloatArray, outliers: Sequence[int], swapped: Sequence[int], views: Sequence[int]
) -> Iterator[Finding]:
    """Reports outlier rows, by (2, n) residuals: two exchanged ones, and the others."""
    if swapped:
        first, second = (views[row] for row in swapped)
        words = (
            f"The joint angles of views {first} and {second} are exchanged, or their poses are: "
            "each view's angles lead to the other's pose. The hand-eye result uses the poses."
        )
        step = Remedy(
            "Exchange q1_rad ... of both rows in views.csv, or x_m to qw where these are wrong, "
            "and calibrate again.",
            CALIBRATE,
        )
        yield Finding("exchanged_joints", words, step, (first, second))
    rest = [row for row in outliers if row not in swapped]
    if rest:
        named = tuple(views[row] for row in rest)
        words = (
            f"Pose and joint angles disagree in {', '.join(f'view {view}' for view in named)}, by "
            f"up to {_words(residuals[:, rest].max(axis=1))}; in the other views they agree. The "
            "hand-eye result uses the poses."
        )
        step = Remedy("Correct what is wrong there in views.csv.")
        yield Finding("contradicting_joints", words, step, named)


def _report_base(matched: MatchedJoints, base: FloatArray) -> MatchedJoints:
    """Reports the frame in which the poses are, by the (4, 4) base of the model in it."""
    name = matched.robot.name
    away_mm, away_deg = pose_difference(HALF_TURN, base)
    if away_mm < _NEAR_MM and away_deg < _NEAR_DEG:
        words = (
            f"base_link was taken for base: the reported poses are in a frame that is turned by "
            f"180 deg about z from the base of {name}, as ROS's base_link is from the controller's "
            "base. The results are in the frame of the poses, and so is the arm."
        )
        step = Remedy(
            "To have them in the controller's base, write a copy of the session whose poses are "
            "turned; to keep base_link, name a model that has it for its root.",
            GUESS,
        )
        return replace(matched, warnings=(*matched.warnings, Finding("base_link", words, step)))
    x, y, z = 1e3 * base[:3, 3]
    words = (
        f"The reported poses are in a frame in which the base of {name} is at ({x:.1f}, {y:.1f}, "
        f"{z:.1f}) mm and turned by {pose_difference(np.eye(4), base)[1]:.2f} deg. The arm was put "
        "there."
    )
    return replace(matched, notes=(*matched.notes, words))


def _report_tool_frame(
    matched: MatchedJoints, largest: FloatArray, typical: FloatArray
) -> MatchedJoints:
    """Reports the frame whose poses are given, and how well the model predicts them.

    Both are (2,) residuals [m, rad]: the largest inlier, and the typical one.
    """
    robot, warnings, notes = matched.robot, list(matched.warnings), list(matched.notes)
    if np.any(largest > _AGREE):
        if np.any(typical > _CALIBRATED):
            warnings.append(_other_arm(robot, largest))
        else:
            notes.append(
                f"Through the model of {robot.name} the joint angles give poses that differ by up "
                f"to {_words(largest)} from the reported ones, as where one of model and "
                "controller has the arm's calibration, and the other has not."
            )
    offset_mm, turn_deg = pose_difference(np.eye(4), matched.flange_from_reported)
    limit_m, limit_rad = (largest + _AGREE).tolist()
    if offset_mm > 1e3 * limit_m or turn_deg > np.rad2deg(limit_rad):
        words = (
            f"The reported poses are of a tool frame, {offset_mm:.1f} mm and {turn_deg:.1f} deg "
            f"from the flange of {robot.name}: what the flange carries is placed in that frame."
        )
        step = Remedy(
            "If the flange itself is meant, set the controller's tool to zero and record again, or "
            "delete x_m to qw in views.csv: the poses are then those of the joint angles."
        )
        warnings.append(Finding("tool_frame", words, step))
    return replace(matched, warnings=tuple(warnings), notes=tuple(notes))


def _other_arm(robot: Robot, largest: FloatArray) -> Finding:
    return Finding(
        "other_arm",
        f"Poses and joint angles disagree: through the model of {robot.name} the joints give poses "
        f"that differ by up to {_words(largest)}. The hand-eye result uses the poses.",
        Remedy("Check [robot] model and tip, and whether the base frame is the controller's."),
    )


def zero_taken(zero: JointReading) -> str:
    """States how a shifted zero is used."""
    name = zero.robot.joint_names[zero.columns[0]]
    return f"The zero of {name} was taken so, and the arm is calibrated from there."


def _words(residual: FloatArray) -> str:
    """A (2,) residual [m, rad] in words."""
    return mm_and_deg(1e3 * residual[0], float(np.rad2deg(residual[1])))

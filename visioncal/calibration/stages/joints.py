"""Check of joint angles against the robot's model and its reported poses."""

from collections.abc import Mapping, Sequence
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
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.core.verdict import CALIBRATE, GUESS, Finding, Remedy
from visioncal.robot import Robot, robot_names, with_base, with_joint_offsets
from visioncal.session import View
from visioncal.session.table import reported_matrices

# Controllers print poses to 0.01 mm or 1e-5 rad at worst; a model of another robot, another tip or
# another convention differs by far more.
_AGREE_M, _AGREE_RAD = 1e-3, 2e-3
# Controllers with their own arm's calibration report poses that differ from the nominal model by up
# to this.
_CALIBRATED_M, _CALIBRATED_RAD = 1e-2, 2e-2
# Beyond this, the model is of another arm.
_SAME_ARM_M, _SAME_ARM_RAD = 0.05, 0.1
# Ratio of the model's own base's residuals to those of another base that is preferred.
_BETTER_BASE = 3.0
# Limits for a half turn of the base [mm], [deg]: nominal models err less.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# Outlier rows have residuals beyond this many medians.
_OUTLIER = 7.0
# More outlier rows are not two rows exchanged.
_MOST_OUTLIERS = 8
# With at least this share of outlier rows, it is not the rows that are wrong.
_HALF = 0.5
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


@dataclass(frozen=True, eq=False)
class _BaseAndFlange:
    """Constant transforms between model and reported poses, and the residual of each row.

    `fit` has x, the model's base in the poses' base, and z, its flange in the poses' flange.
    """

    fit: Fit

    @property
    def typical(self) -> tuple[float, float]:
        """Median residual [m], [rad]."""
        return float(np.median(self.fit.shift)), float(np.median(self.fit.angle))

    def limits(self) -> tuple[float, float]:
        """Limits beyond which a row is an outlier [m], [rad]."""
        shift, angle = self.typical
        return max(_AGREE_M, _OUTLIER * shift), max(_AGREE_RAD, _OUTLIER * angle)

    @property
    def outliers(self) -> Mask:
        """(n,) outlier rows."""
        shift, angle = self.limits()
        return np.asarray((self.fit.shift > shift) | (self.fit.angle > angle))

    @property
    def figures(self) -> str:
        return _words(self.fit.shift.max(), self.fit.angle.max())


def match_joints(rows: Sequence[View], robot: Robot) -> MatchedJoints:
    """Compares the joint angles of a robot with its reported poses.

    Poses that belong to the angles are `base_from_model @ FK(q) @ flange_from_reported` with two
    constant transforms: another base than the model's and a tool on its flange are no mistakes.

    Returns:
        The angles that belong to it, and what is wrong with the others.
    """
    joints = {row.number: q for row in rows if (q := row.joints_rad) is not None}
    poses = reported_matrices([row for row in rows if row.number in joints])
    counts = {len(joint) for joint in joints.values()} - {robot.joint_count}
    if counts:
        words = (
            f"Joint angles were not used: there are {min(counts)} a row, and {robot.name} has "
            f"{robot.joint_count} joints."
        )
        step = "Correct [robot] model in session.toml, or the columns q1_rad ... of views.csv."
        finding = Finding("misread_joints", words, Remedy(step))
        return MatchedJoints(robot, warnings=(finding,) if poses else ())
    if not poses:
        return MatchedJoints(robot, joints)
    views, q = tuple(poses), np.array([joints[view] for view in poses])
    return _compared(MatchedJoints(robot, joints), views, q, np.array(list(poses.values())))


def _compared(
    matched: MatchedJoints, views: Sequence[int], q: FloatArray, poses: FloatArray
) -> MatchedJoints:
    robot, guess = matched.robot, None
    if len(q) >= FEWEST_JOINT_ROWS:
        guess = guess_joints(robot, q, poses)
        if _is_calibrated(robot, guess):
            guess = replace(guess, best=guess.declared, rivals=())
    if guess is not None and guess.stands_out and guess.zero is None:
        sentence = guess.sentence("the reported poses")
        words = f"The joint angles were not used: they are misread. {sentence}"
        misread = f"The angles of this session are misread. {sentence} {guess.fix}"
        doubt = Finding("misread_joints", words, Remedy(guess.fix))
        return MatchedJoints(robot, misread=misread, warnings=(doubt,))
    if guess is not None and (zero := guess.zero) is not None:
        words = (
            "The joint angles do not belong to the reported poses as they are declared. "
            f"{guess.sentence('the reported poses')} {zero_taken(zero)}"
        )
        shifted = Finding("misread_joints", words, Remedy(zero.fix, EXPORT_ARM))
        matched = replace(matched, zero=zero, warnings=(shifted,))
    model = matched.arm.base_from_flange(q)
    constants = _fit_base_and_flange(model, poses, guess)
    typical_m, typical_rad = constants.typical
    outliers = constants.outliers
    if typical_m > _SAME_ARM_M or typical_rad > _SAME_ARM_RAD or outliers.mean() >= _HALF:
        finding = _other_arm(robot, constants.figures)
        words = f"{finding.words} The joint angles were not used."
        return MatchedJoints(robot, warnings=(replace(finding, words=words),))
    matched = _report_outliers(matched, constants, views, (model, poses))
    if not np.array_equal(constants.fit.x, np.eye(4)):
        matched = replace(_report_base(matched, constants), robot=with_base(robot, constants.fit.x))
    tool = mean_transform(invert(matched.arm.base_from_flange(q[~outliers])) @ poses[~outliers])
    return _report_tool_frame(replace(matched, flange_from_reported=tool), constants)


def _is_calibrated(robot: Robot, guess: JointGuess) -> bool:
    """Whether the user's model is a built-in arm's except for what calibration changes.

    Its controller computes with the built-in one, which fits the poses that it reports exactly.
    """
    reading, fit = guess.best.reading, guess.declared.fit
    is_near = np.median(fit.shift) <= _CALIBRATED_M and np.median(fit.angle) <= _CALIBRATED_RAD
    is_other = not reading.is_zero and np.array_equal(reading.mixing, np.eye(robot.joint_count))
    return bool(is_near and is_other and robot.name not in robot_names())


def _fit_base_and_flange(
    model: FloatArray, poses: FloatArray, guess: JointGuess | None
) -> _BaseAndFlange:
    """Fits the flange with the model's own base; another base where clearly better."""
    flange_from_reported, flange_from_base = invert(model) @ poses, invert(poses)
    lever = max(float(np.median(np.linalg.norm(model[:, :3, 3], axis=1))), _AGREE_M)
    # The most central one, robust to wrong rows; those of one stop give the same.
    first = np.unique(flange_from_reported, axis=0, return_index=True)[1]
    fits = [
        distances(flange_from_base, model, lever, (np.eye(4), invert(flange_from_reported[index])))
        for index in np.sort(first)
    ]
    own = _BaseAndFlange(min(fits, key=lambda value: float(np.median(value.residuals))))
    if guess is None:
        return own
    other = _BaseAndFlange(guess.best.fit)
    (own_m, own_rad), (other_m, other_rad) = own.typical, other.typical
    disagree = own_m > _AGREE_M or own_rad > _AGREE_RAD
    better = own_m > _BETTER_BASE * other_m and own_rad >= other_rad
    better |= own_rad > _BETTER_BASE * other_rad and own_m >= other_m
    return other if disagree and better else own


def _report_outliers(
    matched: MatchedJoints,
    constants: _BaseAndFlange,
    views: Sequence[int],
    sides: tuple[FloatArray, FloatArray],
) -> MatchedJoints:
    """Reports the views whose pose is not that of their angles."""
    outliers = np.flatnonzero(constants.outliers)
    if not len(outliers):
        return matched
    swapped = _exchanged(constants, outliers, sides)
    reasons: dict[int, str] = {}
    warnings = list(matched.warnings)
    for row in outliers.tolist():
        residual = _words(constants.fit.shift[row], constants.fit.angle[row])
        reasons[views[row]] = f"its joint angles lead {residual} away from its pose"
        if row in swapped:
            mate = views[sum(swapped) - row]
            reasons[views[row]] = f"its joint angles are those of view {mate}"
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
        warnings.append(Finding("exchanged_joints", words, step, (first, second)))
    rest = [row for row in outliers.tolist() if row not in swapped]
    if rest:
        shift, angle = constants.fit.shift[rest].max(), constants.fit.angle[rest].max()
        words = (
            f"Pose and joint angles disagree in "
            f"{', '.join(f'view {views[index]}' for index in rest)}, "
            f"by up to {_words(shift, angle)}; in the other views they agree. The hand-eye result "
            "uses the poses."
        )
        step = Remedy("Correct what is wrong there in views.csv.")
        named = tuple(views[index] for index in rest)
        warnings.append(Finding("contradicting_joints", words, step, named))
    return replace(matched, contradicting=reasons, warnings=tuple(warnings))


def _exchanged(
    constants: _BaseAndFlange, outliers: IntArray, sides: tuple[FloatArray, FloatArray]
) -> tuple[int, ...]:
    """The two rows whose angles lead to each other's pose; empty for none or several."""
    model, poses = sides
    fit, limits = constants.fit, constants.limits()
    pairs = []
    for pair in combinations(outliers.tolist(), 2) if len(outliers) <= _MOST_OUTLIERS else ():
        crossed = distances(
            invert(poses[list(pair)]), model[list(pair[::-1])], fit.lever, (fit.x, fit.z)
        )
        if crossed.shift.max() < limits[0] and crossed.angle.max() < limits[1]:
            pairs.append(pair)
    return pairs[0] if len(pairs) == 1 else ()


def _report_base(matched: MatchedJoints, constants: _BaseAndFlange) -> MatchedJoints:
    """Reports the frame in which the poses are."""
    name, base = matched.robot.name, constants.fit.x
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
    turn = pose_difference(np.eye(4), base)[1]
    words = (
        f"The reported poses are in a frame in which the base of {name} is at ({x:.1f}, {y:.1f}, "
        f"{z:.1f}) mm and turned by {turn:.2f} deg. The arm was put there."
    )
    return replace(matched, notes=(*matched.notes, words))


def _report_tool_frame(matched: MatchedJoints, constants: _BaseAndFlange) -> MatchedJoints:
    """Reports the frame whose poses are given, and how well the model predicts them."""
    robot, tool = matched.robot, matched.flange_from_reported
    warnings, notes = list(matched.warnings), list(matched.notes)
    fit, inliers = constants.fit, ~constants.outliers
    shift, angle = fit.shift[inliers].max(), fit.angle[inliers].max()
    if shift > _AGREE_M or angle > _AGREE_RAD:
        differ = _words(shift, angle)
        typical_m, typical_rad = constants.typical
        if typical_m > _CALIBRATED_M or typical_rad > _CALIBRATED_RAD:
            warnings.append(_other_arm(robot, differ))
        else:
            notes.append(
                f"Through the model of {robot.name} the joint angles give poses that differ by up "
                f"to {differ} from the reported ones, as where one of model and controller has the "
                "arm's calibration, and the other has not."
            )
    offset_mm, turn_deg = pose_difference(np.eye(4), tool)
    if offset_mm > 1e3 * _AGREE_M + shift * 1e3 or turn_deg > np.rad2deg(_AGREE_RAD + angle):
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


def _other_arm(robot: Robot, figures: str) -> Finding:
    return Finding(
        "other_arm",
        f"Poses and joint angles disagree: through the model of {robot.name} the joints give poses "
        f"that differ by up to {figures}. The hand-eye result uses the poses.",
        Remedy("Check [robot] model and tip, and whether the base frame is the controller's."),
    )


def zero_taken(zero: JointReading) -> str:
    """States how a shifted zero is used."""
    name = zero.robot.joint_names[zero.columns[0]]
    return f"The zero of {name} was taken so, and the arm is calibrated from there."


def _words(shift_m: float, angle_rad: float) -> str:
    return mm_and_deg(1e3 * shift_m, float(np.rad2deg(angle_rad)))

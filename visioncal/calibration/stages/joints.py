"""Whether joint angles belong to the robot's model and to its reported poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances
from visioncal.calibration.guess.hypothesis import HALF_TURN
from visioncal.calibration.guess.joints import JointReading
from visioncal.calibration.guess.misread import FEWEST_JOINT_ROWS, JointGuess, guess_joints
from visioncal.core.errors import DataError
from visioncal.core.number_format import mm_and_deg
from visioncal.core.transforms import invert, mean_transform, pose_difference
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.core.verdict import CALIBRATE, GUESS, Finding, Remedy
from visioncal.robot import Robot, placed_at, robot_names, with_zeros
from visioncal.session import View
from visioncal.session.table import reported_matrices

# Controllers print poses to 0.01 mm or 1e-5 rad at worst; a model of another robot, another tip or
# another convention is off by far more.
_AGREE_M, _AGREE_RAD = 1e-3, 2e-3
# Controllers that know their own arm's calibration report poses so far from the nominal model.
_CALIBRATED_M, _CALIBRATED_RAD = 1e-2, 2e-2
# Beyond, the model is of another arm.
_SAME_ARM_M, _SAME_ARM_RAD = 0.05, 0.1
# Another base explains the poses where it leaves so much less than the model's own.
_CLEARLY = 3.0
# A half turn of the base is meant within this [mm], [deg]: nominal models err less.
_NEAR_MM, _NEAR_DEG = 10.0, 2.0
# A row does not belong to the others beyond this many times their median distance.
_OUT = 7.0
# More rows than this that disagree are no two rows exchanged.
_MOST = 8
# Where at least this share of the rows disagrees, it is not the rows that are wrong.
_HALF = 0.5
_LISTED_COLUMNS = 7
# The arm as it was calibrated, for other programs.
ARM_AS_FOUND = "visioncal export OUT --to robot-urdf -o robot.urdf"


@dataclass(frozen=True, eq=False)
class Matched:
    """The joint angles of a session beside its reported poses.

    Attributes:
        robot: The model, its base in the frame of the poses.
        joints_rad: (n,) by view, those that belong to it [rad].
        flange_from_reported: (4, 4) the frame of the poses in the model's flange.
        zero: The joint whose zero is elsewhere, as the poses show; None for none.
        misread: What is wrong with the angles or the model, and the fix; empty where nothing is.
        contradicting: What is wrong with the angles, if it is not the pose, by view.
        warnings: What to mend.
        notes: What is good to know.
    """

    robot: Robot
    joints_rad: Mapping[int, FloatArray] = field(default_factory=dict)
    flange_from_reported: FloatArray = field(default_factory=lambda: np.eye(4))
    zero: JointReading | None = None
    misread: str = ""
    contradicting: Mapping[int, str] = field(default_factory=dict)
    warnings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def arm(self) -> Robot:
        """The model with its zeros where the poses have them."""
        return self.robot if self.zero is None else with_zeros(self.robot, self.zero.zeros)

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
class _Constants:
    """Where the model's base and the poses' flange are, and what is left of each row.

    `fit` has x, the model's base in the poses' base, and z, its flange in the poses' flange.
    """

    fit: Fit

    @property
    def typical(self) -> tuple[float, float]:
        """What is left of most rows [m], [rad]."""
        return float(np.median(self.fit.shift)), float(np.median(self.fit.angle))

    def limits(self) -> tuple[float, float]:
        """From where on a row does not belong to the others [m], [rad]."""
        shift, angle = self.typical
        return max(_AGREE_M, _OUT * shift), max(_AGREE_RAD, _OUT * angle)

    @property
    def out(self) -> Mask:
        """(n,) the rows that do not belong to the others."""
        shift, angle = self.limits()
        return np.asarray((self.fit.shift > shift) | (self.fit.angle > angle))

    @property
    def figures(self) -> str:
        return _away(self.fit.shift.max(), self.fit.angle.max())


def match_joints(rows: Sequence[View], robot: Robot) -> Matched:
    """Compares the joint angles of a robot with its reported poses.

    Poses that belong to the angles are `base_from_model @ FK(q) @ flange_from_reported` with two
    constants: another base than the model's and a tool on its flange are no mistakes.

    Args:
        rows: The views with its pose.
        robot: Its model, as the session names it.

    Returns:
        The angles that belong to it, and what does not.
    """
    joints = {row.number: q for row in rows if (q := row.joints_rad) is not None}
    poses = reported_matrices([row for row in rows if row.number in joints])
    counts = {len(joint) for joint in joints.values()} - {robot.joint_count}
    if counts:
        words = (
            f"Joint angles were not used: there are {min(counts)} a row, and {robot.name} has "
            f"{robot.joint_count} joints."
        )
        step = Remedy(
            "Correct [robot] model in session.toml, or the columns q1_rad ... of views.csv."
        )
        return Matched(robot, warnings=(Finding("misread_joints", words, step),) if poses else ())
    if not poses:
        return Matched(robot, joints)
    views, q = tuple(poses), np.array([joints[view] for view in poses])
    return _compared(Matched(robot, joints), views, q, np.array(list(poses.values())))


def _compared(matched: Matched, views: Sequence[int], q: FloatArray, poses: FloatArray) -> Matched:
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
        return Matched(robot, misread=misread, warnings=(doubt,))
    zero = None if guess is None else guess.zero
    if zero is not None and guess is not None:
        words = (
            "The joint angles do not belong to the reported poses as they are declared. "
            f"{guess.sentence('the reported poses')} {zero_taken(zero)}"
        )
        lost = Finding("misread_joints", words, Remedy(zero.fix, ARM_AS_FOUND))
        matched = replace(matched, zero=zero, warnings=(lost,))
    model = matched.arm.base_from_flange(q)
    found = _constants(model, poses, guess)
    typical_m, typical_rad = found.typical
    is_other = typical_m > _SAME_ARM_M or typical_rad > _SAME_ARM_RAD or found.out.mean() >= _HALF
    if is_other:
        return Matched(robot, warnings=(_of_another_arm(robot, found),))
    matched = _rows_out(matched, found, views, (model, poses))
    if not np.array_equal(found.fit.x, np.eye(4)):
        matched = replace(_based(matched, found), robot=placed_at(robot, found.fit.x))
    sound = ~found.out
    tool = mean_transform(invert(matched.arm.base_from_flange(q[sound])) @ poses[sound])
    return _described(replace(matched, flange_from_reported=tool), found)


def _is_calibrated(robot: Robot, guess: JointGuess) -> bool:
    """Whether a model of one's own is a built-in arm's but for what calibration changes.

    Its controller computes with the built-in one, which fits the poses that it reports exactly.
    """
    reading, fit = guess.best.reading, guess.declared.fit
    is_near = np.median(fit.shift) <= _CALIBRATED_M and np.median(fit.angle) <= _CALIBRATED_RAD
    is_other = not reading.is_zero and np.array_equal(reading.mixing, np.eye(robot.joint_count))
    return bool(is_near and is_other and robot.name not in robot_names())


def _constants(model: FloatArray, poses: FloatArray, guess: JointGuess | None) -> _Constants:
    """The model's own base, with whatever is on its flange; another base where that is clear."""
    flange_from_reported, of_poses = invert(model) @ poses, invert(poses)
    lever = max(float(np.median(np.linalg.norm(model[:, :3, 3], axis=1))), _AGREE_M)
    # The most central one, which wrong rows do not move as they would move the mean.
    # Rows of one stop give the same.
    first = np.unique(flange_from_reported, axis=0, return_index=True)[1]
    around = [
        distances(of_poses, model, lever, (np.eye(4), invert(flange_from_reported[index])))
        for index in np.sort(first)
    ]
    same = _Constants(min(around, key=lambda value: float(np.median(value.away))))
    if guess is None:
        return same
    other = _Constants(guess.best.fit)
    (same_m, same_rad), (other_m, other_rad) = same.typical, other.typical
    disagree = same_m > _AGREE_M or same_rad > _AGREE_RAD
    better = same_m > _CLEARLY * other_m and same_rad >= other_rad
    better |= same_rad > _CLEARLY * other_rad and same_m >= other_m
    return other if disagree and better else same


def _rows_out(
    matched: Matched,
    found: _Constants,
    views: Sequence[int],
    sides: tuple[FloatArray, FloatArray],
) -> Matched:
    """Names the views whose pose is not that of their angles."""
    out = np.flatnonzero(found.out)
    if not len(out):
        return matched
    swapped = _exchanged(found, out, sides)
    reasons: dict[int, str] = {}
    warnings = list(matched.warnings)
    for row in out.tolist():
        away = _away(found.fit.shift[row], found.fit.angle[row])
        reasons[views[row]] = f"its joint angles lead {away} away from its pose"
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
    rest = [row for row in out.tolist() if row not in swapped]
    if rest:
        shift, angle = found.fit.shift[rest].max(), found.fit.angle[rest].max()
        words = (
            f"Pose and joint angles disagree in "
            f"{', '.join(f'view {views[index]}' for index in rest)}, "
            f"by up to {_away(shift, angle)}; in the other views they agree. The hand-eye result "
            "uses the poses."
        )
        step = Remedy("Correct what is wrong there in views.csv.")
        named = tuple(views[index] for index in rest)
        warnings.append(Finding("contradicting_joints", words, step, named))
    return replace(matched, contradicting=reasons, warnings=tuple(warnings))


def _exchanged(
    found: _Constants, out: IntArray, sides: tuple[FloatArray, FloatArray]
) -> tuple[int, ...]:
    """The two rows whose angles lead to each other's pose; empty where there are none, or more."""
    model, poses = sides
    fit, limits = found.fit, found.limits()
    pairs = []
    for pair in combinations(out.tolist(), 2) if len(out) <= _MOST else ():
        crossed = distances(
            invert(poses[list(pair)]), model[list(pair[::-1])], fit.lever, (fit.x, fit.z)
        )
        if crossed.shift.max() < limits[0] and crossed.angle.max() < limits[1]:
            pairs.append(pair)
    return pairs[0] if len(pairs) == 1 else ()


def _based(matched: Matched, found: _Constants) -> Matched:
    """Says in which frame the poses are."""
    name, base = matched.robot.name, found.fit.x
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


def _described(matched: Matched, found: _Constants) -> Matched:
    """Says of which frame the poses are, and how well the model predicts them."""
    robot, tool = matched.robot, matched.flange_from_reported
    warnings, notes = list(matched.warnings), list(matched.notes)
    shift, angle = (array[~found.out].max() for array in (found.fit.shift, found.fit.angle))
    if shift > _AGREE_M or angle > _AGREE_RAD:
        away = _away(shift, angle)
        typical_m, typical_rad = found.typical
        if typical_m > _CALIBRATED_M or typical_rad > _CALIBRATED_RAD:
            warnings.append(_disagree(robot, away))
        else:
            notes.append(
                f"Through the model of {robot.name} the joint angles give poses that differ by up "
                f"to {away} from the reported ones, as where one of model and controller has the "
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


def _of_another_arm(robot: Robot, found: _Constants) -> Finding:
    disagree = _disagree(robot, found.figures)
    return replace(disagree, words=f"{disagree.words} The joint angles were not used.")


def _disagree(robot: Robot, figures: str) -> Finding:
    return Finding(
        "other_arm",
        f"Poses and joint angles disagree: through the model of {robot.name} the joints give poses "
        f"that differ by up to {figures}. The hand-eye result uses the poses.",
        Remedy("Check [robot] model and tip, and whether the base frame is the controller's."),
    )


def zero_taken(zero: JointReading) -> str:
    """Says what becomes of a lost zero that is used."""
    name = zero.robot.joint_names[zero.columns[0]]
    return f"The zero of {name} was taken so, and the arm is calibrated from there."


def _away(shift_m: float, angle_rad: float) -> str:
    return mm_and_deg(1e3 * shift_m, float(np.rad2deg(angle_rad)))

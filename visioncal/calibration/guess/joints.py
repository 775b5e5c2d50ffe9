"""Readings of joint angles and of the robot model, tried by poses that belong to the angles.

Reported poses, and those that a camera sees, are `base_from_model @ FK(q) @ flange_from_reported`
with two unknown constant transforms: frames of world and tool, or the unknown edges of the chain.
A reading of the joints is right where this holds for most rows.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations, product

import numpy as np

from visioncal.calibration.guess.fit import (
    STARTS,
    Fit,
    distance_factor,
    distances,
    is_about_one_axis,
    mounting_fits,
    robust_fits,
)
from visioncal.calibration.guess.recording import thinned
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.robot import Robot, load_robot
from visioncal.robot.conversion import other_convention
from visioncal.robot.files import robot_names

# Largest deviation of an arm from its model, as a share of its reach and an angle [rad]: 2 mm and 3
# mrad a link add up to half of it. Another arm of the same shape deviates by as much again.
_MODEL_DEVIATION = 0.03
# Below the first score the declared reading is right: cameras do not see better, and most mistakes
# leave more, unless they change nothing. Scores below the second are alike: controllers print their
# poses no more finely.
_FITS, _FLOOR = 2e-3, 1e-4
# Cost of a reading with a fitted number, which explains more by chance.
_FITTED = 1.5
# Stands for all rotary joints together.
_ALL = -1


@dataclass(frozen=True, eq=False)
class JointReading:
    """One reading of a session's joint angles."""

    robot: Robot  # The model.
    mixing: FloatArray  # (n, n) the true angles are `mixing @ recorded + zeros`.
    zeros: FloatArray  # (n,) correction of each joint's zero [rad].
    # The difference from the declared reading; empty for the declared reading itself.
    words: str = ""
    fix: str = ""  # The remedy, for the user.
    columns: tuple[int, ...] = ()  # The columns concerned, numbered from 0; empty for all.
    cost: float = 1.0  # Number of mistakes it implies; a lost zero counts more than one.

    def poses(self, recorded: FloatArray) -> FloatArray:
        """(m, 4, 4) `base_from_flange` [m] for (m, n) recorded angles [rad]."""
        return self.robot.base_from_flange(recorded @ self.mixing.T + self.zeros)


def declared_reading(robot: Robot) -> JointReading:
    """The joint angles as recorded."""
    return JointReading(robot, np.eye(robot.joint_count), np.zeros(robot.joint_count), cost=0.0)


def joint_readings(robot: Robot) -> Iterator[JointReading]:
    """All other readings but lost zeros."""

    def entry(words: str, fix: str, mixing: FloatArray, *columns: int) -> JointReading:
        return JointReading(robot, mixing, np.zeros(count), words, fix, columns)

    count, same = robot.joint_count, np.eye(robot.joint_count)
    for factor, words, change in (
        (np.pi / 180.0, "in degrees", "pi / 180"),
        (180.0 / np.pi, "in radians that were taken for degrees", "180 / pi"),
    ):
        fix = f"Where the angles are recorded, multiply q1_rad to q{count}_rad by {change}."
        mixing = np.diag(np.where(robot.chain.prismatic, 1.0, factor))
        yield entry(f"the angles {words}", fix, mixing)
    for first, second in combinations(range(count), 2):
        order = np.arange(count)
        order[[first, second]] = second, first
        headings = f"q{first + 1}_rad and q{second + 1}_rad"
        fix = f"Exchange the headings {headings} in views.csv (ROS's joint_states sort by name)."
        yield entry(f"the columns {headings} exchanged", fix, same[order], first, second)
    for at, name in enumerate(robot.joint_names):
        fix = f"Negate q{at + 1}_rad, or turn the axis of {name} in the robot's model."
        yield entry(f"q{at + 1}_rad of the opposite sign", fix, np.diag(1.0 - 2.0 * same[at]), at)
    yield from _coupled(robot)
    # Zeros of DH tables and of makers differ by quarter turns; those of the first joint and the
    # last hide in the constants, and a single one is sought with all zeros.
    inner = (np.flatnonzero(~robot.chain.prismatic[1:-1]) + 1).tolist()
    for quarters in product((0, 1, -1), repeat=len(inner)):
        moved = [(at, quarter) for at, quarter in zip(inner, quarters, strict=True) if quarter]
        if len(moved) not in (2, 3):
            continue
        zeros = np.zeros(count)
        zeros[[at for at, _ in moved]] = [0.5 * np.pi * quarter for _, quarter in moved]
        words = " and ".join(
            f"{90 * quarter:+d} deg added to q{at + 1}_rad" for at, quarter in moved
        )
        adds = " and ".join(f"{zeros[at]:+.6f} to q{at + 1}_rad" for at, _ in moved)
        fix = f"Add {adds} in all rows: these joints are counted from another zero."
        columns = tuple(at for at, _ in moved)
        yield JointReading(robot, same, zeros, words, fix, columns, cost=1.2)
    other = other_convention(robot)
    if other is not None:
        table, convention = other
        fix = f'Write convention = "{convention}" into the table of {robot.name}.'
        words = f"the table of {robot.name} read as {convention}"
        yield replace(entry(words, fix, same), robot=table)
    for model in _built_in_robots():
        if model.name != robot.name and model.joint_count == count:
            fix = f'In session.toml, write model = "{model.name}" for this robot.'
            words = f"the arm a {model.name} and not a {robot.name}"
            yield replace(entry(words, fix, same), robot=model)


def _coupled(robot: Robot) -> Iterator[JointReading]:
    """The third joint's angle with the second's in it: FANUC's count it from the horizon."""
    same = declared_reading(robot)
    for sign, word in ((-1.0, "less"), (1.0, "plus")) if robot.joint_count > 3 else ():
        mixing = same.mixing.copy()
        mixing[2, 1] = sign
        words = f"q3_rad {word} q2_rad for the third joint (coupled, as FANUC counts it)"
        fix = f"In all rows, write q3_rad {word} q2_rad into q3_rad."
        yield replace(same, mixing=mixing, words=words, fix=fix, columns=(2,), cost=1.0)


@cache
def _built_in_robots() -> tuple[Robot, ...]:
    return tuple(map(load_robot, robot_names()))


def _with_zero(robot: Robot, joint: int, zero_rad: float) -> JointReading:
    """The reading in which one joint's zero is shifted."""
    name, degrees = robot.joint_names[joint], np.rad2deg(zero_rad)
    return replace(
        declared_reading(robot),
        zeros=np.where(np.arange(robot.joint_count) == joint, zero_rad, 0.0),
        words=f"the zero of {name} (q{joint + 1}_rad) moved by {degrees:.2f} deg",
        fix=f"Home {name} anew, or add {zero_rad:.5f} to q{joint + 1}_rad in all rows; the poses "
        "x_m to qw, where there are any, were computed by the same zero: empty them.",
        columns=(joint,),
        cost=_FITTED,
    )


def _with_share(robot: Robot, joint: int, share: float) -> JointReading:
    """The reading in which one joint, or all rotary ones, turn further than recorded."""
    is_turned = (np.arange(robot.joint_count) == joint) | ((joint == _ALL) & ~robot.chain.prismatic)
    which = "all angles" if joint == _ALL else f"q{joint + 1}_rad"
    return replace(
        declared_reading(robot),
        mixing=np.diag(1.0 + share * is_turned),
        words=f"{which} {100.0 * abs(share):.2f} % {'larger' if share > 0.0 else 'smaller'}",
        fix=f"Multiply {which} by {1.0 + share:.5f} in all rows, or state the gear ratios that the "
        "controller has: its encoders count other turns.",
        columns=() if joint == _ALL else (joint,),
        cost=_FITTED,
    )


@dataclass(frozen=True, eq=False)
class FittedJoints:
    """A reading of the joints, and the fit of both constant transforms under it."""

    reading: JointReading
    fit: Fit

    @property
    def score(self) -> float:
        """The fit's score, not below a least one."""
        return max(self.fit.score, _FLOOR)


@dataclass(frozen=True, eq=False)
class JointGuess:
    """The reading of the joints that is right, and its rivals."""

    declared: FittedJoints  # The joints as recorded.
    # The reading that explains the poses; the declared one where none stands out.
    best: FittedJoints
    # Other readings that explain them as well and are as simple.
    rivals: tuple[JointReading, ...] = ()

    @property
    def stands_out(self) -> bool:
        """Whether another reading than the declared one is clearly right."""
        return self.best is not self.declared

    @property
    def zero(self) -> JointReading | None:
        """The reading with one joint's zero shifted, or a share; None where more may be wrong.

        Of joints with parallel axes it is the more likely one: only a fit of all determines which.
        """
        is_fitted = all(one.cost == _FITTED for one in self._readings)
        return self.best.reading if is_fitted else None

    @property
    def _readings(self) -> tuple[JointReading, ...]:
        return self.best.reading, *self.rivals

    def sentence(self, what: str) -> str:
        """States the finding; `what` is what the joints are compared with."""
        words = " or with ".join(reading.words for reading in self._readings)
        return (
            f"With {words}, they fit {what} to {self.best.fit.figures}; as recorded, to "
            f"{self.declared.fit.figures}."
        )

    @property
    def fix(self) -> str:
        """The remedy, for the user."""
        return " Or: ".join(reading.fix for reading in self._readings)


def guess_joints(robot: Robot, q: FloatArray, poses: FloatArray) -> JointGuess:
    """Tries the common mistakes with joint angles and finds the one that explains the poses.

    Args:
        robot: The declared model.
        q: (m, n) joint angles as recorded [rad], of `FEWEST_COMPARED` rows or more.
        poses: (m, 4, 4) `base_from_flange` of the same rows, up to a constant on either side; or
            (m, 3) places of one point on the flange, in an instrument's frame.

    Returns:
        The reading; the declared one where it is right, where no other is clearly better, or where
        the poses turn about one axis at most and determine nothing.
    """
    rows, recorded = thinned(np.arange(len(q))), declared_reading(robot)
    with one_blas_thread():
        (declared,) = _fitted([recorded], q, poses, rows, STARTS)
        is_poor = poses.ndim > 2 and is_about_one_axis(poses[:, :3, :3])
        if declared.score <= _FITS or is_poor:
            return JointGuess(declared, declared)
        readings = [*joint_readings(robot), *_with_numbers(robot, q, poses, rows)]
        tried = _fitted(readings, q, poses, rows, STARTS)
    least = min(item.score for item in tried)
    # Ratio to the best score within which readings are equivalent: those with the fewest mistakes
    # are chosen.
    equivalent = [item for item in tried if item.score <= 2.0 * least]
    equivalent.sort(key=lambda item: (item.reading.cost, item.score))
    if least > _MODEL_DEVIATION or declared.score <= CLEAR_RATIO * equivalent[0].score:
        return JointGuess(declared, declared)
    best, *others = equivalent
    if poses.ndim > 2:
        # Where turns agree, another arm follows in part what a board of another size explains.
        scaled = distance_factor(invert(poses), declared.reading.poses(q), declared.fit)
        if scaled is not None and scaled[1] < best.fit.rms[0]:
            return JointGuess(declared, declared)
    rivals = (item.reading for item in others if item.reading.cost == best.reading.cost)
    return JointGuess(declared, best, tuple(rivals))


def _with_numbers(
    robot: Robot, q: FloatArray, poses: FloatArray, rows: IntArray
) -> list[JointReading]:
    """The best zero of each inner joint, and the best share by which each joint turns further.

    Zeros of the first and last hide in the constants. One of 180 degrees is left out: it looks like
    an opposite sign of the joint before or behind it.
    """
    rotary, step, share = ~robot.chain.prismatic, 0.25, 0.02
    best = partial(_best_numbers, (q, poses, rows))
    zeros = np.arange(step - np.pi, np.pi - 0.5 * step, step)
    found = best(partial(_with_zero, robot), np.flatnonzero(rotary[1:-1]) + 1, zeros, step)
    # Shares of teeth and of units: of a grade nine tenths of a degree.
    shares, joints = np.arange(-6.0, 7.0) * share, np.append(np.flatnonzero(rotary), _ALL)
    return [*found, *best(partial(_with_share, robot), joints, shares, share)]


def _best_numbers(
    against: tuple[FloatArray, FloatArray, IntArray],
    reading: Callable[[int, float], JointReading],
    joints: IntArray,
    grid: FloatArray,
    step: float,
) -> list[JointReading]:
    """The readings with the best number of each joint, from a grid of numbers of some step on.

    They are fitted `against` joint angles and poses by some rows.
    """
    numbers, best = dict.fromkeys(joints.tolist(), 0.0), list[JointReading]()
    while numbers and step > 0.3 * _FLOOR:
        tried = [(joint, numbers[joint] + more) for joint in numbers for more in grid.tolist()]
        fits = _fitted([reading(*one) for one in tried], *against)
        scores = np.reshape([one.fit.score for one in fits], (len(numbers), len(grid)))
        at = scores.argmin(axis=1) + len(grid) * np.arange(len(numbers))
        # Half a step from the right number, poses scatter by less than a step.
        kept = at[scores.min(axis=1) < _MODEL_DEVIATION + step].tolist()
        numbers, best = dict(tried[one] for one in kept), [fits[one].reading for one in kept]
        step, grid = step / 4.0, np.arange(-4.0, 5.0) * step / 4.0
    return best


def _fitted(
    tried: Sequence[JointReading], q: FloatArray, poses: FloatArray, rows: IntArray, starts: int = 0
) -> list[FittedJoints]:
    """Fits both constant transforms by some rows; residuals are of all rows where these are few."""
    if poses.ndim == 2:
        by_joints = np.array([reading.poses(q) for reading in tried])
        each = zip(tried, mounting_fits(by_joints, poses, starts), strict=True)
        return [FittedJoints(reading, fit) for reading, fit in each]
    flange_from_base = invert(poses)
    by_joints = np.array([reading.poses(q[rows]) for reading in tried])
    fits = robust_fits(np.broadcast_to(flange_from_base[rows], by_joints.shape), by_joints, starts)
    if starts and len(rows) < len(q):
        fits = [
            distances(flange_from_base, reading.poses(q), fit.lever, (fit.x, fit.z))
            for reading, fit in zip(tried, fits, strict=True)
        ]
    return [FittedJoints(reading, fit) for reading, fit in zip(tried, fits, strict=True)]

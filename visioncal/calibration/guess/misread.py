"""Whether joint angles belong to poses, and by which mistake they do not.

Poses that were reported, and those that a camera sees, are `base_from_model @ FK(q) @
flange_from_reported` with two constant transforms, whatever they are: frames of world and tool, or
the unknown edges of the chain. A reading of the joints is right where this holds for most rows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from visioncal.calibration.guess.fit import Fit, distances, is_about_one_axis, robust_fit
from visioncal.calibration.guess.given import SCORE_FLOOR, STANDS_OUT
from visioncal.calibration.guess.joints import (
    JointReading,
    declared_reading,
    joint_readings,
    with_zero,
)
from visioncal.calibration.guess.search import thinned
from visioncal.core.number_format import mm_and_deg
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.robot import Robot

# Two constant transforms and a zero have thirteen unknowns; fewer rows fit anything.
FEWEST_JOINT_ROWS = 5
# What an arm may depart from its model, a share of its reach and an angle [rad]: 2 mm and 3 mrad a
# link add up to half of it. Another arm of the same shape is off by as much again.
_CLOSES = 0.03
# Under this there is nothing to be explained: controllers print their poses more finely. Cameras do
# not see better, and what most mistakes leave is more, unless they change nothing.
_FITS, FITS_SEEN = 3.0 * SCORE_FLOOR, 2e-3
# Readings this near to the best are as good; of them the one with the fewest mistakes is meant, and
# of several as simple, the matter stays open between those that are nearer still.
_ALIKE, _RIVALS = 2.0, 1.5
_STARTS, _REFINED = 12, 6
# The scatter over a joint's zero falls from afar: it halves only some 30 degrees from its least.
# Where most of it is gone as recorded, the zero is nearer than that. A half turn looks like an
# opposite sign of the joint before it, or behind it, and is not meant.
_STEP_RAD, _FARTHEST_RAD = 0.25, 2.75
# Rows that are looked at first, and the share of what is left as recorded that gets a second look.
_SCREENED, _SHARE = 16, 0.6
# Rows beyond this many times the typical distance do not belong to the others.
_OUT = 5.0


@dataclass(frozen=True, eq=False)
class FittedJoints:
    """A reading of the joints, and how well it explains the poses.

    Attributes:
        reading: The reading.
        fit: Both constants, and how far every row is from them.
    """

    reading: JointReading
    fit: Fit

    @property
    def score(self) -> float:
        """The fit's score, not under what makes no difference."""
        return max(self.fit.score, SCORE_FLOOR)

    @property
    def figures(self) -> str:
        """How well the rows that agree best are explained, in words."""
        shift, angle = self.fit.rms
        return mm_and_deg(1e3 * shift, np.rad2deg(angle))

    @property
    def out(self) -> IntArray:
        """Rows that do not belong to the others."""
        return np.flatnonzero(self.fit.away > _OUT * self.score)


@dataclass(frozen=True, eq=False)
class JointGuess:
    """How the joints are to be taken.

    Attributes:
        declared: The joints as they are recorded.
        best: The reading that explains the poses; the declared one where none stands out.
        rivals: Other readings that explain them as well and are as simple.
    """

    declared: FittedJoints
    best: FittedJoints
    rivals: tuple[JointReading, ...] = ()

    @property
    def stands_out(self) -> bool:
        """Whether another reading than the declared one is clearly right."""
        return self.best is not self.declared

    @property
    def zero(self) -> JointReading | None:
        """The reading in which one joint's zero is off; None where something else may be wrong.

        Of joints with parallel axes it is the likelier: whose zero it is takes a fit of all.
        """
        lost = all(joint_reading.is_zero for joint_reading in (self.best.reading, *self.rivals))
        return self.best.reading if lost else None

    def sentence(self, what: str) -> str:
        """Says what was found: `what` is what the joints are compared with."""
        readings = [self.best.reading, *self.rivals]
        words = " or with ".join(reading.words for reading in readings)
        fit = self.best.fit
        agreeing = len(fit.away) - len(self.best.out)
        rows = "" if agreeing == len(fit.away) else f" in {agreeing} of {len(fit.away)} views"
        return (
            f"With {words}, they fit {what} to {self.best.figures}{rows}; as recorded, to "
            f"{self.declared.figures}."
        )

    @property
    def fix(self) -> str:
        """What the user can do about it."""
        return " Or: ".join(
            joint_reading.fix for joint_reading in (self.best.reading, *self.rivals)
        )


def guess_joints(robot: Robot, q: FloatArray, poses: FloatArray, fits: float = _FITS) -> JointGuess:
    """Tries the common mistakes with joint angles and says which explains the poses.

    Args:
        robot: The model that is declared.
        q: (m, n) joint angles as recorded [rad], of `FEWEST_JOINT_ROWS` rows or more.
        poses: (m, 4, 4) `base_from_flange` that belong to them, up to a constant on either side.
        fits: The score under which the declared reading is right without a look at others.

    Returns:
        The reading, and how well it does; the declared one where it is right, where no other is
        clearly better, or where the poses turn about one axis at most and determine nothing.
    """
    declared = declared_reading(robot)
    with one_blas_thread():
        declared_fit = _fitted(declared, q, poses, _STARTS)
        if declared_fit.score <= fits or is_about_one_axis(poses[:, :3, :3]):
            return JointGuess(declared_fit, declared_fit)
        few = thinned(np.arange(len(q)), _SCREENED)
        screened = _screened(declared_fit, q[few], poses[few])
        best = [_fitted(joint_reading, q, poses, _STARTS) for joint_reading in screened]
    return _decided(declared_fit, best) if best else JointGuess(declared_fit, declared_fit)


def _screened(start: FittedJoints, q: FloatArray, poses: FloatArray) -> list[JointReading]:
    """The readings that may explain a few rows far better than the declared one."""
    declared = start.reading
    tried = [_fitted(reading, q, poses, 0) for reading in joint_readings(declared.robot)]
    tried.sort(key=lambda fit: fit.score * (1.0 + fit.reading.cost))
    best = [*tried[:_REFINED], *_with_zeros(start, q, poses)]
    limit = _SHARE * _fitted(declared, q, poses, 0).score
    return [fit.reading for fit in best if fit.score < limit]


def _decided(start: FittedJoints, tried: Sequence[FittedJoints]) -> JointGuess:
    least = min(fit.score for fit in tried)
    alike = [fit for fit in tried if fit.score <= _ALIKE * least]
    alike.sort(key=lambda fit: (fit.reading.cost, fit.score))
    best, others = alike[0], alike[1:]
    if best.score > _CLOSES or start.score <= STANDS_OUT * best.score:
        return JointGuess(start, start)
    rivals = tuple(
        other.reading
        for other in others
        if other.reading.cost == best.reading.cost and other.score < _RIVALS * best.score
    )
    return JointGuess(start, best, rivals)


def _with_zeros(start: FittedJoints, q: FloatArray, poses: FloatArray) -> Iterator[FittedJoints]:
    """The best zero of each joint between the first and the last, whose zeros hide in constants."""
    declared = start.reading
    turns = ~declared.robot.chain.prismatic
    farthest = 2.0 * _STEP_RAD if start.score < _CLOSES else _FARTHEST_RAD
    for joint in np.flatnonzero(turns[1:-1]) + 1:

        def score(zero: float, joint: int = int(joint)) -> float:
            return _fitted(with_zero(declared, joint, zero), q, poses, 0).fit.score

        coarse = min(np.arange(-farthest, farthest + _STEP_RAD, _STEP_RAD), key=score)
        reach = coarse - _STEP_RAD, coarse + _STEP_RAD
        least = minimize_scalar(score, bounds=reach, method="bounded", options={"xatol": 1e-6})
        yield _fitted(with_zero(declared, int(joint), float(least.x)), q, poses, 0)


def _fitted(reading: JointReading, q: FloatArray, poses: FloatArray, starts: int) -> FittedJoints:
    """Fits both constants by some rows, and measures all."""
    rows = thinned(np.arange(len(q)))
    of_poses, of_joints = invert(poses), reading.poses(q)
    fit = robust_fit(of_poses[rows], of_joints[rows], starts)
    if len(rows) < len(q):
        fit = distances(of_poses, of_joints, fit.lever, (fit.x, fit.z))
    return FittedJoints(reading, fit)

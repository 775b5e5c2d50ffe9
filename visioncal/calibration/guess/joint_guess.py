"""Search for the right reading of joint angles, by poses that belong to them.

Reported poses, and those that a camera sees, are `base_from_model @ FK(q) @ flange_from_reported`
with two unknown constant transforms: frames of world and tool, or the unknown edges of the chain.
A reading of the joints is right where this holds for most rows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances, is_about_one_axis, robust_fit
from visioncal.calibration.guess.joint_readings import (
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
# Largest deviation of an arm from its model, as a share of its reach and an angle [rad]: 2 mm and 3
# mrad a link add up to half of it. Another arm of the same shape deviates by as much again.
_MODEL_DEVIATION = 0.03
# Below these scores the declared reading is right: controllers print their poses more finely.
# Cameras do not see better, and most mistakes leave more, unless they change nothing.
_FLOOR = 1e-4
_FITS, FITS_SEEN = 3.0 * _FLOOR, 2e-3
# Ratio of the declared reading's score to that of one that replaces it.
_STANDS_OUT = 3.0
# Ratio to the best score within which readings are equivalent: the one with the fewest mistakes is
# chosen. Equally simple ones within the second ratio are rivals.
_EQUIVALENT, _RIVALS = 2.0, 1.5
_STARTS, _REFINED = 12, 6
# The scatter over a joint's zero falls from afar: it halves only some 30 degrees from its minimum.
# Where most of it is gone as recorded, the zero is nearer than that. A shift of 180 degrees is left
# out: it looks like an opposite sign of the joint before or behind it.
_STEP_RAD, _FARTHEST_RAD = 0.25, 2.75
# Rows of the first screening, and the share of the declared score below which readings are refined.
_SCREENED, _REFINED_SHARE = 16, 0.6
# Outliers have residuals beyond this many scores.
_OUTLIER = 5.0


@dataclass(frozen=True, eq=False)
class FittedJoints:
    """A reading of the joints, and the fit of both constant transforms under it."""

    reading: JointReading
    fit: Fit

    @property
    def score(self) -> float:
        """The fit's score, not below a least one."""
        return max(self.fit.score, _FLOOR)

    @property
    def figures(self) -> str:
        """RMS residual of the kept rows, in words."""
        shift, angle = self.fit.rms
        return mm_and_deg(1e3 * shift, np.rad2deg(angle))

    @property
    def outliers(self) -> IntArray:
        """Outlier rows."""
        return np.flatnonzero(self.fit.residuals > _OUTLIER * self.score)


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
        """The reading with one joint's zero shifted; None where something else may be wrong.

        Of joints with parallel axes it is the more likely one: only a fit of all determines which.
        """
        return self.best.reading if all(reading.is_zero for reading in self._readings) else None

    @property
    def _readings(self) -> tuple[JointReading, ...]:
        return self.best.reading, *self.rivals

    def sentence(self, what: str) -> str:
        """States the finding; `what` is what the joints are compared with."""
        words = " or with ".join(reading.words for reading in self._readings)
        count, outliers = len(self.best.fit.residuals), len(self.best.outliers)
        rows = f" in {count - outliers} of {count} views" if outliers else ""
        return (
            f"With {words}, they fit {what} to {self.best.figures}{rows}; as recorded, to "
            f"{self.declared.figures}."
        )

    @property
    def fix(self) -> str:
        """What the user can do about it."""
        return " Or: ".join(reading.fix for reading in self._readings)


def guess_joints(robot: Robot, q: FloatArray, poses: FloatArray, fits: float = _FITS) -> JointGuess:
    """Tries the common mistakes with joint angles and finds the one that explains the poses.

    Args:
        robot: The declared model.
        q: (m, n) joint angles as recorded [rad], of `FEWEST_JOINT_ROWS` rows or more.
        poses: (m, 4, 4) `base_from_flange` of the same rows, up to a constant on either side.
        fits: Score at which the declared reading is accepted without trying others.

    Returns:
        The reading; the declared one where it is right, where no other is clearly better, or where
        the poses turn about one axis at most and determine nothing.
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
    promising = [*tried[:_REFINED], *_with_zeros(start, q, poses)]
    limit = _REFINED_SHARE * _fitted(declared, q, poses, 0).score
    return [fit.reading for fit in promising if fit.score < limit]


def _decided(start: FittedJoints, tried: Sequence[FittedJoints]) -> JointGuess:
    least_score = min(fit.score for fit in tried)
    equivalent = [fit for fit in tried if fit.score <= _EQUIVALENT * least_score]
    equivalent.sort(key=lambda fit: (fit.reading.cost, fit.score))
    best, others = equivalent[0], equivalent[1:]
    if best.score > _MODEL_DEVIATION or start.score <= _STANDS_OUT * best.score:
        return JointGuess(start, start)
    limit, cost = _RIVALS * best.score, best.reading.cost
    rivals = (fit.reading for fit in others if fit.reading.cost == cost and fit.score < limit)
    return JointGuess(start, best, tuple(rivals))


def _with_zeros(start: FittedJoints, q: FloatArray, poses: FloatArray) -> Iterator[FittedJoints]:
    """The best zero of each inner joint; those of the first and last hide in the constants."""
    from scipy.optimize import minimize_scalar

    declared = start.reading
    revolute = ~declared.robot.chain.prismatic
    largest = 2.0 * _STEP_RAD if start.score < _MODEL_DEVIATION else _FARTHEST_RAD
    for joint in np.flatnonzero(revolute[1:-1]) + 1:

        def score(zero: float, joint: int = int(joint)) -> float:
            return _fitted(with_zero(declared, joint, zero), q, poses, 0).fit.score

        coarse_zero = min(np.arange(-largest, largest + _STEP_RAD, _STEP_RAD), key=score)
        bounds = coarse_zero - _STEP_RAD, coarse_zero + _STEP_RAD
        best = minimize_scalar(score, bounds=bounds, method="bounded", options={"xatol": 1e-6})
        yield _fitted(with_zero(declared, int(joint), float(best.x)), q, poses, 0)


def _fitted(reading: JointReading, q: FloatArray, poses: FloatArray, starts: int) -> FittedJoints:
    """Fits both constant transforms by some rows; residuals are of all rows."""
    rows = thinned(np.arange(len(q)))
    flange_from_base, from_joints = invert(poses), reading.poses(q)
    fit = robust_fit(flange_from_base[rows], from_joints[rows], starts)
    if len(rows) < len(q):
        fit = distances(flange_from_base, from_joints, fit.lever, (fit.x, fit.z))
    return FittedJoints(reading, fit)

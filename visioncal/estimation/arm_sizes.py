"""Sizes of an arm's errors: joint offsets, links, gears, compliance, backlash.

Every error is a set of columns: the flange's Jacobian at each stop. All columns are carried,
however redundant, as random effects with one size per block, and the sizes of all blocks are
estimated together by restricted likelihood with log-normal priors (Harville 1977 for the
likelihood, Gilmour, Thompson and Cullis 1995 for the steps): what the data do not determine stays
nominal. Blocks without evidence have size zero, one after the other, the least likely first.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import LinAlgError

from visioncal.core.types import FloatArray
from visioncal.estimation.arm import SIGNIFICANT, ArmErrors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, WEIGHT
from visioncal.estimation.mixed import LEAST_SIGMA, MOST_SIGMA, MixedEstimate
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import RobotLikelihood, robot_likelihood

# Typical sizes of errors [rad], with a log-normal prior of a factor of e, and the torque of a
# compliance's [N m].
_TYPICAL = {
    "links": 7e-4,
    "offsets": 7e-4,
    COMPLIANCE: 1e-4,
    WEIGHT: 1e-4,
    BACKLASH: 1e-4,
    "ratios": 1e-4,
    "eccentricity": 1.5e-4,
}
_TORQUE_NM = 10.0
# Noise at the start, as a share of the residuals with the nominal arm.
_LITTLE_NOISE = 0.1
# Least gain in log-likelihood of a step.
_LITTLE = 1e-2


@dataclass(frozen=True, eq=False)
class ArmSizes:
    """The sizes of an arm's errors, estimated together."""

    errors: Mapping[str, ArmErrors]  # The errors by block, without those of size zero.
    levels: FloatArray  # (r, 2) of the robots' noise beside them; see `Noise`.
    gain: float  # Twice the gain in log-likelihood over the nominal arm.


def estimate_arm_sizes(
    problem: Problem,
    state: State,
    noise: Noise,
    robot: str,
    bases: Mapping[str, FloatArray],
    torque_nm: float,
) -> ArmSizes | None:
    """Estimates the sizes of the errors of one robot's arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The solution with the nominal arm.
        noise: The noise levels; those of robots are estimated beside the sizes.
        robot: The robot.
        bases: (s, 6, p) by stop, Jacobian of the flange by the errors of each block.
        torque_nm: The torque of a unit compliance [N m].

    Returns:
        The sizes; None where no errors have evidence.

    Raises:
        LinAlgError: The columns are so large that their squares are no numbers.
    """
    nominal = robot_likelihood(problem, state, noise)
    arm = _Blocks(nominal, problem.robots.index(robot), bases, torque_nm)
    best = arm.most_likely(arm.start())
    # Where all blocks together have no evidence, none has.
    if 2.0 * (nominal.white[1] - best.value) <= SIGNIFICANT:
        return None
    while (lesser := arm.without_least_likely(best)) is not None:
        arm, best = lesser
    # A joint does not bend against its torque; residuals have the opposite sign of the errors.
    while COMPLIANCE in arm.bases and (
        (negative := best.values[arm.slice_of(COMPLIANCE)] > 0.0).any()
    ):
        arm = replace(arm, bases={**arm.bases, COMPLIANCE: arm.bases[COMPLIANCE] * ~negative})
        best = arm.most_likely(best.logs)
    count, gain = nominal.before.size, 2.0 * (nominal.white[1] - best.value)
    sigmas = np.exp(best.logs)
    errors = {
        name: ArmErrors(basis, sigma, gain, of_links=True)
        for (name, basis), sigma in zip(arm.bases.items(), sigmas[count:].tolist(), strict=True)
    }
    return ArmSizes(errors, sigmas[:count].reshape(-1, 2), gain)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Likelihood of an arm with blocks of errors of unknown sizes."""

    nominal: RobotLikelihood  # Of the nominal arm.
    robot: int  # Index of the robot.
    bases: Mapping[str, FloatArray]  # (s, 6, p) the columns of each of the g blocks.
    torque_nm: float  # The torque of a unit compliance [N m].

    @cached_property
    def typical(self) -> FloatArray:
        """(g,) typical sizes of the blocks [rad]."""
        factors = {COMPLIANCE: self.torque_nm / _TORQUE_NM}
        return np.array([_TYPICAL[name] * factors.get(name, 1.0) for name in self.bases])

    @cached_property
    def likelihood(self) -> RobotLikelihood:
        """That of the robots' levels, with the q errors of the arm as the last unknowns."""
        if not self.bases:
            return self.nominal
        counts = [basis.shape[2] for basis in self.bases.values()]
        shares = np.repeat(np.eye(len(counts)), counts, axis=0)
        basis = np.concatenate(list(self.bases.values()), axis=2)
        return self.nominal.beside(self.robot, basis, shares, np.log(self.typical))

    def slice_of(self, name: str) -> slice:
        """A block's place among the q errors, from the end of all unknowns."""
        counts = {block: basis.shape[2] for block, basis in self.bases.items()}
        before = list(counts).index(name)
        start = sum(list(counts.values())[:before]) - sum(counts.values())
        return slice(start, start + counts[name] or None)

    def start(self) -> FloatArray:
        """Logarithms (2 r + g,): sizes that explain all residuals, beside little noise.

        A search from much noise may stay there, with sizes of next to nothing.
        """
        rms = self.nominal.rms
        levels = np.tile(np.maximum(_LITTLE_NOISE * rms, LEAST_SIGMA), len(self.nominal.before))
        moved = (self.nominal.moved(self.robot, basis)[:, :6] for basis in self.bases.values())
        motion = [np.sqrt(np.sum(np.mean(columns**2, axis=0))) for columns in moved]
        sizes = np.linalg.norm(rms) / np.maximum(motion, LEAST_SIGMA)
        return np.asarray(np.log(np.append(levels, np.maximum(self.typical, sizes))))

    def most_likely(self, start: FloatArray, enough: float = np.inf) -> MixedEstimate:
        """Maximum-likelihood levels and sizes, from (2 r + g,) logarithms.

        `enough` is a value that matters: the search ends once it is unlikely to be reached.
        """
        low, high = np.log(LEAST_SIGMA), np.log(MOST_SIGMA)
        return self.likelihood.model.maximised(start, low, high, 0.0, enough, _LITTLE)

    def without_least_likely(self, best: MixedEstimate) -> tuple[Self, MixedEstimate] | None:
        """Without the block that has the least evidence; None where all have enough."""
        trials, first = [], self.nominal.before.size
        for at, name in enumerate(self.bases):
            bases = {other: basis for other, basis in self.bases.items() if other != name}
            lesser, logs = replace(self, bases=bases), np.delete(best.logs, first + at)
            # Residuals that nothing else explains can make the likelihood singular.
            with suppress(LinAlgError):
                # With the other sizes held, this is an upper bound of the gain.
                value = lesser.likelihood.model.at(logs, is_sloped=False).value
                trials.append((value, lesser, logs))
        enough = best.value + 0.5 * SIGNIFICANT
        for _, lesser, logs in sorted(trials, key=lambda trial: trial[0]):
            with suppress(LinAlgError):
                found = lesser.most_likely(logs, enough)
                if found.value < enough:
                    return lesser, found
        return None

"""Sizes of an arm's errors: joint offsets, links, gears, compliance, backlash, joint functions.

Every error is a set of columns: the flange's Jacobian at each stop. All columns are carried,
however redundant, as random effects with one size per block, and the sizes of all blocks are
estimated together by restricted likelihood with log-normal priors (Harville 1977 for the
likelihood, Gilmour, Thompson and Cullis 1995 for the steps): what the data do not determine stays
nominal. Blocks without evidence have size zero, one after the other, the least likely first.

Encoders and their mounts err by some tenths of a milliradian, repeatably over each turn, with more
than low harmonics. Each joint's function is a periodic Gaussian process (MacKay 1998), `s^2 exp(-2
sin^2(d/2) / l^2)` for two angles d apart, represented by harmonics with the variances of that
kernel's Fourier series. The first two orders have further sizes of their own: that of eccentric
gears, and one of second harmonics. All joints share s and l, which is sought on a grid.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np
from scipy.linalg import LinAlgError
from scipy.special import ive

from visioncal.core.linalg import LEAST_SIGMA, MOST_SIGMA, gram
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.mixed import MixedEstimate
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import RobotLikelihood, robot_likelihood
from visioncal.robot.arm_model import (
    COMPLIANCE,
    GROUPS,
    HARMONICS,
    ArmModel,
    JointFunctions,
)
from visioncal.robot.errors import SIGNIFICANT

# Lengths tried [rad], longest first, and the highest harmonic in inverse lengths: three thousandths
# of the variance lie beyond. Shorter ones are not tried after this many that are less likely.
_LENGTHS_RAD, _CARRIED, _WORSE = (0.5, 0.25, 0.12, 0.06, 0.03), 3.0, 2
# Least twice gain by errors with all other sizes held: those that are just significant have half of
# that or more.
_SHOWN = 5.0
# Harmonics of order 2 of each joint.
_SECOND = "second"
# Typical sizes of errors [rad], with a log-normal prior of a factor of e.
_TYPICAL = {_SECOND: 1e-4} | {name: group.usual_rad for name, group in GROUPS.items()}
# The arm with all blocks of errors but those of size zero, (r, 2) levels of robots' noise beside
# these (see `Noise`), and twice the gain in log-likelihood over the nominal arm.
SizedArm: TypeAlias = tuple[ArmModel, FloatArray, float]


def most_orders() -> int:
    """Number of orders of harmonics, from 2 on, for the shortest length."""
    return len(_variances(min(_LENGTHS_RAD))) - 1


def _variances(length_rad: float) -> FloatArray:
    """(k + 1,) variances of the harmonics of a process of unit size, from order 1 on."""
    orders = np.arange(1, max(int(np.ceil(_CARRIED / length_rad)), 2) + 1)
    return np.asarray(2.0 * ive(orders, length_rad**-2))


def estimate_arm_sizes(
    problem: Problem,
    state: State,
    noise: Noise,
    robot: str,
    model: ArmModel,
    bases: Mapping[str, FloatArray],
    harmonics: FloatArray | None = None,
) -> SizedArm | None:
    """Estimates the sizes of the errors of one robot's arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The solution with the nominal arm.
        noise: The noise levels; those of robots are estimated beside the sizes.
        robot: The robot.
        model: The nominal arm.
        bases: (s, 6, p) by stop, Jacobian of the flange by the errors of each block.
        harmonics: (s, 6, 2 n k) the same for sine and cosine of each joint and order from 2 on, as
            `Robot.harmonic_jacobian` has them; None to seek no functions of the joints.

    Returns:
        The sizes; None where no errors have evidence, or with `harmonics` no functions.

    Raises:
        LinAlgError: The columns are so large that their squares are no numbers.
    """
    nominal = robot_likelihood(problem, state, noise)
    plain = _Blocks(nominal, problem.robots.index(robot), model, bases)
    columns: Iterable[FloatArray] = ()
    if harmonics is not None:
        harmonics = harmonics.reshape(*harmonics.shape[:2], -1, most_orders(), 2)
        first = (_Waves.of(harmonics, length) for length in _LENGTHS_RAD[: _WORSE + 1])
        columns = (candidate.columns for candidate in first)
        second = harmonics[:, :, :, 0].reshape(len(harmonics), 6, -1)
        plain = replace(plain, bases={**bases, _SECOND: second})
    if not plain.may_be_shown(columns):
        return None
    best = found = plain.most_likely(plain.start())
    if harmonics is None:
        # Where all blocks together have no evidence, none has.
        return _sized(plain, found) if plain.gain(found) > SIGNIFICANT else None
    arm, waves, worse = plain, None, -1
    for length in _LENGTHS_RAD:
        candidate = _Waves.of(harmonics, length)
        every = {**plain.bases, HARMONICS: candidate.columns}
        blocks = replace(plain, bases=every, low=tuple(_variances(length)[:2].tolist()))
        tried = None
        # Skips the search where the gain seems too small.
        _, gain = plain.likelihood.model.likely_size(
            found, blocks.columns(HARMONICS), plain.robot_units
        )
        if 2.0 * gain > _SHOWN:
            logs = np.append(best.logs[: len(found.logs)], np.log(_TYPICAL[HARMONICS]))
            tried = blocks.most_likely(logs)
        if tried is not None and tried.value < best.value:
            arm, best, waves, worse = blocks, tried, candidate, 0
        else:
            # The longest length has no longer one to compare with.
            worse += 1
        if worse == _WORSE:
            break
    is_likely = 2.0 * (found.value - best.value) > SIGNIFICANT
    sized = _sized(arm, best, waves) if is_likely else None
    return sized if sized is not None and sized[0].waves is not None else None


@dataclass(frozen=True, eq=False)
class _Waves:
    """The harmonics of a process as columns."""

    columns: FloatArray  # (s, 6, q) Jacobian of the flange by q combinations, in units of s.
    # (n, k, 2, q) each in terms of sine and cosine of each joint and order from 2 on; of order 2
    # all are zero.
    expanded: FloatArray
    sizes: FloatArray  # (k,) sizes of the orders in units of s.
    length_rad: float

    @classmethod
    def of(cls, harmonics: FloatArray, length_rad: float) -> Self:
        """Chooses the columns of a process among (s, 6, n, k, 2) harmonics."""
        sizes = np.sqrt(_variances(length_rad)[1:])
        higher = harmonics[:, :, :, 1 : len(sizes)] * sizes[1:, None]
        columns = higher.reshape(6 * len(higher), -1)
        values, vectors = np.linalg.eigh(columns.T @ columns)
        # Combinations that move all stops by less per unit are dropped [rad, m].
        kept = vectors[:, values > 5e-3**2]
        expanded = np.zeros((harmonics.shape[2], len(sizes), 2, kept.shape[1]))
        expanded[:, 1:] = kept.reshape(*higher.shape[2:], -1) * sizes[1:, None, None]
        return cls((columns @ kept).reshape(len(higher), 6, -1), expanded, sizes, length_rad)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Likelihood of an arm with blocks of errors of unknown sizes."""

    nominal: RobotLikelihood  # Of the nominal arm.
    robot: int  # Index of the robot.
    model: ArmModel  # The nominal arm.
    bases: Mapping[str, FloatArray]  # (s, 6, p) the columns of each of the g blocks.
    low: tuple[float, ...] = ()  # Variances of a process's orders 1 and 2; empty for none.

    @cached_property
    def shares(self) -> FloatArray:
        """(q, g) variance of each error per unit variance of each block."""
        counts = [basis.shape[2] for basis in self.bases.values()]
        shares = np.repeat(np.eye(len(counts)), counts, axis=0)
        for name, variance in zip(("eccentricity", _SECOND), self.low, strict=False):
            if name in self.bases:
                shares[self.slice_of(name), -1] = variance
        return shares

    @cached_property
    def likelihood(self) -> RobotLikelihood:
        """The likelihood of the robots' levels, with the arm's q errors as the last unknowns."""
        if not self.bases:
            return self.nominal
        factor = {COMPLIANCE: self.model.torque_nm / 10.0}
        typical = np.log([_TYPICAL[name] * factor.get(name, 1.0) for name in self.bases])
        basis = np.concatenate(list(self.bases.values()), axis=2)
        return self.nominal.with_moves(self.robot, basis, self.shares, typical)

    @cached_property
    def robot_units(self) -> Mask:
        """(u,) mask of the units of the robot: no other depends on its errors."""
        return np.asarray((self.nominal.members == self.robot).any(axis=1))

    def slice_of(self, name: str) -> slice:
        """A block's place among the q errors, from the end of all unknowns."""
        counts = {block: basis.shape[2] for block, basis in self.bases.items()}
        before = list(counts).index(name)
        start = sum(list(counts.values())[:before]) - sum(counts.values())
        return slice(start, start + counts[name] or None)

    def columns(self, name: str) -> FloatArray:
        """(m, 6 w, p) Jacobian of the robot's units by a block's errors."""
        return np.asarray(self.likelihood.jacobian[self.robot_units][:, :, self.slice_of(name)])

    def may_be_shown(self, more: Iterable[FloatArray]) -> bool:
        """Whether errors of the blocks, or by more columns (s, 6, q), may be significant.

        By the gain of each block alone, at the noise of the nominal arm. Where significant errors
        were found, of 94 searches, it was ten times the limit for blocks, and three for functions.
        """
        nominal, gain = self.nominal, 0.0
        levels = np.maximum(nominal.white[0].ravel(), LEAST_SIGMA)
        at = nominal.model.at(np.log(levels), is_sloped=False)
        for basis in (*self.bases.values(), *more):
            moved = nominal.moved(self.robot, basis)
            gain += 2.0 * nominal.model.likely_size(at, moved, self.robot_units)[1]
            if gain > _SHOWN:
                return True
        return False

    def start(self) -> FloatArray:
        """Logarithms (2 r + g,): sizes that explain all residuals, beside little noise."""
        typical = np.array([_TYPICAL[name] for name in self.bases])
        return np.log(self.nominal.start_beside([*map(self.columns, self.bases)], typical))

    def gain(self, estimate: MixedEstimate) -> float:
        """Twice the gain in log-likelihood over the nominal arm."""
        return 2.0 * (self.nominal.white[1] - estimate.value)

    def most_likely(self, start: FloatArray) -> MixedEstimate:
        """Maximum-likelihood levels and sizes, from (2 r + g,) logarithms."""
        low, high = np.log(LEAST_SIGMA), np.log(MOST_SIGMA)
        # Least gain in log-likelihood of a step.
        return self.likelihood.model.maximised(start, low, high, 1e-2)

    def without(self, name: str, logs: FloatArray) -> tuple[Self, FloatArray]:
        """The model without a block, and the logarithms of the other sizes."""
        at = self.nominal.before.size + list(self.bases).index(name)
        bases = {other: basis for other, basis in self.bases.items() if other != name}
        low = () if name == HARMONICS else self.low
        return replace(self, bases=bases, low=low), np.delete(logs, at)

    def without_least_likely(self, best: MixedEstimate) -> tuple[Self, MixedEstimate] | None:
        """Without the block that has the least evidence; None where all have enough."""
        # These are the first harmonics of the joints' functions.
        fixed = {"eccentricity", _SECOND} if HARMONICS in self.bases else {_SECOND}
        trials = []
        for name in (name for name in self.bases if name not in fixed):
            lesser, logs = self.without(name, best.logs)
            # Residuals that nothing else explains can make the likelihood singular.
            with suppress(LinAlgError):
                # With the other sizes held, this is an upper bound of the gain.
                value = lesser.likelihood.model.at(logs, is_sloped=False).value
                trials.append((value, lesser, logs))
        enough = best.value + 0.5 * SIGNIFICANT
        for _, lesser, logs in sorted(trials, key=lambda trial: trial[0]):
            with suppress(LinAlgError):
                found = lesser.most_likely(logs)
                if found.value < enough:
                    return lesser, found
        return None


def _sized(arm: _Blocks, best: MixedEstimate, waves: _Waves | None = None) -> SizedArm | None:
    """The sizes without blocks that have no evidence, and without negative compliances.

    None where none are left that explain more than chance.
    """
    while True:
        while (lesser := arm.without_least_likely(best)) is not None:
            arm, best = lesser
        if COMPLIANCE not in arm.bases:
            break
        bends = arm.bases[COMPLIANCE]
        # Residuals have the opposite sign of the errors; joints that were left out have rounding.
        negative = (best.values[arm.slice_of(COMPLIANCE)] > 0.0) & bends.any(axis=(0, 1))
        if not negative.any():
            break
        # Without joints that would bend upwards, the rest may have no evidence.
        arm = replace(arm, bases={**arm.bases, COMPLIANCE: bends * ~negative})
        best = arm.most_likely(best.logs)
    count, gain = arm.nominal.before.size, arm.gain(best)
    if gain <= SIGNIFICANT:
        return None
    levels = np.exp(best.logs[:count]).reshape(-1, 2)
    sizes = np.sqrt(arm.shares @ np.exp(2.0 * best.logs[count:]))
    by_block = {name: float(sizes[arm.slice_of(name)][0]) for name in arm.bases}
    compliance = arm.bases.get(COMPLIANCE)
    yielding = None if compliance is None else np.any(compliance, axis=(0, 1))
    if waves is None or HARMONICS not in by_block:
        return arm.model.with_errors(by_block, yielding), levels, gain
    # Combinations that the observations do not determine keep their prior.
    share = by_block.pop(_SECOND) / by_block[HARMONICS]
    weights = np.linalg.inv(arm.likelihood.model.units.total(best.logs)[arm.robot_units])
    jacobian = np.concatenate([share * arm.columns(_SECOND), arm.columns(HARMONICS)], axis=2)
    scaled = jacobian * by_block[HARMONICS]
    values, vectors = np.linalg.eigh(gram(scaled, weights @ scaled))
    # Least ratio of data to prior information of combinations that are unknowns; others keep their
    # prior.
    determined = vectors[:, values > 0.05]
    joints, orders = waves.expanded.shape[:2]
    of_second = np.zeros((joints, orders, 2, 2 * joints))
    of_second[:, 0] = share * np.eye(2 * joints).reshape(joints, 2, -1)
    expanded = np.concatenate([of_second, waves.expanded], axis=3)
    rest, logs = arm.without(HARMONICS, best.logs)
    functions = JointFunctions(
        np.tile(np.repeat([share, *waves.sizes[1:]], 2), joints),
        expanded.reshape(2 * joints * orders, -1) @ determined,
        waves.length_rad,
        2.0 * (rest.most_likely(logs).value - best.value),
    )
    return arm.model.with_errors(by_block, yielding, functions), levels, gain

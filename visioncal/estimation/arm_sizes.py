"""Sizes of an arm's errors: joint offsets, links, gears, compliance, backlash, joint functions.

Every error is a set of columns: the flange's Jacobian at each stop. All columns are carried,
however redundant, as random effects with one size per block, and the sizes of all blocks are
estimated together by restricted likelihood with log-normal priors (Harville 1977 for the
likelihood, Gilmour, Thompson and Cullis 1995 for the steps): what the data do not determine stays
nominal. Blocks without evidence have size zero, one after the other, the least likely first.

Encoders and their mounts err by some tenths of a milliradian, repeatably over each turn, with more
than low harmonics. Each joint's function is a periodic Gaussian process (MacKay 1998), `s^2 exp(-2
sin^2(d/2) / l^2)` for two angles d apart, represented by harmonics with the variances of that
kernel's Fourier series; all joints share one size s and one length l, which is sought on a grid.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import LinAlgError
from scipy.special import ive

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import SIGNIFICANT, ArmErrors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, HARMONICS, WEIGHT
from visioncal.estimation.linalg import gram
from visioncal.estimation.mixed import LEAST_SIGMA, MOST_SIGMA, MixedEstimate
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import RobotLikelihood, robot_likelihood

# Lengths tried [rad], longest first, and the highest harmonic in inverse lengths: three thousandths
# of the variance lie beyond.
_LENGTHS_RAD, _CARRIED = (0.5, 0.25, 0.12, 0.06, 0.03), 3.0
# Shorter lengths are not tried after this many that are less likely than a longer one.
_WORSE = 2
# Combinations of harmonics that move all stops by less per unit are dropped [rad, m].
_LEAST_MOTION = 5e-3
# Harmonics of order 2 of each joint.
_SECOND = "second"
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
    _SECOND: 1e-4,
    HARMONICS: 2e-4,
}
_TORQUE_NM = 10.0
# Noise at the start, as a share of the residuals with the nominal arm.
_LITTLE_NOISE = 0.1
# Least twice gain by functions with all other sizes held: those that are just significant have half
# of that or more. Least gain in log-likelihood of a step.
_LEAST_GAIN = 5.0
_LITTLE = 1e-2
# Least ratio of data to prior information of combinations that are unknowns; others keep their
# prior.
_INFORMATIVE = 0.05


@dataclass(frozen=True, eq=False)
class JointFunctions:
    """Estimated functions of an arm's joints."""

    # (2 n k,) of sine and cosine of each joint and order from 2 on, relative to that of their
    # block.
    sizes: FloatArray
    # (2 n k, r) Jacobian of these by the block's values: combinations that the observations
    # determine.
    directions: FloatArray
    sigma_rad: float  # Their size s [rad].
    length_rad: float  # Correlation length l over the joint angle [rad].
    gain: float  # Twice the gain in log-likelihood over the same arm without them.


@dataclass(frozen=True, eq=False)
class ArmSizes:
    """The sizes of an arm's errors, estimated together."""

    errors: Mapping[str, ArmErrors]  # The errors by block, without those of size zero.
    levels: FloatArray  # (r, 2) of the robots' noise beside them; see `Noise`.
    gain: float  # Twice the gain in log-likelihood over the nominal arm.
    functions: JointFunctions | None = None  # Functions of the joints; None without any.


def most_orders() -> int:
    """Number of orders of harmonics, from 2 on, for the shortest length."""
    return _orders_of(min(_LENGTHS_RAD))


def _series(length_rad: float) -> FloatArray:
    """(k + 1,) variances of the harmonics of a process of unit size, from order 1 on."""
    orders = np.arange(1, _orders_of(length_rad) + 2)
    return np.asarray(2.0 * ive(orders, length_rad**-2))


def _orders_of(length_rad: float) -> int:
    return max(int(np.ceil(_CARRIED / length_rad)) - 1, 1)


def estimate_arm_sizes(
    problem: Problem,
    state: State,
    noise: Noise,
    robot: str,
    bases: Mapping[str, FloatArray],
    torque_nm: float,
    harmonics: FloatArray | None = None,
) -> ArmSizes | None:
    """Estimates the sizes of the errors of one robot's arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The solution with the nominal arm.
        noise: The noise levels; those of robots are estimated beside the sizes.
        robot: The robot.
        bases: (s, 6, p) by stop, Jacobian of the flange by the errors of each block.
        torque_nm: The torque of a unit compliance [N m].
        harmonics: (s, 6, n, k, 2) the same for sine and cosine of each joint and order from 2 on;
            None to seek no functions of the joints.

    Returns:
        The sizes; None where no errors have evidence, or with `harmonics` no functions.

    Raises:
        LinAlgError: The columns are so large that their squares are no numbers.
    """
    nominal = robot_likelihood(problem, state, noise)
    arm = _ArmLikelihood(nominal, problem.robots.index(robot), bases, torque_nm)
    if harmonics is None:
        best = arm.most_likely(arm.start())
        # Where all blocks together have no evidence, none has.
        return arm.sized(best) if arm.gain(best) > SIGNIFICANT else None
    arm = replace(arm, waves=_Waves.of(harmonics))
    plain = best = arm.most_likely(arm.start())
    chosen, worse = arm, -1
    # The longest length has no longer one to compare with.
    for length in _LENGTHS_RAD:
        candidate = replace(arm, waves=_Waves.of(harmonics, length))
        found = None
        # Skips the search where the gain seems too small.
        if 2.0 * plain.likely_size(candidate.process, candidate.mine)[1] > _LEAST_GAIN:
            logs = np.append(best.logs[: len(plain.logs)], np.log(_TYPICAL[HARMONICS]))
            found = candidate.most_likely(logs, plain.value - 0.5 * SIGNIFICANT)
        if found is not None and found.value < best.value:
            chosen, best, worse = candidate, found, 0
        else:
            worse += 1
        if worse == _WORSE:
            break
    is_likely = 2.0 * (plain.value - best.value) > SIGNIFICANT
    sizes = chosen.sized(best) if is_likely else None
    return sizes if sizes is not None and sizes.functions is not None else None


@dataclass(frozen=True, eq=False)
class _Waves:
    """The harmonics of a process as columns."""

    # (s, 6, 2 n + r) Jacobian of the flange by sine and cosine of order 2 of each joint, and by r
    # combinations of higher orders in units of the process.
    columns: FloatArray
    # (k + 1,) variances of the process's orders, from 1 on; zeros without a process.
    series: FloatArray
    # (2 n k, 2 n + r) each column in terms of sine and cosine of each joint and order.
    expanded: FloatArray
    seconds: int  # Number 2 n of columns of order 2.
    length_rad: float  # Length of the process; 0 of none.

    @classmethod
    def of(cls, harmonics: FloatArray, length_rad: float = 0.0) -> "_Waves":
        """Chooses the columns of a process among (s, 6, n, k, 2) harmonics."""
        stops, _, joints, _, _ = harmonics.shape
        series = _series(length_rad) if length_rad else np.zeros(2)
        orders = len(series) - 1
        sizes = np.sqrt(series[2:])[:, None]
        second = harmonics[:, :, :, 0].reshape(stops, 6, -1)
        higher = (harmonics[:, :, :, 1:orders] * sizes).reshape(6 * stops, -1)
        values, vectors = np.linalg.eigh(higher.T @ higher)
        kept = vectors[:, values > _LEAST_MOTION**2]
        shape = (joints, orders - 1, 2, kept.shape[1])
        expanded = np.zeros((joints, orders, 2, 2 * joints + kept.shape[1]))
        expanded[:, 0, :, : 2 * joints] = np.eye(2 * joints).reshape(joints, 2, -1)
        expanded[:, 1:, :, 2 * joints :] = sizes[..., None] * kept.reshape(shape)
        columns = np.concatenate([second, (higher @ kept).reshape(stops, 6, -1)], axis=2)
        rows = expanded.reshape(2 * joints * orders, -1)
        return cls(columns, series, rows, 2 * joints, length_rad)


@dataclass(frozen=True, eq=False)
class _ArmLikelihood:
    """Likelihood of an arm with blocks of errors of unknown sizes."""

    nominal: RobotLikelihood  # Of the nominal arm.
    robot: int  # Index of the robot.
    bases: Mapping[str, FloatArray]  # (s, 6, p) the columns of each block but the harmonics.
    torque_nm: float  # The torque of a unit compliance [N m].
    waves: _Waves | None = None  # The harmonics; None without functions of the joints.

    @property
    def names(self) -> tuple[str, ...]:
        """The g blocks, in the order of the sizes."""
        if self.waves is None:
            return tuple(self.bases)
        process = (HARMONICS,) if self.waves.length_rad else ()
        return (*self.bases, _SECOND, *process)

    @cached_property
    def shares(self) -> FloatArray:
        """(q, g) variance of each error per unit variance of each block."""
        names, waves = self.names, self.waves
        groups = np.repeat(np.arange(len(self.bases)), [b.shape[2] for b in self.bases.values()])
        count = len(groups) + (0 if waves is None else waves.columns.shape[2])
        shares = np.zeros((count, len(names)))
        shares[np.arange(len(groups)), groups] = 1.0
        if waves is None:
            return shares
        second = slice(len(groups), len(groups) + waves.seconds)
        shares[second, len(self.bases)] = 1.0
        if waves.length_rad:
            shares[second, -1], shares[second.stop :, -1] = waves.series[1], 1.0
            # The process's own first harmonic is among those of eccentric gears.
            if "eccentricity" in names:
                shares[:, -1] += waves.series[0] * shares[:, names.index("eccentricity")]
        return shares

    @cached_property
    def likelihood(self) -> RobotLikelihood:
        """That of the robots' levels, with the arm's errors as the last unknowns."""
        columns = [*self.bases.values(), *([] if self.waves is None else [self.waves.columns])]
        factor = {COMPLIANCE: self.torque_nm / _TORQUE_NM}
        typical = np.log([_TYPICAL[name] * factor.get(name, 1.0) for name in self.names])
        if not columns:
            return self.nominal
        basis = np.concatenate(columns, axis=2)
        return self.nominal.beside(self.robot, basis, self.shares, typical)

    def start(self) -> FloatArray:
        """Logarithms (2 r + g,): sizes that explain all residuals, beside little noise.

        A search from much noise may stay there, with sizes of next to nothing.
        """
        rms = self.nominal.rms
        levels = np.maximum(_LITTLE_NOISE * rms, LEAST_SIGMA)
        squares = np.sum(np.mean(self.columns[:, :6] ** 2, axis=0), axis=0)
        motion = np.sqrt(squares @ self.shares)
        typical = np.array([_TYPICAL[name] for name in self.names])
        sizes = np.maximum(typical, np.linalg.norm(rms) / np.maximum(motion, LEAST_SIGMA))
        start = np.append(np.tile(levels, len(self.nominal.before)), sizes)
        return np.asarray(np.log(start))

    @property
    def mine(self) -> Mask:
        """(u,) mask of the units of the robot: no other depends on its errors."""
        return np.asarray((self.nominal.members == self.robot).any(axis=1))

    @property
    def columns(self) -> FloatArray:
        """(m, 6 w, q) Jacobian of the robot's units by the arm's errors."""
        return np.asarray(self.likelihood.jacobian[self.mine, :, -len(self.shares) :])

    @property
    def process(self) -> FloatArray:
        """(m, 6 w, q) Jacobian of these units by the process, for a size of one."""
        return np.asarray(self.columns * np.sqrt(self.shares[:, -1]))

    def gain(self, estimate: MixedEstimate) -> float:
        """Twice the gain in log-likelihood over the nominal arm."""
        return 2.0 * (self.nominal.white[1] - estimate.value)

    def most_likely(self, start: FloatArray, enough: float = np.inf) -> MixedEstimate:
        """Maximum-likelihood levels and sizes, from (2 r + g,) logarithms.

        `enough` is a value that matters: the search ends once it is unlikely to be reached.
        """
        low, high = np.log(LEAST_SIGMA), np.log(MOST_SIGMA)
        return self.likelihood.model.maximised(start, low, high, 0.0, enough, _LITTLE)

    def without(self, name: str, logs: FloatArray) -> tuple[Self, FloatArray]:
        """The same without a block, and the logarithms of the other sizes."""
        dropped = {HARMONICS, _SECOND} if name == HARMONICS else {name}
        waves = None if name == HARMONICS else self.waves
        bases = {other: basis for other, basis in self.bases.items() if other != name}
        kept = [True] * self.nominal.before.size + [other not in dropped for other in self.names]
        return replace(self, bases=bases, waves=waves), logs[np.array(kept)]

    def sized(self, best: MixedEstimate) -> ArmSizes:
        """The sizes without blocks that have no evidence, and without negative compliances."""
        arm: _ArmLikelihood = self
        while (lesser := arm._without_least_likely(best)) is not None:
            arm, best = lesser
        while (negative := arm._compliances(best) < 0.0).any():
            bases = {**arm.bases, COMPLIANCE: arm.bases[COMPLIANCE] * ~negative}
            arm = replace(arm, bases=bases)
            best = arm.most_likely(best.logs)
        return arm._sizes(best)

    def _without_least_likely(self, best: MixedEstimate) -> tuple[Self, MixedEstimate] | None:
        """Without the block that has the least evidence; None where all have enough."""
        has_process = HARMONICS in self.names
        # Eccentricity carries the first harmonics of the process.
        fixed = {_SECOND, "eccentricity"} if has_process else {_SECOND}
        names = [name for name in self.names if name not in fixed]
        if _SECOND in self.names and not has_process:
            # Second harmonics alone are no function of the joints.
            lesser, logs = self.without(HARMONICS, best.logs)
            return lesser, lesser.most_likely(logs)
        trials = [self.without(name, best.logs) for name in names]
        # With the other sizes held, this is an upper bound of the gain.
        values = [lesser.at(logs) for lesser, logs in trials]
        enough = best.value + 0.5 * SIGNIFICANT
        for index in np.argsort(values).tolist():
            lesser, logs = trials[index]
            # Residuals that nothing else explains can make the search singular.
            with suppress(LinAlgError):
                found = lesser.most_likely(logs, enough)
                if found.value < enough:
                    return lesser, found
        return None

    def at(self, logs: FloatArray) -> float:
        """Negative log-likelihood at some sizes; infinite where it is singular."""
        try:
            return self.likelihood.model.at(logs, is_sloped=False).value
        except LinAlgError:
            return np.inf

    def _compliances(self, estimate: MixedEstimate) -> FloatArray:
        """(n,) the compliances at some sizes; empty without any."""
        # Residuals have the opposite sign of the errors.
        effects, column = -estimate.values[len(estimate.values) - len(self.shares) :], 0
        for name, base in self.bases.items():
            if name == COMPLIANCE:
                return effects[column : column + base.shape[2]]
            column += base.shape[2]
        return np.zeros(0)

    def _sizes(self, best: MixedEstimate) -> ArmSizes:
        count = self.nominal.before.size
        gain = self.gain(best)
        levels, sizes = np.exp(best.logs[:count]).reshape(-1, 2), np.exp(best.logs[count:])
        variances, block_gain = self.shares @ sizes**2, gain / max(len(self.names), 1)
        errors, start = dict[str, ArmErrors](), 0
        for name, basis in self.bases.items():
            size_rad = float(np.sqrt(variances[start]))
            errors[name] = ArmErrors(basis, size_rad, block_gain, of_links=True)
            start += basis.shape[2]
        if (waves := self.waves) is None:
            return ArmSizes(errors, levels, gain)
        own, sigma = np.sqrt(variances[start:]), float(sizes[-1])
        determined = own[:, None] * self._determined(best.logs, own) / sigma
        errors[HARMONICS] = ArmErrors(waves.columns @ determined, sigma, block_gain, of_links=True)
        order_sizes = np.sqrt(waves.series[1:])
        order_sizes[0] = own[0] / sigma
        lesser, logs = self.without(HARMONICS, best.logs)
        functions = JointFunctions(
            np.tile(np.repeat(order_sizes, 2), waves.seconds // 2),
            waves.expanded @ determined,
            sigma,
            waves.length_rad,
            2.0 * (lesser.most_likely(logs).value - best.value),
        )
        return ArmSizes(errors, levels, gain, functions)

    def _determined(self, logs: FloatArray, sizes: FloatArray) -> FloatArray:
        """(q, r) orthonormal combinations, in units of (q,) sizes, of determined harmonics."""
        (units,) = self.likelihood.model.units
        weights = np.linalg.inv(units.total(logs)[self.mine])
        jacobian = self.columns[:, :, -len(sizes) :] * sizes
        values, vectors = np.linalg.eigh(gram(jacobian, weights @ jacobian))
        return np.asarray(vectors[:, values > _INFORMATIVE])

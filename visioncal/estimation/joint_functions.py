"""Joint functions: periodic errors of each joint angle, beyond links and gears.

Encoders and their mounts err by some tenths of a milliradian, repeatably over each turn, with more
than low harmonics. Each joint's error is a periodic Gaussian process (MacKay 1998), `s^2 exp(-2
sin^2(d/2) / l^2)` for two angles d apart, represented by harmonics with the variances of that
kernel's Fourier series; all joints share one size s and one length l. Beside it are twists of the
links, gravity and the first two harmonics, each group with a size of its own. All sizes are
estimated by restricted likelihood with log-normal priors, the length on a grid (Gilmour, Thompson
and Cullis 1995 for the steps, Harville 1977 for the likelihood).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError
from scipy.special import ive

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, HARMONICS, WEIGHT
from visioncal.estimation.linalg import gram
from visioncal.estimation.mixed import LEAST_SIGMA, MOST_SIGMA, MixedEstimate
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import RobotLikelihood, robot_likelihood

# Least twice gain in log-likelihood over the same arm without them.
SIGNIFICANT = 20.0
# Least share of that gain with all other sizes held: functions that are just significant have half
# of it or more.
_LEAST_SHARE = 0.25
# Lengths tried [rad], longest first, and the highest harmonic in inverse lengths: three thousandths
# of the variance lie beyond.
_LENGTHS_RAD, _CARRIED = (0.5, 0.25, 0.12, 0.06, 0.03), 3.0
# Shorter lengths are not tried after this many that are less likely than a longer one.
_WORSE = 2
# Combinations of harmonics that move all stops by less per unit are dropped [rad, m].
_LEAST_MOTION = 5e-3
# Typical sizes of errors [rad], with a log-normal prior of a factor of e, and the torque of a
# compliance's [N m].
_TYPICAL = {
    "links": 7e-4,
    COMPLIANCE: 1e-4,
    WEIGHT: 1e-4,
    BACKLASH: 1e-4,
    "ratios": 1e-4,
    "eccentricity": 1.5e-4,
    "second": 1e-4,
    HARMONICS: 2e-4,
}
_TORQUE_NM, _START_RAD = 10.0, 2e-4
# Least gain in log-likelihood of a step.
_LITTLE = 1e-2
# Least ratio of data to prior information of combinations that are unknowns; others keep their
# prior.
_INFORMATIVE = 0.05


@dataclass(frozen=True, eq=False)
class JointFunctions:
    """Estimated functions of an arm's joints."""

    # The errors of the whole arm by block, with their re-estimated sizes.
    errors: Mapping[str, ArmErrors]
    levels: FloatArray  # (r, 2) of the robots' noise beside them; see `Noise`.
    # (2 n k,) of sine and cosine of each joint and order from 2 on, relative to that of their
    # block.
    sizes: FloatArray
    # (2 n k, r) Jacobian of these by the block's values: combinations that the observations
    # determine.
    directions: FloatArray
    sigma_rad: float  # Their size s [rad].
    length_rad: float  # Correlation length l over the joint angle [rad].
    gain: float  # Twice the gain in log-likelihood over the nominal arm.


def most_orders() -> int:
    """Number of orders of harmonics, from 2 on, for the shortest length."""
    return _orders_of(min(_LENGTHS_RAD))


def _orders_of(length_rad: float) -> int:
    return max(int(np.ceil(_CARRIED / length_rad)) - 1, 1)


def _series(length_rad: float) -> FloatArray:
    """(k + 1,) variances of the harmonics of a process of unit size, from order 1 on."""
    orders = np.arange(1, _orders_of(length_rad) + 2)
    return np.asarray(2.0 * ive(orders, length_rad**-2))


def find_joint_functions(
    problem: Problem,
    state: State,
    noise: Noise,
    robot: str,
    bases: Mapping[str, FloatArray],
    harmonics: FloatArray,
    torque_nm: float,
) -> JointFunctions | None:
    """Estimates the joint functions of one robot's arm, if they are significant.

    Args:
        problem: The observations, without errors of this arm.
        state: The solution with the nominal arm.
        noise: The noise levels; those of robots are re-estimated.
        robot: The robot.
        bases: (s, 6, p) by stop, Jacobian of the flange by the errors of each other block.
        harmonics: (s, 6, n, k, 2) the same for sine and cosine of each joint and order from 2 on.
        torque_nm: The torque of a unit compliance [N m].

    Returns:
        The functions with all other errors of the arm; None where the gain is not significant.
    """
    nominal, index = robot_likelihood(problem, state, noise), problem.robots.index(robot)
    plain = _ArmLikelihood.of(nominal, index, bases, _Waves.of(harmonics), torque_nm)
    without = plain.most_likely(plain.start())
    if without is None:
        return None
    # The longest length has no longer one to compare with.
    chosen, best, worse = None, without, -1
    for length in _LENGTHS_RAD:
        arm = _ArmLikelihood.of(nominal, index, bases, _Waves.of(harmonics, length), torque_nm)
        # Skips the search where the gain seems too small.
        _, gain = without.likely_size(arm.functions, arm.mine)
        sizes = None
        if 2.0 * gain > _LEAST_SHARE * SIGNIFICANT:
            sizes = arm.most_likely(
                np.append(best.logs[: len(without.logs)], np.log(_START_RAD)),
                without.value - 0.5 * SIGNIFICANT,
            )
        if sizes is None or (chosen is not None and sizes.value > best.value):
            worse += 1
        else:
            chosen, best, worse = arm, sizes, 0
        if worse == _WORSE:
            break
    if chosen is None or 2.0 * (without.value - best.value) < SIGNIFICANT:
        return None
    # Negative compliances are set to zero.
    while (negative := chosen.compliances_of(best) < 0.0).any():
        bases = {**bases, COMPLIANCE: bases[COMPLIANCE] * ~negative}
        constrained = _ArmLikelihood.of(nominal, index, bases, chosen.waves, torque_nm)
        sizes = constrained.most_likely(best.logs)
        if sizes is None:
            break
        chosen, best = constrained, sizes
    return chosen.assembled(best, 2.0 * (nominal.white[1] - best.value))


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
    """Likelihood of an arm with groups of errors of unknown sizes."""

    likelihood: RobotLikelihood  # With the arm's errors as the last unknowns.
    mine: Mask  # (u,) the units of the robot: no other depends on its errors.
    names: tuple[str, ...]  # The groups, in the order of the sizes.
    shares: FloatArray  # (q, g) variance of each error per unit variance of each group.
    typical: FloatArray  # (g,) logarithms of typical sizes of the groups.
    bases: Mapping[str, FloatArray]  # The columns of each block but the harmonics.
    waves: _Waves  # The harmonics.

    @classmethod
    def of(
        cls,
        nominal: RobotLikelihood,
        robot: int,
        bases: Mapping[str, FloatArray],
        waves: _Waves,
        torque_nm: float,
    ) -> "_ArmLikelihood":
        """Appends the arm's errors; `torque_nm` is the torque of a unit compliance."""
        basis = np.concatenate([*bases.values(), waves.columns], axis=2)
        names = (*bases, "second", *([HARMONICS] if waves.length_rad else []))
        groups = np.repeat(np.arange(len(bases)), [base.shape[2] for base in bases.values()])
        shares = np.zeros((basis.shape[2], len(names)))
        shares[np.arange(len(groups)), groups] = 1.0
        second = slice(len(groups), len(groups) + waves.seconds)
        shares[second, len(bases)] = 1.0
        if waves.length_rad:
            shares[second, -1], shares[second.stop :, -1] = waves.series[1], 1.0
            # The process's own first harmonic is among those of eccentric gears.
            shares[:, -1] += waves.series[0] * shares[:, names.index("eccentricity")]
        factor = {COMPLIANCE: torque_nm / _TORQUE_NM}
        typical = np.log([_TYPICAL[name] * factor.get(name, 1.0) for name in names])
        mine = (nominal.members == robot).any(axis=1)
        likelihood = nominal.beside(robot, basis, shares, typical)
        return cls(likelihood, mine, names, shares, typical, bases, waves)

    @property
    def own(self) -> FloatArray:
        """(m, 6 w, q) Jacobian of the robot's units by the arm's errors."""
        return self.likelihood.jacobian[self.mine, :, -len(self.shares) :]

    @property
    def functions(self) -> FloatArray:
        """(m, 6 w, q) Jacobian of these units by the process, for a size of one."""
        return np.asarray(self.own * np.sqrt(self.shares[:, -1]))

    def effects(self, estimate: MixedEstimate) -> FloatArray:
        """(q,) the most likely errors of the arm; residuals have the opposite sign."""
        return -estimate.values[-len(self.shares) :]

    def compliances_of(self, estimate: MixedEstimate) -> FloatArray:
        """(n,) the compliances at some sizes; empty without any."""
        column = 0
        for name, base in self.bases.items():
            if name == COMPLIANCE:
                return self.effects(estimate)[column : column + base.shape[2]]
            column += base.shape[2]
        return np.zeros(0)

    def start(self) -> FloatArray:
        """Logarithms of the robots' levels, and of the sizes of the groups."""
        levels = np.maximum(self.likelihood.rms, LEAST_SIGMA)
        return np.append(np.log(np.tile(levels, len(self.likelihood.before))), self.typical)

    def most_likely(self, start: FloatArray, enough: float = np.inf) -> MixedEstimate | None:
        """Maximum-likelihood levels and sizes; None where the start is singular."""
        low, high = np.log(LEAST_SIGMA), np.log(MOST_SIGMA)
        try:
            return self.likelihood.model.maximised(start, low, high, 0.0, enough, _LITTLE)
        except LinAlgError:
            return None

    def assembled(self, estimate: MixedEstimate, gain: float) -> JointFunctions:
        """The errors of all blocks with the sizes of an estimate."""
        sizes = np.exp(estimate.logs[-len(self.names) :])
        variances, sigma = self.shares @ sizes**2, float(sizes[-1])
        block_gain, errors, start = gain / (len(self.bases) + 1), {}, 0
        for name, basis in self.bases.items():
            size_rad = float(np.sqrt(variances[start]))
            errors[name] = ArmErrors(basis, size_rad, block_gain, of_links=True)
            start += basis.shape[2]
        own, waves = np.sqrt(variances[start:]), self.waves
        determined = own[:, None] * self._determined(estimate.logs, own) / sigma
        errors[HARMONICS] = ArmErrors(waves.columns @ determined, sigma, block_gain, of_links=True)
        order_sizes = np.sqrt(waves.series[1:])
        order_sizes[0] = own[0] / sigma
        return JointFunctions(
            errors,
            np.exp(estimate.logs[: -len(self.names)]).reshape(-1, 2),
            np.tile(np.repeat(order_sizes, 2), waves.seconds // 2),
            waves.expanded @ determined,
            sigma,
            waves.length_rad,
            gain,
        )

    def _determined(self, logs: FloatArray, sizes: FloatArray) -> FloatArray:
        """(q, r) orthonormal combinations, in units of (q,) sizes, of determined harmonics."""
        (units,) = self.likelihood.model.units
        weights = np.linalg.inv(units.total(logs)[self.mine])
        jacobian = self.own[:, :, -len(sizes) :] * sizes
        values, vectors = np.linalg.eigh(gram(jacobian, weights @ jacobian))
        return np.asarray(vectors[:, values > _INFORMATIVE])

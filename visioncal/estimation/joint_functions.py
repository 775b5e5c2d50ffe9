"""Functions of the joints: repeatable errors of each angle over its turn, beyond links and gears.

Encoders and their mounts err by some tenths of a milliradian in a way that comes back every turn
and is no low harmonic. Each joint's error is a periodic Gaussian process (MacKay 1998),
`s^2 exp(-2 sin^2(d/2) / l^2)` for two angles d apart, carried as harmonics with the variances of
that kernel's Fourier series; all joints have one size s and one length l. Beside it are twists of
the links, gravity and the first two harmonics, each group with a size of its own. All sizes are by
restricted likelihood with log-normal priors, the length on a grid (Gilmour, Thompson and Cullis
1995 for the steps, Harville 1977 for the likelihood).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, lapack
from scipy.special import ive

from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import BACKLASH, COMPLIANCE, HARMONICS, WEIGHT
from visioncal.estimation.linalg import gram, weighted_gram
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import RobotLikelihood, ratio_prior, robot_likelihood
from visioncal.estimation.variance import (
    LEAST_SIGMA,
    MOST_SIGMA,
    Knowledge,
    Likely,
    Weighed,
    most_likely,
)

# Twice the gain in log-likelihood over the same arm without them.
SIGNIFICANT = 20.0
# With all other sizes as they are without functions, these show at least such a share of that: of
# functions that are just significant, half of it or more.
_LEAST_SHARE = 0.25
# Lengths that are tried [rad], the longest first, and how many lengths' inverses of harmonics are
# carried: beyond, three thousandths of the variance are left.
_LENGTHS_RAD, _CARRIED = (0.5, 0.25, 0.12, 0.06, 0.03), 3.0
# After so many lengths that are less likely than a longer one no shorter one is tried.
_WORSE = 2
# Combinations of harmonics of which a unit moves all stops by less are not carried [rad, m].
_SHOWN = 5e-3
# Typical sizes of errors [rad], give or take a factor of e, and the torque of a spring's [N m].
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
_TORQUE_NM, _SPREAD, _START_RAD = 10.0, 1.0, 2e-4
# A step that gains less of the log-likelihood is none.
_LITTLE, _RIDGE = 1e-2, 1e-12
# Combinations of harmonics that residuals determine by less than this share of what is known of
# them beforehand are no unknowns: they stay as open as they were.
_INFORMATIVE = 0.05


@dataclass(frozen=True, eq=False)
class JointFunctions:
    """What was found of the functions of an arm's joints.

    Attributes:
        errors: The errors of the whole arm by block, with the sizes that were found beside them.
        levels: (r, 2) of the robots' noise beside them; see `Noise`.
        sizes: (2 n k,) of sine and cosine of each joint and order from 2 on, relative to that of
            their block.
        directions: (2 n k, r) what each value of their block makes of these: combinations that the
            observations determine.
        sigma_rad: Their size s [rad].
        length_rad: Over which change of its angle a joint's error changes [rad].
        gain: Twice the gain in log-likelihood over the arm as stated.
    """

    errors: Mapping[str, ArmErrors]
    levels: FloatArray
    sizes: FloatArray
    directions: FloatArray
    sigma_rad: float
    length_rad: float
    gain: float


def most_orders() -> int:
    """How many orders of harmonics, from 2 on, the shortest length takes."""
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
    """Looks for functions of the joints of one robot's arm.

    Args:
        problem: The observations, without errors of this arm.
        state: The answer with the nominal arm.
        noise: The levels of the sensors; those of robots are sought anew.
        robot: The robot.
        bases: (s, 6, p) by stop, how the flange moves with the errors of each other block.
        harmonics: (s, 6, n, k, 2) the same for sine and cosine of each joint and order from 2 on.
        torque_nm: The torque that a unit of a compliance is for [N m].

    Returns:
        The functions with all other errors of the arm; None where these explain about as much.
    """
    nominal, place = robot_likelihood(problem, state, noise), problem.robots.index(robot)
    plain = _ArmLikelihood.of(nominal, place, bases, _Waves.of(harmonics), torque_nm)
    without = plain.most_likely(plain.start())
    if without is None:
        return None
    # The longest length has no longer one to be worse than.
    chosen, best, worse, weighed = None, without, -1, plain.weighed(without)
    for length in _LENGTHS_RAD:
        arm = _ArmLikelihood.of(nominal, place, bases, _Waves.of(harmonics, length), torque_nm)
        # Of what seems not to gain enough, the rest of the way does not matter.
        _, gain = weighed.likely_size(arm.functions, arm.mine)
        found = None
        if 2.0 * gain > _LEAST_SHARE * SIGNIFICANT:
            found = arm.most_likely(
                np.append(best.logs[: len(without.logs)], np.log(_START_RAD)),
                without.value - 0.5 * SIGNIFICANT,
            )
        if found is None or (chosen is not None and found.value > best.value):
            worse += 1
        else:
            chosen, best, worse = arm, found, 0
        if worse == _WORSE:
            break
    if chosen is None or 2.0 * (without.value - best.value) < SIGNIFICANT:
        return None
    # Springs that would yield against their load are none.
    while (against := chosen.springs_of(best) < 0.0).any():
        bases = {**bases, COMPLIANCE: bases[COMPLIANCE] * ~against}
        stiffer = _ArmLikelihood.of(nominal, place, bases, chosen.waves, torque_nm)
        found = stiffer.most_likely(best.logs)
        if found is None:
            break
        chosen, best = stiffer, found
    return chosen.found(best, 2.0 * (nominal.white[1] - best.value))


@dataclass(frozen=True, eq=False)
class _Waves:
    """The harmonics of a process as columns.

    Attributes:
        columns: (s, 6, 2 n + r) how the flange moves with sine and cosine of order 2 of each joint,
            and with r combinations of higher orders in units of the process.
        series: (k + 1,) variances of the process's orders, from 1 on; of no process 0.
        expanded: (2 n k, 2 n + r) what each column is of sine and cosine of each joint and order.
        seconds: How many columns 2 n are of order 2.
        length_rad: Of the process; 0 of none.
    """

    columns: FloatArray
    series: FloatArray
    expanded: FloatArray
    seconds: int
    length_rad: float

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
        shown = vectors[:, values > _SHOWN**2]
        shape = (joints, orders - 1, 2, shown.shape[1])
        expanded = np.zeros((joints, orders, 2, 2 * joints + shown.shape[1]))
        expanded[:, 0, :, : 2 * joints] = np.eye(2 * joints).reshape(joints, 2, -1)
        expanded[:, 1:, :, 2 * joints :] = sizes[..., None] * shown.reshape(shape)
        columns = np.concatenate([second, (higher @ shown).reshape(stops, 6, -1)], axis=2)
        rows = expanded.reshape(2 * joints * orders, -1)
        return cls(columns, series, rows, 2 * joints, length_rad)


@dataclass(frozen=True, eq=False)
class _ArmLikelihood:
    """An arm with groups of errors whose sizes are sought.

    Attributes:
        nominal: The likelihood without errors of the arm.
        mine: (u,) the units of the robot: no other has anything of its errors.
        own: (m, 6 w, p) how what these say moves with the unknowns, the arm's errors last.
        others: (u - m, 6 w, p - q) the same of the others, without the arm's errors.
        known: What is known of the unknowns besides.
        names: The groups, in the order of the sizes.
        shares: (q, g) which share of the variance of each error a group's is.
        bases: The columns of each block but the harmonics.
        waves: The harmonics.
        torque_nm: The torque that a unit of a compliance is for [N m].
    """

    nominal: RobotLikelihood
    mine: Mask
    own: FloatArray
    others: FloatArray
    known: Knowledge
    names: tuple[str, ...]
    shares: FloatArray
    bases: Mapping[str, FloatArray]
    waves: _Waves
    torque_nm: float

    @classmethod
    def of(
        cls,
        nominal: RobotLikelihood,
        robot: int,
        bases: Mapping[str, FloatArray],
        waves: _Waves,
        torque_nm: float,
    ) -> "_ArmLikelihood":
        basis = np.concatenate([*bases.values(), waves.columns], axis=2)
        size, mine = basis.shape[2], (nominal.members == robot).any(axis=1)
        own = np.concatenate([nominal.jacobian[mine], nominal.moved(robot, basis)], axis=2)
        names = (*bases, "second", *([HARMONICS] if waves.length_rad else []))
        groups = np.repeat(np.arange(len(bases)), [base.shape[2] for base in bases.values()])
        shares = np.zeros((size, len(names)))
        shares[np.arange(len(groups)), groups] = 1.0
        second = slice(len(groups), len(groups) + waves.seconds)
        shares[second, len(bases)] = 1.0
        if waves.length_rad:
            shares[second, -1], shares[second.stop :, -1] = waves.series[1], 1.0
            # The process's own first harmonic is among those of eccentric gears.
            shares[:, -1] += waves.series[0] * shares[:, names.index("eccentricity")]
        others, known = nominal.jacobian[~mine], nominal.known.beside(size)
        return cls(nominal, mine, own, others, known, names, shares, bases, waves, torque_nm)

    @property
    def random(self) -> slice:
        """The places of the arm's errors among the unknowns."""
        return slice(self.others.shape[2], None)

    @property
    def functions(self) -> FloatArray:
        """(m, 6 w, q) how what units say moves with the process, for a size of one."""
        return np.asarray(self.own[:, :, self.random] * np.sqrt(self.shares[:, -1]))

    def weighed(self, step: "_SizesAt") -> Weighed:
        """What units say, weighed by the levels and sizes of some step."""
        components, known = self.nominal.components, self.known
        levels, count = len(components.parts), self.others.shape[2]
        jacobian = np.zeros((*self.nominal.reduced.errors.shape, self.own.shape[2]))
        jacobian[self.mine], jacobian[~self.mine, :, :count] = self.own, self.others
        information = known.information.copy()
        random = np.arange(count, len(information))
        information[random, random] += 1.0 / (self.shares @ np.exp(2.0 * step.logs[levels:]))
        return Weighed.of(
            self.nominal.reduced.errors,
            jacobian,
            components,
            replace(known, information=information),
            step.logs[:levels],
        )

    def springs_of(self, step: "_SizesAt") -> FloatArray:
        """(n,) the compliances at some step; none without any."""
        at = 0
        for name, base in self.bases.items():
            if name == COMPLIANCE:
                return step.effects[at : at + base.shape[2]]
            at += base.shape[2]
        return np.zeros(0)

    def start(self) -> FloatArray:
        """Logarithms of the robots' levels, and of the sizes of the groups."""
        levels = np.maximum(self.nominal.rms, LEAST_SIGMA)
        count = len(self.nominal.components.parts) // 2
        return np.concatenate([np.log(np.tile(levels, count)), self._typical])

    @property
    def _typical(self) -> FloatArray:
        """(g,) logarithms of typical sizes of the groups."""
        factor = {COMPLIANCE: self.torque_nm / _TORQUE_NM}
        return np.log([_TYPICAL[name] * factor.get(name, 1.0) for name in self.names])

    def most_likely(self, start: FloatArray, enough: float = np.inf) -> "_SizesAt | None":
        """Finds the most likely levels and sizes; None where there are none to start from."""
        low, high = (np.full(len(start), np.log(value)) for value in (LEAST_SIGMA, MOST_SIGMA))
        try:
            return most_likely(self._likelihood, start, low, high, 0.0, enough, little=_LITTLE)[1]
        except LinAlgError:
            return None

    def _likelihood(self, logs: FloatArray) -> "_SizesAt":
        components, known, mine = self.nominal.components, self.known, self.mine
        residuals, levels, plain = self.nominal.reduced.errors, len(components.parts), self.others
        count = plain.shape[2]
        inner = np.s_[:count, :count]
        sigmas, squares = np.exp(logs[:levels]), np.exp(2.0 * logs[levels:])
        total, variances = components.total(sigmas), self.shares @ squares
        weights = np.linalg.inv(total)
        weighted, rest = weights[mine] @ self.own, weights[~mine] @ plain
        information = gram(self.own, weighted) + known.information
        information[inner] += gram(plain, rest)
        diagonal = np.arange(count, len(information))
        information[diagonal, diagonal] += 1.0 / variances
        inverse, log_determinant = _inverted(information)
        pull = gram(weighted, residuals[mine]) + known.gradient
        pull[:count] += gram(rest, residuals[~mine])
        best, left = inverse @ pull, residuals.copy()
        left[mine] -= self.own @ best
        left[~mine] -= plain @ best[:count]
        pulled = (weights @ left[:, :, None])[:, :, 0]
        effects = best[self.random]
        value = 0.5 * float(
            np.linalg.slogdet(total)[1].sum()
            + log_determinant
            + np.log(variances).sum()
            + np.einsum("ui,ui->", left, pulled)
            + best @ (known.information @ best - 2.0 * known.gradient)
            + np.sum(effects**2 / variances)
        )
        growth = 2.0 * sigmas[:, None, None] ** 2 * components.parts
        taken = np.array([
            np.sum(inverse * weighted_gram(weighted, value[mine]))
            + np.sum(inverse[inner] * weighted_gram(rest, value[~mine]))
            for value in growth
        ])  # fmt: skip
        own = np.diagonal(weights, axis1=1, axis2=2)
        by_levels = 0.5 * (np.einsum("kui,ui->k", growth, own - pulled**2) - taken)
        asked = growth * pulled
        owned = self.shares * squares
        posterior = np.diag(inverse)[self.random] + effects**2
        by_sizes = (1.0 / variances - posterior / variances**2) @ owned
        # Products of the residuals' growth with each level and size, as the average information.
        moved = 2.0 * owned * (effects / variances)[:, None]
        grown = np.zeros((*residuals.shape, levels + len(squares)))
        grown[..., :levels] = np.moveaxis(asked, 0, 2)
        grown[mine, :, levels:] = self.own[:, :, self.random] @ moved
        of_weights = gram(weighted, grown[mine])
        of_weights[:count] += gram(rest, grown[~mine])
        curvature = 0.5 * (gram(grown, weights @ grown) - of_weights.T @ inverse @ of_weights)
        slope = np.concatenate([by_levels, by_sizes])
        away = (logs[levels:] - self._typical) / _SPREAD
        slope[levels:] += away / _SPREAD
        curvature[levels:, levels:] += np.eye(len(away)) / _SPREAD**2
        value += 0.5 * float(away @ away)
        found = ratio_prior(range(levels // 2)).beside(Likely(value, slope, curvature), logs)
        # Residuals fall as errors that are left out of the prediction grow.
        return _SizesAt(found.value, found.slope, found.curvature, logs, -effects)

    def found(self, step: "_SizesAt", gain: float) -> JointFunctions:
        """The errors of all blocks with the sizes at some step."""
        sizes = np.exp(step.logs[-len(self.names) :])
        variances, sigma = self.shares @ sizes**2, float(sizes[-1])
        share, errors, at = gain / (len(self.bases) + 1), {}, 0
        for name, basis in self.bases.items():
            size_rad = float(np.sqrt(variances[at]))
            errors[name] = ArmErrors(basis, size_rad, share, of_links=True)
            at += basis.shape[2]
        own, waves = np.sqrt(variances[at:]), self.waves
        known = own[:, None] * self._determined(step.logs, own) / sigma
        errors[HARMONICS] = ArmErrors(waves.columns @ known, sigma, share, of_links=True)
        of_orders = np.sqrt(waves.series[1:])
        of_orders[0] = own[0] / sigma
        return JointFunctions(
            errors,
            np.exp(step.logs[: -len(self.names)]).reshape(-1, 2),
            np.tile(np.repeat(of_orders, 2), waves.seconds // 2),
            waves.expanded @ known,
            sigma,
            waves.length_rad,
            gain,
        )

    def _determined(self, logs: FloatArray, sizes: FloatArray) -> FloatArray:
        """(q, r) unit vectors, in units of (q,) sizes, of harmonics that residuals determine."""
        components = self.nominal.components
        weights = np.linalg.inv(components.total(np.exp(logs[: len(components.parts)]))[self.mine])
        jacobian = self.own[:, :, -len(sizes) :] * sizes
        values, vectors = np.linalg.eigh(gram(jacobian, weights @ jacobian))
        return np.asarray(vectors[:, values > _INFORMATIVE])


@dataclass(frozen=True, eq=False)
class _SizesAt(Likely):
    """What is found at some logarithms of levels and sizes; its curvature is average information.

    Attributes:
        logs: The logarithms.
        effects: (q,) the most likely errors of the arm.
    """

    logs: FloatArray
    effects: FloatArray


def _inverted(information: FloatArray) -> tuple[FloatArray, float]:
    """The inverse of (p, p) information, and the logarithm of its determinant.

    Raises:
        LinAlgError: It has none.
    """
    diagonal = np.diag(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = information * np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
    factor, failed = lapack.dpotrf(scaled, lower=1)
    if failed:
        raise LinAlgError("the information has no inverse")
    inverse, _ = lapack.dpotri(factor, lower=1)
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    logarithm = 2.0 * float(np.log(np.diag(factor)).sum() - np.log(scale).sum())
    return inverse * np.outer(scale, scale), logarithm

"""Arm errors without joint angles: Gaussian processes over posture, and over time.

The errors of such an arm depend on its posture, or persist from stop to stop: residuals are not
white noise, and their mean converges more slowly than their number suggests. Several models are
averaged by their restricted likelihood (Bayesian model averaging; Hoeting et al. 1999):

    white       independent noise from stop to stop
    scatter     the same of the flange as well, where that of observed poses is combined with it;
                both then share a weight
    basis       smooth functions of the posture, see `arm.pose_basis`
    posture     Gaussian processes over the posture, one of the flange and one of the base, of a
                short or a long range (Rasmussen and Williams 2006)
    time        an Ornstein-Uhlenbeck process over the stops, of a short or a long memory
    drift       the flange and the base move evenly from the first stop to the last
    both        the most likely two of these

The solution stays that of white noise; its covariance is the average of the models'.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import LEVER_M, TWIST_UNITS, ArmErrors, pose_basis, stops_of
from visioncal.estimation.linalg import ROUNDING, gram
from visioncal.estimation.mixed import LEAST_SIGMA, MOST_SIGMA, CommonRows, MixedModel, Units
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import ratio_prior, robot_likelihood

# Ranges of the processes over the posture [rad], and memories of those over time [stops]. The size
# of a memory longer than the session is undetermined: a hundred stands for it.
_RANGES, _MEMORIES = (0.15, 0.4, 1.0, 2.8), (3.0, 10.0, 30.0, 100.0)
_PRIOR = {
    "white": 1 / 4,
    "basis": 1 / 4,
    "posture": 1 / 4,
    "time": 1 / 8,
    "drift": 1 / 16,
    "both": 1 / 16,
}
# Least weight of a model.
_NO_WEIGHT = 1e-4
# Rows of a session that is one block, and of the blocks of a longer one: the work grows with the
# square of these. Most stops that tie its blocks.
_ONE_BLOCK, _BLOCK, _MOST_TIES = 200, 96, 16
# Most columns that represent the errors of all stops; the remainder counts as noise.
_MOST_COLUMNS = 360
# Least information of stops on a combination of these, over its prior, and most combinations.
_FAINT, _MOST_COMBINED = 0.1, 96
# Start of a process's size in units of the noise, and the size that counts as zero.
_START_SIZE, _NOTHING = 0.7, 1e-2
# Least gain in log-likelihood of a step.
_LITTLE = 5e-3


@dataclass(frozen=True, eq=False)
class _Process:
    """Errors with the covariance `size^2 kernel_ij at_i at_j'` between stops i and j."""

    kernel: FloatArray  # (s, s) correlation of the stops.
    at: FloatArray  # (s, 6, q) Jacobian of the flange at each stop by q independent errors.
    size: float  # Their standard deviation, in units of `at`.
    lasts: bool = False  # Whether they are correlated over time, not over the posture.

    def between(self, some: IntArray, others: IntArray) -> FloatArray:
        """(a, b, 6, 6) covariance between the flange at some stops and at others."""
        correlation = self.size**2 * self.kernel[np.ix_(some, others)]
        products = np.tensordot(self.at[some], self.at[others], axes=(2, 2))
        return np.asarray(correlation[:, :, None, None] * np.swapaxes(products, 1, 2))


@dataclass(frozen=True, eq=False)
class _Model:
    """One model of an arm's errors."""

    kind: str  # A key of the priors.
    prior: float  # Its prior probability.
    processes: tuple[_Process, ...]  # The processes beside white noise.
    white: FloatArray  # (2,) the noise, of rotation [rad] and position [m].
    value: float = np.inf  # The negative restricted log-likelihood at the most likely sizes.

    @property
    def evidence(self) -> float:
        """The logarithm of its weight, up to a constant common to all models."""
        return float(np.log(self.prior) - self.value - len(self.processes))


def find_pose_errors(problem: Problem, state: State, noise: Noise, robot: str) -> ArmErrors | None:
    """Errors of an arm without joint angles, and noise beside them, averaged over all models.

    The solution is that of white noise; the noise of sensors and other robots is kept. None for too
    few stops.
    """
    observed = stops_of(problem, robot)
    if len(observed) < FEWEST_STOPS:
        return None
    poses = problem.poses[robot]
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    likelihood = _Likelihood.of(problem, state, noise, robot, posed)
    levels = np.maximum(noise.robots[problem.robots.index(robot)], LEAST_SIGMA)
    white = likelihood.maximised(_Model("white", _PRIOR["white"], (), levels))
    independent = [white]
    if problem.is_combined:
        # Noise of the flange from stop to stop, which acts on distant frames with its lever.
        flange = np.broadcast_to(np.diag(np.repeat(white.white, 3)), (len(posed), 6, 6))
        own = (_Process(np.eye(len(posed)), flange, _START_SIZE),)
        scatter = likelihood.maximised(_Model("scatter", _PRIOR["white"], own, white.white))
        independent = [replace(model, prior=_PRIOR["white"] / 2) for model in (white, scatter)]
    observed_rows = np.searchsorted(posed, observed)
    others = _models(poses[posed], white.white, observed_rows)
    models = [*independent, *map(likelihood.maximised, others)]
    best_models = [
        max((model for model in models if model.kind == kind), key=lambda model: model.evidence)
        for kind in ("posture", "time")
    ]
    both = tuple(process for model in best_models for process in model.processes)
    models.append(likelihood.maximised(_Model("both", _PRIOR["both"], both, white.white)))
    logs = np.array([model.evidence for model in models])
    shares = np.exp(logs - logs.max())
    independent_value = min(model.value + len(model.processes) for model in independent)
    # Drift has its own test, and is no error of the arm.
    of_arm = [value for value, model in zip(logs, models, strict=True) if model.kind != "drift"]
    gain = 2.0 * float(np.logaddexp.reduce(of_arm) + independent_value)
    weights = np.where(shares / shares.sum() > _NO_WEIGHT, shares, 0.0)
    weights /= weights.sum()
    pairs = [pair for pair in zip(models, weights.tolist(), strict=True) if pair[1]]
    processes = [
        replace(process, size=weight**0.5 * process.size)
        for model, weight in pairs
        for process in model.processes
    ]
    kinds = [
        [process for process in processes if process.lasts is lasts] for lasts in (False, True)
    ]
    most_stops = _MOST_COLUMNS // 6 // max(sum(map(bool, kinds)), 1)
    noise_sq = sum((weight * model.white**2 for model, weight in pairs), np.zeros(2))
    by_posture, in_time = (
        _informative(*_columns(some, len(posed), observed_rows, most_stops), noise_sq)
        for some in kinds
    )
    left = noise_sq + by_posture[1] + in_time[1]
    columns, lasting = np.concatenate([by_posture[0], in_time[0]], axis=2), in_time[0].shape[2]
    basis = np.zeros((len(poses), 6, columns.shape[2]))
    basis[posed] = columns
    return ArmErrors(
        basis,
        1.0,
        gain,
        of_links=False,
        white=np.sqrt(left),
        fit_sigmas=levels,
        time_correlated_count=lasting,
    )


def spread_postures(poses: FloatArray, count: int) -> IntArray:
    """(k,) indices of some of (s, 4, 4) postures, which are far apart.

    They are chosen by farthest-point clustering (Gonzalez 1985).
    """
    distance_sq = _squared_distances(poses)
    chosen = [int(np.argmax(distance_sq.sum(axis=1)))]
    for _ in range(min(count, len(poses)) - 1):
        chosen.append(int(np.argmax(distance_sq[chosen].min(axis=0))))
    return np.array(chosen)


def _models(poses: FloatArray, white: FloatArray, observed: IntArray) -> Iterator[_Model]:
    """Yields all models except independent noise and the combination of both processes."""
    flange = np.broadcast_to(np.diag(np.repeat(white, 3)), (len(poses), 6, 6))
    level = float(np.sqrt(np.mean(np.square(white / TWIST_UNITS[[0, 3]]))))
    base = level * adjoint(invert(poses)) * TWIST_UNITS
    smooth = _Process(np.ones((len(poses),) * 2), level * pose_basis(poses), _START_SIZE)
    yield _Model("basis", _PRIOR["basis"], (smooth,), white)
    both = np.concatenate([flange, base], axis=2)
    distance_sq = _squared_distances(poses)
    for length in _RANGES:
        kernel = np.exp(-distance_sq / (2.0 * length**2))
        processes = (_Process(kernel, both, _START_SIZE),)
        yield _Model("posture", _PRIOR["posture"] / len(_RANGES), processes, white)
    order = np.arange(len(poses))
    for memory in _MEMORIES:
        kernel = np.exp(-np.abs(order[:, None] - order) / memory)
        process = _Process(kernel, flange, _START_SIZE, lasts=True)
        yield _Model("time", _PRIOR["time"] / len(_MEMORIES), (process,), white)
    centred_order = (order - observed.mean()) / observed.std()
    moving = centred_order[:, None, None] * both
    process = _Process(np.ones((len(poses),) * 2), moving, _START_SIZE, lasts=True)
    yield _Model("drift", _PRIOR["drift"], (process,), white)


def posture_correlation(poses: FloatArray) -> FloatArray:
    """(s, s) correlation of the errors at (s, 4, 4) postures, of the shortest range considered."""
    return np.exp(-_squared_distances(poses) / (2.0 * _RANGES[0] ** 2))


def posture_features(poses: FloatArray) -> FloatArray:
    """(s, 12) features of (s, 4, 4) postures, whose distance is that of the postures [rad]."""
    places, turns = (poses[:, :3, 3] / LEVER_M, poses[:, :3, :3].reshape(-1, 9) / np.sqrt(2.0))
    return np.concatenate([places, turns], axis=1)


def _squared_distances(poses: FloatArray) -> FloatArray:
    """(s, s) squared distances of postures; 2 (1 - cos) of an angle [rad^2]."""
    features = posture_features(poses)
    return np.asarray(np.sum((features[:, None] - features) ** 2, axis=2))


def _columns(
    processes: Sequence[_Process], count: int, observed: IntArray, most: int
) -> tuple[FloatArray, FloatArray]:
    """(s, 6, c) columns of stops, largest remainder first, and (2,) the variance they leave."""
    all_stops, columns = np.arange(count), np.zeros((count, 6, 0))
    remainder = np.zeros((count, 6, 6))
    for process in processes:
        remainder += process.size**2 * process.at @ np.swapaxes(process.at, 1, 2)
    total = np.diagonal(remainder[observed].mean(axis=0)).reshape(2, 3).mean(axis=1)
    scale = np.repeat(np.sqrt(np.maximum(total, LEAST_SIGMA**2)), 3)
    for _ in range(min(len(observed), most) if processes else 0):
        sizes = np.diagonal(remainder[observed], axis1=1, axis2=2) / scale**2
        pivot = int(observed[np.argmax(sizes.sum(axis=1))])
        values, vectors = np.linalg.eigh(remainder[pivot] / np.outer(scale, scale))
        if values[-1] < ROUNDING:
            break
        kept = values > ROUNDING
        cross = -columns @ columns[pivot].T
        for process in processes:
            cross += process.between(all_stops, np.array([pivot]))[:, 0]
        added = cross / scale @ (vectors[:, kept] / np.sqrt(values[kept]))
        columns = np.concatenate([columns, added], axis=2)
        remainder -= added @ np.swapaxes(added, 1, 2)
    mean = np.diagonal(remainder[observed].mean(axis=0))
    return columns, np.maximum(mean.reshape(2, 3).mean(axis=1), 0.0)


def _informative(
    columns: FloatArray, left: FloatArray, noise_sq: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Combinations of (s, 6, c) columns that stops distinguish from noise, and what they leave."""
    if not columns.shape[2]:
        return columns, left
    scale = np.repeat(np.sqrt(noise_sq + left), 3)[:, None]
    white = (columns / scale).reshape(-1, columns.shape[2])
    values, vectors = np.linalg.eigh(white.T @ white)
    kept = (values > _FAINT) & (np.arange(len(values)) >= len(values) - _MOST_COMBINED)
    lost = np.sum((columns @ vectors[:, ~kept]) ** 2, axis=2).mean(axis=0)
    return columns @ vectors[:, kept], left + lost.reshape(2, 3).mean(axis=1)


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """The restricted likelihood of one robot's errors.

    Consecutive stops form blocks, each with its joint covariance; blocks share the errors at some
    stops, and are independent beside these (Quinonero-Candela and Rasmussen 2005, section 6).
    """

    stops: IntArray  # (u,) the stop of each of u units, among those with a pose.
    units: Units  # They; their sizes are the robot's two noise levels.
    by_flange: FloatArray  # (u, d, 6) Jacobian by the robot's flange.
    rest: CommonRows  # Everything else that is known of the unknowns.

    @classmethod
    def of(
        cls, problem: Problem, state: State, noise: Noise, robot: str, posed: IntArray
    ) -> "_Likelihood":
        """Linearises the observations; arguments are those of `find_pose_errors`."""
        index, count = problem.robots.index(robot), len(problem.poses[robot])
        likelihood = robot_likelihood(problem, state, noise)
        (every,), (rest,) = likelihood.model.units, likelihood.model.common
        mine = (likelihood.members == index).any(axis=1)
        levels, own = noise.robots.copy(), every.known
        levels[index] = 0.0
        known = own + problem.error_covariance(replace(noise, robots=levels))
        total = own + problem.error_covariance(noise)
        weighted = np.linalg.solve(total[~mine], every.jacobian[~mine])
        rest = CommonRows(
            rest.information + gram(weighted, every.jacobian[~mine]),
            rest.gradient + gram(weighted, every.residuals[~mine]),
        )
        units = np.flatnonzero(mine)
        order = np.argsort(likelihood.stops[units], kind="stable")
        parts, units = every.parts[2 * index : 2 * index + 2], units[order]
        by_flange = likelihood.moved(index, np.broadcast_to(np.eye(6), (count, 6, 6)))
        return cls(
            np.searchsorted(posed, likelihood.stops[units]),
            Units(
                every.residuals[units],
                every.jacobian[units],
                known[units],
                parts[:, units],
                np.arange(2),
            ),
            by_flange[order],
            rest,
        )

    def model(self, processes: Sequence[_Process]) -> MixedModel:
        """The mixed model, with a size for each process after those of the noise."""
        rows = self.units.residuals.size
        blocks = np.array_split(
            np.arange(len(self.stops)), 1 if rows <= _ONE_BLOCK else -(-rows // _BLOCK)
        )
        processes = [replace(process, size=1.0) for process in processes]
        ties = [self._ties(process, blocks) for process in processes]
        columns = [self.by_flange @ tied[self.stops] for tied in ties]
        jacobian = np.concatenate([self.units.jacobian, *columns], axis=2)
        shares = [np.ones((tied.shape[2], 1)) for tied in ties]
        units = []
        for block in blocks:
            own, stops = replace(self.units, parts=self.units.parts[:, block]), self.stops[block]
            parts = [block_diag(*part) for part in own.parts]
            for process, tied in zip(processes, ties, strict=True):
                covariance = process.between(stops, stops)
                covariance -= np.tensordot(tied[stops], tied[stops], (2, 2)).swapaxes(1, 2)
                moved = self.by_flange[block]
                seen = moved[:, None] @ covariance @ np.swapaxes(moved, 1, 2)
                parts.append(np.swapaxes(seen, 1, 2).reshape(parts[0].shape))
            units.append(
                Units(
                    self.units.residuals[block].reshape(1, -1),
                    jacobian[block].reshape(1, -1, jacobian.shape[2]),
                    block_diag(*self.units.known[block])[None],
                    np.array(parts)[:, None],
                    np.arange(len(parts)),
                )
            )
        count = len(self.rest.gradient)
        return MixedModel(
            tuple(units),
            (self.rest.beside(jacobian.shape[2] - count),),
            np.asarray(block_diag(np.zeros((count, 2)), *shares)),
            ratio_prior([0], 2 + len(processes)),
        )

    def _ties(self, process: _Process, blocks: Sequence[IntArray]) -> FloatArray:
        """(s, 6, c) columns of a process at the stops that tie blocks."""
        count = len(process.kernel)
        if len(blocks) == 1:
            return np.zeros((count, 6, 0))
        # What was before a stop, and is behind it, is independent given a process that lasts there.
        stops = self.stops[[block[0] for block in blocks]] if process.lasts else self.stops
        return _columns([process], count, np.unique(stops), _MOST_TIES)[0]

    def maximised(self, model: _Model) -> _Model:
        """The model with maximum-likelihood sizes, searched from its present ones."""
        sizes = np.array([process.size for process in model.processes])
        least = np.append([LEAST_SIGMA] * 2, np.full(len(sizes), _NOTHING))
        mixed = self.model(model.processes)
        start = np.log(np.append(model.white, sizes))
        try:
            # Where the likelihood falls from next to nothing on, a process has no size.
            little = np.log(np.append(model.white, np.full(len(sizes), 3.0 * _NOTHING)))
            found = mixed.at(little)
            if not len(sizes) or (found.gradient[2:] < 0.0).any():
                found = mixed.maximised(start, np.log(least), np.log(MOST_SIGMA), little=_LITTLE)
        except np.linalg.LinAlgError:
            return model
        sigmas = np.exp(found.logs)
        pairs = zip(model.processes, sigmas[2:].tolist(), strict=True)
        processes = tuple(replace(process, size=size) for process, size in pairs)
        return replace(model, processes=processes, white=sigmas[:2], value=found.value)

"""Errors of arms without joint angles, which last from stop to stop: noise beside a fit of poses.

The errors of such an arm depend on its posture, or persist in time: residuals are no white noise,
and their mean converges more slowly than their number suggests. Processes by posture and by time
are averaged by their restricted likelihood, as in `fit.processes`. The solution is that beside what
lasts in time (`Fit.beside_lasting`); its covariance is the average of the models'.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.linalg import ROUNDING, gram
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import stops_of
from visioncal.estimation.mixed import LEAST_SIGMA
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.fit.kernels import Process, StopErrors, processes
from visioncal.fit.processes import weigh
from visioncal.robot.errors import ArmErrors


def find_pose_errors(problem: Problem, state: State, noise: Noise, robot: str) -> ArmErrors | None:
    """Errors of an arm without joint angles, and noise beside them, averaged over all models.

    The noise of sensors and other robots is kept. None for too few stops.
    """
    observed = stops_of(problem, robot)
    if len(observed) < FEWEST_STOPS:
        return None
    poses = problem.poses[robot]
    posed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    levels = np.maximum(noise.robots[problem.robots.index(robot)], LEAST_SIGMA)
    flanges, sigmas = poses[posed], np.repeat(levels, 3)
    kinds = [*processes(flanges, sigmas, creeps=True, as_reported=False)]
    lasting = kinds.copy()
    if problem.is_combined:
        # Noise of the flange from stop to stop, which acts on distant frames with its lever.
        flange = np.tile(np.diag(sigmas), (len(posed), 1, 1))
        kinds.append(Process(1 / 4, np.eye(len(posed)), flange))
    by_stop, by_flange = _stop_errors(problem, state, noise, robot)
    at = np.searchsorted(posed, by_stop.stops)
    seen = {
        replace(kind, kernel=kind.kernel[np.ix_(at, at)], basis=by_flange @ kind.basis[at]): kind
        for kind in kinds
    }
    try:
        models, logs_of = zip(*weigh(by_stop, flanges[at], [*seen]), strict=True)
    except np.linalg.LinAlgError:
        return None
    logs = np.array(logs_of)
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    # Least share of a model's evidence, and most columns that represent the errors of all stops;
    # the remainder counts as noise.
    shares[shares < 1e-4] = 0.0
    shares /= shares.sum()
    squares = dict.fromkeys(kinds, 0.0)
    for one, share in zip(models, shares.tolist(), strict=True):
        if one.process is not None:
            squares[seen[one.process]] += share * one.size**2
    noise_sq = levels**2 * float(shares @ [one.white**2 for one in models])
    # Base and flange that creep have a test of their own, and are no error of the arm.
    of_arm = [one.process is None or not one.process.is_creep for one in models]
    lasts = np.array([one.process is not None and seen[one.process] in lasting for one in models])
    gain = np.logaddexp.reduce(logs[of_arm]) - np.logaddexp.reduce(logs[~lasts])
    parts = [
        [(kind, square) for kind, square in squares.items() if square and kind.is_of_time is lasts]
        for lasts in (False, True)
    ]
    most = 360 // 6 // max(sum(map(bool, parts)), 1)
    by_posture, in_time = (
        _informative(*_columns(part, len(posed), np.unique(at), most), noise_sq) for part in parts
    )
    basis = np.zeros((len(poses), 6, by_posture[0].shape[2] + in_time[0].shape[2]))
    basis[posed] = np.concatenate([by_posture[0], in_time[0]], axis=2)
    return ArmErrors(
        basis,
        1.0,
        2.0 * float(gain),
        of_links=False,
        white=np.sqrt(noise_sq + by_posture[1] + in_time[1]),
        fit_sigmas=levels,
        time_correlated_count=in_time[0].shape[2],
    )


def _stop_errors(
    problem: Problem, state: State, noise: Noise, robot: str
) -> tuple[StopErrors, FloatArray]:
    """Residuals of each stop alone, and their (s, d, 6) derivatives by a robot's flange."""
    index, count = problem.robots.index(robot), len(problem.poses[robot])
    likelihood = robot_likelihood(problem, state, noise)
    units, common = likelihood.model.units, likelihood.model.common
    with_robot = (likelihood.members == index).any(axis=1)
    levels = noise.robots.copy()
    levels[index] = 0.0
    others = problem.error_covariance(replace(noise, robots=levels))
    total, robot_units = problem.error_covariance(noise), np.flatnonzero(with_robot)
    rows = np.concatenate([units.jacobian, units.residuals[:, :, None]], axis=2)
    p = rows.shape[2] - 1
    rest = gram(
        np.linalg.solve((units.known + total)[~with_robot], rows[~with_robot]), rows[~with_robot]
    )
    rest[:p, :p] += common.information
    rest[:p, p] += common.gradient
    rest[p, :p] += common.gradient
    by_stop = StopErrors(
        likelihood.stops[robot_units],
        (units.known + others)[robot_units],
        (total - others)[robot_units],
        rows[robot_units],
        rest,
        p,
    )
    return by_stop, likelihood.moved(index, np.broadcast_to(np.eye(6), (count, 6, 6)))


def _columns(
    weighed: Sequence[tuple[Process, float]], count: int, observed: IntArray, most: int
) -> tuple[FloatArray, FloatArray]:
    """(s, 6, c) columns of stops, largest remainder first, and (2,) the variance they leave.

    The columns are of processes, weighed by a squared size each.
    """
    all_stops, columns = np.arange(count), np.zeros((count, 6, 0))
    remainder = np.zeros((count, 6, 6))
    for kind, square in weighed:
        products = np.einsum("sar,sbr->sab", kind.basis, kind.basis, optimize=True)
        remainder += square * np.diag(kind.kernel)[:, None, None] * products
    total = np.diagonal(remainder[observed].mean(axis=0)).reshape(2, 3).mean(axis=1)
    scale = np.repeat(np.sqrt(np.maximum(total, LEAST_SIGMA**2)), 3)
    for _ in range(min(len(observed), most) if weighed else 0):
        sizes = np.diagonal(remainder[observed], axis1=1, axis2=2) / scale**2
        pivot = int(observed[np.argmax(sizes.sum(axis=1))])
        values, vectors = np.linalg.eigh(remainder[pivot] / np.outer(scale, scale))
        if values[-1] < ROUNDING:
            break
        kept = values > ROUNDING
        cross = -columns @ columns[pivot].T
        for kind, square in weighed:
            shared = square * kind.kernel[all_stops, pivot]
            cross += shared[:, None, None] * (kind.basis @ kind.basis[pivot].T)
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
    # Least information of stops on a combination of these, over its prior, and most combinations.
    kept = (values > 0.1) & (np.arange(len(values)) >= len(values) - 96)
    lost = np.sum((columns @ vectors[:, ~kept]) ** 2, axis=2).mean(axis=0)
    return columns @ vectors[:, kept], left + lost.reshape(2, 3).mean(axis=1)

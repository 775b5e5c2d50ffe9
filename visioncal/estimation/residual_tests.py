"""Tests whether residuals are white noise: drift, correlated neighbours, lens errors."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtrc

from visioncal.core.quantiles import chi2_limit, f_limit
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import rows_of, stops_of
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import (
    fisher_information,
    normal_equations,
)
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, Noise, State

# Share of sessions in which noise fails a test.
_FALSE_ALARM = 1e-4
_BLOCKS = 10
# Largest leverage of a block in any direction: first order is invalid beyond.
_MOST_LEVERAGE = 0.99
# Image cells per axis whose mean residuals are compared, and least corners of a cell.
_CELLS, _FEWEST_CORNERS = 6, 4
# Degrees of freedom that a lens's parameters and a plane's pose absorb from the cells' means.
_ABSORBED = 12
# Smaller probabilities are not resolved.
_LEAST_CHANCE = 1e-300


@dataclass(frozen=True)
class Neighbours:
    """Excess correlation of the errors of neighbouring stops."""

    # Variance of the solution by the blocked jackknife, over the model's; one on average where
    # errors are independent.
    factor: float
    is_significant: bool  # Whether chance does not explain it.


@dataclass(frozen=True)
class Drift:
    """A steady motion of base or target over the session."""

    # Displacement of a stationary target from the first stop to the last, at its mean position [m].
    moved_m: float
    moved_rad: float  # Its rotation [rad].
    mahalanobis_sq: float  # The test statistic.


@dataclass(frozen=True)
class LensField:
    """Excess of common errors of the corners in regions of the image."""

    factor: float  # Variance of the cells' mean residuals over that of noise; at least one.
    sigma_px: float  # Size of the displacements beyond the lens model, per axis [px].
    mahalanobis_sq: float  # The evidence, as the square of a standard normal variable.
    is_significant: bool  # Whether chance does not explain it.


def lens_field(
    px: FloatArray, residuals: FloatArray, resolution: tuple[int, int], shares: FloatArray
) -> LensField:
    """Compares the mean residuals of the image's cells with the scatter within them (F test).

    A lens error beyond the model displaces all corners of a region alike, in all views: no number
    of views averages it out, and residuals of single corners hardly grow.

    Args:
        px: (n, 2) corners of all views of one camera [px].
        residuals: (n, 2) of the fit [px].
        resolution: Width and height of the image [px].
        shares: (n,) weight of each corner; images that repeat an earlier one share one weight.
    """
    cells = np.clip((_CELLS * px / np.array(resolution)).astype(np.int64), 0, _CELLS - 1)
    return common_errors(cells[:, 0] + _CELLS * cells[:, 1], residuals, shares)


def common_errors(cell: IntArray, residuals: FloatArray, shares: FloatArray) -> LensField:
    """Compares the mean residuals of cells, numbered from 0, with the scatter within them.

    Arguments and result are those of `lens_field`, for any (n,) cells.
    """
    counts = np.bincount(cell, shares)
    rows = counts[cell] >= _FEWEST_CORNERS
    many = counts[counts >= _FEWEST_CORNERS]
    between, within = (2 * len(many) - _ABSORBED, 2 * (float(many.sum()) - len(many)))
    if between < 1:
        return LensField(1.0, 0.0, 0.0, is_significant=False)
    sums = np.stack(
        [
            np.bincount(cell[rows], (shares * residuals[:, axis])[rows], len(counts))
            for axis in (0, 1)
        ],
        axis=1,
    )
    between_squares = float(np.sum(sums[counts >= _FEWEST_CORNERS] ** 2 / many[:, None]))
    noise = (float(np.sum(shares[rows, None] * residuals[rows] ** 2)) - between_squares) / within
    factor = between_squares / between / noise if noise > 0.0 else 1.0
    return LensField(
        max(factor, 1.0),
        float(np.sqrt(max(factor - 1.0, 0.0) * noise / np.mean(many))),
        float(chdtri(1.0, max(fdtrc(between, within, factor), _LEAST_CHANCE))),
        bool(factor > f_limit(_FALSE_ALARM, between, within)),
    )


def neighbours(problem: Problem, state: State, noise: Noise, robot: str) -> Neighbours:
    """Compares a blocked jackknife with the covariance of the fit.

    Blocks of neighbouring stops of one robot, in the order of the session, are left out in turn
    (Kuensch 1989), to first order. The squared influence of each block is compared with its
    expectation under the model, so that small samples and unequal blocks do not bias it. The state
    has to be the least-squares solution: elsewhere the gradient passes for a misfit.
    """
    moving, edges = problem.moving, slice(6 * len(problem.unknown))
    information_all = normal_equations(problem, state, noise)[0]
    fitted, metric = covariance_among(information_all, moving), information_all[edges, edges]
    rows, stops = rows_of(problem, robot), stops_of(problem, robot)
    prior = problem.prior_information(state)
    observed = expected = scatter = 0.0
    for block in np.array_split(stops, min(_BLOCKS, len(stops) // 2)):
        part = problem.subset(rows & np.isin(problem.observations.stops, block))
        information, gradient = normal_equations(part, state, noise)
        block_information = information - prior.information
        # Directions that only this block determines have no solution without it.
        if np.linalg.eigvals(fitted @ block_information).real.max() > _MOST_LEVERAGE:
            continue
        without = covariance_among(information_all - block_information, moving)
        change = (without @ (gradient - prior.gradient))[edges]
        expectation = (without @ block_information @ fitted)[edges, edges] @ metric
        observed += float(change @ metric @ change)
        expected += float(np.trace(expectation))
        scatter += 2.0 * float(np.trace(expectation @ expectation))
    if expected == 0.0:
        return Neighbours(1.0, is_significant=False)
    freedom = 2.0 * expected**2 / scatter
    factor = observed / expected
    return Neighbours(factor, factor > float(chi2_limit(_FALSE_ALARM, freedom)) / freedom)


def drift(problem: Problem, state: State, noise: Noise, robot: str) -> Drift | None:
    """Tests for a motion of a robot's base in proportion to the number of the stop.

    Rao's score test: stationary frames move by as much in the base, in the opposite direction. The
    stops are in the order of the session, and the state is the least-squares solution. None where
    the motion is not significant.
    """
    stops, poses = stops_of(problem, robot), problem.poses[robot]
    jacobian = np.zeros((len(poses), 6, 6))
    time = np.linspace(-0.5, 0.5, len(stops))[:, None, None]
    jacobian[stops] = adjoint(invert(poses[stops])) * time
    zeros, no_prior = np.zeros(6), PriorInformation.flat(6)
    effect = Effect("creep", zeros, no_prior, zeros > 0.0, flange_jacobian={robot: jacobian})
    widened = problem.with_effects([*problem.effects, effect])
    widened_state = State(state.edges, np.concatenate([state.values, zeros]))
    information, gradient = normal_equations(widened, widened_state, noise)
    gradient[: problem.size] = 0.0
    step = -covariance_among(information, widened.moving) @ gradient
    mahalanobis_sq = float(-gradient @ step)
    if mahalanobis_sq < chi2_limit(_FALSE_ALARM, 6):
        return None
    base = step[problem.size :]
    moved = base[3:] + np.cross(base[:3], _mean_position(problem, state, robot))
    angle = float(np.linalg.norm(base[:3]))
    return Drift(float(np.linalg.norm(moved)), angle, mahalanobis_sq)


def _mean_position(problem: Problem, state: State, robot: str) -> FloatArray:
    """(3,) mean position, in a robot's base, of the frames observed with it [m]."""
    base = problem.tree.bases[robot]
    rows, observed = rows_of(problem, robot), np.array(problem.observations.observed)
    positions = [
        problem.between(base, frame, state, np.flatnonzero(rows & (observed == frame)))[:, :3, 3]
        for frame in dict.fromkeys(observed[rows].tolist())
    ]
    return np.asarray(np.concatenate(positions).mean(axis=0))


def inflation(
    problem: Problem, state: State, noise: Noise, robot: str, factor: float
) -> FloatArray:
    """Covariance (p, p) added for correlated neighbouring stops of a robot.

    `factor` is the variance contributed by its stops, over that of independent noise.
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    part = problem.subset(rows_of(problem, robot))
    information = (
        fisher_information(part, state, noise) - problem.prior_information(state).information
    )
    return np.asarray((factor - 1.0) * fitted @ information @ fitted)

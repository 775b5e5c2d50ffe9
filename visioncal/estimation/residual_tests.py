"""Whether the residuals are noise: tests of drift, of neighbours that err alike, of the lens."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtrc

from visioncal.core.quantiles import chi2_limit, f_limit
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import rows_of, stops_of
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fisher_information, normal_equations
from visioncal.estimation.variance import Knowledge

# Noise looks like a misfit in one session of ten thousand.
_FALSE_ALARM = 1e-4
_BLOCKS = 10
# A block has at most this share of what is known of any direction; first order is no guess beyond.
_MOST_LEVERAGE = 0.99
# Cells of the image whose mean residuals are compared, an axis; corners that a cell has at least.
_CELLS, _FEWEST_CORNERS = 6, 4
# What a lens's own parameters and a plane's pose take out of the cells' means.
_ABSORBED = 12
# Smaller probabilities are not resolved.
_LEAST_CHANCE = 1e-300


@dataclass(frozen=True)
class Neighbours:
    """How much more neighbouring stops err alike than independent noise lets them.

    Attributes:
        factor: Variance of the answer by the blocked jackknife, over what the model says; one on
            average where errors are independent.
        is_significant: Whether chance does not explain it.
    """

    factor: float
    is_significant: bool


@dataclass(frozen=True)
class Drift:
    """A steady motion of base or target over the session.

    Attributes:
        moved_m: How far a target at rest moved from the first stop to the last, where it is on
            average [m].
        moved_rad: How far it turned [rad].
        mahalanobis_sq: The evidence for it.
    """

    moved_m: float
    moved_rad: float
    mahalanobis_sq: float


@dataclass(frozen=True)
class LensField:
    """How much more corners of one part of the image err alike than noise lets them.

    Attributes:
        factor: Variance of the cells' mean residuals over that of noise; at least one.
        sigma_px: Size of the displacements that the lens's model leaves, an axis [px].
        mahalanobis_sq: The evidence for it, as the square of a standard normal variable.
        is_significant: Whether chance does not explain it.
    """

    factor: float
    sigma_px: float
    mahalanobis_sq: float
    is_significant: bool


def lens_field(
    px: FloatArray, residuals: FloatArray, resolution: tuple[int, int], shares: FloatArray
) -> LensField:
    """Compares the mean residuals of the image's cells with the scatter within them (F test).

    A lens beyond its model displaces all corners of a region alike, in all views: no number of
    views averages that out, and residuals of single corners hardly grow.

    Args:
        px: (n, 2) corners of all views of one camera [px].
        residuals: (n, 2) of the fit [px].
        resolution: Width and height of the image [px].
        shares: (n,) as how much of a corner each counts: of images that show the same, whatever is
            wrong with one is wrong with all.
    """
    place = np.clip((_CELLS * px / np.array(resolution)).astype(np.int64), 0, _CELLS - 1)
    return common_errors(place[:, 0] + _CELLS * place[:, 1], residuals, shares)


def common_errors(cell: IntArray, residuals: FloatArray, shares: FloatArray) -> LensField:
    """Compares the mean residuals of cells, numbered from 0, with the scatter within them.

    Arguments and result are those of `lens_field`, of any (n,) cells.
    """
    counts = np.bincount(cell, shares)
    rows = counts[cell] >= _FEWEST_CORNERS
    many = counts[counts >= _FEWEST_CORNERS]
    between, within = 2 * len(many) - _ABSORBED, 2 * (float(many.sum()) - len(many))
    if between < 1:
        return LensField(1.0, 0.0, 0.0, is_significant=False)
    sums = np.stack(
        [
            np.bincount(cell[rows], (shares * residuals[:, axis])[rows], len(counts))
            for axis in (0, 1)
        ],
        axis=1,
    )
    among = float(np.sum(sums[counts >= _FEWEST_CORNERS] ** 2 / many[:, None]))
    noise = (float(np.sum(shares[rows, None] * residuals[rows] ** 2)) - among) / within
    factor = among / between / noise if noise > 0.0 else 1.0
    return LensField(
        max(factor, 1.0),
        float(np.sqrt(max(factor - 1.0, 0.0) * noise / np.mean(many))),
        float(chdtri(1.0, max(fdtrc(between, within, factor), _LEAST_CHANCE))),
        bool(factor > f_limit(_FALSE_ALARM, between, within)),
    )


def neighbours(problem: Problem, state: State, noise: Noise, robot: str) -> Neighbours:
    """Compares a blocked jackknife with the covariance of the fit.

    Blocks of neighbouring stops of one robot are left out in turn (Kuensch 1989), to first order.
    The squared influence of each block is put in proportion to its expectation under the model, so
    that small samples and unequal blocks do not bias it.

    Args:
        problem: The observations, their stops in the order of the session.
        state: Where the whitened residuals are least: elsewhere their slope passes for a misfit.
        noise: Its levels.
        robot: The robot whose stops are left out.
    """
    moving, edges = problem.moving, slice(6 * len(problem.unknown))
    whole = normal_equations(problem, state, noise)[0]
    fitted, metric = covariance_among(whole, moving), whole[edges, edges]
    mine, stops = rows_of(problem, robot), stops_of(problem, robot)
    known = problem.knowledge(state)
    seen = expected = scatter = 0.0
    for block in np.array_split(stops, min(_BLOCKS, len(stops) // 2)):
        part = problem.subset(mine & np.isin(problem.observations.stops, block))
        information, gradient = normal_equations(part, state, noise)
        own = information - known.information
        # What a block alone determines has no answer without it.
        if np.linalg.eigvals(fitted @ own).real.max() > _MOST_LEVERAGE:
            continue
        # Leaving the block out takes its information, too.
        without = covariance_among(whole - own, moving)
        moved = (without @ (gradient - known.gradient))[edges]
        likely = (without @ own @ fitted)[edges, edges] @ metric
        seen += float(moved @ metric @ moved)
        expected += float(np.trace(likely))
        scatter += 2.0 * float(np.trace(likely @ likely))
    if expected == 0.0:
        return Neighbours(1.0, is_significant=False)
    freedom = 2.0 * expected**2 / scatter
    factor = seen / expected
    return Neighbours(factor, factor > float(chi2_limit(_FALSE_ALARM, freedom)) / freedom)


def drift(problem: Problem, state: State, noise: Noise, robot: str) -> Drift | None:
    """Looks for a motion of a robot's base in proportion to the number of the stop.

    Rao's score test: what stands still before the base moves in it as much, the other way.

    Args:
        problem: The observations, their stops in the order of the session.
        state: Where the whitened residuals are least.
        noise: Its levels.
        robot: The robot.

    Returns:
        The motion; None where noise explains the residuals as well.
    """
    stops, poses = stops_of(problem, robot), problem.poses[robot]
    creep = np.zeros((len(poses), 6, 6))
    time = np.linspace(-0.5, 0.5, len(stops))[:, None, None]
    creep[stops] = adjoint(invert(poses[stops])) * time
    nothing, freely = np.zeros(6), Knowledge(np.zeros((6, 6)), np.zeros(6))
    effect = Effect("creep", nothing, freely, nothing > 0.0, flange_jacobian={robot: creep})
    widened = problem.with_effects([*problem.effects, effect])
    there = State(state.edges, np.concatenate([state.values, nothing]))
    information, gradient = normal_equations(widened, there, noise)
    gradient[: problem.size] = 0.0
    step = -covariance_among(information, widened.moving) @ gradient
    mahalanobis_sq = float(-gradient @ step)
    if mahalanobis_sq < chi2_limit(_FALSE_ALARM, 6):
        return None
    base = step[problem.size :]
    moved = base[3:] + np.cross(base[:3], _where_it_looks(problem, state, robot))
    turned = float(np.linalg.norm(base[:3]))
    return Drift(float(np.linalg.norm(moved)), turned, mahalanobis_sq)


def _where_it_looks(problem: Problem, state: State, robot: str) -> FloatArray:
    """(3,) the mean place, in a robot's base, of what is observed by way of it [m]."""
    base = problem.tree.bases[robot]
    rows, observed = rows_of(problem, robot), np.array(problem.observations.observed)
    places = [
        problem.between(base, frame, state, np.flatnonzero(rows & (observed == frame)))[:, :3, 3]
        for frame in dict.fromkeys(observed[rows].tolist())
    ]
    return np.asarray(np.concatenate(places).mean(axis=0))


def inflation(
    problem: Problem, state: State, noise: Noise, robot: str, factor: float
) -> FloatArray:
    """What is to be added to a covariance (p, p) where a robot's neighbouring stops err alike.

    Args:
        problem: The observations.
        state: The answer.
        noise: Its levels.
        robot: The robot.
        factor: By how much more its stops contribute than independent noise lets them.
    """
    fitted = covariance_among(fisher_information(problem, state, noise), problem.counted)
    part = problem.subset(rows_of(problem, robot))
    own = fisher_information(part, state, noise) - problem.knowledge(state).information
    return np.asarray((factor - 1.0) * fitted @ own @ fitted)

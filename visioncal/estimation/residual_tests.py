"""Whether the residuals are noise: tests of drift, and of neighbours that err alike."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import rows_of, stops_of
from visioncal.estimation.linalg import covariance_among
from visioncal.estimation.parts import Effect, Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import fisher_information, normal_equations
from visioncal.estimation.variance import Knowledge

# Noise looks like a misfit in one session of ten thousand.
_FALSE_ALARM = 1e-4
_BLOCKS = 10


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
    """

    moved_m: float
    moved_rad: float


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
        # Leaving the block out takes its information, too.
        without = covariance_among(whole - own, moving)
        moved = (without @ (gradient - known.gradient))[edges]
        likely = (without @ own @ fitted)[edges, edges] @ metric
        seen += float(moved @ metric @ moved)
        expected += float(np.trace(likely))
        scatter += 2.0 * float(np.trace(likely @ likely))
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
    if -gradient @ step < chi2_limit(_FALSE_ALARM, 6):
        return None
    base = step[problem.size :]
    moved = base[3:] + np.cross(base[:3], _where_it_looks(problem, state, robot))
    return Drift(float(np.linalg.norm(moved)), float(np.linalg.norm(base[:3])))


def _where_it_looks(problem: Problem, state: State, robot: str) -> FloatArray:
    """(3,) the mean place, in a robot's base, of what is observed by way of it [m]."""
    branches = problem.tree.branches.values()
    base = next(it.parent for it in branches if it.robot == robot)
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

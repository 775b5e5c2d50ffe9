"""Whether the residuals are noise: tests of drift, and of neighbours that err alike."""

from dataclasses import dataclass

import numpy as np

from visioncal.chance import chi2_limit
from visioncal.estimation.closure import (
    Closure,
    Edges,
    Noise,
    flange_to_residual,
    normal_equations,
    residual_blocks,
)
from visioncal.estimation.linalg import covariance, gram
from visioncal.transforms import adjoint, invert

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


def neighbours(data: Closure, edges: Edges, noise: Noise) -> Neighbours:
    """Compares a blocked jackknife with the covariance of the joint fit.

    Blocks of neighbouring stops are left out in turn (Kuensch 1989), to first order. The squared
    influence of each block is put in proportion to its expectation under the model, so that small
    samples and unequal blocks do not bias it.

    Args:
        data: The views, one a stop, in the order of the session.
        edges: Where the whitened residuals are least: elsewhere their slope passes for a misfit.
        noise: Of the flange.
    """
    residuals, jacobian, spread = residual_blocks(data, edges, noise)
    information = normal_equations(data, edges, noise)[0]
    fitted, metric = covariance(information), information[:12, :12]
    seen = expected = scatter = 0.0
    for rows in np.array_split(np.arange(len(data)), min(_BLOCKS, len(data) // 2)):
        weighted = np.linalg.solve(spread[rows], jacobian[rows])
        own = gram(jacobian[rows], weighted)
        # Leaving the block out takes its information, too.
        without = covariance(information - own)
        moved = (without @ gram(weighted, residuals[rows]))[:12]
        likely = (without @ own @ fitted)[:12, :12] @ metric
        seen += float(moved @ metric @ moved)
        expected += float(np.trace(likely))
        scatter += 2.0 * float(np.trace(likely @ likely))
    freedom = 2.0 * expected**2 / scatter
    factor = seen / expected
    return Neighbours(factor, factor > float(chi2_limit(_FALSE_ALARM, freedom)) / freedom)


def drift(data: Closure, edges: Edges, noise: Noise) -> Drift | None:
    """Looks for a motion in proportion to the number of the stop (Rao's score test).

    Args:
        data: The views, one a stop, in the order of the session.
        edges: Where the whitened residuals are least.
        noise: Of the flange.

    Returns:
        The motion; None where noise explains the residuals as well.
    """
    residuals, jacobian, spread = residual_blocks(data, edges, noise)
    flange = data.robot if data.mount == "eye-in-hand" else invert(data.robot)
    time = np.linspace(-0.5, 0.5, len(data))[:, None, None]
    seen = data.under(edges.shared)
    moving = flange_to_residual(seen, edges) @ (adjoint(invert(flange)) * time)
    both = np.concatenate([jacobian, moving], axis=2)
    weighted = np.linalg.solve(spread, both)
    information = gram(both, weighted)
    known = normal_equations(data, edges, noise)[0]
    size = len(known)
    information[:size, :size] = known
    gradient = gram(weighted, residuals)
    gradient[:size] = 0.0
    step = -covariance(information) @ gradient
    if -gradient @ step < chi2_limit(_FALSE_ALARM, 6):
        return None
    base = step[size:]
    target = edges.z if data.mount == "eye-in-hand" else (flange @ edges.z).mean(axis=0)
    moved = base[3:] + np.cross(base[:3], target[:3, 3])
    return Drift(float(np.linalg.norm(moved)), float(np.linalg.norm(base[:3])))

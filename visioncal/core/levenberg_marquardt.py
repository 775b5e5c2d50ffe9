"""Levenberg-Marquardt minimisation of any problem that can linearise itself."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

State = TypeVar("State")

# Well-posed problems take far fewer; flat valleys of rational lens models take two hundred.
ITERATIONS = 400
# Decrease of the cost, relative to the cost plus one, below which it has converged.
SETTLED = 1e-10
START_DAMPING = 1e-4  # Share of the diagonal.
# Least damping, and that near the solution, where poorly determined directions would need many
# damped steps; its inverse leaves no step.
NEAR_DAMPING = 1e-9


@dataclass(frozen=True, eq=False)
class Linearised(Generic[State]):
    """A problem linearised at one state."""

    state: State  # The linearisation point.
    cost: float  # The squared error there.
    step: Callable[[float], State]  # Maps a damping to the state after the damped step.
    # Maps a damping to the predicted decrease of the cost; None if not known.
    fall: Callable[[float], float] | None = None


def levenberg_marquardt(
    start: State,
    linearise: Callable[[State], Linearised[State]],
    settled: float = SETTLED,
    damping: float = START_DAMPING,
    most: int = ITERATIONS,
) -> tuple[State, bool]:
    """Minimises a sum of squares (Levenberg 1944; Marquardt 1963).

    It has converged at a decrease of the cost below `settled`, relative to the cost plus one: costs
    in units of the noise differ insignificantly by less than one.

    Returns:
        The state of least cost, and whether the iteration converged within `most` steps.
    """
    now = linearise(start)
    for _ in range(most):
        predicted = now.fall(damping) if now.fall is not None else np.inf
        tolerance = settled * (abs(now.cost) + 1.0)
        if 0.0 <= predicted <= tolerance:
            # At convergence, a step whose predicted decrease is below this share of the tolerance
            # is skipped, so that the problem is already linearised at the returned state.
            return now.state if predicted <= 0.1 * tolerance else now.step(damping), True
        trial = linearise(now.step(damping))
        if trial.cost <= now.cost:
            decrease, factor = now.cost - trial.cost, 0.1
            # By the gain over what was predicted (Nielsen 1999).
            if 0.0 < predicted < np.inf:
                factor = max(0.1, 1.0 - (2.0 * min(decrease / predicted, 1.0) - 1.0) ** 3)
            now, damping = trial, max(damping * factor, NEAR_DAMPING)
            if decrease <= tolerance:
                return now.state, True
        else:
            # A step that raises the cost, though it should decrease by a hundredth of a sigma at
            # most, ends the iteration: the rest is rounding, curvature that Gauss-Newton neglects,
            # or an error of the derivatives.
            if predicted <= 1e-4:
                return now.state, True
            damping = max(10.0 * damping, START_DAMPING)
            if damping > 1.0 / NEAR_DAMPING:
                return now.state, True
    return now.state, False

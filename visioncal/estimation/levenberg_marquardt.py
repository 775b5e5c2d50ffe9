"""Levenberg-Marquardt, for any problem that can linearise itself."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

State = TypeVar("State")

# Far more than a healthy problem takes: flat valleys of rational lenses take two hundred.
_ITERATIONS = 400
_START_DAMPING, _LEAST_DAMPING, _WORST_DAMPING = 1e-4, 1e-12, 1e9
# Near the answer, where directions that are hardly determined would need many damped steps.
NEAR_DAMPING = 1e-9


@dataclass(frozen=True, eq=False)
class Linearised(Generic[State]):
    """A problem at one state: its cost, and where a damped step leads to.

    Attributes:
        state: The state.
        cost: The squared error there.
        step: Where a step of some damping leads to.
        fall: By how much the cost then falls, to first order; None where that is not known.
    """

    state: State
    cost: float
    step: Callable[[float], State]
    fall: Callable[[float], float] | None = None


def levenberg_marquardt(
    start: State,
    linearise: Callable[[State], Linearised[State]],
    settled: float,
    damping: float = _START_DAMPING,
) -> tuple[State, bool]:
    """Minimises a sum of squares (Levenberg 1944; Marquardt 1963).

    Args:
        start: Where to begin.
        linearise: Gives the cost at a state and the way on.
        settled: Decrease of the cost under which the state has come to rest, relative to the
            cost and one: in units of the noise, less than one is no difference.
        damping: Of the first step.

    Returns:
        The state of the least cost, and whether it came to rest there.
    """
    now = linearise(start)
    for _ in range(_ITERATIONS):
        if now.fall is not None and 0.0 <= now.fall(damping) <= settled * (abs(now.cost) + 1.0):
            return now.step(damping), True
        then = linearise(now.step(damping))
        if then.cost <= now.cost:
            rested = now.cost - then.cost <= settled * (abs(now.cost) + 1.0)
            now, damping = then, max(damping / 10, _LEAST_DAMPING)
            if rested:
                return now.state, True
        else:
            damping *= 10
            # No step, however small, goes down any more: rounding is all that is left.
            if damping > _WORST_DAMPING:
                return now.state, True
    return now.state, False

"""Levenberg-Marquardt, for any problem that can linearise itself."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

State = TypeVar("State")

# Far more than a healthy problem takes: flat valleys of rational lenses take two hundred.
ITERATIONS = 400
START_DAMPING, _LEAST_DAMPING, _WORST_DAMPING = 1e-4, 1e-12, 1e9
# A step that promised less than this, and went up, is the last: in units of the noise that is a
# hundredth of a sigma.
_LITTLE = 1e-4
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
    damping: float = START_DAMPING,
    most: int = ITERATIONS,
) -> tuple[State, bool]:
    """Minimises a sum of squares (Levenberg 1944; Marquardt 1963).

    Args:
        start: Where to begin.
        linearise: Gives the cost at a state and the way on.
        settled: Decrease of the cost under which the state has come to rest, relative to the
            cost and one: in units of the noise, less than one is no difference.
        damping: Of the first step.
        most: So many steps.

    Returns:
        The state of the least cost, and whether it came to rest there.
    """
    now = linearise(start)
    for _ in range(most):
        if now.fall is not None and 0.0 <= now.fall(damping) <= settled * (abs(now.cost) + 1.0):
            return now.step(damping), True
        then = linearise(now.step(damping))
        if then.cost <= now.cost:
            fell = now.cost - then.cost
            rested = fell <= settled * (abs(now.cost) + 1.0)
            damping = max(damping * _change(now, fell, damping), _LEAST_DAMPING)
            now = then
            if rested:
                return now.state, True
        else:
            # Curvature that Gauss and Newton leave out is all that is left to follow, or rounding.
            if now.fall is not None and now.fall(damping) <= _LITTLE:
                return now.state, True
            damping *= 10
            if damping > _WORST_DAMPING:
                return now.state, True
    return now.state, False


def _change(now: Linearised[State], fell: float, damping: float) -> float:
    """What the damping is multiplied by after a step that lowered the cost (Nielsen 1999).

    It falls to a tenth after a step that kept its promise and doubles after one that kept none of
    it: where Gauss and Newton's curvature is too small, every second step would go up otherwise.
    """
    promised = now.fall(damping) if now.fall is not None else 0.0
    gain = min(fell / promised, 1.0) if promised > 0 else 1.0
    return float(max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3))

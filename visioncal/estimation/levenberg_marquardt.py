"""Levenberg-Marquardt, for any problem that can linearise itself."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

State = TypeVar("State")

# Far more than a healthy problem takes: flat valleys of rational lenses take two hundred.
ITERATIONS = 400
START_DAMPING, _LEAST_DAMPING, _WORST_DAMPING = 1e-4, 1e-12, 1e9
# A step that promised less than this, and went up, is the last: in units of the noise that is a
# hundredth of a sigma. Where the next promise is this much less, it leads on all the same.
_LITTLE, _LEADS = 1e-4, 1e-2
# A step is not taken at rest that promises so much less than what is rest: the linearisation at the
# answer is then at hand.
_NOTHING = 0.1
# Least change of the damping after a step, and that after one which kept its promise to this share:
# the problem is as good as linear.
_LEAST_CHANGE, _LINEAR_CHANGE, _LINEAR = 0.1, 1e-3, 0.99
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
        promised = now.fall(damping) if now.fall is not None else np.inf
        little = settled * (abs(now.cost) + 1.0)
        if 0.0 <= promised <= little:
            return now.state if promised <= _NOTHING * little else now.step(damping), True
        then = linearise(now.step(damping))
        if then.cost <= now.cost:
            fell = now.cost - then.cost
            damping = max(damping * _change(fell, promised), _LEAST_DAMPING)
            now = then
            if fell <= little:
                return now.state, True
        else:
            # What is left is rounding, curvature that Gauss and Newton leave out, or an error of
            # the derivatives.
            if promised <= _LITTLE:
                leads = then.fall is not None and then.fall(damping) < _LEADS * promised
                return then.state if leads else now.state, True
            damping *= 10
            if damping > _WORST_DAMPING:
                return now.state, True
    return now.state, False


def _change(fell: float, promised: float) -> float:
    """What the damping is multiplied by after a step that lowered the cost (Nielsen 1999).

    It falls to a tenth after a step that kept its promise and doubles after one that kept none of
    it: where Gauss and Newton's curvature is too small, every second step would go up otherwise.
    """
    if not 0.0 < promised < np.inf:
        return _LEAST_CHANGE
    gain = min(fell / promised, 1.0)
    return _LINEAR_CHANGE if gain > _LINEAR else max(_LEAST_CHANGE, 1.0 - (2.0 * gain - 1.0) ** 3)

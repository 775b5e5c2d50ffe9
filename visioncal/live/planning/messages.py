"""A plan in words."""

from visioncal.core.number_format import figure
from visioncal.live.planning.accuracy import Accuracy
from visioncal.live.planning.plan import Plan

# More stops are no help where this many times the error is the board's.
_LIMITED = 1.5


def accuracy_words(found: Accuracy) -> str:
    """Says what is predicted: `0.12 mm and 0.02 deg`."""
    if found.is_open:
        return "not determined"
    return f"{figure(found.mm)} mm and {figure(found.deg)} deg"


def summary_of(plan: Plan) -> str:
    """Says in a sentence what a plan gives."""
    count, design = len(plan.stops), plan.design
    stops = f"{count} stop{'s' if count != 1 else ''}"
    wanted = f"{plan.request.purpose.errors}, predicted sigma"
    if plan.begun is None:
        return (
            f"{stops} from {plan.found} possible ones; {wanted}: {accuracy_words(design.predicted)}"
        )
    return (
        f"{stops} to add, from {plan.found} possible ones; {wanted}: "
        f"{accuracy_words(design.before)} before, {accuracy_words(design.predicted)} after"
    )


def looks_note(plan: Plan) -> str:
    """Says that more stops would not help where lens or board limit a plan; else nothing."""
    best, exact = plan.design.best, plan.design.best_look
    if best.is_open or best.mm < _LIMITED * exact.mm:
        return ""
    return (
        f"All candidates together give {figure(best.mm)} mm, and {figure(exact.mm)} mm if the "
        "board's size were known exactly: measure its squares over the whole board, and state "
        "square_sigma_m."
    )

"""Choosing the most informative stops: experimental design by greedy start and exchange."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.choices import Criterion
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import IntArray
from visioncal.live.planning.accuracy import Accuracy, Wish
from visioncal.live.planning.information import World
from visioncal.live.planning.selection import CRITERIA, Selection, reduced

# An exchange must gain this share; so many of them a stop are enough.
_GAIN, _EXCHANGES = 1e-4, 1.0


@dataclass(frozen=True, eq=False)
class Design:
    """Chosen stops.

    Attributes:
        rows: (n,) which candidates, the most informative first.
        criterion: By what they were chosen.
        value: The criterion at these stops: a sigma [mm] for I, else in its own units.
        history: What is predicted without any of them, and after each in the order of `rows`.
        best: What all candidates together could give.
        best_look: The same if lens and board were known exactly.
        best_arm: The same without errors of the arm that a fit takes for noise.
        met: Whether that is as good as was wished; None where nothing was.
    """

    rows: IntArray
    criterion: Criterion
    value: float
    history: tuple[Accuracy, ...]
    best: Accuracy
    best_look: Accuracy
    best_arm: Accuracy
    met: bool | None

    @property
    def predicted(self) -> Accuracy:
        """What is predicted of all of them."""
        return self.history[-1]

    @property
    def before(self) -> Accuracy:
        """What is predicted without any of them."""
        return self.history[0]


def chosen(
    worlds: Sequence[World],
    count: int,
    *,
    criterion: Criterion = "I",
    wish: Wish | None = None,
) -> Design:
    """Chooses the most informative stops beside what is recorded.

    Stops are added greedily until there are enough of them, or the wish is met in prediction; then
    the best that is left out is exchanged for the least of those taken while that gains (Mitchell
    1974, DETMAX, with excursions of one).

    Args:
        worlds: The candidates' information, in each of the cells that may be.
        count: The most stops that may be taken.
        criterion: What makes stops good.
        wish: Where to stop before.

    Raises:
        DataError: The criterion is not known, or there are fewer candidates than stops.
    """
    _check(worlds, count, criterion)
    with one_blas_thread():
        # A wish that is met already needs no stop.
        state = Selection.of(tuple(reduced(world, criterion) for world in worlds), criterion)
        while len(state.rows) < count and not (wish and state.accuracy.meets(wish)):
            state = state.with_one(state.best_to_add())
        state = _exchanged(state)
        if wish is not None:
            state = _thinned(state, wish)
        rows = _ranked(state)
        history, best = _history(worlds, rows)
        sure = _all_of([world.with_known_looks() for world in worlds]).accuracy
        exact = _all_of([world.without_misfit() for world in worlds]).accuracy
    met = None if wish is None else history[-1].meets(wish)
    return Design(rows, criterion, state.figure, history, best, sure, exact, met)


def shortfall(design: Design, wish: Wish, count: int) -> str:
    """Says why a wish is not met and what to do; empty where it is met.

    Args:
        design: What was chosen.
        wish: What was wished.
        count: How many stops were allowed.
    """
    if design.met is not False:
        return ""
    given = f"{len(design.rows)} stops give {_words(design.predicted, wish)}"
    if design.best.meets(wish):
        return (
            f"{given} of the {_wished(wish)} that were wished; more than {count} are needed: all "
            f"candidates together give {_words(design.best, wish)}."
        )
    cause = "A larger board, a nearer camera or more room to move would give more."
    if design.best_look.meets(wish):
        cause = (
            "The uncertainty of the board's size and the lens is in the way: measure the print, "
            "and state its square_sigma_m."
        )
    elif design.best_arm.meets(wish):
        cause = (
            "Errors of the arm that go with its posture are in the way: record joint angles "
            "(q1_rad ...) with all views, and they are calibrated."
        )
    return (
        f"The wished {_wished(wish)} cannot be reached from these candidates: all of them together "
        f"give {_words(design.best, wish)}, and {given}. {cause}"
    )


def _words(accuracy: Accuracy, wish: Wish) -> str:
    return " and ".join(
        f"{figure(getattr(accuracy, unit))} {unit}"
        for unit in ("mm", "deg")
        if getattr(wish, unit) is not None
    )


def _wished(wish: Wish) -> str:
    return _words(Accuracy(wish.mm or 0.0, wish.deg or 0.0), wish)


def _check(worlds: Sequence[World], count: int, criterion: str) -> None:
    if criterion not in CRITERIA:
        raise DataError(
            f"criterion {criterion!r} is not one of {', '.join(CRITERIA)}.", culprits=["criterion"]
        )
    candidates = len(worlds[0].factors)
    if not 0 < count <= candidates:
        raise DataError(
            f"{count} stops cannot be chosen from {candidates} candidates.",
            culprits=["count"],
            next_step="Ask for fewer stops, or make more candidates.",
        )


def _exchanged(state: Selection) -> Selection:
    """Exchanges stops while that gains; all the same in number."""
    for _ in range(int(_EXCHANGES * len(state.rows))):
        if not state.left:
            break
        then = _added_first(state)
        if not _improves(then, state):
            then = _left_out_first(state)
        if not _improves(then, state):
            break
        state = then
    return state


def _improves(then: Selection, now: Selection) -> bool:
    return then.value < (1.0 - _GAIN) * now.value


def _added_first(state: Selection) -> Selection:
    more = state.with_one(state.best_to_add())
    return more.without(more.least())


def _left_out_first(state: Selection) -> Selection:
    fewer = state.without(state.least())
    return fewer.with_one(fewer.best_to_add())


def _thinned(state: Selection, wish: Wish) -> Selection:
    """Leaves out stops while the wish is met without them."""
    while state.rows:
        fewer = state.without(state.least())
        if not fewer.accuracy.meets(wish):
            break
        state = fewer
    return state


def _ranked(state: Selection) -> IntArray:
    """The chosen rows, the most informative first."""
    rows = np.array(state.rows, dtype=np.int64)
    few = tuple(
        replace(item, factors=item.factors[rows], misfit=item.misfit[rows])
        for item in state.problem
    )
    now = Selection.of(few, state.criterion)
    for _ in rows:
        now = now.with_one(now.best_to_add())
    return rows[list(now.rows)]


def _history(worlds: Sequence[World], rows: IntArray) -> tuple[tuple[Accuracy, ...], Accuracy]:
    """What is predicted after each of some candidates in order, and after all that there are."""
    now = Selection.of(tuple(reduced(world, "I") for world in worlds), "I")
    history = [now.accuracy]
    for row in rows.tolist():
        now = now.with_one(row)
        history.append(now.accuracy)
    return tuple(history), _all_of(worlds).accuracy


def _all_of(worlds: Sequence[World]) -> Selection:
    return Selection.of(tuple(reduced(world, "I") for world in worlds), "I").with_all()

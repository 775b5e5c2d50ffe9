"""Choosing the most informative stops: experimental design by greedy start and exchange.

Criteria (Atkinson, Donev and Tobias 2007, chapter 10; Borm and Menq 1991 for O1), each as a mean
over the worlds in which the plan must be good:

    I   mean variance of the places that count
    D   determinant of the unknowns' covariance
    A   mean variance of the unknowns, each in its own unit
    E   largest variance of a combination of unknowns, of those that the candidates determine
    O1  geometric mean of the stacked Jacobian's singular values, over the root of the stops

A stop adds six rows, so that its effect on a covariance C is a correction of rank six (Woodbury):
`C - C F^T (1 + F C F^T)^-1 F C`, for all candidates F in a few products.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import numpy as np

from visioncal.core.choices import Criterion
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.linalg import covariance_root, gram
from visioncal.live.planning.accuracy import Accuracy, Wish
from visioncal.live.planning.information import World

# An exchange must gain this share; so many of them a stop are enough.
_GAIN, _EXCHANGES = 1e-4, 1.0

CRITERIA: tuple[str, ...] = get_args(Criterion)

# Directions of which all candidates together take less than this share of the variance are left
# aside: that changes no figure.
_NULL = 1e-9
# Singular values under this share of the largest are no directions that a stop could determine.
_LEAST_SHARE = 1e-7
# For O1 next to nothing is known beforehand.
_LITTLE = 1e-4
# The largest variance is a peak, and not smooth: so many of the most promising stops are tried,
# where the promise is the drop of the mean variance raised to this power.
_TRIED, _POWER = 12, 6


@dataclass(frozen=True, eq=False)
class Variance:
    """A variance as a function of a covariance C: `trace(roots C roots^T) + rest`.

    Attributes:
        roots: (s, r).
        rest: The share of the directions that nobody determines.
    """

    roots: FloatArray
    rest: float

    def of(self, covariance: FloatArray) -> float:
        """The variance with an (r, r) covariance."""
        return float(np.sum((self.roots @ covariance) * self.roots)) + self.rest


@dataclass(frozen=True, eq=False)
class Reduced:
    """A world in coordinates in which what is known beforehand is the identity.

    Attributes:
        factors: (k, 6, r) of the information of candidates or recorded stops.
        start: (r, r) information without any candidate.
        counted: What counts for the criterion.
        place: The variance of the place that the accuracy is stated of [m^2].
        turn: The same for the rotation [rad^2].
        determined: (r, t) directions that the candidates determine well enough to count for O1.
        watched: (r, r) of edges and arm in their units, as far as the candidates determine them;
            the largest variance among them counts for E.
        misfit: (k, 6, a) and
        gradient: (r, a) by errors of the arm that a fit takes for noise; see `World`.
    """

    factors: FloatArray
    start: FloatArray
    counted: Variance
    place: Variance
    turn: Variance
    determined: FloatArray
    watched: FloatArray
    misfit: FloatArray
    gradient: FloatArray


def reduced(world: World, criterion: Criterion) -> Reduced:
    """Puts a world into the coordinates in which stops are chosen by a criterion."""
    prior = world.prior * (_LITTLE if criterion == "O1" else 1.0)
    size = len(prior)
    # theta = out @ phi, and phi has the identity for a prior. What corners determine of a rational
    # lens is singular to rounding.
    out = covariance_root(prior)
    factors = (world.factors.reshape(-1, size) @ out).reshape(-1, 6, size)
    rows = factors.reshape(-1, size)
    recorded = out.T @ world.recorded @ out
    values, vectors = np.linalg.eigh(rows.T @ rows + recorded)
    basis = vectors[:, values > _NULL]
    share = values[values > _NULL]
    # Lens and board are in the way of what is wanted, and not wanted themselves.
    inverse = 1.0 / world.units
    inverse[12 : 12 + world.looks] = 0.0
    wanted = np.diag(inverse**2) / (size - world.looks) if criterion == "A" else world.counted

    def seen(square: FloatArray) -> Variance:
        turned = out.T @ square @ out
        inner = basis.T @ turned @ basis
        return Variance(_square_root(inner), float(np.trace(turned) - np.trace(inner)))

    watched = np.linalg.qr(inverse[:, None] * (out @ basis) * (share > 1.0)).R
    return Reduced(
        factors @ basis,
        np.eye(len(share)) + basis.T @ recorded @ basis,
        seen(wanted),
        seen(world.place),
        seen(world.turn),
        np.eye(len(share))[:, share > _LEAST_SHARE**2 * share.max(initial=0.0)],
        watched,
        world.misfit,
        basis.T @ (out.T @ world.gradient),
    )


def _square_root(square: FloatArray) -> FloatArray:
    """(s, r) whose square is a non-negative (r, r)."""
    values, vectors = np.linalg.eigh(square)
    kept = values > _NULL**2 * values.max(initial=0.0)
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T)


@dataclass(frozen=True, eq=False)
class Selection:
    """Some chosen candidates, and their information in each world.

    Attributes:
        problem: The worlds.
        criterion: What makes stops good.
        rows: The chosen ones.
        information: (r, r) by world.
        pulls: (r, a) by world, how the gradient moves with errors that a fit takes for noise.
    """

    problem: tuple[Reduced, ...]
    criterion: Criterion
    rows: tuple[int, ...]
    information: tuple[FloatArray, ...]
    pulls: tuple[FloatArray, ...]

    @classmethod
    def of(cls, problem: tuple[Reduced, ...], criterion: Criterion) -> "Selection":
        """No candidates, but what is recorded."""
        starts, pulls = ((item.start for item in problem), (item.gradient for item in problem))
        return cls(problem, criterion, (), tuple(starts), tuple(pulls))

    @cached_property
    def spreads(self) -> tuple[FloatArray, ...]:
        """(r, r) covariance by world, of noise alone."""
        return tuple(np.asarray(np.linalg.inv(array), dtype=float) for array in self.information)

    def with_one(self, row: int) -> "Selection":
        """Takes one more candidate."""
        return self._changed((*self.rows, row), [row], 1.0)

    def without(self, row: int) -> "Selection":
        """Leaves one out."""
        return self._changed(tuple(index for index in self.rows if index != row), [row], -1.0)

    def with_all(self) -> "Selection":
        """Takes all candidates."""
        rest = self.left
        return self._changed((*self.rows, *rest), rest, 1.0)

    @property
    def left(self) -> list[int]:
        """The candidates that are not taken."""
        taken = set(self.rows)
        return [index for index in range(len(self.problem[0].factors)) if index not in taken]

    def _changed(self, rows: tuple[int, ...], by: list[int], sign: float) -> "Selection":
        added = [(item.factors[by], item.misfit[by]) for item in self.problem]
        information = tuple(
            before + sign * gram(factors, factors)
            for before, (factors, _) in zip(self.information, added, strict=True)
        )
        pulls = tuple(
            before + sign * gram(factors, misfit)
            for before, (factors, misfit) in zip(self.pulls, added, strict=True)
        )
        return Selection(self.problem, self.criterion, rows, information, pulls)

    @cached_property
    def value(self) -> float:
        """What is minimised: a mean variance over the worlds, above zero."""
        return float(np.mean([self._value(*world) for world in self._worlds()]))

    def _value(self, world: Reduced, covariance: FloatArray) -> float:
        if self.criterion in ("I", "A"):
            return world.counted.of(covariance)
        if self.criterion == "E":
            return float(np.linalg.eigvalsh(_watched(world, covariance)).max(initial=0.0))
        return float(np.exp(np.linalg.slogdet(covariance)[1] / max(len(covariance), 1)))

    def _worlds(self) -> Iterator[tuple[Reduced, FloatArray]]:
        answers = (
            spread @ gradient for spread, gradient in zip(self.spreads, self.pulls, strict=True)
        )
        totals = (spread + off @ off.T for spread, off in zip(self.spreads, answers, strict=True))
        return zip(self.problem, totals, strict=True)

    @property
    def figure(self) -> float:
        """The criterion's value as it is reported."""
        if self.criterion == "I":
            return 1e3 * float(np.sqrt(self.value))
        if self.criterion != "O1":
            return float(np.sqrt(self.value))
        # What little is known beforehand is no part of the Jacobian.
        volumes = [
            np.linalg.slogdet(world.determined.T @ (array - np.eye(len(array))) @ world.determined)
            for world, array in zip(self.problem, self.information, strict=True)
        ]
        mean = [
            np.exp(value / (2 * max(world.determined.shape[1], 1))) if sign > 0 else 0.0
            for world, (sign, value) in zip(self.problem, volumes, strict=True)
        ]
        return float(np.mean(mean)) / float(np.sqrt(max(len(self.rows), 1)))

    @property
    def accuracy(self) -> Accuracy:
        """What is predicted."""
        place = np.mean([world.place.of(covariance) for world, covariance in self._worlds()])
        turn = np.mean([world.turn.of(covariance) for world, covariance in self._worlds()])
        return Accuracy.of(float(place), float(turn))

    def best_to_add(self) -> int:
        """The candidate that would lessen the value most."""
        return self._best(self.left, 1.0)

    def least(self) -> int:
        """The one of those taken without which the value would rise least."""
        return self._best(list(self.rows), -1.0)

    def _best(self, rows: list[int], sign: float) -> int:
        gains: FloatArray = np.mean(
            [
                self._gains(*pair, rows, sign)
                for pair in zip(self.problem, self.spreads, strict=True)
            ],
            axis=0,
        )
        if self.criterion != "E":
            return rows[int(np.argmax(gains))]
        promising: list[int] = [rows[index] for index in np.argsort(-gains)[:_TRIED].tolist()]
        then = [self.with_one(index) if sign > 0 else self.without(index) for index in promising]
        values = [selection.value for selection in then]
        return promising[int(np.argmin(values))]

    def _gains(
        self, world: Reduced, covariance: FloatArray, rows: list[int], sign: float
    ) -> FloatArray:
        """How much smaller the value would be with each of (k,) rows more, or less."""
        factors = world.factors[rows]
        carried = factors @ covariance
        changed = np.eye(6) + sign * carried @ np.swapaxes(factors, 1, 2)
        if self.criterion in ("D", "O1"):
            return np.asarray(np.linalg.slogdet(changed)[1])
        roots = world.counted.roots if self.criterion != "E" else _peak(world, covariance)
        moved = carried @ roots.T
        squares = moved @ np.swapaxes(moved, 1, 2)
        return np.asarray(sign * np.trace(np.linalg.solve(changed, squares), axis1=1, axis2=2))


def _watched(world: Reduced, covariance: FloatArray) -> FloatArray:
    return np.asarray(world.watched @ covariance @ world.watched.T)


def _peak(world: Reduced, covariance: FloatArray) -> FloatArray:
    """(r, r) roots of the slope of the mean of a high power of the variances."""
    values, vectors = np.linalg.eigh(_watched(world, covariance))
    weights = (np.maximum(values, 0.0) / values[-1]) ** (_POWER - 1)
    return np.asarray(np.sqrt(weights)[:, None] * (vectors.T @ world.watched))


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

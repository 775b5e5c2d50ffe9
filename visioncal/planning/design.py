"""Choosing the stops that tell most: experimental design by greedy start and exchange.

Criteria (Atkinson, Donev and Tobias 2007, chapter 10; Borm and Menq 1991 for O1), each as a mean
over the worlds in which the plan must be good:

    I   mean variance of the places that count
    D   determinant of the unknowns' covariance
    A   mean variance of the unknowns, each in its own unit
    E   largest variance of a combination of what the candidates tell at all
    O1  geometric mean of the stacked Jacobian's singular values, over the root of the stops

A stop adds six rows, so that its effect on a covariance C is a correction of rank six (Woodbury):
`C - C F^T (1 + F C F^T)^-1 F C`, for all candidates F in a few products.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.linalg import solve_triangular

from visioncal.errors import DataError
from visioncal.estimator.linalg import one_blas_thread
from visioncal.planning.information import WEAK_SIGMA, World
from visioncal.types import FloatArray, IntArray

Criterion: TypeAlias = Literal["I", "D", "A", "E", "O1"]
CRITERIA: tuple[str, ...] = get_args(Criterion)

# Directions of which all candidates together take less than this share of the variance are left
# aside: that changes no figure.
_UNTOLD = 1e-9
# Singular values under this share of the largest are no directions that a stop could tell.
_LEAST_SHARE = 1e-7
# For O1 next to nothing is known beforehand.
_LITTLE = 1e-4
# The largest variance is a peak, and not smooth: so many of the most promising stops are tried,
# where the promise is the drop of the mean variance raised to this power.
_TRIED, _POWER = 12, 6
# A sigma over this means that nothing tells: it is that of what is assumed beforehand [rad or m].
OPEN_SIGMA = 0.25 * WEAK_SIGMA
# An exchange must gain this share; so many of them a stop are enough.
_GAIN, _EXCHANGES = 1e-4, 1.0


@dataclass(frozen=True)
class Wish:
    """The accuracy that is wanted, as standard deviations; None where that does not matter.

    Attributes:
        mm: Of the place [mm].
        deg: Of the rotation [deg].
    """

    mm: float | None = None
    deg: float | None = None

    def __post_init__(self) -> None:
        for name in ("mm", "deg"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise DataError(
                    f"the wished accuracy is {value} {name}; a number above zero is needed.",
                    culprits=[f"wish_{name}"],
                )


@dataclass(frozen=True)
class Accuracy:
    """Predicted standard deviations over all worlds, as root mean squares: place and rotation."""

    mm: float
    deg: float

    @property
    def is_open(self) -> bool:
        """Whether a direction is not determined at all; the figures are nothing to go by then."""
        return self.mm > 1e3 * OPEN_SIGMA or self.deg > np.rad2deg(OPEN_SIGMA)

    def meets(self, wish: Wish) -> bool:
        """Whether it is as good as was wished."""
        return (wish.mm is None or self.mm <= wish.mm) and (
            wish.deg is None or self.deg <= wish.deg
        )


@dataclass(frozen=True, eq=False)
class Design:
    """Chosen stops.

    Attributes:
        rows: (n,) which candidates, the most telling first.
        criterion: By what they were chosen.
        value: The criterion at these stops: a sigma [mm] for I, else in its own units.
        history: What is predicted without any of them, and after each in the order of `rows`.
        best: What all candidates together could give.
        met: Whether that is as good as was wished; None where nothing was.
    """

    rows: IntArray
    criterion: Criterion
    value: float
    history: tuple[Accuracy, ...]
    best: Accuracy
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
    """Chooses the stops that tell most beside what is recorded.

    Stops are added greedily until there are enough of them, or the wish is met in prediction; then
    the best that is left out is exchanged for the least of those taken while that gains (Mitchell
    1974, DETMAX, with excursions of one).

    Args:
        worlds: What the candidates tell, in each of the cells that may be.
        count: The most stops that may be taken.
        criterion: What makes stops good.
        wish: Where to stop before.

    Raises:
        DataError: The criterion is not known, or there are fewer candidates than stops.
    """
    _check(worlds, count, criterion)
    with one_blas_thread():
        # A wish that is met already needs no stop.
        state = _State.of(tuple(_reduced(it, criterion) for it in worlds), criterion)
        while len(state.rows) < count and not _enough(state, wish):
            state = state.with_one(state.best_to_add())
        state = _exchanged(state)
        if wish is not None:
            state = _thinned(state, wish)
        rows = _ranked(state)
        history, best = _history(worlds, rows)
    met = None if wish is None else history[-1].meets(wish)
    return Design(rows, criterion, state.figure, history, best, met)


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
    return (
        f"The wished {_wished(wish)} cannot be reached from these candidates: all of them together "
        f"give {_words(design.best, wish)}, and {given}. A larger board, a nearer camera, other "
        "postures, or a board whose size is better known would give more."
    )


def _words(accuracy: Accuracy, wish: Wish) -> str:
    return " and ".join(
        f"{getattr(accuracy, unit):.2g} {unit}"
        for unit in ("mm", "deg")
        if getattr(wish, unit) is not None
    )


def _wished(wish: Wish) -> str:
    return _words(Accuracy(wish.mm or 0.0, wish.deg or 0.0), wish)


def _enough(state: "_State", wish: Wish | None) -> bool:
    return wish is not None and state.accuracy.meets(wish)


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


@dataclass(frozen=True, eq=False)
class _Reduced:
    """A world in coordinates in which what is known beforehand is the identity.

    Attributes:
        factors: (k, 6, r) of what candidates or recorded stops tell at all.
        start: (r, r) information without any candidate.
        counted: What counts for the criterion.
        place: The variance of the place that the accuracy is stated of [m^2].
        turn: The same for the rotation [rad^2].
        told: (r, t) directions that the candidates tell well enough to count for E and O1.
    """

    factors: FloatArray
    start: FloatArray
    counted: "_Variance"
    place: "_Variance"
    turn: "_Variance"
    told: FloatArray


@dataclass(frozen=True, eq=False)
class _Variance:
    """A variance as a function of a covariance C: `trace(roots C roots^T) + rest`.

    Attributes:
        roots: (s, r).
        rest: The share of the directions that nobody tells.
    """

    roots: FloatArray
    rest: float

    def of(self, spread: FloatArray) -> float:
        """The variance with an (r, r) covariance."""
        return float(np.sum((self.roots @ spread) * self.roots)) + self.rest


def _reduced(world: World, criterion: Criterion) -> _Reduced:
    prior = world.prior * (_LITTLE if criterion == "O1" else 1.0)
    size = len(prior)
    root = np.linalg.cholesky(prior)
    # theta = out @ phi, and phi has the identity for a prior.
    out = solve_triangular(root, np.eye(size), lower=True).T
    factors = (world.factors.reshape(-1, size) @ out).reshape(-1, 6, size)
    rows = factors.reshape(-1, size)
    recorded = out.T @ world.recorded @ out
    values, vectors = np.linalg.eigh(rows.T @ rows + recorded)
    basis = vectors[:, values > _UNTOLD]
    share = values[values > _UNTOLD]
    wanted = np.diag(world.units**-2.0) / size if criterion == "A" else world.counted

    def seen(square: FloatArray) -> _Variance:
        turned = out.T @ square @ out
        inner = basis.T @ turned @ basis
        return _Variance(_square_root(inner), float(np.trace(turned) - np.trace(inner)))

    least = _LEAST_SHARE**2 * share.max(initial=0.0) if criterion == "O1" else 1.0
    return _Reduced(
        factors @ basis,
        np.eye(len(share)) + basis.T @ recorded @ basis,
        seen(wanted),
        seen(world.place),
        seen(world.turn),
        np.eye(len(share))[:, share > least],
    )


def _square_root(square: FloatArray) -> FloatArray:
    """(s, r) whose square is a non-negative (r, r)."""
    values, vectors = np.linalg.eigh(square)
    kept = values > _UNTOLD**2 * values.max(initial=0.0)
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T)


@dataclass(frozen=True, eq=False)
class _State:
    """Some chosen candidates, and what they tell in each world.

    Attributes:
        problem: The worlds.
        criterion: What makes stops good.
        rows: The chosen ones.
        information: (r, r) by world.
    """

    problem: tuple[_Reduced, ...]
    criterion: Criterion
    rows: tuple[int, ...]
    information: tuple[FloatArray, ...]

    @classmethod
    def of(cls, problem: tuple[_Reduced, ...], criterion: Criterion) -> "_State":
        """No candidates, but what is recorded."""
        return cls(problem, criterion, (), tuple(it.start for it in problem))

    @cached_property
    def spreads(self) -> tuple[FloatArray, ...]:
        """(r, r) covariance by world."""
        return tuple(np.asarray(np.linalg.inv(it), dtype=float) for it in self.information)

    def with_one(self, row: int) -> "_State":
        """Takes one more candidate."""
        return self._changed((*self.rows, row), [row], 1.0)

    def without(self, row: int) -> "_State":
        """Leaves one out."""
        return self._changed(tuple(it for it in self.rows if it != row), [row], -1.0)

    def with_all(self) -> "_State":
        """Takes all candidates."""
        rest = self.left
        return self._changed((*self.rows, *rest), rest, 1.0)

    @property
    def left(self) -> list[int]:
        """The candidates that are not taken."""
        taken = set(self.rows)
        return [it for it in range(len(self.problem[0].factors)) if it not in taken]

    def _changed(self, rows: tuple[int, ...], by: list[int], sign: float) -> "_State":
        added = (it.factors[by].reshape(-1, it.factors.shape[2]) for it in self.problem)
        information = tuple(
            np.asarray(before + sign * it.T @ it)
            for before, it in zip(self.information, added, strict=True)
        )
        return _State(self.problem, self.criterion, rows, information)

    @cached_property
    def value(self) -> float:
        """What is minimised: a mean variance over the worlds, above zero."""
        return float(np.mean([self._value(*it) for it in self._worlds()]))

    def _value(self, world: _Reduced, spread: FloatArray) -> float:
        if self.criterion in ("I", "A"):
            return world.counted.of(spread)
        if self.criterion == "E":
            return float(np.linalg.eigvalsh(_inner(world, spread)).max(initial=0.0))
        return float(np.exp(np.linalg.slogdet(spread)[1] / max(len(spread), 1)))

    def _worlds(self) -> Iterator[tuple[_Reduced, FloatArray]]:
        return zip(self.problem, self.spreads, strict=True)

    @property
    def figure(self) -> float:
        """The criterion's value as it is told."""
        if self.criterion == "I":
            return 1e3 * float(np.sqrt(self.value))
        if self.criterion != "O1":
            return float(np.sqrt(self.value))
        # What little is known beforehand is no part of the Jacobian.
        told = [
            np.linalg.slogdet(_inner(world, it - np.eye(len(it))))
            for world, it in zip(self.problem, self.information, strict=True)
        ]
        mean = [
            np.exp(it / (2 * max(world.told.shape[1], 1))) if sign > 0 else 0.0
            for world, (sign, it) in zip(self.problem, told, strict=True)
        ]
        return float(np.mean(mean)) / float(np.sqrt(max(len(self.rows), 1)))

    @property
    def accuracy(self) -> Accuracy:
        """What is predicted."""
        place = np.mean([world.place.of(spread) for world, spread in self._worlds()])
        turn = np.mean([world.turn.of(spread) for world, spread in self._worlds()])
        return Accuracy(1e3 * float(np.sqrt(place)), float(np.rad2deg(np.sqrt(turn))))

    def best_to_add(self) -> int:
        """The candidate that would lessen the value most."""
        return self._best(self.left, 1.0)

    def least(self) -> int:
        """The one of those taken without which the value would rise least."""
        return self._best(list(self.rows), -1.0)

    def _best(self, rows: list[int], sign: float) -> int:
        gains: FloatArray = np.mean([self._gains(*it, rows, sign) for it in self._worlds()], axis=0)
        if self.criterion != "E":
            return rows[int(np.argmax(gains))]
        promising: list[int] = [rows[it] for it in np.argsort(-gains)[:_TRIED].tolist()]
        then = [self.with_one(it) if sign > 0 else self.without(it) for it in promising]
        values = [it.value for it in then]
        return promising[int(np.argmin(values))]

    def _gains(
        self, world: _Reduced, spread: FloatArray, rows: list[int], sign: float
    ) -> FloatArray:
        """How much smaller the value would be with each of (k,) rows more, or less."""
        factors = world.factors[rows]
        carried = factors @ spread
        changed = np.eye(6) + sign * carried @ np.swapaxes(factors, 1, 2)
        if self.criterion in ("D", "O1"):
            return np.asarray(np.linalg.slogdet(changed)[1])
        roots = world.counted.roots if self.criterion != "E" else _peak(world, spread)
        moved = carried @ roots.T
        squares = moved @ np.swapaxes(moved, 1, 2)
        return np.asarray(sign * np.trace(np.linalg.solve(changed, squares), axis1=1, axis2=2))


def _inner(world: _Reduced, square: FloatArray) -> FloatArray:
    return np.asarray(world.told.T @ square @ world.told)


def _peak(world: _Reduced, spread: FloatArray) -> FloatArray:
    """(t, r) roots of the slope of the mean of a high power of the variances."""
    values, vectors = np.linalg.eigh(_inner(world, spread))
    weights = (np.maximum(values, 0.0) / values[-1]) ** (_POWER - 1)
    return np.asarray(np.sqrt(weights)[:, None] * (world.told @ vectors).T)


def _exchanged(state: _State) -> _State:
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


def _improves(then: _State, now: _State) -> bool:
    return then.value < (1.0 - _GAIN) * now.value


def _added_first(state: _State) -> _State:
    more = state.with_one(state.best_to_add())
    return more.without(more.least())


def _left_out_first(state: _State) -> _State:
    fewer = state.without(state.least())
    return fewer.with_one(fewer.best_to_add())


def _thinned(state: _State, wish: Wish) -> _State:
    """Leaves out stops while the wish is met without them."""
    while state.rows:
        fewer = state.without(state.least())
        if not fewer.accuracy.meets(wish):
            break
        state = fewer
    return state


def _ranked(state: _State) -> IntArray:
    """The chosen rows, the most telling first."""
    rows = np.array(state.rows, dtype=np.int64)
    few = tuple(replace(it, factors=it.factors[rows]) for it in state.problem)
    now = _State.of(few, state.criterion)
    for _ in rows:
        now = now.with_one(now.best_to_add())
    return rows[list(now.rows)]


def _history(worlds: Sequence[World], rows: IntArray) -> tuple[tuple[Accuracy, ...], Accuracy]:
    """What is predicted after each of some candidates in order, and after all that there are."""
    now = _State.of(tuple(_reduced(it, "I") for it in worlds), "I")
    best, history = now.with_all().accuracy, [now.accuracy]
    for row in rows.tolist():
        now = now.with_one(row)
        history.append(now.accuracy)
    return tuple(history), best

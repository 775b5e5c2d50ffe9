"""Choosing the most informative stops: I-optimal design by greedy selection and exchange.

The criterion is the mean variance of the positions that count, over the possible cells ("worlds")
(Atkinson, Donev and Tobias 2007, chapter 10).

A stop adds six rows F, so that its effect on a covariance C is a rank-six update (Woodbury):
`C - C F^T (1 + F C F^T)^-1 F C`, computed for all candidates in a few products.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.linalg import covariance_root, gram
from visioncal.live.planning.information import WEAK_SIGMA, World

# Least relative gain of an exchange, and the most exchanges per stop.
_GAIN, _EXCHANGES = 1e-4, 1.0

# Directions in which all candidates together add less information than this, relative to the
# prior, are dropped: that changes no figure.
_NULL = 1e-9
# A sigma above this comes from the weak prior alone: no data determine it [rad or m].
OPEN_SIGMA = 0.25 * WEAK_SIGMA


@dataclass(frozen=True)
class Wish:
    """Wished accuracy, as standard deviations; None where that does not matter."""

    mm: float | None = None  # Of the position [mm].
    deg: float | None = None  # Of the rotation [deg].

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
    """Predicted standard deviations of position and rotation, as root mean squares over worlds."""

    mm: float
    deg: float

    @classmethod
    def of(cls, place_m2: float, turn_rad2: float) -> "Accuracy":
        """The accuracy from the sums of the variances of all axes [m^2], [rad^2]."""
        return cls(1e3 * float(np.sqrt(place_m2)), float(np.rad2deg(np.sqrt(turn_rad2))))

    @property
    def is_open(self) -> bool:
        """Whether a direction is undetermined; the figures are then meaningless."""
        return self.mm > 1e3 * OPEN_SIGMA or self.deg > np.rad2deg(OPEN_SIGMA)

    @property
    def words(self) -> str:
        """States it: `0.12 mm and 0.02 deg`."""
        return "not determined" if self.is_open else mm_and_deg(self.mm, self.deg)

    def meets(self, wish: Wish) -> bool:
        """Whether it is at least as good as wished."""
        return (wish.mm is None or self.mm <= wish.mm) and (
            wish.deg is None or self.deg <= wish.deg
        )


@dataclass(frozen=True, eq=False)
class Variance:
    """A variance as a function of a covariance C: `trace(roots C roots^T) + rest`."""

    roots: FloatArray  # (s, r).
    rest: float  # Contribution of the directions that no candidate determines.

    def of(self, covariance: FloatArray) -> float:
        """The variance with an (r, r) covariance."""
        return float(np.sum((self.roots @ covariance) * self.roots)) + self.rest


@dataclass(frozen=True, eq=False)
class Reduced:
    """A world in coordinates in which the prior information is the identity."""

    factors: FloatArray  # (k, 6, r) whitened Jacobians of the candidates.
    start: FloatArray  # (r, r) information without any candidate.
    objective: Variance  # Variance that is minimised.
    position: Variance  # Variance of the position whose accuracy is reported [m^2].
    rotation: Variance  # The same for the rotation [rad^2].
    unestimated: FloatArray  # (k, 6, a) as in `World`.
    gradient: FloatArray  # (r, a) as in `World`.


def reduced(world: World) -> Reduced:
    """Transforms a world to the coordinates in which stops are chosen."""
    size = len(world.prior)
    # theta = unwhitened @ phi, where phi has unit prior information. The information of corners on
    # a rational lens is singular to rounding.
    unwhitened = covariance_root(world.prior)
    factors = (world.factors.reshape(-1, size) @ unwhitened).reshape(-1, 6, size)
    rows = factors.reshape(-1, size)
    recorded = unwhitened.T @ world.recorded @ unwhitened
    values, vectors = np.linalg.eigh(rows.T @ rows + recorded)
    basis = vectors[:, values > _NULL]

    def variance(square: FloatArray) -> Variance:
        transformed = unwhitened.T @ square @ unwhitened
        reduced_square = basis.T @ transformed @ basis
        return Variance(
            _square_root(reduced_square), float(np.trace(transformed) - np.trace(reduced_square))
        )

    return Reduced(
        factors @ basis,
        np.eye(basis.shape[1]) + basis.T @ recorded @ basis,
        variance(world.objective),
        variance(world.position),
        variance(world.rotation),
        world.unestimated,
        basis.T @ (unwhitened.T @ world.gradient),
    )


def _square_root(square: FloatArray) -> FloatArray:
    """Root R (s, r) of a non-negative (r, r): R^T R is the matrix."""
    values, vectors = np.linalg.eigh(square)
    positive = values > _NULL**2 * values.max(initial=0.0)
    return np.asarray((vectors[:, positive] * np.sqrt(values[positive])).T)


@dataclass(frozen=True, eq=False)
class Selection:
    """Chosen candidates, and their information in each world."""

    problem: tuple[Reduced, ...]
    rows: tuple[int, ...]  # The chosen candidates.
    information: tuple[FloatArray, ...]  # (r, r) by world.
    # (r, a) by world, the gradient's Jacobian in parameters that a fit does not estimate.
    gradients: tuple[FloatArray, ...]

    @classmethod
    def of(cls, problem: tuple[Reduced, ...]) -> "Selection":
        """Starts with no candidate, only the recorded stops."""
        starts, gradients = ((item.start for item in problem), (item.gradient for item in problem))
        return cls(problem, (), tuple(starts), tuple(gradients))

    @cached_property
    def covariances(self) -> tuple[FloatArray, ...]:
        """Covariance (r, r) of noise alone, by world."""
        return tuple(np.asarray(np.linalg.inv(array), dtype=float) for array in self.information)

    def with_one(self, row: int) -> "Selection":
        """Adds a candidate."""
        return self._changed((*self.rows, row), [row], 1.0)

    def without(self, row: int) -> "Selection":
        """Removes a candidate."""
        return self._changed(tuple(index for index in self.rows if index != row), [row], -1.0)

    def with_all(self) -> "Selection":
        """Adds all candidates."""
        rest = self.left
        return self._changed((*self.rows, *rest), rest, 1.0)

    @property
    def left(self) -> list[int]:
        """Candidates that are not chosen."""
        chosen_rows = set(self.rows)
        return [index for index in range(len(self.problem[0].factors)) if index not in chosen_rows]

    def _changed(self, rows: tuple[int, ...], by: list[int], sign: float) -> "Selection":
        added = [(item.factors[by], item.unestimated[by]) for item in self.problem]
        information = tuple(
            before + sign * gram(factors, factors)
            for before, (factors, _) in zip(self.information, added, strict=True)
        )
        gradients = tuple(
            before + sign * gram(factors, unestimated)
            for before, (factors, unestimated) in zip(self.gradients, added, strict=True)
        )
        return Selection(self.problem, rows, information, gradients)

    @cached_property
    def value(self) -> float:
        """The minimised variance: a mean over the worlds [m^2]."""
        return float(np.mean([world.objective.of(array) for world, array in self._worlds()]))

    def _worlds(self) -> Iterator[tuple[Reduced, FloatArray]]:
        pairs = zip(self.covariances, self.gradients, strict=True)
        biased = ((covariance, covariance @ gradient) for covariance, gradient in pairs)
        totals = (covariance + bias @ bias.T for covariance, bias in biased)
        return zip(self.problem, totals, strict=True)

    @property
    def accuracy(self) -> Accuracy:
        """The predicted accuracy."""
        position = np.mean([world.position.of(covariance) for world, covariance in self._worlds()])
        rotation = np.mean([world.rotation.of(covariance) for world, covariance in self._worlds()])
        return Accuracy.of(float(position), float(rotation))

    def best_to_add(self) -> int:
        """The candidate that would reduce the value most."""
        return self._best(self.left, 1.0)

    def least_informative(self) -> int:
        """The chosen candidate without which the value would rise least."""
        return self._best(list(self.rows), -1.0)

    def _best(self, rows: list[int], sign: float) -> int:
        gains: FloatArray = np.mean(
            [
                self._gains(*pair, rows, sign)
                for pair in zip(self.problem, self.covariances, strict=True)
            ],
            axis=0,
        )
        return rows[int(np.argmax(gains))]

    @staticmethod
    def _gains(world: Reduced, covariance: FloatArray, rows: list[int], sign: float) -> FloatArray:
        """Decrease (k,) of the value if each of the rows were added, or removed."""
        factors = world.factors[rows]
        carried = factors @ covariance
        changed = np.eye(6) + sign * carried @ np.swapaxes(factors, 1, 2)
        moved = carried @ world.objective.roots.T
        squares = moved @ np.swapaxes(moved, 1, 2)
        return np.asarray(sign * np.trace(np.linalg.solve(changed, squares), axis1=1, axis2=2))


@dataclass(frozen=True, eq=False)
class Design:
    """Chosen stops."""

    rows: IntArray  # (n,) chosen candidates, the most informative first.
    sigma_mm: float  # Root mean variance of the positions that count, with these stops [mm].
    # Accuracy predicted without any of them, and after each in the order of `rows`.
    history: tuple[Accuracy, ...]
    best: Accuracy  # Accuracy with all candidates.
    best_known_lens_board: Accuracy  # The same if lens and board were known exactly.
    best_exact_arm: Accuracy  # The same without errors of the arm that a fit treats as noise.
    met: bool | None  # Whether the wish is met; None where there was none.

    @property
    def predicted(self) -> Accuracy:
        """Accuracy predicted with all of them."""
        return self.history[-1]

    @property
    def before(self) -> Accuracy:
        """Accuracy predicted without any of them."""
        return self.history[0]


def choose_stops(
    worlds: Sequence[World],
    count: int,
    *,
    wish: Wish | None = None,
) -> Design:
    """Chooses at most `count` of the candidates to add to the recorded stops, the most informative.

    Stops are added greedily until there are enough, or the predicted accuracy meets the wish; then
    the best unused candidate replaces the least informative stop while that gains (Mitchell 1974,
    DETMAX, with excursions of one).

    Raises:
        DataError: There are fewer candidates than stops.
    """
    _check(worlds, count)
    with one_blas_thread():
        # A wish that is met already needs no stop.
        state = Selection.of(tuple(map(reduced, worlds)))
        while len(state.rows) < count and not (wish and state.accuracy.meets(wish)):
            state = state.with_one(state.best_to_add())
        state = _exchange(state)
        if wish is not None:
            state = _without_needless(state, wish)
        rows = _ranked(state)
        history, best = _history(worlds, rows)
        known_lens_board = _all_of([world.with_known_lens_board() for world in worlds]).accuracy
        exact_arm = _all_of([world.without_unestimated_arm() for world in worlds]).accuracy
    met = None if wish is None else history[-1].meets(wish)
    sigma_mm = 1e3 * float(np.sqrt(state.value))
    return Design(rows, sigma_mm, history, best, known_lens_board, exact_arm, met)


def shortfall(design: Design, wish: Wish, count: int) -> str:
    """Explains why at most `count` stops do not meet a wish, and a remedy; empty if they do."""
    if design.met is not False:
        return ""
    given = f"{len(design.rows)} stops give {_accuracy_words(design.predicted, wish)}"
    if design.best.meets(wish):
        return (
            f"{given} of the {_wished(wish)} that were wished; more than {count} are needed: all "
            f"candidates together give {_accuracy_words(design.best, wish)}."
        )
    cause = "A larger board, a nearer camera or more room to move would give more."
    if design.best_known_lens_board.meets(wish):
        cause = (
            "The uncertainty of the board's size and the lens is in the way: measure the print, "
            "and state its square_sigma_m."
        )
    elif design.best_exact_arm.meets(wish):
        cause = (
            "Errors of the arm that go with its posture are in the way: record joint angles "
            "(q1_rad ...) with all views, and they are calibrated."
        )
    return (
        f"The wished {_wished(wish)} cannot be reached from these candidates: all of them together "
        f"give {_accuracy_words(design.best, wish)}, and {given}. {cause}"
    )


def _accuracy_words(accuracy: Accuracy, wish: Wish) -> str:
    return " and ".join(
        f"{figure(getattr(accuracy, unit))} {unit}"
        for unit in ("mm", "deg")
        if getattr(wish, unit) is not None
    )


def _wished(wish: Wish) -> str:
    return _accuracy_words(Accuracy(wish.mm or 0.0, wish.deg or 0.0), wish)


def _check(worlds: Sequence[World], count: int) -> None:
    candidates = len(worlds[0].factors)
    if not 0 < count <= candidates:
        raise DataError(
            f"{count} stops cannot be chosen from {candidates} candidates.",
            culprits=["count"],
            next_step="Ask for fewer stops, or make more candidates.",
        )


def _exchange(state: Selection) -> Selection:
    """Exchanges stops while that gains; their number stays."""
    for _ in range(int(_EXCHANGES * len(state.rows))):
        if not state.left:
            break
        enough = (1.0 - _GAIN) * state.value
        more = state.with_one(state.best_to_add())
        exchanged = more.without(more.least_informative())
        if not exchanged.value < enough:
            fewer = state.without(state.least_informative())
            exchanged = fewer.with_one(fewer.best_to_add())
        if not exchanged.value < enough:
            break
        state = exchanged
    return state


def _without_needless(state: Selection, wish: Wish) -> Selection:
    """Removes stops while the wish is met without them."""
    while state.rows:
        fewer = state.without(state.least_informative())
        if not fewer.accuracy.meets(wish):
            break
        state = fewer
    return state


def _ranked(state: Selection) -> IntArray:
    """The chosen rows, the most informative first."""
    rows = np.array(state.rows, dtype=np.int64)
    few = tuple(
        replace(item, factors=item.factors[rows], unestimated=item.unestimated[rows])
        for item in state.problem
    )
    selection = Selection.of(few)
    for _ in rows:
        selection = selection.with_one(selection.best_to_add())
    return rows[list(selection.rows)]


def _history(worlds: Sequence[World], rows: IntArray) -> tuple[tuple[Accuracy, ...], Accuracy]:
    """Accuracy predicted after each of some candidates in order, and after all candidates."""
    selection = Selection.of(tuple(map(reduced, worlds)))
    history = [selection.accuracy]
    for row in rows.tolist():
        selection = selection.with_one(row)
        history.append(selection.accuracy)
    return tuple(history), _all_of(worlds).accuracy


def _all_of(worlds: Sequence[World]) -> Selection:
    return Selection.of(tuple(map(reduced, worlds))).with_all()

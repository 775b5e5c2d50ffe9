"""Choosing the most informative stops: I- or D-optimal design by greedy selection and exchange.

The I criterion is the mean variance of the positions that count, over the possible cells
("worlds"); the D criterion is the determinant of the covariance of all unknowns (Atkinson, Donev
and Tobias 2007, chapter 10).

A stop adds a few rows F, so that its effect on a covariance C is an update of low rank (Woodbury):
`C - C F^T (1 + F C F^T)^-1 F C`, computed for all candidates in a few products.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.choices import Criterion
from visioncal.core.errors import DataError
from visioncal.core.linalg import covariance_root, gram
from visioncal.core.number_format import mm_and_deg
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray
from visioncal.planning.information import WEAK_SIGMA, World

# A sigma above this comes from the weak prior alone: no data determine it [rad or m].
OPEN_SIGMA = 0.25 * WEAK_SIGMA


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
        """The accuracy in words: `0.12 mm and 0.02 deg`."""
        return "not determined" if self.is_open else mm_and_deg(self.mm, self.deg)


class _Reduced:
    """A world in coordinates in which the prior information is the identity.

    Attributes:
        factors: (k, m, p) whitened Jacobians of the candidates.
        start: (p, p) information without any candidate.
        roots: Roots R (s, p) of the variances that are minimised and reported, of position [m^2]
            and rotation [rad^2]: with a covariance C the variance is trace(R C R^T).
        unestimated: (k, m, a) as in `World`.
        gradient: (p, a) as in `World`.
    """

    def __init__(self, world: World) -> None:
        size = len(world.prior)
        # theta = unwhitened @ phi, where phi has unit prior information. The information of corners
        # on a rational lens is singular to rounding.
        unwhitened = covariance_root(world.prior)
        self.factors = world.factors @ unwhitened
        self.start = np.eye(size) + unwhitened.T @ world.recorded @ unwhitened
        self.gradient = unwhitened.T @ world.gradient
        self.unestimated, self.roots = world.unestimated, []
        for square in (world.objective, world.position, world.rotation):
            values, vectors = np.linalg.eigh(unwhitened.T @ square @ unwhitened)
            positive = values > np.finfo(float).eps * values.max(initial=0.0)
            self.roots.append((vectors[:, positive] * np.sqrt(values[positive])).T)


@dataclass(frozen=True, eq=False)
class _Selection:
    """Chosen candidates, and their information in each world."""

    problem: tuple[_Reduced, ...]
    criterion: Criterion = "I"
    rows: tuple[int, ...] = ()  # The chosen candidates, beside the recorded stops.

    @classmethod
    def of(cls, worlds: Sequence[World], criterion: Criterion = "I") -> "_Selection":
        """Starts with no candidate, only the recorded stops."""
        return cls(tuple(map(_Reduced, worlds)), criterion)

    @property
    def left(self) -> list[int]:
        """Candidates that are not chosen."""
        chosen = set(self.rows)
        return [row for row in range(len(self.problem[0].factors)) if row not in chosen]

    def with_rows(self, added: list[int]) -> "_Selection":
        """Adds candidates."""
        return replace(self, rows=(*self.rows, *added))

    def with_best(self) -> "_Selection":
        """Adds the candidate that reduces the value most."""
        return self.with_rows([self._best(self.left, 1.0)])

    def without_least(self) -> "_Selection":
        """Removes the chosen candidate without which the value rises least."""
        row = self._best(list(self.rows), -1.0)
        return replace(self, rows=tuple(other for other in self.rows if other != row))

    @cached_property
    def covariances(self) -> tuple[FloatArray, ...]:
        """Covariance (p, p) of noise alone, by world."""
        # Information that is summed, never subtracted, keeps its smallest eigenvalues.
        chosen = [world.factors[list(self.rows)] for world in self.problem]
        pairs = zip(self.problem, chosen, strict=True)
        roots = [covariance_root(world.start + gram(rows, rows)) for world, rows in pairs]
        return tuple(root @ root.T for root in roots)

    @cached_property
    def variances(self) -> FloatArray:
        """(3,) minimised, position [m^2] and rotation [rad^2]: means over the worlds."""
        sums = np.zeros(3)
        for world, covariance in zip(self.problem, self.covariances, strict=True):
            rows = list(self.rows)
            gradient = world.gradient + gram(world.factors[rows], world.unestimated[rows])
            bias = covariance @ gradient
            total = covariance + bias @ bias.T
            sums += [np.sum((root @ total) * root) for root in world.roots]
        return sums / len(self.problem)

    @property
    def value(self) -> float:
        """The minimised value: a variance, for D the geometric mean of those of all unknowns."""
        if self.criterion == "I":
            return float(self.variances[0])
        logs = [np.linalg.slogdet(each)[1] / len(each) for each in self.covariances]
        return float(np.exp(np.mean(logs)))

    @property
    def accuracy(self) -> Accuracy:
        """The predicted accuracy."""
        return Accuracy.of(*self.variances[1:].tolist())

    def _best(self, rows: list[int], sign: float) -> int:
        """The row whose addition reduces the value most, or whose removal raises it least."""
        gains = np.zeros(len(rows))
        for world, covariance in zip(self.problem, self.covariances, strict=True):
            factors = world.factors[rows]
            carried = factors @ covariance
            changed = np.eye(factors.shape[1]) + sign * carried @ np.swapaxes(factors, 1, 2)
            if self.criterion == "D":
                gains += sign * np.linalg.slogdet(changed)[1]
                continue
            moved = carried @ world.roots[0].T
            squares = moved @ np.swapaxes(moved, 1, 2)
            gains += sign * np.trace(np.linalg.solve(changed, squares), axis1=1, axis2=2)
        return rows[int(np.argmax(gains))]


@dataclass(frozen=True, eq=False)
class Design:
    """Chosen stops."""

    rows: IntArray  # (n,) chosen candidates, the most informative first.
    sigma_mm: float  # Root mean variance of the positions that count, with these stops [mm].
    # Accuracy predicted without any of them, and after each in the order of `rows`.
    history: tuple[Accuracy, ...]
    best: Accuracy  # Accuracy with all candidates.

    @property
    def predicted(self) -> Accuracy:
        """Accuracy predicted with all chosen stops."""
        return self.history[-1]

    @property
    def before(self) -> Accuracy:
        """Accuracy predicted without any chosen stop."""
        return self.history[0]


def choose_stops(worlds: Sequence[World], count: int, criterion: Criterion = "I") -> Design:
    """Chooses `count` of the candidates to add to the recorded stops, the most informative.

    Stops are added greedily; then the best unused candidate replaces the least informative stop
    while that gains (Mitchell 1974, DETMAX, with excursions of one).

    Raises:
        DataError: There are fewer candidates than stops.
    """
    candidates = len(worlds[0].factors)
    if not 0 < count <= candidates:
        raise DataError(
            f"{count} stops cannot be chosen from {candidates} candidates.",
            culprits=["count"],
            next_step="Ask for fewer stops, or make more candidates.",
        )
    with one_blas_thread():
        state = _Selection.of(worlds, criterion)
        for _ in range(count):
            state = state.with_best()
        # Stops are exchanged while that gains; their number stays.
        for _ in state.rows:
            if not state.left:
                break
            enough = (1.0 - 1e-4) * state.value
            exchanged = state.with_best().without_least()
            if not exchanged.value < enough:
                exchanged = state.without_least().with_best()
            if not exchanged.value < enough:
                break
            state = exchanged
        rows = np.array(state.rows, dtype=np.int64)
        ranking = _Selection.of([world.of_candidates(rows) for world in worlds], criterion)
        history = [ranking.accuracy]
        for _ in rows:
            ranking = ranking.with_best()
            history.append(ranking.accuracy)
        best = _Selection.of(worlds).with_rows(list(range(candidates))).accuracy
    sigma_mm = 1e3 * float(np.sqrt(state.variances[0]))
    rows = rows[list(ranking.rows)]
    return Design(rows, sigma_mm, tuple(history), best)

"""The way from stop to stop: in a short order, and clear of everything all along."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.live.planning.cell import PlanCell, collisions_of
from visioncal.robot.collision import Collisions

# Exchanges gain at least this [rad]; a tour is improved over and over at most so many times.
_GAIN_RAD, _ROUNDS = 1e-9, 50
# Places at which a stop that was left aside is tried again, the nearest first.
_PLACES = 3
# A tour that leads to fewer of the stops is begun at another one, so many times.
_MOST, _BEGINNINGS = 0.5, 3
# Draws before a search is given up, and how far one step of it goes [rad].
_DRAWS, _STEP_RAD = 120, 0.7
# After so many searches in vain, ways are straight or none.
_IN_VAIN = 60
# How far a detour may leave the box of both postures [rad].
_ASIDE_RAD = 1.5


class Detours:
    """Finds ways between postures on which nothing comes too near to anything."""

    def __init__(self, cell: PlanCell, collisions: Collisions, seed: int) -> None:
        """Prepares the search for a cell."""
        margin = cell.limits.joint_margin_rad
        self._lower = cell.robot.lower_rad + margin
        self._upper = cell.robot.upper_rad - margin
        self._collisions = collisions
        self._rng = np.random.default_rng(seed)
        self._in_vain = 0

    def way(self, start: FloatArray, end: FloatArray) -> FloatArray | int:
        """Finds a way: straight, or around what is in between.

        Args:
            start: (n,) joint angles [rad].
            end: (n,) joint angles [rad].

        Returns:
            The postures (j, n) between which the joints move evenly, without the ends; or, where no
            way was found, the pair of bodies that the straight one brings together, as
            `Collisions.names` counts them.
        """
        blocked = self._collisions.on_the_way(start, end)
        if blocked < 0:
            return np.empty((0, len(start)))
        found = self._around(start, end) if self._in_vain < _IN_VAIN else None
        if found is None:
            self._in_vain += 1
            return blocked
        return self._straightened(found)[1:-1]

    def _around(self, start: FloatArray, end: FloatArray) -> FloatArray | None:
        """Two trees that grow towards draws and one another (Kuffner and LaValle 2000).

        Returns:
            (j, n) postures from start to end; None where the trees did not meet.
        """
        low = np.maximum(np.minimum(start, end) - _ASIDE_RAD, self._lower)
        high = np.minimum(np.maximum(start, end) + _ASIDE_RAD, self._upper)
        trees = (_PostureTree(start), _PostureTree(end))
        for draw in range(_DRAWS):
            near, far = trees if draw % 2 == 0 else trees[::-1]
            grown = self._grow(near, self._rng.uniform(low, high), steps=1)
            if grown is None:
                continue
            met = self._grow(far, near.postures[grown], steps=_DRAWS)
            if met is not None and np.array_equal(far.postures[met], near.postures[grown]):
                halves = [near.to_root(grown)[::-1], far.to_root(met)[1:]]
                way = np.vstack(halves)
                return way if near is trees[0] else way[::-1]
        return None

    def _grow(self, tree: "_PostureTree", goal: FloatArray, steps: int) -> int | None:
        """Grows a tree towards a posture, until something is in the way: its last new place."""
        place, new = tree.nearest(goal), None
        for _ in range(steps):
            left = goal - tree.postures[place]
            far = float(np.linalg.norm(left))
            if far == 0.0:
                return place
            posture = goal if far <= _STEP_RAD else tree.postures[place] + left * (_STEP_RAD / far)
            if self._collisions.on_the_way(tree.postures[place], posture) >= 0:
                break
            place = new = tree.add(posture, place)
        return new

    def _straightened(self, way: FloatArray) -> FloatArray:
        """Leaves out postures between which a straight way is clear."""
        kept, at = [0], 0
        while at < len(way) - 1:
            ahead = range(len(way) - 1, at + 1, -1)
            clear = (
                index for index in ahead if self._collisions.on_the_way(way[at], way[index]) < 0
            )
            at = next(clear, at + 1)
            kept.append(at)
        return np.asarray(way[kept])


class _PostureTree:
    """Postures that can be reached from the first of them."""

    def __init__(self, root: FloatArray) -> None:
        self.postures = [root]
        self._parents = [0]

    def add(self, posture: FloatArray, parent: int) -> int:
        """Adds a posture behind another one, and returns its place."""
        self.postures.append(posture)
        self._parents.append(parent)
        return len(self.postures) - 1

    def nearest(self, goal: FloatArray) -> int:
        """The place of the posture nearest to one."""
        return int(np.linalg.norm(np.array(self.postures) - goal, axis=1).argmin())

    def to_root(self, place: int) -> FloatArray:
        """The postures (j, n) from a place to the root."""
        way = [place]
        while way[-1]:
            way.append(self._parents[way[-1]])
        return np.array([self.postures[index] for index in way])


@dataclass(frozen=True, eq=False)
class Route:
    """The way through the stops. Between two postures all joints move evenly, in a straight line.

    Attributes:
        order: (k,) rows of the stops in their given order.
        segments: The postures (j, n) that are passed on the way to each stop, j often 0; the first
            is from the start where one was given, and absent otherwise.
        length_rad: How far the joints travel altogether, as the sum of the ways' norms.
        unreachable: The rows that no safe way was found to, and what is in the way.
    """

    order: tuple[int, ...]
    segments: tuple[FloatArray, ...]
    length_rad: float
    unreachable: Mapping[int, str]


def ordered(cell: PlanCell, start_q: FloatArray | None, q: FloatArray, seed: int = 0) -> Route:
    """Orders stops so that the joints travel little, and finds a clear way between them.

    The order is that of nearest neighbours, improved by reversals (Croes 1958, 2-opt). Each way is
    a straight line of the joints, or a detour where something is in between.

    Args:
        cell: The cell.
        start_q: (n,) where the arm stands before [rad]; None to begin at any stop.
        q: (k, n) joint angles of the stops [rad], each clear as `candidates` gives them.
        seed: Of the detours.

    Returns:
        The way. Stops that cannot be reached safely are left out and named.

    Raises:
        DataError: The start is nearer to something than the clearance allows.
    """
    collisions = collisions_of(cell)
    if start_q is not None:
        _check_start(cell, collisions, start_q)
    detours = Detours(cell, collisions, seed)
    best: _Tour | None = None
    first = int(np.linalg.norm(q - np.median(q, axis=0), axis=1).argmax()) if len(q) else 0
    for _ in range(1 if start_q is not None else _BEGINNINGS):
        order = _short_order(start_q, q, first)
        tour = _Tour(detours, start_q, q)
        tour.walk(order)
        if best is None or len(tour.order) > len(best.order):
            best = tour
        if len(best.order) > _MOST * len(q):
            break
        first = next((row for row in order if row not in best.order), first)
    if best is None:
        return Route((), (), 0.0, {})
    return best.route(collisions)


def _check_start(cell: PlanCell, collisions: Collisions, start_q: FloatArray) -> None:
    contact = int(collisions.first_contact(start_q[None])[0])
    if contact >= 0:
        first, second = collisions.names[contact]
        apart = float(collisions.distances(start_q)[contact])
        needed = float(collisions.needed_m()[contact])
        raise DataError(
            f"plan: where the arm starts, {first} and {second} are {1e3 * apart:.0f} mm apart; "
            f"{1e3 * needed:.0f} mm and a little more are needed.",
            culprits=[first, second],
            next_step="Drive the arm clear by hand, or begin the plan at its first stop. The "
            f"clearance is {1e3 * cell.limits.clearance_m:.0f} mm.",
        )


class _Tour:
    """A way that grows from stop to stop."""

    def __init__(self, detours: Detours, start_q: FloatArray | None, q: FloatArray) -> None:
        self.order: list[int] = []
        self._detours, self._start, self._q = detours, start_q, q
        # The way to each stop of the order; that to the first is None where there is no start.
        self._ways: list[FloatArray | None] = []
        self._blocked: dict[int, int] = {}

    def walk(self, order: Sequence[int]) -> None:
        """Goes to all stops in an order, and comes back to those that were not reached at first."""
        aside = [row for row in order if not self._insert(row, len(self.order))]
        for row in aside:
            away = [float(np.linalg.norm(self._q[index] - self._q[row])) for index in self.order]
            # Behind its nearest neighbours, or before them.
            places = [place + after for place in np.argsort(away)[:_PLACES] for after in (1, 0)]
            any(self._insert(row, int(place)) for place in dict.fromkeys(places))

    def route(self, collisions: Collisions) -> Route:
        """The way as it is handed out."""
        segments = tuple(way for way in self._ways if way is not None)
        length = 0.0
        for place, way in enumerate(self._ways):
            before = self._before(place)
            if before is not None and way is not None:
                postures = np.vstack([before, way, self._q[self.order[place]]])
                length += float(np.linalg.norm(np.diff(postures, axis=0), axis=1).sum())
        missing = [row for row in self._blocked if row not in self.order]
        words = {row: " and ".join(collisions.names[self._blocked[row]]) for row in missing}
        return Route(tuple(self.order), segments, length, words)

    def _insert(self, row: int, place: int) -> bool:
        """Goes to a stop at a place of the order, if there are ways to it and from it."""
        before, goal = self._before(place), self._q[row]
        way = None if before is None else self._way(before, goal, row)
        if before is not None and way is None:
            return False
        if place < len(self.order):
            onward = self._way(goal, self._q[self.order[place]], row)
            if onward is None:
                return False
            self._ways[place] = onward
        self.order.insert(place, row)
        self._ways.insert(place, way)
        return True

    def _way(self, start: FloatArray, end: FloatArray, row: int) -> FloatArray | None:
        found = self._detours.way(start, end)
        if isinstance(found, int):
            self._blocked[row] = found
            return None
        return found

    def _before(self, place: int) -> FloatArray | None:
        """The posture before a place of the order; None before the first where none is given."""
        return self._q[self.order[place - 1]] if place else self._start


def _short_order(start_q: FloatArray | None, q: FloatArray, first: int) -> list[int]:
    """An order in which the joints travel little: nearest neighbours, improved by reversals."""
    points = q if start_q is None else np.vstack([q, start_q])
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    order = [first if start_q is None else len(q)]
    left = set(range(len(q))) - set(order)
    while left:
        here = order[-1]
        order.append(min(left, key=lambda row: apart[here, row]))
        left.remove(order[-1])
    tour = np.array(order)
    for _ in range(_ROUNDS):
        if not _reversed(tour, apart):
            break
    return [int(row) for row in tour if row < len(q)]


def _reversed(tour: FloatArray, apart: FloatArray) -> bool:
    """Reverses parts of an open tour, in place, where that makes it shorter; its start stays."""
    gained = False
    for i in range(1, len(tour) - 1):
        # Reversing i..j changes the ways into i and out of j; at the end there is none.
        ends = tour[i + 1 :]
        after = np.append(tour[i + 2 :], -1)
        onward = np.where(after >= 0, apart[ends, after] - apart[tour[i], after], 0.0)
        gain = apart[tour[i - 1], tour[i]] - apart[tour[i - 1], ends] + onward
        j = int(gain.argmax())
        if gain[j] > _GAIN_RAD:
            tour[i : i + 2 + j] = tour[i : i + 2 + j][::-1].copy()
            gained = True
    return gained

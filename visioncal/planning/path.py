"""Path planning through the stops: a short order, with collision-free paths in joint space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.planning.cell import AnyCell
from visioncal.robot.collision import Collisions

# Most rounds in which stops without a safe path are replaced: an arm that folds far back needs up
# to six for 8 to 30 stops.
ROUNDS = 12
# Draws per search, and the length of one step [rad].
_DRAWS, _STEP_RAD = 120, 0.7
# How far a detour may leave the joint box of both postures [rad].
_ASIDE_RAD = 1.5


class _Tree:
    """Tree of postures that can be reached from its root."""

    def __init__(self, root: FloatArray) -> None:
        self.postures, self.parents = [root], [0]

    def grow(self, goal: FloatArray, steps: int, collisions: Collisions) -> int | None:
        """Grows towards a posture until it is blocked; returns its last new node."""
        place, new = int(np.linalg.norm(np.array(self.postures) - goal, axis=1).argmin()), None
        for _ in range(steps):
            difference = goal - self.postures[place]
            distance = float(np.linalg.norm(difference))
            if distance == 0.0:
                return place
            posture = goal
            if distance > _STEP_RAD:
                posture = self.postures[place] + difference * (_STEP_RAD / distance)
            if collisions.path_contact(self.postures[place], posture) >= 0:
                break
            self.postures.append(posture)
            self.parents.append(place)
            place = new = len(self.postures) - 1
        return new

    def to_root(self, place: int) -> list[FloatArray]:
        """Postures from a node to the root."""
        path = [place]
        while path[-1]:
            path.append(self.parents[path[-1]])
        return [self.postures[index] for index in path]


class _Detours:
    """Planner of collision-free paths between postures."""

    def __init__(self, cell: AnyCell, collisions: Collisions, seed: int) -> None:
        margin = cell.limits.joint_margin_rad
        self._lower = cell.robot.lower_rad + margin
        self._upper = cell.robot.upper_rad - margin
        self._collisions = collisions
        self._rng = np.random.default_rng(seed)
        self._failed_searches = 0

    def path(self, start: FloatArray, end: FloatArray) -> FloatArray | int:
        """Finds a path between joint angles (n,) [rad]: straight in joint space, or a detour.

        Returns:
            Via postures (j, n), without the ends; or, where no path was found, the index in
            `Collisions.names` of the pair of bodies that collides on the straight one.
        """
        blocked = self._collisions.path_contact(start, end)
        if blocked < 0:
            return np.empty((0, len(start)))
        # After so many failures only straight paths are tried.
        detour = self._rrt_connect(start, end) if self._failed_searches < 60 else None
        if detour is None:
            self._failed_searches += 1
            return blocked
        # Postures that a straight path can skip are removed.
        kept, last = [], 0
        while last < len(detour) - 1:
            ahead = range(len(detour) - 1, last + 1, -1)
            contact = self._collisions.path_contact
            clear = (index for index in ahead if contact(detour[last], detour[index]) < 0)
            last = next(clear, last + 1)
            kept.append(detour[last])
        return np.array(kept[:-1]).reshape(-1, len(start))

    def _rrt_connect(self, start: FloatArray, end: FloatArray) -> list[FloatArray] | None:
        """RRT-Connect: two trees grow towards draws and each other (Kuffner and LaValle 2000)."""
        low = np.maximum(np.minimum(start, end) - _ASIDE_RAD, self._lower)
        high = np.minimum(np.maximum(start, end) + _ASIDE_RAD, self._upper)
        trees = (_Tree(start), _Tree(end))
        for draw in range(_DRAWS):
            near, far = trees if draw % 2 == 0 else trees[::-1]
            grown = near.grow(self._rng.uniform(low, high), 1, self._collisions)
            if grown is None:
                continue
            met = far.grow(near.postures[grown], _DRAWS, self._collisions)
            if met is not None and np.array_equal(far.postures[met], near.postures[grown]):
                path = near.to_root(grown)[::-1] + far.to_root(met)[1:]
                return path if near is trees[0] else path[::-1]
        return None


@dataclass(frozen=True, eq=False)
class Route:
    """Path through the stops, straight in joint space between its postures."""

    order: tuple[int, ...]  # (k,) rows of the stops in driving order.
    # Via postures (j, n) before each stop, j often 0; the first is from the start where one was
    # given, and absent otherwise.
    segments: tuple[FloatArray, ...]
    length_rad: float  # Length of the path, as the sum of its segments' norms.
    # Rows to which no safe path was found, with the pair of bodies that collides.
    unreachable: Mapping[int, str]


def left_candidates(
    q: FloatArray, left: IntArray, chosen: IntArray, route: Route, *, missed_only: bool
) -> IntArray:
    """Candidates from which to choose again, where a route misses chosen stops.

    Args:
        q: (k, n) joint angles of all candidates [rad].
        left: Rows of the candidates.
        chosen: (s,) rows of the stops.
        route: The path through the stops.
        missed_only: Whether only the missed stops go. Otherwise all nearer to these than to reached
            ones go, too, since another in the same part of the workspace would replace each.
    """
    missed = chosen[list(route.unreachable)]
    reached = np.setdiff1d(chosen, missed)
    if not missed_only and len(reached):
        to_missed, to_reached = (
            np.linalg.norm(q[left][:, None] - q[rows], axis=2).min(axis=1)
            for rows in (missed, reached)
        )
        missed = left[to_missed < to_reached]
    return np.setdiff1d(left, missed)


def order_stops(cell: AnyCell, start_q: FloatArray | None, q: FloatArray, seed: int = 0) -> Route:
    """Orders stops for a short path of the joints, and finds collision-free segments.

    The order is that of nearest neighbours, improved by reversals (Croes 1958, 2-opt). Each segment
    is straight in joint space, or a detour around obstacles.

    Args:
        cell: The cell.
        start_q: (n,) joint angles of the arm before [rad]; None to begin at any stop.
        q: (k, n) joint angles of the stops [rad], free of collisions as from `candidates`.
        seed: Random seed of the detours.

    Returns:
        The path. Stops that cannot be reached safely are left out and named.

    Raises:
        DataError: The start violates the clearance.
    """
    collisions = cell.collisions()
    if start_q is not None and (contact := int(collisions.first_contact(start_q[None])[0])) >= 0:
        first_body, second_body = collisions.names[contact]
        apart_m, needed_m = collisions.distances(start_q)[contact], collisions.needed_m()[contact]
        raise DataError(
            f"plan: where the arm starts, {first_body} and {second_body} are {1e3 * apart_m:.0f} "
            f"mm apart, but must be {1e3 * needed_m:.0f} mm and a little more.",
            culprits=[first_body, second_body],
            next_step="Drive the arm clear by hand, or begin the plan at its first stop. The "
            f"clearance is {1e3 * cell.limits.clearance_m:.0f} mm.",
        )
    detours = _Detours(cell, collisions, seed)
    best: _Tour | None = None
    first = int(np.linalg.norm(q - np.median(q, axis=0), axis=1).argmax()) if len(q) else 0
    for _ in range(1 if start_q is not None else 3):
        order = short_order(start_q, q, first)
        tour = _Tour(detours, start_q, q)
        tour.walk(order)
        if best is None or len(tour.order) > len(best.order):
            best = tour
        # A tour that reaches so few stops is started at another one.
        if len(best.order) > 0.5 * len(q):
            break
        first = next((row for row in order if row not in best.order), first)
    if best is None:
        return Route((), (), 0.0, {})
    return best.route(collisions)


class _Tour:
    """Path that is extended stop by stop."""

    def __init__(self, detours: _Detours, start_q: FloatArray | None, q: FloatArray) -> None:
        self.order: list[int] = []
        self._detours, self._start, self._q = detours, start_q, q
        # Path to each stop of the order; None for the first where there is no start.
        self._paths: list[FloatArray | None] = []
        self._blocked: dict[int, int] = {}

    def walk(self, order: Sequence[int]) -> None:
        """Inserts stops in an order, and tries those again that were not reached at first."""
        postponed = [row for row in order if not self._insert(row, len(self.order))]
        for row in postponed:
            apart = [float(np.linalg.norm(self._q[index] - self._q[row])) for index in self.order]
            # After its nearest neighbours, or before them.
            places = [place + after for place in np.argsort(apart)[:3] for after in (1, 0)]
            any(self._insert(row, int(place)) for place in dict.fromkeys(places))

    def route(self, collisions: Collisions) -> Route:
        """The finished path."""
        segments = tuple(path for path in self._paths if path is not None)
        length = 0.0
        for place, path in enumerate(self._paths):
            previous = self._before(place)
            if previous is not None and path is not None:
                postures = np.vstack([previous, path, self._q[self.order[place]]])
                length += float(np.linalg.norm(np.diff(postures, axis=0), axis=1).sum())
        missing = [row for row in self._blocked if row not in self.order]
        words = {row: " and ".join(collisions.names[self._blocked[row]]) for row in missing}
        return Route(tuple(self.order), segments, length, words)

    def _insert(self, row: int, place: int) -> bool:
        """Inserts a stop at a place of the order if there are paths to it and from it."""
        previous, goal = self._before(place), self._q[row]
        path = None if previous is None else self._path(previous, goal, row)
        if previous is not None and path is None:
            return False
        if place < len(self.order):
            next_way = self._path(goal, self._q[self.order[place]], row)
            if next_way is None:
                return False
            self._paths[place] = next_way
        self.order.insert(place, row)
        self._paths.insert(place, path)
        return True

    def _path(self, start: FloatArray, end: FloatArray, row: int) -> FloatArray | None:
        path = self._detours.path(start, end)
        if isinstance(path, int):
            self._blocked[row] = path
            return None
        return path

    def _before(self, place: int) -> FloatArray | None:
        """Posture before a place of the order; None at the start where none is given."""
        return self._q[self.order[place - 1]] if place else self._start


def short_order(start: FloatArray | None, stops: FloatArray, first: int) -> list[int]:
    """Order with a short path: nearest neighbours, improved by reversals.

    Args:
        start: (n,) joints or a place to start from, in any unit; None to start at a stop.
        stops: (k, n) joints or places.
        first: Row of that stop.

    Returns:
        (k,) rows of the stops.
    """
    points = stops if start is None else np.vstack([stops, start])
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    order = [first if start is None else len(stops)]
    remaining = set(range(len(stops))) - set(order)
    while remaining:
        last = order[-1]
        order.append(min(remaining, key=lambda row: distance[last, row]))
        remaining.remove(order[-1])
    tour = np.array(order)
    for _ in range(50):
        gained = False
        for i in range(1, len(tour) - 1):
            # Reversing i..j changes the segments into i and out of j; there is none out of the end.
            ends = tour[i + 1 :]
            after = np.append(tour[i + 2 :], -1)
            onward = np.where(after >= 0, distance[ends, after] - distance[tour[i], after], 0.0)
            gain = distance[tour[i - 1], tour[i]] - distance[tour[i - 1], ends] + onward
            j = int(gain.argmax())
            # Less is rounding [rad, m].
            if gain[j] > 1e-9:
                tour[i : i + 2 + j] = tour[i : i + 2 + j][::-1].copy()
                gained = True
        if not gained:
            break
    return [int(row) for row in tour if row < len(stops)]

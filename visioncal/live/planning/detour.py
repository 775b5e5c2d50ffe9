"""Ways around what stands between two postures."""

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.live.planning.cell import PlanCell
from visioncal.robot.collision import Collisions

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
        trees = (_Tree(start), _Tree(end))
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

    def _grow(self, tree: "_Tree", goal: FloatArray, steps: int) -> int | None:
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
            clear = (it for it in ahead if self._collisions.on_the_way(way[at], way[it]) < 0)
            at = next(clear, at + 1)
            kept.append(at)
        return np.asarray(way[kept])


class _Tree:
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
        return np.array([self.postures[it] for it in way])

"""Ways through the tree from observer to observed, all of one kind worked on at once."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import adjoint, exp, invert
from visioncal.core.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Stride:
    """One step of m ways, each by its own edge.

    Attributes:
        is_up: Whether the edges are gone against their own sense.
        edges: (m,) which unknown edges they are; empty where they are known, or a robot's.
        poses: (m, 4, 4) what they are in the sense in which they are gone, where they are known, or
            a robot's.
        moves: (m, 6, k) how they move with all effects; None where they do not.
        slots: (m,) in which place of its unit's errors a robot's flange errs; -1 where it does not.
    """

    is_up: bool
    edges: IntArray
    poses: FloatArray
    moves: FloatArray | None
    slots: IntArray

    def backward(self, edges: FloatArray, change: FloatArray) -> FloatArray:
        """(m, 4, 4) the inverse of the edges as they are gone, effects having changed by (k,)."""
        if len(self.edges):
            found = edges[self.edges]
            return found if self.is_up else invert(found)
        if self.moves is None or not change.any():
            return self.poses
        moved = exp((-1.0 if not self.is_up else 1.0) * (self.moves @ change))
        return np.asarray(self.poses @ moved if self.is_up else moved @ self.poses)


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways of m observations that are made of the same kinds of steps.

    Attributes:
        rows: (m,) the observations, group by group.
        groups: Which groups of observations these are, and where their rows stand among them.
        strides: The steps, from the observer on.
    """

    rows: IntArray
    groups: tuple[tuple[int, slice], ...]
    strides: tuple[Stride, ...]

    def backward(self, edges: FloatArray, change: FloatArray) -> FloatArray:
        """(m, 4, 4) `observed_from_observer`."""
        found = np.broadcast_to(np.eye(4), (len(self.rows), 4, 4))
        for it in reversed(self.strides):
            found = found @ it.backward(edges, change)
        return found

    def moved(self, edges: FloatArray, change: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """What `backward` gives, and (m, 6, 6) how the observed frames move with each step's edges.

        An edge moves on its right: at its end, or at its start where it is gone up.
        """
        back, found = np.broadcast_to(np.eye(4), (len(self.rows), 4, 4)), []
        for it in reversed(self.strides):
            behind, back = back, back @ it.backward(edges, change)
            counts = len(it.edges) or it.moves is not None or (it.slots >= 0).any()
            none = np.zeros((len(self.rows), 6, 0))
            found.append((-adjoint(back) if it.is_up else adjoint(behind)) if counts else none)
        return back, found[::-1]

"""The frames of a whole cell as a tree, and the way from any of them to any other.

Every frame hangs on its parent by an edge that is unknown, known, or a robot. Frames that no robot
parts are one body: what stands in the cell, and what each flange carries. Ways of one kind, from
observers to what they observed, are worked on at once.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import adjoint, exp, invert
from visioncal.core.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Branch:
    """How a frame hangs on its parent: by neither a robot nor a known transform, it is unknown.

    Attributes:
        parent: The frame that it hangs on.
        robot: The robot whose pose `parent_from_frame` is; empty where none is.
        known: (4, 4) `parent_from_frame`, where that is known.
    """

    parent: str
    robot: str = ""
    known: FloatArray | None = None

    @property
    def is_unknown(self) -> bool:
        """Whether it is to be estimated."""
        return not self.robot and self.known is None


@dataclass(frozen=True)
class PathStep:
    """One edge of a way through the tree.

    Attributes:
        frame: The child at its end, which it is named by.
        robot: The robot that it is; empty where it is none.
        is_up: Whether it is gone from the parent to the child's frame against the edge's own sense:
            as `frame_from_parent`.
    """

    frame: str
    robot: str
    is_up: bool


@dataclass(frozen=True, eq=False)
class Tree:
    """The frames of a cell.

    Attributes:
        root: The frame that hangs on nothing.
        branches: How every other frame hangs, by its name.
    """

    root: str
    branches: Mapping[str, Branch]

    @property
    def unknown(self) -> tuple[str, ...]:
        """The frames whose edges are unknown, in the tree's order."""
        return tuple(name for name, branch in self.branches.items() if branch.is_unknown)

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots, in the tree's order."""
        return tuple(self.flanges)

    @property
    def flanges(self) -> dict[str, str]:
        """The frame of each robot's flange."""
        return {branch.robot: name for name, branch in self.branches.items() if branch.robot}

    @property
    def bases(self) -> dict[str, str]:
        """The frame of each robot's base."""
        return {branch.robot: branch.parent for branch in self.branches.values() if branch.robot}

    def with_known(self, frame: str, matrix: FloatArray) -> "Tree":
        """Returns the tree with one edge that is no longer asked for."""
        branch = replace(self.branches[frame], known=matrix)
        return replace(self, branches={**self.branches, frame: branch})

    def without(self, frames: Collection[str]) -> "Tree":
        """Returns the tree without some frames, and without all that hangs on these."""
        kept = {
            name: branch
            for name, branch in self.branches.items()
            if not any(above in frames for above in self.above(name))
        }
        return replace(self, branches=kept)

    def with_twin(self, frame: str, twin: str) -> "Tree":
        """Returns the tree with one more frame that hangs where another does, by its own edge."""
        branch = Branch(self.branches[frame].parent)
        return replace(self, branches={**self.branches, twin: branch})

    def above(self, frame: str) -> Iterator[str]:
        """A frame, and all that it hangs on in turn."""
        while frame != self.root:
            yield frame
            frame = self.branches[frame].parent
        yield frame

    def body(self, frame: str) -> str:
        """The frame that a frame's body is named by: the root, or a flange."""
        return next(
            name for name in self.above(frame) if name == self.root or self.branches[name].robot
        )

    def path(self, start: str, end: str) -> tuple[PathStep, ...]:
        """The edges whose product is `start_from_end`, first to last."""
        up, down = list(self.above(start)), list(self.above(end))
        while up and down and up[-1] == down[-1]:
            up.pop()
            down.pop()
        return (
            *(PathStep(name, self.branches[name].robot, True) for name in up),
            *(PathStep(name, self.branches[name].robot, False) for name in reversed(down)),
        )


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
class TreePaths:
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
        for stride in reversed(self.strides):
            found = found @ stride.backward(edges, change)
        return found

    def moved(self, edges: FloatArray, change: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """What `backward` gives, and (m, 6, 6) how the observed frames move with each step's edges.

        An edge moves on its right: at its end, or at its start where it is gone up.
        """
        back, found = np.broadcast_to(np.eye(4), (len(self.rows), 4, 4)), []
        for stride in reversed(self.strides):
            behind, back = back, back @ stride.backward(edges, change)
            counts = len(stride.edges) or stride.moves is not None or (stride.slots >= 0).any()
            none = np.zeros((len(self.rows), 6, 0))
            found.append((-adjoint(back) if stride.is_up else adjoint(behind)) if counts else none)
        return back, found[::-1]

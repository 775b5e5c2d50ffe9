"""Frame tree of a cell, and the paths between its frames.

Every frame is attached to its parent by an edge that is unknown, known, or a robot. Frames with no
robot between form one body: the stationary frames, and those on each flange. Paths of one
structure, from observers to observed frames, are evaluated together.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import adjoint, exp, invert
from visioncal.core.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Branch:
    """Edge from a frame to its parent; unknown if neither a robot nor a known transform."""

    parent: str  # The parent frame.
    robot: str = ""  # The robot whose pose `parent_from_frame` is; empty where none is.
    known: FloatArray | None = None  # (4, 4) `parent_from_frame`, if known.

    @property
    def is_unknown(self) -> bool:
        """Whether it is estimated."""
        return not self.robot and self.known is None


@dataclass(frozen=True)
class PathStep:
    """One edge of a path through the tree."""

    frame: str  # The edge's child frame, which names it.
    robot: str  # The edge's robot; empty for none.
    is_up: bool  # Whether it is traversed from the child to the parent, as `frame_from_parent`.


@dataclass(frozen=True, eq=False)
class Tree:
    """The frames of a cell."""

    root: str  # The frame without a parent.
    branches: Mapping[str, Branch]  # Edge of every other frame, by its name.

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
        """Returns the tree with one edge held at a known transform."""
        branch = replace(self.branches[frame], known=matrix)
        return replace(self, branches={**self.branches, frame: branch})

    def without(self, frames: Collection[str]) -> "Tree":
        """Returns the tree without some frames and their descendants."""
        kept = {
            name: branch
            for name, branch in self.branches.items()
            if not any(above in frames for above in self.above(name))
        }
        return replace(self, branches=kept)

    def with_twin(self, frame: str, twin: str) -> "Tree":
        """Returns the tree with one more frame on the parent of another, by an unknown edge."""
        edge = Branch(self.branches[frame].parent)
        return replace(self, branches={**self.branches, twin: edge})

    def above(self, frame: str) -> Iterator[str]:
        """A frame and its ancestors, up to the root."""
        while frame != self.root:
            yield frame
            frame = self.branches[frame].parent
        yield frame

    def body(self, frame: str) -> str:
        """The frame that names a frame's body: the root, or a flange."""
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
    """One step of m paths, each by its own edge."""

    is_up: bool  # Whether the edges are traversed from child to parent.
    edges: IntArray  # (m,) indices of unknown edges; empty for known edges and robots.
    # (m, 4, 4) transforms in the direction of the path, for known edges and robots.
    poses: FloatArray
    moves: FloatArray | None  # (m, 6, k) their Jacobian by all effects; None for zero.
    slots: IntArray  # (m,) index of a robot's flange error within its unit; -1 for none.

    def backward(self, edges: FloatArray, change: FloatArray) -> FloatArray:
        """(m, 4, 4) inverse transforms of the step, after a change (k,) of the effects."""
        if len(self.edges):
            edge = edges[self.edges]
            return edge if self.is_up else invert(edge)
        if self.moves is None or not change.any():
            return self.poses
        motion = exp((-1.0 if not self.is_up else 1.0) * (self.moves @ change))
        return np.asarray(self.poses @ motion if self.is_up else motion @ self.poses)


@dataclass(frozen=True, eq=False)
class TreePaths:
    """Paths of m observations with the same structure."""

    rows: IntArray  # (m,) the observations, group by group.
    # Indices of the groups of observations, and their slices of the rows.
    groups: tuple[tuple[int, slice], ...]
    strides: tuple[Stride, ...]  # The steps, from the observer on.

    def backward(self, edges: FloatArray, change: FloatArray) -> FloatArray:
        """(m, 4, 4) `observed_from_observer`."""
        product = np.broadcast_to(np.eye(4), (len(self.rows), 4, 4))
        for stride in reversed(self.strides):
            product = product @ stride.backward(edges, change)
        return product

    def moved(self, edges: FloatArray, change: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """`backward`, and (m, 6, 6) Jacobians of the observed frames by each step's edges.

        An edge is perturbed on its right: at its end, or at its start where it is traversed up.
        """
        back, jacobians = np.broadcast_to(np.eye(4), (len(self.rows), 4, 4)), []
        for stride in reversed(self.strides):
            before, back = back, back @ stride.backward(edges, change)
            varies = len(stride.edges) or stride.moves is not None or (stride.slots >= 0).any()
            none = np.zeros((len(self.rows), 6, 0))
            jacobians.append(
                (-adjoint(back) if stride.is_up else adjoint(before)) if varies else none
            )
        return back, jacobians[::-1]

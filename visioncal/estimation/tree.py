"""The frames of a whole cell as a tree, and the way from any of them to any other.

Every frame hangs on its parent by an edge that is unknown, known, or a robot. Frames that no robot
parts are one body: what stands in the cell, and what each flange carries.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

from visioncal.core.types import FloatArray


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
class Step:
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
        return tuple(name for name, it in self.branches.items() if it.is_unknown)

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots, in the tree's order."""
        return tuple(it.robot for it in self.branches.values() if it.robot)

    def with_known(self, frame: str, matrix: FloatArray) -> "Tree":
        """Returns the tree with one edge that is no longer asked for."""
        branch = replace(self.branches[frame], known=matrix)
        return replace(self, branches={**self.branches, frame: branch})

    def without(self, frames: Collection[str]) -> "Tree":
        """Returns the tree without some frames, and without all that hangs on these."""
        kept = {
            name: branch
            for name, branch in self.branches.items()
            if not any(it in frames for it in self.above(name))
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
        return next(it for it in self.above(frame) if it == self.root or self.branches[it].robot)

    def path(self, start: str, end: str) -> tuple[Step, ...]:
        """The edges whose product is `start_from_end`, first to last."""
        up, down = list(self.above(start)), list(self.above(end))
        while up and down and up[-1] == down[-1]:
            up.pop()
            down.pop()
        return (
            *(Step(it, self.branches[it].robot, True) for it in up),
            *(Step(it, self.branches[it].robot, False) for it in reversed(down)),
        )

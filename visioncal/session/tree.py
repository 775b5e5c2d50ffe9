"""Frame tree of a cell, and the paths between its frames.

Every frame is attached to its parent by an edge that is unknown, known, or a robot. Frames with no
robot between form one body: the stationary frames, and those on each flange.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import FloatArray


@dataclass(frozen=True, eq=False)
class Branch:
    """Edge from a frame to its parent; unknown if neither a robot nor a known transform."""

    parent: str  # The parent frame.
    robot: str = ""  # The robot whose pose `parent_from_frame` is; empty where none is.
    known: FloatArray | None = None  # (4, 4) `parent_from_frame`, if known.

    @property
    def is_unknown(self) -> bool:
        """Whether the edge is estimated."""
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


def check_prior(name: str, first: str, second: str, tree: Tree) -> None:
    """Refuses the prior of a frame in another that has no fixed place in it.

    Raises:
        DataError: A frame is unknown, or a robot moves one of the two relative to the other.
    """
    label = f"session.toml: prior.{name}"
    for frame in (first, second):
        if frame not in tree.branches:
            names = list(tree.branches)
            raise DataError(
                f"{label}: {frame!r} must be a frame of this cell: {', '.join(names)}.",
                culprits=[label],
                next_step=did_you_mean(frame, names)
                or "Name a prior A_from_B, as [prior.flange_a_from_cam_left].",
            )
    moved_by = [step.robot for step in tree.path(first, second) if step.robot]
    if moved_by or first == second:
        why = f"robot {moved_by[0]} moves one before the other" if moved_by else "they are one"
        raise DataError(
            f"{label}: {first} and {second} have no fixed place in each other: {why}.",
            culprits=[label],
            next_step="State where two frames are that stand in the cell, or on one flange.",
        )

"""The frames of a result: where any of them is in any other, with its covariance."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.tree import Branch, PathStep, Tree
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame
from visioncal.session.frames import CELL


@dataclass(frozen=True, eq=False)
class FrameTree:
    """What hangs on what, and how.

    Attributes:
        reference: The frame that stands for the cell: the cell's frame is its.
        parents: What each frame hangs on, by its name.
        flanges: The robot of each flange, by the flange's frame.
        edges: The estimated transforms by name, as `cell_from_base_b`.
        joint_covariance: (6 k, 6 k) covariance of all of them together, in their order.
        placed: Tools and fixtures by the transform that places them, as `flange_a_from_tool`.
        former: Frames as they hung before they moved.
    """

    reference: str
    parents: Mapping[str, str]
    flanges: Mapping[str, str]
    edges: Mapping[str, Edge]
    joint_covariance: FloatArray
    placed: Mapping[str, Frame]
    former: frozenset[str] = frozenset()

    @property
    def last(self) -> dict[str, str]:
        """What each frame hangs on, as they hung last."""
        return {name: on for name, on in self.parents.items() if name not in self.former}

    def edge_of(self, frame: str) -> Edge:
        """How a frame hangs on its parent; the reference, exactly in the cell's place."""
        if frame == self.reference:
            return Edge(np.eye(4), np.zeros((6, 6)))
        return self.edges[f"{self.parents[frame]}_from_{frame}"]

    def between(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> Edge:
        """Places any frame in any other; see `Calibration.between`.

        Raises:
            DataError: There is no such frame, or a robot's pose is needed.
        """
        near, far = self.placement(first), self.placement(second)
        matrix, slope = self.way(near[0] if near else first, far[0] if far else second, poses)
        covariance = slope @ self.joint_covariance @ slope.T
        if far:
            carry = adjoint(invert(far[1].edge.matrix))
            matrix = matrix @ far[1].edge.matrix
            covariance = carry @ covariance @ carry.T + far[1].edge.covariance
        if near:
            matrix = invert(near[1].edge.matrix) @ matrix
            carry = adjoint(invert(matrix))
            covariance = covariance + carry @ near[1].edge.covariance @ carry.T
        if not all(pair[1].oriented for pair in (near, far) if pair):
            covariance[:3], covariance[:, :3] = 0.0, 0.0
        return Edge(matrix, covariance)

    def placement(self, name: str) -> tuple[str, Frame] | None:
        """The frame in which a tool or a fixture was placed, and its place; None for no such."""
        for transform, frame in self.placed.items():
            parent, _, child = transform.partition("_from_")
            if child == name:
                return parent, frame
        return None

    def way(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """The transform of `between`, (4, 4), and (6, 6 k) how it moves with all edges."""
        tree, poses = self._tree, poses or {}
        for frame in (first, second):
            if frame != tree.root and frame not in tree.branches:
                placed = (name.partition("_from_")[2] for name in self.placed)
                known = [tree.root, *tree.branches, *placed]
                raise DataError(
                    f"no frame {frame!r}: this result has {', '.join(known)}.",
                    culprits=[frame],
                    next_step=did_you_mean(frame, known),
                )
        way, places = tree.path(first, second), {edge: at for at, edge in enumerate(self.edges)}
        rest, slope = np.eye(4), np.zeros((6, 6 * len(places)))
        for step in reversed(way):
            edge = self._matrix(step, poses)
            before = invert(edge) @ rest if step.is_up else edge @ rest
            moved = -adjoint(invert(before)) if step.is_up else adjoint(invert(rest))
            at = places.get(f"{self.parents[step.frame]}_from_{step.frame}")
            if at is not None:
                slope[:, 6 * at : 6 * at + 6] += moved
            rest = before
        return rest, slope

    @cached_property
    def _tree(self) -> Tree:
        branches = {
            name: Branch(on, self.flanges.get(name, "")) for name, on in self.parents.items()
        }
        return Tree(CELL, branches)

    def _matrix(self, step: PathStep, poses: Mapping[str, FloatArray]) -> FloatArray:
        if not step.robot:
            return self.edge_of(step.frame).matrix
        if step.robot not in poses:
            raise DataError(
                f"{step.frame} moves with robot {step.robot!r}: its pose is needed.",
                culprits=[step.frame],
                next_step="Name frames that no robot moves against each other; or in Python, give "
                f'poses={{"{step.robot}": base_from_flange}}.',
            )
        return np.asarray(poses[step.robot], dtype=float)

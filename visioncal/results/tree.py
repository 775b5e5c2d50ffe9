"""Tree of a result's frames: transforms between any two, with covariance."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame
from visioncal.session.frames import CELL
from visioncal.session.tree import Branch, PathStep, Tree


@dataclass(frozen=True, eq=False)
class FrameTree:
    """Tree of frames with the estimated transforms."""

    reference: str  # The frame that defines the cell's frame.
    parents: Mapping[str, str]  # Parent of each frame, by name.
    flanges: Mapping[str, str]  # Robot of each flange, by the flange's frame.
    edges: Mapping[str, Edge]  # Estimated transforms by name, as `cell_from_base_b`.
    joint_covariance: FloatArray  # (6 k, 6 k) joint covariance of these, in their order.
    placed: Mapping[str, Frame]  # Tools and fixtures by transform name, as `flange_a_from_tool`.
    former: frozenset[str] = frozenset()  # Frames at the poses before they moved.

    @property
    def last(self) -> dict[str, str]:
        """Parent of each frame, without former places of frames that moved."""
        return {name: parent for name, parent in self.parents.items() if name not in self.former}

    def edge_of(self, frame: str) -> Edge:
        """Transform of a frame in its parent; identity for the reference."""
        if frame == self.reference:
            return Edge(np.eye(4), np.zeros((6, 6)))
        return self.edges[f"{self.parents[frame]}_from_{frame}"]

    def between(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> Edge:
        """Transform between any two frames; see `Calibration.between`; raises DataError."""
        near, far = self.placement(first), self.placement(second)
        matrix, jacobian = self.compose(
            near[0] if near else first, far[0] if far else second, poses
        )
        covariance = jacobian @ self.joint_covariance @ jacobian.T
        if far:
            transport = adjoint(invert(far[1].edge.matrix))
            matrix = matrix @ far[1].edge.matrix
            covariance = transport @ covariance @ transport.T + far[1].edge.covariance
        if near:
            matrix = invert(near[1].edge.matrix) @ matrix
            transport = adjoint(invert(matrix))
            covariance = covariance + transport @ near[1].edge.covariance @ transport.T
        if not all(pair[1].oriented for pair in (near, far) if pair):
            covariance[:3], covariance[:, :3] = 0.0, 0.0
        return Edge(matrix, covariance)

    def placement(self, name: str) -> tuple[str, Frame] | None:
        """Parent and frame of a tool or fixture; None where there is none of that name."""
        for transform, frame in self.placed.items():
            parent, _, child = transform.partition("_from_")
            if child == name:
                return parent, frame
        return None

    def compose(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Transform of `between` without tools and fixtures, (4, 4), and its Jacobian (6, 6 k)."""
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
        index_of = {edge: at for at, edge in enumerate(self.edges)}
        rest, jacobian = np.eye(4), np.zeros((6, 6 * len(index_of)))
        for step in reversed(tree.path(first, second)):
            edge = self._matrix(step, poses)
            before = invert(edge) @ rest if step.is_up else edge @ rest
            by_edge = -adjoint(invert(before)) if step.is_up else adjoint(invert(rest))
            at = index_of.get(f"{self.parents[step.frame]}_from_{step.frame}")
            if at is not None:
                jacobian[:, 6 * at : 6 * at + 6] += by_edge
            rest = before
        return rest, jacobian

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
                f"{step.frame} moves with robot {step.robot!r}, whose pose must be given.",
                culprits=[step.frame],
                next_step="Name frames that no robot moves against each other; or in Python, give "
                f'poses={{"{step.robot}": base_from_flange}}.',
            )
        return np.asarray(poses[step.robot], dtype=float)

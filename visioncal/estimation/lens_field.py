"""Lens errors beyond the model, as random effects: a smooth field, and varying focus.

A corner is displaced by `(b (d / d0 - 1) + j) (px - centre) + field(px)`: b is focus breathing, by
the view's distance d over the mean one, j is focus jitter, one per view, and the field is a
Gaussian process over the image with a squared exponential kernel of one length. Each has zero mean
and a size of its own, which `lens_levels` estimates. Sizes are in units of the corners' noise:
corners with these effects still have 1 px noise.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.linalg import gram

# Grid points per axis for the field's modes, and the share of its variance they keep.
_POINTS, _KEPT = 64, 0.99
# Combinations that move all poses together by less than this share of a pose's variance are
# neglected.
_MOVED = 1e-2


@dataclass(frozen=True)
class LensLevels:
    """Sizes of the lens errors beyond the model, over the noise of a corner's coordinate."""

    field: float = 0.0  # Standard deviation of the field, per axis.
    length: float = 0.2  # The field's length, as a share of the image's width.
    breathing: float = 0.0  # Relative change of the focal length as the distance doubles [1/px].
    jitter: float = 0.0  # Relative change of the focal length from view to view [1/px].
    # Fall of twice the log-likelihood without each of the three.
    gains: tuple[float, float, float] = (0.0, 0.0, 0.0)


def field_modes(px: FloatArray, resolution: tuple[int, int], length: float) -> FloatArray:
    """Modes of a unit field along one axis of the image; those along the other are equal.

    Args:
        px: (n, 2) corners [px].
        resolution: (width, height) of the image [px].
        length: The field's length, as a share of the width.

    Returns:
        (n, e) displacements for coefficients of variance one.
    """
    scale = length * resolution[0]
    (by_x, size_x), (by_y, size_y) = (
        _modes(at, extent / scale) for at, extent in zip(px.T / scale, resolution, strict=True)
    )
    sizes = np.outer(size_x, size_y)
    order = np.argsort(-sizes, axis=None, kind="stable")
    enough = int(np.searchsorted(np.cumsum(sizes.ravel()[order]), _KEPT * sizes.sum())) + 1
    at_x, at_y = np.unravel_index(order[:enough], sizes.shape)
    return np.asarray(by_x[:, at_x] * by_y[:, at_y])


def _modes(at: FloatArray, extent: float) -> tuple[FloatArray, FloatArray]:
    """Modes along one axis at (n,) positions in units of the length, and their variances."""
    grid, vectors, values = _grid_modes(extent)
    kernel = np.exp(-0.5 * (at[:, None] - grid) ** 2)
    return kernel @ (vectors / np.sqrt(values)), values / len(grid)


@cache
def _grid_modes(extent: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    grid = np.linspace(0.0, extent, _POINTS)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (grid[:, None] - grid) ** 2))
    kept = values > (1.0 - _KEPT) ** 2 * values[-1]
    # Fixed signs: stored coefficients are of the same modes on any machine.
    return grid, vectors[:, kept] * np.sign(vectors[0, kept]), values[kept]


def zooms(stack: CornerStack, camera: Camera) -> FloatArray:
    """(n, 2) derivative of the corners by the relative focal length [px]."""
    return np.asarray(stack.px - camera.matrix[2:])


def depths_m(stack: CornerStack, cam_from_target: FloatArray) -> FloatArray:
    """(v,) mean depths of the views' corners along the camera's axis [m]."""
    turned = cam_from_target[:, 2, :3][stack.view_of]
    depth = np.sum(turned * stack.points, axis=1)
    return np.asarray(stack.sum_by_view(depth) / stack.counts + cam_from_target[:, 2, 3])


def distances(stack: CornerStack, cam_from_target: FloatArray) -> FloatArray:
    """(v,) depths of the views over the mean one, less one."""
    far = depths_m(stack, cam_from_target)
    return np.asarray(far / far.mean() - 1.0)


def breathing_columns(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, size: float
) -> FloatArray:
    """(n, 2, 1) displacement by breathing of some size; (n, 2, 0) for size zero."""
    if size == 0.0:
        return np.zeros((len(stack.px), 2, 0))
    far = distances(stack, cam_from_target)[stack.view_of]
    return (size * far[:, None] * zooms(stack, camera))[:, :, None]


def displacements(
    px: FloatArray, camera: Camera, far: FloatArray | float, levels: LensLevels
) -> FloatArray:
    """Displacements by field and breathing, for coefficients of variance one.

    Args:
        px: (n, 2) pixels.
        camera: The lens.
        far: (n,) distances over the mean one, less one; or one for all.
        levels: The sizes.

    Returns:
        (n, 2, m) in the unit of the levels; breathing, if any, comes last.
    """
    columns = np.zeros((len(px), 2, 0))
    if levels.field > 0.0:
        modes = levels.field * field_modes(px, camera.resolution, levels.length)
        columns = np.einsum("ij,ne->nije", np.eye(2), modes).reshape(len(px), 2, -1)
    if levels.breathing > 0.0:
        share = levels.breathing * np.broadcast_to(far, len(px))
        breath = share[:, None] * (px - camera.matrix[2:])
        columns = np.concatenate([columns, breath[:, :, None]], axis=2)
    return columns


@dataclass(frozen=True, eq=False)
class Coefficients:
    """Estimated coefficients of variance one, in units of the corners' noise."""

    mean: FloatArray  # (m,) the most likely ones.
    slope: FloatArray  # (m, k) their derivative by the shared unknowns.
    moving_roots: FloatArray  # (m, o) roots of their covariance that move poses.
    rest: FloatArray  # (m, m - o) roots of the rest of it.
    freedom: float  # Number of coefficients that the corners determine.

    @classmethod
    def of(
        cls,
        information: FloatArray,
        between: FloatArray,
        gradient: FloatArray,
        by_coefficients: FloatArray,
        poses: FloatArray,
    ) -> "Coefficients":
        """Solves for the coefficients.

        Args:
            information: (m, m) of the corners alone, the poses eliminated.
            between: (m, k) that with the shared unknowns.
            gradient: (m,) of half the squared error.
            by_coefficients: (v, 6, m) derivative of the poses by the coefficients.
            poses: (v, 6, 6) information on the poses.
        """
        root = np.linalg.cholesky(information + np.eye(len(information)))
        both = np.column_stack([between, gradient, np.eye(len(root))])
        solved = np.linalg.solve(root.T, np.linalg.solve(root, both))
        inverse = solved[:, between.shape[1] + 1 :]
        inverse_root = np.linalg.inv(root).T
        pose_changes = by_coefficients @ inverse_root
        values, vectors = np.linalg.eigh(gram(pose_changes, poses @ pose_changes))
        visible = values > _MOVED
        return cls(
            -solved[:, between.shape[1]],
            -solved[:, : between.shape[1]],
            inverse_root @ vectors[:, visible],
            inverse_root @ vectors[:, ~visible],
            float(len(root) - np.trace(inverse)),
        )

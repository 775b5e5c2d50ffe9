"""What a lens does beyond its model, as random effects: a smooth field, and focus that changes.

A corner is displaced by `(b (d / d0 - 1) + j) (px - centre) + field(px)`: b is focus breathing, by
the view's distance d over the mean one, j is focus jitter, one a view, and the field is a Gaussian
process over the image, with a squared exponential of one length. Each has zero mean and a size of
its own, which `lens_levels` estimates. Sizes are in units of the corners' noise: with these, what
corners say stays that of corners of 1 px noise.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.linalg import gram

# Points an axis at which the field's modes are computed, and the share of its variance they keep.
_POINTS, _KEPT = 64, 0.99
# Directions that move all poses together by less than this share of a pose's variance move none.
_MOVED = 1e-2


@dataclass(frozen=True)
class LensLevels:
    """Sizes of what a lens does beyond its model, over the noise of a corner's coordinate.

    Attributes:
        field: Of the field, an axis; its standard deviation.
        length: The field's length, as a share of the image's width.
        breathing: Of the focal length's change as the distance doubles, as a share of it [1/px].
        jitter: And from view to view [1/px].
        gains: By how much twice the logarithm of the likelihood falls without each of the three.
    """

    field: float = 0.0
    length: float = 0.2
    breathing: float = 0.0
    jitter: float = 0.0
    gains: tuple[float, float, float] = (0.0, 0.0, 0.0)


def field_modes(px: FloatArray, resolution: tuple[int, int], length: float) -> FloatArray:
    """The modes of a field of size one, along one axis of the image: those of the other are alike.

    Args:
        px: (n, 2) corners [px].
        resolution: (width, height) of the image [px].
        length: The field's length, as a share of the width.

    Returns:
        (n, e) displacements by coefficients of variance one.
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
    """Modes along one axis at (n,) places in units of the length, and the variance of each."""
    grid, vectors, values = _grid_modes(extent)
    kernel = np.exp(-0.5 * (at[:, None] - grid) ** 2)
    return kernel @ (vectors / np.sqrt(values)), values / len(grid)


@cache
def _grid_modes(extent: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    grid = np.linspace(0.0, extent, _POINTS)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (grid[:, None] - grid) ** 2))
    kept = values > (1.0 - _KEPT) ** 2 * values[-1]
    # Signs are chosen: coefficients that were stored are of the same modes on any machine.
    return grid, vectors[:, kept] * np.sign(vectors[0, kept]), values[kept]


def zooms(stack: CornerStack, camera: Camera) -> FloatArray:
    """(n, 2) how corners move with the focal length, by a share of it [px]."""
    return np.asarray(stack.px - camera.matrix[2:])


def depths_m(stack: CornerStack, cam_from_target: FloatArray) -> FloatArray:
    """(v,) mean distances of the views' corners along the camera's axis [m]."""
    turned = cam_from_target[:, 2, :3][stack.view_of]
    depth = np.sum(turned * stack.points, axis=1)
    return np.asarray(stack.sum_by_view(depth) / stack.counts + cam_from_target[:, 2, 3])


def distances(stack: CornerStack, cam_from_target: FloatArray) -> FloatArray:
    """(v,) distances of the views' corners over the mean one, less one."""
    far = depths_m(stack, cam_from_target)
    return np.asarray(far / far.mean() - 1.0)


def breathing_columns(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, size: float
) -> FloatArray:
    """(n, 2, 1) what breathing of some size displaces; (n, 2, 0) where it has none."""
    if size == 0.0:
        return np.zeros((len(stack.px), 2, 0))
    far = distances(stack, cam_from_target)[stack.view_of]
    return (size * far[:, None] * zooms(stack, camera))[:, :, None]


def displacements(
    px: FloatArray, camera: Camera, far: FloatArray | float, levels: LensLevels
) -> FloatArray:
    """What field and breathing displace, by coefficients of variance one.

    Args:
        px: (n, 2) pixels.
        camera: The lens.
        far: (n,) distances over the mean one, less one; or one for all.
        levels: The sizes.

    Returns:
        (n, 2, m) in the unit of the levels; those of breathing, where it has a size, come last.
    """
    found = np.zeros((len(px), 2, 0))
    if levels.field > 0.0:
        modes = levels.field * field_modes(px, camera.resolution, levels.length)
        found = np.einsum("ij,ne->nije", np.eye(2), modes).reshape(len(px), 2, -1)
    if levels.breathing > 0.0:
        share = levels.breathing * np.broadcast_to(far, len(px))
        breath = share[:, None] * (px - camera.matrix[2:])
        found = np.concatenate([found, breath[:, :, None]], axis=2)
    return found


@dataclass(frozen=True, eq=False)
class Coefficients:
    """What corners say of coefficients of variance one, in units of the corners' noise.

    Attributes:
        mean: (m,) the most likely ones.
        slope: (m, k) how these move with what is shared.
        open: (m, o) roots of their covariance, as far as poses move with them.
        rest: (m, m - o) roots of what is left of it.
        freedom: How many of them the corners determine.
    """

    mean: FloatArray
    slope: FloatArray
    open: FloatArray
    rest: FloatArray
    freedom: float

    @classmethod
    def of(
        cls,
        information: FloatArray,
        between: FloatArray,
        gradient: FloatArray,
        by_coefficients: FloatArray,
        poses: FloatArray,
    ) -> "Coefficients":
        """Solves for them.

        Args:
            information: (m, m) of the corners alone, the poses being free.
            between: (m, k) that with what is shared.
            gradient: (m,) of half the squared error.
            by_coefficients: (v, 6, m) how poses move with them.
            poses: (v, 6, 6) information on these.
        """
        root = np.linalg.cholesky(information + np.eye(len(information)))
        both = np.column_stack([between, gradient, np.eye(len(root))])
        solved = np.linalg.solve(root.T, np.linalg.solve(root, both))
        inverse = solved[:, between.shape[1] + 1 :]
        inward = np.linalg.inv(root).T
        moved = by_coefficients @ inward
        values, vectors = np.linalg.eigh(gram(moved, poses @ moved))
        moving = values > _MOVED
        return cls(
            -solved[:, between.shape[1]],
            -solved[:, : between.shape[1]],
            inward @ vectors[:, moving],
            inward @ vectors[:, ~moving],
            float(len(root) - np.trace(inverse)),
        )

"""Windows of pixels around corners, with their maps to the board, and Gauss-Newton steps."""

from dataclasses import dataclass, fields
from functools import cache
from typing import Self

import cv2
import numpy as np

from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.vision.boards.maps import OpticalAxis, maps_about
from visioncal.vision.boards.prints import Float32Array, Print

# Sigma of the smoothing [px].
SMOOTH_PX = 0.7
# Least half-width of the patch around a corner [px].
_LEAST_PX = 3.0
# Nodes per axis of the polynomial that interpolates a map over a window. With cubics, a fisheye's
# slanted circles would err by up to 0.35 px.
_NODES = 6


@dataclass(frozen=True, eq=False)
class Windows:
    """Pixels around n corners, and the maps from there to the board."""

    px: FloatArray  # (n, 2) corner positions at which the maps were made [px].
    axis: OpticalAxis | None  # The lens's axis with the distortion that the maps remove.
    # (n, 2, 2) Jacobian of pixels with respect to the board position [px/square].
    jacobian: FloatArray
    widths: FloatArray  # (n, 2) squares per pixel, across the lines of constant x and y.
    x: Float32Array  # (n, h, w) x of each pixel on the board, relative to the corner [squares].
    y: Float32Array  # (n, h, w) y, likewise.
    grey: Float32Array  # (n, h, w) the smoothed image, less 128.
    within: Mask  # (n, h, w) mask of a corner's patch.
    inside: Mask  # (n, h, w) mask of pixels inside the image.
    neighbours: IntArray  # (n, k) neighbours of each corner.
    smoother: FloatArray  # (n, 10, k) operators from neighbours' values to polynomial coefficients.

    @classmethod
    def cut(
        cls,
        smooth: Float32Array,
        board: FloatArray,
        px: FloatArray,
        good: Mask,
        chosen: IntArray,
        pattern: Print,
        axis: OpticalAxis | None,
    ) -> Self:
        """Cuts the windows of the chosen corners; the good corners determine the maps."""
        on_board, neighbours, smoother, axis = maps_about(board, px, good, chosen, axis)
        axes = np.eye(2) if pattern.axes is None else pattern.axes[chosen]

        def on_window(places: FloatArray) -> FloatArray:
            return np.asarray(on_board(places) @ np.swapaxes(axes, -1, -2))

        start = px[chosen]
        ends = on_window(start[:, None] + 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
        jacobian_px = np.stack([ends[:, 0] - ends[:, 1], ends[:, 2] - ends[:, 3]], axis=2)
        jacobian = np.asarray(np.linalg.inv(jacobian_px), float)
        side_px = np.sqrt(np.abs(np.linalg.det(jacobian)))
        radii = None if pattern.radii is None else pattern.radii[chosen]
        # Half-width of a patch [px]; a circle needs its whole edge.
        most = 20.0 if radii is None else np.inf
        half = np.clip(pattern.half, _LEAST_PX / side_px, most / side_px)
        if radii is not None:
            # Text may be near: a share of the radius, and at least [px].
            around_px = np.maximum(0.35 * radii * side_px, 4.0)
            half = np.minimum(half, radii + around_px / side_px)
        needed_px = float(np.max(half * np.abs(jacobian).sum(axis=2).max(axis=1)))
        # Limits memory and time for many corners.
        affordable = max(_LEAST_PX, (np.sqrt(600_000 / len(chosen)) - 1.0) / 2.0)
        reach = int(np.ceil(min(most, affordable, needed_px)))
        steps = np.arange(-reach, reach + 1)
        centre = np.rint(start).astype(int)
        # The map is smooth, so a polynomial through some nodes replaces its evaluation everywhere.
        nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
        interpolation = np.vander(steps / reach, _NODES) @ np.linalg.inv(np.vander(nodes, _NODES))
        interpolation = interpolation.astype(np.float32)
        grid = np.stack(np.meshgrid(reach * nodes, reach * nodes), axis=-1).reshape(-1, 2)
        values = on_window(centre[:, None] + grid).reshape(-1, _NODES, _NODES, 2).astype(np.float32)
        x, y = (
            np.asarray(interpolation @ values[..., axis] @ interpolation.T, np.float32)
            for axis in (0, 1)
        )
        height, width = smooth.shape
        rows, columns = centre[:, 1, None] + steps, centre[:, 0, None] + steps
        rim = len(smoothing()) // 2
        inside = ((rows >= rim) & (rows < height - rim))[:, :, None] & (
            (columns >= rim) & (columns < width - rim)
        )[:, None, :]
        rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
        distances = np.hypot(x, y) if radii is not None else np.maximum(np.abs(x), np.abs(y))
        within = distances < half[:, None, None]
        slopes = np.linalg.inv(np.swapaxes(axes, -1, -2)) @ smoother[:, 1:3]
        return cls(
            start,
            axis,
            jacobian,
            np.linalg.norm(jacobian_px, axis=2),
            x,
            y,
            # Centred, so that single precision suffices.
            np.take(smooth, rows[:, :, None] * width + columns[:, None, :]) - np.float32(128.0),
            within,
            inside,
            neighbours,
            # Gradients are along a corner's own axes.
            np.concatenate([smoother[:, :1], slopes, smoother[:, 3:]], axis=1),
        )

    def length_px(self, shift: FloatArray) -> FloatArray:
        """(n,) lengths of shifts (n, 2) [squares] in the image [px]."""
        return np.asarray(np.linalg.norm((self.jacobian @ shift[..., None])[..., 0], axis=1))

    def shifted(self, shift: FloatArray) -> FloatArray:
        """Positions (n, 2) [px] of corners shifted by (n, 2) squares."""
        return np.asarray(self.px + (self.jacobian @ shift[..., None])[..., 0])

    def gradients(self, levels: FloatArray) -> FloatArray:
        """(n, 2, 2) gradients along x and y of (n, 2) levels, from the neighbours."""
        return np.asarray(self.smoother[:, 1:3] @ (levels[self.neighbours] - levels[:, None]))


@dataclass(frozen=True, eq=False)
class GaussNewtonStep:
    """A Gauss-Newton step of n corners."""

    levels: FloatArray  # (n, 2) offset, and contrast with the pattern's sign [grey levels].
    shift: FloatArray  # (n, 2) step of the corners [squares].
    # (n, 2) step of the edge widths' logarithms, (n, 3) with the step of a circle's radius
    # [squares]; (n, 0) unless requested.
    blur: FloatArray
    covariance: FloatArray  # (n, 2, 2) of the shift, from the residuals [squares^2].
    misfit: FloatArray  # (n,) rms residual relative to the contrast.

    @classmethod
    def solve(cls, sums: FloatArray, *, blurs: int) -> Self:
        """Solves the normal equations.

        Args:
            sums: (n, k + 1, k + 1) products of the columns, the last one being the right-hand side.
            blurs: Number of columns for the blur.
        """
        unknowns = sums.shape[1] - 1
        # Scaled to unit columns and slightly damped, so that every matrix is invertible.
        scale = np.sqrt(np.einsum("nii->ni", sums)[:, :unknowns]) + 1e-9
        scales = scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.inv(sums[:, :unknowns, :unknowns] / scales + 1e-7 * np.eye(unknowns))
        inverse /= scales
        solution = (inverse @ sums[:, :unknowns, unknowns:])[..., 0]
        squares = sums[:, unknowns, unknowns] - np.sum(
            solution * sums[:, :unknowns, unknowns], axis=1
        )
        variance = np.maximum(squares, 0.0) / np.maximum(sums[:, 0, 0] - unknowns, 1.0)
        contrast = solution[:, 1, None]
        noise_left = float(np.sum(smoothing() ** 2)) ** 2
        variance_scale = (variance / noise_left)[:, None, None] / contrast[:, :, None] ** 2
        return cls(
            solution[:, :2],
            -solution[:, 2:4] / contrast,
            solution[:, 4 : 4 + blurs] / contrast,
            inverse[:, 2:4, 2:4] * variance_scale,
            np.sqrt(variance) / np.abs(contrast[:, 0]),
        )

    def replace(self, chosen: IntArray, others: Self) -> None:
        """Takes the steps of some corners from others' (m,)."""
        for field in fields(self):
            getattr(self, field.name)[chosen] = getattr(others, field.name)


@cache
def smoothing() -> FloatArray:
    """The (5, 1) taps of the smoothing; white noise keeps the square of their sum of squares."""
    return np.asarray(cv2.getGaussianKernel(5, SMOOTH_PX), dtype=np.float64)

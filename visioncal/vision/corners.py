"""Corners of all views in one stack, and their reprojection with its derivatives.

The model: px = camera(cam_from_target * p_target) + noise. All views are processed at once; the
corners of a view are a contiguous segment of the stack.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from visioncal.core.linalg import covariance_from, gram
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.types import Camera, Corners, FloatArray, IntArray, Mask, chosen_rows
from visioncal.vision.camera import project_with_jacobian
from visioncal.vision.field_modes import FieldModes
from visioncal.vision.viewnoise import weights_by_view

# Least ratio of noise to what is stated that counts: the rounding of a statement of one digit.
_ROUNDED = 1.3
# Distance outside the image from which on corners are none, as a share of its size.
_OUTSIDE = 0.1
# Exact corners have no noise; a millionth of a pixel keeps their covariance positive definite.
_LEAST_SIGMA_PX = 1e-6


def floored_sigma_px(sigma_px: float) -> float:
    """Noise of a corner's coordinate, at least the floor that keeps covariances regular [px]."""
    return max(sigma_px, _LEAST_SIGMA_PX)


@dataclass(frozen=True, eq=False)
class CornerStack:
    """The n corners of v views."""

    views: tuple[int, ...]  # (v,) view numbers.
    blurs: tuple[float, ...]  # (v,) blur of each view's edges, as a sigma [px].
    starts: IntArray  # (v,) index of each view's first corner.
    view_of: IntArray  # (n,) index of each corner's view.
    ids: IntArray  # (n,) each corner's number on the target.
    points: FloatArray  # (n, 3) corners on the target [m].
    px: FloatArray  # (n, 2) detected image positions [px].
    # (n,) weights of the corners' residuals, inverse to their standard deviations; None where all
    # are one.
    weights: FloatArray | None = None
    # Stated standard deviation of a corner of weight one [px]; None if not stated.
    stated_px: float | None = None
    # (n, 2, m) displacements of the corners by one sigma each of what differs from view to view
    # (focus jitter, motion of rows), in units of the corner noise, unweighted; None for none.
    zooms: FloatArray | None = None

    @classmethod
    def of(cls, corners: Mapping[int, Corners], positions: FloatArray) -> Self:
        """Stacks the corners by view; `positions` are the target's (c, 3) corners [m]."""
        views = tuple(corners.values())
        counts = [len(view.ids) for view in views]
        weights = [
            np.ones(len(view.ids)) if view.weights is None else view.weights for view in views
        ]
        stated = {view.stated_px for view in views}
        return cls(
            tuple(corners),
            tuple(view.blur_px for view in views),
            np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64),
            np.repeat(np.arange(len(counts)), counts),
            np.concatenate([view.ids for view in views]),
            np.concatenate([positions[view.ids] for view in views]),
            np.concatenate([view.px for view in views]),
            None if all(view.weights is None for view in views) else np.concatenate(weights),
            stated.pop() if len(stated) == 1 else None,
        )

    def keep(self, mask: Mask) -> "CornerStack":
        """Returns the stack of the corners in an (n,) mask, without views that have none."""
        kept_views, view_of = np.unique(self.view_of[mask], return_inverse=True)
        return replace(
            chosen_rows(self, mask, "views", "blurs", "starts"),
            views=tuple(self.views[at] for at in kept_views),
            blurs=tuple(self.blurs[at] for at in kept_views),
            starts=np.searchsorted(view_of, np.arange(len(kept_views))),
            view_of=view_of,
        )

    def weighed(self, residuals: FloatArray) -> "CornerStack":
        """Returns the stack with views reweighted by their residuals, if noise is not stated.

        Args:
            residuals: (n, 2) weighted by the present weights [px].
        """
        # The residuals of exact corners are rounding errors.
        if float(np.sqrt(np.mean(residuals**2))) <= _LEAST_SIGMA_PX:
            return self
        squares = self.sum_by_view(np.sum(residuals**2, axis=1))
        by_view = weights_by_view(squares, np.asarray(2 * self.counts - 6, float))
        if by_view is None or self.stated_px is not None:
            return self
        return replace(self, weights=self.given_weights * by_view[self.view_of])

    def weigh(self, *rows: FloatArray) -> None:
        """Whitens (n, 2, ...) rows by the corner noise, in place.

        The noise is each corner's own, by its weight, and what differs from view to view.
        """
        kept = [row for row in rows if row.size]
        if self.weights is not None:
            for array in kept:
                np.multiply(array, self.weights.reshape(-1, *[1] * (array.ndim - 1)), out=array)
        for array in kept:
            self.refocus(array)

    @property
    def given_weights(self) -> FloatArray:
        """(n,) the `weights`."""
        return np.ones(len(self.px)) if self.weights is None else self.weights

    @cached_property
    def weighed_zooms(self) -> tuple[FloatArray, FloatArray]:
        """(n, 2, m) weighted `zooms`, orthogonal in each view, and (v, m) sums of their squares."""
        if self.zooms is None:
            return np.zeros((len(self.px), 2, 0)), np.zeros((len(self.starts), 0))
        weighted = self.given_weights[:, None, None] * self.zooms
        squares, turned = np.linalg.eigh(self.products_by_view(weighted, weighted))
        return self.products_with_views(weighted, turned), np.maximum(squares, 0.0)

    def refocus(self, array: FloatArray) -> None:
        """Multiplies (n, 2, ...) rows by each view's (1 + Z Z^T)^(-1/2), Z of `zooms`, in place."""
        if self.zooms is None:
            return
        zooms, squares = self.weighed_zooms
        share = (1.0 - 1.0 / np.sqrt(1.0 + squares)) / np.maximum(squares, np.finfo(float).tiny)
        flat = array.reshape(len(array), 2, -1)
        along = share[:, :, None] * self.products_by_view(zooms, flat)
        removed = self.products_with_views(zooms, along)
        np.subtract(array, removed.reshape(array.shape), out=array)

    @property
    def counts(self) -> IntArray:
        """(v,) number of corners of each view."""
        return np.diff(np.append(self.starts, len(self.px)))

    def sigma_px(self, residuals: FloatArray, unknowns: int) -> float:
        """Noise of a corner's coordinate, stated or estimated from the residuals [px].

        The estimate also replaces a stated noise that is significantly smaller.

        Args:
            residuals: (n, 2) of the stack [px].
            unknowns: Number of fitted parameters.
        """
        estimated, is_contradicted = (
            self.shown_px(residuals, unknowns),
            self.contradicts(residuals, unknowns),
        )
        if self.stated_px is None or (is_contradicted and estimated > self.stated_px):
            return estimated
        return self.stated_px

    def shown_px(self, residuals: FloatArray, unknowns: int) -> float:
        """Noise of a corner's coordinate, estimated from the residuals [px]; see `sigma_px`."""
        freedom = max(residuals.size - unknowns, 1)
        return float(np.sqrt(np.sum(residuals**2) / freedom))

    def contradicts(self, residuals: FloatArray, unknowns: int) -> bool:
        """Whether the residuals significantly contradict the stated noise; see `sigma_px`."""
        freedom = residuals.size - unknowns
        if self.stated_px is None or freedom < 1:
            return False
        ratio = self.shown_px(residuals, unknowns) / self.stated_px
        low, high = chi2_limit(np.array([1.0 - FALSE_ALARM, FALSE_ALARM]), freedom) / freedom
        above, below = ratio > max(np.sqrt(high), _ROUNDED), ratio < min(np.sqrt(low), 1 / _ROUNDED)
        return bool(above or below)

    def sum_by_view(self, values: FloatArray) -> FloatArray:
        """Sums (n, ...) values over the corners of each view: (v, ...)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))

    def products_by_view(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """Sums `left^T right` over the corners of each view: (n, 2, j), (n, 2, k) to (v, j, k)."""
        rows = 2 * len(self.px)
        rows_l, rows_r = left.reshape(rows, left.shape[2]), right.reshape(rows, right.shape[2])
        ends = 2 * np.append(self.starts[1:], len(self.px))
        return np.array(
            [
                rows_l[start:end].T @ rows_r[start:end]
                for start, end in zip((2 * self.starts).tolist(), ends.tolist(), strict=True)
            ]
        )

    def blocks(self) -> Iterator[tuple[slice, slice]]:
        """Slices of some thousand corners each, and of their views."""
        count = len(self.starts)
        # Corners whose modes of a field are held at once.
        step = max(2048 * count // max(len(self.px), 1), 1)
        ends = np.append(self.starts, len(self.px)).tolist()
        for first in range(0, count, step):
            last = min(first + step, count)
            yield slice(ends[first], ends[last]), slice(first, last)

    def products_with_modes(self, left: FloatArray, modes: FloatArray, views: slice) -> FloatArray:
        """Products by view of (n, 2, j) with (m, e) modes along x, then along y: (v, j, 2 e).

        The modes are those of the m corners of v `views`.
        """
        size, ends = left.shape[2], np.append(self.starts, len(left))[views.start : views.stop + 1]
        flat = left.reshape(len(left), -1)[ends[0] : ends[-1]]
        products = np.empty((len(ends) - 1, 2 * size, modes.shape[1]))
        for (start, end), value in zip(pairwise((ends - ends[0]).tolist()), products, strict=True):
            np.matmul(flat[start:end].T, modes[start:end], out=value)
        axis_products = products.reshape(len(products), 2, size, -1)
        return np.concatenate([axis_products[:, 0], axis_products[:, 1]], axis=2)

    def products_with_views(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """Products of each corner's (n, 2, j) and its view's (v, j, k): (n, 2, k)."""
        products = np.empty((2 * len(left), right.shape[2]))
        rows, ends = left.reshape(len(products), -1), 2 * np.append(self.starts, len(left))
        for (start, end), value in zip(pairwise(ends.tolist()), right, strict=True):
            np.matmul(rows[start:end], value, out=products[start:end])
        return products.reshape(*left.shape[:2], -1)


@dataclass(frozen=True, eq=False)
class WithoutPoses:
    """Jacobian columns of a stack after elimination of the views' poses."""

    stack: CornerStack  # The corners.
    by_pose: FloatArray  # (n, 2, 6) derivatives by the poses, in units of the corner noise.
    information: FloatArray  # (v, 6, 6) on the poses.
    inverse: FloatArray  # (v, 6, 6) inverse of the information.
    roots: FloatArray  # (v,) square roots of the views' weights.
    answer: FloatArray  # (v, 6, c) response of the poses to the columns' parameters.
    left: FloatArray  # (n, 2, c) columns projected orthogonally to the poses, times the roots.

    @classmethod
    def of(
        cls, stack: CornerStack, by_pose: FloatArray, columns: FloatArray, shares: FloatArray | None
    ) -> "WithoutPoses":
        """Eliminates the poses from (n, 2, c) columns in units of the corner noise.

        The columns are projected explicitly: their products are then positive semidefinite and
        accurate, whereas a difference of products would magnify rounding a millionfold.

        Args:
            stack: The corners of v views.
            by_pose: (n, 2, 6) derivatives by the poses.
            columns: (n, 2, c).
            shares: (v,) weights of the views; one where None.
        """
        # Information of exactly these derivatives: with that of an earlier step, columns would not
        # be orthogonal to the poses, and the products of `with_modes` would be inconsistent.
        information = stack.products_by_view(by_pose, by_pose)
        inverse = covariance_from(information)
        roots = np.ones(len(inverse)) if shares is None else np.sqrt(shares)
        answer = -inverse @ stack.products_by_view(by_pose, columns)
        left = stack.products_with_views(by_pose, answer)
        left += columns
        if shares is not None:
            left *= roots[stack.view_of, None, None]
        return cls(stack, by_pose, information, inverse, roots, answer, left)

    @cached_property
    def products(self) -> FloatArray:
        """(c, c) products of the projected columns."""
        return gram(self.left, self.left)

    def with_modes(self, modes: FieldModes, lens_part: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Appends the modes of a distortion field to the columns.

        Each mode moves corners along one axis only, and poses absorb little of it: a difference of
        products is accurate enough, and takes a fifth of the time.

        Args:
            modes: The e modes, times the corners' weights.
            lens_part: (k, 2 e) multiples of the first k columns that are subtracted from the modes.

        Returns:
            (v, 6, c + 2 e) response of the poses, and (c + 2 e, c + 2 e) products of all projected
            columns.
        """
        if not modes.count:
            return self.answer, self.products
        stack, count = self.stack, self.left.shape[2]
        zooms, squares = stack.weighed_zooms
        rows = np.concatenate([self.by_pose, zooms], axis=2)
        left = self.left * self.roots[stack.view_of, None, None]
        stack.refocus(rows[:, :, :6])
        stack.refocus(left)
        size, lens = count + 2 * modes.count, len(lens_part)
        by_view = np.empty((len(self.roots), rows.shape[2], 2 * modes.count))
        crossed = np.zeros((2 * count, modes.count))
        inner = np.zeros((modes.count, modes.count))
        for corners, views in stack.blocks():
            at = modes.at(corners)
            by_view[views] = stack.products_with_modes(rows, at, views)
            crossed += left[corners].reshape(len(at), -1).T @ at
            at *= self.roots[stack.view_of[corners], None]
            inner += at.T @ at
        del rows, left
        answer = np.empty((len(self.roots), 6, size))
        answer[:, :, :count], following = self.answer, answer[:, :, count:]
        np.matmul(-self.inverse, by_view[:, :6], out=following)
        by_view *= self.roots[:, None, None] ** 2
        along = by_view[:, 6:] / (self.roots[:, None] * np.sqrt(1.0 + squares))[:, :, None]
        along = along.reshape(-1, along.shape[2])
        products = np.empty((size, size))
        products[:count, :count] = self.products
        products[:count, count:] = np.concatenate([crossed[:count], crossed[count:]], axis=1)
        products[count:, :count] = products[:count, count:].T
        products[count:, count:] = gram(by_view[:, :6], following)
        products[count:, count:] += np.kron(np.eye(2), inner) - along.T @ along
        following -= self.answer[:, :, :lens] @ lens_part
        products[:, count:] -= products[:, :lens] @ lens_part
        products[count:] -= lens_part.T @ products[:lens]
        return answer, products


@dataclass(frozen=True, eq=False)
class Reprojection:
    """Reprojection of a stack."""

    residuals: FloatArray  # (n, 2) predicted minus detected, weighted [px].
    px: FloatArray  # (n, 2) predicted [px].
    # (n, 2, 6) derivatives by the right perturbation of the view's `cam_from_target`.
    by_pose: FloatArray
    by_intrinsics: FloatArray  # (n, 2, k) derivatives by the intrinsics.
    # (n, 2, 3) derivatives by each corner's position on the target, unweighted.
    by_point: FloatArray


def reproject(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, *, lens: bool = True
) -> Reprojection:
    """Reprojects a stack.

    Args:
        stack: The corners of v views.
        camera: The intrinsics.
        cam_from_target: (v, 4, 4) one pose a view.
        lens: Whether to compute derivatives by the intrinsics; else k = 0.

    Returns:
        Residuals and derivatives. A point at or behind the camera gets a residual as large as the
        image and zero derivatives, so that a solver rejects the step that moves it there.
    """
    # By components, as batched products of matrices this small are mostly overhead.
    rotation = np.ascontiguousarray(cam_from_target[:, :3, :3].transpose(1, 2, 0))
    rotation = rotation[:, :, stack.view_of]
    px, py, pz = stack.points.T
    points_cam = (rotation[:, 0] * px + rotation[:, 1] * py + rotation[:, 2] * pz).T
    points_cam = points_cam + cam_from_target[:, :3, 3][stack.view_of]
    projection = project_with_jacobian(camera, points_cam, lens=lens)
    by_cam = np.ascontiguousarray(projection.jacobian_point.transpose(2, 0, 1))
    columns = rotation[:, :, :, None]
    bx, by, bz = (
        by_cam[0] * columns[0, at] + by_cam[1] * columns[1, at] + by_cam[2] * columns[2, at]
        for at in range(3)
    )
    # A rotation w moves point p by w x p: a row b of derivatives by the point becomes p x b.
    px, py, pz = (value[:, None] for value in (px, py, pz))
    by_pose = np.empty((*bx.shape, 6))
    for at, column in enumerate(
        (py * bz - pz * by, pz * bx - px * bz, px * by - py * bx, bx, by, bz)
    ):
        by_pose[:, :, at] = column
    predicted, residuals = projection.px, projection.px - stack.px
    behind = ~np.isfinite(residuals).all(axis=1)
    if behind.any():
        predicted[behind] = stack.px[behind]
        residuals[behind] = max(camera.resolution)
        by_pose[behind] = 0.0
        projection.jacobian_intrinsics[behind] = 0.0
    is_weighed = stack.weights is not None or stack.zooms is not None
    by_point = by_pose[:, :, 3:].copy() if is_weighed else by_pose[:, :, 3:]
    # In place: these three arrays are local to this call.
    stack.weigh(residuals, by_pose, projection.jacobian_intrinsics)
    return Reprojection(residuals, predicted, by_pose, projection.jacobian_intrinsics, by_point)


def mean_square_by_view(stack: CornerStack, residuals: FloatArray) -> FloatArray:
    """Mean squared residual of each view's corners, (v,) [px^2]."""
    return stack.sum_by_view(np.sum(residuals**2, axis=1)) / stack.counts


def far_outside(px: FloatArray, resolution: tuple[int, int]) -> Mask:
    """(n,) whether each of (n, 2) pixels is none of an image of (width, height), nor near it."""
    shares = px / np.array(resolution, dtype=float)
    return np.asarray(~((shares >= -_OUTSIDE) & (shares <= 1.0 + _OUTSIDE)).all(axis=1))

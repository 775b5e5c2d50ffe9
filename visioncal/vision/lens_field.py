"""Lens errors beyond the model, as random effects: a smooth field, and varying focus.

A corner is displaced by `(b (d / d0 - 1) + j) (px - centre) + field(px)`: b is focus breathing, by
the view's distance d over the mean one, j is focus jitter, one per view, and the field is a
Gaussian process over the image with a squared exponential kernel of one length, less what the
intrinsics can explain of it over the image: otherwise it would trade with the focal length. Each
has zero mean and a size of its own, which `fit` estimates. Sizes are in units of the
corners' noise: corners with these effects still have 1 px noise.
"""

from dataclasses import dataclass

import numpy as np

from visioncal.core.linalg import gram
from visioncal.core.types import Camera, FloatArray
from visioncal.vision.camera import normalise, project_with_jacobian
from visioncal.vision.corners import CornerStack
from visioncal.vision.field_modes import field_modes


@dataclass(frozen=True)
class LensLevels:
    """Sizes of the lens errors beyond the model, over the noise of a corner's coordinate."""

    field: float = 0.0  # Standard deviation of the field, per axis.
    length: float = 0.2  # The field's length, as a share of the image's width.
    breathing: float = 0.0  # Relative change of the focal length as the distance doubles [1/px].
    jitter: float = 0.0  # Relative change of the focal length from view to view [1/px].
    motion: float = 0.0  # See `row_motions` [rad/px].
    # Fall of twice the log-likelihood without each of the four.
    gains: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


def lens_part(camera: Camera, length: float) -> FloatArray:
    """(k, 2 e) intrinsics that explain most of each mode over the image (least squares).

    The modes along x come first, then those along y. A random field must be orthogonal to the fixed
    columns beside it (Hodges and Reich 2010).
    """
    # Grid points per axis of the image over which the intrinsics' part is removed, and the relative
    # singular value below which a combination of intrinsics is undetermined there.
    axes = (np.linspace(0.0, size - 1.0, 20) for size in camera.resolution)
    px = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays = normalise(camera, px)
    seen = np.isfinite(rays).all(axis=1)
    px, points = px[seen], np.column_stack([rays[seen], np.ones(int(seen.sum()))])
    flat = np.concatenate(project_with_jacobian(camera, points).jacobian_intrinsics)
    scale = np.linalg.norm(flat, axis=0)
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv(flat / scale, rcond=1e-8) / scale[:, None]
    by_axis = inverse.reshape(len(scale), -1, 2)
    modes = field_modes(px, camera.resolution, length).at(slice(None))
    return np.concatenate([by_axis[:, :, 0] @ modes, by_axis[:, :, 1] @ modes], axis=1)


def zooms(px: FloatArray, camera: Camera) -> FloatArray:
    """(n, 2, 1) derivative of corners at (n, 2) pixels by the relative focal length [px]."""
    return np.asarray(px - camera.matrix[2:])[:, :, None]


def row_motions(px: FloatArray, camera: Camera) -> FloatArray:
    """(n, 2, 4) displacements of corners at (n, 2) pixels by motion while rows are read [px].

    By shifts along both axes, growth and turn of the image from its first row to its last [rad], of
    which the middle row has none: what a plane does that faces the camera. A board that is tilted
    moves otherwise by the share of its depth that its own depth is.
    """
    share = px[:, 1] / (camera.resolution[1] - 1) - 0.5
    x, y = (px - camera.matrix[2:]).T
    focal, none = np.full(len(px), float(np.mean(camera.matrix[:2]))), np.zeros(len(px))
    moved = np.stack([np.array([focal, none, x, -y]), np.array([none, focal, y, x])])
    return np.asarray(np.moveaxis(share * moved, (0, 2), (1, 0)))


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
    stack: CornerStack, px: FloatArray, camera: Camera, cam_from_target: FloatArray, size: float
) -> FloatArray:
    """(n, 2, 1) displacement by breathing of some size; (n, 2, 0) for size zero.

    `px` (n, 2) are the corners as predicted: what depends on detected ones contains their noise,
    and beside the intrinsics explains it.
    """
    if size == 0.0:
        return np.zeros((len(px), 2, 0))
    far = distances(stack, cam_from_target)[stack.view_of]
    return np.asarray(size * far[:, None, None] * zooms(px, camera))


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
        modes = field_modes(px, camera.resolution, levels.length, levels.field).at(slice(None))
        columns = np.einsum("ij,ne->nije", np.eye(2), modes).reshape(len(px), 2, -1)
        rays = normalise(camera, px)
        points = np.column_stack([np.nan_to_num(rays), np.ones(len(px))])
        by_lens = project_with_jacobian(camera, points).jacobian_intrinsics
        columns -= by_lens @ (levels.field * lens_part(camera, levels.length))
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
        right_sides = np.column_stack([between, gradient, np.eye(len(root))])
        solved = np.linalg.solve(root.T, np.linalg.solve(root, right_sides))
        inverse = solved[:, between.shape[1] + 1 :]
        inverse_root = np.linalg.inv(root).T
        pose_changes = by_coefficients @ inverse_root
        values, vectors = np.linalg.eigh(gram(pose_changes, poses @ pose_changes))
        # Others move all poses together by less than a hundredth of a pose's variance.
        visible = values > 1e-2
        return cls(
            -solved[:, between.shape[1]],
            -solved[:, : between.shape[1]],
            inverse_root @ vectors[:, visible],
            inverse_root @ vectors[:, ~visible],
            float(len(root) - np.trace(inverse)),
        )

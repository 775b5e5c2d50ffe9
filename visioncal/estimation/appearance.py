"""Common parameters of all views: intrinsics of the lens and shape of the board.

A printed board has errors of scale, aspect ratio, shear and bend. In the target's frame, a corner p
lies at `(1 + scale) p + aspect (-x, y, 0) / 2 + shear (y, x, 0) / 2 + z(x, y)`, with a polynomial z
of second and third order without offset and tilt, which belong to the board's pose: the target's
frame is that of the plane that fits the corners best.

The points of a rig deviate from its table by their stated standard deviations; corners of a printed
board whose images show that they are elsewhere deviate in its plane, beside its shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.linalg import covariance_from
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import Effect
from visioncal.vision.camera import intrinsics, with_intrinsics
from visioncal.vision.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.vision.field_modes import FieldModes, field_modes
from visioncal.vision.lens_field import Coefficients, LensLevels, breathing_columns, lens_part
from visioncal.vision.pnp import ViewPoses
from visioncal.vision.poses import fit_poses

# The effect's name in a problem.
LENS_AND_BOARD = "lens and board"


@dataclass(frozen=True, eq=False)
class Appearance:
    """Intrinsics of a camera and shapes of the boards."""

    camera: Camera  # The intrinsics.
    # (s,) deviations of all targets from their stated shapes, those of printed boards in the order
    # of `BOARD_NAMES`.
    board: FloatArray

    @property
    def values(self) -> FloatArray:
        """(k + s,) the intrinsics and the boards' shapes."""
        return np.concatenate([intrinsics(self.camera), self.board])

    def moved(self, step: FloatArray) -> "Appearance":
        """Returns the appearance after a (k + s,) step."""
        values = self.values + step
        lens = len(values) - len(self.board)
        return Appearance(with_intrinsics(self.camera, values[:lens]), values[lens:])


@dataclass(frozen=True, eq=False)
class LensBoardParameters:
    """Free parameters of an appearance, with the information on them from all but the robot."""

    appearance: Appearance  # The values for which the views' poses were estimated.
    basis: FloatArray  # (c, 3, s) of `boards_basis`, by corner number.
    positions: FloatArray  # (c, 3) corners of the flat boards, each in its own frame [m].
    columns: IntArray  # (k,) indices of the free parameters among the appearance's values.
    anchored: Mask  # (k,) mask of those that are held and only count in the covariance.
    information: FloatArray  # (k, k) on the free parameters, from the corners and the prior.
    gradient: FloatArray  # (k,) half the gradient of the same, at the present values.

    def effect(self, shift: FloatArray) -> Effect:
        """The parameters as an effect on observations, given their (m, 6, k) Jacobian."""
        prior = PriorInformation(self.information, self.gradient)
        return replace(Effect.free(LENS_AND_BOARD, prior, shift), held=self.anchored)

    def posed(self, views: Sequence[ViewPoses], sigma_px: float) -> tuple[ViewPoses, ...]:
        """Poses of views that are not in the fit, by their corners with this lens and these boards.

        Each view has its one pose and its corners; `sigma_px` is the noise of a corner's
        coordinate.
        """
        if not views:
            return ()
        corners = {view.view: view.corners for view in views if view.corners is not None}
        starts = np.array([view.cam_from_target[0] for view in views])
        with one_blas_thread():
            stack = CornerStack.of(corners, self.positions)
            compressed = compress(stack, self.basis, self.appearance, starts)
        covariances = floored_sigma_px(sigma_px) ** 2 * compressed.covariance
        return tuple(
            replace(
                view,
                cam_from_target=compressed.cam_from_target[at][None],
                covariance=covariances[at][None],
                shared_jacobian=compressed.by_shared[at][None, :, self.columns],
            )
            for at, view in enumerate(views)
        )


@dataclass(frozen=True, eq=False)
class Compressed:
    """Normal equations of the corners, reduced to poses and appearance.

    Information is for a corner noise of 1 px.
    """

    cam_from_target: FloatArray  # (v, 4, 4) the best-fitting poses for the appearance.
    information: FloatArray  # (v, 6, 6) on each pose's right perturbation.
    by_shared: FloatArray  # (v, 6, k) Jacobian of the poses with respect to the appearance.
    shared_information: FloatArray  # (k, k) on the appearance, with free poses (Schur complement).
    # (v, k) half the gradient of each view's squared error by the appearance.
    shared_pulls: FloatArray
    residuals: FloatArray  # (n, 2) [px].
    # (v, 6, m) Jacobian of the poses with respect to lens errors beyond the model, for coefficients
    # in units of the corner noise; see `lens_field`.
    by_field: FloatArray
    # Estimate of these coefficients from the corners; None where there are none.
    coefficients: Coefficients | None = None

    @cached_property
    def covariance(self) -> FloatArray:
        """(v, 6, 6) covariances of the poses."""
        return covariance_from(self.information)

    @property
    def shared_gradient(self) -> FloatArray:
        """(k,) half the gradient by the appearance, of all views."""
        return np.asarray(self.shared_pulls.sum(axis=0))


def compress(
    stack: CornerStack,
    basis: FloatArray,
    appearance: Appearance,
    starts: FloatArray,
    scales: IntArray | None = None,
    shares: FloatArray | None = None,
    levels: LensLevels | None = None,
) -> Compressed:
    """Compresses corners to normal equations in each view's pose and the shared appearance.

    Args:
        stack: The corners of v views, on the flat boards.
        basis: (c, 3, s) of `boards_basis`, by corner number.
        appearance: The linearisation point.
        starts: (v, 4, 4) initial `cam_from_target`.
        scales: Indices of the boards' scales among the appearance's values, which views alone do
            not determine.
        shares: (v,) weight of each view for the appearance; views that repeat each other share
            their errors, and one weight.
        levels: Levels of lens errors beyond the model; None for no such errors.
    """
    shape = basis[stack.ids]
    bent = replace(stack, points=stack.points + shape @ appearance.board)
    compressed = compress_points(
        bent, appearance.camera, starts, shape, shares=shares, levels=levels
    )
    # A larger board farther away looks the same: any information on scale is rounding.
    if scales is not None:
        information = compressed.shared_information
        information[scales] = information[:, scales] = compressed.shared_pulls[:, scales] = 0.0
    return compressed


def compress_points(
    stack: CornerStack,
    camera: Camera,
    starts: FloatArray,
    by_values: FloatArray,
    *,
    lens: bool = True,
    shares: FloatArray | None = None,
    levels: LensLevels | None = None,
) -> Compressed:
    """Compresses corners to normal equations in poses, lens and values that move corners.

    Args:
        stack: The corners of v views, at their positions on the target.
        camera: The intrinsics.
        starts: (v, 4, 4) initial `cam_from_target`.
        by_values: (n, 3, s) derivatives of the corners on the target with respect to s values.
        lens: Whether the intrinsics are free, and come first of the shared values.
        shares: (v,) see `compress`.
        levels: Levels of lens errors beyond the model; None for no such errors.
    """
    fit = fit_poses(stack, camera, starts)
    projected = reproject(stack, camera, fit.cam_from_target, lens=lens)
    by_shape = projected.by_point @ by_values
    stack.weigh(by_shape)
    columns = [projected.by_intrinsics, by_shape]
    shared = projected.by_intrinsics.shape[2] + by_shape.shape[2]
    if levels is not None:
        breath = breathing_columns(
            stack, projected.px, camera, fit.cam_from_target, levels.breathing
        )
        stack.weigh(breath)
        columns += [breath, projected.residuals[:, :, None]]
    all_columns = np.concatenate(columns, axis=2)
    without = WithoutPoses.of(stack, projected.by_pose, all_columns, shares)
    left, answer = without.left[:, :, :shared], without.answer[:, :, :shared]
    information = without.products[:shared, :shared]
    roots = without.roots[stack.view_of, None]
    residuals = roots * projected.residuals
    poses, unscaled, coefficients = fit.cam_from_target, projected.residuals, None
    by_field = np.zeros((len(poses), 6, 0))
    if levels is not None and levels.field + levels.breathing > 0.0:
        modes, by_lens = FieldModes.none(len(stack.px)), np.zeros((0, 0))
        if levels.field > 0.0:
            size = levels.field * stack.given_weights
            modes = field_modes(projected.px, camera.resolution, levels.length, size)
            by_lens = levels.field * lens_part(camera, levels.length)
        following, products = without.with_modes(modes, by_lens)
        # Columns: shared values, breathing, residuals, field. Coefficients: field, then breathing.
        last = all_columns.shape[2] - 1
        beyond = np.r_[last + 1 : len(products), shared:last]
        by_field = following[:, :, beyond]
        coefficients = Coefficients.of(
            products[np.ix_(beyond, beyond)],
            products[np.ix_(beyond, np.arange(shared))],
            products[beyond, last],
            by_field,
            without.information,
        )
        # Eliminates the coefficients, which makes them independent of the shared values.
        information = information + products[:shared, beyond] @ coefficients.slope
        answer = answer + by_field @ coefficients.slope
        moved_poses = by_field @ coefficients.mean
        poses = poses @ exp(moved_poses)
        of_modes, of_breath = np.split(coefficients.mean, [2 * modes.count])
        shift = modes.displaced(of_modes)
        stack.refocus(shift)
        shift -= projected.by_intrinsics[:, :, : len(by_lens)] @ (by_lens @ of_modes)
        shift += all_columns[:, :, shared:last] @ of_breath
        shift += stack.products_with_views(projected.by_pose, moved_poses[:, :, None])[:, :, 0]
        residuals, unscaled = residuals + roots * shift, unscaled + shift
        by_field = by_field @ coefficients.moving_roots
    pulls = stack.sum_by_view(np.einsum("nij,ni->nj", left, residuals))
    return Compressed(
        poses, without.information, answer, information, pulls, unscaled, by_field, coefficients
    )

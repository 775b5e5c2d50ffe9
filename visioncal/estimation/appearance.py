"""What all views share besides the edges: the lens, and the board as it really is.

A printed board is stretched, longer one way than the other, sheared, and bent. In the target's
frame, a corner p lies at `(1 + scale) p + aspect (-x, y, 0) / 2 + shear (y, x, 0) / 2 + z(x, y)`, z
being a polynomial of second and third order. What of it is an offset or a tilt belongs to the
board's pose and is taken out, so that the target's frame is that of the plane which fits the
corners best.

The points of a rig are where its table has them, or near there, each by what it is known to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray, IntArray, Mask, Target
from visioncal.estimation.corners import CornerStack, WithoutPoses, reproject
from visioncal.estimation.lens_field import Coefficients, LensLevels, breathing_columns, field_modes
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.poses import fit_poses
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.variance import PriorInformation
from visioncal.vision.camera import intrinsics, with_intrinsics
from visioncal.vision.targets import corner_positions

# The effect's name in a problem.
LENS_AND_BOARD = "lens and board"
SCALE, ASPECT, SHEAR = 0, 1, 9
_BENDS = slice(2, 9)
# The places are those of files, too; shear came last.
BOARD_NAMES = (
    "scale",
    "aspect",
    *(f"bow_{name}" for name in (["xx", "xy", "yy", "xxx", "xxy", "xyy", "yyy"])),
    "shear",
)
# Exponents of the polynomial's terms.
_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))

# What is known of any printed board: its sides differ by 0.1 % or so, its rows and columns meet at
# a right angle to 1 mrad or so, and it is bent by a hundredth of its size at the most.
_ASPECT_SIGMA, _SHEAR_SIGMA, _BOW_SIGMA_SHARE = 1e-3, 1e-3, 1e-2
# A rig of more points is taken for exact: each adds three unknowns that all views share.
MOST_LOOSE = 100


def board_basis(positions: FloatArray) -> FloatArray:
    """Derivatives of the corners' places by the board's shape.

    Args:
        positions: (c, 3) corners of the flat board, in the target's frame [m].

    Returns:
        (c, 3, 10) in the order of `BOARD_NAMES`; bows are in metres at the board's edge.
    """
    middle = (positions.min(axis=0) + positions.max(axis=0)) / 2
    half = float(np.ptp(positions, axis=0).max()) / 2
    u, v = ((positions - middle) / half)[:, :2].T
    basis = np.zeros((len(positions), 3, len(BOARD_NAMES)))
    basis[:, :, SCALE] = positions
    basis[:, 0, ASPECT], basis[:, 1, ASPECT] = -positions[:, 0] / 2, positions[:, 1] / 2
    basis[:, :2, SHEAR] = positions[:, 1::-1] / 2
    bows = np.stack([u**a * v**b for a, b in _POWERS], axis=1)
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    basis[:, 2, _BENDS] = bows - plane @ np.linalg.lstsq(plane, bows, rcond=None)[0]
    return basis


def shape_basis(target: Target) -> FloatArray:
    """Derivatives (c, 3, s) of a target's corners by its shape.

    A printed board's are those of `board_basis`, of an exact rig there are none, and of another one
    the places of its points are the shape.
    """
    positions = corner_positions(target)
    if target.kind != "points":
        return board_basis(positions)
    size = len(board_prior(target))
    return np.eye(3 * len(positions))[:, :size].reshape(len(positions), 3, size)


def boards_basis(targets: Sequence[Target]) -> FloatArray:
    """Derivatives of several targets' corners by all of their shapes, (c, 3, s)."""
    parts = [shape_basis(target) for target in targets]
    flat = block_diag(*(part.reshape(3 * len(part), part.shape[2]) for part in parts))
    return np.asarray(flat.reshape(len(flat) // 3, 3, flat.shape[1]))


def shape_slices(targets: Sequence[Target], first: int = 0) -> tuple[slice, ...]:
    """Where each target's shape stands among all of them, the first one's at `first`."""
    ends = first + np.cumsum([0, *(len(board_prior(target)) for target in targets)])
    return tuple(slice(*pair) for pair in pairwise(ends.tolist()))


def board_prior(target: Target) -> FloatArray:
    """Standard deviations (s,) of the target's shape, as they are known beforehand."""
    if target.kind == "points":
        sigmas = target.point_sigmas_m if len(target.point_sigmas_m) <= MOST_LOOSE else ()
        return np.repeat(sigmas, 3).astype(float)
    positions = corner_positions(target)
    half = float(np.ptp(positions, axis=0).max()) / 2
    bows = np.full(len(_POWERS), _BOW_SIGMA_SHARE * half)
    return np.array([target.square_sigma_m / target.square_m, _ASPECT_SIGMA, *bows, _SHEAR_SIGMA])


@dataclass(frozen=True, eq=False)
class Appearance:
    """A camera and a board as they really are.

    Attributes:
        camera: The intrinsics.
        board: (s,) the shapes of all targets, printed ones in the order of `BOARD_NAMES`; zero for
            the stated ones.
    """

    camera: Camera
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
    """Which unknowns of an appearance are free, and what is known of them without the robot.

    Attributes:
        appearance: The values that the views' poses were made with.
        basis: (c, 3, s) of `boards_basis`, by corner number.
        positions: (c, 3) corners of the flat boards, each in its own frame [m].
        columns: (k,) the free ones' places among the appearance's values.
        anchored: (k,) mask of those that stay where they are, and count in the covariance only.
        information: (k, k) on them, from the corners and from what is known beforehand.
        gradient: (k,) half the gradient of what is known, at their present values.
    """

    appearance: Appearance
    basis: FloatArray
    positions: FloatArray
    columns: IntArray
    anchored: Mask
    information: FloatArray
    gradient: FloatArray

    def effect(self, shift: FloatArray) -> Effect:
        """Puts it as the chain takes it, with the (m, 6, k) shifts of its views."""
        known = PriorInformation(self.information, self.gradient)
        return replace(Effect.free(LENS_AND_BOARD, known, shift), held=self.anchored)


@dataclass(frozen=True, eq=False)
class Compressed:
    """What the corners say, view by view, of poses and appearance: nothing else is needed of them.

    Information is for corners of 1 px noise.

    Attributes:
        cam_from_target: (v, 4, 4) the poses that fit best under the appearance.
        information: (v, 6, 6) on each pose's right perturbation.
        by_shared: (v, 6, k) how each pose moves with the appearance.
        shared_information: (k, k) on the appearance, the poses being free.
        shared_pulls: (v, k) half the gradient of the squared error by the appearance.
        residuals: (n, 2) [px].
        by_field: (v, 6, m) how each pose moves with the lens beyond its model, by
            coefficients as large as the corners' noise; see `lens_field`.
        coefficients: What corners say of these coefficients; None where there are none.
    """

    cam_from_target: FloatArray
    information: FloatArray
    by_shared: FloatArray
    shared_information: FloatArray
    shared_pulls: FloatArray
    residuals: FloatArray
    by_field: FloatArray
    coefficients: Coefficients | None = None

    @cached_property
    def covariance(self) -> FloatArray:
        """(v, 6, 6) covariances of the poses."""
        return covariance_from(self.information)

    @property
    def field_freedom(self) -> float:
        """How many coefficients of the lens beyond its model the corners determine."""
        return 0.0 if self.coefficients is None else self.coefficients.freedom

    @property
    def shared_gradient(self) -> FloatArray:
        """(k,) that of all views together."""
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
        stack: The corners of v views, at their places on the flat boards.
        basis: (c, 3, s) of `boards_basis`, by corner number.
        appearance: Where to linearise.
        starts: (v, 4, 4) `cam_from_target` to start from.
        scales: Places of the boards' scales among the appearance's values, which views alone do
            not show.
        shares: (v,) as how much of a view each counts for the appearance: of those that show the
            same as others, whatever is wrong with one is wrong with all.
        levels: Sizes of what the lens does beyond its model; nothing where None.
    """
    shape = basis[stack.ids]
    bent = stack.with_points(stack.points + shape @ appearance.board)
    found = compress_points(bent, appearance.camera, starts, shape, shares=shares, levels=levels)
    # A larger board farther away looks the same: what is left is rounding.
    if scales is not None:
        information = found.shared_information
        information[scales] = information[:, scales] = found.shared_pulls[:, scales] = 0.0
    return found


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
    """Compresses corners to normal equations in poses, lens and whatever moves corners.

    Args:
        stack: The corners of v views, where they are on the target.
        camera: The intrinsics.
        starts: (v, 4, 4) `cam_from_target` to start from.
        by_values: (n, 3, s) how the corners move on the target with s values.
        lens: Whether the intrinsics come first of what is shared; else they are held.
        shares: As `compress` has them.
        levels: Sizes of what the lens does beyond its model; nothing where None.
    """
    fit = fit_poses(stack, camera, starts)
    now = reproject(stack, camera, fit.cam_from_target, lens=lens)
    moved = now.by_point @ by_values
    stack.weigh(moved)
    columns = [now.by_intrinsics, moved]
    shared = now.by_intrinsics.shape[2] + moved.shape[2]
    if levels is not None:
        breath = breathing_columns(stack, camera, fit.cam_from_target, levels.breathing)
        stack.weigh(breath)
        columns += [breath, now.residuals[:, :, None]]
    every = np.concatenate(columns, axis=2)
    without = WithoutPoses.of(stack, now.by_pose, every, shares)
    left, answer = without.left[:, :, :shared], without.answer[:, :, :shared]
    information = without.products[:shared, :shared]
    roots = without.roots[stack.view_of, None]
    residuals = roots * now.residuals
    poses, own, found = fit.cam_from_target, now.residuals, None
    by_field = np.zeros((len(poses), 6, 0))
    if levels is not None and levels.field + levels.breathing > 0.0:
        modes = np.zeros((len(stack.px), 0))
        if levels.field > 0.0:
            modes = levels.field * field_modes(stack.px, camera.resolution, levels.length)
        following, products = without.with_modes(modes)
        # The residuals stand between breathing, which comes last, and the field.
        last = every.shape[2] - 1
        beyond = np.r_[last + 1 : len(products), shared:last]
        by_field = following[:, :, beyond]
        found = Coefficients.of(
            products[np.ix_(beyond, beyond)],
            products[np.ix_(beyond, np.arange(shared))],
            products[beyond, last],
            by_field,
            without.information,
        )
        # Coefficients follow what is shared: that then says nothing of them, nor they of it.
        information = information + products[:shared, beyond] @ found.slope
        answer = answer + by_field @ found.slope
        moved_poses = by_field @ found.mean
        poses = poses @ exp(moved_poses)
        of_modes = found.mean[: 2 * modes.shape[1]].reshape(2, -1)
        away = modes @ of_modes.T
        stack.weigh(away)
        away += every[:, :, shared:last] @ found.mean[2 * modes.shape[1] :]
        away += stack.products_with_views(now.by_pose, moved_poses[:, :, None])[:, :, 0]
        residuals, own = residuals + roots * away, own + away
        by_field = by_field @ found.moving_roots
    pulls = stack.sum_by_view(np.einsum("nij,ni->nj", left, residuals))
    return Compressed(poses, without.information, answer, information, pulls, own, by_field, found)

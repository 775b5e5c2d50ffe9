"""Pose of the target in each view, with covariance and rival poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.linalg import covariance_from
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import adjoint, distances_m, invert
from visioncal.core.types import Camera, Corners, FloatArray, Rejection, Target
from visioncal.vision.corners import CornerStack, floored_sigma_px, mean_square_by_view
from visioncal.vision.gating import gate
from visioncal.vision.poses import PoseFit, fit_poses, planar_poses
from visioncal.vision.targets import (
    first_corners,
    numbered_positions,
    rotation_transforms,
    rotations,
)


@dataclass(frozen=True, eq=False)
class ViewPoses:
    """Candidate poses of one view."""

    view: int  # The view's number.
    corners: Corners | None  # The inlier corners; None where the session states the pose itself.
    cam_from_target: FloatArray  # (c, 4, 4) candidates, the best by reprojection first.
    turns: tuple[int, ...]  # (c,) which of the target's own symmetries each candidate has applied.
    # (c, 6, 6) of the candidates' right perturbations; zero where the session states the pose
    # itself.
    covariance: FloatArray
    # (c, 6, k) Jacobian of each candidate by the unknowns that all views share; k = 0 before these
    # are known.
    shared_jacobian: FloatArray
    board: int = 0  # Index of the target.
    first: int = 0  # The number of the target's first corner, where several are numbered through.

    def chosen(self, pick: int, target: Target | None) -> "ViewPoses":
        """Reduces the view to one candidate, and renumbers its corners accordingly."""
        corners, turn = self.corners, self.turns[pick]
        if corners is not None and target is not None and turn:
            # Turned, corner i is where corner rotations[i] was: what was detected as that one is i.
            turned = np.argsort(rotations(target)[turn])[corners.ids - self.first] + self.first
            corners = replace(corners, ids=turned).take(np.argsort(turned))
        only = slice(pick, pick + 1)
        return replace(
            self,
            corners=corners,
            cam_from_target=self.cam_from_target[only],
            turns=(turn,),
            covariance=self.covariance[only],
            shared_jacobian=self.shared_jacobian[only],
        )

    def nearest(self, predicted: FloatArray, target: Target | None) -> "ViewPoses":
        """Chooses the candidate that is nearest to a predicted `cam_from_target` (4, 4)."""
        pick = int(distances_m(self.cam_from_target, predicted).argmin())
        return self.chosen(pick, target)


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of all views, the rejected views, and the noise of a corner's coordinate [px]."""

    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]
    sigma_px: float


def estimate_poses(
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    camera: Camera,
    lens_unknowns: int = 0,
) -> Poses:
    """Estimates `cam_from_target` of each view.

    Both solutions of the planar problem are refined and kept while they cannot be distinguished,
    and a board with rotational symmetry has each of them in every turn.

    Args:
        corners: The corners by view; at least one view.
        targets: The targets; the corners of several are numbered through.
        camera: The intrinsics.
        lens_unknowns: Number of intrinsics that were estimated from these same corners.

    Returns:
        The poses; outlier views are rejected.

    Raises:
        DataError: The lens's distortion cannot be inverted at any view's corners.
    """
    positions = numbered_positions(targets)
    reasons: dict[int, str] = {}
    with one_blas_thread():
        stack, starts = _with_starts(CornerStack.of(corners, positions), camera, reasons)
        fit = fit_poses(stack, camera, starts[0])
        for _ in range(3):
            gated = gate(stack, fit.residuals)
            if gated.is_open:
                break
            reasons |= gated.reasons
            stack, starts = _with_starts(stack.keep(gated.mask), camera, reasons)
            fit = fit_poses(stack, camera, starts[0])
        weighted = stack.weighed(fit.residuals)
        if weighted is not stack:
            stack, fit = weighted, fit_poses(weighted, camera, fit.cam_from_target)
        sigma_px = stack.sigma_px(fit.residuals, 6 * len(stack.views) + lens_unknowns)
        views = _with_rivals(stack, camera, fit, starts[1], sigma_px, targets)
    return Poses(views, tuple(Rejection(*item) for item in reasons.items()), sigma_px)


def measure_poses(
    corners: Mapping[int, Corners], targets: Sequence[Target], camera: Camera, sigma_px: float
) -> tuple[ViewPoses, ...]:
    """Poses of views that are not fitted: with a given noise, ungated."""
    if not corners:
        return ()
    with one_blas_thread():
        stack, starts = _with_starts(
            CornerStack.of(corners, numbered_positions(targets)), camera, reasons={}
        )
        fit = fit_poses(stack, camera, starts[0])
        return _with_rivals(stack, camera, fit, starts[1], sigma_px, targets)


def _with_starts(
    stack: CornerStack, camera: Camera, reasons: dict[int, str]
) -> tuple[CornerStack, tuple[FloatArray, FloatArray]]:
    """Closed-form starts, and the views that have them; the others' reasons are added."""
    guess = planar_poses(stack, camera)
    if not guess.solved.any():
        raise DataError(
            "pnp: no view's pose can be solved: the lens's distortion cannot be inverted where the "
            "corners are.",
            culprits=["session.toml: camera.distortion"],
            next_step="Check the distortion coefficients: their number, order and model.",
        )
    lost = [view for view, solved in zip(stack.views, guess.solved, strict=True) if not solved]
    why = "no pose: the lens's distortion cannot be inverted where its corners are"
    reasons |= dict.fromkeys(lost, why)
    first, second = guess.first[guess.solved], guess.second[guess.solved]
    return stack.keep(guess.solved[stack.view_of]), (first, second)


def _with_rivals(
    stack: CornerStack,
    camera: Camera,
    fit: PoseFit,
    mirrored: FloatArray,
    sigma_px: float,
    targets: Sequence[Target],
) -> tuple[ViewPoses, ...]:
    """Collects each view's candidates: rival planar solutions, in all turns of the target."""
    fits, each = (fit, fit_poses(stack, camera, mirrored)), np.arange(len(stack.views))
    squares = np.array([mean_square_by_view(stack, at.residuals) for at in fits])
    order = np.argsort(squares, axis=0, kind="stable")
    (best, worse), variance = squares[order, each], floored_sigma_px(sigma_px) ** 2
    poses = np.array([at.cam_from_target for at in fits])[order, each]
    information = np.array([at.information for at in fits])[order, each]
    # Elsewhere the mirrored pose has no minimum of its own, and the fit reaches the first one.
    # Smaller differences of rotation [rad] are one pose that was reached from both starts, not
    # quite as near where corners are all but exact; poses that are mirrored differ by twice the
    # board's tilt.
    differ = np.abs(poses[0] - poses[1])[:, :3, :3].max(axis=(1, 2)) > 1e-3
    mahalanobis_sq = stack.counts * (worse - best) / variance
    # The mirrored pose of a planar target stays a candidate while its rms is within this ratio of
    # the better one's, as systematic errors of lens and board can change the order up to there, or
    # while the difference in squared error is within 6 sigma.
    rivals = differ & ((worse < 2.0**2 * best) | (mahalanobis_sq < 36.0))
    firsts = first_corners(targets)
    boards = np.searchsorted(firsts, stack.ids[stack.starts], side="right") - 1
    turns_of = [rotation_transforms(target) for target in targets]
    adjoints = [adjoint(invert(turns)) for turns in turns_of]
    views = []
    for at, (view, board) in enumerate(zip(stack.views, boards.tolist(), strict=True)):
        count, turns, by_turn = 1 + int(rivals[at]), turns_of[board], adjoints[board]
        covariance = variance * covariance_from(information[:count, at])[:, None]
        views.append(
            ViewPoses(
                view,
                _inlier_corners(stack, at),
                (poses[:count, at, None] @ turns).reshape(-1, 4, 4),
                tuple(range(len(turns))) * count,
                (by_turn @ covariance @ np.swapaxes(by_turn, 1, 2)).reshape(-1, 6, 6),
                np.zeros((len(turns) * count, 6, 0)),
                board,
                int(firsts[board]),
            )
        )
    return tuple(views)


def _inlier_corners(stack: CornerStack, at: int) -> Corners:
    """The inlier corners of a view."""
    rows = slice(stack.starts[at], stack.starts[at] + stack.counts[at])
    weights = None if stack.weights is None else stack.weights[rows]
    return Corners(
        stack.views[at], stack.ids[rows], stack.px[rows], stack.blurs[at], weights, stack.stated_px
    )

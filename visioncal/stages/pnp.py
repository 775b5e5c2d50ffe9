"""Stage 3: the pose of the target in each view, with covariance and with its rivals."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.errors import DataError
from visioncal.estimator.corners import CornerStack, mean_square_by_view, reproject
from visioncal.estimator.gating import gate
from visioncal.estimator.linalg import covariance, one_blas_thread
from visioncal.estimator.planar import planar_poses
from visioncal.estimator.poses import PoseFit, fit_poses
from visioncal.session import Session
from visioncal.targets import corner_positions, rotation_transforms
from visioncal.transforms import adjoint, invert
from visioncal.types import Camera, Corners, FloatArray, Mask, Rejection, Target

# The mirrored pose of a planar target stays a candidate while its rms is under this many times
# the better one's: systematic errors of lens and board can change the order up to there.
_RIVAL_RATIO = 2.0
# ... or while the difference in squared error is no surprise: 6 sigma.
_RIVAL_CHI2 = 36.0
# The closed form's guess is worth refining while its rms [px] is under this many times the better
# pose's, or about a pixel: the fit brings it down by two at most.
_PROMISING_RATIO = 5.0
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class ViewPoses:
    """The poses that one view allows.

    Attributes:
        view: The view's number.
        corners: The corners that passed the gate; None where the session gave the pose itself.
        cam_from_target: (c, 4, 4) candidates, the best by reprojection first.
        turns: (c,) which of the target's own symmetries each candidate has applied.
        covariance: (c, 6, 6) of the candidates' right perturbations; zero where the session gave
            the pose itself.
        by_intrinsics: (c, 6, k) how each candidate moves with the intrinsics; k = 0 where the
            session gave the pose itself.
        rms_px: Reprojection error of the first candidate by itself [px]; 0 without corners.
    """

    view: int
    corners: Corners | None
    cam_from_target: FloatArray
    turns: tuple[int, ...]
    covariance: FloatArray
    by_intrinsics: FloatArray
    rms_px: float


@dataclass(frozen=True, eq=False)
class Poses:
    """The poses of all views, those given up, and the noise of a corner's coordinate [px]."""

    views: tuple[ViewPoses, ...]
    rejections: tuple[Rejection, ...]
    sigma_px: float


def estimate_poses(corners: Mapping[int, Corners], target: Target, camera: Camera) -> Poses:
    """Estimates `cam_from_target` of each view.

    Both solutions of the planar problem are refined and kept while they cannot be told apart, and
    a board that looks the same after a turn gives each of them once a turn.

    Args:
        corners: The corners by view.
        target: What was seen.
        camera: The intrinsics.

    Returns:
        The poses; views whose residual is no noise are rejected.

    Raises:
        DataError: No view is left.
    """
    if not corners:
        raise DataError("pnp: no view shows the target.", next_step="Look at the reasons above.")
    stack = CornerStack.of(corners, corner_positions(target))
    reasons: dict[int, str] = {}
    with one_blas_thread():
        starts = planar_poses(stack, camera)
        fit = fit_poses(stack, camera, starts[0])
        for _ in range(_ROUNDS):
            passed = gate(stack, fit.residuals)
            if passed.is_open:
                break
            reasons |= passed.reasons
            stack = stack.keep(passed.mask)
            starts = planar_poses(stack, camera)
            fit = fit_poses(stack, camera, starts[0])
        best, other = _sorted(stack, fit, _mirrored(stack, camera, fit, starts[1]))
    sigma_px = pixel_noise(stack, best.residuals)
    mean_squares = [mean_square_by_view(stack, fit.residuals) for fit in (best, other)]
    turns = rotation_transforms(target)
    turned = adjoint(invert(turns))
    spreads = [sigma_px**2 * covariance(fit.information) for fit in (best, other)]
    views = []
    for at, view in enumerate(stack.views):
        rival = _is_rival(mean_squares[0][at], mean_squares[1][at], stack.counts[at], sigma_px)
        fits = (best, other) if rival else (best,)
        poses = [fit.cam_from_target[at] @ turns for fit in fits]
        spread = [turned @ it[at] @ np.swapaxes(turned, 1, 2) for it in spreads[: len(fits)]]
        views.append(
            ViewPoses(
                view,
                _surviving(corners[view], stack, at),
                np.concatenate(poses),
                tuple(range(len(turns))) * len(fits),
                np.concatenate(spread),
                np.concatenate([turned @ fit.by_intrinsics[at] for fit in fits]),
                float(np.sqrt(mean_squares[0][at])),
            )
        )
    return Poses(tuple(views), tuple(Rejection(*item) for item in reasons.items()), sigma_px)


def given_poses(session: Session) -> dict[int, ViewPoses]:
    """Collects the poses that the session gives itself (`cft_` columns), by view."""
    given = ((view, view.cam_from_target()) for view in session.views)
    return {
        view.number: ViewPoses(
            view.number,
            None,
            np.asarray(pose.as_matrix())[None],
            (0,),
            np.zeros((1, 6, 6)),
            np.zeros((1, 6, 0)),
            0.0,
        )
        for view, pose in given
        if pose is not None
    }


def pixel_noise(stack: CornerStack, residuals: FloatArray, parameters: int = 0) -> float:
    """Standard deviation of a corner's coordinate [px], poses (and more parameters) fitted."""
    freedom = 2 * len(stack.px) - 6 * len(stack.views) - parameters
    return float(np.sqrt(np.sum(residuals**2) / max(freedom, 1)))


def _mirrored(stack: CornerStack, camera: Camera, fit: PoseFit, starts: FloatArray) -> PoseFit:
    """Refines the other planar solution in the views where it may be a rival.

    Elsewhere it has no minimum of its own, and a fit from there would wander to the first one:
    that one stands in for it.
    """
    raw = mean_square_by_view(stack, reproject(stack, camera, starts).residuals)
    promising = raw < _PROMISING_RATIO**2 * mean_square_by_view(stack, fit.residuals) + 1.0
    of_corner = promising[stack.view_of]
    if not promising.any():
        return fit
    part = fit_poses(stack.keep(of_corner), camera, starts[promising])
    return PoseFit(
        _replaced(fit.cam_from_target, promising, part.cam_from_target),
        _replaced(fit.information, promising, part.information),
        _replaced(fit.by_intrinsics, promising, part.by_intrinsics),
        _replaced(fit.residuals, of_corner, part.residuals),
    )


def _replaced(values: FloatArray, rows: Mask, new: FloatArray) -> FloatArray:
    changed = values.copy()
    changed[rows] = new
    return changed


def _sorted(stack: CornerStack, first: PoseFit, second: PoseFit) -> tuple[PoseFit, PoseFit]:
    """Exchanges the fits' views so that of each the first has the smaller residuals."""
    squares = [mean_square_by_view(stack, fit.residuals) for fit in (first, second)]
    swap = squares[1] < squares[0]
    of_corner = swap[stack.view_of]

    def pick(a: PoseFit, b: PoseFit) -> PoseFit:
        return PoseFit(
            np.where(swap[:, None, None], b.cam_from_target, a.cam_from_target),
            np.where(swap[:, None, None], b.information, a.information),
            np.where(swap[:, None, None], b.by_intrinsics, a.by_intrinsics),
            np.where(of_corner[:, None], b.residuals, a.residuals),
        )

    return pick(first, second), pick(second, first)


def _is_rival(best: float, other: float, corners: int, sigma_px: float) -> bool:
    """Whether the mirrored pose explains a view's corners about as well as the better one."""
    if np.isclose(best, other, rtol=1e-6, atol=0.0):
        return False  # both starts ran into the same pose
    surprise = corners * (other - best) / sigma_px**2
    return bool(other < _RIVAL_RATIO**2 * best or surprise < _RIVAL_CHI2)


def _surviving(corners: Corners, stack: CornerStack, at: int) -> Corners:
    """The corners of a view that the gate let pass."""
    rows = slice(stack.starts[at], stack.starts[at] + stack.counts[at])
    return Corners(corners.view, stack.ids[rows], stack.px[rows], corners.blur_px)

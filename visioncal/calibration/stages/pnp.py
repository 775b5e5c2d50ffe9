"""The pose of the target in each view, with covariance and with its rivals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import Camera, Corners, FloatArray, Mask, Rejection, Target
from visioncal.estimation.corners import (
    CornerStack,
    floored_sigma_px,
    mean_square_by_view,
    reproject,
)
from visioncal.estimation.gating import gate
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.poses import PoseFit, fit_poses, planar_poses
from visioncal.session import Session
from visioncal.vision.targets import first_corners, numbered_positions, rotation_transforms

# The mirrored pose of a planar target stays a candidate while its rms is under this many times
# the better one's: systematic errors of lens and board can change the order up to there.
_RIVAL_RATIO = 2.0
# ... or while the difference in squared error is no surprise: 6 sigma.
_RIVAL_CHI2 = 36.0
# The closed form's guess is refined while its rms [px] is under this many times the better
# pose's, or about a pixel: the fit brings it down by two at most.
_PROMISING_RATIO = 5.0
# Rotations [rad] no further apart are one pose that was reached from both starts.
_SAME_RAD = 1e-5
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
        by_shared: (c, 6, k) how each candidate moves with the unknowns that all views share, once
            it is known which these are; k = 0 before.
        board: Which of several targets it is.
        first: The number of the target's first corner, where several are numbered through.
    """

    view: int
    corners: Corners | None
    cam_from_target: FloatArray
    turns: tuple[int, ...]
    covariance: FloatArray
    by_shared: FloatArray
    board: int = 0
    first: int = 0


@dataclass(frozen=True, eq=False)
class Poses:
    """The poses of all views, those given up, and the noise of a corner's coordinate [px]."""

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
    and a board that looks the same after a turn gives each of them once a turn.

    Args:
        corners: The corners by view; at least one view.
        targets: What was seen; the corners of several are numbered through.
        camera: The intrinsics.
        lens_unknowns: How many intrinsics were estimated from these same corners.

    Returns:
        The poses; views whose residual is no noise are rejected.

    Raises:
        DataError: The lens's distortion cannot be inverted at any view's corners.
    """
    positions = numbered_positions(targets)
    reasons: dict[int, str] = {}
    with one_blas_thread():
        stack, starts = _started(CornerStack.of(corners, positions), camera, reasons)
        fit = fit_poses(stack, camera, starts[0])
        for _ in range(_ROUNDS):
            passed = gate(stack, fit.residuals)
            if passed.is_open:
                break
            reasons |= passed.reasons
            stack, starts = _started(stack.keep(passed.mask), camera, reasons)
            fit = fit_poses(stack, camera, starts[0])
        weighed = stack.weighed(fit.residuals)
        if weighed is not stack:
            stack, fit = weighed, fit_poses(weighed, camera, fit.cam_from_target)
        sigma_px = stack.sigma_px(fit.residuals, 6 * len(stack.views) + lens_unknowns)
        views = _with_rivals(stack, camera, fit, starts[1], sigma_px, targets)
    return Poses(views, tuple(Rejection(*item) for item in reasons.items()), sigma_px)


def measure_poses(
    corners: Mapping[int, Corners], targets: Sequence[Target], camera: Camera, sigma_px: float
) -> tuple[ViewPoses, ...]:
    """Poses of views that are only to be looked at: by a noise that others have set, ungated."""
    if not corners:
        return ()
    with one_blas_thread():
        stack, starts = _started(
            CornerStack.of(corners, numbered_positions(targets)), camera, reasons={}
        )
        fit = fit_poses(stack, camera, starts[0])
        return _with_rivals(stack, camera, fit, starts[1], sigma_px, targets)


def _started(
    stack: CornerStack, camera: Camera, reasons: dict[int, str]
) -> tuple[CornerStack, tuple[FloatArray, FloatArray]]:
    """Closed-form starts, and the views that have them; the others' reasons are added."""
    guess = planar_poses(stack, camera)
    if not guess.solved.any():
        raise DataError(
            "pnp: no view's pose can be solved: the lens's distortion cannot be inverted where the "
            "corners are.",
            next_step="Check the distortion coefficients: their number, order and model.",
        )
    lost = [view for view, solved in zip(stack.views, guess.solved, strict=True) if not solved]
    reasons |= dict.fromkeys(
        lost, "no pose: the lens's distortion cannot be inverted where its corners are"
    )
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
    """Gives each view its candidates: the planar solutions that rival, in all of its turns."""
    best, other = _sorted(stack, fit, _mirrored(stack, camera, fit, mirrored))
    mean_squares = [mean_square_by_view(stack, pose_fit.residuals) for pose_fit in (best, other)]
    turns_of = [rotation_transforms(target) for target in targets]
    turned_of = [adjoint(invert(turn)) for turn in turns_of]
    firsts = first_corners(targets)
    boards = np.searchsorted(firsts, stack.ids[stack.starts], side="right") - 1
    spreads = [
        floored_sigma_px(sigma_px) ** 2 * covariance_from(pose_fit.information)
        for pose_fit in (best, other)
    ]
    turned_by = np.abs(best.cam_from_target - other.cam_from_target)[:, :3, :3].max(axis=(1, 2))
    views = []
    for at, (view, board) in enumerate(zip(stack.views, boards.tolist(), strict=True)):
        turns, turned = turns_of[board], turned_of[board]
        rival = turned_by[at] > _SAME_RAD and _is_rival(
            mean_squares[0][at], mean_squares[1][at], stack.counts[at], sigma_px
        )
        fits = (best, other) if rival else (best,)
        covariances = [
            turned @ spread[at] @ np.swapaxes(turned, 1, 2) for spread in spreads[: len(fits)]
        ]
        views.append(
            ViewPoses(
                view,
                _surviving(stack, at),
                np.concatenate([pose_fit.cam_from_target[at] @ turns for pose_fit in fits]),
                tuple(range(len(turns))) * len(fits),
                np.concatenate(covariances),
                np.zeros((len(turns) * len(fits), 6, 0)),
                board,
                int(firsts[board]),
            )
        )
    return tuple(views)


def given_poses(session: Session) -> dict[int, ViewPoses]:
    """Collects the poses that the session gives itself (`cft_` columns), by view."""
    boards = {name: at for at, name in enumerate(session.boards)}
    given = ((view, view.cam_from_target()) for view in session.views)
    return {
        view.number: ViewPoses(
            view.number,
            None,
            np.asarray(pose.as_matrix())[None],
            (0,),
            np.zeros((1, 6, 6)),
            np.zeros((1, 6, 0)),
            boards.get(session.board_of(view), 0),
        )
        for view, pose in given
        if pose is not None
    }


def _mirrored(stack: CornerStack, camera: Camera, fit: PoseFit, starts: FloatArray) -> PoseFit:
    """Refines the other planar solution in the views where it may be a rival."""
    # Elsewhere it has no minimum of its own, and a fit from there would wander to the first one:
    # that one stands in for it.
    raw = mean_square_by_view(stack, reproject(stack, camera, starts).residuals)
    promising = raw < _PROMISING_RATIO**2 * mean_square_by_view(stack, fit.residuals) + 1.0
    of_corner = promising[stack.view_of]
    if not promising.any():
        return fit
    part = fit_poses(stack.keep(of_corner), camera, starts[promising])
    return PoseFit(
        _replaced(fit.cam_from_target, promising, part.cam_from_target),
        _replaced(fit.information, promising, part.information),
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
            np.where(of_corner[:, None], b.residuals, a.residuals),
        )

    return pick(first, second), pick(second, first)


def _is_rival(best: float, other: float, corners: int, sigma_px: float) -> bool:
    """Whether the mirrored pose explains a view's corners about as well as the better one."""
    mahalanobis_sq = corners * (other - best) / floored_sigma_px(sigma_px) ** 2
    return bool(other < _RIVAL_RATIO**2 * best or mahalanobis_sq < _RIVAL_CHI2)


def _surviving(stack: CornerStack, at: int) -> Corners:
    """The corners of a view that the gate let pass."""
    rows = slice(stack.starts[at], stack.starts[at] + stack.counts[at])
    weights = None if stack.weights is None else stack.weights[rows]
    return Corners(
        stack.views[at], stack.ids[rows], stack.px[rows], stack.blurs[at], weights, stack.stated_px
    )

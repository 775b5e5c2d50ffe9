"""Cross-validation: each observation is predicted by a fit without its stop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import apply, distances
from visioncal.core.types import Camera, Corners, FloatArray, IntArray, Mask
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.vision.camera import project


@dataclass(frozen=True, eq=False)
class HeldOutResiduals:
    """Residuals of held-out observations."""

    method: str  # The method of cross-validation, in words.
    # (n,) distance between the observed and the predicted position [m]; NaN where the other
    # observations do not determine it.
    residual_m: FloatArray
    residual_rad: FloatArray  # (n,) angle between the rotations [rad]; NaN for positions alone.
    rms_px: FloatArray  # (n,) reprojection error through the chain [px]; NaN without corners.


def cross_validate(
    problem: Problem,
    refit: Callable[[Mask], State],
    pixels: Callable[[IntArray, FloatArray, State], FloatArray],
    of: str = "",
) -> HeldOutResiduals:
    """Holds stops out, one by one or in ten groups, and predicts their observations.

    Args:
        problem: The n observations in the fit.
        refit: Fits those of an (n,) mask.
        pixels: Reprojection errors (m,) [px] of some observations (m,), which are predicted at
            (m, 4, 4), at a state.
        of: What is fitted, as a part of the method's words.

    Returns:
        The residuals; NaN for what the others do not determine.
    """
    stops = np.unique(problem.observations.stops, return_inverse=True)[1]
    needed = _needed_frames(problem)
    count = int(stops.max()) + 1
    # Few stops are held out one by one; with more, ten groups suffice.
    folds = count if count <= 30 else 10
    # Strides, so that a group's stops are not neighbours.
    fold = stops % folds
    away_m, away_rad, rms_px = (np.full(len(problem), np.nan) for _ in range(3))
    with one_blas_thread():
        for left_out in range(folds):
            kept = fold != left_out
            determined = needed[kept].any(axis=0)
            held = ~kept & ~(needed & ~determined).any(axis=1)
            if not held.any():
                continue
            state = refit(kept)
            predicted = problem.predicted(state)
            off_m, off_rad = pose_residuals(problem, state, predicted)
            away_m[held], away_rad[held] = off_m[held], off_rad[held]
            rms_px[held] = pixels(np.flatnonzero(held), predicted[held], state)
    method = "leave-one-out" if folds == count else f"{folds}-fold"
    unit = "views" if count == len(problem) else "stops"
    return HeldOutResiduals(f"{method} over {unit}{of}", away_m, away_rad, rms_px)


def _needed_frames(problem: Problem) -> Mask:
    """(n, u) the unknown frames in the path of each observation."""
    needed = np.zeros((len(problem), len(problem.unknown)), dtype=bool)
    for group in problem.groups:
        frames = [step.frame for step in group.path if step.frame in problem.unknown]
        needed[group.rows[:, None], [problem.unknown[frame] for frame in frames]] = True
    return needed


def pose_residuals(
    problem: Problem, state: State, predicted: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n,) [m] and (n,) [rad] of observations; (n, 4, 4) `predicted` if known."""
    predicted = problem.predicted(state) if predicted is None else predicted
    away_m, away_rad = distances(problem.measured(state), predicted)
    observations = problem.observations
    # The rotation of a mere point is arbitrary.
    is_point = np.isin(observations.observed, list(problem.points))
    return away_m, np.where(observations.has_rotation & ~is_point, away_rad, np.nan)


def chain_rms_px(
    seen: Sequence[Corners | None],
    poses: FloatArray,
    cameras: Sequence[Camera | None],
    positions: FloatArray,
) -> FloatArray:
    """Reprojection error of each view's corners, (m,) [px]; NaN without corners.

    Args:
        seen: (m,) each view's corners.
        poses: (m, 4, 4) `cam_from_target` by the chain.
        cameras: (m,) each view's camera, where it has corners.
        positions: (c, 3) all corners, each on its target [m].
    """
    rms = np.full(len(poses), np.nan)
    for at, (corners, camera) in enumerate(zip(seen, cameras, strict=True)):
        if camera is None or corners is None:
            continue
        residuals = project(camera, apply(poses[at], positions[corners.ids])) - corners.px
        # A corner behind the camera counts as a whole image width of error.
        residuals = np.nan_to_num(residuals, nan=float(max(camera.resolution)))
        rms[at] = np.sqrt(np.mean(np.sum(residuals**2, axis=1)))
    return rms

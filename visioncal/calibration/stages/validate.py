"""Residuals of observations, of those that are left out of a fit, and of their corners."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import apply, distances
from visioncal.core.types import Camera, Corners, FloatArray, Mask
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


def needed_frames(problem: Problem) -> Mask:
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

"""Stage 6: predicts each view from a fit that has not seen it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.camera import project
from visioncal.estimator.closure import Closure, distances
from visioncal.estimator.linalg import one_blas_thread
from visioncal.stages.handeye import HandEyeResult, refit
from visioncal.types import Camera, Corners, FloatArray, SolverName

# Up to here every view is left out by itself; beyond, ten groups tell the same.
_MOST_FOLDS_OF_ONE = 30
_FOLDS = 10


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residuals of views that the fit had not seen.

    Attributes:
        method: How views were left out, in words.
        away_m: (m,) distance between where the view and the fit place the target [m].
        away_rad: (m,) the same in rotation [rad].
        rms_px: (m,) reprojection error through the chain [px]; NaN for views without corners.
    """

    method: str
    away_m: FloatArray
    away_rad: FloatArray
    rms_px: FloatArray


def validate(
    data: Closure,
    result: HandEyeResult,
    solver: SolverName,
    corners: Sequence[tuple[Corners, FloatArray] | None],
    camera: Camera | None,
) -> HeldOut:
    """Leaves views out, one by one or in ten groups, and predicts them from the others.

    Args:
        data: The used views.
        result: The fit to all of them.
        solver: The solver to fit again with.
        corners: Each view's corners with their (n, 3) positions on the target [m], if any.
        camera: The intrinsics, if any.

    Returns:
        The residuals.
    """
    count = len(data)
    folds = count if count <= _MOST_FOLDS_OF_ONE else _FOLDS
    # Strides, so that a group's views are not neighbours.
    fold = np.arange(count) % folds
    away_m, away_rad, rms_px = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    with one_blas_thread():
        for left_out in range(folds):
            held = fold == left_out
            x, z = refit(data.subset(~held), result, solver)
            away_m[held], away_rad[held] = distances(data.subset(held).placed(x), z)
            rms_px[held] = chain_rms_px(
                data.subset(held), x, z, [corners[int(at)] for at in np.flatnonzero(held)], camera
            )
    method = "leave-one-out" if folds == count else f"{folds}-fold"
    return HeldOut(method, away_m, away_rad, rms_px)


def chain_rms_px(
    data: Closure,
    x: FloatArray,
    z: FloatArray,
    corners: Sequence[tuple[Corners, FloatArray] | None],
    camera: Camera | None,
) -> FloatArray:
    """Reprojection error of each view through the whole chain, (m,) [px]; NaN where unseen."""
    rms = np.full(len(data), np.nan)
    if camera is None:
        return rms
    for at, (pose, seen) in enumerate(zip(data.predicted_camera(x, z), corners, strict=True)):
        if seen is not None:
            away = predict_corners(camera, pose, seen[1]) - seen[0].px
            rms[at] = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    return rms


def predict_corners(
    camera: Camera, cam_from_target: FloatArray, positions: FloatArray
) -> FloatArray:
    """Projects a target's (n, 3) corners [m] at a pose, to (n, 2) [px]."""
    return project(camera, positions @ cam_from_target[:3, :3].T + cam_from_target[:3, 3])

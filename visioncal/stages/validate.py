"""Predicts each observation from a fit that was made without its stop."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.camera import project
from visioncal.estimation.appearance import Free
from visioncal.estimation.problem import Problem, State
from visioncal.threads import one_blas_thread
from visioncal.transforms import distances
from visioncal.types import Camera, Corners, FloatArray, IntArray, Mask

# Up to here every stop is left out by itself; beyond, ten groups say the same.
_MOST_FOLDS_OF_ONE = 30
_FOLDS = 10


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residuals of observations that the fit had not seen.

    Attributes:
        method: How they were left out, in words.
        away_m: (n,) distance between where the observation and the fit place what it saw [m]; NaN
            where the others do not place it.
        away_rad: (n,) the same in rotation [rad]; NaN where places alone were read.
        rms_px: (n,) reprojection error through the chain [px]; NaN without corners.
    """

    method: str
    away_m: FloatArray
    away_rad: FloatArray
    rms_px: FloatArray


def validate(
    problem: Problem,
    stops: IntArray,
    needs: Sequence[Collection[str]],
    refit: Callable[[Mask], State],
    pixels: Callable[[IntArray, State], FloatArray],
) -> HeldOut:
    """Leaves stops out, one by one or in ten groups, and predicts what was observed there.

    Args:
        problem: The n observations in the fit.
        stops: (n,) the stop of each, numbered from 0; those of one are left out together.
        needs: (n,) the names of what each observation needs to be placed by others.
        refit: Fits those of an (n,) mask.
        pixels: Reprojection errors (m,) [px] of (m,) observations at a state.

    Returns:
        The residuals.
    """
    count = int(stops.max()) + 1
    folds = count if count <= _MOST_FOLDS_OF_ONE else _FOLDS
    # Strides, so that a group's stops are not neighbours.
    fold = stops % folds
    away_m, away_rad, rms_px = (np.full(len(problem), np.nan) for _ in range(3))
    with one_blas_thread():
        for left_out in range(folds):
            kept = fold != left_out
            known = {it for row, its in enumerate(needs) if kept[row] for it in its}
            held = np.array(
                [not kept[row] and known.issuperset(it) for row, it in enumerate(needs)]
            )
            if not held.any():
                continue
            state, rows = refit(kept), np.flatnonzero(held)
            away_m[held], away_rad[held] = apart(problem.subset(held), state)
            rms_px[held] = pixels(rows, state)
    method = "leave-one-out" if folds == count else f"{folds}-fold"
    unit = "views" if count == len(problem) else "stops"
    return HeldOut(f"{method} over {unit}", away_m, away_rad, rms_px)


def apart(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """How far (n,) [m] and (n,) [rad] observations are from what is predicted.

    Args:
        problem: The observations.
        state: The unknowns.
    """
    away_m, turned = distances(problem.measured(state), problem.predicted(state))
    return away_m, np.where(problem.observations.has_rotation, turned, np.nan)


def chain_rms_px(
    seen: Sequence[Corners | None], poses: FloatArray, free: Free | None, change: FloatArray
) -> FloatArray:
    """Reprojection error of each view's corners, (m,) [px]; NaN where there are none.

    Args:
        seen: (m,) each view's corners.
        poses: (m, 4, 4) `cam_from_target` as the chain predicts it.
        free: Lens and board that the views' poses were made with; None without corners.
        change: (k,) by how much they changed since.
    """
    rms = np.full(len(poses), np.nan)
    if free is None:
        return rms
    camera, positions = free.after(change).camera, free.corners_after(change)
    for at, (pose, it) in enumerate(zip(poses, seen, strict=True)):
        if it is not None:
            away = predict_corners(camera, pose, positions[it.ids]) - it.px
            # A corner behind the camera counts as a whole image away.
            away = np.nan_to_num(away, nan=float(max(camera.resolution)))
            rms[at] = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    return rms


def predict_corners(
    camera: Camera, cam_from_target: FloatArray, positions: FloatArray
) -> FloatArray:
    """Projects a target's (n, 3) corners [m] at a pose, to (n, 2) [px]."""
    return project(camera, positions @ cam_from_target[:3, :3].T + cam_from_target[:3, 3])

"""Predicts each view from a fit that has not seen it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.camera import project
from visioncal.estimation.appearance import Free
from visioncal.estimation.boards import Boards
from visioncal.estimation.closure import Closure, Edges, distances
from visioncal.stages.handeye import HandEyeResult, refit
from visioncal.threads import one_blas_thread
from visioncal.types import Camera, Corners, FloatArray, IntArray, SolverName

# Up to here every view is left out by itself; beyond, ten groups tell the same.
_MOST_FOLDS_OF_ONE = 30
_FOLDS = 10


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residuals of views that the fit had not seen.

    Attributes:
        method: How views were left out, in words.
        away_m: (m,) distance between where the view and the fit place the target [m].
        away_rad: (m,) the same in rotation [rad]; NaN where places alone were read.
        rms_px: (m,) reprojection error through the chain [px]; NaN for views without corners.
    """

    method: str
    away_m: FloatArray
    away_rad: FloatArray
    rms_px: FloatArray


def validate(
    data: Closure,
    stops: IntArray,
    result: HandEyeResult,
    solver: SolverName,
    corners: Sequence[Corners | None],
    free: Free | None,
    boards: Boards,
) -> HeldOut:
    """Leaves stops out, one by one or in ten groups, and predicts their views from the others.

    Args:
        data: The used views.
        stops: (m,) which stop of the robot each was taken at; they are left out together.
        result: The fit to all of them.
        solver: The solver to fit again with.
        corners: Each view's corners, if any.
        free: Lens and board, if there are corners.
        boards: What the views show, where there are several boards. A view that alone shows its
            board cannot be predicted by the others: its residuals are NaN.

    Returns:
        The residuals.
    """
    count = int(stops.max()) + 1
    folds = count if count <= _MOST_FOLDS_OF_ONE else _FOLDS
    # Strides, so that a group's stops are not neighbours.
    fold = stops % folds
    away_m, away_rad, rms_px = (np.full(len(data), np.nan) for _ in range(3))
    with one_blas_thread():
        for left_out in range(folds):
            held = fold == left_out
            rest = data.subset(~held).merged(_renumbered(stops[~held]))
            edges = refit(rest, result, solver)
            held &= np.isin(boards.shown, boards.shown[~held])
            left, own = data.subset(held), boards.moved(edges.shared).first_from_own[held]
            placed = left.under(edges.shared).placed(edges.x)
            away_m[held], turned = distances(placed @ own, edges.z @ own)
            away_rad[held] = turned if data.guess is None else np.nan
            seen = [corners[int(at)] for at in np.flatnonzero(held)]
            rms_px[held] = chain_rms_px(left, edges, seen, free, own)
    method = "leave-one-out" if folds == count else f"{folds}-fold"
    fit = "whole fit" if data.mount == "instrument" else "hand-eye fit"
    unit = "views" if count == len(data) else "stops of the robot"
    return HeldOut(f"{method} over {unit}, of the {fit}", away_m, away_rad, rms_px)


def _renumbered(stops: IntArray) -> IntArray:
    return np.unique(stops, return_inverse=True)[1].astype(np.int64)


def chain_rms_px(
    data: Closure,
    edges: Edges,
    corners: Sequence[Corners | None],
    free: Free | None,
    first_from_own: FloatArray,
) -> FloatArray:
    """Reprojection error of each view through the whole chain, (m,) [px]; NaN where unseen.

    Lens and board are those that the views' poses were made with; the edges carry their change.
    `first_from_own` (m, 4, 4) is each view's board in the frame of the first.
    """
    rms = np.full(len(data), np.nan)
    if free is None:
        return rms
    camera, positions = free.after(edges.shared).camera, free.corners_after(edges.shared)
    poses = data.under(edges.shared).predicted_camera(edges.x, edges.z) @ first_from_own
    for at, (pose, seen) in enumerate(zip(poses, corners, strict=True)):
        if seen is not None:
            away = predict_corners(camera, pose, positions[seen.ids]) - seen.px
            # A corner behind the camera counts as a whole image away.
            away = np.nan_to_num(away, nan=float(max(camera.resolution)))
            rms[at] = np.sqrt(np.mean(np.sum(away**2, axis=1)))
    return rms


def predict_corners(
    camera: Camera, cam_from_target: FloatArray, positions: FloatArray
) -> FloatArray:
    """Projects a target's (n, 3) corners [m] at a pose, to (n, 2) [px]."""
    return project(camera, positions @ cam_from_target[:3, :3].T + cam_from_target[:3, 3])

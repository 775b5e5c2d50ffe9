"""Start from places alone: of points that an arm carries, or that its tool's tip touched."""

import numpy as np

from visioncal.core.transforms import exp, skew
from visioncal.core.types import FloatArray
from visioncal.estimation.procrustes import align

# Small sets of places that are tried, and Gauss-Newton steps from each.
_SETS, _STEPS = 60, 10


def robust_carried(
    carriers: FloatArray, places: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Where a carried point is, and the frame in which it was measured, by the nearest half.

    Least trimmed squares over small sets (Rousseeuw and Van Driessen 1999).

    Args:
        carriers: (m, 4, 4) poses of its carrier in the frame that is sought.
        places: (m, 3) of the point as measured [m].

    Returns:
        (4, 4) pose of the measuring frame, of which touches leave the rotation open; (3,) the point
        on its carrier [m]; the mean distance of the nearest half [m].
    """
    count, rng = len(carriers), np.random.default_rng(0)
    half = max(count // 2 + 1, min(count, 6))
    sets = np.array([rng.choice(count, min(7, count), replace=False) for _ in range(_SETS)])
    sets = sets if count > half else np.arange(count)[None]
    off = _off(carriers, places, *_carried(carriers[sets], places[sets]))
    best = off[np.sort(off, axis=1)[:, :half].sum(axis=1).argmin()]
    for _ in range(5):
        near = best.argsort()[:half]
        frame, point = _carried(carriers[None, near], places[None, near])
        best = _off(carriers, places, frame, point)[0]
    return frame[0], point[0], float(np.sort(best)[:half].mean())


def _off(
    carriers: FloatArray, places: FloatArray, frames: FloatArray, points: FloatArray
) -> FloatArray:
    """Distances (k, m) of m places from what each of k solutions predicts [m]."""
    carried = np.einsum("mij,kj->kmi", carriers[:, :3, :3], points) + carriers[:, :3, 3]
    placed = places @ np.swapaxes(frames[:, :3, :3], 1, 2) + frames[:, None, :3, 3]
    return np.asarray(np.linalg.norm(carried - placed, axis=2))


def _carried(carriers: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frames (k, 4, 4) and points (k, 3) of k sets of (k, m, 4, 4) carriers and (k, m, 3) places.

    By Gauss-Newton from a point at the carrier's origin.
    """
    turns, shape = carriers[..., :3, :3], places.shape
    frames, points = align(carriers[..., :3, 3], places), np.zeros((len(places), 3))
    for _ in range(_STEPS):
        turned = frames[:, None, :3, :3] @ places[..., None]
        away = turned[..., 0] + frames[:, None, :3, 3] - (turns @ points[:, None, :, None])[..., 0]
        away -= carriers[..., :3, 3]
        by_frame = frames[:, None, :3, :3] @ np.concatenate(
            [-skew(places), np.broadcast_to(np.eye(3), (*shape, 3))], axis=3
        )
        rows = np.concatenate([by_frame, -turns], axis=3).reshape(len(places), -1, 9)
        turned_rows = np.swapaxes(rows, 1, 2)
        pull = turned_rows @ -away.reshape(len(places), -1, 1)
        solution = np.linalg.pinv(turned_rows @ rows, rcond=1e-12, hermitian=True) @ pull
        frames = frames @ exp(solution[:, :6, 0])
        points = points + solution[:, 6:, 0]
    return frames, points

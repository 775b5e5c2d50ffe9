"""Parts with known places: points of a drawing and touches of features, with noise as asked for."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.estimation.pointfit import PointPairs

# Derivatives by central differences are exact to 1e-8 at this step, of lengths near a metre.
_STEP = 1e-6


def moved(frame: FloatArray, step: FloatArray) -> FloatArray:
    """A (4, 4) frame after a (6,) step on the right, by the matrix exponential."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(step[:3]), step[3:]
    return np.asarray(frame @ expm(generator))


def away(frame: FloatArray, other: FloatArray) -> FloatArray:
    """The small (6,) step on the right that leads from one (4, 4) frame to another."""
    between = np.linalg.inv(frame) @ other
    turn = 0.5 * (between[:3, :3] - between[:3, :3].T)
    return np.concatenate([[turn[2, 1], turn[0, 2], turn[1, 0]], between[:3, 3]])


def placed(frame: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3) of a part that lies at a (4, 4) frame."""
    return points @ frame[:3, :3].T + frame[:3, 3]


def some_frame(rng: np.random.Generator) -> FloatArray:
    """A place on a table, turned anyhow."""
    return moved(np.eye(4), np.concatenate([rng.normal(size=3), rng.uniform(-0.8, 0.8, 3)]))


def some_drawing(rng: np.random.Generator, count: int) -> FloatArray:
    """Points (n, 3) of a part of 40 cm, the first three of them far apart [m]."""
    corners = np.array([[0.0, 0.0, 0.0], [0.36, 0.02, 0.05], [0.07, 0.31, 0.1]])
    return np.vstack([corners, rng.uniform(0.0, 0.4, (count - 3, 3))])


def noise_of(spreads: FloatArray, rng: np.random.Generator) -> FloatArray:
    """One draw (n, 3) of noise with (n, 3, 3) covariances."""
    return np.einsum("nij,nj->ni", np.linalg.cholesky(spreads), rng.normal(size=(len(spreads), 3)))


def even(count: int, sigma_m: float) -> FloatArray:
    """Covariances (n, 3, 3) of noise that is alike everywhere."""
    return np.tile(sigma_m**2 * np.eye(3), (count, 1, 1))


def uneven(rng: np.random.Generator, count: int) -> FloatArray:
    """Covariances (n, 3, 3) of points that a camera saw: ten times worse along some direction."""
    root = 5e-5 * np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    root[:, :, 0] *= 10.0
    return root @ np.swapaxes(root, 1, 2)


def pairs_of(
    nominal: FloatArray, measured: FloatArray, covariances: FloatArray | None = None
) -> PointPairs:
    """Points named P0, P1 ... with what is said of their noise."""
    count = len(measured)
    return PointPairs(
        tuple(f"P{at}" for at in range(count)),
        measured,
        np.zeros((count, 3, 3)) if covariances is None else covariances,
        nominal,
        np.zeros(count),
    )


def some_touches(rng: np.random.Generator, frame: FloatArray, kinds: Sequence[str]) -> PointPairs:
    """Exact touches of a fixture's features, named 0, 1 ..."""
    ranges = {
        "origin": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        "x": ([0.2, 0.0, 0.0], [0.4, 0.0, 0.0]),
        "xy": ([-0.1, 0.1, 0.0], [0.3, 0.3, 0.0]),
    }
    local = np.array([rng.uniform(*ranges[kind]) for kind in kinds])
    names = tuple(str(at) for at in range(len(kinds)))
    return replace(
        pairs_of(np.zeros_like(local), placed(frame, local)), labels=names, kinds=tuple(kinds)
    )


def jacobian(function: Callable[[FloatArray], FloatArray], size: int) -> FloatArray:
    """Derivatives (..., size) of a function of (size,) numbers at zero, by central differences."""
    steps = _STEP * np.eye(size)
    return np.stack([(function(step) - function(-step)) / (2 * _STEP) for step in steps], axis=-1)


def point_bound(frame: FloatArray, nominal: FloatArray, spreads: FloatArray) -> FloatArray:
    """Least covariance (6, 6) of a frame from points with (n, 3, 3) covariances (Cramer-Rao)."""
    by_step = jacobian(lambda array: placed(moved(frame, array), nominal), 6)
    return np.linalg.inv(np.einsum("nij,nik,nkl->jl", by_step, np.linalg.inv(spreads), by_step))


def feature_bound(frame: FloatArray, touches: PointPairs, sigma_m: float) -> FloatArray:
    """Least covariance (6, 6) of a frame from touches with even noise.

    Where a touch lies on the axis or in the plane is unknown beside the frame.
    """
    local = placed(np.linalg.inv(frame), touches.measured)
    free = {"origin": 0, "x": 1, "xy": 2}
    total = np.zeros((6, 6))
    for point, kind in zip(local, touches.kinds, strict=True):
        size = 6 + free[kind]

        def touched(step, point=point):
            return placed(
                moved(frame, step[:6]), (point + np.pad(step[6:], (0, 9 - len(step))))[None]
            )

        by_step = jacobian(touched, size)[0] / sigma_m
        whole = by_step.T @ by_step
        across = whole[:6, 6:]
        total += whole[:6, :6] - across @ np.linalg.solve(whole[6:, 6:], across.T)
    return np.linalg.inv(total)

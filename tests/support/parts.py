"""Parts with known places: points of a drawing and touches of features, with noise as asked for."""

import numpy as np
from scipy.linalg import expm

from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.frames.pointfit import PointPairs


def placed(frame: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3) of a part that lies at a (4, 4) frame."""
    return points @ frame[:3, :3].T + frame[:3, 3]


def some_frame(rng: np.random.Generator) -> FloatArray:
    """A place on a table, turned anyhow, by the matrix exponential."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(rng.normal(size=3)), rng.uniform(-0.8, 0.8, 3)
    return np.asarray(expm(generator))


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

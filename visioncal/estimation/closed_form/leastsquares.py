"""Small normal equations whose unobservable directions must come out as zero."""

import numpy as np

from visioncal.core.types import FloatArray


def smallest_solution(normal: FloatArray, right: FloatArray, noise: float) -> FloatArray:
    """Solves `normal @ x = right` for the shortest x.

    Args:
        normal: (n, n) symmetric and positive semidefinite.
        right: (n,) or (n, k) right-hand sides.
        noise: An eigenvalue up to this one says nothing.

    Returns:
        x of the shape of `right`, without any component along which the eigenvalue is within noise.
    """
    values, vectors = np.linalg.eigh(normal)
    seen = vectors[:, values > noise]
    return np.asarray((seen / values[values > noise]) @ (seen.T @ right))

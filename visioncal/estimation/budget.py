"""Where the uncertainty of a result comes from, and how it looks at a place of work."""

from collections.abc import Mapping

import numpy as np

from visioncal.estimation.closure import Closure, Edges, Noise, closure_information, weighted_slopes
from visioncal.estimation.linalg import covariance, gram
from visioncal.transforms import skew
from visioncal.types import FloatArray, IntArray


def covariance_by_source(
    data: Closure,
    edges: Edges,
    noise: Noise,
    shared: Mapping[str, IntArray],
    seen: str = "pixels",
) -> dict[str, FloatArray]:
    """Splits the covariance of the joint fit into the parts that its sources contribute.

    The estimate is linear in the errors of corners, arm, lens and board: each contributes its own
    covariance through the same gain, and the parts add up to the whole. Lens and board are known
    from the same corners, so their errors hang together: each takes half of what is common, which
    may leave one of them less than nothing where they make up for each other.

    Args:
        data: The views, one a stop.
        edges: The answer.
        noise: Of the flange, or of both together where the camera's is not known.
        shared: Which of the unknowns that the views share belong to which source, a new one or one
            of the others; those of no source count for nothing.
        seen: What the noise of the camera's poses is called.

    Returns:
        (12, 12) by source: `seen`, `robot` (or `poses` for both together), and `shared`'s.
    """
    fitted = covariance(closure_information(data, edges, noise))
    slopes, camera, robot = weighted_slopes(data, edges, noise)
    parts: dict[str, FloatArray] = {}
    if data.camera_covariance is None:
        parts["poses"] = gram(slopes, robot @ slopes)
    else:
        parts[seen] = gram(slopes, camera @ slopes)
        parts["robot"] = gram(slopes, robot @ slopes)
    if data.shared is not None:
        owned = np.concatenate([*shared.values(), np.zeros(0, np.int64)])
        information = data.shared.information[np.ix_(owned, owned)]
        for name, rows in shared.items():
            share = np.where(np.isin(owned, rows), 0.5, 0.0)
            known = np.zeros_like(fitted)
            known[np.ix_(12 + owned, 12 + owned)] = (share[:, None] + share) * information
            parts[name] = parts.get(name, 0.0) + known
    return {name: (fitted @ part @ fitted)[:12, :12] for name, part in parts.items()}


def point_covariance(edge: FloatArray, spread: FloatArray, point: FloatArray) -> FloatArray:
    """Covariance of a point that an uncertain transform carries.

    Args:
        edge: (4, 4) `a_from_b`.
        spread: (6, 6) of its right perturbation (rotation, translation).
        point: (3,) in frame b, exact [m].

    Returns:
        (3, 3) of the point in frame a [m^2].
    """
    slope = edge[:3, :3] @ np.concatenate([-skew(point), np.eye(3)], axis=1)
    return np.asarray(slope @ spread @ slope.T)

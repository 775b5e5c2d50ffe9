"""Errors, by source, of what a calibration is used for: picks, places, tools, the next views.

Each is a forward model f(x) of the calibrated unknowns x. To first order its covariance is the sum
of parts that are independent of each other,

    sigma^2 = J C J'  +  errors that act at the stop itself  +  pixels        J = df / dx

with the covariance C of the unknowns from all sources (of a fit `estimation.fit.Fit.whole`, of a
stored result `results.lens.CameraResult.covariance_with` and `joint_fit`), and never of single
blocks of it: a lens that is estimated from the same views errs with the transform, and where both
are used, most of it cancels. Errors are right perturbations, (rotation [rad], translation [m]).
Parts have names (`calibration`, `robot`, `pixels` ...) and (..., k, k) covariances, at one or many
places.
"""

from collections.abc import Mapping

import numpy as np

from visioncal.core.transforms import adjoint, compose
from visioncal.core.types import FloatArray


def through(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances J C J' (..., k, k) of what depends on errors by a Jacobian (..., k, p)."""
    return np.asarray(jacobian @ covariance @ jacobian.mT)


def point_jacobian(a_from_b: FloatArray, point_b: FloatArray) -> FloatArray:
    """(3, 6) Jacobian of a b-fixed point (3,) in a by the right perturbation of `a_from_b` [m]."""
    return np.asarray(a_from_b[:3, :3] @ to_points(point_b)[3:])


def to_points(points_m: FloatArray) -> FloatArray:
    """Jacobians (..., 6, 6) of rotation and place of points by a twist of their frame.

    Args:
        points_m: (..., 3) points in the frame [m].

    Returns:
        By right perturbations of the frame, along its axes.
    """
    return adjoint(compose(np.eye(3), -points_m))


def at_points(covariances: FloatArray, points_m: FloatArray) -> FloatArray:
    """(..., 6, 6) covariance of rotation and points (..., 3) [m], from that of their frame."""
    return through(to_points(points_m), covariances)


def total_of(parts: Mapping[str, FloatArray]) -> FloatArray:
    """Covariance (..., k, k) by all sources together."""
    return np.asarray(np.sum(list(parts.values()), axis=0))


def sigmas_of(
    parts: Mapping[str, FloatArray], unit: float = 1e3, axes: slice = slice(None)
) -> dict[str, float]:
    """Standard deviation by source and as a `total`: of all `axes` together, mean over places.

    `unit` is the factor on it, from metres or radians.
    """
    budget = {}
    for name, covariances in {**parts, "total": total_of(parts)}.items():
        squares = np.trace(covariances[..., axes, axes], axis1=-2, axis2=-1)
        # Of two sources that compensate each other, one may be negative.
        budget[name] = unit * float(max(np.mean(squares), 0.0) ** 0.5)
    return budget

"""Closing the chain of frames: both unknown edges from the poses of all views.

Every view says `robot * x * camera = z`, up to noise, with its residual
`log(z^-1 * robot * x * camera)` in the target's frame:

    eye-in-hand   robot = base_from_flange, x = flange_from_cam, z = base_from_target
    eye-to-hand   robot = flange_from_base, x = base_from_cam,   z = flange_from_target
"""

from dataclasses import dataclass

import numpy as np

from visioncal.estimator.linalg import covariance, damped_step
from visioncal.transforms import (
    adjoint,
    exp,
    inverse_right_jacobian,
    invert,
    log,
    mean_transform,
    rotation_angle,
)
from visioncal.types import FloatArray, Mask

UNKNOWNS = 12
_ITERATIONS = 50
_SETTLED = 1e-12
# Exact data has no noise; weights stay finite with this one [rad and m].
_LEAST_SIGMA = 1e-10


@dataclass(frozen=True, eq=False)
class Closure:
    """The poses of m views.

    Attributes:
        robot: (m, 4, 4) the known part of the chain that is the robot's.
        camera: (m, 4, 4) `cam_from_target`.
    """

    robot: FloatArray
    camera: FloatArray

    def __len__(self) -> int:
        return len(self.robot)

    def subset(self, chosen: Mask) -> "Closure":
        """Returns the views of an (m,) mask."""
        return Closure(self.robot[chosen], self.camera[chosen])

    def placed(self, x: FloatArray) -> FloatArray:
        """Where each view places the target: (m, 4, 4) `robot * x * camera`."""
        return self.robot @ x @ self.camera

    def predicted_camera(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """The (m, 4, 4) `cam_from_target` that the edges and the robot predict."""
        return invert(self.robot @ x) @ z


@dataclass(frozen=True)
class Noise:
    """Standard deviations of a residual's components: rotation [rad] and translation [m]."""

    sigma_rad: float
    sigma_m: float

    @property
    def weights(self) -> FloatArray:
        """(6,) inverse variances."""
        return np.repeat([self.sigma_rad**-2.0, self.sigma_m**-2.0], 3)


@dataclass(frozen=True, eq=False)
class ClosureFit:
    """Both edges, (4, 4) each, and the noise that their residuals show."""

    x: FloatArray
    z: FloatArray
    noise: Noise


def deviations(placed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviation of each view's target from the mean of all: (m,) [m] and (m,) [rad]."""
    return distances(placed, mean_transform(placed))


def distances(placed: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance of each view's target from a place: (m,) [m] and (m,) [rad]."""
    return (
        np.linalg.norm(placed[:, :3, 3] - z[:3, 3], axis=1),
        rotation_angle(invert(z)[None] @ placed),
    )


def fit_closure(data: Closure, x: FloatArray, z: FloatArray) -> ClosureFit:
    """Minimises the whitened residuals, estimating the noise of rotation and translation too.

    The two variances are those of the residuals over the degrees of freedom that each keeps
    (Helmert's method; Foerstner and Wrobel 2016, section 4.2.4); the edges follow from
    Levenberg-Marquardt, in turn.

    Args:
        data: The views.
        x: (4, 4) start of the first edge.
        z: (4, 4) start of the second.

    Returns:
        Both edges and the noise.
    """
    noise = estimate_noise(data, x, z)
    for _ in range(_ITERATIONS):
        x, z = solve_closure(data, x, z, noise)
        before, noise = noise, estimate_noise(data, x, z, noise)
        if np.allclose(before.weights, noise.weights, rtol=1e-4):
            break
    return ClosureFit(x, z, noise)


def solve_closure(
    data: Closure, x: FloatArray, z: FloatArray, noise: Noise
) -> tuple[FloatArray, FloatArray]:
    """Minimises the residuals whitened by a known noise (Levenberg-Marquardt)."""
    damping = 1e-6
    weights = noise.weights
    residuals = _residuals(data, x, z)
    cost = np.sum(weights * residuals**2)
    for _ in range(_ITERATIONS):
        jacobian = closure_jacobian(data, x, z)
        weighted = (jacobian * weights[:, None]).reshape(-1, UNKNOWNS)
        information = weighted.T @ jacobian.reshape(-1, UNKNOWNS)
        step = damped_step(information, weighted.T @ residuals.ravel(), damping)
        x_then, z_then = x @ exp(step[:6]), z @ exp(step[6:])
        then = _residuals(data, x_then, z_then)
        cost_then = np.sum(weights * then**2)
        if not cost_then <= cost:
            damping *= 10
            continue
        settled = cost - cost_then <= _SETTLED * cost
        x, z, residuals, cost = x_then, z_then, then, cost_then
        damping = max(damping / 10, 1e-12)
        if settled:
            break
    return x, z


def closure_jacobian(data: Closure, x: FloatArray, z: FloatArray) -> FloatArray:
    """Derivatives (m, 6, 12) of the residuals by the right perturbations of x and of z."""
    error = invert(z) @ data.placed(x)
    log_slope = inverse_right_jacobian(log(error))
    by_x = log_slope @ adjoint(invert(data.camera))
    by_z = -log_slope @ adjoint(invert(error))
    return np.concatenate([by_x, by_z], axis=2)


def closure_information(data: Closure, x: FloatArray, z: FloatArray, noise: Noise) -> FloatArray:
    """Fisher information (12, 12) of both edges.

    It is taken where the chain closes exactly: at the measured poses their noise would pass for
    information about directions that the motion leaves open.
    """
    ideal = Closure(data.robot, data.predicted_camera(x, z))
    jacobian = closure_jacobian(ideal, x, z)
    return np.asarray(np.einsum("mij,i,mik->jk", jacobian, noise.weights, jacobian))


def moved_by(
    data: Closure, x: FloatArray, z: FloatArray, noise: Noise, camera_shift: FloatArray
) -> FloatArray:
    """How both edges answer to shifts that all camera poses share a cause of.

    Args:
        data: The views.
        x: (4, 4) first edge.
        z: (4, 4) second edge.
        noise: That the edges were solved with.
        camera_shift: (m, 6, k) right perturbations of `cam_from_target` by k causes.

    Returns:
        (12, k) right perturbations of both edges by the same causes.
    """
    ideal = Closure(data.robot, data.predicted_camera(x, z))
    weighted = closure_jacobian(ideal, x, z) * noise.weights[:, None]
    pull = np.einsum("mij,mik->jk", weighted, camera_shift)
    return np.asarray(-covariance(closure_information(data, x, z, noise)) @ pull)


def estimate_noise(
    data: Closure, x: FloatArray, z: FloatArray, assumed: Noise | None = None
) -> Noise:
    """Estimates the noise of the residuals at a solution.

    Args:
        data: The views.
        x: (4, 4) first edge.
        z: (4, 4) second edge.
        assumed: The noise that the edges were solved with, by which the unknowns divide between
            rotation and translation; without it they divide evenly.

    Returns:
        The noise.
    """
    squares = _residuals(data, x, z) ** 2
    sums = np.array([squares[:, :3].sum(), squares[:, 3:].sum()])
    taken = np.full(2, UNKNOWNS / 2)
    if assumed is not None:
        jacobian = closure_jacobian(data, x, z)
        spread = covariance(closure_information(data, x, z, assumed))
        leverage = np.einsum("mij,jk,mik->i", jacobian, spread, jacobian) * assumed.weights
        taken = np.array([leverage[:3].sum(), leverage[3:].sum()])
    freedom = np.maximum(3.0 * len(data) - taken, 1.0)
    sigma = np.maximum(np.sqrt(sums / freedom), _LEAST_SIGMA)
    return Noise(float(sigma[0]), float(sigma[1]))


def _residuals(data: Closure, x: FloatArray, z: FloatArray) -> FloatArray:
    return log(invert(z) @ data.placed(x))

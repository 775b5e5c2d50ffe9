"""Bundle adjustment of intrinsics and poses, from corners alone (Zhang 2000, section 3.2).

The poses are eliminated view by view with a Schur complement (Triggs et al. 2000, section 6.1), so
that each step solves a system of the size of the intrinsics.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.corners import CornerStack, Reprojection, reproject
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import covariance_from, damped_step
from visioncal.vision.camera import intrinsics, with_intrinsics

# The intrinsics (4 + k,) and the poses (v, 4, 4).
_State: TypeAlias = tuple[FloatArray, FloatArray]

# Relative decrease of the cost at which the fit has converged.
_CONVERGED = 1e-9


@dataclass(frozen=True, eq=False)
class BundleFit:
    """Result of the bundle adjustment."""

    camera: Camera
    cam_from_target: FloatArray  # (v, 4, 4).
    residuals: FloatArray  # (n, 2) [px].
    sigma_px: float  # Standard deviation of a corner's coordinate, stated or by the residuals [px].
    covariance: FloatArray  # (4 + k, 4 + k) of the intrinsics, poses marginalised.
    settled: bool  # Whether the iteration converged.


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Normal equations in blocks: intrinsics (k), poses (v, 6), and between them (v, 6, k)."""

    by_intrinsics: FloatArray
    by_pose: FloatArray
    between: FloatArray
    intrinsics_gradient: FloatArray
    pose_gradient: FloatArray

    def reduced(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Eliminates the poses.

        Returns:
            (k, k) information and (k,) gradient of the intrinsics alone, and (v, 6, k + 1) response
            of the poses: to a step of the intrinsics, and of their own gradient.
        """
        damped = self.by_pose + damping * self.by_pose * np.eye(6)
        right = np.concatenate([self.between, self.pose_gradient[:, :, None]], axis=2)
        response = covariance_from(damped) @ right
        schur = (np.swapaxes(self.between, 1, 2) @ response).sum(axis=0)
        gradient = self.intrinsics_gradient - schur[:, -1]
        return self.by_intrinsics - schur[:, :-1], gradient, response


def fit_bundle(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, prior_sigma: FloatArray
) -> BundleFit:
    """Estimates intrinsics and poses by Levenberg-Marquardt.

    Args:
        stack: The corners of v views.
        camera: The start, and the mean of the prior.
        cam_from_target: (v, 4, 4) starts.
        prior_sigma: (4 + k,) weak prior, which holds what the views cannot determine.

    Returns:
        The fit. Its covariance counts the corners only, not the prior.
    """
    start, weight = intrinsics(camera), 1.0 / prior_sigma**2

    def linearise(at: _State) -> Linearised[_State]:
        values, poses = at
        reprojection = reproject(stack, with_intrinsics(camera, values), poses)
        offset = values - start
        blocks = _blocks(stack, reprojection)

        def step(damping: float) -> _State:
            information, gradient, response = blocks.reduced(damping)
            # The prior is in units of a corner's noise of 1 px, as the information is.
            change = damped_step(information + np.diag(weight), gradient + weight * offset, damping)
            pose_steps = -(response[:, :, :-1] @ change) - response[:, :, -1]
            return values + change, poses @ exp(pose_steps)

        return Linearised(at, float(np.sum(reprojection.residuals**2) + weight @ offset**2), step)

    (values, poses), settled = levenberg_marquardt((start, cam_from_target), linearise, _CONVERGED)
    fitted = with_intrinsics(camera, values)
    return _finished(stack, fitted, poses, reproject(stack, fitted, poses), settled=settled)


def _finished(
    stack: CornerStack,
    camera: Camera,
    poses: FloatArray,
    reprojection: Reprojection,
    *,
    settled: bool,
) -> BundleFit:
    information, _, _ = _blocks(stack, reprojection).reduced(0.0)
    sigma_px = stack.sigma_px(reprojection.residuals, 6 * len(poses) + len(information))
    covariance = sigma_px**2 * covariance_from(information)
    return BundleFit(camera, poses, reprojection.residuals, sigma_px, covariance, settled)


def _blocks(stack: CornerStack, reprojection: Reprojection) -> _Blocks:
    by_pose, by_intrinsics = reprojection.by_pose, reprojection.by_intrinsics
    size, flat = by_intrinsics.shape[2], by_intrinsics.reshape(-1, by_intrinsics.shape[2])
    rest = np.concatenate([by_pose, by_intrinsics, reprojection.residuals[:, :, None]], axis=2)
    products = stack.products_by_view(by_pose, rest)
    return _Blocks(
        flat.T @ flat,
        products[:, :, :6],
        products[:, :, 6 : 6 + size],
        flat.T @ reprojection.residuals.reshape(-1),
        products[:, :, -1],
    )

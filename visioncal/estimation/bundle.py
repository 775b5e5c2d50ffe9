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
from visioncal.estimation.linalg import covariance_from, damped_step, gram
from visioncal.vision.camera import intrinsics, with_intrinsics

# The intrinsics (4 + k,) and the poses (v, 4, 4).
_State: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class BundleFit:
    """Result of the bundle adjustment."""

    camera: Camera
    cam_from_target: FloatArray  # (v, 4, 4).
    residuals: FloatArray  # (n, 2) [px].
    sigma_px: float  # Standard deviation of a corner's coordinate, stated or by the residuals [px].
    covariance: FloatArray  # (4 + k, 4 + k) of the intrinsics, poses marginalised.
    settled: bool  # Whether the iteration converged.


def fit_bundle(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, prior_sigma: FloatArray
) -> BundleFit:
    """Estimates intrinsics and poses by Levenberg-Marquardt.

    The camera is the start and the mean of a weak prior, (4 + k,) sigmas, which holds what views
    cannot determine; the covariance does not count it. `cam_from_target` are (v, 4, 4) starts.
    """
    start, weight = intrinsics(camera), 1.0 / prior_sigma**2

    def linearise(at: _State) -> Linearised[_State]:
        values, poses = at
        reprojection = reproject(stack, with_intrinsics(camera, values), poses)
        offset = values - start

        def step(damping: float) -> _State:
            information, gradient, response = _reduced(stack, reprojection, damping)
            # The prior is in units of a corner's noise of 1 px, as the information is.
            change = damped_step(information + np.diag(weight), gradient + weight * offset, damping)
            pose_steps = -(response[:, :, :-1] @ change) - response[:, :, -1]
            return values + change, poses @ exp(pose_steps)

        return Linearised(at, float(np.sum(reprojection.residuals**2) + weight @ offset**2), step)

    (values, poses), settled = levenberg_marquardt((start, cam_from_target), linearise)
    fitted = with_intrinsics(camera, values)
    reprojection = reproject(stack, fitted, poses)
    information, _, _ = _reduced(stack, reprojection, 0.0)
    sigma_px = stack.sigma_px(reprojection.residuals, 6 * len(poses) + len(information))
    covariance = sigma_px**2 * covariance_from(information)
    return BundleFit(fitted, poses, reprojection.residuals, sigma_px, covariance, settled)


def _reduced(
    stack: CornerStack, reprojection: Reprojection, damping: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (k, k) and gradient (k,) of k intrinsics, without the v poses.

    And (v, 6, k + 1) response of the poses: to a step of the intrinsics, and of their own gradient.
    """
    by_pose, by_intrinsics = reprojection.by_pose, reprojection.by_intrinsics
    rest = np.concatenate([by_intrinsics, reprojection.residuals[:, :, None]], axis=2)
    products = stack.products_by_view(by_pose, np.concatenate([by_pose, rest], axis=2))
    information = products[:, :, :6]
    response = covariance_from(information + damping * information * np.eye(6)) @ products[:, :, 6:]
    between = products[:, :, 6:-1]
    schur = gram(by_intrinsics, rest) - gram(between, response)
    return schur[:, :-1], schur[:, -1], response

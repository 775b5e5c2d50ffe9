"""Intrinsics and poses together, from corners alone (Zhang 2000, section 3.2).

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

# Relative decrease of the cost below which the fit has settled.
_SETTLED = 1e-9


@dataclass(frozen=True, eq=False)
class BundleFit:
    """Intrinsics and poses.

    Attributes:
        camera: The intrinsics.
        cam_from_target: (v, 4, 4).
        residuals: (n, 2) [px].
        sigma_px: Standard deviation of a corner's coordinate, stated or by the residuals [px].
        covariance: (4 + k, 4 + k) of the intrinsics, poses marginalised.
        settled: Whether the iteration came to rest.
    """

    camera: Camera
    cam_from_target: FloatArray
    residuals: FloatArray
    sigma_px: float
    covariance: FloatArray
    settled: bool


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
            (k, k) information and (k,) gradient of the intrinsics alone, and (v, 6, k + 1): what
            the poses do in answer to a step of the intrinsics, and by themselves.
        """
        damped = self.by_pose + damping * self.by_pose * np.eye(6)
        right = np.concatenate([self.between, self.pose_gradient[:, :, None]], axis=2)
        answer = covariance_from(damped) @ right
        taken = np.swapaxes(self.between, 1, 2) @ answer
        taken = taken.sum(axis=0)
        return (
            self.by_intrinsics - taken[:, :-1],
            self.intrinsics_gradient - taken[:, -1],
            answer,
        )


def fit_bundle(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, prior_sigma: FloatArray
) -> BundleFit:
    """Estimates intrinsics and poses by Levenberg-Marquardt.

    Args:
        stack: The corners of v views.
        camera: The start, and the mean of the prior.
        cam_from_target: (v, 4, 4) starts.
        prior_sigma: (4 + k,) weak prior, which keeps what the views cannot determine in place.

    Returns:
        The fit. Its covariance counts the corners only, not the prior.
    """
    start, weight = intrinsics(camera), 1.0 / prior_sigma**2

    def linearise(at: _State) -> Linearised[_State]:
        values, poses = at
        now = reproject(stack, with_intrinsics(camera, values), poses)
        offset = values - start
        blocks = _blocks(stack, now)

        def step(damping: float) -> _State:
            information, gradient, answer = blocks.reduced(damping)
            # The prior is in units of a corner's noise of 1 px, as the information is.
            moved = damped_step(information + np.diag(weight), gradient + weight * offset, damping)
            pose_steps = -(answer[:, :, :-1] @ moved) - answer[:, :, -1]
            return values + moved, poses @ exp(pose_steps)

        return Linearised(at, float(np.sum(now.residuals**2) + weight @ offset**2), step)

    (values, poses), settled = levenberg_marquardt((start, cam_from_target), linearise, _SETTLED)
    fitted = with_intrinsics(camera, values)
    return _finished(stack, fitted, poses, reproject(stack, fitted, poses), settled=settled)


def _finished(
    stack: CornerStack, camera: Camera, poses: FloatArray, now: Reprojection, *, settled: bool
) -> BundleFit:
    information, _, _ = _blocks(stack, now).reduced(0.0)
    sigma_px = stack.sigma_px(now.residuals, 6 * len(poses) + len(information))
    covariance = sigma_px**2 * covariance_from(information)
    return BundleFit(camera, poses, now.residuals, sigma_px, covariance, settled)


def _blocks(stack: CornerStack, at: Reprojection) -> _Blocks:
    by_pose, by_intrinsics = at.by_pose, at.by_intrinsics
    size, flat = by_intrinsics.shape[2], by_intrinsics.reshape(-1, by_intrinsics.shape[2])
    rest = np.concatenate([by_pose, by_intrinsics, at.residuals[:, :, None]], axis=2)
    products = stack.products_by_view(by_pose, rest)
    return _Blocks(
        flat.T @ flat,
        products[:, :, :6],
        products[:, :, 6 : 6 + size],
        flat.T @ at.residuals.reshape(-1),
        products[:, :, -1],
    )

"""Poses of a target from its corners, the camera being known: all views at once."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.corners import CornerStack, Reprojection, reproject
from visioncal.estimation.linalg import damped_step

_ITERATIONS = 30
# A step [rad or m] so small that the next, some hundred times smaller, is nothing beside any noise.
_SETTLED = 1e-6
# Views whose step is of rounding no longer go along with others.
_AT_REST = 1e-8
_START_DAMPING = 1e-6
# At rest, costs differ by rounding: that is no reason to stay.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Poses of v views.

    Attributes:
        cam_from_target: (v, 4, 4).
        information: (v, 6, 6) of each pose's right perturbation, for corners of 1 px noise.
        residuals: (n, 2) of the stack [px].
    """

    cam_from_target: FloatArray
    information: FloatArray
    residuals: FloatArray


def fit_poses(stack: CornerStack, camera: Camera, cam_from_target: FloatArray) -> PoseFit:
    """Minimises each view's reprojection error by Levenberg-Marquardt.

    Args:
        stack: The corners.
        camera: The intrinsics, held.
        cam_from_target: (v, 4, 4) starts.

    Returns:
        The poses with their information.
    """
    damping = np.full(len(cam_from_target), _START_DAMPING)
    return _descended(stack, camera, cam_from_target, damping, _ITERATIONS)


def _descended(
    stack: CornerStack, camera: Camera, poses: FloatArray, damping: FloatArray, iterations: int
) -> PoseFit:
    """Takes so many steps at most; few views that go on longer than the others go on alone."""
    now = reproject(stack, camera, poses, lens=False)
    cost = stack.sum_by_view(np.sum(now.residuals**2, axis=1))
    information, gradient = _normal_equations(stack, now)
    for done in range(iterations):
        step = damped_step(information, gradient, damping[:, None])
        candidate = poses @ exp(step)
        if np.all(np.abs(step) < _SETTLED):
            poses = candidate
            break
        moving = np.any(np.abs(step) >= _AT_REST, axis=1)
        if 2 * moving.sum() <= len(moving):
            corners, residuals = moving[stack.view_of], now.residuals.copy()
            rest = _descended(
                stack.keep(corners), camera, poses[moving], damping[moving], iterations - done
            )
            poses = candidate
            poses[moving], information[moving] = rest.cam_from_target, rest.information
            residuals[corners] = rest.residuals
            return PoseFit(poses, information, residuals)
        then = reproject(stack, camera, candidate, lens=False)
        cost_then = stack.sum_by_view(np.sum(then.residuals**2, axis=1))
        better = cost_then <= cost * (1.0 + _ROUNDING)
        poses = np.where(better[:, None, None], candidate, poses)
        cost = np.where(better, cost_then, cost)
        damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-12, 1e6)
        now = then if better.all() else reproject(stack, camera, poses, lens=False)
        information, gradient = _normal_equations(stack, now)
    return PoseFit(poses, information, now.residuals)


def _normal_equations(stack: CornerStack, at: Reprojection) -> tuple[FloatArray, FloatArray]:
    """Sums (v, 6, 6) information and (v, 6) gradient over each view's corners."""
    both = np.concatenate([at.by_pose, at.residuals[:, :, None]], axis=2)
    products = stack.products_by_view(at.by_pose, both)
    return products[:, :, :6], products[:, :, 6]

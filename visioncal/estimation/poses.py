"""Poses of a target from its corners, the camera being known: all views at once.

A planar target has two first guesses, which look almost alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.transforms import exp, skew
from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.estimation.corners import CornerStack, Reprojection, reproject
from visioncal.estimation.linalg import damped_step
from visioncal.vision.camera import normalise

# A homography takes four points. Nearer to a line than this share of the target is on it.
_FEWEST, _ON_LINE = 4, 1e-6
# Points whose depth is under this share of their width are as good as in a plane.
_FLAT = 0.1
_ITERATIONS = 30
# A step [rad or m] so small that the next, some hundred times smaller, is nothing beside any noise.
_SETTLED = 1e-6
# Views whose step is of rounding no longer go along with others.
_AT_REST = 1e-8
_START_DAMPING = 1e-6
# At rest, costs differ by rounding: that is no reason to stay.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """Guesses for v views.

    Attributes:
        first: (v, 4, 4) the better `cam_from_target`.
        second: (v, 4, 4) the other; equal where there is one.
        solved: (v,) whether there is any; the poses of the others mean nothing.
    """

    first: FloatArray
    second: FloatArray
    solved: Mask


def planar_poses(stack: CornerStack, camera: Camera) -> PlanarPoses:
    """Solves each view's pose in closed form, by OpenCV.

    Points of a plane by IPPE (Collins and Bartoli 2014), others by SQPnP (Terzakis and Lourakis
    2020).

    Returns:
        Both solutions. There is none where the lens cannot be inverted at the corners, or where
        they do not determine a pose.
    """
    plane = normalise(camera, stack.px)
    poses = np.tile(np.eye(4), (2, len(stack.views), 1, 1))
    solved = np.zeros(len(stack.views), dtype=bool)
    for at, (start, count) in enumerate(zip(stack.starts, stack.counts, strict=True)):
        rows = slice(start, start + count)
        usable = np.isfinite(plane[rows]).all(axis=1)
        points = stack.points[rows][usable]
        if not determines_pose(points):
            continue
        flat = _flattened(points)
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points if flat is None else flat,
            plane[rows][usable],
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_SQPNP if flat is None else cv2.SOLVEPNP_IPPE,
        )
        found = [
            _pose(np.asarray(rotation, float), np.asarray(translation, float))
            for rotation, translation in zip(rotations, translations, strict=True)
        ]
        if found and np.isfinite(found).all():
            solved[at] = True
            poses[0, at], poses[1, at] = found[0], found[-1]
    return PlanarPoses(poses[0], poses[1], solved)


def _flattened(points: FloatArray) -> FloatArray | None:
    """(n, 3) points in the plane that is nearest to them; None where that is not near."""
    if not points[:, 2].any():
        return points
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extents[2] > _FLAT * extents[1]:
        return None
    return np.asarray(points - np.outer((points - middle) @ axes[2], axes[2]))


def determines_pose(points: FloatArray) -> bool:
    """Whether (n, 3) points determine a pose: at least two lie off every line.

    A line that all but one lie on passes through two of any three: three lines are enough to try.
    """
    if len(points) < _FEWEST:
        return False
    starts, span = points[[0, 0, 1]], float(np.ptp(points, axis=0).max())
    along = points[[1, 2, 2]] - starts
    # Of every view: `np.cross` takes ten times as long.
    away = np.linalg.norm((points - starts[:, None]) @ skew(along), axis=2)
    is_off = away > _ON_LINE * span * np.linalg.norm(along, axis=1)[:, None]
    return bool(np.all(is_off.sum(axis=1) >= 2))


def _pose(rotation_vector: FloatArray, translation: FloatArray) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation_vector)[0]
    pose[:3, 3] = translation.ravel()
    return pose


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

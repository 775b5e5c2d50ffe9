"""Target poses from corners with a known camera, batched over all views.

A planar target has two closed-form solutions, which look almost alike.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from visioncal.core.levenberg_marquardt import NEAR_DAMPING, START_DAMPING
from visioncal.core.linalg import damped_step
from visioncal.core.transforms import compose, exp, skew
from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.vision.camera import normalise
from visioncal.vision.corners import CornerStack, Reprojection, reproject

# Least points of a homography.
FEWEST_CORNERS = 4
# Converged step [rad or m]: the next, some hundred times smaller, is negligible beside any noise.
_CONVERGED = 1e-6


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """Closed-form poses of v views."""

    first: FloatArray  # (v, 4, 4) the better `cam_from_target`.
    second: FloatArray  # (v, 4, 4) the other; equal where there is one.
    solved: Mask  # (v,) whether there is any; the poses of other views are meaningless.


def planar_poses(stack: CornerStack, camera: Camera) -> PlanarPoses:
    """Solves each view's pose in closed form.

    Returns:
        Both solutions; none where the lens cannot be inverted at the corners, or where they do not
        determine a pose.
    """
    plane = normalise(camera, stack.px)
    poses = np.tile(np.eye(4), (2, len(stack.views), 1, 1))
    solved = np.zeros(len(stack.views), dtype=bool)
    for view, (start, count) in enumerate(zip(stack.starts, stack.counts, strict=True)):
        rows = slice(start, start + count)
        solutions = closed_form_poses(stack.points[rows], plane[rows])
        if len(solutions):
            solved[view] = True
            poses[0, view], poses[1, view] = solutions[0], solutions[-1]
    return PlanarPoses(poses[0], poses[1], solved)


def closed_form_poses(points: FloatArray, plane: FloatArray) -> FloatArray:
    """Poses (j, 4, 4) of a target in closed form, with OpenCV, the better first.

    Coplanar points by IPPE (Collins and Bartoli 2014), others by SQPnP (Terzakis and Lourakis
    2020).

    Args:
        points: (n, 3) on the target [m].
        plane: (n, 2) as they are seen on the plane at unit depth; NaN where the lens cannot be
            inverted.

    Returns:
        None where the points do not determine a pose.
    """
    usable = np.isfinite(plane).all(axis=1)
    points, none = points[usable], np.zeros((0, 4, 4))
    if not determines_pose(points):
        return none
    flat = _flattened(points)
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        points if flat is None else flat,
        plane[usable],
        np.eye(3),
        None,
        flags=cv2.SOLVEPNP_SQPNP if flat is None else cv2.SOLVEPNP_IPPE,
    )
    solutions = [
        compose(np.asarray(cv2.Rodrigues(rotation)[0], float), np.ravel(translation))
        for rotation, translation in zip(rotations, translations, strict=True)
    ]
    return np.array(solutions) if solutions and np.isfinite(solutions).all() else none


def _flattened(points: FloatArray) -> FloatArray | None:
    """(n, 3) points projected on their best plane; None where they are not near one."""
    if not points[:, 2].any():
        return points
    middle = points.mean(axis=0)
    _, extents, axes = np.linalg.svd(points - middle, full_matrices=False)
    # Ratio of depth to width below which points count as coplanar.
    if extents[2] > 0.1 * extents[1]:
        return None
    return np.asarray(points - np.outer((points - middle) @ axes[2], axes[2]))


def determines_pose(points: FloatArray) -> bool:
    """Whether (n, 3) points determine a pose: at least two lie off every line.

    A line through all points but one contains two of any three: three lines are enough to try.
    """
    return len(points) >= FEWEST_CORNERS and _off_every_line(np.asarray(points, float).tobytes())


# Nearly all views show the same corners of a board.
@lru_cache(maxsize=1024)
def _off_every_line(data: bytes) -> bool:
    """Whether at least two of (n, 3) points, as bytes, lie off every line."""
    points = np.frombuffer(data).reshape(-1, 3)
    starts = points[[0, 0, 1]]
    along, span = points[[1, 2, 2]] - starts, float(np.ptp(points, axis=0).max())
    distances = np.linalg.norm((points - starts[:, None]) @ skew(along), axis=2)
    # Relative distance from a line below which points are collinear.
    is_off = distances > 1e-6 * span * np.linalg.norm(along, axis=1)[:, None]
    return bool(np.all(is_off.sum(axis=1) >= 2))


@dataclass(frozen=True, eq=False)
class PoseFit:
    """Poses of v views."""

    cam_from_target: FloatArray  # (v, 4, 4).
    # (v, 6, 6) of each pose's right perturbation, for corners of 1 px noise.
    information: FloatArray
    residuals: FloatArray  # (n, 2) of the stack [px].


def fit_poses(stack: CornerStack, camera: Camera, cam_from_target: FloatArray) -> PoseFit:
    """Minimises each view's reprojection error by Levenberg-Marquardt, from (v, 4, 4) starts."""
    damping = np.full(len(cam_from_target), START_DAMPING)
    return _descended(stack, camera, cam_from_target, damping, 30)


def _descended(
    stack: CornerStack, camera: Camera, poses: FloatArray, damping: FloatArray, iterations: int
) -> PoseFit:
    """Iterates up to a number of steps; once most views have converged, only the others go on."""
    current = reproject(stack, camera, poses, lens=False)
    cost = stack.sum_by_view(np.sum(current.residuals**2, axis=1))
    information, gradient = _normal_equations(stack, current)
    for done in range(iterations):
        step = damped_step(information, gradient, damping[:, None])
        candidate = poses @ exp(step)
        if np.all(np.abs(step) < _CONVERGED):
            poses = candidate
            break
        moving = np.any(np.abs(step) >= _CONVERGED, axis=1)
        if 2 * moving.sum() <= len(moving):
            corners, residuals = moving[stack.view_of], current.residuals.copy()
            rest = _descended(
                stack.keep(corners), camera, poses[moving], damping[moving], iterations - done
            )
            poses = candidate
            poses[moving], information[moving] = rest.cam_from_target, rest.information
            residuals[corners] = rest.residuals
            return PoseFit(poses, information, residuals)
        trial = reproject(stack, camera, candidate, lens=False)
        trial_cost = stack.sum_by_view(np.sum(trial.residuals**2, axis=1))
        better = trial_cost <= cost
        poses = np.where(better[:, None, None], candidate, poses)
        cost = np.where(better, trial_cost, cost)
        damping = np.clip(
            np.where(better, damping / 10, damping * 10), NEAR_DAMPING, 1.0 / NEAR_DAMPING
        )
        current = trial if better.all() else reproject(stack, camera, poses, lens=False)
        information, gradient = _normal_equations(stack, current)
    return PoseFit(poses, information, current.residuals)


def _normal_equations(
    stack: CornerStack, reprojection: Reprojection
) -> tuple[FloatArray, FloatArray]:
    """Information (v, 6, 6) and gradient (v, 6) of each view's corners."""
    columns = np.concatenate([reprojection.by_pose, reprojection.residuals[:, :, None]], axis=2)
    products = stack.products_by_view(reprojection.by_pose, columns)
    return products[:, :, :6], products[:, :, 6]

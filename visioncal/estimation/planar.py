"""First guesses of a target's pose: of a planar one both of the two that look almost alike."""

from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.transforms import skew
from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.estimation.corners import CornerStack
from visioncal.vision.camera import normalise

# A homography takes four points. Nearer to a line than this share of the target is on it.
_FEWEST, _ON_LINE = 4, 1e-6
# Points whose depth is under this share of their width are as good as in a plane.
_FLAT = 0.1


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
    _, covariance, axes = np.linalg.svd(points - middle, full_matrices=False)
    if covariance[2] > _FLAT * covariance[1]:
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

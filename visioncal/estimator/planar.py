"""First guesses of a planar target's pose: both of the two that look almost alike."""

import cv2
import numpy as np

from visioncal.camera import normalise
from visioncal.estimator.corners import CornerStack
from visioncal.types import Camera, FloatArray


def planar_poses(stack: CornerStack, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Solves each view's pose in closed form (Collins and Bartoli 2014, IPPE; OpenCV).

    Args:
        stack: The corners of v views; at least 4 a view, not on one line.
        camera: The intrinsics.

    Returns:
        (v, 4, 4) the better and (v, 4, 4) the other `cam_from_target`; equal where there is one.
    """
    plane = normalise(camera, stack.px)
    first, second = [], []
    for start, count in zip(stack.starts, stack.counts, strict=True):
        rows = slice(start, start + count)
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            stack.points[rows], plane[rows], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        poses = [
            _pose(np.asarray(rotation, float), np.asarray(translation, float))
            for rotation, translation in zip(rotations, translations, strict=True)
        ]
        first.append(poses[0])
        second.append(poses[-1])
    return np.array(first), np.array(second)


def _pose(rotation_vector: FloatArray, translation: FloatArray) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation_vector)[0]
    pose[:3, 3] = translation.ravel()
    return pose

"""Poorer models of a lens, which other programs hold, and what they leave of it."""

from collections.abc import Mapping

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure, known_name, rounded_up
from visioncal.core.types import Camera, FloatArray
from visioncal.vision.camera import intrinsics, normalise, project_with_jacobian, with_intrinsics

# Coefficients of OpenCV's k1, k2, p1, p2, k3 that each model has.
POORER: Mapping[str, int] = {"pinhole": 0, "radtan": 4, "plumb_bob": 5}


def seen_rays(camera: Camera, model: str) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels all over the image, and their rays x / z, y / z; DataError beyond 80 deg."""
    steps = (np.linspace(0.0, side - 1.0, 31) for side in camera.resolution)
    px = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    rays = normalise(camera, px)
    seen = np.isfinite(rays).all(axis=1) & (np.abs(rays).max(axis=1) < np.tan(np.deg2rad(80.0)))
    if not seen.all():
        raise DataError(
            f"{model} holds rays up to 80 degrees from the axis, and {(~seen).mean():.0%} of this "
            "image see beyond, or beyond the lens's model.",
            culprits=["camera.distortion"],
            next_step="Export the lens with --to camera-info or opencv, and undistort there.",
        )
    return px, rays


def poorer(camera: Camera, name: str) -> tuple[Camera, str]:
    """The camera of a poorer model that sees the same rays nearest, and what it leaves, in words.

    Focal lengths, centre and the model's coefficients are those of the least squares of pixels all
    over the image; raises DataError.
    """
    count = 4 + POORER[known_name("lens", name, POORER)]
    px, rays = seen_rays(camera, f"The model {name}")
    points = np.column_stack([rays, np.ones(len(rays))])
    found = Camera("brown", camera.resolution, camera.matrix, np.zeros(5))
    for _ in range(10):
        seen = project_with_jacobian(found, points)
        columns = seen.jacobian_intrinsics[:, :, :count].reshape(-1, count)
        step = np.linalg.lstsq(columns, (px - seen.px).ravel(), rcond=None)[0]
        found = with_intrinsics(found, intrinsics(found) + np.pad(step, (0, 9 - count)))
    left_px = np.linalg.norm(project_with_jacobian(found, points).px - px, axis=1)
    rms, most = figure(float(np.sqrt(np.mean(left_px**2)))), figure(rounded_up(left_px.max()))
    return found, f"--lens {name} leaves {rms} px rms of this lens, {most} px at the most"

"""The camera's transform for a receiving program that has a lens model of its own."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import Camera, FloatArray
from visioncal.interchange.exports.sources import HAND_EYE, Placements, Source
from visioncal.interchange.formats.intrinsics import read_intrinsics
from visioncal.results import Calibration, Edge
from visioncal.results.conditions import Condition
from visioncal.results.lens import image_grid, to_ray
from visioncal.vision.camera import normalise

# Coefficients of OpenCV's largest model, whose last two tilt the sensor.
_MOST_COEFFICIENTS = 14
# Share of the image about its centre in which both lenses are compared: at the rim neither is known
# well where no view looked.
_INNER = 0.5
# Largest error of an inverted distortion [px]: far less than any lens is known to.
_SAME_PX = 1e-3
# Iterations of OpenCV's fixed point, and where it ends [plane at unit depth].
_INVERSE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


def with_lens(source: Source, available: Placements, name: str, path: Path) -> Placements:
    """The transforms, with the camera's for another lens model of the same camera.

    The ray of the image's centre is the same for any lens model (`Calibration.ray_frame`), and so
    is, for the roll about it, what the rays around it point at.

    Args:
        source: The calibration.
        available: Its transforms.
        name: The one that is exported.
        path: The other lens, in any form of `read_intrinsics`, with up to 14 coefficients.

    Raises:
        DataError: The transform is not that of the only camera, or the lens is not of that camera.
    """
    frame = source.ray_frame if isinstance(source, Calibration) and source.cell is None else None
    lens, mount = available.lens, available.mount
    if frame is None or lens is None or mount is None or name != HAND_EYE[mount]:
        raise DataError(
            "--lens is of the transform of one calibrated camera on its robot, or in its base, and "
            f"{name} of {available.words} is none.",
            culprits=["--lens"],
            next_step="Leave it out; of a whole cell, name --robot, --camera and --target.",
        )
    stated, _ = read_intrinsics(path, _MOST_COEFFICIENTS)
    resolution = tuple(stated.get("resolution", lens.camera.resolution))
    if resolution != lens.camera.resolution:
        raise DataError(
            f"{path} is of images of {resolution[0]} x {resolution[1]} px; the calibrated camera "
            "has {} x {} px.".format(*lens.camera.resolution),
            culprits=["--lens"],
            next_step="Name the lens of the same camera, with the same binning and region.",
        )
    px = np.concatenate([frame.px[None], image_grid(lens.camera, _INNER)])
    own, other = normalise(lens.camera, lens.in_model(px)), _rays(stated, lens.camera, px)
    if not np.isfinite([own, other]).all():
        raise DataError(
            f"{path}: its distortion cannot be inverted in the middle of the image.",
            culprits=["--lens"],
            next_step="Name the lens of this camera.",
        )
    turns = [np.eye(4), np.eye(4)]
    around = []
    for turn, rays in zip(turns, (own, other), strict=True):
        turn[:3, :3] = to_ray(rays[0])
        seen = np.column_stack([rays, np.ones(len(rays))]) @ turn[:3, :3]
        around.append((seen[:, 0] + 1j * seen[:, 1]) / seen[:, 2])
    roll = np.eye(4)
    angle = np.angle(np.vdot(around[1], around[0]))
    roll[:3, :3] = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    remaining = np.abs(around[0] - np.exp(1j * angle) * around[1])
    remaining_px = lens.camera.matrix[0] * np.sqrt(np.mean(remaining**2) / 2.0)
    back = roll @ invert(turns[1])
    carried = adjoint(invert(back))
    edge = Edge(
        frame.transform.matrix @ back, np.asarray(carried @ frame.transform.covariance @ carried.T)
    )
    placement = available.by_name[name]
    own_lens = Condition(
        "own-lens",
        f"The transform is for the lens of {path.name}, which differs from the calibration's own "
        f"by {figure(remaining_px)} px rms in the inner half of the image.",
        "Use it with that lens only.",
    )
    others = (condition for condition in placement.conditions if condition.kind != "own-lens")
    placed = replace(placement, edge=edge, conditions=(own_lens, *others))
    # The calibration's own lens does not go with it.
    return replace(available, by_name={**available.by_name, name: placed}, lens=None)


def _rays(stated: dict[str, object], camera: Camera, px: FloatArray) -> FloatArray:
    """(n, 2) rays of a stated lens, at unit depth; NaN where it has none."""
    matrix, distortion = (np.array(stated[name], dtype=float) for name in ("matrix", "distortion"))
    if stated["model"] == "fisheye":
        return normalise(Camera("fisheye", camera.resolution, matrix, distortion), px)
    fx, fy, cx, cy = matrix
    square = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    plane = np.eye(3)
    rays = cv2.undistortPointsIter(px[:, None], square, distortion, plane, plane, _INVERSE)[:, 0]
    points = np.column_stack([rays, np.ones(len(rays))])
    shown = cv2.projectPoints(points, np.zeros(3), np.zeros(3), square, distortion)[0][:, 0]
    found = np.linalg.norm(shown - px, axis=1) < _SAME_PX
    return np.where(found[:, None], rays, np.nan)

"""Where a simulated camera stands to look at a board: views on a cap above it."""

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.simulation.boards import (
    Sheet,
    centre_m,
    corners_m,
    found_in_part,
    outline_m,
    pattern_box,
)
from visioncal.simulation.optics import rays, sees
from visioncal.simulation.options import CellOptions

# The print stays this far from the image's edge in views that show it whole [px].
MARGIN_PX = 12.0
# A view that the image's edge may cut still shows this share of the corners.
LEAST_SHARE = 0.6


def _working_distance_m(options: CellOptions) -> tuple[float, float]:
    """Least and greatest distance between camera and board [m]."""
    if options.distance_m is not None:
        return options.distance_m
    left, top, right, bottom = pattern_box(options.target)
    focal, short_side = float(options.camera.matrix[0]), min(options.camera.resolution)
    full = focal * float(np.hypot(right - left, bottom - top)) / short_side
    near, far = full / 1.15, full / 0.7
    if options.mount == "eye-in-hand":
        return near, far
    return min(max(near, 0.7), 1.0), min(max(far, 1.0), 1.2)


def mean_view(options: CellOptions, sheet: Sheet) -> FloatArray:
    """The view that the others are spread around: straight, at the mean distance, (4, 4)."""
    middle = 0.5 * sum(_working_distance_m(options))
    return compose(np.eye(3), np.array([0.0, 0.0, middle]) - centre_m(sheet))


def draw_views(
    options: CellOptions, sheet: Sheet, count: int, rng: np.random.Generator
) -> FloatArray:
    """Draws views and keeps those in which the board is where it should be in the image.

    Returns:
        (k, 4, 4) `cam_from_target`, k <= count.
    """
    rotation = _rotations(options, count, rng)
    distance = rng.uniform(*_working_distance_m(options), size=count)
    # At most this share of the views may be cut.
    may_be_cut = rng.random(count) < (options.cut_views if found_in_part(options.target) else 0)
    reach = np.where(may_be_cut, 0.4, 0.3)[:, None]
    aim = (0.5 + reach * rng.uniform(-1.0, 1.0, size=(count, 2))) * np.array(
        options.camera.resolution
    )
    centre = distance[:, None] * rays(options.camera, aim)
    cam_from_target = compose(rotation, centre - rotation @ centre_m(sheet))
    whole = sees(options.camera, _place(cam_from_target, outline_m(sheet, 0.0)), MARGIN_PX)
    seen = sees(options.camera, _place(cam_from_target, corners_m(sheet)), MARGIN_PX)
    fits = whole.all(axis=1) | (may_be_cut & (seen.mean(axis=1) > LEAST_SHARE))
    return np.asarray(cam_from_target[fits])


def _rotations(options: CellOptions, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, 3, 3) rotations: the board's tilt about an axis in its plane, then the roll."""
    low, high = options.tilt_rad
    # Uniform on the cap's area: the cosine of the tilt is uniform.
    tilt = np.arccos(rng.uniform(np.cos(high), np.cos(low), size=count))
    azimuth = rng.uniform(-np.pi, np.pi, size=count)
    roll = rng.uniform(-options.roll_rad, options.roll_rad, size=count)
    if options.motion != "free":
        tilt, azimuth = np.full(count, 0.5 * (low + high)), np.full(count, 0.6)
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    tilted = Rotation.from_rotvec(tilt[:, None] * axis)
    along_z = roll[:, None] * np.array([0.0, 0.0, 1.0])
    if options.motion == "translation":
        turned = tilted
    elif options.motion == "one_axis":
        # The board turns about its own normal, so that all relative rotations share that axis.
        turned = tilted * Rotation.from_rotvec(along_z)
    else:
        turned = Rotation.from_rotvec(along_z) * tilted
    return np.asarray(turned.as_matrix(), dtype=float)


def _place(cam_from_target: FloatArray, points: FloatArray) -> FloatArray:
    """(k, n, 3) points in the camera frame, from (n, 3) in the target frame."""
    return np.asarray(
        points @ np.swapaxes(cam_from_target[:, :3, :3], 1, 2) + cam_from_target[:, None, :3, 3]
    )

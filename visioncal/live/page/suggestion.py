"""The next view to take: a pose of the board in the camera that differs most from all so far."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import Camera, FloatArray, Target
from visioncal.vision.camera import normalise, project
from visioncal.vision.targets import extent_m, outline

# Views to choose from: the board's tilt and its turn in the image [deg], its centre from the
# image's in shares of the image's size, and its distance in shares of the usual one.
_TILTS_DEG, _TURNS_DEG = (15.0, 32.0), (0.0, 50.0, -50.0)
_PLACES, _DISTANCES = (-0.22, 0.0, 0.22), (0.85, 1.0, 1.25)
# What counts as another view: as far apart as these together [rad, shares of the image, log].
_APART = np.array([0.5, 0.35, 0.25])


@dataclass(frozen=True, eq=False)
class NextPose:
    """A pose to drive to; what is not known is None."""

    words: str
    cam_from_target: FloatArray | None = None  # (4, 4) where the camera will see the board [m].
    base_from_flange: FloatArray | None = None  # (4, 4) where the flange will be [m].


def next_view(target: Target, lens: Camera, avoid: Sequence[FloatArray]) -> FloatArray:
    """The view that differs most from all others, about as far away as the first of them.

    Args:
        target: The board.
        lens: Intrinsics; rough ones are enough.
        avoid: (4, 4) `cam_from_target` of one view or more so far, and of rejected suggestions [m].

    Returns:
        (4, 4) `cam_from_target` with the whole board in the image [m].
    """
    low, high = extent_m(target)
    centre = np.append(0.5 * (low + high), 0.0)
    size, first = np.array(lens.resolution, dtype=float), avoid[0]
    usual_m = float(np.linalg.norm(first[:3, :3] @ centre + first[:3, 3]))
    turn = float(np.arctan2(first[1, 0], first[0, 0]))
    tilts = [Rotation.identity()]
    for tilt, azimuth in product(np.deg2rad(_TILTS_DEG), np.deg2rad(np.arange(0, 360, 60))):
        tilts.append(Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])))
    views = []
    for by, turned, x, y, far in product(
        tilts, turn + np.deg2rad(_TURNS_DEG), _PLACES, _PLACES, _DISTANCES
    ):
        rotation = (by * Rotation.from_euler("z", turned)).as_matrix()
        ray = np.append(normalise(lens, (size * (0.5 + np.array([x, y])))[None])[0], 1.0)
        position = far * usual_m * ray / np.linalg.norm(ray)
        views.append(compose(rotation, position - rotation @ centre))
    candidates = np.array(views)
    edges = outline(target)
    fits = np.array([_is_inside(lens, edges @ view[:3, :3].T + view[:3, 3]) for view in candidates])
    candidates = candidates[fits] if fits.any() else candidates
    apart = [_apart(candidates, view, centre, lens) for view in avoid]
    return np.asarray(candidates[int(np.argmax(np.min(apart, axis=0)))])


def _is_inside(lens: Camera, points: FloatArray) -> bool:
    px, size = project(lens, points), np.array(lens.resolution)
    # NaN is outside, too.
    return bool(np.all((px > 0.03 * size) & (px < 0.97 * size)))


def _apart(views: FloatArray, view: FloatArray, centre: FloatArray, lens: Camera) -> FloatArray:
    """How different views (k, 4, 4) are from another one: (k,), dimensionless."""
    both = np.concatenate([views, view[None]])
    points = both[:, :3, :3] @ centre + both[:, :3, 3]
    places = points[:, :2] / points[:, 2:] * lens.matrix[:2] / max(lens.resolution)
    logs = np.log(np.linalg.norm(points, axis=1))
    steps = [
        rotation_angle(invert(views) @ view),
        np.linalg.norm(places[:-1] - places[-1], axis=1),
        np.abs(logs[:-1] - logs[-1]),
    ]
    return np.asarray(np.array(steps).T @ (1.0 / _APART))

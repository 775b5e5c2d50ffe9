"""The next view to take: a pose of the board in the camera that differs most from all so far."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import apply, compose, distances, invert, rotation_angle
from visioncal.core.types import Camera, FloatArray, Mask, Target
from visioncal.live.capture.assessment import Coach
from visioncal.planning.visibility import FieldOfView
from visioncal.vision.camera import normalise
from visioncal.vision.targets import extent_m, outline

# Views to choose from: the board's tilt and its turn in the image [deg], its centre from the
# image's in shares of the image's size, and its distance in shares of the usual one.
_TILTS_DEG, _TURNS_DEG = (15.0, 32.0), (0.0, 50.0, -50.0)
_PLACES, _DISTANCES = (-0.22, 0.0, 0.22), (0.85, 1.0, 1.25)
# Distance of another view: as far apart as these together [rad, shares of the image, log].
_APART = np.array([0.5, 0.35, 0.25])


@dataclass(frozen=True, eq=False)
class NextPose:
    """A pose to drive to; what is not known is None."""

    words: str
    cam_from_target: FloatArray | None = None  # (4, 4) where the camera will see the board [m].
    base_from_flange: FloatArray | None = None  # (4, 4) where the flange will be [m].


def next_view(
    target: Target,
    lens: Camera,
    avoid: Sequence[FloatArray],
    allowed: Callable[[FloatArray], Mask] | None = None,
) -> FloatArray | None:
    """The view that differs most from all others, about as far away as the first of them.

    Args:
        target: The board.
        lens: Intrinsics; rough ones are enough.
        avoid: (4, 4) `cam_from_target` of one view or more so far, and of rejected suggestions [m].
        allowed: Says of (k, 4, 4) views which may be suggested, (k,).

    Returns:
        (4, 4) `cam_from_target` with the whole board in the image [m]; None where none is allowed.
    """
    low, high = extent_m(target)
    centre = np.append(0.5 * (low + high), 0.0)
    first = avoid[0]
    usual_m = float(np.linalg.norm(apply(first, centre[None])))
    turn = float(np.arctan2(first[1, 0], first[0, 0]))
    tilts = [Rotation.identity()]
    for tilt, azimuth in product(np.deg2rad(_TILTS_DEG), np.deg2rad(np.arange(0, 360, 60))):
        tilts.append(Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])))
    turns = Rotation.from_euler("z", (turn + np.deg2rad(_TURNS_DEG))[:, None])
    rotations = [(by * turned).as_matrix() for by, turned in product(tilts, turns)]
    shares = 0.5 + np.array([*product(_PLACES, _PLACES)])
    rays = np.insert(normalise(lens, np.array(lens.resolution) * shares), 2, 1.0, axis=1)
    rays *= usual_m / np.linalg.norm(rays, axis=1, keepdims=True)
    places = [far * ray for ray, far in product(rays, _DISTANCES)]
    candidates = np.array(
        [compose(turned, at - turned @ centre) for turned, at in product(rotations, places)]
    )
    field = FieldOfView(lens, 0.06 * min(lens.resolution))
    candidates = candidates[field.holds(apply(candidates, outline(target)))]
    candidates = candidates if allowed is None else candidates[allowed(candidates)]
    if not len(candidates):
        return None
    apart = [_apart(candidates, view, centre, lens) for view in avoid]
    return np.asarray(candidates[int(np.argmax(np.min(apart, axis=0)))])


def _apart(views: FloatArray, view: FloatArray, centre: FloatArray, lens: Camera) -> FloatArray:
    """How different views (k, 4, 4) are from another one: (k,), dimensionless."""
    points = apply(np.concatenate([views, view[None]]), centre[None])[:, 0]
    places = points[:, :2] / points[:, 2:] * lens.matrix[:2] / max(lens.resolution)
    logs = np.log(np.linalg.norm(points, axis=1))
    steps = [
        rotation_angle(invert(views) @ view),
        np.linalg.norm(places[:-1] - places[-1], axis=1),
        np.abs(logs[:-1] - logs[-1]),
    ]
    return np.asarray(np.array(steps).T @ (1.0 / _APART))


def _near(flanges: FloatArray, taken: FloatArray) -> Mask:
    """Whether poses of the flange (k, 4, 4) are near those taken (n, 4, 4), and no farther out [m].

    Where an arm has stood it can stand; what it reaches beyond, and what stands there, only its
    user knows.
    """
    apart = (distances(flanges, pose) for pose in taken)
    # How far from a pose that was taken another may be suggested in numbers [m, rad].
    near_masks = [(shifts_m < 0.3) & (angles < 1.0) for shifts_m, angles in apart]
    out, low = np.linalg.norm(taken[:, :3, 3], axis=1).max(), taken[:, 2, 3].min()
    is_inside = (np.linalg.norm(flanges[:, :3, 3], axis=1) <= out) & (flanges[:, 2, 3] >= low)
    return np.asarray(np.any(near_masks, axis=0) & is_inside)


def suggested_pose(
    coach: Coach,
    rejected: Sequence[FloatArray],
    flange_of: Callable[[FloatArray], FloatArray] | None,
    taken: Sequence[FloatArray],
) -> NextPose:
    """The next view by coverage, and where a trial says it, the pose of the flange.

    Args:
        coach: The views so far.
        rejected: (4, 4) `cam_from_target` of suggestions that were skipped [m].
        flange_of: The flange's poses (k, 4, 4) at views, by a trial; None without one.
        taken: (4, 4) poses of the flange so far [m].
    """
    if not coach.poses:
        return NextPose("Begin with the whole board large in the picture.")
    avoid, flange, view = [*coach.poses, *rejected], None, None
    if flange_of is not None:
        stood = np.array(taken)
        view = next_view(coach.target, coach.lens, avoid, lambda at: _near(flange_of(at), stood))
        flange = None if view is None else flange_of(view)
    view = next_view(coach.target, coach.lens, avoid) if view is None else view
    if view is None:
        return NextPose("Another place, with the whole board in the picture.")
    tilt = np.rad2deg(np.arccos(np.clip(view[2, 2], -1.0, 1.0)))
    words = (
        "Move until the board fills the orange outline, its first corner in the ring; it is "
        f"tilted by {tilt:.0f} degrees there."
    )
    return NextPose(words, view, flange)

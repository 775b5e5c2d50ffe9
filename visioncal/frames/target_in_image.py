"""A look through a calibrated camera: a target's pose in one image, and what moves it."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.pnp import ViewPoses, measure_poses
from visioncal.core.errors import DataError
from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.number_format import figure
from visioncal.core.quantiles import chi2_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, Corners, FloatArray, Image, Target
from visioncal.estimation.appearance import SCALE, Appearance, Compressed, compress, shape_basis
from visioncal.estimation.corners import CornerStack, reproject
from visioncal.estimation.gating import gate
from visioncal.estimation.lens_field import depths_m, zooms
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.poses import determines_pose
from visioncal.frames.camera_chain import Eye
from visioncal.vision.finders import NotFound, find_target
from visioncal.vision.finders.imaging import GREY, blur_at_corners, why_hard_to_see
from visioncal.vision.targets import corner_positions, rotations

# Corners scatter more than this by chance in one look of ten thousand.
_FALSE_ALARM = 1e-4
# Less than so many times the noise that was to be expected is counted without a word: light and
# distance do that.
_MENTIONED = 2.0
# Wrong corners spoil the pose that they are judged by: so often it is made anew without them.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SeenTarget:
    """A target as one image shows it: c poses that it allows, the best by reprojection first.

    Attributes:
        cam_from_target: (c, 4, 4).
        covariance: (c, 6, 6) of the right perturbations, by the pixels' noise alone.
        by_lens: (c, 6, k + m) how each moves with the camera's intrinsics, and with what its lens
            does beyond them.
        by_scale: (c, 6) how each moves with the target's size, as a share of it.
        scale_sigma: How well the size is known, as a share of it.
        turns: (c,) which of the target's own symmetries each has applied.
        warnings: What is odd about the image, in sentences.
    """

    cam_from_target: FloatArray
    covariance: FloatArray
    by_lens: FloatArray
    by_scale: FloatArray
    scale_sigma: float
    turns: tuple[int, ...]
    warnings: tuple[str, ...]


def see(
    eye: Eye, seen: Corners | Image, target: Target, label: str, sigma_px: float | None = None
) -> SeenTarget:
    """Finds the poses of a target in one image.

    Args:
        eye: The calibrated camera.
        seen: The target's corners, or the (h, w) grey image to find them in.
        target: What is seen.
        label: What the image is called in messages.
        sigma_px: Noise of a corner's coordinate [px]; where None, what is stated with the corners,
            or else the calibration's. Corners that scatter significantly more count with what they
            show, and a warning says so.

    Raises:
        DataError: The target is not in the image, its corners do not determine a pose, or they do
            not fit any pose of it.
    """
    corners = seen if isinstance(seen, Corners) else _found(eye, seen, target, label)
    _check(corners, target, label)
    noise_px = eye.noise_px(corners.stated_px if sigma_px is None else sigma_px)
    with one_blas_thread():
        straight = replace(corners, px=eye.lens.in_model(corners.px))
        poses, kept, squares = _fitted(eye, straight, target, label, noise_px)
        distance_m = _distance_m(poses, kept, target)
        if eye.breathes:
            straight = replace(corners, px=eye.lens.in_model(corners.px, distance_m))
            poses, kept, squares = _fitted(eye, straight, target, label, noise_px)
        looks = [
            _jacobian(eye, poses, at, kept, target, noise_px, distance_m)
            for at in range(len(poses.turns))
        ]
    noise_px, warnings = _noise(noise_px, squares, 2 * len(kept.ids) - 6, label)
    # Exact corners show no noise; a millionth of a pixel keeps their covariance a covariance.
    variance, lens = max(noise_px, 1e-6) ** 2, 4 + len(eye.camera.distortion)
    return SeenTarget(
        np.array([compressed.cam_from_target[0] for compressed, _ in looks]),
        np.array(
            [variance * covariance_from(compressed.information[0]) for compressed, _ in looks]
        ),
        np.array(
            [np.hstack([compressed.by_shared[0, :, :lens], beyond]) for compressed, beyond in looks]
        ),
        np.array([_by_scale(compressed.by_shared[0, :, lens:], target) for compressed, _ in looks]),
        target.square_sigma_m / target.square_m,
        poses.turns,
        warnings,
    )


def check_size(eye: Eye, image: Image, label: str) -> None:
    """Refuses an image of another size than the camera's.

    Raises:
        DataError: So it is.
    """
    width, height = eye.camera.resolution
    if image.shape != (height, width):
        shown = " x ".join(map(str, image.shape[1::-1] + image.shape[2:]))
        raise DataError(
            f"{label}: it has {shown} pixels, and the calibrated camera has {width} x {height}, "
            "grey.",
            culprits=[label],
            next_step=GREY
            if image.shape[:2] == (height, width)
            else "Take the image with the same camera, binning and region as calibrated.",
        )


def _found(eye: Eye, image: Image, target: Target, label: str) -> Corners:
    check_size(eye, image, label)
    seen = find_target(image, target)
    if isinstance(seen, NotFound):
        cause = why_hard_to_see(image, MAX_BLUR_PX)
        raise DataError(
            f"{label}: target {target.name}: {seen.reason}{'; ' if cause else ''}{cause}.",
            culprits=[label],
        )
    blur = blur_at_corners(image, seen.px) if seen.blur_px is None else seen.blur_px
    return Corners(0, seen.ids, seen.px, blur, seen.weights)


def _check(corners: Corners, target: Target, label: str) -> None:
    positions = corner_positions(target)
    ids = corners.ids
    if len(ids) and not (int(ids.min()) >= 0 and int(ids.max()) < len(positions)):
        raise DataError(
            f"{label}: corners {ids.min()} to {ids.max()}, and target {target.name} has "
            f"{len(positions)}.",
            culprits=[label],
        )
    if not determines_pose(positions[ids]):
        raise DataError(
            f"{label}: {len(ids)} corners of target {target.name} do not determine its pose: it "
            "takes four, of which two lie off every line.",
            culprits=[label],
        )


def _distance_m(poses: ViewPoses, corners: Corners, target: Target) -> float:
    """How far the corners are along the camera's axis, on average."""
    stack = CornerStack.of({corners.view: corners}, corner_positions(target))
    return float(depths_m(stack, poses.cam_from_target[:1])[0])


def _fitted(
    eye: Eye, corners: Corners, target: Target, label: str, noise_px: float
) -> tuple[ViewPoses, Corners, float]:
    """The poses, the corners that fit the best of them, and the sum of their squares [px^2]."""
    positions = corner_positions(target)
    for _ in range(_ROUNDS):
        (poses,) = measure_poses({corners.view: corners}, [target], eye.camera, noise_px)
        stack = _stack(eye, corners, positions, noise_px)
        residuals = _compressed(eye.camera, stack, target, poses.cam_from_target[:1]).residuals
        passed = gate(stack, residuals)
        if passed.reasons:
            reason = next(iter(passed.reasons.values()))
            raise DataError(f"{label}: target {target.name}: {reason}.", culprits=[label])
        if passed.is_open:
            break
        kept = passed.mask
        corners = corners.take(kept)
    return poses, corners, float(np.sum(residuals[passed.mask] ** 2))


def _stack(eye: Eye, corners: Corners, positions: FloatArray, noise_px: float) -> CornerStack:
    """The corners, which share a change of the focus."""
    stack = CornerStack.of({corners.view: corners}, positions)
    if eye.jitter == 0.0:
        return stack
    return replace(stack, zooms=eye.jitter / max(noise_px, 1e-6) * zooms(stack, eye.camera))


def _jacobian(
    eye: Eye,
    poses: ViewPoses,
    at: int,
    corners: Corners,
    target: Target,
    noise_px: float,
    distance_m: float,
) -> tuple[Compressed, FloatArray]:
    """One of the poses with all that moves it, under the numbering that it stands for.

    Returns:
        Them, and (6, m) how it moves with what the lens does beyond its model.
    """
    # Turned, corner i lies where corner p[i] was: what was seen as that one is i.
    ids = np.argsort(rotations(target)[poses.turns[at]])[corners.ids]
    turned = replace(corners, ids=ids).take(np.argsort(ids))
    stack = _stack(eye, turned, corner_positions(target), noise_px)
    found = _compressed(eye.camera, stack, target, poses.cam_from_target[at : at + 1])
    by_pose = reproject(stack, eye.camera, found.cam_from_target, lens=False).by_pose
    beyond = eye.lens.displacements(stack.px, distance_m)
    stack.weigh(beyond)
    moved = stack.products_by_view(by_pose, beyond)
    return found, -(covariance_from(found.information) @ moved)[0]


def _compressed(
    camera: Camera, stack: CornerStack, target: Target, starts: FloatArray
) -> Compressed:
    basis = shape_basis(target)
    return compress(stack, basis, Appearance(camera, np.zeros(basis.shape[2])), starts)


def _by_scale(by_shape: FloatArray, target: Target) -> FloatArray:
    """How a pose moves with the target's size: a rig has the size that its table says."""
    return np.zeros(6) if target.kind == "points" else by_shape[:, SCALE]


def _noise(
    noise_px: float, squares: float, freedom: int, label: str
) -> tuple[float, tuple[str, ...]]:
    """The noise to count with: what is known, or what the corners show where that is more."""
    limit = noise_px**2 * float(chi2_limit(_FALSE_ALARM, freedom))
    shown = float(np.sqrt(squares / freedom))
    # Rounding of exact corners is no scatter.
    if squares <= limit or shown < 1e-6:
        return noise_px, ()
    if shown < _MENTIONED * noise_px:
        return shown, ()
    return shown, (
        f"{label}: the corners scatter by {figure(shown)} px around the target's pose, and "
        f"{figure(noise_px)} px was to be expected: look whether the image is sharp, and the "
        "target flat and of the size that is stated.",
    )

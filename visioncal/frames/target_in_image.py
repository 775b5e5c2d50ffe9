"""Pose of a target in one image of a calibrated camera, with its Jacobians."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.linalg import covariance_from
from visioncal.core.number_format import figure
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Corners, FloatArray, Image, Target
from visioncal.estimation.appearance import Appearance, compress
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.results.boards import shape_seen
from visioncal.vision.board_shape import SCALE, shape_basis
from visioncal.vision.boards import NotFound
from visioncal.vision.boards.imaging import GREY, poor_image_reason
from visioncal.vision.corners import CornerStack, reproject
from visioncal.vision.detection import corners_in
from visioncal.vision.gating import gate
from visioncal.vision.lens_field import depths_m, zooms
from visioncal.vision.pnp import ViewPoses, measure_poses
from visioncal.vision.poses import determines_pose
from visioncal.vision.targets import corner_positions, rotations

# Errors of corners in sharp images, which differ by light and tilt, are up to this [px].
_SHARP_PX = 0.03


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """Candidate poses of a target in one image, c in all, the best by reprojection first."""

    cam_from_target: FloatArray  # (c, 4, 4).
    covariance: FloatArray  # (c, 6, 6) of the right perturbations, by the pixel noise alone.
    # (c, 6, k + m) Jacobians by the camera's intrinsics, and by the lens's field beyond its model.
    by_lens: FloatArray
    by_scale: FloatArray  # (c, 6) Jacobians by the target's relative size.
    scale_sigma: float  # Standard deviation of the relative size.
    symmetries: tuple[int, ...]  # (c,) index of the target's symmetry that each has applied.
    warnings: tuple[str, ...]  # Warnings on the image, in sentences.


def corners_seen(image: Image, target: Target, label: str) -> Corners:
    """A target's corners in a (h, w) grey image, called `label`; raises DataError without it."""
    corners = corners_in(image, target)
    if isinstance(corners, NotFound):
        cause = poor_image_reason(image, MAX_BLUR_PX)
        raise DataError(
            f"{label}: target {target.name}: {corners.reason}{'; ' if cause else ''}{cause}.",
            culprits=[label],
            next_step=f"Look at {label}: is target {target.name} in it, sharp, near enough and "
            "not mirrored? Take it again, or name the target that it shows.",
        )
    return corners


def target_pose_candidates(
    eye: CalibratedCamera,
    seen: Corners | Image,
    target: Target,
    label: str,
    sigma_px: float | None = None,
) -> PoseCandidates:
    """Estimates the candidate poses of a target in one image.

    Args:
        eye: The calibrated camera.
        seen: The target's corners, or the (h, w) grey image to find them in.
        target: The target.
        label: The image's name in messages.
        sigma_px: Noise of a corner's coordinate [px]; where None, that stated with the corners, or
            else the calibration's. Where corners scatter significantly more, their scatter is used,
            with a warning.

    Raises:
        DataError: The target is not in the image, its corners do not determine a pose, or they do
            not fit any pose of it.
    """
    if not isinstance(seen, Corners):
        check_image_size(eye, seen, label)
        seen = corners_seen(seen, target, label)
    corners = seen
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
    noise_px = eye.noise_px(corners.stated_px if sigma_px is None else sigma_px)
    look = Appearance(eye.camera, shape_seen(eye.calibration, target))
    with one_blas_thread():
        in_model = replace(corners, px=eye.lens.in_model(corners.px))
        poses, kept, squared_sum = _fit_poses(eye, in_model, target, look, label, noise_px)
        stack = CornerStack.of({kept.view: kept}, positions)
        # Mean depth of the corners.
        distance_m = float(depths_m(stack, poses.cam_from_target[:1])[0])
        if eye.lens.field is not None and eye.lens.field.breathing > 0.0:
            in_model = replace(corners, px=eye.lens.in_model(corners.px, distance_m))
            poses, kept, squared_sum = _fit_poses(eye, in_model, target, look, label, noise_px)
        # Each candidate refined, with its Jacobians and corners numbered by its symmetry.
        fits = []
        for at, turn in enumerate(poses.turns):
            # With the rotation p applied, corner i lies where corner p[i] was: that id becomes i.
            ids = np.argsort(rotations(target)[turn])[kept.ids]
            turned = replace(kept, ids=ids).take(np.argsort(ids))
            stack = _stack(eye, turned, positions, noise_px)
            start = poses.cam_from_target[at : at + 1]
            compressed = compress(stack, shape_basis(target), look, start)
            by_pose = reproject(stack, eye.camera, compressed.cam_from_target, lens=False).by_pose
            by_field = eye.lens.displacements(stack.px, distance_m)
            stack.weigh(by_field)
            cross = stack.products_by_view(by_pose, by_field)
            fits.append((compressed, -(covariance_from(compressed.information) @ cross)[0]))
    freedom = 2 * len(kept.ids) - 6
    warnings: tuple[str, ...] = ()
    scatter_px = float(np.sqrt(squared_sum / freedom))
    is_larger = squared_sum > noise_px**2 * float(chi2_limit(FALSE_ALARM, freedom))
    # Rounding of exact corners is no scatter.
    if is_larger and scatter_px >= 1e-6:
        # Light and distance explain less.
        if scatter_px >= max(2.0 * noise_px, _SHARP_PX):
            warnings = (
                f"{label}: the corners scatter by {figure(scatter_px)} px around the target's "
                f"pose, and {figure(noise_px)} px was to be expected: look whether the image is "
                "sharp, and the target flat and of the size that is stated.",
            )
        noise_px = scatter_px
    # Corners without noise get a millionth of a pixel, so that the covariance is not zero.
    variance, lens = max(noise_px, 1e-6) ** 2, 4 + len(eye.camera.distortion)
    return PoseCandidates(
        np.array([compressed.cam_from_target[0] for compressed, _ in fits]),
        np.array([variance * covariance_from(compressed.information[0]) for compressed, _ in fits]),
        np.array(
            [np.hstack([compressed.by_shared[0, :, :lens], beyond]) for compressed, beyond in fits]
        ),
        # A rig's size is exact.
        np.array(
            [
                np.zeros(6) if target.is_rig else compressed.by_shared[0, :, lens + SCALE]
                for compressed, _ in fits
            ]
        ),
        target.square_sigma_m / target.square_m,
        poses.turns,
        warnings,
    )


def check_image_size(eye: CalibratedCamera, image: Image, label: str) -> None:
    """Checks that an image is grey and of the camera's resolution; raises DataError."""
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


def _fit_poses(
    eye: CalibratedCamera,
    corners: Corners,
    target: Target,
    look: Appearance,
    label: str,
    noise_px: float,
) -> tuple[ViewPoses, Corners, float]:
    """Candidate poses, the inlier corners of the best, and their squared residuals' sum [px^2]."""
    positions = corner_positions(target)
    for _ in range(3):
        (poses,) = measure_poses({corners.view: corners}, [target], eye.camera, noise_px)
        stack = _stack(eye, corners, positions, noise_px)
        start = poses.cam_from_target[:1]
        residuals = compress(stack, shape_basis(target), look, start).residuals
        passed = gate(stack, residuals)
        if passed.reasons:
            reason = next(iter(passed.reasons.values()))
            raise DataError(f"{label}: target {target.name}: {reason}.", culprits=[label])
        if passed.is_open:
            break
        kept = passed.mask
        corners = corners.take(kept)
    return poses, corners, float(np.sum(residuals[passed.mask] ** 2))


def _stack(
    eye: CalibratedCamera, corners: Corners, positions: FloatArray, noise_px: float
) -> CornerStack:
    """Stack of the corners, with the common effect of focal length jitter."""
    stack = CornerStack.of({corners.view: corners}, positions)
    if eye.jitter == 0.0:
        return stack
    return replace(stack, zooms=eye.jitter / max(noise_px, 1e-6) * zooms(stack.px, eye.camera))

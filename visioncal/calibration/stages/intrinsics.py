"""Estimation of the camera's intrinsics, where the session states none."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from visioncal.core.errors import ConvergenceError, DataError, DegenerateError
from visioncal.core.finding_kinds import EMPTY_IMAGE
from visioncal.core.number_format import counted, listed
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import Camera, CameraKind, Corners, FloatArray, Rejection, Target
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.bundle import BundleFit, fit_bundle
from visioncal.estimation.corners import CornerStack, mean_square_by_view
from visioncal.estimation.gating import gate
from visioncal.estimation.poses import fit_poses, planar_poses
from visioncal.vision.targets import numbered_positions

# Two views of a plane determine fx, fy, cx, cy in theory (Zhang 2000, section 3.1); a third gives
# the distortion and a first check.
_FEWEST_VIEWS = 3
_ROUNDS = 3
# Starts for the focal length, in image widths, where Zhang's own start does not converge.
_FOCAL_WIDTHS = (0.3, 0.6, 1.0, 2.0)
# Least relative gain of the rational model, of views in the fit and of held-out ones.
_LEAST_GAIN, _FOLDS = 0.02, 5
# Limits of the warnings: the focal length as a share, the principal point [px], tilt [deg] and
# ratio of distances of the views; the parts of the image along each side.
_FOCAL_LIMIT, _CENTRE_LIMIT_PX = 0.005, 5.0
_TILT_SPREAD_DEG, _DISTANCE_SPREAD, _GRID = 10.0, 1.2, 3


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Estimated intrinsics."""

    camera: Camera  # The intrinsics.
    covariance: FloatArray  # (4 + k, 4 + k) of fx, fy, cx, cy and the distortion.
    sigma_px: float  # Standard deviation of a corner's coordinate, stated or by the residuals [px].
    rejections: tuple[Rejection, ...]  # Outlier views.
    warnings: tuple[Finding, ...]  # What the views do not determine.


def estimate_intrinsics(
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    resolution: tuple[int, int],
    model: CameraKind,
) -> Intrinsics:
    """Estimates the intrinsics from views of targets (Zhang 2000 for planar ones).

    Brown's model has 5 coefficients of distortion, or 8 where these predict held-out views better;
    a fisheye has 4.

    Args:
        corners: The corners by view.
        targets: The targets; the corners of several are numbered through.
        resolution: (width, height) [px].
        model: `brown` or `fisheye`.

    Returns:
        The intrinsics with covariance.

    Raises:
        DataError: There are too few views.
        DegenerateError: The views do not determine the focal length at all.
        ConvergenceError: No start converges.
    """
    if len(corners) < _FEWEST_VIEWS:
        raise DataError(
            f"intrinsics: {counted(len(corners), 'view', ('shows', 'show'))} the target, and at "
            f"least {_FEWEST_VIEWS} are needed.",
            culprits=["views"],
            next_step="Add views, or give matrix and distortion in [camera].",
        )
    full = CornerStack.of(corners, numbered_positions(targets))
    with one_blas_thread():
        stack, fit, reasons = _gated(full, _first_fit(full, model, resolution))
        if reasons:
            # With a wrong initial focal length a pose may tilt the other way and stay there: the
            # most tilted views, which determine the lens best, then seem outliers.
            plain = replace(fit.camera, distortion=np.zeros_like(fit.camera.distortion))
            restarted = _gated(full, _fit(full, plain, planar_poses(full, plain).first))
            if len(restarted[2]) < len(reasons):
                stack, fit, reasons = restarted
        if model == "brown":
            fit = _with_rational_terms(stack, fit)
    relative = np.sqrt(np.diag(fit.covariance)[:2]) / fit.camera.matrix[:2]
    if not fit.settled or not np.all(np.isfinite(relative)) or np.any(fit.camera.matrix[:2] <= 0):
        raise ConvergenceError(
            "intrinsics: the estimate does not come to rest.",
            next_step="Give matrix and distortion in [camera], or add tilted views.",
        )
    if relative.max() > 0.2:
        raise DegenerateError(
            f"intrinsics: the views leave the focal length open to {100 * relative.max():.0f} %.",
            next_step="Add views tilted by 30 to 45 degrees, or give matrix and distortion.",
        )
    rejections = tuple(Rejection(*item) for item in reasons.items())
    warnings = tuple(_warnings(stack, fit))
    return Intrinsics(fit.camera, fit.covariance, fit.sigma_px, rejections, warnings)


def _gated(stack: CornerStack, fit: BundleFit) -> tuple[CornerStack, BundleFit, dict[int, str]]:
    """Refits without outlier corners and views; reasons by view."""
    reasons: dict[int, str] = {}
    for _ in range(_ROUNDS):
        gated = gate(stack, fit.residuals)
        if gated.is_open:
            break
        reasons |= gated.reasons
        kept = stack.keep(gated.mask)
        poses = fit.cam_from_target[np.isin(stack.views, kept.views)]
        stack, fit = kept, _fit(kept, fit.camera, poses)
    return stack, fit, reasons


def _fit(stack: CornerStack, camera: Camera, poses: FloatArray) -> BundleFit:
    """Fits with priors far wider than any lens, which only bound undetermined directions."""
    size = np.array(camera.resolution, dtype=float)
    sigma = np.concatenate([np.full(2, size[0]), size / 4, np.full(len(camera.distortion), 100.0)])
    return fit_bundle(stack, camera, poses, sigma)


def _first_fit(stack: CornerStack, model: CameraKind, resolution: tuple[int, int]) -> BundleFit:
    """Fits from Zhang's start and further focal lengths until a fit is good."""
    (width, height), fits = resolution, list[BundleFit]()
    starts = [share * width for share in _FOCAL_WIDTHS]
    # Zhang's start takes boards in their plane z = 0.
    if not stack.points[:, 2].any():
        points = np.split(stack.points.astype(np.float32), stack.starts[1:])
        px = np.split(stack.px.astype(np.float32), stack.starts[1:])
        zhang = float(cv2.initCameraMatrix2D(points, px, resolution)[0, 0])
        starts = [zhang] * bool(0.1 * width < zhang < 20 * width) + starts
    for focal in starts:
        matrix = np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])
        camera = Camera(model, resolution, matrix, np.zeros(4 if model == "fisheye" else 5))
        fits.append(_fit(stack, camera, planar_poses(stack, camera).first))
        best = min(fits, key=lambda fit: fit.sigma_px)
        # Corners are found to a few tenths of a pixel; a wrong minimum is off by many pixels.
        if best.sigma_px < 1.0 and best.settled:
            break
    if not np.isfinite(best.sigma_px):
        raise ConvergenceError(
            "intrinsics: no focal length explains the views.",
            next_step="Check the target's description against the print.",
        )
    return best


def _with_rational_terms(stack: CornerStack, fit: BundleFit) -> BundleFit:
    """Takes 8 coefficients instead of 5 where held-out views are predicted better."""
    # Starts from the polynomial: from zero, a pole and a zero may cancel inside the image.
    camera = fit.camera
    padded = replace(camera, distortion=np.concatenate([camera.distortion, np.zeros(3)]))
    wider = _fit(stack, padded, fit.cam_from_target)
    gain = 1.0 - float(np.sum(wider.residuals**2) / np.sum(fit.residuals**2))
    if not wider.settled or gain < _LEAST_GAIN or len(stack.views) < 2 * _FOLDS:
        return fit
    # The median, because where a fold leaves out an edge of the image, the wider model may diverge
    # there, which it does not with all views.
    ratio = float(np.median(_held_out(stack, wider) / _held_out(stack, fit)))
    return wider if ratio < 1.0 - _LEAST_GAIN else fit


def _held_out(stack: CornerStack, fit: BundleFit) -> FloatArray:
    """(v,) mean squared error [px^2] of held-out views."""
    fold = np.arange(len(stack.views)) % _FOLDS
    squares = np.zeros(len(stack.views))
    for left_out in range(_FOLDS):
        inside = fold[stack.view_of] != left_out
        fitted = _fit(stack.keep(inside), fit.camera, fit.cam_from_target[fold != left_out])
        rest = stack.keep(~inside)
        poses = fit_poses(rest, fitted.camera, fit.cam_from_target[fold == left_out])
        squares[fold == left_out] = mean_square_by_view(rest, poses.residuals)
    return squares


def _warnings(stack: CornerStack, fit: BundleFit) -> Iterator[Finding]:
    """States what the views do not determine, and why."""
    sigma, poses = np.sqrt(np.diag(fit.covariance)), fit.cam_from_target
    focal, centre = (sigma[:2] / fit.camera.matrix[:2]).max(), sigma[2:4].max()
    tilt_deg = np.rad2deg(np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0.0, 1.0))).max()
    distances = np.linalg.norm(poses[:, :3, 3], axis=1)
    spread = distances.max() / distances.min()
    words, step = [], Remedy("Add views, tilted and near the image's edges.")
    if focal > _FOCAL_LIMIT:
        words.append(f"The corners alone determine the focal length to {100 * focal:.1f} % only.")
    if centre > _CENTRE_LIMIT_PX:
        words.append(f"The corners alone determine the image centre to {centre:.1f} px only.")
    is_flat = not stack.points[:, 2].any()
    if is_flat and spread < _DISTANCE_SPREAD and tilt_deg < 2 * _TILT_SPREAD_DEG:
        words.append(f"All views are from one distance (within {100 * (spread - 1):.0f} %).")
        step = Remedy("Vary the distance of the views.")
    if is_flat and tilt_deg < _TILT_SPREAD_DEG:
        words.append(f"All views are frontal (tilted by at most {tilt_deg:.0f} degrees).")
        step = Remedy("Add views tilted by 30 to 45 degrees.")
    if words:
        yield Finding("weak_lens", " ".join(words), step, until_mm=0.0)
    cell = np.minimum((stack.px / np.array(fit.camera.resolution) * _GRID).astype(int), _GRID - 1)
    visited, ends = set(map(tuple, cell.tolist())), (0, _GRID - 1)
    empty = [
        f"{edge} {side}"
        for y, edge in zip(ends, ("upper", "lower"), strict=True)
        for x, side in zip(ends, ("left", "right"), strict=True)
        if (x, y) not in visited
    ]
    if empty:
        yield Finding(
            EMPTY_IMAGE,
            f"No corner was ever seen in the {listed(empty)} of the image, so the lens is "
            "extrapolated there.",
            Remedy(f"In some views, move the target into the {listed(empty)} of the image."),
        )

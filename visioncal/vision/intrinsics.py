"""Estimation of the camera's intrinsics, where the session states none.

Bundle adjustment of intrinsics and poses, from corners alone (Zhang 2000, section 3.2). The poses
are eliminated view by view with a Schur complement (Triggs et al. 2000, section 6.1), so that each
step solves a system of the size of the intrinsics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np

from visioncal.core.errors import ConvergenceError, DataError, DegenerateError
from visioncal.core.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.linalg import covariance_from, damped_step, gram
from visioncal.core.number_format import counted, percent
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import exp
from visioncal.core.types import Camera, CameraKind, Corners, FloatArray, Rejection, Target
from visioncal.vision.camera import intrinsics, with_intrinsics
from visioncal.vision.corners import CornerStack, Reprojection, reproject
from visioncal.vision.gating import gate
from visioncal.vision.poses import planar_poses
from visioncal.vision.targets import numbered_positions

# The intrinsics (4 + k,) and the poses (v, 4, 4).
_State: TypeAlias = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Estimated intrinsics."""

    camera: Camera  # The intrinsics.
    covariance: FloatArray  # (4 + k, 4 + k) of fx, fy, cx, cy and the distortion.
    sigma_px: float  # Standard deviation of a corner's coordinate, stated or by the residuals [px].
    rejections: tuple[Rejection, ...]  # Outlier views.


@dataclass(frozen=True, eq=False)
class BundleFit:
    """Result of the bundle adjustment."""

    camera: Camera
    cam_from_target: FloatArray  # (v, 4, 4).
    residuals: FloatArray  # (n, 2) [px].
    sigma_px: float  # Standard deviation of a corner's coordinate, stated or by the residuals [px].
    covariance: FloatArray  # (4 + k, 4 + k) of the intrinsics, poses marginalised.
    settled: bool  # Whether the iteration converged.


def estimate_intrinsics(
    corners: Mapping[int, Corners],
    targets: Sequence[Target],
    resolution: tuple[int, int],
    model: CameraKind,
) -> Intrinsics:
    """Estimates the intrinsics from views of targets (Zhang 2000 for planar ones).

    Brown's model has 5 coefficients of distortion, a fisheye 4.

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
    # Two views of a plane determine fx, fy, cx, cy in theory (Zhang 2000, section 3.1); a third
    # gives the distortion and a first check.
    if len(corners) < FEWEST_VIEWS:
        raise DataError(
            f"intrinsics: {counted(len(corners), 'view', ('shows', 'show'))} the target, but it "
            f"takes at least {FEWEST_VIEWS}.",
            culprits=["views"],
            next_step="Add views, or give matrix and distortion in [camera].",
        )
    stack = CornerStack.of(corners, numbered_positions(targets))
    with one_blas_thread():
        fit, reasons = _gated(stack, _first_fit(stack, model, resolution))
        if reasons:
            # With a wrong initial focal length a pose may tilt the other way and stay there: the
            # most tilted views, which determine the lens best, then seem outliers.
            plain = replace(fit.camera, distortion=np.zeros_like(fit.camera.distortion))
            restarted = _gated(stack, _fit(stack, plain, planar_poses(stack, plain).first))
            if len(restarted[1]) < len(reasons):
                fit, reasons = restarted
    relative = np.sqrt(np.diag(fit.covariance)[:2]) / fit.camera.matrix[:2]
    if not fit.settled or not np.all(np.isfinite(relative)) or np.any(fit.camera.matrix[:2] <= 0):
        spans = [np.ptp(seen.px[:, 0]) for seen in corners.values()]
        share = float(np.median(spans)) / resolution[0]
        raise ConvergenceError(
            "intrinsics: the estimate does not come to rest: the target is seen over "
            f"{percent(share)} of the image's width (median), and perspective shows where it is "
            "near and tilted.",
            next_step="Give matrix and distortion in [camera], as a calibration of this camera "
            "alone has them, or add 10 images (role = intrinsics) in which the target is held "
            "near, over half of the width, tilted by 30 to 45 degrees.",
        )
    if relative.max() > 0.2:
        raise DegenerateError(
            f"intrinsics: the views leave the focal length open to {100 * relative.max():.0f} %.",
            next_step="Add views tilted by 30 to 45 degrees, or give matrix and distortion.",
        )
    rejections = tuple(Rejection(*item) for item in reasons.items())
    return Intrinsics(fit.camera, fit.covariance, fit.sigma_px, rejections)


def _gated(stack: CornerStack, fit: BundleFit) -> tuple[BundleFit, dict[int, str]]:
    """Refits without outlier corners and views; reasons by view."""
    reasons: dict[int, str] = {}
    for _ in range(3):
        gated = gate(stack, fit.residuals)
        if gated.is_open:
            break
        reasons |= gated.reasons
        kept = stack.keep(gated.mask)
        poses = fit.cam_from_target[np.isin(stack.views, kept.views)]
        stack, fit = kept, _fit(kept, fit.camera, poses)
    return fit, reasons


def _fit(stack: CornerStack, camera: Camera, poses: FloatArray) -> BundleFit:
    """Fits with priors far wider than any lens, which only bound undetermined directions."""
    size = np.array(camera.resolution, dtype=float)
    sigma = np.concatenate([np.full(2, size[0]), size / 4, np.full(len(camera.distortion), 100.0)])
    return _bundle(stack, camera, poses, sigma)


def _first_fit(stack: CornerStack, model: CameraKind, resolution: tuple[int, int]) -> BundleFit:
    """Fits from Zhang's start and further focal lengths until a fit is good."""
    (width, height), fits = resolution, list[BundleFit]()
    # Starts for the focal length, in image widths, where Zhang's own start does not converge.
    starts = [share * width for share in (0.3, 0.6, 1.0, 2.0)]
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


def _bundle(
    stack: CornerStack, camera: Camera, cam_from_target: FloatArray, prior_sigma: FloatArray
) -> BundleFit:
    """Estimates intrinsics and poses by Levenberg-Marquardt.

    The camera is the start and the mean of a weak prior, (4 + k,) sigmas, which holds what views
    cannot determine; the covariance does not count it. `cam_from_target` are (v, 4, 4) starts.
    """
    start, weight = intrinsics(camera), 1.0 / prior_sigma**2

    def linearise(at: _State) -> Linearised[_State]:
        values, poses = at
        reprojection = reproject(stack, with_intrinsics(camera, values), poses)
        offset = values - start

        def step(damping: float) -> _State:
            information, gradient, response = _reduced(stack, reprojection, damping)
            # The prior is in units of a corner's noise of 1 px, as the information is.
            change = damped_step(information + np.diag(weight), gradient + weight * offset, damping)
            pose_steps = -(response[:, :, :-1] @ change) - response[:, :, -1]
            return values + change, poses @ exp(pose_steps)

        return Linearised(at, float(np.sum(reprojection.residuals**2) + weight @ offset**2), step)

    (values, poses), settled = levenberg_marquardt((start, cam_from_target), linearise)
    fitted = with_intrinsics(camera, values)
    reprojection = reproject(stack, fitted, poses)
    information, _, _ = _reduced(stack, reprojection, 0.0)
    sigma_px = stack.sigma_px(reprojection.residuals, 6 * len(poses) + len(information))
    covariance = sigma_px**2 * covariance_from(information)
    return BundleFit(fitted, poses, reprojection.residuals, sigma_px, covariance, settled)


def _reduced(
    stack: CornerStack, reprojection: Reprojection, damping: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (k, k) and gradient (k,) of k intrinsics, without the v poses.

    And (v, 6, k + 1) response of the poses: to a step of the intrinsics, and of their own gradient.
    """
    by_pose, by_intrinsics = reprojection.by_pose, reprojection.by_intrinsics
    rest = np.concatenate([by_intrinsics, reprojection.residuals[:, :, None]], axis=2)
    products = stack.products_by_view(by_pose, np.concatenate([by_pose, rest], axis=2))
    information = products[:, :, :6]
    response = covariance_from(information + damping * information * np.eye(6)) @ products[:, :, 6:]
    between = products[:, :, 6:-1]
    schur = gram(by_intrinsics, rest) - gram(between, response)
    return schur[:, :-1], schur[:, -1], response

"""Lens errors beyond the camera models: their size, and the section of the result."""

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.fit import Fit
from visioncal.estimation.unknowns import BOARD, LENS, LENS_ERRORS
from visioncal.results.lens import LensField
from visioncal.vision.corners import floored_sigma_px
from visioncal.vision.lens_field import LensLevels, depths_m, displacements


def mean_distance_m(fit: Fit, camera: str) -> float:
    """The mean distance of one camera's views [m]."""
    seen, which = fit.linearised, fit.unknowns.of(LENS).index(camera)
    stack = seen.camera_parameters.problems[camera].stack
    return float(np.mean(depths_m(stack, seen.compressed[which].cam_from_target)))


def lens_field_of(fit: Fit, camera: str) -> LensField | None:
    """The result's section on one lens's errors beyond its model; None where there are none.

    `camera` is its frame.
    """
    seen, covariance, lens = fit.linearised, fit.whole, (LENS, camera)
    optics, which = seen.camera_parameters, fit.unknowns.of(LENS).index(camera)
    levels, noise_px = optics.problems[camera].levels, floored_sigma_px(seen.sigmas_px[which])
    if levels is None or not (levels.field or levels.breathing or levels.jitter):
        return None
    mean, jacobian, root = np.zeros(0), np.zeros((0, len(covariance))), np.zeros((0, 0))
    if (coefficients := seen.compressed[which].coefficients) is not None:
        # Coefficients depend on lens and boards, and on those directions of themselves that also
        # move the poses, which are unknowns of the fit.
        places, beyond = optics.places(camera), (LENS_ERRORS, camera)
        slope = coefficients.slope[:, np.isin(places, seen.free)]
        columns = np.append(fit.unknowns.columns(lens), fit.unknowns.of_kinds(BOARD))
        jacobian = np.zeros((len(slope), len(covariance)))
        jacobian[:, columns], jacobian[:, fit.unknowns[beyond]] = slope, coefficients.moving_roots
        change = (fit.camera_parameters.values - optics.values)[np.intersect1d(places, seen.free)]
        fitted = coefficients.moving_roots @ fit.values(beyond)
        mean = (coefficients.mean + slope @ change + fitted) / noise_px
        rest = coefficients.rest @ coefficients.rest.T
        covariance_px = jacobian @ covariance @ jacobian.T / noise_px**2 + rest
        root = _root(covariance_px, optics.camera(camera), levels)
    with_lens = np.zeros((len(mean), len(fit.values(lens))))
    with_lens[:, fit.unknowns.values_of(lens)] = (
        jacobian @ covariance[:, fit.unknowns.columns(lens)] / noise_px
    )
    return LensField(
        field_px=noise_px * levels.field,
        length=levels.length,
        breathing=noise_px * levels.breathing,
        jitter=noise_px * levels.jitter,
        distance_m=mean_distance_m(fit, camera),
        coefficients=mean,
        root=root,
        intrinsics_covariance=with_lens,
        edge_covariance=jacobian @ covariance[:, : 6 * len(fit.frames)] / noise_px,
    )


def _root(covariance: FloatArray, camera: Camera, levels: LensLevels) -> FloatArray:
    """(m, r) root of a covariance of coefficients, without those of negligible displacement."""
    # Grid points per image axis.
    x_px, y_px = (np.linspace(0.0, size - 1.0, 12) for size in camera.resolution)
    px = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
    # Breathing counts at twice the mean distance.
    size = np.sqrt(np.mean(np.sum(displacements(px, camera, 1.0, levels) ** 2, axis=1), axis=0))
    values, vectors = np.linalg.eigh(np.outer(size, size) * covariance)
    # Less variance of displacements is negligible beside that of corners.
    kept = values > 1e-4
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]) / size[:, None])

"""Lens errors beyond the camera models: their size, and the section of the result."""

from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.effects.lenses import LENSES, LinearisedCorners
from visioncal.estimation.lens_field import LensLevels, depths_m, displacements
from visioncal.results.lens import LensField

# Variance of displacements that is negligible beside that of corners; grid points per image axis.
_NEGLIGIBLE, _GRID = 1e-4, 12


@dataclass(frozen=True)
class LensErrors:
    """Errors of one lens beyond its model."""

    levels: LensLevels  # Their sizes, in units of `noise_px`.
    noise_px: float  # Standard deviation of a corner's coordinate [px].
    distance_m: float  # The mean distance of the views [m].
    focal_px: float  # The focal length [px].

    @property
    def field_px(self) -> float:
        """Standard deviation of the displacement field per axis [px]."""
        return self.levels.field * self.noise_px


def lens_errors(cell_fit: CellFit) -> dict[str, LensErrors]:
    """Lens errors of each camera; empty for a session without images."""
    seen = cell_fit.linearised_corners
    if seen is None:
        return {}
    optics = seen.camera_parameters
    return {
        name: LensErrors(
            problem.levels or LensLevels(),
            seen.sigmas_px[which],
            _distance_m(seen, which),
            float(np.mean(optics.camera(name).matrix[:2])),
        )
        for which, (name, problem) in enumerate(optics.problems.items())
    }


def _distance_m(seen: LinearisedCorners, which: int) -> float:
    """The mean distance of one camera's views."""
    stack = [*seen.camera_parameters.problems.values()][which].stack
    return float(np.mean(depths_m(stack, seen.compressed[which].cam_from_target)))


def lens_field_of(
    cell_fit: CellFit, camera: str, covariance: FloatArray, edges: int
) -> LensField | None:
    """The result's section on one lens's errors beyond its model; None where there are none.

    Args:
        cell_fit: The fit.
        camera: The frame of the camera.
        covariance: (p, p) of the fit's unknowns.
        edges: How many of these, the first, belong to edges.
    """
    seen = cell_fit.linearised_corners
    if seen is None:
        return None
    optics, which = seen.camera_parameters, list(seen.camera_parameters.problems).index(camera)
    levels, noise_px = optics.problems[camera].levels, floored_sigma_px(seen.sigmas_px[which])
    if levels is None or not (levels.field or levels.breathing or levels.jitter):
        return None
    lens, places = optics.lens_of(camera), optics.places(camera)
    mean, jacobian, root = np.zeros(0), np.zeros((0, len(covariance))), np.zeros((0, 0))
    if (coefficients := seen.compressed[which].coefficients) is not None:
        # Coefficients depend on lens and boards, and on those directions of themselves that also
        # move the poses, which are unknowns of the fit.
        sizes = seen.field_sizes
        first, is_free = sum(sizes[:which]), np.isin(places, seen.free)
        beyond = cell_fit.field_columns[first : first + sizes[which]]
        jacobian = np.zeros((len(coefficients.mean), len(covariance)))
        jacobian[:, cell_fit.columns_of(places[is_free])] = coefficients.slope[:, is_free]
        jacobian[:, beyond] = coefficients.moving_roots
        values = cell_fit.inlier_fit.problem.values_of(LENSES, cell_fit.inlier_fit.fit.state)
        change = (values[: len(seen.free)] - optics.values[seen.free])[np.isin(seen.free, places)]
        fitted = coefficients.moving_roots @ values[beyond - cell_fit.lens_columns.start]
        mean = (coefficients.mean + coefficients.slope[:, is_free] @ change + fitted) / noise_px
        rest = coefficients.rest @ coefficients.rest.T
        own = jacobian @ covariance @ jacobian.T / noise_px**2 + rest
        root = _root(own, optics.camera(camera), levels)
    with_lens, free = np.zeros((len(mean), len(lens))), np.isin(lens, seen.free)
    with_lens[:, free] = jacobian @ covariance[:, cell_fit.columns_of(lens[free])] / noise_px
    return LensField(
        field_px=noise_px * levels.field,
        length=levels.length,
        breathing=noise_px * levels.breathing,
        jitter=noise_px * levels.jitter,
        distance_m=_distance_m(seen, which),
        coefficients=mean,
        root=root,
        intrinsics_covariance=with_lens,
        edge_covariance=jacobian @ covariance[:, :edges] / noise_px,
    )


def _root(covariance: FloatArray, camera: Camera, levels: LensLevels) -> FloatArray:
    """(m, r) root of a covariance of coefficients, without those of negligible displacement."""
    x_px, y_px = (np.linspace(0.0, size - 1.0, _GRID) for size in camera.resolution)
    px = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
    # Breathing counts at twice the mean distance.
    size = np.sqrt(np.mean(np.sum(displacements(px, camera, 1.0, levels) ** 2, axis=1), axis=0))
    values, vectors = np.linalg.eigh(np.outer(size, size) * covariance)
    kept = values > _NEGLIGIBLE
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]) / size[:, None])

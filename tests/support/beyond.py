"""Calibrations of lenses beyond their models, and with one error of edge, lens and field."""

from dataclasses import replace

import numpy as np

from visioncal.core.transforms import exp
from visioncal.results import Calibration
from visioncal.results.lens import LensField
from visioncal.vision.camera import intrinsics, with_intrinsics
from visioncal.vision.lens_field import displacements


def with_field(calibration: Calibration, seed: int = 0) -> Calibration:
    """The calibration of a lens with a field of 0.3 px that breathes by 0.1 %."""
    rng, lens = np.random.default_rng(seed), calibration.camera
    field = LensField(
        field_px=0.3,
        length=0.2,
        breathing=1e-3,
        jitter=0.0,
        distance_m=0.5,
        coefficients=np.zeros(0),
        root=np.zeros((0, 0)),
        intrinsics_covariance=np.zeros((0, 9)),
        edge_covariance=np.zeros((0, 12)),
    )
    count = displacements(np.zeros((1, 2)), lens.camera, 0.0, field.levels).shape[2]
    field = replace(
        field,
        coefficients=rng.standard_normal(count),
        root=0.1 * rng.standard_normal((count, 3)),
        intrinsics_covariance=np.zeros((count, 9)),
        edge_covariance=np.zeros((count, 12)),
    )
    return replace(calibration, camera=replace(lens, field=field))


def moved(calibration: Calibration, step: np.ndarray) -> Calibration:
    """The calibration after a (6 + k + m,) step of the camera's edge, its lens, and its field."""
    name, lens = next(iter(calibration.edges)), calibration.camera
    size = 6 + 4 + len(lens.camera.distortion)
    edge = calibration.edges[name]
    edges = {**calibration.edges, name: replace(edge, matrix=edge.matrix @ exp(step[:6]))}
    camera = with_intrinsics(lens.camera, intrinsics(lens.camera) + step[6:size])
    field = lens.field
    if field is not None:
        field = replace(field, coefficients=field.coefficients + step[size:])
    return replace(calibration, edges=edges, camera=replace(lens, camera=camera, field=field))


def an_error(calibration: Calibration, seed: int) -> np.ndarray:
    """A (6 + k + m,) error: some mrad, mm, pixels, thousandths of distortion, tenths of sizes."""
    lens, field = calibration.camera.camera.distortion, calibration.camera.field
    count = 0 if field is None else len(field.coefficients)
    size = [np.full(6, 1e-3), np.full(4, 1.0), np.full(len(lens), 1e-3), np.full(count, 0.1)]
    every = np.concatenate(size)
    return every * np.random.default_rng(seed).standard_normal(len(every))


def with_error(calibration: Calibration, error: np.ndarray) -> Calibration:
    """The calibration with the covariance of one (6 + k + m,) error of random size."""
    covariance, size = np.outer(error, error), 6 + 4 + len(calibration.camera.camera.distortion)
    lens, beyond, name = slice(6, size), slice(size, None), next(iter(calibration.edges))
    others = ((0, 0), (0, 6 * (len(calibration.edges) - 1)))
    field = calibration.camera.field
    if field is not None:
        field = replace(
            field,
            root=error[beyond, None],
            intrinsics_covariance=covariance[beyond, lens],
            edge_covariance=np.pad(covariance[beyond, :6], others),
        )
    camera = replace(
        calibration.camera,
        estimated=True,
        covariance=covariance[lens, lens],
        edge_covariance=np.pad(covariance[lens, :6], others),
        field=field,
    )
    edge = replace(calibration.edges[name], covariance=covariance[:6, :6])
    return replace(calibration, edges={**calibration.edges, name: edge}, camera=camera)

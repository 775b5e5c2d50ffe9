"""A lens with a field, as far as coefficients alone can say it."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import Camera, FloatArray
from visioncal.results.lens import CameraResult
from visioncal.vision.camera import (
    intrinsics,
    normalise,
    project,
    project_with_jacobian,
    with_intrinsics,
)

# Pixels along the image's width and height to which coefficients are fitted, and steps of that.
_GRID, _STEPS = (40, 32), 5
# A field of less where it was seen changes nothing [px].
_NOTICED_PX = 0.01
# What counts as seen: where the field is known to better than so much of its variance.
_SEEN = 0.5
# Combinations of coefficients that move no pixel stay.
_DETERMINED = 1e-8


@dataclass(frozen=True, eq=False)
class RefittedLens:
    """The lens that readers of matrix and coefficients alone are given.

    Attributes:
        camera: Matrix and coefficients that see rays as the lens and its field do.
        rms_px: What they leave of the field, an axis, where it was seen [px].
        most_px: The largest of it there, an axis [px].
    """

    camera: Camera
    rms_px: float = 0.0
    most_px: float = 0.0


def refitted(lens: CameraResult) -> RefittedLens:
    """Fits matrix and coefficients to a lens and its field, at the views' mean distance.

    Where nothing was seen the field is not known, and nothing is fitted. The camera's frame stays,
    so that its transform goes with the lens.
    """
    camera = lens.camera
    if lens.field is None or not len(lens.field.coefficients):
        return RefittedLens(camera)
    axes = (np.linspace(0.0, at - 1.0, n) for at, n in zip(camera.resolution, _GRID, strict=True))
    px = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    straight = lens.in_model(px)
    rays, weights = normalise(camera, straight), _known(lens, px)
    seen = np.isfinite(rays).all(axis=1) & (weights > 0.0)
    px, straight, rays, weights = px[seen], straight[seen], rays[seen], weights[seen]
    size = len(intrinsics(camera))
    if len(px) < size or _rms(px - straight, weights) < _NOTICED_PX:
        return RefittedLens(camera)
    found, points = camera, np.column_stack([rays, np.ones(len(rays))])
    roots, moved = np.sqrt(weights)[:, None], np.arange(_last(camera))
    for _ in range(_STEPS):
        there = project_with_jacobian(found, points)
        columns = (roots[:, :, None] * there.by_intrinsics[:, :, moved]).reshape(-1, len(moved))
        scale = np.linalg.norm(columns, axis=0)
        away = (roots * (px - there.px)).ravel()
        step = np.linalg.lstsq(columns / scale, away, rcond=_DETERMINED)[0] / scale
        found = with_intrinsics(found, intrinsics(found) + np.pad(step, (0, size - len(step))))
    left = px - project(found, points)
    most_px = float(np.abs(left[weights > _SEEN]).max(initial=0.0))
    return RefittedLens(found, _rms(left, weights), most_px)


def _last(camera: Camera) -> int:
    """How many intrinsics are fitted: coefficients at the end that are zero are none of the model.

    Without any, all of them are.
    """
    used = np.flatnonzero(camera.distortion)
    return len(intrinsics(camera)) if not len(used) else 4 + int(used[-1]) + 1


def _known(lens: CameraResult, px: FloatArray) -> FloatArray:
    """(n,) by which share of its variance the field is known at (n, 2) pixels."""
    if lens.field is None:
        return np.zeros(len(px))
    columns = lens.displacements(px)
    before = np.sum(columns**2, axis=(1, 2))
    after = np.sum((columns @ lens.field.root) ** 2, axis=(1, 2))
    return np.asarray(np.clip(1.0 - after / np.where(before > 0.0, before, np.inf), 0.0, 1.0))


def _rms(px: FloatArray, weights: FloatArray) -> float:
    """The weighted RMS of (n, 2) displacements, an axis [px]."""
    return float(np.sqrt(np.sum(weights * np.mean(px**2, axis=1)) / np.sum(weights)))

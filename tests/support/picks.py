"""Simulated picks: a calibrated cell looks at a point whose true place is known.

The robot stands, once more, not quite where it reports to; the pixels are noisy once more. What is
seen comes from the simulation's own camera.
"""

from dataclasses import dataclass

import numpy as np
from support.cells import calibrated

from visioncal.calibration.pipeline.result import result_of
from visioncal.core.transforms import compose, exp
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.results import Calibration
from visioncal.simulation import SimulatedCell, project, rays
from visioncal.vision.targets import corner_positions


@dataclass(frozen=True, eq=False)
class Stand:
    """Where the flange is reported to stand (None for a fixed camera), and the true camera."""

    base_from_flange: FloatArray | None
    base_from_cam: FloatArray


def calibration_of(cell: SimulatedCell, **changes) -> Calibration:
    """The result that the session of a simulated cell gives."""
    return result_of(calibrated(cell, **changes))


def stand(cell: SimulatedCell, rng: np.random.Generator) -> Stand:
    """A new stop near one of the calibration's own."""
    edge = next(iter(cell.transforms.values()))
    if cell.options.mount == "eye-to-hand":
        return Stand(None, edge)
    near = cell.robot.base_from_flange[rng.integers(len(cell.robot.base_from_flange))]
    reported = near @ exp(rng.normal(0.0, np.repeat([0.1, 0.03], 3)))
    return Stand(reported, really(cell, reported, rng) @ edge)


def really(cell: SimulatedCell, reported: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Where the flange really stands, (4, 4), when it reports a pose."""
    sigma = np.repeat([cell.options.robot_sigma_rad, cell.options.robot_sigma_m], 3)
    return reported @ exp(sigma * rng.standard_normal(6))


def seen_point(
    cell: SimulatedCell, at: Stand, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """A point at a working distance: (3,) in the base, and (1, 2) where it is seen."""
    camera = cell.options.camera
    aim = np.array(camera.resolution) * rng.uniform(0.2, 0.8, 2)
    point_cam = rays(camera, aim) * rng.uniform(*_distances(cell))
    place = at.base_from_cam[:3, :3] @ point_cam + at.base_from_cam[:3, 3]
    noise = cell.options.pixel_sigma_px * rng.standard_normal((1, 2))
    return place, project(camera, point_cam[None]) + noise


def before_camera(cell: SimulatedCell, target: Target, rng: np.random.Generator) -> FloatArray:
    """A target well tilted, near the image's middle: (4, 4) `cam_from_target`."""
    camera, middle = cell.options.camera, corner_positions(target).mean(axis=0)
    direction = rng.standard_normal(2)
    tilt = rng.uniform(0.4, 0.7) * direction / np.linalg.norm(direction)
    turn = exp(np.array([*tilt, 0, 0, 0, 0])) @ exp(np.array([0, 0, rng.uniform(-1, 1), 0, 0, 0]))
    aim = np.array(camera.resolution) * rng.uniform(0.4, 0.6, 2)
    centre = rays(camera, aim) * rng.uniform(*_distances(cell))
    return compose(turn[:3, :3], centre - turn[:3, :3] @ middle)


def seen_corners(
    cell: SimulatedCell, cam_from_target: FloatArray, target: Target, rng: np.random.Generator
) -> Corners:
    """The noisy corners, in the image, of a target."""
    camera, real = cell.options.camera, corner_positions(target)
    px = project(camera, real @ cam_from_target[:3, :3].T + cam_from_target[:3, 3])
    ids = np.flatnonzero(np.all((px > 0) & (px < np.array(camera.resolution) - 1), axis=1))
    px = px[ids] + cell.options.pixel_sigma_px * rng.standard_normal((len(ids), 2))
    return Corners(0, ids, px, cell.options.blur_px)


def _distances(cell: SimulatedCell) -> tuple[float, float]:
    distance = np.linalg.norm(cell.cam_from_target[:, :3, 3], axis=1)
    return float(distance.min()), float(distance.max())

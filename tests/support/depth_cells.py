"""Cells with a depth sensor of a camera of half the default's resolution, and picks by them."""

from dataclasses import replace
from functools import cache

import numpy as np

from visioncal import simulation
from visioncal.calibration.run import Run, run
from visioncal.core.transforms import apply, exp
from visioncal.core.types import FloatArray, Mount
from visioncal.session import Session
from visioncal.simulation import CAMERAS, CellOptions, DepthOptions, SimulatedCell

WIDE = CAMERAS["wide"]
# Half of the resolution of the default, which is rendered in a quarter of the time.
FOCAL, MIDDLE = WIDE.matrix[:2] / 2, (WIDE.matrix[2:] + 0.5) / 2 - 0.5
SMALL = replace(WIDE, resolution=(640, 400), matrix=np.concatenate([FOCAL, MIDDLE]))
TRUE = DepthOptions(scale=1.0, offset_m=0.0, bowl_m=0.0)


@cache
def calibrated(
    seed: int, mount: Mount, depth: DepthOptions, views: int = 15
) -> tuple[SimulatedCell, Session, Run]:
    """A cell with a depth sensor, its session, and its calibration."""
    distance_m = (0.35, 0.6) if mount == "eye-to-hand" else None
    options = CellOptions(
        mount=mount, camera=SMALL, views=views, seed=seed, distance_m=distance_m, blur_px=0.5
    )
    cell = simulation.simulate(options)
    session = simulation.cell_session(cell, "depth", depth=depth)
    return cell, session, run(session)


def deviations(result: Run, depth: DepthOptions) -> tuple[FloatArray, float]:
    """Deviations of scale, offset, tilt and bowl in their sigmas, and their squared error."""
    found = result.calibration.camera.depth
    truth = [depth.scale, depth.offset_m, *depth.tilt_m, depth.bowl_m]
    error = found.values - truth
    squared = error @ np.linalg.solve(found.covariance, error)
    return error / np.sqrt(np.diag(found.covariance)), float(squared / len(error))


def picks(
    cell: SimulatedCell, result: Run, depth: DepthOptions, rng: np.random.Generator, count: int
) -> FloatArray:
    """(count, 3) errors of picks at 0.3 to 1.2 m, the same by uncorrected depth, radius95 [m]."""
    calibration, true_camera = result.calibration, cell.camera().camera
    width, height = true_camera.resolution
    plain = replace(calibration, camera=replace(calibration.camera, depth=None))
    edge = "flange_from_cam" if calibration.mount == "eye-in-hand" else "base_from_cam"
    noise_px = calibration.noise["pixel_px"]
    errors = []
    for _ in range(count):
        px = np.array([rng.uniform(0, width - 1), rng.uniform(0, height - 1)])
        metres = rng.uniform(0.3, 1.2)
        (ray,) = simulation.rays(true_camera, px[None])
        point = metres * ray / ray[2]
        u, v = (2 * px + 1) / [width, height] - 1
        measured = (
            depth.scale * metres
            + depth.offset_m
            + depth.bowl_m * (u**2 + (v * height / width) ** 2)
        )
        measured += depth.noise_m * metres**2 * rng.standard_normal()
        # The flange stands where it repeats to, and reports where it should.
        reported = cell.robot.base_from_flange[rng.integers(len(cell.robot.base_from_flange))]
        jitter = exp(
            rng.standard_normal(6)
            * np.repeat([cell.options.robot_sigma_rad, cell.options.robot_sigma_m], 3)
        )
        carried = reported @ jitter if calibration.mount == "eye-in-hand" else np.eye(4)
        true = apply(carried @ cell.mountings[edge.partition("_from_")[2]], point[None])[0]
        seen = px + noise_px * rng.standard_normal(2)
        seen = np.clip(seen, 0, [width - 1, height - 1])
        place = calibration.locate(seen, measured, reported)
        raw = plain.locate(seen, measured, reported)
        errors.append(
            [
                np.linalg.norm(place.p_base - true),
                np.linalg.norm(raw.p_base - true),
                1e-3 * place.radius95_mm,
            ]
        )
    return np.array(errors)

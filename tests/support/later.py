"""Later looks at a simulated cell that was calibrated: fresh stops, after some change or none."""

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from support.cells import calibrated, known_of, reporting, showing
from support.wrong_arms import WRONG_LINKS, target_in_camera

from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.transforms import exp
from visioncal.core.types import Corners, FloatArray, Mount
from visioncal.results import Calibration
from visioncal.simulation import CellOptions, SimulatedCell, project, simulate
from visioncal.simulation.boards import corners_m

# Arms that are off by 0.5 mm and 1 mrad in every parameter, moved through all of their branches.
ANYHOW = replace(WRONG_LINKS, roll_rad=np.pi, branches=True)
FITTED = 40


@dataclass(frozen=True, eq=False)
class Change:
    """What has changed: twists (6,) on the right of x and z, joints' offsets, noise, sizes."""

    camera: FloatArray = field(default_factory=lambda: np.zeros(6))
    board: FloatArray = field(default_factory=lambda: np.zeros(6))
    joints_rad: FloatArray = field(default_factory=lambda: np.zeros(6))
    noise_factor: float = 1.0
    board_scale: float = 1.0
    lens_scale: float = 1.0  # Of the focal length.


@dataclass(frozen=True, eq=False)
class Lot:
    """A cell of many views, the first of which its calibration rests on."""

    cell: SimulatedCell
    calibration: Calibration


@lru_cache
def usual(mount: Mount) -> Lot:
    """The lot that tests share."""
    return lot(replace(ANYHOW, mount=mount))


def lot(options: CellOptions = ANYHOW, further: int = 60) -> Lot:
    """A calibrated cell, and as many further postures from which the board is in view."""
    cell = simulate(replace(options, views=FITTED + further))
    return Lot(cell, result_of(calibrated(cell.only(range(FITTED)))))


def again(
    cell: SimulatedCell,
    rng: np.random.Generator,
    change: Change | None = None,
    stops: int = 5,
    *,
    repeated: int = 0,
) -> SimulatedCell:
    """Fresh stops of a cell, with noise of their own; `repeated`: of how many first postures."""
    change, count = change or Change(), len(cell.robot.joints) - FITTED
    first, among = (0, repeated) if repeated else (FITTED, count)
    rows = first + rng.choice(among, stops, replace=False)
    fresh, options = cell.only(rows.tolist()), cell.options
    sigma = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3)
    jitter = exp(change.noise_factor * sigma * rng.standard_normal((stops, 6)))
    flange = (
        cell.robot.flange_at(fresh.robot.joints + change.joints_rad, fresh.robot.loads) @ jitter
    )
    x, z = cell.transforms.values()
    moved = x @ exp(change.camera), z @ exp(change.board)
    poses = target_in_camera(options.mount, *moved, flange)
    corners = tuple(_detected(cell, at, pose, rng, change) for at, pose in enumerate(poses))
    return reporting(showing(fresh, corners), true_base_from_flange=flange)


def _detected(
    cell: SimulatedCell, view: int, pose: FloatArray, rng: np.random.Generator, change: Change
) -> Corners:
    """The board as it was printed, as a detector reports it."""
    camera = cell.options.camera
    grown = camera.matrix * np.array([change.lens_scale, change.lens_scale, 1.0, 1.0])
    camera = replace(camera, matrix=grown)
    px = project(
        camera, change.board_scale * corners_m(cell.board()) @ pose[:3, :3].T + pose[:3, 3]
    )
    ids = np.flatnonzero(np.all((px > 0) & (px < np.array(camera.resolution) - 1), axis=1))
    noise = cell.options.pixel_sigma_px * rng.standard_normal((len(ids), 2))
    return Corners(view, ids, px[ids] + noise, cell.options.blur_px)


def known_again(
    cell: SimulatedCell, rng: np.random.Generator, change: Change | None = None, stops: int = 5
) -> RunState:
    """What is known of such stops after detection."""
    return known_of(again(cell, rng, change, stops))


def knock(rng: np.random.Generator, mm: float, deg: float) -> FloatArray:
    """A twist (6,) of so much, about and along some direction each."""
    directions = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.concatenate([np.deg2rad(deg) * directions[0], 1e-3 * mm * directions[1]])

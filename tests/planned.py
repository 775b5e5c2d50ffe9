"""Simulated cells to be planned: their guesses, and what calibrating at planned stops gives."""

from dataclasses import replace

import numpy as np
from cells import known_of

from visioncal.calibration.pipeline.steps import STAGES
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.estimation.parts import Noise
from visioncal.live.planning.cell import PlanCell
from visioncal.live.planning.recorded import SoFar
from visioncal.robot import load_robot
from visioncal.simulation import Cell, CellOptions, simulate


def plan_cell(options: CellOptions, sigma_rad: float = 0.0, sigma_m: float = 0.0) -> PlanCell:
    """The cell as it would be planned for: guesses that are off by a draw of their sigmas."""
    true = true_cell(options)
    rng = np.random.default_rng([options.seed, 99])
    off = exp(rng.standard_normal((2, 6)) * np.repeat([sigma_rad, sigma_m], 3))
    return replace(true, x=true.x @ off[0], z=true.z @ off[1], sigma_rad=sigma_rad, sigma_m=sigma_m)


def true_cell(options: CellOptions) -> PlanCell:
    """The cell as it is, but for the arm's errors."""
    x, z = simulate(replace(options, views=1, motion="free")).transforms.values()
    return PlanCell(
        options.mount,
        load_robot(options.robot),
        options.camera,
        options.target,
        x,
        z,
        0.0,
        0.0,
        Noise.of_robot(options.robot_sigma_rad, options.robot_sigma_m),
        options.pixel_sigma_px,
    )


def postures_in_view(options: CellOptions, count: int) -> FloatArray:
    """(k, n) random postures from which the simulated camera sees the whole board [rad]."""
    free = replace(options, views=count, motion="free", branches=True, roll_rad=np.pi)
    return simulate(replace(free, cut_views=0.0)).joints


def so_far_of(cell: Cell, **changes) -> SoFar:
    """What is known of a cell's views, as far as they tell it."""
    known = known_of(cell, level="hand-eye", **changes)
    for stage in STAGES:
        if stage.name in ("robot", "detect"):
            continue
        try:
            known = stage.run(known)
        except DegenerateError as error:
            return SoFar(known, error.message)
    return SoFar(known)

"""Simulated cells to be planned: their guesses, and what calibrating at planned stops gives."""

from dataclasses import replace

import numpy as np
from support.cells import known_of

from visioncal.calibration.run import STAGES
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import exp, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.problem_parts import Noise
from visioncal.live.planning.cell import Limits, PlanCell
from visioncal.live.planning.design import Design, choose_stops
from visioncal.live.planning.information import WORLDS, predict_worlds
from visioncal.live.planning.purposes import Purpose
from visioncal.live.planning.recorded import PartialCalibration, SessionStart
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.simulation.arms import forward, ur_arm
from visioncal.simulation.boards import Sheet, outline_m
from visioncal.simulation.optics import sees


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
    return simulate(replace(free, cut_views=0.0)).robot.joints


def next_best(
    begun: SessionStart,
    purpose: Purpose,
    q: FloatArray,
    count: int,
    **draw,
) -> Design:
    """The stops that a plan adds to a session, wherever the arm can drive."""
    cells = (begun.cell, *begun.cell.guesses(draw.get("worlds", WORLDS) - 1, draw.get("seed", 0)))
    worlds = predict_worlds(cells, purpose, q, recorded=begun.recorded)
    return choose_stops(worlds, count)


def so_far_of(cell: SimulatedCell, **changes) -> PartialCalibration:
    """What is known of a cell's views, as far as they tell it."""
    known = known_of(cell, level="hand-eye", **changes)
    for stage in STAGES:
        if stage.name in ("robot", "detect"):
            continue
        try:
            known = stage.run(known)
        except DegenerateError as error:
            return PartialCalibration(known, error.message)
    return PartialCalibration(known)


def cell_of(options: CellOptions, **changes) -> PlanCell:
    """The cell as it is; a floor so low that the board lies on it."""
    x, z = simulate(replace(options, views=2)).transforms.values()
    floor_m = min(0.0, z[2, 3] - 0.02) if options.mount == "eye-in-hand" else 0.0
    cell = PlanCell(
        mount=options.mount,
        robot=load_robot(options.robot),
        camera=options.camera,
        target=options.target,
        x=x,
        z=z,
        sigma_rad=0.005,
        sigma_m=0.002,
        noise=Noise.of_robot(5e-5, 3e-5),
        pixel_px=0.05,
        limits=Limits(floor_m=floor_m),
    )
    return replace(cell, **changes)


def views(cell: PlanCell, q: FloatArray) -> FloatArray:
    """`cam_from_target` by the simulation's kinematics."""
    flange = forward(ur_arm(cell.robot.name), q)
    if cell.mount == "eye-in-hand":
        return invert(flange @ cell.x) @ cell.z
    return invert(cell.x) @ flange @ cell.z


def whole(cell: PlanCell, q: FloatArray, edge_px: float) -> FloatArray:
    """Whether the simulation's camera sees the whole print."""
    outline = outline_m(Sheet(target=cell.target), 0.0)
    seen = views(cell, q)
    points = outline @ np.swapaxes(seen[:, :3, :3], 1, 2) + seen[:, None, :3, 3]
    return sees(cell.camera, points, edge_px).all(axis=1)

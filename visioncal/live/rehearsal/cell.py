"""Simulated cell of a rehearsal: the truth, and what its user would know of it."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import CameraMount
from visioncal.live.planning.cell import TYPICAL_NOISE, TYPICAL_PX, Limits, PlanCell
from visioncal.live.rehearsal.machine import ControllerOptions, true_arm
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.simulation.arms import ArmErrors

# Errors of the user's guesses of both edges, as measured by ruler and by eye [m, rad].
GUESS_M, GUESS_RAD = 0.02, float(np.deg2rad(5.0))
# Joint offsets that have changed since the factory calibration.
_WORN = ArmErrors(offset_sigma_rad=3e-4)
# Depth of the floor below base and board [m].
_FLOOR_DEPTH_M = 0.1
# Seed of the guesses, distinct from those of the cell and the controller.
_GUESSES = 101


@dataclass(frozen=True)
class RehearsalOptions:
    """Options of a rehearsal.

    Attributes:
        robot: `ur3e`, `ur5e` or `ur10e`.
    """

    robot: str = "ur5e"
    mount: CameraMount = "eye-in-hand"
    stops: int = 16
    seed: int = 0


@dataclass(frozen=True, eq=False)
class RehearsedCell:
    """A simulated cell.

    Attributes:
        truth: The true arm, edges, lens and board.
        controller: The same arm for the simulated controller.
        known: The user's prior knowledge: rough guesses and the factory's lens.
    """

    truth: SimulatedCell
    controller: ControllerOptions
    known: PlanCell


def rehearsed_cell(options: RehearsalOptions) -> RehearsedCell:
    """Builds the cell of a rehearsal; the same options give the same cell.

    Raises:
        DataError: The arm is unknown, or cannot have the board in view.
    """
    wanted = CellOptions(
        robot=options.robot,
        mount=options.mount,
        views=1,
        cut_views=0.0,
        seed=options.seed,
    )
    cell = simulate(wanted)
    controller = ControllerOptions(robot=options.robot, seed=options.seed, errors=_WORN)
    robot = replace(cell.robot, true_arm=true_arm(controller))
    truth = replace(cell, robots={"": robot})
    return RehearsedCell(truth, controller, _user_description(truth, wanted))


def _user_description(truth: SimulatedCell, options: CellOptions) -> PlanCell:
    """The cell as its user would describe it to `visioncal plan`."""
    draws = np.random.default_rng([options.seed, _GUESSES]).standard_normal((2, 2, 3))
    directions = draws / np.linalg.norm(draws, axis=2, keepdims=True)
    errors = exp((directions * np.array([[GUESS_RAD], [GUESS_M]])).reshape(2, 6))
    x, z = truth.transforms.values()
    lowest = min(0.0, float(z[2, 3])) if options.mount == "eye-in-hand" else 0.0
    per_axis = float(np.sqrt(3.0))
    return PlanCell(
        options.mount,
        load_robot(options.robot),
        truth.stated[""],
        options.target,
        x @ errors[0],
        z @ errors[1],
        GUESS_RAD / per_axis,
        GUESS_M / per_axis,
        TYPICAL_NOISE,
        TYPICAL_PX,
        Limits(floor_m=lowest - _FLOOR_DEPTH_M),
    )

"""A simulated cell to record live: the truth, and what its user would know of it."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import exp
from visioncal.live.planning.cell import TYPICAL_NOISE, TYPICAL_PX, Limits, PlanCell
from visioncal.live.simulated.arm import ControllerOptions
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.simulation.arms import ArmErrors

# Errors of the user's guesses of both edges, as measured by ruler and by eye [m, rad].
GUESS_M, GUESS_RAD = 0.02, float(np.deg2rad(5.0))
_ROBOT = "ur5e"
# Joint offsets that have changed since the factory calibration.
_WORN = ArmErrors(offset_sigma_rad=3e-4)
# Depth of the floor below base and board [m].
_FLOOR_DEPTH_M = 0.1
# Seed of the guesses, distinct from those of the cell and the controller.
_GUESSES = 101


@dataclass(frozen=True, eq=False)
class LiveSimulation:
    """A simulated cell."""

    truth: SimulatedCell  # The true arm, edges, lens and board.
    controller: ControllerOptions  # The same arm for the simulated controller.
    known: PlanCell  # The user's prior knowledge: rough guesses and the factory's lens.


def live_simulation(seed: int) -> LiveSimulation:
    """Builds a cell with a camera on the flange of a UR; the same seed gives the same cell."""
    options = CellOptions(robot=_ROBOT, views=1, cut_views=0.0, seed=seed)
    controller = ControllerOptions(robot=_ROBOT, seed=seed, errors=_WORN)
    cell = simulate(options)
    truth = replace(cell, robots={"": replace(cell.robot, true_arm=controller.true_arm)})
    draws = np.random.default_rng([seed, _GUESSES]).standard_normal((2, 2, 3))
    directions = draws / np.linalg.norm(draws, axis=2, keepdims=True)
    errors = exp((directions * np.array([[GUESS_RAD], [GUESS_M]])).reshape(2, 6))
    x, z = truth.transforms.values()
    per_axis = float(np.sqrt(3.0))
    known = PlanCell(
        options.mount,
        load_robot(_ROBOT),
        truth.stated[""],
        options.target,
        x @ errors[0],
        z @ errors[1],
        GUESS_RAD / per_axis,
        GUESS_M / per_axis,
        TYPICAL_NOISE,
        TYPICAL_PX,
        Limits(floor_m=min(0.0, float(z[2, 3])) - _FLOOR_DEPTH_M),
    )
    return LiveSimulation(truth, controller, known)

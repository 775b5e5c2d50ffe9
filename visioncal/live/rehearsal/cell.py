"""The simulated cell of a rehearsal: what really is, and what its user would know of it."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import exp
from visioncal.core.types import CameraMount
from visioncal.live.planning.cell import TYPICAL_NOISE, TYPICAL_PX, Limits, PlanCell
from visioncal.live.rehearsal.machine import ControllerOptions, true_arm
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.simulation.arms import ArmErrors

# How far the user's guesses of both edges are off: as measured by a ruler and by eye [m, rad].
GUESS_M, GUESS_RAD = 0.02, float(np.deg2rad(5.0))
# An arm whose joints' zeros have moved since its maker measured it [m, rad and rad].
_WORN = ArmErrors(offset_sigma_rad=3e-4)
# The floor is so far below base and board [m].
_BELOW_M = 0.1
# Of the guesses; other numbers belong to the cell and to the controller.
_GUESSES = 101


@dataclass(frozen=True)
class RehearsalOptions:
    """What is rehearsed.

    Attributes:
        robot: `ur3e`, `ur5e` or `ur10e`.
        mount: Where the camera is.
        stops: How many are planned.
        seed: Of everything random.
    """

    robot: str = "ur5e"
    mount: CameraMount = "eye-in-hand"
    stops: int = 16
    seed: int = 0


@dataclass(frozen=True, eq=False)
class RehearsedCell:
    """A simulated cell.

    Attributes:
        truth: What really is: the arm, both edges, the lens and the board.
        controller: The same arm, as the simulated controller is to have it.
        known: What a user knows before: rough guesses and the factory's lens.
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
    return RehearsedCell(truth, controller, _known(truth, wanted))


def _known(truth: SimulatedCell, options: CellOptions) -> PlanCell:
    """The cell as its user would describe it to `visioncal plan`."""
    draws = np.random.default_rng([options.seed, _GUESSES]).standard_normal((2, 2, 3))
    ways = draws / np.linalg.norm(draws, axis=2, keepdims=True)
    off = exp((ways * np.array([[GUESS_RAD], [GUESS_M]])).reshape(2, 6))
    x, z = truth.transforms.values()
    lowest = min(0.0, float(z[2, 3])) if options.mount == "eye-in-hand" else 0.0
    per_axis = float(np.sqrt(3.0))
    return PlanCell(
        options.mount,
        load_robot(options.robot),
        truth.stated[""],
        options.target,
        x @ off[0],
        z @ off[1],
        GUESS_RAD / per_axis,
        GUESS_M / per_axis,
        TYPICAL_NOISE,
        TYPICAL_PX,
        Limits(floor_m=lowest - _BELOW_M),
    )

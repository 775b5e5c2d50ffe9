"""Whole cells of `visioncal simulate`, with torques and instruments."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from visioncal.cli.simulate import Read, SimulateOptions
from visioncal.core.errors import DataError
from visioncal.session import frame_name
from visioncal.simulation import (
    CameraAt,
    CellOptions,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
    SimulatedCell,
    read_cell,
    simulate,
)
from visioncal.simulation.dynamics import LinkBody
from visioncal.simulation.exercise import ExerciseOptions, Senses, exercise, seed_of, with_exercises
from visioncal.simulation.instrument_session import THREE, InstrumentOptions

_T = TypeVar("_T", RobotAt, CameraAt)

# Fields of robots and cameras, by the parameters that set them.
_FIELDS: Mapping[str, str] = {
    "robot_sigma_mm": "robot_sigma_m",
    "robot_sigma_mrad": "robot_sigma_rad",
    "arm_sigma_mm": "dh_sigma_m",
    "arm_sigma_mrad": "dh_sigma_rad",
    "stiffness_knm": "compliance_rad_per_nm",
    "payload_kg": "payloads",
    "with_intrinsics": "state_intrinsics",
}
# Centre of a simulated load in the flange's frame [m].
CENTRE_M = (0.0, 0.0, 0.1)
# Half the side of a cubic load [m], and torque constant of each drive [N m/A].
_HALF_M = 0.05
_GAINS_NM_A = (10.0, 10.0, 9.0, 7.0, 7.0, 7.0)


def whole_cell(
    name: str, options: CellOptions, given: frozenset[str], instrument: Read | None
) -> SimulatedCell:
    """Simulates a whole cell; the user's options override its description."""
    cell = simulate(_described(name, options, given, instrument))
    if not (cell.sights or cell.readings):
        raise DataError(
            f"--cell {name}: nothing in this cell is seen or read.",
            culprits=[name],
            next_step="Give it a camera that sees a target, or an instrument and points.",
        )
    return cell


def exercised(cell: SimulatedCell, options: SimulateOptions) -> SimulatedCell:
    """The cell with torque streams of all its robots."""
    exercises = {
        robot.name: exercise(exercise_options(options, robot.robot, seed_of(cell.options.seed, at)))
        for at, robot in enumerate(cell.layout.robots)
    }
    return with_exercises(cell, exercises)


def _described(
    name: str, options: CellOptions, given: frozenset[str], instrument: Read | None
) -> NetworkOptions:
    """A cell's description, with the user's options in its place."""
    described = read_cell(name)
    changes = {"views": "stops", "wrong_views": "stray_images", "seed": "seed"}
    changes |= {"recording": "recording"}
    described = replace(
        described,
        **{
            field: getattr(options, parameter)
            for parameter, field in changes.items()
            if parameter in given
        },
    )
    described = replace(
        described,
        robots=tuple(_with_given(robot, options, given) for robot in described.robots),
        cameras=tuple(_with_given(camera, options, given) for camera in described.cameras),
        boards=tuple(
            replace(board, scale=options.board_scale) if "board_scale" in given else board
            for board in described.boards
        ),
    )
    if "camera_moved_mm" in given:
        if not described.cameras:
            raise DataError(
                f"--cell {name}: there is no camera to knock.", culprits=["--camera-moved-mm"]
            )
        frame = frame_name("camera", described.cameras[0].name)
        knocked = Moved(frame, 0, shift_m=options.camera_moved_m, turn_rad=0.0)
        described = replace(described, moved=(*described.moved, knocked))
    return described if instrument is None else _with_instrument(name, described, instrument)


def _with_given(thing: _T, options: CellOptions, given: frozenset[str]) -> _T:
    """A robot or a camera with the user's options."""
    names = {field.name for field in fields(thing)}
    changes = {_FIELDS[name] for name in given & _FIELDS.keys()} & names
    return replace(thing, **{name: getattr(options, name) for name in changes})


def _with_instrument(name: str, described: NetworkOptions, instrument: Read) -> NetworkOptions:
    """The description with an instrument that measures every robot's flange."""
    if described.instruments or described.points:
        raise DataError(
            f"--cell {name} has instruments or points of its own.",
            culprits=["--instrument"],
            next_step="Leave --instrument out.",
        )
    places = THREE if instrument == "points" else THREE[:1]
    points = tuple(
        PointAt(f"{robot.name}{at}", robot.name, place)
        for robot in described.robots
        for at, place in enumerate(places, start=1)
    )
    tracker = InstrumentAt("tracker", (2.5, -1.0, 0.4), 2.5)
    if instrument == "probe":
        tracker = replace(tracker, sigma_rad=InstrumentOptions.sigma_rad)
    return replace(described, instruments=(tracker,), points=points)


def exercise_options(options: SimulateOptions, robot: str, seed: int) -> ExerciseOptions:
    """An arm's motions, without load or with a cube on its flange."""
    loads = options.payload_kg or [0.0]
    if len(loads) > 1:
        raise DataError(
            f"--payload-kg is given {len(loads)} times; with --torques the arm carries one load.",
            culprits=["--payload-kg"],
            next_step="Make a session of each load, with the same --seed.",
        )
    inertia = loads[0] * 2.0 / 3.0 * _HALF_M**2 * np.eye(3)
    load = LinkBody(loads[0], np.array(CENTRE_M), inertia) if loads[0] else None
    senses = Senses(gains_nm_a=_GAINS_NM_A if options.currents else ())
    return ExerciseOptions(robot, load, senses, seed=seed)

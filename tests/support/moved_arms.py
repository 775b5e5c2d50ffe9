"""Simulated arms that move, as robots whose bodies are known and as recordings."""

from collections.abc import Callable

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned, condition
from visioncal.dynamics.reading import read_recorded
from visioncal.robot import Robot, load_robot
from visioncal.session import Stream
from visioncal.simulation.dynamics import DynamicArm, Exercise, Senses, record

_ROWS, _COLUMNS = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])


def robot_with_bodies(built: DynamicArm) -> Robot:
    """The robot of a simulated arm's name, with the simulated arm's bodies as its own."""
    document = dict(load_robot(built.arm.name).document)
    rows = []
    for row, body in zip(document["joint"], built.bodies, strict=True):
        inertia = body.inertia_kg_m2[_ROWS, _COLUMNS].tolist()
        inertial = {"mass_kg": body.kg, "com_m": body.centre_m.tolist(), "inertia_kg_m2": inertia}
        rows.append({**row, **inertial})
    return Robot.from_document({**document, "joint": rows})


def true_base(base: BaseModel, built: DynamicArm) -> FloatArray:
    """The base parameters that a simulated arm really has."""
    gears = built.gears
    values = {"Fc": gears.coulomb, "Fv": gears.viscous, "offset": gears.offset}
    values["Ia"] = gears.motor_inertia
    friction = np.stack([values[symbol] for symbol in base.model.terms.symbols], axis=1)
    links = robot_with_bodies(built).inertias.values
    return base.of(np.concatenate([links.ravel(), friction.ravel()]))


def recorded(
    built: DynamicArm, done: Exercise, rng: np.random.Generator, senses: Senses | None = None
) -> Conditioned:
    """What is made of a recorded motion before the fit."""
    stream = record(built, done, rng, senses)
    return condition(read_recorded(stream, "streams/robot.csv", len(built.bodies)))


def changed(stream: Stream, change: Callable[[dict[str, FloatArray]], None]) -> Stream:
    """A stream whose columns, by their names, were changed in place."""
    columns = {name: stream[name].copy() for name in stream.columns}
    change(columns)
    return Stream(tuple(columns), np.column_stack(list(columns.values())))

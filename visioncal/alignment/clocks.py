"""The errors of clocks as effects of the joint fit of a whole cell."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from visioncal.alignment.cell import Cell, robot_key
from visioncal.estimation.effects.clock import clock_effect
from visioncal.estimation.problem import Effect
from visioncal.stages.clock import Clocked, Pair
from visioncal.stages.offset import Clock


def clock_effects(cell: Cell, clocks: Mapping[Pair, Clocked]) -> tuple[Effect, ...]:
    """The errors of offsets and times within images [s], as effects on the cell's rows."""
    views = [it.view for it in cell.rows]
    found: list[Effect] = []
    for pair, clocked in clocks.items():
        if clocked.clock.speeds and robot_key(pair.robot) in cell.poses:
            found.append(_effect(cell, pair, clocked.clock))
            found += [
                it.effect(views, pair.delay(it.of)) for it in clocked.clock.delays if it.is_clear
            ]
    return tuple(found)


def _effect(cell: Cell, pair: Pair, clock: Clock) -> Effect:
    speeds = clock.speeds
    concerned = np.array([it.view in speeds for it in cell.rows], dtype=bool)
    robot = robot_key(pair.robot)
    moving = np.zeros((len(cell.poses[robot]), 6))
    for row in cell.rows:
        if row.view in speeds:
            moving[row.station] = speeds[row.view]
    found = clock_effect(moving, clock.sigma_s, pair.effect, robot)
    return replace(found, concerned=concerned)

"""Checks whether a session's loads can determine the arm's elasticity."""

from collections.abc import Sequence

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray
from visioncal.robot import Loads, Robot

# Stops that differ by less are at one pose: a loaded arm may deflect by so much [m, rad].
_SAME_M, _SAME_RAD = 0.02, 0.02


def check_stops(loads: Loads, views: Sequence[int], stops: Sequence[int | None]) -> None:
    """Refuses views of one declared stop under different loads; `stops` has None for none.

    Raises:
        DataError: Two views of a stop differ; it names them.
    """
    rows = loads.rows
    first: dict[int, int] = {}
    for at, stop in enumerate(stops):
        if stop is None:
            continue
        other = first.setdefault(stop, at)
        if not np.array_equal(rows[at], rows[other]):
            raise DataError(
                f"views {views[other]} and {views[at]} are of stop {stop} and differ in payload, "
                "force or approach: views of one stop share the pose of the arm, which these "
                "change.",
                culprits=[f"view {views[other]}", f"view {views[at]}"],
                next_step="Give each of them a stop of its own.",
            )


def check_poses(loads: Loads, poses: FloatArray) -> None:
    """Refuses loads that change while the arm stands still at one reported flange pose (m, 4, 4).

    Raises:
        DegenerateError: The load changes, and all poses are the same.
    """
    kg = loads.payload_kg
    force = np.linalg.norm(loads.force_n, axis=1)
    if len(poses) < 2 or (np.ptp(kg) == 0.0 and np.ptp(force) == 0.0):
        return
    difference = invert(poses[:1]) @ poses
    shift = np.linalg.norm(difference[:, :3, 3], axis=1).max()
    if shift > _SAME_M or rotation_angle(difference).max() > _SAME_RAD:
        return
    changed = f"{kg.min():g} to {kg.max():g} kg" if np.ptp(kg) else f"0 to {force.max():g} N"
    raise DegenerateError(
        f"the load changes ({changed}), and all {len(poses)} views are of one pose of the arm: "
        "where the frames are cannot be separated from how far the joints bend.",
        culprits=["payload_kg" if np.ptp(kg) else "force_x_n"],
        next_step="Take the same loads to other poses, all over the workspace: ten or more.",
    )


def check_elastic(asked: str, robot: Robot | None, loads: Loads) -> None:
    """Refuses to estimate joint compliance where no load on the arm is known.

    Raises:
        DataError: The level is asked for, masses are not known, and there is no load.
    """
    if asked != "elastic" or robot is None or robot.masses is not None or loads.any:
        return
    raise DataError(
        f"level 'elastic' needs to know what bends the arm: the model of {robot.name} does not "
        "state the masses of its links, and no view has a payload_kg or a force.",
        culprits=["level", robot.name],
        next_step="Add mass_kg and com_m to each [[joint]] of its table, take its URDF, or record "
        "payload_kg (with payload_x_m, payload_y_m, payload_z_m) with every view.",
    )

"""Why stops do not tell what others would: which joints would have to move, and how far."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.workspace import turning_range
from visioncal.robot import Robot

# How far joints are turned to see whether that helps; prismatic ones move by as many times 1 m.
_SPANS_RAD = tuple(np.deg2rad([30.0, 60.0, 120.0, 240.0]).tolist())


@dataclass(frozen=True)
class Move:
    """A joint that would have to move.

    Attributes:
        joint: Which, from 0.
        moved: How far it moved over the stops [rad or m].
        wanted: How far would be enough, all other joints as they were [rad or m].
    """

    joint: int
    moved: float
    wanted: float


def joints_to_move(
    robot: Robot, q: FloatArray, told: Callable[[FloatArray], int], missing: int
) -> tuple[Move, ...]:
    """Finds joints that tell what is missing when they move farther.

    A joint is moved evenly over a wider range, in no order that has to do with the others. The one
    is taken that tells all with the least range; else the one that tells most, and another besides.

    Args:
        robot: The arm.
        q: (m, n) joint angles of the stops [rad].
        told: Counts what stops with other joint angles tell.
        missing: How much more is to be told.

    Returns:
        The joints; none where no joint alone would help.
    """
    found: list[Move] = []
    now = told(q)
    wanted = now + missing
    while now < wanted:
        tried = _tried(robot, q, told, wanted)
        # Of joints that tell as much, the one that has to move least, and then that moved least.
        best = max(tried, key=lambda it: (tried[it], -it.wanted, -it.moved), default=None)
        if best is None or tried[best] <= now:
            break
        found.append(best)
        q, now = _range_of(robot, q, best.joint, best.wanted), tried[best]
    return tuple(found)


def _tried(
    robot: Robot, q: FloatArray, told: Callable[[FloatArray], int], wanted: int
) -> dict[Move, int]:
    """What would be told if one joint moved farther, by ranges up to one that tells all."""
    moved = np.ptp(q, axis=0)
    tried: dict[Move, int] = {}
    for span in _SPANS_RAD:
        for joint in np.flatnonzero(moved < span).tolist():
            move = Move(joint, float(moved[joint]), span)
            tried[move] = told(_range_of(robot, q, joint, span))
        if max(tried.values(), default=0) >= wanted:
            break
    return tried


def _range_of(robot: Robot, q: FloatArray, joint: int, span: float) -> FloatArray:
    lower, upper = (limit[joint] for limit in turning_range(robot))
    middle = 0.5 * (q[:, joint].min() + q[:, joint].max())
    order = np.random.default_rng(joint).permutation(len(q))
    covariance = q.copy()
    covariance[:, joint] = np.clip(middle + span * np.linspace(-0.5, 0.5, len(q)), lower, upper)[
        order
    ]
    return covariance

"""Why stops do not determine what others would: which joints would have to move, and how far."""

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
    robot: Robot, q: FloatArray, count: Callable[[FloatArray], int], missing: int
) -> tuple[Move, ...]:
    """Finds joints that determine what is missing when they move farther.

    A joint is moved evenly over a wider range, in no order that has to do with the others. The one
    is taken that determines all with the least range; else the best, and another.

    Args:
        robot: The arm.
        q: (m, n) joint angles of the stops [rad].
        count: Counts what stops with other joint angles determine.
        missing: How much more is to be determined.

    Returns:
        The joints; none where no joint alone would help.
    """
    found: list[Move] = []
    now = count(q)
    wanted = now + missing
    while now < wanted:
        tried = _tried(robot, q, count, wanted)
        # Of equal joints, the one that has to move least, and then that moved least.
        best = max(
            tried, key=lambda value: (tried[value], -value.wanted, -value.moved), default=None
        )
        if best is None or tried[best] <= now:
            break
        found.append(best)
        q, now = _range_of(robot, q, best.joint, best.wanted), tried[best]
    return tuple(found)


def _tried(
    robot: Robot, q: FloatArray, count: Callable[[FloatArray], int], wanted: int
) -> dict[Move, int]:
    """What one joint determines if it moves farther, by ranges up to one that determines all."""
    moved = np.ptp(q, axis=0)
    tried: dict[Move, int] = {}
    for span in _SPANS_RAD:
        for joint in np.flatnonzero(moved < span).tolist():
            move = Move(joint, float(moved[joint]), span)
            tried[move] = count(_range_of(robot, q, joint, span))
        if max(tried.values(), default=0) >= wanted:
            break
    return tried


def _range_of(robot: Robot, q: FloatArray, joint: int, span: float) -> FloatArray:
    lower, upper = (limit[joint] for limit in turning_range(robot))
    middle = 0.5 * (q[:, joint].min() + q[:, joint].max())
    order = np.random.default_rng(joint).permutation(len(q))
    widened = q.copy()
    evenly = np.clip(middle + span * np.linspace(-0.5, 0.5, len(q)), lower, upper)
    widened[:, joint] = evenly[order]
    return widened

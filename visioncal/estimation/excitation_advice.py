"""Advice on exciting the arm: which joints would have to move, and how far."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.workspace import turning_range
from visioncal.robot import Robot

# Tried ranges of a joint; of prismatic ones in metres.
_SPANS_RAD = tuple(np.deg2rad([30.0, 60.0, 120.0, 240.0]).tolist())


@dataclass(frozen=True)
class Move:
    """A joint that has to move over a wider range."""

    joint: int  # Index from 0.
    moved: float  # Its range over the stops [rad or m].
    wanted: float  # Sufficient range, all other joints unchanged [rad or m].


def joints_to_move(
    robot: Robot, q: FloatArray, count: Callable[[FloatArray], int], missing: int
) -> tuple[Move, ...]:
    """Finds joints whose wider range would determine what is missing.

    A joint is moved evenly over a wider range, in an order independent of the other joints. The
    joint that determines everything with the least range is chosen; else the best one, and then
    another.

    Args:
        robot: The arm.
        q: (m, n) joint angles of the stops [rad].
        count: Number of directions that stops at given joint angles determine.
        missing: Number of further directions to determine.

    Returns:
        The joints; none where no joint alone would help.
    """
    moves: list[Move] = []
    determined = count(q)
    wanted = determined + missing
    while determined < wanted:
        tried = _tried(robot, q, count, wanted)
        # Ties: the least wanted range, then the least present range.
        best = max(
            tried, key=lambda value: (tried[value], -value.wanted, -value.moved), default=None
        )
        if best is None or tried[best] <= determined:
            break
        moves.append(best)
        q, determined = _range_of(robot, q, best.joint, best.wanted), tried[best]
    return tuple(moves)


def _tried(
    robot: Robot, q: FloatArray, count: Callable[[FloatArray], int], wanted: int
) -> dict[Move, int]:
    """Directions determined with one joint's wider range, by ranges up to a sufficient one."""
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

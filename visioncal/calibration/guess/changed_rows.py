"""How rows have to be read from some row on, where only those before it are as declared.

A driver that was set up anew midway writes other units or rotations; an image that was lost, or a
pose that was recorded twice, shifts all rows behind it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances, robust_fit
from visioncal.calibration.guess.given import CLOSING_SCORE, Recording
from visioncal.calibration.guess.hypothesis import Hypothesis, SideReading, Turns
from visioncal.core.conventions import ROTATION_FORMS, UNITS_M
from visioncal.core.types import IntArray, Mask

# Rows at one end that determine both edges, and the fewest that show another reading.
_REFERENCE, _FEWEST = 6, 3
# So many of the rows as declared agree, and of those that are read otherwise; of others so few.
_MOST, _FEW = 0.9, 0.2
_SHIFTS = (1, -1, 2, -2)
# Others are no slip of a driver, but of a whole program.
_FORMS = ("quaternion-xyzw", "quaternion-wxyz", "quaternion-yzwx", "matrix", "matrix-transposed")


@dataclass(frozen=True)
class ChangedRows:
    """Rows at one end that are to be read otherwise than the rest.

    Attributes:
        rows: The rows, ascending.
        is_behind: Whether they come last.
        reading: How they are to be read.
        words: In what that departs from what is declared.
    """

    rows: tuple[int, ...]
    is_behind: bool
    reading: Hypothesis
    words: tuple[str, ...]


def changed_rows(recording: Recording) -> ChangedRows | None:
    """Finds rows, from some row on or before one, that only another reading explains.

    Args:
        recording: Both sides' numbers, in the order of time.

    Returns:
        Them; None where all rows fit as declared, or no reading makes those of one end fit.
    """
    rows = recording.common_rows()
    if len(rows) < _REFERENCE + _FEWEST:
        return None
    for order in (rows, rows[::-1]):
        fit, count = _as_declared(recording, order)
        rest = np.sort(order[count:])
        if count < _REFERENCE or len(rest) < _FEWEST:
            continue
        found = next(
            (tried for tried in _readings(recording) if _explains(recording, tried, fit, rest)),
            None,
        )
        if found is not None:
            is_behind = bool(rest[0] > order[0])
            return ChangedRows(tuple(rest.tolist()), is_behind, found, recording.changes(found))
    return None


def _as_declared(recording: Recording, order: IntArray) -> tuple[Fit, int]:
    """The fit of the first rows of an order that agree as declared, and how many these are."""
    robot, camera = (
        side[order] for side in recording.declared.chain(recording.robot, recording.camera)
    )
    count = _REFERENCE
    for _ in range(2):
        fit = robust_fit(robot[:count], camera[:count])
        agrees = distances(robot, camera, fit.lever, (fit.x, fit.z)).away < CLOSING_SCORE
        count = _agreeing(agrees)
        if count < _REFERENCE:
            break
    return fit, count


def _agreeing(agrees: Mask) -> int:
    """How many rows agree before those of which hardly any does; 0 where there is no such place."""
    before = np.append(0, np.cumsum(agrees))
    count = np.arange(len(before))
    best = int(np.argmax(2 * before - count))
    behind = float(np.mean(agrees[best:])) if best < len(agrees) else 0.0
    return best if before[best] >= _MOST * best and behind <= _FEW else 0


def _readings(recording: Recording) -> Iterator[Hypothesis]:
    """Other readings of the robot's rows, the likelier ones first."""
    declared, size = recording.declared, recording.robot.rotations.shape[1]
    yield from (replace(declared, shift=shift) for shift in _SHIFTS)
    sides = (
        SideReading(Turns(form), unit, inverse)
        for form in _FORMS
        if ROTATION_FORMS[form].size == size
        for unit in UNITS_M
        for inverse in (False, True)
    )
    others = (replace(declared, robot=side) for side in sides if side != declared.robot)
    yield from sorted(others, key=recording.cost)


def _explains(recording: Recording, tried: Hypothesis, fit: Fit, rows: IntArray) -> bool:
    """Whether some rows, read so, close the chain of the others."""
    robot, camera = (side[rows] for side in tried.chain(recording.robot, recording.camera))
    there = np.isfinite(robot).all(axis=(1, 2))
    if not there.any():
        return False
    away = distances(robot[there], camera[there], fit.lever, (fit.x, fit.z)).away
    # A shift leaves as many rows without a partner: at the end of the table where images are lost,
    # and where it begins where poses are.
    paired = len(rows) - abs(tried.shift)
    return bool(np.sum(away < CLOSING_SCORE) >= max(_FEWEST, _MOST * paired))

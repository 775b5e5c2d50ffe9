"""Rows that need another reading from some row on, while those before it are as declared.

A driver that is set up anew midway writes other units or rotations; an image that was lost, or a
pose that was recorded twice, shifts all rows behind it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.fit import Fit, distances, robust_fit
from visioncal.calibration.guess.hypothesis import Hypothesis, SideReading, Turns
from visioncal.calibration.guess.recording import CLOSING_SCORE, Recording
from visioncal.core.conventions import ROTATION_FORMS, UNITS_M
from visioncal.core.types import IntArray, Mask

# Fewest rows at one end that determine both edges, and fewest that show another reading.
_REFERENCE, _FEWEST = 6, 3
# Least share of rows that agree with their reading, and largest share with a wrong one.
_AGREEING_SHARE, _WRONG_SHARE = 0.9, 0.2
_SHIFTS = (1, -1, 2, -2)
# Other forms are mistakes of a whole program, not of a driver.
_FORMS = ("quaternion-xyzw", "quaternion-wxyz", "quaternion-yzwx", "matrix", "matrix-transposed")


@dataclass(frozen=True)
class ChangedRows:
    """Rows at one end of the recording that need another reading, ascending.

    `is_behind` is whether they come last, `words` are the differences from the declared reading.
    """

    rows: tuple[int, ...]
    is_behind: bool
    reading: Hypothesis
    words: tuple[str, ...]


def changed_rows(recording: Recording) -> ChangedRows | None:
    """Finds rows at either end, in the order of time, that only another reading explains.

    Returns:
        The rows; None where all fit as declared, or no reading makes those of one end fit.
    """
    rows = recording.common_rows()
    if len(rows) < _REFERENCE + _FEWEST:
        return None
    for order in (rows, rows[::-1]):
        fit, count = _declared_fit(recording, order)
        rest = np.sort(order[count:])
        if count < _REFERENCE or len(rest) < _FEWEST:
            continue
        for reading in _readings(recording):
            if _explains(recording, reading, fit, rest):
                is_behind, words = bool(rest[0] > order[0]), recording.changes(reading)
                return ChangedRows(tuple(rest.tolist()), is_behind, reading, words)
    return None


def _declared_fit(recording: Recording, order: IntArray) -> tuple[Fit, int]:
    """Fit of the first rows of an order that agree as declared, and their number."""
    robot, camera = (
        side[order] for side in recording.declared.chain(recording.robot, recording.camera)
    )
    count = _REFERENCE
    for _ in range(2):
        fit = robust_fit(robot[:count], camera[:count])
        agrees = distances(robot, camera, fit.lever, (fit.x, fit.z)).residuals < CLOSING_SCORE
        count = _agreeing(agrees)
        if count < _REFERENCE:
            break
    return fit, count


def _agreeing(agrees: Mask) -> int:
    """Number of rows before the change point; 0 without a clear one."""
    agreeing = np.append(0, np.cumsum(agrees))
    count = np.arange(len(agreeing))
    change = int(np.argmax(2 * agreeing - count))
    share_behind = float(np.mean(agrees[change:])) if change < len(agrees) else 0.0
    is_clear = agreeing[change] >= _AGREEING_SHARE * change and share_behind <= _WRONG_SHARE
    return change if is_clear else 0


def _readings(recording: Recording) -> Iterator[Hypothesis]:
    """Other readings of the robot's rows, the more likely ones first."""
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
    """Whether the rows under another reading close the chain of the others."""
    robot, camera = (side[rows] for side in tried.chain(recording.robot, recording.camera))
    readable = np.isfinite(robot).all(axis=(1, 2))
    if not readable.any():
        return False
    residuals = distances(robot[readable], camera[readable], fit.lever, (fit.x, fit.z)).residuals
    # A shift leaves as many rows without a partner: at the table's end where images are lost, at
    # its beginning where poses are.
    paired = len(rows) - abs(tried.shift)
    return bool(np.sum(residuals < CLOSING_SCORE) >= max(_FEWEST, _AGREEING_SHARE * paired))

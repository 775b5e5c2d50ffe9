"""Rows of the robot in another order than the views: two exchanged, or all of them sorted."""

from dataclasses import replace
from itertools import combinations

import numpy as np

from visioncal.calibration.guess.fit import distances, robust_fit
from visioncal.calibration.guess.given import (
    CLOSING_SCORE,
    SCORE_FLOOR,
    STANDS_OUT,
    Recording,
    Scored,
    fitted,
)
from visioncal.calibration.guess.hypothesis import ROW_ORDERS, Hypothesis

# A view stands out from here, in the typical distance of those that agree. Exchanged back it has
# to be nearer than that, and by this many times nearer than it was.
_OUT, _NEARER = 5.0, 3.0
# A fit of all pairs of views takes time with the square of these.
_MOST_ROWS = 200
# Up to so many views every exchange is tried.
_FEW = 8
# The best exchange is meant where no other comes within this many times of it.
_CLEARLY = 2.0
# More views than this that disagree are no two rows exchanged.
_MOST = 8
# Sets of views from which the fit of an order is begun.
_STARTS = 12


def reordered(recording: Recording, declared: Scored) -> Scored | None:
    """Finds the order of all rows in which a chain closes that does not as declared.

    Args:
        recording: What was recorded.
        declared: The declared reading.

    Returns:
        The same reading with its rows in that order; None where none of them closes the chain.
    """
    rows = recording.common_rows()[:_MOST_ROWS]
    ways = (replace(declared.hypothesis, order=order) for order in ROW_ORDERS)
    best = min((fitted(recording, way, rows, _STARTS) for way in ways), key=lambda way: way.score)
    is_clear = best.score <= CLOSING_SCORE and STANDS_OUT * best.score < declared.score
    return replace(best, cost=recording.cost(best.hypothesis)) if is_clear else None


def exchanged(recording: Recording, scored: Scored, *, is_poor: bool) -> Scored | None:
    """Finds the exchange of two rows that makes two views agree which stood out.

    Args:
        recording: What was recorded.
        scored: The reading under which most views agree.
        is_poor: Whether the motion is so poor that few views agree with anything.

    Returns:
        The same reading with the rows exchanged; None where no exchange explains anything, or
        several do.
    """
    if not scored.is_readable:
        return None
    scored = _on_all_rows(recording, scored)
    fit, tried = scored.fit, scored.hypothesis
    if len(fit.away) <= _FEW and fit.score > CLOSING_SCORE:
        return None if is_poor else _exchanged_among_few(recording, scored)
    typical = max(fit.score, SCORE_FLOOR)
    out = np.flatnonzero(fit.away > _OUT * typical)
    if not 2 <= len(out) <= min(_MOST, len(fit.away) - 4):
        return None
    of_robot, found = tried.rows(len(recording.robot)), []
    for pair in combinations(out, 2):
        rows = tuple(of_robot[scored.rows[list(pair)]].tolist())
        again = _with(recording, scored, replace(tried, swap=rows))
        before, after = fit.away[list(pair)], again.fit.away[list(pair)]
        if after.max() < _OUT * typical and (after < before / _NEARER).all():
            found.append((float(after.max()), again))
    found.sort(key=lambda value: value[0])
    if not found or (len(found) > 1 and found[1][0] < _CLEARLY * found[0][0]):
        return None
    return found[0][1]


def _on_all_rows(recording: Recording, scored: Scored) -> Scored:
    """The same with the rows that the search left out to save time: any two may be exchanged."""
    rows = recording.common_rows()[:_MOST_ROWS]
    if len(rows) <= len(scored.rows):
        return scored
    whole = fitted(recording, scored.hypothesis, rows, starts=0)
    return replace(scored, fit=whole.fit, rows=whole.rows)


def _exchanged_among_few(recording: Recording, scored: Scored) -> Scored | None:
    """Tries every exchange: among few views the right ones are no majority to be seen by."""
    tried, found = scored.hypothesis, []
    of_robot = tried.rows(len(recording.robot))
    for pair in combinations(scored.rows, 2):
        rows = tuple(of_robot[list(pair)].tolist())
        changed = replace(tried, swap=rows)
        robot, camera = changed.chain(recording.robot, recording.camera)
        fit = robust_fit(robot[scored.rows], camera[scored.rows])
        found.append(Scored(changed, fit, scored.rows))
    found.sort(key=lambda item: item.score)
    best, second = found[:2]
    is_clear = best.score < CLOSING_SCORE and second.score > _CLEARLY * best.score
    return best if is_clear and scored.score > _NEARER * best.score else None


def _with(recording: Recording, scored: Scored, changed: Hypothesis) -> Scored:
    """The same edges, with rows exchanged."""
    robot, camera = changed.chain(recording.robot, recording.camera)
    fit, rows = scored.fit, scored.rows
    again = distances(robot[rows], camera[rows], fit.lever, (fit.x, fit.z))
    return Scored(changed, again, rows)

"""Instrument mounting from position readings of points on the flange, and their positions there.

A position reading is a pose of the instrument's probe without a measured rotation: the predicted
one is supplied, with the variance of an unknown rotation, so that readings of points are weighted
and merged as poses are. Several points of one stop determine the rotation too, once their positions
on the flange are unknowns common to all readings.
"""

from collections.abc import Iterator

import numpy as np

from visioncal.core.procrustes import align
from visioncal.core.robust import half_of, small_sets, trimmed_start
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.points import Placement, PointProblem, descended

# Stops in a start set: with 30 % of the stops wrong, all sixty sets contain a wrong one with
# probability 1e-5.
_SET_SIZE = 5


def mounting_problem(
    base_from_flange: FloatArray, read: FloatArray, points: IntArray
) -> PointProblem:
    """The problem of a mounting; its residuals are in the instrument's frame.

    Args:
        base_from_flange: (m, 4, 4) one per reading.
        read: (m, 3) positions in the instrument's frame [m].
        points: (m,) index of the point.
    """
    count = len(read)

    # The flange is aligned with the readings, with the points at its origin.
    frame = align(base_from_flange[:, :3, 3], read)
    start = Placement(frame, np.zeros((int(points.max()) + 1, 3)))
    return PointProblem(
        read,
        np.ones((count, 3), dtype=bool),
        np.zeros((count, 3, 3)),
        lambda: (start,),
        carriers=base_from_flange,
        points=points,
    )


def find_mounting(problem: PointProblem, stops: IntArray) -> tuple[Placement, FloatArray]:
    """Fits the mounting robustly to readings with outlier stops.

    Args:
        problem: Of m readings.
        stops: (m,) index of the robot's stop.

    Returns:
        The pose of the instrument with the positions of the points on the flange, and the (m, 3)
        predicted less the read positions, in the instrument's frame [m].
    """
    count, even = int(stops.max()) + 1, np.eye(3)[None].repeat(len(stops), axis=0)
    (first,) = problem.guesses()

    def solve(chosen: Mask, start: Placement) -> Placement:
        return descended(problem, start, chosen[stops], even)

    def sets() -> Iterator[Mask]:
        yield np.ones(count, dtype=bool)
        for rows in small_sets(count, _SET_SIZE) if count > _SET_SIZE else ():
            chosen = np.isin(np.arange(count), rows)
            if len(np.unique(problem.points[chosen[stops]])) == len(first.points):
                yield chosen

    def by_stop(mounting: Placement) -> FloatArray:
        farthest = np.zeros(count)
        errors = problem.linearise(mounting).residuals
        np.maximum.at(farthest, stops, np.linalg.norm(errors, axis=1))
        return farthest

    starts = (solve(chosen, first) for chosen in sets())
    best = trimmed_start(starts, by_stop, solve, half_of(count))[1]
    return best, problem.linearise(best).residuals

"""Instrument mounting from position readings of points on the flange, and their poses.

A position reading is a pose of the instrument's probe without a measured rotation: the predicted
one is supplied, with the variance of an unknown rotation, so that readings of points are weighted
and merged as poses are. Several points of one stop determine the rotation too, once their positions
on the flange are unknowns common to all readings.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import apply, exp, invert, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.estimation.linalg import damped_step
from visioncal.estimation.procrustes import align
from visioncal.estimation.robust import half_of, small_sets, trimmed_start

# Relative and absolute change of the cost [m^2] at convergence.
_CONVERGED = 1e-14
# Stops in a start set: with 30 % of the stops wrong, all sixty sets contain a wrong one with
# probability 1e-5.
_SET_SIZE = 5


@dataclass(frozen=True, eq=False)
class PositionReadings:
    """Position readings of points on the flange by an instrument."""

    base_from_flange: FloatArray  # (m, 4, 4) one per reading.
    read: FloatArray  # (m, 3) positions in the instrument's frame [m].
    points: IntArray  # (m,) index of the point.
    stops: IntArray  # (m,) index of the robot's stop.
    sigmas: FloatArray  # (m,) standard deviations of each coordinate [m].

    def subset(self, chosen: Mask) -> "PositionReadings":
        """Returns the readings of an (m,) mask."""
        return PositionReadings(
            self.base_from_flange[chosen],
            self.read[chosen],
            self.points[chosen],
            self.stops[chosen],
            self.sigmas[chosen],
        )


@dataclass(frozen=True, eq=False)
class Mounting:
    """Pose of the instrument and positions of the points on the flange."""

    base_from_instrument: FloatArray  # (4, 4).
    on_flange: FloatArray  # (p, 3) the points in the flange's frame [m].


def find_mounting(places: PositionReadings) -> tuple[Mounting, FloatArray]:
    """Fits the mounting robustly to readings with outlier stops.

    Returns:
        The mounting, and the (m,) distances [m] between read and predicted positions.
    """
    count, points = int(places.stops.max()) + 1, int(places.points.max()) + 1
    starts = (fit_mounting(places.subset(start), None, points) for start in _starts(places, count))

    def solve(stops: Mask, start: Mounting) -> Mounting:
        return fit_mounting(places.subset(stops[places.stops]), start, points)

    def by_stop(mounting: Mounting) -> FloatArray:
        farthest = np.zeros(count)
        np.maximum.at(farthest, places.stops, distances(places, mounting))
        return farthest

    best = trimmed_start(starts, by_stop, solve, half_of(count))[1]
    return best, distances(places, best)


def _starts(places: PositionReadings, count: int) -> Iterator[Mask]:
    """Masks of readings: all of them, and small sets of stops with readings of all points."""
    yield np.ones(len(places.stops), dtype=bool)
    if count <= _SET_SIZE:
        return
    points = len(np.unique(places.points))
    for stops in small_sets(count, _SET_SIZE):
        chosen = np.isin(places.stops, stops)
        if len(np.unique(places.points[chosen])) == points:
            yield chosen


def distances(places: PositionReadings, mounting: Mounting) -> FloatArray:
    """Distances (m,) [m] between the read and the predicted positions."""
    return np.asarray(np.linalg.norm(residuals(places, mounting), axis=1))


def fit_mounting(places: PositionReadings, start: Mounting | None, count: int) -> Mounting:
    """Minimises the distances between read and predicted positions of a number of points.

    Without a start, the flange is aligned with the readings, with the points at its origin. Points
    without readings stay there.
    """
    if start is None:
        x = align(places.base_from_flange[:, :3, 3], places.read)
        start = Mounting(x, np.zeros((count, 3)))

    def linearise(at: Mounting) -> Linearised[Mounting]:
        errors, jacobian = residuals(places, at), _jacobian(places, at)
        information = np.einsum("mij,mik->jk", jacobian, jacobian)
        gradient = np.einsum("mij,mi->j", jacobian, errors)

        def step(damping: float) -> Mounting:
            change = damped_step(information, gradient, damping)
            on_flange = at.on_flange + change[6:].reshape(-1, 3)
            return Mounting(at.base_from_instrument @ exp(change[None, :6])[0], on_flange)

        return Linearised(at, float(np.sum(errors**2)), step)

    return levenberg_marquardt(start, linearise, _CONVERGED)[0]


def residuals(places: PositionReadings, at: Mounting) -> FloatArray:
    """Read minus predicted positions (m, 3), in the flange's frame [m]."""
    in_base = apply(at.base_from_instrument, places.read)
    flange_from_base = invert(places.base_from_flange)
    turned = np.einsum("mij,mj->mi", flange_from_base[:, :3, :3], in_base)
    return np.asarray(turned + flange_from_base[:, :3, 3] - at.on_flange[places.points])


def _jacobian(places: PositionReadings, at: Mounting) -> FloatArray:
    """Derivatives (m, 3, 6 + 3 p) of `residuals` by the instrument's frame and the points."""
    turns = np.swapaxes(places.base_from_flange[:, :3, :3], 1, 2) @ at.base_from_instrument[:3, :3]
    count = len(at.on_flange)
    jacobian = np.zeros((len(turns), 3, 6 + 3 * count))
    jacobian[:, :, :3] = -turns @ skew(places.read)
    jacobian[:, :, 3:6] = turns
    for point in range(count):
        jacobian[:, :, 6 + 3 * point : 9 + 3 * point][places.points == point] = -np.eye(3)
    return jacobian

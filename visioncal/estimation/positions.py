"""Places of points on the flange, read by an instrument: a start, and the poses they stand for.

A reading of a place is a pose of the instrument's probe whose rotation is not measured: it is
supplied as the chain predicts it, with the variance of a rotation that is not known at all. So
supplied, readings of points are weighed and merged as poses are. Several points of one stop
determine the rotation too, once their places on the flange are unknowns that all readings share.
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

# A cost [m^2] that changes by less than this share of itself and of a square metre is at rest.
_SETTLED = 1e-14
# Sets of stops to start from: with 30 % of the stops wrong, all sixty contain a wrong one with
# probability 1e-5.
_SET_SIZE = 5


@dataclass(frozen=True, eq=False)
class Places:
    """What an instrument read of points on the flange.

    Attributes:
        base_from_flange: (m, 4, 4) one a reading.
        read: (m, 3) places in the instrument's frame [m].
        points: (m,) which point each is of, numbered from 0.
        stops: (m,) at which stop of the robot, numbered from 0.
        sigmas: (m,) standard deviations of each coordinate [m].
    """

    base_from_flange: FloatArray
    read: FloatArray
    points: IntArray
    stops: IntArray
    sigmas: FloatArray

    def subset(self, chosen: Mask) -> "Places":
        """Returns the readings of an (m,) mask."""
        return Places(
            self.base_from_flange[chosen],
            self.read[chosen],
            self.points[chosen],
            self.stops[chosen],
            self.sigmas[chosen],
        )


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where the instrument stands and the points sit.

    Attributes:
        base_from_instrument: (4, 4).
        on_flange: (p, 3) the points in the flange's frame [m].
    """

    base_from_instrument: FloatArray
    on_flange: FloatArray


def find_mounting(places: Places) -> tuple[Mounting, FloatArray]:
    """Finds where the instrument stands and the points sit, although some stops may be wrong.

    Returns:
        The mounting, and the (m,) distances [m] between read and predicted places.
    """
    count, points = int(places.stops.max()) + 1, int(places.points.max()) + 1
    starts = (fit_mounting(places.subset(start), None, points) for start in _starts(places, count))

    def solve(stops: Mask, start: Mounting) -> Mounting:
        return fit_mounting(places.subset(stops[places.stops]), start, points)

    def by_stop(at: Mounting) -> FloatArray:
        away = np.zeros(count)
        np.maximum.at(away, places.stops, distances(places, at))
        return away

    best = trimmed_start(starts, by_stop, solve, half_of(count))[1]
    return best, distances(places, best)


def _starts(places: Places, count: int) -> Iterator[Mask]:
    """Masks of readings: all of them, and small sets of stops in which all points are read."""
    yield np.ones(len(places.stops), dtype=bool)
    if count <= _SET_SIZE:
        return
    points = len(np.unique(places.points))
    for stops in small_sets(count, _SET_SIZE):
        chosen = np.isin(places.stops, stops)
        if len(np.unique(places.points[chosen])) == points:
            yield chosen


def distances(places: Places, mounting: Mounting) -> FloatArray:
    """Distances (m,) [m] between the read and the predicted places."""
    return np.asarray(np.linalg.norm(residuals(places, mounting), axis=1))


def fit_mounting(places: Places, start: Mounting | None, count: int) -> Mounting:
    """Minimises the distances between read and predicted places.

    Args:
        places: The readings.
        start: Where to start; None for the flange laid on what was read, without the points'
            places on it.
        count: How many points there are; those that were not read stay where they are.
    """
    if start is None:
        x = align(places.base_from_flange[:, :3, 3], places.read)
        start = Mounting(x, np.zeros((count, 3)))

    def linearise(at: Mounting) -> Linearised[Mounting]:
        off, jacobian = residuals(places, at), _jacobian(places, at)
        information = np.einsum("mij,mik->jk", jacobian, jacobian)
        gradient = np.einsum("mij,mi->j", jacobian, off)

        def step(damping: float) -> Mounting:
            by = damped_step(information, gradient, damping)
            moved = at.on_flange + by[6:].reshape(-1, 3)
            return Mounting(at.base_from_instrument @ exp(by[None, :6])[0], moved)

        return Linearised(at, float(np.sum(off**2)), step)

    return levenberg_marquardt(start, linearise, _SETTLED)[0]


def residuals(places: Places, at: Mounting) -> FloatArray:
    """From the predicted to the read places (m, 3), in the flange's frame [m]."""
    x = at.base_from_instrument
    in_base = apply(x, places.read)
    flange_from_base = invert(places.base_from_flange)
    turned = np.einsum("mij,mj->mi", flange_from_base[:, :3, :3], in_base)
    return np.asarray(turned + flange_from_base[:, :3, 3] - at.on_flange[places.points])


def _jacobian(places: Places, at: Mounting) -> FloatArray:
    """Their derivatives (m, 3, 6 + 3 p) by steps of the instrument's frame and of the points."""
    turns = np.swapaxes(places.base_from_flange[:, :3, :3], 1, 2) @ at.base_from_instrument[:3, :3]
    count = len(at.on_flange)
    jacobian = np.zeros((len(turns), 3, 6 + 3 * count))
    jacobian[:, :, :3] = -turns @ skew(places.read)
    jacobian[:, :, 3:6] = turns
    for point in range(count):
        jacobian[:, :, 6 + 3 * point : 9 + 3 * point][places.points == point] = -np.eye(3)
    return jacobian

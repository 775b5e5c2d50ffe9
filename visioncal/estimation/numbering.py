"""Correspondence of measured and drawn points: swapped and shifted numbers, by geometry.

Distances between points do not depend on the part's pose. Where the stated correspondence does not
fit the drawing, and another fits far better, the stated one is wrong. A symmetric pattern fits in
several orders: then geometry does not determine the order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import perm

import numpy as np
from scipy.spatial.distance import cdist

from visioncal.core.quantiles import FALSE_REJECTION, f_limit
from visioncal.core.transforms import apply
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.placing import LEAST_NOISE_M
from visioncal.estimation.procrustes import align, procrustes_residual

# Most pairs and triples of drawn points that are compared with a measured triangle.
_MOST = 500
# Chance of noise at which an order fits as well as the best.
_AS_GOOD = 1e-2
# From 13 points on the orders are so many that the corrected test would never reject; those that
# noise could favour move a few points only.
_MOST_TRIED = 10**9


@dataclass(frozen=True, eq=False)
class Numbering:
    """The order in which measured points fit a drawing."""

    # (n,) index of the drawn point of each measured one: `arange(n)` for the stated order. Of
    # several that fit equally well it is the one that moves the fewest.
    assignment: IntArray
    rms_m: float  # Root mean square distance of the points in that order [m].
    stated_rms_m: float  # The same in the stated order [m].
    is_wrong: bool  # Whether the stated order fits significantly worse.
    # Number of orders that fit as well as the best one; 1 where it is unique. Of large sets not all
    # orders are tried, and this is a lower bound.
    equally_good: int

    @property
    def moved(self) -> IntArray:
        """The measured points that differ from the stated order."""
        return np.flatnonzero(self.assignment != np.arange(len(self.assignment)))

    def words(self, labels: Sequence[str]) -> str:
        """Words for the difference from the stated order, if any: `P3 and P7 are exchanged`.

        `labels` are the (m,) names of the drawn points; the first n are the stated ones.
        """
        moved = self.moved
        if not len(moved):
            return ""
        if len(moved) == 2 and set(moved) == set(self.assignment[moved]):
            return f"{labels[moved[0]]} and {labels[moved[1]]} are exchanged"
        pairs = (f"{labels[index]} is {labels[self.assignment[index]]}" for index in moved)
        return f"points are exchanged: {', '.join(pairs)}"


def misfit_by_noise(count: int, noise_m: float) -> float:
    """Squared misfit [m^2] of placed points by noise alone, added to both sides of a ratio."""
    return (3.0 * count - 6.0) * max(noise_m, LEAST_NOISE_M) ** 2


def find_numbering(
    measured: FloatArray, nominal: FloatArray, noise_m: float = LEAST_NOISE_M
) -> Numbering:
    """Finds the order in which measured points best fit a drawing.

    A large triangle of measured points is matched with the drawing by its sides, and each alignment
    assigns the points to their nearest ones (Kuhn 1955, with all points at once).

    Args:
        measured: (n, 3) in any frame [m], n at least 3.
        nominal: (m, 3) of the drawing [m]; the first n are the stated partners, any others are
            stated as not measured.
        noise_m: Stated noise of a coordinate [m].

    Returns:
        The best order, and its comparison with the stated one.
    """
    count = len(measured)
    stated = np.arange(count)
    orders = np.unique(np.vstack([stated, _orders(measured, nominal)]), axis=0)
    squares = procrustes_residual(measured[None], nominal[orders])
    freedom = 3.0 * count - 6.0
    # The misfit by stated noise makes no difference between orders.
    floor = misfit_by_noise(count, noise_m)
    ratio = (squares + floor) / (squares.min() + floor)
    as_good = ratio < f_limit(_AS_GOOD, freedom, freedom)
    moves = (orders != stated).sum(axis=1)
    best = int(np.lexsort((squares, moves, ~as_good))[0])
    stated_row = int(np.flatnonzero(moves == 0)[0])
    # Corrected for the number of orders among which the best one was chosen.
    tried = min(perm(len(nominal), count), _MOST_TRIED)
    limit = f_limit(FALSE_REJECTION / tried, freedom, freedom)
    # Exchanging two measurements of one drawn point gives no other order.
    distinct = np.asarray(np.unique(nominal, axis=0, return_inverse=True)[1]).ravel()
    return Numbering(
        orders[best].astype(np.int64),
        float(np.sqrt(squares[best] / count)),
        float(np.sqrt(squares[stated_row] / count)),
        bool(ratio[stated_row] > limit and not as_good[stated_row]),
        len(np.unique(distinct[orders[as_good]], axis=0)),
    )


def _orders(measured: FloatArray, nominal: FloatArray) -> IntArray:
    """Candidate orders (k, n)."""
    from scipy.optimize import linear_sum_assignment

    # The two farthest points, and the one farthest from their line.
    sides, distances = cdist(measured, measured), cdist(nominal, nominal)
    a, b = np.unravel_index(sides.argmax(), sides.shape)
    along = measured[b] - measured[a]
    c = np.linalg.norm(np.cross(measured - measured[a], along), axis=1).argmax()
    # The drawn points whose distances are most like those of the three.
    off = np.abs(distances - sides[a, b])
    first, second = np.unravel_index(off.argsort(axis=None)[:_MOST], off.shape)
    totals = off[first, second][:, None] ** 2 + (distances[first] - sides[a, c]) ** 2
    totals += (distances[second] - sides[b, c]) ** 2
    pair, third = np.unravel_index(totals.argsort(axis=None)[:_MOST], totals.shape)
    triples = np.column_stack([first[pair], second[pair], third])
    placed = apply(align(measured[[a, b, c]][None], nominal[triples]), nominal[None])
    costs = (cdist(measured, points, "sqeuclidean") for points in placed)
    return np.array([linear_sum_assignment(cost)[1] for cost in costs])

"""Measured points beside a drawing's coordinates of them, and what is wrong with them as a whole.

A line of points, another unit and a left-handed drawing are found before anything is fitted: no
choice of points would mend them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.conventions import UNITS_M
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.files import some_of
from visioncal.core.number_format import figure
from visioncal.core.quantiles import f_limit
from visioncal.core.types import FloatArray
from visioncal.estimation.numbering import Numbering
from visioncal.estimation.observability import axis_words
from visioncal.estimation.placing import LEAST_NOISE_M, LEAST_RATIO
from visioncal.estimation.procrustes import mirrored, procrustes_residual, spreads

FEWEST_POINTS = 3
# A ratio of lengths this near to that of two units is no chance: no part is off by so much.
_UNIT_TOLERANCE = 0.1
# Two units (small, large) that are taken for each other.
_MIXED_UNITS = (
    ("mm", "m"),
    ("mm", "inch"),
    ("mm", "cm"),
    ("cm", "m"),
    ("inch", "m"),
    ("cm", "inch"),
)
# A sound set is called mirrored in one of a thousand, at most.
_FALSE_ALARM = 1e-3


@dataclass(frozen=True, eq=False)
class PointPairs:
    """Measured points and the drawing's coordinates of them, n in all.

    Attributes:
        labels: (n,) the points' names; one that was measured several times is there several times.
        measured: (n, 3) in the base [m].
        covariances: (n, 3, 3) what is known of their noise [m^2]; zeros where nothing is.
        nominal: (n, 3) in the fixture's frame [m].
        nominal_sigma_m: (n,) how well the part keeps to its drawing, per axis [m].
        spare_labels: (k,) names of drawn points that were not measured.
        spare: (k, 3) their coordinates in the fixture's frame [m].
    """

    labels: tuple[str, ...]
    measured: FloatArray
    covariances: FloatArray
    nominal: FloatArray
    nominal_sigma_m: FloatArray
    spare_labels: tuple[str, ...] = ()
    spare: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def merged(self) -> "PointPairs":
        """Returns each point once: the median of its measurements, with their mean covariance."""
        names = tuple(dict.fromkeys(self.labels))
        if len(names) == len(self.labels):
            return self
        labels = np.array(self.labels)
        rows = [np.flatnonzero(labels == name) for name in names]
        first = np.array([row[0] for row in rows])
        return replace(
            self,
            labels=names,
            measured=np.array([np.median(self.measured[row], axis=0) for row in rows]),
            covariances=np.array([self.covariances[row].mean(axis=0) for row in rows]),
            nominal=self.nominal[first],
            nominal_sigma_m=self.nominal_sigma_m[first],
        )

    @property
    def drawn(self) -> FloatArray:
        """(n + k, 3) all drawn points, the measured ones first [m]."""
        return self.nominal if self.spare is None else np.vstack([self.nominal, self.spare])

    @property
    def drawn_labels(self) -> tuple[str, ...]:
        """(n + k,) their names."""
        return self.labels + self.spare_labels

    @property
    def known(self) -> FloatArray:
        """(n, 3, 3) what is known of each point's noise, measured and drawn together [m^2].

        A part's deviation from its drawing is alike in all directions, however it is turned.
        """
        return np.asarray(
            self.covariances + self.nominal_sigma_m[:, None, None] ** 2 * np.eye(3), dtype=float
        )

    @property
    def known_noise_m(self) -> float:
        """The known noise of a coordinate, root mean square over all [m]."""
        return float(np.sqrt(np.trace(self.known, axis1=1, axis2=2).mean() / 3.0))


def check_pairs(pairs: PointPairs) -> None:
    """Refuses points that cannot place anything.

    Raises:
        DataError: Fewer than three points, numbers that are none, or another unit.
        DegenerateError: The points lie on a line, or in one place.
    """
    if len(pairs) < FEWEST_POINTS:
        raise DataError(
            f"fixture: {len(pairs)} measured points with coordinates in the drawing, at least "
            f"{FEWEST_POINTS} are needed.",
            culprits=list(pairs.labels),
            next_step="Measure more points, not all on one line.",
        )
    bad = ~np.isfinite(pairs.measured).all(axis=1) | ~np.isfinite(pairs.nominal).all(axis=1)
    if bad.any():
        names = [pairs.labels[at] for at in np.flatnonzero(bad)]
        raise DataError(
            f"fixture: point {some_of(names)}: a coordinate is missing.", culprits=names
        )
    for points, whose in ((pairs.nominal, "drawn"), (pairs.measured, "measured")):
        _check_line(points, whose, pairs.labels)
    _check_units(pairs)


def determines_hand(measured: FloatArray, nominal: FloatArray, noise_m: float) -> bool:
    """Whether points (n, 3) distinguish a drawing of them (n, 3) from its mirror image.

    Points in one plane have no hand: mirrored they are the same points seen from behind, and the
    frame's z axis points the other way. They do not show that.

    Args:
        measured: In the base [m].
        nominal: In the fixture's frame [m].
        noise_m: What is known of a coordinate's noise [m].
    """
    as_drawn, flipped, limit = _hands(measured, nominal, noise_m)
    return flipped > limit * as_drawn


def check_hand(pairs: PointPairs, numbering: Numbering, noise_m: float) -> None:
    """Refuses points that are the mirror image of the drawing.

    Args:
        pairs: The points.
        numbering: The order in which they fit best.
        noise_m: What is known of a coordinate's noise [m].

    Raises:
        DataError: Mirrored, the points fit so much better that noise does not explain it.
    """
    as_drawn, flipped, limit = _hands(pairs.measured, pairs.nominal, noise_m)
    reordered = float(procrustes_residual(pairs.measured, pairs.drawn[numbering.assignment]))
    if as_drawn <= limit * flipped or flipped > limit * (reordered + _floor(len(pairs), noise_m)):
        return
    rms_mm = 1e3 * np.sqrt(np.array([as_drawn, flipped]) / len(pairs))
    other = ""
    if numbering.is_wrong:
        words = numbering.words(pairs.drawn_labels)
        other = f" Or another order is right, which fits as well: {words}."
    raise DataError(
        f"fixture: the measured points are the mirror image of the drawing: mirrored they fit to "
        f"{figure(rms_mm[1])} mm, as they are to {figure(rms_mm[0])} mm only (root mean "
        f"square).{other}",
        culprits=list(pairs.labels),
        next_step="Look for a coordinate of the wrong sign or two exchanged axes, in the drawing's "
        "table or in the measured one: a robot's frames are right-handed.",
    )


def _hands(measured: FloatArray, nominal: FloatArray, noise_m: float) -> tuple[float, float, float]:
    """Squared misfits of the drawing and of its mirror image [m^2], and how far they may differ."""
    freedom, floor = 3.0 * len(measured) - 6.0, _floor(len(measured), noise_m)
    return (
        float(procrustes_residual(measured, nominal)) + floor,
        float(procrustes_residual(measured, mirrored(nominal))) + floor,
        float(f_limit(_FALSE_ALARM, freedom, freedom)),
    )


def _floor(count: int, noise_m: float) -> float:
    """Squared misfit [m^2] that is noise in any case: it sets no two fits apart."""
    return (3.0 * count - 6.0) * max(noise_m, LEAST_NOISE_M) ** 2


def line_words(points: FloatArray, whose: str) -> str:
    """Says how near points (n, 3) are to a line: `the drawn points lie within 0.2 mm of a line`."""
    centred = points - points.mean(axis=0)
    axis = spreads(points)[1][0]
    aside = np.linalg.norm(centred - np.outer(centred @ axis, axis), axis=1).max()
    return f"the {whose} points lie within {figure(1e3 * aside)} mm of a line"


def _check_line(points: FloatArray, whose: str, labels: Sequence[str]) -> None:
    extents, axes = spreads(points)
    if extents[1] ** 2 > max(LEAST_RATIO * extents[0] ** 2, LEAST_NOISE_M**2):
        return
    if extents[0] <= LEAST_NOISE_M:
        raise DegenerateError(
            f"fixture: the fixture's rotation is not determined at all: the {whose} points are all "
            f"in one place, to within {figure(1e3 * extents[0])} mm.",
            culprits=list(labels),
            next_step="Measure three points that are far apart and not on one line.",
        )
    frame = "fixture" if whose == "drawn" else "base"
    raise DegenerateError(
        f"fixture: the fixture's rotation about the {frame}'s {axis_words(axes[0])} is not "
        f"determined at all: {line_words(points, whose)}.",
        culprits=list(labels),
        next_step="Add a point far from that line.",
    )


def _check_units(pairs: PointPairs) -> None:
    """Compares the typical distances: whatever the numbering, and with a few points wrong."""
    ratio = _typical_distance(pairs.measured) / _typical_distance(pairs.nominal)
    for small, large in _MIXED_UNITS:
        factor = UNITS_M[large] / UNITS_M[small]
        for read, meant, size in ((small, large, factor), (large, small, 1.0 / factor)):
            if abs(ratio / size - 1.0) < _UNIT_TOLERANCE:
                raise DataError(
                    f"fixture: the measured points are {ratio:.4g} times as far apart as the drawn "
                    f"ones, and should be as far: the measured ones are in {read} and were read as "
                    f"{meant}, or the drawn ones are in {meant} and were read as {read}.",
                    culprits=list(pairs.labels),
                    next_step="Correct the unit of one of the two tables.",
                )


def _typical_distance(points: FloatArray) -> float:
    i, j = np.triu_indices(len(points), 1)
    return float(np.median(np.linalg.norm(points[i] - points[j], axis=1)))

"""Fixture frame from measured points and the drawing's coordinates of the same points.

Each point obeys `measured = base_from_fixture * nominal`, up to its stated noise and one common
noise level, which is estimated. Scale is estimated separately, never absorbed.

Collinear points, another unit and a left-handed drawing are found before the fit: no selection of
points would correct them.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.conventions import UNITS_M
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure, some_of
from visioncal.core.quantiles import f_limit, t_chance
from visioncal.core.transforms import apply, exp, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.groups import GroupFit, Groups, fit_groups
from visioncal.estimation.numbering import Numbering, find_numbering
from visioncal.estimation.observability import SIGMA_LIMIT_M, Direction, axis_words
from visioncal.estimation.placing import (
    LEAST_NOISE_M,
    LEAST_RATIO,
    left_out_words,
    noise_words,
    refuse_poor,
    worst_directions,
)
from visioncal.estimation.procrustes import (
    align,
    mirrored,
    procrustes_residual,
    scale_between,
    spreads,
)
from visioncal.estimation.robust import small_sets

# Share of sound sets that are called mirrored, or of another scale.
_FALSE_ALARM = 1e-3
# Ratio of extents below which points are nearly collinear.
_SLENDER = 0.1

FEWEST_POINTS = 3
# Relative tolerance of a ratio of lengths about that of two units: no part is off by so much.
_UNIT_TOLERANCE = 0.1
# Pairs of units (small, large) that are confused.
_MIXED_UNITS = (
    ("mm", "m"),
    ("mm", "inch"),
    ("mm", "cm"),
    ("cm", "m"),
    ("inch", "m"),
    ("cm", "inch"),
)


@dataclass(frozen=True, eq=False)
class PointPairs:
    """Measured points and their coordinates in the drawing, n in all."""

    labels: tuple[str, ...]  # (n,) the points' names, repeated for repeated measurements.
    measured: FloatArray  # (n, 3) in the base [m].
    # (n, 3, 3) stated covariance of their noise [m^2]; zeros where none is.
    covariances: FloatArray
    nominal: FloatArray  # (n, 3) in the fixture's frame [m].
    # (n,) tolerance of the part to its drawing, per axis, as a sigma [m].
    nominal_sigma_m: FloatArray
    spare_labels: tuple[str, ...] = ()  # (k,) names of drawn points that were not measured.
    spare: FloatArray | None = None  # (k, 3) their coordinates in the fixture's frame [m].

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
        """(n, 3, 3) stated covariance of each point, measured and drawn together [m^2].

        A part's deviation from its drawing is isotropic, so that its rotation does not matter.
        """
        return np.asarray(
            self.covariances + self.nominal_sigma_m[:, None, None] ** 2 * np.eye(3), dtype=float
        )

    @property
    def known_noise_m(self) -> float:
        """The stated noise of a coordinate, root mean square over all [m]."""
        return float(np.sqrt(np.trace(self.known, axis1=1, axis2=2).mean() / 3.0))


def check_pairs(pairs: PointPairs) -> None:
    """Refuses points that cannot determine a frame.

    Raises:
        DataError: Fewer than three points, missing numbers, or another unit.
        DegenerateError: The points are collinear or coincident.
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
        names = [pairs.labels[index] for index in np.flatnonzero(bad)]
        raise DataError(
            f"fixture: point {some_of(names)}: a coordinate is missing.", culprits=names
        )
    for points, whose in ((pairs.nominal, "drawn"), (pairs.measured, "measured")):
        _check_line(points, whose, pairs.labels)
    _check_units(pairs)


def determines_hand(measured: FloatArray, nominal: FloatArray, noise_m: float) -> bool:
    """Whether points (n, 3) distinguish a drawing of them (n, 3) from its mirror image.

    Coplanar points have no handedness: mirrored they are the same points seen from behind, with the
    frame's z axis reversed.

    Args:
        measured: In the base [m].
        nominal: In the fixture's frame [m].
        noise_m: Stated noise of a coordinate [m].
    """
    as_drawn, flipped, limit = _hands(measured, nominal, noise_m)
    return flipped > limit * as_drawn


def check_hand(pairs: PointPairs, numbering: Numbering, noise_m: float) -> None:
    """Refuses points that are the mirror image of the drawing, at a stated noise [m].

    `numbering` is the order in which they fit best.

    Raises:
        DataError: Mirrored, the points fit significantly better.
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
    """Squared misfits of the drawing and of its mirror image [m^2], and their ratio's limit."""
    freedom, floor = 3.0 * len(measured) - 6.0, _floor(len(measured), noise_m)
    return (
        float(procrustes_residual(measured, nominal)) + floor,
        float(procrustes_residual(measured, mirrored(nominal))) + floor,
        float(f_limit(_FALSE_ALARM, freedom, freedom)),
    )


def _floor(count: int, noise_m: float) -> float:
    """Squared misfit [m^2] by noise, added to both sides of a ratio."""
    return (3.0 * count - 6.0) * max(noise_m, LEAST_NOISE_M) ** 2


def line_words(points: FloatArray, whose: str) -> str:
    """Words for near collinearity of (n, 3): `the drawn points lie within 0.2 mm of a line`."""
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
    """Compares typical distances, which do not depend on the numbering or a few outliers."""
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


@dataclass(frozen=True)
class Scale:
    """Scale of the measured part relative to the drawing, if left free."""

    value: float  # Measured over drawn.
    sigma: float  # Its standard deviation.
    differs: bool  # Whether it differs significantly from one.


@dataclass(frozen=True, eq=False)
class FixturePlacement:
    """Pose of the drawing: (4, 4) `base_from_fixture`, applied after a scale of the drawing."""

    base_from_fixture: FloatArray
    scale: float


@dataclass(frozen=True, eq=False)
class PointFit:
    """A fixture's frame from n points."""

    # The inlier points and their fit, without any scale. Its residuals are measured less drawn, in
    # the base [m].
    agreement: GroupInliers[FixturePlacement]
    scale: Scale  # The scale if it were free.
    # The order in which the points fit the drawing best; repeated measurements count once, at their
    # first place.
    numbering: Numbering
    # Whether mirrored points would have been found: coplanar points leave the sign of the fixture's
    # z axis open.
    hand_known: bool
    # The least certain offset, amid the points, and the least certain rotation.
    worst: tuple[Direction, Direction]

    @property
    def base_from_fixture(self) -> FloatArray:
        """(4, 4) the frame."""
        return self.agreement.fit.state.base_from_fixture

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of its right perturbation (rotation [rad], translation [m])."""
        return self.agreement.fit.covariance

    @property
    def by_points(self) -> FloatArray:
        """(n, 6, 3) Jacobian of the frame's right perturbation by each measured point."""
        return self.agreement.fit.gains


@dataclass(frozen=True, eq=False)
class PointProblem:
    """Fit of points to their drawing, with the drawing's scale free or held at one."""

    pairs: PointPairs
    scaled: bool

    def guesses(self) -> Iterator[FixturePlacement]:
        """Closed forms from all points, and from small sets."""
        yield self._closed_form(np.arange(len(self.pairs)))
        for rows in small_sets(len(self.pairs), FEWEST_POINTS):
            yield self._closed_form(rows)

    def _closed_form(self, rows: IntArray) -> FixturePlacement:
        measured, nominal = self.pairs.measured[rows], self.pairs.nominal[rows]
        scale = scale_between(measured, nominal) if self.scaled else 1.0
        return FixturePlacement(align(measured, scale * nominal), scale)

    def linearise(self, state: FixturePlacement) -> Groups:
        """Residuals (n, 3) in the base, and their Jacobian by the perturbation and the scale.

        `R (s p + w x s p + v) + t`, so that a step (w, v) moves the residual by `R (sp x w) - R v`,
        and one of the scale by `-R p`.
        """
        points, rotation = state.scale * self.pairs.nominal, state.base_from_fixture[:3, :3]
        columns = [rotation @ skew(points), np.broadcast_to(-rotation, (len(points), 3, 3))]
        if self.scaled:
            columns.append(-(rotation @ self.pairs.nominal[:, :, None]))
        return Groups(
            self.pairs.measured - apply(state.base_from_fixture, points),
            np.concatenate(columns, axis=2),
            np.ones(points.shape, dtype=bool),
            self.pairs.known,
        )

    def move(self, state: FixturePlacement, step: FloatArray) -> FixturePlacement:
        """Takes a (6,) or (7,) step on the right."""
        scale = state.scale + float(step[6]) if self.scaled else 1.0
        return FixturePlacement(state.base_from_fixture @ exp(step[:6]), scale)


def fit_points(pairs: PointPairs, expected_noise_m: float | None = None) -> PointFit:
    """Fits a fixture's frame to points of its drawing.

    Weighted least squares from the closed form (Arun, Huang and Blostein 1987; Umeyama 1991), with
    the points' own covariances, the noise level by restricted maximum likelihood, and outliers
    rejected.

    Args:
        pairs: The points.
        expected_noise_m: Expected noise of a coordinate beyond the stated one of each point [m];
            None where unknown.

    Raises:
        DataError: Too few points, another unit, mirrored or wrongly numbered points, or points that
            do not fit the drawing at all.
        DegenerateError: The points are collinear, or nearly so.
    """
    points = pairs.merged()
    check_pairs(points)
    noise = float(np.hypot(pairs.known_noise_m, expected_noise_m or 0.0))
    numbering = find_numbering(points.measured, points.drawn, noise)
    check_hand(points, numbering, noise)
    agreement, scale = _fit_inliers(pairs, expected_noise_m)
    _check_numbering(
        points, numbering, {pairs.labels[index] for index in np.flatnonzero(agreement.mask)}
    )
    fit, agrees = agreement.fit, agreement.mask
    centre = pairs.nominal[agrees].mean(axis=0)
    worst = worst_directions(fit, fit.state.base_from_fixture, centre, fit.sigma)
    if fit.sigma > SIGMA_LIMIT_M and any(direction.sigma > direction.limit for direction in worst):
        raise _no_fit(pairs, fit, scale)
    refuse_poor(
        worst,
        left_out_words(pairs.labels, agrees) + _cause(pairs, fit),
        pairs.labels,
        "Measure points that are farther apart and not nearly on one line, or measure them better.",
    )
    hand_known = determines_hand(pairs.measured[agrees], pairs.nominal[agrees], noise)
    return PointFit(agreement, scale, numbering, hand_known, worst)


def _fit_inliers(
    pairs: PointPairs, expected_noise_m: float | None
) -> tuple[GroupInliers[FixturePlacement], Scale]:
    """Finds the inliers, without rejecting points that only a scale contradicts."""
    rigid = find_inlier_groups(PointProblem(pairs, scaled=False), expected_noise_m)
    if not _is_inlier(rigid).all():
        scaled = find_inlier_groups(PointProblem(pairs, scaled=True), expected_noise_m)
        scale = _scale_of(scaled.fit)
        if scale.differs and _is_inlier(scaled).sum() > _is_inlier(rigid).sum():
            fit = fit_groups(PointProblem(pairs, scaled=False), scaled.mask)
            return _as_scaled(scaled, fit), scale
    return rigid, _scale_of(fit_groups(PointProblem(pairs, scaled=True), rigid.mask))


def _is_inlier(agreement: GroupInliers[FixturePlacement]) -> Mask:
    return agreement.mask & ~agreement.doubtful


def _as_scaled(
    scaled: GroupInliers[FixturePlacement], fit: GroupFit[FixturePlacement]
) -> GroupInliers[FixturePlacement]:
    """Inliers with a free scale, with the fit without it, which noise does not explain."""
    return GroupInliers(
        fit, fit.used, scaled.mahalanobis_sq, scaled.limit, scaled.doubtful, explained=False
    )


def _scale_of(fit: GroupFit[FixturePlacement]) -> Scale:
    value, sigma = fit.state.scale, float(np.sqrt(fit.covariance[6, 6]))
    chance = t_chance((value - 1.0) / sigma, max(fit.freedom, 1))
    # A negative scale is no drawing of another size: exchanged names fit like that.
    return Scale(value, sigma, value > 0.0 and chance < _FALSE_ALARM)


def _check_numbering(pairs: PointPairs, numbering: Numbering, agree: Collection[str]) -> None:
    """Refuses a wrong order, unless the points out of order were rejected anyway."""
    moved = [pairs.labels[at] for at in numbering.moved]
    if not numbering.is_wrong or not any(value in agree for value in moved):
        return
    more = ""
    if not numbering.is_unique:
        more = f", or one of {numbering.equally_good - 1} other orders that fit as well"
    raise DataError(
        f"fixture: as they are numbered the points fit the drawing to "
        f"{figure(1e3 * numbering.stated_rms_m)} mm, in another order to "
        f"{figure(1e3 * numbering.rms_m)} mm (root mean square): "
        f"{numbering.words(pairs.drawn_labels)}{more}.",
        culprits=moved,
        next_step="Correct the points' names.",
    )


def _no_fit(pairs: PointPairs, fit: GroupFit[FixturePlacement], scale: Scale) -> DataError:
    """Error for points that contradict the drawing too much for any frame."""
    distances = np.linalg.norm(fit.groups.residuals, axis=1)
    rms_mm, worst = 1e3 * np.sqrt(np.mean(distances**2)), int(np.argmax(distances))
    scaled = pairs.nominal[fit.used] * scale.value
    left = np.sqrt(procrustes_residual(pairs.measured[fit.used], scaled) / fit.used.sum())
    hint = f" A drawing {scale.value:.4g} times as large would fit to {figure(1e3 * left)} mm."
    return DataError(
        f"fixture: the points do not fit the drawing: they are {rms_mm:.3g} mm off (root mean "
        f"square), most of all {pairs.labels[worst]} with {1e3 * distances[worst]:.3g} mm."
        f"{hint if scale.differs else ''}",
        culprits=[pairs.labels[worst]],
        next_step="Check the drawing's coordinates, the points' names and how they were measured.",
    )


def _cause(pairs: PointPairs, fit: GroupFit[FixturePlacement]) -> str:
    noise = float(np.hypot(fit.sigma, pairs.known_noise_m))
    for points, whose in ((pairs.nominal, "drawn"), (pairs.measured, "measured")):
        extents = spreads(points[fit.used])[0]
        if extents[1] < _SLENDER * extents[0]:
            return f"{line_words(points[fit.used], whose)}, {noise_words(noise)}"
    reach = 1e3 * spreads(pairs.nominal[fit.used])[0][0]
    return f"the points reach {reach:.3g} mm from their centre (rms), {noise_words(noise)}"

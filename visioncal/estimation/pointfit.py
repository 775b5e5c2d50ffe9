"""Fixture frame from measured points: of a drawing, or of its origin, x axis and xy plane.

Each point obeys `measured = base_from_fixture * nominal`, up to its stated noise and one common
noise level, which is estimated. All three coordinates of a drawn point are stated; of a touched
feature those that are zero: x, y and z of the origin, y and z on the x axis, z in the xy plane.
There the others only matter by their side, which is positive.

The scale of a drawing is estimated separately, never absorbed. Collinear points, another unit and a
left-handed drawing are found before the fit: no selection of points would correct them.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.conventions import UNITS_M
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure, some_of
from visioncal.core.quantiles import f_limit, t_chance
from visioncal.core.transforms import compose, nearest_rotation
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.groups import GroupFit, fit_groups
from visioncal.estimation.numbering import Numbering, find_numbering, misfit_by_noise
from visioncal.estimation.observability import Direction, axis_words
from visioncal.estimation.placing import LEAST_NOISE_M, TOUCH_NOISE_M, refuse_poor, worst_of
from visioncal.estimation.points import Placement, PointProblem
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

# Ratio of squared extents below which points are collinear.
_LEAST_RATIO = 1e-8

FEWEST_POINTS = 3
FeatureKind: TypeAlias = Literal["origin", "x", "xy"]
FEATURE_KINDS: tuple[FeatureKind, ...] = ("origin", "x", "xy")
# Which of x, y, z in the fixture's frame are stated, by kind; empty for a drawn point.
_STATED = {
    "": (True, True, True),
    "origin": (True, True, True),
    "x": (False, True, True),
    "xy": (False, False, True),
}
# Most starts from one touch of each kind.
_SETS = 60
# Touches nearer to the start than this share of the farthest one's distance may be on either side,
# by noise; they do no harm.
_BEHIND = 0.1
# Relative tolerance of a ratio of lengths about that of two units: no part is off by so much.
_UNIT_TOLERANCE = 0.1
_UNITS = ("m", "mm", "cm", "inch")


@dataclass(frozen=True, eq=False)
class PointPairs:
    """Measured points and their coordinates in the fixture, n in all."""

    labels: tuple[str, ...]  # (n,) the points' names, repeated for repeated measurements.
    measured: FloatArray  # (n, 3) in the base [m].
    # (n, 3, 3) stated covariance of their noise [m^2]; zeros where none is.
    covariances: FloatArray
    nominal: FloatArray  # (n, 3) in the fixture's frame [m].
    # (n,) tolerance of the part to its drawing, per axis, as a sigma [m].
    nominal_sigma_m: FloatArray
    spare_labels: tuple[str, ...] = ()  # (k,) names of drawn points that were not measured.
    spare: FloatArray | None = None  # (k, 3) their coordinates in the fixture's frame [m].
    kinds: tuple[FeatureKind, ...] = ()  # (n,) the touched features; empty for drawn points.

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def stated(self) -> Mask:
        """(n, 3) mask of the coordinates in the fixture's frame that are stated."""
        return np.array([_STATED[kind] for kind in self.kinds or ("",) * len(self)])

    def rows(self, kind: FeatureKind) -> IntArray:
        """Rows of the touches of a kind."""
        return np.array([i for i, name in enumerate(self.kinds) if name == kind], dtype=np.int64)

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


def _check_pairs(pairs: PointPairs) -> None:
    """Refuses points that cannot determine a frame."""
    if len(pairs) < FEWEST_POINTS:
        raise DataError(
            f"fixture: {len(pairs)} measured points with coordinates in the drawing, at least "
            f"{FEWEST_POINTS} are needed.",
            culprits=list(pairs.labels),
            next_step="Measure more points, not all on one line.",
        )
    _check_finite(pairs, "point")
    for points, whose in ((pairs.nominal, "drawn"), (pairs.measured, "measured")):
        extents, axes = spreads(points)
        if extents[1] ** 2 > max(_LEAST_RATIO * extents[0] ** 2, LEAST_NOISE_M**2):
            continue
        frame = "fixture" if whose == "drawn" else "base"
        centred = points - points.mean(axis=0)
        aside = np.linalg.norm(centred - np.outer(centred @ axes[0], axes[0]), axis=1).max()
        of = f" about the {frame}'s {axis_words(axes[0])}"
        words = f"the {whose} points lie within {figure(1e3 * aside)} mm of a line"
        if extents[0] <= LEAST_NOISE_M:
            of, words = "", f"the {whose} points are all in one place"
        raise DegenerateError(
            f"fixture: the fixture's rotation{of} is not determined at all: {words}.",
            culprits=list(pairs.labels),
            next_step="Measure three points that are far apart and not on one line.",
        )
    # Typical distances do not depend on the numbering or a few outliers.
    first, second = np.triu_indices(len(pairs), 1)
    measured_m, drawn_m = (
        float(np.median(np.linalg.norm(points[first] - points[second], axis=1)))
        for points in (pairs.measured, pairs.nominal)
    )
    ratio = measured_m / drawn_m
    for read, meant in product(_UNITS, _UNITS):
        if read != meant and abs(ratio * UNITS_M[read] / UNITS_M[meant] - 1.0) < _UNIT_TOLERANCE:
            raise DataError(
                f"fixture: the measured points are {ratio:.4g} times as far apart as the drawn "
                f"ones, and should be as far: the measured ones are in {read} and were read as "
                f"{meant}, or the drawn ones are in {meant} and were read as {read}.",
                culprits=list(pairs.labels),
                next_step="Correct the unit of one of the two tables.",
            )


def _check_finite(pairs: PointPairs, thing: str) -> None:
    bad = ~np.isfinite(pairs.measured).all(axis=1) | ~np.isfinite(pairs.nominal).all(axis=1)
    if bad.any():
        names = [pairs.labels[index] for index in np.flatnonzero(bad)]
        raise DataError(
            f"fixture: {thing} {some_of(names)}: a coordinate is missing.", culprits=names
        )


def _hands(measured: FloatArray, nominal: FloatArray, noise_m: float) -> tuple[float, float, float]:
    """Squared misfits of a drawing and of its mirror image [m^2], and their ratio's limit.

    Coplanar points have no handedness: mirrored they are the same points seen from behind, with the
    frame's z axis reversed.
    """
    freedom, floor = 3.0 * len(measured) - 6.0, misfit_by_noise(len(measured), noise_m)
    return (
        float(procrustes_residual(measured, nominal)) + floor,
        float(procrustes_residual(measured, mirrored(nominal))) + floor,
        float(f_limit(_FALSE_ALARM, freedom, freedom)),
    )


def _check_hand(pairs: PointPairs, numbering: Numbering, noise_m: float) -> None:
    """Refuses points that are the mirror image of the drawing, at a stated noise [m]."""
    as_drawn, flipped, limit = _hands(pairs.measured, pairs.nominal, noise_m)
    reordered = float(procrustes_residual(pairs.measured, pairs.drawn[numbering.assignment]))
    if as_drawn <= limit * flipped or flipped > limit * (
        reordered + misfit_by_noise(len(pairs), noise_m)
    ):
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


@dataclass(frozen=True)
class Scale:
    """Scale of the measured part relative to the drawing, if left free."""

    value: float  # Measured over drawn.
    sigma: float  # Its standard deviation.
    differs: bool  # Whether it differs significantly from one.


@dataclass(frozen=True, eq=False)
class PointFit:
    """A fixture's frame from n points."""

    # The inlier points and their fit, without any scale. Its residuals are measured less stated, in
    # the fixture's frame [m], zero where nothing is stated.
    agreement: GroupInliers[Placement]

    @property
    def base_from_fixture(self) -> FloatArray:
        """(4, 4) the frame."""
        return self.agreement.fit.state.frame

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) of its right perturbation (rotation [rad], translation [m])."""
        return self.agreement.fit.covariance

    @property
    def by_points(self) -> FloatArray:
        """(n, 6, 3) Jacobian of the frame's right perturbation by each measured point."""
        fit = self.agreement.fit
        stated = fit.groups.observed[:, :, None]
        return np.asarray(fit.gains @ np.where(stated, self.base_from_fixture[:3, :3].T, 0.0))


@dataclass(frozen=True, eq=False)
class DrawingFit(PointFit):
    """A fixture's frame from n points of its drawing."""

    scale: Scale  # The scale if it were free.
    # The order in which the points fit the drawing best; repeated measurements count once, at their
    # first place.
    numbering: Numbering
    # Whether mirrored points would have been found: coplanar points leave the sign of the fixture's
    # z axis open.
    hand_known: bool


def fixture_problem(pairs: PointPairs, *, scaled: bool = False) -> PointProblem:
    """The problem of a fixture, with its scale free or held at one."""

    def closed_form(rows: IntArray) -> Placement:
        measured, nominal = pairs.measured[rows], pairs.nominal[rows]
        scale = scale_between(measured, nominal) if scaled else 1.0
        return Placement(align(measured, scale * nominal), scale=scale)

    def starts(_: PointProblem) -> Iterator[Placement]:
        if pairs.kinds:
            yield from map(Placement, _feature_frames(pairs))
            return
        yield closed_form(np.arange(len(pairs)))
        yield from map(closed_form, small_sets(len(pairs), FEWEST_POINTS))

    return PointProblem(
        pairs.nominal, pairs.stated, pairs.known, starts, pairs.measured, scaled=scaled
    )


def _feature_frames(touches: PointPairs) -> Iterator[FloatArray]:
    """Frames (4, 4) from the means of each kind, then from one touch of each."""
    points = touches.measured
    kinds = [touches.rows(kind) for kind in FEATURE_KINDS]
    yield _frame_from(*(points[rows].mean(axis=0) for rows in kinds))
    sets = np.array(list(product(*kinds)))
    if len(sets) > _SETS:
        sets = np.random.default_rng(0).choice(sets, _SETS, replace=False)
    yield from (_frame_from(*points[rows]) for rows in sets)


def _frame_from(origin: FloatArray, on_x: FloatArray, in_xy: FloatArray) -> FloatArray:
    """The (4, 4) frame of three points: on the origin, the x axis and the xy plane.

    Of collinear points it is one of the many.
    """
    x = on_x - origin
    z = np.cross(x, in_xy - origin)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    lengths = np.linalg.norm(axes, axis=0)
    return compose(nearest_rotation(axes / np.maximum(lengths, np.finfo(float).tiny)), origin)


def fit_features(touches: PointPairs, expected_noise_m: float | None = None) -> PointFit:
    """Fits a fixture's frame to touches of its features.

    Args:
        touches: At least one of each kind; see `FEATURE_KINDS`.
        expected_noise_m: Expected noise of a touch per axis, beyond its stated one [m]; None where
            unknown. One of each kind leaves no residual to estimate it from, and is taken for
            careful then.

    Returns:
        The frame with its covariance, and the inlier touches.

    Raises:
        DataError: A kind is missing, touches of one kind lie on both sides of the origin, or the
            touches contradict each other wildly.
        DegenerateError: The x axis was touched at the origin, or the plane on the x axis.
    """
    _check_kinds(touches)
    if expected_noise_m is None and len(touches) == len(FEATURE_KINDS):
        expected_noise_m = TOUCH_NOISE_M
    agreement = find_inlier_groups(fixture_problem(touches), expected_noise_m)
    fit = agreement.fit
    off, worst = _off_words(touches, fit)
    wild = DataError(
        f"fixture: the touches contradict each other: {off}.",
        culprits=[worst],
        next_step="Check their kinds and touch the worst again.",
    )
    frame = fit.state.frame
    local = (touches.measured - frame[:3, 3]) @ frame[:3, :3]
    _refuse_poor(
        touches,
        fit,
        np.zeros(3),
        wild,
        f"the x axis was touched up to {1e3 * local[touches.rows('x'), 0].max():.3g} mm from the "
        f"origin and the plane up to {1e3 * local[touches.rows('xy'), 1].max():.3g} mm from the x "
        f"axis, at a noise of {figure(1e3 * fit.sigma)} mm",
        "Touch the x axis farther from the origin and the plane farther from the x axis, or say "
        "how well the points are touched.",
    )
    return PointFit(agreement)


def _check_kinds(touches: PointPairs) -> None:
    """Refuses touches of missing kinds, and those on both sides of the origin or the x axis."""
    missing = [kind for kind in FEATURE_KINDS if kind not in touches.kinds]
    if missing:
        raise DataError(
            f"fixture: no touch of kind {some_of(missing)}: at least one of each kind, "
            f"{some_of(FEATURE_KINDS)}, is needed.",
            culprits=missing,
            next_step="Touch the fixture's origin, a point on its x axis, and a point in its xy "
            "plane on the side of positive y.",
        )
    _check_finite(touches, "touch")
    origin = touches.measured[touches.rows("origin")].mean(axis=0)
    along, aside = (touches.measured[touches.rows(kind)] - origin for kind in ("x", "xy"))
    x = along.mean(axis=0) / max(float(np.linalg.norm(along.mean(axis=0))), LEAST_NOISE_M)
    aside = aside - np.outer(aside @ x, x)
    for kind, vectors, start in (("x", along, "origin"), ("xy", aside, "x axis")):
        names = [name for name, of in zip(touches.labels, touches.kinds, strict=True) if of == kind]
        distances = np.linalg.norm(vectors, axis=1)
        farthest = int(np.argmax(distances))
        shares = vectors @ vectors[farthest] / max(float(distances[farthest]), LEAST_NOISE_M) ** 2
        behind = [name for name, share in zip(names, shares, strict=True) if share < -_BEHIND]
        if behind:
            raise DataError(
                f"fixture: the touches of kind {kind} lie on both sides of the {start}: "
                f"{some_of(behind)} on the other side than {names[farthest]}.",
                culprits=[*behind, names[farthest]],
                next_step=f"Touch only points of positive {kind[-1]}.",
            )


def fit_points(pairs: PointPairs, expected_noise_m: float | None = None) -> DrawingFit:
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
    _check_pairs(points)
    noise = float(np.hypot(pairs.known_noise_m, expected_noise_m or 0.0))
    numbering = find_numbering(points.measured, points.drawn, noise)
    _check_hand(points, numbering, noise)
    agreement, scale = _fit_inliers(pairs, expected_noise_m)
    _check_numbering(
        points, numbering, {pairs.labels[index] for index in np.flatnonzero(agreement.mask)}
    )
    fit, agrees = agreement.fit, agreement.mask
    extents = spreads(pairs.nominal[agrees])[0]
    level_m = float(np.hypot(fit.sigma, pairs.known_noise_m))
    _refuse_poor(
        pairs,
        fit,
        pairs.nominal[agrees].mean(axis=0),
        _no_fit(pairs, fit, scale),
        f"the points reach {figure(1e3 * extents[0])} mm from their centre (rms) and "
        f"{figure(1e3 * extents[1])} mm across, at a noise of {figure(1e3 * level_m)} mm",
        "Measure points that are farther apart and not nearly on one line, or measure them better.",
    )
    as_drawn, flipped, limit = _hands(pairs.measured[agrees], pairs.nominal[agrees], noise)
    return DrawingFit(agreement, scale, numbering, flipped > limit * as_drawn)


def _fit_inliers(
    pairs: PointPairs, expected_noise_m: float | None
) -> tuple[GroupInliers[Placement], Scale]:
    """Finds the inliers, without rejecting points that only a scale contradicts."""
    rigid = find_inlier_groups(fixture_problem(pairs), expected_noise_m)
    if not _is_inlier(rigid).all():
        scaled = find_inlier_groups(fixture_problem(pairs, scaled=True), expected_noise_m)
        scale = _scale_of(scaled.fit)
        if scale.differs and _is_inlier(scaled).sum() > _is_inlier(rigid).sum():
            fit = fit_groups(fixture_problem(pairs), scaled.mask)
            # Noise does not explain the fit without the scale.
            return replace(scaled, fit=fit, mask=fit.used, explained=False), scale
    return rigid, _scale_of(fit_groups(fixture_problem(pairs, scaled=True), rigid.mask))


def _is_inlier(agreement: GroupInliers[Placement]) -> Mask:
    return agreement.mask & ~agreement.doubtful


def _scale_of(fit: GroupFit[Placement]) -> Scale:
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


def _no_fit(pairs: PointPairs, fit: GroupFit[Placement], scale: Scale) -> DataError:
    """Error for points that contradict the drawing too much for any frame."""
    off, worst = _off_words(pairs, fit)
    scaled = pairs.nominal[fit.used] * scale.value
    left = np.sqrt(procrustes_residual(pairs.measured[fit.used], scaled) / fit.used.sum())
    hint = f" A drawing {scale.value:.4g} times as large would fit to {figure(1e3 * left)} mm."
    return DataError(
        f"fixture: the points do not fit the drawing: {off}.{hint if scale.differs else ''}",
        culprits=[worst],
        next_step="Check the drawing's coordinates, the points' names and how they were measured.",
    )


def _off_words(pairs: PointPairs, fit: GroupFit[Placement]) -> tuple[str, str]:
    """How far points are off, in words, and the name of the farthest."""
    distances = np.linalg.norm(fit.groups.residuals, axis=1)
    rms_mm, worst = 1e3 * np.sqrt(np.mean(distances**2)), int(np.argmax(distances))
    words = (
        f"they are {rms_mm:.3g} mm off (root mean square), most of all {pairs.labels[worst]} with "
        f"{1e3 * distances[worst]:.3g} mm"
    )
    return words, pairs.labels[worst]


def _refuse_poor(
    pairs: PointPairs,
    fit: GroupFit[Placement],
    centre: FloatArray,
    wild: DataError,
    cause: str,
    next_step: str,
) -> None:
    """Refuses a fixture whose worst directions, at a (3,) centre in it [m], are over the limits."""

    def worst(covariance: FloatArray) -> Sequence[Direction]:
        return worst_of(fit.state.frame, covariance[:6, :6], "fixture", "base", centre)

    lost = [name for name, stays in zip(pairs.labels, fit.used, strict=True) if not stays]
    verb = "does" if len(lost) == 1 else "do"
    without = f"without {some_of(lost)}, which {verb} not agree with the others, " if lost else ""
    words = f"{without}{cause}"
    refuse_poor("fixture", fit, worst, lambda _: (words, next_step), pairs.labels, wild)

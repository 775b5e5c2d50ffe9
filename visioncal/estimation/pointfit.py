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
from typing import Literal, Self, TypeAlias

import numpy as np

from visioncal.core.conventions import UNITS_M
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure, some_of
from visioncal.core.quantiles import f_limit, t_chance
from visioncal.core.transforms import compose, exp, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.groups import GroupFit, Groups, fit_groups
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.numbering import Numbering, find_numbering
from visioncal.estimation.observability import SIGMA_LIMIT_M, axis_words
from visioncal.estimation.placing import LEAST_NOISE_M, TOUCH_NOISE_M, worst_of
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
# Least determinant of axes: it is one, or zero for collinear touches.
_IS_FRAME = 0.5
# Touches nearer to the start than this share of the farthest one's distance may be on either side,
# by noise; they do no harm.
_BEHIND = 0.1
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

    @classmethod
    def of_features(
        cls,
        labels: tuple[str, ...],
        kinds: tuple[FeatureKind, ...],
        measured: FloatArray,
        covariances: FloatArray,
    ) -> Self:
        """Touches of a fixture's features."""
        count = len(labels)
        zeros = np.zeros((count, 3)), np.zeros(count)
        return cls(labels, measured, covariances, *zeros, kinds=kinds)

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
    _check_finite(pairs, "point")
    for points, whose in ((pairs.nominal, "drawn"), (pairs.measured, "measured")):
        _check_line(points, whose, pairs.labels)
    _check_units(pairs)


def _check_finite(pairs: PointPairs, thing: str) -> None:
    bad = ~np.isfinite(pairs.measured).all(axis=1) | ~np.isfinite(pairs.nominal).all(axis=1)
    if bad.any():
        names = [pairs.labels[index] for index in np.flatnonzero(bad)]
        raise DataError(
            f"fixture: {thing} {some_of(names)}: a coordinate is missing.", culprits=names
        )


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
    if extents[1] ** 2 > max(_LEAST_RATIO * extents[0] ** 2, LEAST_NOISE_M**2):
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

    # The inlier points and their fit, without any scale. Its residuals are measured less stated, in
    # the fixture's frame [m], zero where nothing is stated.
    agreement: GroupInliers[FixturePlacement]

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


@dataclass(frozen=True, eq=False)
class PointProblem:
    """Fit of a fixture to points, with its scale free or held at one."""

    pairs: PointPairs
    scaled: bool = False

    def guesses(self) -> Iterator[FixturePlacement]:
        """Closed forms from all points, and from small sets."""
        if self.pairs.kinds:
            yield from (FixturePlacement(frame, 1.0) for frame in _feature_frames(self.pairs))
            return
        yield self._closed_form(np.arange(len(self.pairs)))
        for rows in small_sets(len(self.pairs), FEWEST_POINTS):
            yield self._closed_form(rows)

    def _closed_form(self, rows: IntArray) -> FixturePlacement:
        measured, nominal = self.pairs.measured[rows], self.pairs.nominal[rows]
        scale = scale_between(measured, nominal) if self.scaled else 1.0
        return FixturePlacement(align(measured, scale * nominal), scale)

    def linearise(self, state: FixturePlacement) -> Groups:
        """Residuals (n, 3) in the fixture's frame, and their Jacobian by its step and the scale.

        A step (w, v) on the right moves a point `q` of the fixture's frame by `q x w - v`, and one
        of the scale moves the stated point p by p.
        """
        pairs, frame = self.pairs, state.base_from_fixture
        rotation, stated = frame[:3, :3], pairs.stated
        local = (pairs.measured - frame[:3, 3]) @ rotation
        columns = [skew(local), np.tile(-np.eye(3), (len(local), 1, 1))]
        if self.scaled:
            columns.append(-pairs.nominal[:, :, None])
        return Groups(
            np.where(stated, local - state.scale * pairs.nominal, 0.0),
            np.where(stated[:, :, None], np.concatenate(columns, axis=2), 0.0),
            stated,
            rotation.T @ pairs.known @ rotation,
        )

    def move(self, state: FixturePlacement, step: FloatArray) -> FixturePlacement:
        """Takes a (6,) or (7,) step on the right."""
        scale = state.scale + float(step[6]) if self.scaled else 1.0
        return FixturePlacement(state.base_from_fixture @ exp(step[:6]), scale)


def _feature_frames(touches: PointPairs) -> Iterator[FloatArray]:
    """Frames (4, 4) from the means of each kind, then from one touch of each."""
    points = touches.measured
    kinds = [touches.rows(kind) for kind in FEATURE_KINDS]
    yield _frame_from(*(points[rows].mean(axis=0) for rows in kinds))
    sets = np.array(list(product(*kinds)))
    if len(sets) > _SETS:
        sets = np.random.default_rng(0).choice(sets, _SETS, replace=False)
    frames = (_frame_from(*points[rows]) for rows in sets)
    # Collinear touches determine no frame, and no other touch would contradict it.
    yield from (frame for frame in frames if np.linalg.det(frame[:3, :3]) > _IS_FRAME)


def _frame_from(origin: FloatArray, on_x: FloatArray, in_xy: FloatArray) -> FloatArray:
    """The (4, 4) frame of three points: on the origin, the x axis and the xy plane."""
    # For collinear points axes are zero, and so is the determinant.
    x = on_x - origin
    x = x / max(float(np.linalg.norm(x)), np.finfo(float).tiny)
    z = np.cross(x, in_xy - origin)
    z = z / max(float(np.linalg.norm(z)), np.finfo(float).tiny)
    return compose(np.stack([x, np.cross(z, x), z], axis=1), origin)


def fit_features(touches: PointPairs, expected_noise_m: float | None = None) -> PointFit:
    """Fits a fixture's frame to touches of its features.

    Args:
        touches: At least one of each kind; see `PointPairs.of_features`.
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
    _check_sides(touches)
    if expected_noise_m is None and len(touches) == len(FEATURE_KINDS):
        expected_noise_m = TOUCH_NOISE_M
    agreement = find_inlier_groups(PointProblem(touches), expected_noise_m)
    fit = agreement.fit
    off, worst = _off_words(touches, fit)
    wild = DataError(
        f"fixture: the touches contradict each other: {off}.",
        culprits=[worst],
        next_step="Check their kinds and touch the worst again.",
    )
    frame = fit.state.base_from_fixture
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


def _check_sides(touches: PointPairs) -> None:
    """Refuses touches that do not determine the axes: too near, or on both sides."""
    origin = touches.measured[touches.rows("origin")].mean(axis=0)
    along = touches.measured[touches.rows("x")] - origin
    _check_one_side(touches, "x", along, "origin", LEAST_NOISE_M)
    x = along.mean(axis=0) / np.linalg.norm(along.mean(axis=0))
    aside = touches.measured[touches.rows("xy")] - origin
    reach = max(float(np.linalg.norm(aside, axis=1).max()), float(np.linalg.norm(along[0])))
    aside = aside - np.outer(aside @ x, x)
    least = max(LEAST_NOISE_M, float(np.sqrt(_LEAST_RATIO)) * reach)
    _check_one_side(touches, "xy", aside, "x axis", least)


def _check_one_side(
    touches: PointPairs, kind: FeatureKind, vectors: FloatArray, start: str, least_m: float
) -> None:
    """Checks (k, 3) vectors from the origin, or from the x axis, to the touches of a kind."""
    names = [touches.labels[at] for at in touches.rows(kind)]
    distances = np.linalg.norm(vectors, axis=1)
    farthest = int(np.argmax(distances))
    if distances[farthest] <= least_m:
        axes = "y and z axes" if kind == "x" else "x axis"
        raise DegenerateError(
            f"fixture: the fixture's rotation about its {axes} is not determined at all: touch "
            f"{some_of(names)} of kind {kind} is {figure(1e3 * distances[farthest])} mm from the "
            f"{start}.",
            culprits=names,
            next_step=f"Touch a point far from the {start}.",
        )
    shares = vectors @ vectors[farthest] / distances[farthest] ** 2
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
    check_pairs(points)
    noise = float(np.hypot(pairs.known_noise_m, expected_noise_m or 0.0))
    numbering = find_numbering(points.measured, points.drawn, noise)
    check_hand(points, numbering, noise)
    agreement, scale = _fit_inliers(pairs, expected_noise_m)
    _check_numbering(
        points, numbering, {pairs.labels[index] for index in np.flatnonzero(agreement.mask)}
    )
    fit, agrees = agreement.fit, agreement.mask
    _refuse_poor(
        pairs,
        fit,
        pairs.nominal[agrees].mean(axis=0),
        _no_fit(pairs, fit, scale),
        _cause(pairs, fit),
        "Measure points that are farther apart and not nearly on one line, or measure them better.",
    )
    hand_known = determines_hand(pairs.measured[agrees], pairs.nominal[agrees], noise)
    return DrawingFit(agreement, scale, numbering, hand_known)


def _fit_inliers(
    pairs: PointPairs, expected_noise_m: float | None
) -> tuple[GroupInliers[FixturePlacement], Scale]:
    """Finds the inliers, without rejecting points that only a scale contradicts."""
    rigid = find_inlier_groups(PointProblem(pairs), expected_noise_m)
    if not _is_inlier(rigid).all():
        scaled = find_inlier_groups(PointProblem(pairs, scaled=True), expected_noise_m)
        scale = _scale_of(scaled.fit)
        if scale.differs and _is_inlier(scaled).sum() > _is_inlier(rigid).sum():
            fit = fit_groups(PointProblem(pairs), scaled.mask)
            # Noise does not explain the fit without the scale.
            return replace(scaled, fit=fit, mask=fit.used, explained=False), scale
    return rigid, _scale_of(fit_groups(PointProblem(pairs, scaled=True), rigid.mask))


def _is_inlier(agreement: GroupInliers[FixturePlacement]) -> Mask:
    return agreement.mask & ~agreement.doubtful


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
    off, worst = _off_words(pairs, fit)
    scaled = pairs.nominal[fit.used] * scale.value
    left = np.sqrt(procrustes_residual(pairs.measured[fit.used], scaled) / fit.used.sum())
    hint = f" A drawing {scale.value:.4g} times as large would fit to {figure(1e3 * left)} mm."
    return DataError(
        f"fixture: the points do not fit the drawing: {off}.{hint if scale.differs else ''}",
        culprits=[worst],
        next_step="Check the drawing's coordinates, the points' names and how they were measured.",
    )


def _off_words(pairs: PointPairs, fit: GroupFit[FixturePlacement]) -> tuple[str, str]:
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
    fit: GroupFit[FixturePlacement],
    centre: FloatArray,
    wild: DataError,
    cause: str,
    next_step: str,
) -> None:
    """Refuses a fixture whose worst directions are over their limits.

    Wild disagreement of points is no fault of the geometry: it is judged by a noise of at most the
    limit, and at least of a micrometre; beyond, the error is `wild`. The offset is that of a (3,)
    centre in the fixture [m].
    """
    level = min(max(fit.sigma, LEAST_NOISE_M), SIGMA_LIMIT_M)
    covariance = covariance_from(fit.groups.subset(fit.used).information(level))[:6, :6]
    worst = worst_of(fit.state.base_from_fixture, covariance, "fixture", "base", centre)
    beyond = [direction for direction in worst if direction.sigma > direction.limit]
    if not beyond:
        return
    if fit.sigma > SIGMA_LIMIT_M:
        raise wild
    lost = [name for name, stays in zip(pairs.labels, fit.used, strict=True) if not stays]
    verb = "does" if len(lost) == 1 else "do"
    without = f"without {some_of(lost)}, which {verb} not agree with the others, " if lost else ""
    raise DegenerateError(
        f"fixture: {beyond[0].words} has a predicted sigma of {beyond[0].figure}: "
        f"{without}{cause}.",
        culprits=[*(direction.words for direction in beyond), *pairs.labels],
        next_step=next_step,
    )


def _cause(pairs: PointPairs, fit: GroupFit[FixturePlacement]) -> str:
    noise = f"at a noise of {figure(1e3 * float(np.hypot(fit.sigma, pairs.known_noise_m)))} mm"
    for points, whose in ((pairs.nominal, "drawn"), (pairs.measured, "measured")):
        extents = spreads(points[fit.used])[0]
        if extents[1] < _SLENDER * extents[0]:
            return f"{line_words(points[fit.used], whose)}, {noise}"
    reach = 1e3 * spreads(pairs.nominal[fit.used])[0][0]
    return f"the points reach {reach:.3g} mm from their centre (rms), {noise}"

"""Fixture frame from measured points: of a drawing, or of its origin, x axis and xy plane.

Each point obeys `measured = base_from_fixture * nominal`, up to its stated noise and one common
noise level, which is estimated. All three coordinates of a drawn point are stated; of a touched
feature those that are zero: x, y and z of the origin, y and z on the x axis, z in the xy plane.
There the others only matter by their side, which is positive.

The scale of a drawing is estimated separately, never absorbed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import figure, some_of
from visioncal.core.quantiles import FALSE_REJECTION, t_chance
from visioncal.core.transforms import compose, nearest_rotation
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.observability import Direction
from visioncal.estimation.placing import TOUCH_NOISE_M, check_sides, refuse_poor, worst_of
from visioncal.estimation.points import FEWEST_POINTS, GroupFit, Placement, PointProblem, fit_groups
from visioncal.estimation.procrustes import align, spreads
from visioncal.estimation.robust import SETS, small_sets

FeatureKind: TypeAlias = Literal["origin", "x", "xy"]
FEATURE_KINDS: tuple[FeatureKind, ...] = ("origin", "x", "xy")
# Those of x, y, z in the fixture's frame that are stated, by kind; empty for a drawn point.
_STATED = {
    "": (True, True, True),
    "origin": (True, True, True),
    "x": (False, True, True),
    "xy": (False, False, True),
}


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

    @property
    def known(self) -> FloatArray:
        """(n, 3, 3) stated covariance of each point, measured and drawn together [m^2].

        A part's deviation from its drawing is isotropic, so that its rotation does not matter.
        """
        return np.asarray(
            self.covariances + self.nominal_sigma_m[:, None, None] ** 2 * np.eye(3), dtype=float
        )


@dataclass(frozen=True)
class Scale:
    """Scale of the measured part relative to the drawing, if left free."""

    value: float  # Measured over drawn.
    sigma: float  # Its standard deviation.
    differs: bool  # Whether it differs significantly from one.


@dataclass(frozen=True, eq=False)
class DrawingFit:
    """A fixture's frame from n points of its drawing."""

    agreement: GroupInliers  # The inlier points and their fit, without any scale.
    scale: Scale  # The scale if it were free.
    # Whether the points lie in one plane: a mirrored drawing would fit them as well.
    is_flat: bool


def fixture_problem(pairs: PointPairs, *, scaled: bool = False) -> PointProblem:
    """The problem of a fixture, with its scale free or held at one."""

    def closed_form(rows: IntArray) -> Placement:
        return Placement(align(pairs.measured[rows], pairs.nominal[rows]))

    def starts() -> Iterator[Placement]:
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
    if len(sets) > SETS:
        sets = np.random.default_rng(0).choice(sets, SETS, replace=False)
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


def fit_features(touches: PointPairs, expected_noise_m: float | None = None) -> GroupInliers:
    """Fits a fixture's frame to touches of its features.

    Args:
        touches: At least one of each kind; see `FEATURE_KINDS`.
        expected_noise_m: Expected noise of a touch per axis, beyond its stated one [m]; None where
            unknown. One of each kind leaves no residual to estimate it from, and is taken for
            careful then.

    Returns:
        The inlier touches, and their fit.

    Raises:
        DataError: A kind is missing, touches of one kind lie on both sides, or the touches
            contradict each other wildly.
        DegenerateError: The x axis was touched at the origin, or the plane on the x axis.
    """
    missing = [kind for kind in FEATURE_KINDS if kind not in touches.kinds]
    if missing:
        raise DataError(
            f"fixture: no touch of kind {some_of(missing)}: it takes at least one of each "
            f"kind, {some_of(FEATURE_KINDS)}.",
            culprits=missing,
            next_step="Touch the fixture's origin, a point on its x axis, and a point in its xy "
            "plane on the side of positive y.",
        )
    if expected_noise_m is None and len(touches) == len(FEATURE_KINDS):
        expected_noise_m = TOUCH_NOISE_M
    problem = fixture_problem(touches)
    agreement = find_inlier_groups(problem, expected_noise_m)
    fit = agreement.fit
    local = problem.local(fit.state)
    reaches = local[touches.rows("x"), 0].max(), local[touches.rows("xy"), 1].max()
    reach_mm = 1e3 * np.maximum(reaches, 0.0).round(9)
    _refuse_poor(
        touches,
        fit,
        np.zeros(3),
        f"the x axis was touched up to {figure(reach_mm[0])} mm from the origin and the plane up "
        f"to {figure(reach_mm[1])} mm from the x axis, at a noise of {figure(1e3 * fit.sigma)} mm",
        "Touch the x axis farther from the origin and the plane farther from the x axis, or say "
        "how well the points are touched.",
    )
    along = {"x": local[:, 0], "xy": local[:, 1]}
    check_sides("fixture", touches.labels, touches.kinds, agreement.mask, along)
    return agreement


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
        DataError: Too few points, or points that do not fit the drawing at all.
        DegenerateError: The points are collinear, or nearly so.
    """
    names = tuple(dict.fromkeys(pairs.labels))
    if len(names) < FEWEST_POINTS:
        raise DataError(
            f"fixture: {len(names)} measured points with coordinates in the drawing, but it "
            f"takes at least {FEWEST_POINTS}.",
            culprits=names,
            next_step="Measure more points, not all on one line.",
        )
    agreement, scale = _fit_inliers(pairs, expected_noise_m)
    fit, agrees = agreement.fit, agreement.mask
    extents = spreads(pairs.nominal[agrees])[0]
    # Beside the stated noise of a coordinate, root mean square over all.
    stated_m = np.sqrt(np.trace(pairs.known, axis1=1, axis2=2).mean() / 3.0)
    level_m = float(np.hypot(fit.sigma, stated_m))
    _refuse_poor(
        pairs,
        fit,
        pairs.nominal[agrees].mean(axis=0),
        f"the points reach {figure(1e3 * extents[0])} mm from their centre (rms) and "
        f"{figure(1e3 * extents[1])} mm across, at a noise of {figure(1e3 * level_m)} mm",
        "Measure points that are farther apart and not nearly on one line, or measure them better.",
        f" The part is {scale.value:.4g} times as large as drawn." if scale.differs else "",
    )
    # Points within five sigmas of a plane lie in it.
    return DrawingFit(agreement, scale, float(extents[2]) < 5.0 * level_m)


@dataclass(frozen=True)
class Mistake:
    """A mistake that makes all points agree with their drawing."""

    # Pairs of points, of which one has its names exchanged; an empty pair: the drawing is mirrored.
    exchanged: tuple[tuple[str, ...], ...]
    rms_m: float  # How far off the points then are, root mean square [m].
    declared_m: float  # The same as they are named and drawn [m].


def mistake_of(pairs: PointPairs) -> Mistake | None:
    """Two exchanged names, or a mirrored drawing; None where none of these makes all agree.

    Any mirror image of a drawing is any other one, turned. Symmetric points leave several open.
    """

    def off_m(nominal: FloatArray) -> FloatArray:
        frame = align(pairs.measured, nominal)
        off = pairs.measured - nominal @ frame[:3, :3].T - frame[:3, 3]
        return np.asarray(np.linalg.norm(off, axis=1))

    def rms_m(nominal: FloatArray) -> float:
        return float(np.sqrt(np.mean(off_m(nominal) ** 2)))

    declared_m, labels = rms_m(pairs.nominal), np.array(pairs.labels)
    tried: dict[tuple[str, ...], float] = {(): rms_m(pairs.nominal * [1.0, 1.0, -1.0])}
    # Of many points, the two are among those that are off most.
    worst = dict.fromkeys(labels[np.argsort(-off_m(pairs.nominal), kind="stable")].tolist())
    for names in combinations(sorted([*worst][:12]), 2):
        first, second = (labels == name for name in names)
        nominal = pairs.nominal.copy()
        nominal[first], nominal[second] = pairs.nominal[second][0], pairs.nominal[first][0]
        tried[names] = rms_m(nominal)
    least_m = min(tried.values())
    if not CLEAR_RATIO * least_m < declared_m:
        return None
    rivals = tuple(names for names, off_m in tried.items() if off_m < CLEAR_RATIO * least_m)
    return Mistake(rivals, least_m, declared_m)


def _fit_inliers(pairs: PointPairs, expected_noise_m: float | None) -> tuple[GroupInliers, Scale]:
    """Finds the inliers, without rejecting points that only a scale contradicts."""
    rigid = find_inlier_groups(fixture_problem(pairs), expected_noise_m)
    if not _is_inlier(rigid).all():
        scaled = find_inlier_groups(fixture_problem(pairs, scaled=True), expected_noise_m)
        scale = _scale_of(scaled.fit)
        if scale.differs and _is_inlier(scaled).sum() > _is_inlier(rigid).sum():
            fit = fit_groups(fixture_problem(pairs), scaled.mask)
            # Noise does not explain the fit without the scale.
            return replace(scaled, fit=fit, explained=False), scale
    return rigid, _scale_of(fit_groups(fixture_problem(pairs, scaled=True), rigid.mask))


def _is_inlier(agreement: GroupInliers) -> Mask:
    return agreement.mask & ~agreement.doubtful


def _scale_of(fit: GroupFit) -> Scale:
    value, sigma = fit.state.scale, float(np.sqrt(fit.covariance[6, 6]))
    chance = t_chance((value - 1.0) / sigma, max(fit.freedom, 1))
    # A negative scale is no drawing of another size: exchanged names fit like that.
    return Scale(value, sigma, value > 0.0 and chance < FALSE_REJECTION)


def _refuse_poor(
    pairs: PointPairs, fit: GroupFit, centre: FloatArray, cause: str, next_step: str, hint: str = ""
) -> None:
    """Refuses a fixture whose worst directions, at a (3,) centre in it [m], are over the limits."""

    def worst(covariance: FloatArray) -> Sequence[Direction]:
        return worst_of(fit.state.frame, covariance[:6, :6], "fixture", "base", centre)

    off_m = np.linalg.norm(fit.groups.residuals, axis=1)
    farthest = int(np.argmax(off_m))
    fault = "touches contradict each other" if pairs.kinds else "points do not fit the drawing"
    wild = DataError(
        f"fixture: the {fault}: they are {1e3 * np.sqrt(np.mean(off_m**2)):.3g} mm off (root mean "
        f"square), most of all {pairs.labels[farthest]} with {1e3 * off_m[farthest]:.3g} mm.{hint}",
        culprits=[pairs.labels[farthest]],
        next_step="Check the points' names or kinds (are two exchanged?), the drawing's numbers, "
        "signs and units, and how they were measured.",
    )
    lost = [name for name, stays in zip(pairs.labels, fit.used, strict=True) if not stays]
    without = f"without {some_of(lost)}, off the others, " if lost else ""
    refuse_poor(
        "fixture", fit, worst, lambda _: (f"{without}{cause}", next_step), pairs.labels, wild
    )

"""Fixture frame from measured points: of a drawing, or of its origin, x axis and xy plane.

Each point obeys `measured = base_from_fixture * nominal`, up to its stated noise and one common
noise level, which is estimated. All three coordinates of a drawn point are stated; of a touched
feature those that are zero: x, y and z of the origin, y and z on the x axis, z in the xy plane.
There the others only matter by their side, which is positive.

The scale of a drawing is estimated separately, never absorbed.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import Literal, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from visioncal.core.directions import Direction
from visioncal.core.errors import DataError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import figure, some_of
from visioncal.core.procrustes import align, spreads
from visioncal.core.quantiles import FALSE_REJECTION, t_chance
from visioncal.core.robust import SETS, small_sets
from visioncal.core.transforms import apply, compose, nearest_rotation
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.points import FEWEST_POINTS, GroupFit, Placement, PointProblem, fit_groups
from visioncal.frames.group_outliers import GroupInliers, find_inlier_groups
from visioncal.frames.placing import (
    TOUCH_NOISE_M,
    check_sides,
    refuse_exchanged_kinds,
    refuse_poor,
    worst_of,
)

FeatureKind: TypeAlias = Literal["origin", "x", "xy"]
FEATURE_KINDS: tuple[FeatureKind, ...] = ("origin", "x", "xy")
# Names that are tried in all pairs, and in any order.
_MOST_NAMES = 12
# Units of a drawing in place of those that it has, by the ratio of the part to it.
_UNITS = {
    25.4: "inches read as millimetres (--cad-unit inch)",
    1 / 25.4: "millimetres read as inches (--cad-unit mm)",
    1e3: "metres read as millimetres (--cad-unit m)",
    1e-3: "millimetres read as metres (--cad-unit mm)",
    10.0: "centimetres read as millimetres (--cad-unit cm)",
}
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
    refuse_exchanged_kinds(
        "fixture",
        touches.labels,
        touches.kinds,
        lambda kinds: fit_groups(fixture_problem(replace(touches, kinds=kinds))),
    )
    local = problem.local(fit.state)
    reaches = local[touches.rows("x"), 0].max(), local[touches.rows("xy"), 1].max()
    reach_mm = 1e3 * np.maximum(reaches, 0.0).round(9)
    rows = zip(touches.labels, agreement.doubtful, strict=True)
    doubtful = some_of([label for label, is_doubtful in rows if is_doubtful])
    words = f", as touches {doubtful} contradict each other" if doubtful else ""
    farther = "touch the x axis farther from the origin and the plane farther from the x axis"
    _refuse_poor(
        touches,
        fit,
        np.zeros(3),
        f"the x axis was touched up to {figure(reach_mm[0])} mm from the origin and the plane up "
        f"to {figure(reach_mm[1])} mm from the x axis, at a noise of {figure(1e3 * fit.sigma)} mm"
        f"{words}",
        f"Touch {doubtful} again, and see to their kinds; or {farther}."
        if doubtful
        else f"T{farther[1:]}, or say how well the points are touched.",
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
        f" The part is {scale.value:.4g} times as large as drawn{_unit_words(scale.value)}."
        if scale.differs
        else "",
    )
    # Points within five sigmas of a plane lie in it.
    return DrawingFit(agreement, scale, float(extents[2]) < 5.0 * level_m)


def _unit_words(ratio: float) -> str:
    """The units whose ratio it is, to a percent, after a comma; else empty."""
    near = (words for value, words in _UNITS.items() if abs(np.log(ratio / value)) < 0.01)
    return f", as with {words}" if (words := next(near, "")) else ""


@dataclass(frozen=True)
class Mistake:
    """A mistake that makes all points agree with their drawing."""

    # Rivals: the drawing's name of each point that has another; none: the drawing is mirrored.
    renamed: tuple[Mapping[str, str], ...]
    rms_m: float  # How far off the points then are, root mean square [m].
    declared_m: float  # The same as they are named and drawn [m].


def mistake_of(pairs: PointPairs) -> Mistake | None:
    """Wrong names, or a mirrored drawing; None where none of these makes all points agree.

    Any mirror image of a drawing is any other one, turned. Symmetric points leave several open.
    Where no two exchanged names do it, any order of up to a dozen is sought.
    """
    labels = np.array(pairs.labels)
    drawn = dict(zip(pairs.labels, pairs.nominal, strict=True))

    def off_m(nominal: FloatArray) -> FloatArray:
        frame = align(pairs.measured, nominal)
        off = pairs.measured - nominal @ frame[:3, :3].T - frame[:3, 3]
        return np.asarray(np.linalg.norm(off, axis=1))

    def rms_m(renamed: Mapping[str, str], sign: float = 1.0) -> float:
        nominal = np.array([drawn[renamed.get(name, name)] for name in pairs.labels])
        return float(np.sqrt(np.mean(off_m(nominal * [1.0, 1.0, sign]) ** 2)))

    declared_m = rms_m({})
    # Of many points, the two are among those that are off most.
    worst = [*dict.fromkeys(labels[np.argsort(-off_m(pairs.nominal), kind="stable")].tolist())]
    tried: list[tuple[Mapping[str, str], float]] = [({}, rms_m({}, -1.0))]
    exchanged = ({a: b, b: a} for a, b in combinations(sorted(worst[:_MOST_NAMES]), 2))
    tried += [(renamed, rms_m(renamed)) for renamed in exchanged]
    is_pair = CLEAR_RATIO * min(off for _, off in tried) < declared_m
    if not is_pair and FEWEST_POINTS < len(worst) <= _MOST_NAMES:
        tried = [(renamed, rms_m(renamed)) for renamed in _orders(pairs, sorted(worst))]
    least_m = min((off for _, off in tried), default=np.inf)
    if not CLEAR_RATIO * least_m < declared_m:
        return None
    rivals = [renamed for renamed, off in tried if off < CLEAR_RATIO * least_m]
    # Turned onto itself, a symmetric pattern has others, of more names.
    fewest = min(len(renamed) for renamed in rivals) or 2
    rivals = [renamed for renamed in rivals if len(renamed) in (0, fewest)]
    return Mistake(tuple(rivals), least_m, declared_m)


def _orders(pairs: PointPairs, names: Sequence[str]) -> list[dict[str, str]]:
    """The drawing's names of points that have other ones, by where all of them lie.

    Three of them that are far apart have the sides of three of the drawing, and so a frame, in
    which each point has the name of its place.
    """
    labels = np.array(pairs.labels)
    measured, drawn = (
        np.array([points[labels == name].mean(axis=0) for name in names])
        for points in (pairs.measured, pairs.nominal)
    )
    triples = np.array([*permutations(range(len(names)), 3)], dtype=np.int64).reshape(-1, 3)

    def sides(points: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(points - np.roll(points, 1, axis=-2), axis=-1))

    three = triples[int(np.argmax(sides(measured[triples]).min(axis=1)))]
    apart = np.abs(sides(drawn[triples]) - sides(measured[three])).max(axis=1)
    # Frames by three points that are tried.
    nearest = triples[np.argsort(apart, kind="stable")[:40]]
    frames = align(measured[three], drawn[nearest])
    places = apply(frames, drawn)
    off_m = np.linalg.norm(measured[:, None] - places[:, None, :, :], axis=-1)
    orders = {tuple(linear_sum_assignment(each**2)[1].tolist()) for each in off_m}
    return [
        {name: names[at] for name, at in zip(names, order, strict=True) if names[at] != name}
        for order in sorted(orders)
    ]


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

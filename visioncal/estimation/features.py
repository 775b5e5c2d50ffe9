"""Fixture frame from touches of its origin, its x axis and its xy plane.

In the fixture's frame a touch of the origin has three residuals, one of the x axis its y and z, one
of the xy plane its z. Its position along the axis or in the plane only matters by its side: x and y
are positive there. Any number of each are fitted together.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure, some_of
from visioncal.core.transforms import compose, exp, skew
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.group_outliers import GroupInliers, find_inlier_groups
from visioncal.estimation.groups import GroupFit, Groups
from visioncal.estimation.observability import SIGMA_LIMIT_M, Direction
from visioncal.estimation.placing import (
    LEAST_NOISE_M,
    LEAST_RATIO,
    left_out_words,
    noise_words,
    refuse_poor,
    worst_directions,
)

FeatureKind: TypeAlias = Literal["origin", "x", "xy"]
# Which of x, y, z in the fixture's frame are zero at a touch of each kind.
_ZEROS: Mapping[str, tuple[bool, bool, bool]] = MappingProxyType(
    {"origin": (True, True, True), "x": (False, True, True), "xy": (False, False, True)}
)
FEATURE_KINDS: tuple[FeatureKind, ...] = ("origin", "x", "xy")
# Most starts from one touch of each kind.
_SETS = 60
# Least determinant of axes: it is one, or zero for collinear touches.
_IS_FRAME = 0.5
# Touches nearer to the start than this share of the farthest one's distance may be on either side,
# by noise; they do no harm.
_BEHIND = 0.1


@dataclass(frozen=True, eq=False)
class FeatureTouches:
    """Touched points of a fixture's features, n in all."""

    labels: tuple[str, ...]  # (n,) the touches' names.
    kinds: tuple[FeatureKind, ...]  # (n,) the touched features.
    points: FloatArray  # (n, 3) in the base [m].
    # (n, 3, 3) stated covariance of their noise [m^2]; zeros where none is.
    covariances: FloatArray

    def __len__(self) -> int:
        return len(self.labels)

    def rows(self, kind: FeatureKind) -> IntArray:
        """Rows of the touches of a kind."""
        return np.array([i for i, name in enumerate(self.kinds) if name == kind], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class FeatureFit:
    """A fixture's frame from n touches of its features."""

    # The inlier touches, and their fit. Its residuals are in the fixture's frame [m], zero where a
    # coordinate is unconstrained.
    agreement: GroupInliers[FloatArray]
    # Noise of a touch per axis, beyond its stated one [m]: estimated where there are redundant
    # touches, else the expected one, else zero where each touch's own is stated; None where nothing
    # determines it.
    noise_m: float | None
    # The least certain offset, and the least certain rotation. Where nothing determines the noise
    # they are those of a careful touch.
    worst: tuple[Direction, Direction]

    @property
    def base_from_fixture(self) -> FloatArray:
        """(4, 4) the frame."""
        return self.agreement.fit.state

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) of the frame's right perturbation (rotation [rad], translation [m]).

        None where nothing determines the noise.
        """
        return None if self.noise_m is None else self.agreement.fit.covariance

    @property
    def by_points(self) -> FloatArray:
        """(n, 6, 3) Jacobian of the frame's right perturbation by each touched point."""
        fit = self.agreement.fit
        observed = np.where(fit.groups.observed[:, :, None], fit.state[:3, :3].T, 0.0)
        return np.asarray(fit.gains @ observed)


@dataclass(frozen=True, eq=False)
class FeatureProblem:
    """Touches of features; the unknown is (4, 4) `base_from_fixture`."""

    touches: FeatureTouches

    def guesses(self) -> Iterator[FloatArray]:
        """The frame from the means of each kind, then from one touch of each."""
        points = self.touches.points
        kinds = [self.touches.rows(kind) for kind in FEATURE_KINDS]
        yield _frame_from(*(points[rows].mean(axis=0) for rows in kinds))
        sets = np.array(list(product(*kinds)))
        if len(sets) > _SETS:
            sets = np.random.default_rng(0).choice(sets, _SETS, replace=False)
        frames = (_frame_from(*points[rows]) for rows in sets)
        # Collinear touches determine no frame, and no other touch would contradict it.
        yield from (frame for frame in frames if np.linalg.det(frame[:3, :3]) > _IS_FRAME)

    def linearise(self, state: FloatArray) -> Groups:
        """Residuals (n, 3) in the fixture's frame, and their Jacobian by its perturbation.

        A step (w, v) on the right moves a point `q` of the fixture's frame by `q x w - v`.
        """
        touches, rotation = self.touches, state[:3, :3]
        local = (touches.points - state[:3, 3]) @ rotation
        zero = np.array([_ZEROS[kind] for kind in touches.kinds])
        jacobian = np.concatenate([skew(local), np.tile(-np.eye(3), (len(local), 1, 1))], axis=2)
        return Groups(
            np.where(zero, local, 0.0),
            np.where(zero[:, :, None], jacobian, 0.0),
            zero,
            rotation.T @ touches.covariances @ rotation,
        )

    def move(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """Takes a (6,) step on the right."""
        return state @ exp(step)


def _frame_from(origin: FloatArray, on_x: FloatArray, in_xy: FloatArray) -> FloatArray:
    """The (4, 4) frame of three points: on the origin, the x axis and the xy plane."""
    # For collinear points axes are zero, and so is the determinant.
    x = on_x - origin
    x = x / max(float(np.linalg.norm(x)), np.finfo(float).tiny)
    z = np.cross(x, in_xy - origin)
    z = z / max(float(np.linalg.norm(z)), np.finfo(float).tiny)
    return compose(np.stack([x, np.cross(z, x), z], axis=1), origin)


def fit_features(touches: FeatureTouches, expected_noise_m: float | None = None) -> FeatureFit:
    """Fits a fixture's frame to touches of its features.

    Args:
        touches: At least one of each kind.
        expected_noise_m: Expected noise of a touch per axis, beyond its stated one [m]; None where
            unknown.

    Returns:
        The frame with its covariance, and the inlier touches.

    Raises:
        DataError: A kind is missing, touches of one kind lie on both sides of the origin, or the
            touches contradict each other wildly.
        DegenerateError: The x axis was touched at the origin, or the plane on the x axis.
    """
    _check_kinds(touches)
    _check_sides(touches)
    agreement = find_inlier_groups(FeatureProblem(touches), expected_noise_m)
    fit = agreement.fit
    noise_m = _noise_of(touches, fit, expected_noise_m)
    worst = worst_directions(fit, fit.state, np.zeros(3), noise_m)
    if fit.sigma > SIGMA_LIMIT_M and any(direction.sigma > direction.limit for direction in worst):
        raise _contradiction(touches, fit)
    refuse_poor(
        worst,
        left_out_words(touches.labels, fit.used) + _cause(touches, fit, noise_m),
        touches.labels,
        "Touch the x axis farther from the origin and the plane farther from the x axis, or say "
        "how well the points are touched.",
    )
    return FeatureFit(agreement, noise_m, worst)


def _noise_of(
    touches: FeatureTouches, fit: GroupFit[FloatArray], expected_noise_m: float | None
) -> float | None:
    if fit.freedom > 0:
        return fit.sigma
    if expected_noise_m is not None:
        return expected_noise_m
    stated = np.trace(touches.covariances[fit.used], axis1=1, axis2=2)
    return 0.0 if np.all(stated > 0.0) else None


def _check_kinds(touches: FeatureTouches) -> None:
    missing = [kind for kind in FEATURE_KINDS if kind not in touches.kinds]
    if missing:
        raise DataError(
            f"fixture: no touch of kind {some_of(missing)}: at least one of each kind, "
            f"{some_of(FEATURE_KINDS)}, is needed.",
            culprits=missing,
            next_step="Touch the fixture's origin, a point on its x axis, and a point in its xy "
            "plane on the side of positive y.",
        )
    bad = np.flatnonzero(~np.isfinite(touches.points).all(axis=1))
    if len(bad):
        names = [touches.labels[at] for at in bad]
        raise DataError(
            f"fixture: touch {some_of(names)}: a coordinate is missing.", culprits=names
        )


def _check_sides(touches: FeatureTouches) -> None:
    """Refuses touches that do not determine the axes: too near, or on both sides."""
    origin = touches.points[touches.rows("origin")].mean(axis=0)
    along = touches.points[touches.rows("x")] - origin
    _check_one_side(touches, "x", along, "origin", LEAST_NOISE_M)
    x = along.mean(axis=0) / np.linalg.norm(along.mean(axis=0))
    aside = touches.points[touches.rows("xy")] - origin
    reach = max(float(np.linalg.norm(aside, axis=1).max()), float(np.linalg.norm(along[0])))
    aside = aside - np.outer(aside @ x, x)
    least = max(LEAST_NOISE_M, float(np.sqrt(LEAST_RATIO)) * reach)
    _check_one_side(touches, "xy", aside, "x axis", least)


def _check_one_side(
    touches: FeatureTouches, kind: FeatureKind, vectors: FloatArray, start: str, least_m: float
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


def _contradiction(touches: FeatureTouches, fit: GroupFit[FloatArray]) -> DataError:
    distances = np.linalg.norm(fit.groups.residuals, axis=1)
    rms_mm, worst = 1e3 * np.sqrt(np.mean(distances**2)), int(np.argmax(distances))
    return DataError(
        f"fixture: the touches contradict each other: they are {rms_mm:.3g} mm off (root mean "
        f"square), most of all {touches.labels[worst]} with {1e3 * distances[worst]:.3g} mm.",
        culprits=[touches.labels[worst]],
        next_step="Check their kinds and touch the worst again.",
    )


def _cause(touches: FeatureTouches, fit: GroupFit[FloatArray], noise_m: float | None) -> str:
    local = (touches.points - fit.state[:3, 3]) @ fit.state[:3, :3]
    on_x, in_xy = touches.rows("x"), touches.rows("xy")
    return (
        f"the x axis was touched up to {1e3 * local[on_x, 0].max():.3g} mm from the origin and the "
        f"plane up to {1e3 * local[in_xy, 1].max():.3g} mm from the x axis, {noise_words(noise_m)}"
    )

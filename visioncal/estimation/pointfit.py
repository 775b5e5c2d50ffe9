"""A fixture's frame from measured points and the drawing's coordinates of the same points.

Each point says `measured = base_from_fixture * nominal`, up to the noise that is known of it and
one level of noise that is common to all and estimated. Scale is estimated beside, never absorbed.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.quantiles import t_chance
from visioncal.core.transforms import exp, skew
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.group_outliers import GroupInliers, agreeing_groups
from visioncal.estimation.groups import GroupFit, Groups, fit_groups
from visioncal.estimation.numbering import Numbering, find_numbering
from visioncal.estimation.observability import SIGMA_LIMIT_M, Direction
from visioncal.estimation.placing import left_out_words, noise_words, refuse_poor, worst_directions
from visioncal.estimation.pointpairs import (
    FEWEST_POINTS,
    PointPairs,
    check_hand,
    check_pairs,
    determines_hand,
    line_words,
)
from visioncal.estimation.procrustes import (
    align,
    apply,
    procrustes_residual,
    scale_between,
    spreads,
)
from visioncal.estimation.robust import small_sets

# A scale is called different from one in one sound set of a thousand.
_FALSE_ALARM = 1e-3
# Points that reach so much less far aside than along are nearly on a line.
_SLENDER = 0.1


@dataclass(frozen=True)
class Scale:
    """How much larger the measured part is than the drawn one, where that is left free.

    Attributes:
        value: Measured over drawn.
        sigma: Its standard deviation.
        differs: Whether it is another than one, beyond noise.
    """

    value: float
    sigma: float
    differs: bool


@dataclass(frozen=True, eq=False)
class FixturePlacement:
    """Where the drawing lies: (4, 4) `base_from_fixture`, behind a scale of the drawing."""

    base_from_fixture: FloatArray
    scale: float


@dataclass(frozen=True, eq=False)
class PointFit:
    """A fixture's frame from n points.

    Attributes:
        agreement: Which points agree and their fit, without any scale. Its residuals are measured
            less drawn, in the base [m].
        scale: What the scale would be.
        numbering: In which order the points fit the drawing; one that was measured several times
            counts once, at its first place.
        hand_known: Whether mirrored points would have been found: else they lie in one plane, and
            the fixture's z axis may as well point the other way.
        worst: The worst known offset, amid the points, and the worst known rotation.
    """

    agreement: GroupInliers[FixturePlacement]
    scale: Scale
    numbering: Numbering
    hand_known: bool
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
        """(n, 6, 3) how the frame's right perturbation moves with each measured point."""
        return self.agreement.fit.gains


@dataclass(frozen=True, eq=False)
class PointProblem:
    """Points on their drawing, with the drawing's scale free or held at one."""

    pairs: PointPairs
    scaled: bool

    def guesses(self) -> Iterator[FixturePlacement]:
        """Gives closed forms from all points, and from small sets."""
        yield self._closed_form(np.arange(len(self.pairs)))
        for rows in small_sets(len(self.pairs), FEWEST_POINTS):
            yield self._closed_form(rows)

    def _closed_form(self, rows: IntArray) -> FixturePlacement:
        measured, nominal = self.pairs.measured[rows], self.pairs.nominal[rows]
        scale = scale_between(measured, nominal) if self.scaled else 1.0
        return FixturePlacement(align(measured, scale * nominal), scale)

    def linearise(self, state: FixturePlacement) -> Groups:
        """Residuals (n, 3) in the base, and their derivatives by the perturbation and the scale.

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
    the points' own covariances, the noise's level by restricted maximum likelihood, and the points
    that do not agree with the others left out.

    Args:
        pairs: The points.
        expected_noise_m: Noise that is to be expected of a coordinate beyond what is known of each
            point [m]; None where nobody knows.

    Returns:
        The frame, and what else the points determine.

    Raises:
        DataError: Too few points, another unit, mirrored or wrongly numbered points, or points that
            do not fit the drawing at all.
        DegenerateError: The points are on a line, or nearly so.
    """
    points = pairs.merged()
    check_pairs(points)
    noise = float(np.hypot(pairs.known_noise_m, expected_noise_m or 0.0))
    numbering = find_numbering(points.measured, points.drawn, noise)
    check_hand(points, numbering, noise)
    agreement, scale = _agreeing(pairs, expected_noise_m)
    _check_numbering(
        points, numbering, {pairs.labels[index] for index in np.flatnonzero(agreement.agrees)}
    )
    fit, agrees = agreement.fit, agreement.agrees
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


def _agreeing(
    pairs: PointPairs, expected_noise_m: float | None
) -> tuple[GroupInliers[FixturePlacement], Scale]:
    """Finds the points that agree, without accusing those that only a scale sets apart."""
    rigid = agreeing_groups(PointProblem(pairs, scaled=False), expected_noise_m)
    if not _sound(rigid).all():
        scaled = agreeing_groups(PointProblem(pairs, scaled=True), expected_noise_m)
        scale = _scale_of(scaled.fit)
        if scale.differs and _sound(scaled).sum() > _sound(rigid).sum():
            fit = fit_groups(PointProblem(pairs, scaled=False), scaled.agrees)
            return _as_scaled(scaled, fit), scale
    return rigid, _scale_of(fit_groups(PointProblem(pairs, scaled=True), rigid.agrees))


def _sound(agreement: GroupInliers[FixturePlacement]) -> Mask:
    return agreement.agrees & ~agreement.doubtful


def _as_scaled(
    scaled: GroupInliers[FixturePlacement], fit: GroupFit[FixturePlacement]
) -> GroupInliers[FixturePlacement]:
    """What agrees behind a scale, with the fit that has none: noise does not explain that one."""
    return GroupInliers(
        fit, fit.used, scaled.mahalanobis_sq, scaled.limit, scaled.doubtful, explained=False
    )


def _scale_of(fit: GroupFit[FixturePlacement]) -> Scale:
    value, sigma = fit.state.scale, float(np.sqrt(fit.covariance[6, 6]))
    chance = t_chance((value - 1.0) / sigma, max(fit.freedom, 1))
    # Points through their middle are no drawing of another size: exchanged names fit like that.
    return Scale(value, sigma, value > 0.0 and chance < _FALSE_ALARM)


def _check_numbering(pairs: PointPairs, numbering: Numbering, agree: Collection[str]) -> None:
    """Refuses a wrong order, unless just the points that are out of order were left out."""
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
    """The points contradict the drawing by so much that no frame follows, whatever their places."""
    off = np.linalg.norm(fit.groups.residuals, axis=1)
    rms_mm, worst = 1e3 * np.sqrt(np.mean(off**2)), int(np.argmax(off))
    scaled = pairs.nominal[fit.used] * scale.value
    left = np.sqrt(procrustes_residual(pairs.measured[fit.used], scaled) / fit.used.sum())
    hint = f" A drawing {scale.value:.4g} times as large would fit to {figure(1e3 * left)} mm."
    return DataError(
        f"fixture: the points do not fit the drawing: they are {rms_mm:.3g} mm off (root mean "
        f"square), most of all {pairs.labels[worst]} with {1e3 * off[worst]:.3g} mm."
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

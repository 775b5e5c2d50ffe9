"""Which images of a target put it in one place, and the mean of those.

The unit of rejection is the image as a whole: the 6-vector by which it puts the target away from
where the others put it. The start is the one image about which most others gather (least median,
Rousseeuw 1984), over all poses that each of them allows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.quantiles import chi2_limit, f_limit
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.linalg import covariance_from, squared_lengths
from visioncal.estimation.robust import Distances, settled
from visioncal.frames.single_view import TargetPlace

# A sound image is lost in one set of a thousand.
_FALSE_ALARM = 1e-3
# Poses farther apart than 95 % of what noise does are two different ones.
_ANOTHER = float(chi2_limit(0.05, 6))
# Scores that differ by a smaller share are equal.
_SAME = 1e-6
# The mean settles to the rounding of metres in a few steps: the places are near each other.
_STEPS, _SETTLED = 10, 1e-12


@dataclass(frozen=True, eq=False)
class CandidateViews:
    """The places of m images, each with the poses that it allows.

    Attributes:
        views: What each image allows, the best by reprojection first.
        flange_noise: (6, 6) covariance of the flange at one stop.
        common: (c, c) covariance of what all images share.
        freedom: Degrees of freedom of the noise's levels.
    """

    views: Sequence[Sequence[TargetPlace]]
    flange_noise: FloatArray
    common: FloatArray
    freedom: float

    def own(self, place: TargetPlace) -> FloatArray:
        """(6, 6) covariance of a place by what is its image's own: pixels, and robot."""
        carried = place.flange_jacobian @ self.flange_noise @ place.flange_jacobian.T
        return np.asarray(place.pixels + carried)

    @property
    def limit(self) -> float:
        """Largest squared distance that noise may give, corrected for the number of images.

        The noise's levels are estimated, which gives it the tails of an F distribution.
        """
        tail = _FALSE_ALARM / len(self.views)
        return 6.0 * float(f_limit(tail, 6, min(self.freedom, 1e6)))


@dataclass(frozen=True, eq=False)
class Mean:
    """Where images put a target together.

    Attributes:
        matrix: (4, 4) `parent_from_target`.
        own: (6, 6) covariance by what is each image's own, which the mean averages.
        gains: (m, 6, 6) share of each image; zero for one that has no part.
        by_common: (6, c) how the mean moves with what all images share.
    """

    matrix: FloatArray
    own: FloatArray
    gains: FloatArray
    by_common: FloatArray


@dataclass(frozen=True, eq=False)
class ImageInliers:
    """The images that agree, and their mean.

    Attributes:
        mean: Of those that agree.
        picks: (m,) which of its poses each image has.
        agrees: (m,) mask.
        away: (m, 6) by how much each image puts the target away from the mean.
        mahalanobis_sq: (m,) the same as a squared Mahalanobis distance; six on average where it is
            noise.
        limit: What it may be.
        variance: Of what is each image's own, in units of what was expected; one at the least.
        rival: Another place that all agreeing images allow; None where there is none.
    """

    mean: Mean
    picks: IntArray
    agrees: Mask
    away: FloatArray
    mahalanobis_sq: FloatArray
    limit: float
    variance: float
    rival: FloatArray | None


def agreeing(sights: CandidateViews) -> ImageInliers:
    """Finds the images that put the target in one place.

    Where no more than half agree, the right ones are unknown: all stay.
    """
    picks, agrees = _core(sights)
    search = _ImageSearch(sights, picks)
    agrees, found = settled(search, agrees, _judged(sights, picks, agrees), fewest=2, suspect=0.0)
    if 2 * int(agrees.sum()) <= len(picks):
        return _judged(sights, picks, np.ones(len(picks), dtype=bool))
    return found


@dataclass(frozen=True, eq=False)
class _ImageSearch:
    """The search among images, each with one of its poses."""

    sights: CandidateViews
    picks: IntArray

    def fit(self, used: Mask, _: ImageInliers) -> ImageInliers:
        return _judged(self.sights, self.picks, used)

    def distances(self, _: Mask, fit: ImageInliers) -> Distances:
        six = np.full(len(self.picks), 6.0)
        return Distances(fit.mahalanobis_sq, six, fit.variance * fit.limit * np.ones_like(six))


def _core(sights: CandidateViews) -> tuple[IntArray, Mask]:
    """The half of the images that gather about one place, and the poses that take them there."""
    best: tuple[float, IntArray, FloatArray] | None = None
    half = len(sights.views) // 2 + 1
    for seed in (place for view in sights.views for place in view):
        nearest, picks = _nearest(sights, seed)
        score = float(np.sort(nearest)[:half].sum())
        # Poses of a board that is turned fit alike, but for where their fits have stopped.
        if best is None or score < (1.0 - _SAME) * best[0] - 1e-9:
            best = (score, picks, nearest)
    if best is None:
        raise RuntimeError("there are no images to agree")
    _, picks, nearest = best
    agrees = np.zeros(len(picks), dtype=bool)
    agrees[np.argsort(nearest)[:half]] = True
    return picks, agrees


def _nearest(sights: CandidateViews, seed: TargetPlace) -> tuple[FloatArray, IntArray]:
    """Squared distance (m,) of each image's nearest pose from a place, and which one it is."""
    own, found = sights.own(seed), []
    for view in sights.views:
        away = [log(invert(seed.matrix) @ place.matrix) for place in view]
        squared = [
            float(d @ np.linalg.solve(own + sights.own(place), d))
            for d, place in zip(away, view, strict=True)
        ]
        found.append((min(squared), int(np.argmin(squared))))
    return np.array([item[0] for item in found]), np.array(
        [item[1] for item in found], dtype=np.int64
    )


def _judged(sights: CandidateViews, picks: IntArray, agrees: Mask) -> ImageInliers:
    """The mean of some images, and how far all of them are from it."""
    chosen = [view[at] for view, at in zip(sights.views, picks, strict=True)]
    mean = _mean(sights, chosen, agrees)
    away = log(invert(mean.matrix) @ np.array([value.matrix for value in chosen]))
    own = np.array([sights.own(value) for value in chosen])
    apart = np.array([value.by_common for value in chosen]) - mean.by_common
    shared = apart @ sights.common @ np.swapaxes(apart, 1, 2)
    inside, others = agrees[:, None, None], int(agrees.sum()) - 1
    squared = np.einsum("mi,mi->m", away, np.linalg.solve(own + shared, away[..., None])[..., 0])
    # Over six for each image beyond the first, which says nothing.
    variance = max(float(squared[agrees].sum()) / (6.0 * others), 1.0) if others else 1.0
    # An image inside the mean has drawn it to itself; its share is taken out.
    left = own + shared + np.where(inside, -1.0, 1.0) * mean.own
    mahalanobis_sq = (
        squared_lengths(away, left, own)[0] if others else np.where(agrees, 0.0, squared)
    )
    return ImageInliers(
        mean,
        picks,
        agrees,
        away,
        mahalanobis_sq,
        sights.limit,
        variance,
        _rival(sights, mean.matrix, agrees, variance),
    )


def _mean(sights: CandidateViews, chosen: Sequence[TargetPlace], agrees: Mask) -> Mean:
    """Weighs images by what is their own; what they share cannot be averaged by weights."""
    weights = np.array(
        [
            np.linalg.inv(sights.own(place)) if ok else np.zeros((6, 6))
            for place, ok in zip(chosen, agrees, strict=True)
        ]
    )
    own = covariance_from(weights.sum(axis=0))
    gains = own @ weights
    matrices = np.array([place.matrix for place in chosen])
    matrix = matrices[int(np.flatnonzero(agrees)[0])]
    for _ in range(_STEPS):
        step = np.einsum("mij,mj->i", gains, log(invert(matrix) @ matrices))
        matrix = matrix @ exp(step)
        if np.abs(step).max() < _SETTLED:
            break
    by_common = np.einsum("mij,mjk->ik", gains, np.array([place.by_common for place in chosen]))
    return Mean(matrix, own, gains, by_common)


def _rival(
    sights: CandidateViews, matrix: FloatArray, agrees: Mask, variance: float
) -> FloatArray | None:
    """Another place that all agreeing images allow: a mirrored or a turned target's."""
    limit = variance * sights.limit
    first = sights.views[int(np.flatnonzero(agrees)[0])]
    for seed in first:
        away = log(invert(matrix) @ seed.matrix)
        is_other = float(away @ np.linalg.solve(2.0 * sights.own(seed), away)) > _ANOTHER
        if is_other and bool(np.all(_nearest(sights, seed)[0][agrees] < limit)):
            return seed.matrix
    return None

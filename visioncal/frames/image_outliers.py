"""Outlier rejection among images of a target, and the mean pose of the inliers.

The unit of rejection is the whole image: the 6-vector of its pose's difference from the mean. The
search starts from the image pose with the smallest distances to half of the images (least median of
squares, Rousseeuw 1984), over all candidate poses of each.
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

# Probability that a set of images loses an inlier.
_FALSE_ALARM = 1e-3
# Squared distance beyond which two poses differ significantly.
_DIFFERENT = float(chi2_limit(0.05, 6))
# Relative difference below which scores are equal.
_SAME = 1e-6
# The mean converges in a few steps, since the poses are near each other.
_STEPS, _CONVERGED = 10, 1e-12


@dataclass(frozen=True, eq=False)
class CandidateViews:
    """Candidate poses of a target from m images."""

    # Candidates of each image, the best by reprojection first.
    views: Sequence[Sequence[TargetPlace]]
    flange_noise: FloatArray  # (6, 6) covariance of the flange at one stop.
    common: FloatArray  # (c, c) covariance of the errors that all images share.
    freedom: float  # Degrees of freedom of the noise levels.

    def independent(self, place: TargetPlace) -> FloatArray:
        """(6, 6) covariance of a candidate by errors of its image alone: pixels and robot."""
        carried = place.flange_jacobian @ self.flange_noise @ place.flange_jacobian.T
        return np.asarray(place.pixels + carried)

    @property
    def limit(self) -> float:
        """Outlier limit of the squared distance, corrected for the number of images.

        F distributed, since the noise levels are estimated.
        """
        tail = _FALSE_ALARM / len(self.views)
        return 6.0 * float(f_limit(tail, 6, min(self.freedom, 1e6)))


@dataclass(frozen=True, eq=False)
class Mean:
    """Weighted mean pose of a target over images."""

    matrix: FloatArray  # (4, 4) `parent_from_target`.
    independent: FloatArray  # (6, 6) covariance by the images' independent errors.
    gains: FloatArray  # (m, 6, 6) weight of each image; zero for outliers.
    by_common: FloatArray  # (6, c) Jacobian by the errors that all images share.


@dataclass(frozen=True, eq=False)
class ImageInliers:
    """Inlier images and their mean pose."""

    mean: Mean  # Mean of the inliers.
    picks: IntArray  # (m,) index of each image's selected candidate.
    inliers: Mask  # (m,) inlier mask.
    residuals: FloatArray  # (m, 6) residual of each image's pose from the mean [rad, m].
    mahalanobis_sq: FloatArray  # (m,) its squared Mahalanobis distance; six on average under noise.
    limit: float  # Its outlier limit.
    variance: float  # Variance factor of the images' independent errors; at least one.
    # Another pose that is a candidate of all inliers; None where there is none.
    rival: FloatArray | None


def find_inliers(candidates: CandidateViews) -> ImageInliers:
    """Finds the inlier images of a target.

    Where no more than half are inliers, the correct ones are unknown, and all are kept.
    """
    picks, agrees = _start(candidates)
    search = _ImageSearch(candidates, picks)
    agrees, fit = settled(search, agrees, _fit(candidates, picks, agrees), fewest=2, suspect=0.0)
    if 2 * int(agrees.sum()) <= len(picks):
        return _fit(candidates, picks, np.ones(len(picks), dtype=bool))
    return fit


@dataclass(frozen=True, eq=False)
class _ImageSearch:
    """Inlier search over images, each with its selected candidate."""

    candidates: CandidateViews
    picks: IntArray

    def fit(self, used: Mask, _: ImageInliers) -> ImageInliers:
        return _fit(self.candidates, self.picks, used)

    def distances(self, _: Mask, fit: ImageInliers) -> Distances:
        six = np.full(len(self.picks), 6.0)
        return Distances(fit.mahalanobis_sq, six, fit.variance * fit.limit * np.ones_like(six))


def _start(candidates: CandidateViews) -> tuple[IntArray, Mask]:
    """Selected candidates, and the half of the images nearest to one pose (least median)."""
    best: tuple[float, IntArray, FloatArray] | None = None
    half = len(candidates.views) // 2 + 1
    for seed in (place for view in candidates.views for place in view):
        nearest, picks = _nearest(candidates, seed)
        score = float(np.sort(nearest)[:half].sum())
        # Poses of a symmetric board fit equally, apart from rounding of their fits.
        if best is None or score < (1.0 - _SAME) * best[0] - 1e-9:
            best = (score, picks, nearest)
    if best is None:
        raise RuntimeError("there are no images to agree")
    _, picks, nearest = best
    agrees = np.zeros(len(picks), dtype=bool)
    agrees[np.argsort(nearest)[:half]] = True
    return picks, agrees


def _nearest(candidates: CandidateViews, seed: TargetPlace) -> tuple[FloatArray, IntArray]:
    """Squared distance (m,) of each image's nearest candidate from a pose, and its index."""
    independent, nearest = candidates.independent(seed), []
    for view in candidates.views:
        differences = [log(invert(seed.matrix) @ place.matrix) for place in view]
        squared = [
            float(d @ np.linalg.solve(independent + candidates.independent(place), d))
            for d, place in zip(differences, view, strict=True)
        ]
        nearest.append((min(squared), int(np.argmin(squared))))
    return np.array([item[0] for item in nearest]), np.array(
        [item[1] for item in nearest], dtype=np.int64
    )


def _fit(candidates: CandidateViews, picks: IntArray, agrees: Mask) -> ImageInliers:
    """Mean over the inliers, and the distances of all images from it."""
    chosen = [view[at] for view, at in zip(candidates.views, picks, strict=True)]
    mean = _mean(candidates, chosen, agrees)
    errors = log(invert(mean.matrix) @ np.array([value.matrix for value in chosen]))
    independent = np.array([candidates.independent(value) for value in chosen])
    common_difference = np.array([value.by_common for value in chosen]) - mean.by_common
    shared = common_difference @ candidates.common @ np.swapaxes(common_difference, 1, 2)
    is_inlier, others = agrees[:, None, None], int(agrees.sum()) - 1
    squared = np.einsum(
        "mi,mi->m", errors, np.linalg.solve(independent + shared, errors[..., None])[..., 0]
    )
    # Six degrees of freedom for each image beyond the first.
    variance = max(float(squared[agrees].sum()) / (6.0 * others), 1.0) if others else 1.0
    # The residual of an image that is part of the mean has a smaller covariance.
    covariance = independent + shared + np.where(is_inlier, -1.0, 1.0) * mean.independent
    mahalanobis_sq = (
        squared_lengths(errors, covariance, independent)[0]
        if others
        else np.where(agrees, 0.0, squared)
    )
    return ImageInliers(
        mean,
        picks,
        agrees,
        errors,
        mahalanobis_sq,
        candidates.limit,
        variance,
        _rival(candidates, mean.matrix, agrees, variance),
    )


def _mean(candidates: CandidateViews, chosen: Sequence[TargetPlace], agrees: Mask) -> Mean:
    """Mean pose weighted by the images' independent errors; common errors do not average out."""
    weights = np.array(
        [
            np.linalg.inv(candidates.independent(place)) if ok else np.zeros((6, 6))
            for place, ok in zip(chosen, agrees, strict=True)
        ]
    )
    independent = covariance_from(weights.sum(axis=0))
    gains = independent @ weights
    matrices = np.array([place.matrix for place in chosen])
    matrix = matrices[int(np.flatnonzero(agrees)[0])]
    for _ in range(_STEPS):
        step = np.einsum("mij,mj->i", gains, log(invert(matrix) @ matrices))
        matrix = matrix @ exp(step)
        if np.abs(step).max() < _CONVERGED:
            break
    by_common = np.einsum("mij,mjk->ik", gains, np.array([place.by_common for place in chosen]))
    return Mean(matrix, independent, gains, by_common)


def _rival(
    candidates: CandidateViews, matrix: FloatArray, agrees: Mask, variance: float
) -> FloatArray | None:
    """Another pose among the candidates of all inliers: of a mirrored or rotated target."""
    limit = variance * candidates.limit
    first = candidates.views[int(np.flatnonzero(agrees)[0])]
    for seed in first:
        delta = log(invert(matrix) @ seed.matrix)
        is_other = (
            float(delta @ np.linalg.solve(2.0 * candidates.independent(seed), delta)) > _DIFFERENT
        )
        if is_other and bool(np.all(_nearest(candidates, seed)[0][agrees] < limit)):
            return seed.matrix
    return None

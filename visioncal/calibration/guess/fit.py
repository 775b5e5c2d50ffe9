"""Robust fit of both unknown edges of the chain, its closing error without unit, its likelihood.

Distances of the target's positions are divided by the typical distance between camera and target,
and combined with angles in radians. So a reading that makes everything tiny gains nothing.

The likelihood is by which readings are compared: a view is gaussian, with the standard deviations
of its own fit, or one of a few outliers, with a broad tail.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.robust import trimmed_start

# Share of the views that is fitted: two rows exchanged among eight are a quarter.
KEPT_SHARE = 0.7
# Fewer views would agree with any reading.
_FEWEST_KEPT = 5
_SUBSET = 4
# Smaller turns about a second axis, relative to the largest or absolute, are noise of the poses.
_SECOND_AXIS, _LEAST_TURN_RAD = 0.05, 0.01
# The unknowns of both edges, and the equations of a view.
_UNKNOWNS, _PER_VIEW = 12, 6
# Standard deviation by axis [rad, or share of the distance]: readings are not distinguished by less
# than the first, and beyond the second no reading explains the views.
LEAST_SIGMA, UNEXPLAINED_SIGMA = 5e-4, 0.12
# Prior probability of an outlier view, and rounds in which outliers are weighted down.
_OUTLIER_PRIOR, _ROUNDS = 0.05, 5


@dataclass(frozen=True, eq=False)
class Fit:
    """Both edges by the views that agree best, and the residual of every view."""

    x: FloatArray  # (4, 4) X of `robot * x * camera = z`, in the poses' units.
    z: FloatArray  # (4, 4) Z.
    shift: FloatArray  # (n,) distance of each view's target from Z, in the poses' units.
    angle: FloatArray  # (n,) its rotation relative to Z [rad].
    lever: float  # Typical distance between camera and target, in the poses' units.
    lost: int = 0  # Views that have no residual under this reading, and are outliers.

    @cached_property
    def residuals(self) -> FloatArray:
        """(n,) residuals without unit."""
        return np.asarray(np.hypot(self.shift / self.lever, self.angle))

    @cached_property
    def kept(self) -> IntArray:
        """The rows with the smallest residuals, smallest first."""
        return np.argsort(self.residuals, kind="stable")[: kept_count(len(self.residuals))]

    @cached_property
    def score(self) -> float:
        """RMS residual of the kept rows, corrected for the degrees of freedom."""
        count = len(self.kept)
        if not count:
            return np.inf
        freedom = max(_PER_VIEW * count - _UNKNOWNS, _PER_VIEW)
        mean_square = float(np.mean(self.residuals[self.kept] ** 2))
        return float(np.sqrt(mean_square * _PER_VIEW * count / freedom))

    @cached_property
    def log_likelihood(self) -> float:
        """Restricted log-likelihood of the views under this reading, at its own noise."""
        return self._log_likelihood(self._estimate[0]) if np.isfinite(self.score) else -np.inf

    @cached_property
    def agreeing(self) -> int:
        """Number of views that are no outliers."""
        return int((self._estimate[1] > 0.5).sum())

    @cached_property
    def unexplained(self) -> float:
        """Log-likelihood of the residuals if positions, or rotations, remain unexplained."""
        beyond = np.where(np.eye(2), UNEXPLAINED_SIGMA, self._estimate[0])
        return max(map(self._log_likelihood, beyond))

    @cached_property
    def _estimate(self) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (2,) by axis of position and rotation, and each view's weight."""
        sigma, squares = np.full(2, UNEXPLAINED_SIGMA), self._squares
        weights = np.isin(np.arange(len(self.angle)), self.kept) * np.isfinite(self.score)
        for _ in range(_ROUNDS if np.isfinite(self.score) else 0):
            # Three equations a view each, less the six unknowns of the edges.
            freedom = max(3.0 * weights.sum() - 0.5 * _UNKNOWNS, 3.0)
            sigma = np.clip(np.sqrt(squares @ weights / freedom), LEAST_SIGMA, UNEXPLAINED_SIGMA)
            inlier, outlier = self._densities(sigma)
            weights = 1.0 / (1.0 + np.exp(np.clip(outlier - inlier, -500.0, 500.0)))
        return sigma, weights

    @property
    def _squares(self) -> FloatArray:
        """(2, n) squared residuals of position and rotation, without unit."""
        return np.array([self.shift / self.lever, self.angle]) ** 2

    def _densities(self, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) log densities of inlier and outlier views, each times its prior probability."""
        squares = self._squares
        inlier = -3.0 * np.log(sigma).sum() - 0.5 * (squares.T / sigma**2).sum(axis=1)
        outlier = -3.0 * np.log1p(squares).sum(axis=0)
        return inlier + np.log1p(-_OUTLIER_PRIOR), outlier + np.log(_OUTLIER_PRIOR)

    def _log_likelihood(self, sigma: FloatArray) -> float:
        count = len(self.angle) + self.lost
        lost = self.lost * (np.log(_OUTLIER_PRIOR) - 6.0 * np.log(2.0))
        inlier, outlier = self._densities(sigma)
        # A reading explains most of the views: only the farthest ones may be outliers.
        views = np.logaddexp(inlier, outlier)
        views[self.kept] = inlier[self.kept]
        total = float(views.sum() + lost)
        return total * max(1.0 - _UNKNOWNS / (_PER_VIEW * max(count, 1)), 0.0)

    @property
    def rms(self) -> tuple[float, float]:
        """RMS (distance in the poses' units, angle [rad]) of the kept rows."""
        shift, angle = self.shift[self.kept], self.angle[self.kept]
        if not len(shift):
            return np.inf, np.pi
        return float(np.sqrt(np.mean(shift**2))), float(np.sqrt(np.mean(angle**2)))


def is_about_one_axis(rotations: FloatArray) -> bool:
    """Whether (n, 3, 3) rotations differ by turns about one axis at most."""
    # Turning about one axis leaves directions along it fixed: the last singular value vanishes.
    singular = np.linalg.svd((rotations - rotations.mean(axis=0)).reshape(-1, 3), compute_uv=False)
    singular /= np.sqrt(len(rotations))
    return bool(singular[2] < max(_SECOND_AXIS * singular[0], _LEAST_TURN_RAD))


def kept_count(rows: int) -> int:
    """Number of rows that a fit of this many keeps."""
    return max(int(np.ceil(KEPT_SHARE * rows)), min(rows, _FEWEST_KEPT))


def no_fit(rows: int) -> Fit:
    """The fit of rows that cannot be read: infinite residuals."""
    return Fit(np.eye(4), np.eye(4), np.full(rows, np.inf), np.full(rows, np.pi), lever=1.0)


def robust_fit(robot: FloatArray, camera: FloatArray, starts: int = 0) -> Fit:
    """Solves `robot * x * camera = z` by the views that agree best (trimmed least squares).

    Args:
        robot: (n, 4, 4) the robot's part of the chain.
        camera: (n, 4, 4) `cam_from_target`.
        starts: Number of random small subsets to start from, besides all views.
    """
    lever = max(float(np.median(np.linalg.norm(camera[:, :3, 3], axis=1))), 1e-12)
    rng, count = np.random.default_rng(0), len(robot)
    fits = [_fit(robot, camera, lever, np.arange(count))]
    if count > _SUBSET and starts:
        subsets = np.array([rng.choice(count, _SUBSET, replace=False) for _ in range(starts)])
        solutions = SOLVERS["park"](robot[subsets], camera[subsets])
        edges = zip(solutions.x, solutions.z, strict=True)
        fits += [distances(robot, camera, lever, item) for item in edges]
    return trimmed_start(
        fits,
        lambda fit: fit.residuals**2,
        lambda mask, _: _fit(robot, camera, lever, np.flatnonzero(mask)),
        kept_count(count),
        len(fits),
    )[1]


def _fit(robot: FloatArray, camera: FloatArray, lever: float, rows: IntArray) -> Fit:
    solution = SOLVERS["park"](robot[rows], camera[rows])
    return distances(robot, camera, lever, (solution.x, solution.z))


def distances(
    robot: FloatArray, camera: FloatArray, lever: float, edges: tuple[FloatArray, FloatArray]
) -> Fit:
    """Computes the residuals of every view for given edges (x, z)."""
    x, z = edges
    placed = robot @ x @ camera
    shift = np.linalg.norm(placed[:, :3, 3] - z[:3, 3], axis=1)
    return Fit(x, z, shift, rotation_angle(invert(z) @ placed), lever)

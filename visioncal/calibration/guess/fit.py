"""Robust fit of both unknown edges of the chain, and its closing error without unit.

Distances of the target's positions are divided by the typical distance between camera and target,
and combined with angles in radians. So a reading that makes everything tiny gains nothing.
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


@dataclass(frozen=True, eq=False)
class Fit:
    """Both edges by the views that agree best, and the residual of every view."""

    x: FloatArray  # (4, 4) X of `robot * x * camera = z`, in the poses' units.
    z: FloatArray  # (4, 4) Z.
    shift: FloatArray  # (n,) distance of each view's target from Z, in the poses' units.
    angle: FloatArray  # (n,) its rotation relative to Z [rad].
    lever: float  # Typical distance between camera and target, in the poses' units.

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

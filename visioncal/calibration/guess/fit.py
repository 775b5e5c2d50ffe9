"""How well poses of robot and camera close the chain, whatever share of the views is wrong.

The measure has no unit: distances of the target's places count in typical distances between camera
and target, angles in radians. So a reading that makes everything tiny gains nothing.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.robust import trimmed_start

# Two rows exchanged among eight are a quarter of the views.
KEPT_SHARE = 0.7
# Fewer views than this would agree with any reading.
_FEWEST_KEPT = 5
_SUBSET = 4
# Turns about a second axis that are smaller, than the largest or at all, are noise of the poses.
_SECOND_AXIS, _LEAST_TURN_RAD = 0.05, 0.01
# The unknowns of both edges, and the numbers that a view gives.
_UNKNOWNS, _PER_VIEW = 12, 6


@dataclass(frozen=True, eq=False)
class Fit:
    """Both edges by the views that agree best, and how far every view is from them.

    Attributes:
        x: (4, 4) X of `robot * x * camera = z`, in the poses' units.
        z: (4, 4) Z.
        shift: (n,) distance of each view's target from z, in the poses' units.
        angle: (n,) its angle to z [rad].
        lever: Typical distance between camera and target, in the poses' units.
    """

    x: FloatArray
    z: FloatArray
    shift: FloatArray
    angle: FloatArray
    lever: float

    @cached_property
    def away(self) -> FloatArray:
        """(n,) distances without unit."""
        return np.asarray(np.hypot(self.shift / self.lever, self.angle))

    @cached_property
    def kept(self) -> IntArray:
        """The rows that agree best, nearest first."""
        return np.argsort(self.away, kind="stable")[: kept_count(len(self.away))]

    @cached_property
    def score(self) -> float:
        """Scatter of the views that agree best, corrected for what the unknowns absorb."""
        count = len(self.kept)
        if not count:
            return np.inf
        freedom = max(_PER_VIEW * count - _UNKNOWNS, _PER_VIEW)
        mean_square = float(np.mean(self.away[self.kept] ** 2))
        return float(np.sqrt(mean_square * _PER_VIEW * count / freedom))

    @property
    def rms(self) -> tuple[float, float]:
        """Scatter (distance in the poses' units, angle [rad]) of the views that agree best."""
        shift, angle = self.shift[self.kept], self.angle[self.kept]
        if not len(shift):
            return np.inf, np.pi
        return float(np.sqrt(np.mean(shift**2))), float(np.sqrt(np.mean(angle**2)))


def is_about_one_axis(rotations: FloatArray) -> bool:
    """Whether (n, 3, 3) rotations differ by turns about one axis at most: too few directions."""
    # Turning about one axis leaves what lies along it in place: the last value vanishes.
    singular = np.linalg.svd((rotations - rotations.mean(axis=0)).reshape(-1, 3), compute_uv=False)
    singular /= np.sqrt(len(rotations))
    return bool(singular[2] < max(_SECOND_AXIS * singular[0], _LEAST_TURN_RAD))


def kept_count(rows: int) -> int:
    """How many of some rows decide."""
    return max(int(np.ceil(KEPT_SHARE * rows)), min(rows, _FEWEST_KEPT))


def no_fit(rows: int) -> Fit:
    """The fit of rows that cannot be read: infinitely far off."""
    return Fit(np.eye(4), np.eye(4), np.full(rows, np.inf), np.full(rows, np.pi), lever=1.0)


def robust_fit(robot: FloatArray, camera: FloatArray, starts: int = 0) -> Fit:
    """Solves `robot * x * camera = z` by the views that agree best.

    Args:
        robot: (n, 4, 4) the robot's part of the chain.
        camera: (n, 4, 4) `cam_from_target`.
        starts: How many small sets to start from, besides all views.
    """
    lever = max(float(np.median(np.linalg.norm(camera[:, :3, 3], axis=1))), 1e-12)
    rng, count = np.random.default_rng(0), len(robot)
    every = [_fit(robot, camera, lever, np.arange(count))]
    if count > _SUBSET and starts:
        sets = np.array([rng.choice(count, _SUBSET, replace=False) for _ in range(starts)])
        found = SOLVERS["park"](robot[sets], camera[sets])
        edges = zip(found.x, found.z, strict=True)
        every += [distances(robot, camera, lever, item) for item in edges]
    return trimmed_start(
        every,
        lambda fit: fit.away**2,
        lambda mask, _: _fit(robot, camera, lever, np.flatnonzero(mask)),
        kept_count(count),
        len(every),
    )[1]


def _fit(robot: FloatArray, camera: FloatArray, lever: float, rows: IntArray) -> Fit:
    solution = SOLVERS["park"](robot[rows], camera[rows])
    return distances(robot, camera, lever, (solution.x, solution.z))


def distances(
    robot: FloatArray, camera: FloatArray, lever: float, edges: tuple[FloatArray, FloatArray]
) -> Fit:
    """Tells how far each view is from known edges (x, z)."""
    x, z = edges
    placed = robot @ x @ camera
    shift = np.linalg.norm(placed[:, :3, 3] - z[:3, 3], axis=1)
    return Fit(x, z, shift, rotation_angle(invert(z) @ placed), lever)

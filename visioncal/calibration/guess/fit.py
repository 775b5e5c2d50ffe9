"""Robust fits of both unknown edges of the chain, their closing errors without unit, likelihoods.

Distances of the target's positions are divided by the typical distance between camera and target,
and combined with angles in radians. So a reading that makes everything tiny gains nothing.

The likelihood is by which readings are compared: a view is gaussian, with the standard deviations
of its own fit, or one of a few outliers, with a broad tail.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from visioncal.core.limits import FEWEST_COMPARED
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.transforms import (
    apply,
    compose,
    exp,
    invert,
    nearest_rotation,
    rotation_angle,
    skew,
)
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.closed_form import SOLVERS

# A right reading closes the chain to this share of the distance, or angle [rad]: poses with 10 mm
# and 1 degree of noise leave less, wrong readings ten times more.
CLOSING_SCORE = 0.05
# Random small subsets from which a fit starts where views may be wrong.
STARTS = 12
# Shares of the views that are fitted: two rows exchanged among eight are a quarter, and half are
# rows apart beside another mistake, which the second is for; fewer would agree with any reading.
KEPT_SHARE, HALF_SHARE = 0.7, 0.45
_SUBSET = 4  # Views of a start.
# Standard deviation by axis [rad, or share of the distance], at least and at most: readings are not
# distinguished by less than the first.
_LEAST_SIGMA, _MOST_SIGMA = 5e-4, 1.0
# Prior probability of an outlier view.
_OUTLIER_PRIOR = 0.05
# Rounds in which the nearest rows are found.
CONCENTRATED = 4
# Another program's lens shifts a camera by some hundredths of its distance [m], and turns it less
# than so: no camera is so near a flange, its axes parallel, and a board so flat in a base at once.
_SAME_M, _PARALLEL = 0.02, np.cos(np.radians(2.0))
# Poses that are so found.
CAMERA_OVER_BOARD = (
    "the robot's poses are those of the camera over the board, or of the board before the camera: "
    "by them, the camera is within 20 mm and 2 deg of the flange, and the board of the base. "
    "Another program found them in the same images, or the controller's tool is the camera, and "
    "its base the board"
)
# Next step of both.
SWITCH_OFF = (
    "where the controller has the camera as its tool and the board as its base, switch both off "
    "and record again"
)


@dataclass(frozen=True, eq=False)
class Fit:
    """Both edges by the views that agree best, and the residual of every view."""

    x: FloatArray  # (4, 4) X of `robot * x * camera = z`, in the poses' units.
    z: FloatArray  # (4, 4) Z.
    shift: FloatArray  # (n,) distance of each view's target from Z, in the poses' units.
    angle: FloatArray  # (n,) its rotation relative to Z [rad].
    lever: float  # Typical distance between camera and target, in the poses' units.
    lost: int = 0  # Views that have no residual under this reading, and are outliers.
    share: float = KEPT_SHARE  # Share of the views that must agree.

    @cached_property
    def residuals(self) -> FloatArray:
        """(n,) residuals without unit."""
        return np.asarray(np.hypot(self.shift / self.lever, self.angle))

    @cached_property
    def kept(self) -> IntArray:
        """The rows with the smallest residuals, smallest first."""
        return np.argsort(self.residuals, kind="stable")[
            : kept_count(len(self.residuals), self.share)
        ]

    @cached_property
    def score(self) -> float:
        """RMS residual of the kept rows, corrected for the degrees of freedom."""
        count = len(self.kept)
        if not count:
            return np.inf
        # Six equations a view, less the twelve unknowns of both edges.
        squares = float(np.sum(self.residuals[self.kept] ** 2))
        return float(np.sqrt(6 * squares / max(6 * count - 12, 6)))

    @property
    def rms(self) -> tuple[float, float]:
        """RMS (distance in the poses' units, angle [rad]) of the kept rows."""
        if not len(self.kept):
            return np.inf, np.pi
        squares = np.array([self.shift, self.angle])[:, self.kept] ** 2
        shift, angle = np.sqrt(squares.mean(axis=1)).tolist()
        return shift, angle

    @property
    def is_readable(self) -> bool:
        """Whether there are residuals: the numbers can be read as rotations at all."""
        return bool(np.isfinite(self.score))

    @property
    def closes(self) -> bool:
        """Whether the chain closes as well as under a right reading."""
        return self.score <= CLOSING_SCORE

    @property
    def figures(self) -> str:
        """RMS residual of the kept rows, in words; distances in metres."""
        if not self.is_readable:
            return "no rotations"
        shift_m, angle = self.rms
        if not self.angle.any():
            return f"{figure(1e3 * shift_m)} mm"
        return mm_and_deg(1e3 * shift_m, float(np.rad2deg(angle)))

    @cached_property
    def log_likelihood(self) -> float:
        """Restricted log-likelihood of the views under this reading, at its own noise."""
        if not self.is_readable:
            return -np.inf
        inlier, outlier = self._densities(self._estimate[0])
        # A reading explains most of the views: only the farthest ones may be outliers.
        views = np.logaddexp(inlier, outlier)
        views[self.kept] = inlier[self.kept]
        lost = self.lost * (np.log(_OUTLIER_PRIOR) - 6.0 * np.log(2.0))
        count = len(self.angle) + self.lost
        return float(views.sum() + lost) * max(1.0 - 2.0 / max(count, 1), 0.0)

    @cached_property
    def agreeing(self) -> int:
        """Number of views that are no outliers."""
        return int((self._estimate[1] > 0.5).sum())

    @cached_property
    def _estimate(self) -> tuple[FloatArray, FloatArray]:
        """Standard deviations (2,) by axis of position and rotation, and each view's weight."""
        sigma, squares = np.full(2, _MOST_SIGMA), self._squares
        weights = np.zeros(len(self.angle))
        weights[self.kept] = 1.0
        for _ in range(5 if self.is_readable else 0):
            # Three equations a view each, less the six unknowns of the edges.
            freedom = max(3.0 * weights.sum() - 6.0, 3.0)
            sigma = np.clip(np.sqrt(squares @ weights / freedom), _LEAST_SIGMA, _MOST_SIGMA)
            inlier, outlier = self._densities(sigma)
            weights = 1.0 / (1.0 + np.exp(np.clip(outlier - inlier, -500.0, 500.0)))
        return sigma, weights

    @cached_property
    def _squares(self) -> FloatArray:
        """(2, n) squared residuals of position and rotation, without unit."""
        return np.array([self.shift / self.lever, self.angle]) ** 2

    def _densities(self, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) log densities of inlier and outlier views, each times its prior probability."""
        inlier = -3.0 * np.log(sigma).sum() - 0.5 * (self._squares.T / sigma**2).sum(axis=1)
        return inlier + np.log1p(-_OUTLIER_PRIOR), self._outlier

    @cached_property
    def _outlier(self) -> FloatArray:
        """(n,) log densities of outlier views, which no noise changes."""
        return np.asarray(np.log(_OUTLIER_PRIOR) - 3.0 * np.log1p(self._squares).sum(axis=0))


def are_of_camera(camera: FloatArray, target: FloatArray) -> bool:
    """Whether (4, 4) edges are the identity, and the board's own frame but for its first corner.

    The poses of a robot by which they are so are the camera's over the board.
    """
    turned = np.abs(target[:3, :3])
    is_parallel = min(*camera.diagonal()[:3], turned[2, 2], turned[:2, :2].max()) > _PARALLEL
    return bool(is_parallel and max(np.abs(camera[:3, 3]).max(), abs(target[2, 3])) < _SAME_M)


def is_about_one_axis(rotations: FloatArray) -> bool:
    """Whether (n, 3, 3) rotations differ by turns about one axis at most."""
    # Turning about one axis leaves directions along it fixed: the last singular value vanishes.
    singular = np.linalg.svd((rotations - rotations.mean(axis=0)).reshape(-1, 3), compute_uv=False)
    singular /= np.sqrt(len(rotations))
    # Smaller turns about a second axis, relative to the largest or absolute, are noise of the
    # poses.
    return bool(singular[2] < max(0.05 * singular[0], 0.01))


def robust_fits(
    robot: FloatArray, camera: FloatArray, starts: int = 0, share: float = KEPT_SHARE
) -> list[Fit]:
    """Solves `robot * x * camera = z` for k readings by the views that agree best.

    Least trimmed squares with concentration steps (Rousseeuw and Van Driessen 1999).

    Args:
        robot: (k, n, 4, 4) the robot's part of the chain.
        camera: (k, n, 4, 4) `cam_from_target`.
        starts: Number of random small subsets to start from, besides all views.
        share: Share of the views that must agree.
    """
    count = robot.shape[1]
    kept = kept_count(count, share)
    lever = np.maximum(np.median(np.linalg.norm(camera[..., :3, 3], axis=2), axis=1), 1e-12)

    def solved(some: IntArray, rows: IntArray) -> _Solved:
        sides = robot[some, None], camera[some, None]
        edges = SOLVERS["park"](
            *(np.take_along_axis(side, rows[..., None, None], 2) for side in sides)
        )
        shift, angle = _away(*sides, (edges.x, edges.z))
        squares = (shift / lever[some, None, None]) ** 2 + angle**2
        return np.stack([edges.x, edges.z], axis=2), *_trimmed(squares, kept)

    best = _least_trimmed(solved, len(robot), count, _random_sets(count, starts, _SUBSET))
    away = zip(*_away(robot, camera, (best[:, 0], best[:, 1])), lever.tolist(), strict=True)
    return [
        Fit(x, z, shift, angle, at, share=share)
        for (x, z), (shift, angle, at) in zip(best, away, strict=True)
    ]


# Edges (k, s, 2, 4, 4), trimmed sums (k, s), and the rows with the least (k, s, kept).
_Solved: TypeAlias = tuple[FloatArray, FloatArray, IntArray]


def _trimmed(squares: FloatArray, kept: int) -> tuple[FloatArray, IntArray]:
    """Sums of the least squares (k, s, n), and their rows."""
    nearest = np.argpartition(squares, kept - 1)[..., :kept]
    return np.take_along_axis(squares, nearest, axis=2).sum(axis=2), nearest


def _random_sets(count: int, starts: int, size: int) -> list[IntArray]:
    """(starts, size) random rows of `count`, if any; empty where all rows are as few."""
    if not starts or count <= size:
        return []
    rng = np.random.default_rng(0)
    return [np.array([rng.choice(count, size, replace=False) for _ in range(starts)])]


def _least_trimmed(
    solved: Callable[[IntArray, IntArray], _Solved],
    readings: int,
    count: int,
    sets: Sequence[IntArray],
) -> FloatArray:
    """(k, 2, 4, 4) edges of the least trimmed squares that were found.

    Args:
        solved: Solves some (k,) of the readings by (k, s, m) rows.
        readings: Number of readings.
        count: Number of rows.
        sets: (s, m) rows to start from, besides all.
    """
    every = np.arange(readings)
    edges, sums, nearest = solved(every, np.broadcast_to(np.arange(count), (readings, 1, count)))
    for rows in sets:
        more = solved(every, np.broadcast_to(rows, (readings, *rows.shape)))
        edges, sums = np.hstack([edges, more[0]]), np.hstack([sums, more[1]])
        nearest = np.hstack([nearest, more[2]])
    if sets:
        # Starts that are followed.
        followed = every[:, None], np.argsort(sums, axis=1)[:, :3]
        edges, sums, nearest = edges[followed], sums[followed], nearest[followed]
    falls = np.ones(sums.shape, dtype=bool)
    for _ in range(6 if sets else 2):
        # Rows whose sum did not fall have the same solution again.
        trial, lower, rows = solved(np.nonzero(falls)[0], nearest[falls][:, None])
        falls[falls] = less = lower[:, 0] < sums[falls]
        if not less.any():
            break
        edges[falls], sums[falls], nearest[falls] = trial[less, 0], lower[less, 0], rows[less, 0]
    return np.asarray(edges[every, sums.argmin(axis=1)])


def mounting_fits(
    flanges: FloatArray,
    read: FloatArray,
    starts: int = 0,
    share: float = KEPT_SHARE,
    window: int = 0,
) -> list[Fit]:
    """Fits where an instrument stands and where the point is that it reads, as `robust_fits`.

    A linear solution for both, with any matrix as rotation, is projected on rotations, from which
    Gauss-Newton steps start. X of a fit has the point's place in the flange, Z the instrument's
    pose in the base, and no view a turn.

    Args:
        flanges: (k, n, 4, 4) `base_from_flange`.
        read: (n, 3) places of the point in the instrument's frame.
        starts: Number of random small subsets to start from, besides all views.
        share: Share of the views that must agree.
        window: Number of neighbouring views from which it starts, too; 0 for none.
    """
    count = len(read)
    kept = kept_count(count, share)
    lever = max(float(np.median(np.linalg.norm(read - np.median(read, axis=0), axis=1))), 1e-12)

    def solved(some: IntArray, rows: IntArray) -> _Solved:
        each = flanges[some, None]
        edges = _mounted(np.take_along_axis(each, rows[..., None, None], 2), read[rows])
        squares = (_missed(each, read, edges) / lever) ** 2
        return edges, *_trimmed(squares, kept)

    # Places of a point read at so few stops determine where it and the instrument are.
    sets = _random_sets(count, starts, 6)
    if 0 < window < count:
        firsts = np.arange(0, count - window + 1, window // 2)
        sets.append(firsts[:, None] + np.arange(window))
    best = _least_trimmed(solved, len(flanges), count, sets)
    still = np.zeros(count)
    each = zip(best, _missed(flanges, read, best), strict=True)
    return [Fit(x, z, shift, still, lever, share=share) for (x, z), shift in each]


def _mounted(flanges: FloatArray, read: FloatArray) -> FloatArray:
    """(..., 2, 4, 4) X and Z of (..., m, 4, 4) flanges and (..., m, 3) read places of a point."""
    turned, places = flanges[..., :3, :3], flanges[..., :3, 3]
    eye = np.broadcast_to(np.eye(3), turned.shape)
    # Places are `matrix @ read + place - turned @ point`, linear in the rows of the matrix.
    by_matrix = np.einsum("ij,...k->...ijk", np.eye(3), read).reshape(*turned.shape[:-1], 9)
    flat = (*flanges.shape[:-3], -1)
    design = np.concatenate([by_matrix, eye, -turned], axis=-1).reshape(*flat, 15)
    linear = _least_squares(design, places.reshape(*flat, 1))[..., :9]
    rotation = nearest_rotation(linear.reshape(*linear.shape[:-1], 3, 3))
    values = np.zeros((*linear.shape[:-1], 9))
    # Steps towards their least squares.
    for _ in range(4):
        pointed = read @ np.swapaxes(rotation, -1, -2)
        design = np.concatenate([-skew(pointed), eye, -turned], axis=-1).reshape(*flat, 9)
        values = _least_squares(design, (places - pointed).reshape(*flat, 1))
        turn = np.concatenate([values[..., :3], np.zeros_like(values[..., :3])], axis=-1)
        rotation = exp(turn)[..., :3, :3] @ rotation
    x = compose(np.broadcast_to(np.eye(3), rotation.shape), values[..., 6:])
    return np.stack([x, compose(rotation, values[..., 3:6])], axis=-3)


def _least_squares(design: FloatArray, right: FloatArray) -> FloatArray:
    """(..., q) solutions of (..., n, q) equations; what these leave open is zero.

    By the normal equations, in which singular values under 1e-6 of the largest count as none.
    """
    across = np.swapaxes(design, -1, -2)
    inverse = np.linalg.pinv(across @ design, rcond=1e-12, hermitian=True)
    return np.asarray((inverse @ (across @ right))[..., 0])


def _missed(flanges: FloatArray, read: FloatArray, edges: FloatArray) -> FloatArray:
    """(..., n) distances of read places from the point on (..., n, 4, 4) flanges."""
    points = (flanges @ edges[..., 0, None, :, :])[..., :3, 3]
    away = points - apply(edges[..., 1, :, :], read)
    return np.asarray(np.linalg.norm(away, axis=-1))


def _away(
    robot: FloatArray, camera: FloatArray, edges: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """(..., n) distances and angles [rad] of targets from Z."""
    x, z = edges
    placed = robot @ x[..., None, :, :] @ camera
    shift = np.linalg.norm(placed[..., :3, 3] - z[..., None, :3, 3], axis=-1)
    return shift, rotation_angle(invert(z)[..., None, :, :] @ placed)


def distances(
    robot: FloatArray, camera: FloatArray, lever: float, edges: tuple[FloatArray, FloatArray]
) -> Fit:
    """Computes the residuals of every view, of (n, 4, 4) poses, for given edges (x, z)."""
    return Fit(*edges, *_away(robot, camera, edges), lever)


def kept_count(rows: int, share: float = KEPT_SHARE) -> int:
    """Number of rows that a fit of this many keeps."""
    return max(int(np.ceil(share * rows)), min(rows, FEWEST_COMPARED))


def distance_rows(
    robot: FloatArray, camera: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rows by which the factor of measured distances is linear, whatever the places of X and Z are.

    The target's places over the factor are linear in its inverse. A regression on the factor itself
    would give zero for a robot that only turns, as a pan-tilt head: this makes all places the same.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        camera: (m, 4, 4) `cam_from_target`.
        x: (4, 4) X, of which the rotation is used.

    Returns:
        (m, 3, 7) rows by both translations and the inverse of the factor, the translations over it,
        and (m, 3) what these make up for with the other sign.
    """
    turned = robot[:, :3, :3]
    same = np.broadcast_to(-np.eye(3), (len(robot), 3, 3))
    rows = np.concatenate([turned, same, robot[:, :3, 3:]], axis=2)
    return rows, (turned @ x[:3, :3] @ camera[:, :3, 3:])[:, :, 0]


def distance_factor(robot: FloatArray, camera: FloatArray, fit: Fit) -> tuple[float, float] | None:
    """Factor of the camera's distances by which those of most rows agree; None without motion.

    Args:
        robot: (m, 4, 4) the robot's part of the chain.
        camera: (m, 4, 4) `cam_from_target`.
        fit: Their fit, of whose X the rotation is used.

    Returns:
        It, and the rms of what is left of the camera's distances in these rows.
    """
    by_edges, seen = distance_rows(robot, camera, fit.x)
    kept, inverse = np.argsort(fit.angle, kind="stable")[: len(fit.kept)], 0.0
    for _ in range(CONCENTRATED):
        rows, some = by_edges[kept].reshape(-1, 7), seen[kept].reshape(-1)
        # Directions with a smaller singular value, relative to the largest, are not determined.
        solution, _, rank, _ = np.linalg.lstsq(rows, -some, rcond=1e-3)
        if rank < 7:
            return None
        away = np.linalg.norm(seen + by_edges @ solution, axis=1)
        kept, inverse = np.argsort(away, kind="stable")[: len(kept)], float(solution[6])
    left = float(np.sqrt(np.mean(away[kept] ** 2)))
    return (1.0 / inverse, left) if inverse > 0.0 else None

"""One fit of points: a frame, and where points lie in it.

Each row has a point in the parent of an unknown frame, and coordinates of it that are stated in the
frame:

    frame^-1 * carrier * point = scale * nominal        in the stated coordinates

Of a fixture the points are measured, without carriers. Of a tool the touched points are unknown,
the carrier is `flange_from_base`, and the nominal coordinates are zero. Of an instrument's mounting
the points are unknown on the flange, and the nominal coordinates are its readings.

The residuals of a row are a group, an inlier or outlier as a whole: they share one error, whose
covariance is the stated one plus one unknown level of noise per axis, `known + sigma^2 I`, with
sigma by restricted maximum likelihood.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.core.linalg import NULL_SHARE, covariance_from, damped_step, eigenvalue_shares, gram
from visioncal.core.robust import ROUNDS
from visioncal.core.transforms import apply_each, exp, skew
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows
from visioncal.estimation.mixed import LEAST_SIGMA, MOST_SIGMA, MixedModel, PriorInformation, Units
from visioncal.estimation.robot_likelihood import START_SIGMA

# Fewest points of a frame, and fewest touches of a point.
FEWEST_POINTS = 3


@dataclass(frozen=True, eq=False)
class Placement:
    """The unknowns: a frame in its parent, unknown points [m], and the scale of what is stated."""

    frame: FloatArray  # (4, 4).
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3).
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class Groups:
    """A problem linearised at a placement: m groups of up to d residuals, by p unknowns."""

    residuals: FloatArray  # (m, d) [m], zero where not observed.
    jacobian: FloatArray  # (m, d, p) by the unknowns' steps, zero where not observed.
    observed: Mask  # (m, d) mask of the existing residuals: groups may be smaller than d.
    known: FloatArray  # (m, d, d) stated covariance [m^2]; zeros where none is.

    def __len__(self) -> int:
        return len(self.residuals)

    def subset(self, chosen: Mask) -> "Groups":
        """Returns the groups of an (m,) mask."""
        return chosen_rows(self, chosen)

    def covariance(self, sigma: float) -> FloatArray:
        """Covariances (m, d, d) at a noise level [m]; identity where nothing was observed."""
        return self._units().total(np.log([sigma]))

    def _units(self) -> Units:
        pair_mask = self.observed[:, :, None] & self.observed[:, None, :]
        identity = np.eye(self.observed.shape[1])
        absent = identity * ~self.observed[:, None, :]
        return Units(
            self.residuals,
            self.jacobian,
            np.where(pair_mask, self.known, 0.0) + absent,
            (identity * self.observed[:, None, :])[None],
            np.zeros(1, dtype=np.int64),
        )

    def level(self, start: float) -> float:
        """Noise by restricted maximum likelihood [m], searched from a start."""
        count = self.jacobian.shape[2]
        model = MixedModel(self._units(), PriorInformation.flat(count), np.zeros((count, 1)))
        low, high = np.log([LEAST_SIGMA]), np.log([MOST_SIGMA])
        found = model.maximised(np.log([max(start, LEAST_SIGMA)]), low, high)
        return float(np.exp(found.logs[0]))

    def information(self, sigma: float) -> FloatArray:
        """Fisher information (p, p) of the unknowns at a noise level [m]."""
        weighted = np.linalg.solve(self.covariance(sigma), self.jacobian)
        return gram(self.jacobian, weighted)

    @property
    def freedom(self) -> int:
        """Degrees of freedom: residuals observed less directions determined."""
        shares = eigenvalue_shares(gram(self.jacobian, self.jacobian))
        return int(self.observed.sum() - np.sum(shares > NULL_SHARE))


@dataclass(frozen=True, eq=False)
class PointProblem:
    """Points as a problem of groups, one per row.

    The unknowns' steps are the frame's right perturbation (rotation [rad], translation [m]), the
    points [m], and the scale.
    """

    nominal: FloatArray  # (n, 3) coordinates in the frame [m].
    stated: Mask  # (n, 3) mask of those that are stated.
    covariances: FloatArray  # (n, 3, 3) stated covariance of each point in the parent [m^2].
    # Starts from all rows, then from small sets: near the solution if a set has no outliers.
    guesses: Callable[[], Iterable[Placement]]
    measured: FloatArray | None = None  # (n, 3) known points in the parent [m]; None for unknown.
    # (n, 4, 4) transforms that carry unknown points to the parent, and the (n,) indices of these.
    carriers: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    points: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    turn_rad: float = 0.0  # Standard deviation of the carriers' rotations, per axis of the parent.
    oriented: bool = True  # Whether the frame's rotation is estimated.
    scaled: bool = False  # Whether the scale is.

    def in_parent(self, state: Placement) -> FloatArray:
        """(n, 3) the points in the frame's parent [m]."""
        if self.measured is not None:
            return self.measured
        return apply_each(self.carriers, state.points[self.points])

    def local(self, state: Placement) -> FloatArray:
        """(n, 3) the points in the frame [m]."""
        return np.asarray((self.in_parent(state) - state.frame[:3, 3]) @ state.frame[:3, :3])

    def linearise(self, state: Placement) -> Groups:
        """Residuals (n, 3) in the frame, and their Jacobian.

        A step (w, v) on the right moves a point q of the frame by `q x w - v`. Of unknown points
        the stated coordinates stand for q, where noise would pass for information on the rotation:
        the gradient stays exact as long as the noise is isotropic, as the neglected term is
        `residual x residual`.
        """
        rotation, count, stated = state.frame[:3, :3], len(self.nominal), self.stated
        local, nominal = self.local(state), state.scale * self.nominal
        lever = np.where(stated, nominal, local) if self.measured is None else local
        columns = [np.tile(-np.eye(3), (count, 1, 1))]
        if self.oriented:
            columns.insert(0, skew(lever))
        if self.measured is None:
            turns = rotation.T @ self.carriers[:, :3, :3]
            selection = np.eye(len(state.points))[self.points]
            by_points = turns[:, :, None, :] * selection[:, None, :, None]
            columns.append(by_points.reshape(count, 3, -1))
        if self.scaled:
            columns.append(-self.nominal[:, :, None])
        arms = self.turn_rad * skew(self.in_parent(state))
        known = self.covariances + arms @ np.swapaxes(arms, 1, 2)
        return Groups(
            np.where(stated, local - nominal, 0.0),
            np.where(stated[:, :, None], np.concatenate(columns, axis=2), 0.0),
            stated,
            rotation.T @ known @ rotation,
        )

    def move(self, state: Placement, step: FloatArray) -> Placement:
        """Takes a step from a state."""
        edge, size = 6 if self.oriented else 3, state.points.size
        twist = np.concatenate([np.zeros(6 - edge), step[:edge]])
        return Placement(
            state.frame @ exp(twist),
            state.points + step[edge : edge + size].reshape(-1, 3),
            state.scale + float(step[-1]) if self.scaled else state.scale,
        )


@dataclass(frozen=True, eq=False)
class GroupFit:
    """Fit to some of the groups."""

    state: Placement  # The maximum-likelihood unknowns.
    # (p, p) of their steps; undetermined directions have a large but finite variance.
    covariance: FloatArray
    # Maximum-likelihood noise of one residual [m], beyond the stated one; the expected one where
    # there are no degrees of freedom.
    sigma: float
    freedom: int  # Degrees of freedom: residuals used less directions determined.
    groups: Groups  # All groups at the solution, used or not.
    used: Mask  # (m,) mask of the groups of the fit.

    @property
    def by_points(self) -> FloatArray:
        """(m, p, 3) derivative of the unknowns by each measured point in the parent.

        It propagates an error that several points share, and that their weights do not model.
        """
        weights = np.linalg.inv(self.groups.covariance(self.sigma))
        weighted = np.where(self.used[:, None, None], weights @ self.groups.jacobian, 0.0)
        gains = -self.covariance @ np.swapaxes(weighted, 1, 2)
        rotation = self.state.frame[:3, :3]
        return np.asarray(gains @ np.where(self.groups.observed[:, :, None], rotation.T, 0.0))


def fit_groups(
    problem: PointProblem,
    used: Mask | None = None,
    start: Placement | None = None,
    expected_sigma: float = 0.0,
) -> GroupFit:
    """Fits the unknowns and the noise level to some groups.

    Args:
        problem: The problem to fit.
        used: (m,) mask of the groups to use; all where None.
        start: Start; the problem's first guess where None.
        expected_sigma: Noise level where there are no degrees of freedom [m].
    """
    state = next(iter(problem.guesses())) if start is None else start
    groups = problem.linearise(state)
    chosen = np.ones(len(groups), dtype=bool) if used is None else used
    inside = groups.subset(chosen)
    square = float(np.sum(inside.residuals**2)) / max(int(inside.observed.sum()), 1)
    sigma = max(float(np.sqrt(square)), START_SIGMA)
    for _ in range(ROUNDS):
        # Weights are held during the descent: weights that follow the state would favour states
        # with large noise.
        weights = np.asarray(np.linalg.inv(groups.covariance(sigma)), dtype=float)
        state = descended(problem, state, chosen, weights)
        groups = problem.linearise(state)
        inside = groups.subset(chosen)
        before, sigma = sigma, inside.level(sigma)
        if np.isclose(before, sigma, rtol=1e-4):
            break
    freedom = inside.freedom
    if freedom < 1:
        sigma = max(expected_sigma, LEAST_SIGMA)
    covariance = covariance_from(inside.information(sigma))
    return GroupFit(state, covariance, sigma, freedom, groups, chosen)


def descended(
    problem: PointProblem, start: Placement, chosen: Mask, weights: FloatArray
) -> Placement:
    """Minimises the residuals of some groups at (m, d, d) weights."""
    weights = np.where(chosen[:, None, None], weights, 0.0)

    def linearise(at: Placement) -> Linearised[Placement]:
        groups = problem.linearise(at)
        weighted = weights @ groups.jacobian
        information = gram(groups.jacobian, weighted)
        gradient = gram(weighted, groups.residuals)
        cost = np.einsum("mi,mij,mj->", groups.residuals, weights, groups.residuals)
        return Linearised(
            at,
            float(cost),
            lambda damping: problem.move(at, damped_step(information, gradient, damping)),
        )

    return levenberg_marquardt(start, linearise)[0]

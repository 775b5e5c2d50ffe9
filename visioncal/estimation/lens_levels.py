"""Variance components of lens errors that the lens model does not describe, by REML.

The corners of one camera and its observations (the chains of frames through it) are linearised
once. Random effects are the modes of the distortion field, focus breathing, one focus jitter a
view, and one error of each flange a stop; fixed effects are frames, lens, board and whatever else
the fit moves. Errors of single views are eliminated view by view, so that an evaluation of the
restricted likelihood costs one Cholesky factorisation of some hundred unknowns. Newton steps are
used because the likelihood is flat where a level is small: a search by gradients alone would stop
there at rounding errors.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from visioncal.core.errors import ConvergenceError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.estimation.effects.lenses import LENSES, LinearisedCorners
from visioncal.estimation.lens_field import LensLevels, distances, field_modes, zooms
from visioncal.estimation.linalg import covariance_from, gram
from visioncal.estimation.normal_equations import normal_equations
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import ratio_prior
from visioncal.estimation.variance import HARDLY, LikelihoodValue, most_likely

# Candidate correlation lengths of the field, as shares of the image's width; index of the first
# that is tried, and least gain in log-likelihood of a change to another one.
_LENGTHS, _FIRST, _GAIN = (0.07, 0.12, 0.2), 2, 0.5
# Upper bounds of the field [px], of breathing and of jitter (relative changes of focus): autofocus
# repeats to some 0.1 %. The corner noise lies between the residuals with lens, board and field all
# free and those with lens and board alone, times these factors.
_MOST = (1.0, 0.02, 5e-3)
_NOISE_RANGE = (0.7, 3.0)
# Residuals above this with lens, board and field all free are wrong corners, not noise [px].
_WRONG_PX = 10.0
# Lower bounds of field (in units of the corner noise), breathing and jitter, at which they count
# as zero, and start values of the search.
_LEAST, _START = (1e-3, 1e-6, 1e-6), (0.3, 1e-3, 3e-4)
_FLANGE_RANGE = (1e-7, 1e-1)
# Likelihood-ratio limit with a false alarm in one session of ten thousand; half of the
# chi-square's mass is at zero, as a level cannot be negative.
SIGNIFICANT = float(chi2_limit(2e-4, 1))
# Breathing and jitter are not identifiable with fewer stops.
_FEWEST_STOPS = 6
# Indices of the levels: corner noise, field, breathing, jitter, and then two for each flange.
_NOISE, _FIELD, _BREATHING, _JITTER, _FLANGES = range(5)
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class _Rows:
    """One camera's linearised corners and observations: o observations (chains) of v views."""

    stack: CornerStack  # The corners, without effects of the focus.
    camera: Camera  # The lens.
    # (n, 2, c + 2) columns of lens, board and breathing, of a change of focus, and of the
    # residuals, after elimination of the poses.
    without: WithoutPoses
    chained: IntArray  # (o,) the view of each observation.
    jacobian: FloatArray  # (o, 6, t) Jacobian of the observations' residuals by the unknowns.
    by_errors: FloatArray  # (o, 6, 6 w) Jacobian by the flange errors.
    away: FloatArray  # (o, 6) the residuals.
    robots: IntArray  # (o, w) indices of these flanges' robots; -1 for none.
    places: IntArray  # (c - 1,) indices of lens and board among the unknowns.
    known: FloatArray  # (t, t) information on the unknowns from everything else.
    gradient: FloatArray  # (t,) half the gradient of everything else.


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Restricted likelihood of the levels' logarithms, at one correlation length of the field.

    Corner quantities are in units of the corner noise. The q unknowns are the t of the
    observations, breathing, and the field's modes.
    """

    rows: float  # Number of residuals.
    information: FloatArray  # (q, q) on the unknowns, with the errors of single views at zero.
    gradient: FloatArray  # (q,) half the gradient of the squared error.
    cost: float  # The squared error.
    # (v, l, l) information on the errors of single views: of flanges, then of the focus.
    local: FloatArray
    cross: FloatArray  # (v, l, q) information between these and the unknowns.
    pulls: FloatArray  # (v, l) half the gradient by the errors of single views.
    kinds: IntArray  # (v, l) the level of each of these errors; -1 for none.
    known: FloatArray  # (t, t) information on the observations' unknowns from everything else.
    known_gradient: FloatArray  # (t,) half the gradient of everything else.
    # (2,) RMS corner residuals with lens, board and field all free, and with lens and board alone.
    noise_px: tuple[float, float]
    flanges: int  # Number of robots.

    @cached_property
    def modes(self) -> IntArray:
        """(m,) the levels of the random unknowns, which follow the t others."""
        levels = np.full(len(self.gradient) - len(self.known), _FIELD)
        levels[0] = _BREATHING
        return levels

    @cached_property
    def counts(self) -> FloatArray:
        """Number of random values of each level; zero for the corner noise."""
        kinds = np.concatenate([self.kinds[self.kinds >= 0], self.modes])
        return np.bincount(kinds, minlength=_FLANGES + 2 * self.flanges).astype(float)

    @cached_property
    def _members(self) -> tuple[FloatArray, FloatArray]:
        """Indicators of each value's level: (v, l, k) of single views, (q, k) of unknowns."""
        levels = np.flatnonzero(self.counts)
        modes = np.zeros((len(self.gradient), len(levels)))
        modes[len(self.known) :] = self.modes[:, None] == levels
        return (self.kinds[:, :, None] == levels).astype(float), modes

    def __call__(self, logs: FloatArray, *, is_sloped: bool = True) -> LikelihoodValue:
        """Negative log-likelihood, gradient and Hessian; these two are zero without `is_sloped`."""
        # Where the Hessian is not positive definite, the average information replaces it (Gilmour,
        # Thompson and Cullis 1995), which is never negative.
        t, variances, is_random = len(self.known), np.exp(2.0 * logs), self.kinds >= 0
        weight, behind = 1.0 / variances[_NOISE], np.arange(t, len(self.gradient))
        precision = np.where(is_random, 1.0 / variances[self.kinds], 1.0)
        prior = 1.0 / variances[self.modes]
        local, cross = weight * self.local, weight * self.cross
        diagonal = np.arange(local.shape[1])
        local[:, diagonal, diagonal] += precision
        root = np.linalg.cholesky(local)
        outward = np.linalg.inv(root)
        half = outward @ cross
        inward = np.swapaxes(outward, 1, 2)
        inverse, taken = inward @ outward, inward @ half
        information = weight * self.information - gram(half, half)
        information[:t, :t] += self.known
        information[behind, behind] += prior
        pulls = weight * self.pulls
        gradient = weight * self.gradient - gram(taken, pulls)
        gradient[:t] += self.known_gradient
        precisions = np.diag(information)
        # Unknowns without information get the ridge of `_factor` only.
        scale = 1.0 / np.sqrt(np.where(precisions > _RIDGE**2, precisions, 1.0))
        factor = _factor(information * np.outer(scale, scale))
        covariance = cho_solve(factor, np.diag(scale), check_finite=False) * scale[:, None]
        solution = -covariance @ gradient
        pulled = (inverse @ pulls[:, :, None])[:, :, 0]
        single = -pulled - taken @ solution
        squared = weight * self.cost + gradient @ solution - float(np.sum(pulls * pulled))
        determinants = 2.0 * float(np.log(np.diag(factor[0])).sum() - np.log(scale).sum())
        determinants += 2.0 * float(np.log(root[:, diagonal, diagonal]).sum() + self.counts @ logs)
        value = 0.5 * float(self.rows * 2.0 * logs[_NOISE] + determinants + squared)
        by_level, hessian = np.zeros(len(logs)), np.zeros((len(logs),) * 2)
        ratios = ratio_prior(range(self.flanges), _FLANGES)
        if not is_sloped:
            return ratios.beside(LikelihoodValue(value, by_level, hessian), logs)
        # Squares and variances of each level's values, in units of the level's variance.
        levels = np.flatnonzero(self.counts)
        singles, modes = self._members
        of_single, of_modes = single[:, :, None] * singles, solution[:, None] * modes
        squares = np.sum(of_single**2, axis=(0, 1)) + np.sum(of_modes**2, axis=0)
        # A single product of a tall matrix: view by view it takes several times as long.
        spread_out = (taken.reshape(-1, len(solution)) @ covariance).reshape(taken.shape)
        in_common = spread_out @ np.swapaxes(taken, 1, 2)
        variances_of_errors = np.diagonal(inverse + in_common, axis1=1, axis2=2)
        uncertain = np.tensordot(variances_of_errors, singles, axes=2) + np.diag(covariance) @ modes
        squares, uncertain = squares / variances[levels], uncertain / variances[levels]
        by_level = self.counts.copy()
        by_level[levels] -= squares + uncertain
        # The rest of the squared error and of the degrees of freedom belongs to the corners.
        prior_cost = solution[:t] @ (self.known @ solution[:t] + 2.0 * self.known_gradient)
        corner_cost = squared - squares.sum() - prior_cost
        freedom = len(solution) + is_random.sum() - np.sum(self.known * covariance[:t, :t])
        by_level[_NOISE] = self.rows - corner_cost - freedom + uncertain.sum()
        # Working variates of each level (average information); those of the corners are residuals.
        by_single = (weight * self.local) @ of_single + cross @ of_modes
        by_modes = weight * (self.information @ of_modes) + gram(cross, of_single)
        products = np.tensordot(of_single, by_single, axes=([0, 1], [0, 1])) + of_modes.T @ by_modes
        rest = pulls + ((weight * self.local) @ single[:, :, None])[:, :, 0] + cross @ solution
        rest_modes = weight * (self.gradient + self.information @ solution) + gram(cross, single)
        by_single = np.concatenate([rest[:, :, None], -by_single], axis=2)
        by_modes = np.column_stack([rest_modes, -by_modes])
        crossed = np.tensordot(rest, of_single, axes=([0, 1], [0, 1])) + rest_modes @ of_modes
        working = np.block([[np.atleast_2d(corner_cost), -crossed], [-crossed[:, None], products]])
        followed = inverse @ by_single
        by_modes -= gram(cross, followed)
        working -= gram(by_single, followed) + by_modes.T @ covariance @ by_modes
        expected = self._expected(
            covariance,
            taken,
            inverse,
            in_common,
            uncertain,
            self.rows - freedom + uncertain.sum(),
            logs,
        )
        places = np.append(_NOISE, levels)
        second = 4.0 * working - expected + 2.0 * np.diag(by_level[places])
        if np.linalg.eigvalsh(second)[0] <= 0.0:
            second = 2.0 * working
        hessian[np.ix_(places, places)] = second
        return ratios.beside(LikelihoodValue(value, by_level, hessian), logs)

    def _expected(
        self,
        covariance: FloatArray,
        taken: FloatArray,
        inverse: FloatArray,
        in_common: FloatArray,
        spread: FloatArray,
        of_corners: float,
        logs: FloatArray,
    ) -> FloatArray:
        """Expected Hessian (Fisher information): half the traces of P V_k P V_l.

        Those with the corner noise follow from P V P = P.

        Args:
            covariance: (q, q) of the unknowns.
            taken: (v, l, q) response of the errors of single views to the unknowns.
            inverse: (v, l, l) covariance of these errors, given the unknowns.
            in_common: (v, l, l) the unknowns' contribution to it.
            spread: (k,) traces of the levels' posterior covariances over their variances.
            of_corners: Degrees of freedom of the corners.
            logs: The logarithms of the levels.

        Returns:
            (1 + k, 1 + k) for the corner noise and the levels with any values.
        """
        t, levels, variances = len(self.known), np.flatnonzero(self.counts), np.exp(2.0 * logs)
        singles, modes = self._members
        among_rows = [taken[self.kinds == level] for level in levels.tolist()]
        turned = np.array([covariance @ (row.T @ row) for row in among_rows])
        of_one_view = (inverse * (inverse + 2.0 * in_common)) @ singles
        traces = np.tensordot(singles, of_one_view, axes=([0, 1], [0, 1]))
        traces += np.tensordot(turned, turned, axes=([1, 2], [2, 1]))
        of_rows = np.sum(turned * covariance, axis=2) @ modes
        traces += of_rows + of_rows.T + modes.T @ covariance**2 @ modes
        among = np.diag(self.counts[levels] - 2.0 * spread)
        among += traces / np.outer(variances[levels], variances[levels])
        held = self.known @ covariance[:t]
        by_prior = np.tensordot(turned[:, :t], held, axes=2)
        by_prior = (by_prior + np.sum(held * covariance[:t], axis=0) @ modes) / variances[levels]
        of_noise = 2.0 * (self.counts[levels] - spread - among.sum(axis=0) - by_prior)
        inner = held[:, :t]
        of_prior = np.trace(inner) - np.sum(inner * inner.T) - by_prior.sum()
        alone = 2.0 * of_corners - of_noise.sum() - of_prior
        return np.block([[np.atleast_2d(alone), of_noise], [of_noise[:, None], 2.0 * among]])

    def minimised(
        self, logs: FloatArray, closed: tuple[int, ...], enough: float = np.inf
    ) -> tuple[float, FloatArray]:
        """Minimum and the levels' logarithms there; `closed` ones stay at their lower bounds."""
        low, high = self.limits(closed)
        hardly = HARDLY * np.maximum(self.counts, 1.0)
        start = np.clip(logs, low, high)
        logs, likelihood = most_likely(self, start, low, high, enough=enough, hardly=hardly)
        # Insignificant levels decrease by ever smaller gains: tries their lower bounds directly.
        for level in (_FIELD, _BREATHING, _JITTER):
            if likelihood.gradient[level] <= 0.0 or logs[level] <= low[level]:
                continue
            without = logs.copy()
            without[level] = low[level]
            candidate = self(without)
            if candidate.value <= likelihood.value:
                logs, likelihood = without, candidate
        return likelihood.value, logs

    def gain(self, logs: FloatArray, value: float, closed: tuple[int, ...], level: int) -> float:
        """Likelihood-ratio statistic of one level, against its lower bound."""
        logs_without, least = logs.copy(), self.limits((*closed, level))[0][level]
        if logs[level] <= least:
            return 0.0
        logs_without[level] = least
        upper_bound = 2.0 * (self(logs_without, is_sloped=False).value - value)
        # The other levels are only refitted where it matters.
        if upper_bound < SIGNIFICANT:
            return upper_bound
        return 2.0 * (self.minimised(logs_without, (*closed, level))[0] - value)

    def limits(self, closed: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the levels' logarithms."""
        low = np.repeat([_FLANGE_RANGE[0]], _FLANGES + 2 * self.flanges)
        high = np.repeat([_FLANGE_RANGE[1]], len(low))
        low[_NOISE], high[_NOISE] = np.multiply(_NOISE_RANGE, self.noise_px)
        low[_FIELD : _JITTER + 1] = np.multiply(_LEAST, (self.noise_px[0], 1.0, 1.0))
        high[_FIELD : _JITTER + 1] = _MOST
        high[[*closed]] = low[[*closed]]
        return np.log(low), np.log(high)


def are_beyond(levels: LensLevels, sigma_px: float) -> bool:
    """Whether levels exceed those of any real lens, given the corner noise of a fit with them.

    They are in units of that noise: both grow where the poses diverge.
    """
    sizes = sigma_px * np.array([levels.field, levels.breathing, levels.jitter])
    # The noise was estimated again, and differs by some percent.
    return bool(np.any(sizes > 1.2 * np.array(_MOST)))


def estimate_levels(
    seen: LinearisedCorners,
    problem: Problem,
    rows: IntArray,
    state: State,
    noise: Noise,
    camera: str,
) -> LensLevels:
    """Estimates the error levels of one camera's lens, beyond its model.

    Args:
        seen: The linearised corners of all cameras, with all values of lenses and boards free.
        problem: The inlier observations, with these corners.
        rows: (n,) the view of each observation; -1 for none.
        state: The linearisation point.
        noise: The levels of robots and sensors.
        camera: Name of the camera.
    """
    mine = seen.camera_parameters.problems[camera]
    if not mine.has_spare_corners:
        return LensLevels()
    linearised = _rows(seen, problem, rows, state, noise, camera)
    has_focus_levels = (
        len(np.unique(linearised.chained)) >= _FEWEST_STOPS and not mine.scene.is_focus_fixed
    )
    closed = () if has_focus_levels else (_BREATHING, _JITTER)
    before = mine.levels
    at = _FIRST if before is None else _LENGTHS.index(before.length)
    likelihood = _assembled(linearised, _LENGTHS[at], len(noise.robots))
    left_px, noise_px = likelihood.noise_px
    if left_px > _WRONG_PX:
        return LensLevels()
    sizes = np.array([noise_px, _START[0] * left_px, *_START[1:]])
    if before is not None:
        stated = [1.0, before.field, before.breathing, before.jitter]
        sizes = np.maximum(noise_px * np.array(stated), np.array([0.0, 0.1, 0.1, 0.1]) * sizes)
    logs = np.log(np.concatenate([sizes, np.maximum(noise.robots, 1e-6).ravel()]))
    best = (*likelihood.minimised(logs, closed), at, likelihood)
    for step in (1, -1):
        while 0 <= best[2] + step < len(_LENGTHS):
            candidate = _assembled(linearised, _LENGTHS[best[2] + step], len(noise.robots))
            value, candidate_logs = candidate.minimised(best[1], closed, best[0] - _GAIN)
            if value > best[0] - _GAIN:
                break
            best = value, candidate_logs, best[2] + step, candidate
    _, logs, at, likelihood = best
    sizes = np.exp(logs[: _JITTER + 1])
    low = np.exp(likelihood.limits(closed)[0][: _JITTER + 1])
    field, breathing, jitter = np.where(sizes > 2.0 * low, sizes, 0.0)[1:] / sizes[_NOISE]
    gains = [
        likelihood.gain(logs, best[0], closed, index) for index in (_FIELD, _BREATHING, _JITTER)
    ]
    return LensLevels(
        float(field), _LENGTHS[at], float(breathing), float(jitter), (gains[0], gains[1], gains[2])
    )


def _factor(scaled: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky factor of a matrix with unit diagonal, by a ridge made positive definite."""
    ridge = _RIDGE
    while True:
        raised = scaled + ridge * np.eye(len(scaled))
        try:
            factor, is_lower = cho_factor(raised, lower=True, check_finite=False)
        except np.linalg.LinAlgError as error:
            if ridge > 1.0:
                raise ConvergenceError(
                    "lens: no sizes of its errors are likely: the fit that they are sought in runs "
                    "away.",
                    next_step="Look whether poses, images and board go together.",
                ) from error
            ridge *= 1e3
        else:
            return factor, is_lower


def _rows(
    seen: LinearisedCorners,
    problem: Problem,
    rows: IntArray,
    state: State,
    noise: Noise,
    camera: str,
) -> _Rows:
    optics, which = seen.camera_parameters, list(seen.camera_parameters.problems).index(camera)
    of_camera = optics.rows(camera)
    corners, poses = optics.problems[camera], optics.poses[of_camera]
    shape = corners.basis[corners.stack.ids]
    stack = corners.stack.with_points(corners.stack.points + shape @ optics.values[optics.boards])
    stack, lens = replace(stack, zooms=None), optics.camera(camera)
    now = reproject(stack, lens, poses)
    focus = zooms(stack, lens)
    breath = distances(stack, poses)[stack.view_of][:, None] * focus
    by_board = now.by_point @ shape
    stack.weigh(focus, breath, by_board)
    columns = [now.by_intrinsics, by_board, *(
        array[:, :, None] for array in (breath, focus, now.residuals)
    )]  # fmt: skip
    all_columns = np.concatenate(columns, axis=2)
    own_rows = np.flatnonzero((rows >= of_camera.start) & (rows < of_camera.stop))
    linear, (of, members) = problem.linear(state), problem.units
    jacobian = linear.jacobian_of(own_rows)
    places = problem.effect_columns[LENSES].start + np.searchsorted(
        seen.free, optics.places(camera)
    )
    others = np.ones(len(problem), dtype=bool)
    others[own_rows] = False
    known, gradient = normal_equations(problem, state, noise, among=others)
    weight = floored_sigma_px(seen.sigmas_px[which]) ** -2.0
    known[np.ix_(places, places)] -= weight * seen.compressed[which].shared_information
    gradient[places] -= weight * seen.compressed[which].shared_gradient
    kept = problem.moving & jacobian.any(axis=(0, 1))
    kept[places] = problem.moving[places]
    # The fit's coefficients of this lens's errors are left out: they are estimated again here.
    sizes = [compressed.by_field.shape[2] for compressed in seen.compressed]
    first = problem.effect_columns[LENSES].start + len(seen.free) + sum(sizes[:which])
    kept[first : first + sizes[which]] = False
    known, gradient = _without(known, gradient, problem.moving & ~kept, kept)
    return _Rows(
        stack,
        lens,
        WithoutPoses.of(stack, now.by_pose, all_columns, corners.shares),
        rows[own_rows] - of_camera.start,
        jacobian[:, :, kept],
        linear.by_errors[own_rows],
        linear.residuals[own_rows],
        np.where((of[own_rows] >= 0)[:, None], members[of[own_rows]], -1),
        np.searchsorted(np.flatnonzero(kept), places),
        known,
        gradient,
    )


def _without(
    known: FloatArray, gradient: FloatArray, out: Mask, kept: Mask
) -> tuple[FloatArray, FloatArray]:
    """Marginalises unknowns by a Schur complement: information and gradient on the kept ones."""
    inner, rest = known[np.ix_(kept, kept)], gradient[kept]
    if not out.any():
        return inner, rest
    between = known[np.ix_(kept, out)]
    gain = between @ covariance_from(known[np.ix_(out, out)])
    return inner - gain @ between.T, rest - gain @ gradient[out]


def _assembled(rows: _Rows, length: float, robots: int) -> _Likelihood:
    """Assembles the likelihood at one correlation length of the field."""
    stack, without = rows.stack, rows.without
    modes = field_modes(stack.px, rows.camera.resolution, length)
    answer, products = without.with_modes(modes)
    # Columns: lens, board, breathing, a change of focus, residuals, and the modes.
    focus = without.left.shape[2] - 2
    residual, shared = focus + 1, np.r_[:focus, focus + 2 : len(products)]
    by_focus = without.by_view(focus, modes)
    views, chained, t, q = len(stack.views), rows.chained, len(rows.known), len(shared)
    size = t + q - len(rows.places)
    columns = np.concatenate([rows.places, np.arange(t, size)])
    among, pulled = products[np.ix_(shared, shared)], products[shared, residual]
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[np.ix_(columns, columns)], gradient[columns] = among, pulled
    # Observations: measured poses are the best ones for given lens, board, field and focus.
    following = answer[chained]
    jacobian = np.zeros((len(chained), 6, size))
    jacobian[:, :, :t] = rows.jacobian
    jacobian[:, :, columns] = following[:, :, shared]
    residuals = rows.away + following[:, :, residual]
    # Repeats of stationary frames share an error, too, but are taken as independent here.
    by_flanges = np.repeat(rows.robots, 6, axis=1)
    of_flanges = np.where(by_flanges[:, None] < 0, 0.0, rows.by_errors)
    errors = np.concatenate([of_flanges, following[:, :, focus : focus + 1]], axis=2)
    weights = without.information[chained]
    turned = np.swapaxes(errors, 1, 2) @ weights
    width = errors.shape[2]
    local, cross = np.zeros((views, width, width)), np.zeros((views, width, size))
    pulls, kinds = np.zeros((views, width)), np.full((views, width), -1)
    local[:, -1, -1], cross[:, -1, columns] = by_focus[:, focus], by_focus[:, shared]
    pulls[:, -1], kinds[:, -1] = by_focus[:, residual], _JITTER
    local[chained] += turned @ errors
    cross[chained] += turned @ jacobian
    pulls[chained] += (turned @ residuals[:, :, None])[:, :, 0]
    flanges = np.repeat(_FLANGES + 2 * rows.robots, 6, axis=1) + np.tile(
        np.repeat([0, 1], 3), rows.robots.shape[1]
    )
    kinds[chained, :-1] = np.where(by_flanges < 0, -1, flanges)
    inner, cost = among + np.diag(_RIDGE + 1e-6 * np.diag(among)), products[residual, residual]
    # Images that repeat the same view count as one.
    freedom = float(without.roots**2 @ (2 * stack.counts - 6))

    def left_px(free: int) -> float:
        rest = cost - pulled[:free] @ np.linalg.solve(inner[:free, :free], pulled[:free])
        return floored_sigma_px(float(np.sqrt(max(rest, 0.0) / max(freedom - free, 1.0))))

    return _Likelihood(
        freedom + 6 * len(chained),
        information + gram(jacobian, weights @ jacobian),
        gradient + gram(jacobian, (weights @ residuals[:, :, None])[:, :, 0]),
        float(cost + np.einsum("oi,oij,oj->", residuals, weights, residuals)),
        local,
        cross,
        pulls,
        kinds,
        rows.known,
        rows.gradient,
        (left_px(q), left_px(focus)),
        robots,
    )

"""Sizes of what lenses do beyond their models, by restricted likelihood (REML).

The corners of one camera and the chains of frames through it are linearised once. Random are the
field's modes, breathing, one change of focus a view, and one error of each flange a stop; free are
frames, lens, board and whatever else the fit moves. Errors of single views are eliminated view by
view, so that an evaluation of the likelihood costs one Cholesky of some hundred unknowns. Steps are
Newton's: the likelihood is flat where a level is small, and a search by slopes alone would rest
wherever rounding stops it.
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
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import normal_equations, ratio_prior
from visioncal.estimation.variance import HARDLY, LikelihoodValue, most_likely

# Lengths of the field that are tried, as shares of the image's width, from the third on; another
# one has to gain so much.
_LENGTHS, _FIRST, _GAIN = (0.07, 0.12, 0.2), 2, 0.5
# A field is no larger [px], and no change of focus with the distance or from view to view, as a
# share: autofocus repeats to some 0.1 %. The noise of corners is no less than what lens, board and
# field, all free, leave of them, and no more than what lens and board alone do, give or take these.
_MOST = (1.0, 0.02, 5e-3)
_NOISE_RANGE = (0.7, 3.0)
# Corners of which lens, board and field, all free, leave more [px] are wrong, and no noise.
_WRONG_PX = 10.0
# Sizes below these are none: of the field in units of the noise, of focus as a share; and those
# from which the search starts.
_LEAST, _START = (1e-3, 1e-6, 1e-6), (0.3, 1e-3, 3e-4)
_FLANGE_RANGE = (1e-7, 1e-1)
# Gains that chance gives in one session of ten thousand: a level is none, or more (chi-square, half
# of it at zero).
SIGNIFICANT = float(chi2_limit(2e-4, 1))
# Fewer stops say nothing of the focus.
_FEWEST_STOPS = 6
# Places of the levels: of corners, field, breathing and jitter, and then of the flanges, two each.
_NOISE, _FIELD, _BREATHING, _JITTER, _FLANGES = range(5)
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class _Rows:
    """One camera's corners and chains where they were linearised, o chains of v views.

    Attributes:
        stack: The corners, without effects of the focus.
        camera: The lens.
        without: (n, 2, c + 2) columns by lens, board and breathing, by a change of focus, and the
            residuals, once the poses have followed.
        chained: (o,) the view of each chain.
        jacobian: (o, 6, t) of the chains' residuals by the unknowns.
        by_errors: (o, 6, 6 w) by the flanges' errors.
        away: (o, 6) the residuals.
        robots: (o, w) places of these flanges' robots; -1 for none.
        places: (c - 1,) places of lens and board among the unknowns.
        known: (t, t) what all else says of the unknowns.
        gradient: (t,) half its gradient.
    """

    stack: CornerStack
    camera: Camera
    without: WithoutPoses
    chained: IntArray
    jacobian: FloatArray
    by_errors: FloatArray
    away: FloatArray
    robots: IntArray
    places: IntArray
    known: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """The restricted likelihood of logarithms of the levels, at one length of the field.

    What is of corners is in units of their noise. Unknowns are those of the chains, breathing, and
    the field's modes: q in all.

    Attributes:
        rows: How many residuals there are.
        information: (q, q), the errors of single views being zero.
        gradient: (q,).
        cost: The squared error.
        local: (v, l, l) on the errors of single views: of flanges, and then of the focus.
        cross: (v, l, q).
        pulls: (v, l).
        kinds: (v, l) the level of each; -1 for none.
        known: (t, t) what all else says of the chains' unknowns.
        known_gradient: (t,).
        noise_px: (2,) what lens, board and field leave of the corners, all free, and what lens and
            board alone do.
        flanges: How many robots there are.
    """

    rows: float
    information: FloatArray
    gradient: FloatArray
    cost: float
    local: FloatArray
    cross: FloatArray
    pulls: FloatArray
    kinds: IntArray
    known: FloatArray
    known_gradient: FloatArray
    noise_px: tuple[float, float]
    flanges: int

    @cached_property
    def modes(self) -> IntArray:
        """(m,) the levels of the unknowns behind the chains'."""
        found = np.full(len(self.gradient) - len(self.known), _FIELD)
        found[0] = _BREATHING
        return found

    @cached_property
    def counts(self) -> FloatArray:
        """How many random values each level has; of the corners' noise, none."""
        every = np.concatenate([self.kinds[self.kinds >= 0], self.modes])
        return np.bincount(every, minlength=_FLANGES + 2 * self.flanges).astype(float)

    @cached_property
    def _members(self) -> tuple[FloatArray, FloatArray]:
        """Of which level each value is: (v, l, k) of single views, (q, k) of the unknowns."""
        levels = np.flatnonzero(self.counts)
        modes = np.zeros((len(self.gradient), len(levels)))
        modes[len(self.known) :] = self.modes[:, None] == levels
        return (self.kinds[:, :, None] == levels).astype(float), modes

    def __call__(self, logs: FloatArray, *, is_sloped: bool = True) -> LikelihoodValue:
        """The negative logarithm, its slope and its second derivative, or zeros for these two."""
        # Where that is not positive, the average information takes its place (Gilmour, Thompson and
        # Cullis 1995): it never is negative.
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
        known = np.diag(information)
        # Of what nothing is known, the ridge below is.
        scale = 1.0 / np.sqrt(np.where(known > _RIDGE**2, known, 1.0))
        factor = _factor(information * np.outer(scale, scale))
        covariance = cho_solve(factor, np.diag(scale), check_finite=False) * scale[:, None]
        best = -covariance @ gradient
        pulled = (inverse @ pulls[:, :, None])[:, :, 0]
        single = -pulled - taken @ best
        squared = weight * self.cost + gradient @ best - float(np.sum(pulls * pulled))
        determinants = 2.0 * float(np.log(np.diag(factor[0])).sum() - np.log(scale).sum())
        determinants += 2.0 * float(np.log(root[:, diagonal, diagonal]).sum() + self.counts @ logs)
        value = 0.5 * float(self.rows * 2.0 * logs[_NOISE] + determinants + squared)
        slope, curvature = np.zeros(len(logs)), np.zeros((len(logs),) * 2)
        ratios = ratio_prior(range(self.flanges), _FLANGES)
        if not is_sloped:
            return ratios.beside(LikelihoodValue(value, slope, curvature), logs)
        # Where a level's values are, and how well they are known: in units of the level.
        levels = np.flatnonzero(self.counts)
        singles, modes = self._members
        of_single, of_modes = single[:, :, None] * singles, best[:, None] * modes
        sizes = np.sum(of_single**2, axis=(0, 1)) + np.sum(of_modes**2, axis=0)
        # One product of a tall matrix: by views it takes several times as long.
        spread_out = (taken.reshape(-1, len(best)) @ covariance).reshape(taken.shape)
        in_common = spread_out @ np.swapaxes(taken, 1, 2)
        own = np.diagonal(inverse + in_common, axis1=1, axis2=2)
        spread = np.tensordot(own, singles, axes=2) + np.diag(covariance) @ modes
        sizes, spread = sizes / variances[levels], spread / variances[levels]
        slope = self.counts.copy()
        slope[levels] -= sizes + spread
        # The rest of the squared error and of the freedom is the corners'.
        stated = best[:t] @ (self.known @ best[:t] + 2.0 * self.known_gradient)
        left = squared - sizes.sum() - stated
        freedom = len(best) + is_random.sum() - np.sum(self.known * covariance[:t, :t])
        slope[_NOISE] = self.rows - left - freedom + spread.sum()
        # What the residuals move with each level, that of the corners being what is left of them.
        by_single = (weight * self.local) @ of_single + cross @ of_modes
        by_modes = weight * (self.information @ of_modes) + gram(cross, of_single)
        products = np.tensordot(of_single, by_single, axes=([0, 1], [0, 1])) + of_modes.T @ by_modes
        rest = pulls + ((weight * self.local) @ single[:, :, None])[:, :, 0] + cross @ best
        rest_modes = weight * (self.gradient + self.information @ best) + gram(cross, single)
        by_single = np.concatenate([rest[:, :, None], -by_single], axis=2)
        by_modes = np.column_stack([rest_modes, -by_modes])
        crossed = np.tensordot(rest, of_single, axes=([0, 1], [0, 1])) + rest_modes @ of_modes
        moved = np.block([[np.atleast_2d(left), -crossed], [-crossed[:, None], products]])
        followed = inverse @ by_single
        by_modes -= gram(cross, followed)
        moved -= gram(by_single, followed) + by_modes.T @ covariance @ by_modes
        expected = self._expected(
            covariance, taken, inverse, in_common, spread, self.rows - freedom + spread.sum(), logs
        )
        places = np.append(_NOISE, levels)
        second = 4.0 * moved - expected + 2.0 * np.diag(slope[places])
        if np.linalg.eigvalsh(second)[0] <= 0.0:
            second = 2.0 * moved
        curvature[np.ix_(places, places)] = second
        return ratios.beside(LikelihoodValue(value, slope, curvature), logs)

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
        """What is expected of the second derivative: half the traces of P V_k P V_l.

        Those with the corners' noise follow from P V P = P.

        Args:
            covariance: (q, q) of the unknowns.
            taken: (v, l, q) how errors of single views follow them.
            inverse: (v, l, l) the covariance of these errors, the unknowns being known.
            in_common: (v, l, l) what the unknowns add to it.
            spread: (k,) the levels' covariances over their variances.
            of_corners: The same of the corners' freedom.
            logs: The logarithms of the levels.

        Returns:
            (1 + k, 1 + k) of the corners' noise, and of the levels that anything has.
        """
        t, levels, variances = len(self.known), np.flatnonzero(self.counts), np.exp(2.0 * logs)
        singles, modes = self._members
        among_rows = [taken[self.kinds == level] for level in levels.tolist()]
        turned = np.array([covariance @ (row.T @ row) for row in among_rows])
        of_one_view = (inverse * (inverse + 2.0 * in_common)) @ singles
        both = np.tensordot(singles, of_one_view, axes=([0, 1], [0, 1]))
        both += np.tensordot(turned, turned, axes=([1, 2], [2, 1]))
        of_rows = np.sum(turned * covariance, axis=2) @ modes
        both += of_rows + of_rows.T + modes.T @ covariance**2 @ modes
        among = np.diag(self.counts[levels] - 2.0 * spread)
        among += both / np.outer(variances[levels], variances[levels])
        held = self.known @ covariance[:t]
        by_held = np.tensordot(turned[:, :t], held, axes=2)
        by_held = (by_held + np.sum(held * covariance[:t], axis=0) @ modes) / variances[levels]
        of_noise = 2.0 * (self.counts[levels] - spread - among.sum(axis=0) - by_held)
        inner = held[:, :t]
        of_held = np.trace(inner) - np.sum(inner * inner.T) - by_held.sum()
        alone = 2.0 * of_corners - of_noise.sum() - of_held
        return np.block([[np.atleast_2d(alone), of_noise], [of_noise[:, None], 2.0 * among]])

    def minimised(
        self, logs: FloatArray, closed: tuple[int, ...], enough: float = np.inf
    ) -> tuple[float, FloatArray]:
        """The most likely logarithms, some of them closed to what is least; the value first."""
        low, high = self.limits(closed)
        hardly = HARDLY * np.maximum(self.counts, 1.0)
        start = np.clip(logs, low, high)
        logs, found = most_likely(self, start, low, high, enough=enough, hardly=hardly)
        # Levels that hardly count still fall, by ever smaller gains: to nothing at once.
        for level in (_FIELD, _BREATHING, _JITTER):
            if found.gradient[level] <= 0.0 or logs[level] <= low[level]:
                continue
            without = logs.copy()
            without[level] = low[level]
            other = self(without)
            if other.value <= found.value:
                logs, found = without, other
        return found.value, logs

    def gain(self, logs: FloatArray, value: float, closed: tuple[int, ...], level: int) -> float:
        """By how much twice the logarithm falls from a value without a level."""
        without, least = logs.copy(), self.limits((*closed, level))[0][level]
        if logs[level] <= least:
            return 0.0
        without[level] = least
        most = 2.0 * (self(without, is_sloped=False).value - value)
        # What the others can take over is asked only where it matters.
        if most < SIGNIFICANT:
            return most
        return 2.0 * (self.minimised(without, (*closed, level))[0] - value)

    def limits(self, closed: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Least and largest logarithms of the levels."""
        low = np.repeat([_FLANGE_RANGE[0]], _FLANGES + 2 * self.flanges)
        high = np.repeat([_FLANGE_RANGE[1]], len(low))
        low[_NOISE], high[_NOISE] = np.multiply(_NOISE_RANGE, self.noise_px)
        low[_FIELD : _JITTER + 1] = np.multiply(_LEAST, (self.noise_px[0], 1.0, 1.0))
        high[_FIELD : _JITTER + 1] = _MOST
        high[[*closed]] = low[[*closed]]
        return np.log(low), np.log(high)


def are_beyond(levels: LensLevels, sigma_px: float) -> bool:
    """Whether levels are larger than any lens has them, by the corners' noise of a fit with them.

    They are in units of that noise: where poses run away with them, both grow.
    """
    sizes = sigma_px * np.array([levels.field, levels.breathing, levels.jitter])
    # Noise is estimated anew, and differs by some percent.
    return bool(np.any(sizes > 1.2 * np.array(_MOST)))


def estimate_levels(
    seen: LinearisedCorners,
    problem: Problem,
    rows: IntArray,
    state: State,
    noise: Noise,
    camera: str,
) -> LensLevels:
    """Estimates the sizes of what one camera's lens does beyond its model.

    Args:
        seen: The corners of all cameras, all values of lenses and boards open.
        problem: The observations that agree, with these corners.
        rows: (n,) which of the views each observation is; -1 for none of them.
        state: Where they were linearised.
        noise: The levels of robots and sensors.
        camera: Which camera.
    """
    mine = seen.camera_parameters.problems[camera]
    if not mine.has_spare_corners:
        return LensLevels()
    found = _rows(seen, problem, rows, state, noise, camera)
    is_open = len(np.unique(found.chained)) >= _FEWEST_STOPS and not mine.scene.is_focus_fixed
    closed = () if is_open else (_BREATHING, _JITTER)
    before = mine.levels
    at = _FIRST if before is None else _LENGTHS.index(before.length)
    likelihood = _assembled(found, _LENGTHS[at], len(noise.robots))
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
            other = _assembled(found, _LENGTHS[best[2] + step], len(noise.robots))
            value, there = other.minimised(best[1], closed, best[0] - _GAIN)
            if value > best[0] - _GAIN:
                break
            best = value, there, best[2] + step, other
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
    """Cholesky's factor of a matrix of unit diagonal; what rounding made negative is raised."""
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
    mine, poses = optics.problems[camera], optics.poses[of_camera]
    shape = mine.basis[mine.stack.ids]
    stack = mine.stack.with_points(mine.stack.points + shape @ optics.values[optics.boards])
    stack, lens = replace(stack, zooms=None), optics.camera(camera)
    now = reproject(stack, lens, poses)
    focus = zooms(stack, lens)
    breath = distances(stack, poses)[stack.view_of][:, None] * focus
    by_board = now.by_point @ shape
    stack.weigh(focus, breath, by_board)
    columns = [now.by_intrinsics, by_board, *(
        array[:, :, None] for array in (breath, focus, now.residuals)
    )]  # fmt: skip
    every = np.concatenate(columns, axis=2)
    here = np.flatnonzero((rows >= of_camera.start) & (rows < of_camera.stop))
    linear, (of, members) = problem.linear(state), problem.units
    jacobian = linear.jacobian_of(here)
    places = problem.effect_columns[LENSES].start + np.searchsorted(
        seen.free, optics.places(camera)
    )
    others = np.ones(len(problem), dtype=bool)
    others[here] = False
    known, gradient = normal_equations(problem, state, noise, among=others)
    weight = floored_sigma_px(seen.sigmas_px[which]) ** -2.0
    known[np.ix_(places, places)] -= weight * seen.compressed[which].shared_information
    gradient[places] -= weight * seen.compressed[which].shared_gradient
    kept = problem.moving & jacobian.any(axis=(0, 1))
    kept[places] = problem.moving[places]
    # What the fit took for this lens's errors is what is asked for anew: it has no place beside.
    sizes = [compressed.by_field.shape[2] for compressed in seen.compressed]
    first = problem.effect_columns[LENSES].start + len(seen.free) + sum(sizes[:which])
    kept[first : first + sizes[which]] = False
    known, gradient = _without(known, gradient, problem.moving & ~kept, kept)
    return _Rows(
        stack,
        lens,
        WithoutPoses.of(stack, now.by_pose, every, mine.shares),
        rows[here] - of_camera.start,
        jacobian[:, :, kept],
        linear.by_errors[here],
        linear.residuals[here],
        np.where((of[here] >= 0)[:, None], members[of[here]], -1),
        np.searchsorted(np.flatnonzero(kept), places),
        known,
        gradient,
    )


def _without(
    known: FloatArray, gradient: FloatArray, out: Mask, kept: Mask
) -> tuple[FloatArray, FloatArray]:
    """Information and gradient on what is kept, once what is out has followed."""
    inner, rest = known[np.ix_(kept, kept)], gradient[kept]
    if not out.any():
        return inner, rest
    between = known[np.ix_(kept, out)]
    taken = between @ covariance_from(known[np.ix_(out, out)])
    return inner - taken @ between.T, rest - taken @ gradient[out]


def _assembled(rows: _Rows, length: float, robots: int) -> _Likelihood:
    """The likelihood at one length of the field."""
    stack, without = rows.stack, rows.without
    modes = field_modes(stack.px, rows.camera.resolution, length)
    answer, products = without.with_modes(modes)
    # Behind lens, board and breathing stand a change of the focus and the residuals.
    focus = without.left.shape[2] - 2
    residual, shared = focus + 1, np.r_[:focus, focus + 2 : len(products)]
    by_focus = without.by_view(focus, modes)
    views, chained, t, q = len(stack.views), rows.chained, len(rows.known), len(shared)
    size = t + q - len(rows.places)
    columns = np.concatenate([rows.places, np.arange(t, size)])
    among, pulled = products[np.ix_(shared, shared)], products[shared, residual]
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[np.ix_(columns, columns)], gradient[columns] = among, pulled
    # Chains: poses follow lens, board, field and focus, and are the best ones.
    following = answer[chained]
    jacobian = np.zeros((len(chained), 6, size))
    jacobian[:, :, :t] = rows.jacobian
    jacobian[:, :, columns] = following[:, :, shared]
    away = rows.away + following[:, :, residual]
    # Repeats of still frames share an error, too: here each counts by itself.
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
    pulls[chained] += (turned @ away[:, :, None])[:, :, 0]
    flanges = np.repeat(_FLANGES + 2 * rows.robots, 6, axis=1) + np.tile(
        np.repeat([0, 1], 3), rows.robots.shape[1]
    )
    kinds[chained, :-1] = np.where(by_flanges < 0, -1, flanges)
    inner, cost = among + np.diag(_RIDGE + 1e-6 * np.diag(among)), products[residual, residual]
    # Of images that show the same, all count as one.
    freedom = float(without.roots**2 @ (2 * stack.counts - 6))

    def left_px(of: int) -> float:
        rest = cost - pulled[:of] @ np.linalg.solve(inner[:of, :of], pulled[:of])
        return floored_sigma_px(float(np.sqrt(max(rest, 0.0) / max(freedom - of, 1.0))))

    return _Likelihood(
        freedom + 6 * len(chained),
        information + gram(jacobian, weights @ jacobian),
        gradient + gram(jacobian, (weights @ away[:, :, None])[:, :, 0]),
        float(cost + np.einsum("oi,oij,oj->", away, weights, away)),
        local,
        cross,
        pulls,
        kinds,
        rows.known,
        rows.gradient,
        (left_px(q), left_px(focus)),
        robots,
    )

"""Sizes of what lenses do beyond their models, by restricted likelihood (REML).

The corners of one camera and the chains of frames through it are linearised once. Random are the
field's modes, breathing, one change of focus a view, and one error of each flange a stop; free are
frames, lens, board and whatever else the fit moves. Errors of single views are eliminated view by
view, so that an evaluation of the likelihood costs one Cholesky of some hundred unknowns.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from visioncal.core.errors import ConvergenceError
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.corners import CornerStack, floored_sigma_px, reproject
from visioncal.estimation.effects.lenses import LENSES, LinearisedCorners
from visioncal.estimation.lens_field import LensLevels, distances, field_columns, zooms
from visioncal.estimation.linalg import covariance_from, gram
from visioncal.estimation.parts import Noise, State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import RATIO_PRIOR, normal_equations

# Lengths of the field that are tried, as shares of the image's width, from the third on; another
# one has to gain so much.
_LENGTHS, _FIRST, _GAIN = (0.07, 0.12, 0.2), 2, 0.5
# A field is no larger [px], and no change of focus with the distance or from view to view, as a
# share: autofocus repeats to some 0.1 %. The noise of corners is about what lens, board and field,
# all free, leave of them.
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
_ROUNDS, _LONGEST_STEP = 8, 1.0


@dataclass(frozen=True, eq=False)
class _Rows:
    """One camera's corners and chains where they were linearised, o chains of v views.

    Attributes:
        stack: The corners, without effects of the focus.
        camera: The lens.
        columns: (n, 2, c) by lens, board and breathing.
        by_pose: (n, 2, 6).
        residuals: (n, 2).
        information: (v, 6, 6) on the poses.
        roots: (v,) by which share of a view each counts, as a root.
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
    columns: FloatArray
    by_pose: FloatArray
    residuals: FloatArray
    information: FloatArray
    roots: FloatArray
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
        noise_px: What lens, board and field leave of the corners, all free.
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
    noise_px: float
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

    def __call__(self, logs: FloatArray) -> tuple[float, FloatArray]:
        """The negative logarithm, and its slope."""
        t, variances, is_random = len(self.known), np.exp(2.0 * logs), self.kinds >= 0
        weight, behind = 1.0 / variances[_NOISE], np.arange(t, len(self.gradient))
        precision = np.where(is_random, 1.0 / variances[self.kinds], 1.0)
        prior = 1.0 / variances[self.modes]
        local = weight * self.local
        diagonal = np.arange(local.shape[1])
        local[:, diagonal, diagonal] += precision
        inverse = np.linalg.inv(local)
        taken = inverse @ (weight * self.cross)
        information = weight * (self.information - gram(self.cross, taken))
        information[:t, :t] += self.known
        information[behind, behind] += prior
        gradient = weight * (self.gradient - gram(taken, self.pulls))
        gradient[:t] += self.known_gradient
        known = np.diag(information)
        # Of what nothing is known, the ridge below is.
        scale = 1.0 / np.sqrt(np.where(known > _RIDGE**2, known, 1.0))
        factor = _factor(information * np.outer(scale, scale))
        covariance = cho_solve(factor, np.diag(scale), check_finite=False) * scale[:, None]
        best = -covariance @ gradient
        pulled = (inverse @ self.pulls[:, :, None])[:, :, 0]
        single = -weight * pulled - taken @ best
        squared = weight * self.cost + gradient @ best
        squared -= weight**2 * float(np.sum(self.pulls * pulled))
        determinants = 2.0 * float(np.log(np.diag(factor[0])).sum() - np.log(scale).sum())
        determinants += float(np.linalg.slogdet(local)[1].sum() + 2.0 * self.counts @ logs)
        # Where a level's values are, and how well they are known: in units of the level.
        flat = taken.reshape(-1, len(best))
        spread = np.einsum("np,np->n", flat @ covariance, flat).reshape(single.shape)
        spread += np.diagonal(inverse, axis1=1, axis2=2)
        of_single, of_modes = precision * single**2, prior * best[t:] ** 2
        open_single, open_modes = precision * spread, prior * np.diag(covariance)[t:]
        slope = self.counts.copy()
        np.subtract.at(slope, self.kinds[is_random], (of_single + open_single)[is_random])
        np.subtract.at(slope, self.modes, of_modes + open_modes)
        # The rest of the squared error and of the freedom is the corners'.
        stated = best[:t] @ (self.known @ best[:t] + 2.0 * self.known_gradient)
        left = squared - of_single[is_random].sum() - of_modes.sum() - stated
        freedom = len(best) + is_random.sum() - np.sum(self.known * covariance[:t, :t])
        freedom -= open_single[is_random].sum() + open_modes.sum()
        slope[_NOISE] = self.rows - left - freedom
        lean = (np.diff(logs[_FLANGES:])[::2] - np.log(RATIO_PRIOR.ratio)) / RATIO_PRIOR.log_sigma
        slope[_FLANGES:] += np.outer(lean, [-1.0, 1.0]).ravel() / RATIO_PRIOR.log_sigma
        value = 0.5 * (self.rows * 2.0 * logs[_NOISE] + determinants + squared + lean @ lean)
        return float(value), slope

    def minimised(self, logs: FloatArray, closed: tuple[int, ...]) -> tuple[float, FloatArray]:
        """The most likely logarithms, some of them closed to what is least; the value first."""
        from scipy.optimize import minimize

        low, high = self.limits(closed)
        options = {"maxiter": 40, "ftol": 1e-8}
        logs = np.clip(logs, low, high)
        for _ in range(_ROUNDS):
            # A long step up may end where all is noise of the focus, and stay there.
            most = np.minimum(logs + _LONGEST_STEP, high)
            bounds = list(zip(low, most, strict=True))
            found = minimize(
                self, logs, jac=True, method="L-BFGS-B", bounds=bounds, options=options
            )
            logs = np.asarray(found.x)
            if not np.any((logs >= most) & (most < high)):
                break
        return float(found.fun), logs

    def gain(self, logs: FloatArray, value: float, closed: tuple[int, ...], level: int) -> float:
        """By how much twice the logarithm falls from a value without a level."""
        without = logs.copy()
        without[level] = self.limits((*closed, level))[0][level]
        most = 2.0 * (self(without)[0] - value)
        # What the others can take over is asked only where it matters.
        if most < SIGNIFICANT:
            return most
        return 2.0 * (self.minimised(without, (*closed, level))[0] - value)

    def limits(self, closed: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Least and largest logarithms of the levels."""
        low = np.repeat([_FLANGE_RANGE[0]], _FLANGES + 2 * self.flanges)
        high = np.repeat([_FLANGE_RANGE[1]], len(low))
        low[_NOISE], high[_NOISE] = np.multiply(_NOISE_RANGE, self.noise_px)
        low[_FIELD : _JITTER + 1] = np.multiply(_LEAST, (self.noise_px, 1.0, 1.0))
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
    mine = seen.looks.problems[camera]
    if not mine.has_spare_corners:
        return LensLevels()
    found = _rows(seen, problem, rows, state, noise, camera)
    is_open = len(np.unique(found.chained)) >= _FEWEST_STOPS and not mine.scene.is_focus_fixed
    closed = () if is_open else (_BREATHING, _JITTER)
    at, before = _FIRST, mine.levels
    likelihood = _assembled(found, _LENGTHS[at], len(noise.robots))
    if likelihood.noise_px > _WRONG_PX:
        return LensLevels()
    sizes = np.array([1.0, _START[0], 0.0, 0.0]) * likelihood.noise_px + [0.0, 0.0, *_START[1:]]
    if before is not None:
        at = _LENGTHS.index(before.length)
        likelihood = _assembled(found, _LENGTHS[at], len(noise.robots))
        sizes = likelihood.noise_px * np.array([1.0, before.field, before.breathing, before.jitter])
        sizes = np.maximum(sizes, 0.1 * np.array([0.0, _START[0] * sizes[0], *_START[1:]]))
    logs = np.log(np.concatenate([sizes, np.maximum(noise.robots, 1e-6).ravel()]))
    best = (*likelihood.minimised(logs, closed), at, likelihood)
    for step in (1, -1):
        while 0 <= best[2] + step < len(_LENGTHS):
            other = _assembled(found, _LENGTHS[best[2] + step], len(noise.robots))
            value, there = other.minimised(best[1], closed)
            if value > best[0] - _GAIN:
                break
            best = value, there, best[2] + step, other
    _, logs, at, likelihood = best
    sizes = np.exp(logs[: _JITTER + 1])
    low = np.exp(likelihood.limits(closed)[0][: _JITTER + 1])
    field, breathing, jitter = np.where(sizes > 2.0 * low, sizes, 0.0)[1:] / sizes[_NOISE]
    gains = [
        0.0 if it in closed else likelihood.gain(logs, best[0], closed, it)
        for it in (_FIELD, _BREATHING, _JITTER)
    ]
    return LensLevels(
        float(field), _LENGTHS[at], float(breathing), float(jitter), (gains[0], gains[1], gains[2])
    )


def _factor(scaled: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky's factor of a matrix of unit diagonal; what rounding made negative is raised.

    Raises:
        ConvergenceError: It is far from positive: the fit behind it has run away.
    """
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
    looks, which = seen.looks, list(seen.looks.problems).index(camera)
    of_camera = looks.rows(camera)
    mine, poses = looks.problems[camera], looks.poses[of_camera]
    shape = mine.basis[mine.stack.ids]
    stack = mine.stack.with_points(mine.stack.points + shape @ looks.values[looks.boards])
    stack, lens = replace(stack, zooms=None), looks.camera(camera)
    now = reproject(stack, lens, poses)
    breath = distances(stack, poses)[stack.view_of][:, None] * zooms(stack, lens)
    by_board = now.by_point @ shape
    stack.weigh(breath, by_board)
    here = np.flatnonzero((rows >= of_camera.start) & (rows < of_camera.stop))
    linear, (of, members) = problem.linear(state), problem.units
    jacobian = linear.jacobian[here]
    places = problem.effect_columns[LENSES].start + np.searchsorted(seen.free, looks.places(camera))
    known, gradient = _by_others(problem, here, state, noise)
    weight = floored_sigma_px(seen.sigmas_px[which]) ** -2.0
    known[np.ix_(places, places)] -= weight * seen.compressed[which].shared_information
    gradient[places] -= weight * seen.compressed[which].shared_gradient
    kept = problem.moving & jacobian.any(axis=(0, 1))
    kept[places] = problem.moving[places]
    known, gradient = _without(known, gradient, problem.moving & ~kept, kept)
    return _Rows(
        stack,
        lens,
        np.concatenate([now.by_intrinsics, by_board, breath[:, :, None]], axis=2),
        now.by_pose,
        now.residuals,
        stack.products_by_view(now.by_pose, now.by_pose),
        np.sqrt(mine.shares),
        rows[here] - of_camera.start,
        jacobian[:, :, kept],
        linear.by_errors[here],
        linear.residuals[here],
        np.where((of[here] >= 0)[:, None], members[of[here]], -1),
        np.searchsorted(np.flatnonzero(kept), places),
        known,
        gradient,
    )


def _by_others(
    problem: Problem, here: IntArray, state: State, noise: Noise
) -> tuple[FloatArray, FloatArray]:
    """Information (p, p) and gradient (p,) of all but the rows of one camera."""
    others = np.ones(len(problem), dtype=bool)
    others[here] = False
    if others.any():
        known, gradient = normal_equations(problem.subset(others), state, noise)
    else:
        knowledge = problem.knowledge(state)
        known, gradient = knowledge.information, knowledge.gradient
    return known, gradient


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
    stack, own = rows.stack, len(rows.places)
    modes = field_columns(stack.px, rows.camera.resolution, length)
    focus = zooms(stack, rows.camera)
    stack.weigh(modes, focus)
    every = np.concatenate(
        [rows.columns, modes, focus[:, :, None], rows.residuals[:, :, None]], axis=2
    )
    answer = -covariance_from(rows.information) @ stack.products_by_view(rows.by_pose, every)
    left = every + stack.products_with_views(rows.by_pose, answer)
    left *= rows.roots[stack.view_of, None, None]
    flat = left.reshape(-1, left.shape[2])
    products = flat.T @ flat
    by_focus = stack.products_by_view(left[:, :, -2:-1], left)[:, 0]
    views, chained, t, q = len(stack.views), rows.chained, len(rows.known), every.shape[2] - 2
    size = t + q - own
    columns = np.concatenate([rows.places, np.arange(t, size)])
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[np.ix_(columns, columns)] = products[:q, :q]
    gradient[columns] = products[:q, -1]
    # Chains: poses follow lens, board, field and focus, and are the best ones.
    jacobian = np.zeros((len(chained), 6, size))
    jacobian[:, :, :t] = rows.jacobian
    jacobian[:, :, columns] = answer[chained][:, :, :q]
    away = rows.away + answer[chained][:, :, -1]
    # Repeats of still frames share an error, too: here each counts by itself.
    by_flanges = np.repeat(rows.robots, 6, axis=1)
    of_flanges = np.where(by_flanges[:, None] < 0, 0.0, rows.by_errors)
    errors = np.concatenate([of_flanges, answer[chained][:, :, q : q + 1]], axis=2)
    weights = rows.information[chained]
    turned = np.swapaxes(errors, 1, 2) @ weights
    width = errors.shape[2]
    local, cross = np.zeros((views, width, width)), np.zeros((views, width, size))
    pulls, kinds = np.zeros((views, width)), np.full((views, width), -1)
    local[:, -1, -1], cross[:, -1, columns] = by_focus[:, q], by_focus[:, :q]
    pulls[:, -1], kinds[:, -1] = by_focus[:, -1], _JITTER
    local[chained] += turned @ errors
    cross[chained] += turned @ jacobian
    pulls[chained] += (turned @ away[:, :, None])[:, :, 0]
    flanges = np.repeat(_FLANGES + 2 * rows.robots, 6, axis=1) + np.tile(
        np.repeat([0, 1], 3), rows.robots.shape[1]
    )
    kinds[chained, :-1] = np.where(by_flanges < 0, -1, flanges)
    inner = products[:q, :q] + np.diag(_RIDGE + 1e-6 * np.diag(products)[:q])
    rest = products[-1, -1] - products[:q, -1] @ np.linalg.solve(inner, products[:q, -1])
    # Of images that show the same, all count as one.
    freedom = float(rows.roots**2 @ (2 * stack.counts - 6))
    return _Likelihood(
        freedom + 6 * len(chained),
        information + gram(jacobian, weights @ jacobian),
        gradient + gram(jacobian, (weights @ away[:, :, None])[:, :, 0]),
        float(products[-1, -1] + np.einsum("oi,oij,oj->", away, weights, away)),
        local,
        cross,
        pulls,
        kinds,
        rows.known,
        rows.gradient,
        floored_sigma_px(float(np.sqrt(rest / max(freedom - q, 1.0)))),
        robots,
    )

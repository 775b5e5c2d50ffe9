"""Variance components of lens errors that the lens model does not describe, by REML.

The corners of one camera and its observations (the chains of frames through it) are linearised
once. Random effects are the modes of the distortion field, focus breathing, one focus jitter a
view, and one error of each flange a stop; fixed effects are frames, lens, board and whatever else
the fit moves. Errors of single views are eliminated view by view, so that an evaluation of the
restricted likelihood costs one Cholesky factorisation of some hundred unknowns.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.estimation.effects.lenses import LENSES, LinearisedCorners
from visioncal.estimation.lens_field import LensLevels, distances, field_modes, zooms
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.mixed import HARDLY, CommonRows, MixedEstimate, MixedModel, Units
from visioncal.estimation.normal_equations import normal_equations
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import ratio_prior

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
    """Restricted likelihood of the levels' logarithms, at one correlation length of the field."""

    model: MixedModel  # Sizes are the levels.
    counts: FloatArray  # (k,) number of random values of each level; zero for the corner noise.
    # RMS corner residuals with lens, board and field all free, and with lens and board alone [px].
    noise_px: tuple[float, float]

    def minimised(
        self, logs: FloatArray, closed: tuple[int, ...], enough: float = np.inf
    ) -> MixedEstimate:
        """The most likely levels; `closed` ones stay at their lower bounds."""
        low, high = self.limits(closed)
        hardly = HARDLY * np.maximum(self.counts, 1.0)
        found = self.model.maximised(logs, low, high, enough=enough, hardly=hardly)
        # Insignificant levels decrease by ever smaller gains: tries their lower bounds directly.
        for level in (_FIELD, _BREATHING, _JITTER):
            if found.gradient[level] <= 0.0 or found.logs[level] <= low[level]:
                continue
            without = found.logs.copy()
            without[level] = low[level]
            candidate = self.model.at(without)
            if candidate.value <= found.value:
                found = candidate
        return found

    def gain(self, found: MixedEstimate, closed: tuple[int, ...], level: int) -> float:
        """Likelihood-ratio statistic of one level, against its lower bound."""
        without, least = found.logs.copy(), self.limits((*closed, level))[0][level]
        if without[level] <= least:
            return 0.0
        without[level] = least
        upper_bound = 2.0 * (self.model.at(without, is_sloped=False).value - found.value)
        # The other levels are only refitted where it matters.
        if upper_bound < SIGNIFICANT:
            return upper_bound
        return 2.0 * (self.minimised(without, (*closed, level)).value - found.value)

    def limits(self, closed: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the levels' logarithms."""
        low = np.repeat([_FLANGE_RANGE[0]], len(self.counts))
        high = np.repeat([_FLANGE_RANGE[1]], len(low))
        low[_NOISE], high[_NOISE] = np.multiply(_NOISE_RANGE, self.noise_px)
        low[_FIELD : _JITTER + 1] = np.multiply(_LEAST, (self.noise_px[0], 1.0, 1.0))
        high[_FIELD : _JITTER + 1] = _MOST
        high[[*closed]] = low[[*closed]]
        return np.log(low), np.log(high)


def are_beyond(levels: LensLevels, sigma_px: float, share: float = 1.2) -> bool:
    """Whether levels exceed those of any real lens, given the corner noise of a fit with them.

    They are in units of that noise: both grow where the poses diverge.
    """
    sizes = sigma_px * np.array([levels.field, levels.breathing, levels.jitter])
    # The noise was estimated again, and differs by some percent.
    return bool(np.any(sizes > share * np.array(_MOST)))


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
    found = likelihood.minimised(logs, closed)
    for step in (1, -1):
        while 0 <= at + step < len(_LENGTHS):
            candidate = _assembled(linearised, _LENGTHS[at + step], len(noise.robots))
            other = candidate.minimised(found.logs, closed, found.value - _GAIN)
            if other.value > found.value - _GAIN:
                break
            found, at, likelihood = other, at + step, candidate
    sizes = np.exp(found.logs[: _JITTER + 1])
    low = np.exp(likelihood.limits(closed)[0][: _JITTER + 1])
    field, breathing, jitter = np.where(sizes > 2.0 * low, sizes, 0.0)[1:] / sizes[_NOISE]
    gains = [likelihood.gain(found, closed, index) for index in (_FIELD, _BREATHING, _JITTER)]
    return LensLevels(
        float(field), _LENGTHS[at], float(breathing), float(jitter), (gains[0], gains[1], gains[2])
    )


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
    """Assembles the likelihood at one correlation length of the field.

    A view is a unit of seven rows: its observation, of the pose that is the best one for given
    lens, board, field and focus, and its own estimate of its focus. What its corners tell beside
    these depends on the common unknowns alone: those of the observations, breathing, and the
    field's modes.
    """
    stack, without, chained = rows.stack, rows.without, rows.chained
    modes = field_modes(stack.px, rows.camera.resolution, length)
    answer, products = without.with_modes(modes)
    # Columns: lens, board, breathing, a change of focus, residuals, and the modes.
    focus = without.left.shape[2] - 2
    residual, shared = focus + 1, np.r_[:focus, focus + 2 : len(products)]
    by_focus = without.by_view(focus, modes)
    views, t, levels = len(stack.views), len(rows.known), _FLANGES + 2 * robots
    size = t + len(shared) - len(rows.places)
    columns = np.concatenate([rows.places, np.arange(t, size)])
    noise, known_noise = np.zeros((2, views, 7, 7))
    jacobian, residuals = np.zeros((views, 7, size)), np.zeros((views, 7))
    # Views without an observation have no pose rows; theirs are of no consequence.
    known_noise[:, :6, :6] = np.eye(6)
    known_noise[chained] = 0.0
    noise[chained, :6, :6] = without.inverse[chained]
    # Lens and board move the measured poses, as breathing and the field do.
    following = np.zeros((len(chained), 6, size))
    following[:, :, :t], following[:, :, columns] = rows.jacobian, answer[chained][:, :, shared]
    jacobian[chained, :6] = following
    residuals[chained, :6] = rows.away + answer[chained, :, residual]
    zoomed = np.zeros((views, 7))
    zoomed[chained, :6] = answer[chained, :, focus]
    zoomed[:, 6] = 1.0
    # Corners of a view without extent do not determine its focus.
    focus_information = np.maximum(by_focus[:, focus], _RIDGE)
    noise[:, 6, 6] = 1.0 / focus_information
    jacobian[:, 6, columns] = by_focus[:, shared] / focus_information[:, None]
    residuals[:, 6] = by_focus[:, residual] / focus_information
    parts = np.zeros((2 + 2 * robots, views, 7, 7))
    parts[0], parts[1] = noise, zoomed[:, :, None] * zoomed[:, None, :]
    # Repeats of stationary frames share an error, too, but are taken as independent here.
    for slot, of_slot in enumerate(rows.robots.T):
        seen = np.flatnonzero(of_slot >= 0)
        for axes in (0, 1):
            moved = rows.by_errors[seen, :, 6 * slot + 3 * axes : 6 * slot + 3 * axes + 3]
            parts[2 + 2 * of_slot[seen] + axes, chained[seen], :6, :6] += moved @ np.swapaxes(
                moved, 1, 2
            )
    by_shared = by_focus[:, shared]
    shared_products = products[np.ix_(shared, shared)] - by_shared.T @ (
        by_shared / focus_information[:, None]
    )
    pulled = products[shared, residual] - residuals[:, 6] @ by_shared
    information, gradient = np.zeros((size, size)), np.zeros(size)
    information[np.ix_(columns, columns)], gradient[columns] = shared_products, pulled
    among, cost = products[np.ix_(shared, shared)], products[residual, residual]
    inner = among + np.diag(_RIDGE + 1e-6 * np.diag(among))
    # Images that repeat the same view count as one.
    freedom = float(without.roots**2 @ (2 * stack.counts - 6))

    def left_px(free: int) -> float:
        pull = products[shared[:free], residual]
        rest = cost - pull @ np.linalg.solve(inner[:free, :free], pull)
        return floored_sigma_px(float(np.sqrt(max(rest, 0.0) / max(freedom - free, 1.0))))

    shares = np.zeros((size, levels))
    shares[t, _BREATHING] = shares[t + 1 :, _FIELD] = 1.0
    of_corners = CommonRows(
        information, gradient, float(cost - by_focus[:, residual] @ residuals[:, 6]),
        freedom - views, _NOISE,
    )  # fmt: skip
    known = CommonRows(rows.known, rows.gradient).beside(size - t)
    sizes = np.r_[_NOISE, _JITTER, _FLANGES:levels]
    units = Units(residuals, jacobian, known_noise, parts, sizes)
    prior = ratio_prior(range(robots), levels, _FLANGES)
    counts = shares.sum(axis=0)
    counts[_JITTER] = views
    counts[_FLANGES:] = [
        3 * np.sum(rows.robots == robot) for robot in range(robots) for _ in range(2)
    ]
    return _Likelihood(
        MixedModel((units,), (of_corners, known), shares, prior),
        counts,
        (left_px(len(shared)), left_px(focus)),
    )

"""Variance components of lens errors that the lens model does not describe, by REML.

The corners of one camera and its observations (the chains of frames through it) are linearised
once. Random effects are the modes of the distortion field, focus breathing, one focus jitter a
view, the errors of a given lens and of the boards, and one error of each flange a stop; fixed
effects are frames, an estimated lens, and whatever else the fit moves. Errors of single views are
eliminated view by view, so that an evaluation of the restricted likelihood costs one Cholesky
factorisation of some hundred unknowns.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.quantiles import chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray, Mask
from visioncal.estimation.corners import CornerStack, WithoutPoses, floored_sigma_px, reproject
from visioncal.estimation.effects.lenses import LENSES, LinearisedCorners
from visioncal.estimation.field_modes import field_modes
from visioncal.estimation.lens_field import (
    LensLevels,
    LensSizes,
    distances,
    lens_modes,
    lens_part,
    zooms,
)
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.mixed import (
    LITTLE,
    CommonRows,
    MixedEstimate,
    MixedModel,
    Units,
    level_weight,
)
from visioncal.estimation.normal_equations import normal_equations
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.robot_likelihood import ratio_prior
from visioncal.estimation.scene import BoardSizes, CornerProblem

# Correlation lengths of the field that are tried, as shares of the image's width, and least gain in
# log-likelihood of the next one; gain that a likelihood-ratio statistic may neglect.
_LENGTHS, _GAIN, _LITTLE_GAIN = (0.2, 0.12, 0.07), 0.5, 1e-2
# The corner noise lies between the residuals with lens, board and field all free and those with
# lens and board alone, times these factors.
_NOISE_RANGE = (0.7, 3.0)
# Lower bounds, at which sizes count as zero, upper bounds and starts: of the field (in units of the
# corner noise, but for the upper bound [px]), breathing and jitter (autofocus repeats to some
# 0.1 %), errors of a given lens [px], of a board's scale, plane (shares of its size) and bend [m],
# and of flanges.
_BEYOND = ((1e-3, 1.0, 0.3), (1e-6, 0.02, 1e-3), (1e-6, 5e-3, 3e-4))
_LENS_ERRORS = (1e-3, 1e2, 1.0)
_BOARD_ERRORS = ((1e-6, 0.2, 1e-3), (1e-6, 2e-2, 3e-4), (1e-7, 5e-2, 1e-4))
_FLANGE_ERRORS = (1e-7, 1e-1, 1e-6)
# Likelihood-ratio limit with a false alarm in one session of ten thousand; half of the
# chi-square's mass is at zero, as a level cannot be negative.
SIGNIFICANT = float(chi2_limit(2e-4, 1))
# Indices of the sizes: corner noise, field, breathing, jitter, one that is not estimated, three of
# a given lens; then three of each printed board, and two of each flange.
_NOISE, _FIELD, _BREATHING, _JITTER, _ONE, _FOCAL, _CENTRE, _SHAPE, _BOARDS = range(9)
# Share of boards whose size is not within what is stated; of boards that are not flat, or not drawn
# to one scale, of given lenses that have errors, and of lenses whose focus moves.
_WRONG_SIZE, _WRONG_SHAPE = 1e-2, 0.1
# Weight of a size below which it is zero.
_NO_WEIGHT = 0.05
_RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class _Rows:
    """One camera's linearised corners and observations: o observations (chains) of v views."""

    stack: CornerStack  # The corners, without effects of the focus.
    px: FloatArray  # (n, 2) the corners as predicted [px].
    camera: Camera  # The lens.
    # (n, 2, c + 2) columns of lens, board and breathing, of a change of focus, and of the
    # residuals, after elimination of the poses.
    without: WithoutPoses
    chained: IntArray  # (o,) the view of each observation.
    jacobian: FloatArray  # (o, 6, t) Jacobian of the observations' residuals by the unknowns.
    by_errors: FloatArray  # (o, 6, 6 w) Jacobian by the flange errors.
    away: FloatArray  # (o, 6) the residuals.
    robots: IntArray  # (o, w) indices of these flanges' robots; -1 for none.
    # (c - 1, r + z) lens and board by those r of them that are unknowns by themselves, and by the z
    # modes of a given lens; indices (r,) of the former among the unknowns.
    values: FloatArray
    places: IntArray
    shares: FloatArray  # (r + z, k) their variance by the square of each size; zeros where flat.
    known: FloatArray  # (t, t) information on the unknowns from everything else.
    gradient: FloatArray  # (t,) half the gradient of everything else.


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """Restricted likelihood of the levels' logarithms, at one correlation length of the field."""

    model: MixedModel  # Sizes are the levels.
    # RMS corner residuals with lens, board and field all free, and with lens and board alone [px].
    noise_px: tuple[float, float]
    flanges: int  # Index of the first size of a flange.

    def minimised(
        self,
        logs: FloatArray,
        closed: tuple[int, ...],
        enough: float = np.inf,
        little: float = LITTLE,
    ) -> MixedEstimate:
        """The most likely levels; `closed` ones stay at their lower bounds."""
        low, high = self.limits(closed)
        found = self.model.maximised(logs, low, high, enough, little)
        # Insignificant levels decrease by ever smaller gains: tries their lower bounds directly.
        for level in (_FIELD, _BREATHING, _JITTER, *range(_FOCAL, self.flanges)):
            if found.gradient[level] <= 0.0 or found.logs[level] <= low[level]:
                continue
            without = found.logs.copy()
            without[level] = low[level]
            if self.model.at(without, is_sloped=False).value <= found.value:
                found = self.model.at(without)
        return found

    def gain(self, found: MixedEstimate, closed: tuple[int, ...], level: int) -> float:
        """Likelihood-ratio statistic of one level, against its lower bound."""
        without, least = found.logs.copy(), self.limits((*closed, level))[0][level]
        if without[level] <= least:
            return 0.0
        without[level] = least
        upper_bound = 2.0 * (self.model.at(without, is_sloped=False).value - found.value)
        # The other levels are only refitted where it matters: beside a focus, as most of what it
        # explains may be noise of the flange.
        is_large = upper_bound >= SIGNIFICANT and (level == _FIELD or _is_scale(level))
        if not is_large and level not in (_BREATHING, _JITTER):
            return upper_bound
        refitted = self.minimised(without, (*closed, level), little=_LITTLE_GAIN)
        return 2.0 * (refitted.value - found.value)

    def limits(self, closed: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the levels' logarithms."""
        low, high, _ = self.bounds.T
        high = np.where(np.isin(np.arange(len(high)), closed), low, high)
        return np.log(low), np.log(high)

    @property
    def bounds(self) -> FloatArray:
        """(k, 3) lower bounds, upper bounds and starts of the levels."""
        left_px, alone_px = self.noise_px
        bounds = np.array(
            [
                (_NOISE_RANGE[0] * left_px, _NOISE_RANGE[1] * alone_px, alone_px),
                *_BEYOND,
                (1.0, 1.0, 1.0),
                *[_LENS_ERRORS] * 3,
                *_BOARD_ERRORS * ((self.flanges - _BOARDS) // 3),
                *[_FLANGE_ERRORS] * (self.model.shares.shape[1] - self.flanges),
            ]
        )
        bounds[_FIELD, [0, 2]] *= left_px
        return bounds


def estimate_sizes(
    seen: LinearisedCorners,
    problem: Problem,
    rows: IntArray,
    state: State,
    noise: Noise,
    camera: str,
    uneven: float = 1.0,
) -> tuple[LensLevels, LensSizes, tuple[BoardSizes, ...]]:
    """Estimates the sizes of errors of one camera's lens and of the boards.

    Args:
        seen: The linearised corners of all cameras, with all values free.
        problem: The inlier observations, with these corners.
        rows: (n,) the view of each observation; -1 for none.
        state: The linearisation point.
        noise: The levels of robots and sensors.
        camera: Name of the camera.
        uneven: Factor by which errors of arms that look like a board's scale may be larger than
            their size says.

    Returns:
        Sizes of errors of the lens beyond the model, of its intrinsics, if given, and of the
        printed boards, both beyond what is stated.
    """
    mine, count = seen.camera_parameters.problems[camera], len(noise.robots)
    linearised = _rows(seen, problem, rows, state, noise, camera)
    closed = _closed(mine, len(np.unique(linearised.chained)))
    before = mine.levels
    length = _LENGTHS[0] if before is None else before.length
    likelihood = _assembled(linearised, length, count)
    left_px, noise_px = likelihood.noise_px
    # With lens, board and field all free such residuals are wrong corners, not noise [px].
    if left_px > 10.0:
        return LensLevels(), mine.lens_sizes, mine.board_sizes
    starts = likelihood.bounds[:, 2].copy()
    if before is not None:
        stated = noise_px * np.array([before.field, before.breathing, before.jitter])
        starts[_FIELD:_ONE] = np.maximum(stated, 0.1 * starts[_FIELD:_ONE])
    starts[likelihood.flanges :] = np.maximum(starts[likelihood.flanges :], noise.robots.ravel())
    logs = np.log(starts)
    found = likelihood.minimised(logs, closed)
    if before is None and found.logs[_JITTER] > np.log(2.0 * likelihood.bounds[_JITTER, 0]):
        # A focus that varies may have been taken for errors of the flange: then these are far
        # smaller from above. Else it would only stand in for whatever corners have in common.
        logs[_BREATHING:_ONE] = np.log(0.5 * likelihood.bounds[_BREATHING:_ONE, 1])
        above, flanges = likelihood.minimised(logs, closed), slice(likelihood.flanges, None)
        if above.value < found.value and np.any(above.logs[flanges] < found.logs[flanges] - 1.0):
            found = above
    # The length was sought before, near another fit.
    for shorter in _LENGTHS[1:] if _FIELD not in closed and before is None else ():
        candidate = _assembled(linearised, shorter, count)
        other = candidate.minimised(found.logs, closed, found.value - _GAIN)
        if other.value > found.value - _GAIN:
            break
        found, length, likelihood = other, shorter, candidate
    low = np.exp(likelihood.limits(closed)[0])
    sizes = np.where(np.exp(found.logs) > 2.0 * low, np.exp(found.logs), 0.0)
    tested = (_FIELD, _BREATHING, _JITTER, *range(_FOCAL, likelihood.flanges))
    gains = {at: likelihood.gain(found, closed, at) if sizes[at] else 0.0 for at in tested}
    # A focus that surely moves is as likely to do so otherwise as well.
    focus = 0.5 if max(gains[_BREATHING], gains[_JITTER]) > SIGNIFICANT else _WRONG_SHAPE
    for at in tested[1:]:
        wrong, share = (_WRONG_SIZE, uneven**-2) if _is_scale(at) else (_WRONG_SHAPE, 1.0)
        # Averaged over a size of zero, too.
        weight = level_weight(share * gains[at], focus if at < _FOCAL else wrong)
        sizes[at] *= weight**0.5 if weight > _NO_WEIGHT else 0.0
    field, breathing, jitter = (sizes[_FIELD:_ONE] / np.exp(found.logs[_NOISE])).tolist()
    levels = LensLevels(
        *(field, length, breathing, jitter), (gains[_FIELD], gains[_BREATHING], gains[_JITTER])
    )
    boards = sizes[_BOARDS : likelihood.flanges].reshape(-1, 3).tolist()
    return (
        levels,
        LensSizes(*sizes[_FOCAL:_BOARDS].tolist()),
        tuple(BoardSizes(*at) for at in boards),
    )


def _is_scale(size: int) -> bool:
    """Whether a size of a board, or one before those of the boards, is that of a board's scale."""
    return size >= _BOARDS and (size - _BOARDS) % 3 == 0


def _closed(problem: CornerProblem, stops: int) -> tuple[int, ...]:
    """The sizes that are zero: those that too few corners or stops do not determine."""
    boards = range(_BOARDS, _BOARDS + 3 * len(problem.board_sizes))
    closed = set[int]()
    if not problem.has_spare_corners:
        closed |= {_FIELD, _BREATHING, _JITTER, _SHAPE}
        # A lens that is known to some pixels may be off by more; another one is held.
        if problem.scene.matrix_sigma_px is None:
            closed |= {_FOCAL, _CENTRE}
        closed |= {at for at in boards if not _is_scale(at)}
    if stops < FEWEST_STOPS or problem.scene.is_focus_fixed:
        closed |= {_BREATHING, _JITTER}
    if problem.is_flat[0]:
        closed |= {_FOCAL, _CENTRE, _SHAPE}
    return tuple(sorted(closed))


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
    bent = corners.stack.points + shape @ optics.values[optics.boards]
    stack, lens = replace(corners.stack, points=bent, zooms=None), optics.camera(camera)
    now = reproject(stack, lens, poses)
    focus = zooms(now.px, lens)
    breath = distances(stack, poses)[stack.view_of][:, None] * focus
    by_board = now.by_point @ shape
    stack.weigh(focus, breath, by_board)
    columns = [now.by_intrinsics, by_board, *(
        array[:, :, None] for array in (breath, focus, now.residuals)
    )]  # fmt: skip
    all_columns = np.concatenate(columns, axis=2)
    values, shares, alone = _values(corners, len(noise.robots))
    # Errors are deviations from the stated values.
    deviation = np.where(
        corners.is_flat, 0.0, (optics.values - optics.stated)[optics.places(camera)]
    )
    all_columns[:, :, -1] -= all_columns[:, :, : len(deviation)] @ deviation
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
    kept[places] = alone
    # The fit's coefficients of this lens's errors are left out: they are estimated again here.
    sizes = seen.field_sizes
    first = problem.effect_columns[LENSES].start + len(seen.free) + sum(sizes[:which])
    kept[first : first + sizes[which]] = False
    out = problem.moving & ~kept
    out[places] = False
    known, gradient = _without(known, gradient, out, kept)
    own = np.searchsorted(np.flatnonzero(kept), places[alone])
    gradient -= known[:, own] @ deviation[alone]
    return _Rows(
        stack,
        now.px,
        lens,
        WithoutPoses.of(stack, now.by_pose, all_columns, corners.shares),
        rows[own_rows] - of_camera.start,
        jacobian[:, :, kept],
        linear.by_errors[own_rows],
        linear.residuals[own_rows],
        np.where((of[own_rows] >= 0)[:, None], members[of[own_rows]], -1),
        values,
        own,
        shares,
        known,
        gradient,
    )


def _values(problem: CornerProblem, robots: int) -> tuple[FloatArray, FloatArray, Mask]:
    """Lens and board by random and flat unknowns.

    Returns:
        (c, r + z) and (r + z, k) `values` and `shares` of `_Rows`, and (c,) mask of the values that
        are unknowns by themselves: all but those of a lens that is given without a sigma.
    """
    count, lens = len(problem.stated_sigma), len(problem.lens)
    alone = (problem.stated_sigma > 0.0) | (np.arange(count) >= lens)
    values = np.eye(count)[:, alone]
    sizes = _BOARDS + 3 * len(problem.board_sizes) + 2 * robots
    by_value = np.zeros((count, sizes))
    by_value[:, _ONE] = np.where(problem.is_flat, 0.0, problem.stated_sigma) ** 2
    for at, board in zip(range(_BOARDS, sizes, 3), problem.printed, strict=False):
        aspect, *bends, shear = problem.shape_of(board)
        by_value[problem.scale_of(board), at] = 1.0
        by_value[[aspect, shear], at + 1] = by_value[bends, at + 2] = 1.0
    shares = by_value[alone]
    if not problem.is_flat[0]:
        modes = np.zeros((count, lens))
        modes[:lens] = lens_modes(problem.scene.camera)
        of_modes = np.zeros((lens, sizes))
        of_modes[:2, _FOCAL] = of_modes[2:4, _CENTRE] = of_modes[4:, _SHAPE] = 1.0
        values, shares = np.hstack([values, modes]), np.vstack([shares, of_modes])
    return values, shares, alone


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
    modes = field_modes(rows.px, rows.camera.resolution, length, stack.given_weights)
    by_lens = lens_part(rows.camera, length)
    answer, products = without.with_modes(modes, by_lens)
    # Columns: lens, board, breathing, a change of focus, residuals, and the modes.
    focus = without.left.shape[2] - 2
    residual, beside = focus + 1, np.r_[focus - 1, focus + 2 : len(products)]
    shared = np.r_[:focus, focus + 2 : len(products)]
    # From values of lens and board to the unknowns.
    by_values = np.asarray(block_diag(rows.values, np.eye(len(beside))))
    by_focus = without.by_view(focus, modes, by_lens)
    views, t, flanges = len(stack.views), len(rows.known), rows.shares.shape[1] - 2 * robots
    levels = flanges + 2 * robots
    size = t + by_values.shape[1] - len(rows.places)
    columns = np.concatenate([rows.places, np.arange(t, size)])
    following_values = answer[:, :, shared] @ by_values
    noise, known_noise = np.zeros((2, views, 7, 7))
    jacobian, residuals = np.zeros((views, 7, size)), np.zeros((views, 7))
    # Views without an observation have no pose rows; theirs are of no consequence.
    known_noise[:, :6, :6] = np.eye(6)
    known_noise[chained] = 0.0
    noise[chained, :6, :6] = without.inverse[chained]
    # Lens and board move the measured poses, as breathing and the field do.
    following = np.zeros((len(chained), 6, size))
    following[:, :, :t], following[:, :, columns] = rows.jacobian, following_values[chained]
    jacobian[chained, :6] = following
    residuals[chained, :6] = rows.away + answer[chained, :, residual]
    zoomed = np.zeros((views, 7))
    zoomed[chained, :6] = answer[chained, :, focus]
    zoomed[:, 6] = 1.0
    # Corners of a view without extent do not determine its focus.
    focus_information = np.maximum(by_focus[:, focus], _RIDGE)
    noise[:, 6, 6] = 1.0 / focus_information
    by_shared = by_focus[:, shared] @ by_values
    jacobian[:, 6, columns] = by_shared / focus_information[:, None]
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
    shared_products = by_values.T @ products[np.ix_(shared, shared)] @ by_values
    shared_products -= by_shared.T @ (by_shared / focus_information[:, None])
    pulled = by_values.T @ products[shared, residual] - residuals[:, 6] @ by_shared
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
    own = len(rows.shares) - len(rows.places)
    shares[rows.places], shares[t : t + own] = np.split(rows.shares, [len(rows.places)])
    shares[t + own, _BREATHING] = shares[t + own + 1 :, _FIELD] = 1.0
    of_corners = CommonRows(
        information, gradient, float(cost - by_focus[:, residual] @ residuals[:, 6]),
        freedom - views, _NOISE,
    )  # fmt: skip
    known = CommonRows(rows.known, rows.gradient).beside(size - t)
    sizes = np.r_[_NOISE, _JITTER, flanges:levels]
    units = Units(residuals, jacobian, known_noise, parts, sizes)
    prior = ratio_prior(range(robots), levels, flanges)
    return _Likelihood(
        MixedModel((units,), (of_corners, known), shares, prior),
        (left_px(len(shared)), left_px(focus)),
        flanges,
    )

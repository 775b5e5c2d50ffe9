"""Errors of arms that last from stop to stop: they judge no sighting, and move the result last.

An arm's errors are functions of its posture and of time that nobody knows; where joint angles are,
beside those of its links. Inliers and noise are found as if they were independent. The covariance
is then averaged over processes by posture and by time, each over a grid of sizes and of levels of
what is independent, by their restricted likelihood (Hoeting, Madigan, Raftery and Volinsky 1999),
and so is the estimate over those by time. Estimates under processes by posture are further off than
that of independent errors: they take a camera's transform for the arm's error. The estimate of each
flange by its stop alone follows from the factorisation.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import TypeAlias, TypeVar

import numpy as np
from scipy.linalg import lapack

from visioncal.core.types import FloatArray, IntArray, evenly
from visioncal.fit.fit import Fit
from visioncal.fit.kernels import SIZES, WHITE, Process, Shared, StopErrors, Tried, processes
from visioncal.fit.mixed import body_with, factors_of, inverse
from visioncal.fit.score import Added, Products, Score, products
from visioncal.fit.unknowns import Key, Prior
from visioncal.model.effects import Effect
from visioncal.model.effects.posture import PostureEffect, twists_of_frames
from visioncal.robot.errors import posture_features

T = TypeVar("T")
# Log-likelihood of what is tried, what it takes of further columns, and squares of boards.
Judged: TypeAlias = tuple[float, FloatArray, FloatArray]
# Stops that determine errors of an arm's posture; of more than the most, some stand for all in the
# likelihood.
ENOUGH_STOPS, _MOST = 8, 40
# Sizes of what boards that are not as stated are off by, as shares, and how many of them are: most
# are prints that were scaled, some are not the described ones.
_LOOSE = {0.01: 0.9, 0.1: 0.1}
# Share of evidence of a size that does not count.
_LITTLE = 1e-4
# Logarithm below the most evidence from which less is not looked for.
_FAR = 14.0


@dataclass(frozen=True, eq=False)
class Considered:
    """Changes of a fit by an arm's lasting errors."""

    shift: FloatArray  # (p,) of the estimate, in units of the columns.
    covariance: FloatArray  # (p, p) beyond that of independent errors, in units of the columns.
    # Log-odds of boards of any size against boards as stated; zero where their size is free.
    board_odds: float
    # Mean square of what each held board is off by, if boards are of any size.
    board_squares: Mapping[Key, float]


def consider(fit: Fit, flange: str) -> Considered | None:
    """The changes by lasting errors of one arm; None where too few stops show any."""
    by_stop = _errors_by_stop(fit, flange)
    if by_stop is None:
        return None
    stops, p = len(by_stop.stops), fit.unknowns.count
    boards, logs, free = _boards(fit), list[float](), list[float]()
    usual, off = list[float](), list[FloatArray]()
    levels = list[tuple[Process | None, float, float]]()

    grid, at_stops = _grid_of(fit, flange, by_stop, creeps=True)

    weighed = partial(_in_all_ways, at_stops=at_stops, boards=boards)
    # Without boards, all are as stated.
    ways = [*enumerate(_LOOSE.values(), 1)] if boards else [(0, 1.0)]
    for tried, found in _climb(grid, weighed, _logs_of):
        logs.append(tried.prior + found[0][0])
        free += [tried.prior + found[at][0] + np.log(share) for at, share in ways]
        # Other prints show themselves: where none does, a board is off by what printers do.
        usual.append(free[-len(ways)])
        off.append(found[ways[0][0]][2])
        levels.append((tried.process, tried.size, tried.white))
    odds = float(np.logaddexp.reduce(free) - np.logaddexp.reduce(logs))
    mean_squares = np.exp(usual - np.logaddexp.reduce(usual)) @ np.array(off)
    shares = np.exp(logs - np.logaddexp.reduce(logs)).tolist()
    by_process = dict[Process, list[tuple[float, tuple[Process, float, float]]]]()
    for share, (process, size, white) in zip(shares, levels, strict=True):
        if process is not None:
            by_process.setdefault(process, []).append((share, (process, size, white)))
    # The estimate's response to an error at each stop, which it takes for independent.
    gains = np.linalg.inv(by_stop.known + by_stop.independent) @ by_stop.rows[:, :, :p]
    independent = np.einsum("uia,uij,ujb->ab", gains, by_stop.independent, gains, optimize=True)
    known, excess, shift = fit.estimate.covariance, np.zeros((p, p)), np.zeros(p)
    added = np.zeros((p, p))
    moved = list[tuple[float, FloatArray]]()
    for process, weighted in by_process.items():
        share = sum(share for share, _ in weighted)
        # Less evidence of a process does not count. Most stops at which estimates are averaged; of
        # more, the mean over the stops is nearly as good.
        if process.is_of_time and share > 0.01 and stops <= 100:
            # The likeliest size of a process stands for all of its sizes where it is estimated.
            values, covariance = _estimated(by_stop, *max(weighted, key=lambda one: one[0])[1])
            moved.append((share, values - fit.estimate.values))
            excess += share * (covariance - known)
            continue
        shown = [one for one in weighted if one[0] > _LITTLE]
        squares = sum(share * size**2 for share, (_, size, _) in shown)
        missing = sum(share * (1.0 - white**2) for share, (*_, white) in shown)
        if shown:
            added += squares * process.through(gains) - missing * independent
    excess += known @ added @ known
    for share, away in moved:
        shift += share * away
        excess += share * np.outer(away, away)
    excess += _of_frames(fit, flange, by_stop, gains)
    by_board = dict(zip(held_boards(fit), mean_squares.tolist(), strict=True))
    return Considered(shift, excess - np.outer(shift, shift), odds, by_board)


def _in_all_ways(
    one: "Tried", at_stops: Callable[["Tried"], "Tried"], boards: Sequence["_Board"]
) -> "tuple[Tried, list[Judged]]":
    """A trial given the stops, judged with boards as stated, and with boards of any size."""
    seen, sizes = at_stops(one), (0.0, *_LOOSE) if boards else (0.0,)
    return seen, [judged(seen, boards, size) for size in sizes]


def _logs_of(weighed: "tuple[Tried, list[Judged]]") -> FloatArray:
    return np.array([weighed[0].prior + way[0] for way in weighed[1]])


def _of_frames(fit: Fit, flange: str, by_stop: StopErrors, gains: FloatArray) -> FloatArray:
    """(p, p) covariance by the postures of the stops, to whose mean effects of posture refer."""
    p, frames = fit.unknowns.count, np.zeros((12, 12))
    for effect in fit.unknowns.effects:
        if isinstance(effect, PostureEffect) and effect.frame == flange:
            columns, values = fit.unknowns.columns("effect", effect.name), fit.state.values
            found = values["effect", effect.name]
            square = fit.estimate.covariance[columns[:, None], columns] + np.outer(found, found)
            frames += effect.covariance_of_frames(square)
    if not frames.any():
        return np.zeros((p, p))
    twists = twists_of_frames(fit.cell.arms[flange].poses[by_stop.stops])
    moved = fit.estimate.covariance @ np.einsum("uia,uib->ab", gains, twists)
    return np.asarray(moved @ frames @ moved.T)


def scored(
    fit: Fit, flange: str, effects: Sequence[tuple[Effect, Sequence[Added]]]
) -> list[tuple[float, float, float]]:
    """Effects, with their columns, beside an arm's lasting errors.

    Empty where too few stops show the arm's errors.

    Returns:
        The size of each, its gain in log-likelihood alone, and the same at its estimate.
    """
    counts, by_count = [effect.count for effect, _ in effects], dict[int, list[int]]()
    for at, count in enumerate(counts):
        by_count.setdefault(count, []).append(at)
    # (g, c) columns of effects with c unknowns each, and which ones they are.
    ends = np.cumsum(counts)
    groups = [
        (ends[same][:, None] - np.arange(count, 0, -1), same) for count, same in by_count.items()
    ]
    columns = [products(fit, added, effect.count) for effect, added in effects]
    by_stop, boards = _errors_by_stop(fit, flange, columns), _boards(fit)
    if by_stop is None:
        return []
    sizes, ways = np.geomspace(1e-6, 0.1, 31), {0.0: 1.0}
    if boards:
        # One board of twenty is of another size.
        ways = {0.0: 0.95, **{off: 0.05 * share for off, share in _LOOSE.items()}}
    shares = np.log([*ways.values()])
    grid, at_stops = _grid_of(fit, flange, by_stop, creeps=False)

    def weighed(one: Tried) -> tuple[FloatArray, FloatArray]:
        """Evidence (w,) with boards in w ways, and what e effects gain by size (2, w, e, 31)."""
        seen = at_stops(one)
        found = [judged(seen, boards, off) for off in ways]
        taken = np.array([pull for _, pull, _ in found])
        whole = seen.total[len(seen.boards) :, len(seen.boards) :]
        gains = np.empty((2, len(ways), len(effects), len(sizes)))
        for at, same in groups:
            part = taken[:, :, at].transpose(0, 2, 3, 1)
            information = whole[at[:, :, None], at[:, None, :]] - part @ np.swapaxes(part, 2, 3)
            pull = whole[at, -1] - (part @ taken[:, None, :, -1:])[..., 0]
            gains[:, :, same] = Score(pull, information, np.inf).gains(sizes)
        return seen.prior + shares + [value for value, *_ in found], gains

    def logs_of(each: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Logarithms with no effect, and with each, which may explain errors that last."""
        logs, gains = each
        return np.append(logs, logs[:, None] + gains[0].max(axis=2))

    tried = [*_climb(grid, weighed, logs_of)]
    known = np.concatenate([logs for logs, _ in tried])
    gains = np.concatenate([gain for _, gain in tried], axis=1)
    averaged = np.logaddexp.reduce(known[:, None, None] + gains, axis=1)
    found = list[tuple[float, float, float]]()
    for (effect, _), gain, explained in zip(
        effects, *(averaged - np.logaddexp.reduce(known)), strict=True
    ):
        is_possible = (sizes >= effect.size.low) & (sizes <= effect.size.high)
        best = int(np.where(is_possible, gain, -np.inf).argmax())
        found.append((float(sizes[best]), float(gain[best]), float(explained[best])))
    return found


def _grid_of(
    fit: Fit, flange: str, by_stop: StopErrors, *, creeps: bool
) -> tuple[Iterator[Tried], Callable[[Tried], Tried]]:
    """Processes over the stops, each of all sizes, before the stops are seen; the same at them.

    Independent errors of all levels come first.
    """
    levels, poses = fit.flange_sigmas(flange), fit.cell.arms[flange].poses[by_stop.stops]
    boards = np.eye(fit.unknowns.count)[:, [board.column for board in _boards(fit)]]
    some = evenly(len(by_stop.stops), _MOST)
    kinds = tuple(processes(poses, levels, creeps=creeps))
    shared = Shared.of(by_stop, some, kinds)
    rows, rest, by_boards = _combined(by_stop, some, shared.independent[1.0], boards)
    rows = np.asfortranarray(rows)
    return _grid(kinds, SIZES, rest, by_boards), lambda one: one.with_stops(rows, shared)


def _climb(
    grid: Iterable[Tried],
    weighed: Callable[[Tried], T],
    logs_of: Callable[[T], FloatArray],
    far: float = _FAR,
) -> Iterator[T]:
    """Yields what is weighed, but for sizes and levels beyond those that are as good as ruled out.

    Along sizes, and along levels, a likelihood has one peak.

    Args:
        grid: What is tried, with sizes and levels in their order.
        weighed: Weighs one of it.
        logs_of: Logarithms of evidence, in one way or in several.
        far: Logarithm below the most evidence from which less is not looked for.
    """
    most = np.full(1, -np.inf)
    for _, of_process in groupby(grid, lambda one: one.process):
        before = np.full(1, -np.inf)
        for _, of_size in groupby(of_process, lambda one: one.size):
            last = best = np.full(1, -np.inf)
            for one in of_size:
                found = weighed(one)
                logs = logs_of(found)
                best, most = np.maximum(best, logs), np.maximum(most, logs)
                yield found
                if np.all(logs < np.minimum(last, most - far)):
                    break
                last = logs
            if np.all(best < np.minimum(before, most - far)):
                break
            before = best


def _grid(
    kinds: Iterable[Process], sizes: Sequence[float], rest: FloatArray, boards: FloatArray
) -> Iterator[Tried]:
    """Yields what is tried before any stop: independent errors first, then processes one by one."""
    for white in WHITE:
        weight = 1 / 4 if white == 1.0 else 1 / 4 / len(WHITE)
        yield Tried(float(np.log(weight)), rest, 0.0, boards, white=white)
    for process in kinds:
        prior = float(np.log(process.prior / len(sizes) / len(WHITE)))
        for size in sizes:
            for white in WHITE:
                yield Tried(prior, rest, 0.0, boards, process, size, white)


def weigh(
    by_stop: StopErrors, poses: FloatArray, kinds: Sequence[Process]
) -> list[tuple[Tried, float]]:
    """Processes over (s, 4, 4) stops, and independent errors alone, with their evidence.

    The evidence is the logarithm of prior and restricted likelihood, over that of independent
    errors. Many stops form groups, which are independent beside the common unknowns
    (Quinonero-Candela and Rasmussen 2005, section 6): those next to each other for what is of
    time, and those of similar postures else.
    """
    stops = np.arange(len(by_stop.stops))
    count = -(-len(stops) // _MOST)
    near = [kind for kind in kinds if kind.is_of_time and not kind.is_creep]
    in_time = _by_groups(by_stop, near, np.array_split(stops, count))
    rest = [kind for kind in kinds if kind not in near]
    others = _by_groups(by_stop, rest, _similar(posture_features(poses), count))
    return [*others, *(pair for pair in in_time if pair[0].process is not None)]


def _similar(features: FloatArray, count: int) -> list[IntArray]:
    """Groups of (s, f) features that are near each other, by halves along their widest axis."""
    groups = [np.arange(len(features))]
    while len(groups) < count:
        largest = groups.pop(int(np.argmax([len(group) for group in groups])))
        along = features[largest, int(np.ptp(features[largest], axis=0).argmax())]
        groups += np.array_split(largest[along.argsort(kind="stable")], 2)
    return groups


def _by_groups(
    by_stop: StopErrors, kinds: Sequence[Process], groups: Sequence[IntArray]
) -> list[tuple[Tried, float]]:
    """Trials by groups of stops; one that a group excludes is not tried on others."""
    # Most arms have next to no lasting errors.
    grid = [*_grid(kinds, (0.1, *SIZES), by_stop.rest, np.zeros((by_stop.count, 0)))]
    left = [(one, 0.0) for one in grid]
    for at, group in enumerate(groups, 1):
        rows = np.asfortranarray(by_stop.rows[group].reshape(-1, by_stop.count + 1))
        shared = Shared.of(by_stop, group, {one.process for one, _ in left if one.process})
        weighed = partial(_evidence, rows=rows, shared=shared)
        # Further groups may change what is far.
        far = _FAR if at == len(groups) else np.inf
        found = [*_climb((one for one, _ in left), weighed, lambda pair: np.array([pair[1]]), far)]
        none = np.logaddexp.reduce([log for one, log in found if one.process is None])
        left = [
            (one, float(log - none))
            for one, log in found
            if one.process is None or log - none > np.log(_LITTLE)
        ]
    return left


def _evidence(one: Tried, rows: FloatArray, shared: "Shared") -> tuple[Tried, float]:
    """A trial given more stops, and the logarithm of its evidence, with boards as stated."""
    seen = one.with_stops(rows, shared)
    return seen, seen.prior + judged(seen, (), 0.0)[0]


def _combined(
    errors: StopErrors, some: IntArray, independent: FloatArray, boards: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows (d k, r + c + 1), and all else, by those r combinations of p unknowns that they show.

    Whatever the covariance of k stops' errors, it changes no information of others. Thousands of
    unknowns of lenses are a few hundreds. Where there are less unknowns, they stay as they are.

    Returns:
        Rows and rest, and the (r, b) sizes of boards that are held by these combinations.
    """
    p, rest, flat = errors.count, errors.rest, errors.rows[some].reshape(-1, errors.rows.shape[2])
    if p <= len(flat):
        return flat, rest, boards
    root = np.linalg.cholesky(independent)
    solved, _ = lapack.dtrtrs(root, flat, lower=1)
    whole = solved.T @ solved + rest
    factor = factors_of(whole[None, :p, :p])[0]
    # In units of the whole information: by the stops, and by what is asked for.
    within, _ = lapack.dtrtrs(factor, np.column_stack([solved[:, :p].T, boards]), lower=1)
    basis, _ = np.linalg.qr(within)
    map_to, _ = lapack.dtrtrs(factor, basis, lower=1, trans=1)
    pull, _ = lapack.dtrtrs(factor, whole[:p, p:], lower=1)
    beyond = pull - basis @ (basis.T @ pull)
    moved = np.column_stack([flat[:, :p] @ map_to, flat[:, p:]])
    solved, _ = lapack.dtrtrs(root, moved, lower=1)
    found, r = -solved.T @ solved, basis.shape[1]
    found[:r, :r] += np.eye(r)
    found[:r, r:] += basis.T @ pull
    found[r:, :r] = found[:r, r:].T
    found[r:, r:] += whole[p:, p:] - beyond.T @ beyond
    return moved, found, map_to.T @ boards


def _estimated(
    by_stop: StopErrors, process: Process, size: float, white: float
) -> tuple[FloatArray, FloatArray]:
    """The (p,) estimate under a process, and its covariance (p, p)."""
    every, p = np.arange(len(by_stop.stops)), by_stop.rows.shape[2] - 1
    covariance = by_stop.covariance(every, white) + size**2 * process.covariance(every)
    root = np.linalg.cholesky(covariance)
    solved = np.linalg.solve(root, by_stop.rows.reshape(-1, p + 1))
    total = solved.T @ solved + by_stop.rest
    found, _ = inverse(total[:p, :p])
    return found @ total[:p, p], found


def _errors_by_stop(fit: Fit, flange: str, added: Sequence[Products] = ()) -> StopErrors | None:
    """Residuals of each stop alone; None of too few stops.

    Args:
        fit: The fit.
        flange: The arm.
        added: More columns.
    """
    at = body_with(fit.mixed.bodies, (flange,))
    if at < 0:
        return None
    body, p = fit.mixed.bodies[at], fit.unknowns.count
    places = body.errors_of((flange,))
    others = np.setdiff1d(np.arange(body.width), places)
    levels = fit.flange_sigmas(flange)
    units, rest = _beside(*fit.mixed.assembled(fit.estimate.logs), added)
    p, more = len(rest) - 1, np.arange(p, len(rest))
    past = fit.linearised.errors[flange][body.stops]
    for other, (errors, cross) in enumerate(units):
        if other != at:
            columns = np.append(fit.mixed.bodies[other].columns, more)
            solved = np.linalg.solve(errors, cross)
            rest[columns[:, None], columns] -= np.einsum("uma,umb->ab", cross, solved)
    errors, cross = units[at]
    errors[:, places, places] -= levels**-2.0
    cross[:, places, -1] += past * levels**-2.0
    columns = np.append(body.columns, more)
    if len(others):
        inner, between = errors[:, others[:, None], others], errors[:, places[:, None], others]
        solved = np.linalg.solve(inner, cross[:, others])
        rest[columns[:, None], columns] -= np.einsum("uma,umb->ab", cross[:, others], solved)
        cross = cross[:, places] - between @ solved
        errors = errors[:, places[:, None], places] - between @ np.linalg.solve(
            inner, np.swapaxes(between, 1, 2)
        )
    seen = np.flatnonzero(np.linalg.eigvalsh(errors)[:, 0] * levels.min() ** 2 > 1e-6)
    if len(seen) < ENOUGH_STOPS:
        return None
    known = np.asarray(np.linalg.inv(errors[seen]), dtype=float)
    rows = np.zeros((len(seen), 6, p + 1))
    rows[:, :, columns] = known @ cross[seen]
    rest[columns[:, None], columns] -= np.einsum(
        "uma,umb->ab", cross[seen], rows[:, :, columns], optimize=True
    )
    # From what is reported, not from where it was linearised.
    rows[:, :, p] += past[seen]
    independent = np.tile(np.diag(levels**2), (len(seen), 1, 1))
    return StopErrors(body.stops[seen], known, independent, rows, rest, fit.unknowns.count)


def _beside(
    units: list[tuple[FloatArray, FloatArray]], rest: FloatArray, added: Sequence[Products]
) -> tuple[list[tuple[FloatArray, FloatArray]], FloatArray]:
    """Information of units and common unknowns with more columns, before the residual."""
    for one in added:
        c, pull = len(one.pull), one.pull[:, None]
        common = np.zeros((len(rest) - 1, c))
        common[: len(one.common)] = one.common
        rest = np.block(
            [
                [rest[:-1, :-1], common, rest[:-1, -1:]],
                [common.T, one.inner, pull],
                [rest[-1:, :-1], pull.T, rest[-1:, -1:]],
            ]
        )
        units = [
            (errors, np.concatenate([cross[:, :, :-1], by, cross[:, :, -1:]], axis=2))
            for (errors, cross), by in zip(units, one.errors, strict=True)
        ]
    return units, rest


def held_boards(fit: Fit) -> dict[Key, Prior]:
    """Boards whose size is held, and its prior."""
    boards = (member for member in fit.unknowns.members if member.key[0] == "shape")
    return {at.key: at.priors[0] for at in boards if at.priors[0].considered > 0.0}


@dataclass(frozen=True)
class _Board:
    """A board whose size is held."""

    column: int  # Of its size, among the unknowns.
    held: Prior
    past: float  # Its size where it was linearised.


def _boards(fit: Fit) -> list[_Board]:
    past, starts = fit.unknowns.offsets(fit.linearised), fit.unknowns.slices
    each = [(starts[key].start, prior) for key, prior in held_boards(fit).items()]
    return [_Board(column, prior, float(past[column])) for column, prior in each]


def judged(tried: Tried, boards: Sequence[_Board], off: float) -> Judged:
    """The restricted log-likelihood of a process, with boards as stated or of other sizes.

    Args:
        tried: The process; c columns beside the unknowns are no part of the likelihood.
        boards: Those whose size is held.
        off: Share by which the boards may be off, where it is more than is stated.

    Returns:
        It; the (p, c + 1) part of columns and residual that p unknowns take, in units of their
        information; and (b,) mean squares of what the boards are off by.
    """
    prior, p = -tried.log_det / 2.0, len(tried.boards)
    within, by_columns = tried.total[:p, :p].copy(), tried.total[:p, p:].copy()
    corner = float(tried.total[-1, -1])
    diagonal, by_boards = np.arange(p), tried.boards[:, : len(boards)]
    for board, by in zip(boards, by_boards.T, strict=True):
        sigma = max(off, board.held.considered)
        more = sigma**-2.0 - board.held.sigma**-2.0
        within += more * np.outer(by, by)
        by_columns[:, -1] -= more * board.past * by
        corner += more * board.past**2
        prior -= np.log(sigma)
    within[diagonal, diagonal] *= 1.0 + 1e-12
    factor = np.linalg.cholesky(within)
    pull, _ = lapack.dtrtrs(factor, by_columns, lower=1)
    value = prior - np.log(np.diag(factor)).sum() - 0.5 * (corner - pull[:, -1] @ pull[:, -1])
    of_boards, _ = lapack.dtrtrs(factor, by_boards, lower=1)
    found = of_boards.T @ pull[:, -1] + [board.past for board in boards]
    return float(value), pull, found**2 + np.sum(of_boards**2, axis=0)

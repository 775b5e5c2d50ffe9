"""Errors of arms that last: what each stop alone says, and honesty under them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.marks import seeds, slow
from support.small_cells import ROBOT_M, ROBOT_RAD, made, pose
from support.whole_cells import OPTIONS, recorded

from visioncal.core.transforms import invert, log
from visioncal.fit.assemble import mixed_model
from visioncal.fit.inliers import Search
from visioncal.fit.kernels import processes
from visioncal.fit.processes import _boards, _errors_by_stop, _grid_of, consider, judged
from visioncal.fit.solve import _explained, solve, state_of, unknowns_of
from visioncal.fit.start import start_of
from visioncal.fit.unknowns import State
from visioncal.model import read_cell
from visioncal.simulation import simulate


def two_arms():
    session = recorded(simulate(OPTIONS))
    return read_cell(session, session.corners)


@pytest.mark.parametrize("cell", [made(stops=10, cameras=2).cell, two_arms()])
def test_information_of_single_stops_adds_up_to_that_of_the_fit(cell):
    fit, p = solve(cell).fit, None
    for flange in fit.unknowns.erring:
        by_stop = _errors_by_stop(fit, flange)
        p = fit.unknowns.count
        total = by_stop.rest.copy()
        noise = np.linalg.inv(by_stop.known + by_stop.independent)
        total += np.einsum("uia,uij,ujb->ab", by_stop.rows, noise, by_stop.rows)
        covariance = np.linalg.inv(total[:p, :p])
        scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        # Stops that say nothing of the flange are left out: they are none of these cells'.
        assert np.abs((covariance - fit.estimate.covariance) / scale).max() < 1e-4
        sigmas = np.sqrt(np.diag(covariance))
        assert covariance @ total[:p, p] == pytest.approx(
            fit.estimate.values, abs=1e-3 * sigmas.min()
        )


def test_a_process_through_gains_is_its_covariance():
    rng = np.random.default_rng(0)
    poses, gains = made(stops=9).cell.arms["flange"].poses, rng.normal(size=(9, 6, 4))
    levels, flat = np.repeat([1e-4, 5e-5], 3), gains.reshape(54, 4)
    for process in processes(poses, levels, creeps=True):
        whole = process.covariance(np.arange(9))
        assert np.allclose(process.through(gains), flat.T @ whole @ flat)
        assert np.linalg.eigvalsh(whole).min() > -1e-9 * np.trace(whole)


def lasting(seed, share):
    """A cell whose arm's errors remember those of the stop before by a share."""
    small, rng = made(seed, stops=20), np.random.default_rng([seed, 7])
    errors = rng.normal(size=(20, 2, 3)) * np.array([ROBOT_RAD, ROBOT_M])[:, None] * 3.0
    for stop in range(1, 20):
        errors[stop] = share * errors[stop - 1] + np.sqrt(1 - share**2) * errors[stop]
    arm = small.cell.arms["flange"]
    moved = np.array([at @ pose(*step) for at, step in zip(arm.poses, errors, strict=True)])
    arms = {"flange": replace(arm, poses=moved)}
    moments = replace(small.cell.moments, poses={"flange": moved})
    return replace(small, cell=replace(small.cell, arms=arms, moments=moments))


@pytest.mark.slow
@pytest.mark.parametrize("draws", seeds(10, 30))
def test_errors_that_last_move_the_estimate_and_are_in_the_covariance(draws):
    squares, lengths = {True: [], False: []}, {True: [], False: []}
    for seed in draws:
        small = lasting(seed, 0.95)
        fit = solve(small.cell).fit
        for is_considered in (True, False):
            one = fit if is_considered else replace(fit, considered=None, shift=None)
            away = log(invert(small.edges["cam"]) @ one.edge("cam"))
            covariance = one.covariance(("edge", "cam"))
            squares[is_considered].append(away @ np.linalg.solve(covariance, away) / 6)
            lengths[is_considered].append(np.linalg.norm(away[3:]))
    # Independent errors would be claimed to leave less than a third of it.
    assert np.mean(squares[False]) > 2.0
    assert 0.3 < np.mean(squares[True]) < 1.6
    assert np.mean(lengths[True]) < np.mean(lengths[False])


def test_boards_that_are_larger_are_found_beside_errors_of_the_arm():
    small = made(stops=16)
    cell = replace(
        small.cell, boards={"target": replace(small.cell.boards["target"], square_m=0.0402)}
    )
    fit = solve(cell).fit
    scale = fit.state.values["shape", "target"][0]
    assert scale == pytest.approx(0.04 / 0.0402 - 1, abs=5e-4)
    assert abs(consider(solve(small.cell).fit, "flange").board_odds) < 7.0


@pytest.mark.parametrize(("stops", "factor"), [(8, 0.7), (9, 1.4), slow(12, 0.85), slow(14, 1.2)])
def test_boards_of_any_size_are_found_from_eight_stops_on(stops, factor):
    small = made(stops, stops, in_hand=stops % 2 == 0, given=factor > 1.0)
    fit = solve(with_board(small.cell, 0.04 / factor, 1e-3)).fit
    # Five sigmas of so few stops.
    assert fit.state.values["shape", "target"][0] + 1.0 == pytest.approx(factor, rel=3e-3)
    assert fit.used.all()


def test_views_that_agreed_with_no_half_come_back_with_another_size_of_the_board():
    small = made(3, stops=12)
    start = start_of(with_board(small.cell, 0.04 / 1.2, 1e-3))
    search = Search.of(start.cell, unknowns_of(start, ()), start.sound)
    # Too few for the arm's lasting errors, beside which a board's size is judged.
    some = search._sized(state_of(start, ()), np.arange(12) < 7, None)
    _, fit, _ = _explained(search, some, some.left_out())
    assert fit.used.all()
    assert fit.state.values["shape", "target"][0] == pytest.approx(0.2, abs=3e-3)


def test_a_trial_of_another_size_that_does_not_come_to_rest_begins_with_less_noise(monkeypatch):
    small = made(3, stops=12)
    start = start_of(with_board(small.cell, 0.04 / 1.2, 1e-3))
    search = Search.of(start.cell, unknowns_of(start, ()), start.sound)
    some = search._sized(state_of(start, ()), np.arange(12) < 7, None)
    run = Search.run

    def diverges(search, state, used, known=None):
        if known is not None and known.used.all():
            raise np.linalg.LinAlgError
        return run(search, state, used, known)

    monkeypatch.setattr(Search, "run", diverges)
    _, fit, _ = _explained(search, some, some.left_out())
    assert fit.used.all()
    assert fit.state.values["shape", "target"][0] == pytest.approx(0.2, abs=3e-3)


def with_board(cell, square_m, share):
    board = replace(cell.boards["target"], square_m=square_m, square_sigma_m=share * square_m)
    return replace(cell, boards={"target": board})


def test_odds_of_boards_are_those_of_the_whole_likelihood():
    cell = with_board(made(stops=12).cell, 0.04, 3e-4)
    fit = solve(cell).fit
    # Linearised elsewhere than at the prior's mean, which has a pull there.
    shape = fit.state.values["shape", "target"] + 1e-4 * np.eye(10)[0]
    state = State({**fit.state.values, ("shape", "target"): shape}, fit.state.errors)
    fit = Search.of(cell, fit.unknowns)._sized(state, fit.used, fit)
    by_stop = _errors_by_stop(fit, "flange")
    (board,) = _boards(fit)
    grid, at_stops = _grid_of(fit, "flange", by_stop, creeps=True)
    white = at_stops(next(grid))
    found = [judged(white, [board], off)[0] for off in (0.0, 1e-2)]
    values = []
    for sigma in (3e-4, 1e-2):
        member = fit.unknowns["shape", "target"]
        prior = replace(board.held, sigma=sigma)
        unknowns = fit.unknowns.with_members(replace(member, priors=(prior, *member.priors[1:])))
        mixed = mixed_model(cell, unknowns, fit.linearised, fit.grams, fit.used)
        best = mixed.at(fit.estimate.logs)
        values.append(-0.5 * best.value - np.log(sigma))
    assert abs(board.past) == pytest.approx(1e-4, rel=0.1)
    assert found[1] - found[0] == pytest.approx(values[1] - values[0], abs=1e-3)
    # Of any size, it is off by what the whole likelihood says.
    (square,) = judged(white, [board], 1e-2)[2]
    off = best.values[board.column] + board.past
    variance = best.covariance[board.column, board.column]
    assert square == pytest.approx(off**2 + variance, rel=1e-3)


def test_errors_of_held_boards_are_in_the_covariance_and_not_in_the_estimate():
    cell, share = made(stops=16).cell, 2e-4
    edges, sigmas = {}, {}
    for factor in (1.0, 1.0 + share):
        fit = solve(with_board(cell, 0.04 * factor, share)).fit
        assert abs(fit.state.values["shape", "target"][0]) < 1e-2 * share
        edges[factor] = fit.edge("cam")
        sigmas[share] = fit.covariance(("edge", "cam"))
    moved = log(invert(edges[1.0]) @ edges[1.0 + share])
    exact = solve(with_board(cell, 0.04, 1e-7)).fit.covariance(("edge", "cam"))
    added = sigmas[share] - exact
    assert np.linalg.norm(moved[3:]) > 3e-5
    assert np.sqrt(added[5, 5]) == pytest.approx(abs(moved[5]), rel=0.1)


@pytest.mark.parametrize("draws", seeds(1, 6))
def test_a_board_that_is_doubted_and_not_freed_counts_in_the_covariance(draws):
    squares, odds = [], []
    for seed in draws:
        world = made(stops=16, seed=seed)
        # Larger by 0.12 % than stated, to 0.02 %.
        fit = solve(with_board(world.cell, 0.04 / 1.0012, 2e-4)).fit
        odds.append(consider(fit, "flange").board_odds)
        away = log(invert(world.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away) / 6.0)
    assert max(odds) < 7.0
    # Chi-square of six each exceeds this in one case of a thousand.
    assert 6.0 * np.sum(squares) < chi2.isf(1e-3, 6 * len(squares))


@pytest.mark.slow
def test_evidence_by_combinations_of_many_unknowns_is_the_same():
    fit = solve(made(stops=8, cameras=4).cell).fit
    by_stop, boards = _errors_by_stop(fit, "flange"), _boards(fit)
    assert fit.unknowns.count > 6 * len(by_stop.stops)
    rows, sizes = by_stop.rows.reshape(-1, by_stop.rows.shape[2]), np.eye(fit.unknowns.count)
    found, values = [], []
    grid, at_stops = _grid_of(fit, "flange", by_stop, creeps=True)
    for tried in map(at_stops, grid):
        full = by_stop.covariance(np.arange(8), tried.white)
        if tried.process is not None:
            full += tried.size**2 * tried.process.covariance(np.arange(8))
        total = rows.T @ np.linalg.solve(full, rows) + by_stop.rest
        known = replace(tried, total=total, boards=sizes[:, [one.column for one in boards]])
        for off in (0.0, 0.01, 0.1):
            found.append([*judged(tried, boards, off)[::2]])
            values.append([*judged(known, boards, off)[::2]])
    levels = np.array([[one[0] - some[0][0] for one in some] for some in (found, values)])
    assert np.ptp(levels[1]) > 3.0
    # Both have a ridge of a billionth; a twentieth in a log-likelihood decides nothing.
    assert levels[0] == pytest.approx(levels[1], abs=0.05)
    squares = np.array([[one[1] for one in some] for some in (found, values)])
    assert squares[0] == pytest.approx(squares[1], rel=1e-3)

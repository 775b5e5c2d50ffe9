"""What session.toml states of frames and lenses: as much as it says, unless views contradict it."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import seeds
from support.small_cells import PX, TABLE, made, pose
from support.whole_cells import OPTIONS, recorded
from test_measured import is_fair

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.fit.held import with_small_sizes
from visioncal.fit.lens_field import by_lens
from visioncal.fit.score import Score
from visioncal.fit.solve import solve
from visioncal.model import MeasuredPlace, MeasuredPose, Sighting, read_cell
from visioncal.model.sightings import is_copy
from visioncal.session.tree import Branch, Tree
from visioncal.simulation import instrument_session, simulate
from visioncal.simulation.instrument_session import InstrumentOptions, session_of
from visioncal.vision.camera import intrinsics, project, with_intrinsics


def stated(pair, place_m, sigma_m, turn=None, sigma_rad=1.0):
    """Priors of the components of one frame's place in another, and of its turn."""
    places = (MeasuredPlace(place_m * np.eye(3)[axis], sigma_m, (axis,)) for axis in range(3))
    found = [Sighting(-1 - axis, 5, *pair, place) for axis, place in enumerate(places)]
    if turn is not None:
        evidence = MeasuredPose(pose(turn, [0, 0, 0]), (sigma_rad, np.inf))
        found.append(Sighting(-4, 5, *pair, evidence))
    return found


def with_prior(small, *prior):
    """A made cell with a prior of a camera on its flange."""
    more = stated(("flange", "cam"), *prior)
    return small.cell.with_sightings([*small.cell.sightings, *more])


@pytest.mark.parametrize("draws", seeds(1, 12))
def test_a_prior_counts_with_its_stated_sigma(draws):
    squares, gains, sigma = [], [], 5e-5
    for seed in draws:
        small = made(seed)
        place = small.edges["cam"][:3, 3] + sigma * np.random.default_rng(seed).normal(size=3)
        solved = solve(with_prior(small, place, sigma))
        assert solved.used[-3:].all()
        fit = solved.fit
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        covariance = fit.covariance(("edge", "cam"))
        squares.append(away @ np.linalg.solve(covariance, away))
        assert np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])).max() < sigma
        without = solve(small.cell).fit.covariance(("edge", "cam"))
        gains.append(np.trace(without[3:, 3:]) / np.trace(covariance[3:, 3:]))
    assert is_fair(squares, 6)
    assert min(gains) > 1.0


def test_a_component_that_the_views_contradict_is_left_out_alone():
    small = made(3, 16)
    place = small.edges["cam"][:3, 3] + np.array([0.0, 0.01, 0.0])
    turn = log(small.edges["cam"])[:3]
    solved = solve(with_prior(small, place, 5e-5, turn, 2e-3))
    assert solved.used[-4:].tolist() == [True, False, True, True]
    away = log(invert(small.edges["cam"]) @ solved.fit.edge("cam"))
    covariance = solved.fit.covariance(("edge", "cam"))
    # 0.999 of six degrees of freedom.
    assert away @ np.linalg.solve(covariance, away) < 22.5


def test_a_camera_that_no_robot_passes_is_placed_by_a_prior_alone():
    small = made(2, 6, in_hand=False)
    base_from_board = pose([0.3, 2.0, 0.1], [0.4, 0.2, 0.1])
    first, rng, looks = small.cell.sightings[0].evidence, np.random.default_rng(2), []
    for sighting in small.cell.sightings:
        look = replace(first, px=first.px + PX * rng.normal(size=first.px.shape))
        looks.append(replace(sighting, evidence=look))
    branches = {**small.cell.tree.branches, "target": Branch("base")}
    turn = log(base_from_board)[:3]
    looks += stated(("base", "target"), base_from_board[:3, 3], 1e-3, turn, 2e-3)
    cell = replace(small.cell, tree=Tree("cell", branches), sightings=tuple(looks))
    fit = solve(cell).fit
    board = fit.edge("target")
    assert board == pytest.approx(base_from_board, abs=1e-6)
    covariance = fit.covariance(("edge", "target"))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.repeat([2e-3, 1e-3], 3), rel=0.05)
    assert np.trace(fit.covariance(("edge", "cam"))[3:, 3:]) > np.trace(covariance[3:, 3:])


@pytest.mark.slow
def test_a_height_that_is_stated_of_a_base_leaves_its_turn_free():
    made_cell = simulate(OPTIONS)
    session = recorded(made_cell)
    cell = read_cell(session, session.corners)
    away = made_cell.between("base_a", "base_b")
    gauge = MeasuredPlace(away[2, 3] * np.eye(3)[2], 5e-4, (2,))
    known = cell.with_sightings([*cell.sightings, Sighting(-1, 0, "base_a", "base_b", gauge)])
    found, before = (solve(one).fit for one in (known, cell))
    assert found.used[-1]
    covariance, without = (fit.covariance(("edge", "base_b")) for fit in (found, before))
    # It adds to what is known, and holds nothing.
    assert np.diag(covariance)[:3] == pytest.approx(np.diag(without)[:3], rel=0.5)
    turn = log(invert(away) @ found.edge("base_b"))
    assert turn @ np.linalg.solve(covariance, turn) < 27.9  # one in ten thousand, of six


def test_tables_become_sightings_of_one_component_each():
    table = {"x_m": 0.03, "z_m": 0.12, "sigma_m": 1e-4}
    shop = instrument_session.tracked(InstrumentOptions(stops=6))
    session = session_of(shop, prior={"flange_from_probe": table})
    stated = [s for s in read_cell(session, {}).sightings if s.is_stated]
    assert [s.pair for s in stated] == [("flange", "point")] * 2
    assert [s.evidence.axes for s in stated] == [(0,), (2,)]
    assert [s.evidence.sigma_m for s in stated] == [1e-4, 1e-4]
    # One of no edge that is looked at says nothing.
    session = session_of(shop, prior={"flange_from_cam": table})
    assert not any(s.is_stated for s in read_cell(session, {}).sightings)


def test_a_prior_across_a_robot_is_refused_where_frames_have_names():
    shop = instrument_session.tracked(InstrumentOptions(stops=6))
    tables = {"base_from_probe": {"x_m": 0.0, "sigma_m": 1e-3}}
    session = session_of(shop, prior=tables, frames={"instrument": "cell"})
    with pytest.raises(DataError, match="no fixed place in each other"):
        read_cell(session, {})


def test_copies_of_a_reading_count_once_and_held_rows_are_kept():
    session = session_of(instrument_session.tracked(InstrumentOptions(stops=6)))
    first = session.views[0]
    copy = replace(first, number=100)
    held = replace(session.views[1], holdout=True)
    more = replace(session, views=(first, copy, held, *session.views[2:]))
    cell = read_cell(more, {})
    assert [s.view for s in cell.sightings] == [v.number for v in session.views]
    assert cell.held.tolist() == [False, True, False, False, False, False]


def test_poses_by_images_that_hardly_differ_are_one_reading_unless_taken_anew():
    one, other = (MeasuredPose(pose([0, 0, 0.3], [0, 0, 0.5 + away])) for away in (0.0, 1e-4))
    assert is_copy(one, other, is_anew=False)
    assert not is_copy(one, other, is_anew=True)
    assert not is_copy(one, MeasuredPose(pose([0, 0, 0.3], [0, 0, 0.503])), is_anew=False)
    by_tracker = [MeasuredPose(at.matrix, (5e-5, 2e-5)) for at in (one, other)]
    assert not is_copy(*by_tracker, is_anew=False)


def off_lens(rng, sigma_px, **changes):
    """A table of a lens whose matrix is stated wrong by a sigma."""
    matrix = (np.array(TABLE.matrix) + sigma_px * rng.normal(size=4)).tolist()
    return replace(TABLE, matrix=matrix, matrix_sigma_px=sigma_px, **changes)


@pytest.mark.parametrize("draws", seeds(1, 12))
@pytest.mark.parametrize("mode", ["hold", "refine", "auto"])
def test_a_stated_lens_is_as_sure_as_its_sigma(mode, draws):
    squares, sigma = [], 2.0
    for seed in draws:
        small = made(seed, 14)
        table = off_lens(np.random.default_rng(seed), sigma, intrinsics=mode)
        fit = solve(replace(small.cell, cameras={"cam": table})).fit
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away))
        has_moved = not np.array_equal(fit.camera("cam").matrix, np.array(table.matrix))
        assert has_moved == (mode != "hold")
        if mode != "hold":
            off = (fit.camera("cam").matrix - np.array(TABLE.matrix))[:4]
            sigmas = np.sqrt(np.diag(fit.covariance(("lens", "cam"))))[:4]
            assert (sigmas < sigma).all()
            assert (np.abs(off) < 5 * sigmas).all()
    assert is_fair(squares, 6)


def test_a_refined_lens_without_a_sigma_is_found_from_the_corners():
    small = made(5, 20)
    matrix = [value * 1.02 for value in TABLE.matrix[:2]] + list(TABLE.matrix[2:])
    table = replace(TABLE, matrix=matrix, intrinsics="refine")
    fit = solve(replace(small.cell, cameras={"cam": table})).fit
    off = fit.camera("cam").matrix - np.array(TABLE.matrix)
    sigmas = np.sqrt(np.diag(fit.covariance(("lens", "cam"))))[:4]
    assert (np.abs(off) < 5 * sigmas).all()
    assert (sigmas < 10).all()


def test_small_sizes_that_chance_explains_count_as_their_posterior_says():
    fit = solve(made(4, 16).cell).fit
    bare = replace(fit, considered=None, shift=None)
    edge_columns = fit.unknowns.columns("edge", "cam")
    names = [name for name in bare.unknowns.closed if name.endswith(" cam")]
    assert names
    expected = np.zeros((6, 6))
    for name in names:
        at = bare.unknowns.size_of(name)
        prior = next(
            prior
            for prior in bare.unknowns["lens", "cam"].priors
            if prior.size is not None and prior.size.name == name
        )
        columns = bare.unknowns.columns("lens", "cam")[prior.columns]
        inner = np.linalg.inv(bare.estimate.covariance[columns[:, None], columns])
        shown = inner - np.eye(len(columns)) * prior.size.low**-2.0
        sizes, _ = Score(np.zeros(len(columns)), shown, np.inf).posterior(
            prior.size.low, prior.size.high
        )
        found = []
        for size in sizes:
            logs = bare.estimate.logs.copy()
            logs[at] = np.log(size)
            found.append(bare.mixed.at(logs, is_sloped=False))
        logs = np.array([(bare.estimate.value - one.value) / 2 for one in found])
        weights = np.exp(logs) / (np.exp(logs).sum() + len(logs))
        for one, weight in zip(found, weights, strict=True):
            away = (one.values - bare.estimate.values)[edge_columns]
            covariance = (one.covariance - bare.estimate.covariance)[
                edge_columns[:, None], edge_columns
            ]
            expected += weight * (covariance + np.outer(away, away))
    others = {name for name in bare.unknowns.closed if name not in names}
    only = replace(bare, unknowns=bare.unknowns.closing(set(bare.unknowns.closed) - others))
    added = with_small_sizes(only).considered[edge_columns[:, None], edge_columns]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((added - expected) / scale).max() < 0.02


def test_a_stated_lens_leaves_without_its_field_as_matrix_and_distortion_explain_best():
    small = made(5, stops=24)
    bent = []
    for sighting in small.cell.sightings:
        # None of the lens's own parameters does just that.
        x, y = (sighting.corners.px / 150.0).T
        px = sighting.corners.px + 0.5 * np.column_stack([np.sin(y), np.cos(x)])
        bent.append(replace(sighting, evidence=replace(sighting.corners, px=px)))
    fit = solve(small.cell.with_sightings(bent)).fit
    field, values = fit.unknowns.fields["cam"], fit.state.values["field", "cam"]
    lens, bare = fit.unknowns.camera(fit.state, "cam"), fit.camera("cam")
    axes = (np.linspace(0.0, side - 1.0, 33) for side in lens.resolution)
    px = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays = np.column_stack([(px - lens.matrix[2:]) / lens.matrix[:2], np.ones(len(px))])
    seen = project(lens, rays)

    def left(camera):
        return float(np.mean((project(camera, rays) - seen - field.moved(px, values)) ** 2))

    assert 1e-3 < left(bare) < left(lens)
    # No change of matrix or distortion by which corners move by a tenth of a pixel is nearer.
    for column, step in enumerate(np.eye(9)):
        by = np.abs(by_lens(lens, px)[:, :, column]).max()
        for sign in (-1, 1):
            other = with_intrinsics(bare, intrinsics(bare) + sign * 0.1 / by * step)
            assert left(other) > left(bare)


@pytest.mark.parametrize("draws", seeds(1, 8))
@pytest.mark.parametrize("stops", [5, 14])
def test_the_axis_of_a_given_lens_with_wrong_decentring_is_within_its_sigma(stops, draws):
    squares = []
    for seed in draws:
        # Five views leave distortion no parameters of its own: a field shows that it is wrong.
        small, off = made(seed, stops), np.array(TABLE.distortion)
        off[2:4] += [1.6e-3, -1.2e-3]
        table = replace(TABLE, distortion=tuple(off.tolist()))
        fit = solve(replace(small.cell, cameras={"cam": table})).fit
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away))
    assert is_fair(squares, 6)

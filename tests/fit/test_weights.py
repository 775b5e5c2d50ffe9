"""Corners that disagree within their views, and noise that differs from view to view."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import seeds
from support.small_cells import PX, made

from visioncal.core.transforms import invert, log
from visioncal.fit.pairs import pairs_of
from visioncal.fit.solve import solve
from visioncal.fit.start import start_lenses, start_of
from visioncal.fit.weights import by_homography, first_weighed, weighed
from visioncal.vision.targets import corner_positions

WRONG = {1: [3], 4: [0, 7, 12], 5: [19]}


def seen_otherwise(cell, change):
    """The cell with (row, corners) changed: `change` has the row's number and its corners."""
    sightings = [
        replace(sighting, evidence=change(row, sighting.corners))
        for row, sighting in enumerate(cell.sightings)
    ]
    return cell.with_sightings(sightings)


def displaced(row, corners):
    """Some corners are 3 to 40 px off."""
    rng, px = np.random.default_rng(row), corners.px.copy()
    for at in WRONG.get(row, []):
        px[at] += rng.uniform(3, 40) * np.array([np.cos(row), np.sin(row)])
    return replace(corners, px=px)


def without_those(row, corners):
    """The corners without those that `displaced` moves."""
    return corners.take(np.setdiff1d(np.arange(len(corners.ids)), WRONG.get(row, [])))


@pytest.mark.parametrize("given", [True, False])
def test_wrong_corners_are_as_good_as_absent(given):
    cell = made(2, stops=10, given=given).cell
    with_wrong = solve(seen_otherwise(cell, displaced)).fit
    without = solve(seen_otherwise(cell, without_those)).fit
    assert [len(s.corners.ids) for s in with_wrong.cell.sightings] == [
        20 - len(WRONG.get(row, [])) for row in range(10)
    ]
    # The same rows are counted, so that sizes and covariance are the same; where the lens is not
    # given, iterations start elsewhere.
    assert with_wrong.mixed.terms[0].count == without.mixed.terms[0].count
    assert with_wrong.sizes == pytest.approx(without.sizes, rel=1e-2)
    away = log(invert(without.edge("cam")) @ with_wrong.edge("cam"))
    sigmas = np.sqrt(np.diag(without.covariance(("edge", "cam"))))
    assert np.abs(away / sigmas).max() < 0.02
    ratio = np.diag(with_wrong.covariance(("edge", "cam"))) / sigmas**2
    assert ratio == pytest.approx(np.ones(6), rel=0.02)


def test_a_corner_that_only_the_fit_shows_is_left_out_then():
    cell = made(3, stops=10).cell
    solved = solve(cell)
    moved = solved.fit.state.values["lens", "cam"].copy()
    fit = solved.fit
    bad = seen_otherwise(fit.cell, displaced)
    found = weighed(bad, fit.unknowns, fit.state, pairs_of(bad), fit.used)
    assert found.changed
    for row, sighting in enumerate(found.cell.sightings):
        left = np.setdiff1d(np.arange(20), sighting.corners.ids)
        assert left.tolist() == WRONG.get(row, [])
    assert fit.state.values["lens", "cam"] == pytest.approx(moved)


def test_sound_corners_stay_as_they_are():
    for seed in range(20):
        cell = made(seed, stops=10).cell
        found = first_weighed(cell, start_lenses(cell, {}))
        assert not found.changed
        assert found.sound.all()


def test_a_view_of_two_boards_is_left_out():
    def torn(row, corners):
        px = corners.px.copy()
        px[:9] += [6.0, 25.0]
        return replace(corners, px=px) if row == 6 else corners

    solved = solve(seen_otherwise(made(4, stops=10).cell, torn))
    # Half of it is one board: that half may stay, but not what is neither.
    assert not solved.fit.used[6] or len(solved.fit.cell.sightings[6].corners.ids) <= 11
    assert solved.fit.used.sum() >= 9


@pytest.mark.parametrize("draws", seeds(2, 12))
def test_noise_by_view_is_found(draws):
    sigmas = PX * np.array([1, 1, 4, 1, 2, 1, 1, 4, 1, 2, 1, 1])
    squares = []
    for seed in draws:
        small, rng = made(seed, stops=12), np.random.default_rng([seed, 3])

        def noisier(row, corners, rng=rng):
            more = np.sqrt(sigmas[row] ** 2 - PX**2)
            return replace(corners, px=corners.px + more * rng.normal(size=corners.px.shape))

        fit = solve(seen_otherwise(small.cell, noisier)).fit
        assert fit.used.sum() >= 11
        away = log(invert(small.edges["cam"]) @ fit.edge("cam"))
        squares.append(away @ np.linalg.solve(fit.covariance(("edge", "cam")), away))
        weights = [s.corners.weights[0] for s in fit.cell.sightings]
        # Each is known to 1 / sqrt(2 * 34) by its own corners, and drawn to the others'.
        relative = np.log(sigmas * weights * fit.sizes["px cam"] ** -1.0)
        assert np.abs(relative).max() < 0.6
    # Three sigma of the mean of so many of six degrees.
    assert np.mean(squares) / 6 == pytest.approx(1.0, abs=np.sqrt(3.0 / len(squares)))


def test_stated_noise_is_kept():
    def stated(row, corners):
        more = 0.5 * np.random.default_rng(row).normal(size=corners.px.shape) * (row == 2)
        return replace(corners, stated_px=PX, px=corners.px + more)

    cell = seen_otherwise(made(0, stops=10).cell, stated)
    found = start_of(cell)
    assert all(sighting.corners.weights is None for sighting in found.cell.sightings)


def test_exact_corners_are_not_weighed_by_their_rounding():
    def exact(row, corners):
        points = corner_positions(cell.boards["target"])[corners.ids]
        turned = points[:, :2] @ [[0.9, 0.1], [-0.2, 1.0]] * 1e4
        return replace(corners, px=np.round(turned, 9 + row % 3))

    cell = made(0, stops=10).cell
    lenses = {"cam": replace(start_lenses(cell, {})["cam"], distortion=np.zeros(5))}
    found = first_weighed(seen_otherwise(cell, exact), lenses)
    assert not found.changed


def test_a_homography_needs_more_corners_than_four():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    assert by_homography(points, points[:, :2] + [[0, 9], [0, 0], [0, 0], [0, 0]]).agreeing.all()

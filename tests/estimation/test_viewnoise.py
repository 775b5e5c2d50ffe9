"""Noise of corners by view."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, showing

from visioncal.core.transforms import invert, log
from visioncal.estimation.viewnoise import weights_by_view
from visioncal.simulation import CellOptions, simulate


@pytest.mark.parametrize("freedom", [8.0, 100.0])
def test_views_of_one_noise_weigh_alike(freedom):
    rng = np.random.default_rng(0)
    all_of = np.full(20, freedom)
    # One of ten thousand is called uneven by chance.
    assert all(weights_by_view(rng.chisquare(all_of), all_of) is None for _ in range(100))


def test_weights_are_what_noise_asks_for():
    rng = np.random.default_rng(1)
    freedom = rng.integers(20, 120, 40).astype(float)
    sigma = np.exp(0.4 * rng.standard_normal(40))
    squares = sigma**2 * rng.chisquare(freedom)
    scaled = sigma * weights_by_view(squares, freedom)
    # A variance of 70 degrees of freedom is known to 17 %, its root to 8 %.
    assert np.std(np.log(scaled)) < 0.12
    # Drawn towards all: less is made of a view than its residuals alone would.
    alone = np.log(np.sqrt(squares / freedom))
    assert np.std(np.log(weights_by_view(squares, freedom))) < np.std(alone)


def test_views_that_say_nothing_set_no_weights():
    assert weights_by_view(np.array([1.0]), np.array([50.0])) is None
    assert weights_by_view(np.array([1.0, 0.0, 900.0]), np.full(3, 50.0)) is None
    assert weights_by_view(np.array([1.0, 2.0, 900.0]), np.array([50.0, 0.0, 50.0])) is None


def nees(cell, known, views):
    """Mean squared error of the chosen poses over their covariance, by degree of freedom."""
    found = []
    for view in views:
        seen = known.poses[view]
        error = log(invert(cell.cam_from_target[view][None]) @ seen.cam_from_target[:1])[0]
        found.append(error @ np.linalg.solve(seen.covariance[0], error) / 6.0)
    return float(np.mean(found))


def test_sharp_and_blurred_views_have_their_own_covariance():
    cell = simulate(replace(CellOptions(), views=24, state_intrinsics=True, seed=5))
    rng = np.random.default_rng(0)
    corners = [
        replace(
            view_corners,
            px=view_corners.px + (0.0, 0.15)[at % 2] * rng.standard_normal(view_corners.px.shape),
        )
        for at, view_corners in enumerate(cell.corners)
    ]
    uneven = showing(cell, corners)
    known = calibrated(uneven)
    assert len(known.used) == 24
    # 72 degrees of freedom tell a mean square to 17 %; one noise for all gives 0.2 and 1.8.
    for first in (0, 1):
        assert 0.6 < nees(cell, known, range(first, 24, 2)) < 1.5
    weights = [known.poses[index].corners.weights.mean() for index in range(24)]
    assert min(weights[::2]) > 2.0 * max(weights[1::2])
    even = calibrated(cell)
    assert all(even.poses[index].corners.weights is None for index in range(24))

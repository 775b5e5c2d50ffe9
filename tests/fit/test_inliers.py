"""Sightings that disagree with the others, those that hide each other, and sound ones."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import seeds
from support.small_cells import ROBOT_M, ROBOT_RAD, made, pose

from visioncal.fit.solve import solve


def wrong_at(cell, rows, sigmas):
    """The cell whose arm is elsewhere than it reports at some stops, by so many sigmas an axis."""
    arm, rng = cell.arms["flange"], np.random.default_rng(9)
    poses = arm.poses.copy()
    for row in rows:
        signs = rng.choice([-1.0, 1.0], size=6)
        poses[row] = poses[row] @ pose(sigmas * ROBOT_RAD * signs[:3], sigmas * ROBOT_M * signs[3:])
    moments = replace(cell.moments, poses={"flange": poses})
    return replace(cell, arms={"flange": replace(arm, poses=poses)}, moments=moments)


@pytest.mark.parametrize(
    ("rows", "sigmas"), [([4], 6.0), ([2, 9], 7.0), ([2, 5, 9], 8.0), ([1, 5, 6, 10], 300.0)]
)
@pytest.mark.parametrize("draws", seeds(1, 3))
def test_wrong_stops_are_left_out(rows, sigmas, draws):
    for seed in draws:
        cell = wrong_at(made(seed, stops=14).cell, rows, sigmas)
        assert np.flatnonzero(~solve(cell).used).tolist() == rows


@pytest.mark.parametrize("draws", seeds(1, 12))
def test_sound_stops_stay(draws):
    # One sound session of a thousand loses one.
    assert all(solve(made(seed, stops=12).cell).used.all() for seed in draws)


def test_half_of_the_stops_stay_however_wrong_the_others_are():
    rng = np.random.default_rng(2)
    cell = made(1, stops=12).cell
    rows = rng.permutation(12)[:5]
    used = solve(wrong_at(cell, rows, 500.0)).used
    assert np.flatnonzero(~used).tolist() == sorted(rows.tolist())

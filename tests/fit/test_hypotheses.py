"""What is wrong with a record, named by one score."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_cells import BOARD, made, pose

from visioncal.fit.hypothesis import Exchanged, Moved, Turned, ranked
from visioncal.fit.solve import solve

KINDS = (Moved(), Turned(), Exchanged())


def with_arm(cell, poses):
    arms = {"flange": replace(cell.arms["flange"], poses=poses)}
    moments = replace(cell.moments, poses={"flange": poses})
    return replace(cell, arms=arms, moments=moments)


def sound(cell):
    return cell


def moved(cell):
    """The board was pushed by 4 mm before the ninth stop."""
    poses = cell.arms["flange"].poses.copy()
    poses[8:] = pose([0, 0, 0], [0.004, 0.0, 0.0]) @ poses[8:]
    return with_arm(cell, poses)


def exchanged(cell):
    poses = cell.arms["flange"].poses.copy()
    poses[[3, 9]] = poses[[9, 3]]
    return with_arm(cell, poses)


def turned(cell):
    found = list(cell.sightings)
    for row in (2, 7):
        corners = found[row].evidence
        ids = BOARD.columns * BOARD.rows - 1 - corners.ids
        found[row] = replace(found[row], evidence=replace(corners, ids=ids))
    return cell.with_sightings(found)


@pytest.mark.parametrize("plant", [moved, exchanged, turned])
def test_what_was_planted_comes_first(plant):
    for seed in range(4):
        (case, probability), *_ = ranked(solve(plant(made(seed, stops=16).cell)), KINDS)
        assert case.kind == plant.__name__, (seed, case)
        assert probability > 0.9
        if plant is moved:
            # The push is shared by all edges of one camera and one board; its stop is not.
            assert case.views == (8,)
        else:
            assert set(case.views) == ({3, 9} if plant is exchanged else {2, 7})


def test_sound_records_are_not_accused():
    for seed in range(8):
        found = ranked(solve(made(seed, stops=16).cell), KINDS)
        assert sum(probability for _, probability in found) < 0.5, found[0]


def test_all_sightings_agree_where_none_is_rejected():
    solved = solve(made(stops=12).cell)
    assert solved.fit.used.all()
    assert np.isfinite([case.odds for case, _ in ranked(solved, KINDS)]).all()

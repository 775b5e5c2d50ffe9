"""Wrong corners and wrong views against noise; corners that determine a pose."""

import numpy as np
import pytest

from visioncal.core.types import Corners
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.gating import gate
from visioncal.estimation.poses import determines_pose

GRID = np.array([[x, y, 0.0] for y in range(5) for x in range(8)])


def stack_of(views=6):
    corners = {view: Corners(view, np.arange(40), np.zeros((40, 2)), 0.7) for view in range(views)}
    return CornerStack.of(corners, GRID)


def noise(stack, seed=0):
    return np.random.default_rng(seed).normal(0.0, 0.1, (len(stack.px), 2))


def test_noise_passes():
    stack = stack_of()
    for seed in range(50):
        passed = gate(stack, noise(stack, seed))
        assert passed.is_open
        assert not passed.reasons


def test_a_wrong_corner_goes_and_its_view_stays():
    stack = stack_of()
    residuals = noise(stack)
    residuals[45] += [4.0, 3.0]
    passed = gate(stack, residuals)
    assert np.flatnonzero(~passed.mask).tolist() == [45]
    assert not passed.reasons


def test_a_view_of_another_board_goes_as_a_whole():
    stack = stack_of()
    residuals = noise(stack)
    residuals[stack.view_of == 2] *= 30.0
    passed = gate(stack, residuals)
    assert set(passed.reasons) == {2}
    assert not passed.mask[stack.view_of == 2].any()
    assert passed.mask[stack.view_of != 2].all()


def test_a_view_with_too_few_good_corners_says_so():
    stack = stack_of()
    residuals = noise(stack)
    residuals[80:104] += 20.0  # 24 of the 40 corners of view 2
    passed = gate(stack, residuals)
    assert "only 16 of 40 corners fit one pose" in passed.reasons[2]


def test_small_errors_are_no_reason_however_quiet_the_rest():
    stack = stack_of()
    residuals = 1e-3 * noise(stack)
    residuals[3] += [0.3, 0.3]
    assert gate(stack, residuals).is_open


@pytest.mark.parametrize(
    ("ids", "enough"),
    [
        ([0, 1, 8, 9], True),
        ([0, 1, 2, 8, 10], True),
        ([0, 1, 2], False),
        ([0, 1, 2, 3, 4, 5], False),
        ([0, 1, 2, 3, 4, 13], False),  # all but one in a row
        ([13, 0, 1, 2, 3, 4], False),
        ([0, 9, 18, 27, 3], False),  # all but one on a diagonal
        ([0, 1, 2, 3, 12, 13], True),
    ],
)
def test_two_corners_off_every_line_determine_a_pose(ids, enough):
    assert determines_pose(GRID[ids]) is enough

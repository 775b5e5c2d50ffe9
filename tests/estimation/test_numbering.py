"""Exchanged and shifted numbers of points are told by geometry, where it can tell them."""

from itertools import permutations

import numpy as np
import pytest
from support.parts import placed, some_drawing, some_frame

from visioncal.estimation.numbering import find_numbering
from visioncal.estimation.procrustes import procrustes_residual

NOISE_M = 1e-4
NAMES = [f"P{at}" for at in range(40)]
SQUARE = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.2, 0.0], [0.0, 0.2, 0.0]])
TRIANGLE = 0.2 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, np.sqrt(0.75), 0.0]])


def measured(nominal, order, rng, noise_m=NOISE_M):
    points = placed(some_frame(rng), nominal[order])
    return points + noise_m * rng.normal(size=points.shape)


ORDERS = {
    "swapped": (lambda n: [1, 0, *range(2, n)], "P0 and P1 are exchanged"),
    "shifted": (lambda n: [*range(1, n), 0], "points are exchanged: P0 is P1"),
    "reversed": (lambda n: [*range(n)][::-1], "points are exchanged: P0 is P"),
    "anyhow": (lambda n: [2, 0, 1, *range(4, n), 3], "points are exchanged: P0 is P2, P1 is P0"),
}


@pytest.mark.parametrize("count", [5, 7, 12, 30])
@pytest.mark.parametrize("order", ORDERS)
def test_a_wrong_order_is_found_and_named(order, count):
    rng = np.random.default_rng(count)
    nominal, (make, words) = some_drawing(rng, count), ORDERS[order]
    found = find_numbering(measured(nominal, make(count), rng), nominal)
    assert found.is_wrong
    assert found.equally_good == 1
    assert found.assignment.tolist() == make(count)
    assert found.words(NAMES[:count]).startswith(words)
    # Root mean square over three coordinates of noise that the fit has taken a part of.
    assert found.rms_m < 2 * NOISE_M < found.stated_rms_m


def test_a_right_order_is_left_alone():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        nominal = some_drawing(rng, 3 + seed % 10)
        found = find_numbering(measured(nominal, np.arange(len(nominal)), rng), nominal)
        assert not found.is_wrong
        assert not len(found.moved)
        assert found.words(NAMES[: len(nominal)]) == ""


@pytest.mark.parametrize(("pattern", "orders"), [(SQUARE, 8), (TRIANGLE, 6)])
def test_a_symmetrical_pattern_cannot_be_told(pattern, orders):
    rng = np.random.default_rng(0)
    turned = np.roll(np.arange(len(pattern)), 1)
    found = find_numbering(measured(pattern, turned, rng), pattern)
    # It fits in any order that is a symmetry, so that nothing speaks against the stated one.
    assert not found.is_wrong
    assert not len(found.moved)
    assert found.equally_good == orders


def test_two_exchanged_corners_of_a_square_are_two_of_several():
    found = find_numbering(measured(SQUARE, [1, 0, 2, 3], np.random.default_rng(0)), SQUARE)
    assert found.is_wrong
    assert found.equally_good == 8
    # The orders that move the fewest: it may as well be the other two.
    assert len(found.moved) == 2


@pytest.mark.parametrize("drawn", [6, 15])
def test_a_point_that_was_skipped_is_found_in_a_longer_drawing(drawn):
    rng = np.random.default_rng(1)
    nominal, order = some_drawing(rng, drawn), [0, 1, 3, 4, 5]
    found = find_numbering(measured(nominal, order, rng), nominal)
    assert found.is_wrong
    assert found.assignment.tolist() == order
    assert found.words(NAMES[:drawn]) == "points are exchanged: P2 is P3, P3 is P4, P4 is P5"


def test_what_is_known_of_the_noise_counts_in_its_favour():
    rng = np.random.default_rng(3)
    # Nearly equal sides: exchanged, the triangle fits to 0.6 mm.
    nominal = TRIANGLE + 1e-3 * rng.normal(size=(3, 3))
    points = measured(nominal, [1, 0, 2], rng, 0.0)
    assert find_numbering(points, nominal).is_wrong
    assert not find_numbering(points, nominal, noise_m=1e-3).is_wrong


def test_triangles_find_what_trying_all_orders_finds():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        nominal = some_drawing(rng, 6)
        points = measured(nominal, rng.permutation(6), rng, 1e-3)
        tried = find_numbering(points, nominal)
        best = min(
            permutations(range(6)),
            key=lambda permutation: procrustes_residual(points, nominal[list(permutation)]),
        )
        assert tried.assignment.tolist() == list(best)

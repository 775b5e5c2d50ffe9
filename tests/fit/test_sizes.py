"""Sizes that chance explains, alone and beside others of the same thing."""

from types import SimpleNamespace

import numpy as np

from visioncal.fit.sizes import most_likely, significant
from visioncal.model.effects import Size

LOW, HIGH, BEST = np.log(1e-3), np.log(1e2), 0.0


class Independent:
    """A likelihood whose parts gain so much at their best sizes, and nothing at the lowest."""

    def __init__(self, gains):
        self.gains = np.array(gains)

    def at(self, logs, *, is_sloped=True):
        """The estimate at some logarithms of sizes, as `Mixed.at`."""
        del is_sloped
        away = (logs - BEST) / (BEST - LOW)
        slope, curvature = (2.0 * self.gains * away, 2.0 * self.gains) / (BEST - LOW) ** np.array(
            [[1.0], [2.0]]
        )
        value = float(self.gains @ away**2)
        return SimpleNamespace(logs=logs, value=value, gradient=slope, curvature=np.diag(curvature))


def closed(gains, owners, limits=(13.8,) * 3):
    mixed, low, high = Independent(gains), np.full(3, LOW), np.full(3, HIGH)
    sizes = {
        at: Size("size", 1.0, 1e-3, 1e2, limit, owner)
        for at, (limit, owner) in enumerate(zip(limits, owners, strict=True))
    }
    start = np.full(3, 1.0)
    found = most_likely(mixed, start, low, high)
    return significant(mixed, found, start, low, high, sizes)[1]


def test_sizes_of_chance_are_closed_together():
    assert closed([30.0, 1.0, 2.0], ["", "", ""]) == (1, 2)


def test_sizes_of_a_lens_that_is_off_stay_open():
    # A given lens whose focal length is off has hardly the centre that is stated.
    assert closed([30.0, 1.0, 2.0], ["lens", "lens", "board"]) == (2,)


def test_an_error_that_is_more_frequent_needs_less_evidence():
    assert closed([5.0, 5.0, 5.0], ["a", "b", "c"], limits=(13.8, 4.4, 13.8)) == (0, 2)

"""Limits of chance, against scipy's distributions."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import chi2, f, t

from visioncal.core.quantiles import chi2_limit, crossing, f_limit, t_chance

CHANCES = (0.5, 0.05, 1e-4, 1e-9)


# Two ways to the same quantile: a few thousand units in the last place.
@pytest.mark.parametrize("chance", CHANCES)
def test_limits_are_the_distributions_upper_quantiles(chance):
    freedoms = np.array([1, 6, 40, 300])
    assert chi2_limit(chance, freedoms) == pytest.approx(chi2.isf(chance, freedoms), rel=1e-9)
    for of_noise in (3, 50, 1e6):
        expected = f.isf(chance, freedoms, of_noise)
        assert f_limit(chance, freedoms, of_noise) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("value", [-3.0, 0.0, 0.7, 20.0])
def test_chance_counts_both_sides(value):
    assert t_chance(value, 4) == pytest.approx(2 * t.sf(abs(value), 4), rel=1e-9)


@pytest.mark.parametrize("freedom", [1, 6, 40])
@pytest.mark.parametrize("share", [1e-6, 0.05, 0.5, 0.999])
def test_a_crossing_is_the_quantile_of_what_rises_or_falls(share, freedom):
    # The function is flat at both ends.
    place = chi2.ppf(share, freedom)
    ends = place - 1e3, place + 1e3
    risen = crossing(lambda it: float(chi2.cdf(it, freedom)) - share, *ends, 1e-9)
    fallen = crossing(lambda it: share - float(chi2.cdf(it, freedom)), *ends, 1e-9)
    # The next place is nearer by far than the last two are to each other.
    np.testing.assert_allclose([risen, fallen], place, atol=1e-9)
    assert crossing(lambda it: it - 2.0, 2.0, 3.0) == crossing(lambda it: it - 2.0, 1.0, 2.0) == 2.0
    with pytest.raises(ValueError, match="no change of sign between 1 and 3"):
        crossing(lambda it: it, 1.0, 3.0)


def test_nothing_loads_the_slow_way_to_them():
    code = "import sys, visioncal.calibration.pipeline, visioncal.frames;"
    code += "print({'scipy.stats', 'scipy.optimize'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "set()"

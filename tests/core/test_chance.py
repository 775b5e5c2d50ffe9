"""Limits of chance, against scipy's distributions."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import chi2, f, t

from visioncal.core.quantiles import chi2_limit, f_limit, t_chance

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


def test_nothing_loads_the_slow_way_to_them():
    code = "import sys, visioncal.calibration.pipeline, visioncal.frames;"
    code += "print('scipy.stats' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"

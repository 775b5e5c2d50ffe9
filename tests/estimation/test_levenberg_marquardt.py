"""Levenberg-Marquardt where Gauss and Newton's curvature is far too small."""

import numpy as np
import pytest

from visioncal.estimation.levenberg_marquardt import Linearised, levenberg_marquardt


def bent(curvature: float, seen: list[float]):
    """Residuals x + 1 and c x^2 + x - 1 (Dennis and Schnabel 1983, example 10.2.4).

    The least cost is at zero, where steps without damping err by a factor of -c.
    """

    def linearise(at: float) -> Linearised[float]:
        residuals = np.array([at + 1.0, curvature * at**2 + at - 1.0])
        slopes = np.array([1.0, 2.0 * curvature * at + 1.0])
        information, gradient = slopes @ slopes, slopes @ residuals
        seen.append(at)

        def change(damping: float) -> float:
            return -gradient / (information * (1.0 + damping))

        def fall(damping: float) -> float:
            step = change(damping)
            return float(-2.0 * gradient * step - information * step**2)

        return Linearised(at, float(residuals @ residuals), lambda by: at + change(by), fall)

    return linearise


@pytest.mark.parametrize("curvature", [-0.5, -3.0, -30.0])
def test_it_rests_at_the_least_cost_in_few_steps(curvature):
    seen: list[float] = []
    found, settled = levenberg_marquardt(0.9, bent(curvature, seen), settled=1e-10)
    assert settled
    # About (1 - c) x^2 is what the cost is above its least, and 1e-10 of it 2e-6 at most. Damping
    # that falls to a tenth after each step downwards rests 5e-6 to 1e-3 away, in 17 to 27 steps.
    assert abs(found) < 2e-6
    assert len(seen) < 25

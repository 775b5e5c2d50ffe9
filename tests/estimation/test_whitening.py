"""Errors of flanges far beyond the noise of what was read at them."""

import numpy as np
import pytest

from visioncal.estimation.normal_equations import _factors


def test_errors_far_beyond_the_noise_are_factored():
    """A point at a lever determines three of six errors; rounding makes the others negative."""
    lever = np.array([[0.0, 0.3, -0.2], [-0.3, 0.0, 0.7], [0.2, -0.7, 0.0]])
    rows = 4.5e8 * np.hstack([lever, np.eye(3)])
    information = (rows.T @ rows + np.eye(6))[None]
    information[0, 0, 0] -= 200.0
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(information)
    factors = _factors(information)
    product = factors @ np.swapaxes(factors, 1, 2)
    # To the share of the diagonal that is added.
    np.testing.assert_allclose(product, information, rtol=1e-11, atol=1e-11 * information.max())

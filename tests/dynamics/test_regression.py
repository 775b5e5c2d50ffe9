"""Weighted least squares with a covariance: noise of several levels, correlated noise, outliers."""

from dataclasses import replace

import numpy as np
import pytest

from visioncal.dynamics.regression import NoiseBlock, regress

TRUE = np.array([2.0, -1.0, 0.5])
SIGMAS = np.array([0.1, 1.0])
NONE = np.zeros(0)


def block(seed: int, count: int = 400, taps=(1.0,)) -> NoiseBlock:
    """Slow columns, which correlated noise hurts, for two joints of different noise."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    angle = 0.05 * np.arange(count)[:, None, None] * np.array([0.3, 0.7, 1.1]) + phase
    x = np.sin(angle)
    weights = np.array(taps) / np.linalg.norm(taps)
    white = rng.standard_normal((count + len(taps) - 1, 2))
    noise = np.apply_along_axis(np.convolve, 0, white, weights, "valid")
    return NoiseBlock(x, x @ TRUE + SIGMAS * noise, np.ones((count, 2), dtype=bool), NONE)


def chi2(fit) -> float:
    away = fit.values - TRUE
    return float(away @ np.linalg.solve(fit.covariance, away))


@pytest.mark.parametrize("taps", [(1.0,), (1.0, 1.0, 1.0, 1.0)])
def test_the_covariance_counts_white_and_correlated_noise(taps):
    found = np.mean([chi2(regress([block(seed, taps=taps)])) for seed in range(60)])
    # The mean of 60 draws of chi-square of 3 degrees of freedom is known to 0.32; covariances that
    # took four equal neighbours for four samples would make it 12.
    assert found == pytest.approx(3.0, abs=1.2)


def test_each_joint_gets_the_weight_of_its_noise():
    fit = regress([block(1, 2000)])
    # The standard deviation of 2000 draws is known to 1.6 %.
    assert fit.sigmas[0] == pytest.approx(SIGMAS, rel=0.06)
    (only,), (left,), (sigma,) = fit.blocks, fit.residuals, fit.sigmas
    assert np.sum((only.used * left / sigma) ** 2) == pytest.approx(4000.0, rel=0.06)


def test_blocks_have_noise_of_their_own():
    quiet, loud = block(2, 1000), block(3, 1000)
    loud = replace(loud, y=loud.x @ TRUE + 10.0 * (loud.y - loud.x @ TRUE))
    fit = regress([quiet, loud])
    assert fit.sigmas[1] / fit.sigmas[0] == pytest.approx([10.0, 10.0], rel=0.1)


def test_outliers_are_left_out():
    wrong = block(4)
    y = wrong.y.copy()
    y[[10, 100], 0] += 5.0
    y[50:60, 1] -= 30.0
    fit = regress([replace(wrong, y=y)])
    used = fit.blocks[0].used
    assert not used[[10, 100], 0].any()
    assert not used[50:60, 1].any()
    assert used.mean() > 0.97
    assert chi2(fit) < 16.3  # chance exceeds it once in a thousand


def test_unused_rows_count_for_nothing():
    whole = block(5)
    used = whole.used.copy()
    used[200:] = False
    y = whole.y.copy()
    y[200:] = 1e6
    half = regress([NoiseBlock(whole.x[:200], whole.y[:200], whole.used[:200], NONE)])
    fit = regress([replace(whole, y=y, used=used)])
    assert fit.values == pytest.approx(half.values, rel=1e-12)
    assert np.diag(fit.covariance) == pytest.approx(np.diag(half.covariance), rel=1e-9)


def test_columns_without_effect_are_refused():
    empty = block(6)
    x = empty.x.copy()
    x[..., 1] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        regress([replace(empty, x=x)])

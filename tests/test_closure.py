"""Identities of the joint fit: views left out, stops merged, and the likelihood's slope."""

from dataclasses import replace

import numpy as np
import pytest
from cells import calibrated

from visioncal.errors import ConvergenceError
from visioncal.estimation import joint
from visioncal.estimation.closure import (
    Closure,
    fit_closure,
    solve_closure,
)
from visioncal.estimation.problem import ROBOT, Effect
from visioncal.estimation.solve import (
    RATIO_PRIOR,
    left_out_residuals,
    normal_equations,
    robot_likelihood,
)
from visioncal.estimation.variance import Components, Knowledge, _likelihood, estimate_sigmas
from visioncal.simulation import CellOptions, fine_camera, simulate

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)
LENS = pytest.mark.parametrize("given", [True, False], ids=["lens given", "lens estimated"])


def answered(given, **changes):
    known = calibrated(simulate(replace(FINE, state_intrinsics=given, **changes)))
    data = known.closure(known.used)
    return data, fit_closure(data, known.solved.edges)


@LENS
def test_residuals_of_views_left_out_are_those_of_fits_without_them(given):
    data, fit = answered(given, views=12, seed=3)
    predicted = left_out_residuals(data.problem, fit.edges.state, fit.noise.levels)
    linear = data.problem.linear(fit.edges.state)
    spread = data.problem.total_covariance(linear, fit.noise.levels)
    for view in range(12):
        others = np.arange(12) != view
        without, _ = solve_closure(data.subset(others), fit.edges, fit.noise)
        refitted = data.problem.linear(without.state).residuals[view]
        sigma = np.sqrt(np.diagonal(spread[view]))
        # To first order: what is left is the curvature over a step of the size of the noise.
        np.testing.assert_allclose(predicted[view], refitted, atol=0.01 * sigma.max())


def doubled(data):
    """Every view twice, as two that know half as much each."""
    again = np.repeat(np.arange(len(data)), 2)
    return Closure(
        data.mount,
        data.robot[again],
        data.camera[again],
        2.0 * data.camera_covariance[again],
        tuple(it.take(again).of_stops(again) for it in data.effects),
    ), again


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_stop_seen_twice_half_as_well_is_one_seen_once(mount):
    data, fit = answered(False, views=8, seed=2, mount=mount)
    arm = 1e-3 * np.random.default_rng(0).standard_normal((8, 6, 2))
    known = Knowledge(np.eye(2), np.zeros(2))
    data = data.with_more(Effect.free("arm", known, by_flange={ROBOT: arm}))
    once = replace(fit.edges, shared=data.unchanged)
    twice, stops = doubled(data)
    merged = twice.merged(stops)
    for expected, seen in zip(
        normal_equations(data.problem, once.state, fit.noise.levels),
        normal_equations(merged.problem, once.state, fit.noise.levels),
        strict=True,
    ):
        # The same sums in another order.
        np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_views_of_a_stop_move_with_the_lens_by_their_information():
    data, _ = answered(False, views=8, seed=2)
    twice, stops = doubled(data)
    # The second view of each stop knows nothing to speak of, and says nonsense.
    (effect,) = twice.effects
    known, lens = twice.camera_covariance.copy(), effect.by_sensor.copy()
    known[1::2] *= 1e12
    lens[1::2] *= -5.0
    lopsided = replace(
        twice, camera_covariance=known, effects=(replace(effect, by_sensor=lens),)
    ).merged(stops)
    (seen,), (before,) = lopsided.effects, data.effects
    np.testing.assert_allclose(seen.by_sensor, before.by_sensor, rtol=1e-6)
    np.testing.assert_allclose(lopsided.camera_covariance, 2 * data.camera_covariance, rtol=1e-6)


@LENS
def test_the_likelihood_slopes_as_its_differences_say(given):
    data, fit = answered(given, views=10, seed=4)
    edges = fit.edges.moved(np.full(12 + len(fit.edges.shared), 1e-5))
    found = robot_likelihood(data.problem, edges.state, fit.noise.levels)
    errors, slopes = found.reduced.errors, found.reduced.slopes[:, :, found.moving]

    def at(logs):
        return _likelihood(errors, slopes, found.components, found.known, logs, RATIO_PRIOR)

    logs, step = np.log(2.0 * fit.noise.sigmas), 1e-4
    for level in range(2):
        shift = step * np.eye(2)[level]
        slope = (at(logs + shift).value - at(logs - shift).value) / (2 * step)
        # The third order of a step of 1e-4 is left, and rounding of values of some thousands.
        assert at(logs).slope[level] == pytest.approx(slope, rel=1e-4, abs=1e-4)


def test_a_fit_that_runs_away_is_an_error_of_the_input(monkeypatch):
    def runs_away(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(joint, "fit_problem", runs_away)
    with pytest.raises(ConvergenceError, match="poses of other views than the images"):
        calibrated(simulate(replace(FINE, views=6)))


def test_a_noise_level_of_nothing_is_found_beside_a_large_one():
    """Both coordinates err alike: what each has of its own is lost in the rounding."""
    common = np.random.default_rng(2).normal(0.0, 1.0, (40, 1))
    parts = np.tile([[[1.0, 1.0], [1.0, 1.0]], [[1.0, 0.0], [0.0, 1.0]]], (40, 1, 1, 1))
    sigmas, value = estimate_sigmas(
        np.hstack([common, common]),
        np.ones((40, 2, 1)),
        Components(np.zeros((40, 2, 2)), parts.swapaxes(0, 1)),
        Knowledge(np.zeros((1, 1)), np.zeros(1)),
        np.array([3.0, 3.0]),
    )
    assert np.isfinite(value)
    # Forty of them tell a level to a ninth.
    assert sigmas[0] == pytest.approx(1.0, rel=0.4)
    assert sigmas[1] < 1e-5

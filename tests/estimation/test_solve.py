"""Identities of the joint fit: views left out, stops seen twice, and the likelihood's slope."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from support.cells import calibrated
from support.marks import slow

from visioncal.core.errors import ConvergenceError
from visioncal.estimation import joint
from visioncal.estimation.intervals import expected_levels
from visioncal.estimation.mixed import (
    PriorInformation,
)
from visioncal.estimation.normal_equations import (
    Whitening,
    normal_equations,
)
from visioncal.estimation.problem_parts import ROBOT, Effect
from visioncal.estimation.robot_likelihood import (
    robot_likelihood,
)
from visioncal.estimation.solve import (
    fit_problem,
    left_out_residuals,
    solve_problem,
)
from visioncal.simulation import CellOptions, fine_camera, simulate

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)
LENS = pytest.mark.parametrize("given", [True, False], ids=["lens given", "lens estimated"])


def answered(given, **changes):
    known = calibrated(simulate(replace(FINE, state_intrinsics=given, **changes)))
    problem = known.assessment.problem
    return problem, fit_problem(problem, known.assessment.state)


@LENS
def test_residuals_of_views_left_out_are_those_of_fits_without_them(given):
    problem, fit = answered(given, views=12, seed=3)
    predicted = left_out_residuals(problem, fit.state, fit.noise)
    covariance = problem.total_covariance(problem.linear(fit.state), fit.noise)
    for view in range(12):
        others = np.arange(12) != view
        without, _ = solve_problem(problem.subset(others), fit.state, fit.noise)
        refitted = problem.linear(without).residuals[view]
        sigma = np.sqrt(np.diagonal(covariance[view]))
        # To first order: what is left is the curvature over a step of the size of the noise.
        np.testing.assert_allclose(predicted[view], refitted, atol=0.01 * sigma.max())


def doubled(problem):
    """Every view twice, as two that know half as much each."""
    again = np.repeat(np.arange(len(problem)), 2)
    seen = problem.observations.take(again)
    return replace(
        problem,
        observations=replace(seen, covariance=2.0 * seen.covariance),
        effects=tuple(effect.take(again) for effect in problem.effects),
    )


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_stop_seen_twice_half_as_well_is_one_seen_once(mount):
    problem, fit = answered(False, views=8, seed=2, mount=mount)
    arm = 1e-3 * np.random.default_rng(0).standard_normal((8, 6, 2))
    known = PriorInformation(np.eye(2), np.zeros(2))
    errors = Effect.free("arm", known, flange_jacobian={ROBOT: arm})
    problem = problem.with_effects([*problem.effects, errors])
    state = replace(fit.state, values=problem.start_values)
    twice = doubled(problem)
    for expected, seen in zip(
        normal_equations(problem, state, fit.noise),
        normal_equations(twice, state, fit.noise),
        strict=True,
    ):
        # The same sums in another order.
        allowed = 1e-9 * np.abs(expected).max()
        np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=allowed)


@pytest.mark.parametrize("views", [6, slow(20)])
def test_the_variance_to_be_expected_is_that_of_a_level_with_its_degrees_of_freedom(views):
    # Corners know poses far better than the robot stands.
    problem, fit = answered(True, views=views, seed=5, robot_sigma_m=1e-3, robot_sigma_rad=1e-3)
    expected = expected_levels(problem, fit.state, fit.noise)
    freedom = 6 * views - 12
    # Corners' own noise takes some of the freedom; the sum over the scales is right to 1e-3.
    ratio = (expected / fit.noise.robots) ** 2
    np.testing.assert_allclose(ratio - 1.0, 2.0 / (freedom - 2.0), rtol=0.15)


def test_a_level_that_may_be_zero_is_expected_to_be_what_the_corners_hide():
    problem, fit = answered(True, views=6, seed=1, robot_sigma_m=0.0, robot_sigma_rad=0.0)
    at = replace(fit.noise, robots=np.full((1, 2), 1e-9))
    expected = expected_levels(problem, fit.state, at)[0, 1]
    assert 1e-6 < expected < 1e-4


@pytest.mark.parametrize(
    "kind", [slow("one a stop"), slow("two a stop"), slow("places"), "combined"]
)
def test_errors_of_an_arm_beside_a_likelihood_are_those_of_a_wider_problem(kind):
    problem, fit = answered(False, views=8, seed=6)
    seen = problem.observations
    if kind == "two a stop":
        problem = doubled(problem)
    if kind == "places":  # of one point a stop, which leaves a flange's rotation open
        seen = replace(seen, has_rotation=np.zeros(8, dtype=bool))
        problem = replace(problem, observations=seen)
    if kind == "combined":
        seen = replace(seen, covariance=np.zeros_like(seen.covariance))
        problem = replace(problem, observations=seen, is_combined=True)
    moves = np.random.default_rng(0).standard_normal((8, 6, 3))
    effect = Effect.free(
        "arm", PriorInformation(np.zeros((3, 3)), np.zeros(3)), flange_jacobian={ROBOT: moves}
    )
    wider = problem.with_effects([*problem.effects, effect])
    there = replace(fit.state, values=np.append(fit.state.values, np.zeros(3)))
    beside = robot_likelihood(problem, fit.state, fit.noise).beside(0, moves)
    expected = robot_likelihood(wider, there, fit.noise)
    np.testing.assert_allclose(beside.jacobian, expected.jacobian, rtol=1e-6, atol=1e-9)
    if kind == "places":  # These leave rotations open: the rounding of none decides the likelihood.
        return
    # What the wider problem has left of the arm's columns beside them is rounding.
    levels, fixed = 2.0 * fit.noise.robots, np.zeros(2, dtype=bool)
    found, values = (item.most_likely(levels, fixed)[1] for item in (beside, expected))
    assert found == pytest.approx(values, abs=1e-5)


@pytest.mark.parametrize("kind", [slow("one a stop"), slow("two a stop"), "combined"])
def test_the_likelihood_of_levels_that_grow_together_is_that_of_each(kind):
    problem, fit = answered(True, views=8, seed=6)
    if kind == "two a stop":
        problem = doubled(problem)
    if kind == "combined":
        seen = problem.observations
        seen = replace(seen, covariance=np.zeros_like(seen.covariance))
        problem = replace(problem, observations=seen, is_combined=True)
    found = robot_likelihood(problem, fit.state, fit.noise)
    scales, fixed = np.array([0.02, 0.5, 1.0, 8.0]), np.zeros(2, dtype=bool)
    values = [found.most_likely(scale * fit.noise.robots, fixed)[1] for scale in scales]
    scaled = found.scaled(0, fit.noise.robots, scales)
    # The rounding of values of some hundreds, at a fiftieth of the noise some millions.
    np.testing.assert_allclose(np.diff(scaled), np.diff(values), rtol=1e-7, atol=1e-7)


def test_shared_errors_of_flanges_are_eliminated_exactly():
    """Against the covariance of all observations, written out."""
    problem, fit = answered(False, views=6, seed=5)
    problem = doubled(problem)
    linear = problem.linear(fit.state)
    by_errors = np.zeros((len(problem), 6, 6 * 6))
    for row, unit in enumerate(problem.units[0]):
        by_errors[row, :, 6 * unit : 6 * unit + 6] = linear.by_errors[row]
    by_errors = by_errors.reshape(-1, 36)
    noise = block_diag(*problem.covariance(fit.noise))
    noise += by_errors @ block_diag(*problem.error_covariance(fit.noise)) @ by_errors.T
    jacobian, residuals = linear.jacobian.reshape(len(noise), -1), linear.residuals.ravel()
    known = problem.prior_information(fit.state)
    weighted = np.linalg.solve(noise, jacobian)
    whitening = Whitening.of(problem, fit.noise, linear.by_errors)
    information, gradient, cost = whitening.equations(problem, fit.state, linear)
    scale = np.sqrt(np.diag(information))
    # Rounding, of numbers whose squares differ by ten powers of ten.
    np.testing.assert_allclose(
        (information - known.information - jacobian.T @ weighted) / np.outer(scale, scale),
        0.0,
        atol=1e-8,
    )
    away = gradient - known.gradient - weighted.T @ residuals
    np.testing.assert_allclose(away / scale, 0.0, atol=1e-8)
    whole = residuals @ np.linalg.solve(noise, residuals)
    assert cost == pytest.approx(whole + known.cost, rel=1e-8)


def test_a_fit_that_runs_away_is_an_error_of_the_input(monkeypatch):
    def runs_away(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(joint, "fit_problem", runs_away)
    with pytest.raises(ConvergenceError, match="poses of other views than the images"):
        calibrated(simulate(replace(FINE, views=6)))

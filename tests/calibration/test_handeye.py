"""Both unknown edges: the fit, its covariance, and the motions that are refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cells import calibrated, error_of, exact
from support.edges import solved
from support.marks import slow

from visioncal.calibration.stages.handeye import compare_solvers
from visioncal.core.errors import DegenerateError
from visioncal.core.transforms import adjoint, compose, exp, invert, log
from visioncal.estimation.chain import chain, robot_part
from visioncal.estimation.linalg import covariance_from, damped_step, eigenvalue_shares
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import ROBOT, Effect, Noise, State
from visioncal.estimation.solve import (
    estimate_noise,
    fit_problem,
    solve_problem,
    starting_noise,
)
from visioncal.simulation import CellOptions, measured_poses, simulate

MOUNTS = ("eye-in-hand", "eye-to-hand")
NOISE = Noise.of_robot(1e-3, 5e-4)


def problem_of(cell, camera=None):
    seen = cell.cam_from_target if camera is None else camera
    return chain(cell.options.mount, cell.robot.base_from_flange, seen)


def state_of(*edges):
    return State(np.array(edges), np.zeros(0))


def made_up(robot, x, z, noise=NOISE, seed=0, mount="eye-in-hand"):
    """A chain whose residuals have just this noise."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat(noise.robots[0], 3)
    errors = exp(rng.standard_normal((len(robot), 6)) * sigma)
    return chain(mount, robot_part(robot, mount), invert(robot @ x) @ z @ errors)


def some_edges(seed=0):
    rng = np.random.default_rng(seed)
    return [
        compose(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3)) for _ in range(2)
    ]


def some_motion(count, seed=0, tilt=0.5):
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.uniform(-tilt, tilt, (count, 3))).as_matrix()
    return compose(rotation, rng.uniform(-0.3, 0.3, (count, 3)))


@pytest.mark.parametrize("mount", MOUNTS)
def test_jacobian_agrees_with_central_differences(mount):
    x, z = some_edges()
    rng = np.random.default_rng(0)
    by_camera, flange_jacobian = rng.normal(size=(2, 5, 6, 3))
    known = PriorInformation(np.eye(3), np.zeros(3))
    effect = Effect.free("any", known, by_camera, {ROBOT: flange_jacobian})
    problem = made_up(some_motion(5), x, z, Noise.of_robot(0.05, 0.02), mount=mount)
    problem, state = problem.with_effects([effect]), State(np.array([x, z]), np.zeros(3))
    analytic, step = problem.linear(state).jacobian, 1e-6
    for axis in range(15):
        shift = np.zeros(15)
        shift[axis] = step
        moved = [state.moved(sign * shift) for sign in (1, -1)]
        ahead, behind = (problem.linear(state).residuals for state in moved)
        # Truncation step^2, rounding 1e-16 / step = 1e-10, and the series' own cut of 1e-9.
        np.testing.assert_allclose(analytic[:, :, axis], (ahead - behind) / (2 * step), atol=5e-9)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("solver", ["joint", "tsai", "li"])
def test_exact_data_give_the_exact_edges(mount, solver):
    cell = simulate(exact(CellOptions(mount=mount, seed=1)))
    result = solved(problem_of(cell), solver)
    for found, true in zip(result.state.edges, cell.transforms.values(), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)


@pytest.mark.parametrize("mount", MOUNTS)
def test_every_solver_is_shown_beside_the_answer(mount):
    cell = simulate(CellOptions(mount=mount, seed=2))
    problem = problem_of(cell, measured_poses(cell))
    result = solved(problem)
    found = compare_solvers(problem, result.state, mount, "joint")
    closed_forms = ["tsai", "park", "horaud", "daniilidis", "andreff", "shah", "li"]
    assert list(found) == ["joint", *closed_forms]
    np.testing.assert_array_equal(found["joint"].edges, result.state.edges)
    by_tsai = compare_solvers(problem, solved(problem, "tsai").state, mount, "tsai")
    assert list(by_tsai) == closed_forms


def test_noise_and_errors_are_as_stated():
    x, z = some_edges(1)
    robot = some_motion(20, 1)
    surprises, sigmas = [], []
    for seed in range(100):
        data = made_up(robot, x, z, seed=seed)
        sigmas.append(fit_problem(data, state_of(x, z)).noise.robots[0])
        result = solved(data)
        error = log(invert(np.array([x, z])) @ result.state.edges).ravel()
        surprises.append(error @ np.linalg.solve(result.covariance, error) / 12)
    # Variances, not deviations, are unbiased; 100 runs of 54 degrees of freedom: 2 %.
    variances = np.mean(np.square(sigmas), axis=0)
    np.testing.assert_allclose(variances, NOISE.robots[0] ** 2, rtol=0.08)
    # Mean of 100 chi-square of 12: 0.04; the estimated noise adds 1 / 27 to the expectation
    # (F against chi-square).
    assert np.mean(surprises) == pytest.approx(1.04, abs=0.15)


def test_the_fit_is_the_least_squares_solution_from_far_starts_too():
    x, z = some_edges(2)
    data = made_up(some_motion(15, 2), x, z)
    near, rested = solve_problem(data, state_of(x, z), NOISE)
    assert rested
    push = exp(np.array([0.15, -0.1, 0.1, 0.05, -0.03, 0.04]))
    far, _ = solve_problem(data, state_of(x @ push, z @ push), NOISE)
    # The cost is settled to 1e-10 of itself, the edges to 1e-5 of their sigma of about 1e-4.
    np.testing.assert_allclose(far.edges, near.edges, atol=1e-8)
    linear = data.linear(near)
    jacobian, weights = linear.jacobian, np.repeat(NOISE.robots[0] ** -2.0, 3)
    gradient = np.einsum("mij,i,mi->j", jacobian, weights, linear.residuals)
    information = np.einsum("mij,i,mik->jk", jacobian, weights, jacobian)
    # In units of the edges' sigma the gradient of a settled fit is nothing.
    assert np.abs(gradient * np.sqrt(np.diag(np.linalg.inv(information)))).max() < 1e-4


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
@pytest.mark.parametrize(
    "given",
    [True, slow(False)],
    ids=["lens given", "lens estimated"],
)
@pytest.mark.parametrize("coarse", [1.0, slow(10.0)], ids=["fine robot", "coarse robot"])
def test_the_whole_chain_states_its_errors_honestly(mount, given, coarse):
    seeds, robot_m, robot_rad = 8, coarse * 3e-5, coarse * 5e-5
    surprises, noises = [], []
    for seed in range(seeds):
        cell = simulate(
            CellOptions(
                mount=mount,
                state_intrinsics=given,
                seed=seed,
                pixel_sigma_px=0.1,
                robot_sigma_m=robot_m,
                robot_sigma_rad=robot_rad,
            )
        )
        known = calibrated(cell)
        error, covariance = error_of(cell, known), known.assessment.covariance[:12, :12]
        surprises.append(error @ np.linalg.solve(covariance, error) / 12)
        noises.append(known.assessment.noise.robots[0])
        assert known.pixel_px == pytest.approx(0.1, rel=0.1)
    # The mean of 8 chi-square of 12 has the standard deviation 0.144: four of it. The estimated
    # noise raises the expectation by some percent (F against chi-square).
    assert np.mean(surprises) == pytest.approx(1.05, abs=0.58)
    # A level has some 67 degrees of freedom over 8 cells at the worst: 9 %; four of it.
    level_rad, level_m = np.sqrt(np.mean(np.square(noises), axis=0))
    assert level_m == pytest.approx(robot_m, rel=0.36)
    # Beside a fixed camera's 0.5 mrad a view, a robot's 0.05 mrad hardly shows.
    if mount == "eye-in-hand" or coarse > 1.0:
        assert level_rad == pytest.approx(robot_rad, rel=0.36)


def test_a_stop_counts_once_however_often_it_is_looked_at():
    coarse = CellOptions(
        seed=4, views=12, pixel_sigma_px=0.1, robot_sigma_m=2e-4, robot_sigma_rad=4e-4
    )
    problem = calibrated(simulate(coarse)).assessment.problem.with_effects([])
    once = solved(problem)
    again = np.repeat(np.arange(12), 3)
    looks = problem.observations.take(again)
    looks = replace(looks, covariance=3.0 * looks.covariance)
    thrice = replace(problem, observations=looks)
    # Three looks of three times the variance are one look.
    found = solved(thrice)
    np.testing.assert_allclose(found.state.edges, once.state.edges, atol=1e-9)
    np.testing.assert_allclose(found.covariance, once.covariance, rtol=1e-5, atol=1e-14)
    apart = solved(
        replace(
            thrice,
            poses={ROBOT: problem.poses[ROBOT][again]},
            observations=replace(looks, stops=np.arange(len(again))),
        )
    )
    # The robot's noise is most of it: of three stops a third would be left.
    assert np.trace(apart.covariance) < 0.45 * np.trace(once.covariance)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_three_views_do_not_pass_for_exact(mount):
    for seed in range(20):
        cell = simulate(CellOptions(mount=mount, views=3, seed=seed, pixel_sigma_px=0.1))
        try:
            result = solved(problem_of(cell, measured_poses(cell)))
        except DegenerateError:
            continue
        # Nine equations of translation can be fitted away by nine unknowns; the noise stays.
        assert np.all(result.noise.robots > 1e-6)


def one_axis(count, seed, wobble_rad):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turns = np.outer(rng.uniform(-1, 1, count), axis) + wobble_rad * rng.normal(size=(count, 3))
    return compose(Rotation.from_rotvec(turns).as_matrix(), rng.uniform(-0.3, 0.3, (count, 3)))


@pytest.mark.parametrize("wobble_rad", [0.0, slow(1e-5), slow(1e-4)])
def test_turns_about_one_axis_are_refused_with_that_axis(wobble_rad):
    for seed in range(30):
        x, z = some_edges(seed)
        data = made_up(one_axis(12, seed, wobble_rad), x, z, seed=seed)
        with pytest.raises(DegenerateError, match="camera's offset along the tool's"):
            solved(data)


def test_thousands_of_views_about_one_axis_are_refused_by_the_farthest_of_them():
    x, z = some_edges()
    turns = np.outer(1e-3 * np.linspace(-1, 1, 2000), [0.0, 0.0, 1.0])
    turns[777] *= 1000.0
    robot = compose(Rotation.from_rotvec(turns).as_matrix(), some_motion(2000)[:, :3, 3])
    # All other views, and any even choice of them, differ by 0.1 deg only: in position alone.
    with pytest.raises(DegenerateError, match="all 2000 used views turn about the tool's z"):
        solved(made_up(robot, x, z))


@pytest.mark.parametrize("noise_rad", [0.0, 2e-4])
@pytest.mark.parametrize("mount", MOUNTS)
def test_translation_alone_is_refused(mount, noise_rad):
    for seed in range(6):
        x, z = some_edges(seed)
        robot = compose(np.tile(np.eye(3), (10, 1, 1)), some_motion(10, seed)[:, :3, 3])
        turns = noise_rad * np.random.default_rng(seed).normal(size=(10, 3))
        robot = robot @ exp(np.hstack([turns, np.zeros((10, 3))]))
        data = made_up(robot, x, z, seed=seed, mount=mount)
        with pytest.raises(DegenerateError, match="differ in position only") as caught:
            solved(data)
        assert "measure that offset" not in caught.value.next_step


@pytest.mark.parametrize("stops", ["0 usable stops", "1 usable stop", "2 usable stops"])
def test_fewer_than_three_views_are_refused(stops):
    x, z = some_edges()
    count = int(stops[0])
    with pytest.raises(DegenerateError, match=f"{stops} of the robot, at least 3"):
        solved(made_up(some_motion(count), x, z))


def test_one_pose_again_and_again_is_refused():
    x, z = some_edges()
    data = made_up(np.repeat(some_motion(1), 12, axis=0), x, z)
    with pytest.raises(DegenerateError, match="all from one pose of the robot"):
        solved(data)


def test_healthy_motion_is_never_refused_small_tilts_included():
    for seed in range(60):
        rng = np.random.default_rng(seed)
        x, z = some_edges(seed)
        tilt = np.deg2rad(rng.uniform(5, 40))
        data = made_up(
            some_motion(int(rng.integers(8, 30)), seed, tilt), x, z, Noise.of_robot(3e-4, 2e-4)
        )
        result = solved(data)
        sigma = np.sqrt(np.diag(result.covariance))
        # 5.5 sigma of six components over 60 sets: once in thousands of runs of this test.
        assert np.all(np.abs(log(invert(x) @ result.state.edges[0])) < 5.5 * sigma[:6])


def test_noise_that_the_data_show_refuses_nothing():
    # Rows that are exchanged, another convention, wrong images: what disagrees is looked for and
    # named, and judged; the stops themselves are sound.
    for seed in range(20):
        x, z = some_edges(seed)
        motion = some_motion(12, seed, np.deg2rad(5.0))
        result = solved(made_up(motion, x, z, Noise.of_robot(np.deg2rad(3.0), 2e-2), seed=seed))
        assert max(direction.sigma / direction.limit for direction in result.worst) > 2.0


def test_the_geometry_of_the_stops_decides_and_not_how_little_noise_the_data_show():
    x, z = some_edges(2)
    motion, messages = one_axis(12, 2, np.deg2rad(0.3)), set()
    for share in (1e-3, 0.1, 1.0):
        noise = Noise.of_robot(share * np.deg2rad(0.05), share * 1e-4)
        with pytest.raises(DegenerateError, match="at a typical noise") as refused:
            solved(made_up(motion, x, z, noise))
        figure = re.search(r"predicted sigma of ([\d.]+) mm", str(refused.value))
        messages.add(float(figure[1]))
    # The poses at which it is predicted differ by the noise itself.
    assert max(messages) < 1.1 * min(messages)


def test_covariance_moves_with_its_frame():
    """The information of z is that of x carried over by the adjoint of the mean chain."""
    cell = simulate(exact(CellOptions(seed=6, views=4)))
    jacobian = problem_of(cell).linear(state_of(*cell.transforms.values())).jacobian
    of_camera = adjoint(invert(cell.cam_from_target))
    np.testing.assert_allclose(jacobian[:, :, :6], of_camera, atol=1e-9)
    np.testing.assert_allclose(jacobian[:, :, 6:], np.tile(-np.eye(6), (4, 1, 1)), atol=1e-9)


def test_noise_of_exact_data_is_nil_and_nothing_divides_by_it():
    cell = simulate(exact(CellOptions(seed=7)))
    problem, state = problem_of(cell), state_of(*cell.transforms.values())
    noise = estimate_noise(problem, state, starting_noise(problem), from_above=True)
    assert noise.robots[0, 1] < 1e-9
    result = solved(problem)
    assert np.all(np.isfinite(result.covariance))


def test_a_covariance_is_found_where_the_eigenvalues_do_not_converge(monkeypatch):
    jacobian = np.random.default_rng(5).standard_normal((3, 20, 6))
    information = np.swapaxes(jacobian, 1, 2) @ jacobian

    def give_up(_):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", give_up)
    np.testing.assert_allclose(covariance_from(information), np.linalg.inv(information), rtol=1e-8)
    with pytest.raises(np.linalg.LinAlgError):
        covariance_from(np.full((2, 6, 6), np.nan))


def test_no_information_at_all_gives_a_finite_covariance():
    found = covariance_from(np.stack([np.zeros((6, 6)), np.eye(6)]))
    assert np.isfinite(found).all()
    assert found[0].diagonal().min() > 1e12
    assert found[1] == pytest.approx(np.eye(6))


def test_linear_algebra_says_what_it_sees():
    rng = np.random.default_rng(0)
    tall = rng.normal(size=(30, 4)) * [1.0, 1e3, 1e-3, 1.0]
    information = tall.T @ tall
    np.testing.assert_allclose(covariance_from(information), np.linalg.inv(information), rtol=1e-8)
    assert eigenvalue_shares(information)[0] > 0.1  # the units of the columns do not matter
    tall[:, 3] = tall[:, 0]
    assert eigenvalue_shares(tall.T @ tall)[0] < 1e-12
    step = damped_step(information, information @ np.ones(4), 0.0)
    np.testing.assert_allclose(step, -np.ones(4), rtol=1e-8)

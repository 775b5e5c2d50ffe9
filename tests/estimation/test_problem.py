"""The estimation problem in plain arrays: derivatives, identities, the fit, and what moved."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from support.cells import calibrated
from support.edges import inliers_of
from support.problems import ROBOT_SIGMAS, away, observed, pose, swung, true_state, world
from support.slopes import jacobian

from visioncal.core.errors import ConvergenceError
from visioncal.core.linalg import covariance_from, damped_step, eigenvalue_shares
from visioncal.core.transforms import adjoint, compose, exp, invert, log
from visioncal.estimation import joint
from visioncal.estimation.budget import Sources, covariance_by_source
from visioncal.estimation.chain import chain
from visioncal.estimation.clock import clock_problem
from visioncal.estimation.clock_correlation import ImageTimes, turning_matches
from visioncal.estimation.fit import Fit
from visioncal.estimation.intervals import expected_levels
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import Whitening, normal_equations
from visioncal.estimation.outliers import distances, inliers_and_moves, refine_inliers
from visioncal.estimation.problem_parts import ROBOT, Effect, FramePrior, Noise, State, by_size
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    equations_from,
    fit_problem,
    left_out_residuals,
    solve_problem,
)
from visioncal.estimation.steps import find_steps, frames_of
from visioncal.fit.consensus import Candidates
from visioncal.fit.joining import Network
from visioncal.robot.trajectory import Trajectory
from visioncal.simulation import CAMERAS, CellOptions, simulate
from visioncal.verification.model_evidence import (
    CalibrationPosterior,
    ChangeHypothesis,
    evidence_of,
    undone,
    with_change,
)
from visioncal.vision.board_shape import SCALE
from visioncal.vision.camera import intrinsics

MOVABLE = ("cam_left", "cam_right", "target_floor", "target_a", "target_b")
FINE = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1)
SOURCES = Sources(
    {"cam_left": "pixels of left", "cam_right": "pixels of right"}, {"a": "robot a", "b": "robot b"}
)
NETWORK_NOISE = Noise(np.array([ROBOT_SIGMAS["a"], ROBOT_SIGMAS["b"]]), np.zeros(0))
NOISE = Noise.of_robot(1e-4, 1e-4)
MOUNTS = ("eye-in-hand", "eye-to-hand")


def problem_of(seed, stops=20, seen=0.7, **more):
    """A cell, what is seen of it, and its true state."""
    rng = np.random.default_rng(seed)
    cell = world(rng, stops, seen)
    problem = observed(cell, rng, **more)
    return cell, problem, true_state(cell, problem.tree)


def network(problem, **turned):
    """The frames that the observations connect, each by its only pose."""
    shape = (len(problem.observations), 1)
    poses = problem.observations.measured[:, None]
    candidates = Candidates(poses, np.zeros(shape, dtype=np.int64), np.ones(shape, dtype=bool))
    seen = problem.observations
    whole = Network(
        problem.tree, problem.poses, seen.observers, seen.observed, seen.stops, seen.has_rotation,
        candidates, turned, early=0.4,
    )  # fmt: skip
    return whole.connected()


def started(problem):
    tied = network(problem)
    assert not tied.untied
    return State(np.array([tied.edges[index] for index in problem.unknown]), np.zeros(0))


def with_values(problem, rng):
    """The problem with two effects of one and two values: on sensors, and on one robot's flange."""
    known = [PriorInformation(np.eye(name), np.zeros(name)) for name in (1, 2)]
    held = [np.zeros(name, dtype=bool) for name in (1, 2)]
    by_sensor = rng.normal(size=(len(problem), 6, 1)) * 1e-3
    flange_jacobian = {"a": rng.normal(size=(len(problem.poses["a"]), 6, 2)) * 1e-3}
    concerned = np.arange(len(problem)) % 2 == 0
    return problem.with_effects(
        [
            Effect("sensors", np.full(1, 0.2), known[0], held[0], by_sensor),
            Effect("flanges", np.zeros(2), known[1], held[1], None, flange_jacobian, concerned),
        ]
    )


@pytest.mark.parametrize("kind", ["poses", "places", "values"])
def test_derivatives_are_those_of_central_differences(kind):
    _, problem, state = problem_of(1, stops=3, seen=1.0)
    if kind == "places":
        problem = with_places_alone(problem, slice(0, 5))
    if kind == "values":
        problem = with_values(problem, np.random.default_rng(2))
    state = State(state.edges, np.full(problem.size - 6 * len(state.edges), 0.3))
    found = problem.linear(state).jacobian
    slopes = jacobian(lambda by: problem.linear(state.moved(by)).residuals, problem.size)
    # Differences of 1e-6 are exact to 1e-9. Of a place alone, a turn of the frame that it is in
    # counts by the place's own error, 0.1 mm, which is left out; and an effect's values move as
    # their last step does, which is its own square, 1e-6, off.
    assert np.abs(slopes - found).max() < {"poses": 1e-8, "places": 5e-4, "values": 5e-6}[kind]


def test_equations_from_a_stop_on_are_those_of_its_observations_alone():
    _, problem, state = problem_of(4, stops=6)
    fit = fit_problem(problem, state)
    stops = []
    for stop, *parts in equations_from(problem, fit, np.arange(problem.size)):
        later = problem.subset(problem.observations.stops >= stop)
        for part, whole in zip(parts, normal_equations(later, fit.state, fit.noise), strict=True):
            np.testing.assert_allclose(part, whole, atol=1e-9 * np.abs(parts[0]).max())
        stops.append(stop)
    assert stops == [5, 4, 3, 2, 1, 0]


def test_repeats_do_not_pass_for_a_step():
    """Of fixed boards that fixed cameras see again and again, at rest."""
    for seed in range(3):
        _, problem, state = problem_of(seed, stops=16)
        problem = replace(problem, with_repeats=True)
        assert problem.repeat_counts.max() > 1.0
        fit = fit_problem(problem, state)
        assert not find_steps(problem, fit, frames_of(problem, tuple(problem.unknown)))


def test_the_fit_is_as_good_as_its_covariance_says():
    squares, levels = [], []
    for seed in range(6):
        cell, problem, state = problem_of(seed)
        fit = fit_problem(problem, state)
        assert fit.settled
        covariance = covariance_of(problem, fit)
        error = away(cell, problem, fit.state)
        squares.append(error @ np.linalg.solve(covariance, error) / len(error))
        levels.append(fit.noise.robots[:, 1])
    # Chi-square of 6 x 36: a standard deviation of 0.1; the levels' own errors add some.
    assert 0.7 < np.mean(squares) < 1.5
    # Twenty stops tell a flange's error to 15 % each.
    np.testing.assert_allclose(np.mean(levels, axis=0), [3e-5, 8e-5], rtol=0.35)


def test_the_level_of_a_sensor_is_found():
    _, problem, state = problem_of(6)
    sensors = np.array(
        [0 if observer == "cam_left" else -1 for observer in problem.observations.observers]
    )
    # What cam_left says of its own noise is three times too little.
    covariance = problem.observations.covariance / np.where(sensors == 0, 9.0, 1.0)[:, None, None]
    problem = replace(
        problem, observations=replace(problem.observations, sensors=sensors, covariance=covariance)
    )
    fit = fit_problem(problem, state)
    # Some 150 residuals tell it to 6 %.
    assert fit.noise.sensors[0] == pytest.approx(3.0, rel=0.2)


def test_a_held_value_stays_and_counts_with_what_is_known_of_it():
    _, problem, state = problem_of(13)
    by_sensor = np.zeros((len(problem), 6, 1))
    by_sensor[:, 3, 0] = 1e-3  # every camera measures x too long alike
    known = PriorInformation(np.eye(1), np.zeros(1))
    effect = Effect("drift", np.zeros(1), known, np.ones(1, dtype=bool), by_sensor)
    held = problem.with_effects([effect])
    moved, _ = solve_problem(held, State(state.edges, np.zeros(1)), NETWORK_NOISE)
    without, _ = solve_problem(problem, state, NETWORK_NOISE)
    assert moved.values[0] == 0.0
    # A column more changes the order in which a processor's kernels sum, and so the last bits.
    np.testing.assert_allclose(moved.edges, without.edges, rtol=0.0, atol=1e-14)
    free = problem.with_effects([replace(effect, held=np.zeros(1, dtype=bool))])
    solution = Solution(moved, NETWORK_NOISE)
    apart = covariance_of(held, solution) / covariance_of(free, solution) - 1.0
    assert np.abs(apart).max() < 1e-9
    exact = covariance_of(problem, Solution(without, NETWORK_NOISE))
    assert np.trace(covariance_of(held, solution)[:-1, :-1]) > 1.5 * np.trace(exact)


def test_a_prior_of_an_edge_pulls_it_by_its_share_of_the_information():
    _, problem, state = problem_of(14)
    plain, _ = solve_problem(problem, state, NETWORK_NOISE)
    covariance = covariance_of(problem, Solution(plain, NETWORK_NOISE))[
        problem.edge_columns("target_a")
    ]
    at = problem.unknown["target_a"]
    turn, place = plain.edges[at][:3, :3], plain.edges[at][:3, 3]
    before = turn @ covariance[3:, problem.edge_columns("target_a")][:, 3:] @ turn.T
    sigma_m = float(np.sqrt(before[0, 0]))
    prior = FramePrior("flange_a", "target_a", (0,), (place[0] + 1e-4,), sigma_m)
    found, _ = solve_problem(replace(problem, priors=(prior,)), plain, NETWORK_NOISE)
    # As sure as the observations: half-way. Of second order are a few thousandths of a step.
    assert found.edges[at][0, 3] - place[0] == pytest.approx(0.5e-4, rel=0.02)
    narrower = covariance_of(replace(problem, priors=(prior,)), Solution(found, NETWORK_NOISE))
    block = narrower[problem.edge_columns("target_a"), problem.edge_columns("target_a")][3:, 3:]
    turned = found.edges[at][:3, :3]
    assert (turned @ block @ turned.T)[0, 0] == pytest.approx(0.5 * sigma_m**2, rel=0.02)


def test_priors_of_frames_have_the_jacobian_of_central_differences():
    _, problem, state = problem_of(15, stops=4)
    rotation = pose((4, -2, -58), (0.0, 0.0, 0.0))[:3, :3]
    for prior in (
        # Up to the cell and down again, along two axes; and an edge by itself, with its rotation.
        FramePrior("cam_left", "cam_right", (0, 2), (0.1, 0.2), 1e-3),
        FramePrior("flange_b", "target_b", (0, 1, 2), (0.0, 0.0, 0.1), 1e-3, rotation, 2e-3),
    ):
        slopes = jacobian(
            lambda by, prior=prior: problem.prior_rows(prior, state.moved(by))[0], problem.size
        )
        # In units of sigmas of a millimetre: rounding of 1e-16 m over steps of 1e-6.
        np.testing.assert_allclose(slopes, problem.prior_rows(prior, state)[1], atol=1e-6)


def test_noise_does_not_pass_for_a_smaller_board_where_the_arm_can_follow():
    # The board's size is known to 5 %, the arm's not at all: the stops say nothing about either.
    rng = np.random.default_rng(3)
    cell = world(rng, 40, 1.0)
    pairs = [pair for pair in cell.pairs if pair[:2] == ("cam_left", "target_a")]
    exact = dict.fromkeys(cell.robot_sigmas, (1e-06, 1e-06))
    problem = observed(replace(cell, pairs=pairs, robot_sigmas=exact), rng, noise=10.0)
    kept = ("base_a", "flange_a", "cam_left", "target_a")
    tree = replace(problem.tree, branches={name: problem.tree.branches[name] for name in kept})
    covariance = 100.0 * problem.observations.covariance
    problem = replace(
        problem,
        tree=tree,
        poses={"a": problem.poses["a"]},
        observations=replace(problem.observations, covariance=covariance),
    )
    wide = PriorInformation(1e-4 * np.eye(1), np.zeros(1))
    larger = {"a": by_size(problem.poses["a"])[:, :, None]}
    arm, size = Effect.free("arm", wide, flange_jacobian=larger), 0.05
    problem = problem.with_effects([arm, joint.target_sizes(problem, {"target_a": size})])
    state = problem.start(cell.truth)
    noise = Noise(np.array([exact["a"]]), np.zeros(0))
    found, _ = solve_problem(problem.sized_at(state), state, noise)
    # Slopes at the measured poses make it 20 % smaller: four sigmas of what is stated.
    assert abs(found.values[-1]) < 0.2 * size


def test_repeated_views_of_a_still_board_count_as_one():
    rng = np.random.default_rng(16)
    cell = world(rng, 40, 1.0)
    problem = replace(observed(cell, rng), with_repeats=True)
    state = true_state(cell, problem.tree)
    pairs = zip(problem.observations.observers, problem.observations.observed, strict=True)
    still = np.array([pair == ("cam_left", "target_floor") for pair in pairs])
    single = problem.observations.covariance[still][0]
    # cam_left is held in the cell by all else, as if it were known: what is left is the board's.
    fixed = replace(
        problem, tree=problem.tree.with_known("cam_left", cell.truth["cam_left"])
    ).subset(still)
    edges = np.array([cell.truth[index] for index in fixed.tree.unknown])
    for count in (1, 5, 40):
        some = fixed.subset(np.arange(40) < count)
        known = covariance_of(some, Solution(State(edges, np.zeros(0)), NETWORK_NOISE))
        of_target = known[some.edge_columns("target_floor"), some.edge_columns("target_floor")]
        np.testing.assert_allclose(of_target, single, atol=1e-6 * single.max())
    # What the boards on the flanges tell is as without.
    moving = problem.subset(~still & ~problem.observations.involves("target_floor"))
    plain = replace(moving, with_repeats=False)
    found = [covariance_of(value, Solution(state, NETWORK_NOISE)) for value in (moving, plain)]
    np.testing.assert_array_equal(*found)


def test_residuals_of_views_left_out_are_those_of_fits_without_them():
    problem, fit = answered(False, views=12, seed=3)
    predicted = left_out_residuals(problem, fit.state, fit.noise)
    covariance = problem.total_covariance(problem.linear(fit.state), fit.noise)
    everything = np.ones(12, dtype=bool)
    inside = distances(problem, everything, fit)
    for view in range(12):
        others = np.arange(12) != view
        without, _ = solve_problem(problem.subset(others), fit.state, fit.noise)
        refitted = problem.linear(without).residuals[view]
        sigma = np.sqrt(np.diagonal(covariance[view]))
        # To first order: what is left is the curvature over a step of the size of the noise.
        np.testing.assert_allclose(predicted[view], refitted, atol=0.01 * sigma.max())
        square = distances(problem, others, Solution(without, fit.noise)).squares[view]
        assert square == pytest.approx(inside.squares[view], rel=1e-2)


def test_shared_errors_of_flanges_are_eliminated_exactly():
    """Against the covariance of all observations, written out."""
    _, problem, state = problem_of(3, stops=6)
    problem = with_values(problem, np.random.default_rng(5))
    state = State(state.edges, np.full(problem.size - 6 * len(state.edges), 0.3))
    linear, (units, members) = problem.linear(state), problem.units
    by_errors = np.zeros((len(problem), 6, 6 * len(members)))
    for row, unit in enumerate(units):
        if unit >= 0:
            by_errors[row, :, 6 * unit : 6 * unit + 6] = linear.by_errors[row]
    by_errors = by_errors.reshape(6 * len(problem), -1)
    noise = block_diag(*problem.covariance(NETWORK_NOISE))
    noise += by_errors @ block_diag(*problem.error_covariance(NETWORK_NOISE)) @ by_errors.T
    slopes, residuals = linear.jacobian.reshape(len(noise), -1), linear.residuals.ravel()
    known = problem.prior_information(state)
    weighted = np.linalg.solve(noise, slopes)
    whitening = Whitening.of(problem, NETWORK_NOISE, linear.by_errors)
    information, gradient, cost, _ = whitening.equations(problem, state, linear)
    scale = np.sqrt(np.diag(information))
    away = (information - known.information - slopes.T @ weighted) / np.outer(scale, scale)
    # Rounding, of numbers whose squares differ by ten powers of ten.
    np.testing.assert_allclose(away, 0.0, atol=1e-8)
    away = gradient - known.gradient - weighted.T @ residuals
    np.testing.assert_allclose(away / scale, 0.0, atol=1e-8 * np.abs(gradient / scale).max())
    whole = residuals @ np.linalg.solve(noise, residuals)
    assert cost == pytest.approx(whole + known.cost, rel=1e-8)


def causes_of(problem, rng):
    """A board that moved, and a joint that slipped."""
    count = len(problem)
    board = ChangeHypothesis("board", np.full(6, 2.0), -np.tile(np.eye(6), (count, 1, 1)))
    by_flange = rng.normal(size=(count, 6, 1))
    return board, ChangeHypothesis("joint", np.ones(1), flange_jacobian=by_flange)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("size", [0.0, 1.5])
def test_stops_move_with_a_change_as_its_derivatives_say(mount, size):
    rng = np.random.default_rng(3)
    data, state = stops_of(mount, rng)
    for cause in causes_of(data, rng):
        at = size * np.ones(len(cause.units)) / np.sqrt(6.0)
        beginning = with_change(state, cause)

        def changed(by, cause=cause, at=at, beginning=beginning):
            return undone(data, cause, at + by).linear(beginning)

        by_cause = changed(0.0).jacobian[:, :, 12:]
        slopes = jacobian(lambda by, changed=changed: changed(by).residuals, len(at))
        # The series of the right Jacobian is cut where it is exact to 1e-9 up to 0.5 rad, and to
        # some 1e-3 at two radians.
        assert by_cause == pytest.approx(slopes, abs=1e-7 if size < 1 else 2e-2)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_board_that_was_turned_over_is_found_exactly(mount):
    rng = np.random.default_rng(4)
    data, state = stops_of(mount, rng)
    change = np.array([0.0, 2.9, 0.3, 0.2, -0.1, 0.4])
    turned = seen_otherwise(data, measured=data.observations.measured @ exp(change))
    board, _ = causes_of(data, rng)
    cause = replace(board, start=log(turned.change_of("target", state)).mean(axis=0))
    found = evidence_of(turned, belief_of(state), cause)
    assert exp(found.values) == pytest.approx(exp(change), abs=1e-6)
    # Exact stops leave nothing but rounding.
    assert found.misfit == pytest.approx(0.0, abs=1e-3)
    before = undone(turned, cause, found.values).observations
    assert before.measured == pytest.approx(data.observations.measured, abs=1e-6)
    # What was noise of the turned board's pose is noise of it where it was.
    carried = adjoint(invert(exp(-change)))
    assert before.covariance[0] == pytest.approx(1e-10 * carried @ carried.T, rel=1e-4)


def test_a_fit_that_runs_away_is_an_error_of_the_input(monkeypatch):
    def runs_away(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(joint, "fit_problem", runs_away)
    with pytest.raises(ConvergenceError, match="poses of other views than the images"):
        calibrated(simulate(replace(FINE, views=6)))


def with_drift(problem):
    """The problem with two values that are known together, and all that counts besides."""
    by_sensor = np.zeros((len(problem), 6, 2))
    by_sensor[:, 3, 0] = by_sensor[:, 5, 1] = 1e-3
    known = PriorInformation(np.array([[4.0, 1.0], [1.0, 2.0]]), np.zeros(2))
    effect = Effect("drift", np.zeros(2), known, np.zeros(2, dtype=bool), by_sensor)
    prior = FramePrior("flange_b", "target_b", (0, 2), (-0.02, 0.06), 1e-4)
    return replace(problem.with_effects([effect]), priors=(prior,), with_repeats=True)


def test_the_parts_add_up_to_the_whole():
    _, problem, state = problem_of(1, stops=12, seen=0.8, noise=0.0)
    problem = with_drift(problem)
    state = State(state.edges, np.zeros(2))
    first = 6 * len(problem.unknown)
    columns = {"x": np.array([first]), "z": np.array([first + 1])}
    parts = covariance_by_source(problem, state, NETWORK_NOISE, replace(SOURCES, columns=columns))
    whole = covariance_of(problem, Solution(state, NETWORK_NOISE))
    assert set(parts) == {*SOURCES.sensors.values(), "robot a", "robot b", "x", "z", "priors"}
    # An identity; what is left is rounding of an inverse with a condition of 1e6.
    np.testing.assert_allclose(sum(parts.values()), whole, atol=1e-7 * np.abs(whole).max())


@pytest.mark.parametrize("robot", ["a", "b"])
def test_the_part_of_a_robot_is_what_its_errors_do_to_the_answer(robot):
    _, problem, state = problem_of(2, stops=5, seen=0.8, noise=0.0)
    whole = covariance_of(problem, Solution(state, NETWORK_NOISE))
    sigmas, step, part = np.repeat(ROBOT_SIGMAS[robot], 3), 1e-6, np.zeros_like(whole)
    for stop in range(5):
        for axis in range(6):
            twist = np.zeros(6)
            twist[axis] = step
            poses = problem.poses[robot].copy()
            poses[stop] = poses[stop] @ exp(twist)
            other = replace(problem, poses={**problem.poses, robot: poses})
            pulled = whole @ normal_equations(other, state, NETWORK_NOISE)[1] / step * sigmas[axis]
            part += np.outer(pulled, pulled)
    found = covariance_by_source(problem, state, NETWORK_NOISE, SOURCES)[f"robot {robot}"]
    # Steps of 1e-6 are of the first order to 1e-5, and weights follow the poses by as much.
    np.testing.assert_allclose(found, part, atol=1e-3 * np.abs(part).max())


def stops_of(mount, rng, count=5):
    """Stops that close the chain exactly, with the edges that they close it with."""
    x, z, *poses = exp(rng.normal(0.0, 0.5, (count + 2, 6)))
    poses = np.array(poses)
    robot = poses if mount == "eye-in-hand" else invert(poses)
    covariance = np.tile(1e-10 * np.eye(6), (count, 1, 1))
    problem = chain(mount, poses, invert(robot @ x) @ z, covariance)
    return problem, State(np.stack([x, z]), np.zeros(0))


def belief_of(state, freedom=np.inf):
    return CalibrationPosterior(state, 1e-10 * np.eye(12), NOISE, freedom)


def test_misfit_and_evidence_follow_their_distributions():
    rng = np.random.default_rng(5)
    data, state = stops_of("eye-in-hand", rng)
    sigma = np.repeat(NOISE.robots[0], 3)
    misfits, ratios = [], []
    for _ in range(60):
        noise = exp(sigma * rng.standard_normal((5, 6)))
        noisy = replace(data, poses={ROBOT: data.poses[ROBOT] @ noise})
        nothing = evidence_of(noisy, belief_of(state, freedom=60.0))
        board = evidence_of(noisy, belief_of(state, freedom=60.0), causes_of(data, rng)[0])
        misfits.append(nothing.misfit)
        ratios.append(np.exp(board.likelihood - nothing.likelihood))
    # Chi-square of thirty directions: its mean over 60 draws is known to 1.
    assert np.mean(misfits) == pytest.approx(30.0, abs=4.0)
    # One on average at most; a ratio of a hundred is chance in one draw of a hundred at most.
    assert np.mean(ratios) < 1.5
    assert max(ratios) < 100.0


def test_linear_algebra_agrees_with_numpy_and_names_its_failures(monkeypatch):
    rng = np.random.default_rng(0)
    tall = rng.normal(size=(30, 4)) * [1.0, 1e3, 1e-3, 1.0]
    information = tall.T @ tall
    np.testing.assert_allclose(covariance_from(information), np.linalg.inv(information), rtol=1e-8)
    assert eigenvalue_shares(information)[0] > 0.1  # the units of the columns do not matter
    tall[:, 3] = tall[:, 0]
    assert eigenvalue_shares(tall.T @ tall)[0] < 1e-12
    step = damped_step(information, information @ np.ones(4), 0.0)
    np.testing.assert_allclose(step, -np.ones(4), rtol=1e-8)
    # No information at all gives a finite covariance.
    found = covariance_from(np.stack([np.zeros((6, 6)), np.eye(6)]))
    assert np.isfinite(found).all()
    assert found[0].diagonal().min() > 1e12
    assert found[1] == pytest.approx(np.eye(6))

    def give_up(_):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", give_up)
    np.testing.assert_allclose(covariance_from(information), np.linalg.inv(information), rtol=1e-8)
    with pytest.raises(np.linalg.LinAlgError):
        covariance_from(np.full((2, 6, 6), np.nan))


def sampled(hz: float, keep=lambda times_s: times_s >= 0.0) -> Trajectory:
    times_s = np.arange(0, 10, 1 / hz)
    times_s = times_s[keep(times_s)]
    return Trajectory(times_s, swung(times_s))


def test_a_trajectory_covers_neither_gaps_nor_times_beyond_its_ends() -> None:
    moved = sampled(100, lambda value: (value < 2.0) | (value > 2.5))
    at_s = np.array([-0.01, 0.0, 1.985, 2.2, 2.505, 9.985, 9.995])
    assert moved.covers(at_s).tolist() == [False, True, True, False, False, True, False]
    assert moved.covers(at_s, 0.02).tolist() == [False] * 7
    # Beside a gap a line is left, through the last two samples.
    away = log(invert(swung(at_s[2:3])) @ moved.at(at_s[2:3]))
    assert np.abs(away).max() < 1e-3


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_offset_moves_the_chain_as_its_column_says(mount) -> None:
    rng = np.random.default_rng(1)
    x, z = exp(rng.normal(size=(2, 6)))
    moved, at_s = sampled(500), np.linspace(0.5, 9.5, 40)
    robot = swung(at_s) if mount == "eye-in-hand" else invert(swung(at_s))
    frames = ImageTimes(mount, at_s, invert(robot @ x) @ z @ exp(1e-3 * rng.normal(size=(40, 6))))
    state = State(np.stack([x, z]), np.zeros(1))

    def late(by_s):
        return clock_problem(moved, frames, by_s).linear(state)

    slope = jacobian(lambda by_s: late(by_s[0]).residuals, 1, 1e-4)[..., 0]
    # Speeds are means over 0.04 s: 2e-3 of the fastest, which a lever of metres enlarges.
    found = late(0.0).jacobian[:, :, 12]
    np.testing.assert_allclose(found, slope, atol=4e-3 * np.abs(slope).max())


@pytest.mark.parametrize("rate_hz", [10, 50])
def test_stamps_since_1970_are_matched_as_those_near_zero(rate_hz) -> None:
    begin_s = 1_700_000_000.0
    times_s = np.arange(0.0, 9.95, 1.0 / rate_hz)
    robot = Trajectory(begin_s + times_s, swung(times_s))
    at_s = np.arange(0.5, 9.0, 1.0 / 30.0)
    frames = ImageTimes("eye-in-hand", begin_s + at_s + 0.03, invert(swung(at_s)))
    best = turning_matches(robot, frames)[0]
    # Half a step of the search; a robot of 10 Hz is interpolated over 0.1 s.
    assert best.offset_s == pytest.approx(0.03, abs=0.006)


def with_places_alone(problem, rows):
    """The problem in which some rows read places without rotations."""
    rotation = problem.observations.has_rotation.copy()
    rotation[rows] = False
    return seen_otherwise(problem, has_rotation=rotation)


def seen_otherwise(problem, **changes):
    return replace(problem, observations=replace(problem.observations, **changes))


def pushed(cell, frame, stop, twist, stops=20):
    edge = cell.truth[frame] @ exp(np.array(twist))
    return {(frame, at): edge for at in range(stop, stops)}


@cache
def answered(given, **changes):
    known = calibrated(simulate(replace(FINE, state_intrinsics=given, **changes)))
    problem = known.assessment.fit.problem
    return problem, fit_problem(problem, known.assessment.fit.state)


@pytest.mark.slow
def test_the_variance_to_be_expected_is_that_of_a_level_with_its_degrees_of_freedom():
    # Corners know poses far better than the robot stands.
    problem, fit = answered(True, views=6, seed=5, robot_sigma_m=1e-3, robot_sigma_rad=1e-3)
    expected = expected_levels(problem, fit.state, fit.noise)
    # Corners' own noise takes some of the freedom; the sum over the scales is right to 1e-3.
    ratio = (expected / fit.noise.robots) ** 2
    np.testing.assert_allclose(ratio - 1.0, 2.0 / (6 * 6 - 14.0), rtol=0.15)
    # A level that may be zero is expected to be what the corners hide.
    problem, fit = answered(True, views=6, seed=1, robot_sigma_m=0.0, robot_sigma_rad=0.0)
    at = replace(fit.noise, robots=np.full((1, 2), 1e-9))
    assert 1e-6 < expected_levels(problem, fit.state, at)[0, 1] < 1e-4


def test_a_fit_has_its_unknowns_by_name_and_none_of_exact_values():
    for given in (True, False):
        known = calibrated(simulate(replace(FINE, state_intrinsics=given, views=12, seed=0)))
        fit, lens, board = known.assessment.fit, ("lens", "cam"), ("board", "")
        parts, size = fit.unknowns.parts, len(fit.whole)
        assert [*parts][:4] == [("edge", "cam"), ("edge", "target"), lens, board]
        columns = fit.unknowns.columns(*parts)
        np.testing.assert_array_equal(columns, np.arange(size))
        assert fit.unknowns["lens", "another"] == slice(0, 0)
        np.testing.assert_array_equal(fit.values(lens), intrinsics(fit.camera("cam")))
        np.testing.assert_array_equal(fit.covariance(board, lens), fit.whole[
            np.ix_(*[np.r_[parts[board], parts[lens]]] * 2)
        ])  # fmt: skip
        # Of a board as it is printed, the scale alone is uncertain, and of a given lens nothing.
        assert fit.unknowns.values_of(board).tolist() == [SCALE]
        assert not fit.values(board)[SCALE + 1 :].any()
        assert len(fit.unknowns.values_of(lens)) == (0 if given else len(fit.values(lens)))


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_closure_in_the_base_is_the_derivative_of_where_things_are_seen(mount):
    options = replace(FINE, state_intrinsics=False, mount=mount, views=8, seed=6)
    fit, rows = calibrated(simulate(options)).assessment.fit, np.array([1, 4])
    closure = fit.closure(rows, "base")
    steps = np.random.default_rng(0).normal(size=(4, len(fit.whole))) * 1e-7
    # A board's size moves no thing.
    steps[:, fit.unknowns.of_kinds("board")] = 0.0
    for step in steps:
        after, before = (
            fit.at(fit.state.moved(side * step)).closure(rows, "base").poses for side in (0.5, -0.5)
        )
        by_step = log(after @ invert(before))
        # By the lens it is that where the corners were linearised, the fit's last small step away.
        np.testing.assert_allclose(
            closure.linear.jacobian @ step, by_step, atol=1e-4 * np.abs(by_step).max()
        )
    slope = closure.linear.jacobian
    expected = slope @ fit.whole @ slope.mT
    np.testing.assert_allclose(closure.covariance(fit.whole), expected, rtol=1e-9)


def test_one_more_column_of_a_fit_steps_to_what_a_fit_with_it_finds():
    problem, fit = answered(False, views=8, seed=6)
    size = joint.target_sizes(problem, {"target": 1e-3})
    widened = Fit(problem, fit).with_columns(size)
    step = -widened.absorbed @ widened.equations[1]
    state, _ = solve_problem(widened.problem, widened.state, fit.noise, is_near=True)
    # The problem is linear to the square of a step of some 1e-4.
    assert step[-1] == pytest.approx(state.values[-1], rel=1e-3)
    assert abs(step[-1]) > 1e-6


@pytest.mark.parametrize("kind", ["one a stop", "places", "combined"])
def test_errors_of_an_arm_beside_a_likelihood_are_those_of_a_wider_problem(kind):
    problem, fit = answered(False, views=8, seed=6)
    if kind == "places":  # Which leave a flange's rotation open.
        problem = seen_otherwise(problem, has_rotation=np.zeros(len(problem), dtype=bool))
    if kind == "combined":  # One noise of robot and camera.
        unknown = np.zeros_like(problem.observations.covariance)
        problem = replace(seen_otherwise(problem, covariance=unknown), is_combined=True)
    moves = np.random.default_rng(0).standard_normal((8, 6, 3))
    nothing = PriorInformation(np.zeros((3, 3)), np.zeros(3))
    effect = Effect.free("arm", nothing, flange_jacobian={ROBOT: moves})
    wider = problem.with_effects([*problem.effects, effect])
    wider_state = replace(fit.state, values=np.append(fit.state.values, np.zeros(3)))
    extended = robot_likelihood(problem, fit.state, fit.noise).with_moves(0, moves)
    expected = robot_likelihood(wider, wider_state, fit.noise)
    np.testing.assert_allclose(extended.jacobian, expected.jacobian, rtol=1e-6, atol=1e-9)
    if kind != "combined":
        return
    # What the wider problem has left of the arm's columns beside them is rounding.
    levels, fixed = 2.0 * fit.noise.robots, np.zeros(2, dtype=bool)
    found, values = (item.most_likely(levels, fixed)[1] for item in (extended, expected))
    assert found == pytest.approx(values, abs=1e-5)


def test_distant_views_are_left_out_where_the_others_agree_poorly():
    """Poses to 10 mm and 1 deg, which is more than any result may be off, and one to 100 deg."""
    cell, rng = simulate(replace(FINE, views=60, seed=4)), np.random.default_rng(0)
    noise = np.repeat([np.deg2rad(1.0), 0.01], 3) * rng.standard_normal((60, 6))
    noise[17, 1] += np.deg2rad(100.0)
    measured = cell.cam_from_target @ exp(noise)
    found = inliers_of(chain("eye-in-hand", cell.robot.base_from_flange, measured))
    assert np.flatnonzero(~found.used).tolist() == [17]


@pytest.mark.parametrize("wrong", [[2], [1, 6]])
def test_boards_read_upside_down_are_left_out_however_noisy_the_others_are(wrong):
    """A fit of all would follow them, and none would be far from it."""
    rng, count = np.random.default_rng(3), 12
    rotation = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (count, 3))).as_matrix()
    poses, edges = (
        compose(rotation, rng.uniform(-0.3, 0.3, (count, 3))),
        exp(rng.uniform(-1, 1, (2, 6))),
    )
    noise = rng.standard_normal((count, 6)) * np.repeat([0.02, 0.006], 3)
    measured = invert(poses @ edges[0]) @ edges[1] @ exp(noise)
    measured[wrong] = measured[wrong] @ exp(np.array([0.0, 0.0, np.pi, 0.1, 0.05, 0.0]))
    found = inliers_of(chain("eye-in-hand", poses, measured))
    assert np.flatnonzero(~found.used).tolist() == wrong


def test_a_wrong_image_does_not_take_a_sound_one_of_its_stop_with_it():
    """Each stop looked at several times, with the camera's own noise each time."""
    times = 3
    problem = answered(True, seed=1)[0].with_effects([])
    seen = problem.observations.take(np.repeat(np.arange(len(problem)), times))
    noise = np.random.default_rng(5).standard_normal((len(seen), 6))
    step = np.einsum("nij,nj->ni", np.linalg.cholesky(seen.covariance), noise)
    problem = replace(problem, observations=replace(seen, measured=seen.measured @ exp(step)))
    assert inliers_of(problem).used.all()
    measured = problem.observations.measured
    for rows in ([4 * times + 1], [*range(4 * times, 5 * times)]):
        # One image, or all of a stop, is of another.
        wrong = measured.copy()
        wrong[rows] = measured[11 * times]
        found = inliers_of(seen_otherwise(problem, measured=wrong))
        assert np.flatnonzero(~found.used).tolist() == rows


def test_between_samples_pose_and_speed_are_right() -> None:
    at_s, step_s = np.random.default_rng(0).uniform(0.1, 9.8, 500), 1e-4
    # Far below any arm's repeatability (0.05 mrad, 0.03 mm); the fourth power of the distance.
    for hz, most in ((50, 3e-6), (125, 1e-7), (500, 1e-9)):
        assert np.abs(log(invert(swung(at_s)) @ sampled(hz).at(at_s))).max() < most
    # A sample that is missing now and then is no gap: through samples of 50 Hz on one side.
    moved = sampled(100, lambda value: np.arange(len(value)) % 7 != 3)
    assert moved.covers(at_s).all()
    assert np.abs(log(invert(swung(at_s)) @ moved.at(at_s))).max() < 5e-6
    speeds = sampled(125).speeds(at_s)
    true = log(invert(swung(at_s - step_s)) @ swung(at_s + step_s)) / (2 * step_s)
    # Means over 0.04 s.
    assert np.abs(speeds - true).max() < 2e-3 * np.abs(true).max()


def test_a_slip_that_hides_in_the_noise_of_single_views_is_found():
    rng = np.random.default_rng(10)
    cell = world(rng, 40, 1.0)
    # 0.12 mm: one sigma of a single view along its axis.
    problem = observed(cell, rng, pushed(cell, "target_floor", 20, (0, 0, 0, 1e-4, 6e-5, 0), 40))
    found = refine_inliers(inliers_and_moves(problem, started(problem), MOVABLE), MOVABLE)
    (move,) = found.moves
    assert move.frame == "target_floor"
    assert abs(move.stop - 20) <= 2
    assert found.used.all()

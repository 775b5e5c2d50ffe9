"""Whole cells in plain arrays: the linearisation, the fit, its start, and what moved."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import ROBOT_SIGMAS, away, moved, observed, pose, true_state, world

from visioncal.calibration.stages.init_frames import init_network
from visioncal.calibration.stages.pairwise import Candidates
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.model_evidence import SIZES_M, TURN_PER_M
from visioncal.estimation.normal_equations import normal_equations
from visioncal.estimation.outliers import inliers_and_moves, refine_inliers
from visioncal.estimation.problem_parts import Effect, FramePrior, Noise, State
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    equations_from,
    fit_problem,
    posterior,
    solve_problem,
)
from visioncal.estimation.steps import Step, evidence, find_steps, frames_of

MOVABLE = ("cam_left", "cam_right", "target_floor", "target_a", "target_b")
NOISE = Noise(np.array([ROBOT_SIGMAS["a"], ROBOT_SIGMAS["b"]]), np.zeros(0))


def problem_of(seed, stops=20, seen=0.7, **more):
    rng = np.random.default_rng(seed)
    cell = world(rng, stops, seen)
    return cell, observed(cell, rng, **more)


def network(problem, **turned):
    """The frames that the observations connect, each by its only pose."""
    shape = (len(problem.observations), 1)
    poses = problem.observations.measured[:, None]
    candidates = Candidates(poses, np.zeros(shape, dtype=np.int64), np.ones(shape, dtype=bool))
    return init_network(problem, candidates, turned)


def started(problem):
    tied = network(problem)
    assert not tied.untied
    return State(np.array([tied.edges[index] for index in problem.unknown]), np.zeros(0))


def with_places_alone(problem, rows):
    """The problem in which some rows read places without rotations."""
    rotation = problem.observations.has_rotation.copy()
    rotation[rows] = False
    return replace(problem, observations=replace(problem.observations, has_rotation=rotation))


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
    cell, problem = problem_of(1, stops=3, seen=1.0)
    if kind == "places":
        problem = with_places_alone(problem, slice(0, 5))
    if kind == "values":
        problem = with_values(problem, np.random.default_rng(2))
    state = true_state(cell, problem.tree)
    state = State(state.edges, np.full(problem.size - 6 * len(state.edges), 0.3))
    found, step = problem.linear(state).jacobian, 1e-6
    for at, column in enumerate(np.eye(problem.size) * step):
        ends = [problem.linear(state.moved(value)).residuals for value in (column, -column)]
        # Differences of 1e-6 are exact to 1e-9. Of a place alone, a turn of the frame that it is
        # in counts by the place's own error, 0.1 mm, which is left out; and an effect's values move
        # as their last step does, which is its own square, 1e-6, off.
        away_by = np.abs((ends[0] - ends[1]) / (2 * step) - found[:, :, at]).max()
        assert away_by < {"poses": 1e-8, "places": 5e-4, "values": 5e-6}[kind]


def test_flanges_move_as_central_differences_have_it():
    cell, problem = problem_of(1, stops=2, seen=1.0)
    state, step = true_state(cell, problem.tree), 1e-6
    found = problem.linear(state).by_errors
    of, members = problem.units
    for robot, name in enumerate(problem.robots):
        for at in range(6):
            ends = []
            for sign in (step, -step):
                twist = np.zeros(6)
                twist[at] = sign
                poses = np.array([moved(value, twist) for value in problem.poses[name]])
                other = replace(problem, poses={**problem.poses, name: poses})
                ends.append(other.linear(state).residuals)
            slope = (ends[0] - ends[1]) / (2 * step)
            mine = [row for row, unit in enumerate(of) if unit >= 0 and members[unit, 0] == robot]
            assert mine
            np.testing.assert_allclose(found[mine, :, at], slope[mine], atol=1e-8)


def dense_information(problem, state):
    """The information with every flange's error as an unknown of its own."""
    linear = problem.linear(state, ideal=True)
    weights = np.linalg.inv(problem.observations.covariance)
    of, members = problem.units
    size = problem.size
    whole = np.zeros((size + 6 * len(members), size + 6 * len(members)))
    for row, unit in enumerate(of):
        slope = np.zeros((6, len(whole)))
        slope[:, :size] = linear.jacobian[row]
        if unit >= 0:
            slope[:, size + 6 * unit : size + 6 * unit + 6] = linear.by_errors[row]
        whole += slope.T @ weights[row] @ slope
    for unit, (robot,) in enumerate(members):
        at = size + 6 * unit + np.arange(6)
        whole[at, at] += np.repeat(NOISE.robots[robot], 3) ** -2.0
    return whole


def test_taking_the_flanges_out_loses_nothing():
    cell, problem = problem_of(3, stops=6)
    state = true_state(cell, problem.tree)
    dense = np.linalg.inv(dense_information(problem, state))[: problem.size, : problem.size]
    found = covariance_of(problem, Solution(state, NOISE))
    # The same to rounding, for matrices of a condition of 1e6.
    np.testing.assert_allclose(found, dense, atol=1e-7 * np.abs(dense).max())


def test_equations_from_a_stop_on_are_those_of_its_observations_alone():
    cell, problem = problem_of(4, stops=6)
    fit = fit_problem(problem, true_state(cell, problem.tree))
    stops = []
    for stop, *parts in equations_from(problem, fit, np.arange(problem.size)):
        later = problem.subset(problem.observations.stops >= stop)
        for part, whole in zip(parts, normal_equations(later, fit.state, fit.noise), strict=True):
            np.testing.assert_allclose(part, whole, atol=1e-9 * np.abs(parts[0]).max())
        stops.append(stop)
    assert stops == [5, 4, 3, 2, 1, 0]


def still_cell(seed):
    """A cell whose fixed cameras see fixed boards again and again, at rest."""
    cell, problem = problem_of(seed, stops=16)
    problem = replace(problem, with_repeats=True)
    assert problem.repeat_counts.max() > 1.0
    return problem, fit_problem(problem, true_state(cell, problem.tree))


def test_repeats_do_not_pass_for_a_step():
    for seed in range(6):
        problem, fit = still_cell(seed)
        assert not find_steps(problem, fit, frames_of(problem, tuple(problem.unknown)))


@pytest.mark.slow
def test_steps_are_as_likely_as_their_evidence_says():
    """Half of the cells have one, of the sizes that steps have; robots hide the smallest."""
    frame, found = "target_b", []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        cell = replace(world(rng, 14), robot_sigmas={"a": (1e-3, 1e-3), "b": (1e-3, 1e-3)})
        steps = rng.random() < 0.5
        twist = steps * rng.choice(SIZES_M) * np.repeat([TURN_PER_M, 1.0], 3) * rng.normal(size=6)
        changed = {(frame, stop): moved(cell.truth[frame], twist) for stop in range(6, 14)}
        problem = observed(cell, rng, changed)
        fit = fit_problem(problem, true_state(cell, problem.tree))
        (candidate,) = frames_of(problem, [frame])
        unmoved = Step(candidate, 6, np.zeros(6), np.eye(6), 0.0, np.zeros((0, 0)))
        gain, wider, _ = evidence(problem, fit, unmoved)
        assert f"{frame}@2" in wider.unknown
        found.append((steps, 1.0 / (1.0 + np.exp(-0.5 * gain))))
    stepped, likely = np.array(found).T
    # The number of steps is off by as much as they are uncertain; a few are never seen, and none
    # is seen where there is none.
    spread = np.sqrt(np.sum(likely * (1.0 - likely)))
    assert 1.0 < spread < 4.0
    assert abs(np.sum(stepped - likely)) < 3.0 * spread
    assert stepped[likely > 0.99].all()
    assert np.sum(likely > 0.99) > 16


def test_the_fit_is_as_good_as_its_covariance_says():
    squares, levels = [], []
    for seed in range(6):
        cell, problem = problem_of(seed)
        fit = fit_problem(problem, true_state(cell, problem.tree))
        assert fit.settled
        covariance = covariance_of(problem, fit)
        error = away(cell, problem, fit.state)
        squares.append(error @ np.linalg.solve(covariance, error) / len(error))
        levels.append(fit.noise.robots[:, 1])
    # Chi-square of 6 x 36: a standard deviation of 0.1; the levels' own errors add some.
    assert 0.7 < np.mean(squares) < 1.5
    # Twenty stops tell a flange's error to 15 % each.
    np.testing.assert_allclose(np.mean(levels, axis=0), [3e-5, 8e-5], rtol=0.35)


def test_what_is_left_of_the_observations_is_their_redundancy():
    cell, problem = problem_of(5)
    fit = fit_problem(problem, true_state(cell, problem.tree))
    squares, left = posterior(problem, fit.state, fit.noise)
    # Chi-square of some 300: a standard deviation of 8 %.
    assert left.sum() > 200
    assert squares.sum() == pytest.approx(left.sum(), rel=0.3)


def test_the_level_of_a_sensor_is_found():
    cell, problem = problem_of(6)
    sensors = np.array(
        [0 if observer == "cam_left" else -1 for observer in problem.observations.observers]
    )
    # What cam_left says of its own noise is three times too little.
    covariance = problem.observations.covariance / np.where(sensors == 0, 9.0, 1.0)[:, None, None]
    problem = replace(
        problem, observations=replace(problem.observations, sensors=sensors, covariance=covariance)
    )
    fit = fit_problem(problem, true_state(cell, problem.tree))
    # Some 150 residuals tell it to 6 %.
    assert fit.noise.sensors[0] == pytest.approx(3.0, rel=0.2)


def test_the_start_is_near_the_truth():
    cell, problem = problem_of(7)
    off = away(cell, problem, started(problem)).reshape(-1, 2, 3)
    # Closed forms of 8 to 16 views: far inside the 50 mm and 5 degrees that the fit needs.
    assert np.abs(off[:, 0]).max() < 0.02
    assert np.abs(off[:, 1]).max() < 0.02


def test_a_camera_in_one_hand_and_a_board_in_the_other_place_three_frames():
    rng = np.random.default_rng(14)
    cell = world(rng, 20)
    sights = [("cam_left", "target_b", stop) for stop in range(20)]
    cell = replace(cell, parents={**cell.parents, "cam_left": "flange_a"}, pairs=sights)
    edges = network(observed(cell, rng)).edges
    for name in ("base_b", "cam_left", "target_b"):
        off = np.linalg.inv(cell.truth[name]) @ edges[name]
        assert np.linalg.norm(off[:3, 3]) < 0.02


def test_a_sound_cell_has_nothing_left_out_and_nothing_moved():
    _, problem = problem_of(8)
    found = refine_inliers(inliers_and_moves(problem, started(problem), MOVABLE), MOVABLE)
    assert found.used.all()
    assert not found.moves


def pushed(cell, frame, stop, twist, stops=20):
    edge = moved(cell.truth[frame], np.array(twist))
    return {(frame, at): edge for at in range(stop, stops)}


def test_a_board_that_slips_and_a_camera_that_is_bumped_are_two_frames_each():
    rng = np.random.default_rng(9)
    cell = world(rng, 20, 0.9)
    changed = pushed(cell, "target_b", 9, (0.004, 0, 0, 0.003, 0, 0.004))
    changed |= pushed(cell, "cam_right", 12, (0, -0.006, 0, 0, 0.005, 0))
    problem = observed(cell, rng, changed)
    found = refine_inliers(inliers_and_moves(problem, started(problem), MOVABLE), MOVABLE)
    assert {(move.frame, move.stop) for move in found.moves} == {("target_b", 9), ("cam_right", 12)}
    assert found.used.all()
    plain = [name for name in found.problem.unknown if "@" not in name]
    edges = dict(zip(found.problem.unknown, found.fit.state.edges, strict=True))
    was = np.linalg.inv(cell.truth["base_b"]) @ edges["base_b"]
    assert len(plain) == 6
    # The base is as near as without: to some 0.1 mm.
    assert np.linalg.norm(was[:3, 3]) < 4e-4


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


# Of the views of one pair, a few in the middle, or most of the earliest.
@pytest.mark.parametrize(
    ("some", "others"), [(slice(3, 6), slice(8, 11)), (slice(4), slice(9, 13))]
)
def test_wrong_images_are_left_out_and_nothing_else(some, others):
    _, problem = problem_of(11, stops=25)
    measured = problem.observations.measured.copy()
    pairs = list(zip(problem.observations.observers, problem.observations.observed, strict=True))
    rows = [at for at, pair in enumerate(pairs) if pair == ("cam_left", "target_a")]
    wrong = rows[some]
    measured[wrong] = problem.observations.measured[rows[others]]
    problem = replace(problem, observations=replace(problem.observations, measured=measured))
    found = refine_inliers(inliers_and_moves(problem, started(problem), MOVABLE), MOVABLE)
    assert np.flatnonzero(~found.used).tolist() == wrong
    assert not found.moves


def test_a_held_value_stays_and_counts_with_what_is_known_of_it():
    cell, problem = problem_of(13)
    state = true_state(cell, problem.tree)
    by_sensor = np.zeros((len(problem), 6, 1))
    by_sensor[:, 3, 0] = 1e-3  # every camera measures x too long alike
    known = PriorInformation(np.eye(1), np.zeros(1))
    effect = Effect("drift", np.zeros(1), known, np.ones(1, dtype=bool), by_sensor)
    held = problem.with_effects([effect])
    moved, _ = solve_problem(held, State(state.edges, np.zeros(1)), NOISE)
    without, _ = solve_problem(problem, state, NOISE)
    assert moved.values[0] == 0.0
    np.testing.assert_array_equal(moved.edges, without.edges)
    free = problem.with_effects([replace(effect, held=np.zeros(1, dtype=bool))])
    there = Solution(moved, NOISE)
    np.testing.assert_array_equal(covariance_of(held, there), covariance_of(free, there))
    alone = covariance_of(problem, Solution(without, NOISE))
    assert np.trace(covariance_of(held, there)[:-1, :-1]) > 1.5 * np.trace(alone)


def test_a_prior_of_an_edge_pulls_it_by_its_share_of_the_information():
    cell, problem = problem_of(14)
    state = true_state(cell, problem.tree)
    plain, _ = solve_problem(problem, state, NOISE)
    covariance = covariance_of(problem, Solution(plain, NOISE))[problem.edge_columns("target_a")]
    at = problem.unknown["target_a"]
    turn, place = plain.edges[at][:3, :3], plain.edges[at][:3, 3]
    before = turn @ covariance[3:, problem.edge_columns("target_a")][:, 3:] @ turn.T
    sigma_m = float(np.sqrt(before[0, 0]))
    prior = FramePrior("flange_a", "target_a", (0,), (place[0] + 1e-4,), sigma_m)
    found, _ = solve_problem(replace(problem, priors=(prior,)), plain, NOISE)
    # As sure as the observations: half-way. Of second order are a few thousandths of a step.
    assert found.edges[at][0, 3] - place[0] == pytest.approx(0.5e-4, rel=0.02)
    narrower = covariance_of(replace(problem, priors=(prior,)), Solution(found, NOISE))
    block = narrower[problem.edge_columns("target_a"), problem.edge_columns("target_a")][3:, 3:]
    turned = found.edges[at][:3, :3]
    assert (turned @ block @ turned.T)[0, 0] == pytest.approx(0.5 * sigma_m**2, rel=0.02)


def test_priors_of_frames_have_the_jacobian_of_central_differences():
    cell, problem = problem_of(15, stops=4)
    rotation = pose((4, -2, -58), (0.0, 0.0, 0.0))[:3, :3]
    state, step = true_state(cell, problem.tree), 1e-6
    for prior in (
        # Up to the cell and down again, along two axes; and an edge by itself, with its rotation.
        FramePrior("cam_left", "cam_right", (0, 2), (0.1, 0.2), 1e-3),
        FramePrior("flange_b", "target_b", (0, 1, 2), (0.0, 0.0, 0.1), 1e-3, rotation, 2e-3),
    ):
        _, jacobian = problem.prior_rows(prior, state)
        for at, column in enumerate(np.eye(problem.size) * step):
            ends = [problem.prior_rows(prior, state.moved(value))[0] for value in (column, -column)]
            # In units of sigmas of a millimetre: rounding of 1e-16 m over steps of 1e-6.
            np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), jacobian[:, at], atol=1e-6)


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
        known = covariance_of(some, Solution(State(edges, np.zeros(0)), NOISE))
        mine = known[some.edge_columns("target_floor"), some.edge_columns("target_floor")]
        np.testing.assert_allclose(mine, single, atol=1e-6 * single.max())
    # What the boards on the flanges tell is as without.
    moving = problem.subset(~still & ~problem.observations.involves("target_floor"))
    plain = replace(moving, with_repeats=False)
    found = [covariance_of(value, Solution(state, NOISE)) for value in (moving, plain)]
    np.testing.assert_array_equal(*found)

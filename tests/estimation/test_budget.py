"""What the uncertainty of a whole cell is made of."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems import ROBOT_SIGMAS, moved, observed, true_state, world

from visioncal.estimation.budget import Sources, covariance_by_source
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import normal_equations
from visioncal.estimation.problem_parts import Effect, FramePrior, Noise, State
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
)

NOISE = Noise(np.array([ROBOT_SIGMAS["a"], ROBOT_SIGMAS["b"]]), np.zeros(0))
SOURCES = Sources(
    {"cam_left": "pixels of left", "cam_right": "pixels of right"},
    {"a": "robot a", "b": "robot b"},
)


def exact(seed, stops=5):
    """A cell that was measured without noise, and its state."""
    rng = np.random.default_rng(seed)
    cell = world(rng, stops, 0.8)
    problem = observed(cell, rng, noise=0.0)
    return problem, true_state(cell, problem.tree)


def with_drift(problem):
    """The problem with two values that are known together, and all that counts besides."""
    by_sensor = np.zeros((len(problem), 6, 2))
    by_sensor[:, 3, 0] = by_sensor[:, 5, 1] = 1e-3
    known = PriorInformation(np.array([[4.0, 1.0], [1.0, 2.0]]), np.zeros(2))
    effect = Effect("drift", np.zeros(2), known, np.zeros(2, dtype=bool), by_sensor)
    prior = FramePrior("flange_b", "target_b", (0, 2), (-0.02, 0.06), 1e-4)
    return replace(problem.with_effects([effect]), priors=(prior,), with_repeats=True)


def test_the_parts_add_up_to_the_whole():
    problem, state = exact(1, stops=12)
    problem = with_drift(problem)
    state = State(state.edges, np.zeros(2))
    first = 6 * len(problem.unknown)
    columns = {"x": np.array([first]), "z": np.array([first + 1])}
    parts = covariance_by_source(problem, state, NOISE, replace(SOURCES, columns=columns))
    whole = covariance_of(problem, Solution(state, NOISE))[:first, :first]
    assert set(parts) == {*SOURCES.sensors.values(), "robot a", "robot b", "x", "z", "priors"}
    # An identity; what is left is rounding of an inverse with a condition of 1e6.
    np.testing.assert_allclose(sum(parts.values()), whole, atol=1e-7 * np.abs(whole).max())


@pytest.mark.parametrize("robot", ["a", "b"])
def test_the_part_of_a_robot_is_what_its_errors_do_to_the_answer(robot):
    problem, state = exact(2)
    whole = covariance_of(problem, Solution(state, NOISE))
    sigmas, step, part = np.repeat(ROBOT_SIGMAS[robot], 3), 1e-6, np.zeros_like(whole)
    for stop in range(5):
        for axis in range(6):
            twist = np.zeros(6)
            twist[axis] = step
            poses = problem.poses[robot].copy()
            poses[stop] = moved(poses[stop], twist)
            other = replace(problem, poses={**problem.poses, robot: poses})
            pulled = whole @ normal_equations(other, state, NOISE)[1] / step * sigmas[axis]
            part += np.outer(pulled, pulled)
    found = covariance_by_source(problem, state, NOISE, SOURCES)[f"robot {robot}"]
    # Steps of 1e-6 are of the first order to 1e-5, and weights follow the poses by as much.
    np.testing.assert_allclose(found, part, atol=1e-3 * np.abs(part).max())

"""Causes of a change: how stops move with them, and what they say."""

from dataclasses import replace

import numpy as np
import pytest

from visioncal.core.transforms import adjoint, exp, invert, log
from visioncal.estimation.chain import chain
from visioncal.estimation.model_evidence import (
    CalibrationPosterior,
    ChangeHypothesis,
    evidence_of,
    undone,
    with_change,
)
from visioncal.estimation.problem_parts import ROBOT, Noise, State

NOISE = Noise.of_robot(1e-4, 1e-4)
MOUNTS = ("eye-in-hand", "eye-to-hand")


def stops_of(mount, rng, count=5):
    """Stops that close the chain exactly, with the edges that they close it with."""
    x, z, *poses = exp(rng.normal(0.0, 0.5, (count + 2, 6)))
    poses = np.array(poses)
    robot = poses if mount == "eye-in-hand" else invert(poses)
    covariance = np.tile(1e-10 * np.eye(6), (count, 1, 1))
    problem = chain(mount, poses, invert(robot @ x) @ z, covariance)
    return problem, State(np.stack([x, z]), np.zeros(0))


def seen_as(problem, measured):
    return replace(problem, observations=replace(problem.observations, measured=measured))


def moved_board(data):
    return ChangeHypothesis("board", np.full(6, 2.0), -np.tile(np.eye(6), (len(data), 1, 1)))


def slipped(data, rng):
    by_flange = rng.normal(size=(len(data), 6, 1))
    return ChangeHypothesis("joint", np.ones(1), flange_jacobian=by_flange)


def belief_of(state, freedom=np.inf, sigma=1e-5):
    return CalibrationPosterior(state, sigma**2 * np.eye(12), NOISE, freedom)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("size", [0.0, 0.4, 1.5])
def test_stops_move_with_a_change_as_its_derivatives_say(mount, size):
    rng = np.random.default_rng(3)
    data, state = stops_of(mount, rng)
    for cause in (moved_board(data), slipped(data, rng)):
        count = len(cause.units)
        at = size * np.ones(count) / np.sqrt(6.0)
        beginning, step = with_change(state, cause), 1e-6
        by_cause = undone(data, cause, at).linear(beginning).jacobian[:, :, 12:]
        for unknown in range(count):
            ends = []
            for sign in (1.0, -1.0):
                beside = at.copy()
                beside[unknown] += sign * step
                ends.append(undone(data, cause, beside).linear(beginning).residuals)
            slope = (ends[0] - ends[1]) / (2 * step)
            # The series of the right Jacobian is cut where it is exact to 1e-9 up to 0.5 rad, and
            # to some 1e-3 at two radians.
            assert by_cause[:, :, unknown] == pytest.approx(slope, abs=1e-7 if size < 1 else 2e-2)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_board_that_was_turned_over_is_told_exactly(mount):
    rng = np.random.default_rng(4)
    data, state = stops_of(mount, rng)
    change = np.array([0.0, 2.9, 0.3, 0.2, -0.1, 0.4])
    turned = seen_as(data, data.observations.measured @ exp(change))
    start = log(turned.change_of("target", state)).mean(axis=0)
    cause = replace(moved_board(data), start=start)
    found = evidence_of(turned, belief_of(state), cause)
    assert exp(found.values) == pytest.approx(exp(change), abs=1e-6)
    # Exact stops leave nothing but rounding.
    assert found.misfit == pytest.approx(0.0, abs=1e-3)
    before = undone(turned, cause, found.values).observations
    assert before.measured == pytest.approx(data.observations.measured, abs=1e-6)
    # What was noise of the turned board's pose is noise of it where it was.
    carried = adjoint(invert(exp(-change)))
    assert before.covariance[0] == pytest.approx(1e-10 * carried @ carried.T, rel=1e-4)


def test_misfit_and_evidence_follow_their_distributions():
    rng = np.random.default_rng(5)
    data, state = stops_of("eye-in-hand", rng)
    sigma = np.repeat(NOISE.robots[0], 3)
    misfits, ratios = [], []
    for _ in range(60):
        noise = exp(sigma * rng.standard_normal((5, 6)))
        noisy = replace(data, poses={ROBOT: data.poses[ROBOT] @ noise})
        nothing = evidence_of(noisy, belief_of(state, freedom=60.0))
        board = evidence_of(noisy, belief_of(state, freedom=60.0), moved_board(data))
        misfits.append(nothing.misfit)
        ratios.append(np.exp(board.likelihood - nothing.likelihood))
    # Chi-square of thirty directions: its mean over 60 draws is known to 1.
    assert np.mean(misfits) == pytest.approx(30.0, abs=4.0)
    # One on average at most; a ratio of a hundred is chance in one draw of a hundred at most.
    assert np.mean(ratios) < 1.5
    assert max(ratios) < 100.0


def test_a_known_scale_and_one_of_many_degrees_of_freedom_agree():
    data, state = stops_of("eye-in-hand", np.random.default_rng(6))
    off = seen_as(data, data.observations.measured @ exp(np.full(6, 2e-4)))
    sure, nearly = (
        evidence_of(off, belief_of(state, freedom=value)).likelihood for value in (np.inf, 1e9)
    )
    assert nearly == pytest.approx(sure, rel=1e-6)

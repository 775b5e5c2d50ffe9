"""Poses between samples: the cubic, the ends, the gaps, and how an offset moves the chain."""

import numpy as np
import pytest

from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.clock import clock_problem
from visioncal.estimation.clock_correlation import ImageTimes, turning_matches
from visioncal.estimation.problem_parts import State
from visioncal.estimation.trajectory import Samples, Trajectory

RATES = np.array([0.31, 0.47, 0.73, 0.21, 0.37, 0.53])
SIZES = np.array([0.4, 0.5, 0.7, 0.1, 0.1, 0.1])


def swung(times_s: FloatArray) -> FloatArray:
    """A flange that swings about all axes, at up to 3 rad/s: (n, 4, 4)."""
    return exp(np.sin(2 * np.pi * RATES * times_s[:, None] + np.arange(6)) * SIZES)


def sampled(hz: float, keep=lambda times_s: times_s >= 0.0) -> Trajectory:
    times_s = np.arange(0, 10, 1 / hz)
    times_s = times_s[keep(times_s)]
    return Trajectory(times_s, swung(times_s))


@pytest.mark.parametrize(("hz", "most"), [(50, 3e-6), (125, 1e-7), (500, 1e-9)])
def test_between_samples_the_pose_is_right(hz: float, most: float) -> None:
    at_s = np.random.default_rng(0).uniform(0.1, 9.8, 500)
    away = log(invert(swung(at_s)) @ sampled(hz).at(at_s))
    # Far below any arm's repeatability (0.05 mrad, 0.03 mm); the fourth power of the distance.
    assert np.abs(away).max() < most


def test_samples_give_themselves_back() -> None:
    moved = sampled(50)
    np.testing.assert_allclose(moved.at(moved.stamps_s), moved.poses, atol=1e-12)


def test_nothing_is_said_across_gaps_and_beyond_the_ends() -> None:
    moved = sampled(100, lambda value: (value < 2.0) | (value > 2.5))
    at_s = np.array([-0.01, 0.0, 1.985, 2.2, 2.505, 9.985, 9.995])
    assert moved.covers(at_s).tolist() == [False, True, True, False, False, True, False]
    assert moved.covers(at_s, 0.02).tolist() == [False] * 7
    # Beside a gap a line is left, through the last two samples.
    away = log(invert(swung(at_s[2:3])) @ moved.at(at_s[2:3]))
    assert np.abs(away).max() < 1e-3


def test_a_sample_that_is_missing_now_and_then_is_no_gap() -> None:
    moved = sampled(100, lambda value: np.arange(len(value)) % 7 != 3)
    at_s = np.linspace(0.1, 9.9, 300)
    assert moved.covers(at_s).all()
    # Through samples of 50 Hz on one side.
    assert np.abs(log(invert(swung(at_s)) @ moved.at(at_s))).max() < 5e-6


def test_numbers_are_blended_like_poses() -> None:
    times_s = np.arange(0, 2, 0.01)
    at_s = np.linspace(0.05, 1.9, 50)
    blended = Samples(times_s).blend(np.sin(np.outer(times_s, [1.0, 3.0])), at_s)
    np.testing.assert_allclose(blended, np.sin(np.outer(at_s, [1.0, 3.0])), atol=1e-8)


def test_speeds_are_those_of_the_motion() -> None:
    at_s, step_s = np.linspace(0.1, 9.8, 200), 1e-4
    told = sampled(125).speeds(at_s)
    true = log(invert(swung(at_s - step_s)) @ swung(at_s + step_s)) / (2 * step_s)
    # Means over 0.04 s.
    assert np.abs(told - true).max() < 2e-3 * np.abs(true).max()


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_offset_moves_the_chain_as_its_column_says(mount) -> None:
    rng = np.random.default_rng(1)
    x, z = exp(rng.normal(size=(2, 6)))
    moved, at_s = sampled(500), np.linspace(0.5, 9.5, 40)
    robot = swung(at_s) if mount == "eye-in-hand" else invert(swung(at_s))
    frames = ImageTimes(mount, at_s, invert(robot @ x) @ z @ exp(1e-3 * rng.normal(size=(40, 6))))
    state, step_s = State(np.stack([x, z]), np.zeros(1)), 1e-4
    residuals = [
        clock_problem(moved, frames, value).linear(state).residuals for value in (-step_s, step_s)
    ]
    column = clock_problem(moved, frames, 0.0).linear(state).jacobian[:, :, 12]
    difference = (residuals[1] - residuals[0]) / (2 * step_s)
    # Speeds are means over 0.04 s: 2e-3 of the fastest, which a lever of metres enlarges.
    np.testing.assert_allclose(column, difference, atol=4e-3 * np.abs(difference).max())


@pytest.mark.parametrize("rate_hz", [10, 30, 50, 100])
def test_stamps_since_1970_are_matched_as_those_near_zero(rate_hz) -> None:
    begin_s = 1_700_000_000.0
    times_s = np.arange(0.0, 9.95, 1.0 / rate_hz)
    robot = Trajectory(begin_s + times_s, swung(times_s))
    at_s = np.arange(0.5, 9.0, 1.0 / 30.0)
    frames = ImageTimes("eye-in-hand", begin_s + at_s + 0.03, invert(swung(at_s)))
    best = turning_matches(robot, frames)[0]
    # Half a step of the search; a robot of 10 Hz is interpolated over 0.1 s.
    assert best.offset_s == pytest.approx(0.03, abs=0.006)

"""Torques and angles of the wrong joint, the wrong sign or other units are named."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import slow
from support.moved_arms import changed, robot_with_bodies

from visioncal.core.errors import DataError
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import condition
from visioncal.dynamics.convention_hypotheses import check_recording
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.reading import read_recorded
from visioncal.simulation.dynamics import (
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
    slow_sweep,
)

TORQUE, ANGLE, SPEED = "tau{}_nm", "q{}_rad", "dq{}_rad_s"
ALL = range(1, 7)


def check(stream, name="ur5e", *, with_inertias=True):
    robot = robot_with_bodies(nominal_dynamics(name))
    robot = robot if with_inertias else replace(robot, inertias=None)
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms()))
    check_recording(base, [condition(read_recorded(stream, "streams/robot.csv", 6))])


def swapped(one, other, *groups):
    def change(columns):
        for group in groups:
            first, second = group.format(one), group.format(other)
            columns[first], columns[second] = columns[second].copy(), columns[first].copy()

    return change


def scaled(by, joints, *groups):
    def change(columns):
        for name in (group.format(joint) for group in groups for joint in joints):
            columns[name] *= by

    return change


@pytest.fixture(scope="module")
def stream():
    rng = np.random.default_rng(1)
    return record(real_dynamics("ur5e", rng), multi_sine(6, rng), rng)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (swapped(1, 2, TORQUE), "the torques of joints 1 and 2 are swapped"),
        (swapped(3, 4, ANGLE, SPEED), "the angles of joints 3 and 4 are swapped"),
        (swapped(5, 6, TORQUE, ANGLE, SPEED), "joints 5 and 6 are swapped, with angles"),
        (scaled(-1.0, [2], TORQUE), "the torque of joint 2 has the other sign"),
        (scaled(-1.0, [3], ANGLE, SPEED), "the angle of joint 3 has the other sign"),
        (scaled(-1.0, ALL, TORQUE), "all torques have the other sign"),
        (scaled(57.2958, ALL, ANGLE, SPEED), "angles are in degrees"),
        (scaled(1000.0, ALL, TORQUE), "times what .* need; are they mN m, or mA for A"),
        (scaled(1000.0, [3], TORQUE), "the torques of joint 3 are .* mN m, or mA for A"),
        (scaled(0.01, ALL, TORQUE), "of the motors, before gears of a ratio of about (9|10)"),
    ],
)
def test_mistakes_are_named(stream, change, words):
    with pytest.raises(DataError, match=words):
        check(changed(stream, change))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (swapped(5, 6, TORQUE), "the torques of joints 5 and 6 are swapped"),
        (scaled(57.2958, ALL, ANGLE, SPEED), "angles are in degrees"),
    ],
)
def test_mistakes_are_named_without_inertias(stream, change, words):
    """No inertias at all explain them: only a scale of all torques is open."""
    with pytest.raises(DataError, match=words):
        check(changed(stream, change), with_inertias=False)


@pytest.mark.parametrize(
    ("seed", "motion", "with_inertias"),
    [
        (0, multi_sine, True),
        (1, slow_sweep, True),
        (1, multi_sine, False),
        slow(2, slow_sweep, False),
    ],
)
def test_right_recordings_pass(seed, motion, with_inertias):
    name = "ur10e" if seed % 2 else "ur5e"
    rng = np.random.default_rng(10 + seed)
    stream = record(real_dynamics(name, rng, stribeck=True), motion(6, rng), rng)
    check(stream, name, with_inertias=with_inertias)

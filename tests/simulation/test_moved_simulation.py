"""The simulated arm's own dynamics, against the robot model's and against mechanics."""

import numpy as np
import pytest
from support.moved_arms import robot_with_bodies

from visioncal.core.errors import DataError
from visioncal.robot import body_regressor, joint_torques
from visioncal.simulation.dynamics import (
    LinkBody,
    drive_torques,
    multi_sine,
    nominal_dynamics,
    real_dynamics,
    record,
    slow_sweep,
)


def states(seed=0):
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (3, 20, 6))


@pytest.mark.parametrize("name", ["ur5e", "ur10e"])
def test_two_recursions_agree(name):
    built = nominal_dynamics(name)
    robot = robot_with_bodies(built)
    ours = joint_torques(robot, robot.inertias, *states())
    # Two ways through the same sums: rounding on torques of up to 300 N m.
    assert drive_torques(built, *states()) == pytest.approx(ours, abs=1e-10)


def test_a_load_adds_what_a_body_on_the_flange_does():
    built = nominal_dynamics("ur10e")
    load = LinkBody(2.8, np.array([0.02, -0.01, 0.09]), np.diag([0.01, 0.012, 0.006]))
    robot = robot_with_bodies(built)
    kg, (x, y, z) = load.kg, load.centre_m
    about = load.inertia_kg_m2 + kg * (load.centre_m @ load.centre_m * np.eye(3))
    about -= kg * np.outer(load.centre_m, load.centre_m)
    six = about[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    parameters = np.array([kg, kg * x, kg * y, kg * z, *six])
    added = drive_torques(built.carrying(load), *states()) - drive_torques(built, *states())
    assert added == pytest.approx(body_regressor(robot, *states()) @ parameters, abs=1e-10)


def test_friction_brakes_and_a_hump_fades():
    gears = real_dynamics("ur5e", np.random.default_rng(1), stribeck=True).gears
    still = np.zeros((1, 6))
    fast = gears.torques(still + 2.0, still)[0]
    assert fast == pytest.approx(gears.coulomb + 2.0 * gears.viscous + gears.offset, rel=1e-12)
    begun = gears.torques(still - 1e-9, still)[0]
    assert begun == pytest.approx(gears.offset - gears.coulomb - gears.stribeck, rel=1e-6)


def test_real_arms_are_bodies_off_by_a_fifth():
    nominal = nominal_dynamics("ur5e").bodies
    off = []
    for seed in range(50):
        for body, published in zip(
            real_dynamics("ur5e", np.random.default_rng(seed)).bodies, nominal, strict=True
        ):
            main = np.linalg.eigvalsh(body.inertia_kg_m2)
            assert main[0] > 0.0
            assert main[2] < main[0] + main[1]
            off.append(np.log(body.kg / published.kg))
    # The standard deviation of 300 draws of 0.2 is known to 4 %.
    assert np.std(off) == pytest.approx(0.2, rel=0.15)


@pytest.mark.parametrize("motion", [multi_sine, slow_sweep])
def test_motions_are_their_own_derivatives(motion):
    done = motion(6, np.random.default_rng(2), seconds=10.0)
    step = done.times_s[1] - done.times_s[0]
    for value, slope in ((done.q, done.dq), (done.dq, done.ddq)):
        by_differences = (value[2:] - value[:-2]) / (2.0 * step)
        # Central differences over 2 ms of at most 0.5 Hz: a third derivative's 1e-5.
        assert by_differences == pytest.approx(slope[1:-1], abs=3e-5)


def test_recordings_have_the_noise_that_they_are_asked_for():
    rng = np.random.default_rng(3)
    built, done = real_dynamics("ur5e", rng), multi_sine(6, rng)
    stream = record(built, done, rng)
    true = drive_torques(built, done.q, done.dq, done.ddq)
    torques = np.stack([stream[f"tau{index}_nm"] for index in range(1, 7)], axis=1)
    noise = np.std(torques - true, axis=0) / np.sqrt(np.mean(true**2, axis=0))
    # The standard deviation of 10,000 draws is known to 0.7 %.
    assert noise == pytest.approx(np.full(6, 0.03), rel=0.03)


def test_unknown_arms_are_named():
    with pytest.raises(DataError, match="generic-6r-1800"):
        nominal_dynamics("generic-6r-1800")

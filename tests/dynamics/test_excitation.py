"""Exciting motions: their series, their criterion, their limits, against plain calculations."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from support.apart import clearances
from support.small_arm import small_arm

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose
from visioncal.dynamics import excitation
from visioncal.dynamics.base import BaseModel, smooth_condition
from visioncal.dynamics.excitation import ExcitationRequest, Harmonics, Objective, Series, excite
from visioncal.dynamics.limits import DefaultLimits, MotionMargins, motion_extremes, motion_limits
from visioncal.dynamics.model import DynamicModel, FrictionTerms, JointMotion
from visioncal.robot import Robot, joint_torques, load_robot
from visioncal.robot.collision import Body
from visioncal.simulation.arms import ur_arm

QUICK = ExcitationRequest(harmonics=4, starts=1, steps=20)


def some_series(joints: int = 3, seed: int = 0) -> Series:
    harmonics = Harmonics(12.0, 4)
    return Series(harmonics, np.random.default_rng(seed).normal(size=(joints, 7)))


def test_a_series_begins_and_ends_at_rest_where_it_began():
    motion = some_series().sampled(100.0)
    assert motion.times_s[[0, -1]].tolist() == [0.0, 12.0]
    assert np.abs(motion.q[0] - motion.q[-1]).max() < 1e-12
    assert np.abs(motion.q[0] - some_series().start).max() < 1e-12
    for rates in (motion.dq, motion.ddq):
        # Rounding of sums of some tens of terms of size 1.
        assert np.abs(rates[[0, -1]]).max() < 1e-12
        assert np.abs(rates).max() > 1.0


def test_speeds_and_accelerations_are_derivatives():
    motion = some_series().sampled(2000.0)
    for values, rates in ((motion.q, motion.dq), (motion.dq, motion.ddq)):
        jacobian = np.gradient(values, motion.times_s, axis=0)[1:-1]
        # Central differences err by a sixth of the third derivative times the squared step.
        assert np.abs(jacobian - rates[1:-1]).max() < 1e-5 * np.abs(rates).max()


def test_the_smooth_condition_tends_to_the_condition_and_knows_its_jacobian():
    rows = np.random.default_rng(2).normal(size=(30, 5)) * [1.0, 40.0, 0.1, 3.0, 1.0]
    unit = rows / np.linalg.norm(rows, axis=0)
    # A power mean of five values is within the fifth root's logarithm over the power of the most.
    value = smooth_condition(rows, 200.0)[0]
    assert value == pytest.approx(np.log(np.linalg.cond(unit)), abs=np.log(5) / 200.0)
    for sharpness in (1.0, 8.0):
        jacobian = smooth_condition(rows, sharpness)[1]
        flat = rows.ravel()
        for place in range(0, flat.size, 17):
            step = np.zeros(flat.size)
            step[place] = 1e-6 * max(abs(flat[place]), 0.01)
            ahead, behind = (
                smooth_condition((flat + array).reshape(rows.shape), sharpness)[0]
                for array in (step, -step)
            )
            numeric = (ahead - behind) / (2.0 * step[place])
            # Central differences at this step round at 1e-9 of the value over the step.
            assert jacobian.ravel()[place] == pytest.approx(numeric, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("far", [0.01, 0.5])
def test_the_objective_knows_its_jacobian(far):
    """Within the limits, and with all of them broken: ranges, rates, torques and distances."""
    centre = compose(np.eye(3), np.array([0.4, 0.0, 0.4]))
    post = Body("post", 0, "box", np.array([0.1, 0.1, 0.8]), centre)
    arm = small_arm(lower_deg=-100.0, upper_deg=100.0, torque_nm=40.0)
    allowed = motion_limits(arm, MotionMargins(), bodies=[post])
    base = BaseModel.reduce(DynamicModel(arm, FrictionTerms()))
    objective = Objective(allowed, base, np.array([1.0, 2.0, 3.0]), Harmonics(12.0, 4))
    series = some_series(seed=4)
    # Upright, with motions of a degree or of some tens of degrees.
    upright = np.outer([0.0, np.pi / 2.0, 0.0], series.harmonics.resting[0])
    free = (upright + far * series.free).ravel()
    price = 3.0
    broken = (objective.value(free, 4.0, price)[0] - objective.value(free, 4.0, 0.0)[0]) / price
    assert (broken == 0.0) if far < 0.1 else (broken > 1.0)

    def along(step: float) -> float:
        return objective.value(free + step * direction, 4.0, price)[0]

    jacobian = objective.value(free, 4.0, price)[1]
    for seed in range(3):
        direction = np.random.default_rng(seed).normal(size=free.size)
        numeric = (along(1e-5) - along(-1e-5)) / 2e-5
        # Forward differences with steps of 1e-6 in the regressor and 1e-5 in the distances.
        assert jacobian @ direction == pytest.approx(numeric, rel=2e-3, abs=1e-3)


@pytest.fixture(scope="module")
def ur5e() -> Robot:
    return load_robot("ur5e")


@pytest.fixture(scope="module")
def found(ur5e):
    return excite(motion_limits(ur5e, MotionMargins()), QUICK)


def test_a_found_motion_keeps_the_data_sheet_by_plain_differences(ur5e, found):
    """Limits at 1 kHz, from positions alone."""
    motion = found.series.sampled(1000.0)
    q, step = motion.q, 1e-3
    speed = np.diff(q, axis=0) / step
    hard = np.diff(q, 2, axis=0) / step**2
    margin = np.deg2rad(2.8)
    assert (q > ur5e.lower_rad + margin).all()
    assert (q < ur5e.upper_rad - margin).all()
    # Nine tenths of each; differences of doubles at 1 ms round at 1e-9 rad/s^2.
    assert (np.abs(speed).max(axis=0) <= 0.9 * np.pi).all()
    assert (np.abs(hard).max(axis=0) <= 0.9 * 10.0 + 1e-6).all()
    assert np.abs(speed[[0, -1]]).max() < 1e-4
    # The least distance of tubes, by golden sections; coal's may differ by its own 1e-6.
    apart = clearances(ur_arm("ur5e"), q[::5], 0.0, [])
    assert apart.min() > 0.03 - 1e-5
    assert found.extremes.clearance_m == pytest.approx(apart.min(), abs=1e-3)
    assert found.extremes.breaches == ()


def test_torques_have_room_for_wrong_inertias(ur5e, found):
    """By Pinocchio's recursion with bodies of its own, not by a regressor."""
    model, motion = pinocchio_with_bodies(ur5e), found.series.sampled(50.0)
    data = model.createData()
    states = zip(motion.q, motion.dq, motion.ddq, strict=True)
    torques = np.array([pin.rnea(model, data, *state).copy() for state in states])
    assert (1.2 * np.abs(torques).max(axis=0) <= ur5e.torque_nm).all()
    # At a twentieth of the samples the peaks are lower by their curvature.
    assert np.abs(torques).max(axis=0) == pytest.approx(found.extremes.torque, rel=0.01)


def pinocchio_with_bodies(robot: Robot) -> pin.Model:
    model = robot.pinocchio_model.copy()
    masses, about = robot.inertias.masses, robot.inertias.about_centres
    for place in range(robot.joint_count):
        body = pin.Inertia(masses.kg[place], masses.centres_m[place], about[place])
        model.inertias[place + 1] = body
    model.gravity.linear = robot.gravity
    return model


def test_a_short_search_already_beats_random_motions(found):
    """By singular values of the regressor, with columns that pivots of its own choose."""
    assert found.base.rank == 54
    rows = found.base.model.regressor(found.series.sampled(50.0)) * found.weights[:, None]
    rows = rows.reshape(-1, rows.shape[2])[:, found.base.independent]
    weighted = np.linalg.cond(rows / np.linalg.norm(rows, axis=0))
    # Other samples of the same motion.
    assert weighted == pytest.approx(found.condition, rel=0.02)
    assert found.condition < 0.8 * found.random
    assert found.starts == 1


@pytest.mark.slow
def test_a_slow_computer_finds_the_same_motion_unless_a_limit_of_time_is_wished(monkeypatch):
    allowed = motion_limits(small_arm(), MotionMargins())
    wished = replace(QUICK, steps=3, harmonics=3, starts=2)
    first = excite(allowed, wished)
    hours = itertools.count(step=3600.0)
    monkeypatch.setattr(excitation, "time", SimpleNamespace(process_time=lambda: next(hours)))
    slow = excite(allowed, wished)
    assert np.array_equal(first.series.free, slow.series.free)
    assert slow.starts == 2
    assert excite(allowed, replace(wished, seconds=60.0)).starts == 1


def breaking(kind: str) -> JointMotion:
    """A motion of the small arm that breaks one limit alone."""
    times = np.linspace(0.0, 1.0, 201)
    still = np.zeros((len(times), 3))
    q = still + np.array([0.0, np.pi / 2.0, 0.0])
    dq, ddq = still.copy(), still.copy()
    if kind == "position":
        q[100, 0] = 2.96
    elif kind == "speed":
        dq[50, 1] = -2.3
    elif kind == "acceleration":
        ddq[50, 0] = 7.3
    elif kind == "torque":
        q[70, 1], ddq[70, 1] = 0.0, 7.0
    elif kind == "floor":
        q[30] = [0.0, -1.2, 0.0]
    return JointMotion(times, q, dq, ddq)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("position", "position of joint_1 reaches 2.96 rad, 2.92 is allowed"),
        ("speed", "speed of joint_2 reaches 2.3 rad/s, 2.25 is allowed"),
        ("acceleration", "acceleration of joint_1 reaches 7.3 rad/s^2, 7.2 is allowed"),
        ("torque", "torque of joint_2 reaches"),
        ("floor", "floor and link joint_3 come to"),
    ],
)
def test_each_broken_limit_is_named(kind, words):
    allowed = motion_limits(small_arm(torque_nm=24.0), MotionMargins())
    assert motion_extremes(allowed, breaking("none")).breaches == ()
    breaches = motion_extremes(allowed, breaking(kind)).breaches
    assert len(breaches) == 1
    assert breaches[0].startswith(words)


def test_a_payload_counts_in_the_torques():
    arm, motion = small_arm(), breaking("none")
    motion.q[:, 1] = 0.0
    body = np.array([2.0, *(2.0 * np.array([0.0, 0.0, 0.1])), 0.02, 0.0, 0.02, 0.0, 0.0, 0.0])
    bare = motion_limits(arm, MotionMargins()).torques(motion)
    loaded = motion_limits(arm, MotionMargins(), payload=body).torques(motion)
    # Two kilograms at the end of 0.65 m, stretched out level.
    more = np.abs(loaded - bare)[0, 1]
    assert more == pytest.approx(2.0 * 9.80665 * 0.65, rel=1e-9)
    assert (
        np.abs(bare - joint_torques(arm, arm.inertias, motion.q, motion.dq, motion.ddq)).max() == 0
    )


def test_without_inertias_the_torques_are_not_checked_and_that_is_said():
    allowed = motion_limits(
        small_arm(mass_kg=None, com_m=None, inertia_kg_m2=None), MotionMargins()
    )
    assert "no inertias" in allowed.unchecked[0]
    quick = replace(QUICK, steps=2, harmonics=3)
    found = excite(allowed, quick)
    assert found.extremes.torque is None
    assert "torque" not in found.extremes.shares
    unknown = motion_limits(small_arm(torque_nm=None), MotionMargins())
    assert "joint_1, joint_2, joint_3" in unknown.unchecked[0]
    assert motion_limits(small_arm(), MotionMargins()).unchecked == ()


# A joint that turns without end, and in whose URDF nobody can write an acceleration.
ENDLESS = """<robot name="endless"><link name="base"/><link name="tool0"/>
<joint name="wheel" type="continuous"><parent link="base"/><child link="tool0"/>
<origin xyz="0 0 0.5"/><axis xyz="0 0 1"/><limit effort="10" velocity="2"/></joint></robot>"""


@pytest.mark.parametrize(
    ("robot", "joints", "option"),
    [
        (small_arm(velocity_rad_s=None), "speed for joint_1, joint_2, joint_3", "--speed-deg"),
        (small_arm(acceleration_rad_s2=None), "acceleration for joint_1", "--acceleration-deg"),
        (
            Robot.from_document({"schema": 1, "name": "endless", "urdf": ENDLESS}),
            "positions for wheel",
            "--range-deg",
        ),
    ],
)
def test_missing_limits_are_named_and_can_be_given(robot, joints, option):
    with pytest.raises(DataError, match=joints) as told:
        motion_limits(robot, MotionMargins())
    assert option in told.value.next_step
    given = motion_limits(robot, MotionMargins(), missing=DefaultLimits(2.0, 1.0, 3.0))
    expected = {
        "--range-deg": (given.upper, 2.0 - 0.05),
        "--speed-deg": (given.speed, 0.9 * 1.0),
        "--acceleration-deg": (given.acceleration, 0.9 * 3.0),
    }
    values, wanted = expected[option]
    assert values == pytest.approx(np.full(robot.joint_count, wanted))


@pytest.mark.slow
def test_limits_that_leave_nothing_are_named():
    with pytest.raises(DataError, match=r"joint_1 10\.0 deg are left"):
        motion_limits(small_arm(lower_deg=-5.0, upper_deg=5.0), MotionMargins(margin_rad=0.2))
    flooded = motion_limits(small_arm(), MotionMargins(floor_m=2.0))
    with pytest.raises(DegenerateError, match="none of 2000 postures") as told:
        excite(flooded, QUICK)
    assert "floor" in told.value.culprits
    # Level within 20 degrees, its second joint holds more than 8 N m; upright it would hold none.
    weak = motion_limits(small_arm(torque_nm=8.0, lower_deg=-20.0, upper_deg=20.0), MotionMargins())
    with pytest.raises(DegenerateError, match="torque of joint_2"):
        excite(weak, replace(QUICK, harmonics=3))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"period_s": 4.0}, "4 s is too short; 10 to 30 s"),
        ({"period_s": 60.0}, "60 s is too long"),
        ({"harmonics": 2}, "2 harmonics"),
        ({"seconds": -1.0}, "-1 s from"),
        ({"seconds": float("nan")}, "nan s from"),
        ({"starts": 0}, "from 0 starts"),
    ],
)
def test_wishes_that_make_no_sense_are_refused(wrong, words):
    with pytest.raises(DataError, match=words):
        ExcitationRequest(**wrong)
    with pytest.raises(DataError, match=r"speed is 1\.5"):
        MotionMargins(speed=1.5)

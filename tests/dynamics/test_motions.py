"""Exciting motions and sweeps against plain calculations, and `visioncal dynamics plan`."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tomli_w
from support.apart import clearances
from support.commands import visioncal
from support.refusals import raised

from visioncal.cli import dynamics
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose
from visioncal.dynamics.base import BaseModel, smooth_condition
from visioncal.dynamics.excitation import ExcitationRequest, Harmonics, Objective, Series, excite
from visioncal.dynamics.limits import DefaultLimits, MotionMargins, motion_extremes, motion_limits
from visioncal.dynamics.model import DynamicModel, FrictionTerms, JointMotion
from visioncal.dynamics.sweeps import Stroke, SweepRequest, plan_sweeps
from visioncal.robot import Robot, load_robot
from visioncal.robot.collision import Body
from visioncal.robot.torques import joint_torques
from visioncal.simulation.arms import arm_named

pytestmark = pytest.mark.usefixtures("strict_rerun")

RATES = {"velocity_rad_s": 2.5, "acceleration_rad_s2": 8.0, "torque_nm": 60.0}


def small_document(**changed: Any) -> dict[str, Any]:
    """Its description; of every joint, what is None is left out."""
    shapes = [(0.0, 1.5707963267948966, 0.3), (0.35, 0.0, 0.0), (0.3, 0.0, 0.0)]
    joints = []
    for place, (a, alpha, d) in enumerate(shapes):
        row = {
            "name": f"joint_{place + 1}",
            "a_m": a,
            "alpha_rad": alpha,
            "d_m": d,
            "lower_deg": -170.0,
            "upper_deg": 170.0,
            "mass_kg": 4.0 - place,
            "com_m": [-0.4 * a, 0.02, 0.01],
            "inertia_kg_m2": [0.01, 0.001, 0.03, 0.0, 0.002, 0.03],
            **RATES,
        }
        joints.append({key: value for key, value in (row | changed).items() if value is not None})
    return {"schema": 1, "name": "small", "tip": "tool0", "convention": "standard", "joint": joints}


def small_arm(**changed: Any) -> Robot:
    """The arm."""
    return Robot.from_document(small_document(**changed))


QUICK = ExcitationRequest(harmonics=4, starts=1, steps=20)


def some_series(joints=3, seed=0):
    harmonics = Harmonics(12.0, 4)
    return Series(harmonics, np.random.default_rng(seed).normal(size=(joints, 7)))


def test_a_series_begins_and_ends_at_rest_and_knows_its_derivatives():
    motion = some_series().sampled(2000.0)
    assert motion.times_s[[0, -1]].tolist() == [0.0, 12.0]
    # Rounding of sums of some tens of terms of size 1.
    assert np.abs(motion.q[[0, -1]] - some_series().start).max() < 1e-12
    assert np.abs([motion.dq[[0, -1]], motion.ddq[[0, -1]]]).max() < 1e-12
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

    def along(step):
        return objective.value(free + step * direction, 4.0, price)[0]

    jacobian = objective.value(free, 4.0, price)[1]
    for seed in range(3):
        direction = np.random.default_rng(seed).normal(size=free.size)
        numeric = (along(1e-5) - along(-1e-5)) / 2e-5
        # Forward differences with steps of 1e-6 in the regressor and 1e-5 in the distances.
        assert jacobian @ direction == pytest.approx(numeric, rel=2e-3, abs=1e-3)


@pytest.fixture(scope="module")
def ur5e():
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
    apart = clearances(arm_named("ur5e"), q[::20], 0.0, [])
    assert apart.min() > 0.03 - 1e-5
    assert found.extremes.clearance_m == pytest.approx(apart.min(), abs=1e-3)
    assert found.extremes.breaches == ()


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


def breaking(kind):
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
    assert option in raised(DataError, joints, motion_limits, robot, MotionMargins()).next_step
    given = motion_limits(robot, MotionMargins(), missing=DefaultLimits(2.0, 1.0, 3.0))
    expected = {
        "--range-deg": (given.upper, 2.0 - 0.05),
        "--speed-deg": (given.speed, 0.9 * 1.0),
        "--acceleration-deg": (given.acceleration, 0.9 * 3.0),
    }
    values, wanted = expected[option]
    assert values == pytest.approx(np.full(robot.joint_count, wanted))


TABLES = {"excitation.csv", "sweeps.csv", "plan.json", "plan.rrd"}


@pytest.fixture(scope="module")
def sweeps():
    post = Body(
        "post", 0, "box", np.array([0.1, 0.1, 0.8]), compose(np.eye(3), np.array([0.5, 0.2, 0.4]))
    )
    return plan_sweeps(
        motion_limits(load_robot("ur5e"), MotionMargins(), bodies=[post]), SweepRequest(speeds=4)
    )


def test_a_stroke_is_a_ramp_constant_speed_and_a_ramp():
    stroke = Stroke(0, 1.0, -0.5, 0.6, 0.4, sweeps=True)
    times = np.linspace(0.0, stroke.duration_s, 20001)
    position, speed, acceleration = stroke.at(times)
    assert position[[0, -1]] == pytest.approx([1.0, -0.5], abs=1e-12)
    assert np.abs([speed[[0, -1]], acceleration[[0, -1]]]).max() < 1e-9
    steady = (times > 0.4) & (times < stroke.duration_s - 0.4)
    assert steady.mean() == pytest.approx(1.0 - 0.8 / 2.9, abs=1e-3)
    assert speed[steady] == pytest.approx(-0.6)
    assert np.abs(speed).max() < 0.6 + 1e-12
    # Central differences at 0.15 ms, where the third derivative is below 25 rad/s^3.
    assert np.abs(np.gradient(position, times)[1:-1] - speed[1:-1]).max() < 1e-6
    assert np.abs(np.gradient(speed, times)[1:-1] - acceleration[1:-1]).max() < 3e-3
    # After its end it rests.
    assert np.abs(stroke.at(np.array([9.0]))[0] + 0.5).max() < 1e-12


def test_sweeps_move_one_joint_at_a_time_within_all_limits(sweeps):
    motion = sweeps.sampled(250.0)
    assert ((np.abs(motion.dq) > 1e-9).sum(axis=1) <= 1).all()
    assert motion.q[0] == pytest.approx(sweeps.home)
    assert motion.q[-1] == pytest.approx(sweeps.home, abs=1e-12)
    differences = np.diff(motion.q, axis=0) * 250.0
    assert (np.abs(differences).max(axis=0) <= 0.9 * np.pi).all()
    assert (np.abs(np.diff(differences, axis=0) * 250.0).max(axis=0) <= 9.0 + 1e-6).all()
    pose = compose(np.eye(3), np.array([0.5, 0.2, 0.4]))
    apart = clearances(arm_named("ur5e"), motion.q[::10], 0.0, [(pose, np.array([0.1, 0.1, 0.8]))])
    assert apart.min() > 0.03 - 1e-5
    assert sweeps.extremes.breaches == ()
    assert sweeps.left_out == ()


def test_every_joint_sweeps_over_the_same_place_in_both_directions_at_every_speed(sweeps):
    for joint in range(6):
        strokes = [stroke for stroke in sweeps.strokes if stroke.sweeps and stroke.joint == joint]
        forth, back = strokes[::2], strokes[1::2]
        speeds = [value.speed for value in forth]
        assert speeds == sorted(speeds)
        assert len(speeds) == 4
        assert speeds[0] == pytest.approx(0.02)
        assert speeds[-1] > 1.0
        for one, other in zip(forth, back, strict=True):
            assert (one.begin, one.end, one.speed) == (other.end, other.begin, other.speed)
            # Besides its ramps it holds its speed for some time.
            assert abs(one.end - one.begin) / one.speed - one.ramp_s > 0.39


def test_joints_without_room_are_left_out_and_named():
    document = small_document()
    document["joint"][1] |= {"lower_deg": 80.0, "upper_deg": 96.0}
    arm = type(small_arm()).from_document(document)
    found = plan_sweeps(motion_limits(arm, MotionMargins()), SweepRequest(speeds=2))
    assert found.left_out == ("joint_2",)
    assert {stroke.joint for stroke in found.strokes} == {0, 2}
    with pytest.raises(DegenerateError, match="no posture was found"):
        plan_sweeps(motion_limits(arm, MotionMargins(floor_m=2.0)), SweepRequest())
    raised(DataError, "speeds is 1, but must be", SweepRequest, speeds=1)


@pytest.fixture
def quick(monkeypatch):
    """Searches a little only: what is written does not depend on how good it is."""

    def short(allowed, request, progress):
        return excite(allowed, replace(request, steps=4), progress)

    monkeypatch.setattr(dynamics, "excite", short)


def plan(robot, out, *more):
    return visioncal("dynamics", "plan", robot, "-o", out, "--starts", 1, *more)


def table(path):
    head = path.read_text().partition("\n")[0].split(",")
    return head, np.loadtxt(path, delimiter=",", skiprows=1)


def small_file(folder):
    path = folder / "small.toml"
    path.write_text(tomli_w.dumps(small_document()))
    return path


@pytest.mark.usefixtures("quick")
def test_a_plan_has_tables_a_preview_and_all_of_it_as_json(tmp_path):
    out = tmp_path / "größer"
    done = plan(
        "ur5e", out, "--rate", 100, "--harmonics", 3, "--duration", 12, "--sweep-speeds", 2
    ).good()
    assert {path.name for path in out.iterdir()} == TABLES
    assert "for 54 base parameters (random motions:" in done.out
    assert "warning" not in done.out
    document = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    found = document["excitation"]
    assert len(found["base_parameters"]) == 54
    assert min(found["condition"], found["condition_random"]) > 1.0
    assert max(found["kept"]["share_of_allowed"]["torque"]) <= 1.0
    head, rows = table(out / "excitation.csv")
    assert head[:2] == ["stamp_s", "q1_rad"]
    assert head[7] == "dq1_rad_s"
    assert head[-1] == "ddq6_rad_s2"
    assert rows[:, 0] == pytest.approx(np.arange(1201) / 100.0)
    # The series as it is written down gives the table.
    phases = 2.0 * np.pi / 12.0 * rows[:, :1] * np.arange(1, 4)
    q = (
        np.array(found["mean_rad"])
        + np.sin(phases) @ np.transpose(found["sine_rad"])
        + np.cos(phases) @ np.transpose(found["cosine_rad"])
    )
    # Ten digits are written.
    assert np.abs(q - rows[:, 1:7]).max() < 1e-8
    strokes = document["sweeps"]["strokes"]
    assert len(strokes) == 6 * 2 * 2
    swept = table(out / "sweeps.csv")[1]
    fast = strokes[-1]
    middle = fast["begin_s"] + 0.5 * fast["duration_s"]
    row = swept[np.abs(swept[:, 0] - middle).argmin()]
    assert abs(row[6 + fast["joint"]]) == pytest.approx(fast["speed_rad_s"])


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_tables_of_an_earlier_plan_are_taken_away(tmp_path):
    out = tmp_path / "motions"
    out.mkdir()
    for name in ("sweeps.csv", "notes.txt"):
        (out / name).write_text("old")
    done = plan(small_file(tmp_path), out, "--no-sweeps", "--harmonics", 3, "--json").good()
    assert {path.name for path in out.iterdir()} == {
        "excitation.csv",
        "plan.json",
        "plan.rrd",
        "notes.txt",
    }
    document = json.loads(done.out)
    assert document == json.loads((out / "plan.json").read_text(encoding="utf-8"))
    assert "sweeps" not in document
    assert "null" not in done.out


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_checks_that_are_impossible_are_named(tmp_path):
    document = small_document(inertia_kg_m2=None)
    path = tmp_path / "light.toml"
    path.write_text(tomli_w.dumps(document))
    done = plan(path, tmp_path / "out", "--no-sweeps", "--harmonics", 3).good()
    assert "warning: not checked: torques: the description of small states no inertias" in done.out
    written = json.loads((tmp_path / "out" / "plan.json").read_text(encoding="utf-8"))
    assert "states no inertias" in written["not_checked"][0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--duration", 3), "a motion of 3 s is too short"),
        (("--duration", 60), "60 s is too long"),
        (("--harmonics", 2), "harmonics is 2, but must be"),
        (("--friction", "coulomb,stiction"), "--friction names stiction"),
        (("--payload", "2,0,0"), "--payload is '2,0,0', but must be kg,x,y,z"),
        (("--payload", "-2,0,0,0"), "a mass of 0 kg or more"),
        (("--tool", "100,0"), "a length and a radius above zero"),
        (("--speed-deg", -5), "--speed-deg"),
        (("--speed", 2), "speed is 2.0, but must be a number from 0.01 to 1"),
        (("--floor", 1900), "no posture was found from which its joints could sweep"),
        (("--floor", 1900, "--no-sweeps"), "none of 2000 postures within the limits is clear"),
    ],
)
def test_wrong_options_end_with_status_2_and_no_folder(options, words, tmp_path):
    out = tmp_path / "out"
    plan("ur5e", out, *options).refused(words)
    assert not out.exists()

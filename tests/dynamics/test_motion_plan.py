"""Sweeps and files of a plan of motions, and `visioncal dynamics plan` as it is run."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import tomli_w
from support.apart import clearances
from support.commands import Done, visioncal
from support.drawn import column
from support.small_arm import small_arm, small_document

from visioncal.cli import dynamics
from visioncal.cli.show import find_recording
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose
from visioncal.dynamics.excitation import excite
from visioncal.dynamics.limits import MotionMargins, motion_limits
from visioncal.dynamics.sweeps import Stroke, SweepRequest, Sweeps, plan_sweeps
from visioncal.present.recording import paths
from visioncal.robot import load_robot
from visioncal.robot.collision import Body
from visioncal.simulation.arms import ur_arm

TABLES = {"excitation.csv", "sweeps.csv", "plan.json", "plan.rrd"}


@pytest.fixture(autouse=True)
def strict_rerun():
    """Turns rerun's warnings, which it prints and forgets, into errors."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="module")
def sweeps() -> Sweeps:
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
    apart = clearances(ur_arm("ur5e"), motion.q[::10], 0.0, [(pose, np.array([0.1, 0.1, 0.8]))])
    assert apart.min() > 0.03 - 1e-5
    assert sweeps.extremes.breaches == ()
    assert sweeps.left_out == ()


def test_every_joint_sweeps_over_the_same_place_in_both_directions_at_every_speed(sweeps):
    for joint in range(6):
        own = [stroke for stroke in sweeps.strokes if stroke.sweeps and stroke.joint == joint]
        there, back = own[::2], own[1::2]
        speeds = [value.speed for value in there]
        assert speeds == sorted(speeds)
        assert len(speeds) == 4
        assert speeds[0] == pytest.approx(0.02)
        assert speeds[-1] > 1.0
        for one, other in zip(there, back, strict=True):
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
    with pytest.raises(DataError, match="1 speeds"):
        SweepRequest(speeds=1)


@pytest.fixture
def quick(monkeypatch):
    """Searches a little only: what is written does not depend on how good it is."""

    def short(allowed, request, progress):
        return excite(allowed, replace(request, steps=4), progress)

    monkeypatch.setattr(dynamics, "excite", short)


def plan(robot: object, out: Path, *more: object) -> Done:
    return visioncal("dynamics", "plan", robot, "-o", out, "--starts", 1, *more)


def table(path: Path) -> tuple[list[str], np.ndarray]:
    head = path.read_text().partition("\n")[0].split(",")
    return head, np.loadtxt(path, delimiter=",", skiprows=1)


def small_file(folder: Path) -> Path:
    path = folder / "small.toml"
    path.write_text(tomli_w.dumps(small_document()))
    return path


@pytest.mark.usefixtures("quick")
def test_a_plan_has_tables_a_preview_and_all_of_it_as_json(tmp_path):
    out = tmp_path / "größer"
    done = plan("ur5e", out, "--rate", 100, "--harmonics", 3, "--duration", 12, "--sweep-speeds", 2)
    assert done.status == 0, done.err
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
def test_a_preview_moves_the_arm_and_draws_its_curves(tmp_path):
    done = plan(
        small_file(tmp_path), tmp_path, "--harmonics", 3, "--box", "post:900,0,100:100,100,200"
    )
    assert done.status == 0, done.err
    file = find_recording(tmp_path)
    assert file.name == "plan.rrd"
    torques = column(file, f"{paths.MOTION}/torque_nm", "Scalars:scalars", paths.MOTION_TIMELINE)
    # Twenty samples a second, and then the sweeps.
    assert len(torques) > 400
    assert {len(torque) for torque in torques.values()} == {3}
    links = column(file, f"{paths.ROBOT}/links", "Capsules3D:translations", paths.MOTION_TIMELINE)
    assert set(links) == set(torques)
    assert column(file, f"{paths.OBSTACLES}/box_1", "Boxes3D:labels")


@pytest.mark.usefixtures("quick")
def test_tables_of_an_earlier_plan_are_taken_away(tmp_path):
    out = tmp_path / "motions"
    out.mkdir()
    for name in ("sweeps.csv", "notes.txt"):
        (out / name).write_text("old")
    done = plan(small_file(tmp_path), out, "--no-sweeps", "--harmonics", 3, "--json")
    assert done.status == 0, done.err
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


@pytest.mark.usefixtures("quick")
def test_what_cannot_be_checked_is_said(tmp_path):
    document = small_document(inertia_kg_m2=None)
    path = tmp_path / "light.toml"
    path.write_text(tomli_w.dumps(document))
    done = plan(path, tmp_path / "out", "--no-sweeps", "--harmonics", 3)
    assert done.status == 0, done.err
    assert "warning: not checked: torques: the description of small states no inertias" in done.out
    written = json.loads((tmp_path / "out" / "plan.json").read_text(encoding="utf-8"))
    assert "states no inertias" in written["not_checked"][0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--duration", 3), "a motion of 3 s is too short"),
        (("--friction", "coulomb,stiction"), "--friction names stiction"),
        (("--payload", "2,0,0"), "--payload is '2,0,0'; kg,x,y,z is needed"),
        (("--payload", "-2,0,0,0"), "a mass of 0 kg or more"),
        (("--tool", "100,0"), "a length and a radius above zero"),
        (("--speed-deg", -5), "--speed-deg"),
        (("--speed", 2), "speed is 2.0; 0.01 to 1 is needed"),
        (("--floor", 1900), "no posture was found from which its joints could sweep"),
        (("--floor", 1900, "--no-sweeps"), "none of 2000 postures within the limits is clear"),
    ],
)
def test_wrong_wishes_end_with_status_2_and_no_folder(options, words, tmp_path):
    out = tmp_path / "out"
    done = plan("ur5e", out, *options)
    assert done.status == 2
    assert words in " ".join(done.err.split())
    assert not out.exists()

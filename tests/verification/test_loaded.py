"""Stiffness from loads: at one pose against an unloaded arm, and where weight is compensated."""

from dataclasses import replace

import numpy as np
import pytest
from support.commands import visioncal as command
from support.refusals import raised

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.robot import Robot, load_robot
from visioncal.simulation.arms import Payload, arm_named
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    random_postures,
    session_of,
    tracked,
)
from visioncal.verification.loaded import calibrate_loaded

ARM = "generic-6r-1800"
# The brief's shoulder and elbow, and others of a medium arm [N m/rad].
STIFF = np.array([3e6, 1.4e6, 9e5, 3e5, 3e5, 2e5])
FORCES = tuple(Payload(force_n=(0.0, 0.0, -newtons)) for newtons in (10.0, 20.0, 50.0))
SHOP = InstrumentOptions(
    robot=ARM, dh_sigma_m=5e-4, dh_sigma_rad=5e-4, compliance_rad_per_nm=tuple(1.0 / STIFF)
)
# The arm is stretched out nearly horizontally.
FLAT = np.array([[0.3, 1.2, -1.0, 0.2, 0.4, 0.1]])


@pytest.fixture(scope="module")
def unloaded():
    return calibrate(session_of(tracked(replace(SHOP, seed=4)), name="unloaded"))


def loaded(*payloads: Payload, options=SHOP, q=FLAT, seed=4):
    shop = replace(options, payloads=payloads or FORCES, seed=seed)
    return session_of(tracked(shop, np.repeat(q, len(shop.payloads), axis=0)), name="loaded")


def off_in_sigmas(result) -> np.ndarray:
    springs = result.elastic.joints
    found = np.array([spring.compliance_rad_per_nm for spring in springs])
    return (found - 1.0 / STIFF) / np.array([spring.sigma_rad_per_nm for spring in springs])


@pytest.mark.slow
def test_three_forces_at_one_pose_show_shoulder_and_elbow(unloaded):
    result = calibrate_loaded(loaded(), unloaded)
    _, shoulder, elbow, *wrist = result.elastic.joints
    assert (np.abs(off_in_sigmas(result)[1:3]) < 3.0).all()
    assert shoulder.stiffness_sigma_nm_per_rad < 0.03 * STIFF[1]
    assert elbow.determined
    assert [spring.joint for spring in wrist if not spring.determined] == [
        "joint_4",
        "joint_6",
    ] or ("joint_6" in result.elastic.not_determined)
    words = result.verdict.findings[0].words
    assert "10 to 50 N move the tip by" in words
    assert "joint_6 (no moment reaches it)" in words
    # Forces are stated, and no payload is.
    conditions = " ".join(condition.sentence for condition in result.conditions)
    assert "under the 10 to 50 N of the stops" in conditions
    assert "kg of the stops" not in conditions


@pytest.mark.slow
def test_loads_alone_show_the_stiffness_of_an_arm_whose_weight_is_compensated():
    options = replace(SHOP, weight_compensated=True, robot_sigma_rad=3e-6, robot_sigma_m=3e-6)
    before = calibrate(session_of(tracked(replace(options, seed=1))))
    assert before.elastic is None
    once = calibrate_loaded(loaded(options=options, seed=1), before)
    # What its own weight bends is in the geometry.
    assert once.calibrated_robot.weight_compensated
    more = calibrate_loaded(loaded(*FORCES, *FORCES, *FORCES, options=options, seed=1), before)
    for result in (once, more):
        assert (np.abs(off_in_sigmas(result)[1:3]) < 3.0).all()
    sigmas = [result.elastic.joints[1].sigma_rad_per_nm for result in (once, more)]
    assert sigmas[1] < sigmas[0]
    # The unloaded arm's error at that posture would count twice.
    raised(DataError, "stiffness of earlier loads", calibrate_loaded, loaded(seed=1), once)
    # Of another arm, which no stiffness explains.
    other = calibrate_loaded(loaded(options=options, seed=2), before)
    assert other.verdict.status == "bad"


@pytest.mark.slow
def test_half_of_a_load_is_named_and_hidden_joints_have_no_bounds(unloaded):
    heavy = tuple(Payload(force_n=(0.0, 0.0, -newtons)) for newtons in (200.0, 500.0, 800.0))
    session = loaded(*heavy)
    sound = calibrate_loaded(session, unloaded)
    assert sound.verdict.status != "bad"
    springs = dict(zip(sound.elastic.joints, 1.0 / STIFF, strict=True))
    for spring, true in springs.items():
        words = sound.verdict.findings[0].words.partition(f"{spring.joint} (over ")[2]
        assert not words or 1e3 * float(words.split()[0]) < 1.0 / true
    half = [
        replace(view, numbers=dict(view.numbers) | {"force_z_n": 0.5 * view.numbers["force_z_n"]})
        for view in session.views
    ]
    result = calibrate_loaded(replace(session, views=tuple(half)), unloaded)
    finding = next(at for at in result.verdict.findings if at.kind == "loads_misfit")
    factor = float(finding.words.partition("Loads about ")[2].split()[0])
    # The unloaded arm's own weight shows its compliances to a tenth.
    assert factor == pytest.approx(2.0, rel=0.1)
    assert "Weigh the loads" in finding.do.words


def test_a_sighting_pushed_aside_under_a_load_is_named(unloaded):
    moved = tracked(replace(SHOP, payloads=FORCES, seed=4), np.repeat(FLAT, 3, axis=0))
    rows = []
    for stop, point, read in moved.rows:
        away = read.copy()
        away[:3, 3] += [0.0, 3e-3, 0.0]  # The tracker was pushed aside.
        rows.append((stop, point, away))
    result = calibrate_loaded(session_of(replace(moved, rows=tuple(rows))), unloaded)
    assert result.verdict.status == "bad"
    assert "No stiffness explains the readings" in result.verdict.findings[1].words
    nothing = session_of(tracked(SHOP, FLAT))
    raised(DataError, "states no load", calibrate_loaded, nothing, unloaded)
    seen = replace(unloaded, mount="eye-to-hand")
    raised(DataError, "of a camera", calibrate_loaded, loaded(), seen)


@pytest.mark.slow
@pytest.mark.parametrize("compensated", [True, False])
def test_loads_show_whether_the_arms_weight_bends_it(compensated):
    """Controllers of KUKA and ABB compensate it: its stiffness was once denied there."""
    q = np.repeat(random_postures(arm_named(ARM), 20, np.random.default_rng(5)), 2, axis=0)
    options = replace(SHOP, weight_compensated=compensated, payloads=(Payload(), FORCES[2]), seed=5)
    result = calibrate(session_of(tracked(options, q)))
    assert result.elastic is not None
    assert result.elastic.weight.startswith("compensated" if compensated else "of the model")
    assert abs(off_in_sigmas(result)[1]) < 3.0
    said = any("controller compensates" in each.words for each in result.verdict.findings)
    assert said == compensated
    again = Robot.from_document(result.calibrated_robot.document)
    assert again.weight_compensated == compensated
    assert again.masses is not None


@pytest.mark.slow
def test_twelve_stops_under_payloads_reject_no_sound_view():
    payloads = tuple(Payload(kg, (0.0, 0.0, 0.1)) for kg in (1.0, 2.0, 5.0))
    result = calibrate(session_of(tracked(replace(SHOP, payloads=payloads, stops=12, seed=1))))
    assert [view.view for view in result.views if not view.used] == []


def test_an_arm_whose_weight_is_compensated_bends_by_its_load_alone():
    robot = load_robot(ARM).with_weight_compensated
    q = np.array([[0.1, 0.5, -0.4, 0.3, 0.2, 0.0]])
    assert not robot.load_torques(q).any()
    assert robot.gravity_torques(q).any()
    assert robot.corrected().weight_compensated


def test_the_command_writes_beside_and_never_over_the_unloaded_arm(tmp_path, unloaded):
    loaded().save(tmp_path / "loaded")
    first = tmp_path / "first out"
    first.mkdir()
    # Its steps name it, as those of a calibration by a command do.
    verdict = unloaded.verdict.with_paths(tmp_path / "unloaded", first)
    replace(unloaded, verdict=verdict).save(first / "calibration.json")
    words = ("calibrate", tmp_path / "loaded", "--against", first, "-o")
    command(*words, first).refused("is the calibration of the unloaded arm itself")
    done = command(*words, tmp_path / "stiff").good()
    assert "joint_2" in done.out
    # Steps are taken with the stiffness just found.
    assert f"correct targets.csv --against {tmp_path / 'stiff'}" in done.out
    assert "10 to 50 N" in (tmp_path / "stiff" / "report.html").read_text()

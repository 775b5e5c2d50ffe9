"""Exports of the calibrated arm: what is read back is calibration.base_from_flange."""

import json
import re
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import yaml
from support.arm_documents import arm_of
from support.commands import visioncal
from support.placed import alone, tool
from support.readers import ARM_FORMATS, rx, ry, rz, transform
from support.samples import made_up
from support.urdf_arm import URDF, of_urdf, some_changes, some_joints

from visioncal.core.choices import CONVENTIONS
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.interchange.exports import Selection, document, export
from visioncal.interchange.result_files import load_result_or_frames
from visioncal.results.arm import (
    ArmResult,
    ElasticResult,
    JointRange,
    JointSpring,
    Sag,
    WorkspaceSigma,
)
from visioncal.robot import Robot, load_robot
from visioncal.robot.writing import without_functions
from visioncal.session import Session

SAMPLE = made_up(5).calibration
SIGMA = WorkspaceSigma(0.123, 0.345)


def calibrated(nominal, *, waves=False, **changes):
    """A calibration whose arm is off its nominal one by some mm and mrad."""
    placements, functions = some_changes(nominal)
    if not waves:
        functions[:, 1:] = 0.0
    arm = nominal.corrected(placements, functions)
    found = arm_of(arm, workspace_sigma_mm=SIGMA)
    return replace(SAMPLE, robot=nominal, arm=found, **changes)


def poses(calibration):
    """Random joint angles, and where the calibrated arm's flange is [m]."""
    q = some_joints(calibration.robot, 50)
    return q, calibration.base_from_flange(q).as_matrix()


def read_back(tmp_path, name, text, tip=None):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return load_robot(str(path), tip)


def of_urdf_text(text, tip):
    return Robot.from_document({"schema": 1, "name": "x", "tip": tip, "urdf": text})


def off(robot, calibration):
    q, expected = poses(calibration)
    return float(np.abs(robot.base_from_flange(q) - expected).max())


# All but rounding of lengths of a metre over some ten products; nine digits are a nanometre.
EXACT = 1e-9


@pytest.mark.parametrize("name", ["ur5e", "ur10e", "irb120", "panda"])
def test_a_urdf_is_the_calibrated_arm(tmp_path, name):
    result = calibrated(load_robot(name))
    text = export(result, "robot-urdf")
    tip = result.robot.tip
    assert off(of_urdf_text(text, tip), result) < EXACT
    assert off(read_back(tmp_path, "arm.urdf", text, tip), result) < EXACT


@pytest.mark.parametrize("tip", ["flange", "mount", "bend"])
def test_a_given_urdf_keeps_all_but_its_origins(tip):
    result = calibrated(of_urdf(tip))
    found = document(result, "robot-urdf")
    # A moving joint cannot place the tip behind it, which is then said.
    held = f"{tip}_corrected" if tip == "bend" else tip
    assert off(of_urdf_text(found.text, held), result) < EXACT
    assert [held in warning for warning in found.warnings] == [True] * (held != tip)
    before, after = ET.fromstring(URDF), ET.fromstring(found.text)
    added = 1 if tip == "bend" else 0
    for kind in ("link", "joint", "transmission"):
        there = [element.get("name") for element in after.findall(kind)]
        extra = added if kind in ("link", "joint") else 0
        assert there[: len(there) - extra] == [
            element.get("name") for element in before.findall(kind)
        ]


@pytest.mark.parametrize("convention", [None, *CONVENTIONS])
def test_a_table_is_the_calibrated_arm(tmp_path, convention):
    result = calibrated(load_robot("ur5e"))
    found = document(result, "robot-dh", Selection(convention=convention))
    assert off(read_back(tmp_path, "arm.toml", found.text), result) < EXACT
    # A UR's parallel axes get Hayati's form where nothing was said.
    assert tomllib.loads(found.text)["convention"] == (convention or "hayati")


def test_a_table_of_an_arm_without_parallel_axes_stays_in_its_form():
    result = calibrated(load_robot("panda"))
    assert tomllib.loads(export(result, "robot-dh"))["convention"] == "modified"


def of_rpy(roll, pitch, yaw):
    return rz(yaw) @ ry(pitch) @ rx(roll)


def ur_description(content):
    """The arm as urdf/ur_macro.xacro builds it of the file: placements, and joints about z."""
    links = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
    assert list(content) == [*links, "hash"]
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    assert all(tuple(content[link]) == keys for link in links)
    placed = [[content[link][key] for key in keys] for link in links]
    return [transform(of_rpy(*group[3:]), group[:3]) for group in placed]


def test_urs_kinematics_are_the_calibrated_arm():
    result = calibrated(load_robot("ur10e"))
    found = document(result, "ur-kinematics", Selection(calibration_hash="calib_12"))
    content = yaml.safe_load(found.text)["kinematics"]
    assert content["hash"] == "calib_12"
    said = next(
        line for line in found.text.splitlines() if line.startswith("# flange in wrist_3: ")
    )
    xyz, rpy = (part.split() for part in said.partition("xyz ")[2].split(" rpy "))
    flange = transform(of_rpy(*map(float, rpy)), np.array(xyz, dtype=float))
    q, expected = poses(result)
    for angles, pose in zip(q, expected, strict=True):
        chain = np.eye(4)
        for placement, angle in zip(ur_description(content), angles, strict=True):
            chain = chain @ placement @ exp(np.array([0, 0, angle, 0, 0, 0]))
        assert np.abs(chain @ flange - pose).max() < EXACT
    # That the flange is not where ur_description has it is the one thing to be told.
    assert len(found.warnings) == 1
    assert "mm and" in found.warnings[0]


def test_urs_kinematics_without_a_hash_say_so():
    found = document(calibrated(load_robot("ur5e")), "ur-kinematics")
    # ur_description's macro reads it, so it is never absent.
    assert yaml.safe_load(found.text)["kinematics"]["hash"] == "calib_visioncal"
    assert any("--hash" in warning for warning in found.warnings)


@pytest.mark.parametrize("name", ["irb120", "panda"])
def test_urs_kinematics_are_no_other_robots(name):
    with pytest.raises(DataError, match="ur_description's kinematics are of six"):
        export(calibrated(load_robot(name)), "ur-kinematics")


@pytest.mark.parametrize("nominal", [load_robot("ur5e"), of_urdf()], ids=["ur5e", "urdf"])
def test_json_holds_all_that_was_found(tmp_path, nominal):
    result = calibrated(nominal, waves=True)
    found = document(result, "robot-json")
    assert found.warnings == ()
    again = read_back(tmp_path, "arm.json", found.text)
    # Every number is written in full.
    q = some_joints(nominal)
    expected = result.arm.robot.base_from_flange(q)
    assert np.array_equal(again.base_from_flange(q), expected)


def bending(result):
    """The same arm with joints that yield to its own weight."""
    count = result.robot.joint_count
    springs = tuple(
        JointSpring(
            joint=joint,
            compliance_rad_per_nm=2e-5,
            sigma_rad_per_nm=1e-6,
            determined=True,
            torque_nm=(0.0, 100.0),
        )
        for joint in result.robot.joint_names[:count]
    )
    shown = ElasticResult(
        joints=springs,
        not_determined=(),
        weight="model",
        payload_kg=(0.0, 0.0),
        sag_mm=Sag(1.0, 2.0),
    )
    return replace(result, elastic=shown)


def rms_and_most_mm(away):
    distances = 1e3 * np.linalg.norm(away[:, :3, 3], axis=1)
    return np.sqrt(np.mean(distances**2)), distances.max()


@pytest.mark.parametrize("name", ["robot-urdf", "robot-dh", "ur-kinematics"])
@pytest.mark.parametrize("bends", [False, True])
def test_links_alone_leave_little_where_the_arm_was_measured_and_say_how_much(
    tmp_path, name, bends
):
    nominal = load_robot("ur10e")
    result = calibrated(nominal, waves=True)
    middle = np.array([0.3, -1.2, 1.4, -0.4, 1.2, 0.1])
    ranges = tuple(map(JointRange, nominal.joint_names, middle - 0.5, middle + 0.5))
    result = replace(result, arm=replace(result.arm, measured=ranges))
    result = bending(result) if bends else result
    found = document(result, name)
    (said,) = (warning for warning in found.warnings if "has no place in it" in warning)
    assert said.rstrip(".") in found.text.replace("- -", "--")
    assert ("bend under its own weight" in said) == bends
    q = middle + np.random.default_rng(9).uniform(-0.5, 0.5, (1000, 6))
    if name == "ur-kinematics":
        return
    suffix = {"robot-urdf": ".urdf", "robot-dh": ".toml"}[name]
    written = read_back(tmp_path, f"arm{suffix}", found.text, nominal.tip)
    real = result.standing(q)
    rms, most = rms_and_most_mm(real - written.base_from_flange(q))
    figures = [float(value) for value in re.findall(r"([\d.]+) mm", said.partition("of that: ")[2])]
    # Two random draws of hundreds; the worst of each hits the corner more or less well.
    assert figures[0] == pytest.approx(rms, rel=0.15)
    assert figures[1] == pytest.approx(most, rel=0.4)
    # Cut off, functions and weight would cost several times that; no links are better in the box
    # by much, as the rest of the workspace counts little.
    plain = without_functions(result.arm.robot)
    assert rms < 0.4 * rms_and_most_mm(real - plain.base_from_flange(q))[0]


@pytest.mark.parametrize("name", ARM_FORMATS)
def test_the_file_says_where_it_comes_from(name):
    result = calibrated(load_robot("ur5e"), session_name="a -- b --- c\n</robot>\nhash: x")
    text = export(result, name)
    assert "sigma over the workspace 0.12 mm, at 95 % of it under 0.34" in text
    if name == "robot-urdf":
        assert off(of_urdf_text(text, "tool0"), result) < EXACT
        assert ET.fromstring(text).get("name") == "ur5e"
    elif name == "ur-kinematics":
        assert list(yaml.safe_load(text)) == ["kinematics"]
    else:
        assert json.loads(text) if name == "robot-json" else tomllib.loads(text)


@pytest.mark.parametrize("name", ARM_FORMATS)
@pytest.mark.parametrize(
    "source",
    [SAMPLE, replace(SAMPLE, arm=ArmResult(level="nominal", levels=())), alone(tool())],
    ids=["none", "nominal", "frames"],
)
def test_without_a_calibrated_arm_the_next_step_is_told(name, source):
    with pytest.raises(DataError, match=r"and there is none\. .*q1_rad"):
        export(source, name)


@pytest.mark.parametrize(
    ("name", "chosen", "words"),
    [
        ("robot-urdf", Selection("flange_from_cam"), "no place for --edge"),
        ("robot-json", Selection(inverse=True, parent="a"), "--inverse, --parent"),
        ("robot-urdf", Selection(convention="hayati"), "no place for --convention"),
        ("robot-dh", Selection(calibration_hash="calib_1"), "no place for --hash"),
        ("robot-dh", Selection(convention="craig"), "standard, modified, hayati"),
        ("ros", Selection(convention="hayati"), "no place for --convention"),
        ("ur", Selection(calibration_hash="calib_1"), "no place for --hash"),
    ],
)
def test_what_a_format_has_no_place_for_is_refused(name, chosen, words):
    with pytest.raises(DataError) as caught:
        export(calibrated(load_robot("ur5e")), name, chosen)
    assert words in str(caught.value)


def test_the_command_writes_the_arm_and_warns(tmp_path):
    result = calibrated(load_robot("ur5e"), waves=True)
    result.save(tmp_path / "calibration.json")
    out = tmp_path / "arm.toml"
    done = visioncal(
        *("export", tmp_path, "--to", "robot-dh", "--convention", "standard", "-o", out)
    )
    assert (done.status, done.out) == (0, ""), done.err
    assert "has no place in it" in done.err
    # Of the session's ranges nothing is known here: what is left is that of the workspace.
    said_mm = float(done.err.replace("\n", " ").partition("least of that: ")[2].split()[0])
    q, expected = poses(load_result_or_frames(tmp_path))
    rms, _ = rms_and_most_mm(load_robot(str(out)).base_from_flange(q) - expected)
    assert rms == pytest.approx(said_mm, rel=0.3)


def test_a_session_takes_a_calibrated_arm_for_its_own(tmp_path):
    result = calibrated(load_robot("ur5e"), waves=True)
    sample = made_up(3, images=False).session
    folder, again = tmp_path / "a", tmp_path / "b"
    sample.save(folder)
    (folder / "arm.json").write_text(export(result, "robot-json"), encoding="utf-8")
    toml = folder / "session.toml"
    toml.write_text(toml.read_text().replace('"ur10e"', '"arm.json"'), encoding="utf-8")
    session = Session.load(folder)
    session.save(again)
    assert Session.load(again).robot_document == session.robot_document
    # Written again in its own form, so that it stands under its own name.
    assert off(load_robot(str(again / "arm.json")), result) < EXACT


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "is no JSON"), ("[]", "kind chain"), ('{"a": 1}', "--to robot-json")],
)
def test_a_json_that_is_no_arm_is_refused(tmp_path, text, words):
    with pytest.raises(DataError, match=words):
        read_back(tmp_path, "arm.json", text)

"""Exports of calibrated arms and of cells: what is read back is what was calibrated."""

import io
import json
import re
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import yaml
from support import placed
from support.aligned_cells import made_up_cell, with_cell
from support.arm_documents import arm_of
from support.placed import frame_file, tool
from support.readers import ARM_FORMATS, rx, ry, rz, transform
from support.refusals import raised
from support.samples import made_up
from support.urdf_arm import URDF, of_urdf, some_changes, some_joints

from visioncal.core.choices import CONVENTIONS
from visioncal.core.errors import DataError
from visioncal.core.files import write_json
from visioncal.core.transforms import adjoint, exp, invert
from visioncal.interchange.exports import Selection, document, export
from visioncal.interchange.result_files import load_calibration, load_exportable
from visioncal.results import CameraResult, Verdict, to_document
from visioncal.results.arm import (
    ArmResult,
    ElasticResult,
    JointRange,
    JointSpring,
    Sag,
    WorkspaceSigma,
)
from visioncal.robot import load_robot
from visioncal.robot.writing import without_functions
from visioncal.session import Session
from visioncal.session.selecting import Choice
from visioncal.simulation import CAMERAS

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


def off(robot, calibration):
    q, expected = poses(calibration)
    return float(np.abs(robot.base_from_flange(q) - expected).max())


# All but rounding of lengths of a metre over some ten products; nine digits are a nanometre.
EXACT = 1e-9


@pytest.mark.parametrize("name", ["ur5e", "ur10e", "irb120", "panda"])
def test_a_urdf_is_the_calibrated_arm(tmp_path, name):
    result = calibrated(load_robot(name))
    written = read_back(tmp_path, "arm.urdf", export(result, "robot-urdf"), result.robot.tip)
    assert off(written, result) < EXACT


@pytest.mark.parametrize("tip", ["flange", "mount", "bend"])
def test_a_given_urdf_keeps_all_but_its_origins(tmp_path, tip):
    result = calibrated(of_urdf(tip))
    found = document(result, "robot-urdf")
    # A moving joint cannot place the tip behind it, which is then said.
    held = f"{tip}_corrected" if tip == "bend" else tip
    assert off(read_back(tmp_path, "arm.urdf", found.text, held), result) < EXACT
    assert [held in warning for warning in found.warnings] == [True] * (held != tip)
    before, after = ET.fromstring(URDF), ET.fromstring(found.text)
    for kind in ("link", "joint", "transmission"):
        names = [element.get("name") for element in before.findall(kind)]
        assert [element.get("name") for element in after.findall(kind)][: len(names)] == names


@pytest.mark.parametrize("convention", [None, *CONVENTIONS])
def test_a_table_is_the_calibrated_arm(tmp_path, convention):
    result = calibrated(load_robot("ur5e"))
    found = document(result, "robot-dh", Selection(convention=convention))
    assert off(read_back(tmp_path, "arm.toml", found.text), result) < EXACT
    # A UR's parallel axes get Hayati's form where nothing was said.
    assert tomllib.loads(found.text)["convention"] == (convention or "hayati")


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
    (said,) = found.warnings
    assert "mm and" in said
    for name in ("irb120", "panda"):
        other = calibrated(load_robot(name))
        raised(DataError, "ur_description's kinematics are of six", export, other, "ur-kinematics")


def bending(result):
    """The same arm with joints that yield to its own weight."""
    spring = {"compliance_rad_per_nm": 2e-5, "sigma_rad_per_nm": 1e-6, "torque_nm": (0.0, 100.0)}
    springs = [
        JointSpring(joint=name, determined=True, **spring) for name in result.robot.joint_names
    ]
    shown = {"joints": tuple(springs), "not_determined": (), "payload_kg": (0.0, 0.0)}
    return replace(result, elastic=ElasticResult(**shown, weight="model", sag_mm=Sag(1.0, 2.0)))


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
        assert ET.fromstring(text).get("name") == "ur5e"
    elif name == "ur-kinematics":
        assert list(yaml.safe_load(text)) == ["kinematics"]
    else:
        assert json.loads(text) if name == "robot-json" else tomllib.loads(text)


@pytest.mark.parametrize("name", ARM_FORMATS)
@pytest.mark.parametrize(
    "source",
    [SAMPLE, replace(SAMPLE, arm=ArmResult(level="nominal", levels=())), frame_file(tool())],
    ids=["none", "nominal", "frames"],
)
def test_without_a_calibrated_arm_the_next_step_is_reported(name, source):
    raised(DataError, r"needs a calibrated arm.*q1_rad", export, source, name)


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


CELL = made_up_cell(4)


def test_any_frame_is_written_in_any_other(tmp_path):
    write_json(tmp_path / "calibration.json", to_document(CELL))
    source = load_exportable(tmp_path)
    text = export(source, "text", Selection(edge="base_b_from_cam_top"))
    expected = (
        invert(CELL.edges["cell_from_base_b"].matrix) @ CELL.edges["cell_from_cam_top"].matrix
    )
    # Numbers are written so that they read back as they are; the way takes a few roundings.
    assert np.allclose(np.loadtxt(io.StringIO(text)), expected, atol=1e-12)
    assert "calibrated by visioncal from 'made up'" in text
    turned = export(source, "text", Selection(edge="base_b_from_cam_top", inverse=True))
    assert np.allclose(np.loadtxt(io.StringIO(turned)) @ expected, np.eye(4), atol=1e-12)


FIXTURE = "base_b_from_jig"


@pytest.mark.parametrize(("name", "sign"), [("base_a_from_jig", 1), ("jig_from_base_a", -1)])
def test_a_fixture_of_one_robot_is_written_in_the_base_of_another(name, sign):
    jig = placed.frame(placed.BASE_FROM_FIXTURE, verdict=Verdict.of("bad", "It slips."))
    cell = replace(CELL, frames={FIXTURE: jig})
    far = CELL.between("base_a", "base_b").matrix @ jig.edge.matrix
    # The pieces are independent: each covariance goes through its own derivative.
    whole = np.zeros((6, 6))
    for edge, after in ((CELL.between("base_a", "base_b"), jig.edge.matrix), (jig.edge, np.eye(4))):
        slope = adjoint(invert(after) if sign > 0 else far @ invert(after))
        whole += slope @ edge.covariance @ slope.T
    found = cell.between(*name.split("_from_"))
    np.testing.assert_allclose(found.matrix, far if sign > 0 else invert(far), atol=1e-12)
    np.testing.assert_allclose(found.covariance, whole, atol=1e-12)
    text = export(cell, "text", Selection(edge=name))
    assert np.allclose(np.loadtxt(io.StringIO(text)), found.matrix, atol=1e-12)
    assert "# verdict bad" in text


def test_all_frames_are_one_tree():
    found = list(yaml.safe_load_all(export(CELL, "ros", Selection(edge="all"))))
    hangs = {value["child_frame_id"]: value["header"]["frame_id"] for value in found}
    assert hangs == {
        name: on for name, on in CELL.cell.tree.items() if not name.startswith("flange")
    }
    robot = ET.fromstring(export(CELL, "urdf", Selection(edge="all")))
    links = [element.attrib["name"] for element in robot.findall("link")]
    assert sorted(links) == sorted(["cell", *hangs])
    joints = {
        element.find("child").attrib["link"]: element.find("parent").attrib["link"]
        for element in robot.findall("joint")
    }
    assert joints == hangs
    launch = export(CELL, "ros-launch", Selection(edge="all"))
    assert launch.count("static_transform_publisher") == len(hangs)
    compile(launch, "launch", "exec")
    rows = np.loadtxt(io.StringIO(export(CELL, "text", Selection(edge="all"))))
    assert rows.shape == (4 * len(hangs), 4)
    # The verdict is that of the cell.
    bad = replace(CELL, verdict=replace(CELL.verdict, status="bad"))
    assert document(bad, "ros", Selection(edge="all")).verdict.status == "bad"


def test_a_lens_is_that_of_the_camera_that_is_named():
    cameras = {
        "top": CameraResult(CAMERAS["wide"], False),
        "hand": CameraResult(CAMERAS["fisheye"], False),
    }
    cell = with_cell(CELL, cameras=cameras)
    for name, focal_px in (("top", 914.2), ("cam_hand", 563.0)):
        info = yaml.safe_load(export(cell, "camera-info", Selection(camera=name)))
        assert info["camera_matrix"]["data"][0] == focal_px
    with pytest.raises(DataError, match="holds one camera; this cell has cam_top, cam_hand"):
        export(cell, "camera-info")


@pytest.mark.parametrize(
    ("to", "selection", "words"),
    [
        ("ros", Selection(), r"and one is written.*--edge \w+_from_cam_\w+"),
        ("ros", Selection(edge="base_a_from_target_plate"), "whose pose must be given"),
        ("ros", Selection(edge="base_a_from_cam_tpo"), "Did you mean cam_top"),
        ("ros", Selection(edge="all", inverse=True), "without --inverse, --parent and --child"),
        ("opencv", Selection(edge="all"), "written as ros, "),
        ("easy-handeye", Selection(), "holds the camera"),
    ],
)
def test_a_selection_that_cannot_be_written_is_refused(to, selection, words):
    raised(DataError, words, export, CELL, to, selection)


def test_a_format_of_one_camera_takes_the_only_one_that_fits(tmp_path):
    write_json(tmp_path / "calibration.json", to_document(CELL))
    for path in (tmp_path, tmp_path / "calibration.json"):
        found = load_calibration(path)
        expected = CELL.between("base_b", "cam_top")
        np.testing.assert_allclose(found.edges["base_from_cam"].matrix, expected.matrix)
    raised(DataError, "no one robot parts", load_calibration, tmp_path, Choice("hand"))

"""Robots: kinematics by plain matrices, derivatives, corrections, joint tables, and files."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.marks import slow
from support.readers import rx, ry, rz, transform
from support.refusals import raised
from support.slopes import jacobian, twists
from support.urdf_arm import of_urdf, some_changes, some_joints

from visioncal.core.choices import CONVENTIONS
from visioncal.core.documents.structured import read_yaml
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.robot import Robot, load_robot
from visioncal.robot.chain import chain_document
from visioncal.robot.conversion import convert_table, other_convention, parallel_axes, table_of
from visioncal.robot.files import read_robot_document, robot_file, robot_names
from visioncal.robot.loads import Masses
from visioncal.robot.tables import table_document, table_from_document
from visioncal.robot.writing import (
    corrected_urdf,
    small_urdf,
    unexportable_functions,
    ur_kinematics_yaml,
)

# Joint, then tool, with a branch (camera) and a wheel that are not between base and tip.
URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base_link"/> <link name="upper"/> <link name="wheel"/> <link name="lower"/>
  <link name="tool0"/> <link name="camera"/>
  <joint name="a_wheel" type="continuous">
    <parent link="base_link"/> <child link="wheel"/> <axis xyz="0 1 0"/>
  </joint>
  <joint name="turn" type="continuous">
    <parent link="base_link"/> <child link="upper"/>
    <origin xyz="0 0 0.5"/> <axis xyz="0 0 1"/>
  </joint>
  <joint name="bend" type="revolute">
    <parent link="upper"/> <child link="lower"/>
    <origin xyz="0.1 0 0.2" rpy="0.3 0 0"/> <axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="2.5" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed">
    <parent link="lower"/> <child link="tool0"/> <origin xyz="0 0 0.4"/>
  </joint>
  <joint name="eye" type="fixed">
    <parent link="upper"/> <child link="camera"/> <origin xyz="0.2 0 0"/>
  </joint>
</robot>
"""


def given(place):
    """A constant transform of a table, by its position and angles about x, y, z."""
    if place is None:
        return np.eye(4)
    roll, pitch, yaw = place["rpy_rad"]
    return transform(rz(yaw) @ ry(pitch) @ rx(roll), place["xyz_m"])


def dh_product(document, q):
    """The textbook's product of a DH table, row by row."""
    result = given(document.get("base"))
    for row, angle in zip(document["joint"], q, strict=True):
        slides = row.get("type") == "prismatic"
        theta = row.get("theta_offset_rad", 0.0) + (0.0 if slides else angle)
        about_z = transform(rz(theta), [0.0, 0.0, row["d_m"] + (angle if slides else 0.0)])
        along_x = transform(rx(row["alpha_rad"]), [row["a_m"], 0.0, 0.0])
        if document["convention"] == "modified":
            result = result @ along_x @ about_z
        else:  # Only Hayati's rows have a beta.
            beta = transform(ry(row.get("beta_rad", 0.0)), np.zeros(3))
            result = result @ about_z @ along_x @ beta
    return result @ given(document.get("flange"))


@pytest.mark.parametrize("name", robot_names())
def test_forward_kinematics_is_the_product_of_the_table(name):
    robot = load_robot(name)
    rng = np.random.default_rng(1)
    q = rng.uniform(robot.lower_rad, robot.upper_rad, (20, robot.joint_count))
    expected = [dh_product(dict(robot.document), row) for row in q]
    # Some fifteen products of matrices with entries near 1 in double precision.
    np.testing.assert_allclose(robot.base_from_flange(q), expected, atol=1e-13)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_offsets_and_flange_enter_in_all_conventions(convention):
    rng = np.random.default_rng(2)
    keys = ("a_m", "alpha_rad", "d_m", "theta_offset_rad")
    document = {
        "schema": 1,
        "name": "random",
        "convention": convention,
        "joint": [dict(zip(keys, rng.normal(size=4).tolist(), strict=True)) for _ in range(5)],
        "flange": {"xyz_m": [0.1, 0.2, 0.3], "rpy_rad": [0.4, 0.5, 0.6]},
    }
    if convention == "hayati":
        document["joint"][1]["beta_rad"] = 0.3
    robot = Robot.from_document(document)
    q = rng.normal(size=(4, 5))
    expected = [dh_product(document, row) for row in q]
    # Entries are of the order of 10 m here.
    np.testing.assert_allclose(robot.base_from_flange(q), expected, atol=1e-12)
    np.testing.assert_allclose(robot.link_frames(q)[:, -1], expected, atol=1e-12)
    assert robot.link_frames(q).shape == (4, 6, 4, 4)


def test_a_urdf_is_read_up_to_the_tip(tmp_path):
    (tmp_path / "my arm.urdf").write_text(URDF)
    robot = load_robot("my arm.urdf", folder=tmp_path)
    assert (robot.tip, robot.joint_names) == ("tool0", ("turn", "bend"))
    assert robot.lower_rad.tolist() == [-np.inf, -1.5]
    assert robot.upper_rad.tolist() == [np.inf, 2.5]
    q = np.array([[0.7, -0.4], [4.0, 1.0]])
    expected = [
        transform(rz(turn), [0.0, 0.0, 0.5])
        @ transform(rx(0.3) @ ry(bend), [0.1, 0.0, 0.2])
        @ transform(np.eye(3), [0.0, 0.0, 0.4])
        for turn, bend in q
    ]
    # Products of a few matrices with entries near 1: some units in the last place.
    np.testing.assert_allclose(robot.base_from_flange(q), expected, atol=1e-14)


def test_an_unknown_tip_is_refused_with_the_names_of_the_frames(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    with pytest.raises(DataError, match=r"no frame 'tool'; its frames are .*tool0") as caught:
        load_robot("arm.urdf", "tool", tmp_path)
    assert "Did you mean tool0" in caught.value.next_step
    (tmp_path / "bare.urdf").write_text(URDF.replace("tool0", "gripper"))
    raised(DataError, "no tip is named; its frames are", load_robot, "bare.urdf", None, tmp_path)


def test_a_file_that_is_no_urdf_is_refused(tmp_path, capfd):
    (tmp_path / "a.urdf").write_text("<robot name='x'><link name=")
    raised(DataError, "is not XML", load_robot, "a.urdf", "x", tmp_path)
    (tmp_path / "a.urdf").write_text("<robot/>")
    raised(DataError, "cannot be parsed", load_robot, "a.urdf", "x", tmp_path)
    capfd.readouterr()  # the parser speaks on its own
    # One that Pinocchio's reader takes, and no other.
    (tmp_path / "bold.urdf").write_text(URDF.replace("<link name=", "<link note='<i>' name=", 1))
    raised(DataError, "is not XML: not well-formed", load_robot, "bold.urdf", "tool0", tmp_path)
    (tmp_path / "long.urdf").write_text(f"<robot name='x'>{'<joint/>' * 2001}</robot>")
    raised(DataError, "has 2001 joints; up to 2000", load_robot, "long.urdf", "x", tmp_path)
    (tmp_path / "b.urdf").write_bytes(b" " * 10_000_001)
    raised(DataError, "has more than 10 MB", read_robot_document, "b.urdf", folder=tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": 2}, "schema is 2"),
        ({"repeatability_mm": 0}, "repeatability_mm is 0, but must be a number above 0"),
        ({"joint": [{"a_m": 0.0, "d_m": 0.1}]}, "joint joint_1: alpha_rad is missing"),
        ({"joint": [{"name": "j", "a_m": 0, "d_m": 0, "alpha_rad": 0}] * 2}, "a name of its own"),
        (
            {"joint": [{"a_m": 0, "d_m": 0, "alpha_rad": 0, "lower_deg": 9, "upper_deg": 3}]},
            r"lower_deg is 9\.0, but must be less than upper_deg = 3\.0",
        ),
    ],
)
def test_a_wrong_table_is_refused_by_field(change, words):
    raised(DataError, words, Robot.from_document, read_robot_document("ur5") | change)


def robots():
    return [*(load_robot(name) for name in robot_names()), of_urdf()]


def other(robot):
    return robot.corrected(*some_changes(robot))


# Of central differences.
STEP = 1e-5

# Flange with all joints at zero, as drawings and pendants of the makers have it [mm].
_AT_ZERO = {
    "xarm6": (207, 0, 112),
    "xarm7": (206, 0, 120.5),
    "kr6-r900": (980, 0, 435),
    "iiwa14": (0, 0, 1306 + 26),
    "irb1200-5-0.9": (533, 0, 889.1),
    "lrmate200id": (465, 0, 365 + 330),
    "gen3": (0, -24.9, 1187.4),
    "a0509": (0, 0, 1055.5),
    "m1013": (0, 34.5, 1452.5),
    "cr5": (0, -246, 1047),
    # A UR stretched out along -x: its reach a2 + a3, its offset d4 + d6, its height d1 - d5.
    "ur5e": (-817.2, -232.9, 62.8),
    "ur10e": (-1184.25, -290.7, 60.85),
    # A Panda upright: 0.333 + 0.316 + 0.384 - 0.107 high, 0.088 to the front.
    "panda": (88, 0, 926),
    "fr3": (88, 0, 926),
    "irb120": (374, 0, 630),
    "generic-scara-600": (600, 0, 350),
    "ur20": (-1590.7, -355.3, 77),
    "ur30": (-1140.7, -355.3, 77),
}


@pytest.mark.parametrize("name", _AT_ZERO)
def test_arms_stand_at_zero_as_their_makers_draw_them(name):
    flange = load_robot(name).base_from_flange(np.zeros((1, load_robot(name).joint_count)))[0]
    # Drawings are rounded to a tenth of a millimetre.
    np.testing.assert_allclose(1e3 * flange[:3, 3], _AT_ZERO[name], atol=0.06)


@pytest.mark.parametrize(
    "robot",
    [*robots()[::4], other(load_robot("ur5e")), other(of_urdf())]
    + [slow(robot) for at, robot in enumerate(robots()) if at % 4],
)
def test_jacobians_are_the_jacobian_of_the_forward_kinematics(robot):
    q, count = some_joints(robot), robot.joint_count
    turning = np.where(robot.chain.prismatic[:, None], [1, 1, 0, 0], 1).ravel()

    def placed(change):
        return robot.corrected(placements=change.reshape(-1, 6)).base_from_flange(q)

    def functioning(change):
        changes = (turning * change).reshape(-1, 4)
        return robot.corrected(functions=changes).base_from_flange(q)

    # The third order of a step of 1e-5, and rounding of 1e-16 over it: 1e-10 for metres.
    tolerance = {"rtol": 0, "atol": 1e-9}
    joints = twists(lambda change: robot.base_from_flange(q + change), count, STEP)
    np.testing.assert_allclose(robot.joint_jacobian(q), joints, **tolerance)
    links = twists(placed, 6 * (count + 1), STEP)
    np.testing.assert_allclose(robot.placement_jacobian(q), links, **tolerance)
    functions = twists(functioning, 4 * count, STEP)
    np.testing.assert_allclose(robot.function_jacobian(q), functions, **tolerance)


@pytest.mark.parametrize("robot", [load_robot("ur5e"), load_robot("panda"), other(of_urdf())])
def test_frames_and_their_jacobian_are_those_of_pinocchio(robot):
    import pinocchio as pin

    centres_m = np.linspace(-0.1, 0.2, 3 * robot.joint_count).reshape(-1, 3)
    masses = robot.masses or Masses(np.linspace(8.0, 1.0, robot.joint_count), centres_m)
    robot = replace(robot, masses=masses)
    model, q = robot.pinocchio_model, some_joints(robot)
    data, tip = model.createData(), model.getFrameId(robot.tip)
    frames, jacobians = robot.link_frames(q), robot.placement_jacobian(q)
    gravity = robot.gravity_torques(q)
    for at, positions in enumerate(robot.chain.effective(q)):
        pin.forwardKinematics(model, data, positions)
        expected = [joint.homogeneous for joint in data.oMi[1:]]
        expected.append(pin.updateFramePlacement(model, data, tip).homogeneous)
        # Products of some ten matrices of order one in double precision.
        np.testing.assert_allclose(frames[at], expected, atol=1e-13)
        regressor = pin.computeFrameKinematicRegressor(model, data, tip, pin.LOCAL)
        # Pinocchio puts translations first.
        halves = regressor.reshape(2, 3, -1, 2, 3)[::-1, :, :, ::-1].reshape(6, -1)
        np.testing.assert_allclose(jacobians[at, :, :-6], halves, atol=1e-13)
        torques = pin.computeGeneralizedGravity(model, data, positions)
        # Of up to some 100 N m.
        np.testing.assert_allclose(gravity[at], torques, atol=1e-11)


def test_no_postures_have_arrays_of_no_rows():
    robot, none = load_robot("ur10e"), np.zeros((0, 6))
    assert robot.base_from_flange(none).shape == (0, 4, 4)
    assert robot.placement_jacobian(none).shape == (0, 6, 42)
    assert robot.joint_jacobian(none).shape == (0, 6, 6)
    assert robot.function_jacobian(none).shape == (0, 6, 24)
    assert robot.gravity_torques(none).shape == (0, 6)


def test_an_axis_of_few_digits_turns_rigidly():
    document = chain_document("rounded", "tip", load_robot("ur10e").chain)
    document["joint"][0]["axis"] = [0.577, 0.577, 0.577]
    robot = Robot.from_document(document)
    rotation = robot.base_from_flange(np.full((1, 6), 0.5))[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    turn = robot.link_frames(np.array([[0.5, 0, 0, 0, 0, 0]]))[0, 0, :3, :3]
    start = robot.link_frames(np.zeros((1, 6)))[0, 0, :3, :3]
    assert np.arccos((np.trace(start.T @ turn) - 1) / 2) == pytest.approx(0.5, abs=1e-12)


def test_corrections_are_as_stated():
    robot = load_robot("ur10e")
    placements, functions = some_changes(robot)
    corrected = robot.corrected(placements, functions)
    expected = robot.chain.placements @ exp(placements)
    assert np.array_equal(corrected.chain.placements, expected)
    q = some_joints(robot)
    offset, ratio, sine, cosine = functions.T
    at = robot.corrected(placements).base_from_flange(
        q + offset + ratio * q + sine * np.sin(q) + cosine * np.cos(q)
    )
    # The same angles, added in another order.
    np.testing.assert_allclose(corrected.base_from_flange(q), at, atol=1e-14)
    once_more = corrected.corrected(functions=-functions)
    np.testing.assert_allclose(
        once_more.base_from_flange(q), robot.corrected(placements).base_from_flange(q), atol=1e-14
    )


@pytest.mark.parametrize("robot", [load_robot("panda"), of_urdf()], ids=["panda", "urdf"])
def test_a_corrected_robot_is_described_by_its_document_alone(robot, tmp_path):
    corrected = other(robot)
    again = Robot.from_document(json.loads(json.dumps(corrected.document)))
    name, content = robot_file(corrected.document)
    (tmp_path / name).write_text(content)
    q = some_joints(robot)
    for copy in (again, load_robot(name, folder=tmp_path)):
        assert (copy.name, copy.tip, copy.joint_names) == (robot.name, robot.tip, robot.joint_names)
        assert np.array_equal(copy.base_from_flange(q), corrected.base_from_flange(q))
        assert np.array_equal(copy.lower_rad, robot.lower_rad)
        assert np.array_equal(copy.upper_rad, robot.upper_rad)


def test_corrections_that_a_urdf_cannot_hold_are_named():
    robot = of_urdf()
    corrected = other(robot)
    assert [name.partition(":")[0] for name in unexportable_functions(corrected)] == list(
        robot.joint_names
    )
    assert unexportable_functions(robot) == ()
    for text in (corrected_urdf(robot, corrected), small_urdf(corrected)):
        assert "Not in this file" in text
        assert "turn: ratio " in text
        Robot.from_document({"schema": 1, "name": "x", "tip": "flange", "urdf": text})
    raised(DataError, "must come from a URDF", corrected_urdf, load_robot("ur5"), load_robot("ur5"))


# What ur_description's config/ur5e/default_kinematics.yaml holds, pi / 2 in full.
UR5E_KINEMATICS = {
    "shoulder": (0, 0, 0.1625, 0, 0, 0),
    "upper_arm": (0, 0, 0, np.pi / 2, 0, 0),
    "forearm": (-0.425, 0, 0, 0, 0, 0),
    "wrist_1": (-0.3922, 0, 0.1333, 0, 0, 0),
    "wrist_2": (0, -0.0997, 0, np.pi / 2, 0, 0),
    "wrist_3": (0, 0.0996, 0, -np.pi / 2, 0, 0),
}


@pytest.mark.parametrize("turned", [False, True], ids=["base", "base_link"])
def test_the_kinematics_of_urs_driver_are_those_of_its_description(tmp_path, turned):
    robot = load_robot("ur5e")
    if turned:
        half = '<joint name="h" type="fixed"><parent link="base_link"/><child link="base"/>'
        half += '<origin xyz="0 0 0" rpy="0 0 3.141592653589793"/></joint><link name="base_link"/>'
        urdf = small_urdf(robot).replace("</robot>", half + "</robot>")
        robot = Robot.from_document({"schema": 1, "name": "ur", "tip": "tool0", "urdf": urdf})
    path = tmp_path / "kinematics.yaml"
    path.write_text(ur_kinematics_yaml(robot, calibration_hash="calib_12788084448423163542"))
    content = read_yaml(path)["kinematics"]
    assert content.pop("hash") == "calib_12788084448423163542"
    for link, numbers in UR5E_KINEMATICS.items():
        found = [content[link][key] for key in ("x", "y", "z", "roll", "pitch", "yaw")]
        np.testing.assert_allclose(found, numbers, atol=1e-12)  # rounding of half turns


def some_harmonics(robot, orders=5):
    rng = np.random.default_rng(2)
    return 1e-3 * rng.standard_normal((robot.joint_count, orders, 2))


@pytest.fixture
def wavy():
    robot = load_robot("ur5e")
    return robot.corrected(*some_changes(robot), some_harmonics(robot))


def test_harmonics_turn_each_joint_as_stated():
    robot = load_robot("ur5e")
    q, harmonics = some_joints(robot), some_harmonics(robot)
    turned = q.copy()
    for at in range(5):
        sine, cosine = harmonics[:, at].T
        turned += sine * np.sin((at + 2) * q) + cosine * np.cos((at + 2) * q)
    found = robot.corrected(harmonics=harmonics).base_from_flange(q)
    np.testing.assert_allclose(found, robot.base_from_flange(turned), atol=1e-14)


def test_their_jacobian_is_that_of_the_forward_kinematics(wavy):
    q, shape = some_joints(wavy), (wavy.joint_count, 7, 2)

    def turned(change):
        return wavy.corrected(harmonics=change.reshape(shape)).base_from_flange(q)

    # The third order of the step, and rounding over it.
    slopes = twists(turned, int(np.prod(shape)), STEP)
    np.testing.assert_allclose(wavy.harmonic_jacobian(q, 7), slopes, rtol=0, atol=1e-8)


def test_encoder_angles_invert_joint_functions(wavy):
    q = some_joints(wavy)
    # Newton's last step squares what it was off by.
    np.testing.assert_allclose(wavy.chain.encoded(wavy.chain.effective(q)), q, atol=1e-13)
    for function, slope in (
        (wavy.chain.effective, wavy.chain.jacobian),
        (wavy.chain.jacobian, wavy.chain.curvatures),
    ):
        slopes = jacobian(lambda by, function=function: function(q + by), 1)[..., 0]
        np.testing.assert_allclose(slope(q), slopes, atol=1e-8)


NUMBERS = ("theta_rad", "d_m", "a_m", "alpha_rad", "beta_rad", "parallel", "base", "flange")
KEYS = ("a_m", "alpha_rad", "d_m", "theta_offset_rad")


def table(name):
    return table_from_document(load_robot(name).document)


def random_table(convention, seed=1):
    """Rows in general position, one with all that a row can hold, a base and a flange."""
    rng = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = [
        dict(zip(KEYS, rng.normal(size=4).tolist(), strict=True)) for _ in range(5)
    ]
    rows[2] |= {"type": "prismatic", "lower_m": -0.5, "upper_m": 0.5}
    rows[3] |= {"gear_ratio": 1.01, "sine_rad": 0.02, "cosine_rad": 0.03, "lower_deg": -np.inf}
    if convention == "hayati":
        rows[1] |= {"alpha_rad": 2e-3, "beta_rad": -1e-3, "d_m": 0.0}
    pose = {"xyz_m": rng.normal(size=3).tolist(), "rpy_rad": rng.normal(size=3).tolist()}
    flange = {"xyz_m": [0.1, 0.2, 0.3], "rpy_rad": [0.4, 0.5, 0.6]}
    document = {"schema": 1, "name": "random", "convention": convention, "joint": rows}
    return table_from_document(document | {"base": pose, "flange": flange})


def disturbed(name, seed):
    """An arm off by 0.5 mm and 1 mrad in everything."""
    robot, rng = load_robot(name), np.random.default_rng(seed)
    scale = np.repeat([1e-3, 5e-4], 3)
    return robot.corrected(scale * rng.normal(size=(robot.joint_count + 1, 6)))


def robot_of(dhtable):
    return Robot.from_document(json.loads(json.dumps(table_document(dhtable, "a test"))))


def poses(dhtable, count=20):
    robot = dhtable if isinstance(dhtable, Robot) else robot_of(dhtable)
    q = np.random.default_rng(7).uniform(-2, 2, (count, robot.joint_count))
    return robot.base_from_flange(q)


def assert_same_table(found, expected, atol):
    assert (found.convention, found.joint_names) == (expected.convention, expected.joint_names)
    for name in (*NUMBERS, "lower", "upper", "functions", "prismatic"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=0, atol=atol, err_msg=name
        )


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("name", robot_names())
def test_conversions_keep_the_arm_and_come_back(name, convention):
    start = table(name)
    converted = convert_table(start, convention)
    assert converted.convention == convention
    # Rounding of some ten products; nothing is computed anew, so the way back is exact.
    np.testing.assert_allclose(poses(converted), poses(start), rtol=0, atol=1e-14)
    assert_same_table(convert_table(converted, start.convention), start, atol=0.0)


@pytest.mark.parametrize("other", CONVENTIONS)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_conversions_of_any_table_come_back(convention, other):
    start = random_table(convention)
    converted = convert_table(start, other)
    # d of some hundred metres where beta had been: 1e-16 of it, a few times over.
    np.testing.assert_allclose(poses(converted), poses(start), rtol=0, atol=1e-12)
    assert_same_table(convert_table(converted, convention), start, atol=1e-12)


@pytest.mark.parametrize("other", ["standard", "modified"])
@pytest.mark.parametrize("name", ["ur5e", "ur10e", "irb120", "generic-6r-1800"])
def test_nearly_parallel_axes_come_back_too(name, other):
    for seed in range(5):
        robot = disturbed(name, seed)
        hayati = table_of(robot, "hayati", like=table(name))
        converted = convert_table(hayati, other)
        # What Hayati's form is for: the common normal is far away.
        assert np.abs(converted.d_m).max() > 5.0 > 2.0 > np.abs(hayati.d_m).max()
        for dhtable in (hayati, converted):
            np.testing.assert_allclose(poses(dhtable), poses(robot), rtol=0, atol=2e-12)
        assert_same_table(convert_table(converted, "hayati"), hayati, atol=2e-12)


def test_beta_is_chosen_for_the_axes_that_are_nearly_parallel():
    for robot in (load_robot("ur5e"), disturbed("ur5e", 1)):
        assert parallel_axes(robot).tolist() == [False, True, True, False, False]
        assert table_of(robot, "hayati").parallel.tolist() == [0, 0, 1, 1, 0, 0, 0]
        assert not table_of(robot, "standard").parallel.any()
    assert parallel_axes(load_robot("irb120")).tolist() == [False, True, False, False, False]
    assert not parallel_axes(load_robot("panda")).any()


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("name", robot_names())
def test_a_urdfs_table_is_the_published_one(name, convention):
    nominal = table(name)
    document = load_robot(name).document
    if any("xyz_m" in document.get(part, ()) for part in ("base", "flange")):
        pytest.skip("its table is one of many of its URDF")
    document = {"schema": 1, "name": name, "tip": nominal.tip, "urdf": small_urdf(load_robot(name))}
    found = table_of(Robot.from_document(document), convention)
    expected = convert_table(nominal, convention)
    if name in ("panda", "fr3"):
        # Its flange is a way along the last axis, which goes into that axis' row.
        d = np.append(expected.d_m[:-1], expected.flange[2, 3])
        expected = replace(expected, d_m=d, flange=np.eye(4))
    # Angles written as roll, pitch and yaw and read again.
    assert_same_table(found, replace(expected, name=found.name), atol=1e-13)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_table_holds_what_a_corrected_arm_has(convention):
    robot = random_table("standard")
    rng = np.random.default_rng(2)
    functions = 1e-2 * rng.normal(size=(5, 4))
    functions[2, 2:] = 0.0
    corrected = robot_of(robot).corrected(1e-2 * rng.normal(size=(6, 6)), functions)
    for like in (None, robot):
        found = table_of(corrected, convention, like=like)
        np.testing.assert_allclose(poses(found), poses(corrected), rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.functions[:, 1:], corrected.chain.functions[:, 1:])


def test_axes_in_one_line_have_a_table():
    straight = {"a_m": 0.0, "alpha_rad": 0.0, "d_m": 0.2}
    rows = [straight, straight | {"alpha_rad": np.pi}, straight]
    document = {"schema": 1, "name": "x", "convention": "standard", "joint": rows}
    robot = Robot.from_document(document)
    for convention in CONVENTIONS:
        found = table_of(robot, convention)
        np.testing.assert_allclose(poses(found), poses(robot), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"beta_rad": 0.1}, "beta_rad has no place in the convention 'standard'"),
        ({"a_m": 425.0}, "a_m is 425.0, but must be .* under 20. .* looks like millimetres"),
        ({"gear_ratio": 0.0}, "gear_ratio is 0.0, but must be a number above 0"),
        ({"type": "prismatic", "lower_m": 2.0, "upper_m": 1.0}, "less than upper_m = 1.0"),
    ],
)
def test_a_wrong_row_is_refused_by_field(change, words):
    document = json.loads(json.dumps(load_robot("ur5").document))
    document["joint"][1] |= change
    with pytest.raises(DataError) as caught:
        Robot.from_document(document)
    assert re.search(words, str(caught.value), re.DOTALL)
    assert "shoulder_lift_joint" in str(caught.value)


def motions(robot, q):
    """Turns [rad] and shifts along their axes [m] between poses: base and flange drop out."""
    poses = robot.base_from_flange(q)
    moved = log(invert(poses[:-1]) @ poses[1:])
    turns = np.linalg.norm(moved[:, :3], axis=1)
    return np.stack([turns, np.sum(moved[:, :3] * moved[:, 3:], axis=1) / turns])


@pytest.mark.parametrize("name", robot_names())
def test_the_other_convention_is_the_arm_of_a_misread_table(name):
    start = table(name)
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (12, len(start)))
    seen = motions(load_robot(name), q)
    misread = Robot.from_document(table_document(_misread(start)))
    assert np.abs(motions(misread, q) - seen).max() > 1e-3
    found, convention = other_convention(misread)
    assert convention == start.convention
    assert motions(found, q) == pytest.approx(seen, abs=1e-9)


def _misread(dhtable):
    """The same printed rows under the other convention."""
    document = table_document(dhtable)
    other = "standard" if dhtable.convention == "modified" else "modified"
    return table_from_document(document | {"convention": other})

"""Robots: forward kinematics against plain matrices, and descriptions that stand alone."""

import json
import subprocess
import sys

import numpy as np
import pytest

from visioncal.core.errors import DataError
from visioncal.core.files import parse_toml
from visioncal.robot import Robot, load_robot, read_robot_document, robot_file, robot_names

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


def elementary(axis, angle=0.0, along=0.0):
    """A rotation about and a translation along one axis, written out."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix = np.eye(4)
    matrix[j, j] = matrix[k, k] = np.cos(angle)
    matrix[k, j], matrix[j, k] = np.sin(angle), -np.sin(angle)
    matrix[i, 3] = along
    return matrix


def dh_product(document, q):
    """The textbook's product of a DH table, row by row."""
    result = np.eye(4)
    rows = [(row, row.get("theta_offset_rad", 0.0)) for row in document["joint"]]
    angles = [offset + angle for (_, offset), angle in zip(rows, q, strict=True)]
    if "flange" in document:
        rows.append((document["flange"], 0.0))
        angles.append(document["flange"].get("theta_rad", 0.0))
    for (row, _), theta in zip(rows, angles, strict=True):
        about_z = elementary("z", theta) @ elementary("z", along=row["d_m"])
        along_x = elementary("x", along=row["a_m"]) @ elementary("x", row["alpha_rad"])
        modified = document["convention"] == "modified"
        result = result @ (along_x @ about_z if modified else about_z @ along_x)
    return result


@pytest.mark.parametrize("name", robot_names())
def test_forward_kinematics_is_the_product_of_the_table(name):
    robot = load_robot(name)
    rng = np.random.default_rng(1)
    q = rng.uniform(robot.lower_rad, robot.upper_rad, (20, robot.joint_count))
    expected = [dh_product(dict(robot.document), row) for row in q]
    # Some fifteen products of matrices with entries near 1 in double precision.
    np.testing.assert_allclose(robot.base_from_flange(q), expected, atol=1e-13)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_offsets_and_flange_row_enter_in_both_conventions(convention):
    rng = np.random.default_rng(2)
    keys = ("a_m", "alpha_rad", "d_m", "theta_offset_rad")
    document = {
        "schema": 1,
        "name": "random",
        "convention": convention,
        "joint": [dict(zip(keys, rng.normal(size=4).tolist(), strict=True)) for _ in range(5)],
        "flange": {"a_m": 0.1, "alpha_rad": 0.2, "d_m": 0.3, "theta_rad": 0.4},
    }
    robot = Robot.from_document(document)
    q = rng.normal(size=(4, 5))
    expected = [dh_product(document, row) for row in q]
    # Entries are of the order of 10 m here.
    np.testing.assert_allclose(robot.base_from_flange(q), expected, atol=1e-12)
    np.testing.assert_allclose(robot.link_frames(q[0])[-1], expected[0], atol=1e-12)
    assert robot.link_frames(q[0]).shape == (6, 4, 4)


@pytest.mark.parametrize(
    ("name", "q", "position_m"),
    [
        # A UR stretched out along -x: its reach a2 + a3, its offset d4 + d6, its height d1 - d5.
        ("ur10e", [0, 0, 0, 0, 0, 0], [-1.18425, -0.2907, 0.06085]),
        ("ur5e", [0, 0, 0, 0, 0, 0], [-0.8172, -0.2329, 0.0628]),
        # A Panda upright: 0.333 + 0.316 + 0.384 - 0.107 high, 0.088 to the front.
        ("panda", [0, 0, 0, 0, 0, 0, 0], [0.088, 0.0, 0.926]),
    ],
)
def test_known_poses(name, q, position_m):
    flange = load_robot(name).base_from_flange(np.array([q], float))[0]
    np.testing.assert_allclose(flange[:3, 3], position_m, atol=1e-12)  # sums of printed numbers


def test_a_urdf_is_read_up_to_the_tip(tmp_path):
    (tmp_path / "my arm.urdf").write_text(URDF)
    robot = load_robot("my arm.urdf", folder=tmp_path)
    assert (robot.tip, robot.joint_names) == ("tool0", ("turn", "bend"))
    assert robot.lower_rad.tolist() == [-np.inf, -1.5]
    assert robot.upper_rad.tolist() == [np.inf, 2.5]
    q = np.array([[0.7, -0.4], [4.0, 1.0]])
    expected = [
        elementary("z", along=0.5)
        @ elementary("z", turn)
        @ elementary("x", 0.3, 0.1)
        @ np.linalg.inv(elementary("x", 0.3))
        @ elementary("z", along=0.2)
        @ elementary("x", 0.3)
        @ elementary("y", bend)
        @ elementary("z", along=0.4)
        for turn, bend in q
    ]
    # Products of a few matrices with entries near 1: some units in the last place.
    np.testing.assert_allclose(robot.base_from_flange(q), expected, atol=1e-14)


@pytest.mark.parametrize("tip", [None, "upper"])
def test_a_description_stands_alone(tmp_path, tip):
    (tmp_path / "arm.urdf").write_text(URDF)
    for name in ("arm.urdf", "ur3e"):
        robot = load_robot(name, None if name == "ur3e" else tip, tmp_path)
        again = Robot.from_document(json.loads(json.dumps(robot.document)))
        file_name, content = robot_file(robot.document)
        (tmp_path / file_name).write_text(content)
        from_file = load_robot(file_name, robot.tip, tmp_path)
        q = np.full((1, robot.joint_count), 0.3)
        for copy in (again, from_file):
            assert (copy.tip, copy.joint_names) == (robot.tip, robot.joint_names)
            assert np.array_equal(copy.base_from_flange(q), robot.base_from_flange(q))


def test_a_tip_that_is_not_there_is_refused_with_the_frames(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    with pytest.raises(DataError, match=r"no frame 'tool'; its frames are .*tool0") as caught:
        load_robot("arm.urdf", "tool", tmp_path)
    assert "Did you mean tool0" in caught.value.next_step
    (tmp_path / "bare.urdf").write_text(URDF.replace("tool0", "gripper"))
    with pytest.raises(DataError, match="no tip is named; its frames are"):
        load_robot("bare.urdf", None, tmp_path)


def test_what_is_no_urdf_is_refused(tmp_path, capfd):
    (tmp_path / "a.urdf").write_text("<robot name='x'><link name=")
    with pytest.raises(DataError, match="is no XML"):
        load_robot("a.urdf", "x", tmp_path)
    (tmp_path / "a.urdf").write_text("<robot/>")
    with pytest.raises(DataError, match="cannot be parsed"):
        load_robot("a.urdf", "x", tmp_path)
    capfd.readouterr()  # the parser speaks on its own
    # One that Pinocchio's reader takes, and no other.
    (tmp_path / "bold.urdf").write_text(URDF.replace("<link name=", "<link note='<i>' name=", 1))
    with pytest.raises(DataError, match="is no XML: not well-formed"):
        load_robot("bold.urdf", "tool0", tmp_path)
    (tmp_path / "long.urdf").write_text(f"<robot name='x'>{'<joint/>' * 2001}</robot>")
    with pytest.raises(DataError, match="has 2001 joints; up to 2000"):
        load_robot("long.urdf", "x", tmp_path)
    (tmp_path / "b.urdf").write_bytes(b" " * 10_000_001)
    with pytest.raises(DataError, match="has more than 10 MB"):
        read_robot_document("b.urdf", folder=tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": 2}, "schema is 2"),
        (
            {"convention": "craig"},
            'convention is \'craig\'; "standard" or "modified" or "hayati" is needed',
        ),
        ({"joint": []}, r"one \[\[joint\]\] table for each joint"),
        ({"joint": [{"a_m": 0.0, "d_m": 0.1}]}, "joint joint_1: alpha_rad is missing"),
        (
            {"joint": [{"name": "j", "a_m": 0, "d_m": 0, "alpha_rad": 0}] * 2},
            "a name of its own for each joint",
        ),
        (
            {"joint": [{"a_m": 0, "d_m": 0, "alpha_rad": 0, "lower_deg": 9, "upper_deg": 3}]},
            r"lower_deg is 9\.0; less than upper_deg = 3\.0",
        ),
    ],
)
def test_a_wrong_table_is_refused_by_field(change, words):
    with pytest.raises(DataError, match=words):
        Robot.from_document(read_robot_document("ur5") | change)


def test_an_unknown_robot_lists_the_names():
    with pytest.raises(DataError, match=r"no robot named 'ur5f'\. Did you mean .*ur5") as caught:
        load_robot("ur5f")
    assert "The names are generic-6r-1800, irb120, panda" in caught.value.next_step


@pytest.mark.parametrize("shape", [(6,), (3, 7), (1, 2, 6)])
def test_joint_angles_of_another_shape_are_refused(shape):
    with pytest.raises(DataError, match="robot ur5 has 6 joints"):
        load_robot("ur5").base_from_flange(np.zeros(shape))


def test_shipped_tables_cite_their_source():
    for name in robot_names():
        assert read_robot_document(name)["source"]
        assert parse_toml(robot_file(read_robot_document(name))[1], name)


def test_descriptions_are_read_without_pinocchio():
    code = (
        "import sys; sys.modules['pinocchio'] = None\n"
        "from visioncal.robot import read_robot_document as read; print(read('ur5')['name'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "ur5"

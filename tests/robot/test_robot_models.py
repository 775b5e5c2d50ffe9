"""Robots as calibrations need them: derivatives, corrected models, and the files they go into."""

import json

import numpy as np
import pytest
from support.urdf_arm import of_urdf, some_changes, some_joints

from visioncal.core.documents.structured import read_yaml
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.robot import Robot, load_robot, robot_file, robot_names
from visioncal.robot.writing import (
    corrected_urdf,
    small_urdf,
    unexportable_functions,
    ur_kinematics_yaml,
)


def robots():
    return [*(load_robot(name) for name in robot_names()), of_urdf()]


def other(robot):
    return robot.corrected(*some_changes(robot))


def slope(poses, size):
    """Central differences (m, 6, size) of poses(step), a function of (size,) changes."""
    step, columns = 1e-5, []
    middle = invert(poses(np.zeros(size)))
    for at in range(size):
        change = np.zeros(size)
        change[at] = step
        columns.append((log(middle @ poses(change)) - log(middle @ poses(-change))) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("robot", [*robots(), other(load_robot("ur5e")), other(of_urdf())])
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
    joints = slope(lambda change: robot.base_from_flange(q + change), count)
    np.testing.assert_allclose(robot.joint_jacobian(q), joints, **tolerance)
    links = slope(placed, 6 * (count + 1))
    np.testing.assert_allclose(robot.placement_jacobian(q), links, **tolerance)
    functions = slope(functioning, 4 * count)
    np.testing.assert_allclose(robot.function_jacobian(q), functions, **tolerance)


def test_corrections_are_what_they_say():
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
def test_a_corrected_robot_stands_alone(robot, tmp_path):
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


@pytest.mark.parametrize(
    ("placements", "functions", "words"),
    [
        (np.zeros((3, 6)), None, r"placements of shape \(4, 6\)"),
        (None, np.zeros((3, 3)), r"functions of shape \(3, 4\)"),
        (None, np.full((3, 4), np.nan), "finite"),
        (None, np.eye(3, 4, 2), "prismatic joint has no eccentricity"),
        (None, -np.eye(3, 4, 1), "ratio is 0.0; a number above 0"),
    ],
)
def test_impossible_corrections_are_refused(placements, functions, words):
    with pytest.raises(DataError, match=words):
        of_urdf().corrected(placements, functions)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("type", "ball", "type is 'ball'"),
        ("axis", [0, 0, 2], "a vector of length 1"),
        ("axis", "z", "a list of 3 numbers"),
        ("placement", [[1, 0, 0, 0]] * 4, "no rigid transform"),
        ("placement", np.diag([1, 1, -1, 1]).tolist(), "no rigid transform"),
        ("placement", 7, "a list of 4 rows"),
        ("lower", 9.0, r"lower is 9\.0; less than upper"),
        ("ratio", -1.0, "ratio is -1.0"),
    ],
)
def test_a_wrong_chain_is_refused_by_field(field, value, words):
    document = json.loads(json.dumps(other(load_robot("ur5")).document))
    document["joint"][1][field] = value
    with pytest.raises(DataError, match=words) as caught:
        Robot.from_document(document)
    assert "shoulder_lift_joint" in str(caught.value)


def test_what_a_urdf_cannot_hold_is_said():
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
    with pytest.raises(DataError, match="a robot of a URDF"):
        corrected_urdf(load_robot("ur5"), load_robot("ur5"))


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


def test_abbs_arm_is_the_one_of_its_published_urdf():
    # ros-industrial/abb, irb120_3_58_macro.xacro: origins and axes of the joints, then tool0.
    origins = [(0, 0, 0), (0, 0, 0.29), (0, 0, 0.27), (0, 0, 0.07), (0.302, 0, 0), (0.072, 0, 0)]
    axes = np.eye(3)[[2, 1, 1, 0, 1, 0]]
    robot = load_robot("irb120")
    q = some_joints(robot)
    for angles, pose in zip(q, robot.base_from_flange(q), strict=True):
        chain = np.eye(4)
        for origin, axis, angle in zip(origins, axes, angles, strict=True):
            chain = (
                chain
                @ exp(np.array([0, 0, 0, *origin]))
                @ exp(np.array([*(angle * axis), 0, 0, 0]))
            )
        chain = chain @ exp(np.array([0, np.pi / 2, 0, 0, 0, 0]))
        np.testing.assert_allclose(pose, chain, atol=1e-14)

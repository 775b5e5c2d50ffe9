"""Joint tables: three conventions, from one to another, from any chain, and misread."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from visioncal.core.choices import CONVENTIONS
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.robot import Robot, load_robot
from visioncal.robot.conversion import convert_table, other_convention, parallel_axes, table_of
from visioncal.robot.files import robot_names
from visioncal.robot.tables import table_document, table_from_document
from visioncal.robot.writing import small_urdf

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
    there = convert_table(start, convention)
    assert there.convention == convention
    # Rounding of some ten products; nothing is computed anew, so the way back is exact.
    np.testing.assert_allclose(poses(there), poses(start), rtol=0, atol=1e-14)
    assert_same_table(convert_table(there, start.convention), start, atol=0.0)


@pytest.mark.parametrize("other", CONVENTIONS)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_conversions_of_any_table_come_back(convention, other):
    start = random_table(convention)
    there = convert_table(start, other)
    # d of some hundred metres where beta had been: 1e-16 of it, a few times over.
    np.testing.assert_allclose(poses(there), poses(start), rtol=0, atol=1e-12)
    assert_same_table(convert_table(there, convention), start, atol=1e-12)


@pytest.mark.parametrize("other", ["standard", "modified"])
@pytest.mark.parametrize("name", ["ur5e", "ur10e", "irb120", "generic-6r-1800"])
def test_nearly_parallel_axes_come_back_too(name, other):
    for seed in range(5):
        robot = disturbed(name, seed)
        hayati = table_of(robot, "hayati", like=table(name))
        there = convert_table(hayati, other)
        # What Hayati's form is for: the common normal is far away.
        assert np.abs(there.d_m).max() > 5.0 > 2.0 > np.abs(hayati.d_m).max()
        for dhtable in (hayati, there):
            np.testing.assert_allclose(poses(dhtable), poses(robot), rtol=0, atol=2e-12)
        assert_same_table(convert_table(there, "hayati"), hayati, atol=2e-12)


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
    if name == "panda":
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
        ({"a_m": 425.0}, "a_m is 425.0; .* under 20, .* looks like millimetres"),
        ({"gear_ratio": 0.0}, "gear_ratio is 0.0; a number above 0"),
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

"""Harmonics of the joints' functions: forward, back, their derivatives, and as a document."""

import json

import numpy as np
import pytest
from support.urdf_arm import of_urdf, some_changes, some_joints

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.robot import Robot, load_robot
from visioncal.robot.writing import unexportable_functions


def some_harmonics(robot, orders=5):
    rng = np.random.default_rng(2)
    return 1e-3 * rng.standard_normal((robot.joint_count, orders, 2))


@pytest.fixture
def wavy():
    robot = load_robot("ur5e")
    return robot.corrected(*some_changes(robot), some_harmonics(robot))


def test_they_turn_each_joint_as_they_say():
    robot = load_robot("ur5e")
    q, harmonics = some_joints(robot), some_harmonics(robot)
    turned = q.copy()
    for at in range(5):
        sine, cosine = harmonics[:, at].T
        turned += sine * np.sin((at + 2) * q) + cosine * np.cos((at + 2) * q)
    found = robot.corrected(harmonics=harmonics).base_from_flange(q)
    np.testing.assert_allclose(found, robot.base_from_flange(turned), atol=1e-14)


def test_their_jacobian_is_that_of_the_forward_kinematics(wavy):
    q, step = some_joints(wavy), 1e-5
    middle = invert(wavy.base_from_flange(q))
    jacobian = wavy.harmonic_jacobian(q, 7)
    rng = np.random.default_rng(3)
    for _ in range(3):
        change = rng.standard_normal((wavy.joint_count, 7, 2))
        ends = [
            log(middle @ wavy.corrected(harmonics=value * change).base_from_flange(q))
            for value in (step, -step)
        ]
        # The third order of the step, and rounding over it.
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(jacobian @ change.ravel(), slope, rtol=0, atol=1e-8)


def test_encoders_tell_again_where_the_joints_stand(wavy):
    q = some_joints(wavy)
    # Newton's last step squares what it was off by.
    np.testing.assert_allclose(wavy.chain.encoded(wavy.chain.effective(q)), q, atol=1e-13)
    step = 1e-6
    slopes = (wavy.chain.effective(q + step) - wavy.chain.effective(q - step)) / (2 * step)
    np.testing.assert_allclose(wavy.chain.jacobian(q), slopes, atol=1e-8)
    bends = (wavy.chain.jacobian(q + step) - wavy.chain.jacobian(q - step)) / (2 * step)
    np.testing.assert_allclose(wavy.chain.curvatures(q), bends, atol=1e-8)


def test_a_document_holds_them_to_the_last_bit(wavy):
    again = Robot.from_document(json.loads(json.dumps(wavy.document)))
    q = some_joints(wavy)
    assert np.array_equal(again.base_from_flange(q), wavy.base_from_flange(q))


def test_a_prismatic_joint_has_none():
    robot = of_urdf()
    q, harmonics = some_joints(robot), some_harmonics(robot)
    moved = robot.corrected(harmonics=harmonics).base_from_flange(q)
    harmonics[robot.chain.prismatic] = 0.0
    assert np.array_equal(moved, robot.corrected(harmonics=harmonics).base_from_flange(q))
    jacobian = robot.harmonic_jacobian(q, 5).reshape(len(q), 6, robot.joint_count, -1)
    assert not jacobian[:, :, robot.chain.prismatic].any()


@pytest.mark.parametrize("bad", [[[1.0]], [[0.0, 0.0]], 3.0, [["a", 0.0]] * 5])
def test_what_is_no_pairs_of_numbers_is_refused(wavy, bad):
    document = json.loads(json.dumps(wavy.document))
    document["joint"][2]["harmonics"] = bad
    with pytest.raises(DataError, match="harmonics"):
        Robot.from_document(document)


def test_files_that_cannot_hold_them_say_so(wavy):
    (first, *_) = unexportable_functions(wavy)
    assert "harmonics from order 2 on" in first
    assert unexportable_functions(load_robot("ur5e")) == ()

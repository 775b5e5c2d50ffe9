"""Inverse kinematics: poses are reached, near to the seed, within the limits, many at a time."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.marks import slow

from visioncal.robot import Robot, load_robot
from visioncal.robot.chain import chain_document
from visioncal.robot.files import robot_names
from visioncal.robot.inverse import Inverse

# A wrist bent and an elbow bent: far from every singular posture of a UR.
HOME = np.array([0.4, -1.3, 1.5, -1.75, -1.57, 0.3])


def with_chain(robot, **changes):
    return Robot.from_document(
        chain_document(robot.name, robot.tip, replace(robot.chain, **changes))
    )


def disturbed(robot, rng):
    """An arm whose links, gears and encoders all err."""
    n = robot.joint_count
    functions = np.column_stack([1e-3 * rng.normal(size=n), 1e-4 * rng.normal(size=n)])
    functions = np.column_stack([functions, 1e-3 * rng.normal(size=(n, 2))])
    functions[robot.chain.prismatic, 2:] = 0.0
    return robot.corrected(5e-4 * rng.normal(size=(n + 1, 6)), functions)


def reached(robot, pose, q, **options):
    """The posture found from joint angles q, and its own joint angles."""
    found = Inverse(robot).solve(pose, robot.chain.effective(q[None])[0], **options)
    return found, robot.chain.encoded(found.positions[None])[0]


# To the solver, arms that differ in length alone are the same.
ALIKE = re.compile(r"ur\d+e?|irb1200.*|cr5|a0509")


@pytest.mark.parametrize(
    "name", [slow(name) if ALIKE.fullmatch(name) else name for name in robot_names()]
)
def test_poses_are_reached_from_anywhere_within_the_limits(name):
    rng = np.random.default_rng(3)
    robot = disturbed(load_robot(name), rng)
    q = rng.uniform(
        np.maximum(robot.lower_rad, -3.0), np.minimum(robot.upper_rad, 3.0), (8, robot.joint_count)
    )
    for pose in robot.base_from_flange(q):
        found, joints = reached(robot, pose, np.zeros(robot.joint_count), widest_rad=0.0)
        assert found.reached
        # A nanometre and a nanoradian, as promised; of five joints, the position alone.
        flange = robot.base_from_flange(joints[None])[0]
        assert flange[:3, 3] == pytest.approx(pose[:3, 3], abs=1e-9)
        assert robot.joint_count < 6 or flange == pytest.approx(pose, abs=1e-9)
        assert (robot.lower_rad - 1e-12 <= joints).all()
        assert (joints <= robot.upper_rad + 1e-12).all()


def test_the_branch_is_that_of_the_seed():
    robot = load_robot("ur5e")
    flipped = HOME * [1, 1, 1, 1, -1, 1] + [0, 0, 0, np.pi, 0, np.pi]
    for seed in (HOME, flipped):
        (pose,) = robot.base_from_flange(seed[None])
        near = seed + np.random.default_rng(6).uniform(-0.2, 0.2, 6)
        _, joints = reached(robot, pose, near)
        # Newton's end is as exact as the pose, divided by the least singular value, some tenths.
        assert joints == pytest.approx(seed, abs=1e-8)


def test_whole_turns_keep_to_the_seed():
    robot = disturbed(load_robot("ur5e"), np.random.default_rng(7))
    turned = HOME + np.array([-2, 2, -2, 2, 2, -2]) * np.pi
    (pose,) = robot.base_from_flange(turned[None])
    _, joints = reached(robot, pose, turned + 0.1)
    assert joints == pytest.approx(turned, abs=1e-8)
    _, joints = reached(robot, pose, HOME + 0.1)
    # A gear's ratio of 1 + 1e-4 makes a turn of the axis another one of the encoder: 1 mrad or so,
    # and the same flange.
    assert joints == pytest.approx(HOME, abs=5e-3)
    assert np.abs(joints - HOME).max() > 1e-5
    assert robot.base_from_flange(joints[None])[0] == pytest.approx(pose, abs=1e-9)


def test_a_limit_in_the_way_is_kept():
    free = load_robot("irb120")
    q = np.array([0.2, 0.4, 0.3, 0.5, 0.9, 0.1])
    upper = free.upper_rad.copy()
    upper[0] = -0.5
    robot = with_chain(free, upper=upper, lower=np.array([-0.7, *free.lower_rad[1:]]))
    (pose,) = free.base_from_flange(q[None])
    found, joints = reached(robot, pose, q)
    assert not found.reached
    assert joints[0] <= -0.5


def test_an_unreachable_target_is_reported_with_the_nearest_distance():
    robot = load_robot("ur5e")
    found, _ = reached(robot, np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * 2.0, HOME)
    assert not found.reached
    # A UR5e reaches 0.95 m from its shoulder at the most.
    assert 1.0 < found.off_m < 1.3


def test_a_seventh_joint_stays_near_to_the_seed():
    robot = load_robot("panda")
    seed = np.array([0.1, -0.5, 0.2, -2.0, 0.1, 1.6, 0.7])
    (pose,) = robot.base_from_flange(seed[None])
    shifted = pose.copy()
    shifted[:3, 3] += 1e-3
    found, joints = reached(robot, shifted, seed)
    assert found.reached
    shortest = np.linalg.pinv(robot.joint_jacobian(seed[None])[0])
    step = shortest @ np.concatenate([np.zeros(3), pose[:3, :3].T @ np.full(3, 1e-3)])
    # The shortest step of first order; the second order of 5 mrad is under 1e-4.
    assert joints - seed == pytest.approx(step, abs=1e-4)


def test_five_axes_reach_the_position_and_nearly_the_rotation():
    six = load_robot("irb120")
    keep = [0, 1, 2, 4, 5]
    placements = six.chain.placements.copy()
    placements[4] = placements[3] @ placements[4]
    five = with_chain(
        six,
        joint_names=tuple(six.joint_names[index] for index in keep),
        prismatic=six.chain.prismatic[keep],
        axes=six.chain.axes[keep],
        placements=np.delete(placements, 3, axis=0),
        lower=six.lower_rad[keep],
        upper=six.upper_rad[keep],
        functions=six.chain.functions[keep],
    )
    real = disturbed(five, np.random.default_rng(8))
    q = np.array([0.2, 0.3, 0.1, 0.7, 0.4])
    (pose,) = five.base_from_flange(q[None])
    found, joints = reached(real, pose, q)
    assert found.reached
    assert np.linalg.norm(real.base_from_flange(joints[None])[0, :3, 3] - pose[:3, 3]) < 1e-9
    # Links that err by a milliradian or two.
    assert 1e-5 < found.off_rad < 1e-2
    pose[:3, :3] = pose[:3, :3] @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert not reached(real, pose, q)[0].reached


@pytest.mark.parametrize("name", ["ur10e", slow("irb120"), "panda", slow("gen3")])
def test_random_starts_lead_to_poses_in_reach_by_all_branches(name):
    robot, rng = load_robot(name), np.random.default_rng(2)
    inverse = Inverse(robot)
    q = robot.chain.encoded(inverse.starts(100, rng))
    poses = np.repeat(robot.base_from_flange(q), 4, axis=0)
    positions, reached = inverse.from_starts(poses, inverse.starts(400, rng))
    # What fails ends at a limit, or near a singular posture. The search for stops tries three times
    # as many views as it still needs: a quarter that succeeds takes it a second round.
    assert reached.mean() > 0.25
    flanges = robot.base_from_flange(robot.chain.encoded(positions[reached]))
    # A nanometre and a nanoradian, as promised.
    np.testing.assert_allclose(flanges, poses[reached], atol=1e-9)
    bounds = robot.chain.effective(np.array([robot.lower_rad, robot.upper_rad]))
    assert np.all((positions[reached] >= bounds[0]) & (positions[reached] <= bounds[1]))
    # Four starts of one pose end on several branches of most.
    ends = [
        found[mask]
        for found, mask in zip(positions.reshape(100, 4, -1), reached.reshape(100, 4), strict=True)
    ]
    apart = [np.ptp(np.sin(end), axis=0).max() > 0.1 for end in ends if len(end) > 1]
    assert np.mean(apart) > 0.5
    farther = poses.copy()
    farther[:, :3, 3] *= 10.0 / np.linalg.norm(farther[:, :3, 3], axis=1, keepdims=True)
    assert not inverse.from_starts(farther, inverse.starts(400, rng))[1].any()

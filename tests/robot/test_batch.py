"""Many postures at a time: frames, the atlas that knows where an arm reaches, and ways to poses."""

import numpy as np
import pytest

from visioncal.robot import load_robot, robot_names
from visioncal.robot.batch import chain_frames
from visioncal.robot.capability_map import CapabilityMap
from visioncal.robot.inverse import Inverse

ARMS = [name for name in robot_names() if load_robot(name).joint_count >= 6]


@pytest.mark.parametrize("name", robot_names())
def test_frames_are_those_of_pinocchio(name):
    robot = load_robot(name)
    positions = Inverse(robot).starts(4, np.random.default_rng(1))
    frames = chain_frames(robot.chain, positions)
    # Some hundred roundings of lengths about 1.
    for found, q in zip(frames, robot.chain.encoded(positions), strict=True):
        np.testing.assert_allclose(found, robot.link_frames(q), atol=1e-13)


@pytest.mark.parametrize("name", ARMS)
def test_an_atlas_knows_what_is_in_reach_and_leads_there(name):
    robot, rng = load_robot(name), np.random.default_rng(2)
    inverse = Inverse(robot)
    atlas = CapabilityMap(robot, inverse, rng)
    q = robot.chain.encoded(inverse.starts(300, rng))
    poses = robot.base_from_flange(q)
    within, starts = atlas.starts(poses, rng)
    # It learned from a thousand poses how far the next posture is: one in a thousand is farther.
    assert within.mean() > 0.98
    positions, reached = inverse.from_starts(poses[within], starts)
    # What fails is near a limit or a singular posture; a start at random fails as often.
    assert reached.mean() > 0.65
    there = robot.base_from_flange(robot.chain.encoded(positions[reached]))
    # A nanometre and a nanoradian, as promised.
    np.testing.assert_allclose(there, poses[within][reached], atol=1e-9)
    bounds = robot.chain.effective(np.array([robot.lower_rad, robot.upper_rad]))
    assert np.all((positions[reached] >= bounds[0]) & (positions[reached] <= bounds[1]))
    farther = poses.copy()
    farther[:, :3, 3] *= 10.0 / np.linalg.norm(farther[:, :3, 3], axis=1, keepdims=True)
    assert not atlas.starts(farther, rng)[0].any()


def test_an_atlas_leads_to_all_branches():
    robot, rng = load_robot("ur5e"), np.random.default_rng(3)
    inverse = Inverse(robot)
    (pose,) = robot.base_from_flange(np.array([[0.4, -1.3, 1.5, -1.75, -1.2, 0.3]]))
    poses = np.repeat(pose[None], 400, axis=0)
    positions, reached = inverse.from_starts(
        poses, CapabilityMap(robot, inverse, rng).starts(poses, rng)[1]
    )
    branches = {tuple(np.sign(np.sin(position[[2, 4]]))) for position in positions[reached]}
    # Six neighbours of one pose lie on several branches.
    assert len(branches) > 1

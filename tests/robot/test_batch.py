"""Many postures at a time: frames, and ways to poses."""

import numpy as np
import pytest

from visioncal.robot import load_robot, robot_names
from visioncal.robot.inverse import Inverse, chain_frames

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
def test_random_starts_lead_to_poses_in_reach_by_all_branches(name):
    robot, rng = load_robot(name), np.random.default_rng(2)
    inverse = Inverse(robot)
    q = robot.chain.encoded(inverse.starts(100, rng))
    poses = np.repeat(robot.base_from_flange(q), 4, axis=0)
    positions, reached = inverse.from_starts(poses, inverse.starts(400, rng))
    # What fails ends at a limit, or near a singular posture. The search for stops tries three times
    # as many views as it still needs: a quarter that succeeds takes it a second round.
    assert reached.mean() > 0.25
    there = robot.base_from_flange(robot.chain.encoded(positions[reached]))
    # A nanometre and a nanoradian, as promised.
    np.testing.assert_allclose(there, poses[reached], atol=1e-9)
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

"""Errors that follow the arm's posture: told from noise, and counted."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, error_of
from support.marks import slow

import visioncal
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.estimation.arm import LEVER_M, link_basis, pose_basis
from visioncal.estimation.armmodel import ArmModel
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, fine_camera, simulate, write_session

WRONG = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
MOUNTS = ("eye-in-hand", "eye-to-hand")


def test_links_move_the_flange_as_their_basis_says():
    robot = load_robot("ur5e")
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 6))
    basis, step = link_basis(robot, q), 1e-6
    for row, angles in enumerate(q):
        links = robot.link_frames(angles)
        for link in range(6):
            for axis in range(6):
                twist = np.zeros(6)
                twist[axis] = step * (1.0 if axis < 3 else LEVER_M)
                moved = links[link] @ exp(twist) @ invert(links[link]) @ links[-1]
                slope = log(invert(links[-1]) @ moved) / step
                # The first order of a step of 1e-6.
                np.testing.assert_allclose(basis[row, :, 6 * link + axis], slope, atol=1e-5)


@pytest.mark.parametrize("tool_m", [0.0, 0.1])
def test_the_mean_of_noise_is_no_tool(tool_m):
    robot, rng, tool = load_robot("ur5e"), np.random.default_rng(0), np.eye(4)
    tool[2, 3] = tool_m
    q = rng.uniform(-1.5, 1.5, (25, 6))
    noise = exp(rng.normal(size=(25, 6)) * np.repeat([5e-5, 3e-5], 3))
    found = ArmModel.of(robot, q, robot.base_from_flange(q) @ tool @ noise).flange_from_reported
    if tool_m:
        # Five times the standard deviation of a mean of 25.
        np.testing.assert_allclose(found, tool, atol=5e-5)
    else:
        np.testing.assert_array_equal(found, np.eye(4))


def test_base_and_flange_move_the_flange_as_their_basis_says():
    pose = compose(np.eye(3)[[1, 2, 0]][None], np.array([[0.3, -0.2, 0.5]]))
    basis, step = pose_basis(pose), 1e-6
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = step * (1.0 if axis < 3 else LEVER_M)
        slope = log(invert(pose[0]) @ exp(twist) @ pose[0]) / step
        np.testing.assert_allclose(basis[0, :, 6 + axis], slope, atol=1e-5)
        np.testing.assert_allclose(basis[0, :, axis], twist / step, atol=1e-12)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
@pytest.mark.parametrize("joints", [slow(True), False], ids=["joints", "poses only"])
def test_a_wrong_arm_is_noticed_and_counts_in_the_covariance(mount, joints):
    surprises = []
    for seed in range(2):
        cell = simulate(replace(WRONG, mount=mount, seed=seed))
        known = calibrated(cell, joints=joints)
        assert known.robot_arm.errors is not None
        assert known.robot_arm.errors.of_links == joints
        # A scale of thirty to fifty random effects: its own sigma is some 15 %; of a flange, what
        # looks the same in all views is not in it.
        sigma = known.robot_arm.errors.sigma
        if not joints:
            (found,) = known.assessment.arms.values()
            sigma = np.deg2rad(found.sections.arm_errors.sigma_deg)
        assert 1e-4 < sigma < 3e-3
        told = known.notes if joints else [warning.words for warning in known.warnings]
        assert any(("was calibrated" if joints else "arm's posture") in name for name in told)
        error, covariance = error_of(cell, known), known.assessment.covariance[:12, :12]
        surprises.append(error @ np.linalg.solve(covariance, error) / 12)
    # Without it, this is about a hundred.
    assert np.mean(surprises) < 2.0


@pytest.mark.parametrize("dh", [0.0, 1e-3])
def test_measured_poses_alone_tell_a_wrong_arm_too(dh, tmp_path):
    options = replace(WRONG, dh_sigma_m=0.5 * dh, dh_sigma_rad=dh)
    result = visioncal.calibrate(write_session(simulate(options), tmp_path / "cell", images=False))
    assert (result.arm_errors is not None) == (dh > 0.0)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
@pytest.mark.parametrize("sigma", [5e-5, slow(5e-4)])
def test_white_noise_is_not_taken_for_a_wrong_arm(mount, sigma):
    options = CellOptions(
        mount=mount,
        camera=fine_camera(),
        robot_sigma_rad=sigma,
        robot_sigma_m=0.6 * sigma,
    )
    for joints in (True, False):
        errors = calibrated(simulate(options), joints=joints).robot_arm.errors
        assert errors is None or not errors.is_likely

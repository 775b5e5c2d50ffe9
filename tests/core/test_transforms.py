"""SE(3) in batches, against scipy's RigidTransform and against central differences."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core import transforms


@pytest.fixture
def poses():
    rng = np.random.default_rng(4)
    rotation = Rotation.random(30, rng=rng).as_matrix()
    return transforms.compose(rotation, rng.normal(size=(30, 3)))


def test_invert_undoes_and_agrees_with_scipy(poses):
    # Products of matrices of order one in double precision.
    np.testing.assert_allclose(
        transforms.invert(poses) @ poses, np.tile(np.eye(4), (30, 1, 1)), atol=1e-14
    )
    expected = RigidTransform.from_matrix(poses).inv().as_matrix()
    np.testing.assert_allclose(transforms.invert(poses), expected, atol=1e-14)


def test_exp_and_log_undo_each_other(poses):
    np.testing.assert_allclose(transforms.exp(transforms.log(poses)), poses, atol=1e-12)


def test_adjoint_carries_a_twist_to_the_other_side(poses):
    twist = np.random.default_rng(5).normal(size=(30, 6))
    carried = (transforms.adjoint(poses) @ twist[:, :, None])[:, :, 0]
    np.testing.assert_allclose(
        transforms.exp(carried) @ poses, poses @ transforms.exp(twist), atol=1e-12
    )


def test_inverse_right_jacobian_agrees_with_central_differences():
    rng = np.random.default_rng(6)
    twists = rng.uniform(-1, 1, (20, 6))
    twists[:, :3] *= 0.5 / np.linalg.norm(twists[:, :3], axis=1, keepdims=True)
    analytic = transforms.inverse_right_jacobian(twists)
    step = 1e-5
    for axis in range(6):
        shift = np.zeros(6)
        shift[axis] = step
        ahead = transforms.log(transforms.exp(twists) @ transforms.exp(shift))
        behind = transforms.log(transforms.exp(twists) @ transforms.exp(-shift))
        # Truncation step^2 = 1e-10 and rounding 1e-16 / step = 1e-11, times terms of order ten.
        np.testing.assert_allclose(analytic[:, :, axis], (ahead - behind) / (2 * step), atol=2e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, np.pi - 1e-9, np.pi])
def test_rotation_angle_is_exact_at_both_ends(angle):
    rotation = Rotation.from_rotvec([0.0, angle * 0.6, angle * 0.8]).as_matrix()
    # arctan2 of sine and cosine loses nothing at 0; at pi the sine's rounding is the angle's.
    assert transforms.rotation_angle(rotation) == pytest.approx(angle, abs=1e-15)


def test_nearest_rotation_repairs_and_never_reflects(poses):
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(transforms.nearest_rotation(2.5 * rotation), rotation, atol=1e-13)
    mirrored = rotation @ np.diag([1.0, 1.0, -1.0])
    assert np.all(np.linalg.det(transforms.nearest_rotation(mirrored)) > 0.999)


def test_mean_transform_of_a_symmetric_pair_is_the_middle(poses):
    twist = np.array([0.1, -0.2, 0.05, 0.0, 0.0, 0.0])
    pair = np.stack([poses[0] @ transforms.exp(twist), poses[0] @ transforms.exp(-twist)])
    np.testing.assert_allclose(transforms.mean_transform(pair), poses[0], atol=1e-14)

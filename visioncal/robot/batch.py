"""Batched forward and inverse kinematics of one arm.

Joint positions are effective ones here (`Chain.effective`).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray, Mask
from visioncal.robot.chain import Chain

# Newton steps from any posture: of poses in reach half converge, most of them within twenty.
_STEPS = 40
# Regularises singular systems; far below the square of any relevant singular value.
_FLOOR = 1e-13


def chain_frames(chain: Chain, positions: FloatArray) -> FloatArray:
    """Frames of the joints, after their motion, and of the tip, in the base.

    Returns:
        (m, n + 1, 4, 4) at (m, n) effective positions [m].
    """
    frames = np.zeros((len(positions), len(chain) + 1, 4, 4))
    frames[..., 3, 3] = 1.0
    rotation = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    position = np.zeros((len(positions), 3))
    for joint, placement in enumerate(chain.placements):
        position = position + rotation @ placement[:3, 3]
        rotation = rotation @ placement[:3, :3]
        if joint < len(chain):
            motion = positions[:, joint, None]
            if chain.prismatic[joint]:
                position = position + motion * (rotation @ chain.axes[joint])
            else:
                # Rodrigues' formula.
                crossed = rotation @ skew(chain.axes[joint])
                crossed_twice = crossed @ skew(chain.axes[joint])
                motion = motion[:, :, None]
                rotation = (
                    rotation + np.sin(motion) * crossed + (1.0 - np.cos(motion)) * crossed_twice
                )
        frames[:, joint, :3, :3], frames[:, joint, :3, 3] = rotation, position
    return frames


def reached_from(
    chain: Chain,
    base_from_tip: FloatArray,
    starts: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    good: float,
) -> tuple[FloatArray, Mask]:
    """Inverse kinematics by damped Newton steps from given postures.

    The damping vanishes with the error (Sugihara 2011); an arm with more than six joints takes the
    shortest step. Postures that do not converge in a few steps are given up.

    Args:
        chain: The arm, with six joints or more.
        base_from_tip: (m, 4, 4) the poses [m].
        starts: (m, n) effective positions to start from [rad or m].
        bounds: (n,) least and greatest effective positions.
        good: Greatest error of a reached pose [m and rad].

    Returns:
        (m, n) positions, and whether the pose was reached there (m,).
    """
    positions = np.clip(starts, *bounds)
    active = np.arange(len(positions))
    for step in range(_STEPS + 1):
        frames = chain_frames(chain, positions[active])
        error = _pose_error(frames[:, -1], base_from_tip[active])
        unreached = np.linalg.norm(error.reshape(-1, 2, 3), axis=2).max(axis=1) >= good
        active, frames, error = active[unreached], frames[unreached], error[unreached]
        if step == _STEPS or not len(active):
            break
        jacobian = _jacobian(chain, frames)
        gram = jacobian @ np.swapaxes(jacobian, 1, 2)
        damping = np.sum(error**2, axis=1) + _FLOOR
        gram += damping[:, None, None] * np.eye(6)
        solved = np.linalg.solve(gram, error[:, :, None])
        moved = positions[active] + (np.swapaxes(jacobian, 1, 2) @ solved)[:, :, 0]
        positions[active] = np.clip(moved, *bounds)
    reached = np.ones(len(positions), dtype=bool)
    reached[active] = False
    return positions, reached


def _pose_error(base_from_tip: FloatArray, wanted: FloatArray) -> FloatArray:
    """Error to wanted poses: (m, 6) rotation [rad] and translation [m], along the base's axes."""
    turn = wanted[:, :3, :3] @ np.swapaxes(base_from_tip[:, :3, :3], 1, 2)
    offset = wanted[:, :3, 3] - base_from_tip[:, :3, 3]
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), offset], axis=1)


def _jacobian(chain: Chain, frames: FloatArray) -> FloatArray:
    """Geometric Jacobian (m, 6, n) of the tip along the base's axes."""
    joints, tip = frames[:, :-1], frames[:, -1]
    axes = (joints[..., :3, :3] @ chain.axes[:, :, None])[..., 0]
    arms = np.cross(axes, tip[:, None, :3, 3] - joints[..., :3, 3])
    slides = chain.prismatic[:, None]
    moves = np.concatenate([np.where(slides, 0.0, axes), np.where(slides, axes, arms)], axis=2)
    return np.swapaxes(moves, 1, 2)

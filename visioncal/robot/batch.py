"""Many postures of one arm at a time: their links' frames, and Newton's way to as many poses.

Joints stand at their effective positions here (`Chain.effective`).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray, Mask
from visioncal.robot.chain import Chain

# Steps to a pose from near to it: an error squares from step to step.
_STEPS = 8
# Keeps a singular system solvable; far below the square of any singular value that matters.
_FLOOR = 1e-13


def chain_frames(chain: Chain, positions: FloatArray) -> FloatArray:
    """Computes where the joints and the tip are.

    Args:
        chain: The arm.
        positions: (m, n) effective positions [rad or m].

    Returns:
        (m, n + 1, 4, 4) the joints' frames after their motion, and the tip's, in the base [m].
    """
    frames = np.zeros((len(positions), len(chain) + 1, 4, 4))
    frames[..., 3, 3] = 1.0
    rotation = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    place = np.zeros((len(positions), 3))
    for joint, placement in enumerate(chain.placements):
        place = place + rotation @ placement[:3, 3]
        rotation = rotation @ placement[:3, :3]
        if joint < len(chain):
            by = positions[:, joint, None]
            if chain.prismatic[joint]:
                place = place + by * (rotation @ chain.axes[joint])
            else:
                # Rodrigues' formula.
                crossed = rotation @ skew(chain.axes[joint])
                twice = crossed @ skew(chain.axes[joint])
                by = by[:, :, None]
                rotation = rotation + np.sin(by) * crossed + (1.0 - np.cos(by)) * twice
        frames[:, joint, :3, :3], frames[:, joint, :3, 3] = rotation, place
    return frames


def reached_from(
    chain: Chain,
    base_from_tip: FloatArray,
    starts: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    good: float,
) -> tuple[FloatArray, Mask]:
    """Goes to poses from postures that are near to them, by damped steps of Newton.

    The damping vanishes with the error (Sugihara 2011); of an arm with more than six joints the
    step is the shortest one. Postures that do not arrive in a few steps are given up.

    Args:
        chain: The arm, with six joints or more.
        base_from_tip: (m, 4, 4) the poses [m].
        starts: (m, n) effective positions to start from [rad or m].
        bounds: (n,) least and greatest effective positions.
        good: A pose is reached from here on [m and rad].

    Returns:
        (m, n) positions, and whether the pose was reached there (m,).
    """
    found = np.clip(starts, *bounds)
    going = np.arange(len(found))
    for step in range(_STEPS + 1):
        frames = chain_frames(chain, found[going])
        left = _left(frames[:, -1], base_from_tip[going])
        far = np.linalg.norm(left.reshape(-1, 2, 3), axis=2).max(axis=1) >= good
        going, frames, left = going[far], frames[far], left[far]
        if step == _STEPS or not len(going):
            break
        jacobian = _jacobian(chain, frames)
        gram = jacobian @ np.swapaxes(jacobian, 1, 2)
        damping = np.sum(left**2, axis=1) + _FLOOR
        gram += damping[:, None, None] * np.eye(6)
        pulled = np.linalg.solve(gram, left[:, :, None])
        moved = found[going] + (np.swapaxes(jacobian, 1, 2) @ pulled)[:, :, 0]
        found[going] = np.clip(moved, *bounds)
    reached = np.ones(len(found), dtype=bool)
    reached[going] = False
    return found, reached


def _left(base_from_tip: FloatArray, wanted: FloatArray) -> FloatArray:
    """What is left to poses: (m, 6) rotation [rad] and translation [m], along the base's axes."""
    turn = wanted[:, :3, :3] @ np.swapaxes(base_from_tip[:, :3, :3], 1, 2)
    way = wanted[:, :3, 3] - base_from_tip[:, :3, 3]
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), way], axis=1)


def _jacobian(chain: Chain, frames: FloatArray) -> FloatArray:
    """How the tip moves (m, 6, n) with the joints, along the base's axes."""
    joints, tip = frames[:, :-1], frames[:, -1]
    axes = (joints[..., :3, :3] @ chain.axes[:, :, None])[..., 0]
    arms = np.cross(axes, tip[:, None, :3, 3] - joints[..., :3, 3])
    slides = chain.prismatic[:, None]
    moves = np.concatenate([np.where(slides, 0.0, axes), np.where(slides, axes, arms)], axis=2)
    return np.swapaxes(moves, 1, 2)

"""Rotations that are hard to write down: some form of them is singular there."""

import numpy as np
from scipy.spatial.transform import Rotation
from support import readers

RNG = np.random.default_rng(3)


def rotation_cases():
    """Rotations by kind: any, and those at which some form of writing them is singular."""
    quarter, half = np.pi / 2, np.pi
    turns = RNG.uniform(-half, half, (10, 2))
    axes = RNG.normal(size=(8, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    r = readers
    return {
        "any": list(Rotation.random(16, rng=RNG).as_matrix()),
        "identity": [np.eye(3)],
        "pitch of 90": [r.rz(a) @ r.ry(s * quarter) @ r.rx(b) for a, b in turns for s in (-1, 1)],
        "second x y z angle of 90": [
            r.rx(a) @ r.ry(s * quarter) @ r.rz(b) for a, b in turns for s in (-1, 1)
        ],
        "second z y z angle of 0 or 180": [
            r.rz(a) @ r.ry(m) @ r.rz(b) for a, b in turns for m in (0.0, half)
        ],
        "by 180": [
            *(2 * np.outer(axis, axis) - np.eye(3) for axis in axes),
            *(r.rx(half), r.ry(half), r.rz(half)),
        ],
        "tiny": list(Rotation.from_rotvec(1e-7 * axes).as_matrix()),
        "near 180": list(Rotation.from_rotvec((half - 1e-9) * axes).as_matrix()),
        "near a pitch of 90": [
            r.rz(a) @ r.ry(quarter - off) @ r.rx(b)
            for (a, b), off in zip(turns, np.geomspace(1e-12, 1e-4, len(turns)), strict=True)
        ],
    }


CASES = rotation_cases()

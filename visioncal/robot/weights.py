"""Basis functions of the gravity torques of links with unknown masses.

The torque on a joint is linear in mass and first moments of all that moves with it (Khalil and
Dombre 2002, chapter 9); the independent combinations of these are functions of the posture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot.model import Robot

# Number of random postures, and relative singular value below which functions are dependent.
_POSTURES, _RANK = 200, 1e-8


@dataclass(frozen=True, eq=False)
class WeightFunctions:
    """Independent gravity torque functions of each joint."""

    # For each joint (4 n, r), the combinations of masses and first moments of its r functions,
    # whose root mean square over postures is 1.
    parts: tuple[FloatArray, ...]

    @classmethod
    def of(cls, robot: Robot) -> "WeightFunctions":
        """Finds the functions of an arm, over random postures."""
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSTURES, robot.joint_count))
        jacobian = np.moveaxis(robot.weight_jacobian(q), 1, 0)
        return cls(tuple(_independent(value) for value in jacobian))

    @property
    def size(self) -> int:
        """Total number of functions."""
        return sum(part.shape[1] for part in self.parts)

    def values(self, robot: Robot, q: FloatArray) -> FloatArray:
        """Values (m, n, size) of the functions at (m, n) joint angles, zero for other joints."""
        jacobian = robot.weight_jacobian(q)
        values, at = np.zeros((*q.shape, self.size)), 0
        for joint, part in enumerate(self.parts):
            values[:, joint, at : at + part.shape[1]] = jacobian[:, joint] @ part
            at += part.shape[1]
        return values

    def moments(self, values: Sequence[float] | FloatArray) -> FloatArray:
        """Compliances times masses and moments, (n, 4 n), of (size,) coefficients."""
        rows, at = [], 0
        for part in self.parts:
            rows.append(part @ np.asarray(values)[at : at + part.shape[1]])
            at += part.shape[1]
        return np.array(rows)


def _independent(jacobian: FloatArray) -> FloatArray:
    """Independent combinations (4 n, r) of the columns of (m, 4 n) derivatives, of unit rms."""
    _, sizes, vectors = np.linalg.svd(jacobian, full_matrices=False)
    kept = sizes > _RANK * max(float(sizes.max(initial=0.0)), 1.0)
    return np.asarray(np.sqrt(len(jacobian)) * vectors[kept].T / sizes[kept])

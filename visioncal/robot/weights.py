"""How the weight of links of unknown masses may turn the joints.

Its torque on a joint is linear in mass and first moments of what hangs on the joint (Khalil and
Dombre 2002, chapter 9): so many functions of the posture as these have independent effects.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot.model import Robot

# Postures that stand for all, and from where on a function is another's multiple.
_POSTURES, _RANK = 200, 1e-8


@dataclass(frozen=True, eq=False)
class WeightFunctions:
    """The functions of the posture that the weight of links can be, joint by joint.

    Attributes:
        parts: One (4 n, r) matrix a joint: which masses and first moments make up each of its r
            functions, whose root mean square over postures is 1.
    """

    parts: tuple[FloatArray, ...]

    @classmethod
    def of(cls, robot: Robot) -> "WeightFunctions":
        """Finds the functions of an arm, by postures all around."""
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSTURES, robot.joint_count))
        jacobian = np.moveaxis(robot.weight_jacobian(q), 1, 0)
        return cls(tuple(_independent(value) for value in jacobian))

    @property
    def size(self) -> int:
        """How many functions there are in all."""
        return sum(part.shape[1] for part in self.parts)

    def bends(self, robot: Robot, q: FloatArray) -> FloatArray:
        """The functions' values at (m, n) joint angles: (m, n, size), each for its joint alone."""
        jacobian = robot.weight_jacobian(q)
        values, at = np.zeros((*q.shape, self.size)), 0
        for joint, part in enumerate(self.parts):
            values[:, joint, at : at + part.shape[1]] = jacobian[:, joint] @ part
            at += part.shape[1]
        return values

    def moments(self, values: Sequence[float] | FloatArray) -> FloatArray:
        """The (n, 4 n) masses and moments times compliances that (size,) shares stand for."""
        rows, at = [], 0
        for part in self.parts:
            rows.append(part @ np.asarray(values)[at : at + part.shape[1]])
            at += part.shape[1]
        return np.array(rows)


def _independent(jacobian: FloatArray) -> FloatArray:
    """Combinations (4 n, r) of columns of (m, 4 n) slopes that are independent, of unit size."""
    _, sizes, across = np.linalg.svd(jacobian, full_matrices=False)
    kept = sizes > _RANK * max(float(sizes.max(initial=0.0)), 1.0)
    return np.asarray(np.sqrt(len(jacobian)) * across[kept].T / sizes[kept])

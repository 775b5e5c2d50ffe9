"""Deflection of joints by torques of gravity and loads."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot.loads import Loads
from visioncal.robot.model import Robot

# Prior of a compliance of which nothing is known: a gear of 10 kN m/rad [rad/(N m)].
SOFT = 1e-4
# Beginning of a remark on the springs.
BENDS = "The joints bend under load"
BY_CONTROLLER, OF_MASSES = "compensated by the controller", "of the model's masses"


def deflected_joints(
    robot: Robot,
    q: FloatArray,
    compliance: FloatArray,
    loads: Loads | None = None,
    moments: FloatArray | None = None,
) -> FloatArray:
    """Joint angles under load: iterates `joint_deflections` to its fixed point.

    Args:
        robot: The rigid arm.
        q: (m, n) joint angles of the encoders [rad].
        compliance: (n,) compliance of each joint [rad/(N m)].
        loads: Payloads and forces; none where None.
        moments: (n, 4 n) compliance times mass and first moments of links of unknown mass, joint by
            joint; None where masses are known or neglected.

    Returns:
        (m, n) joint angles of the rigid arm in the same posture [rad].
    """
    bent = np.asarray(q, dtype=float)
    if not compliance.any() and moments is None:
        return bent
    # Fixed-point iterations of the deflection: a deflection changes torques by about as large a
    # share, so that the remaining error is below its cube.
    for _ in range(3):
        bent = q + joint_deflections(robot, bent, compliance, loads, moments)
    return bent


def joint_deflections(
    robot: Robot,
    q: FloatArray,
    compliance: FloatArray,
    loads: Loads | None = None,
    moments: FloatArray | None = None,
) -> FloatArray:
    """Joint deflections (m, n) under load at (m, n) angles [rad]; see `deflected_joints`."""
    deflections = compliance * robot.load_torques(q, loads)
    if moments is None:
        return np.asarray(deflections)
    return np.asarray(deflections + np.einsum("mjk,jk->mj", robot.weight_jacobian(q), moments))


@dataclass(frozen=True, eq=False)
class WeightFunctions:
    """Independent gravity torque functions of each joint, for links of unknown masses.

    The torque on a joint is linear in mass and first moments of all that moves with it (Khalil and
    Dombre 2002, chapter 9); the independent combinations of these are functions of the posture.
    """

    # For each joint (4 n, r), the combinations of masses and first moments of its r functions,
    # whose root mean square over postures is 1.
    parts: tuple[FloatArray, ...]

    @classmethod
    def of(cls, robot: Robot) -> "WeightFunctions":
        """Finds the functions of an arm, over random postures."""
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, robot.joint_count))
        jacobian = np.moveaxis(robot.weight_jacobian(q), 1, 0)
        parts = []
        for derivatives in jacobian:
            _, sizes, vectors = np.linalg.svd(derivatives, full_matrices=False)
            kept = sizes > 1e-8 * max(float(sizes.max(initial=0.0)), 1.0)
            parts.append(np.sqrt(len(q)) * vectors[kept].T / sizes[kept])
        return cls(tuple(parts))

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


def weight_words(robot: Robot) -> str:
    """Where the deflection by the links' own weight comes from."""
    if robot.weight_compensated:
        return BY_CONTROLLER
    return "unknown" if robot.masses is None else OF_MASSES

"""The torques of a moving arm, which are linear in its links' inertial parameters.

Joint angles are those of the encoders; torques are about the joints' axes. Rigid bodies, no
friction, and gravity as the robot's description has it.
"""

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.robot.inertia import Inertias, moving
from visioncal.robot.kinematics import regressors
from visioncal.robot.model import Robot


def torque_regressor(
    robot: Robot,
    q: FloatArray,
    dq: FloatArray,
    ddq: FloatArray,
    columns: IntArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Derivatives of the joints' torques by the links' inertial parameters.

    Args:
        robot: The arm.
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].
        ddq: (m, n) their accelerations [rad/s^2].
        columns: (c,) which parameters are wanted; all where None.
        out: (m, c or more, n) where to write them, parameters before joints; new where None.

    Returns:
        (m, n, c) in the order of `Inertias.values` [N m for a unit of each].

    Raises:
        DataError: A shape is wrong.
    """
    states = effective_states(robot, q, dq, ddq)
    count = 10 * robot.joint_count
    wanted = np.arange(count) if columns is None else columns
    rows = np.empty((len(q), len(wanted), robot.joint_count)) if out is None else out
    rows = rows[:, : len(wanted)]
    found = regressors(robot.pinocchio_model, robot.gravity, states)
    for row, values in zip(rows, found, strict=True):
        # This loop runs for every sample: a checked copy would take as long as the dynamics.
        values.take(wanted, 0, row, "clip")
    return np.swapaxes(rows, 1, 2)


def joint_torques(
    robot: Robot, inertias: Inertias, q: FloatArray, dq: FloatArray, ddq: FloatArray
) -> FloatArray:
    """Computes the torques that move an arm.

    Args:
        robot: The arm.
        inertias: Of its links; any numbers, not only those of bodies.
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].
        ddq: (m, n) their accelerations [rad/s^2].

    Returns:
        (m, n) [N m].

    Raises:
        DataError: A shape is wrong.
    """
    states = effective_states(robot, q, dq, ddq)
    parameters = inertias.values.ravel()
    found = regressors(robot.pinocchio_model, robot.gravity, states)
    return np.array([parameters @ it for it in found]).reshape(np.shape(q))


def body_regressor(robot: Robot, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
    """Derivatives of the joints' torques by the inertial parameters of a body on the flange.

    Args:
        robot: The arm.
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].
        ddq: (m, n) their accelerations [rad/s^2].

    Returns:
        (m, n, 10) for mass [kg], first moments [kg m] and inertia xx, xy, yy, xz, yz, zz
        [kg m^2] in the flange's frame, about its origin.

    Raises:
        DataError: A shape is wrong.
    """
    last_from_flange = robot.chain.placements[-1]
    return np.asarray(torque_regressor(robot, q, dq, ddq)[:, :, -10:] @ moving(last_from_flange))


def effective_states(
    robot: Robot, q: FloatArray, dq: FloatArray, ddq: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, speeds and accelerations (m, n) of the joints' axes, where encoders report (m, n).

    Raises:
        DataError: A shape is wrong.
    """
    q, dq, ddq = (np.asarray(it, dtype=float) for it in (q, dq, ddq))
    wanted = (len(q), robot.joint_count)
    if not q.shape == dq.shape == ddq.shape == wanted:
        raise DataError(
            f"robot {robot.name}: positions, speeds and accelerations of shape (m, {wanted[1]}) "
            f"are needed, not {q.shape}, {dq.shape} and {ddq.shape}.",
            culprits=[robot.name],
        )
    chain = robot.chain
    jacobian = chain.jacobian(q)
    if not chain.is_periodic:
        return chain.effective(q), jacobian * dq, jacobian * ddq
    return chain.effective(q), jacobian * dq, jacobian * ddq + chain.curvatures(q) * dq**2

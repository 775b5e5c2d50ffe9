"""Inverse dynamics of an arm with rigid links, linear in inertial parameters, and its momentum.

Joint angles are those of the encoders, torques are about the joints' axes, without friction.
"""

from collections.abc import Iterator

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.robot.inertia import Inertias, parameter_transform
from visioncal.robot.model import Robot


def torque_regressor(
    robot: Robot,
    q: FloatArray,
    dq: FloatArray,
    ddq: FloatArray,
    columns: IntArray | None = None,
    out: FloatArray | None = None,
) -> FloatArray:
    """Regressor of the joint torques over the links' inertial parameters.

    Args:
        robot: The arm.
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].
        ddq: (m, n) their accelerations [rad/s^2].
        columns: (c,) indices of the parameters; all where None.
        out: (m, c or more, n) array to be filled, parameters before joints; new where None.

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
    matrices = _regressors(robot, states)
    for row, values in zip(rows, matrices, strict=True):
        # For every sample: a copy with bounds checking would take as long as the dynamics.
        values.take(wanted, 0, row, "clip")
    return np.swapaxes(rows, 1, 2)


def joint_torques(
    robot: Robot, inertias: Inertias, q: FloatArray, dq: FloatArray, ddq: FloatArray
) -> FloatArray:
    """Inverse dynamics: joint torques (m, n) [N m] of a motion as in `torque_regressor`.

    The inertias need not be physically consistent.

    Raises:
        DataError: A shape is wrong.
    """
    states = effective_states(robot, q, dq, ddq)
    parameters = inertias.values.ravel()
    matrices = _regressors(robot, states)
    return np.array([parameters @ array for array in matrices]).reshape(np.shape(q))


def body_regressor(robot: Robot, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
    """Regressor of the joint torques over the inertial parameters of a body on the flange.

    The motion is as in `torque_regressor`.

    Returns:
        (m, n, 10) for mass [kg], first moments [kg m] and inertia xx, xy, yy, xz, yz, zz
        [kg m^2] in the flange's frame, about its origin.

    Raises:
        DataError: A shape is wrong.
    """
    last_from_flange = robot.chain.placements[-1]
    return np.asarray(
        torque_regressor(robot, q, dq, ddq)[:, :, -10:] @ parameter_transform(last_from_flange)
    )


def effective_states(
    robot: Robot, q: FloatArray, dq: FloatArray, ddq: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Effective positions, speeds and accelerations (m, n) at encoder values (m, n).

    Raises:
        DataError: A shape is wrong.
    """
    q, dq, ddq = (np.asarray(array, dtype=float) for array in (q, dq, ddq))
    wanted = (len(q), robot.joint_count)
    if not q.shape == dq.shape == ddq.shape == wanted:
        raise DataError(
            f"robot {robot.name}: positions, speeds and accelerations must have the shape "
            f"(m, {wanted[1]}), not {q.shape}, {dq.shape} and {ddq.shape}.",
            culprits=[robot.name],
        )
    chain = robot.chain
    jacobian = chain.jacobian(q)
    if not chain.is_periodic:
        return chain.effective(q), jacobian * dq, jacobian * ddq
    return chain.effective(q), jacobian * dq, jacobian * ddq + chain.curvatures(q) * dq**2


def _regressors(
    robot: Robot, states: tuple[FloatArray, FloatArray, FloatArray]
) -> Iterator[FloatArray]:
    """Iterates over the torque regressors of states, for the bodies' inertial parameters.

    Args:
        robot: The arm.
        states: (m, n) effective positions, speeds and accelerations.

    Yields:
        (10 n, n) for each state, in memory that the next state overwrites.
    """
    import pinocchio as pin

    model, compute = robot.pinocchio_model, pin.computeJointTorqueRegressor
    data = model.createData()
    # The function's return value is a copy of this array.
    regressor = data.jointTorqueRegressor.T
    for q, dq, ddq in zip(*states, strict=True):
        compute(model, data, q, dq, ddq)
        yield regressor

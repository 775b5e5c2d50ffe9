"""The generalised momentum of an arm."""

from typing import TYPE_CHECKING

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.robot.inertia import Inertias
from visioncal.robot.model import Robot
from visioncal.robot.torques import effective_states

if TYPE_CHECKING:
    import pinocchio as pin


def momenta(
    robot: Robot, inertias: Inertias, q: FloatArray, dq: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Computes the generalised momentum of an arm, and how it changes where nothing drives it.

    `p = M dq` and `C^T dq - g`: the derivative of p is the latter plus all torques (De Luca and
    Mattone 2003, Actuator failure detection and isolation using generalized momenta).

    Args:
        robot: The arm.
        inertias: Of its links; each has a mass above zero, or neither mass nor first moments.
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].

    Returns:
        (m, n) momenta [N m s] and (m, n) rates [N m].

    Raises:
        DataError: The number of joints differs from the robot's, or an inertia is of no mass.
    """
    import pinocchio as pin

    positions, speeds, _ = effective_states(robot, q, dq, np.zeros_like(q))
    model = weighed_model(robot, inertias)
    data = model.createData()
    momentum, rate = np.empty_like(speeds), np.empty_like(speeds)
    for row, (position, speed) in enumerate(zip(positions, speeds, strict=True)):
        upper = np.triu(pin.crba(model, data, position))
        momentum[row] = upper @ speed + np.triu(upper, 1).T @ speed
        held = pin.computeGeneralizedGravity(model, data, position)
        rate[row] = pin.computeCoriolisMatrix(model, data, position, speed).T @ speed - held
    return momentum, rate


def weighed_model(robot: Robot, inertias: Inertias) -> "pin.Model":
    """Pinocchio's model of an arm with these bodies; of this package.

    Raises:
        DataError: First moments have no mass.
    """
    import pinocchio as pin

    masses = inertias.masses
    lost = (masses.kg == 0.0) & inertias.values[:, 1:4].any(axis=1)
    if lost.any():
        names = [name for name, it in zip(robot.joint_names, lost, strict=True) if it]
        raise DataError(
            f"robot {robot.name}: {', '.join(names)} have first moments and no mass.",
            culprits=names,
            next_step="Give inertias of bodies, as a physically consistent identification has "
            "them.",
        )
    model = robot.pinocchio_model.copy()
    model.gravity.linear = robot.gravity
    bodies = zip(masses.kg, masses.centres_m, inertias.about_centres, strict=True)
    for joint, (kg, centre, about) in enumerate(bodies, start=1):
        model.inertias[joint] = pin.Inertia(kg, centre, about)
    return model

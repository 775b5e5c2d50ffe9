"""Dynamics of a simulated arm: inertia, weight, friction and load.

A Newton-Euler recursion in plain numpy over the frames of the simulated arm, independent of the
application's dynamic model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.simulation.arms import DhArm, link_frames, ur_arm

_GRAVITY = np.array([0.0, 0.0, -9.80665])
# Relative standard deviation of masses and inertias from the published values.
_INERTIA_ERROR = 0.2
# Mass [kg], centre of mass [m] and principal moments of inertia about it [kg m^2], in the link
# frames: Universal Robots, "DH parameters for calculations of kinematics and dynamics", rounded.
_BODIES: Mapping[str, Sequence[tuple[float, Sequence[float], Sequence[float]]]] = {
    "ur5e": (
        (3.761, (0.0, -0.0256, 0.0019), (0.0084, 0.0064, 0.0084)),
        (8.058, (0.2125, 0.0, 0.1134), (0.0078, 0.21, 0.21)),
        (2.846, (0.15, 0.0, 0.0265), (0.0016, 0.0462, 0.0462)),
        (1.37, (0.0, -0.0018, 0.0163), (0.0016, 0.0016, 0.0009)),
        (1.3, (0.0, 0.0018, 0.0163), (0.0016, 0.0016, 0.0009)),
        (0.365, (0.0, 0.0, -0.0012), (0.0001, 0.0001, 0.0001)),
    ),
    "ur10e": (
        (7.369, (0.021, 0.0, 0.027), (0.0341, 0.0353, 0.0216)),
        (13.051, (0.38, 0.0, 0.158), (0.0281, 0.7707, 0.7694)),
        (3.989, (0.24, 0.0, 0.068), (0.0101, 0.3093, 0.3065)),
        (2.1, (0.0, 0.007, 0.018), (0.003, 0.0022, 0.0026)),
        (1.98, (0.0, 0.007, 0.018), (0.003, 0.0022, 0.0026)),
        (0.615, (0.0, 0.0, -0.026), (0.0004, 0.0004, 0.0005)),
    ),
}
# Typical Coulomb [N m] and viscous friction [N m s/rad] of each joint.
_COULOMB, _VISCOUS = (9.0, 10.0, 7.0, 1.6, 1.5, 1.4), (12.0, 13.0, 9.0, 1.5, 1.4, 1.3)
_MOTOR_INERTIA = (1.1, 1.2, 0.9, 0.08, 0.08, 0.07)


@dataclass(frozen=True, eq=False)
class LinkBody:
    """A rigid body."""

    kg: float  # Mass [kg].
    centre_m: FloatArray  # (3,) centre of mass in its frame [m].
    inertia_kg_m2: FloatArray  # (3, 3) inertia about the centre of mass, along that frame's axes.


@dataclass(frozen=True, eq=False)
class Gears:
    """Friction, offset and rotor inertia of n drives.

    `(coulomb + stribeck exp(-(dq / stribeck_speed)^2)) sign(dq) + viscous dq + offset
    + motor_inertia ddq`.
    """

    coulomb: FloatArray  # (n,) Coulomb friction [N m].
    viscous: FloatArray  # (n,) viscous friction [N m s/rad].
    offset: FloatArray  # (n,) torque offset [N m].
    stribeck: FloatArray  # (n,) static friction in addition to `coulomb` [N m].
    stribeck_speed: FloatArray  # (n,) speed over which it fades [rad/s].
    motor_inertia: FloatArray  # (n,) inertia of the rotors at the joints [kg m^2].

    def torques(self, dq: FloatArray, ddq: FloatArray) -> FloatArray:
        """(m, n) torques of friction, offset and rotors [N m]."""
        breaking = self.stribeck * np.exp(-((dq / self.stribeck_speed) ** 2))
        dry = (self.coulomb + breaking) * np.sign(dq)
        return np.asarray(dry + self.viscous * dq + self.offset + self.motor_inertia * ddq)


@dataclass(frozen=True, eq=False)
class DynamicArm:
    """An arm with its bodies, one per link in the frame at its end, and its drives."""

    arm: DhArm
    bodies: tuple[LinkBody, ...]
    gears: Gears

    def carrying(self, load: LinkBody) -> "DynamicArm":
        """The arm with a load in the flange's frame."""
        return replace(self, bodies=(*self.bodies[:-1], joined(self.bodies[-1], load)))


def joined(first: LinkBody, second: LinkBody) -> LinkBody:
    """Two bodies in one frame as a single one (parallel axis theorem)."""
    kg = first.kg + second.kg
    centre = (first.kg * first.centre_m + second.kg * second.centre_m) / kg
    inertia = np.zeros((3, 3))
    for body in (first, second):
        lever = body.centre_m - centre
        inertia += body.inertia_kg_m2 + body.kg * (
            lever @ lever * np.eye(3) - np.outer(lever, lever)
        )
    return LinkBody(kg, centre, inertia)


def nominal_dynamics(name: str) -> DynamicArm:
    """Arm by name, `ur5e` or `ur10e`, with published inertias and without friction.

    Raises:
        DataError: The arm's dynamics are unknown.
    """
    if name not in _BODIES:
        raise DataError(
            f"simulation: nothing is known of the dynamics of {name!r}, only of "
            f"{', '.join(sorted(_BODIES))}."
        )
    bodies = tuple(
        LinkBody(kg, np.array(centre), np.diag(main)) for kg, centre, main in _BODIES[name]
    )
    zeros = np.zeros(len(bodies))
    return DynamicArm(ur_arm(name), bodies, Gears(zeros, zeros, zeros, zeros, zeros + 1.0, zeros))


def real_dynamics(name: str, rng: np.random.Generator, *, stribeck: bool = False) -> DynamicArm:
    """Draws a real arm: deviations from the published inertias, and friction.

    Masses vary by a fifth, the second moments about the centres of mass are stretched by half of
    that along and across all axes, and the centres move by 1 cm: the result is always physically
    consistent.

    Args:
        name: Name, as for `nominal_dynamics`.
        rng: Source of randomness.
        stribeck: Whether static friction exceeds sliding friction.

    Raises:
        DataError: The arm's dynamics are unknown.
    """
    nominal = nominal_dynamics(name)
    count = len(nominal.bodies)
    scale = nominal.bodies[1].kg / _BODIES["ur5e"][1][0]

    def around(values: Sequence[float]) -> FloatArray:
        return np.asarray(scale * np.array(values) * rng.uniform(0.7, 1.3, count))

    coulomb = around(_COULOMB)
    gears = Gears(
        coulomb,
        around(_VISCOUS),
        0.1 * coulomb * rng.standard_normal(count),
        coulomb * rng.uniform(0.2, 1.0, count) * stribeck,
        rng.uniform(0.01, 0.05, count),
        around(_MOTOR_INERTIA),
    )
    return replace(
        nominal,
        bodies=tuple(_disturbed(body, _INERTIA_ERROR, rng) for body in nominal.bodies),
        gears=gears,
    )


def _disturbed(body: LinkBody, share: float, rng: np.random.Generator) -> LinkBody:
    kg = body.kg * np.exp(share * rng.standard_normal())
    second_moments = 0.5 * np.trace(body.inertia_kg_m2) * np.eye(3) - body.inertia_kg_m2
    stretch = np.sqrt(kg / body.kg) * (np.eye(3) + 0.5 * share * rng.standard_normal((3, 3)))
    second_moments = stretch @ second_moments @ stretch.T
    centre = body.centre_m + 0.01 * rng.standard_normal(3)
    return LinkBody(float(kg), centre, np.trace(second_moments) * np.eye(3) - second_moments)


def drive_torques(built: DynamicArm, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
    """(m, n) drive torques [N m] of a motion (Luh, Walker and Paul 1980).

    `q`, `dq` and `ddq` are (m, n) joint angles [rad], speeds and accelerations. All vectors are in
    the base frame.
    """
    frames = link_frames(built.arm, q)
    axes, origins = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
    angular_velocity = angular_acceleration = np.zeros((len(q), 3))
    # Gravity as an upward acceleration of the base.
    acceleration = np.broadcast_to(-_GRAVITY, (len(q), 3))
    wrenches = []
    for joint, body in enumerate(built.bodies):
        axis = axes[:, joint]
        angular_acceleration = angular_acceleration + ddq[:, joint, None] * axis
        angular_acceleration = angular_acceleration + dq[:, joint, None] * np.cross(
            angular_velocity, axis
        )
        angular_velocity = angular_velocity + dq[:, joint, None] * axis
        frame = frames[:, joint + 1]
        centre = frame[:, :3, :3] @ body.centre_m + frame[:, :3, 3]
        force = body.kg * (
            acceleration
            + _relative_acceleration(
                centre - origins[:, joint], angular_velocity, angular_acceleration
            )
        )
        inertia = frame[:, :3, :3] @ body.inertia_kg_m2 @ np.swapaxes(frame[:, :3, :3], 1, 2)
        moment = _times(inertia, angular_acceleration) + np.cross(
            angular_velocity, _times(inertia, angular_velocity)
        )
        wrenches.append((centre, force, moment))
        acceleration = acceleration + _relative_acceleration(
            frame[:, :3, 3] - origins[:, joint], angular_velocity, angular_acceleration
        )
    torques = built.gears.torques(dq, ddq)
    for joint in range(q.shape[1]):
        for centre, force, moment in wrenches[joint:]:
            joint_moment = moment + np.cross(centre - origins[:, joint], force)
            torques[:, joint] += np.einsum("mi,mi->m", axes[:, joint], joint_moment)
    return torques


def _relative_acceleration(
    lever: FloatArray, angular_velocity: FloatArray, angular_acceleration: FloatArray
) -> FloatArray:
    """Acceleration of a point of a rotating body relative to another point [m/s^2]."""
    return np.asarray(
        np.cross(angular_acceleration, lever)
        + np.cross(angular_velocity, np.cross(angular_velocity, lever))
    )


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])

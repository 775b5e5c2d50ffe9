"""What a simulated arm's drives have to give: inertia, weight, friction and load.

A Newton-Euler recursion of its own in plain numpy, over the frames of the simulated arm; it shares
nothing with the application's model of dynamics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.simulation.arms import DhArm, link_frames, ur_arm

_GRAVITY = np.array([0.0, 0.0, -9.80665])
# By how much masses and inertias depart from what is published (standard deviation).
_OFF_SHARE = 0.2
# Mass [kg], its centre [m] and the main moments of inertia about that [kg m^2], in the frames of
# the links: Universal Robots, "DH parameters for calculations of kinematics and dynamics", rounded.
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
# Friction of each joint at first go [N m] and [N m s/rad], from the shoulder to the wrist.
_COULOMB, _VISCOUS = (9.0, 10.0, 7.0, 1.6, 1.5, 1.4), (12.0, 13.0, 9.0, 1.5, 1.4, 1.3)
_MOTOR_INERTIA = (1.1, 1.2, 0.9, 0.08, 0.08, 0.07)


@dataclass(frozen=True, eq=False)
class LinkBody:
    """A rigid body.

    Attributes:
        kg: Its mass [kg].
        centre_m: (3,) where its centre is, in its frame [m].
        inertia_kg_m2: (3, 3) its inertia about the centre, along that frame's axes.
    """

    kg: float
    centre_m: FloatArray
    inertia_kg_m2: FloatArray


@dataclass(frozen=True, eq=False)
class Gears:
    """What each of n drives takes for itself.

    `(coulomb + stribeck exp(-(dq / stribeck_speed)^2)) sign(dq) + viscous dq + offset
    + motor_inertia ddq`.

    Attributes:
        coulomb: (n,) [N m].
        viscous: (n,) [N m s/rad].
        offset: (n,) [N m].
        stribeck: (n,) what breaking loose takes beyond `coulomb` [N m].
        stribeck_speed: (n,) the speed over which that fades [rad/s].
        motor_inertia: (n,) of the rotors, on the joints' side [kg m^2].
    """

    coulomb: FloatArray
    viscous: FloatArray
    offset: FloatArray
    stribeck: FloatArray
    stribeck_speed: FloatArray
    motor_inertia: FloatArray

    def torques(self, dq: FloatArray, ddq: FloatArray) -> FloatArray:
        """(m, n) what the drives take [N m]."""
        breaking = self.stribeck * np.exp(-((dq / self.stribeck_speed) ** 2))
        dry = (self.coulomb + breaking) * np.sign(dq)
        return np.asarray(dry + self.viscous * dq + self.offset + self.motor_inertia * ddq)


@dataclass(frozen=True, eq=False)
class DynamicArm:
    """An arm with its bodies, one a link in the frame in which the link ends, and its drives."""

    arm: DhArm
    bodies: tuple[LinkBody, ...]
    gears: Gears

    def carrying(self, load: LinkBody) -> "DynamicArm":
        """The arm with a load on its flange, in the flange's frame."""
        return replace(self, bodies=(*self.bodies[:-1], joined(self.bodies[-1], load)))


def joined(first: LinkBody, second: LinkBody) -> LinkBody:
    """Two bodies of one frame as one (Huygens and Steiner)."""
    kg = first.kg + second.kg
    centre = (first.kg * first.centre_m + second.kg * second.centre_m) / kg
    inertia = np.zeros((3, 3))
    for body in (first, second):
        arm = body.centre_m - centre
        inertia += body.inertia_kg_m2 + body.kg * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return LinkBody(kg, centre, inertia)


def nominal_dynamics(name: str) -> DynamicArm:
    """The arm of a name, `ur5e` or `ur10e`, as its maker publishes it, without friction.

    Raises:
        DataError: Another name was given.
    """
    if name not in _BODIES:
        raise DataError(
            f"simulation: nothing is known of the dynamics of {name!r}, only of "
            f"{', '.join(sorted(_BODIES))}."
        )
    bodies = tuple(LinkBody(kg, np.array(at), np.diag(main)) for kg, at, main in _BODIES[name])
    still = np.zeros(len(bodies))
    return DynamicArm(ur_arm(name), bodies, Gears(still, still, still, still, still + 1.0, still))


def real_dynamics(name: str, rng: np.random.Generator, *, stribeck: bool = False) -> DynamicArm:
    """An arm as it may have been built: off from what is published, and with friction.

    Masses are off by a fifth, the second moments about the centres of mass are stretched by half of
    it along and across all axes, and the centres by 1 cm: what comes out is a body always.

    Args:
        name: As for `nominal_dynamics`.
        rng: Source of randomness.
        stribeck: Whether breaking loose takes more than sliding.

    Raises:
        DataError: Nothing is known of the arm.
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
        nominal, bodies=tuple(_off(body, _OFF_SHARE, rng) for body in nominal.bodies), gears=gears
    )


def _off(body: LinkBody, share: float, rng: np.random.Generator) -> LinkBody:
    kg = body.kg * np.exp(share * rng.standard_normal())
    second_moments = 0.5 * np.trace(body.inertia_kg_m2) * np.eye(3) - body.inertia_kg_m2
    stretch = np.sqrt(kg / body.kg) * (np.eye(3) + 0.5 * share * rng.standard_normal((3, 3)))
    second_moments = stretch @ second_moments @ stretch.T
    centre = body.centre_m + 0.01 * rng.standard_normal(3)
    return LinkBody(float(kg), centre, np.trace(second_moments) * np.eye(3) - second_moments)


def drive_torques(built: DynamicArm, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
    """What the drives have to give for a motion (Luh, Walker and Paul 1980).

    All vectors are in the base's frame.

    Args:
        built: The arm.
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].
        ddq: (m, n) their accelerations [rad/s^2].

    Returns:
        (m, n) [N m].
    """
    frames = link_frames(built.arm, q)
    axes, origins = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
    spin = turning = np.zeros((len(q), 3))
    # Standing still against gravity is being pushed up.
    push = np.broadcast_to(-_GRAVITY, (len(q), 3))
    wrenches = []
    for joint, body in enumerate(built.bodies):
        axis = axes[:, joint]
        turning = turning + ddq[:, joint, None] * axis
        turning = turning + dq[:, joint, None] * np.cross(spin, axis)
        spin = spin + dq[:, joint, None] * axis
        frame = frames[:, joint + 1]
        at = frame[:, :3, :3] @ body.centre_m + frame[:, :3, 3]
        force = body.kg * (push + _carried(at - origins[:, joint], spin, turning))
        inertia = frame[:, :3, :3] @ body.inertia_kg_m2 @ np.swapaxes(frame[:, :3, :3], 1, 2)
        moment = _times(inertia, turning) + np.cross(spin, _times(inertia, spin))
        wrenches.append((at, force, moment))
        push = push + _carried(frame[:, :3, 3] - origins[:, joint], spin, turning)
    torques = built.gears.torques(dq, ddq)
    for joint in range(q.shape[1]):
        for at, force, moment in wrenches[joint:]:
            about = moment + np.cross(at - origins[:, joint], force)
            torques[:, joint] += np.einsum("mi,mi->m", axes[:, joint], about)
    return torques


def _carried(lever: FloatArray, spin: FloatArray, turning: FloatArray) -> FloatArray:
    """Acceleration of a point of a turning body beyond that of another [m/s^2]."""
    return np.asarray(np.cross(turning, lever) + np.cross(spin, np.cross(spin, lever)))


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])

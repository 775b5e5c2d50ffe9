"""How a simulated arm gives way: gears that yield to weight, payload and force, and play in them.

Torques come from the simulated arm's own frames, by moments about its axes, and share nothing with
the application's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.simulation.arms import DhArm, link_frames

_GRAVITY = np.array([0.0, 0.0, -9.80665])
# Yielding changes the levers by a hundredth, and the torques as much: enough to be exact.
_ROUNDS = 8
# Masses [kg] and their centres [m] in the frames of the links, after Universal Robots, "DH
# parameters for calculations of kinematics and dynamics"; round numbers for the other arm.
_BODIES: Mapping[str, Sequence[tuple[float, Sequence[float]]]] = {
    "ur3e": (
        (1.98, (0.0, -0.02, 0.0)),
        (3.4445, (0.13, 0.0, 0.1157)),
        (1.437, (0.05, 0.0, 0.0238)),
        (0.871, (0.0, 0.0, 0.01)),
        (0.805, (0.0, 0.0, 0.01)),
        (0.261, (0.0, 0.0, -0.02)),
    ),
    "ur5e": (
        (3.761, (0.0, -0.02561, 0.00193)),
        (8.058, (0.2125, 0.0, 0.11336)),
        (2.846, (0.15, 0.0, 0.0265)),
        (1.37, (0.0, -0.0018, 0.01634)),
        (1.3, (0.0, 0.0018, 0.01634)),
        (0.365, (0.0, 0.0, -0.001159)),
    ),
    "ur10e": (
        (7.369, (0.021, 0.0, 0.027)),
        (13.051, (0.38, 0.0, 0.158)),
        (3.989, (0.24, 0.0, 0.068)),
        (2.1, (0.0, 0.007, 0.018)),
        (1.98, (0.0, 0.007, 0.018)),
        (0.615, (0.0, 0.0, -0.026)),
    ),
    "generic-6r-1800": (
        (120.0, (-0.1, 0.1, 0.0)),
        (75.0, (-0.45, 0.0, 0.1)),
        (60.0, (-0.05, 0.0, 0.15)),
        (25.0, (0.0, -0.3, 0.0)),
        (10.0, (0.0, 0.0, 0.03)),
        (5.0, (0.0, 0.0, -0.04)),
    ),
}


@dataclass(frozen=True)
class Payload:
    """What hangs on the flange, and pushes at it.

    Attributes:
        kg: Its mass [kg].
        centre_m: Where its centre is in the flange's frame [m].
        force_n: A force on the flange's origin, in the base's frame [N].
    """

    kg: float = 0.0
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Giving:
    """How an arm gives way.

    Attributes:
        compliance: (n,) what each joint yields to a torque [rad/(N m)].
        mass_share: Real over published masses of the links.
        backlash: (n,) play of each joint [rad].
    """

    compliance: FloatArray
    mass_share: float
    backlash: FloatArray


def sagging(
    arm: DhArm,
    giving: Giving,
    joints: FloatArray,
    payloads: Sequence[Payload] = (),
    approach: FloatArray | None = None,
) -> FloatArray:
    """Where the joints stand when the arm gives way.

    Args:
        arm: The arm as it was built.
        giving: How it gives way.
        joints: (m, n) joint angles as the encoders have them [rad].
        payloads: m loads, one a stop; none where empty.
        approach: (m,) the side from which all joints came to each stop, +1 from above or -1; zero
            for the middle of their play.

    Returns:
        (m, n) angles at which a rigid arm without play stands likewise [rad].
    """
    side = np.zeros(len(joints)) if approach is None else approach
    # A joint that came down from above stops short of where its encoder has it.
    at_rest = joints + 0.5 * side[:, None] * giving.backlash
    sagged = at_rest
    if giving.compliance.any():
        for _ in range(_ROUNDS):
            sagged = at_rest + giving.compliance * load_torques(arm, giving, sagged, payloads)
    return np.asarray(sagged)


def giving_of(
    arm: DhArm, compliance: Sequence[float], mass_share: float, backlash: Sequence[float]
) -> Giving:
    """How an arm gives way; empty sequences stand for a rigid arm and for one without play.

    Raises:
        DataError: The values are not one a joint.
    """
    count = len(arm.offset)
    for what, values in (("compliance", compliance), ("backlash", backlash)):
        if len(values) not in (0, count):
            raise DataError(f"simulation: {len(values)} values of {what} for {count} joints.")
    return Giving(
        np.array(compliance) if compliance else np.zeros(count),
        mass_share,
        np.array(backlash) if backlash else np.zeros(count),
    )


def load_torques(
    arm: DhArm, giving: Giving, joints: FloatArray, payloads: Sequence[Payload]
) -> FloatArray:
    """(m, n) by which weight and force turn the joints [N m]: their moments about the axes."""
    frames = link_frames(arm, joints)
    kg, centres = (np.array(pair) for pair in zip(*_BODIES[arm.name], strict=True))
    weights = giving.mass_share * kg[:, None] * _GRAVITY
    at = frames[:, 1:, :3, :3] @ centres[:, :, None]
    places = at[..., 0] + frames[:, 1:, :3, 3]
    forces = np.broadcast_to(weights, places.shape)
    if payloads:
        tip = frames[:, -1]
        hung = np.array([payload.centre_m for payload in payloads])
        held = np.einsum("mij,mj->mi", tip[:, :3, :3], hung) + tip[:, :3, 3]
        load = np.array([payload.kg for payload in payloads])[:, None] * _GRAVITY
        pushed = np.array([payload.force_n for payload in payloads])
        places = np.concatenate([places, held[:, None], tip[:, None, :3, 3]], axis=1)
        forces = np.concatenate([forces, load[:, None], pushed[:, None]], axis=1)
    torques = np.empty(joints.shape)
    for joint in range(joints.shape[1]):
        axis, origin = frames[:, joint, :3, 2], frames[:, joint, :3, 3]
        # Links behind the joint pull at it; payload and force are behind all.
        moments = np.cross(places[:, joint:] - origin[:, None], forces[:, joint:])
        torques[:, joint] = np.einsum("mi,mki->m", axis, moments)
    return torques

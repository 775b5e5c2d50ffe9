"""How a simulated arm is built and gives way: gears that yield to weight, payload and force; play.

Torques come from the simulated arm's own frames, by moments about its axes, and share nothing with
the application's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.simulation.arms import ArmErrors, DhArm, arm_named, disturb, forward, link_frames

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

    def row(self) -> dict[str, float]:
        """The values of its columns."""
        centre = {f"payload_{name}_m": at for name, at in zip("xyz", self.centre_m, strict=True)}
        force = {f"force_{name}_n": at for name, at in zip("xyz", self.force_n, strict=True)}
        return {"payload_kg": self.kg} | centre | force


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


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmOptions(ArmErrors):
    """An arm, how the real one departs from it, and what it carries.

    Attributes:
        robot: `ur3e`, `ur5e`, `ur10e` or `generic-6r-1800`.
        robot_sigma_m: Repeatability: where the flange really stands, per axis [m].
        robot_sigma_rad: The same for its rotation [rad].
        compliance_rad_per_nm: What each joint yields to a torque; empty for a rigid arm.
        payloads: What the arm carries, stop by stop in turn; empty for nothing.
        mass_share: Real over published masses of the links.
        backlash_rad: Play of each joint; empty for none. With play, stops are approached from
            either side in turn.
    """

    robot: str = "ur10e"
    robot_sigma_m: float = 3e-5
    robot_sigma_rad: float = 5e-5
    compliance_rad_per_nm: tuple[float, ...] = ()
    payloads: tuple[Payload, ...] = ()
    mass_share: float = 1.0
    backlash_rad: tuple[float, ...] = ()

    @property
    def sigma(self) -> FloatArray:
        """(6,) repeatability of the flange: rotation [rad], translation [m]."""
        return np.repeat([self.robot_sigma_rad, self.robot_sigma_m], 3)

    def loads(self, stops: int) -> tuple[Payload, ...]:
        """What the arm carries at so many stops; empty where it carries nothing."""
        loads = self.payloads
        return tuple(loads[at % len(loads)] for at in range(stops)) if loads else ()

    def approach(self, stops: int) -> FloatArray | None:
        """(stops,) the sides from which stops are approached, +1 or -1; None without play."""
        return np.where(np.arange(stops) % 2, 1.0, -1.0) if self.backlash_rad else None

    def built(self, rng: np.random.Generator) -> DhArm:
        """Draws the arm as it was built."""
        return disturb(arm_named(self.robot), self, rng)

    def flange_at(
        self,
        arm: DhArm,
        q: FloatArray,
        payloads: Sequence[Payload] = (),
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Where the flange of an arm of this kind stands, before the error of its repeatability.

        Args:
            arm: The arm as it was built.
            q: (k, n) joint angles as the encoders have them [rad].
            payloads: k loads; none where empty.
            approach: (k,) the side from which it came; None for the middle of its play.

        Returns:
            (k, 4, 4) `base_from_flange`.
        """
        giving = giving_of(arm, self.compliance_rad_per_nm, self.mass_share, self.backlash_rad)
        return forward(arm, sagging(arm, giving, q, payloads, approach))

    def jitter(self, stops: int, rng: np.random.Generator) -> FloatArray:
        """(stops, 4, 4) `flange_from_stood`: by how much the flange does not repeat."""
        return exp(rng.standard_normal((stops, 6)) * self.sigma)

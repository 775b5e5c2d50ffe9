"""Elastic deflection, backlash and manufacturing errors of a simulated arm.

Torques are computed from the simulated arm's own frames, by moments about its axes, independent of
the application's model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.simulation.arms import ArmErrors, DhArm, arm_named, disturb, forward, link_frames

_GRAVITY = np.array([0.0, 0.0, -9.80665])
# Iterations of deflection and torques: each changes the levers by about a hundredth.
_ROUNDS = 8
# Masses [kg] and centres of mass [m] in the link frames, from Universal Robots, "DH parameters for
# calculations of kinematics and dynamics"; round numbers for the other arm.
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
    """A load on the flange, and a force on it."""

    kg: float = 0.0  # Mass [kg].
    # Centre of mass in the flange frame [m].
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Force on the flange's origin, in the base frame [N].
    force_n: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def row(self) -> dict[str, float]:
        """Values of a session's payload columns."""
        centre = {
            f"payload_{name}_m": value for name, value in zip("xyz", self.centre_m, strict=True)
        }
        force = {f"force_{name}_n": value for name, value in zip("xyz", self.force_n, strict=True)}
        return {"payload_kg": self.kg} | centre | force


@dataclass(frozen=True, eq=False)
class JointElasticity:
    """Compliance and backlash of an arm."""

    compliance: FloatArray  # (n,) compliance of each joint [rad/(N m)].
    mass_share: float  # Ratio of real to published masses of the links.
    backlash: FloatArray  # (n,) backlash of each joint [rad].


def loaded_joints(
    arm: DhArm,
    giving: JointElasticity,
    joints: FloatArray,
    payloads: Sequence[Payload] = (),
    approach: FloatArray | None = None,
) -> FloatArray:
    """True joint angles under load and backlash.

    Args:
        arm: Real arm.
        giving: Compliance and backlash.
        joints: (m, n) encoder angles [rad].
        payloads: m payloads, one per stop; empty for none.
        approach: (m,) side from which all joints approached each stop, +1 from above or -1; zero
            for the middle of the backlash.

    Returns:
        (m, n) equivalent angles of a rigid arm without backlash [rad].
    """
    side = np.zeros(len(joints)) if approach is None else approach
    # A joint that approached from above stops short of its encoder angle.
    unloaded = joints + 0.5 * side[:, None] * giving.backlash
    sagged = unloaded
    if giving.compliance.any():
        for _ in range(_ROUNDS):
            sagged = unloaded + giving.compliance * load_torques(arm, giving, sagged, payloads)
    return np.asarray(sagged)


def elasticity_of(
    arm: DhArm, compliance: Sequence[float], mass_share: float, backlash: Sequence[float]
) -> JointElasticity:
    """Compliance and backlash of an arm; empty sequences stand for none.

    Raises:
        DataError: There is not one value per joint.
    """
    count = len(arm.offset)
    for name, values in (("compliance", compliance), ("backlash", backlash)):
        if len(values) not in (0, count):
            raise DataError(f"simulation: {len(values)} values of {name} for {count} joints.")
    return JointElasticity(
        np.array(compliance) if compliance else np.zeros(count),
        mass_share,
        np.array(backlash) if backlash else np.zeros(count),
    )


def load_torques(
    arm: DhArm, giving: JointElasticity, joints: FloatArray, payloads: Sequence[Payload]
) -> FloatArray:
    """(m, n) torques of weight and force on the joints [N m]: moments about the axes."""
    frames = link_frames(arm, joints)
    kg, centres = (np.array(pair) for pair in zip(*_BODIES[arm.name], strict=True))
    weights = giving.mass_share * kg[:, None] * _GRAVITY
    lever = frames[:, 1:, :3, :3] @ centres[:, :, None]
    places = lever[..., 0] + frames[:, 1:, :3, 3]
    forces = np.broadcast_to(weights, places.shape)
    if payloads:
        tip = frames[:, -1]
        payload_centres = np.array([payload.centre_m for payload in payloads])
        payload_places = np.einsum("mij,mj->mi", tip[:, :3, :3], payload_centres) + tip[:, :3, 3]
        load = np.array([payload.kg for payload in payloads])[:, None] * _GRAVITY
        flange_forces = np.array([payload.force_n for payload in payloads])
        places = np.concatenate([places, payload_places[:, None], tip[:, None, :3, 3]], axis=1)
        forces = np.concatenate([forces, load[:, None], flange_forces[:, None]], axis=1)
    torques = np.empty(joints.shape)
    for joint in range(joints.shape[1]):
        axis, origin = frames[:, joint, :3, 2], frames[:, joint, :3, 3]
        # Links after the joint load it; payload and force come after all links.
        moments = np.cross(places[:, joint:] - origin[:, None], forces[:, joint:])
        torques[:, joint] = np.einsum("mi,mki->m", axis, moments)
    return torques


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmOptions(ArmErrors):
    """An arm, deviations of the real one, and its payloads."""

    robot: str = "ur10e"  # `ur3e`, `ur5e`, `ur10e` or `generic-6r-1800`.
    robot_sigma_m: float = 3e-5  # Repeatability of the flange's position, per axis [m].
    robot_sigma_rad: float = 5e-5  # Repeatability of its rotation, per axis [rad].
    # Compliance of each joint; empty for a rigid arm.
    compliance_rad_per_nm: tuple[float, ...] = ()
    payloads: tuple[Payload, ...] = ()  # Payloads, cycled over the stops; empty for none.
    mass_share: float = 1.0  # Ratio of real to published masses of the links.
    # Backlash of each joint; empty for none. With backlash, stops are approached from alternating
    # sides.
    backlash_rad: tuple[float, ...] = ()

    @property
    def sigma(self) -> FloatArray:
        """(6,) repeatability of the flange: rotation [rad], translation [m]."""
        return np.repeat([self.robot_sigma_rad, self.robot_sigma_m], 3)

    def loads(self, stops: int) -> tuple[Payload, ...]:
        """Payload of each of `stops` stops; empty without payloads."""
        loads = self.payloads
        return tuple(loads[at % len(loads)] for at in range(stops)) if loads else ()

    def approach(self, stops: int) -> FloatArray | None:
        """(stops,) side from which stops are approached, +1 or -1; None without backlash."""
        return np.where(np.arange(stops) % 2, 1.0, -1.0) if self.backlash_rad else None

    def built(self, rng: np.random.Generator) -> DhArm:
        """Draws the real arm."""
        return disturb(arm_named(self.robot), self, rng)

    def flange_at(
        self,
        arm: DhArm,
        q: FloatArray,
        payloads: Sequence[Payload] = (),
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Flange poses (k, 4, 4) of a real arm, before repeatability errors.

        `q` are (k, n) encoder angles [rad]. Without payloads there are none; without sides of
        approach (k,), the arm is in the middle of its backlash.
        """
        giving = elasticity_of(arm, self.compliance_rad_per_nm, self.mass_share, self.backlash_rad)
        return forward(arm, loaded_joints(arm, giving, q, payloads, approach))

    def jitter(self, stops: int, rng: np.random.Generator) -> FloatArray:
        """(stops, 4, 4) repeatability errors of the flange, in its own frame."""
        return exp(rng.standard_normal((stops, 6)) * self.sigma)

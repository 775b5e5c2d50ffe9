"""Arms that warm up, and where their flanges are meanwhile."""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, interpolated
from visioncal.session import Stream
from visioncal.simulation.arms import JOINTS, DhArm, forward


@dataclass(frozen=True, eq=False)
class Heat:
    """Thermal parameters of a real arm."""

    duty_a: FloatArray  # (n,) rms motor currents at work [A].
    # (n,) steady temperature rise of a joint over ambient per squared current [K/A^2].
    k_per_a2: FloatArray
    tau_s: FloatArray  # (n,) time constants of the joints [s].
    growth_per_k: FloatArray  # (n,) thermal expansion of a joint's link [1/K].
    drift_rad_per_k: FloatArray  # (n,) thermal drift of a joint's zero [rad/K].
    lag_s: float = 240.0  # Time constant by which the links lag behind their joints' sensors [s].
    ambient_c: float = 21.0  # Ambient temperature at the start, which the cold arm has [deg C].
    # Amplitude of the ambient temperature, with a period of six hours [K].
    ambient_swing_k: float = 1.5
    sensor_sigma_k: float = 0.2  # Noise of recorded temperatures [K].

    @classmethod
    def drawn(cls, seed: int) -> "Heat":
        """Draws an arm whose joints warm up by 10 to 35 K within hours."""
        rng = np.random.default_rng([99, seed])
        duty = rng.uniform(1.5, 4.0, JOINTS)
        # Rises [K] and time constants [s]; expansion between steel's and aluminium's [1/K].
        return cls(
            duty,
            rng.uniform(10.0, 35.0, JOINTS) / duty**2,
            rng.uniform(1500.0, 3600.0, JOINTS),
            rng.uniform(12e-6, 23e-6, JOINTS),
            rng.normal(0.0, 5e-6, JOINTS),
        )


@dataclass(frozen=True, eq=False)
class Warming:
    """Temperatures of an arm over time."""

    stamps_s: FloatArray  # (t,) times [s].
    currents_a: FloatArray  # (t, n) recorded currents [A].
    sensors_c: FloatArray  # (t, n) recorded temperatures [deg C].
    links_c: FloatArray  # (t, n) true temperatures of the links [deg C].
    ambient_c: FloatArray  # (t,) ambient temperature [deg C].

    def at(self, stamps_s: FloatArray) -> FloatArray:
        """(m, n) temperatures of the links at some times [deg C]."""
        return interpolated(stamps_s, self.stamps_s, self.links_c)

    def recorded(self, *, temperatures: bool, until_s: float = np.inf) -> Stream:
        """The controller's stream up to a time: temperatures, or currents."""
        kept = self.stamps_s <= until_s
        signals = self.sensors_c if temperatures else self.currents_a
        form = "temp{}_c" if temperatures else "current{}_a"
        names = [form.format(at + 1) for at in range(signals.shape[1])]
        columns = [self.stamps_s[:, None], signals, self.ambient_c[:, None]]
        return Stream(("stamp_s", *names, "ambient_c"), np.hstack(columns)[kept])


def warm_up(heat: Heat, hours: float, *, seed: int) -> Warming:
    """Temperatures of an arm that starts cold and works for some hours, in steps of 10 s.

    The duty varies by a quarter between pieces of work.
    """
    if hours <= 0.0:
        raise DataError("simulation: a warm-up needs a time above 0.")
    step_s = 10.0
    rng = np.random.default_rng([98, seed])
    stamps = np.arange(0.0, 3600.0 * hours + step_s, step_s)
    pieces = np.exp(0.25 * rng.standard_normal((len(stamps) // 30 + 1, JOINTS)))
    duty = heat.duty_a * np.repeat(pieces, 30, axis=0)[: len(stamps)]
    ambient = heat.ambient_c + heat.ambient_swing_k * np.sin(2.0 * np.pi * stamps / 21600.0)
    joints, links = np.empty_like(duty), np.empty_like(duty)
    joints[0] = links[0] = heat.ambient_c
    joint_decay, link_decay = np.exp(-step_s / heat.tau_s), np.exp(-step_s / heat.lag_s)
    for step in range(len(stamps) - 1):
        steady = ambient[step] + heat.k_per_a2 * duty[step] ** 2
        joints[step + 1] = steady + joint_decay * (joints[step] - steady)
        links[step + 1] = joints[step] + link_decay * (links[step] - joints[step])
    measured = joints + heat.sensor_sigma_k * rng.standard_normal(joints.shape)
    return Warming(stamps, duty, measured, links, ambient)


def heated_poses(arm: DhArm, heat: Heat, q: FloatArray, links_c: FloatArray) -> FloatArray:
    """True flange poses (m, 4, 4) at (m, n) joint angles and link temperatures."""
    poses = []
    for row, rise in zip(q, links_c - heat.ambient_c, strict=True):
        grown = 1.0 + heat.growth_per_k * rise
        offset = arm.offset + heat.drift_rad_per_k * rise
        warm = replace(arm, a=arm.a * grown, d=arm.d * grown, offset=offset)
        poses.append(forward(warm, row[None])[0])
    return np.array(poses)


def heated_flanges(
    arm: DhArm, heat: Heat, q: FloatArray, links_c: FloatArray, cold: FloatArray
) -> FloatArray:
    """Warm flange poses (m, 4, 4) for cold ones (m, 4, 4) at the same joint angles."""
    return heated_poses(arm, heat, q, links_c) @ (invert(forward(arm, q)) @ cold)

"""An arm that warms up while it works: what heats it, and how it grows.

Each joint is a heat source that its motor's current drives, with the air around it as its sink: a
first-order RC element, stepped exactly for a duty that is constant from sample to sample. The link
behind a joint follows the joint's temperature, grows in proportion to it, and the joint's zero
drifts.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.session import Stream
from visioncal.simulation.arms import DhArm, forward

_JOINTS = 6
# What a metre of steel and of aluminium grows by for a kelvin.
STEEL_PER_K, ALUMINIUM_PER_K = 12e-6, 23e-6


@dataclass(frozen=True, eq=False)
class Heat:
    """What heats a real arm, and what that does to it.

    Attributes:
        duty_a: (n,) the motors' currents at work, as a root mean square [A].
        k_per_a2: (n,) rise of a joint over the air for a squared current, once it rests [K/A^2].
        tau_s: (n,) time constants of the joints [s].
        lag_s: How far the links are behind their joints' sensors, as a time constant [s].
        growth_per_k: (n,) relative growth of a joint's link [1/K].
        drift_rad_per_k: (n,) drift of a joint's zero [rad/K].
        ambient_c: The air at the start; cold, the whole arm is as warm as it.
        ambient_swing_k: How far the air warms and cools again in the course of six hours [K].
        sensor_sigma_k: Noise of a recorded temperature [K].
    """

    duty_a: FloatArray
    k_per_a2: FloatArray
    tau_s: FloatArray
    growth_per_k: FloatArray
    drift_rad_per_k: FloatArray
    lag_s: float = 240.0
    ambient_c: float = 21.0
    ambient_swing_k: float = 1.5
    sensor_sigma_k: float = 0.2

    @classmethod
    def drawn(cls, seed: int) -> "Heat":
        """Draws an arm whose joints become 10 to 35 K warmer within hours."""
        rng = np.random.default_rng([99, seed])
        duty = rng.uniform(1.5, 4.0, _JOINTS)
        return cls(
            duty,
            rng.uniform(10.0, 35.0, _JOINTS) / duty**2,
            rng.uniform(1500.0, 3600.0, _JOINTS),
            rng.uniform(STEEL_PER_K, ALUMINIUM_PER_K, _JOINTS),
            rng.normal(0.0, 5e-6, _JOINTS),
        )


@dataclass(frozen=True, eq=False)
class Warming:
    """The course of an arm's temperatures.

    Attributes:
        stamps_s: (t,) [s].
        currents_a: (t, n) as recorded [A].
        sensors_c: (t, n) temperatures as recorded [deg C].
        links_c: (t, n) what the links really have.
        ambient_c: (t,) the air.
    """

    stamps_s: FloatArray
    currents_a: FloatArray
    sensors_c: FloatArray
    links_c: FloatArray
    ambient_c: FloatArray

    def at(self, stamps_s: FloatArray) -> FloatArray:
        """(m, n) temperatures of the links at some times."""
        columns = [np.interp(stamps_s, self.stamps_s, column) for column in self.links_c.T]
        return np.stack(columns, axis=1)

    def recorded(self, *, temperatures: bool, until_s: float = np.inf) -> Stream:
        """The controller's stream up to a time: temperatures, or else currents."""
        kept = self.stamps_s <= until_s
        signals = self.sensors_c if temperatures else self.currents_a
        form = "temp{}_c" if temperatures else "current{}_a"
        names = [form.format(at + 1) for at in range(signals.shape[1])]
        columns = [self.stamps_s[:, None], signals, self.ambient_c[:, None]]
        return Stream(("stamp_s", *names, "ambient_c"), np.hstack(columns)[kept])


def warm_up(heat: Heat, hours: float, *, step_s: float = 10.0, seed: int = 0) -> Warming:
    """Works an arm that was cold.

    Args:
        heat: What heats it; the duty varies by a quarter from one piece of work to the next.
        hours: For how long.
        step_s: Time between two samples [s].
        seed: Of the duty's variation and the sensors' noise.
    """
    if min(hours, step_s) <= 0.0:
        raise DataError("simulation: a warm-up needs a time and a step above 0.")
    rng = np.random.default_rng([98, seed])
    stamps = np.arange(0.0, 3600.0 * hours + step_s, step_s)
    pieces = np.exp(0.25 * rng.standard_normal((len(stamps) // 30 + 1, _JOINTS)))
    duty = heat.duty_a * np.repeat(pieces, 30, axis=0)[: len(stamps)]
    ambient = heat.ambient_c + heat.ambient_swing_k * np.sin(2.0 * np.pi * stamps / 21600.0)
    joints, links = np.empty_like(duty), np.empty_like(duty)
    joints[0] = links[0] = heat.ambient_c
    kept, followed = np.exp(-step_s / heat.tau_s), np.exp(-step_s / heat.lag_s)
    for at in range(len(stamps) - 1):
        rest = ambient[at] + heat.k_per_a2 * duty[at] ** 2
        joints[at + 1] = rest + kept * (joints[at] - rest)
        links[at + 1] = joints[at] + followed * (links[at] - joints[at])
    measured = joints + heat.sensor_sigma_k * rng.standard_normal(joints.shape)
    return Warming(stamps, duty, measured, links, ambient)


def heated_poses(arm: DhArm, heat: Heat, q: FloatArray, links_c: FloatArray) -> FloatArray:
    """Where the flange stands (m, 4, 4) at (m, n) joint angles and temperatures of the links."""
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
    """Where a flange stands (m, 4, 4) once warm that stood at `cold` (m, 4, 4), by its joints."""
    return heated_poses(arm, heat, q, links_c) @ (invert(forward(arm, q)) @ cold)

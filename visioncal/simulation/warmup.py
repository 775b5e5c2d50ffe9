"""An arm that warms up while it works: what heats it, how it grows, and what is seen meanwhile.

Each joint is a heat source that its motor's current drives, with the air around it as its sink: a
first-order RC element, stepped exactly for a duty that is constant from sample to sample. The link
behind a joint follows the joint's temperature, grows in proportion to it, and the joint's zero
drifts.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.session import Session
from visioncal.session import Stream as Recorded
from visioncal.simulation.arms import Arm, forward
from visioncal.simulation.cell import (
    Cell,
    simulate,
)
from visioncal.simulation.observed_points import whole
from visioncal.simulation.options import CellOptions
from visioncal.simulation.records import network_session
from visioncal.simulation.truth import truth_of, write_truth

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

    def recorded(self, *, temperatures: bool, until_s: float = np.inf) -> Recorded:
        """The controller's stream up to a time: temperatures, or else currents."""
        kept = self.stamps_s <= until_s
        signals = self.sensors_c if temperatures else self.currents_a
        form = "temp{}_c" if temperatures else "current{}_a"
        names = [form.format(at + 1) for at in range(signals.shape[1])]
        columns = [self.stamps_s[:, None], signals, self.ambient_c[:, None]]
        return Recorded(("stamp_s", *names, "ambient_c"), np.hstack(columns)[kept])


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


def heated_poses(arm: Arm, heat: Heat, q: FloatArray, links_c: FloatArray) -> FloatArray:
    """Where the flange stands (m, 4, 4) at (m, n) joint angles and temperatures of the links."""
    poses = []
    for row, rise in zip(q, links_c - heat.ambient_c, strict=True):
        grown = 1.0 + heat.growth_per_k * rise
        offset = arm.offset + heat.drift_rad_per_k * rise
        warm = replace(arm, a=arm.a * grown, d=arm.d * grown, offset=offset)
        poses.append(forward(warm, row[None])[0])
    return np.array(poses)


def heated_flanges(
    arm: Arm, heat: Heat, q: FloatArray, links_c: FloatArray, cold: FloatArray
) -> FloatArray:
    """Where a flange stands (m, 4, 4) once warm that stood at `cold` (m, 4, 4), by its joints."""
    return heated_poses(arm, heat, q, links_c) @ (invert(forward(arm, q)) @ cold)


@dataclass(frozen=True, eq=False)
class WarmUp:
    """A session while the arm warms up.

    Attributes:
        cell: What was seen, view by view, by an arm as warm as it was then.
        stamps_s: (m,) when.
        warming: The temperatures, all through.
        heat: What heats the arm.
    """

    cell: Cell
    stamps_s: FloatArray
    warming: Warming
    heat: Heat

    def session(self, name: str, *, temperatures: bool = True) -> Session:
        """The session: measured poses with their times, and the stream `heat`.

        Args:
            name: Its name.
            temperatures: Whether the controller reports temperatures; else currents.
        """
        session = network_session(whole(self.cell, stamps_s=self.stamps_s), name, seen="poses")
        stream = self.warming.recorded(temperatures=temperatures, until_s=self.stamps_s[-1])
        return session.with_streams({"heat": stream})


@dataclass(frozen=True, eq=False)
class Round:
    """When what is looked at.

    Attributes:
        first: Views all over, one after the other, before the arm is warm.
        references: How many of them are looked at again and again.
        every_s: Time from one round of these to the next [s].
        minutes: How long that goes on.
        pace_s: Time from view to view [s].
    """

    first: int = 24
    references: int = 6
    every_s: float = 300.0
    minutes: float = 100.0
    pace_s: float = 5.0

    def schedule(self) -> tuple[FloatArray, Sequence[int]]:
        """(m,) times [s], and which of the first views is looked at."""
        stamps = list(self.pace_s * np.arange(self.first))
        shown = list(range(self.first))
        covariance = np.linspace(0, self.first - 1, self.references).astype(int).tolist()
        for begin in np.arange(self.every_s, 60.0 * self.minutes, self.every_s):
            stamps += list(begin + self.pace_s * np.arange(self.references))
            shown += covariance
        return np.array(stamps), shown


@dataclass(frozen=True, eq=False)
class WarmUpOptions:
    """A cell in which an arm warms up.

    Attributes:
        cell: The cell.
        heat: What heats the arm; None draws it by the cell's seed.
        round: When what is looked at.
        hours: How long the temperatures go on.
    """

    cell: CellOptions = field(default_factory=CellOptions)
    heat: Heat | None = None
    round: Round = field(default_factory=Round)
    hours: float = 5.0


def simulate_warm_up(options: WarmUpOptions) -> WarmUp:
    """Looks at a cell's board while its arm warms up.

    Raises:
        DataError: As `simulate`.
    """
    seed = options.cell.seed
    heat = options.heat or Heat.drawn(seed)
    stamps_s, shown = options.round.schedule()
    postures = simulate(replace(options.cell, views=options.round.first)).joints
    cold = simulate(options.cell, postures[list(shown)])
    warming = warm_up(heat, options.hours, seed=seed)
    links_c, stood = warming.at(stamps_s), cold.true_base_from_flange
    warm = cold.standing_at(heated_flanges(cold.true_arm, heat, cold.joints, links_c, stood))
    return WarmUp(warm, stamps_s, warming, heat)


def write_warm_up(moved: WarmUp, folder: Path | str, *, temperatures: bool = True) -> Path:
    """Writes a warm-up as a session's folder, and its truth beside it.

    Args:
        moved: What was seen meanwhile.
        folder: The session's folder; it must not hold anything yet.
        temperatures: Whether the controller reports temperatures; else currents.

    Returns:
        The session's folder.

    Raises:
        DataError: The folder cannot be written.
    """
    folder = Path(folder)
    moved.session(folder.name, temperatures=temperatures).save(folder)
    write_truth(folder, truth_of(moved.cell) | {"heat": asdict(moved.heat)})
    return folder

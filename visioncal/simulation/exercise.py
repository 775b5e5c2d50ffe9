"""Motions of a simulated arm, and the records of its controller."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.session import Session, Stream
from visioncal.simulation.cell import SimulatedCell
from visioncal.simulation.dynamics import DynamicArm, LinkBody, drive_torques, real_dynamics
from visioncal.simulation.truth import write_truth

_HARMONICS = 5


@dataclass(frozen=True, eq=False)
class Exercise:
    """A motion: (m,) times [s], and (m, n) joint angles [rad], speeds and accelerations."""

    times_s: FloatArray
    q: FloatArray
    dq: FloatArray
    ddq: FloatArray


@dataclass(frozen=True)
class Senses:
    """Accuracy of a controller's records."""

    q_rad: float = 1e-5  # Standard deviation of the angles [rad].
    # Standard deviation of the speeds [rad/s]; None if they are not recorded.
    dq_rad_s: float | None = 1e-3
    # Standard deviation of the torques, relative to each joint's rms torque.
    torque_share: float = 0.03
    torque_nm: float = 0.0  # Constant addition to it [N m].
    # (n,) torque constants [N m/A]; if given, currents are recorded instead of torques.
    gains_nm_a: tuple[float, ...] = ()


def multi_sine(
    count: int,
    rng: np.random.Generator,
    *,
    seconds: float = 20.0,
    rate_hz: float = 500.0,
    speed_rad_s: float = 2.0,
) -> Exercise:
    """A random periodic motion of `count` joints with five harmonics, of one period."""
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    omega = 2.0 * np.pi / seconds * np.arange(1, _HARMONICS + 1)
    phases = omega[:, None] * times_s
    amplitudes = rng.standard_normal((2, count, _HARMONICS)) / omega
    sines, cosines = np.sin(phases), np.cos(phases)
    dq = (amplitudes[0] * omega) @ cosines - (amplitudes[1] * omega) @ sines
    amplitudes *= (speed_rad_s / np.abs(dq).max(axis=1))[:, None]
    centre = rng.uniform(-1.0, 1.0, (count, 1))
    return Exercise(
        times_s,
        (centre + amplitudes[0] @ sines + amplitudes[1] @ cosines).T,
        ((amplitudes[0] * omega) @ cosines - (amplitudes[1] * omega) @ sines).T,
        (-(amplitudes[0] * omega**2) @ sines - (amplitudes[1] * omega**2) @ cosines).T,
    )


def slow_sweep(
    count: int,
    rng: np.random.Generator,
    *,
    seconds: float = 60.0,
    rate_hz: float = 500.0,
    speed_rad_s: float = 0.15,
) -> Exercise:
    """Oscillation of every joint at low speed, with many reversals."""
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    omega = 2.0 * np.pi * rng.uniform(0.1, 0.15, count)
    phases = omega * times_s[:, None] + rng.uniform(0.0, 2.0 * np.pi, count)
    centre, amplitude = rng.uniform(-1.0, 1.0, count), speed_rad_s / omega
    return Exercise(
        times_s,
        centre + amplitude * np.sin(phases),
        amplitude * omega * np.cos(phases),
        -amplitude * omega**2 * np.sin(phases),
    )


def record(
    built: DynamicArm, motion: Exercise, rng: np.random.Generator, senses: Senses | None = None
) -> Stream:
    """The controller's record of a motion, with noise."""
    senses = Senses() if senses is None else senses
    torques = drive_torques(built, motion.q, motion.dq, motion.ddq)
    sigma = senses.torque_share * np.sqrt(np.mean(torques**2, axis=0)) + senses.torque_nm
    torques = torques + sigma * rng.standard_normal(torques.shape)
    groups = {"q{}_rad": motion.q + senses.q_rad * rng.standard_normal(motion.q.shape)}
    if senses.dq_rad_s is not None:
        groups["dq{}_rad_s"] = motion.dq + senses.dq_rad_s * rng.standard_normal(motion.dq.shape)
    if senses.gains_nm_a:
        groups["current{}_a"] = torques / np.array(senses.gains_nm_a)
    else:
        groups["tau{}_nm"] = torques
    numbers = range(1, motion.q.shape[1] + 1)
    columns = ("stamp_s", *(name.format(number) for name in groups for number in numbers))
    return Stream(columns, np.column_stack([motion.times_s, *groups.values()]))


@dataclass(frozen=True)
class ExerciseOptions:
    """Options of a recording for dynamic identification."""

    robot: str = "ur10e"  # `ur5e` or `ur10e`.
    load: LinkBody | None = None  # Load on the flange; None for none.
    senses: Senses = field(default_factory=Senses)  # Accuracy of the controller's records.
    rate_hz: float = 250.0  # Samples per second.
    seed: int = 0  # Seed of everything random; the arm is the same with and without a load.


@dataclass(frozen=True, eq=False)
class Exercised:
    """A recording for dynamic identification."""

    streams: Mapping[str, Stream]  # Motions `excite`, `sweeps` and `fresh`.
    arm: DynamicArm  # Real arm, without its load.


def seed_of(*numbers: int) -> int:
    """One seed from several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def exercise(options: ExerciseOptions) -> Exercised:
    """Moves an arm and records it.

    Raises:
        DataError: The arm's dynamics are unknown.
    """
    empty = real_dynamics(options.robot, np.random.default_rng([options.seed, 0]), stribeck=True)
    built = empty if options.load is None else empty.carrying(options.load)
    rng, count, rate = np.random.default_rng([options.seed, 1]), len(built.bodies), options.rate_hz
    motions = {
        "excite": multi_sine(count, rng, rate_hz=rate),
        "sweeps": slow_sweep(count, rng, seconds=30.0, rate_hz=rate),
        "fresh": multi_sine(count, rng, rate_hz=rate),
    }
    streams = {name: record(built, motion, rng, options.senses) for name, motion in motions.items()}
    return Exercised(streams, empty)


def with_exercises(cell: SimulatedCell, exercised: Mapping[str, Exercised]) -> SimulatedCell:
    """A cell with the recorded motions of its robots, as streams `ROBOT_MOTION`."""
    streams = {
        f"{robot}_{motion}": stream
        for robot, recording in exercised.items()
        for motion, stream in recording.streams.items()
    }
    arms = {robot: asdict(item.arm) for robot, item in exercised.items()}
    return replace(
        cell, streams={**cell.streams, **streams}, facts={**cell.facts, "dynamics": arms}
    )


def write_exercise(options: ExerciseOptions, folder: Path | str) -> Path:
    """Writes the streams `excite`, `sweeps` and `fresh` of an arm, and its ground truth.

    Returns:
        The session's folder.

    Raises:
        DataError: The arm's dynamics are unknown, or the folder cannot be written.
    """
    folder, recording = Path(folder), exercise(options)
    exercise_session(options.robot, recording.streams, folder.name).save(folder)
    write_truth(folder, {"schema": 1, "options": asdict(options), "arm": asdict(recording.arm)})
    return folder


def exercise_session(robot: str, streams: Mapping[str, Stream], name: str = "exercise") -> Session:
    """A session of motions only, without views."""
    document = {"schema": 1, "name": name, "robot": {"model": robot}}
    return Session.of_streams(document, streams)

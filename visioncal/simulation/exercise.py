"""Motions of a simulated arm, and what its controller records of them."""

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
    """A motion: (m,) times [s], and (m, n) angles [rad], speeds and accelerations."""

    times_s: FloatArray
    q: FloatArray
    dq: FloatArray
    ddq: FloatArray


@dataclass(frozen=True)
class Senses:
    """How well a controller records.

    Attributes:
        q_rad: Noise of the angles, as a standard deviation [rad].
        dq_rad_s: That of the speeds; None where none are recorded [rad/s].
        torque_share: That of the torques, as a share of their root mean square by joint.
        torque_nm: What is added to it, whatever the torques are [N m].
        gains_nm_a: (n,) torque for a current; currents are recorded in the place of torques where
            it is reported [N m/A].
    """

    q_rad: float = 1e-5
    dq_rad_s: float | None = 1e-3
    torque_share: float = 0.03
    torque_nm: float = 0.0
    gains_nm_a: tuple[float, ...] = ()


def multi_sine(
    count: int,
    rng: np.random.Generator,
    *,
    seconds: float = 20.0,
    rate_hz: float = 500.0,
    speed_rad_s: float = 2.0,
) -> Exercise:
    """A periodic motion of all of `count` joints, of five harmonics each, at random.

    Args:
        count: The number of joints.
        rng: Source of randomness.
        seconds: Its length, which is one period.
        rate_hz: Samples a second.
        speed_rad_s: The highest speed of each joint.
    """
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    omega = 2.0 * np.pi / seconds * np.arange(1, _HARMONICS + 1)
    turns = omega[:, None] * times_s
    size = rng.standard_normal((2, count, _HARMONICS)) / omega
    sines, cosines = np.sin(turns), np.cos(turns)
    dq = (size[0] * omega) @ cosines - (size[1] * omega) @ sines
    size *= (speed_rad_s / np.abs(dq).max(axis=1))[:, None]
    middle = rng.uniform(-1.0, 1.0, (count, 1))
    return Exercise(
        times_s,
        (middle + size[0] @ sines + size[1] @ cosines).T,
        ((size[0] * omega) @ cosines - (size[1] * omega) @ sines).T,
        (-(size[0] * omega**2) @ sines - (size[1] * omega**2) @ cosines).T,
    )


def slow_sweep(
    count: int,
    rng: np.random.Generator,
    *,
    seconds: float = 60.0,
    rate_hz: float = 500.0,
    speed_rad_s: float = 0.15,
) -> Exercise:
    """Every joint to and fro at up to a low speed, which it passes from rest again and again."""
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    omega = 2.0 * np.pi * rng.uniform(0.1, 0.15, count)
    turns = omega * times_s[:, None] + rng.uniform(0.0, 2.0 * np.pi, count)
    middle, size = rng.uniform(-1.0, 1.0, count), speed_rad_s / omega
    return Exercise(
        times_s,
        middle + size * np.sin(turns),
        size * omega * np.cos(turns),
        -size * omega**2 * np.sin(turns),
    )


def record(
    built: DynamicArm, done: Exercise, rng: np.random.Generator, senses: Senses | None = None
) -> Stream:
    """What the controller records of a motion, with noise."""
    senses = Senses() if senses is None else senses
    torques = drive_torques(built, done.q, done.dq, done.ddq)
    sigma = senses.torque_share * np.sqrt(np.mean(torques**2, axis=0)) + senses.torque_nm
    torques = torques + sigma * rng.standard_normal(torques.shape)
    groups = {"q{}_rad": done.q + senses.q_rad * rng.standard_normal(done.q.shape)}
    if senses.dq_rad_s is not None:
        groups["dq{}_rad_s"] = done.dq + senses.dq_rad_s * rng.standard_normal(done.dq.shape)
    if senses.gains_nm_a:
        groups["current{}_a"] = torques / np.array(senses.gains_nm_a)
    else:
        groups["tau{}_nm"] = torques
    numbers = range(1, done.q.shape[1] + 1)
    columns = ("stamp_s", *(name.format(number) for name in groups for number in numbers))
    return Stream(columns, np.column_stack([done.times_s, *groups.values()]))


@dataclass(frozen=True)
class ExerciseOptions:
    """What a recording for the dynamics is drawn from.

    Attributes:
        robot: `ur5e` or `ur10e`.
        load: What the flange carries; None for nothing.
        senses: How well the controller records.
        rate_hz: Samples a second.
        seed: Of everything random; the arm is the same with and without a load.
    """

    robot: str = "ur10e"
    load: LinkBody | None = None
    senses: Senses = field(default_factory=Senses)
    rate_hz: float = 250.0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Exercised:
    """What a controller recorded.

    Attributes:
        streams: The motions `excite`, `sweeps` and `fresh`.
        arm: The arm as it was built, without its load.
    """

    streams: Mapping[str, Stream]
    arm: DynamicArm


def seed_of(*numbers: int) -> int:
    """One seed of several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def exercise(options: ExerciseOptions) -> Exercised:
    """Moves an arm, and records it.

    Raises:
        DataError: Nothing is known of the arm.
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
    """A cell with what its robots' controllers recorded of motions: streams are `ROBOT_MOTION`."""
    streams = {
        f"{robot}_{motion}": stream
        for robot, done in exercised.items()
        for motion, stream in done.streams.items()
    }
    arms = {robot: asdict(item.arm) for robot, item in exercised.items()}
    return replace(
        cell, streams={**cell.streams, **streams}, facts={**cell.facts, "dynamics": arms}
    )


def write_exercise(options: ExerciseOptions, folder: Path | str) -> Path:
    """Writes the streams `excite`, `sweeps` and `fresh` of an arm, and its truth beside them.

    Returns:
        The session's folder.

    Raises:
        DataError: Nothing is known of the arm, or the folder cannot be written.
    """
    folder, done = Path(folder), exercise(options)
    exercise_session(options.robot, done.streams, folder.name).save(folder)
    write_truth(folder, {"schema": 1, "options": asdict(options), "arm": asdict(done.arm)})
    return folder


def exercise_session(robot: str, streams: Mapping[str, Stream], name: str = "exercise") -> Session:
    """A session of motions alone, without views."""
    document = {"schema": 1, "name": name, "robot": {"model": robot}}
    return Session.of_streams(document, streams)

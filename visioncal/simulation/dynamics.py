"""Dynamics of a simulated arm, its motions, and the records of its controller.

A Newton-Euler recursion of inertia, weight, friction and load in plain numpy over the frames of the
simulated arm, independent of the application's dynamic model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.session import Session, Stream
from visioncal.simulation.arms import BODIES, GRAVITY, DhArm, arm_named, link_frames
from visioncal.simulation.cell import SimulatedCell
from visioncal.simulation.records import write_truth

# Harmonics of a periodic motion.
_HARMONICS = 5
# Principal moments of inertia about the centres of mass [kg m^2], in the link frames: Universal
# Robots, "DH parameters for calculations of kinematics and dynamics", rounded.
_INERTIA: Mapping[str, Sequence[Sequence[float]]] = {
    "ur5e": (
        *((0.0084, 0.0064, 0.0084), (0.0078, 0.21, 0.21), (0.0016, 0.0462, 0.0462)),
        *((0.0016, 0.0016, 0.0009), (0.0016, 0.0016, 0.0009), (0.0001, 0.0001, 0.0001)),
    ),
    "ur10e": (
        *((0.0341, 0.0353, 0.0216), (0.0281, 0.7707, 0.7694), (0.0101, 0.3093, 0.3065)),
        *((0.003, 0.0022, 0.0026), (0.003, 0.0022, 0.0026), (0.0004, 0.0004, 0.0005)),
    ),
}
# Typical Coulomb [N m] and viscous friction [N m s/rad] of each joint.
_COULOMB, _VISCOUS = (9.0, 10.0, 7.0, 1.6, 1.5, 1.4), (12.0, 13.0, 9.0, 1.5, 1.4, 1.3)


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
    if name not in _INERTIA:
        raise DataError(
            f"simulation: nothing is known of the dynamics of {name!r}, only of "
            f"{', '.join(sorted(_INERTIA))}."
        )
    bodies = tuple(
        LinkBody(kg, np.array(centre), np.diag(main))
        for (kg, centre), main in zip(BODIES[name], _INERTIA[name], strict=True)
    )
    zeros = np.zeros(len(bodies))
    return DynamicArm(
        arm_named(name), bodies, Gears(zeros, zeros, zeros, zeros, zeros + 1.0, zeros)
    )


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
    scale = nominal.bodies[1].kg / BODIES["ur5e"][1][0]

    def around(values: Sequence[float]) -> FloatArray:
        return np.asarray(scale * np.array(values) * rng.uniform(0.7, 1.3, count))

    coulomb = around(_COULOMB)
    gears = Gears(
        coulomb,
        around(_VISCOUS),
        0.1 * coulomb * rng.standard_normal(count),
        coulomb * rng.uniform(0.2, 1.0, count) * stribeck,
        rng.uniform(0.01, 0.05, count),
        around((1.1, 1.2, 0.9, 0.08, 0.08, 0.07)),
    )
    bodies = []
    for body in nominal.bodies:
        kg = body.kg * np.exp(0.2 * rng.standard_normal())
        second_moments = 0.5 * np.trace(body.inertia_kg_m2) * np.eye(3) - body.inertia_kg_m2
        stretch = np.sqrt(kg / body.kg) * (np.eye(3) + 0.1 * rng.standard_normal((3, 3)))
        second_moments = stretch @ second_moments @ stretch.T
        centre = body.centre_m + 0.01 * rng.standard_normal(3)
        inertia = np.trace(second_moments) * np.eye(3) - second_moments
        bodies.append(LinkBody(float(kg), centre, inertia))
    return replace(nominal, bodies=tuple(bodies), gears=gears)


def drive_torques(built: DynamicArm, q: FloatArray, dq: FloatArray, ddq: FloatArray) -> FloatArray:
    """(m, n) drive torques [N m] of a motion (Luh, Walker and Paul 1980).

    `q`, `dq` and `ddq` are (m, n) joint angles [rad], speeds and accelerations. All vectors are in
    the base frame.
    """
    frames = link_frames(built.arm, q)
    axes, origins = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
    angular_velocity = angular_acceleration = np.zeros((len(q), 3))
    # Gravity as an upward acceleration of the base.
    acceleration = np.broadcast_to(-GRAVITY, (len(q), 3))
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
    """Moves an arm and records it; raises DataError."""
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


def write_exercise(options: ExerciseOptions, folder: Path) -> None:
    """Writes the streams `excite`, `sweeps` and `fresh` of an arm, and its ground truth.

    Raises:
        DataError: The arm's dynamics are unknown, or the folder cannot be written.
    """
    recording = exercise(options)
    exercise_session(options.robot, recording.streams, folder.name).save(folder)
    write_truth(folder, {"schema": 1, "options": asdict(options), "arm": asdict(recording.arm)})


def exercise_session(robot: str, streams: Mapping[str, Stream], name: str = "exercise") -> Session:
    """A session of motions only, without views."""
    document = {"schema": 1, "name": name, "robot": {"model": robot}}
    return Session.of_streams(document, streams)

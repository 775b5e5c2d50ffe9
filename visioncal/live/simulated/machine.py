"""A robot of a simulated controller: its motions, program, faults and registers, at a time."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.types import FloatArray
from visioncal.simulation.arms import ArmOptions, DhArm, arm_named, forward

# `none` mends all others.
Fault: TypeAlias = Literal[
    "none", "protective-stop", "emergency-stop", "power-off", "remote-off", "link-lost", "silent"
]
# Joint angles at the start [rad]: elbow up, the tool pointing down, clear of every singularity.
_HOME = (0.0, -1.45, 1.75, -1.9, -1.5708, 0.0)
# The payload that is set, and its centre of mass in the flange frame [kg, m].
_PAYLOAD_KG, _PAYLOAD_M = 0.6, (0.0, 0.0, 0.04)
# The control script of ur-rtde executes commands from registers. The client writes the number of
# one at a time into the first, its arguments into others; the script answers with 1 ready, 2 done.
# A command stays until the client clears it. Motions are asynchronous, as our driver asks for them,
# and commands that it does not use are done at once.
COMMAND = "input_int_register_0"
_STATE, _PROGRESS = "output_int_register_0", "output_int_register_2"
_READY, _DONE, REGISTERS = 1, 2, 48
_MOVE_JOINTS, _STOP_JOINTS, _SET_WATCHDOG, _GET_TOOL_OFFSET, _STOP = 1, 34, 35, 40, 255
SAFETY = {
    "normal": ("NORMAL", 1 << 0),
    "protective-stop": ("PROTECTIVE_STOP", 1 << 2),
    "emergency-stop": ("ROBOT_EMERGENCY_STOP", 1 << 6 | 1 << 7),
}
MODES = {"POWER_OFF": 3, "RUNNING": 7}


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated controller and its arm."""

    robot: str = "ur10e"  # `ur3e`, `ur5e` or `ur10e`.
    seed: int = 0
    # Errors of the true arm relative to its controller's model.
    errors: ArmOptions = field(
        default_factory=lambda: ArmOptions(
            dh_sigma_m=3e-4, dh_sigma_rad=3e-4, offset_sigma_rad=5e-4
        )
    )
    # By how much each joint stands beyond what its encoder reads [rad]; empty for nothing.
    slip_rad: tuple[float, ...] = ()
    q: tuple[float, ...] = _HOME  # Joint angles at the start [rad].
    # Tool offset that is set: x, y, z [m] and a rotation vector [rad].
    tcp: tuple[float, ...] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    # Sigma of a joint's error relative to its encoder, drawn anew for each motion [rad].
    repeatability_rad: float = 1e-5
    rate_hz: float = 125.0  # States per second.
    # Its software; PolyScope X, from 10 on, has no dashboard.
    polyscope: tuple[int, int, int, int] = (5, 11, 6, 1010000)

    @property
    def believed_arm(self) -> DhArm:
        """Controller's model of the arm: its data sheet."""
        return arm_named(self.robot)

    @property
    def true_arm(self) -> DhArm:
        """True arm, with errors."""
        arm = replace(self.errors, robot=self.robot).built(np.random.default_rng([self.seed, 2]))
        return replace(arm, offset=arm.offset + np.array(self.slip_rad or 0.0))


class TrueState(NamedTuple):
    """True states of the arm at m moments."""

    q: FloatArray  # (m, n) joint angles [rad].
    dq: FloatArray  # (m, n) joint speeds [rad/s].
    base_from_flange: FloatArray  # (m, 4, 4) by the arm's true geometry [m].


@dataclass(frozen=True, eq=False)
class Motion:
    """Straight path of all joints, with a trapezoidal or triangular speed profile.

    It is a function of time, not a table of ticks: the joints are defined at any moment, however
    late the simulating process is scheduled.
    """

    begins_s: float  # When it begins [s].
    start: FloatArray  # (n,) first posture [rad].
    goal: FloatArray  # (n,) last posture [rad].
    speed: float = 1.0  # Speed limit of the joint that travels farthest [rad/s].
    acceleration: float = 1.0  # Its acceleration [rad/s^2].

    @property
    def _profile(self) -> tuple[float, float]:
        """Distance [rad] and greatest speed [rad/s]."""
        distance = float(np.abs(self.goal - self.start).max())
        return distance, min(self.speed, float(np.sqrt(distance * self.acceleration)))

    @property
    def ends_s(self) -> float:
        """When the joints have come to rest [s]."""
        distance, peak = self._profile
        return self.begins_s + (distance / peak + peak / self.acceleration if distance else 0.0)

    def at(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        distance, peak = self._profile
        since_s, left_s = at_s - self.begins_s, self.ends_s - at_s
        # Both halves are alike: the way from the start, or to the goal.
        near_s = max(min(since_s, left_s), 0.0)
        ramp_s = min(near_s, peak / self.acceleration)
        way = 0.5 * self.acceleration * ramp_s**2 + peak * (near_s - ramp_s)
        all_way = (self.goal - self.start) / max(distance, 1e-12)
        q = self.start + all_way * way if since_s < left_s else self.goal - all_way * way
        return q, all_way * self.acceleration * ramp_s


# When a motion takes over [s], the motion, and the joints' errors relative to their encoders [rad].
Entry: TypeAlias = tuple[float, Motion, FloatArray]


class Machine:
    """The arm with its safety system and control script; times are monotonic [s]."""

    def __init__(self, options: ControllerOptions) -> None:
        self.options, self.believed, self.true = options, options.believed_arm, options.true_arm
        self.safety, self.mode, self.remote, self.playing = "normal", "RUNNING", True, False
        self.began_s = time.monotonic()
        self.registers: dict[str, float] = {}
        for way in ("input", "output"):
            for place in range(REGISTERS):
                self.registers[f"{way}_int_register_{place}"] = 0
                self.registers[f"{way}_double_register_{place}"] = 0.0
        self._is_driven, self._reports = False, 0
        self._watchdog_hz, self._last_tick_s = 0.0, 0.0
        # When the client last wrote its command register.
        self.heard_s = 0.0
        self._rng = np.random.default_rng([options.seed, 3])
        # Replaced as a whole, since another thread reads it.
        self._history: tuple[Entry, ...] = ()
        self.start(Motion(self.began_s, np.array(options.q), np.array(options.q)), self.began_s)

    def joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s] by the encoders."""
        return self._entry(at_s)[1].at(at_s)

    def state(self, at_s: Sequence[float]) -> TrueState:
        """True states at some moments."""
        entries = [(*self.joints(moment), self._entry(moment)[2]) for moment in at_s]
        q, dq, errors = (np.array(rows) for rows in zip(*entries, strict=True))
        return TrueState(q + errors, dq, forward(self.true, q + errors))

    def moving(self, at_s: float) -> bool:
        """Whether a motion is in progress."""
        return at_s < self._history[-1][1].ends_s

    def start(self, motion: Motion, now_s: float) -> None:
        """Starts a motion, replacing one in progress."""
        error = self.options.repeatability_rad * self._rng.standard_normal(len(motion.goal))
        # Pictures are requested within a motion or two.
        self._history = (*self._history[-50:], (now_s, motion, error))

    def brake(self, now_s: float, deceleration: float = 20.0) -> None:
        """Brakes a motion in progress, with a deceleration in [rad/s^2]."""
        if self.moving(now_s):
            q, dq = self.joints(now_s)
            speed = max(float(np.abs(dq).max()), 1e-12)
            # The last ramp of a motion.
            way = 0.5 * dq * speed / deceleration
            begins_s = now_s - speed / deceleration
            self.start(Motion(begins_s, q - way, q + way, speed, deceleration), now_s)

    def guide(self, q: FloatArray, speed: float, acceleration: float) -> float:
        """Moves the arm as if by hand; see `SimulatedController.guide`."""
        now_s = time.monotonic()
        motion = Motion(now_s, self.joints(now_s)[0], q, speed, acceleration)
        self.start(motion, now_s)
        return motion.ends_s

    def stop_program(self, now_s: float) -> None:
        """Ends the control script, and any motion with it."""
        self.playing = False
        self.brake(now_s)

    def inject(self, fault: Fault) -> None:
        """Lets a fault happen, or mends all."""
        self.safety = fault if fault in SAFETY else "normal"
        self.mode = "POWER_OFF" if fault in ("emergency-stop", "power-off") else "RUNNING"
        self.remote = fault != "remote-off"
        # Once mended, the control script has to be sent again.
        self.stop_program(time.monotonic())

    def tool_pose(self, now_s: float) -> FloatArray:
        """Pose (6,) of the tool, by the controller's model."""
        tcp = np.array(self.options.tcp)
        offset = RigidTransform.from_components(tcp[:3], Rotation.from_rotvec(tcp[3:]))
        pose = forward(self.believed, self.joints(now_s)[0][None])[0] @ offset.as_matrix()
        return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])

    def reported(self, now_s: float) -> dict[str, Sequence[float]]:
        """Values of the variables that clients are sent."""
        q, dq = self.joints(now_s)
        # Power, program, power button.
        status = (self.mode != "POWER_OFF") | self.playing << 1 | 1 << 3
        return {
            "timestamp": [now_s - self.began_s],
            "actual_q": q.tolist(),
            "actual_qd": dq.tolist(),
            "actual_current": [1.5] * 6,
            "actual_TCP_pose": self.tool_pose(now_s).tolist(),
            "external_force_torque": [0.0] * 6,
            "joint_temperatures": [33.0] * 6,
            "robot_mode": [MODES[self.mode]],
            "runtime_state": [1 + self.playing],
            "robot_status_bits": [status],
            "safety_status_bits": [SAFETY[self.safety][1]],
            "payload": [_PAYLOAD_KG],
            "payload_cog": _PAYLOAD_M,
        } | {name: [value] for name, value in self.registers.items()}

    def begin_script(self, now_s: float) -> None:
        """Starts the control script when its text arrives."""
        if self.safety == "normal" and self.mode == "RUNNING" and self.remote:
            self.playing, self._is_driven = True, False
            self._watchdog_hz, self.heard_s = 0.0, now_s
            self.registers[_STATE] = _READY

    def tick(self, now_s: float) -> None:
        """Executes what is due, once a cycle."""
        registers = self.registers
        if now_s - self._last_tick_s > 0.1:
            # After a stall of this computer, commands may have arrived that are not read yet.
            self.heard_s = now_s
        self._last_tick_s = now_s
        if self._is_driven and not self.moving(now_s):
            self._report(is_driven=False)
        if not self.playing:
            return
        if self._watchdog_hz * (now_s - self.heard_s) > 1.0:
            self.stop_program(now_s)
            return
        command = int(registers[COMMAND])
        if registers[_STATE] == _DONE:
            registers[_STATE] = _DONE if command else _READY
        elif command:
            registers[_STATE] = _DONE
            self._execute(command, now_s)

    def _execute(self, command: int, now_s: float) -> None:
        # Of a motion: six joints, speed and acceleration.
        numbers = [self.registers[f"input_double_register_{place}"] for place in range(8)]
        if command == _MOVE_JOINTS:
            self.guide(np.array(numbers[:6]), *numbers[6:])
            self._report(is_driven=True)
        elif command == _STOP_JOINTS:
            self.brake(now_s, max(numbers[0], 0.01))
        elif command == _SET_WATCHDOG:
            self._watchdog_hz, self.heard_s = numbers[0], now_s
        elif command == _GET_TOOL_OFFSET:
            for place, value in enumerate(self.options.tcp):
                self.registers[f"output_double_register_{place}"] = value
        elif command == _STOP:
            self.stop_program(now_s)

    def _report(self, *, is_driven: bool) -> None:
        """Reports the motion: its number, the count of reports, whether it runs."""
        self._is_driven, self._reports = is_driven, (self._reports + 1) % 256
        number = self._reports // 2
        self.registers[_PROGRESS] = number << 24 | self._reports << 16 | int(is_driven) << 15

    def _entry(self, at_s: float) -> Entry:
        history = self._history
        return next((entry for entry in reversed(history) if entry[0] <= at_s), history[0])

"""Simulated arm and its controller's model of it: motion, safety, tool and payload.

The controller's poses are x, y, z [m] and a rotation vector [rad], by its nominal model of the arm.
A motion is a function of time, not a table of ticks: the joints are defined at any moment, however
late the simulating process is scheduled.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.types import FloatArray
from visioncal.simulation.arms import ArmErrors, DhArm, disturb, forward, ur_arm

# How long past motions are kept [s]: pictures are requested within this time.
_MEMORY_S = 60.0
# Deceleration of a stop by the safety system [rad/s^2].
_STOP_DECELERATION = 20.0
# Elbow up, the tool pointing down: clear of every singularity.
_HOME = (0.0, -1.45, 1.75, -1.9, -1.5708, 0.0)
Program: TypeAlias = Literal["stopped", "playing", "paused"]


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated controller and its arm."""

    robot: str = "ur10e"  # `ur3e`, `ur5e` or `ur10e`.
    seed: int = 0
    # Errors of the true arm relative to its controller's model.
    errors: ArmErrors = field(
        default_factory=lambda: ArmErrors(dh_sigma_m=3e-4, dh_sigma_rad=3e-4, offset_sigma_rad=5e-4)
    )
    q: tuple[float, ...] = _HOME  # Joint angles at the start [rad].
    # Tool offset that is set: x, y, z [m] and a rotation vector [rad].
    tcp: tuple[float, ...] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    payload_kg: float = 0.6  # Payload that is set [kg].
    payload_m: tuple[float, ...] = (0.0, 0.0, 0.04)  # Its centre of mass in the flange frame [m].
    # Sigma of a joint's error relative to its encoder, drawn anew for each motion [rad].
    repeatability_rad: float = 1e-5
    polyscope: str = "URSoftware 5.11.6.1010000 (Aug 01 2024)"  # The dashboard's version string.
    rate_hz: float = 125.0  # States per second.

    @property
    def believed_arm(self) -> DhArm:
        """Controller's model of the arm: its data sheet."""
        return ur_arm(self.robot)

    @property
    def true_arm(self) -> DhArm:
        """True arm, with errors."""
        return disturb(self.believed_arm, self.errors, np.random.default_rng([self.seed, 2]))


@dataclass(frozen=True, eq=False)
class Motion:
    """Straight path of all joints, with a trapezoidal or triangular speed profile."""

    start: FloatArray  # (n,) first posture [rad].
    goal: FloatArray  # (n,) last posture [rad].
    speed: float = 1.0  # Speed limit of the joint that travels farthest [rad/s].
    acceleration: float = 1.0  # Its acceleration [rad/s^2].
    # Elapsed time at the start [s]: braking is the last ramp of such a motion.
    begun_at: float = 0.0

    @classmethod
    def braking(cls, q: FloatArray, dq: FloatArray, deceleration: float) -> "Motion":
        """Brakes from a posture (n,) [rad] and speeds (n,) [rad/s], all joints together."""
        speed = float(np.abs(dq).max())
        way = 0.5 * dq * speed / deceleration
        ramp_s = speed / deceleration
        return cls(q - way, q + way, max(speed, 1e-12), deceleration, ramp_s)

    @property
    def _profile(self) -> tuple[float, float, float]:
        """Distance [rad], greatest speed [rad/s] and time of a ramp [s]."""
        distance = float(np.abs(self.goal - self.start).max())
        peak = min(self.speed, float(np.sqrt(distance * self.acceleration)))
        return distance, peak, peak / self.acceleration

    @property
    def duration_s(self) -> float:
        """Duration [s]; afterwards the joints are at rest."""
        distance, peak, ramp_s = self._profile
        return distance / peak + ramp_s - self.begun_at if distance else 0.0

    def at(self, elapsed_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        distance, peak, ramp_s = self._profile
        left_s = self.duration_s - elapsed_s
        if left_s <= 0.0:
            return self.goal, np.zeros_like(self.goal)
        elapsed_s += self.begun_at
        if elapsed_s < ramp_s:
            place, speed = 0.5 * self.acceleration * elapsed_s**2, self.acceleration * elapsed_s
        elif left_s < ramp_s:
            place, speed = (
                distance - 0.5 * self.acceleration * left_s**2,
                self.acceleration * left_s,
            )
        else:
            place, speed = peak * (elapsed_s - 0.5 * ramp_s), peak
        way = (self.goal - self.start) / distance
        return self.start + way * place, way * speed


# Start [s], motion, and the joints' errors relative to their encoders before and after it [rad].
_Entry: TypeAlias = tuple[float, Motion, FloatArray, FloatArray]


class Machine:
    """The arm. Times are of the host's monotonic clock [s].

    Attributes:
        safety: `normal`, `protective-stop` or `emergency-stop`.
        mode: The robot's mode, as on the dashboard.
        program: State of the control script.
    """

    def __init__(self, options: ControllerOptions, now_s: float) -> None:
        self.options, self.believed, self.true = options, options.believed_arm, options.true_arm
        self.safety, self.mode, self.remote = "normal", "RUNNING", True
        self.program: Program = "stopped"
        self._rng = np.random.default_rng([options.seed, 3])
        q, error = np.array(options.q), self._draw_encoder_error()
        # Replaced as a whole, since another thread reads it.
        self._history: tuple[_Entry, ...] = ((now_s, Motion(q, q), error, error),)

    @property
    def may_move(self) -> bool:
        """Whether the brakes are off and no stop is active."""
        return self.safety == "normal" and self.mode == "RUNNING"

    def joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s] by the encoders."""
        start_s, motion, _, _ = self._motion_at(at_s)
        return motion.at(max(0.0, at_s - start_s))

    def true_joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """True joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        start_s, motion, before, after = self._motion_at(at_s)
        q, dq = motion.at(max(0.0, at_s - start_s))
        share = np.clip((at_s - start_s) / (motion.duration_s or 1e-9), 0.0, 1.0)
        return q + before + share * (after - before), dq

    def ends_s(self) -> float:
        """End of the last motion [s]."""
        return self._history[-1][0] + self._history[-1][1].duration_s

    def moving(self, at_s: float) -> bool:
        """Whether a motion is in progress."""
        return at_s < self.ends_s()

    def start(self, motion: Motion, now_s: float) -> None:
        """Starts a motion, replacing one in progress."""
        error = self.true_joints(now_s)[0] - self.joints(now_s)[0]
        entry = (now_s, motion, error, self._draw_encoder_error())
        history = (*self._history, entry)
        # A motion is needed for as long as the next one is too young.
        recent = (one for one, after in pairwise(history) if after[0] > now_s - _MEMORY_S)
        self._history = (*recent, entry)

    def brake(self, now_s: float, deceleration: float = _STOP_DECELERATION) -> None:
        """Brakes a motion in progress, with a deceleration in [rad/s^2]."""
        if self.moving(now_s):
            self.start(Motion.braking(*self.joints(now_s), deceleration), now_s)

    def stop_program(self, now_s: float) -> None:
        """Ends the control script, and any motion with it."""
        self.program = "stopped"
        self.brake(now_s)

    def apply_fault(self, fault: str, now_s: float) -> None:
        """Lets a fault happen, or ends it: see `controller.Fault`."""
        if fault in ("protective-stop", "emergency-stop"):
            self.safety = fault
            self.program = "paused" if fault == "protective-stop" else "stopped"
            self.brake(now_s)
            if fault == "emergency-stop":
                self.mode = "POWER_OFF"
        elif fault == "power-off":
            self.stop_program(now_s)
            self.mode = "POWER_OFF"
        elif fault == "local-control":
            self.remote = False
            self.stop_program(now_s)
        elif fault == "remote-control":
            self.remote = True
        elif fault == "release":
            # The control script has to be sent again.
            self.safety, self.mode, self.program = "normal", "RUNNING", "stopped"
        else:
            raise ValueError(f"there is no fault {fault!r}")

    def tool_pose(self, q: FloatArray) -> FloatArray:
        """Pose (6,) of the tool in a posture [rad], by the controller's model."""
        pose = forward(self.believed, q[None])[0] @ matrix_of(self.options.tcp)
        return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])

    def _motion_at(self, at_s: float) -> _Entry:
        history = self._history
        return next((entry for entry in reversed(history) if entry[0] <= at_s), history[0])

    def _draw_encoder_error(self) -> FloatArray:
        size = self.options.repeatability_rad
        return size * self._rng.standard_normal(self.believed.a.size)


def matrix_of(pose: FloatArray | Sequence[float]) -> FloatArray:
    """Matrix (4, 4) of a pose of six numbers."""
    numbers = np.asarray(pose, dtype=float)
    rotation = Rotation.from_rotvec(numbers[3:])
    return np.asarray(RigidTransform.from_components(numbers[:3], rotation).as_matrix())

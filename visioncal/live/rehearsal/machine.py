"""Simulated arm and its controller's model of it: motion, safety, tool and payload.

The controller's poses are x, y, z [m] and a rotation vector [rad], by its nominal model of the arm.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from visioncal.core.types import FloatArray
from visioncal.live.rehearsal.motion import Brake, Motion, Rest
from visioncal.simulation.arms import ArmErrors, DhArm, disturb, forward, inverse, ur_arm

# How long past motions are kept [s]: pictures are requested within this time.
_MEMORY_S = 60.0
# Deceleration of a stop by the safety system [rad/s^2].
_STOP_DECELERATION = 20.0
Program: TypeAlias = Literal["stopped", "playing", "paused"]
# Number of postures along a straight line of the tool.
_KNOTS = 64
# Elbow up, the tool pointing down: clear of every singularity.
_HOME = (0.0, -1.45, 1.75, -1.9, -1.5708, 0.0)


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated controller and its arm.

    Attributes:
        robot: `ur3e`, `ur5e` or `ur10e`.
        errors: Errors of the true arm relative to its controller's model.
        q: Joint angles at the start [rad].
        tcp: Tool offset that is set: x, y, z [m] and a rotation vector [rad].
        payload_kg: Payload that is set [kg].
        payload_m: Its centre of mass in the flange frame [m].
        repeatability_rad: Sigma of a joint's error relative to its encoder, drawn anew for each
            motion [rad].
        polyscope: The dashboard's version string.
        safety: `normal`, `protective-stop` or `emergency-stop`, at the start.
        mode: The robot's mode at the start, as on the dashboard: `RUNNING`, `POWER_OFF`.
        rate_hz: States per second.
    """

    robot: str = "ur10e"
    seed: int = 0
    errors: ArmErrors = field(
        default_factory=lambda: ArmErrors(dh_sigma_m=3e-4, dh_sigma_rad=3e-4, offset_sigma_rad=5e-4)
    )
    q: tuple[float, ...] = _HOME
    tcp: tuple[float, ...] = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    payload_kg: float = 0.6
    payload_m: tuple[float, ...] = (0.0, 0.0, 0.04)
    repeatability_rad: float = 1e-5
    polyscope: str = "URSoftware 5.11.6.1010000 (Aug 01 2024)"
    remote: bool = True
    safety: str = "normal"
    mode: str = "RUNNING"
    rate_hz: float = 125.0


def believed_arm(options: ControllerOptions) -> DhArm:
    """Controller's model of the arm: its data sheet."""
    return ur_arm(options.robot)


def true_arm(options: ControllerOptions) -> DhArm:
    """True arm, with errors."""
    return disturb(believed_arm(options), options.errors, np.random.default_rng([options.seed, 2]))


@dataclass(frozen=True, eq=False)
class _TimedMotion:
    """A motion with its start time.

    Attributes:
        start_s: Start on the monotonic clock [s].
        motion: Motion by the encoders.
        error_before: (n,) errors of the joints relative to their encoders at its start [rad].
        error_after: (n,) the same at its end.
    """

    start_s: float
    motion: Motion
    error_before: FloatArray
    error_after: FloatArray

    def encoder_error(self, at_s: float) -> FloatArray:
        """Errors (n,) of the joints relative to their encoders [rad]."""
        duration_s = self.motion.duration_s
        share = min(max((at_s - self.start_s) / duration_s, 0.0), 1.0) if duration_s else 1.0
        return self.error_before + share * (self.error_after - self.error_before)


class Machine:
    """The arm. Times are of the host's monotonic clock [s].

    Attributes:
        tcp: (6,) tool offset: x, y, z [m] and a rotation vector [rad].
        payload_kg: Payload [kg].
        payload_m: (3,) its centre of mass [m].
        safety: `normal`, `protective-stop` or `emergency-stop`.
        mode: The robot's mode, as on the dashboard.
        program: State of the control script.
        polyscope: The dashboard's version string.
    """

    def __init__(self, options: ControllerOptions, now_s: float) -> None:
        self.believed, self.true = believed_arm(options), true_arm(options)
        self.tcp = np.array(options.tcp)
        self.payload_kg = options.payload_kg
        self.payload_m = np.array(options.payload_m)
        self.safety = options.safety
        self.mode = options.mode
        self.remote = options.remote
        self.program: Program = "stopped"
        self.polyscope = options.polyscope
        self._rng = np.random.default_rng([options.seed, 3])
        self._repeatability_rad = options.repeatability_rad
        encoder_error = self._draw_encoder_error()
        self._history = deque(
            [_TimedMotion(now_s, Rest(np.array(options.q)), encoder_error, encoder_error)]
        )

    @property
    def may_move(self) -> bool:
        """Whether the brakes are off and no stop is active."""
        return self.safety == "normal" and self.mode == "RUNNING"

    def joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """Joint angles (n,) [rad] and speeds (n,) [rad/s] by the encoders."""
        timed = self._motion_at(at_s)
        return timed.motion.at(max(0.0, at_s - timed.start_s))

    def true_joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """True joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        q, dq = self.joints(at_s)
        return q + self._motion_at(at_s).encoder_error(at_s), dq

    def true_flange(self, at_s: float) -> FloatArray:
        """True `base_from_flange` (4, 4) [m]."""
        q, _ = self.true_joints(at_s)
        return np.asarray(forward(self.true, q[None])[0])

    @property
    def ends_s(self) -> float:
        """End of the last motion [s]."""
        return self._history[-1].start_s + self._history[-1].motion.duration_s

    def moving(self, at_s: float) -> bool:
        """Whether a motion is in progress."""
        return at_s < self.ends_s

    def start(self, motion: Motion, now_s: float) -> None:
        """Starts a motion, replacing one in progress."""
        before = self._history[-1]
        encoder_error = self._draw_encoder_error()
        self._history.append(
            _TimedMotion(now_s, motion, before.encoder_error(now_s), encoder_error)
        )
        while len(self._history) > 2 and self._history[1].start_s < now_s - _MEMORY_S:
            self._history.popleft()

    def brake(self, now_s: float, deceleration: float = _STOP_DECELERATION) -> None:
        """Brakes a motion in progress, with a deceleration in [rad/s^2]."""
        if self.moving(now_s):
            self.start(Brake(*self.joints(now_s), deceleration), now_s)

    def stop_program(self, now_s: float) -> None:
        """Ends the control script, and any motion with it."""
        self.program = "stopped"
        self.brake(now_s)

    def trip(self, safety: str, now_s: float) -> None:
        """Stops by the safety system: `protective-stop` or `emergency-stop`."""
        self.safety = safety
        self.program = "paused" if safety == "protective-stop" else "stopped"
        self.brake(now_s)
        if safety == "emergency-stop":
            self.mode = "POWER_OFF"

    def release(self) -> None:
        """Clears any stop; the control script has to be sent again."""
        self.safety, self.mode, self.program = "normal", "RUNNING", "stopped"

    def _motion_at(self, at_s: float) -> _TimedMotion:
        for timed in reversed(self._history):
            if timed.start_s <= at_s:
                return timed
        return self._history[0]

    def _draw_encoder_error(self) -> FloatArray:
        return self._repeatability_rad * self._rng.standard_normal(self.believed.a.size)


def matrix_of(pose: FloatArray | Sequence[float]) -> FloatArray:
    """Matrix (4, 4) of a pose of six numbers."""
    numbers = np.asarray(pose, dtype=float)
    rotation = Rotation.from_rotvec(numbers[3:])
    return np.asarray(RigidTransform.from_components(numbers[:3], rotation).as_matrix())


def pose_of(matrix: FloatArray) -> FloatArray:
    """Pose (6,) of a matrix (4, 4)."""
    rotation = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([matrix[:3, 3], rotation])


def tool_pose(machine: Machine, q: FloatArray) -> FloatArray:
    """Pose (6,) of the tool in a posture [rad], with the offset that is set."""
    return flange_pose(machine, q, machine.tcp)


def flange_pose(machine: Machine, q: FloatArray, tcp: FloatArray | Sequence[float]) -> FloatArray:
    """Pose (6,) of a tool with the offset `tcp`."""
    return pose_of(forward(machine.believed, q[None])[0] @ matrix_of(tcp))


def posture(machine: Machine, pose: FloatArray, near: FloatArray) -> FloatArray | None:
    """Joint angles (n,) for a pose of the tool, near others [rad]; None out of reach."""
    base_from_flange = matrix_of(pose) @ np.linalg.inv(matrix_of(machine.tcp))
    solution = inverse(machine.believed, base_from_flange[None], near[None])
    return solution.joints[0] if solution.solved[0] else None


def postures_to(
    machine: Machine, pose: FloatArray, start: FloatArray
) -> tuple[list[FloatArray], float]:
    """Postures along a straight line of the tool from a posture (n,) [rad] to a pose (6,).

    Returns:
        The postures, none where the line leaves the reach, and the length [m]; of a pure rotation
        its angle [rad].
    """
    begin = tool_pose(machine, start)
    rotations = Rotation.from_rotvec([begin[3:], pose[3:]])
    distance = float(np.linalg.norm(pose[:3] - begin[:3])) or float(
        (rotations[0].inv() * rotations[1]).magnitude()
    )
    knots = [start]
    interpolated = Slerp([0.0, 1.0], rotations)
    for share in np.linspace(0.0, 1.0, _KNOTS)[1:]:
        position = begin[:3] + share * (pose[:3] - begin[:3])
        next_knot = posture(
            machine, np.concatenate([position, interpolated(share).as_rotvec()]), knots[-1]
        )
        if next_knot is None:
            return [], distance
        knots.append(next_knot)
    return knots, distance

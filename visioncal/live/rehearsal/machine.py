"""The simulated arm and what its controller knows of it: motion, safety, tool and load.

The controller reckons with poses as x, y, z [m] and a rotation vector [rad], by the simulation's
arm that it believes in.
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

# How long the arm's past is kept [s]: a picture is asked for within this time.
_MEMORY_S = 60.0
# How hard a stop of the safety system brakes [rad/s^2].
_HARD = 20.0
Program: TypeAlias = Literal["stopped", "playing", "paused"]
# Postures under a straight line of the tool.
_KNOTS = 64
# Elbow up, the tool looking down: clear of every singularity.
_HOME = (0.0, -1.45, 1.75, -1.9, -1.5708, 0.0)


@dataclass(frozen=True)
class ControllerOptions:
    """A simulated controller and its arm.

    Attributes:
        robot: `ur3e`, `ur5e` or `ur10e`.
        seed: Of everything random.
        errors: How the real arm departs from what its controller believes.
        q: Joint angles at the start [rad].
        tcp: The tool offset that is set: x, y, z [m] and a rotation vector [rad].
        payload_kg: The load that is set [kg].
        payload_m: Its centre in the flange frame [m].
        repeatability_rad: How far a joint stands beside what its encoder says, drawn anew at each
            arrival [rad].
        polyscope: What the dashboard answers when asked for its version.
        remote: Whether remote control is on.
        safety: `normal`, `protective-stop` or `emergency-stop`, at the start.
        mode: The robot's mode at the start, in the dashboard's words: `RUNNING`, `POWER_OFF`.
        rate_hz: States a second.
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
    """The arm by which the controller reckons: its data sheet."""
    return ur_arm(options.robot)


def true_arm(options: ControllerOptions) -> DhArm:
    """The arm that really stands there."""
    return disturb(believed_arm(options), options.errors, np.random.default_rng([options.seed, 2]))


@dataclass(frozen=True, eq=False)
class _Stretch:
    """One motion and its time.

    Attributes:
        start_s: When it began, on the monotonic clock [s].
        motion: What the encoders say.
        slack_before: (n,) how far the joints stood beside their encoders at its start [rad].
        slack_after: (n,) and at its end.
    """

    start_s: float
    motion: Motion
    slack_before: FloatArray
    slack_after: FloatArray

    def slack(self, at_s: float) -> FloatArray:
        """(n,) how far the joints stand beside their encoders [rad]."""
        whole = self.motion.duration_s
        share = min(max((at_s - self.start_s) / whole, 0.0), 1.0) if whole else 1.0
        return self.slack_before + share * (self.slack_after - self.slack_before)


class Machine:
    """The arm. Times are of the host's monotonic clock [s].

    Attributes:
        believed: The arm by which the controller reckons.
        true: The arm that really stands there.
        tcp: (6,) the tool offset: x, y, z [m] and a rotation vector [rad].
        payload_kg: The load [kg].
        payload_m: (3,) its centre [m].
        safety: `normal`, `protective-stop` or `emergency-stop`.
        mode: The robot's mode in the dashboard's words.
        remote: Whether remote control is on.
        program: What the control script does.
        polyscope: What the dashboard says of its version.
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
        slack = self._draw_slack()
        self._past = deque([_Stretch(now_s, Rest(np.array(options.q)), slack, slack)])

    @property
    def may_move(self) -> bool:
        """Whether the brakes are off and nothing has stopped it."""
        return self.safety == "normal" and self.mode == "RUNNING"

    def joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) joint angles [rad] and (n,) speeds [rad/s] that the encoders report."""
        stretch = self._stretch(at_s)
        return stretch.motion.at(max(0.0, at_s - stretch.start_s))

    def true_joints(self, at_s: float) -> tuple[FloatArray, FloatArray]:
        """(n,) angles [rad] and (n,) speeds [rad/s] in which the arm really is."""
        q, dq = self.joints(at_s)
        return q + self._stretch(at_s).slack(at_s), dq

    def true_flange(self, at_s: float) -> FloatArray:
        """(4, 4) `base_from_flange` of the arm that really stands there [m]."""
        q, _ = self.true_joints(at_s)
        return np.asarray(forward(self.true, q[None])[0])

    @property
    def ends_s(self) -> float:
        """When the last motion ends, or ended [s]."""
        return self._past[-1].start_s + self._past[-1].motion.duration_s

    def moving(self, at_s: float) -> bool:
        """Whether a motion goes on."""
        return at_s < self.ends_s

    def start(self, motion: Motion, now_s: float) -> None:
        """Begins a motion, in the place of one that goes on."""
        before = self._past[-1]
        slack = self._draw_slack()
        self._past.append(_Stretch(now_s, motion, before.slack(now_s), slack))
        while len(self._past) > 2 and self._past[1].start_s < now_s - _MEMORY_S:
            self._past.popleft()

    def brake(self, now_s: float, deceleration: float = _HARD) -> None:
        """Stops a motion that goes on [rad/s^2]."""
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
        """Takes back whatever stopped it; the control script has to be sent again."""
        self.safety, self.mode, self.program = "normal", "RUNNING", "stopped"

    def _stretch(self, at_s: float) -> _Stretch:
        for stretch in reversed(self._past):
            if stretch.start_s <= at_s:
                return stretch
        return self._past[0]

    def _draw_slack(self) -> FloatArray:
        return self._repeatability_rad * self._rng.standard_normal(self.believed.a.size)


def matrix_of(pose: FloatArray | Sequence[float]) -> FloatArray:
    """(4, 4) of six numbers."""
    numbers = np.asarray(pose, dtype=float)
    turn = Rotation.from_rotvec(numbers[3:])
    return np.asarray(RigidTransform.from_components(numbers[:3], turn).as_matrix())


def pose_of(matrix: FloatArray) -> FloatArray:
    """(6,) of a matrix."""
    turn = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([matrix[:3, 3], turn])


def tool_pose(machine: Machine, q: FloatArray) -> FloatArray:
    """(6,) the tool's pose in a posture [rad], with the offset that is set."""
    return flange_pose(machine, q, machine.tcp)


def flange_pose(machine: Machine, q: FloatArray, tcp: FloatArray | Sequence[float]) -> FloatArray:
    """(6,) the pose of a tool that sits on the flange at `tcp`."""
    return pose_of(forward(machine.believed, q[None])[0] @ matrix_of(tcp))


def posture(machine: Machine, pose: FloatArray, near: FloatArray) -> FloatArray | None:
    """(n,) joint angles for a pose of the tool, near others [rad]; None out of reach."""
    base_from_flange = matrix_of(pose) @ np.linalg.inv(matrix_of(machine.tcp))
    reach = inverse(machine.believed, base_from_flange[None], near[None])
    return reach.joints[0] if reach.solved[0] else None


def postures_to(
    machine: Machine, pose: FloatArray, start: FloatArray
) -> tuple[list[FloatArray], float]:
    """The postures under a straight line of the tool, and its length.

    Args:
        machine: The arm.
        pose: (6,) the line's end.
        start: (n,) the posture at its start [rad].

    Returns:
        The postures, none where the line leaves the reach, and the length [m]; of a turn on the
        spot, its angle [rad].
    """
    begin = tool_pose(machine, start)
    turns = Rotation.from_rotvec([begin[3:], pose[3:]])
    distance = float(np.linalg.norm(pose[:3] - begin[:3])) or float(
        (turns[0].inv() * turns[1]).magnitude()
    )
    knots = [start]
    between = Slerp([0.0, 1.0], turns)
    for share in np.linspace(0.0, 1.0, _KNOTS)[1:]:
        place = begin[:3] + share * (pose[:3] - begin[:3])
        next_knot = posture(machine, np.concatenate([place, between(share).as_rotvec()]), knots[-1])
        if next_knot is None:
            return [], distance
        knots.append(next_knot)
    return knots, distance

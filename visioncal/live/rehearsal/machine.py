"""The simulated arm and what its controller knows of it: motion, safety, tool and load."""

from collections import deque
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.live.rehearsal.motion import Brake, Motion, Rest
from visioncal.live.rehearsal.options import ControllerOptions, believed_arm, true_arm
from visioncal.simulation.arms import forward

# How long the arm's past is kept [s]: a picture is asked for within this time.
_MEMORY_S = 60.0
# How hard a stop of the safety system brakes [rad/s^2].
_HARD = 20.0

Program: TypeAlias = Literal["stopped", "playing", "paused"]


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

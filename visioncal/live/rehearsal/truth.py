"""A channel beside the controller's own: the arm's true state, and faults to suffer.

One JSON object a line asks, one answers. A simulated camera asks for the truth; a rehearsal injects
faults. No real controller has such a thing.
"""

import json
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.rehearsal.machine import Machine
from visioncal.live.rehearsal.motion import joint_way

TRUTH_PORT = 30900

# Stops by the safety system; a hand on the pendant; the controller's own end, or its silence.
Fault: TypeAlias = Literal[
    "protective-stop",
    "emergency-stop",
    "local-control",
    "remote-control",
    "power-off",
    "release",
    "die",
    "freeze",
    "thaw",
]


@dataclass(frozen=True, eq=False)
class TrueState:
    """Where the arm really was.

    Attributes:
        q: (m, n) its joints' angles [rad].
        dq: (m, n) their speeds [rad/s].
        base_from_flange: (m, 4, 4) by the arm's true geometry [m].
    """

    q: FloatArray
    dq: FloatArray
    base_from_flange: FloatArray


class TruthChannel:
    """The channel's end at the controller."""

    def __init__(self, machine: Machine, set_frozen: Callable[[bool], None]) -> None:
        self._machine = machine
        self._set_frozen = set_frozen

    def answer(self, line: bytes, now_s: float) -> bytes:
        """Answers one line."""
        try:
            reply = self._reply(json.loads(line), now_s)
        except (KeyError, TypeError, ValueError) as error:
            reply = {"error": f"{type(error).__name__}: {error}"}
        return json.dumps(reply).encode() + b"\n"

    def _reply(self, asked: Mapping[str, Any], now_s: float) -> dict[str, Any]:
        machine = self._machine
        if "at" in asked:
            states = [machine.true_joints(at) for at in asked["at"]]
            return {
                "q": [q.tolist() for q, _ in states],
                "dq": [dq.tolist() for _, dq in states],
                "base_from_flange": [machine.true_flange(at).tolist() for at in asked["at"]],
            }
        if "guide" in asked:
            q, _ = machine.joints(now_s)
            goal = np.array(asked["guide"], dtype=float)
            speed, acceleration = float(asked["speed"]), float(asked["acceleration"])
            machine.start(joint_way(q, goal, speed=speed, acceleration=acceleration), now_s)
            return {"ends": machine.ends_s}
        self._suffer(asked["fault"], now_s)
        return {}

    def _suffer(self, fault: str, now_s: float) -> None:
        machine = self._machine
        if fault in ("protective-stop", "emergency-stop"):
            machine.trip(fault, now_s)
        elif fault in ("local-control", "remote-control"):
            machine.remote = fault == "remote-control"
            if not machine.remote:
                machine.stop_program(now_s)
        elif fault == "power-off":
            machine.stop_program(now_s)
            machine.mode = "POWER_OFF"
        elif fault == "release":
            machine.release()
        elif fault in ("freeze", "thaw"):
            self._set_frozen(fault == "freeze")
        elif fault == "die":
            # As a process that is killed: no farewell to anyone.
            os._exit(1)
        else:
            raise ValueError(f"there is no fault {fault!r}")


class TruthClient:
    """The channel's end at those who may know the truth.

    Raises:
        DriverError: No simulated controller listens at the host.
    """

    def __init__(self, host: str, *, timeout_s: float = 5.0) -> None:
        self._label = f"{host}:{TRUTH_PORT}"
        try:
            self._socket = socket.create_connection((host, TRUTH_PORT), timeout_s)
        except OSError as error:
            raise self._lost(error) from error
        self._file = self._socket.makefile("rb")

    def state(self, at_s: Sequence[float]) -> TrueState:
        """Where the arm was at some moments of the monotonic clock [s] within its memory.

        Raises:
            DriverError: The controller is gone.
        """
        reply = self._ask({"at": list(at_s)})
        return TrueState(*(np.array(reply[name]) for name in ("q", "dq", "base_from_flange")))

    def inject(self, fault: Fault) -> None:
        """Lets the controller suffer a fault; returns as it has happened.

        Raises:
            DriverError: The controller is gone, other than by this.
        """
        if fault == "die":
            # No answer comes; the end of the stream shows that it happened.
            self._send({"fault": fault})
            self._file.read()
        else:
            self._ask({"fault": fault})

    def guide(self, q: FloatArray, *, speed: float, acceleration: float) -> float:
        """Leads the arm by hand towards a posture.

        Args:
            q: (n,) the posture [rad].
            speed: Of the joint that turns farthest [rad/s].
            acceleration: Likewise [rad/s^2].

        Returns:
            When it will be there, on the monotonic clock [s].
        """
        asked = {"guide": q.tolist(), "speed": speed, "acceleration": acceleration}
        return float(self._ask(asked)["ends"])

    def close(self) -> None:
        """Lets go of it."""
        self._file.close()
        self._socket.close()

    def _send(self, asked: Mapping[str, Any]) -> None:
        try:
            self._socket.sendall(json.dumps(asked).encode() + b"\n")
        except OSError as error:
            raise self._lost(error) from error

    def _ask(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        self._send(asked)
        try:
            line = self._file.readline()
        except OSError as error:
            raise self._lost(error) from error
        if not line:
            raise self._lost("it closed the connection")
        reply: dict[str, Any] = json.loads(line)
        if "error" in reply:
            raise DriverError(f"The simulated controller refuses {asked}: {reply['error']}.")
        return reply

    def _lost(self, why: object) -> DriverError:
        return DriverError(
            f"The simulated controller at {self._label} cannot be asked: {why}.",
            culprits=[self._label],
            next_step="Start one: python -m visioncal.live.rehearsal.controller --host HOST",
        )

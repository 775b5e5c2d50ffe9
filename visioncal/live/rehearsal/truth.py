"""Truth channel of a simulated controller: the arm's true state, and fault injection.

Requests and answers are JSON objects, one a line. A simulated camera reads the truth; a rehearsal
injects faults. No real controller has such a channel.
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
from visioncal.live.rehearsal.motion import joint_path

TRUTH_PORT = 30900

# Safety stops, changes at the pendant, and the controller's end or silence.
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
    """True states of the arm at m moments.

    Attributes:
        q: (m, n) joint angles [rad].
        dq: (m, n) joint speeds [rad/s].
        base_from_flange: (m, 4, 4) by the arm's true geometry [m].
    """

    q: FloatArray
    dq: FloatArray
    base_from_flange: FloatArray


class TruthChannel:
    """Server side of the channel."""

    def __init__(self, machine: Machine, set_frozen: Callable[[bool], None]) -> None:
        self._machine = machine
        self._set_frozen = set_frozen

    def answer(self, line: bytes, now_s: float) -> bytes:
        """Answers a request."""
        try:
            reply = self._reply(json.loads(line), now_s)
        except (KeyError, TypeError, ValueError) as error:
            reply = {"error": f"{type(error).__name__}: {error}"}
        return json.dumps(reply).encode() + b"\n"

    def _reply(self, request: Mapping[str, Any], now_s: float) -> dict[str, Any]:
        machine = self._machine
        if "at" in request:
            states = [machine.true_joints(at) for at in request["at"]]
            return {
                "q": [q.tolist() for q, _ in states],
                "dq": [dq.tolist() for _, dq in states],
                "base_from_flange": [machine.true_flange(at).tolist() for at in request["at"]],
            }
        if "guide" in request:
            q, _ = machine.joints(now_s)
            goal = np.array(request["guide"], dtype=float)
            speed, acceleration = float(request["speed"]), float(request["acceleration"])
            machine.start(joint_path(q, goal, speed=speed, acceleration=acceleration), now_s)
            return {"ends": machine.ends_s}
        self._apply_fault(request["fault"], now_s)
        return {}

    def _apply_fault(self, fault: str, now_s: float) -> None:
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
            # As a killed process: connections are not shut down.
            os._exit(1)
        else:
            raise ValueError(f"there is no fault {fault!r}")


class TruthClient:
    """Client side of the channel.

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
        """Reads true states at moments of the monotonic clock within the arm's memory [s].

        Raises:
            DriverError: The controller is gone.
        """
        reply = self._ask({"at": list(at_s)})
        return TrueState(*(np.array(reply[name]) for name in ("q", "dq", "base_from_flange")))

    def inject(self, fault: Fault) -> None:
        """Injects a fault; returns when it has happened.

        Raises:
            DriverError: The controller is gone for another reason.
        """
        if fault == "die":
            # There is no answer; the end of the stream shows that it happened.
            self._send({"fault": fault})
            self._file.read()
        else:
            self._ask({"fault": fault})

    def guide(self, q: FloatArray, *, speed: float, acceleration: float) -> float:
        """Moves the arm to a posture (n,) [rad] as if by hand, and returns the time of arrival [s].

        Speed [rad/s] and acceleration [rad/s^2] are of the joint that travels farthest.
        """
        request = {"guide": q.tolist(), "speed": speed, "acceleration": acceleration}
        return float(self._ask(request)["ends"])

    def close(self) -> None:
        """Disconnects."""
        self._file.close()
        self._socket.close()

    def _send(self, request: Mapping[str, Any]) -> None:
        try:
            self._socket.sendall(json.dumps(request).encode() + b"\n")
        except OSError as error:
            raise self._lost(error) from error

    def _ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self._send(request)
        try:
            line = self._file.readline()
        except OSError as error:
            raise self._lost(error) from error
        if not line:
            raise self._lost("it closed the connection")
        reply: dict[str, Any] = json.loads(line)
        if "error" in reply:
            raise DriverError(f"The simulated controller refuses {request}: {reply['error']}.")
        return reply

    def _lost(self, why: object) -> DriverError:
        return DriverError(
            f"The simulated controller at {self._label} cannot be asked: {why}.",
            culprits=[self._label],
            next_step="Start one: python -m visioncal.live.rehearsal.controller --host HOST",
        )

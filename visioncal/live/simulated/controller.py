"""Simulated UR controller as a process of its own, for the real client library to talk to.

It must be another process: the client's constructors hold the interpreter lock while they wait for
the controller. A pipe to it, which no real controller has, tells the arm's true state and injects
faults; the process ends with it.
"""

import asyncio
import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import FloatArray
from visioncal.live.simulated.arm import ControllerOptions, Motion
from visioncal.live.simulated.server import PORTS, ControllerServer
from visioncal.simulation.arms import forward

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
# Starting takes a second, but much longer on a busy computer.
_START_S, _END_S = 60.0, 5.0


@dataclass(frozen=True, eq=False)
class TrueState:
    """True states of the arm at m moments."""

    q: FloatArray  # (m, n) joint angles [rad].
    dq: FloatArray  # (m, n) joint speeds [rad/s].
    base_from_flange: FloatArray  # (m, 4, 4) by the arm's true geometry [m].


@dataclass(frozen=True, eq=False)
class SimulatedController:
    """A running controller; it ends with the context."""

    host: str  # The loopback address that it listens on.
    _process: BaseProcess
    _pipe: "Connection[Any, Any]"
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self, at_s: Sequence[float]) -> TrueState:
        """Reads true states at moments of the monotonic clock within the arm's memory [s].

        Raises:
            DriverError: The controller is gone.
        """
        return TrueState(*self._ask("state", list(at_s)))

    def inject(self, fault: Fault) -> None:
        """Injects a fault; returns when it has happened.

        Raises:
            DriverError: The controller is gone, or there is no such fault.
        """
        self._ask("fault", fault)

    def guide(self, q: FloatArray, *, speed: float, acceleration: float) -> float:
        """Moves the arm to a posture (n,) [rad] as if by hand, and returns the time of arrival [s].

        Speed [rad/s] and acceleration [rad/s^2] are of the joint that travels farthest.
        """
        return float(self._ask("guide", (q, speed, acceleration)))

    def close(self) -> None:
        """Ends it; may be called twice."""
        self._process.terminate()
        self._process.join(_END_S)
        self._process.kill()
        self._pipe.close()

    def _ask(self, what: str, of: object) -> Any:  # noqa: ANN401
        """Asks through the pipe, from any thread."""
        with self._lock:
            try:
                self._pipe.send((what, of))
                answer = self._pipe.recv()
            except (OSError, EOFError) as error:
                if of == "die":
                    return None
                raise DriverError(
                    f"The simulated controller at {self.host} is gone.", culprits=[self.host]
                ) from error
        if isinstance(answer, Exception):
            raise DriverError(f"The simulated controller refuses {of!r}: {answer}.") from answer
        return answer


def spawn(options: ControllerOptions | None = None, host: str | None = None) -> SimulatedController:
    """Starts a simulated controller at a loopback address such as `127.0.0.2`; None for any free.

    Raises:
        DriverError: It does not start, for example because a port is taken.
    """
    host = free_host() if host is None else host
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    arguments = (options or ControllerOptions(), host, there)
    process = context.Process(target=_serve, args=arguments, daemon=True)
    process.start()
    # This end alone must hold the pipe open, so that the end of either process is noticed.
    there.close()
    controller = SimulatedController(host, process, here)
    reason: object = f"it did not start within {_START_S:.0f} s"
    if here.poll(_START_S):
        try:
            reason = here.recv()
        except EOFError:
            reason = "it ended"
        if reason is None:
            return controller
    controller.close()
    raise DriverError(f"No simulated controller at {host}: {reason}.", culprits=[host])


def free_host() -> str:
    """Finds a loopback address on which no port of a controller is taken.

    Raises:
        DriverError: There is none, as on systems whose loopback is one address only.
    """
    for host in _hosts():
        if all(_is_free(host, port) for port in PORTS):
            return host
    raise DriverError(
        "No loopback address with free ports was found for a simulated controller.",
        culprits=["127.0.0.0/8"],
        next_step="End other simulated controllers.",
    )


def _hosts() -> Iterator[str]:
    """Addresses to try; processes start at different ones."""
    first = os.getpid()
    for step in range(200):
        number = first + 251 * step
        yield f"127.{number // 62500 % 250 + 2}.{number // 250 % 250 + 2}.{number % 250 + 2}"


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def _serve(options: ControllerOptions, host: str, pipe: "Connection[Any, Any]") -> None:
    """Runs a controller in its process, until the pipe's other end is closed."""
    # Ctrl-C reaches all processes of a terminal; a controller must not end before its client.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server = ControllerServer(options, host)

    def ready() -> None:
        pipe.send(None)
        threading.Thread(target=_answer_all, args=(server, pipe), daemon=True).start()

    try:
        asyncio.run(server.run(ready))
    except OSError as error:
        pipe.send(str(error))


def _answer_all(server: ControllerServer, pipe: "Connection[Any, Any]") -> None:
    while True:
        try:
            what, of = pipe.recv()
        except (OSError, EOFError):
            os._exit(0)
        try:
            pipe.send(_answer(server, what, of))
        except ValueError as error:
            pipe.send(error)


def _answer(server: ControllerServer, what: str, of: Any) -> object:  # noqa: ANN401
    machine, now_s = server.machine, time.monotonic()
    if what == "state":
        q, dq = (np.array(rows) for rows in zip(*map(machine.true_joints, of), strict=True))
        return q, dq, forward(machine.true, q)
    if what == "guide":
        goal, speed, acceleration = of
        machine.start(Motion(machine.joints(now_s)[0], goal, speed, acceleration), now_s)
        return machine.ends_s()
    if of == "die":
        # As a killed process: connections are not shut down.
        os._exit(1)
    if of in ("freeze", "thaw"):
        server.frozen = of == "freeze"
    else:
        machine.apply_fault(of, now_s)
    return None

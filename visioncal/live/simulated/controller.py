"""Simulated UR controller as a process of its own, for the real client library to talk to.

It must be another process: the client's constructors hold the interpreter lock while they wait for
the controller. A pipe to it, which no real controller has, tells the arm's true state and injects
faults; the process ends with it.

Its poses are x, y, z [m] and a rotation vector [rad], by its nominal model of the arm. Its ports
are served in one event loop. Sources: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": a
frame is its whole size (uint16), its type (one byte) and its payload. "Dashboard Server e-Series".
"Remote Control Via TCP/IP": a robot state message of the primary interface is its size (int32), 16,
and packages of size, type and content. Numbers are big-endian.
"""

import asyncio
import itertools
import multiprocessing
import os
import re
import signal
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Self, TypeAlias

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.threads import safe_path
from visioncal.core.types import FloatArray
from visioncal.live.drivers import ur_net
from visioncal.live.simulated.machine import (
    COMMAND,
    SAFETY,
    ControllerOptions,
    Fault,
    Machine,
    TrueState,
)

# Starting takes a second, but much longer on a busy computer [s].
_START_S = 60.0
_YES = b"\x01"
# States are dropped for a client with this many unread bytes; period of primary messages [s].
_BUFFER_BYTES, _PRIMARY_EVERY_S = 1 << 20, 0.1
# Numbers of the controllers that this process has started.
_STARTED = itertools.count()
# The last line of the client's program.
_END = re.compile(rb"^end\s*$", re.MULTILINE)
_Handler: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@dataclass
class _Client:
    """State of an RTDE client."""

    writer: asyncio.StreamWriter
    outputs: tuple[str, ...] = ()  # Names of the variables that it is sent.
    # Names of the variables that it sends, by recipe; it counts these from 1.
    inputs: list[tuple[str, ...]] = field(default_factory=list)
    every_s: float = 0.0  # Period of its states [s].
    due_s: float = np.inf  # When the next one is due [s]; infinity while none are wanted.


class _Server:
    """Servers of a controller's ports."""

    def __init__(self, options: ControllerOptions, host: str) -> None:
        self.machine = Machine(options)
        self._host, self._rate_hz, self._polyscope = host, options.rate_hz, options.polyscope
        self._clients: list[_Client] = []
        # While it is clear, the controller keeps its connections open but stays silent.
        self._awake = threading.Event()
        self._awake.set()

    async def run(self, ready: Callable[[], None]) -> None:
        """Serves until the process ends; calls `ready` once all ports listen.

        Raises:
            OSError: A port is taken.
        """
        self._loop = asyncio.get_running_loop()
        handlers = (self._serve_rtde, self._serve_dashboard, self._take_script, self._send_primary)
        with ExitStack() as servers:
            ports = ur_net.RTDE_PORT, ur_net.DASHBOARD_PORT, ur_net.SCRIPT_PORT
            for port, handler in zip((*ports, ur_net.PRIMARY_PORTS[0]), handlers, strict=True):
                if port == ur_net.DASHBOARD_PORT and self._polyscope[0] >= 10:
                    continue
                server = await asyncio.start_server(_tolerant(handler), self._host, port)
                servers.callback(server.close)
            ready()
            cycle, began_s = 0, self.machine.began_s
            while True:
                # Cycles that a busy computer missed are skipped.
                cycle = max(cycle + 1, int((time.monotonic() - began_s) * self._rate_hz))
                due_s = began_s + cycle / self._rate_hz
                await asyncio.sleep(due_s - time.monotonic())
                self.machine.tick(time.monotonic())
                self._send_states(due_s)

    def inject(self, fault: Fault) -> None:
        """Lets a fault happen, or mends all; called by another thread."""
        if fault == "link-lost":
            # As a killed process: connections are not shut down.
            os._exit(1)
        self.machine.inject(fault)
        if fault == "silent":
            self._awake.clear()
            self._loop.call_soon_threadsafe(self._awake.wait)
        else:
            self._awake.set()

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = _Client(writer)
        self._clients.append(client)
        try:
            while True:
                size, kind = ur_net.HEADER.unpack(await reader.readexactly(ur_net.HEADER.size))
                payload = await reader.readexactly(size - ur_net.HEADER.size)
                if kind == ur_net.DATA:
                    self._receive(client, payload)
                else:
                    writer.write(ur_net.frame(kind, self._answer_rtde(client, kind, payload)))
        finally:
            self._clients.remove(client)

    def _answer_rtde(self, client: _Client, kind: int, payload: bytes) -> bytes:
        """Content of the answer to a frame."""
        if kind == ur_net.VERSION_OF:
            return struct.pack(">4I", *self._polyscope)
        if kind in (ur_net.START, ur_net.PAUSE):
            client.due_s = 0.0 if kind == ur_net.START else np.inf
        if kind not in (ur_net.OUTPUTS, ur_net.INPUTS):
            return _YES
        text = payload[8:] if kind == ur_net.OUTPUTS else payload
        # The last may be followed by a comma.
        names = tuple(part for part in text.decode("ascii").split(",") if part)
        values = self.machine.reported(time.monotonic())
        types = ",".join(_type(values[name]) if name in values else "NOT_FOUND" for name in names)
        if kind == ur_net.OUTPUTS:
            client.every_s = 1.0 / struct.unpack_from(">d", payload)[0]
            client.outputs = tuple(name for name in names if name in values)
            return _YES + types.encode()
        client.inputs.append(names)
        return bytes([len(client.inputs)]) + types.encode()

    def _receive(self, client: _Client, payload: bytes) -> None:
        """Writes a client's values to the registers."""
        names = client.inputs[payload[0] - 1]
        if all("_register_" in name for name in names):
            form = ">" + "".join("i" if "_int_" in name else "d" for name in names)
            self.machine.registers |= zip(names, struct.unpack_from(form, payload, 1), strict=True)
        if COMMAND in names:
            self.machine.heard_s = time.monotonic()

    def _send_states(self, now_s: float) -> None:
        """Sends the state to every client that is due."""
        # Cycles are no finer than this tolerance.
        due = [client for client in self._clients if now_s >= client.due_s - 1e-3]
        if not due:
            return
        values = self.machine.reported(now_s)
        for client in due:
            if client.writer.transport.get_write_buffer_size() < _BUFFER_BYTES:
                client.due_s = max(client.due_s + client.every_s, now_s)
                numbers = [number for name in client.outputs for number in values[name]]
                form = "".join("i" if isinstance(number, int) else "d" for number in numbers)
                packed = struct.pack(f">{form}", *numbers)
                client.writer.write(ur_net.frame(ur_net.DATA, _YES + packed))

    async def _serve_dashboard(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            machine, question = self.machine, line.decode("utf-8", "replace").strip().lower()
            answers = {
                "polyscopeversion": "URSoftware " + ".".join(map(str, self._polyscope)),
                "get serial number": "20235500001",
                # The model's name without its series, as from a real controller.
                "get robot model": machine.options.robot.removesuffix("e").upper(),
                "is in remote control": str(machine.remote).lower(),
                "robotmode": f"Robotmode: {machine.mode}",
                "safetystatus": f"Safetystatus: {SAFETY[machine.safety][0]}",
                "running": f"Program running: {str(machine.playing).lower()}",
                "stop": "Stopped",
            }
            if question == "stop":
                machine.stop_program(time.monotonic())
            writer.write(answers.get(question, "could not understand").encode() + b"\n")

    async def _take_script(self, reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        text = b""
        while part := await reader.read(65536):
            text += part
            if _END.search(text):
                self.machine.begin_script(time.monotonic())
                text = b""

    async def _send_primary(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Sends robot states (16) of one package: the tool's pose and offset (4)."""
        while not writer.is_closing():
            pose = self.machine.tool_pose(time.monotonic())
            content = struct.pack(">12d", *pose, *self.machine.options.tcp)
            size = 5 + len(content)
            writer.write(struct.pack(">IBIB", 5 + size, 16, size, 4) + content)
            await writer.drain()
            await asyncio.sleep(_PRIMARY_EVERY_S)


def _tolerant(handler: _Handler) -> _Handler:
    """Wraps a handler so that a client may disconnect at any time."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            await handler(reader, writer)
        writer.close()

    return serve


def _type(values: Sequence[float]) -> str:
    """The protocol's name of the type of a variable."""
    return (
        f"VECTOR{len(values)}D" if values[1:] else "INT32" if type(values[0]) is int else "DOUBLE"
    )


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
        state: TrueState = self._ask("state", list(at_s))
        return state

    def inject(self, fault: Fault) -> None:
        """Injects a fault; returns when it has happened; raises DriverError."""
        try:
            self._ask("inject", fault)
        except DriverError:
            if fault != "link-lost":
                raise

    def guide(self, q: FloatArray, *, speed: float, acceleration: float) -> float:
        """Moves the arm to a posture (n,) [rad] as if by hand, and returns the time of arrival [s].

        Speed [rad/s] and acceleration [rad/s^2] are of the joint that travels farthest.
        """
        return float(self._ask("guide", q, speed, acceleration))

    def close(self) -> None:
        """Ends the controller; may be called twice."""
        self._process.terminate()
        self._process.join(5.0)
        self._process.kill()
        self._pipe.close()

    def _ask(self, *question: object) -> Any:  # noqa: ANN401
        """Asks through the pipe, from any thread."""
        with self._lock:
            try:
                self._pipe.send(question)
                return self._pipe.recv()
            except (OSError, EOFError) as error:
                raise DriverError(
                    f"The simulated controller at {self.host} is gone.", culprits=[self.host]
                ) from error


def spawn(options: ControllerOptions | None = None) -> SimulatedController:
    """Starts a simulated controller at a loopback address of its own.

    Raises:
        DriverError: The controller does not start, for example because a port is taken.
    """
    host = free_host()
    context = multiprocessing.get_context("spawn")
    parent_end, child_end = context.Pipe()
    arguments = (options or ControllerOptions(), host, child_end)
    process = context.Process(target=_serve, args=arguments, daemon=True)
    with safe_path():
        process.start()
    # The parent's end alone must hold the pipe open, so that the end of either process is noticed.
    child_end.close()
    controller = SimulatedController(host, process, parent_end)
    reason: object = f"it did not start within {_START_S:.0f} s"
    if parent_end.poll(_START_S):
        try:
            reason = parent_end.recv()
        except EOFError:
            reason = "it ended"
        if reason is None:
            return controller
    controller.close()
    raise DriverError(f"No simulated controller at {host}: {reason}.", culprits=[host])


def free_host() -> str:
    """A loopback address that no controller of this process has, nor of another one."""
    number = os.getpid() + 251 * next(_STARTED)
    return f"127.{number // 62500 % 250 + 2}.{number // 250 % 250 + 2}.{number % 250 + 2}"


def _serve(options: ControllerOptions, host: str, pipe: "Connection[Any, Any]") -> None:
    """Runs a controller in its process, until the pipe's other end is closed."""
    # Ctrl-C reaches all processes of a terminal; a controller must not end before its client.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    server = _Server(options, host)

    def answer_all() -> None:
        while True:
            try:
                what, *arguments = pipe.recv()
            except (OSError, EOFError):
                os._exit(0)
            answering = server if what == "inject" else server.machine
            pipe.send(getattr(answering, what)(*arguments))

    def ready() -> None:
        pipe.send(None)
        threading.Thread(target=answer_all, daemon=True).start()

    try:
        asyncio.run(server.run(ready))
    except OSError as error:
        pipe.send(str(error))

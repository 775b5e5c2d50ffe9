"""Servers of a simulated controller's ports, in one event loop.

Sources: Universal Robots, "Dashboard Server e-Series", and "Remote Control Via TCP/IP": a robot
state message of the primary interface is its size (int32), 16, and packages of size, type and
content; numbers are big-endian.
"""

import asyncio
import re
import struct
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import TypeAlias

from visioncal.live.rehearsal.machine import ControllerOptions, Machine, tool_pose
from visioncal.live.rehearsal.rtde_wire import (
    HEADER_BYTES,
    NOT_FOUND,
    RTDE_PORT,
    Kind,
    Recipe,
    Value,
    frame,
    join_types,
    read_header,
    split_names,
)
from visioncal.live.rehearsal.script import ControlScript, Registers
from visioncal.live.rehearsal.truth import TRUTH_PORT, TruthChannel
from visioncal.live.rehearsal.variables import VARIABLES, Moment, input_type

PRIMARY_PORTS = (30001, 30002, 30011, 30012)
_ROBOT_STATE, _CARTESIAN, _KINEMATICS = 16, 4, 5
_LINEARISED = 1
DASHBOARD_PORT = 29999
BANNER = "Connected: Universal Robots Dashboard Server"
_SAFETY = {
    "normal": "NORMAL",
    "protective-stop": "PROTECTIVE_STOP",
    "emergency-stop": "ROBOT_EMERGENCY_STOP",
}

_YES = b"\x01"
_VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)\.(\d+)")
_COMMON_VERSION = (5, 11, 6, 1010000)
# States are dropped for a client with this many unread bytes.
_BUFFER_BYTES = 1 << 20
_REGISTER = re.compile(r"input_(int|double)_register_(\d+)")


@dataclass
class _Client:
    """State of a client.

    Attributes:
        writer: Stream of its states.
        outputs: Recipe of its states; None before it is requested.
        inputs: Recipes of what it sends, by number.
        started: Whether states are sent.
        every_s: Their period [s].
        due_s: When the next one is due, on the monotonic clock [s].
    """

    writer: asyncio.StreamWriter
    outputs: Recipe | None = None
    inputs: dict[int, Recipe] = field(default_factory=dict)
    started: bool = False
    every_s: float = 0.0
    due_s: float = 0.0


class RtdePort:
    """RTDE server: sends states and receives registers."""

    def __init__(
        self,
        script: ControlScript,
        options: ControllerOptions,
        resumed: Callable[[], Awaitable[None]],
    ) -> None:
        self._script = script
        version = _VERSION.search(options.polyscope)
        self._version = tuple(map(int, version.groups())) if version else _COMMON_VERSION
        self._resumed = resumed
        self._clients: list[_Client] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serves one client until it disconnects."""
        client = _Client(writer)
        self._clients.append(client)
        try:
            while True:
                kind, size = read_header(await reader.readexactly(HEADER_BYTES))
                payload = await reader.readexactly(size)
                await self._resumed()
                reply = self._answer(client, kind, payload)
                if reply:
                    writer.write(reply)
        finally:
            self._clients.remove(client)

    def send(self, moment: Moment) -> None:
        """Sends the state to every client that is due."""
        for client in self._clients:
            # Ticks are no finer than this tolerance.
            if not client.started or client.outputs is None or moment.now_s < client.due_s - 1e-3:
                continue
            if client.writer.transport.get_write_buffer_size() > _BUFFER_BYTES:
                continue
            client.due_s = max(client.due_s + client.every_s, moment.now_s)
            values = [VARIABLES[name][1](moment) for name in client.outputs.names]
            client.writer.write(client.outputs.pack(values))

    def _answer(self, client: _Client, kind: int, payload: bytes) -> bytes:
        if kind == Kind.PROTOCOL:
            return frame(Kind.PROTOCOL, _YES)
        if kind == Kind.VERSION:
            return frame(Kind.VERSION, struct.pack(">4I", *self._version))
        if kind == Kind.OUTPUTS:
            return self._set_outputs(client, payload)
        if kind == Kind.INPUTS:
            return _set_inputs(client, payload)
        if kind in (Kind.START, Kind.PAUSE):
            client.started = kind == Kind.START
            return frame(Kind(kind), _YES)
        if kind == Kind.DATA:
            self._receive(client, payload)
        return b""

    def _receive(self, client: _Client, payload: bytes) -> None:
        """Writes a client's values to the registers; data without a valid recipe are ignored."""
        recipe = client.inputs.get(payload[0]) if payload else None
        if recipe is None or NOT_FOUND in recipe.types:
            return
        for name, value in recipe.unpack(payload).items():
            _write_register(self._script.registers, name, value)
            if name == "input_int_register_0":
                self._script.heard(time.monotonic())

    def _set_outputs(self, client: _Client, payload: bytes) -> bytes:
        (rate,) = struct.unpack_from(">d", payload)
        names = split_names(payload[8:])
        types = tuple(VARIABLES[name][0] if name in VARIABLES else NOT_FOUND for name in names)
        client.every_s = 1.0 / rate if rate > 0.0 else 0.0
        client.outputs = None if NOT_FOUND in types else Recipe(1, names, types)
        return frame(Kind.OUTPUTS, _YES + join_types(types))


def _set_inputs(client: _Client, payload: bytes) -> bytes:
    """Adds a recipe; clients count their recipes from 1."""
    names = split_names(payload)
    types = tuple(input_type(name) or NOT_FOUND for name in names)
    number = len(client.inputs) + 1
    client.inputs[number] = Recipe(number, names, types)
    return frame(Kind.INPUTS, bytes([number]) + join_types(types))


def _write_register(registers: Registers, name: str, value: Value) -> None:
    register = _REGISTER.fullmatch(name)
    if register is None or isinstance(value, Sequence):
        return
    place = int(register[2])
    if register[1] == "int":
        registers.int_in[place] = int(value)
    else:
        registers.double_in[place] = value


def answer(machine: Machine, line: str, now_s: float) -> str:
    """Executes a dashboard command, and returns its answer."""
    command = line.strip().lower()
    state = _state(machine, command)
    if state is not None:
        return state
    if command == "stop":
        machine.stop_program(now_s)
        return "Stopped"
    if command == "unlock protective stop":
        machine.release()
        return "Protective stop releasing"
    if command == "power off":
        machine.stop_program(now_s)
        machine.mode = "POWER_OFF"
        return "Powering off"
    if command in ("power on", "brake release"):
        machine.mode = "RUNNING"
        return "Powering on" if command == "power on" else "Brake releasing"
    if command.startswith(("popup", "close popup", "close safety popup", "addtolog")):
        return "ok"
    return f"could not understand: '{line.strip()}'"


def _state(machine: Machine, question: str) -> str | None:
    """Answers a query; None for any other command."""
    playing = machine.program == "playing"
    answers = {
        "polyscopeversion": machine.polyscope,
        "get serial number": "20235500001",
        # The model's name without its series, as from a real controller.
        "get robot model": machine.believed.name.removesuffix("e").upper(),
        "is in remote control": str(machine.remote).lower(),
        "robotmode": f"Robotmode: {machine.mode}",
        "safetymode": f"Safetymode: {_SAFETY[machine.safety]}",
        "safetystatus": f"Safetystatus: {_SAFETY[machine.safety]}",
        "running": f"Program running: {str(playing).lower()}",
        "programstate": f"{machine.program.upper()} rtde_control",
        "quit": "Disconnected",
    }
    return answers.get(question)


def _state_message(machine: Machine, now_s: float) -> bytes:
    """Robot state message with the tool's pose and offset, and with the arm's DH parameters."""
    q, _ = machine.joints(now_s)
    pose = tool_pose(machine, q).tolist()
    cartesian = struct.pack(">12d", *pose, *machine.tcp.tolist())
    arm = machine.believed
    columns = (arm.offset, arm.a, arm.d, arm.alpha)
    table = [float(value) for column in columns for value in column]
    kinematics = struct.pack(f">6I{len(table)}dI", *range(1, 7), *table, _LINEARISED)
    body = _package(_CARTESIAN, cartesian) + _package(_KINEMATICS, kinematics)
    return _package(_ROBOT_STATE, body)


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">IB", 5 + len(content), kind) + content


SCRIPT_PORT = 30003
PORTS = (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, TRUTH_PORT, *PRIMARY_PORTS)
_PRIMARY_EVERY_S = 0.1
# Polling interval of a frozen controller [s].
_FROZEN_S = 0.02
# The last line of the client's program.
_END = re.compile(rb"^end\s*$", re.MULTILINE)
_Handler: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@dataclass
class _Freeze:
    """Whether the controller keeps its connections open but stays silent."""

    frozen: bool = False

    def set(self, frozen: bool) -> None:
        self.frozen = frozen

    async def thawed(self) -> None:
        while self.frozen:
            await asyncio.sleep(_FROZEN_S)


class ControllerServer:
    """A simulated controller on one host."""

    def __init__(self, options: ControllerOptions, host: str) -> None:
        self._options, self._host = options, host
        self._freeze = _Freeze()

    async def run(self, ready: Callable[[], None]) -> None:
        """Serves until it is cancelled.

        Args:
            ready: Called once all ports listen.

        Raises:
            OSError: A port is taken.
        """
        began_s = time.monotonic()
        machine = Machine(self._options, began_s)
        script = ControlScript(machine)
        rtde = RtdePort(script, self._options, self._freeze.thawed)
        handlers: dict[int, _Handler] = {
            RTDE_PORT: rtde.serve,
            DASHBOARD_PORT: lambda r, w: self._dashboard(machine, r, w),
            SCRIPT_PORT: lambda r, w: self._script(script, r, w),
            TRUTH_PORT: lambda r, w: _truth(TruthChannel(machine, self._freeze.set), r, w),
        }
        handlers |= {port: lambda r, w: self._primary(machine, r, w) for port in PRIMARY_PORTS}
        with ExitStack() as servers:
            for port, handler in handlers.items():
                server = await asyncio.start_server(_tolerant(handler), self._host, port)
                servers.callback(server.close)
            ready()
            await self._tick(machine, script, rtde, began_s)

    async def _tick(
        self, machine: Machine, script: ControlScript, rtde: RtdePort, began_s: float
    ) -> None:
        """Runs the script and sends the states, once per cycle.

        Cycles that a busy computer missed are skipped.
        """
        cycle = 0
        while True:
            cycle = max(cycle + 1, int((time.monotonic() - began_s) * self._options.rate_hz))
            up_s = cycle / self._options.rate_hz
            await asyncio.sleep(began_s + up_s - time.monotonic())
            script.tick(time.monotonic())
            if not self._freeze.frozen:
                rtde.send(Moment(machine, script.registers, began_s + up_s, up_s))

    async def _dashboard(
        self, machine: Machine, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        await self._freeze.thawed()
        writer.write(BANNER.encode() + b"\n")
        while line := await reader.readline():
            await self._freeze.thawed()
            reply = answer(machine, line.decode("utf-8", "replace"), time.monotonic())
            writer.write(reply.encode() + b"\n")

    async def _script(
        self, script: ControlScript, reader: asyncio.StreamReader, _: asyncio.StreamWriter
    ) -> None:
        text = b""
        while part := await reader.read(65536):
            text += part
            if _END.search(text):
                await self._freeze.thawed()
                script.begin(time.monotonic())
                text = b""

    async def _primary(
        self, machine: Machine, _: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while not writer.is_closing():
            await self._freeze.thawed()
            writer.write(_state_message(machine, time.monotonic()))
            await writer.drain()
            await asyncio.sleep(_PRIMARY_EVERY_S)


async def _truth(
    channel: TruthChannel, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    while line := await reader.readline():
        writer.write(channel.answer(line, time.monotonic()))


def _tolerant(handler: _Handler) -> _Handler:
    """Wraps a handler so that a client may disconnect at any time."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            await handler(reader, writer)
        writer.close()

    return serve

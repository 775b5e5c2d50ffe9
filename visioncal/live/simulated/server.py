"""Servers of a simulated controller's ports, in one event loop.

Sources: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": a frame is its whole size
(uint16), its type (one byte) and its payload. "Dashboard Server e-Series". "Remote Control Via
TCP/IP": a robot state message of the primary interface is its size (int32), 16, and packages of
size, type and content. Numbers are big-endian.
"""

import asyncio
import re
import struct
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from visioncal.live.simulated.arm import ControllerOptions, Machine
from visioncal.live.simulated.script import ControlScript
from visioncal.simulation.arms import link_frames

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, PRIMARY_PORT = 30004, 29999, 30003, 30011
PORTS = (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, PRIMARY_PORT)
_HEADER = struct.Struct(">HB")
# Packing of the types of variables, by the protocol's names.
_FORMATS = {"UINT32": "I", "INT32": "i", "DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d"}
# Types of frames.
_PROTOCOL, _VERSION, _DATA, _OUTPUTS, _INPUTS, _START, _PAUSE = b"VvUOISP"
_YES, _NOT_FOUND = b"\x01", "NOT_FOUND"
_COMMON_VERSION = (5, 11, 6, 1010000)
# States are dropped for a client with this many unread bytes.
_BUFFER_BYTES = 1 << 20

_SAFETY = {
    "normal": ("NORMAL", 1 << 0),
    "protective-stop": ("PROTECTIVE_STOP", 1 << 2),
    "emergency-stop": ("ROBOT_EMERGENCY_STOP", 1 << 6 | 1 << 7),
}
_RUNTIME = {"stopped": 1, "playing": 2, "paused": 4}
_MODES = {"POWER_OFF": 3, "RUNNING": 7}
# The weight of an arm, as if all of it were at the flange [N]; torque constants after the gears
# [Nm/A], friction [A], and temperature of the joints [C].
_WEIGHT_N, _TORQUE_PER_A, _FRICTION_A, _WARM_C = 100.0, 12.0, 0.4, 33.0
_PRIMARY_EVERY_S, _FROZEN_S = 0.1, 0.02
# The last line of the client's program.
_END = re.compile(rb"^end\s*$", re.MULTILINE)
_Handler: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
_Reader: TypeAlias = Callable[[Machine, float], float | list[float]]


def _currents(machine: Machine, now_s: float) -> list[float]:
    """Motor currents that hold the arm's weight, and overcome friction [A]."""
    q, dq = machine.joints(now_s)
    frames = link_frames(machine.believed, q[None])[0]
    levers, axes = frames[-1, :3, 3] - frames[:-1, :3, 3], frames[:-1, :3, 2]
    torques = np.sum(np.cross(levers, [0.0, 0.0, _WEIGHT_N]) * axes, axis=1)
    return list(torques / _TORQUE_PER_A + _FRICTION_A * np.tanh(dq / 0.01))


_VARIABLES: Mapping[str, tuple[str, _Reader]] = {
    "actual_q": ("VECTOR6D", lambda machine, now_s: machine.joints(now_s)[0].tolist()),
    "actual_qd": ("VECTOR6D", lambda machine, now_s: machine.joints(now_s)[1].tolist()),
    "actual_current": ("VECTOR6D", _currents),
    "actual_TCP_pose": (
        "VECTOR6D",
        lambda machine, now_s: machine.tool_pose(machine.joints(now_s)[0]).tolist(),
    ),
    "joint_temperatures": ("VECTOR6D", lambda *_: [_WARM_C] * 6),
    "robot_mode": ("INT32", lambda machine, _: _MODES[machine.mode]),
    "runtime_state": ("UINT32", lambda machine, _: _RUNTIME[machine.program]),
    # Power, program, power button.
    "robot_status_bits": (
        "UINT32",
        lambda machine, _: (
            (machine.mode != "POWER_OFF") | (machine.program == "playing") << 1 | 1 << 3
        ),
    ),
    "safety_status_bits": ("UINT32", lambda machine, _: _SAFETY[machine.safety][1]),
    "payload": ("DOUBLE", lambda machine, _: machine.options.payload_kg),
    "payload_cog": ("VECTOR3D", lambda machine, _: list(machine.options.payload_m)),
}
_REGISTER = re.compile(r"(in|out)put_(int|double)_register_(\d+)")


def _type_of(name: str) -> str:
    """The type of a variable."""
    if register := _REGISTER.fullmatch(name):
        return {"int": "INT32", "double": "DOUBLE"}[register[2]]
    others = {"timestamp": "DOUBLE", "external_force_torque": "VECTOR6D"}
    return _VARIABLES[name][0] if name in _VARIABLES else others.get(name, _NOT_FOUND)


def frame(kind: int, payload: bytes = b"") -> bytes:
    """Builds a frame from a payload."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


@dataclass
class _Client:
    """State of a client."""

    writer: asyncio.StreamWriter
    outputs: tuple[str, ...] = ()  # Names of the variables that it is sent.
    # Names of the variables that it sends, by recipe; it counts these from 1.
    inputs: list[tuple[str, ...]] = field(default_factory=list)
    started: bool = False
    every_s: float = 0.0  # Period of its states [s].
    due_s: float = 0.0  # When the next one is due, on the monotonic clock [s].


class ControllerServer:
    """A simulated controller on one host.

    Attributes:
        machine: Its arm.
        frozen: Whether it keeps its connections open but stays silent.
    """

    def __init__(self, options: ControllerOptions, host: str) -> None:
        self._options, self._host, self._began_s = options, host, time.monotonic()
        self.machine, self.frozen = Machine(options, self._began_s), False
        self._script = ControlScript(self.machine)
        self._clients: list[_Client] = []

    async def run(self, ready: Callable[[], None]) -> None:
        """Serves until it is cancelled.

        Args:
            ready: Called once all ports listen.

        Raises:
            OSError: A port is taken.
        """
        handlers = (self._serve_rtde, self._serve_dashboard, self._take_script, self._send_primary)
        with ExitStack() as servers:
            for port, handler in zip(PORTS, handlers, strict=True):
                server = await asyncio.start_server(_tolerant(handler), self._host, port)
                servers.callback(server.close)
            ready()
            cycle, rate_hz = 0, self._options.rate_hz
            while True:
                # Cycles that a busy computer missed are skipped.
                cycle = max(cycle + 1, int((time.monotonic() - self._began_s) * rate_hz))
                due_s = self._began_s + cycle / rate_hz
                await asyncio.sleep(due_s - time.monotonic())
                self._script.tick(time.monotonic())
                if not self.frozen:
                    self._send_states(due_s)

    async def _thawed(self) -> None:
        while self.frozen:
            await asyncio.sleep(_FROZEN_S)

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = _Client(writer)
        self._clients.append(client)
        try:
            while True:
                size, kind = _HEADER.unpack(await reader.readexactly(_HEADER.size))
                payload = await reader.readexactly(size - _HEADER.size)
                await self._thawed()
                writer.write(self._answer_rtde(client, kind, payload))
        finally:
            self._clients.remove(client)

    def _answer_rtde(self, client: _Client, kind: int, payload: bytes) -> bytes:
        if kind == _PROTOCOL:
            return frame(kind, _YES)
        if kind == _VERSION:
            version = re.search(r"(\d+)\.(\d+)\.(\d+)\.(\d+)", self._options.polyscope)
            numbers = map(int, version.groups()) if version else _COMMON_VERSION
            return frame(kind, struct.pack(">4I", *numbers))
        if kind in (_START, _PAUSE):
            client.started = kind == _START
            return frame(kind, _YES)
        if kind == _DATA:
            self._receive(client, payload)
        if kind not in (_OUTPUTS, _INPUTS):
            return b""
        text = payload[8:] if kind == _OUTPUTS else payload
        # The last may be followed by a comma.
        names = tuple(part for part in text.decode("ascii").split(",") if part)
        types = ",".join(map(_type_of, names))
        if kind == _OUTPUTS:
            client.every_s = 1.0 / struct.unpack_from(">d", payload)[0]
            client.outputs = () if _NOT_FOUND in types else names
            return frame(kind, _YES + types.encode())
        client.inputs.append(names)
        return frame(kind, bytes([len(client.inputs)]) + types.encode())

    def _receive(self, client: _Client, payload: bytes) -> None:
        """Writes a client's values to the registers."""
        names, offset = client.inputs[payload[0] - 1], 1
        for name in names:
            form = f">{_FORMATS[_type_of(name)]}"
            if register := _REGISTER.fullmatch(name):
                (value,) = struct.unpack_from(form, payload, offset)
                getattr(self._script.registers, f"{register[2]}_in")[int(register[3])] = value
            offset += struct.calcsize(form)
        if "input_int_register_0" in names:
            self._script.heard(time.monotonic())

    def _send_states(self, now_s: float) -> None:
        """Sends the state to every client that is due."""
        for client in self._clients:
            # Ticks are no finer than this tolerance.
            if not client.started or not client.outputs or now_s < client.due_s - 1e-3:
                continue
            if client.writer.transport.get_write_buffer_size() < _BUFFER_BYTES:
                client.due_s = max(client.due_s + client.every_s, now_s)
                packed = b"".join(self._packed(name, now_s) for name in client.outputs)
                client.writer.write(frame(_DATA, _YES + packed))

    def _packed(self, name: str, now_s: float) -> bytes:
        value: float | list[float] = 0.0
        if name == "timestamp":
            value = now_s - self._began_s
        elif register := _REGISTER.fullmatch(name):
            value = getattr(self._script.registers, f"{register[2]}_out")[int(register[3])]
        else:
            value = _VARIABLES[name][1](self.machine, now_s)
        return struct.pack(
            f">{_FORMATS[_type_of(name)]}", *(value if isinstance(value, list) else [value])
        )

    async def _serve_dashboard(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        await self._thawed()
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            await self._thawed()
            machine, question = self.machine, line.decode("utf-8", "replace").strip().lower()
            playing = machine.program == "playing"
            answers = {
                "polyscopeversion": self._options.polyscope,
                "get serial number": "20235500001",
                # The model's name without its series, as from a real controller.
                "get robot model": self._options.robot.removesuffix("e").upper(),
                "is in remote control": str(machine.remote).lower(),
                "robotmode": f"Robotmode: {machine.mode}",
                "safetymode": f"Safetymode: {_SAFETY[machine.safety][0]}",
                "safetystatus": f"Safetystatus: {_SAFETY[machine.safety][0]}",
                "running": f"Program running: {str(playing).lower()}",
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
                await self._thawed()
                self._script.begin(time.monotonic())
                text = b""

    async def _send_primary(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Sends robot states (16) of one package: the tool's pose and offset (4)."""
        while not writer.is_closing():
            await self._thawed()
            pose = self.machine.tool_pose(self.machine.joints(time.monotonic())[0])
            content = struct.pack(">12d", *pose, *self._options.tcp)
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

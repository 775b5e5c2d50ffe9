"""The ports of a simulated controller, served by one loop.

Sources: Universal Robots, "Dashboard Server e-Series", and "Remote Control Via TCP/IP": a robot
state message of the primary interface is its size (int32), 16, and packages of size, type and
content; numbers are big-endian.
"""

import asyncio
import re
import struct
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TypeAlias

from visioncal.live.rehearsal.machine import ControllerOptions, Machine, tool_pose
from visioncal.live.rehearsal.rtde_port import RtdePort
from visioncal.live.rehearsal.rtde_wire import RTDE_PORT
from visioncal.live.rehearsal.script import ControlScript
from visioncal.live.rehearsal.truth import TRUTH_PORT, TruthChannel
from visioncal.live.rehearsal.variables import Moment

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


def answer(machine: Machine, line: str, now_s: float) -> str:
    """Answers one line of a client, and does what it orders."""
    asked = line.strip().lower()
    state = _state(machine, asked)
    if state is not None:
        return state
    if asked == "stop":
        machine.stop_program(now_s)
        return "Stopped"
    if asked == "unlock protective stop":
        machine.release()
        return "Protective stop releasing"
    if asked == "power off":
        machine.stop_program(now_s)
        machine.mode = "POWER_OFF"
        return "Powering off"
    if asked in ("power on", "brake release"):
        machine.mode = "RUNNING"
        return "Powering on" if asked == "power on" else "Brake releasing"
    if asked.startswith(("popup", "close popup", "close safety popup", "addtolog")):
        return "ok"
    return f"could not understand: '{line.strip()}'"


def _state(machine: Machine, asked: str) -> str | None:
    """Answers a question; None where it is none."""
    playing = machine.program == "playing"
    answers = {
        "polyscopeversion": machine.polyscope,
        "get serial number": "20235500001",
        # The model's name without its series, as the real one.
        "get robot model": machine.believed.name.removesuffix("e").upper(),
        "is in remote control": str(machine.remote).lower(),
        "robotmode": f"Robotmode: {machine.mode}",
        "safetymode": f"Safetymode: {_SAFETY[machine.safety]}",
        "safetystatus": f"Safetystatus: {_SAFETY[machine.safety]}",
        "running": f"Program running: {str(playing).lower()}",
        "programstate": f"{machine.program.upper()} rtde_control",
        "quit": "Disconnected",
    }
    return answers.get(asked)


def _state_message(machine: Machine, now_s: float) -> bytes:
    """A robot state message with the tool's pose and offset, and with the arm's table of joints."""
    q, _ = machine.joints(now_s)
    pose = tool_pose(machine, q).tolist()
    cartesian = struct.pack(">12d", *pose, *machine.tcp.tolist())
    arm = machine.believed
    columns = (arm.offset, arm.a, arm.d, arm.alpha)
    numbers = [float(value) for column in columns for value in column]
    kinematics = struct.pack(f">6I{len(numbers)}dI", *range(1, 7), *numbers, _LINEARISED)
    body = _package(_CARTESIAN, cartesian) + _package(_KINEMATICS, kinematics)
    return _package(_ROBOT_STATE, body)


def _package(kind: int, content: bytes) -> bytes:
    return struct.pack(">IB", 5 + len(content), kind) + content


SCRIPT_PORT = 30003
PORTS = (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, TRUTH_PORT, *PRIMARY_PORTS)
_PRIMARY_EVERY_S = 0.1
# How often a frozen controller looks whether it may go on.
_FROZEN_S = 0.02
# The last line of the client's program.
_END = re.compile(rb"^end\s*$", re.MULTILINE)
_Handler: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@dataclass
class _Silence:
    """Whether the controller keeps its connections and says nothing."""

    frozen: bool = False

    def set(self, frozen: bool) -> None:
        self.frozen = frozen

    async def over(self) -> None:
        while self.frozen:
            await asyncio.sleep(_FROZEN_S)


class ControllerServer:
    """A simulated controller on one host."""

    def __init__(self, options: ControllerOptions, host: str) -> None:
        self._options, self._host = options, host
        self._silence = _Silence()

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
        rtde = RtdePort(script, self._options, self._silence.over)
        handlers: dict[int, _Handler] = {
            RTDE_PORT: rtde.serve,
            DASHBOARD_PORT: lambda r, w: self._dashboard(machine, r, w),
            SCRIPT_PORT: lambda r, w: self._script(script, r, w),
            TRUTH_PORT: lambda r, w: _truth(TruthChannel(machine, self._silence.set), r, w),
        }
        handlers |= {port: lambda r, w: self._primary(machine, r, w) for port in PRIMARY_PORTS}
        with ExitStack() as servers:
            for port, handler in handlers.items():
                server = await asyncio.start_server(_quietly(handler), self._host, port)
                servers.callback(server.close)
            ready()
            await self._tick(machine, script, rtde, began_s)

    async def _tick(
        self, machine: Machine, script: ControlScript, rtde: RtdePort, began_s: float
    ) -> None:
        """Lets time pass: the script acts, and the states go out, each of a whole cycle.

        Cycles that a busy computer missed are left out, not made up for.
        """
        cycle = 0
        while True:
            cycle = max(cycle + 1, int((time.monotonic() - began_s) * self._options.rate_hz))
            up_s = cycle / self._options.rate_hz
            await asyncio.sleep(began_s + up_s - time.monotonic())
            script.tick(time.monotonic())
            if not self._silence.frozen:
                rtde.send(Moment(machine, script.registers, began_s + up_s, up_s))

    async def _dashboard(
        self, machine: Machine, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        await self._silence.over()
        writer.write(BANNER.encode() + b"\n")
        while line := await reader.readline():
            await self._silence.over()
            reply = answer(machine, line.decode("utf-8", "replace"), time.monotonic())
            writer.write(reply.encode() + b"\n")

    async def _script(
        self, script: ControlScript, reader: asyncio.StreamReader, _: asyncio.StreamWriter
    ) -> None:
        text = b""
        while part := await reader.read(65536):
            text += part
            if _END.search(text):
                await self._silence.over()
                script.begin(time.monotonic())
                text = b""

    async def _primary(
        self, machine: Machine, _: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while not writer.is_closing():
            await self._silence.over()
            writer.write(_state_message(machine, time.monotonic()))
            await writer.drain()
            await asyncio.sleep(_PRIMARY_EVERY_S)


async def _truth(
    channel: TruthChannel, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    while line := await reader.readline():
        writer.write(channel.answer(line, time.monotonic()))


def _quietly(handler: _Handler) -> _Handler:
    """A client may go at any time; its connection is closed and forgotten."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            await handler(reader, writer)
        writer.close()

    return serve

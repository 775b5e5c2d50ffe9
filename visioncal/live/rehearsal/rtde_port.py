"""The RTDE port of a simulated controller."""

import asyncio
import re
import struct
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from visioncal.live.rehearsal.machine import ControllerOptions
from visioncal.live.rehearsal.rtde_wire import (
    HEADER_BYTES,
    NOT_FOUND,
    Kind,
    Recipe,
    Value,
    frame,
    join_types,
    read_header,
    split_names,
)
from visioncal.live.rehearsal.script import ControlScript, Registers
from visioncal.live.rehearsal.variables import VARIABLES, Moment, input_type

_YES = b"\x01"
_VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)\.(\d+)")
_COMMON_VERSION = (5, 11, 6, 1010000)
# A client that reads nothing for so many bytes of states is left out.
_FULL_BYTES = 1 << 20
_REGISTER = re.compile(r"input_(int|double)_register_(\d+)")


@dataclass
class _Link:
    """One client: what it asked for.

    Attributes:
        writer: Where its states go.
        outputs: What each state holds; None before it is asked for.
        inputs: The recipes of what it sends, by number.
        started: Whether it wants states now.
        every_s: How often [s].
        due_s: When the next one is due, on the monotonic clock [s].
    """

    writer: asyncio.StreamWriter
    outputs: Recipe | None = None
    inputs: dict[int, Recipe] = field(default_factory=dict)
    started: bool = False
    every_s: float = 0.0
    due_s: float = 0.0


class RtdePort:
    """Serves states and takes registers."""

    def __init__(
        self,
        script: ControlScript,
        options: ControllerOptions,
        awake: Callable[[], Awaitable[None]],
    ) -> None:
        self._script = script
        found = _VERSION.search(options.polyscope)
        self._version = tuple(map(int, found.groups())) if found else _COMMON_VERSION
        self._awake = awake
        self._links: list[_Link] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serves one client until it goes."""
        link = _Link(writer)
        self._links.append(link)
        try:
            while True:
                kind, size = read_header(await reader.readexactly(HEADER_BYTES))
                payload = await reader.readexactly(size)
                await self._awake()
                reply = self._answer(link, kind, payload)
                if reply:
                    writer.write(reply)
        finally:
            self._links.remove(link)

    def send(self, moment: Moment) -> None:
        """Sends the state to every client that is due."""
        for link in self._links:
            # A little early is on time: the clock of ticks is no finer.
            if not link.started or link.outputs is None or moment.now_s < link.due_s - 1e-3:
                continue
            if link.writer.transport.get_write_buffer_size() > _FULL_BYTES:
                continue
            link.due_s = max(link.due_s + link.every_s, moment.now_s)
            values = [VARIABLES[name][1](moment) for name in link.outputs.names]
            link.writer.write(link.outputs.pack(values))

    def _answer(self, link: _Link, kind: int, payload: bytes) -> bytes:
        if kind == Kind.PROTOCOL:
            return frame(Kind.PROTOCOL, _YES)
        if kind == Kind.VERSION:
            return frame(Kind.VERSION, struct.pack(">4I", *self._version))
        if kind == Kind.OUTPUTS:
            return self._set_outputs(link, payload)
        if kind == Kind.INPUTS:
            return _set_inputs(link, payload)
        if kind in (Kind.START, Kind.PAUSE):
            link.started = kind == Kind.START
            return frame(Kind(kind), _YES)
        if kind == Kind.DATA:
            self._take(link, payload)
        return b""

    def _take(self, link: _Link, payload: bytes) -> None:
        """Takes what a client writes; what fits no recipe of it is left out."""
        recipe = link.inputs.get(payload[0]) if payload else None
        if recipe is None or NOT_FOUND in recipe.types:
            return
        for name, value in recipe.unpack(payload).items():
            _write(self._script.registers, name, value)
            if name == "input_int_register_0":
                self._script.heard(time.monotonic())

    def _set_outputs(self, link: _Link, payload: bytes) -> bytes:
        (rate,) = struct.unpack_from(">d", payload)
        names = split_names(payload[8:])
        types = tuple(VARIABLES[name][0] if name in VARIABLES else NOT_FOUND for name in names)
        link.every_s = 1.0 / rate if rate > 0.0 else 0.0
        link.outputs = None if NOT_FOUND in types else Recipe(1, names, types)
        return frame(Kind.OUTPUTS, _YES + join_types(types))


def _set_inputs(link: _Link, payload: bytes) -> bytes:
    """Recipes are numbered from 1 for each client, which counts them itself."""
    names = split_names(payload)
    types = tuple(input_type(name) or NOT_FOUND for name in names)
    number = len(link.inputs) + 1
    link.inputs[number] = Recipe(number, names, types)
    return frame(Kind.INPUTS, bytes([number]) + join_types(types))


def _write(registers: Registers, name: str, value: Value) -> None:
    found = _REGISTER.fullmatch(name)
    if found is None or isinstance(value, Sequence):
        return
    place = int(found[2])
    if found[1] == "int":
        registers.int_in[place] = int(value)
    else:
        registers.double_in[place] = value

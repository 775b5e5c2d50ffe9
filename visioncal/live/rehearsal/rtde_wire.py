"""Frames of RTDE, Universal Robots' protocol of states and registers on port 30004.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". A frame is its whole size
(uint16), its type (one byte) and its payload; numbers are big-endian.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import TypeAlias

RTDE_PORT = 30004
_HEADER = struct.Struct(">HB")
HEADER_BYTES = _HEADER.size
# Packing of each type of variable, by the protocol's names.
_FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
NOT_FOUND = "NOT_FOUND"

Value: TypeAlias = float | Sequence[float]


class Kind(IntEnum):
    """Type of a frame."""

    PROTOCOL = ord("V")
    VERSION = ord("v")
    TEXT = ord("M")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


@dataclass(frozen=True)
class Recipe:
    """Recipe of data frames: their variables, in order.

    Attributes:
        number: Number of the recipe, the first byte of its frames.
    """

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @cached_property
    def _struct(self) -> struct.Struct:
        return struct.Struct(">B" + "".join(_FORMATS[name] for name in self.types))

    def pack(self, values: Sequence[Value]) -> bytes:
        """Packs one value for each variable as a frame."""
        flat: list[float] = []
        for value, type_name in zip(values, self.types, strict=True):
            several = value if isinstance(value, Sequence) else [value]
            flat += several if _FORMATS[type_name].endswith("d") else map(int, several)
        return frame(Kind.DATA, self._struct.pack(self.number, *flat))

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Unpacks a data frame's payload: the values by name."""
        flat = list(self._struct.unpack(payload)[1:])
        values: dict[str, Value] = {}
        for name, type_name in zip(self.names, self.types, strict=True):
            count = int(_FORMATS[type_name][:-1] or "1")
            part, flat = flat[:count], flat[count:]
            values[name] = tuple(part) if count > 1 else part[0]
        return values


def frame(kind: Kind, payload: bytes = b"") -> bytes:
    """Builds a frame from a payload."""
    return _HEADER.pack(HEADER_BYTES + len(payload), kind) + payload


def read_header(header: bytes) -> tuple[int, int]:
    """Reads a header: the type, and the size of the payload [B]."""
    size, kind = _HEADER.unpack(header)
    return kind, size - HEADER_BYTES


def split_names(text: bytes) -> tuple[str, ...]:
    """Reads a list of names; the last may be followed by a comma."""
    return tuple(part for part in text.decode("ascii").split(",") if part)


def join_types(types: Sequence[str]) -> bytes:
    """Writes a list of types."""
    return ",".join(types).encode("ascii")

"""What only a UR's primary interface reports: its tool offset.

Source: Universal Robots, "Remote Control Via TCP/IP": a message is its size, its type and its
content; a robot state message (16) holds packages of the same form; numbers are big-endian.
"""

import struct
import time
from collections.abc import Iterator

from visioncal.core.errors import DriverError
from visioncal.live.drivers.ur_net import connect

# The first only reads, and is open where the second is not.
_PORTS = (30011, 30001)
_WAIT_S = 1.0
_HEADER = struct.Struct(">IB")
_ROBOT_STATE, _CARTESIAN = 16, 4
_TOOL = struct.Struct(">6d6d")
# No message of a controller comes near it.
_MOST_BYTES = 1 << 20


def read_tool_offset(host: str) -> list[float]:
    """Reads the tool offset that is set: x, y, z [m] and a rotation vector [rad].

    Raises:
        DriverError: The controller cannot be reached, or does not report it.
    """
    content = _package(host, _CARTESIAN, _TOOL.size, "its tool offset")
    return list(_TOOL.unpack_from(content)[6:])


def _package(host: str, kind: int, size: int, what: str) -> bytes:
    for found, content in _packages(host):
        if found == kind and len(content) >= size:
            return content
    raise DriverError(
        f"The controller at {host} does not report {what} on its primary interface.",
        culprits=[host],
        next_step="It takes PolyScope 3.4 or newer; open the primary client interface under "
        "Settings > Security > Services.",
    )


def _packages(host: str) -> Iterator[tuple[int, bytes]]:
    """The packages of all robot states that come within the time."""
    ends_s = time.monotonic() + _WAIT_S
    try:
        link = connect(host, _PORTS[0], "the primary interface")
    except DriverError:
        link = connect(host, _PORTS[1], "the primary interface")
    with link, link.makefile("rb") as file:
        try:
            while time.monotonic() < ends_s:
                size, kind = _HEADER.unpack(file.read(_HEADER.size))
                if not _HEADER.size <= size <= _MOST_BYTES:
                    return
                message = file.read(size - _HEADER.size)
                if kind == _ROBOT_STATE:
                    yield from _split(message)
        except (OSError, struct.error):
            return


def _split(message: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + _HEADER.size <= len(message):
        size, kind = _HEADER.unpack_from(message, at)
        if size < _HEADER.size:
            return
        yield kind, message[at + _HEADER.size : at + size]
        at += size

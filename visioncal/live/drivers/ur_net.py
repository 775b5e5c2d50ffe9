"""Plain connections to a UR controller, all with timeouts.

The client library waits for a silent controller without a timeout, holding the interpreter lock.
Its servers are therefore checked from here first: the dashboard, and the primary interface, whose
message is its size, its type and its content; a robot state message (16) holds packages of the same
form; numbers are big-endian (Universal Robots, "Remote Control Via TCP/IP").
"""

import queue
import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import BinaryIO, Self

from visioncal.core.errors import DriverError

DASHBOARD_PORT, SCRIPT_PORT, RTDE_PORT = 29999, 30003, 30004
# A controller in the same network answers within milliseconds.
_CONNECT_S = 0.8
_ANSWER_S = 1.0
_BANNER = "Universal Robots Dashboard Server"
_HEADER = struct.Struct(">HB")
# Types of RTDE's frames: request of a version, output recipe, start, state.
_PROTOCOL, _OUTPUTS, _START, _DATA = b"VOSU"
# Primary interface: the read-only port is open where the other may not be.
_PORTS = (30011, 30001)
_WAIT_S = 1.0
_PRIMARY_HEADER = struct.Struct(">IB")
_ROBOT_STATE, _CARTESIAN = 16, 4
_TOOL = struct.Struct(">6d6d")
# Upper bound of a message's size.
_MAX_BYTES = 1 << 20


def resolve(host: str) -> str:
    """Resolves a host's name to its address, such as `192.168.0.10`.

    Raises:
        DriverError: The name is not known, or no name server answers in time.
    """
    result: queue.SimpleQueue[str | OSError] = queue.SimpleQueue()

    def ask() -> None:
        try:
            result.put(socket.gethostbyname(host))
        except OSError as error:
            result.put(error)

    # The system's resolver takes many seconds, and has no timeout.
    threading.Thread(target=ask, daemon=True).start()
    try:
        address = result.get(timeout=_ANSWER_S)
    except queue.Empty:
        address = TimeoutError(f"no answer within {_ANSWER_S} s")
    if isinstance(address, str):
        return address
    raise DriverError(
        f"The robot's address {host!r} is not known: {address.strerror or address}.",
        culprits=[host],
        next_step="Give the IP address that the pendant shows (Settings > System > Network).",
    ) from address


def connect(host: str, port: int, what: str) -> socket.socket:
    """Opens a connection to a port of a controller; `what` listens there is for messages.

    Raises:
        DriverError: The host cannot be reached, or does not listen there.
    """
    try:
        link = socket.create_connection((host, port), _CONNECT_S)
    except ConnectionRefusedError as error:
        raise DriverError(
            f"{host} is there, but its port {port} ({what}) is closed: no UR controller with "
            "PolyScope 3 or 5 is running there.",
            culprits=[f"{host}:{port}"],
            next_step="Check the address; wait until the pendant has started; open the port under "
            "Settings > Security > Services.",
        ) from error
    except OSError as error:
        raise DriverError(
            f"{host} cannot be reached (port {port}, {what}): "
            f"{error.strerror or f'no answer within {_CONNECT_S} s'}.",
            culprits=[f"{host}:{port}"],
            next_step="Check the network cable, the address, and that this computer's is in the "
            f"same network: ping {host}",
        ) from error
    link.settimeout(_ANSWER_S)
    return link


class Dashboard:
    """Client of a controller's dashboard server, which takes commands as lines of text."""

    def __init__(self, host: str, answer_s: float = _ANSWER_S) -> None:
        self._label = f"{host}:{DASHBOARD_PORT}"
        self._socket = connect(host, DASHBOARD_PORT, "the dashboard")
        self._socket.settimeout(answer_s)
        self._file = self._socket.makefile("rb")
        try:
            self._check_banner(self._line())
        except DriverError:
            self.close()
            raise

    def ask(self, line: str) -> str:
        """Sends a line and returns the answer.

        Raises:
            DriverError: There is none.
        """
        try:
            self._socket.sendall(line.encode("ascii") + b"\n")
        except OSError as error:
            raise self._no_answer_error(error) from error
        return self._line()

    def close(self) -> None:
        """Closes the connection."""
        self._file.close()
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_banner(self, banner: str) -> None:
        if _BANNER not in banner:
            raise DriverError(
                f"{self._label} greets with {banner[:60]!r}, not as a {_BANNER}: this is no UR "
                "controller.",
                culprits=[self._label],
                next_step="Give the address that the robot's pendant shows.",
            )

    def _line(self) -> str:
        try:
            line = self._file.readline(1000)
        except OSError as error:
            raise self._no_answer_error(error) from error
        if not line:
            raise self._no_answer_error("it closed the connection")
        return line.decode("utf-8", "replace").strip()

    def _no_answer_error(self, why: object) -> DriverError:
        return DriverError(
            f"The dashboard of the controller at {self._label} does not answer: {why}.",
            culprits=[self._label],
            next_step="Look at the pendant; start the controller anew if it does not react.",
        )


def check_states_come(host: str) -> None:
    """Checks that the controller sends states, by receiving one.

    Raises:
        DriverError: It is no RTDE server, or sends nothing.
    """
    label = f"{host}:{RTDE_PORT}"
    with connect(host, RTDE_PORT, "RTDE") as link, link.makefile("rb") as file:
        try:
            link.sendall(_frame(_PROTOCOL, struct.pack(">H", 2)))
            kind, reply = _read(file)
            if kind != _PROTOCOL or reply != b"\x01":
                raise DriverError(
                    f"{label} does not speak version 2 of RTDE: a UR controller with PolyScope "
                    "3.4 or newer is needed.",
                    culprits=[label],
                    next_step="Check the address; update PolyScope where it is older.",
                )
            link.sendall(_frame(_OUTPUTS, struct.pack(">d", 125.0) + b"timestamp"))
            link.sendall(_frame(_START))
            while kind != _DATA:
                kind, _ = _read(file)
        except (OSError, struct.error) as error:
            raise DriverError(
                f"The controller at {label} accepts the connection but sends no states: {error}.",
                culprits=[label],
                next_step="Look at the pendant; start the controller anew if it does not react.",
            ) from error


def _frame(kind: int, payload: bytes = b"") -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def _read(file: BinaryIO) -> tuple[int, bytes]:
    """Reads a frame's type and payload; raises `struct.error` at the end of the stream."""
    size, kind = _HEADER.unpack(file.read(_HEADER.size))
    return kind, file.read(size - _HEADER.size)


def read_tool_offset(host: str) -> list[float]:
    """Reads the active tool offset: x, y, z [m] and a rotation vector [rad].

    Raises:
        DriverError: The controller cannot be reached, or does not report it.
    """
    content = _package(host, _CARTESIAN, _TOOL.size, "its tool offset")
    return list(_TOOL.unpack_from(content)[6:])


def _package(host: str, kind: int, size: int, what: str) -> bytes:
    for package_kind, content in _packages(host):
        if package_kind == kind and len(content) >= size:
            return content
    raise DriverError(
        f"The controller at {host} does not report {what} on its primary interface.",
        culprits=[host],
        next_step="It takes PolyScope 3.4 or newer; open the primary client interface under "
        "Settings > Security > Services.",
    )


def _packages(host: str) -> Iterator[tuple[int, bytes]]:
    """Packages of all robot states that arrive within the timeout."""
    ends_s = time.monotonic() + _WAIT_S
    try:
        link = connect(host, _PORTS[0], "the primary interface")
    except DriverError:
        link = connect(host, _PORTS[1], "the primary interface")
    with link, link.makefile("rb") as file:
        try:
            while time.monotonic() < ends_s:
                size, kind = _PRIMARY_HEADER.unpack(file.read(_PRIMARY_HEADER.size))
                if not _PRIMARY_HEADER.size <= size <= _MAX_BYTES:
                    return
                message = file.read(size - _PRIMARY_HEADER.size)
                if kind == _ROBOT_STATE:
                    yield from _split_packages(message)
        except (OSError, struct.error):
            return


def _split_packages(message: bytes) -> Iterator[tuple[int, bytes]]:
    offset = 0
    while offset + _PRIMARY_HEADER.size <= len(message):
        size, kind = _PRIMARY_HEADER.unpack_from(message, offset)
        if size < _PRIMARY_HEADER.size:
            return
        yield kind, message[offset + _PRIMARY_HEADER.size : offset + size]
        offset += size

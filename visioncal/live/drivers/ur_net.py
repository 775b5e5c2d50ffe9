"""Plain connections to a UR controller, all with timeouts, and its condition.

The client library waits for a silent controller without a timeout, holding the interpreter lock.
Its servers are therefore checked from here first: the dashboard, and the primary interface, whose
message is its size, its type and its content; a robot state message (16) holds packages of the same
form; numbers are big-endian (Universal Robots, "Remote Control Via TCP/IP").
"""

import re
import socket
import struct
import time
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import BinaryIO

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Safety

DASHBOARD_PORT, SCRIPT_PORT, RTDE_PORT = 29999, 30003, 30004
# A controller in the same network answers within milliseconds.
_CONNECT_S = 0.8
_ANSWER_S = 1.0  # Longest wait for an answer [s].
_BANNER = "Universal Robots Dashboard Server"
HEADER = struct.Struct(">HB")
# Types of RTDE's frames: request of its version, of the controller's, recipes of outputs and of
# inputs, start, pause, state.
PROTOCOL, VERSION_OF, OUTPUTS, INPUTS, START, PAUSE, DATA = b"VvOISPU"
# First major version of PolyScope X: RTDE and the primary interface, but no dashboard.
_POLYSCOPE_X = 10
# Primary interface: the read-only port is open where the other may not be.
PRIMARY_PORTS = (30011, 30001)
_PRIMARY_HEADER = struct.Struct(">IB")
_ROBOT_STATE, _CARTESIAN = 16, 4  # Kinds of a message and of its part.
_TOOL = struct.Struct(">6d6d")
# Upper bound of a message's size.
_MAX_BYTES = 1 << 20
_VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)\.\d+")
# Oldest versions with the floating-point registers that ur-rtde's control script needs.
_LEAST = {3: (3, 4), 5: (5, 4)}
_RUNNING = "RUNNING"
# Models that exist in two series, of which the dashboard reports only the size.
_MODELS_OF_TWO_SERIES = ("UR3", "UR5", "UR10", "UR16")
# Modes in which joints report their positions.
_REPORTING_MODES = (_RUNNING, "IDLE", "BACKDRIVE")
_MODE_STEPS = {
    "POWER_OFF": "Switch it on at the pendant: the circle at the lower left, then On and Start.",
    "IDLE": "Release its brakes at the pendant: the circle at the lower left, then Start.",
}
_EMERGENCY = (
    "Make sure that the cell is clear, pull out the emergency-stop button, and switch the arm on "
    "at the pendant."
)
_PROTECTIVE = (
    "Look what the arm touches or which limit it met, and free it; then press Enable Robot on the "
    "pendant, which waits 5 s, and go on."
)
_SAFETY_STEPS = {
    "PROTECTIVE_STOP": _PROTECTIVE,
    "SAFEGUARD_STOP": "Close the safety gate, or leave the scanner's field, and reset it.",
    "AUTOMATIC_MODE_SAFEGUARD_STOP": "Close the safety gate and reset it.",
    "RECOVERY": "Move the arm back within its safety limits by hand, in recovery mode.",
    "SYSTEM_EMERGENCY_STOP": _EMERGENCY,
    "ROBOT_EMERGENCY_STOP": _EMERGENCY,
    "SYSTEM_THREE_POSITION_ENABLING_STOP": "Hold the enabling switch, or go to automatic mode.",
}
_FAULT_STEP = "Read the pendant's log, and start the controller anew."
# RTDE's `safety_status_bits`, the gravest first.
_SAFETY_BITS: tuple[tuple[int, Safety], ...] = (
    (1 << 8 | 1 << 9, "fault"),
    (1 << 5 | 1 << 6 | 1 << 7, "emergency-stop"),
    (1 << 2 | 1 << 3 | 1 << 4, "protective-stop"),
    (1 << 1, "reduced"),
)


def connect(host: str, port: int, what: str) -> socket.socket:
    """Opens a connection to a port of a controller; `what` listens there is for messages.

    Raises:
        DriverError: The host cannot be reached, or does not listen there.
    """
    try:
        link = socket.create_connection((host, port), _CONNECT_S)
    except ConnectionRefusedError as error:
        raise DriverError(
            f"{host} answers, but its port {port} ({what}) is closed: no UR controller with "
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
            banner = self._line()
        except DriverError:
            self.close()
            raise
        if _BANNER not in banner:
            self.close()
            raise DriverError(
                f"{self._label} greets with {banner[:60]!r}, not as a {_BANNER}: this is no UR "
                "controller.",
                culprits=[self._label],
                next_step="Give the address that the robot's pendant shows.",
            )

    def ask(self, line: str) -> str:
        """Sends a line and returns the answer; raises DriverError."""
        try:
            self._socket.sendall(line.encode("ascii") + b"\n")
        except OSError as error:
            raise self._no_answer_error(error) from error
        return self._line()

    def close(self) -> None:
        """Closes the connection."""
        self._file.close()
        self._socket.close()

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
    """Checks that the controller sends states, by receiving one; raises DriverError."""
    label = f"{host}:{RTDE_PORT}"
    with connect(host, RTDE_PORT, "RTDE") as link, link.makefile("rb") as file:
        try:
            link.sendall(frame(PROTOCOL, struct.pack(">H", 2)))
            kind, reply = _read(file)
            if kind != PROTOCOL or reply != b"\x01":
                raise DriverError(
                    f"{label} does not speak version 2 of RTDE: it must be a UR controller with "
                    "PolyScope 3.4 or newer.",
                    culprits=[label],
                    next_step="Check the address; update PolyScope where it is older.",
                )
            link.sendall(frame(OUTPUTS, struct.pack(">d", 125.0) + b"timestamp"))
            link.sendall(frame(START))
            while kind != DATA:
                kind, _ = _read(file)
        except (OSError, struct.error) as error:
            raise DriverError(
                f"The controller at {label} accepts the connection but sends no states: {error}.",
                culprits=[label],
                next_step="Look at the pendant; start the controller anew if it does not react.",
            ) from error


def frame(kind: int, payload: bytes = b"") -> bytes:
    """A frame of RTDE: its whole size, its type and its payload."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def _read(file: BinaryIO) -> tuple[int, bytes]:
    """Reads a frame's type and payload; raises `struct.error` at the end of the stream."""
    size, kind = HEADER.unpack(file.read(HEADER.size))
    return kind, file.read(size - HEADER.size)


def read_tool_offset(host: str) -> list[float]:
    """Reads the active tool offset: x, y, z [m] and a rotation vector [rad]; raises DriverError."""
    ends_s = time.monotonic() + _ANSWER_S
    try:
        link = connect(host, PRIMARY_PORTS[0], "the primary interface")
    except DriverError:
        link = connect(host, PRIMARY_PORTS[1], "the primary interface")
    with link, link.makefile("rb") as file, suppress(OSError, struct.error):
        while time.monotonic() < ends_s:
            size, kind = _PRIMARY_HEADER.unpack(file.read(_PRIMARY_HEADER.size))
            if not _PRIMARY_HEADER.size <= size <= _MAX_BYTES:
                break
            message, offset = file.read(size - _PRIMARY_HEADER.size), 0
            while kind == _ROBOT_STATE and offset + _PRIMARY_HEADER.size <= len(message):
                size, package = _PRIMARY_HEADER.unpack_from(message, offset)
                start = offset + _PRIMARY_HEADER.size
                if package == _CARTESIAN and size >= _PRIMARY_HEADER.size + _TOOL.size:
                    return list(_TOOL.unpack_from(message, start)[6:])
                offset += max(size, _PRIMARY_HEADER.size)
    raise DriverError(
        f"The controller at {host} does not report its tool offset on its primary interface.",
        culprits=[host],
        next_step="It takes PolyScope 3.4 or newer; open the primary client interface under "
        "Settings > Security > Services.",
    )


@dataclass(frozen=True)
class Condition:
    """The dashboard's answers; of PolyScope X, which has none, only the version is known."""

    host: str
    version: tuple[int, int, int]  # PolyScope's version: major, minor, bug fix.
    model: str  # The arm's name, such as `UR10e`.
    mode: str  # The robot's mode, such as `RUNNING`.
    safety: str  # The state of the safety system, such as `NORMAL`.
    remote: bool  # Whether it is in remote control; True where it does not report it.

    @property
    def is_polyscope_x(self) -> bool:
        """Whether the controller runs PolyScope X."""
        return self.version[0] >= _POLYSCOPE_X

    def check_moves(self) -> None:
        """Checks that it can be moved from outside; raises DriverError."""
        if self.is_polyscope_x:
            raise self._refuse(
                "is not driven: nothing is driven on PolyScope X until its interface is known",
                "Guide it by hand with --follow, or let its own program drive with --arm socket "
                "(see live/clients/visioncal.script), or type its poses with --arm manual.",
            )
        if self.safety not in ("NORMAL", "REDUCED"):
            raise self._refuse(
                f"is stopped by its safety system: {self.safety}",
                _SAFETY_STEPS.get(self.safety, _FAULT_STEP),
            )
        self.check_reports()
        if self.mode != _RUNNING:
            raise self._refuse(f"is not ready to move: its mode is {self.mode}")
        if not self.remote:
            raise self._refuse(
                "is in local control, and takes no orders from here",
                "Switch it to Remote Control at the upper right of the pendant; the mode is there "
                "once it is enabled under Settings > System > Remote Control.",
            )

    def check_reports(self) -> None:
        """Checks that it reports its joint positions; raises DriverError."""
        if not self.is_polyscope_x and self.mode not in _REPORTING_MODES:
            raise self._refuse(f"does not know where its joints are: its mode is {self.mode}")

    def _refuse(self, why: str, step: str = "") -> DriverError:
        mode_step = _MODE_STEPS.get(self.mode, "Look at the pendant, and switch the arm on there.")
        return DriverError(
            f"The {self.model} at {self.host} {why}.",
            culprits=[self.host],
            next_step=step or mode_step,
        )


def read_condition(host: str) -> Condition:
    """Reads the condition from the dashboard, or that there is none; raises DriverError."""
    try:
        opened = Dashboard(host)
    except DriverError:
        version = _version_by_rtde(host)
        if version is None or version[0] < _POLYSCOPE_X:
            raise
        words = ".".join(map(str, version))
        return Condition(host, version, f"UR with PolyScope X {words}", "", "", remote=False)
    with closing(opened) as dashboard:
        version = _read_version(host, dashboard.ask("PolyscopeVersion"))
        model = dashboard.ask("get robot model")
        mode = dashboard.ask("robotmode").rpartition(":")[2].strip()
        query = "safetystatus" if version >= (5, 4, 0) else "safetymode"
        safety = dashboard.ask(query).rpartition(":")[2].strip()
        # Earlier versions do not report it.
        remote = version < (5, 6) or "true" in dashboard.ask("is in remote control").lower()
    series = "e" if version[0] == 5 and model in _MODELS_OF_TWO_SERIES else ""
    return Condition(host, version, f"{model}{series}", mode, safety, remote)


def _version_by_rtde(host: str) -> tuple[int, int, int] | None:
    """Version of the controller by RTDE; None where it does not say it.

    Source: Universal Robots, Real-Time Data Exchange (RTDE) Guide, "Get URControl version".
    """
    with (
        suppress(DriverError, OSError, struct.error),
        connect(host, RTDE_PORT, "RTDE") as link,
        link.makefile("rb") as file,
    ):
        link.sendall(frame(PROTOCOL, struct.pack(">H", 2)) + frame(VERSION_OF))
        _read(file)
        kind, payload = _read(file)
        if kind == VERSION_OF:
            major, minor, patch, _ = struct.unpack(">4I", payload)
            return major, minor, patch
    return None


def safety_of(bits: int) -> Safety:
    """Reads RTDE's `safety_status_bits`."""
    return next((safety for mask, safety in _SAFETY_BITS if bits & mask), "normal")


def _read_version(host: str, text: str) -> tuple[int, int, int]:
    match = _VERSION.search(text)
    if match is None:
        raise DriverError(
            f"The controller at {host} answers {text[:60]!r} when asked for its version; four "
            "numbers are needed, as in URSoftware 5.11.0.108249.",
            culprits=[host],
            next_step="Check that the address is a UR's with PolyScope 3 or 5.",
        )
    major, minor, patch = map(int, match.groups())
    if major not in _LEAST or (major, minor) < _LEAST[major]:
        raise DriverError(
            f"The controller at {host} has PolyScope {major}.{minor}.{patch}; ur-rtde needs 3.4 or "
            "newer on the CB-series, and 5.4 or newer on the e-Series.",
            culprits=[host],
            next_step="Update PolyScope, or type poses by hand with the manual arm.",
        )
    return major, minor, patch

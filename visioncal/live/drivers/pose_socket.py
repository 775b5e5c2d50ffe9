"""Arm that the robot's own program drives, and reports over TCP.

The protocol is a line of text for each stop, and a line as its answer: `live/clients/README.md`.
Visioncal listens, because a robot's controller is the easier client.
"""

import re
import select
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visioncal.core.documents.pendants import line_numbers, possible_forms, read_pose
from visioncal.core.errors import DataError, DriverError
from visioncal.core.types import FloatArray
from visioncal.live.drivers.manual import form_name
from visioncal.live.drivers.protocols import Answer, ArmState, Stopwatch
from visioncal.session.table import MOST_VIEWS

# The programs for robots, beside which the protocol is described.
CLIENTS = Path(__file__).parents[1] / "clients"
# How long no stop may come [s]: a robot stands still in a break, or while somebody looks at it.
PATIENCE_S = 900.0
# Silence after which a peer that answers no probe is lost [s]; a robot connects again after it.
_DEAD_S = 4
# Clients that may wait before one of them says where it stands.
_MOST_WAITING = 8
_SLICE_S = 0.05  # Longest wait for a line, so that a stop is noticed [s].
# Longest line in [bytes].
_MAX_LINE = 500
_ENDS = re.compile(rb"[\r\n]")
# Meaningless characters of a client's line: blanks, and the zeros of a character array.
_FILL = b" \t\r\n\0"


class _LostError(Exception):
    """The link is closed or broken."""


@dataclass(eq=False)
class _Link:
    """A connection to the robot's program."""

    peer: socket.socket
    received: bytes = b""  # Unread bytes of its lines.
    is_understood: bool = False  # Whether it has said where it stands.

    def __post_init__(self) -> None:
        self.peer.setblocking(False)
        self.peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        # The system probes a silent peer, and breaks the link where it does not answer.
        limits = dict.fromkeys(("TCP_NODELAY", "TCP_KEEPIDLE", "TCP_KEEPALIVE", "TCP_KEEPINTVL"), 1)
        # An answer that is not confirmed counts, too [ms]; not all systems have all names.
        limits |= {"TCP_KEEPCNT": _DEAD_S - 1, "TCP_USER_TIMEOUT": 1000 * _DEAD_S}
        for name, value in limits.items():
            with suppress(AttributeError, OSError):
                self.peer.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def receive(self) -> None:
        """Adds received bytes to the text; raises _LostError."""
        # More than this is refused anyway.
        while len(self.received) <= 2 * _MAX_LINE:
            try:
                data = self.peer.recv(_MAX_LINE)
            except BlockingIOError:
                return
            except OSError as error:
                raise _LostError from error
            if not data:
                raise _LostError
            self.received += data

    def send(self, words: bytes) -> None:
        """Sends a line; raises _LostError, also where the client reads nothing."""
        try:
            if self.peer.send(words + b"\n") <= len(words):
                raise _LostError
        except OSError as error:
            raise _LostError from error

    def refuse_more(self) -> None:
        """Refuses what came before an answer; raises _LostError."""
        if self.received.strip(_FILL):
            self.send(b"error more than one line before its answer")
            raise _LostError

    def close(self) -> None:
        """Closes the link, so that the last answer arrives."""
        with suppress(OSError):
            # Unread bytes would reset the link, and take the last answer away.
            self.peer.shutdown(socket.SHUT_WR)
            for _ in range(20):
                self.peer.recv(_MAX_LINE)
        self.peer.close()


class SocketArm:
    """Arm whose program says by a line of text that it stands at a stop, and where.

    A program that sends more than one line before an answer gets `error`, and its link is closed,
    so that no pose is taken for another. A stop that is sent again after a lost answer has the
    number of its view (`take_requested`).

    Args:
        host: Address of this computer at which it listens; `0.0.0.0` for all its networks.
        port: Port; 0 for any that is free.
        form: Form of poses that are bare numbers, as for `ManualArm`; None to recognise it.
        patience_s: How long no stop may come [s].

    Raises:
        DriverError: It cannot listen there, or there is no such form.
    """

    name = "the robot's own program"

    def __init__(
        self, host: str, port: int, form: str | None = None, *, patience_s: float = PATIENCE_S
    ) -> None:
        self._form = None if form is None else form_name(form)
        try:
            self._server = socket.create_server((host, port), backlog=4)
        except (OSError, UnicodeError) as error:
            raise DriverError(
                f"{host}:{port} cannot be opened for a robot: {error}.",
                culprits=[f"{host}:{port}"],
                next_step="Another program, or an earlier visioncal, may listen there: end it, or "
                "name another port and set that in the robot's program, too. The address is one "
                "of this computer.",
            ) from error
        self._server.setblocking(False)
        self.host, self.port = host, int(self._server.getsockname()[1])
        # The robot's program, and before it has said where it stands, whoever may be it.
        self._link: _Link | None = None
        self._waiting: list[_Link] = []
        self._stop: ArmState | None = None
        self._joints: int | None = None
        self._patience_s, self._idle = patience_s, Stopwatch()
        self._refused, self._is_done = "", False

    @property
    def invitation(self) -> str:
        """Words on the address that listens, and on the robot's programs."""
        is_local = self.host == "localhost" or self.host.startswith("127.")
        who = "Programs of this computer alone" if is_local else "All computers that reach this one"
        return (
            f"Waiting for the robot's own program at {self.host}:{self.port}. {who} can send "
            "poses; the first that says where it stands is heard until it hangs up. Programs for "
            f"KUKA, ABB, FANUC and UR are in {CLIENTS}; a line as "
            "'1 | X 512.3 Y -12.5 Z 800 A 10 B 0 C 180' says where it stands."
        )

    def state(self) -> ArmState:
        """The stop of the last request, stamped now; raises DriverError before the first."""
        if self._stop is None:
            raise DriverError("The robot's program has not sent its pose yet.")
        return replace(self._stop, stamp_s=time.monotonic())

    def request(self, timeout_s: float, wanted: str = "") -> ArmState | None:  # noqa: ARG002
        """Waits for a stop; what cannot be understood is answered `error` meanwhile.

        Raises:
            EOFError: The program said `end`.
            DriverError: No stop came for `patience_s`.
        """
        waited = Stopwatch()
        while True:
            line = self._next_line()
            if line is not None:
                if line.strip().lower() == "end":
                    self.reply("done")
                if self._is_done:
                    raise EOFError
                try:
                    self._stop = self._understood(line)
                except DataError as error:
                    self._refused = error.message
                    self.reply("error", f"{error.message} {error.next_step}")
                    # One that never said where it stands takes no robot's place.
                    if self._link is not None and not self._link.is_understood:
                        self._drop(self._link)
                else:
                    self._idle.restart()
                    self._prefer()
                    return self._stop
            if self._idle.read() > self._patience_s:
                refused = f" It was last refused: {self._refused}" if self._refused else ""
                raise DriverError(
                    f"{self.name} has sent no stop to {self.host}:{self.port} for "
                    f"{self._patience_s:.0f} s.{refused}",
                    culprits=[f"{self.host}:{self.port}"],
                    next_step="Start it again on the pendant; see whether "
                    "it has this computer's address and port, and whether a firewall is between.",
                )
            if waited.read() > timeout_s:
                return None
            self._wait()

    def reply(self, answer: Answer, reason: str = "") -> None:
        """Answers the last line, if its link still stands; waits for the link's end after `done`.

        The stop is answered again when the program connects again and sends it again.
        """
        # Links come and go while requests are waited for alone.
        link = self._link
        if link is None:
            return
        words = " ".join(f"{answer} {reason}".split()).encode("ascii", "replace")
        with self._dropped_if_lost(link):
            # A line before the answer did not wait for it.
            link.receive()
            # Longest answer, without its end [bytes].
            link.send(words[:199])
            link.refuse_more()
        self._idle.restart()
        if answer in ("next", "done") and self._stop is not None:
            self._joints = 0 if self._stop.q is None else len(self._stop.q)
        if answer == "done":
            self._is_done, is_answered = True, self._link is link
            lingering = Stopwatch()
            # `done` answers whatever comes, until an answered program has closed its link. So long
            # may a robot take to read it and to close the link [s].
            while lingering.read() < 3.0 and not (is_answered and self._link is None):
                if self._next_line() is not None and self._link is not None:
                    with self._dropped_if_lost(self._link):
                        self._link.send(b"done")
                        is_answered = True
                self._wait()

    def close(self) -> None:
        """Closes link and port, by which the robot's program learns that nothing listens."""
        for link in (*self._waiting, *([self._link] if self._link else [])):
            self._drop(link)
        self._server.close()

    def _understood(self, line: str) -> ArmState:
        """Reads a stop; raises DataError."""
        number, *parts = (part.strip() for part in line.split("|"))
        is_number = number.isascii() and number.isdecimal() and len(number) < 6
        if len(parts) not in (1, 2) or not (is_number and 1 <= int(number) <= MOST_VIEWS):
            raise DataError(
                f"{line[:20]!r} must be a stop.",
                next_step=f"A stop is: number (1 to {MOST_VIEWS}) | pose, or number | pose | "
                "joints deg.",
            )
        if self._form is None and len(forms := possible_forms(parts[0])) > 1:
            raise DataError(
                f"the pose may be of {', '.join(forms)}.",
                next_step=f"Name its numbers, or start visioncal with --pose-form {forms[0]}.",
            )
        pose = read_pose(parts[0], "the pose", self._form)
        joints = _joints(parts[1]) if len(parts) == 2 else None
        count = 0 if joints is None else len(joints)
        if self._joints not in (None, count):
            raise DataError(
                f"{count} joints, and {self._joints} at the first stop.",
                next_step="Send the same joints at all stops, or none at any.",
            )
        form = pose.form.name
        return ArmState(time.monotonic(), pose.pose, joints, stop=int(number), pose_form=form)

    def _next_line(self) -> str | None:
        """Whole line that the client waits for an answer to; None where there is none."""
        self._accept()
        for link in [self._link] if self._link else [*self._waiting]:
            line = self._line_of(link)
            if line is not None:
                self._waiting = [other for other in self._waiting if other is not link]
                self._link = link
                return line
        return None

    def _line_of(self, link: _Link) -> str | None:
        with self._dropped_if_lost(link):
            link.receive()
            link.received = link.received.lstrip(_FILL)
            first, *rest = _ENDS.split(link.received, maxsplit=1)
            if len(first) > _MAX_LINE:
                link.send(b"error a line of more than %d bytes" % _MAX_LINE)
                raise _LostError
            if not rest:
                return None
            link.received = rest[0]
            # A program that went away does not wait at its stop.
            link.receive()
            link.refuse_more()
            try:
                return first.strip(_FILL).decode("utf-8")
            except UnicodeDecodeError:
                link.send(b"error the line must be text in ASCII or UTF-8")
        return None

    def _accept(self) -> None:
        """Takes the client that connects, or refuses it while the robot's program is there."""
        try:
            peer, _ = self._server.accept()
        except OSError:
            return
        now = self._link
        if now is not None:
            # The same program may have hung up, and connects again.
            with self._dropped_if_lost(now):
                now.receive()
        self._waiting.append(_Link(peer))
        if self._link is not None:
            self._prefer()
        elif len(self._waiting) > _MOST_WAITING:
            self._drop(self._waiting[0])

    def _prefer(self) -> None:
        """Keeps the program that said where it stands, and refuses all others."""
        if self._link is not None:
            self._link.is_understood = True
        for link in [*self._waiting]:
            with suppress(_LostError):
                link.send(b"busy another program is connected")
            self._drop(link)

    @contextmanager
    def _dropped_if_lost(self, link: _Link) -> Iterator[None]:
        try:
            yield
        except _LostError:
            self._drop(link)

    def _drop(self, link: _Link) -> None:
        link.close()
        self._waiting = [other for other in self._waiting if other is not link]
        self._link = None if self._link is link else self._link

    def _wait(self) -> None:
        links = [self._link] if self._link else self._waiting
        select.select([self._server, *(link.peer for link in links)], [], [], _SLICE_S)


def _joints(text: str) -> FloatArray:
    """Reads joint angles with their unit behind them (n,) [rad]; raises DataError."""
    *numbers, unit = text.split() or [""]
    values = line_numbers(" ".join(numbers))
    if unit not in ("deg", "rad") or not values:
        raise DataError(
            f"{text[:40]!r} are no joint angles.",
            next_step="Send numbers and their unit, as 10.5 -20 30 0 45 90 deg.",
        )
    angles = np.array(values)
    angles = np.deg2rad(angles) if unit == "deg" else angles
    # No joint turns farther from its zero [rad].
    if not np.abs(angles).max() < 50.0:
        raise DataError(f"a joint angle of {np.abs(angles).max():.4g} rad is too large.")
    return angles

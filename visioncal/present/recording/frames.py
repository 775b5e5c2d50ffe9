"""The messages of an `.rrd` file, found without reading what is in them.

An `.rrd` is a header of 12 bytes and then messages: kind and length, 8 bytes each with the lowest
first, and a payload. A finished file ends with a message of kind LAST, which shows rerun where its
chunks are, and 32 bytes that say where that message is. A writer that was killed leaves none of
these; a file that was cut ends within a message.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from visioncal.core.errors import DataError
from visioncal.core.files import absence

LAST, STORE_INFO, CHUNK, ACTIVATION = range(4)

_MAGIC, _CLOSING_MAGIC = b"RRF2", b"RRF2FOOT"
_START_BYTES, _CLOSING_BYTES = 12, 12
_HEAD = struct.Struct("<QQ")


@dataclass(frozen=True)
class Frame:
    """One message.

    Attributes:
        kind: LAST, STORE_INFO, CHUNK or ACTIVATION (of a layout).
        offset: Where its payload begins in the file.
        size: Length of the payload [bytes].
    """

    kind: int
    offset: int
    size: int

    @property
    def end(self) -> int:
        """Where the next message begins."""
        return self.offset + self.size


@dataclass(frozen=True)
class Scan:
    """The whole messages of a file.

    Attributes:
        path: The file.
        frames: Its messages in its order, up to the first that is cut, without the one of kind
            LAST.
        end: Where the last of them ends.
        finished: Whether the file has its end, as rerun writes it.
        cut: Whether it goes on behind `end` without being finished.
    """

    path: Path
    frames: tuple[Frame, ...]
    end: int
    finished: bool
    cut: bool


def scan(path: Path) -> Scan:
    """Finds the messages of a file.

    Raises:
        DataError: The file is missing or no `.rrd`; or it is finished and yet the head of a message
            does not lead to the next one.
    """
    why_not = absence(path)
    if why_not:
        raise DataError(
            f"{path} {why_not}.", culprits=[str(path)], next_step="Check the path and its spelling."
        )
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            if not file.read(_START_BYTES).startswith(_MAGIC) or size < _START_BYTES:
                raise DataError(
                    f"{path} is no recording: it does not begin as an .rrd does.",
                    culprits=[str(path)],
                    next_step="Give the .rrd that visioncal wrote, or the session's folder.",
                )
            frames = list(_walk(file, size))
            file.seek(max(0, size - _CLOSING_BYTES))
            closed = file.read().startswith(_CLOSING_MAGIC)
    except OSError as error:
        raise _unreadable(path, error) from error
    led_to_last = bool(frames) and frames[-1].kind == LAST
    if led_to_last:
        frames.pop()
    end = frames[-1].end if frames else _START_BYTES
    if closed and not led_to_last:
        raise DataError(
            f"{path} is damaged: the length of the message at byte {end} was changed after it was "
            "written.",
            culprits=[str(path)],
            next_step="Take the recording again from its origin.",
        )
    return Scan(path, tuple(frames), end, closed, end < size and not closed)


def _walk(file: BinaryIO, size: int) -> Iterator[Frame]:
    """Finds whole messages; stops behind the first of kind LAST."""
    at = _START_BYTES
    while at + _HEAD.size <= size:
        file.seek(at)
        frame = _frame(file.read(_HEAD.size), at)
        # A loss of power can leave zeros, which look like an empty message of kind LAST.
        empty_last = frame.kind == LAST and not frame.size
        if frame.kind > ACTIVATION or frame.end > size or empty_last:
            return
        yield frame
        if frame.kind == LAST:
            return
        at = frame.end


def _frame(head: bytes, at: int) -> Frame:
    kind, length = _HEAD.unpack(head)
    return Frame(kind, at + _HEAD.size, length)


def read_payload(path: Path, frame: Frame) -> bytes:
    """Reads one message's payload.

    Raises:
        DataError: The file cannot be read, or has become shorter.
    """
    try:
        with path.open("rb") as file:
            file.seek(frame.offset)
            payload = file.read(frame.size)
    except OSError as error:
        raise _unreadable(path, error) from error
    if len(payload) != frame.size:
        raise DataError(
            f"{path} was replaced since it was opened.",
            culprits=[str(path)],
            next_step="Load it again.",
        )
    return payload


def _unreadable(path: Path, error: OSError) -> DataError:
    missing = isinstance(error, FileNotFoundError)
    what = "does not exist" if missing else f"cannot be read: {error.strerror or error}"
    return DataError(
        f"{path} {what}.",
        culprits=[str(path)],
        next_step="Check the path and its spelling." if missing else "",
    )

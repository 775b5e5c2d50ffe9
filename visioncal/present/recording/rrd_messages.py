"""Locates the messages of an `.rrd` file without reading their content, and unpacks chunks.

An `.rrd` is a header of 12 bytes followed by messages: kind and length, 8 bytes each in
little-endian order, and a payload. A finished file ends with a message of kind LAST, which tells
rerun where its chunks are, and 32 bytes that give the position of that message. A truncated file
has none of these.

Chunks are not read with rerun's reader, which takes whole files and ends the process on some
damaged ones. The payload of a chunk is the message `ArrowMsg` of rerun's Protocol Buffers.
"""

import struct
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa

from visioncal.core.errors import DataError
from visioncal.core.files import opened

LAST, STORE_INFO, CHUNK, ACTIVATION = range(4)

_MAGIC, _CLOSING_MAGIC = b"RRF2", b"RRF2FOOT"
_START_BYTES, _CLOSING_BYTES = 12, 12
_HEAD = struct.Struct("<QQ")
_COMPRESSION, _UNPACKED_SIZE, _BODY = 2, 3, 5
_LZ4 = 2


@dataclass(frozen=True)
class MessageFrame:
    """Position of one message in the file."""

    kind: int  # LAST, STORE_INFO, CHUNK or ACTIVATION (of a layout).
    offset: int  # Offset of its payload in the file.
    size: int  # Length of the payload [bytes].

    @property
    def end(self) -> int:
        """Offset of the next message."""
        return self.offset + self.size


def scan(path: Path) -> tuple[MessageFrame, ...]:
    """Locates the messages of a file, without the one of kind LAST; raises DataError."""
    with opened(path) as file:
        size = path.stat().st_size
        if not file.read(_START_BYTES).startswith(_MAGIC) or size < _START_BYTES:
            raise DataError(
                f"{path} must be a recording, but does not begin as an .rrd does.",
                culprits=[str(path)],
                next_step="Give the .rrd that visioncal wrote, or the session's folder.",
            )
        frames = list(_walk(file, size))
        file.seek(max(0, size - _CLOSING_BYTES))
        is_closed = file.read().startswith(_CLOSING_MAGIC)
    if not (is_closed and frames and frames[-1].kind == LAST):
        end = frames[-1].end if frames else _START_BYTES
        raise DataError(
            f"{path} was cut off or damaged: the message at byte {end} is not whole.",
            culprits=[str(path)],
            next_step="Take the recording again from its origin.",
        )
    return tuple(frames[:-1])


def _walk(file: BinaryIO, size: int) -> Iterator[MessageFrame]:
    """Yields complete messages, up to the first of kind LAST."""
    offset = _START_BYTES
    while offset + _HEAD.size <= size:
        file.seek(offset)
        kind, length = _HEAD.unpack(file.read(_HEAD.size))
        frame = MessageFrame(kind, offset + _HEAD.size, length)
        if frame.kind > ACTIVATION or frame.end > size:
            return
        yield frame
        if frame.kind == LAST:
            return
        offset = frame.end


def read_payload(path: Path, frame: MessageFrame) -> bytes:
    """Reads one message's payload; raises DataError."""
    with opened(path) as file:
        file.seek(frame.offset)
        payload = file.read(frame.size)
    if len(payload) != frame.size:
        raise DataError(
            f"{path} was replaced since it was opened.",
            culprits=[str(path)],
            next_step="Load it again.",
        )
    return payload


def record_batch(payload: bytes, entities: Container[str]) -> tuple[str, pa.RecordBatch] | None:
    """Unpacks a chunk if it belongs to one of the given entities.

    Returns:
        Path of its entity, and its rows; None for another entity.

    Raises:
        ValueError: The chunk is damaged.
    """
    try:
        numbers, fields = _fields(payload)
        body = fields[_BODY]
        if numbers.get(_COMPRESSION) == _LZ4:
            size = numbers[_UNPACKED_SIZE]
            # LZ4 expands a block to at most 255 times its size.
            if size > 255 * len(body):
                raise ValueError(f"{len(body)} bytes cannot unpack to {size}")
            body = pa.decompress(body, size, codec="lz4_raw")
        reader = pa.ipc.open_stream(body)
        entity = reader.schema.metadata[b"rerun:entity_path"].decode()
        if entity not in entities:
            return None
        batch = reader.read_next_batch()
        batch.validate(full=True)
    except (pa.ArrowException, OSError, KeyError, TypeError, StopIteration) as error:
        raise ValueError(f"a chunk cannot be unpacked: {error!r}") from error
    return entity, batch


def _fields(message: bytes) -> tuple[dict[int, int], dict[int, bytes]]:
    """Splits a Protocol Buffers message into integers and other fields, by field number."""
    numbers: dict[int, int] = {}
    fields: dict[int, bytes] = {}
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, wire_type = key >> 3, key & 7
        if wire_type == 0:
            numbers[number], position = _varint(message, position)
            continue
        if wire_type == 2:
            size, position = _varint(message, position)
        elif wire_type in (1, 5):
            size = 8 if wire_type == 1 else 4
        else:
            raise ValueError(f"a message has a field of wire type {wire_type}")
        if position + size > len(message):
            raise ValueError("a message ends within a field")
        fields[number] = message[position : position + size]
        position += size
    return numbers, fields


def _varint(message: bytes, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 64, 7):
        if position >= len(message):
            raise ValueError("a message ends within a number")
        value |= (message[position] & 0x7F) << shift
        position += 1
        if message[position - 1] < 0x80:
            return value, position
    raise ValueError("a number has more than 64 bits")

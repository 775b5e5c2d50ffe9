"""What is in a message of an `.rrd`: a chunk of rows of one entity, as an Arrow record batch.

Read here rather than by rerun, whose reader takes whole files and ends the process on some damaged
ones. The payload of a chunk is the message `ArrowMsg` of rerun's Protocol Buffers.
"""

from collections.abc import Container

import pyarrow as pa

_COMPRESSION, _UNPACKED_SIZE, _BODY = 2, 3, 5
_LZ4 = 2
# No block of LZ4 unpacks to more than this many times its size.
_LZ4_RATIO = 255


def record_batch(payload: bytes, entities: Container[str]) -> tuple[str, pa.RecordBatch] | None:
    """Unpacks a chunk, if it is of one of the entities that are asked for.

    Returns:
        The path of its entity, and its rows; None where it is of another entity.

    Raises:
        ValueError: It is damaged.
    """
    try:
        numbers, fields = _fields(payload)
        body = fields[_BODY]
        if numbers.get(_COMPRESSION) == _LZ4:
            size = numbers[_UNPACKED_SIZE]
            if size > _LZ4_RATIO * len(body):
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
    """Splits a message of Protocol Buffers into its integers and its other fields, by number."""
    numbers: dict[int, int] = {}
    fields: dict[int, bytes] = {}
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, wire_type = key >> 3, key & 7
        if wire_type == 0:
            numbers[number], at = _varint(message, at)
            continue
        if wire_type == 2:
            size, at = _varint(message, at)
        elif wire_type in (1, 5):
            size = 8 if wire_type == 1 else 4
        else:
            raise ValueError(f"a message has a field of wire type {wire_type}")
        if at + size > len(message):
            raise ValueError("a message ends within a field")
        fields[number] = message[at : at + size]
        at += size
    return numbers, fields


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 64, 7):
        if at >= len(message):
            raise ValueError("a message ends within a number")
        value |= (message[at] & 0x7F) << shift
        at += 1
        if message[at - 1] < 0x80:
            return value, at
    raise ValueError("a number has more than 64 bits")

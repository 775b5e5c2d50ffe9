"""Image size from a file's header, read before decoding."""

import struct
from collections.abc import Iterator

# The largest sensors have 150 million pixels.
MOST_PIXELS = 160_000_000
_PNG, _JPEG, _BMP = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"BM"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
SIGNATURES = (_PNG, _JPEG, _BMP, *_TIFF)
# Start-of-frame markers of JPEG; the three excluded ones are tables.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SCAN = 0xDA
# Tags of TIFF, and format of a value by its type.
_WIDTH, _HEIGHT, _PACKED = 256, 257, {1: "B", 3: "H", 4: "I"}


def is_webp(data: bytes) -> bool:
    """Whether a file starts as a webp: RIFF, its length, and the kind of the first chunk."""
    return data.startswith(b"RIFF") and data[8:15] == b"WEBPVP8"


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """Size (width, height) [px] in the header of a png, jpg, tif, bmp or webp; None without one."""
    try:
        if data.startswith(_PNG):
            return struct.unpack_from(">II", data, 16)
        if data.startswith(_JPEG):
            return _size_of_jpeg(data)
        if data.startswith(_BMP):
            width, height = struct.unpack_from("<ii", data, 18)
            return width, abs(height)
        if is_webp(data):
            return _size_of_webp(data)
        return _size_of_tiff(data, _TIFF[data[:4]]) if data[:4] in _TIFF else None
    except struct.error:
        return None


def start_of_scan(data: bytes) -> int:
    """Offset of a JPEG's image data, after thumbnails; -1 without one."""
    return next((at for marker, at in _segments(data) if marker == _SCAN), -1)


def _segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Markers of a JPEG's header with their offsets, up to the first scan."""
    offset = 2
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        yield data[offset + 1], offset
        if data[offset + 1] == _SCAN:
            return
        offset += 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")


def _size_of_jpeg(data: bytes) -> tuple[int, int] | None:
    offset = next((offset for marker, offset in _segments(data) if marker in _FRAMES), None)
    if offset is None:
        return None
    height, width = struct.unpack_from(">HH", data, offset + 5)
    return width, height


def _size_of_webp(data: bytes) -> tuple[int, int] | None:
    match data[15:16]:
        case b" ":
            width, height = struct.unpack_from("<HH", data, 26)
            return width & 0x3FFF, height & 0x3FFF
        case b"L":
            (packed,) = struct.unpack_from("<I", data, 21)
            return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        case b"X" if len(data) >= 30:
            width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
            return width, height
    return None


def _size_of_tiff(data: bytes, order: str) -> tuple[int, int] | None:
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, start)
    sizes = {}
    for offset in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(f"{order}HH", data, offset)
        if tag in (_WIDTH, _HEIGHT) and kind in _PACKED:
            (sizes[tag],) = struct.unpack_from(f"{order}{_PACKED[kind]}", data, offset + 8)
    return (sizes[_WIDTH], sizes[_HEIGHT]) if len(sizes) == 2 else None

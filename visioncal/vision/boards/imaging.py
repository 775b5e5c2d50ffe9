"""Decoding of image files, and measurement of their sharpness."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from visioncal.core.errors import DataError
from visioncal.core.files import MOST_IMAGE_BYTES, read_bytes
from visioncal.core.types import FloatArray, Image, Image16

# Half-widths of the window around a corner in which the edge width is measured [px].
_REACH_PX = (4, 12)
# Number of corners measured in an image; their median is stable to some percent.
_SAMPLE = 12
# Number of rows scaled at a time.
_STRIP = 256
# Minimum contrast that detectors need [grey levels].
_LEAST_CONTRAST = 12
_FAINT_QUALITY = 20
# Instruction for an image in colour.
GREY = "Give its grey levels: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)."


def looks_like_image(data: bytes) -> bool:
    """Whether a file starts as png, jpg, tif, bmp or webp; later damage does not matter."""
    return data.startswith(SIGNATURES) or is_webp(data)


def decode_image(data: bytes, *, colour: bool = False) -> Image | str:
    """Decodes an image file to a (h, w) grey or (h, w, 3) BGR image, or says why not.

    EXIF rotation for viewers is ignored: the camera matrix refers to the sensor's orientation.
    """
    if not data:
        return "unreadable: the file is empty"
    if _is_cut_short(data):
        return "unreadable: the file is cut short"
    if data.startswith(b"\x89PNG") and _is_damaged_png(data):
        return "unreadable: the file is damaged"
    size = claimed_size(data)
    if size is None:
        return "unreadable: not an image that can be decoded (png, jpg, tif, bmp or webp is needed)"
    if size[0] * size[1] > MOST_PIXELS:
        return (
            f"too large: its header claims {size[0]} x {size[1]} px, and up to "
            f"{MOST_PIXELS / 1e6:.0f} million are decoded"
        )
    flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        return "unreadable: not an image that can be decoded"
    return np.asarray(image, dtype=np.uint8) if image.dtype == np.uint8 else _to_eight_bits(image)


def faint_jpeg(image: Image) -> bytes:
    """Encodes a (h, w) or (h, w, 3) image as strongly compressed JPEG, to look at.

    At full size, so that overlaid corners fit: a twentieth of the bytes.
    """
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _FAINT_QUALITY])[1])


def check_grey(image: Image, label: str) -> None:
    """Checks that an image is grey.

    Raises:
        DataError: It does not have exactly two dimensions.
    """
    if image.ndim != 2:
        raise DataError(
            f"{label}: an array of the shape {image.shape}; (h, w) grey levels are needed.",
            culprits=[label],
            next_step=GREY,
        )


def encode_png(image: Image | Image16) -> bytes:
    """Encodes a (h, w) or (h, w, 3) image of 8 or 16 bits as png.

    Raises:
        DataError: The array has another shape or type.
    """
    pixels: npt.NDArray[np.integer[Any]] = np.asarray(image)
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3) or not pixels.size:
        raise DataError(
            f"an image has the shape {pixels.shape} and the type {pixels.dtype}; (h, w) or "
            "(h, w, 3) of uint8 or uint16 is needed.",
            culprits=["images"],
        )
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


def shrunk(image: Image, factor: int) -> Image:
    """A (h, w) image reduced by a whole factor; rows and columns that are left over are cut off."""
    height, width = (factor * (side // factor) for side in image.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def read_image(path: Path) -> Image:
    """Reads a (h, w) grey image; see `decode_image`.

    Raises:
        DataError: The file is missing or cannot be decoded.
    """
    image = decode_image(read_bytes(path, MOST_IMAGE_BYTES))
    if isinstance(image, str):
        raise DataError(
            f"{path} is {image}.",
            culprits=[str(path)],
            next_step="A photograph is needed, as png, jpg, tif, bmp or webp; a page of a PDF has "
            "to be saved as one.",
        )
    return image


def _to_eight_bits(image: npt.NDArray[Any]) -> Image:
    """Scales to the brightest levels, as 10 or 12 bit cameras fill the lower part of 16 bits."""
    top = float(np.percentile(_levels(image[::4, ::4]), 99.9))
    scaled = np.empty(image.shape, dtype=np.uint8)
    # In strips, as the largest images would not fit into memory as floats.
    for at in range(0, len(image), _STRIP):
        strip = _levels(image[at : at + _STRIP])
        scaled[at : at + _STRIP] = np.clip(strip * (255.0 / max(top, 1e-9)), 0, 255)
    return scaled


def _levels(image: npt.NDArray[Any]) -> FloatArray:
    return np.nan_to_num(image.astype(np.float32))


def _is_cut_short(data: bytes) -> bool:
    """Whether the end marker of a PNG or JPEG is missing: decoders fill up missing data."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    if data.startswith(b"\xff\xd8"):
        scan = start_of_scan(data)
        return scan < 0 or data.rfind(b"\xff\xd9") < scan
    return False


def _is_damaged_png(data: bytes) -> bool:
    """Whether a PNG chunk's checksum is wrong: decoders continue past damage with wrong pixels."""
    start, view = 8, memoryview(data)
    while start + 12 <= len(data):
        length = int.from_bytes(view[start : start + 4], "big")
        end = start + 8 + length
        if zlib.crc32(view[start + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            return True
        start = end + 4
    return False


def blur_at_corners(image: Image, px: FloatArray) -> float:
    """Median edge width (sigma) at a sample of (n, 2) chessboard corners, n >= 1 [px].

    A step edge blurred by a Gaussian of sigma s has a steepest central difference of 2 Phi(1 / s) -
    1 times half the step; solved for s, this holds down to half a pixel.
    """
    chosen = px[:: max(1, len(px) // _SAMPLE)]
    spacing = np.linalg.norm(np.diff(px, axis=0), axis=1).min(initial=4 * _REACH_PX[1])
    reach = int(np.clip(0.3 * spacing, *_REACH_PX))
    offsets = np.arange(-reach, reach + 1)
    centre = np.round(chosen).astype(int)
    rows = np.clip(centre[:, 1, None] + offsets, 0, image.shape[0] - 1)
    columns = np.clip(centre[:, 0, None] + offsets, 0, image.shape[1] - 1)
    return float(np.median(_edge_sigma(image[rows[:, :, None], columns[:, None, :]])))


def poor_image_reason(image: Image, max_blur_px: float) -> str:
    """Reason why a target is hard to detect: low contrast, or blur; empty if neither."""
    low, high = np.percentile(image[::4, ::4], [2, 98])
    if high - low < _LEAST_CONTRAST:
        return (
            f"the image is almost uniform, with {high - low:.0f} grey levels of contrast "
            f"({_LEAST_CONTRAST:.0f} are needed)"
        )
    blur = blur_of_edges(image)
    if blur > max_blur_px:
        return (
            f"the image is blurred, its sharpest edges are {blur:.0f} px wide "
            f"(limit {max_blur_px:g} px)"
        )
    return ""


def blur_of_edges(image: Image) -> float:
    """Sigma of the sharpest edges of an image [px]; see `blur_at_corners`."""
    return float(_edge_sigma(image[None])[0])


def _edge_sigma(patches: Image) -> FloatArray:
    levels = patches.astype(np.float32)
    dv = (levels[:, 2:, 1:-1] - levels[:, :-2, 1:-1]) / 2
    du = (levels[:, 1:-1, 2:] - levels[:, 1:-1, :-2]) / 2
    gradient = np.hypot(dv, du).reshape(len(levels), -1)
    low, high = np.percentile(levels.reshape(len(levels), -1), [2, 98], axis=1)
    steepest = np.percentile(gradient, 99.5, axis=1) / np.maximum(high - low, 1.0)
    return np.asarray(1.0 / ndtri(0.5 + np.clip(steepest, 1e-3, 0.499)), dtype=float)


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

"""Decoding of image files, and measurement of their sharpness."""

import io
import warnings
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
# Number of rows scaled at a time.
_STRIP = 256
# Minimum contrast that detectors need [grey levels].
_LEAST_CONTRAST = 12
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
_SIGNATURES = (b"\x89PNG", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM", b"RIFF")
BLURRED = "the image is blurred"  # Begins a reason.
# Instruction for an image in colour.
GREY = "Give its grey levels: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)."


def looks_like_image(data: bytes) -> bool:
    """Whether a file starts as png, jpg, tif, bmp or webp; later damage does not matter."""
    return data.startswith(_SIGNATURES)


def grey_of(image: Image) -> Image:
    """Grey image (h, w) of an image that may be coloured."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def decode_image(data: bytes, *, colour: bool = False) -> Image | str:
    """Decodes an image file to a (h, w) grey or (h, w, 3) BGR image, or says why not.

    EXIF rotation for viewers is ignored: the camera matrix refers to the sensor's orientation.
    """
    if not data:
        return "unreadable: the file is empty"
    if _is_cut_short(data):
        return "unreadable: the file is cut short"
    # Pillow reads the header and a PNG's checksums: OpenCV decodes past damage with wrong pixels.
    from PIL import Image as Pillow

    # Warnings of damage, which is reported below, and of half as many pixels as are refused.
    warnings.filterwarnings("ignore", module=r"PIL\.")
    try:
        with Pillow.open(io.BytesIO(data), formats=_FORMATS) as header:
            header.verify()
    except Pillow.DecompressionBombError:
        most = 2e-6 * (Pillow.MAX_IMAGE_PIXELS or 0)
        return f"too large: images have up to {most:.0f} million pixels"
    except SyntaxError:
        return "unreadable: the file is damaged"
    except (OSError, ValueError):
        return "unreadable: it cannot be decoded as png, jpg, tif, bmp or webp"
    flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        return "unreadable: not an image that can be decoded"
    return np.asarray(image, dtype=np.uint8) if image.dtype == np.uint8 else _to_eight_bits(image)


def exif_turn(data: bytes) -> int | None:
    """The quarter turn by which viewers show an image file, as OpenCV's; None where it has none."""
    from PIL import Image as Pillow

    with Pillow.open(io.BytesIO(data), formats=_FORMATS) as header:
        turns = {6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}
        # EXIF's tag of the orientation.
        return turns.get(header.getexif().get(0x0112, 1))


def image_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of an image file [px]; None where it cannot be decoded."""
    image = decode_image(data)
    return None if isinstance(image, str) else (image.shape[1], image.shape[0])


def faint_jpeg(image: Image) -> bytes:
    """Encodes a (h, w) or (h, w, 3) image as strongly compressed JPEG, to look at.

    At full size, so that overlaid corners fit: a twentieth of the bytes.
    """
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 20])[1])


def check_grey(image: Image) -> None:
    """Checks that an image is grey; raises DataError."""
    if image.ndim != 2:
        raise DataError(
            f"image has the shape {image.shape}, but must have (h, w), of grey levels.",
            culprits=["image"],
            next_step=GREY,
        )


def encode_png(image: Image | Image16) -> bytes:
    """Encodes a (h, w) or (h, w, 3) image of 8 or 16 bits as png; raises DataError."""
    pixels: npt.NDArray[np.integer[Any]] = np.asarray(image)
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3) or not pixels.size:
        raise DataError(
            f"an image has the shape {pixels.shape} and the type {pixels.dtype}, but must "
            "be (h, w) or (h, w, 3) of uint8 or uint16.",
            culprits=["images"],
        )
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


def resized(image: Image, by: float) -> Image:
    """A (h, w) image with sides by a factor as long; itself where that is 1."""
    if by == 1.0:
        return image
    way = cv2.INTER_AREA if by < 1.0 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, None, fx=by, fy=by, interpolation=way), np.uint8)


def shrunk(image: Image, factor: int) -> Image:
    """A (h, w) image reduced by a whole factor; rows and columns that are left over are cut off."""
    # OpenCV halves an image four times as fast as it reduces it by any other factor.
    if factor % 4 == 0:
        return shrunk(shrunk(image, 2), factor // 2)
    height, width = (factor * (side // factor) for side in image.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def read_image(path: Path) -> Image:
    """Reads a (h, w) grey image; see `decode_image`; raises DataError."""
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
    # A thumbnail has an end of its own, before the last scan begins.
    return data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")


def blur_at_corners(image: Image, px: FloatArray, reaches: float = 0.0) -> float:
    """Median edge width (sigma) at a sample of (n, 2) chessboard corners, n >= 1 [px].

    With `reaches`, windows go so many distances of corners far, as to the rims of circles.

    A step edge blurred by a Gaussian of sigma s has a steepest central difference of 2 Phi(1 / s) -
    1 times half the step; solved for s, this holds down to half a pixel.
    """
    # Their median is stable to some percent.
    chosen = px[:: max(1, len(px) // 12)]
    spacing = np.linalg.norm(np.diff(px, axis=0), axis=1).min(initial=4 * _REACH_PX[1])
    reach = int(max(np.clip(0.3 * spacing, *_REACH_PX), reaches * spacing))
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
    dv, du = _slopes(image[None].astype(np.float32))
    steepness = np.hypot(dv, du)[0] / (high - low)
    # Of the sharpest edges, and of those across each of eight directions, half of them twice.
    blur = float(_sigma_of(np.percentile(steepness, 99.5)))
    # Of every third row.
    third = steepness[::3].ravel()
    sectors = np.floor(np.arctan2(dv[0, ::3], du[0, ::3]).ravel() * (16.0 / np.pi)).astype(int) % 16
    by_sector = np.full(16, 0.0)
    for at in range(16):
        steep = third[(sectors == at) | (sectors == (at + 1) % 16)]
        fewest = len(third) // 2000 + 1
        if len(steep) > fewest:
            by_sector[at] = np.partition(steep, -fewest)[-fewest]
    # A board has edges in two directions; motion leaves those sharp that are along it.
    weaker_slopes = np.minimum(by_sector, np.roll(by_sector, 8))
    smear = float(_sigma_of(weaker_slopes.max()))
    for words, wide_px in (
        (f"{BLURRED}, its sharpest edges are", blur),
        (f"{BLURRED} along one direction, as by motion: edges across it are", smear),
    ):
        if wide_px > max_blur_px:
            return f"{words} {wide_px:.0f} px wide (limit {max_blur_px:g} px)"
    return ""


def _slopes(levels: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
    """Central differences of (n, h, w) grey levels, down and across, within the borders."""
    dv = (levels[:, 2:, 1:-1] - levels[:, :-2, 1:-1]) / 2
    du = (levels[:, 1:-1, 2:] - levels[:, 1:-1, :-2]) / 2
    return dv, du


def _sigma_of(steepness: FloatArray | np.float64) -> FloatArray:
    """Widths (sigma) of step edges of some steepness, as a share of the contrast [px]."""
    return np.asarray(1.0 / ndtri(0.5 + np.clip(steepness, 1e-3, 0.499)), dtype=float)


def _edge_sigma(patches: Image) -> FloatArray:
    levels = patches.astype(np.float32)
    gradient = np.hypot(*_slopes(levels)).reshape(len(levels), -1)
    low, high = np.percentile(levels.reshape(len(levels), -1), [2, 98], axis=1)
    return _sigma_of(np.percentile(gradient, 99.5, axis=1) / np.maximum(high - low, 1.0))

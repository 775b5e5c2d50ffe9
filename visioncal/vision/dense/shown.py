"""The board as a calibration, blur and light have it in an image, and what they do not explain."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from visioncal.core.types import Camera, FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.camera import normalise
from visioncal.vision.dense.blur import DRAWN_PX, Blur, transfer
from visioncal.vision.dense.library import ONE_TORCH_THREAD, library
from visioncal.vision.dense.prints import Print, board_places
from visioncal.vision.finders.maps import map_of_all

if TYPE_CHECKING:
    from torch import Tensor

# What is not explained is drawn so many times as strong, about a middle grey.
MAGNIFIED, MIDDLE = 4, 128
# How far around the outermost corners a board is looked at [squares].
_RIM = 1.0
# Polynomials through so many places a side carry a map over an image.
_NODES = 14
# Pixels that show the light, at least and at most.
_FEWEST_LIT, _LIT_BY = 100, 50_000
# Beyond so many pixels, there is one sample in each.
_MOST_FINE = 1_500_000
_FEWEST = 6


@dataclass(frozen=True, eq=False)
class DenseImage:
    """An image, as far as it is explained.

    Attributes:
        drawn: (h, w) the board as it should look; around it, the image.
        rest: (h, w) image less drawn, `MAGNIFIED` times about `MIDDLE`.
        rest_rms: Rms of what is not explained, on the board [grey levels].
    """

    drawn: Image
    rest: Image
    rest_rms: float


def explain(
    image: Image,
    target: Target,
    ids: IntArray,
    px: FloatArray,
    camera: Camera,
    blur: Blur,
    tone: float,
) -> DenseImage | None:
    """Draws the board into an image.

    Args:
        image: (h, w) grey image.
        target: A checkerboard or a ChArUco board.
        ids: (n,) numbers of corners.
        px: (n, 2) where a calibration puts them [px].
        camera: Its camera.
        blur: The image's point-spread function.
        tone: q of `dense.fit`.

    Returns:
        What is explained and what is not; None where the corners do not determine it, or lie
        outside the image.
    """
    if len(ids) < _FEWEST or not np.isfinite(px).all():
        return None
    torch, printed, board = library("torch"), Print.of(target), board_places(target, ids)
    with ONE_TORCH_THREAD.held(), torch.inference_mode(), suppress(np.linalg.LinAlgError):
        on_board = map_of_all(board, normalise(camera, px))
        low, high = _part(px, board, image)
        margin = int(np.ceil(blur.reach_px)) + 1
        fine = 2 if np.prod(high - low) <= _MOST_FINE else 1
        u, v = (
            np.arange(fine * (b - a + 2 * margin)) / fine + a - margin
            for a, b in zip(low.tolist(), high.tolist(), strict=True)
        )
        x, y = _over(u, v, lambda at: on_board(normalise(camera, at)))
        light = _blurred(printed, x, y, blur, fine)
        inner = (slice(margin * fine, -margin * fine, fine),) * 2
        light, x, y = light[inner], x[inner], y[inner]
        part = image[low[1] : high[1], low[0] : high[0]].astype(float)
        toned = light + tone * light * (1.0 - light)
        on = _is_on(printed, x, y)
        if on.sum() < _FEWEST_LIT:
            return None
        model = _lit(part, toned, on)
        drawn, rest = image.copy(), np.full_like(image, MIDDLE)
        place = (slice(low[1], high[1]), slice(low[0], high[0]))
        drawn[place] = np.where(on, np.clip(np.rint(model), 0, 255), part).astype(np.uint8)
        off = np.where(on, MAGNIFIED * (part - model), 0.0) + MIDDLE
        rest[place] = np.clip(np.rint(off), 0, 255).astype(np.uint8)
        return DenseImage(drawn, rest, float(np.sqrt(np.mean((part - model)[on] ** 2))))
    return None


def _part(px: FloatArray, board: FloatArray, image: Image) -> tuple[IntArray, IntArray]:
    """Low and high corner of what is looked at [px]."""
    extent = np.ptp(px, axis=0) / np.maximum(np.ptp(board, axis=0).min(), 1.0)
    more = _RIM * float(extent.max()) + 2.0
    size = np.array(image.shape[::-1])
    low = np.clip(np.floor(px.min(axis=0) - more), 0, size - 1).astype(int)
    high = np.clip(np.ceil(px.max(axis=0) + more) + 1, low + 1, size).astype(int)
    return low, high


def _over(
    u: FloatArray, v: FloatArray, mapped: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """A smooth map (h, w) of all places u, v, by polynomials through some of its values."""
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    inverse = np.linalg.inv(chebvander(nodes, _NODES - 1))
    ends = [(array[0], array[-1]) for array in (u, v)]
    at_u, at_v = ((a + b + nodes * (b - a)) / 2 for a, b in ends)
    values = mapped(np.stack(np.meshgrid(at_u, at_v), axis=-1).reshape(-1, 2))
    values = values.reshape(_NODES, _NODES, 2)
    along_u, along_v = (
        chebvander((2 * array - a - b) / (b - a), _NODES - 1) @ inverse
        for array, (a, b) in zip((u, v), ends, strict=True)
    )
    x, y = (along_v @ values[..., axis] @ along_u.T for axis in (0, 1))
    return x, y


def _blurred(printed: Print, x: FloatArray, y: FloatArray, blur: Blur, fine: int) -> FloatArray:
    """The print at (h, w) places on the board, `fine` samples a pixel, blurred."""
    torch = library("torch")
    step = 1.0 / fine

    def tensor(array: FloatArray) -> "Tensor":
        return torch.as_tensor(array, dtype=torch.float32)

    widths = (
        tensor(DRAWN_PX * fine * np.hypot(*np.gradient(array)).clip(1e-6)) for array in (x, y)
    )
    drawn = printed.drawn(tensor(x), tensor(y), *widths)
    height, width = drawn.shape
    wu = 2 * np.pi * torch.fft.rfftfreq(width, step, dtype=torch.float64)
    wv = 2 * np.pi * torch.fft.fftfreq(height, step, dtype=torch.float64)
    otf = transfer(blur, wu, wv[:, None])[0].to(torch.float32)
    found = torch.fft.irfft2(torch.fft.rfft2(drawn) * otf, s=(height, width))
    return np.asarray(found.numpy(), float)


def _is_on(printed: Print, x: FloatArray, y: FloatArray) -> Mask:
    """Which places are on the print, or on a little of the paper around it."""
    rim = 0.2
    return np.asarray(
        (x > printed.x[0] - rim)
        & (x < printed.x[-1] + rim)
        & (y > printed.y[0] - rim)
        & (y < printed.y[-1] + rim)
    )


def _lit(part: FloatArray, toned: FloatArray, on: Mask) -> FloatArray:
    """The model in grey levels: offset and gain are quadratic surfaces over the image."""
    height, width = part.shape
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    columns = np.concatenate([terms, terms * toned[..., None]], axis=-1)
    chosen = np.flatnonzero(on)
    chosen = chosen[:: 1 + len(chosen) // _LIT_BY]
    rows = columns.reshape(-1, columns.shape[-1])[chosen]
    return np.asarray(columns @ np.linalg.lstsq(rows, part.ravel()[chosen], rcond=None)[0])

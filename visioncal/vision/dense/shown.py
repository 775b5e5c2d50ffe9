"""The board as printed, as calibration, blur and light have it in an image, and what is left."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from visioncal.core.types import Camera, FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.camera import normalise
from visioncal.vision.dense.blur import DRAWN_PX, Blur, transfer
from visioncal.vision.dense.library import ONE_TORCH_THREAD, library
from visioncal.vision.finders.maps import map_of_all
from visioncal.vision.targets import corner_positions, marked_squares, marker_cells

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
class Print:
    """A board as a grid of light and dark cells.

    Attributes:
        x: (c + 1,) lines along x, from the board's origin [squares].
        y: (r + 1,) lines along y.
        light: (r + 2, c + 2) which cells are light; around the board all are.
        inset: How far a light square's marker is from its edges [squares]; infinite without one.
    """

    x: FloatArray
    y: FloatArray
    light: Mask
    inset: float

    @classmethod
    def of(cls, target: Target) -> Self:
        """The print of a checkerboard or a ChArUco board."""
        if target.kind == "checkerboard":
            columns, rows = target.columns + 1, target.rows + 1
            light = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 1
            return cls(
                np.arange(columns + 1.0) - 1, np.arange(rows + 1.0) - 1, _paper(light), np.inf
            )
        share = target.marker_m / target.square_m
        inset = (1.0 - share) / 2
        side = len(marker_cells(target.dictionary, 0))
        cuts = np.concatenate([[0.0], inset + share * np.arange(side + 1) / side])
        light = np.zeros((target.rows * len(cuts), target.columns * len(cuts)), bool)
        for number, (column, row) in enumerate(marked_squares(target).tolist()):
            square = np.ones((len(cuts), len(cuts)), bool)
            square[1:-1, 1:-1] = ~marker_cells(target.dictionary, number)
            low_x, low_y = column * len(cuts), row * len(cuts)
            light[low_y : low_y + len(cuts), low_x : low_x + len(cuts)] = square
        x, y = (
            np.append(np.add.outer(np.arange(count), cuts).ravel(), count)
            for count in (target.columns, target.rows)
        )
        return cls(x, y, _paper(light), inset)

    def light_at(self, places: FloatArray) -> Mask:
        """(n,) which of (n, 2) places [squares] lie on light cells."""
        column = np.searchsorted(self.x, places[:, 0])
        row = np.searchsorted(self.y, places[:, 1])
        return np.asarray(self.light[row, column])

    def drawn(self, x: "Tensor", y: "Tensor", sigma_x: "Tensor", sigma_y: "Tensor") -> "Tensor":
        """Draws the print: 1 where it is light, 0 where dark, edges as of a Gaussian.

        Args:
            x: (...) places on the board [squares].
            y: Likewise.
            sigma_x: Widths of edges across the lines of constant x [squares].
            sigma_y: Likewise.
        """
        torch = library("torch")
        light = torch.as_tensor(self.light, dtype=x.dtype, device=x.device)
        (at_x, beyond_x), (at_y, beyond_y) = (
            _nearest(torch.as_tensor(lines, dtype=x.dtype, device=x.device), at, sigma)
            for lines, at, sigma in ((self.x, x, sigma_x), (self.y, y, sigma_y))
        )
        upper = torch.lerp(light[at_y, at_x], light[at_y, at_x + 1], beyond_x)
        lower = torch.lerp(light[at_y + 1, at_x], light[at_y + 1, at_x + 1], beyond_x)
        return torch.lerp(upper, lower, beyond_y)


def _paper(light: Mask) -> Mask:
    return np.pad(light, 1, constant_values=True)


def _nearest(lines: "Tensor", at: "Tensor", sigma: "Tensor") -> "tuple[Tensor, Tensor]":
    """The line next to each place, and the share of a Gaussian there that lies beyond it."""
    torch = library("torch")
    near = torch.bucketize(at.contiguous(), (lines[1:] + lines[:-1]) / 2)
    return near, torch.special.ndtr((at - lines[near]) / sigma)


def board_places(target: Target, ids: IntArray) -> FloatArray:
    """(n, 2) corners on the board [squares]."""
    return np.asarray(corner_positions(target)[ids, :2] / target.square_m)


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

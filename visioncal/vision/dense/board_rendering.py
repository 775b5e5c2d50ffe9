"""Rendering of a board into an image from calibration, blur and light, and the difference."""

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

# Magnification of the difference image, and its grey level for zero.
MAGNIFIED, MIDDLE = 4, 128
# Rim around the outermost corners [squares].
_RIM = 1.0
# Nodes per side of the polynomial that interpolates a map.
_NODES = 14
# Least and approximate largest number of pixels for the fit of light.
_FEWEST_LIT, _LIT_BY = 100, 50_000
# Largest number of pixels that are rendered with two samples each.
_MOST_FINE = 1_500_000
_FEWEST = 6


@dataclass(frozen=True, eq=False)
class Print:
    """A board as a grid of light and dark cells.

    Attributes:
        x: (c + 1,) grid lines along x, from the board's origin [squares].
        y: (r + 1,) grid lines along y.
        light: (r + 2, c + 2) mask of light cells, with light paper around the board.
        inset: Margin of a light square around its marker [squares]; infinite without markers.
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
        """(n,) mask of (n, 2) positions [squares] on light cells."""
        column = np.searchsorted(self.x, places[:, 0])
        row = np.searchsorted(self.y, places[:, 1])
        return np.asarray(self.light[row, column])

    def drawn(self, x: "Tensor", y: "Tensor", sigma_x: "Tensor", sigma_y: "Tensor") -> "Tensor":
        """Renders the print at (...) positions [squares]: 1 for light, 0 for dark.

        Edges are Gaussian, with widths across the lines of constant x and of constant y [squares].
        """
        torch = library("torch")
        light = torch.as_tensor(self.light, dtype=x.dtype, device=x.device)
        (column, beyond_x), (row, beyond_y) = (
            _nearest(torch.as_tensor(lines, dtype=x.dtype, device=x.device), at, sigma)
            for lines, at, sigma in ((self.x, x, sigma_x), (self.y, y, sigma_y))
        )
        upper = torch.lerp(light[row, column], light[row, column + 1], beyond_x)
        lower = torch.lerp(light[row + 1, column], light[row + 1, column + 1], beyond_x)
        return torch.lerp(upper, lower, beyond_y)


def _paper(light: Mask) -> Mask:
    return np.pad(light, 1, constant_values=True)


def _nearest(lines: "Tensor", positions: "Tensor", sigma: "Tensor") -> "tuple[Tensor, Tensor]":
    """Index of the nearest line, and the share of the Gaussian beyond it."""
    torch = library("torch")
    index = torch.bucketize(positions.contiguous(), (lines[1:] + lines[:-1]) / 2)
    return index, torch.special.ndtr((positions - lines[index]) / sigma)


def board_positions(target: Target, ids: IntArray) -> FloatArray:
    """(n, 2) corner positions on the board [squares]."""
    return np.asarray(corner_positions(target)[ids, :2] / target.square_m)


@dataclass(frozen=True, eq=False)
class DenseImage:
    """A rendered image and its difference from the actual one.

    Attributes:
        rendered: (h, w) the rendered board within the image.
        difference: (h, w) image less rendering, magnified by `MAGNIFIED` about `MIDDLE`.
        difference_rms: Rms difference on the board [grey levels].
    """

    rendered: Image
    difference: Image
    difference_rms: float


def render_board(
    image: Image,
    target: Target,
    ids: IntArray,
    px: FloatArray,
    camera: Camera,
    blur: Blur,
    tone: float,
) -> DenseImage | None:
    """Renders the board into an image.

    Args:
        image: (h, w) grey image.
        target: A checkerboard or a ChArUco board.
        ids: (n,) corner ids.
        px: (n, 2) corners predicted by a calibration [px].
        camera: Camera model.
        blur: Point-spread function of the image.
        tone: Tone q of `dense.fit`.

    Returns:
        Rendering and difference; None if the corners do not determine them, or lie outside the
        image.
    """
    if len(ids) < _FEWEST or not np.isfinite(px).all():
        return None
    torch, printed, board = library("torch"), Print.of(target), board_positions(target, ids)
    with ONE_TORCH_THREAD.held(), torch.inference_mode(), suppress(np.linalg.LinAlgError):
        on_board = map_of_all(board, normalise(camera, px))
        low, high = _region(px, board, image)
        margin = int(np.ceil(blur.reach_px)) + 1
        fine = 2 if np.prod(high - low) <= _MOST_FINE else 1
        u, v = (
            np.arange(fine * (b - a + 2 * margin)) / fine + a - margin
            for a, b in zip(low.tolist(), high.tolist(), strict=True)
        )
        x, y = _interpolated_map(u, v, lambda at: on_board(normalise(camera, at)))
        light = _blurred(printed, x, y, blur, fine)
        inner = (slice(margin * fine, -margin * fine, fine),) * 2
        light, x, y = light[inner], x[inner], y[inner]
        part = image[low[1] : high[1], low[0] : high[0]].astype(float)
        toned = light + tone * light * (1.0 - light)
        on_board_mask = _on_print(printed, x, y)
        if on_board_mask.sum() < _FEWEST_LIT:
            return None
        model = _with_light(part, toned, on_board_mask)
        drawn, rest = image.copy(), np.full_like(image, MIDDLE)
        region = (slice(low[1], high[1]), slice(low[0], high[0]))
        drawn[region] = np.where(on_board_mask, np.clip(np.rint(model), 0, 255), part).astype(
            np.uint8
        )
        difference = np.where(on_board_mask, MAGNIFIED * (part - model), 0.0) + MIDDLE
        rest[region] = np.clip(np.rint(difference), 0, 255).astype(np.uint8)
        return DenseImage(drawn, rest, float(np.sqrt(np.mean((part - model)[on_board_mask] ** 2))))
    return None


def _region(px: FloatArray, board: FloatArray, image: Image) -> tuple[IntArray, IntArray]:
    extent = np.ptp(px, axis=0) / np.maximum(np.ptp(board, axis=0).min(), 1.0)
    margin = _RIM * float(extent.max()) + 2.0
    size = np.array(image.shape[::-1])
    low = np.clip(np.floor(px.min(axis=0) - margin), 0, size - 1).astype(int)
    high = np.clip(np.ceil(px.max(axis=0) + margin) + 1, low + 1, size).astype(int)
    return low, high


def _interpolated_map(
    u: FloatArray, v: FloatArray, board_map: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Values (h, w) of a smooth map on the grid u, v, by polynomial interpolation."""
    nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    inverse = np.linalg.inv(chebvander(nodes, _NODES - 1))
    bounds = [(array[0], array[-1]) for array in (u, v)]
    u_nodes, v_nodes = ((a + b + nodes * (b - a)) / 2 for a, b in bounds)
    values = board_map(np.stack(np.meshgrid(u_nodes, v_nodes), axis=-1).reshape(-1, 2))
    values = values.reshape(_NODES, _NODES, 2)
    along_u, along_v = (
        chebvander((2 * array - a - b) / (b - a), _NODES - 1) @ inverse
        for array, (a, b) in zip((u, v), bounds, strict=True)
    )
    x, y = (along_v @ values[..., axis] @ along_u.T for axis in (0, 1))
    return x, y


def _blurred(printed: Print, x: FloatArray, y: FloatArray, blur: Blur, fine: int) -> FloatArray:
    """The print at (h, w) positions on the board, `fine` samples per pixel, blurred."""
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
    blurred = torch.fft.irfft2(torch.fft.rfft2(drawn) * otf, s=(height, width))
    return np.asarray(blurred.numpy(), float)


def _on_print(printed: Print, x: FloatArray, y: FloatArray) -> Mask:
    """Mask of positions on the print or on a narrow rim of paper."""
    rim = 0.2
    return np.asarray(
        (x > printed.x[0] - rim)
        & (x < printed.x[-1] + rim)
        & (y > printed.y[0] - rim)
        & (y < printed.y[-1] + rim)
    )


def _with_light(part: FloatArray, toned: FloatArray, mask: Mask) -> FloatArray:
    """The rendering in grey levels, with offset and gain as quadratic surfaces over the image."""
    height, width = part.shape
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    columns = np.concatenate([terms, terms * toned[..., None]], axis=-1)
    chosen = np.flatnonzero(mask)
    chosen = chosen[:: 1 + len(chosen) // _LIT_BY]
    rows = columns.reshape(-1, columns.shape[-1])[chosen]
    return np.asarray(columns @ np.linalg.lstsq(rows, part.ravel()[chosen], rcond=None)[0])

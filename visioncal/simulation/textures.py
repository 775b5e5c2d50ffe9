"""Textures of a simulated scene: the printed sheet on its plate, a table-top and a wall."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Image, Mask, Target
from visioncal.simulation.boards import circles_m, pattern_box, tags_m, unit_m

_Canvas: TypeAlias = npt.NDArray[np.float32]

_INK, _PAPER, _PLATE = 30, 222, 152
# Margins around the print in sides of a square: white paper, its plate, the plate's shadow.
_PAPER_MARGIN, _PLATE_MARGIN, _SHADOW_MARGIN = 0.55, 0.85, 1.35
_SHADOW_STRENGTH = 0.7


@dataclass(frozen=True, eq=False)
class SheetTexture:
    """Frontal image of the sheet at halving resolutions."""

    # (2,) outer corner of texel (0, 0) in the flat, unscaled target frame [m].
    origin_m: FloatArray
    texel_m: tuple[float, ...]  # Side of a texel at each level [m], ascending.
    # (h, w, 2) images at each level: brightness times coverage, and coverage. Where coverage is
    # partial, the background shows through.
    levels: tuple[Image, ...]


def draw_sheet(target: Target, texels: int) -> SheetTexture:
    """Draws a target on its plate.

    Args:
        target: The target.
        texels: Texels along a square at the finest level, a power of two.

    Raises:
        DataError: OpenCV does not have the target's dictionary.
    """
    left, top, right, bottom = pattern_box(target)
    # Whole squares for most boards; a remaining part of a texel stays white.
    width, height = (
        math.ceil(round((b - a) / unit_m(target) * texels, 6))
        for a, b in ((left, right), (top, bottom))
    )
    margin = 2 * int(np.ceil(0.5 * _SHADOW_MARGIN * texels))
    grey = np.full((height + 2 * margin, width + 2 * margin), _PLATE, np.uint8)
    paper = margin - round(_PAPER_MARGIN * texels)
    grey[paper:-paper, paper:-paper] = _PAPER
    grey[margin:-margin, margin:-margin] = _print(target, (height, width), texels)
    # A small grey description of the print in the strip below it.
    square_mm, scale = f"{1000.0 * unit_m(target):g} mm", texels / 160.0
    words = f"{target.kind} {target.columns}x{target.rows}, {square_mm} {target.dictionary}"
    at, thickness = (int(0.1 * texels), int(0.42 * texels)), max(round(1.2 * scale), 1)
    font, strip = cv2.FONT_HERSHEY_SIMPLEX, grey[-margin:-paper, margin:-margin]
    cv2.putText(strip, words, at, font, 0.8 * scale, 110.0, thickness, cv2.LINE_AA)
    plate = margin - round(_PLATE_MARGIN * texels)
    # Coverage: 255 on the plate, fading in the shadow around it, which is computed at low
    # resolution, as it is smooth.
    factor = max(texels // 16, 1)
    small = np.zeros((-(-grey.shape[0] // factor), -(-grey.shape[1] // factor)), np.float32)
    inner = plate // factor
    small[inner:-inner, inner:-inner] = 255.0 * _SHADOW_STRENGTH
    soft = cv2.GaussianBlur(small, (0, 0), 0.16 * texels / factor)
    coverage = np.asarray(cv2.resize(soft, (grey.shape[1], grey.shape[0])), np.uint8)
    coverage[plate:-plate, plate:-plate] = 255
    grey[coverage < 255] = 0
    levels = [np.stack([grey, coverage], axis=-1)]
    while levels[-1].shape[0] > 128:
        height, width = levels[-1].shape[:2]
        # Odd rows and columns at the shadow's end are dropped, so that levels halve exactly.
        even = levels[-1][: height // 2 * 2, : width // 2 * 2]
        levels.append(
            np.asarray(
                cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8
            )
        )
    finest = unit_m(target) / texels
    return SheetTexture(
        origin_m=np.array([left, top]) - margin * finest,
        texel_m=tuple(finest * 2.0**level for level in range(len(levels))),
        levels=tuple(levels),
    )


def margin_m(target: Target) -> float:
    """Width of the drawn sheet and its shadow beyond the print [m]."""
    return _SHADOW_MARGIN * unit_m(target)


def draw_table(rng: np.random.Generator, size: int) -> Image:
    """Draws a used table-top, (size, size), periodic in both directions.

    It has brushed grain, stains, scratches and a few small parts, all of low contrast.
    """
    grain = _smooth_noise(rng, size, 60.0, 0.7)
    mottling = _smooth_noise(rng, size, 40.0, 40.0)
    canvas = np.asarray(134.0 + 4.0 * grain + 6.0 * mottling, np.float32)
    for _ in range(14):
        start = rng.uniform(0.1, 0.9, 2) * size
        end = np.clip(start + rng.normal(0.0, 0.12, 2) * size, 0.03 * size, 0.97 * size)
        layer = np.zeros_like(canvas)
        cv2.line(layer, _point(start), _point(end), float(rng.uniform(-9.0, 12.0)), 1)
        part = _around(layer, 8)
        canvas[part] += cv2.GaussianBlur(layer[part], (0, 0), 0.8)
    for _ in range(9):
        _draw_part(canvas, rng)
    return np.asarray(np.clip(canvas, 0.0, 255.0), np.uint8)


def draw_wall(rng: np.random.Generator, size: int) -> Image:
    """Draws a periodic wall, far out of focus, with cabinets and doors."""
    canvas = np.asarray(118.0 + 7.0 * _smooth_noise(rng, size, 80.0, 80.0), np.float32)
    for _ in range(16):
        x, y = rng.uniform(0.04, 0.9, 2) * size
        wide, high = rng.uniform(0.03, 0.2, 2) * size
        corner = (int(min(x + wide, 0.96 * size)), int(min(y + high, 0.96 * size)))
        cv2.rectangle(canvas, (int(x), int(y)), corner, float(rng.uniform(70.0, 165.0)), -1)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), 0.008 * size), np.uint8)


def _print(target: Target, shape: tuple[int, int], texels: int) -> Image:
    """The print, of `shape` texels down and across."""
    if target.kind == "marker":
        return _marker(target, target.marker_id, texels)
    if target.kind == "aprilgrid":
        return _inked(_aprilgrid(target, shape, texels))
    if target.kind == "points":
        return _inked(_tags(target, shape, texels))
    if target.kind == "circles":
        return _inked(_circles(target, shape, texels))
    rows, columns = (index // texels for index in shape)
    row, column = np.mgrid[:rows, :columns]
    # OpenCV's layout before 4.6 starts with a white square for an even number of rows.
    shift = int(target.kind == "charuco" and target.legacy and rows % 2 == 0)
    white = (row + column + shift) % 2 == 1
    image = np.kron(np.where(white, _PAPER, _INK), np.ones((texels, texels))).astype(np.uint8)
    if target.kind == "checkerboard":
        return image
    # An even inset centres the marker in its square.
    inset = round(0.5 * (1.0 - target.marker_m / target.square_m) * texels)
    for number, (row_at, column_at) in enumerate(np.argwhere(white)):
        y, x = row_at * texels + inset, column_at * texels + inset
        side = max(texels - 2 * inset, 1)
        image[y : y + side, x : x + side] = _marker(target, number, side)
    return image


def _inked(dark: FloatArray) -> Image:
    """Grey levels from the dark share (h, w) of each texel."""
    return np.asarray(np.rint(_PAPER + (_INK - _PAPER) * dark), np.uint8)


def _aprilgrid(target: Target, shape: tuple[int, int], texels: int) -> FloatArray:
    """Dark share (h, w) of each texel."""
    dark = np.zeros(shape)
    gap = target.spacing * texels
    for number, corner in tags_m(target):
        bits = _modules(target, number)[1:-1, 1:-1] == 0
        cells = np.pad(bits[::-1, ::-1], target.border, constant_values=True)
        _stamp(dark, cells, gap + corner / target.square_m * texels, texels / len(cells))
    for x in range(target.columns + 1):
        for y in range(target.rows + 1):
            place = (texels + gap) * np.array([x, y], dtype=float)
            _stamp(dark, np.ones((1, 1), bool), place, gap)
    return dark


def _tags(target: Target, shape: tuple[int, int], texels: int) -> FloatArray:
    """Likewise for upright free tags, with four points each from the upper left corner."""
    dark = np.zeros(shape)
    scale = texels / unit_m(target)
    low = np.array(pattern_box(target)[:2])
    for first in range(0, len(target.points_m), 4):
        corner, neighbour = (np.array(target.points_m[first + offset])[:2] for offset in (0, 1))
        cells = _modules(target, target.point_tags[first][0]) == 0
        _stamp(dark, cells, scale * (corner - low), scale * (neighbour - corner)[0] / len(cells))
    return dark


def _circles(target: Target, shape: tuple[int, int], texels: int) -> FloatArray:
    """Dark share (h, w) of each texel, with circles' edges straight within a texel."""
    dark = np.zeros(shape)
    radius = 0.5 * target.diameter_m / target.square_m * texels
    for centre in radius + circles_m(target) / target.square_m * texels:
        low, high = (np.clip(centre + value, 0, shape[::-1]) for value in (-radius - 1, radius + 2))
        (left, top), (right, bottom) = low.astype(int), high.astype(int)
        x, y = np.arange(left, right) + 0.5 - centre[0], np.arange(top, bottom) + 0.5 - centre[1]
        inside = np.clip(radius - np.hypot(x[None], y[:, None]) + 0.5, 0.0, 1.0)
        window = dark[top:bottom, left:right]
        np.maximum(window, inside, out=window)
    return dark


def _stamp(dark: FloatArray, cells: Mask, corner: FloatArray, cell: float) -> None:
    """Adds the dark area of a grid of cells that starts at `corner` [texels]."""
    row_overlaps, column_overlaps = (
        _overlaps(start, cell, cells.shape[axis], dark.shape[axis])
        for axis, start in enumerate(corner[::-1].tolist())
    )
    rows, columns = (
        slice(pair[0], pair[0] + pair[1].shape[1]) for pair in (row_overlaps, column_overlaps)
    )
    dark[rows, columns] += row_overlaps[1].T @ cells @ column_overlaps[1]


def _overlaps(start: float, cell: float, count: int, texels: int) -> tuple[int, FloatArray]:
    """First texel that a row of cells touches, and (cells, texels) overlaps."""
    edges = start + cell * np.arange(count + 1)
    first, end = math.floor(edges[0]), min(math.ceil(edges[-1]), texels)
    texel = np.arange(first, end)
    low, high = (np.clip(texel[None] + side, edges[:-1, None], edges[1:, None]) for side in (0, 1))
    return first, high - low


def _modules(target: Target, number: int) -> Image:
    """Modules of a marker with a border of one; light ones are above zero."""
    if not hasattr(cv2.aruco, target.dictionary):
        raise DataError(f"simulation: OpenCV has no dictionary {target.dictionary!r}.")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    return np.asarray(dictionary.generateImageMarker(number, dictionary.markerSize + 2), np.uint8)


def _marker(target: Target, number: int, side: int) -> Image:
    modules = _modules(target, number)
    # Edges between modules are rounded to texels; they are no corners of a target.
    bits = cv2.resize(modules, (side, side), interpolation=cv2.INTER_NEAREST)
    return np.where(bits > 0, _PAPER, _INK).astype(np.uint8)


def _smooth_noise(
    rng: np.random.Generator, size: int, sigma_x: float, sigma_y: float
) -> FloatArray:
    """Unit-variance noise with Gaussian smoothing [texels], periodic in both directions."""
    frequency = 2.0 * np.pi * np.fft.rfftfreq(size)
    frequency_y = 2.0 * np.pi * np.fft.fftfreq(size)
    damping = np.exp(
        -0.5 * ((sigma_x * frequency)[None, :] ** 2 + (sigma_y * frequency_y)[:, None] ** 2)
    )
    damping[0, 0] = 0.0
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * damping, (size, size))
    return np.asarray(noise / noise.std())


def _draw_part(canvas: _Canvas, rng: np.random.Generator) -> None:
    """Draws a washer, a bar or a cable, with a soft shadow beside it."""
    size = canvas.shape[0]
    centre = rng.uniform(0.15, 0.85, 2) * size
    shape = np.zeros_like(canvas)
    kind = rng.integers(3)
    if kind == 0:
        radius = int(rng.uniform(0.008, 0.018) * size)
        cv2.circle(shape, _point(centre), radius, 1.0, -1)
        cv2.circle(shape, _point(centre), radius // 2, 0.0, -1)
    elif kind == 1:
        half = rng.uniform(0.01, 0.05, 2) * size
        box = cv2.boxPoints((centre.tolist(), (2.0 * half).tolist(), float(rng.uniform(0, 180))))
        cv2.fillPoly(shape, [np.round(box).astype(np.int32)], 1.0)
    else:
        steps = np.cumsum(rng.normal(0.0, 0.025, (8, 2)), axis=0) * size
        path = cv2.GaussianBlur(centre + steps, (1, 5), 1.5)
        curve = np.clip(path, 0.03 * size, 0.97 * size).round().astype(np.int32)
        cv2.polylines(shape, [curve], False, 1.0, max(size // 180, 1))
    # A shadow extends beyond a part by its shift and four sigmas.
    part = _around(shape, size // 24)
    shape, under = shape[part], canvas[part]
    shape = np.asarray(cv2.GaussianBlur(shape, (0, 0), 0.6), np.float32)
    shadow = cv2.GaussianBlur(np.roll(shape, size // 160, (0, 1)), (0, 0), 0.006 * size)
    under *= 1.0 - 0.3 * shadow
    under += shape * (float(rng.uniform(70.0, 150.0)) - under) * 0.8


def _around(layer: _Canvas, margin: int) -> tuple[slice, slice]:
    """Rows and columns of a layer's content, with a margin [texels]."""
    rows, columns = (np.flatnonzero(layer.any(axis=axis)) for axis in (1, 0))
    row_range, column_range = (
        slice(max(int(array[0]) - margin, 0), int(array[-1]) + margin + 1)
        for array in (rows, columns)
    )
    return row_range, column_range


def _point(place: FloatArray) -> tuple[int, int]:
    return int(place[0]), int(place[1])

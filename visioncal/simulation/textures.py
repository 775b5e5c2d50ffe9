"""Textures of a simulated scene: the printed sheet on its plate, and what is behind it."""

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.types import FloatArray, Image, Target
from visioncal.simulation.boards import unit_m
from visioncal.vision.printing.pattern import light_of
from visioncal.vision.targets import extent_m

Float32Array: TypeAlias = npt.NDArray[np.float32]

_INK, _PAPER, _PLATE = 30, 222, 152  # Grey levels.
# Margin around the print with its shadow, in sides of a square.
_SHADOW_MARGIN = 1.35


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
        DataError: The target is a rig of points that cannot be printed.
    """
    low, high = extent_m(target)
    finest = unit_m(target) / texels
    # Whole squares for most boards; a remaining part of a texel stays white.
    width, height = np.ceil(np.round((high - low) / finest, 6)).astype(int).tolist()
    margin = 2 * int(np.ceil(0.5 * _SHADOW_MARGIN * texels))
    grey = np.full((height + 2 * margin, width + 2 * margin), _PLATE, np.uint8)
    # White paper and its plate around the print, in sides of a square.
    paper = margin - round(0.55 * texels)
    grey[paper:-paper, paper:-paper] = _PAPER
    light = light_of(target, low, finest, (height, width))
    grey[margin:-margin, margin:-margin] = np.rint(_INK + (_PAPER - _INK) * light)
    plate = margin - round(0.85 * texels)
    # Coverage: 255 on the plate, fading in the shadow around it, which is computed at low
    # resolution, as it is smooth.
    factor = max(texels // 16, 1)
    small = np.zeros((-(-grey.shape[0] // factor), -(-grey.shape[1] // factor)), np.float32)
    inner = plate // factor
    small[inner:-inner, inner:-inner] = 0.7 * 255.0
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
    return SheetTexture(
        origin_m=low - margin * finest,
        texel_m=tuple(finest * 2.0**level for level in range(len(levels))),
        levels=tuple(levels),
    )


def margin_m(target: Target) -> float:
    """Width of the drawn sheet and its shadow beyond the print [m]."""
    return _SHADOW_MARGIN * unit_m(target)


def draw_backdrop(rng: np.random.Generator, size: int, blur: float) -> Image:
    """Draws a surface with things on it, (size, size), periodic in both directions.

    All is of low contrast, and out of focus by a Gaussian's sigma `blur` [texels].
    """
    frequency = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    damping = np.exp(-0.5 * (2.0 * np.pi * 40.0 * np.hypot(*frequency)) ** 2)
    damping[0, 0] = 0.0
    mottling = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * damping)
    canvas = np.asarray(130.0 + 7.0 * mottling / mottling.std(), np.float32)
    for _ in range(24):
        place, half = rng.uniform(0.1, 0.9, 2) * size, rng.uniform(0.005, 0.08, 2) * size
        box = cv2.boxPoints((place.tolist(), (2.0 * half).tolist(), float(rng.uniform(0, 180))))
        cv2.fillPoly(canvas, [np.round(box).astype(np.int32)], float(rng.uniform(70.0, 165.0)))
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), blur), np.uint8)

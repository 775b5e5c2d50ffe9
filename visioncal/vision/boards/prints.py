"""Prints under blur: grey values about corners and circles, with their derivatives."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from visioncal.core.types import FloatArray

Float32Array: TypeAlias = npt.NDArray[np.float32]
# Smaller exponents count as minus infinity: single precision would have denormal numbers there,
# which are a hundred times slower and negligible.
_MIN_EXPONENT = np.float32(-80.0)


@dataclass(frozen=True, eq=False)
class Print:
    """The print around n corners."""

    # (n,) colour of the squares where x y > 0: one sign for light. On a checkerboard, which may be
    # described rotated, either sign may be light; on an AprilGrid one sign stands for dark.
    signs: FloatArray
    # Margin of a light square around its marker, or of a tag around its bits [squares]; infinite
    # without them.
    inset: float
    half: float = 0.42  # Half-width of the patch around a corner [squares].
    radii: FloatArray | None = None  # (n,) radii of circles [squares]; None without circles.
    # (n, 2) signs of x and y on the dark square of a lone tag's corner; None where two dark squares
    # meet.
    lone: FloatArray | None = None
    outside: float = np.inf  # Width of the white around a lone tag [squares].
    # Distance of pixels from a marker, or from the surroundings of a lone tag's white [edge
    # widths].
    clear: float = 1.5
    # (n, 2, 2) from the board to each corner's own axes and units; None if these are the board's.
    axes: FloatArray | None = None


def crossing(
    pattern: Print,
    x: Float32Array,
    y: Float32Array,
    sx: Float32Array,
    sy: Float32Array,
    *,
    blurs: bool,
    wide: bool,
) -> tuple[Float32Array, ...]:
    """Product of two crossing edges, and its derivatives."""
    # Derivatives are with respect to x, y and, with `blurs`, the logarithms of the widths.
    signs = np.asarray(pattern.signs, np.float32)[:, None, None]
    edge_x, slope_x, *width_x = _edges(x, sx, blurs=blurs, wide=wide)
    edge_y, slope_y, *width_y = _edges(y, sy, blurs=blurs, wide=wide)
    if pattern.lone is not None:
        lone_x, lone_y = np.asarray(pattern.lone.T, np.float32)[:, :, None, None]
        edge_x, edge_y = edge_x + lone_x, edge_y + lone_y
    edge_x *= signs
    return (
        edge_x * edge_y,
        np.multiply(signs * slope_x, edge_y),
        edge_x * slope_y,
        *(signs * array * edge_y for array in width_x),
        *(edge_x * array for array in width_y),
    )


def circle(
    pattern: Print, x: Float32Array, y: Float32Array, sx: Float32Array, sy: Float32Array
) -> tuple[Float32Array, ...]:
    """A disc, likewise; its last derivative is with respect to the radius."""
    distance = np.hypot(x, y) + np.float32(1e-6)
    part_x, part_y = (sx * x / distance) ** 2, (sy * y / distance) ** 2
    width = np.sqrt(part_x + part_y)
    depth = np.asarray(pattern.radii, np.float32)[:, None, None] - distance
    edge, slope, width_derivative = _edges(depth, width, blurs=True, wide=False)
    inward = -slope / distance
    by_width = width_derivative / (part_x + part_y)
    return edge, inward * x, inward * y, by_width * part_x, by_width * part_y, slope


def _edges(
    positions: Float32Array, sigma: Float32Array, *, blurs: bool, wide: bool
) -> tuple[Float32Array, ...]:
    """E of `template`, its derivative by position, and with `blurs` by the logarithm of sigma."""
    sums = _edge(positions / sigma, sigma, blurs=blurs)
    for line in (-1, 1) if wide else ():
        neighbour = _edge((positions - np.float32(line)) / sigma, sigma, blurs=blurs)
        for total, part in zip(sums, neighbour, strict=True):
            np.subtract(total, part, out=total)
    return sums


def _edge(t: Float32Array, sigma: Float32Array, *, blurs: bool) -> tuple[Float32Array, ...]:
    """Contribution of one line to `_edges`."""
    gaussian = np.float32(-0.5) * t
    gaussian *= t
    np.copyto(gaussian, -np.inf, where=gaussian < _MIN_EXPONENT)
    np.exp(gaussian, out=gaussian)
    edge = _erf(t, gaussian)
    gaussian *= np.float32(np.sqrt(2.0 / np.pi))
    if not blurs:
        gaussian /= sigma
        return edge, gaussian
    return edge, gaussian / sigma, -t * gaussian


def _erf(t: Float32Array, gaussian: Float32Array) -> Float32Array:
    """erf(t / sqrt 2), given exp(-t^2 / 2), to 2e-7 (Abramowitz and Stegun 7.1.26)."""
    # Five times as fast as scipy's, which is not vectorised.
    u = np.abs(t)
    u *= np.float32(0.3275911 / np.sqrt(2.0))
    u += 1
    np.reciprocal(u, out=u)
    total = np.float32(1.061405429) * u
    for factor in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        total += np.float32(factor)
        total *= u
    total *= gaussian
    np.subtract(1, total, out=total)
    return np.copysign(total, t, out=total)

"""Corners of a board in a blurred image that the template refuses, by a fit to all its pixels.

The image of a board is its print, seen through a homography and a radial lens, convolved with the
image's point-spread function, times the light:

    grey(p) = o(p) + g(p) (L * h)(p),   h^(w) = exp(-|w|^2 s^2 / 2) sinc(w . m / 2),

with L the print, s the Gaussian of lens and defocus, m the motion during the exposure, and o and g
linear over the image. Nonlinear least squares fit all unknowns. A corner's own position
is its shift against that model, by the pixels half way to the next corners: patches share no pixel,
so that corners are independent, and a lens bent in another way biases none. A convolution that is
even, as one with the disc of defocus, moves no corner.

Images are reduced until a square has about 16 px: a blur of such a share of a square leaves nothing
finer. The start is the detector's corners where it has enough, or else a search for the grid in
reduced copies, where even the markers of a ChArUco board are blurred to grey squares.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.boards import DetectedCorners, find_target, kind_of
from visioncal.vision.targets import corner_positions, extent_m

# Side of a square that images are reduced to [px], and texels per square: a texel is half a pixel.
_SQUARE_PX, _TEXELS = 16.0, 32
# Blur of the print before it is sampled once a pixel; narrower edges would alias [px].
_DRAWN_PX = 0.5
_EDGE = cv2.BORDER_REPLICATE
# White paper around the print, and how much of it is fitted [squares].
_PAPER, _RIM = 2, 0.25
# A corner's contrast relative to the model's, its largest shift [squares], and the largest variance
# of its pixels over the median: elsewhere, something else is in the image.
_CONTRAST, _MOST_SHIFT, _MOST_VARIANCE = (0.5, 2.0), 0.15, 4.0
# Searches for the grid: reduced side of the image, and sigma of the smoothing after it [px].
_SEARCHES = ((320, 0.0), (320, 1.5), (640, 0.0), (640, 2.0), (640, 3.0), (640, 6.0))


@dataclass(frozen=True, eq=False)
class DenseCorners:
    """Corners of one image, and what blurs it."""

    ids: IntArray  # (n,) corner ids, ascending.
    px: FloatArray  # (n, 2) positions [px].
    sigma_px: FloatArray  # (n,) standard deviation of a coordinate, from the residuals [px].
    blur_px: float  # Sigma of the Gaussian [px].
    # (2,) motion along u and v during the exposure; its sign is arbitrary [px].
    motion_px: FloatArray
    noise: float  # Standard deviation of a pixel of the reduced image [grey levels].

    @property
    def width_px(self) -> float:
        """Edge width as a Gaussian's sigma, across the widest edges [px]."""
        return float(np.sqrt(self.blur_px**2 + np.sum(self.motion_px**2) / 12))


def find_densely(image: Image, target: Target) -> DenseCorners | None:
    """Corners of a checkerboard or a ChArUco board, by all pixels of a (h, w) grey image.

    Returns:
        The corners; None where no start is found, or the board explains too little of the image.
    """
    for ids, px in _starts(image, target):
        board = corner_positions(target)[ids, :2] / target.square_m
        if all(np.linalg.matrix_rank(at - at.mean(axis=0)) == 2 for at in (board, px)):
            with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):
                found = _Fit.of(image, target, board, px).corners()
                if found is not None:
                    return found
    return None


def _starts(image: Image, target: Target) -> Iterator[tuple[IntArray, FloatArray]]:
    """Possible positions of corners, to a third of a square; the likeliest first."""
    seen = find_target(image, target)
    if isinstance(seen, DetectedCorners) and len(seen.ids) >= kind_of(target).fewest:
        yield seen.ids, seen.px
        return
    places = corner_positions(target)
    ids, columns = np.arange(len(places)), len(np.unique(places[:, 0]))
    for side_px, sigma_px in _SEARCHES:
        factor = max(1, round(max(image.shape) / side_px))
        small = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
        if sigma_px:
            small = cv2.GaussianBlur(small, (0, 0), sigma_px)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, px = cv2.findChessboardCornersSB(small, (columns, len(ids) // columns), flags=flags)
        if found:
            px = factor * np.asarray(px, float).reshape(-1, 2) + (factor - 1) / 2
            # The grid looks alike when turned by half a turn.
            yield from ((ids, px), (ids, px[::-1]))


@dataclass(frozen=True, eq=False)
class _Fit:
    """A part of a reduced image, and the print that is fitted to it.

    The parameters are the homography from normalised pixels to squares (8), the lens (1), s and m
    (3), and o and g with their slopes (6).
    """

    target: Target  # The board.
    factor: int  # By how much the image is reduced.
    image: FloatArray  # (h, w) the part; NaN outside the image.
    # (h, w, 2) pixels relative to the middle of the image, in half its diagonal.
    places: FloatArray
    unit_px: FloatArray  # (3,) middle and half the diagonal of the reduced image [px].
    texture: npt.NDArray[np.float32]  # The print, light being 1.
    start: FloatArray  # (8,) homography to start from.
    side_px: float  # Side of a square [px].

    @classmethod
    def of(cls, image: Image, target: Target, board: FloatArray, px: FloatArray) -> Self:
        """Reduces an image about (n, 2) places of a board [squares] at (n, 2) pixels."""
        flat = np.asarray(cv2.findHomography(board, px)[0], float)
        ends = board.mean(axis=0) + np.array([[[0.0, 0], [1, 0], [0, 1]]])
        ends = cv2.perspectiveTransform(ends, flat)[0]
        side_px = float(np.sqrt(abs(np.linalg.det(ends[1:] - ends[0]))))
        factor = max(1, round(side_px / _SQUARE_PX))
        size = np.array(image.shape[::-1]) // factor
        small = image[: factor * size[1], : factor * size[0]]
        small = small.reshape(size[1], factor, size[0], factor).mean(axis=(1, 3))
        outline = corner_positions(target)[:, :2] / target.square_m
        # The print ends a square beyond its corners; half a square more of paper blurs into it.
        ends = np.array([outline.min(axis=0) - 2.0, outline.max(axis=0) + 2.0])
        edges = np.array([[ends[i, 0], ends[j, 1]] for i in (0, 1) for j in (0, 1)])
        bounds = cv2.perspectiveTransform(edges[None], flat)[0] / factor
        low = np.floor(np.clip(bounds.min(axis=0), -side_px, size)).astype(int)
        high = np.ceil(np.clip(bounds.max(axis=0), 0, size + side_px)).astype(int)
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        inside = (u >= 0) & (v >= 0) & (u < size[0]) & (v < size[1])
        part = small[v.clip(0, size[1] - 1), u.clip(0, size[0] - 1)]
        unit = np.array([*(size - 1) / 2, np.linalg.norm(size) / 2])
        px = ((px - (factor - 1) / 2) / factor - unit[:2]) / unit[2]
        return cls(
            target,
            factor,
            np.where(inside, part, np.nan),
            (np.stack([u, v], axis=-1) - unit[:2]) / unit[2],
            unit,
            _texture(target, _DRAWN_PX * factor / side_px),
            np.asarray(cv2.findHomography(px, board)[0], float).ravel()[:8],
            side_px / factor,
        )

    def on_board(self, values: FloatArray) -> FloatArray:
        """(h, w, 2) places of all pixels on the board [squares]."""
        straight = self.places / (1 + values[8] * np.sum(self.places**2, axis=-1, keepdims=True))
        flat = np.append(values[:8], 1.0).reshape(3, 3)
        mapped = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1) @ flat.T
        return np.asarray(mapped[..., :2] / mapped[..., 2:])

    def blurred(self, values: FloatArray) -> FloatArray:
        """(h, w) the blurred print."""
        texels = (_TEXELS * (self.on_board(values) + 1 + _PAPER) - 0.5).astype(np.float32)
        drawn = np.asarray(
            cv2.remap(self.texture, texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, None, _EDGE)
        )
        height, width = drawn.shape
        wu = 2 * np.pi * np.fft.rfftfreq(width)
        wv = 2 * np.pi * np.fft.fftfreq(height)[:, None]
        gauss = np.exp(-0.5 * (wu**2 + wv**2) * values[9] ** 2)
        line = np.sinc((wu * values[10] + wv * values[11]) / (2 * np.pi))
        return (
            np.asarray(np.fft.irfft2(np.fft.rfft2(drawn - 1.0) * gauss * line, s=drawn.shape)) + 1
        )

    @cached_property
    def light(self) -> FloatArray:
        """(h, w, 3) terms of the light."""
        return np.concatenate([np.ones_like(self.places[..., :1]), self.places], axis=-1)

    def residuals(self, values: FloatArray, used: Mask) -> FloatArray:
        """(n,) model less image, at the used pixels [grey levels]."""
        gain, offset = self.light @ values[15:18], self.light @ values[12:15]
        return np.asarray((offset + gain * self.blurred(values) - self.image)[used])

    def used(self, values: FloatArray) -> Mask:
        """(h, w) mask of pixels of the board and a rim around it."""
        at = self.on_board(values)
        low, high = (end / self.target.square_m for end in extent_m(self.target))
        on_board = np.all((at > low - _RIM) & (at < high + _RIM), axis=-1)
        return np.asarray(on_board & np.isfinite(self.image))

    def starts(self, used: Mask) -> Iterator[tuple[float, FloatArray]]:
        """Parameters with blurs to begin from, and the best light for each, with their costs."""
        angles = np.pi / 6 * np.arange(6)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # Without motion its derivatives are zero.
        blurs = [(0.15, 0.1 * directions[0])]
        blurs += [(0.05, length * along) for length in (0.25, 0.5, 0.9) for along in directions]
        light = self.light[used]
        for sigma, motion in blurs:
            values = np.concatenate([self.start, [0.0], self.side_px * np.array([sigma, *motion])])
            terms = np.concatenate([light, light * self.blurred(values)[used][:, None]], axis=1)
            solved = np.linalg.lstsq(terms, self.image[used])[0]
            rest = self.image[used] - terms @ solved
            # Where dark is light, the board is turned or shifted by a square.
            yield float(rest @ rest) if solved[3] > 0.0 else np.inf, np.append(values, solved)

    def solved(self) -> tuple[FloatArray, float]:
        """The parameters that fit best, and the explained share of the board's variance."""
        used = self.used(np.append(self.start, np.zeros(10)))
        if used.sum() < kind_of(self.target).fewest * _SQUARE_PX**2 / 4:
            return self.start, 0.0
        cost, values = min(self.starts(used), key=lambda at: at[0])
        if not np.isfinite(cost):
            return values, 0.0
        # In proportion to the noise: the prior sigma of the relative radial distortion at the
        # image's corner, which some views leave open.
        weight = np.sqrt(cost / used.sum()) / 0.3

        def residuals(values: FloatArray) -> FloatArray:
            return np.append(self.residuals(values, used), weight * values[8])

        fit = least_squares(residuals, values, x_scale="jac", ftol=1e-5, max_nfev=40)
        explained = float(np.var(self.image[used]) * used.sum())
        return fit.x, 1.0 - float(np.sum(self.residuals(fit.x, used) ** 2)) / explained

    def corners(self) -> DenseCorners | None:
        """The corners; None where the board explains too little of the image."""
        values, explained = self.solved()
        # Another board explains at most 0.8, as its markers or its rim differ.
        if explained < 0.9:
            return None
        gain, board = self.light @ values[15:18], self.on_board(values)
        blurred = self.blurred(values)
        images = np.stack([blurred, *np.gradient(blurred)[::-1]])
        terms = np.concatenate([np.ones_like(gain)[None], gain * images])
        grey = self.image - self.light @ values[12:15]
        places = corner_positions(self.target)[:, :2] / self.target.square_m
        flat = np.linalg.inv(np.append(values[:8], 1.0).reshape(3, 3))
        straight = cv2.perspectiveTransform(places[None], flat)[0]
        bent = straight
        # A fixed point: distortion in the image is slight.
        for _ in range(50):
            bent = straight * (1 + values[8] * np.sum(bent**2, axis=1, keepdims=True))
        px = np.asarray(self.unit_px[:2] + self.unit_px[2] * bent)
        rows: list[tuple[int, FloatArray, float, float]] = []
        for number, (place, at) in enumerate(zip(places, px, strict=True)):
            patch = (np.abs(board - place) < 0.5).all(axis=-1)
            inside = patch & np.isfinite(grey)
            # A patch cut off by the image's edge is even about the corner no longer.
            if inside.sum() < max(30.0, 0.9 * patch.sum()):
                continue
            columns = terms[:, inside].T
            inverse = np.linalg.pinv(columns.T @ columns)
            solution = inverse @ (columns.T @ grey[inside])
            variance = np.mean((grey[inside] - columns @ solution) ** 2)
            variance *= len(columns) / (len(columns) - 4)
            contrast, shift = solution[1], -solution[2:] / solution[1]
            if (
                _CONTRAST[0] < contrast < _CONTRAST[1]
                and np.linalg.norm(shift) < _MOST_SHIFT * self.side_px
            ):
                sigma = np.sqrt(variance * np.trace(inverse[2:, 2:]) / 2) / contrast
                rows.append((number, at + shift, float(sigma), float(variance)))
        typical = np.median([row[3] for row in rows]) if rows else np.inf
        rows = [row for row in rows if row[3] < _MOST_VARIANCE * typical]
        if len(rows) < kind_of(self.target).fewest:
            return None
        ids, positions, sigmas, _ = (np.array(column) for column in zip(*rows, strict=True))
        sigma_px = np.sqrt(float(values[9]) ** 2 + _DRAWN_PX**2 - (1 - self.factor**-2) / 12)
        return DenseCorners(
            ids,
            self.factor * positions + (self.factor - 1) / 2,
            self.factor * sigmas,
            self.factor * float(sigma_px),
            self.factor * values[10:12],
            float(np.sqrt(typical)),
        )


def _texture(target: Target, blur: float) -> npt.NDArray[np.float32]:
    """The print with paper around it, light being 1; blurred by a share of a square."""
    low, high = extent_m(target)
    counts = np.rint((high - low) / target.square_m).astype(int).tolist()
    columns, rows = (_TEXELS * (count + 2 * (1 + _PAPER)) for count in counts)
    texture = np.ones((rows, columns))
    for cells in kind_of(target).cells(target):
        shares = []
        for axis, size in ((0, columns), (1, rows)):
            cell = _TEXELS * cells.cell_m / target.square_m
            first = _TEXELS * (cells.corner_m[axis] / target.square_m + 1 + _PAPER)
            edges = first + cell * np.arange(cells.dark.shape[1 - axis] + 1)
            texels = np.arange(size)[:, None]
            shares.append(
                np.clip(np.minimum(texels + 1, edges[1:]) - np.maximum(texels, edges[:-1]), 0, 1)
            )
        texture -= shares[1] @ cells.dark @ shares[0].T
    # Dark squares of a ChArUco board and its markers share no area.
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), _TEXELS * blur), np.float32)

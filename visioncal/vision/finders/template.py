"""Corners of checkerboards and ChArUco boards as exactly as the image has them, by a template.

Around a corner the print is a product of two edges, so that the image there is

    grey = o + a . b + (g + c . b) E(x; s_x) E(y; s_y),   b = (x, y) = M(pixel) - d,
    E(x; s) = erf(x / (sqrt 2 s)) - erf((x - 1) / (sqrt 2 s)) - erf((x + 1) / (sqrt 2 s)),

with the corner's own lines and the next ones at either side, in squares of the board. M maps pixels
to the board: the lens's radial distortion is taken off, then follow a homography of all corners,
and for each a cubic polynomial that those around it determine (where a lens bends squares of 60 px,
a homography alone errs by 0.01 px). The unknowns of a corner are its shift d, its offset o and its
contrast g; those of the image are the widths of the edges across its two families of lines, which
differ where something moved. They are found by Gauss-Newton steps, in which o and g have their
least squares given the rest (Golub and Pereyra 1973). The slopes a and c of uneven light come from
the o and g of the corners around.

Ink that spreads, a tone curve, and a symmetric blur of another shape are even about the corner:
they leave residuals but do not move it. The image is smoothed a little first, because demosaicing
and sharpening leave a pattern with a period of two pixels. On ChArUco boards the pixels of the
markers and of their blurred edges are left out. All corners of an image are worked on at once.

The corners of an AprilGrid's tags are such corners too, for each touches a small dark square. The
white between tags takes the place of the squares' side: within it lie a corner's lines alone, and
the next ones. A corner of a tag by itself is one dark square before white. Around it neither uneven
light nor what lies beyond the white is even, so that the slopes of white are unknowns of its own,
and what blur brings in from beyond is left out. Its edges end at it, so that directions of M that
are off move it, and M is made anew until corners rest. Ink and a tone curve move its two edges.

Around the centre of a printed circle of radius r the product of edges becomes one edge,

    E = erf((r - |b|) / (sqrt 2 s)),   s^2 = (s_x x^2 + s_y y^2) / |b|^2 of the squared widths,

in the distance of neighbouring rows. As M is what the lens and the view make of the board there,
the centre is the circle's own, and not that of the ellipse in the image. The radius is measured
along with the blur, because ink spreads.
"""

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, fields, replace
from threading import Lock
from typing import Self, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.finders.maps import OpticalAxis, maps_about
from visioncal.vision.targets import corner_positions, marked_squares, marker_cells

_Float32Array: TypeAlias = npt.NDArray[np.float32]

# Sigma of the smoothing [px], its taps, and the share of white noise's variance that it leaves.
_SMOOTH_PX, _TAPS = 0.7, 5
_KERNEL = np.asarray(cv2.getGaussianKernel(_TAPS, _SMOOTH_PX))
_NOISE_LEFT = float(np.sum(_KERNEL**2)) ** 2
# Half-width of the patch around a corner: in squares, and its bounds [px].
_HALF, _LEAST_PX, _MOST_PX = 0.42, 3.0, 20.0
# A homography takes so many corners.
_FEWEST = 4
# What is looked at around the outermost corners [px].
_RIM_PX = 32
_SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
# The patch of a tag's corner, in modules, and what is left out around the corner itself, in widths
# of an edge.
_TAG_HALF, _SLANT = 1.2, 1.5
# Shares of a module that white reaches around a tag. The one of least variance is taken: what lies
# beyond the white leaves residuals.
_TAG_WHITE = (1.0, 0.7, 0.4)
# How far from a tag's bits, and from what is beyond its white, pixels have to be, in widths of an
# edge. At 1.5 they draw all corners inwards by 0.02 px, but small tags have no others.
_TAG_CLEAR = (2.5, 1.5)
# Sides of a tag by itself that have directions of their own at its corners: shorter ones bend less
# than these add noise [px].
_BENT_PX = 115.0
# What is looked at around a circle: a share of its radius, and no less [px]. Text may be near.
_AROUND_CIRCLE, _AROUND_PX = 0.35, 4.0
# Larger circles are looked at in half of the size.
_MOST_RADIUS_PX = 20.0
# Values of a map, along each axis of a window, through which polynomials give all others. Maps of
# wide windows bend more than cubics: a fisheye's slanted circles would move by up to 0.35 px.
_NODES = 6
# Bounds memory and time where corners are many.
_MOST_PIXELS = 600_000
# Of so few corners, one image is worked on at a time: numpy hands the interpreter over at each of
# some thousand operations, which between threads takes longer than the operations.
_FEW, _ALONE = 100, Lock()
# Corners that measure the blur, and what it starts from and stays above [px].
_BLUR_SAMPLE, _BLUR_START_PX, _BLUR_LEAST_PX = 30, 1.5, 0.5
# Most turns, for the blur and for the corners, the change of the blur that ends them, as a
# logarithm, and the steps that do, of corners that make maps and of the result [px]: of a board's
# corners the next one is a hundredth of that. Lone corners come to rest slowly or not at all, and
# blur moves them.
_BLUR_TURNS, _MOST_TURNS = 8, 8
_STEADY, _LONE_STEADY = 0.03, 0.01
_STILL_PX, _LONE_STILL_PX = (0.1, 0.02), (0.004, 0.004)
# Most turns of the maps about lone corners, and the change of corners that ends them [px].
_LONE_MAPS, _MAPS_STILL_PX = 4, 0.03
# Beyond this share of a square, blur brings in the next lines.
_WIDE = 0.16
# Where its exponent is below this, an edge's slope is zero: single precision has denormal numbers
# there, which take a processor a hundred times as long, and sums do not show them.
_FAINT = np.float32(-80.0)
# Pixels nearer to a ChArUco board's marker than this many widths of an edge are left out.
_CLEAR = 1.5
# No step is longer [squares].
_MOST_STEP = 0.25
# What a fit has to show: a last step, likewise [px], a shift from the corner found [squares], a
# part of its patch inside the image, a part of the median contrast, and residuals by the contrast
# of at most so many times their median and so much more, and never of so much: heavy noise and ink
# leave half of that, other things than a corner twice as much.
_LAST_STEP_PX, _LONE_LAST_STEP_PX = (0.1, 0.02), (0.02, 0.02)
_MOST_SHIFT, _LEAST_INSIDE, _LEAST_CONTRAST = 0.3, 0.6, 0.1
_MISFIT_TIMES, _MISFIT_MORE, _MOST_MISFIT = 3.0, 0.05, 0.6


@dataclass(frozen=True, eq=False)
class Refined:
    """Corners by the template.

    Attributes:
        px: (n, 2) where they are; the detector's where one could not be fitted [px].
        sigma_px: (n,) standard deviation of a coordinate by the residuals, which is too large where
            the image has what the template does not; NaN where a corner could not be fitted [px].
        reasons: (n,) why a corner could not be fitted, in words; empty where it was.
        blur_px: (2,) widths of the edges between neighbours along x and along y, as sigmas; NaN
            where no corner could be fitted [px].
    """

    px: FloatArray
    sigma_px: FloatArray
    reasons: tuple[str, ...]
    blur_px: FloatArray


@dataclass(frozen=True, eq=False)
class _Pattern:
    """What is printed around n corners.

    Attributes:
        signs: (n,) the colour of the squares where x y > 0: one sign for the light ones. On a
            checkerboard, which may be described turned, the other sign may be the light one; on an
            AprilGrid one sign stands for the dark ones.
        inset: How far a light square's marker is from its edges, or the bits of a tag from its own
            [squares]; infinite without them.
        half: Half-width of the patch around a corner [squares].
        radius: That of the circle around it [squares]; 0 without one.
        lone: (n, 2) signs of x and y where the one dark square of a tag's corner is; 0 where two
            dark squares meet.
        outside: How far around a lone one white reaches [squares].
        clear: Pixels nearer to a marker, or to what lies beyond a lone one's white, than this many
            widths of an edge are left out.
        axes: (n, 2, 2) from the board to each corner's own axes and squares; None where these are
            the board's.
    """

    signs: FloatArray
    inset: float
    half: float = _HALF
    radius: float = 0.0
    lone: FloatArray | None = None
    outside: float = np.inf
    clear: float = _CLEAR
    axes: FloatArray | None = None

    @classmethod
    def of(cls, target: Target, ids: IntArray, board: FloatArray) -> Self:
        if target.kind == "aprilgrid":
            modules = len(marker_cells(target.dictionary, target.marker_id, target.border))
            # The tag is off its own corners in turn: below right, below left, and so on.
            return cls(np.where(ids % 2, -1.0, 1.0), target.border / (modules * target.spacing))
        if target.kind == "circles":
            radius = target.diameter_m / target.square_m / 2
            # As far as half-way to the next circle.
            half = np.sqrt(0.5) if target.asymmetric else 0.5
            return cls(np.ones(len(ids)), np.inf, float(half), radius)
        odd = np.rint(board).astype(int).sum(axis=1) % 2
        if target.kind == "checkerboard":
            return cls(1.0 - 2.0 * odd, np.inf)
        light = marked_squares(target)[0].sum() % 2
        inset = (1.0 - target.marker_m / target.square_m) / 2
        return cls(np.where(odd == light, 1.0, -1.0), inset)

    def at(self, chosen: IntArray) -> Self:
        """The pattern around some corners."""
        lone, axes = (None if array is None else array[chosen] for array in (self.lone, self.axes))
        return replace(self, signs=self.signs[chosen], lone=lone, axes=axes)


@dataclass(frozen=True, eq=False)
class _Windows:
    """The pixels around n corners, and the maps from there to the board.

    Attributes:
        px: (n, 2) where the corners were when the maps were made [px].
        by_board: (n, 2, 2) derivatives of pixels by the place on the board [px a square].
        widths: (n, 2) squares a pixel, across the lines of constant x and y.
        x: (n, h, w) place of each pixel on the board, from the corner [squares].
        y: Likewise.
        grey: (n, h, w) the smoothed image, less 128.
        within: (n, h, w) the pixels of a corner's patch.
        inside: (n, h, w) those in the image.
        around: (n, k) the corners around each.
        smoother: (n, 10, k) what makes a polynomial of values at the corners around.
    """

    px: FloatArray
    by_board: FloatArray
    widths: FloatArray
    x: _Float32Array
    y: _Float32Array
    grey: _Float32Array
    within: Mask
    inside: Mask
    around: IntArray
    smoother: FloatArray

    @classmethod
    def cut(
        cls,
        smooth: _Float32Array,
        board: FloatArray,
        px: FloatArray,
        good: Mask,
        chosen: IntArray,
        pattern: _Pattern,
        axis: OpticalAxis,
    ) -> Self:
        """Cuts the windows of the chosen ones among corners, whose good ones make the maps."""
        on_board, around, smoother = maps_about(board, px, good, chosen, axis)
        axes = np.eye(2) if pattern.axes is None else pattern.axes[chosen]

        def on_own(places: FloatArray) -> FloatArray:
            return np.asarray(on_board(places) @ np.swapaxes(axes, -1, -2))

        start = px[chosen]
        ends = on_own(start[:, None] + 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
        by_px = np.stack([ends[:, 0] - ends[:, 1], ends[:, 2] - ends[:, 3]], axis=2)
        by_board = np.asarray(np.linalg.inv(by_px), float)
        side_px = np.sqrt(np.abs(np.linalg.det(by_board)))
        # Of a circle all of the edge is needed.
        most = np.inf if pattern.radius else _MOST_PX
        half = np.clip(pattern.half, _LEAST_PX / side_px, most / side_px)
        if pattern.radius:
            around_px = np.maximum(_AROUND_CIRCLE * pattern.radius * side_px, _AROUND_PX)
            half = np.minimum(half, pattern.radius + around_px / side_px)
        wanted = float(np.max(half * np.abs(by_board).sum(axis=2).max(axis=1)))
        affordable = max(_LEAST_PX, (np.sqrt(_MOST_PIXELS / len(chosen)) - 1.0) / 2.0)
        reach = int(np.ceil(min(most, affordable, wanted)))
        steps = np.arange(-reach, reach + 1)
        centre = np.rint(start).astype(int)
        # A map is smooth: a polynomial through some of its values is as good as all.
        nodes = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
        spread = np.vander(steps / reach, _NODES) @ np.linalg.inv(np.vander(nodes, _NODES))
        spread = spread.astype(np.float32)
        grid = np.stack(np.meshgrid(reach * nodes, reach * nodes), axis=-1).reshape(-1, 2)
        values = on_own(centre[:, None] + grid).reshape(-1, _NODES, _NODES, 2).astype(np.float32)
        x, y = (np.asarray(spread @ values[..., axis] @ spread.T, np.float32) for axis in (0, 1))
        height, width = smooth.shape
        rows, columns = centre[:, 1, None] + steps, centre[:, 0, None] + steps
        rim = _TAPS // 2
        inside = ((rows >= rim) & (rows < height - rim))[:, :, None] & (
            (columns >= rim) & (columns < width - rim)
        )[:, None, :]
        rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
        away = np.hypot(x, y) if pattern.radius else np.maximum(np.abs(x), np.abs(y))
        within = away < half[:, None, None]
        return cls(
            start,
            by_board,
            np.linalg.norm(by_px, axis=2),
            x,
            y,
            # About the middle of the scale, single precision suffices.
            np.take(smooth, rows[:, :, None] * width + columns[:, None, :]) - np.float32(128.0),
            within,
            inside,
            around,
            # Slopes are by a corner's own axes.
            _turned(smoother, axes),
        )

    def at(self, chosen: IntArray) -> Self:
        """The windows of some corners."""
        return replace(
            self, **{field.name: getattr(self, field.name)[chosen] for field in fields(self)}
        )

    def length_px(self, shift: FloatArray) -> FloatArray:
        """(n,) lengths of shifts (n, 2) [squares] in the image [px]."""
        return np.asarray(np.linalg.norm((self.by_board @ shift[..., None])[..., 0], axis=1))

    def moved(self, shift: FloatArray) -> FloatArray:
        """Where corners are that lie (n, 2) squares from where they were, (n, 2) [px]."""
        return np.asarray(self.px + (self.by_board @ shift[..., None])[..., 0])

    def slopes(self, levels: FloatArray) -> FloatArray:
        """(n, 2, 2) slopes by x and y of (n, 2) levels that the corners around have."""
        return np.asarray(self.smoother[:, 1:3] @ (levels[self.around] - levels[:, None]))


@dataclass(frozen=True, eq=False)
class _GaussNewtonStep:
    """One Gauss-Newton step of n corners.

    Attributes:
        levels: (n, 2) offset, and contrast with the sign of the pattern [grey levels].
        shift: (n, 2) by how much the corners have to move [squares].
        blur: (n, 2) by how much, as a logarithm, the edges are wider, and (n, 3) with by how much a
            circle's radius is larger [squares]; (n, 0) unless asked for.
        covariance: (n, 2, 2) of the shift, by the residuals [squares^2].
        misfit: (n,) rms of the residuals over the contrast.
    """

    levels: FloatArray
    shift: FloatArray
    blur: FloatArray
    covariance: FloatArray
    misfit: FloatArray

    @classmethod
    def solved(cls, sums: FloatArray, *, blurs: int) -> Self:
        """The step by least squares.

        Args:
            sums: (n, k + 1, k + 1) products of the columns, the last of them what the others are
                to make up.
            blurs: How many columns are of the blur.
        """
        unknowns = sums.shape[1] - 1
        # In units of the columns, and with a trace more, every corner has an inverse.
        scale = np.sqrt(np.einsum("nii->ni", sums)[:, :unknowns]) + 1e-9
        scales = scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.inv(sums[:, :unknowns, :unknowns] / scales + 1e-7 * np.eye(unknowns))
        inverse /= scales
        found = (inverse @ sums[:, :unknowns, unknowns:])[..., 0]
        rest = sums[:, unknowns, unknowns] - np.sum(found * sums[:, :unknowns, unknowns], axis=1)
        variance = np.maximum(rest, 0.0) / np.maximum(sums[:, 0, 0] - unknowns, 1.0)
        contrast = found[:, 1, None]
        spread = (variance / _NOISE_LEFT)[:, None, None] / contrast[:, :, None] ** 2
        return cls(
            found[:, :2],
            -found[:, 2:4] / contrast,
            found[:, 4 : 4 + blurs] / contrast,
            inverse[:, 2:4, 2:4] * spread,
            np.sqrt(variance) / np.abs(contrast[:, 0]),
        )

    def at(self, chosen: IntArray) -> Self:
        """The steps of some corners."""
        return replace(
            self, **{field.name: getattr(self, field.name)[chosen] for field in fields(self)}
        )

    def replace(self, chosen: IntArray, others: Self) -> None:
        """Takes the steps of some corners from elsewhere."""
        for field in fields(self):
            getattr(self, field.name)[chosen] = getattr(others, field.name)


def refine(image: Image, target: Target, ids: IntArray, px: FloatArray) -> Refined:
    """Refines corners of a checkerboard, a ChArUco board or an AprilGrid; see the module.

    Args:
        image: (h, w) grey image.
        target: The board.
        ids: (n,) the corners' numbers.
        px: (n, 2) where a detector has them, to a pixel or so [px].

    Returns:
        The corners, in the same order.
    """
    share = target.spacing if target.kind == "aprilgrid" else 1.0
    board = corner_positions(target)[ids, :2] / (share * target.square_m)
    if target.kind == "circles" and _is_large(target, board, px):
        return _refined_smaller(image, target, ids, px)
    return _placed(image, _Pattern.of(target, ids, board), board, px)


def refine_tags(
    image: Image, modules: int, px: FloatArray, board: FloatArray | None = None
) -> Refined:
    """Refines the corners of tags in one plane, likewise.

    Around a corner the print is dark in one square, (1 + E(x)) (1 + E(y)), and white as far as a
    module reaches, or less; of the tag itself its border is looked at.

    Args:
        image: (h, w) grey image.
        modules: Modules along a tag's side, its border included.
        px: (t, 4, 2) where a detector has the corners, clockwise from each tag's upper left [px].
        board: (t, 4, 2) where they are in their plane, in any unit; None of a tag by itself, of
            which it is known that it is square.

    Returns:
        The corners, four of each tag.
    """
    board = _SQUARE[None] if board is None else board
    inward = np.tile([[1.0, 1], [-1, 1], [-1, -1], [1, -1]], (len(board), 1))
    sides = np.stack([board[:, 1] - board[:, 0], board[:, 3] - board[:, 0]], axis=1)
    unit = float(np.mean(np.linalg.norm(sides, axis=2)))
    lengths = np.sum(sides**2, axis=2, keepdims=True)
    module = 1.0 / modules
    pattern = _Pattern(
        inward.prod(axis=1),
        module,
        # The corners around show the lens's bend; one tag alone does not.
        module * (_TAG_HALF if len(board) > 1 else 1.0),
        lone=inward,
        axes=np.repeat(unit * sides / lengths, 4, axis=0),
    )
    places, start = board.reshape(-1, 2) / unit, px.reshape(-1, 2)
    tried: list[Refined] = []
    for clear in _TAG_CLEAR:
        for white in _TAG_WHITE:
            printed = replace(pattern, outside=white * module, clear=clear)
            tried.append(_placed(image, printed, places, start))
        best = min(tried, key=_uncertainty)
        if not any(best.reasons):
            break
    return best


def _uncertainty(refined: Refined) -> tuple[int, float]:
    """How many corners could not be fitted, and the sum of the others' variances [px^2]."""
    return sum(map(bool, refined.reasons)), float(np.nansum(refined.sigma_px**2))


def _placed(image: Image, pattern: _Pattern, board: FloatArray, px: FloatArray) -> Refined:
    """Refines (n, 2) corners at places of the board, in the part of the image that shows them."""
    low = np.maximum(np.floor(px.min(axis=0)).astype(int) - _RIM_PX, 0)
    high = np.ceil(px.max(axis=0)).astype(int) + _RIM_PX + 1
    axis = OpticalAxis.of(image.shape, low)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    flat = all(np.linalg.matrix_rank(array - array.mean(axis=0)) == 2 for array in (board, px))
    # Corners that cannot be fitted may lead to anything; they are sorted out afterwards.
    alone = _ALONE if len(px) <= _FEW else nullcontext()
    with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"), alone:
        if len(px) >= _FEWEST and flat and part.size:
            refined = _refined(part, pattern, board, px - low, axis)
            return replace(refined, px=refined.px + low)
    nothing = np.full(len(px), np.nan)
    reason = "the corners found are too few, or lie as no board's do"
    return Refined(px, nothing, (reason,) * len(px), np.full(2, np.nan))


def _is_large(target: Target, board: FloatArray, px: FloatArray) -> bool:
    """Whether circles have so many pixels that windows around them are too large."""
    if len(px) < _FEWEST:
        return False
    scale = np.linalg.norm(px - px.mean(axis=0)) / np.linalg.norm(board - board.mean(axis=0))
    return bool(scale * target.diameter_m / target.square_m > 2 * _MOST_RADIUS_PX)


def _refined_smaller(image: Image, target: Target, ids: IntArray, px: FloatArray) -> Refined:
    """Refines in an image of half the size, whose edges have as many pixels of noise to count."""
    height, width = (2 * (side // 2) for side in image.shape)
    small = cv2.resize(
        image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA
    )
    found = refine(np.asarray(small, np.uint8), target, ids, (px - 0.5) / 2)
    return Refined(2 * found.px + 0.5, 2 * found.sigma_px, found.reasons, 2 * found.blur_px)


def _refined(
    image: Image, pattern: _Pattern, board: FloatArray, px: FloatArray, axis: OpticalAxis
) -> Refined:
    smooth = np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, _KERNEL, _KERNEL), np.float32)
    every, all_good = np.arange(len(px)), np.ones(len(px), bool)
    some = every[:: -(-len(px) // _BLUR_SAMPLE)]
    windows = _Windows.cut(smooth, board, px, all_good, every, pattern, axis)
    blur_px, radius = _measured_blur(windows.at(some), pattern.at(some))
    if pattern.radius:
        pattern = replace(pattern, radius=radius)
        windows = _Windows.cut(smooth, board, px, all_good, every, pattern, axis)
    is_lone = pattern.lone is not None
    still_px, last_px = (
        (_LONE_STILL_PX, _LONE_LAST_STEP_PX) if is_lone else (_STILL_PX, _LAST_STEP_PX)
    )
    none = np.zeros_like(px)
    # The edges of a lone corner lie to one side of it, and it moves with the maps' directions.
    for _ in range(_LONE_MAPS if is_lone else 1):
        first = _step(windows, pattern, none, blur_px)
        shift, step = _fitted(windows, pattern, blur_px, None, first, still_px[0])
        better = windows.moved(shift)
        good = np.array([not reason for reason in _reasons(windows, step, better - px, last_px[0])])
        better = np.where(good[:, None], better, px)
        moved_px = np.abs(better - windows.px).max()
        windows = _Windows.cut(smooth, board, better, good, every, pattern, axis)
        if moved_px < _MAPS_STILL_PX:
            break
    slopes = windows.slopes(step.levels)
    # Glare and shadows have edges: where slopes do not explain more of a corner, it has none.
    first, plain = _steps(windows, pattern, none, blur_px, (slopes, None))
    even = np.flatnonzero(~(first.misfit < plain.misfit))
    slopes[even] = 0.0
    first.replace(even, plain.at(even))
    shift, step = _fitted(windows, pattern, blur_px, slopes, first, still_px[1])
    better = windows.moved(shift)
    reasons = _reasons(windows, step, better - px, last_px[1])
    good = np.array([not reason for reason in reasons])
    spread = windows.by_board @ step.covariance @ windows.by_board.transpose(0, 2, 1)
    sigma_px = np.sqrt(np.trace(spread, axis1=1, axis2=2) / 2)
    return Refined(
        np.where(good[:, None], better, px),
        np.where(good, sigma_px, np.nan),
        reasons,
        np.sqrt(np.maximum(blur_px**2 - _SMOOTH_PX**2, 0.0)) if good.any() else np.full(2, np.nan),
    )


def _measured_blur(windows: _Windows, pattern: _Pattern) -> tuple[FloatArray, float]:
    """(2,) widths of the smoothed image's edges, medians over the corners [px], and the radius."""
    side_px = 1.0 / np.median(windows.widths)
    # A wider one would leave out all white around a lone corner.
    blur_px = np.full(2, min(_BLUR_START_PX, 0.2 * min(pattern.outside, 1.0) * side_px))
    shift = np.zeros((len(windows.px), 2))
    for _ in range(_BLUR_TURNS):
        step = _step(windows, pattern, shift, blur_px, blurs=True)
        shift = shift + _bounded(step.shift)
        medians = np.array([_median(column) for column in step.blur.T])
        changes = np.clip(np.nan_to_num(medians), -0.5, 0.5)
        change, grown = changes[:2], float(changes[2]) if pattern.radius else 0.0
        radius = np.clip(pattern.radius + grown, 0.5 * pattern.radius, 1.5 * pattern.radius)
        pattern = replace(pattern, radius=float(radius))
        blur_px = np.clip(blur_px * np.exp(change), _BLUR_LEAST_PX, 0.5 * side_px)
        if np.abs(change).max() < (_STEADY if pattern.lone is None else _LONE_STEADY):
            break
    # Few pixels around a lone corner determine nothing, and then blur comes to rest nowhere.
    steady = pattern.lone is None or np.abs(medians).max() < _LONE_STEADY
    return blur_px if steady else np.full(2, np.nan), pattern.radius


def _fitted(
    windows: _Windows,
    pattern: _Pattern,
    blur_px: FloatArray,
    slopes: FloatArray | None,
    first: _GaussNewtonStep,
    still_px: float,
) -> tuple[FloatArray, _GaussNewtonStep]:
    """Where the corners are from where they were (n, 2) [squares], and their last steps."""
    shift = np.zeros((len(windows.px), 2))
    moving = np.arange(len(shift))
    last = step = first
    for _ in range(_MOST_TURNS):
        shift[moving] += _bounded(step.shift)
        still = windows.length_px(last.shift)[moving] < still_px
        moving = moving[~still]
        if not moving.size:
            break
        of_light = None if slopes is None else slopes[moving]
        step = _step(windows.at(moving), pattern.at(moving), shift[moving], blur_px, of_light)
        last.replace(moving, step)
    return shift, last


def _bounded(shift: FloatArray) -> FloatArray:
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    bounded = shift * np.minimum(1.0, _MOST_STEP / length)
    return np.where(np.isfinite(length), bounded, 0.0)


def _step(
    windows: _Windows,
    pattern: _Pattern,
    shift: FloatArray,
    blur_px: FloatArray,
    slopes: FloatArray | None = None,
    *,
    blurs: bool = False,
) -> _GaussNewtonStep:
    """One Gauss-Newton step; `slopes` (n, 2, 2) of offset and contrast by x and y."""
    return _steps(windows, pattern, shift, blur_px, (slopes,), blurs=blurs)[0]


def _steps(
    windows: _Windows,
    pattern: _Pattern,
    shift: FloatArray,
    blur_px: FloatArray,
    lights: Sequence[FloatArray | None],
    *,
    blurs: bool = False,
) -> list[_GaussNewtonStep]:
    """One Gauss-Newton step by each of some slopes, None of even light."""
    count = len(shift)
    sx, sy, dx, dy, signs = (
        np.asarray(column, np.float32)[:, None, None]
        for column in (*(blur_px * windows.widths).T, *shift.T, pattern.signs)
    )
    x, y = windows.x - dx, windows.y - dy
    used = windows.within & windows.inside
    if np.isfinite(pattern.inset):
        clear_x, clear_y = (
            np.float32(pattern.inset) - np.float32(pattern.clear) * array for array in (sx, sy)
        )
        # Light squares are where the signs of x and y agree, or do not.
        light = np.logical_xor(np.logical_xor(x > 0, y > 0), signs > 0)
        light &= np.abs(x) > clear_x
        light &= np.abs(y) > clear_y
        used &= ~light
    if pattern.lone is not None:
        lone_x, lone_y = np.asarray(pattern.lone.T, np.float32)[:, :, None, None]
        far_x, far_y = (
            np.float32(pattern.clear) * array - np.float32(pattern.outside) for array in (sx, sy)
        )
        used &= (lone_x * x > far_x) & (lone_y * y > far_y)
        # Where a view slants the corner, its blur is not the product of two.
        used &= (np.abs(x) > np.float32(_SLANT) * sx) | (np.abs(y) > np.float32(_SLANT) * sy)
    if pattern.radius:
        product, *slopes_of = _circle(pattern, x, y, sx, sy)[: None if blurs else 3]
    else:
        # Blur may bring in the next lines of some corner.
        wide = bool(max(sx.max(), sy.max()) > _WIDE)
        product, *slopes_of = _crossing(pattern, x, y, sx, sy, blurs=blurs, wide=wide)
    columns: list[npt.NDArray[np.floating]] = [product, *slopes_of]
    if pattern.lone is not None:
        # Light slopes where it is white, and there the product is 0; in the dark it is 4.
        columns += [(1 - product / 4) * array for array in (x, y)]
        # A lens bends the sides of a tag by itself, and its corners do not show how.
        if windows.around.shape[1] == _FEWEST and np.median(windows.widths) * _BENT_PX < 1.0:
            columns += [y * slopes_of[0], x * slopes_of[1]]
    unknowns = len(columns) + 1
    for slopes in lights:
        if slopes is None:
            columns.append(windows.grey)
        else:
            ox, oy, gx, gy = (
                np.asarray(slopes, np.float32).transpose(2, 1, 0).reshape(4, count, 1, 1)
            )
            columns.append(windows.grey - ox * x - oy * y - (gx * x + gy * y) * product)
    stack = np.empty((count, len(columns) + 1, *x.shape[1:]), np.float32)
    stack[:, 0] = used
    for at, column in enumerate(columns, start=1):
        np.multiply(column, stack[:, 0], out=stack[:, at])
    stack = stack.reshape(count, len(columns) + 1, -1)
    # Of a matrix with itself numpy takes BLAS's syrk, which is slower for so few rows.
    sums = np.empty((count, len(columns) + 1, len(columns) + 1))
    sums[:, 1:] = stack[:, 1:] @ stack.transpose(0, 2, 1)
    sums[:, 0, 1:] = sums[:, 1:, 0]
    sums[:, 0, 0] = np.count_nonzero(used, axis=(1, 2))
    own = [*range(unknowns)]
    return [
        _GaussNewtonStep.solved(sums[:, [*own, at]][:, :, [*own, at]], blurs=len(slopes_of) - 2)
        for at in range(unknowns, len(columns) + 1)
    ]


def _crossing(
    pattern: _Pattern,
    x: _Float32Array,
    y: _Float32Array,
    sx: _Float32Array,
    sy: _Float32Array,
    *,
    blurs: bool,
    wide: bool,
) -> tuple[_Float32Array, ...]:
    """Two edges that cross: their product, and its derivatives."""
    # These are by x and y and, with `blurs`, by the logarithms of the widths.
    signs = np.asarray(pattern.signs, np.float32)[:, None, None]
    edge_x, slope_x, *wider_x = _edges(x, sx, blurs=blurs, wide=wide)
    edge_y, slope_y, *wider_y = _edges(y, sy, blurs=blurs, wide=wide)
    if pattern.lone is not None:
        lone_x, lone_y = np.asarray(pattern.lone.T, np.float32)[:, :, None, None]
        edge_x, edge_y = edge_x + lone_x, edge_y + lone_y
    edge_x *= signs
    return (
        edge_x * edge_y,
        np.multiply(signs * slope_x, edge_y),
        edge_x * slope_y,
        *(signs * array * edge_y for array in wider_x),
        *(edge_x * array for array in wider_y),
    )


def _circle(
    pattern: _Pattern,
    x: _Float32Array,
    y: _Float32Array,
    sx: _Float32Array,
    sy: _Float32Array,
) -> tuple[_Float32Array, ...]:
    """A disc, likewise; the last of its derivatives is by the radius."""
    away = np.hypot(x, y) + np.float32(1e-6)
    of_x, of_y = (sx * x / away) ** 2, (sy * y / away) ** 2
    width = np.sqrt(of_x + of_y)
    off = np.float32(pattern.radius) - away
    edge, slope, wider = _edges(off, width, blurs=True, wide=False)
    inward = -slope / away
    by_width = wider / (of_x + of_y)
    return edge, inward * x, inward * y, by_width * of_x, by_width * of_y, slope


def _turned(smoother: FloatArray, axes: FloatArray) -> FloatArray:
    """What makes polynomials (m, 10, k), with their slopes by other axes (m, 2, 2)."""
    slopes = np.linalg.inv(np.swapaxes(axes, -1, -2)) @ smoother[:, 1:3]
    return np.concatenate([smoother[:, :1], slopes, smoother[:, 3:]], axis=1)


def _edges(
    at: _Float32Array, sigma: _Float32Array, *, blurs: bool, wide: bool
) -> tuple[_Float32Array, ...]:
    """E of the module, its derivative by the place, and with `blurs` by the logarithm of sigma."""
    sums = _edge(at / sigma, sigma, blurs=blurs)
    for line in (-1, 1) if wide else ():
        beside = _edge((at - np.float32(line)) / sigma, sigma, blurs=blurs)
        for total, part in zip(sums, beside, strict=True):
            np.subtract(total, part, out=total)
    return sums


def _edge(t: _Float32Array, sigma: _Float32Array, *, blurs: bool) -> tuple[_Float32Array, ...]:
    """One line's share of `_edges`."""
    bell = np.float32(-0.5) * t
    bell *= t
    np.copyto(bell, -np.inf, where=bell < _FAINT)
    np.exp(bell, out=bell)
    edge = _erf(t, bell)
    bell *= np.float32(np.sqrt(2.0 / np.pi))
    if not blurs:
        bell /= sigma
        return edge, bell
    return edge, bell / sigma, -t * bell


def _erf(t: _Float32Array, bell: _Float32Array) -> _Float32Array:
    """erf(t / sqrt 2), given exp(-t^2 / 2), to 2e-7 (Abramowitz and Stegun 7.1.26)."""
    # Five times as fast as scipy's, which has no vector instructions.
    u = np.abs(t)
    u *= np.float32(0.3275911 / np.sqrt(2.0))
    u += 1
    np.reciprocal(u, out=u)
    total = np.float32(1.061405429) * u
    for factor in (-1.453152027, 1.421413741, -0.284496736, 0.254829592):
        total += np.float32(factor)
        total *= u
    total *= bell
    np.subtract(1, total, out=total)
    return np.copysign(total, t, out=total)


def _reasons(
    windows: _Windows, step: _GaussNewtonStep, moved_px: FloatArray, last_px: float
) -> tuple[str, ...]:
    """(n,) why corners cannot be used, in words; empty where they can."""
    last = windows.length_px(step.shift)
    moved = np.linalg.norm(moved_px, axis=1) * windows.widths.max(axis=1)
    contrast = step.levels[:, 1] * np.sign(_median(step.levels[:, 1]))
    share = np.sum(windows.within & windows.inside, axis=(1, 2)) / np.sum(
        windows.within, axis=(1, 2)
    )
    # Written so that what is not a number fails.
    checks = (
        ("cut off by the edge of the image", share >= _LEAST_INSIDE),
        (
            "without the board's contrast",
            contrast > _LEAST_CONTRAST * _median(contrast),
        ),
        ("no place fits best", last < last_px),
        ("the place that fits best is far from where it was found", moved < _MOST_SHIFT),
        (
            "unlike the print",
            step.misfit < min(_MISFIT_TIMES * _median(step.misfit) + _MISFIT_MORE, _MOST_MISFIT),
        ),
    )
    reasons = np.full(len(last), "", dtype=object)
    for words, holds in checks:
        reasons[(reasons == "") & ~holds] = words
    return tuple(reasons.tolist())


def _median(values: FloatArray) -> float:
    """The median of what is finite; NaN where nothing is."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan

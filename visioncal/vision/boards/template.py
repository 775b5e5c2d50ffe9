"""Sub-pixel corners of boards, tags and circles by template fitting.

Around a corner of a checkerboard or ChArUco board the print is a product of two edges, so that the
image there is

    grey = o + a . b + (g + c . b) E(x; s_x) E(y; s_y),   b = (x, y) = M(pixel) - d,
    E(x; s) = erf(x / (sqrt 2 s)) - erf((x - 1) / (sqrt 2 s)) - erf((x + 1) / (sqrt 2 s)),

with the corner's own lines and the next ones at either side, in squares of the board. M maps pixels
to the board: radial distortion is removed, followed by a homography of all corners and a cubic
polynomial for each corner, determined by its neighbours (where lens distortion bends squares of 60
px, a homography alone errs by 0.01 px). The unknowns of a corner are its shift d, offset o and
contrast g; those of the image are the edge widths across the two families of lines, which differ
under motion. They are estimated by Gauss-Newton steps, with o and g eliminated by variable
projection (Golub and Pereyra 1973). The gradients a and c of uneven illumination are derived from o
and g of the neighbouring corners.

Spreading ink, a tone curve, and symmetric blur of another shape are even about the corner: they
leave residuals but no bias. The image is smoothed slightly first, because demosaicing and
sharpening leave a pattern with a period of two pixels. On ChArUco boards the pixels of markers and
their blurred edges are excluded. All corners of an image are processed together.

The corners of an AprilGrid's tags are of the same kind, as each touches a small dark square. The
gap between tags takes the place of the squares' side: within it there are a corner's own lines and
the next ones only. A corner of a lone tag is one dark square on white. Around it neither uneven
illumination nor the surroundings of the white are even, so that gradients on white are unknowns of
each corner, and pixels blurred by the surroundings are excluded. Its edges end at the corner, so
that errors in the directions of M bias it, and M is recomputed until the corners converge. Ink and
a tone curve shift its two edges.

Around the centre of a printed circle of radius r the product of edges becomes one edge,

    E = erf((r - |b|) / (sqrt 2 s)),   s^2 = (s_x x^2 + s_y y^2) / |b|^2 of the squared widths,

in units of the spacing of neighbouring rows. As M includes lens and perspective, the result is the
circle's centre, not that of the ellipse in the image. The radius is estimated with the blur,
because ink spreads.
"""

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from threading import Lock

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.types import FloatArray, Image, Mask, chosen_rows
from visioncal.vision.boards.maps import OpticalAxis
from visioncal.vision.boards.prints import Print, circle, crossing
from visioncal.vision.boards.windows import SMOOTH_PX, GaussNewtonStep, Windows, smoothing
from visioncal.vision.poses import FEWEST_CORNERS

# Margin around the outermost corners [px].
_RIM_PX = 32
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
# Half-width of the excluded area at a tag's corner itself [edge widths].
_SLANT = 1.5
# Radii of circles in images over those stated from which fits begin; from within 6 % they converge.
_RATIOS = 1.1 ** np.arange(-4, 5)
# Up to this number of corners, images are processed one at a time: numpy releases the interpreter
# lock at each of about a thousand operations, and switching threads takes longer than these.
_FEW, _ONE_IMAGE = 100, Lock()
# Convergence: change of the blur as a logarithm, and steps for the maps and for the result [px].
# Lone corners converge slowly or not at all, and depend on the blur.
_LONE_BLUR_TOLERANCE = 0.01
_STEP_TOLERANCES_PX, _LONE_STEP_TOLERANCES_PX = (0.1, 0.02), (0.004, 0.004)
# Last step of an accepted corner, for maps and result [px].
_LAST_STEP_PX, _LONE_LAST_STEP_PX = (0.1, 0.02), (0.02, 0.02)


@dataclass(frozen=True, eq=False)
class Refined:
    """Corners refined by the template."""

    px: FloatArray  # (n, 2) positions; the detector's where the fit failed [px].
    # (n,) standard deviation of a coordinate, from the residuals; too large where the image has
    # content that is not in the template; NaN where the fit failed [px].
    sigma_px: FloatArray
    # (2,) edge widths between neighbours along x and along y, as sigmas; NaN if no corner was
    # fitted [px].
    blur_px: FloatArray
    grown: float = 0.0  # Radius of circles in the image less that of the print [squares].

    @property
    def fitted(self) -> Mask:
        """(n,) corners whose fit succeeded."""
        return np.isfinite(self.sigma_px)


def refine_tags(
    image: Image, modules: int, px: FloatArray, board: FloatArray | None = None
) -> Refined:
    """Refines the corners of lone tags in one plane; see the module's documentation.

    Around a corner the print is dark in one square, (1 + E(x)) (1 + E(y)), and white for up to a
    module; of the tag itself the border is used.

    Args:
        image: (h, w) grey image.
        modules: Modules along a tag's side, including its border.
        px: (t, 4, 2) detected corners, clockwise from each tag's upper left [px].
        board: (t, 4, 2) corners in their plane, in any unit; None for a single tag, which is
            square.

    Returns:
        The corners, four per tag.
    """
    board = SQUARE[None] if board is None else board
    inward = np.tile([[1.0, 1], [-1, 1], [-1, -1], [1, -1]], (len(board), 1))
    sides = np.stack([board[:, 1] - board[:, 0], board[:, 3] - board[:, 0]], axis=1)
    unit = float(np.mean(np.linalg.norm(sides, axis=2)))
    lengths = np.sum(sides**2, axis=2, keepdims=True)
    module = 1.0 / modules
    pattern = Print(
        inward.prod(axis=1),
        module,
        # Neighbouring corners determine lens distortion; a single tag does not.
        module * (1.2 if len(board) > 1 else 1.0),
        lone=inward,
        axes=np.repeat(unit * sides / lengths, 4, axis=0),
    )
    positions, start = board.reshape(-1, 2) / unit, px.reshape(-1, 2)
    fits: list[Refined] = []
    for clear in (2.5, 1.5):
        # Widths of white around a tag [modules]. The one of least variance is used, as anything
        # beyond the white leaves residuals. Pixels keep 2.5 edge widths from the tag's bits and its
        # surroundings; 1.5 biases all corners inwards by 0.02 px, but small tags have no other
        # pixels.
        for white in (1.0, 0.7, 0.4):
            printed = replace(pattern, outside=white * module, clear=clear)
            fits.append(refine(image, printed, positions, start))
        best = min(fits, key=lambda fit: (np.sum(~fit.fitted), np.nansum(fit.sigma_px**2)))
        if best.fitted.all():
            break
    return best


def refine(image: Image, pattern: Print, board: FloatArray, px: FloatArray) -> Refined:
    """Refines corners of a print; see the module's documentation.

    Args:
        image: (h, w) grey image.
        pattern: The print around the corners.
        board: (n, 2) their positions on the board [squares].
        px: (n, 2) detected corners, to about a pixel [px].

    Returns:
        The corners, in the same order.
    """
    low = np.maximum(np.floor(px.min(axis=0)).astype(int) - _RIM_PX, 0)
    high = np.ceil(px.max(axis=0)).astype(int) + _RIM_PX + 1
    axis = OpticalAxis.of(image.shape, low)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    spans_plane = all(
        np.linalg.matrix_rank(array - array.mean(axis=0)) == 2 for array in (board, px)
    )
    # Failed corners may cause any numerical error; they are rejected afterwards.
    lock = _ONE_IMAGE if len(px) <= _FEW else nullcontext()
    with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"), lock:
        if len(px) >= FEWEST_CORNERS and spans_plane and part.size:
            refined = _refine_corners(part, pattern, board, px - low, axis)
            return replace(refined, px=refined.px + low)
    return unrefined(px)


def unrefined(px: FloatArray) -> Refined:
    """The detector's corners, where none was fitted."""
    return Refined(px, np.full(len(px), np.nan), np.full(2, np.nan))


def _refine_corners(
    image: Image, pattern: Print, board: FloatArray, px: FloatArray, axis: OpticalAxis
) -> Refined:
    kernel = smoothing()
    smooth = np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel), np.float32)
    indices, all_corners = np.arange(len(px)), np.ones(len(px), bool)
    sample = indices[:: -(-len(px) // 30)]
    # Wide, as circles may be larger than stated.
    wide = pattern if pattern.radii is None else replace(pattern, radii=1.4 * pattern.radii)
    windows = Windows.cut(smooth, board, px, all_corners, indices, wide, axis)
    blur_px, grown = _estimate_blur(chosen_rows(windows, sample), chosen_rows(pattern, sample))
    if pattern.radii is not None:
        pattern = replace(pattern, radii=pattern.radii + grown)
        windows = Windows.cut(smooth, board, px, all_corners, indices, pattern, windows.axis)
    is_lone = pattern.lone is not None
    tolerances_px, last_px = (
        (_LONE_STEP_TOLERANCES_PX, _LONE_LAST_STEP_PX)
        if is_lone
        else (_STEP_TOLERANCES_PX, _LAST_STEP_PX)
    )
    no_shift = np.zeros_like(px)
    # The edges of a lone corner are on one side of it, so that it depends on the maps' directions:
    # these are updated until corners stay [px].
    for _ in range(4 if is_lone else 1):
        (first,) = _steps(windows, pattern, no_shift, blur_px, (None,))
        shift, step = _fit_positions(windows, pattern, blur_px, None, first, tolerances_px[0])
        refined_px = windows.shifted(shift)
        good = _accepted(windows, step, refined_px - px, last_px[0])
        refined_px = np.where(good[:, None], refined_px, px)
        change_px = np.abs(refined_px - windows.px).max()
        windows = Windows.cut(smooth, board, refined_px, good, indices, pattern, windows.axis)
        if change_px < 0.03:
            break
    gradients = windows.gradients(step.levels)
    # Glare and shadows have edges: gradients are only used where they reduce a corner's misfit.
    first, without_gradients = _steps(windows, pattern, no_shift, blur_px, (gradients, None))
    unlit = np.flatnonzero(~(first.misfit < without_gradients.misfit))
    gradients[unlit] = 0.0
    first.replace(unlit, chosen_rows(without_gradients, unlit))
    shift, step = _fit_positions(windows, pattern, blur_px, gradients, first, tolerances_px[1])
    refined_px = windows.shifted(shift)
    good = _accepted(windows, step, refined_px - px, last_px[1])
    covariance = windows.jacobian @ step.covariance @ windows.jacobian.transpose(0, 2, 1)
    sigma_px = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return Refined(
        np.where(good[:, None], refined_px, px),
        np.where(good, sigma_px, np.nan),
        np.sqrt(np.maximum(blur_px**2 - SMOOTH_PX**2, 0.0)) if good.any() else np.full(2, np.nan),
        grown,
    )


def _estimate_blur(windows: Windows, pattern: Print) -> tuple[FloatArray, float]:
    """(2,) median edge widths of the smoothed image [px], and the growth of circles' radii.

    Widths start at 1.5 px, and are at least half a pixel.
    """
    side_px = 1.0 / np.median(windows.widths)
    # A larger start would exclude all white around a lone corner.
    blur_px = np.full(2, min(1.5, 0.2 * min(pattern.outside, 1.0) * side_px))
    shift, total = np.zeros((len(windows.px), 2)), 0.0
    if pattern.radii is not None:
        # A fit that begins at another radius takes the difference for blur.
        growths = (_RATIOS - 1.0) * pattern.radii.min()
        printed = [replace(pattern, radii=pattern.radii + growth) for growth in growths]
        steps = [_steps(windows, each, shift, blur_px, (None,))[0] for each in printed]
        residuals = [_median(step.misfit * np.abs(step.levels[:, 1])) for step in steps]
        best = int(np.argmin(np.nan_to_num(residuals, nan=np.inf)))
        pattern, total = printed[best], float(growths[best])
    for _ in range(8):
        (step,) = _steps(windows, pattern, shift, blur_px, (None,), blurs=True)
        shift = shift + _limited(step.shift)
        medians = np.array([_median(column) for column in step.blur.T])
        changes = np.clip(np.nan_to_num(medians), -0.5, 0.5)
        change = changes[:2]
        if pattern.radii is not None:
            least = float(pattern.radii.min())
            grown = float(np.clip(changes[2], -0.5 * least, 0.5 * least))
            pattern, total = replace(pattern, radii=pattern.radii + grown), total + grown
        blur_px = np.clip(blur_px * np.exp(change), 0.5, 0.5 * side_px)
        if np.abs(change).max() < (0.03 if pattern.lone is None else _LONE_BLUR_TOLERANCE):
            break
    # With too few pixels around a lone corner the blur does not converge.
    converged = pattern.lone is None or np.abs(medians).max() < _LONE_BLUR_TOLERANCE
    return blur_px if converged else np.full(2, np.nan), total


def _fit_positions(
    windows: Windows,
    pattern: Print,
    blur_px: FloatArray,
    slopes: FloatArray | None,
    first: GaussNewtonStep,
    tolerance_px: float,
) -> tuple[FloatArray, GaussNewtonStep]:
    """Shifts of the corners (n, 2) [squares], and their last steps."""
    shift = np.zeros((len(windows.px), 2))
    moving = np.arange(len(shift))
    latest = step = first
    for _ in range(8):
        shift[moving] += _limited(step.shift)
        converged = windows.length_px(latest.shift)[moving] < tolerance_px
        moving = moving[~converged]
        if not moving.size:
            break
        lights = (None if slopes is None else slopes[moving],)
        some = chosen_rows(windows, moving), chosen_rows(pattern, moving)
        (step,) = _steps(*some, shift[moving], blur_px, lights)
        latest.replace(moving, step)
    return shift, latest


def _limited(shift: FloatArray) -> FloatArray:
    """Steps (n, 2) of a quarter of a square at most."""
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    bounded = shift * np.minimum(1.0, 0.25 / length)
    return np.where(np.isfinite(length), bounded, 0.0)


def _steps(
    windows: Windows,
    pattern: Print,
    shift: FloatArray,
    blur_px: FloatArray,
    lights: Sequence[FloatArray | None],
    *,
    blurs: bool = False,
) -> list[GaussNewtonStep]:
    """Gauss-Newton steps for several gradients (n, 2, 2) of offset and contrast by x and y.

    None stands for even illumination.
    """
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
        # `signs` says whether light squares are where the signs of x and y agree or differ.
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
        # At a slanted corner the blur is not a product of two edges.
        used &= (np.abs(x) > np.float32(_SLANT) * sx) | (np.abs(y) > np.float32(_SLANT) * sy)
    if pattern.radii is not None:
        product, *derivatives = circle(pattern, x, y, sx, sy)[: None if blurs else 3]
    else:
        # Next lines matter if any corner's edge is so wide [squares].
        wide = bool(max(sx.max(), sy.max()) > 0.16)
        product, *derivatives = crossing(pattern, x, y, sx, sy, blurs=blurs, wide=wide)
    columns: list[npt.NDArray[np.floating]] = [product, *derivatives]
    if pattern.lone is not None:
        # Gradients apply to white, where the product is 0; in the dark it is 4.
        columns += [(1 - product / 4) * array for array in (x, y)]
        # The corners of a single tag do not determine how lens distortion bends its sides: these
        # may bend from 115 px on; on shorter ones noise exceeds the bending.
        if (
            windows.neighbours.shape[1] == FEWEST_CORNERS
            and np.median(windows.widths) * 115.0 < 1.0
        ):
            columns += [y * derivatives[0], x * derivatives[1]]
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
    for index, column in enumerate(columns, start=1):
        np.multiply(column, stack[:, 0], out=stack[:, index])
    stack = stack.reshape(count, len(columns) + 1, -1)
    # Different operands avoid BLAS's syrk, which is slower for so few rows.
    sums = np.empty((count, len(columns) + 1, len(columns) + 1))
    sums[:, 1:] = stack[:, 1:] @ stack.transpose(0, 2, 1)
    sums[:, 0, 1:] = sums[:, 1:, 0]
    sums[:, 0, 0] = np.count_nonzero(used, axis=(1, 2))
    parameters = [*range(unknowns)]
    return [
        GaussNewtonStep.solve(
            sums[:, [*parameters, index]][:, :, [*parameters, index]], blurs=len(derivatives) - 2
        )
        for index in range(unknowns, len(columns) + 1)
    ]


def _accepted(
    windows: Windows, step: GaussNewtonStep, moved_px: FloatArray, last_px: float
) -> Mask:
    """(n,) corners that converged near where they were found, and look like the print."""
    shift_squares = np.linalg.norm(moved_px, axis=1) * windows.widths.max(axis=1)
    contrast = step.levels[:, 1] * np.sign(_median(step.levels[:, 1]))
    within = np.sum(windows.within, axis=(1, 2))
    inside = np.sum(windows.within & windows.inside, axis=(1, 2))
    # Heavy noise and ink reach half of the upper limit, anything but a corner twice as much.
    most_misfit = min(3.0 * _median(step.misfit) + 0.05, 0.6)
    # Written so that NaN fails.
    return np.asarray(
        (inside >= 0.6 * within)
        & (contrast > 0.1 * _median(contrast))
        & (windows.length_px(step.shift) < last_px)
        & (shift_squares < 0.3)
        & (step.misfit < most_misfit)
    )


def _median(values: FloatArray) -> float:
    """Median of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan

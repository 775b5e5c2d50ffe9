"""Corners by all pixels around them: the print, blurred and toned as the image is.

Around a corner at p + d, the image of a board is

    grey = (o + a . u) + (g + c . u) T(L),   T(L) = L + q L (1 - L),

with u the pixel from the corner and L the print, drawn through the map from pixels to the board
(see `finders.maps`) and convolved with the image's point-spread function (see `blur`). Both the
convolution and the shift d are products in Fourier space, at two samples a pixel, and so are all
derivatives. The unknowns of a corner are d, o and g; those of the image its blur and its tone q.
They are found by Gauss-Newton steps on some corners, with the corners eliminated (Schur
complement), and then d, o and g for all. The slopes a and c of uneven light are those of a
quadratic surface over the image. A patch ends half way to the next corners, so that no pixel counts
for two of them; the pixels of ChArUco markers are left out, but what blur carries out of them is
part of the model.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.dense.blur import DRAWN_PX, Blur, transfer
from visioncal.vision.dense.library import ONE_TORCH_THREAD, library
from visioncal.vision.dense.shown import Print, board_places
from visioncal.vision.finders.maps import maps_about

if TYPE_CHECKING:
    from torch import Tensor

# Half-width of the patch around a corner: in squares, and its bounds [px].
_HALF, _LEAST_PX, _MOST_PX = 0.5, 3.0, 32.0
# Taps of the smoothing.
_TAPS = 5
# The rim over which a patch fades into grey [px].
_TAPER_PX = 4
# Corners without which there is no fit.
_FEWEST = 6
# Maps are made anew so often, unless the corners stay where they were, as an rms [px].
_PASSES, _AT_REST_PX = 2, 0.02
# The width of a sharp edge, and of the widest that a search starts from [px].
_SHARP_PX, _MOST_START_PX = 0.45, 5.0
# Edges wider than this share of a square are measured as up to twice as wide as they are.
_WIDE = 0.18
# Corners that scatter so many times as much as they did before are none.
_SCATTERED = 1.2
# Tones beyond have no longer a light for each grey.
_MOST_TONE = 0.9
# Most that blur is modelled to carry into a patch [px].
_MOST_MARGIN_PX = 16.0
# Corners that measure the blur, and that choose where its search starts.
_BLUR_SAMPLE, _START_SAMPLE = 30, 12
# Turns of the search from each start, of the best one, and of the corners alone.
_START_TURNS, _BLUR_TURNS, _CORNER_TURNS = 4, 12, 6
# Steps that end the turns: of corners [px], and of the cost as a share of it.
_STILL_PX, _STILL = 0.001, 3e-5
# Damping to begin with.
_DAMPING = 1e-3
# No step of a corner is longer [px].
_MOST_STEP_PX = 1.0
# Pixels so near to a marker are left out [px]: ink spreads.
_CLEAR_PX = 0.5
# Most pixels of patches worked on at once, at two samples a pixel.
_MOST_SAMPLES = 8_000_000
# What a fit has to show; see `finders.template`.
_LAST_STEP_PX, _MOST_SHIFT, _LEAST_INSIDE, _LEAST_CONTRAST = 0.02, 0.3, 0.6, 0.1
_MISFIT_TIMES, _MISFIT_MORE, _MOST_MISFIT = 3.0, 0.05, 0.6
# A surface of the light takes so many corners, and has to leave less than this share of the cost.
_FEWEST_LIT, _LIT = 12, 0.995


@dataclass(frozen=True, eq=False)
class FittedCorners:
    """Corners of one image.

    Attributes:
        px: (n, 2) where they are; where they were where one could not be fitted [px].
        covariance: (n, 2, 2) by the residuals [px^2]; NaN where a corner could not be fitted.
        fitted: (n,) which could be.
        blur: The image's point-spread function.
        tone: q of the module.
        noise: Standard deviation of a pixel, by the residuals [grey levels].
        scatter_px: Rms distance of most corners from a smooth surface through them [px].
    """

    px: FloatArray
    covariance: FloatArray
    fitted: Mask
    blur: Blur
    tone: float
    noise: float
    scatter_px: float

    @property
    def sigma_px(self) -> FloatArray:
        """(n,) standard deviations of a coordinate [px]."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2))


def fit_corners(
    image: Image,
    target: Target,
    ids: IntArray,
    px: FloatArray,
    widths_px: FloatArray,
    *,
    device: str = "cpu",
    smooth_px: float = 0.0,
) -> FittedCorners | None:
    """Fits the corners of a checkerboard or a ChArUco board in one image.

    Args:
        image: (h, w) grey image.
        target: The board.
        ids: (n,) the corners' numbers.
        px: (n, 2) where the template has them [px].
        widths_px: (2,) widths of the edges along the board's x and y, as the template has them.
        device: What torch works on.
        smooth_px: Sigma of a smoothing of image and model alike, which takes away what
            demosaicing, sharpening and compression leave between neighbours; 0 for none [px].

    Returns:
        The corners, in the same order; None where they are too few, lie as no board's do, or
        scatter more than before.
    """
    board = board_places(target, ids)
    flat = all(np.linalg.matrix_rank(array - array.mean(axis=0)) == 2 for array in (board, px))
    if len(ids) < _FEWEST or not flat:
        return None
    torch = library("torch")
    with (
        ONE_TORCH_THREAD.held(),
        torch.inference_mode(),
        suppress(np.linalg.LinAlgError),
        np.errstate(all="ignore"),
    ):
        pixels = torch.as_tensor(np.ascontiguousarray(image), device=device)
        pixels = pixels.to(torch.float32)
        if smooth_px:
            smooth = library("kornia").filters.gaussian_blur2d
            pixels = smooth(pixels[None, None], (_TAPS, _TAPS), (smooth_px, smooth_px))[0, 0]
        scene = _ImageScene(pixels, Print.of(target), board, smooth_px)
        best = _started(scene, px, widths_px)
        found, good, jacobian = px, np.ones(len(px), bool), np.zeros((len(px), 2, 2))
        for _ in range(_PASSES):
            reach = Blur.of(best[:4]).reach_px
            patches = _Patches.cut(scene, found, good, np.arange(len(px)), reach, jacobian)
            sample = _spread(good, _BLUR_SAMPLE)
            best = _searched(patches.at(sample), best, _BLUR_TURNS)[0]
            shift, sums = _settled(patches, best)
            lit = replace(patches, jacobian=_light(patches, sums, good))
            tried, tried_sums = _settled(lit, best, shift)
            is_lit = tried_sums.cost(good) < _LIT * sums.cost(good)
            if is_lit:
                patches, shift, sums, jacobian = lit, tried, tried_sums, lit.jacobian
            moved = found + shift
            good = _good(patches, sums, moved - px)
            found = np.where(good[:, None], moved, px)
            # What hardly moves leaves maps and blur as they are.
            if not is_lit and np.sqrt(np.mean(shift[good] ** 2)) < _AT_REST_PX:
                break
        fitted = _fitted(patches, sums, shift, best, good, found)
        if fitted.scatter_px <= _SCATTERED * _scatter_px(board[good], px[good]):
            return fitted
    return None


@dataclass(frozen=True, eq=False)
class _ImageScene:
    """What is looked at.

    Attributes:
        pixels: (h, w) the image on the device, smoothed.
        printed: The board.
        board: (n, 2) the corners there [squares].
        smooth_px: Sigma of the smoothing; 0 for none [px].
    """

    pixels: "Tensor"
    printed: Print
    board: FloatArray
    smooth_px: float


@dataclass(frozen=True, eq=False)
class _Patches:
    """The pixels around n corners, and the print there as the maps draw it.

    Attributes:
        scene: What they are cut of.
        px: (n, 2) where the corners are when nothing is shifted [px].
        normals: (n, 2, 2) derivatives of the places on the board by pixels [squares a pixel].
        spectrum: (n, 2p, p + 1) of the print in patches of p pixels, two samples a pixel.
        grey: (n, w, w) the image, less 128.
        weights: (n, w, w) 1 for pixels that count, 0 for others.
        off: (n, 2, w) places of columns and rows from the corner [px].
        jacobian: (n, 2, 2) derivatives of offset and contrast by u and v [grey levels a pixel].
        inside: (n,) the share of a patch that is inside the image.
    """

    scene: _ImageScene
    px: FloatArray
    normals: FloatArray
    spectrum: "Tensor"
    grey: "Tensor"
    weights: "Tensor"
    off: "Tensor"
    jacobian: FloatArray
    inside: FloatArray

    @classmethod
    def cut(
        cls,
        scene: _ImageScene,
        px: FloatArray,
        good: Mask,
        chosen: IntArray,
        blur_px: float,
        jacobian: FloatArray,
    ) -> Self:
        """Cuts the patches of the chosen ones among corners, whose good ones make the maps."""
        torch = library("torch")
        on_board = maps_about(scene.board, px, good, chosen)[0]
        start = px[chosen]
        ends = on_board(start[:, None] + 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
        normals = np.stack([ends[:, 0] - ends[:, 1], ends[:, 2] - ends[:, 3]], axis=2)
        by_board = np.linalg.inv(normals)
        side_px = np.sqrt(np.abs(np.linalg.det(by_board)))
        half = np.clip(_HALF, _LEAST_PX / side_px, _MOST_PX / side_px)
        wanted = float(np.max(half * np.abs(by_board).sum(axis=2).max(axis=1)))
        reach = int(np.ceil(min(wanted, _MOST_PX)))
        margin = int(np.ceil(min(blur_px, _MOST_MARGIN_PX))) + 1
        size = _fast(2 * (reach + margin + _TAPER_PX))
        places = (np.arange(2 * size) - size) / 2
        centre = np.rint(start).astype(int)
        # A map is smooth: quartics through 5 x 5 of its values are as good as all.
        nodes = np.cos(np.pi * (np.arange(5) + 0.5) / 5)
        interpolation = np.vander(2 * places / size, 5) @ np.linalg.inv(np.vander(nodes, 5))
        grid = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) * size / 2
        values = on_board(centre[:, None] + grid).reshape(-1, 5, 5, 2)

        def tensor(array: npt.NDArray[Any]) -> "Tensor":
            return torch.as_tensor(array, dtype=torch.float32, device=scene.pixels.device)

        interpolation, corners = tensor(interpolation), tensor(scene.board[chosen])
        x, y = (interpolation @ tensor(values[..., axis]) @ interpolation.T for axis in (0, 1))
        widths = tensor(DRAWN_PX * np.linalg.norm(normals, axis=2))[:, :, None, None]
        board_x, board_y = (
            value + corners[:, axis, None, None] for axis, value in enumerate((x, y))
        )
        drawn = scene.printed.drawn(board_x, board_y, widths[:, 0], widths[:, 1])
        # What ends at the edge of a patch would ring all over it.
        fade = np.clip((size / 2 - np.abs(places)) / _TAPER_PX, 0.0, 1.0)
        fade = tensor(np.sin(np.pi / 2 * fade) ** 2)
        spectrum = torch.fft.rfft2((drawn - 0.5) * fade * fade[:, None])
        window = slice(size - 2 * reach, size + 2 * reach + 1, 2)
        x, y = (value[:, window, window] for value in (x, y))
        steps = np.arange(-reach, reach + 1)
        height, width = scene.pixels.shape
        rows, columns = centre[:, 1, None] + steps, centre[:, 0, None] + steps
        inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[
            :, None, :
        ]
        rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
        grey = scene.pixels[
            torch.as_tensor(rows[:, :, None], device=scene.pixels.device),
            torch.as_tensor(columns[:, None, :], device=scene.pixels.device),
        ]
        within = torch.maximum(x.abs(), y.abs()) < tensor(half)[:, None, None]
        if np.isfinite(scene.printed.inset):
            clear = scene.printed.inset - widths / DRAWN_PX * _CLEAR_PX
            middle = scene.printed.light_at(scene.board[chosen] + 0.5 * scene.printed.inset)
            sign = tensor(2.0 * middle - 1.0)[:, None, None]
            marker = (x.abs() > clear[:, 0]) & (y.abs() > clear[:, 1])
            within = within & ~(marker & (sign * x * y > 0))
        weights = within & torch.as_tensor(inside, device=scene.pixels.device)
        share = (weights.sum(dim=(1, 2)) / within.sum(dim=(1, 2))).cpu().numpy()
        off = np.stack([columns - start[:, :1], rows - start[:, 1:]], axis=1, dtype=float)
        return cls(
            scene,
            start,
            normals,
            spectrum,
            grey - 128.0,
            weights.to(torch.float32),
            tensor(off),
            jacobian[chosen],
            np.asarray(share, float),
        )

    def at(self, chosen: IntArray) -> Self:
        """The patches of some corners."""
        parts = (field for field in fields(self) if field.name != "scene")
        return replace(self, **{part.name: getattr(self, part.name)[chosen] for part in parts})

    def images(self, values: FloatArray, shift: FloatArray, *, blurs: bool) -> "Tensor":
        """The blurred print, and its derivatives by the shift and, if asked for, by the blur.

        Returns:
            (n, 3 or 7, w, w): 0 in the dark and 1 in the light.
        """
        torch, device = library("torch"), self.grey.device
        size, reach = self.spectrum.shape[-1] - 1, self.grey.shape[-1] // 2
        wu = 2 * np.pi * torch.fft.rfftfreq(2 * size, 0.5, dtype=torch.float64, device=device)
        wv = 2 * np.pi * torch.fft.fftfreq(2 * size, 0.5, dtype=torch.float64, device=device)
        otf = transfer(Blur.of(values[:4]), wu, wv[:, None])
        if self.scene.smooth_px:
            otf *= _kept(self.scene.smooth_px, wu) * _kept(self.scene.smooth_px, wv)[:, None]
        otf = otf.to(torch.float32)
        at = torch.as_tensor(shift, device=device)
        along_u = torch.exp(-1j * wu * at[:, :1]).to(torch.complex64)
        along_v = torch.exp(-1j * wv * at[:, 1:]).to(torch.complex64)
        base = self.spectrum * along_u[:, None] * along_v[:, :, None]
        blurred = base * otf[0]
        wu, wv = wu.to(torch.float32), wv.to(torch.float32)
        parts = [blurred, -1j * wu * blurred, -1j * wv[:, None] * blurred]
        if blurs:
            parts += [base * value for value in otf[1:]]
        folded = torch.stack([_folded(part) for part in parts], dim=1)
        found = torch.fft.irfft2(folded, s=(size, size))
        window = slice(size // 2 - reach, size // 2 + reach + 1)
        found = found[..., window, window]
        found[:, 0] += 0.5
        return found

    def columns(self, values: FloatArray, shift: FloatArray, *, blurs: bool) -> "Tensor":
        """(n, c, w w) columns of the fit and the image, zero where pixels do not count."""
        # They are 1, T, its derivatives by the shift and, if asked for, by blur and tone, and what
        # the slopes leave of the image.
        torch = library("torch")
        found, q = self.images(values, shift, blurs=blurs), float(values[4])
        light = found[:, 0]
        toned = light + q * light * (1.0 - light)
        found[:, 1:] *= (1.0 + q * (1.0 - 2.0 * light))[:, None]
        jacobian = torch.as_tensor(self.jacobian, dtype=torch.float32, device=self.grey.device)
        plane = torch.einsum("nlk,nkw->nlkw", jacobian, self.off)
        offset, gain = (plane[:, of, 0, None, :] + plane[:, of, 1, :, None] for of in (0, 1))
        parts = [torch.ones_like(light), toned, found[:, 1], found[:, 2]]
        if blurs:
            parts += [*found[:, 3:].unbind(dim=1), light * (1.0 - light)]
        parts.append(self.grey - offset - gain * toned)
        return (torch.stack(parts, dim=1) * self.weights[:, None]).flatten(2)


def _kept(smooth_px: float, w: "Tensor") -> "Tensor":
    """What smoothing leaves of angular frequencies w [rad/px]."""
    kernel = library("kornia").filters.get_gaussian_kernel1d
    taps = kernel(_TAPS, smooth_px, device=w.device, dtype=w.dtype)[0]
    return sum(
        taps[index] * library("torch").cos((index - _TAPS // 2) * w) for index in range(_TAPS)
    )


def _folded(spectrum: "Tensor") -> "Tensor":
    """Of the spectrum of (2p, 2p) samples, that of every other sample."""
    torch = library("torch")
    size = spectrum.shape[-1] - 1
    rows = spectrum[:, :size] + spectrum[:, size:]
    turned = torch.roll(torch.flip(rows, (1,)), 1, 1)
    half = size // 2 + 1
    return (rows[..., :half] + torch.flip(turned, (2,))[..., :half].conj()) / 4


def _fast(size: int) -> int:
    """The next even number of samples whose Fourier transform is quick."""
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1 and size % 2 == 0:
            return size
        size += 1


@dataclass(frozen=True, eq=False)
class _Sums:
    """What a Gauss-Newton step takes of the pixels of n corners.

    Attributes:
        levels: (n, 2) offset and contrast that fit best.
        normal: (n, c, c) products of the derivatives by offset, contrast, shift, blur and tone.
        right: (n, c) their products with the residuals.
        squares: (n,) of the residuals.
        pixels: (n,) how many there are.
    """

    levels: FloatArray
    normal: FloatArray
    right: FloatArray
    squares: FloatArray
    pixels: FloatArray

    @classmethod
    def of(cls, patches: _Patches, values: FloatArray, shift: FloatArray, *, blurs: bool) -> Self:
        """Sums over the pixels, by parts that fit into memory."""
        samples = 2 * patches.spectrum[0].numel() * (8 if blurs else 4)
        step = max(1, _MOST_SAMPLES // samples)
        sums = []
        for low in range(0, len(shift), step):
            part = np.arange(low, min(low + step, len(shift)))
            columns = patches.at(part).columns(values, shift[part], blurs=blurs)
            sums.append((columns @ columns.transpose(1, 2)).cpu().numpy().astype(float))
        total = np.concatenate(sums)
        own = total[:, :2, :2] + 1e-6 * np.eye(2)
        levels = np.linalg.solve(own, total[:, :2, -1:])[..., 0]
        right = total[:, :-1, -1] - np.einsum("ncl,nl->nc", total[:, :-1, :2], levels)
        squares = total[:, -1, -1] - np.einsum("nl,nl->n", total[:, :2, -1], levels)
        scale = np.repeat(levels[:, 1:], total.shape[1] - 1, axis=1)
        scale[:, :2] = 1.0
        normal = total[:, :-1, :-1] * scale[:, :, None] * scale[:, None, :]
        return cls(levels, normal, right * scale, np.maximum(squares, 0.0), total[:, 0, 0])

    @property
    def inverse(self) -> FloatArray:
        """(n, 4, 4) of the products of what is a corner's own."""
        own = self.normal[:, :4, :4]
        scale = np.sqrt(np.einsum("nii->ni", own)) + 1e-9
        scales = scale[:, :, None] * scale[:, None, :]
        return np.asarray(np.linalg.inv(own / scales + 1e-7 * np.eye(4)) / scales)

    @property
    def misfit(self) -> FloatArray:
        """(n,) rms of the residuals over the contrast."""
        variance = self.squares / np.maximum(self.pixels - 4.0, 1.0)
        return np.asarray(np.sqrt(variance) / np.abs(self.levels[:, 1]))

    def cost(self, good: Mask) -> float:
        """The squared residuals of some corners."""
        return float(np.sum(self.squares[good]))

    def shifts(self) -> FloatArray:
        """(n, 2) by how much the corners have to move, blur and tone given [px]."""
        return _bounded((self.inverse @ self.right[:, :4, None])[:, 2:, 0])

    def steps(self, good: Mask, damping: float) -> tuple[FloatArray, FloatArray]:
        """By how much blur and tone have to change (5,), and the corners to move (n, 2) [px]."""
        inverse, cross = self.inverse, self.normal[:, :4, 4:]
        kept = np.swapaxes(cross, 1, 2) @ inverse
        reduced = (self.normal[:, 4:, 4:] - kept @ cross)[good].sum(axis=0)
        right = (self.right[:, 4:] - (kept @ self.right[:, :4, None])[..., 0])[good].sum(axis=0)
        diagonal = np.diag(reduced) + 1e-9 * np.trace(reduced) + 1e-12
        shared = np.linalg.solve(reduced + damping * np.diag(diagonal), right)
        own = (inverse @ (self.right[:, :4] - cross @ shared)[..., None])[:, 2:, 0]
        return shared, _bounded(own)


def _bounded(shift: FloatArray) -> FloatArray:
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    bounded = shift * np.minimum(1.0, _MOST_STEP_PX / np.maximum(length, 1e-12))
    return np.where(np.isfinite(length), bounded, 0.0)


def _within(values: FloatArray) -> FloatArray:
    """Blur and tone within what can be."""
    return np.append(Blur.of(values[:4]).values, np.clip(values[4], -_MOST_TONE, _MOST_TONE))


def _searched(patches: _Patches, values: FloatArray, turns: int) -> tuple[FloatArray, float]:
    """Blur and tone that fit some corners best, and what they leave, by Levenberg's steps."""
    shift, damping = np.zeros((len(patches.px), 2)), _DAMPING
    sums = _Sums.of(patches, values, shift, blurs=True)
    good = _alike(sums.misfit)
    for _ in range(turns):
        shared, own = sums.steps(good, damping)
        tried = _within(values + shared)
        tried_sums = _Sums.of(patches, tried, shift + own, blurs=True)
        gain = 1.0 - tried_sums.cost(good) / sums.cost(good)
        if gain > 0.0:
            values, shift, sums, damping = tried, shift + own, tried_sums, damping / 10
        else:
            damping *= 10
        if abs(gain) < _STILL or damping > 1e6:
            break
    return values, sums.cost(good) / float(sums.pixels[good].sum())


def _started(scene: _ImageScene, px: FloatArray, widths_px: FloatArray) -> FloatArray:
    """Blur and tone near the best, from the widths of edges along the board's x and y."""
    good = np.ones(len(px), bool)
    sample = _spread(good, _START_SAMPLE)
    wide = np.clip(np.nan_to_num(widths_px, nan=1.0), _SHARP_PX, _MOST_START_PX)
    reach = 3.0 * float(wide.max()) + 2.0
    patches = _Patches.cut(scene, px, good, sample, reach, np.zeros((len(px), 2, 2)))
    normals = np.median(patches.normals, axis=0)
    starts = [*_starts(normals, wide)]
    if np.linalg.norm(normals, axis=1).max() * wide.max() > _WIDE:
        starts += _starts(normals, np.maximum(wide / 2, _SHARP_PX))
    found = [_searched(patches, np.append(start, 0.0), _START_TURNS) for start in starts]
    return min(found, key=lambda pair: pair[1])[0]


def _starts(normals: FloatArray, wide: FloatArray) -> Iterator[FloatArray]:
    """(4,) values of blurs whose edges are as wide as those that were measured."""
    directions = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    more = np.sqrt(wide**2 - _SHARP_PX**2)
    some = 0.3
    mean = float(np.sqrt(np.mean(wide**2)))
    yield np.array([mean, some, some, some])
    if mean < 1.2 * _SHARP_PX:
        return
    yield np.array([_SHARP_PX, 2.0 * np.sqrt(np.mean(more**2)), some, some])
    for sign in (1.0, -1.0):
        line = np.linalg.solve(directions, np.sqrt(12.0) * more * np.array([1.0, sign]))
        yield np.array([_SHARP_PX, some, *line])
    along = directions[np.argmax(wide)] * np.sqrt(12.0 * (wide.max() ** 2 - wide.min() ** 2))
    yield np.array([_SHARP_PX, max(2.0 * float(more.min()), some), *along])


def _settled(
    patches: _Patches, values: FloatArray, shift: FloatArray | None = None
) -> tuple[FloatArray, _Sums]:
    """Where the corners are from where they were (n, 2) [px], and the last sums."""
    shift = np.zeros((len(patches.px), 2)) if shift is None else shift
    sums = _Sums.of(patches, values, shift, blurs=False)
    for _ in range(_CORNER_TURNS):
        step = sums.shifts()
        shift = shift + step
        sums = _Sums.of(patches, values, shift, blurs=False)
        if np.median(np.linalg.norm(step, axis=1)) < _STILL_PX:
            break
    return shift, sums


def _light(patches: _Patches, sums: _Sums, good: Mask) -> FloatArray:
    """(n, 2, 2) slopes of offset and contrast, by a quadratic surface over the image."""
    good = good & _alike(sums.misfit)
    if good.sum() < _FEWEST_LIT:
        return np.zeros_like(patches.jacobian)
    middle = patches.px.mean(axis=0)
    scale = float(np.abs(patches.px - middle).max())
    u, v = ((patches.px - middle) / scale).T
    one, none = np.ones_like(u), np.zeros_like(u)
    terms = np.stack([one, u, v, u * u, u * v, v * v], axis=1)
    by_u = np.stack([none, one, none, 2 * u, v, none], axis=1)
    by_v = np.stack([none, none, one, none, u, 2 * v], axis=1)
    surface = np.linalg.lstsq(terms[good], sums.levels[good], rcond=None)[0]
    return np.stack([by_u @ surface, by_v @ surface], axis=2) / scale


def _alike(misfit: FloatArray) -> Mask:
    """Which corners are as like their print as most are; what is not a number is not."""
    median = float(np.median(misfit[np.isfinite(misfit)])) if np.isfinite(misfit).any() else 0.0
    return misfit < min(_MISFIT_TIMES * median + _MISFIT_MORE, _MOST_MISFIT)


def _good(patches: _Patches, sums: _Sums, moved_px: FloatArray) -> Mask:
    """Which corners can be used; see `finders.template`."""
    contrast = sums.levels[:, 1] * np.sign(np.median(sums.levels[:, 1]))
    moved = np.linalg.norm((patches.normals @ moved_px[..., None])[..., 0], axis=1)
    return np.asarray(
        _alike(sums.misfit)
        & (patches.inside >= _LEAST_INSIDE)
        & (contrast > _LEAST_CONTRAST * np.median(contrast))
        & (np.linalg.norm(sums.shifts(), axis=1) < _LAST_STEP_PX)
        & (moved < _MOST_SHIFT)
    )


def _fitted(
    patches: _Patches,
    sums: _Sums,
    shift: FloatArray,
    values: FloatArray,
    good: Mask,
    found: FloatArray,
) -> FittedCorners:
    """The corners with their covariance, by what is odd of the residuals about them."""
    levels = np.concatenate([sums.levels, np.zeros((len(good), 2))], axis=1)
    variance = _odd_variance(patches, values, shift, levels[:, :2])
    if patches.scene.smooth_px:
        # White noise that was smoothed counts for as much as there was before.
        taps = cv2.getGaussianKernel(_TAPS, patches.scene.smooth_px)
        variance = variance / float(np.sum(taps**2)) ** 2
    noise = float(np.sqrt(np.median(variance[good]))) if good.any() else np.nan
    covariance = np.where(good[:, None, None], noise**2 * sums.inverse[:, 2:, 2:], np.nan)
    return FittedCorners(
        found,
        covariance,
        good,
        Blur.of(values[:4]),
        float(values[4]),
        noise,
        _scatter_px(patches.scene.board[good], found[good]),
    )


def _odd_variance(
    patches: _Patches, values: FloatArray, shift: FloatArray, levels: FloatArray
) -> FloatArray:
    """(n,) variance of a pixel: what is even about a corner does not move it."""
    torch = library("torch")
    columns = patches.columns(values, shift, blurs=False)
    fit = torch.as_tensor(levels, dtype=torch.float32, device=columns.device)
    rest = columns[:, -1] - fit[:, :1] * columns[:, 0] - fit[:, 1:] * columns[:, 1]
    both = columns[:, 0] * columns[:, 0].flip(1)
    odd = (rest - rest.flip(1)) ** 2 / 2
    sums = torch.stack([(odd * both).sum(dim=1), both.sum(dim=1)]).cpu().numpy().astype(float)
    return np.asarray(sums[0] / np.maximum(sums[1] - 2.0, 1.0))


def _scatter_px(board: FloatArray, px: FloatArray) -> float:
    """Rms distance of most corners from a homography with a cubic on top [px]; 0 for few."""
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    if len(px) <= len(powers):
        return 0.0
    middle, scale = board.mean(axis=0), float(np.abs(board - board.mean(axis=0)).max())
    places = (board - middle) / scale
    homography = cv2.findHomography(places, px)[0]
    if homography is None:
        raise np.linalg.LinAlgError
    off = px - cv2.perspectiveTransform(places[None], homography)[0]
    terms = np.stack([places[:, 0] ** i * places[:, 1] ** j for i, j in powers], axis=1)
    off = off - terms @ np.linalg.lstsq(terms, off, rcond=None)[0]
    squares = np.sum(off**2, axis=1)
    return float(np.sqrt(np.mean(squares[squares <= 9.0 * np.median(squares)])))


def _spread(good: Mask, most: int) -> IntArray:
    """Some of the good corners, spread over the board."""
    every = np.flatnonzero(good)
    return every[:: -(-len(every) // most)]

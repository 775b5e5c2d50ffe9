"""Dense corner fitting: the rendered print, blurred and toned, is fitted to all pixels.

Around a corner at p + d, the image of a board is

    grey = (o + a . u) + (g + c . u) T(L),   T(L) = L + q L (1 - L),

with u the pixel relative to the corner and L the print, rendered through the map from pixels to the
board (see `finders.maps`) and convolved with the image's point-spread function (see `blur`). The
convolution, the shift d and all derivatives are products in Fourier space, at two samples per
pixel. A corner's unknowns are d, o and g; the image's are its blur and its tone q. They are
estimated by Gauss-Newton steps on some corners, with the corners' unknowns eliminated (Schur
complement), followed by d, o and g of all corners. The gradients a and c of uneven illumination are
those of a quadratic surface over the image. A patch ends half way to the next corners, so that no
pixel counts twice; pixels of ChArUco markers are excluded, but the blur that they cause is
modelled.
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
from visioncal.vision.dense.board_rendering import Print, board_positions
from visioncal.vision.dense.library import ONE_TORCH_THREAD, library
from visioncal.vision.finders.maps import maps_about

if TYPE_CHECKING:
    from torch import Tensor

# Half-width of the patch around a corner in squares, and its bounds [px].
_HALF, _LEAST_PX, _MOST_PX = 0.5, 3.0, 32.0
# Taps of the smoothing filter.
_TAPS = 5
# Width of the rim over which a patch fades to grey [px].
_TAPER_PX = 4
# Minimum number of corners.
_MIN_CORNERS = 6
# Number of passes with new maps, and the rms shift that ends them [px].
_PASSES, _CONVERGED_PX = 2, 0.02
# Edge width of a sharp image, and the largest that a search starts from [px].
_SHARP_PX, _MOST_START_PX = 0.45, 5.0
# Measured widths beyond this share of a square may be up to twice the true width.
_WIDE = 0.18
# A fit whose corners scatter by more than this factor of the start is rejected.
_MAX_SCATTER_RATIO = 1.2
# Larger tones are not invertible.
_MOST_TONE = 0.9
# Largest margin around a patch for blur from outside [px].
_MOST_MARGIN_PX = 16.0
# Number of corners that estimate the blur, and that select the start of its search.
_BLUR_SAMPLE, _START_SAMPLE = 30, 12
# Iterations from each start, from the best one, and for the corners alone.
_START_ITERATIONS, _BLUR_ITERATIONS, _CORNER_ITERATIONS = 4, 12, 6
# Convergence: corner step [px], and relative change of the cost.
_STEP_TOLERANCE_PX, _COST_TOLERANCE = 0.001, 3e-5
# Initial damping.
_DAMPING = 1e-3
# Longest step of a corner [px].
_MOST_STEP_PX = 1.0
# Pixels this close to a marker are excluded, as ink spreads [px].
_CLEAR_PX = 0.5
# Largest number of samples processed at once.
_MOST_SAMPLES = 8_000_000
# Acceptance limits of a corner; see `finders.template`.
_LAST_STEP_PX, _MOST_SHIFT, _LEAST_INSIDE, _LEAST_CONTRAST = 0.02, 0.3, 0.6, 0.1
_MISFIT_TIMES, _MISFIT_MORE, _MOST_MISFIT = 3.0, 0.05, 0.6
# Minimum corners for an illumination surface, and the cost ratio that it has to reach.
_MIN_LIGHT_CORNERS, _LIGHT_COST_RATIO = 12, 0.995


@dataclass(frozen=True, eq=False)
class FittedCorners:
    """Fitted corners of one image.

    Attributes:
        px: (n, 2) positions; the given ones where the fit failed [px].
        covariance: (n, 2, 2) from the residuals [px^2]; NaN where the fit failed.
        fitted: (n,) mask of successful fits.
        blur: Point-spread function of the image.
        tone: Tone q of the module's model.
        noise: Standard deviation of a pixel, from the residuals [grey levels].
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
        target: Board.
        ids: (n,) corner ids.
        px: (n, 2) corners by template matching [px].
        widths_px: (2,) edge widths along the board's x and y, by template matching [px].
        device: torch device.
        smooth_px: Sigma of a smoothing of both image and model, which removes correlations between
            neighbouring pixels from demosaicing, sharpening and compression; 0 for none [px].

    Returns:
        The corners in the same order; None if they are too few, do not form a board, or scatter
        more than before.
    """
    board = board_positions(target, ids)
    flat = all(np.linalg.matrix_rank(array - array.mean(axis=0)) == 2 for array in (board, px))
    if len(ids) < _MIN_CORNERS or not flat:
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
        values = _initial_blur(scene, px, widths_px)
        positions, good, jacobian = px, np.ones(len(px), bool), np.zeros((len(px), 2, 2))
        for _ in range(_PASSES):
            reach = Blur.of(values[:4]).reach_px
            patches = _Patches.cut(scene, positions, good, np.arange(len(px)), reach, jacobian)
            sample = _subsample(good, _BLUR_SAMPLE)
            values = _fit_blur(patches.at(sample), values, _BLUR_ITERATIONS)[0]
            shift, sums = _fit_positions(patches, values)
            relit = replace(patches, jacobian=_light_gradients(patches, sums, good))
            relit_shift, relit_sums = _fit_positions(relit, values, shift)
            is_lit = relit_sums.cost(good) < _LIGHT_COST_RATIO * sums.cost(good)
            if is_lit:
                patches, shift, sums, jacobian = relit, relit_shift, relit_sums, relit.jacobian
            shifted = positions + shift
            good = _accepted(patches, sums, shifted - px)
            positions = np.where(good[:, None], shifted, px)
            # Small shifts do not change the maps and the blur.
            if not is_lit and np.sqrt(np.mean(shift[good] ** 2)) < _CONVERGED_PX:
                break
        fitted = _result(patches, sums, shift, values, good, positions)
        if fitted.scatter_px <= _MAX_SCATTER_RATIO * _scatter_px(board[good], px[good]):
            return fitted
    return None


@dataclass(frozen=True, eq=False)
class _ImageScene:
    """An image and its board.

    Attributes:
        pixels: (h, w) image on the device, smoothed.
        printed: The board's print.
        board: (n, 2) corners on the board [squares].
        smooth_px: Sigma of the smoothing; 0 for none [px].
    """

    pixels: "Tensor"
    printed: Print
    board: FloatArray
    smooth_px: float


@dataclass(frozen=True, eq=False)
class _Patches:
    """Pixels around n corners, and the print there, rendered through the maps.

    Attributes:
        scene: Image and board.
        px: (n, 2) corner positions before any shift [px].
        normals: (n, 2, 2) Jacobians of board positions with respect to pixels [squares/px].
        spectrum: (n, 2p, p + 1) spectrum of the print in patches of p pixels, two samples per
            pixel.
        grey: (n, w, w) image, less 128.
        weights: (n, w, w) 1 for pixels in the fit, 0 for others.
        off: (n, 2, w) columns and rows relative to the corner [px].
        jacobian: (n, 2, 2) derivatives of offset and contrast by u and v [grey levels/px].
        inside: (n,) share of a patch inside the image.
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
        """Cuts the patches of the chosen corners; the good corners determine the maps."""
        torch = library("torch")
        on_board = maps_about(scene.board, px, good, chosen)[0]
        start = px[chosen]
        ends = on_board(start[:, None] + 0.5 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
        normals = np.stack([ends[:, 0] - ends[:, 1], ends[:, 2] - ends[:, 3]], axis=2)
        by_board = np.linalg.inv(normals)
        side_px = np.sqrt(np.abs(np.linalg.det(by_board)))
        half = np.clip(_HALF, _LEAST_PX / side_px, _MOST_PX / side_px)
        needed_px = float(np.max(half * np.abs(by_board).sum(axis=2).max(axis=1)))
        reach = int(np.ceil(min(needed_px, _MOST_PX)))
        margin = int(np.ceil(min(blur_px, _MOST_MARGIN_PX))) + 1
        size = _fft_size(2 * (reach + margin + _TAPER_PX))
        samples = (np.arange(2 * size) - size) / 2
        centre = np.rint(start).astype(int)
        # The map is smooth, so quartics through 5 x 5 nodes replace its evaluation at all samples.
        nodes = np.cos(np.pi * (np.arange(5) + 0.5) / 5)
        interpolation = np.vander(2 * samples / size, 5) @ np.linalg.inv(np.vander(nodes, 5))
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
        # A hard edge of the patch would cause ringing.
        fade = np.clip((size / 2 - np.abs(samples)) / _TAPER_PX, 0.0, 1.0)
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
        parts = (field for field in fields(self) if field.name != "scene")
        return replace(self, **{part.name: getattr(self, part.name)[chosen] for part in parts})

    def images(self, values: FloatArray, shift: FloatArray, *, blurs: bool) -> "Tensor":
        """The blurred print, and its derivatives by the shift and optionally by the blur.

        Returns:
            (n, 3 or 7, w, w) with 0 for dark and 1 for light.
        """
        torch, device = library("torch"), self.grey.device
        size, reach = self.spectrum.shape[-1] - 1, self.grey.shape[-1] // 2
        wu = 2 * np.pi * torch.fft.rfftfreq(2 * size, 0.5, dtype=torch.float64, device=device)
        wv = 2 * np.pi * torch.fft.fftfreq(2 * size, 0.5, dtype=torch.float64, device=device)
        otf = transfer(Blur.of(values[:4]), wu, wv[:, None])
        if self.scene.smooth_px:
            otf *= (
                _smoothing_transfer(self.scene.smooth_px, wu)
                * _smoothing_transfer(self.scene.smooth_px, wv)[:, None]
            )
        otf = otf.to(torch.float32)
        offset = torch.as_tensor(shift, device=device)
        along_u = torch.exp(-1j * wu * offset[:, :1]).to(torch.complex64)
        along_v = torch.exp(-1j * wv * offset[:, 1:]).to(torch.complex64)
        base = self.spectrum * along_u[:, None] * along_v[:, :, None]
        blurred = base * otf[0]
        wu, wv = wu.to(torch.float32), wv.to(torch.float32)
        parts = [blurred, -1j * wu * blurred, -1j * wv[:, None] * blurred]
        if blurs:
            parts += [base * value for value in otf[1:]]
        folded = torch.stack([_decimated(part) for part in parts], dim=1)
        images = torch.fft.irfft2(folded, s=(size, size))
        window = slice(size // 2 - reach, size // 2 + reach + 1)
        images = images[..., window, window]
        images[:, 0] += 0.5
        return images

    def columns(self, values: FloatArray, shift: FloatArray, *, blurs: bool) -> "Tensor":
        """(n, c, w w) columns of the least-squares problem, zero for excluded pixels."""
        # The columns are 1, T, its derivatives by the shift and optionally by blur and tone, and
        # the image less its illumination gradients.
        torch = library("torch")
        images, q = self.images(values, shift, blurs=blurs), float(values[4])
        light = images[:, 0]
        toned = light + q * light * (1.0 - light)
        images[:, 1:] *= (1.0 + q * (1.0 - 2.0 * light))[:, None]
        jacobian = torch.as_tensor(self.jacobian, dtype=torch.float32, device=self.grey.device)
        plane = torch.einsum("nlk,nkw->nlkw", jacobian, self.off)
        offset, gain = (plane[:, of, 0, None, :] + plane[:, of, 1, :, None] for of in (0, 1))
        parts = [torch.ones_like(light), toned, images[:, 1], images[:, 2]]
        if blurs:
            parts += [*images[:, 3:].unbind(dim=1), light * (1.0 - light)]
        parts.append(self.grey - offset - gain * toned)
        return (torch.stack(parts, dim=1) * self.weights[:, None]).flatten(2)


def _smoothing_transfer(smooth_px: float, w: "Tensor") -> "Tensor":
    """Transfer function of the smoothing filter at angular frequencies w [rad/px]."""
    kernel = library("kornia").filters.get_gaussian_kernel1d
    taps = kernel(_TAPS, smooth_px, device=w.device, dtype=w.dtype)[0]
    return sum(
        taps[index] * library("torch").cos((index - _TAPS // 2) * w) for index in range(_TAPS)
    )


def _decimated(spectrum: "Tensor") -> "Tensor":
    """Spectrum of every other sample, from the spectrum of (2p, 2p) samples."""
    torch = library("torch")
    size = spectrum.shape[-1] - 1
    rows = spectrum[:, :size] + spectrum[:, size:]
    mirrored = torch.roll(torch.flip(rows, (1,)), 1, 1)
    half = size // 2 + 1
    return (rows[..., :half] + torch.flip(mirrored, (2,))[..., :half].conj()) / 4


def _fft_size(size: int) -> int:
    """The next even size with small prime factors, for a fast Fourier transform."""
    while True:
        remainder = size
        for prime in (2, 3, 5):
            while remainder % prime == 0:
                remainder //= prime
        if remainder == 1 and size % 2 == 0:
            return size
        size += 1


@dataclass(frozen=True, eq=False)
class _Sums:
    """Normal equations of a Gauss-Newton step for n corners.

    Attributes:
        levels: (n, 2) best-fitting offset and contrast.
        normal: (n, c, c) normal matrices for offset, contrast, shift, blur and tone.
        right: (n, c) right-hand sides.
        squares: (n,) sums of squared residuals.
        pixels: (n,) numbers of pixels.
    """

    levels: FloatArray
    normal: FloatArray
    right: FloatArray
    squares: FloatArray
    pixels: FloatArray

    @classmethod
    def of(cls, patches: _Patches, values: FloatArray, shift: FloatArray, *, blurs: bool) -> Self:
        """Accumulates over the pixels, in chunks that fit into memory."""
        samples = 2 * patches.spectrum[0].numel() * (8 if blurs else 4)
        step = max(1, _MOST_SAMPLES // samples)
        sums = []
        for low in range(0, len(shift), step):
            part = np.arange(low, min(low + step, len(shift)))
            columns = patches.at(part).columns(values, shift[part], blurs=blurs)
            sums.append((columns @ columns.transpose(1, 2)).cpu().numpy().astype(float))
        total = np.concatenate(sums)
        level_normal = total[:, :2, :2] + 1e-6 * np.eye(2)
        levels = np.linalg.solve(level_normal, total[:, :2, -1:])[..., 0]
        right = total[:, :-1, -1] - np.einsum("ncl,nl->nc", total[:, :-1, :2], levels)
        squares = total[:, -1, -1] - np.einsum("nl,nl->n", total[:, :2, -1], levels)
        scale = np.repeat(levels[:, 1:], total.shape[1] - 1, axis=1)
        scale[:, :2] = 1.0
        normal = total[:, :-1, :-1] * scale[:, :, None] * scale[:, None, :]
        return cls(levels, normal, right * scale, np.maximum(squares, 0.0), total[:, 0, 0])

    @property
    def inverse(self) -> FloatArray:
        """(n, 4, 4) inverse normal matrices of the corners' own unknowns."""
        corner_normal = self.normal[:, :4, :4]
        scale = np.sqrt(np.einsum("nii->ni", corner_normal)) + 1e-9
        scales = scale[:, :, None] * scale[:, None, :]
        return np.asarray(np.linalg.inv(corner_normal / scales + 1e-7 * np.eye(4)) / scales)

    @property
    def misfit(self) -> FloatArray:
        """(n,) rms residual relative to the contrast."""
        variance = self.squares / np.maximum(self.pixels - 4.0, 1.0)
        return np.asarray(np.sqrt(variance) / np.abs(self.levels[:, 1]))

    def cost(self, good: Mask) -> float:
        return float(np.sum(self.squares[good]))

    def shifts(self) -> FloatArray:
        """(n, 2) Gauss-Newton steps of the corners at fixed blur and tone [px]."""
        return _limited((self.inverse @ self.right[:, :4, None])[:, 2:, 0])

    def steps(self, good: Mask, damping: float) -> tuple[FloatArray, FloatArray]:
        """Steps of blur and tone (5,), and of the corners (n, 2) [px]."""
        inverse, cross = self.inverse, self.normal[:, :4, 4:]
        kept = np.swapaxes(cross, 1, 2) @ inverse
        reduced = (self.normal[:, 4:, 4:] - kept @ cross)[good].sum(axis=0)
        right = (self.right[:, 4:] - (kept @ self.right[:, :4, None])[..., 0])[good].sum(axis=0)
        diagonal = np.diag(reduced) + 1e-9 * np.trace(reduced) + 1e-12
        shared = np.linalg.solve(reduced + damping * np.diag(diagonal), right)
        corner_steps = (inverse @ (self.right[:, :4] - cross @ shared)[..., None])[:, 2:, 0]
        return shared, _limited(corner_steps)


def _limited(shift: FloatArray) -> FloatArray:
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    bounded = shift * np.minimum(1.0, _MOST_STEP_PX / np.maximum(length, 1e-12))
    return np.where(np.isfinite(length), bounded, 0.0)


def _fit_blur(patches: _Patches, values: FloatArray, iterations: int) -> tuple[FloatArray, float]:
    """Blur and tone fitted to some corners, and the mean square residual (Levenberg-Marquardt)."""
    shift, damping = np.zeros((len(patches.px), 2)), _DAMPING
    sums = _Sums.of(patches, values, shift, blurs=True)
    good = _similar_misfit(sums.misfit)
    for _ in range(iterations):
        shared, corner_steps = sums.steps(good, damping)
        tried = values + shared
        tone = np.clip(tried[4], -_MOST_TONE, _MOST_TONE)
        tried = np.append(Blur.of(tried[:4]).values, tone)
        tried_sums = _Sums.of(patches, tried, shift + corner_steps, blurs=True)
        gain = 1.0 - tried_sums.cost(good) / sums.cost(good)
        if gain > 0.0:
            values, shift, sums, damping = tried, shift + corner_steps, tried_sums, damping / 10
        else:
            damping *= 10
        if abs(gain) < _COST_TOLERANCE or damping > 1e6:
            break
    return values, sums.cost(good) / float(sums.pixels[good].sum())


def _initial_blur(scene: _ImageScene, px: FloatArray, widths_px: FloatArray) -> FloatArray:
    """Best start for blur and tone, from the edge widths along the board's x and y."""
    good = np.ones(len(px), bool)
    sample = _subsample(good, _START_SAMPLE)
    widths = np.clip(np.nan_to_num(widths_px, nan=1.0), _SHARP_PX, _MOST_START_PX)
    reach = 3.0 * float(widths.max()) + 2.0
    patches = _Patches.cut(scene, px, good, sample, reach, np.zeros((len(px), 2, 2)))
    normals = np.median(patches.normals, axis=0)
    starts = [*_blur_candidates(normals, widths)]
    if np.linalg.norm(normals, axis=1).max() * widths.max() > _WIDE:
        starts += _blur_candidates(normals, np.maximum(widths / 2, _SHARP_PX))
    fits = [_fit_blur(patches, np.append(start, 0.0), _START_ITERATIONS) for start in starts]
    return min(fits, key=lambda pair: pair[1])[0]


def _blur_candidates(normals: FloatArray, widths: FloatArray) -> Iterator[FloatArray]:
    """(4,) parameters of blurs with the measured edge widths."""
    directions = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    excess = np.sqrt(widths**2 - _SHARP_PX**2)
    little = 0.3
    mean = float(np.sqrt(np.mean(widths**2)))
    yield np.array([mean, little, little, little])
    if mean < 1.2 * _SHARP_PX:
        return
    yield np.array([_SHARP_PX, 2.0 * np.sqrt(np.mean(excess**2)), little, little])
    for sign in (1.0, -1.0):
        line = np.linalg.solve(directions, np.sqrt(12.0) * excess * np.array([1.0, sign]))
        yield np.array([_SHARP_PX, little, *line])
    motion = directions[np.argmax(widths)] * np.sqrt(12.0 * (widths.max() ** 2 - widths.min() ** 2))
    yield np.array([_SHARP_PX, max(2.0 * float(excess.min()), little), *motion])


def _fit_positions(
    patches: _Patches, values: FloatArray, shift: FloatArray | None = None
) -> tuple[FloatArray, _Sums]:
    """Corner shifts (n, 2) [px] at fixed blur and tone, and the final sums."""
    shift = np.zeros((len(patches.px), 2)) if shift is None else shift
    sums = _Sums.of(patches, values, shift, blurs=False)
    for _ in range(_CORNER_ITERATIONS):
        step = sums.shifts()
        shift = shift + step
        sums = _Sums.of(patches, values, shift, blurs=False)
        if np.median(np.linalg.norm(step, axis=1)) < _STEP_TOLERANCE_PX:
            break
    return shift, sums


def _light_gradients(patches: _Patches, sums: _Sums, good: Mask) -> FloatArray:
    """(n, 2, 2) gradients of offset and contrast, from a quadratic surface over the image."""
    good = good & _similar_misfit(sums.misfit)
    if good.sum() < _MIN_LIGHT_CORNERS:
        return np.zeros_like(patches.jacobian)
    centre = patches.px.mean(axis=0)
    scale = float(np.abs(patches.px - centre).max())
    u, v = ((patches.px - centre) / scale).T
    ones, zeros = np.ones_like(u), np.zeros_like(u)
    terms = np.stack([ones, u, v, u * u, u * v, v * v], axis=1)
    by_u = np.stack([zeros, ones, zeros, 2 * u, v, zeros], axis=1)
    by_v = np.stack([zeros, zeros, ones, zeros, u, 2 * v], axis=1)
    surface = np.linalg.lstsq(terms[good], sums.levels[good], rcond=None)[0]
    return np.stack([by_u @ surface, by_v @ surface], axis=2) / scale


def _similar_misfit(misfit: FloatArray) -> Mask:
    """Mask of corners whose misfit is not much above the median; False for NaN."""
    median = float(np.median(misfit[np.isfinite(misfit)])) if np.isfinite(misfit).any() else 0.0
    return misfit < min(_MISFIT_TIMES * median + _MISFIT_MORE, _MOST_MISFIT)


def _accepted(patches: _Patches, sums: _Sums, moved_px: FloatArray) -> Mask:
    """Mask of usable corners; see `finders.template`."""
    contrast = sums.levels[:, 1] * np.sign(np.median(sums.levels[:, 1]))
    moved_squares = np.linalg.norm((patches.normals @ moved_px[..., None])[..., 0], axis=1)
    return np.asarray(
        _similar_misfit(sums.misfit)
        & (patches.inside >= _LEAST_INSIDE)
        & (contrast > _LEAST_CONTRAST * np.median(contrast))
        & (np.linalg.norm(sums.shifts(), axis=1) < _LAST_STEP_PX)
        & (moved_squares < _MOST_SHIFT)
    )


def _result(
    patches: _Patches,
    sums: _Sums,
    shift: FloatArray,
    values: FloatArray,
    good: Mask,
    positions: FloatArray,
) -> FittedCorners:
    """The corners with their covariance, from the odd part of the residuals."""
    levels = np.concatenate([sums.levels, np.zeros((len(good), 2))], axis=1)
    variance = _noise_variance(patches, values, shift, levels[:, :2])
    if patches.scene.smooth_px:
        # Restores the variance of white noise before smoothing.
        taps = cv2.getGaussianKernel(_TAPS, patches.scene.smooth_px)
        variance = variance / float(np.sum(taps**2)) ** 2
    noise = float(np.sqrt(np.median(variance[good]))) if good.any() else np.nan
    covariance = np.where(good[:, None, None], noise**2 * sums.inverse[:, 2:, 2:], np.nan)
    return FittedCorners(
        positions,
        covariance,
        good,
        Blur.of(values[:4]),
        float(values[4]),
        noise,
        _scatter_px(patches.scene.board[good], positions[good]),
    )


def _noise_variance(
    patches: _Patches, values: FloatArray, shift: FloatArray, levels: FloatArray
) -> FloatArray:
    """(n,) pixel variance from the odd part about a corner: even residuals do not shift it."""
    torch = library("torch")
    columns = patches.columns(values, shift, blurs=False)
    fit = torch.as_tensor(levels, dtype=torch.float32, device=columns.device)
    residuals = columns[:, -1] - fit[:, :1] * columns[:, 0] - fit[:, 1:] * columns[:, 1]
    symmetric = columns[:, 0] * columns[:, 0].flip(1)
    odd = (residuals - residuals.flip(1)) ** 2 / 2
    sums = (
        torch.stack([(odd * symmetric).sum(dim=1), symmetric.sum(dim=1)])
        .cpu()
        .numpy()
        .astype(float)
    )
    return np.asarray(sums[0] / np.maximum(sums[1] - 2.0, 1.0))


def _scatter_px(board: FloatArray, px: FloatArray) -> float:
    """Rms residual of most corners from a homography plus cubic polynomial [px]; 0 for few."""
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    if len(px) <= len(powers):
        return 0.0
    centre, scale = board.mean(axis=0), float(np.abs(board - board.mean(axis=0)).max())
    places = (board - centre) / scale
    homography = cv2.findHomography(places, px)[0]
    if homography is None:
        raise np.linalg.LinAlgError
    residuals = px - cv2.perspectiveTransform(places[None], homography)[0]
    terms = np.stack([places[:, 0] ** i * places[:, 1] ** j for i, j in powers], axis=1)
    residuals = residuals - terms @ np.linalg.lstsq(terms, residuals, rcond=None)[0]
    squares = np.sum(residuals**2, axis=1)
    return float(np.sqrt(np.mean(squares[squares <= 9.0 * np.median(squares)])))


def _subsample(good: Mask, limit: int) -> IntArray:
    """A subset of the good corners, spread over the board."""
    indices = np.flatnonzero(good)
    return indices[:: -(-len(indices) // limit)]

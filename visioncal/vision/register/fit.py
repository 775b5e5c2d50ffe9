"""Registration of a flat print to all pixels of an image: nonlinear least squares with covers.

Levenberg and Marquardt's method over pose, blur, motion and lens, with the light eliminated in each
step (Golub and Pereyra 1973), in reduced copies of the image first. Pixels that something covers
have residuals which neither noise nor a small shift of the print explains; they leave with their
surroundings, and Cauchy's weights hold down single ones. The covariance is the sandwich of White
(1980) over blocks of pixels, within which errors of the model go together (Liang and Zeger 1986).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from visioncal.core.quantiles import SIGMA_PER_MAD
from visioncal.core.transforms import skew
from visioncal.core.types import Camera, FloatArray, Image
from visioncal.vision.register.image_model import (
    BLOCK_PX,
    Level,
    Pixels,
    Print,
    Rendered,
    Seen,
    moved_px,
)

# Side of the blocks that err alone [px], and fewest pixels to fit.
_WIDE_PX, _FEWEST = 16, 200
# Least noise of a pixel, a share of its range: that of rounding to 8 bits, and of a print's ink.
_LEAST_NOISE = 0.002


@dataclass(frozen=True, eq=False)
class Look:
    """One rendering beside the image, with the light that fits it best."""

    level: Level
    flat: Print
    seen: Seen
    drawn: Rendered
    gain: Pixels  # (h, w) derivative of the image by the print's light.
    residuals: Pixels  # (h, w) image less model.
    weights: Pixels  # (h, w).
    noise: float  # Robust standard deviation of a pixel.
    # (p,) information that is known before on pose, blur, twist and lens, and what it is on.
    prior: FloatArray
    changes: FloatArray

    @cached_property
    def inside(self) -> Pixels:
        """(h, w) 1 where a pixel sees nothing but the print, through all blur."""
        seen, camera = self.seen, self.level.camera
        blur_px = 3 * seen.gauss_px + seen.disc_px + 0.8 * self.level.factor
        blur_px += moved_px(camera, self.flat, seen) / 2
        at = self.drawn.places_m - self.flat.corner_m[:, None, None]
        # A slanted pixel sees more of the print.
        rim = blur_px / self.level.factor * np.hypot(*np.gradient(at, axis=(1, 2)))
        rim = np.minimum(rim, 0.12 * self.flat.size_m.min())
        inside = ((at > rim) & (self.flat.size_m[:, None, None] - at > rim)).all(axis=0)
        return np.asarray(inside & self.level.is_sound, np.float32)

    @cached_property
    def by_px(self) -> Pixels:
        """(2, h, w) derivatives of the image by a shift of this level's pixels along u and v.

        Differences of the light would miss a part of what is finest.
        """
        moved = (np.gradient(self.drawn.places_m, axis=axis) for axis in (2, 1))
        return np.stack([np.sum(self.drawn.slopes[:2] * one, axis=0) for one in moved]) * self.gain

    @property
    def cost(self) -> float:
        """Weighted sum of squares, and those of what is known before."""
        known = self.noise**2 * float(self.prior @ self.changes**2)
        return float(np.vdot(self.weights * self.residuals, self.residuals)) + known

    def normal(self) -> tuple[FloatArray, FloatArray, Pixels]:
        """Normal matrix (p + 19)^2 and right side by parameters and light, and scores of blocks.

        Within a block, derivatives by pose, lens and nodes are its middle's times slopes of the
        print: so products of pixels are summed for few slopes, and not for all parameters.

        Returns:
            The matrix, the right side, and the scores (p + 19, blocks down, along).
        """
        light, shares = self.drawn.light, self.drawn.shares
        (count, known), shape = shares.shape[:2], shares.shape[2:]
        layers = np.stack(
            [*self.drawn.slopes, light, np.ones_like(light), light**2, self.residuals]
        )
        sums = np.zeros((*shape, count + 3, count + 4), np.float32)
        # Row by row, as more pixels do not fit into a cache.
        for row, total in enumerate(sums):
            rows = slice(BLOCK_PX * row, BLOCK_PX * (row + 1))
            part = layers[:, rows].copy()
            part[:count] *= self.gain[rows]
            pair = [
                one.reshape(-1, BLOCK_PX, shape[1], BLOCK_PX).transpose(2, 0, 1, 3)
                for one in (part[:-1] * self.weights[rows], part)
            ]
            weighed, plain = (one.reshape(*one.shape[:2], -1) for one in pair)
            np.matmul(weighed, np.swapaxes(plain, 1, 2), out=total)
        sums = sums.reshape(-1, count + 3, count + 4)
        down, along = (side.reshape(3, -1, BLOCK_PX).mean(axis=2) for side in self.level.nodes)
        nodes = (down[:, None, :, None] * along[:, None, :]).reshape(9, *shape)
        mixed = np.zeros((count + 3, known + 19, *shape), np.float32)
        mixed[:count, :known] = shares
        mixed[count, known : known + 9] = mixed[count + 1, known + 9 : known + 18] = nodes
        mixed[count + 2, known + 18] = 1.0
        mixed = np.ascontiguousarray(mixed.reshape(count + 3, known + 19, -1).transpose(2, 0, 1))
        normal = np.tensordot(mixed, sums[:, :, :-1] @ mixed, ([0, 1], [0, 1])).astype(float)
        scores = np.einsum("bk,bkp->pb", sums[:, :, -1], mixed)
        goal = scores.sum(axis=1, dtype=float)
        # The light is fitted.
        goal[known:] = 0.0
        at = np.arange(known)
        normal[at, at] += self.noise**2 * self.prior
        goal[at] -= self.noise**2 * self.prior * self.changes
        return normal, goal, scores.reshape(-1, *shape)


@dataclass(frozen=True, eq=False)
class Registered:
    """A print registered to an image."""

    seen: Seen
    # (6 + l, 6 + l) of the right perturbation of `cam_from_target` (rotation, translation) [rad, m]
    # and of the lens's changes.
    covariance: FloatArray
    explained: float  # Share of the variance of the pixels taken that the print explains.
    shown: float  # Share of the print's pixels within the image that nothing covers.
    look: Look


def register(
    image: Image,
    flat: Print,
    camera: Camera,
    start: Seen,
    *,
    lens_sigma: FloatArray | None = None,
    moving: bool = False,
    factors: tuple[int, ...] = (4, 2),
    rough: bool = False,
) -> Registered | None:
    """Registers a print to a (h, w) grey image.

    Args:
        image: Grey levels that are proportional to the light, or nearly.
        flat: The print.
        camera: The lens as far as it is known.
        start: Where the print is expected, to a pixel or two of the coarsest copy.
        lens_sigma: (l,) standard deviations of the changes of fx = fy, cx, cy and coefficients of
            the lens: these are estimated too, and count in the covariance; None for a known lens.
        moving: Whether the print moves during the exposure.
        factors: By how much the copies are reduced, in this order.
        rough: Whether blur and light are unknown: several are tried.

    Returns:
        The registration; None where too little of the print is in the image.
    """
    lens_sigma = np.zeros(0) if lens_sigma is None else lens_sigma
    seen, look, is_blurred = replace(start, lens=np.zeros(len(lens_sigma))), None, rough
    for factor in factors:
        blur_px = max(seen.gauss_px, seen.disc_px / 2, moved_px(camera, flat, seen) / 4)
        texel_px = flat.texel_m * camera.matrix[:2].mean() / flat.middle_at(seen.cam_from_target)[2]
        # Blur, or the print's own texels, leave nothing finer.
        if look is not None and (blur_px > 2.5 * look.level.factor or factor < 0.7 * texel_px):
            break
        level = Level.of(image, factor, flat, camera, seen, len(lens_sigma))
        if level is None:
            return None
        fitter = Fitter(level, flat, lens_sigma, moving, 0.02 * is_blurred)
        if look is None and rough:
            look = fitter.rough(seen)
            seen = seen if look is None else look.seen
        look = fitter.fitted(seen, look)
        if look is None:
            return None
        sigma, found = look.seen.gauss_px, look
        if is_blurred and not moving and sigma > 0.5 * factor and not look.seen.disc_px:
            # A Gaussian of half a disc's radius is the nearest one.
            disc = replace(look.seen, gauss_px=0.4 * sigma, disc_px=1.8 * sigma)
            found = fitter.steps(fitter.look(disc, look.weights, look.noise), 8) or look
        look = min(look, found, key=lambda one: one.cost)
        seen, rough = look.seen, False
    return None if look is None else _result(look)


@dataclass(frozen=True, eq=False)
class Fitter:
    """A print and a reduced image that it is fitted to."""

    level: Level
    flat: Print
    lens_sigma: FloatArray
    moving: bool
    misfit: float  # Error of the model of blur, a share of the contrast.

    def look(
        self,
        seen: Seen,
        weights: Pixels | None = None,
        noise: float = _LEAST_NOISE,
        drawn: Rendered | None = None,
    ) -> Look:
        """Renders the print, unless it is, and fits the light; weights are 1 inside where None."""
        level = self.level
        drawn = drawn or level.rendered(self.flat, seen, moving=self.moving)
        # A print moves by no more than a fifth of itself, nor turns by as much.
        still = np.repeat([1 / (0.2 * self.flat.size_m.max()), 1 / 0.2], 3) ** 2
        known = [np.zeros(7 + (seen.disc_px > 0)), still[: 6 * self.moving], self.lens_sigma**-2.0]
        changes = [known[0], seen.twist[: 6 * self.moving], seen.lens]
        light, image = drawn.light, level.image
        blank = Look(
            level, self.flat, seen, drawn, light, image, light, noise, np.concatenate(known),
            np.concatenate(changes),
        )  # fmt: skip
        weights = blank.inside if weights is None else weights
        # Sums over pixels of products of two nodes with powers of the light and with the image.
        layers = [weights, weights * light]
        layers += [layers[1] * light, weights * image]
        layers += [layers[2] * light, layers[2] * light**2, layers[3] * light, layers[2] * image]
        down, along = ((side[:, None] * side).reshape(9, -1) for side in level.nodes)
        sums = (down @ (np.stack(layers) @ along.T)).astype(float).reshape(-1, 3, 3, 3, 3)
        moments = sums.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
        zeroth, one, two, imaged, three, four, imaged_one, imaged_two = moments
        # Nodes' weights sum to 1.
        square = three.sum(axis=1), two.sum(axis=1)
        normal = np.block([
            [two, one, square[0][:, None]],
            [one, zeroth, square[1][:, None]],
            [square[0], square[1], four.sum()],
        ])  # fmt: skip
        normal += 1e-6 * (float(np.trace(normal)) / len(normal) + 1e-3) * np.eye(len(normal))
        goal = np.r_[imaged_one.sum(axis=1), imaged.sum(axis=1), imaged_two.sum()]
        solved = np.linalg.solve(normal, goal).astype(np.float32)
        down, along = level.nodes
        gain, offset = (down.T @ part @ along for part in solved[:18].reshape(2, 3, 3))
        bent = solved[18] * light
        # Light that few pixels determine is anything where it is not seen.
        residuals = np.clip(image - offset - (gain + bent) * light, -1e3, 1e3)
        return replace(blank, gain=gain + 2 * bent, residuals=residuals, weights=weights)

    def weighed(self, look: Look, slack_px: float) -> Look:
        """A look with weights by its residuals, for covered areas and for single pixels.

        A shift of `slack_px` of this level is no cover yet.
        """
        taken = look.weights > 0
        if taken.sum() < _FEWEST:
            return look
        noise = max(SIGMA_PER_MAD * float(np.median(np.abs(look.residuals[taken]))), _LEAST_NOISE)
        known = noise**2 + (self.misfit * float(np.median(look.gain))) ** 2
        allowed = 4 * known + slack_px**2 * np.sum(look.by_px**2, axis=0)
        side = (5, 5) if self.level.factor > 2 else (7, 7)
        squares = look.residuals**2 / allowed * look.inside
        local = cv2.blur(squares, side) / np.maximum(cv2.blur(look.inside, side), 0.05)
        # Of noise alone the mean is a quarter.
        free = (local < (0.45 if slack_px <= 0.3 else 0.75)).astype(np.float32)
        free = np.asarray(cv2.erode(free, np.ones(side, np.uint8)))
        weights = look.inside * free / (1 + look.residuals**2 / (4 * allowed))
        return self.look(look.seen, weights.astype(np.float32), noise, look.drawn)

    def fitted(self, seen: Seen, before: Look | None) -> Look | None:
        """Fits from a start, with weights anew after each round; first those of a look before."""
        look: Look | None = self.look(seen)
        if before is not None and look is not None:
            # Blurs differ between levels, and would pass for covers.
            weights = look.inside * self.level.resampled(before.level, before.weights)
            look = self.steps(self.look(seen, weights, before.noise, look.drawn), 5, 1e-7)
        is_first = before is None or before.level is self.level
        for slack in (0.6, 0.3) if is_first else (0.3, 0.2):
            damping = 1e-3 if is_first and slack > 0.5 else 1e-7
            look = None if look is None else self.steps(self.weighed(look, slack), 6, damping)
        return look

    def steps(self, look: Look, most: int, damping: float = 1e-3) -> Look | None:
        """Levenberg and Marquardt's steps; None where too little is left to fit."""
        for _ in range(most):
            if look.weights.sum() < _FEWEST:
                return None
            normal, goal, _ = look.normal()
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-12 * normal.max()))
            scaled = normal / np.outer(scale, scale)
            for _ in range(4):
                step = np.linalg.solve(scaled + damping * np.eye(len(scale)), goal / scale) / scale
                gain = float(goal @ step)
                seen = look.seen.moved(step[: len(look.prior)], self.moving)
                tried = self.look(seen, look.weights, look.noise)
                # Interpolation in steps of 1/32 px makes costs uneven, and derivatives less so.
                if tried.cost <= 1.001 * look.cost:
                    # The next is below what noise moves, as convergence is quadratic; what lens and
                    # pose share has 1e-5 of an information, which damping must not hold.
                    if damping < 1e-6 and gain < 2 * look.noise**2 + 1e-5 * look.cost:
                        return tried
                    look, damping = tried, damping / 100
                    break
                damping *= 100
            else:
                return look
        return look

    def rough(self, seen: Seen) -> Look | None:
        """The best fit from several blurs or motions, with all pixels."""

        def quality(look: Look) -> float:
            return look.cost / float(look.weights.sum())

        tried = (self.steps(self.look(start), 2) for start in self._blurs(seen))
        first = sorted((look for look in tried if look is not None), key=quality)[:3]
        settled = (self.steps(look, 15) for look in first)
        return min((look for look in settled if look is not None), key=quality, default=None)

    def _blurs(self, seen: Seen) -> Iterator[Seen]:
        """Starts with blurs, or motions in the image's plane, from which all others are reached."""
        if not self.moving:
            yield from (replace(seen, gauss_px=px) for px in (0.8, 2.0, 4.5, 8.0))
            return
        depth_m = self.flat.middle_at(seen.cam_from_target)[2]
        for length in (3.0, 7.0, 13.0, 22.0):
            for angle in np.pi / 6 * np.arange(6):
                along = length * np.array([np.cos(angle), np.sin(angle), 0.0, 0.0, 0.0, 0.0])
                twist = along * depth_m / self.level.camera.matrix[:2].mean()
                yield replace(seen, gauss_px=max(0.8, 0.1 * length), twist=twist)


def _result(look: Look) -> Registered:
    normal, _, scores = look.normal()

    def wide(sums: Pixels, size: int) -> FloatArray:
        """Sums of (k, h, w) over wide blocks."""
        for axis in (1, 2):
            sums = np.add.reduceat(sums, np.arange(0, sums.shape[axis], size), axis)
        return sums.reshape(len(sums), -1).astype(float)

    errors = wide(scores, _WIDE_PX // BLOCK_PX)
    used = int((wide(look.weights[None], _WIDE_PX) > _WIDE_PX**2 / 4).sum())
    meat = errors @ errors.T * used / max(used - len(normal), 5)
    known = np.arange(len(look.prior))
    meat[known, known] += look.noise**4 * look.prior
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-12 * normal.max()))
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), 1e-10) / np.outer(scale, scale)
    lens = len(look.seen.lens)
    kept = np.r_[:6, len(known) - lens : len(known)]
    # From left perturbations (translation, rotation) to right ones (rotation, translation).
    back = look.seen.cam_from_target[:3, :3].T
    turned = np.eye(6 + lens)
    turned[:6, :6] = np.block(
        [[np.zeros((3, 3)), back], [back, -back @ skew(look.seen.cam_from_target[:3, 3])]]
    )
    covariance = turned @ (inverse @ meat @ inverse)[np.ix_(kept, kept)] @ turned.T
    taken, image = look.weights.astype(float), look.level.image
    varied = np.sum(taken * (image - np.average(image, weights=taken)) ** 2)
    explained = 1.0 - float(np.sum(taken * look.residuals**2) / max(varied, 1e-12))
    shown = float((taken > 0).sum()) / max(float(look.inside.sum()), 1.0)
    return Registered(look.seen, covariance, explained, shown, look)

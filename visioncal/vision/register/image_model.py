"""The image of a flat print: camera, light, blur and motion, with closed derivatives.

    grey(p) = o(p) + g(p) S(p) + q S(p)^2,    S = gauss * disc * mean over s of L(X(p, s)),

with L the print, X the place on the print that a pixel's ray meets, s the time from -1/2 to 1/2 of
the exposure, in which the print moves by a twist, and o and g bilinear between 3 x 3 nodes. The ray
of a pixel is fixed, so that the print's place X = R^T (P - t) moves with the pose by

    dX/dxi = -R_2^T (I - r n^T / (n . r)) [I, -[P]_x],    P = r (n . t) / (n . r),

with r the ray, n the print's normal and R_2 the first two columns of R. Slopes of X change little
within a blur, so that those of S are slopes of X times the blurred slopes of L.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from visioncal.core.transforms import apply
from visioncal.core.types import Camera, FloatArray, Image
from visioncal.vision.camera import normalise, project, project_with_jacobian

Pixels: TypeAlias = npt.NDArray[np.float32]

_EDGE = cv2.BORDER_REPLICATE
# Side of the blocks within which derivatives by pose and lens are those of the middle [px].
BLOCK_PX = 8
# Gaussian of print and of reduced images before they are sampled [px]: the narrowest at which
# sampling at each pixel aliases by less than noise does; and the narrowest of an image, as its
# pixels alone are boxes of 0.29.
_SAMPLED_PX, _SHARPEST_PX = 0.5, 0.32
# Frequencies of a kernel.
_FREQUENCIES = 64


@dataclass(frozen=True, eq=False)
class Print:
    """A flat print: grey levels, 0 for dark and 1 for light, on squares of `texel_m`."""

    grey: Pixels  # (h, w).
    texel_m: float
    corner_m: FloatArray  # (2,) outer corner of the first texel in the target's frame [m].
    _reduced: dict[int, tuple[Pixels, Pixels, int, float]] = field(default_factory=dict, repr=False)

    @classmethod
    def of_picture(cls, picture: Image, width_m: float) -> Self:
        """A (h, w) picture of a width, with its upper left corner as the origin."""
        return cls(_pixels(picture / 255), width_m / picture.shape[1], np.zeros(2))

    @property
    def size_m(self) -> FloatArray:
        """(2,) width and height [m]."""
        return self.texel_m * np.array(self.grey.shape[::-1], float)

    def middle_at(self, pose: FloatArray) -> FloatArray:
        """(3,) middle of the print at a (4, 4) pose [m]."""
        return pose[:3, :2] @ (self.corner_m + self.size_m / 2) + pose[:3, 3]

    @property
    def outline_m(self) -> FloatArray:
        """(4, 3) corners of the print [m]."""
        return np.pad(
            self.corner_m + self.size_m * [[0, 0], [1, 0], [1, 1], [0, 1]], ((0, 0), (0, 1))
        )

    def blurred(self, sigma_m: float) -> tuple[Pixels, Pixels, int, float]:
        """The print through a Gaussian.

        Returns:
            (h, w, 3) grey and its slopes [1/m], (h, w, 3) halves of its second derivatives xx, yy
            and xy twice [1/m^2], by how much both are reduced, and the Gaussian's sigma [m].
        """
        step = round(4 * np.log2(max(sigma_m / self.texel_m, 0.5)))
        if step not in self._reduced:
            sigma = 2.0 ** (step / 4)
            by = max(1, int(sigma / 1.3))
            smooth = np.asarray(cv2.GaussianBlur(self.grey, (0, 0), sigma, borderType=_EDGE))
            grey, pitch_m = smooth[by // 2 :: by, by // 2 :: by], by * self.texel_m
            wide = cv2.copyMakeBorder(grey, 1, 1, 1, 1, _EDGE) / pitch_m
            gx, gy = (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2
            middle = 2 * wide[1:-1, 1:-1]
            xx = (wide[1:-1, 2:] + wide[1:-1, :-2] - middle) / (2 * pitch_m)
            yy = (wide[2:, 1:-1] + wide[:-2, 1:-1] - middle) / (2 * pitch_m)
            first = np.dstack([grey, gx, gy]).astype(np.float32)
            second = np.dstack([xx, yy, np.gradient(gx, pitch_m, axis=0)]).astype(np.float32)
            self._reduced[step] = first, second, by, sigma * self.texel_m
        return self._reduced[step]


@dataclass(frozen=True, eq=False)
class Seen:
    """How a print is seen: what an image determines."""

    cam_from_target: FloatArray  # (4, 4) in the middle of the exposure.
    gauss_px: float = 1.0  # Sigma of the isotropic blur, that of the sensor's pixels included [px].
    disc_px: float = 0.0  # Radius of the disc of defocus [px]; 0 for none.
    # (6,) translation and rotation during the exposure, in the camera's frame [m, rad].
    twist: FloatArray = field(default_factory=lambda: np.zeros(6))
    # (l,) changes of fx = fy together, cx, cy and the first l - 3 coefficients of the lens.
    lens: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def blur_px(self) -> float:
        """The isotropic blur as a Gaussian's sigma [px]."""
        return float(np.hypot(self.gauss_px, self.disc_px / 2))

    def moved(self, step: FloatArray, moving: bool) -> Self:
        """After a step along pose (6), blur (1 or 2), twist (6 if moving) and lens."""
        pose, at = self.cam_from_target, 7 + (self.disc_px > 0.0)
        blurs = [
            float(np.clip(old + np.clip(by, -0.4 * old - 0.2, 0.4 * old + 0.2), low, 40.0))
            for old, by, low in zip(
                (self.gauss_px, self.disc_px), step[6:at], (_SHARPEST_PX, 0.5), strict=False
            )
        ]
        return replace(
            self,
            cam_from_target=_exp(step[:6]) @ pose,
            gauss_px=blurs[0],
            disc_px=blurs[1] if len(blurs) > 1 else 0.0,
            twist=self.twist + step[at : at + 6] if moving else self.twist,
            lens=self.lens + step[len(step) - len(self.lens) :],
        )


def _exp(twist: FloatArray) -> FloatArray:
    """(4, 4) motion by a translation and a rotation vector (6,)."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix()
    motion[:3, 3] = twist[:3]
    return motion


@dataclass(frozen=True, eq=False)
class Rendered:
    """The print as it is seen, in light 1, and its derivatives."""

    light: Pixels  # (h, w).
    slopes: Pixels  # (k, h, w) along x and y of the print, by blurs, and along x and y by a motion.
    # (k, p, blocks down, along) shares of these in the derivatives by pose, as left perturbation
    # (translation, rotation), blur, twist and lens.
    shares: Pixels
    places_m: Pixels  # (2, h, w) place on the target in the middle of the exposure [m].


@dataclass(frozen=True, eq=False)
class Level:
    """A part of an image, reduced by a factor, around where a print is expected: whole blocks."""

    factor: int
    corner_px: tuple[int, int]  # The first pixel's in the image (u, v).
    image: Pixels  # (h, w) grey, 0 to 1.
    is_sound: npt.NDArray[np.bool_]  # (h, w) neither saturated nor without a ray.
    camera: Camera
    # (2 + 2 l, m, n) rays of the lens as given at nodes of cubic splines, at depth 1, and their
    # derivatives by `Seen.lens`; and the splines (h, m) and (w, n).
    table: Pixels
    splines: list[Pixels]

    @classmethod
    def of(
        cls, image: Image, factor: int, flat: Print, camera: Camera, seen: Seen, columns: int
    ) -> "Level | None":
        """Cuts a (h, w) image around a print, with `columns` of the lens; None where it is not."""
        px = project(camera, apply(seen.cam_from_target, flat.outline_m))
        size = np.array(image.shape[::-1]) // factor
        if not np.isfinite(px).all():
            return None
        low = np.clip(np.floor(px.min(axis=0) / factor) - 3, 0, size).astype(int)
        high = np.clip(np.ceil(px.max(axis=0) / factor) + 3, 0, size).astype(int)
        if (high - low < 12).any():
            return None
        (u, v), (w, h) = (low * factor).tolist(), (-(-(high - low) // BLOCK_PX) * BLOCK_PX).tolist()
        part = image[v : v + factor * h, u : u + factor * w]
        beyond = 0, factor * h - part.shape[0], 0, factor * w - part.shape[1]
        layers = [
            _pixels(cv2.copyMakeBorder(_pixels(layer), *beyond, border))
            for layer, border in (
                (part / np.float32(255), _EDGE),
                ((part > 1) & (part < 254), cv2.BORDER_CONSTANT),
            )
        ]
        if factor > 1:
            # The box of the reduction alone would alias.
            layers[0] = _gauss(layers[0], factor**2 * (_SAMPLED_PX**2 - 1 / 12))
            layers = [_pixels(cv2.resize(a, (w, h), interpolation=cv2.INTER_AREA)) for a in layers]
        origin = low * factor + (factor - 1) / 2
        # Cubic between nodes, as lenses are smooth.
        ends = [origin[1 - axis] + factor * np.arange(count) for axis, count in enumerate((h, w))]
        nodes = [np.linspace(end[0], end[-1], max(4, len(end) * factor // 24)) for end in ends]
        at = np.stack(np.meshgrid(nodes[1], nodes[0]), axis=-1).reshape(-1, 2)
        rays, bends = _bends(camera, at, columns)
        table = np.concatenate([rays, bends.reshape(len(at), -1), np.ones((len(at), 1))], axis=1)
        table = np.where(np.isfinite(table).all(axis=1, keepdims=True), table, 0.0)
        table = table.T.reshape(-1, len(nodes[0]), len(nodes[1]))
        down, along = (
            make_interp_spline(node, np.eye(len(node)))(end)
            for node, end in zip(nodes, ends, strict=True)
        )
        is_sound = (layers[1] > 0.99) & (np.abs(down @ table[-1] @ along.T - 1.0) < 1e-6)
        table, splines = _pixels(table[:-1]), [_pixels(down), _pixels(along)]
        return cls(factor, (u, v), _pixels(layers[0]), is_sound, camera, table, splines)

    @cached_property
    def nodes(self) -> list[Pixels]:
        """(3, h) and (3, w) weights of nodes down and along: of 3 x 3, they are products."""
        at = (np.linspace(0, 2, count) - np.arange(3)[:, None] for count in self.image.shape)
        return [_pixels(np.clip(1 - np.abs(off), 0, 1)) for off in at]

    @cached_property
    def middles(self) -> Pixels:
        """(2 + 2 l, blocks down, along) rays and their derivatives in the middles of blocks."""
        down, along = (
            side.reshape(-1, BLOCK_PX, side.shape[1]).mean(axis=1) for side in self.splines
        )
        return _pixels(down @ self.table @ along.T)

    def resampled(self, other: "Level", values: Pixels) -> Pixels:
        """(h, w) values at this level's pixels, of (m, n) at another's around the same print."""
        at = [
            (np.arange(count) * self.factor + first - zero) // other.factor
            for count, first, zero in zip(
                self.image.shape, self.corner_px[::-1], other.corner_px[::-1], strict=True
            )
        ]
        rows, columns = (
            np.clip(a, 0, size - 1) for a, size in zip(at, other.image.shape, strict=True)
        )
        return values[np.ix_(rows, columns)]

    def rendered(self, flat: Print, seen: Seen, *, moving: bool = False) -> Rendered:
        """The print and its derivatives, with those by the twist where it is moving."""
        pose, middle = seen.cam_from_target, flat.middle_at(seen.cam_from_target)
        pixel_m = self.factor * float(middle[2] / self.camera.matrix[:2].mean())
        # A slanted pixel sees more of the print along one direction.
        slant = abs(float(pose[:3, 2] @ middle)) / float(np.linalg.norm(middle))
        # Four places within a pixel leave less to a Gaussian on the print. Cosine of a print's tilt
        # below which a Gaussian on it, as wide along as across, is too rough.
        within, sampled_px = (0.0, _SAMPLED_PX) if moving or slant > 0.85 else (0.25, 0.35)
        first, second, by, sigma_m = flat.blurred(sampled_px * pixel_m / max(slant, 0.2) ** 0.5)
        count = 1 + 2 * moving * int(
            np.clip(moved_px(self.camera, flat, seen) / self.factor / 3, 2, 6)
        )
        lens, ray_tables = _pixels(seen.lens), (self.table, self.middles)
        bends = [one[2:].reshape(len(lens), 2, *one.shape[1:]) for one in ray_tables]
        at_nodes, rays = (
            one[:2] + np.tensordot(lens, bend, 1)
            for one, bend in zip(ray_tables, bends, strict=True)
        )
        x, y = self.splines[0] @ at_nodes @ self.splines[1].T
        n, along = _pixels(pose[:3, 2]), _pixels(pose[:3, :2])
        ray = np.stack([*rays, np.ones_like(rays[0])])
        across = 1 / np.tensordot(n, ray, 1)
        depth = np.float32(n @ pose[:3, 3]) * across
        # (2, 3, ...) slopes of x and y on the print by a motion of the point that is seen, its ray
        # being fixed.
        q = along.T[:, :, None, None] - n[:, None, None] * (
            across * np.tensordot(along.T, ray, 1)[:, None]
        )
        # The print at each pixel beside one Gaussian for all, by the heat equation, and
        # how that is shifted, as slopes of perspective change within a pixel.
        side = np.float32(sampled_px * pixel_m / middle[2])
        (xx, xy), (yx, yy) = side * depth * q[:, :2]
        fields = [xx**2 + xy**2 - sigma_m**2, yx**2 + yy**2 - sigma_m**2, xx * yx + xy * yy]
        fields += [-side * across * (n[0] * px + n[1] * py) for px, py in ((xx, xy), (yx, yy))]
        finer = [_pixels(cv2.resize(_pixels(one), x.shape[::-1])) for one in fields]
        layers = np.zeros((5 if moving else 3, *x.shape), np.float32)
        place = np.zeros((2, *x.shape), np.float32)
        corner = _pixels(flat.corner_m)[:, None, None]
        for k in range(count):
            at = (k + 0.5) / count - 0.5
            moved_pose = _exp(at * seen.twist) @ pose
            # From rays to the plane of the print.
            rows = _pixels(np.linalg.inv(np.c_[moved_pose[:3, :2], moved_pose[:3, 3]]))
            gx, gy, scale = (row[0] * x + row[1] * y + row[2] for row in rows)
            on = np.stack([gx / scale, gy / scale])
            texels = _pixels(((on - corner) / np.float32(flat.texel_m) - 0.5 - by // 2) / by)
            offsets = [np.float32(within) * np.gradient(texels, axis=axis) for axis in (2, 1)]
            for right, down in ((0, 0),) if not within else ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                at_px = texels + right * offsets[0] + down * offsets[1]
                drawn, bent = (
                    cv2.remap(table, at_px[0], at_px[1], cv2.INTER_LINEAR, None, _EDGE)
                    for table in (first, second)
                )
                parts, more = cv2.split(drawn), cv2.split(bent)
                for share, part in zip(finer, (*more, *parts[1:]), strict=True):
                    layers[0] += share * part
                layers[:3] += parts
                if moving:
                    layers[3:] += np.float32(at) * np.stack(parts[1:])
            place = on if 2 * k + 1 == count else place
        # The print's own blur is a part of what is seen, which a reduced image's own is not.
        reduced_px = _SAMPLED_PX * (self.factor > 1)
        variance = (seen.gauss_px / self.factor) ** 2 + reduced_px**2 - sampled_px**2 - within**2
        layers /= np.float32(count * (4 if within else 1))
        by_disc = []
        if seen.disc_px > 0.0:
            radius, sharp = seen.disc_px / self.factor, layers[0]
            layers = np.stack([_through(layer, _disc(radius)) for layer in layers])
            wider = _through(sharp, _disc(1.02 * radius)) - layers[0]
            by_disc = [_gauss(wider, variance) / np.float32(0.02 * seen.disc_px)]
        by_sigma = _gauss_by_variance(layers[0], variance)
        by_sigma *= 2 * seen.gauss_px / self.factor**2
        layers = np.stack([_gauss(layer, variance) for layer in layers])
        slopes = [*layers[1:3], by_sigma, *by_disc, *layers[3:]]
        blurs = 1 + len(by_disc)
        shares = np.zeros((len(slopes), 6 + blurs + 6 * moving + len(lens), *depth.shape))
        by_pose = np.concatenate([-q, np.cross(q, (depth * ray)[None], axis=1)], axis=1)
        shares[:2, :6] = by_pose
        shares[range(2, 2 + blurs), range(6, 6 + blurs)] = 1.0
        if moving:
            shares[-2:, 6 + blurs : 12 + blurs] = by_pose
        by_lens = np.einsum("kixy,lixy->klxy", q[:, :2], bends[1])
        shares[:2, shares.shape[1] - len(lens) :] = depth * by_lens
        return Rendered(layers[0], np.stack(slopes), _pixels(shares), place)

    def pixels_of(self, seen: Seen, places_m: FloatArray) -> FloatArray:
        """(n, 2) pixels of the image at which (n, 3) places of the target are seen [px]."""
        points = apply(seen.cam_from_target, places_m)
        px = project(self.camera, points)
        # The lens's changes belong to pixels: a fixed point.
        for _ in range(20 if len(seen.lens) else 0):
            bends = _bends(self.camera, px, len(seen.lens))[1]
            rays = points[:, :2] / points[:, 2:] - np.einsum("l,nlk->nk", seen.lens, bends)
            px = project(self.camera, np.column_stack([rays, np.ones(len(rays))]))
        return px


def moved_px(camera: Camera, flat: Print, seen: Seen) -> float:
    """Length of the motion during the exposure, at the print's middle [px]."""
    middle = flat.middle_at(seen.cam_from_target)
    moved = seen.twist[:3] + np.cross(seen.twist[3:], middle)
    focal = camera.matrix[:2].mean() + sum(seen.lens[:1])
    return float(focal * np.linalg.norm(moved[:2]) / middle[2])


def _pixels(values: npt.ArrayLike) -> Pixels:
    return np.asarray(values, np.float32)


def _bends(camera: Camera, px: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """(n, 2) rays of (n, 2) pixels, and (n, l, 2) their derivatives by the lens."""
    rays = normalise(camera, px)
    found = project_with_jacobian(camera, np.column_stack([rays, np.ones(len(rays))]))
    by_lens = found.jacobian_intrinsics
    by_lens = np.concatenate([by_lens[:, :, :1] + by_lens[:, :, 1:2], by_lens[:, :, 2:]], axis=2)
    by_ray = np.where(
        np.isfinite(found.jacobian_point[:, :, :2]), found.jacobian_point[:, :, :2], np.eye(2)
    )
    return rays, -np.swapaxes(np.linalg.solve(by_ray, by_lens[:, :, :columns]), 1, 2)


def _kernels(variance: float) -> tuple[FloatArray, FloatArray]:
    """Kernel (2 r + 1,) of a Gaussian [px^2] on pixels, and its derivative by the variance.

    Its frequencies up to those of pixels are a Gaussian's, however small the variance, even below
    0. A sampled Gaussian hardly changes below a sigma of 0.3 px, and that of Lindeberg (1990) has
    the variance, but blurs what is finest too little: both make blurs too wide.
    """
    reach = int(3.5 * abs(variance) ** 0.5 + 4.5)
    frequencies = (np.arange(_FREQUENCIES) + 0.5) * np.pi / _FREQUENCIES
    waves = np.cos(np.arange(-reach, reach + 1)[:, None] * frequencies) / _FREQUENCIES
    passed = np.exp(-0.5 * variance * frequencies**2)
    kernel, by_variance = waves @ passed, waves @ (-0.5 * frequencies**2 * passed)
    return kernel / kernel.sum(), by_variance - by_variance.mean()


def _gauss(layer: Pixels, variance: float) -> Pixels:
    """A (h, w) layer through a Gaussian [px^2]."""
    kernel, _ = _kernels(variance)
    return _pixels(cv2.sepFilter2D(layer, -1, kernel, kernel, borderType=_EDGE))


def _gauss_by_variance(layer: Pixels, variance: float) -> Pixels:
    """The derivative of a layer's Gaussian blur by the variance."""
    kernels = _kernels(variance)
    parts = (
        cv2.sepFilter2D(layer, -1, one, two, borderType=_EDGE)
        for one, two in (kernels, kernels[::-1])
    )
    return _pixels(sum(parts))


def _through(layer: Pixels, kernel: Pixels) -> Pixels:
    return _pixels(cv2.filter2D(layer, -1, kernel, borderType=_EDGE))


def _disc(radius: float) -> Pixels:
    """Kernel of a disc [px], with its rim by area."""
    reach = int(np.ceil(radius + 0.5))
    at = np.arange(-reach, reach + 1)
    kernel = np.clip(radius + 0.5 - np.hypot(at, at[:, None]), 0, 1)
    return _pixels(kernel / kernel.sum())

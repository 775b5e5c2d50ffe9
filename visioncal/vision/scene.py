"""The turn of a camera between two images of one standing scene, without a board.

The patches of most texture (Shi and Tomasi 1994) are tracked from coarse to fine by the inverse
compositional algorithm with a gain and an offset each (Baker and Matthews 2004; Bartoli 2008),
between pixels by cubic B-splines. A small turn of the camera moves the image of a scene at any
depth in the same way; it is fitted to the shifts of all patches through the lens, by sampling
consensus (MSAC; Torr and Zisserman 2000) and weighted least squares. Moving points disagree
and are left out. The covariance is that of the jackknife over blocks of the image (Efron 1982):
neighbouring patches share errors of lens and light.
"""

from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import spline_filter

from visioncal.core.transforms import apply, exp, invert, log
from visioncal.core.types import Camera, FloatArray, Image, Mask
from visioncal.vision.camera import normalise, project_with_jacobian

# Half the side of a patch [px], and blocks along its side whose patches share errors.
_HALF, _BLOCKS = 8, 5
# Residual of a patch that follows the camera, in pixels of its scale.
_GATE_PX = 1.0
# Fewest patches that follow the camera.
_FEWEST = 12


@dataclass(frozen=True, eq=False)
class Registration:
    """Motion of the camera in an image since the reference; without a reason it is to be used."""

    reason: str  # Why it says nothing; empty where it does.
    # (3,) rotation vector of `before_from_now`, the camera's pose in its frame before [rad]; with a
    # plane (6,), followed by the translation [m].
    turn: FloatArray
    covariance: FloatArray  # Of it: of small motions on the right.
    shift_px: FloatArray  # (2,) how far the image's middle moved [px].
    shift_sigma_px: FloatArray  # (2,) its standard deviations [px].
    inliers: int = 0  # Patches that follow the camera.


def nothing(size: int, reason: str) -> Registration:
    """A registration of so many components that says nothing."""
    unknown = np.full((size, size), np.nan)
    return Registration(reason, unknown[0], unknown, unknown[0, :2], unknown[0, :2])


def register(
    reference: Image,
    image: Image,
    camera: Camera,
    mask: Mask | None = None,
    plane: FloatArray | None = None,
) -> Registration:
    """How the camera turned between two images of the same standing scene.

    Args:
        reference: (h, w) grey image before.
        image: (h, w) grey image now.
        camera: The intrinsics of both.
        mask: (h, w) pixels of the reference that stand still; None for all.
        plane: (4,) unit normal and distance [m] of the scene's plane in the camera's frame before,
            n . p = d, to fit the translation too; None for the turn alone.

    Returns:
        The turn, or the reason why there is none.
    """
    size, (width, height) = 3 if plane is None else 6, camera.resolution
    for label, pixels in (("image", image), ("reference", reference)):
        if pixels.shape != (height, width):
            seen = " x ".join(str(side) for side in pixels.shape[::-1])
            return nothing(size, f"the {label} has {seen} px, the camera {width} x {height}")
        if np.ptp(np.percentile(pixels, [2, 98])) < 8:
            return nothing(size, f"the {label} is black, white or even: it shows no scene")
    mask = np.ones(reference.shape, bool) if mask is None else mask
    levels = _pyramid(reference), _pyramid(image)
    found = _registered(*levels, camera, mask, plane, np.zeros(2))
    if found.reason:
        # Patches do not reach so far, but all details together.
        fine = [level[-1] - cv2.GaussianBlur(level[-1], (0, 0), 4.0) for level in levels]
        window = cv2.createHanningWindow(fine[0].shape[::-1], cv2.CV_64F)
        start_px = np.array(cv2.phaseCorrelate(fine[0], fine[1], window)[0])
        found = _registered(*levels, camera, mask, plane, start_px)
    if found.reason and _sharpness(image) < 0.25 * _sharpness(reference):
        return nothing(size, f"the image is blurred: {found.reason}")
    return found


def _sharpness(image: Image) -> float:
    """An image's strongest edges, as noise is no structure, over its contrast."""
    fine = image.astype(np.float32) - cv2.GaussianBlur(image, (0, 0), 2.0)
    return float(np.percentile(np.abs(fine), 99) / max(float(image.std()), 1.0))


def _pyramid(image: Image) -> list[FloatArray]:
    """Smoothed copies, the finest first; pixel (u, v) of one is (u / 2, v / 2) of the next."""
    # Smoothing before anything else, against aliasing [px].
    levels = [np.asarray(cv2.GaussianBlur(image.astype(float), (0, 0), 1.0), float)]
    # The coarsest image is 120 wide, or more [px].
    while min(levels[-1].shape) >= 240:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), float))
    return levels


def _points(camera: Camera, px: FloatArray, plane: FloatArray | None) -> FloatArray:
    """(n, 3) points at pixels: on the plane, or at unit depth; not finite where there is none."""
    rays = np.column_stack([normalise(camera, px), np.ones(len(px))])
    if plane is None:
        return rays
    with np.errstate(divide="ignore"):
        depths = plane[3] / (rays @ plane[:3])
    # Beyond the horizon there is no plane.
    return np.asarray(rays * np.where(depths > 0, depths, np.nan)[:, None])


def _seen(camera: Camera, points: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels of points after `before_from_now`, and (n, 2, 6) by motions on the right."""
    now = apply(invert(pose), points)
    found = project_with_jacobian(camera, now, lens=False)
    by_turn = np.cross(found.jacobian_point, now[:, None, :])
    return found.px, np.concatenate([by_turn, -found.jacobian_point], axis=2)


def _moved(pose: FloatArray, step: FloatArray) -> FloatArray:
    return pose @ exp(np.pad(step, (0, 6 - len(step))))


def _registered(
    before: list[FloatArray],
    now: list[FloatArray],
    camera: Camera,
    mask: Mask,
    plane: FloatArray | None,
    start_px: FloatArray,
) -> Registration:
    """The registration from a shift of the coarsest image [px]."""
    size, pose = 3 if plane is None else 6, np.eye(4)
    middle = _points(camera, 0.5 * (np.array([camera.resolution]) - 1.0), plane)
    middle_px, by_motion = _seen(camera, middle, pose)
    pose = _moved(pose, np.linalg.pinv(by_motion[0, :, :3]) @ start_px * 2 ** (len(before) - 1))
    for level in reversed(range(len(before))):
        scale = 2**level
        at = _textured(before[level], mask, scale)
        points = _points(camera, scale * at, plane)
        is_seen = np.isfinite(points).all(axis=1)
        at, points = at[is_seen], points[is_seen]
        guess = np.nan_to_num(_seen(camera, points, pose)[0] / scale - at)
        shifts, covariances, found = _tracked(before[level], now[level], at, guess)
        px, covariances = scale * (at + shifts)[found], scale**2 * covariances[found]
        gate = scale * _GATE_PX
        pose, rows, rest = _fitted(camera, points[found], pose, px, covariances, gate, size)
    if len(at) < _FEWEST:
        words = f"{len(at)} patches, but needs {_FEWEST}"
        return nothing(size, f"the reference has too little texture: {words}")
    count = int(rows.any(axis=(1, 2)).sum())
    of_pose = _covariance(at[found] / camera.resolution, rows, rest)
    # Least share of the reference's patches that follow the camera: where parts cover three tenths
    # of both images, their edges are many of the best patches.
    if count < max(_FEWEST, 0.15 * len(at)) or not np.isfinite(of_pose).all():
        words = f"{count} of {len(at)} patches of the reference are found and agree"
        return nothing(size, f"another scene, or much of it moved: {words}")
    # A part on the camera, or a belt that carries most of the texture, moves against the rest.
    away = np.linalg.norm(_seen(camera, points, pose)[0] - at, axis=1) > 2 * _GATE_PX
    if away.any():
        shifts, _, found = _tracked(before[0], now[0], at, np.zeros_like(at))
        still = (found & away & (np.linalg.norm(shifts, axis=1) < _GATE_PX)).sum()
        # Share of patches at rest by which two motions are as likely as one.
        if still > 0.5 * count:
            words = f"{still} patches stand still while {count} move together"
            return nothing(size, f"something large moves, or hangs on the camera: {words}")
    px, by_motion = _seen(camera, middle, pose)
    of_shift = by_motion[0, :, :size] @ of_pose @ by_motion[0, :, :size].T
    # The rotation vector itself; over small turns it is that of small motions.
    turn = np.concatenate([log(pose)[:3], pose[:3, 3]])[:size]
    shift_px = px[0] - middle_px[0]
    return Registration("", turn, of_pose, shift_px, np.sqrt(np.diag(of_shift)), count)


def _textured(image: FloatArray, mask: Mask, scale: int) -> FloatArray:
    """(n, 2) whole pixels at the middles of the best patches, in an image so reduced."""
    box = 2 * _HALF + 1
    reach = np.ones((scale * box, scale * box), np.uint8)
    inside = cv2.erode(mask.astype(np.uint8), reach, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    # Most patches of an image, about.
    apart = max(_HALF, float(np.sqrt(image.size / 600)))
    found: tuple[Any, ...] = cv2.goodFeaturesToTrackWithQuality(
        image.astype(np.float32), 0, 1e-6, apart, inside[::scale, ::scale].copy(), blockSize=box
    )
    if found[0] is None:
        return np.zeros((0, 2))
    # The smaller eigenvalue of a shift's information, with slopes that OpenCV divides by box / 2.
    # Least information of a patch on its shift [grey^2/px^2]: 0.3 px in noise of 2 grey levels.
    return np.asarray(found[0].reshape(-1, 2)[found[1].ravel() * (box / 2) ** 2 > 44.0], float)


@dataclass(frozen=True, eq=False)
class _Spline:
    """An image between its pixels, by cubic B-splines."""

    coefficients: FloatArray  # (h + 4, w + 4) of the image, mirrored beyond two pixels of its edge.

    @classmethod
    def of(cls, image: FloatArray) -> Self:
        return cls(np.pad(spline_filter(image), 2, mode="reflect"))

    def patches(self, places: FloatArray, box: int) -> FloatArray:
        """(n, box^2) values by rows of squares whose first pixels are at (n, 2) places (u, v).

        All pixels of a patch lie alike between those of the image: two products with the four
        weights of each axis. A place beyond the image gives the nearest patch in it.
        """
        most = np.array(self.coefficients.shape[::-1]) - 4 - box
        first = np.clip(np.floor(places), 0, most).astype(int)
        t = np.clip(places - first, 0.0, 1.0)
        parts = [(1 - t) ** 3, (3 * t - 6) * t**2 + 4, 1 + 3 * t * (1 + t - t**2), t**3]
        weights = np.stack(parts)[..., None, None] / 6
        windows = sliding_window_view(self.coefficients, (box + 3, box + 3))
        window = windows[first[:, 1] + 1, first[:, 0] + 1]
        rows = sum(weights[at, :, 1] * window[:, at : at + box] for at in range(4))
        found = sum(weights[at, :, 0] * rows[:, :, at : at + box] for at in range(4))
        return np.reshape(found, (len(places), box**2))


def _tracked(
    before: FloatArray, now: FloatArray, at: FloatArray, guess: FloatArray
) -> tuple[FloatArray, FloatArray, Mask]:
    """Shifts of patches (n, 2) [px], their covariances (n, 2, 2), and which were found."""
    u, v = at.astype(int).T - _HALF
    box = 2 * _HALF + 1
    patch, by_v, by_u = (
        sliding_window_view(each, (box, box))[v, u].reshape(-1, box**2)
        for each in (before, *np.gradient(before))
    )
    # now(x + shift) = gain before(x + rest) + offset: a linear fit, whose rest is taken off.
    columns = np.stack([patch, np.ones_like(patch), by_u, by_v], axis=2)
    inverse = np.linalg.pinv(columns.transpose(0, 2, 1) @ columns, hermitian=True)
    solve = inverse @ columns.transpose(0, 2, 1)
    spline, shifts, moving = _Spline.of(now), guess.copy(), np.arange(len(at))
    values, solved = np.zeros((len(at), box**2)), np.zeros((len(at), 4))
    gain, length = np.full(len(at), np.inf), np.full(len(at), np.inf)
    for _ in range(12):
        values[moving] = spline.patches(at[moving] + shifts[moving] - _HALF, box)
        solved[moving] = (solve[moving] @ values[moving, :, None])[:, :, 0]
        gain[moving] = np.where(solved[moving, 0] > 0.1, solved[moving, 0], np.inf)
        rest = solved[moving, 2:] / gain[moving, None]
        length[moving] = away = np.linalg.norm(rest, axis=1)
        # Beyond a pixel and a half the slopes say only where it goes.
        shifts[moving] -= rest * np.minimum(1.0, 1.5 / np.maximum(away, 1e-9))[:, None]
        # Step after which a patch is at rest [px]; the next would be a small part of it.
        moving = moving[away > 1e-3]
    variance = np.mean((values - (columns @ solved[:, :, None])[:, :, 0]) ** 2, axis=1)
    covariances = variance[:, None, None] * inverse[:, 2:, 2:] / gain[:, None, None] ** 2
    limit = np.array(before.shape[::-1]) - _HALF - 1
    found = np.all((at + shifts > _HALF) & (at + shifts < limit), axis=1) & np.isfinite(gain)
    # Share of a patch's variance then that is found now.
    found &= (length < 0.1) & (variance < 0.5 * values.var(axis=1))
    # More is left where something else is in a part of the patch. Residual variance of a patch over
    # the median.
    found &= variance < 4.0 * np.median(variance[found]) if found.any() else found
    # Error of a shift that interpolation, lens and light leave with any contrast [px].
    return shifts, covariances + 0.02**2 * np.eye(2), found


def _fitted(
    camera: Camera,
    points: FloatArray,
    start: FloatArray,
    px: FloatArray,
    covariances: FloatArray,
    gate: float,
    size: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The pose that most patches follow, and their Jacobians and residuals over sigma, or zero."""
    failed = start, np.zeros((len(px), 2, size)), np.zeros((len(px), 2))
    if len(px) < _FEWEST:
        return failed
    predicted, jacobian = _seen(camera, points, start)
    # Pairs of patches give a turn; with a plane, its translation follows from all that agree.
    pairs, off = np.random.default_rng(0).integers(len(px), size=(300, 2)), px - predicted
    by_turn = jacobian[pairs][..., :3].reshape(-1, 4, 3)
    turns = (np.linalg.pinv(by_turn) @ off[pairs].reshape(-1, 4, 1))[..., 0]
    away = np.linalg.norm(off - np.einsum("nij,hj->hni", jacobian[..., :3], turns), axis=2)
    best = int((np.minimum(away, gate) ** 2).sum(axis=1).argmin())
    followed, pose = away[best] < gate, _moved(start, turns[best])
    root = np.linalg.inv(np.linalg.cholesky(covariances))
    for _ in range(10):
        if followed.sum() < _FEWEST:
            return failed
        predicted, jacobian = _seen(camera, points, pose)
        off = px - predicted
        rows, rest = root @ jacobian[..., :size], (root @ off[:, :, None])[:, :, 0]
        length = np.linalg.norm(rest, axis=1)
        # Half of the lengths of a plane's standard normal vectors are below 1.177.
        sigma = max(float(np.median(length[followed])) / 1.177, 0.3)
        # Residual of a patch that follows the camera, in sigmas.
        followed = (length < 4.0 * sigma) & (np.linalg.norm(off, axis=1) < gate)
        step = np.linalg.pinv(rows[followed].reshape(-1, size)) @ rest[followed].ravel()
        pose = _moved(pose, step)
    return pose, rows * followed[:, None, None], (rest - rows @ step) * followed[:, None]


def _covariance(places: FloatArray, rows: FloatArray, rest: FloatArray) -> FloatArray:
    """Covariance by the jackknife over blocks of the image; NaN by too few of them.

    Args:
        places: (n, 2) patches, in the image's sides.
        rows: (n, 2, p) their Jacobians over sigma; zero where they do not follow.
        rest: (n, 2) residuals over sigma.
    """
    size = rows.shape[2]
    unknown = np.full((size, size), np.nan)
    if not rows.any():
        return unknown
    block = np.floor(_BLOCKS * places).astype(int) @ np.array([1, _BLOCKS])
    parts = [block == each for each in np.unique(block)]
    information = np.stack([np.einsum("nki,nkj->ij", rows[part], rows[part]) for part in parts])
    scores = np.stack([np.einsum("nij,ni->j", rows[part], rest[part]) for part in parts])
    total = information.sum(axis=0)
    inverse = np.linalg.pinv(total, hermitian=True)
    # Blocks that say little count as parts of one (Carter, Schnepel and Steigerwald 2017).
    shares = np.einsum("ij,kji->k", inverse, information) / size
    count = 1.0 / max(float(np.sum(shares**2)), 1e-9)
    if count <= size + 3:
        return unknown
    # The change by each block: residuals are the smaller the more a block alone determines.
    changes = (np.linalg.pinv(total - information, hermitian=True) @ scores[:, :, None])[:, :, 0]
    # Few blocks tell their spread poorly: by this factor, the squared error over it is one on
    # average. Equal images are no proof of more than a tenth of the patches' own sigmas.
    factor = (count - 1) / (count - size - 2)
    return np.asarray(factor * changes.T @ changes + 0.01 * inverse)

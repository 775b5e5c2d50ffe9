"""Where patches of a registered print are, each by its own pixels, whatever the lens.

A patch has a shift of its own against the registered print, and light of its own, so that a lens
that is bent in another way biases none. Patches that share no pixel are independent.
"""

from dataclasses import replace

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from visioncal.core.types import Camera, FloatArray, Image, IntArray
from visioncal.vision.camera import normalise, project
from visioncal.vision.register.fit import Registered

# Side of the blocks within a patch whose errors go together [px].
_BLOCK_PX = 6


def places_of(
    found: Registered, points_m: FloatArray, half_m: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Places of square patches in the image.

    Differences of neighbours beyond their noise count in their sigmas.

    Args:
        found: The registered print.
        points_m: (n, 3) middles of patches on the target [m].
        half_m: Half of a patch's side [m].

    Returns:
        (m,) indices of the patches that are seen, (m, 2) their pixels, and (m,) standard deviations
        of a coordinate, the root mean square of both [px].
    """
    look, level = found.look, found.look.level
    light = look.drawn.light
    columns = np.concatenate([-look.by_px, [light, np.ones_like(light)]]).reshape(4, -1)
    free, residuals = look.weights.ravel(), look.residuals.ravel()
    v, u = np.divmod(np.arange(light.size), light.shape[1])
    blocks = v // _BLOCK_PX * light.size + u // _BLOCK_PX
    at, numbers = look.drawn.places_m, np.arange(light.size).reshape(light.shape)
    pixel_m = level.factor * float(look.flat.middle_at(found.seen.cam_from_target)[2])
    reach_m = half_m + 30 * pixel_m / float(level.camera.matrix[:2].mean())
    rows: list[tuple[int, FloatArray, float, float]] = []
    for number, place in enumerate(points_m[:, :2, None, None].astype(np.float32)):
        # Every eighth pixel near the patch bounds the search.
        rough = np.argwhere((np.abs(at[:, ::8, ::8] - place) < reach_m).all(axis=0))
        if not len(rough):
            continue
        (top, left), (bottom, right) = 8 * rough.min(axis=0), 8 * rough.max(axis=0) + 8
        near = (np.abs(at[:, top:bottom, left:right] - place) < half_m).all(axis=0)
        inside = numbers[top:bottom, left:right][near]
        taken = inside[free[inside] > 0.3]
        # Fewest pixels of a patch. Least share of a patch's pixels that is free: what covers a
        # third has a shadow, too.
        if len(taken) < max(60, 0.65 * len(inside)):
            continue
        patch_columns, weights = columns[:, taken], free[taken].astype(float)
        normal = (patch_columns * weights) @ patch_columns.T
        inverse = np.linalg.inv(normal + 1e-9 * (np.trace(normal) + 1e-9) * np.eye(4))
        # Largest ratio of a patch's sigmas: of parallel lines, the other is noise of the model.
        if np.linalg.cond(inverse[:2, :2]) > 4.0**2:
            continue
        solved = inverse @ (patch_columns * weights) @ residuals[taken]
        rest = residuals[taken] - solved @ patch_columns
        variance = float(weights @ rest**2) / (float(weights.sum()) - 4)
        _, block = np.unique(blocks[taken], return_inverse=True)
        scores = np.stack([np.bincount(block, row) for row in patch_columns * weights * rest])
        ratio = float(np.sum((inverse @ scores)[:2] ** 2) / (variance * np.trace(inverse[:2, :2])))
        rows.append((number, solved[:2], variance * np.trace(inverse[:2, :2]) / 2, ratio))
    if len(rows) < 2:
        return np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
    ids, shifts, variances, ratios = (np.array(column) for column in zip(*rows, strict=True))
    # Errors of neighbouring pixels go together alike in all patches.
    variances = variances * max(float(np.median(ratios)), 1.0)
    # Neighbours are shifted alike by what the lens lacks. The median of a squared length of two
    # coordinates is 2 log 2 variances.
    by = cKDTree(points_m[ids]).query(points_m[ids], 2)[1][:, -1]
    apart = np.sum((shifts - shifts[by]) ** 2, axis=1) / (variances + variances[by])
    beyond = max(float(np.median(apart)) / (2 * np.log(2.0)) - 1.0, 0.0)
    sigma = np.sqrt(variances + beyond * float(np.median(variances)))
    # Farther, a shift is beyond its linearisation: something else is there.
    kept = (np.linalg.norm(shifts, axis=1) < 1.0) & (sigma < 0.5)
    px = level.pixels_of(found.seen, points_m[ids]) + level.factor * shifts
    return ids[kept], px[kept], level.factor * sigma[kept]


def usual_lens(image: Image) -> Camera:
    """A lens of 60 deg without distortion, which a (h, w) image may be of."""
    height, width = image.shape
    focal = 0.9 * float(np.hypot(height, width))
    matrix = np.array([focal, focal, (width - 1) / 2, (height - 1) / 2])
    return Camera("brown", (width, height), matrix, np.zeros(5))


def usual_sigma(camera: Camera) -> FloatArray:
    """(7,) standard deviations of focal length, centre [px], k1, k2, p1 and p2 of lenses.

    Patches whose shifts are small against a pixel are as good as their noise: a lens that bends by
    k1 alone left shifts of 0.1 px, and errors of three times their sigmas.
    """
    focal = float(camera.matrix[:2].mean())
    return np.array([0.4 * focal, 0.1 * focal, 0.1 * focal, 0.4, 0.4, 0.01, 0.01])


def started(
    flat: FloatArray, places_m: FloatArray, px: FloatArray, lens: Camera
) -> tuple[Camera, FloatArray]:
    """Lens and (4, 4) pose of a plane that fit most of its features, from a homography of some.

    Args:
        flat: (3, 3) from the plane [m] to pixels.
        places_m: (n, 3) features on the plane [m].
        px: (n, 2) where these may be seen.
        lens: The lens as far as it is known, to within `usual_sigma`.
    """
    rays = normalise(lens, cv2.perspectiveTransform(places_m[None, :, :2], flat)[0])
    found = cv2.solvePnPGeneric(places_m, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    first = np.concatenate([found[1][0][:, 0], found[2][0][:, 0], np.zeros(4)])
    sigma = usual_sigma(lens)

    def bent(values: FloatArray) -> Camera:
        matrix = lens.matrix + sigma[[0, 0, 1, 2]] * values[[6, 6, 7, 8]]
        return replace(lens, matrix=matrix, distortion=sigma[3] * values[9] * np.eye(5)[0])

    def residuals(values: FloatArray) -> FloatArray:
        points = places_m @ cv2.Rodrigues(values[:3])[0].T + values[3:6]
        off = np.nan_to_num(project(bent(values), points) - px, nan=1e3)
        return np.concatenate([off.ravel(), values[6:]])

    # The pixel or two to which features are found; others agree by chance.
    best = least_squares(residuals, first, loss="soft_l1", x_scale="jac", max_nfev=40).x
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(best[:3])[0], best[3:6]
    return bent(best), pose

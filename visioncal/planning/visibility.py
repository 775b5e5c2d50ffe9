"""Views of a board: sampling, the camera's field of view, uncertain guesses and occlusion."""

from collections.abc import Iterable
from copy import copy

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import apply, compose, invert
from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.planning.cell import AnyCell, PlanCell, board_size_m
from visioncal.robot.collision import Body, arm_bodies
from visioncal.vision.camera import normalise, project_with_jacobian
from visioncal.vision.targets import extent_m, outline

# Factor by which draws extend the range of distances found useful.
_WIDER = 1.05
# Draws of the uncertain cell, the numbers of them after which hopeless poses are dropped, and the
# corners and points per side of the print.
_GUESSES, _CHECKED, _CORNERS, _SIDE_POINTS = 100, (5, 15, 40, 100), 4, 2
# A line of sight may end on a box, such as the table under a board: only this share must be free.
_FREE_SHARE, _TINY = 0.99, 1e-12


class FieldOfView:
    """Field of view of a camera."""

    def __init__(self, camera: Camera, edge_px: float) -> None:
        """Takes a camera, and how far from its image's edge points have to stay [px]."""
        self._camera, self._edge_px = camera, edge_px
        border = _border_tangents(camera, 0.0, 33)
        # Beyond these tangents a lens model may fold back into the image.
        self._largest_tangent = float(np.nanmax(np.linalg.norm(border, axis=-1))) * (1.0 + 1e-6)

    def holds(self, points_cam: FloatArray) -> Mask:
        """Whether all of (..., p, 3) points in the camera frame are in the image (...)."""
        ahead = points_cam[..., 2] > 0.0
        reach = np.linalg.norm(points_cam[..., :2], axis=-1)
        inside = np.asarray((ahead & (reach < self._largest_tangent * points_cam[..., 2])).all(-1))
        px = project_with_jacobian(self._camera, points_cam[inside].reshape(-1, 3), lens=False).px
        high_px = np.array(self._camera.resolution) - 1.0 - self._edge_px
        good = ((px >= self._edge_px) & (px <= high_px)).all(axis=1)
        inside[inside] = good.reshape(-1, points_cam.shape[-2]).all(axis=-1)
        return inside


def _border_tangents(camera: Camera, edge_px: float, rays: int) -> FloatArray:
    """(4, rays, 2) x / z and y / z of rays along the image's sides, `edge_px` inside."""
    # The sides are the upper, lower, left and right one; NaN where the lens has no ray.
    along = np.linspace(-1.0, 1.0, rays)
    ones = np.ones_like(along)
    sides = [(along, -ones), (along, ones), (-ones, along), (ones, along)]
    unit = np.concatenate([np.column_stack(side) for side in sides])
    half = 0.5 * (np.array(camera.resolution) - 1.0)
    return normalise(camera, half + unit * (half - edge_px)).reshape(4, rays, 2)


class BoardViews:
    """Views of a board by a camera, with draws from the uncertainty of a cell's guesses.

    Attributes:
        distance_m: Least and greatest distance between camera and board centre [m].
        outline: (p, 3) points around the print, its corners first, in the target frame [m].
        centre: (3,) centre of the print [m].

    Raises:
        DataError: The lens has no field of view, or next to none.
    """

    def __init__(self, cell: PlanCell, seed: int) -> None:
        border = _border_tangents(cell.camera, cell.limits.edge_px, 9)
        tangents = np.abs(border[np.isfinite(border).all(axis=-1)]).max(axis=-1, initial=0.0)
        if not len(tangents) or tangents.min() < 1e-4:
            raise DataError(
                "camera: no ray of this lens reaches the border of its image, or all are parallel: "
                f"matrix is {cell.camera.matrix.tolist()}, distortion "
                f"{cell.camera.distortion.tolist()}.",
                culprits=["camera"],
                next_step="Look at the intrinsics that were given.",
            )
        drawn = cell.guesses(_GUESSES, seed)
        self._cell, self._window = cell, FieldOfView(cell.camera, cell.limits.edge_px)
        # (g, 4, 4) draws of the uncertain edges.
        self._x, self._z = (np.array([getattr(one, edge) for one in drawn]) for edge in "xz")
        self._low, self._high = low, high = extent_m(cell.target)
        self.centre = np.append(0.5 * (low + high), 0.0)
        knots = outline(cell.target)
        shares = np.arange(_SIDE_POINTS)[:, None, None] / _SIDE_POINTS
        points = knots + shares * (np.roll(knots, -1, axis=0) - knots)
        self.outline = points.reshape(-1, 3)
        # Distances at which the board fills the image, and stays in it if the guesses are off: at a
        # distance d by the errors of both positions, by d times the error of the camera's rotation,
        # and by half the board's size times the error of its own rotation.
        half, radius = float(np.nanmin(tangents)), 0.5 * board_size_m(cell.target)
        full = radius / half
        # Range of distances, relative to that at which the print's half diagonal fills the image's
        # half short side.
        near, far = 0.75 * full, 6.0 * full
        for d in np.linspace(full, far, 60):
            turned = cell.sigma_rad * np.hypot(d, radius)
            # Errors of 2.2 standard deviations.
            if half * d > radius + 2.2 * np.sqrt(2.0 * cell.sigma_m**2 + turned**2):
                far = max(1.6 * full, 1.15 * float(d))
                break
        # The board stays in view where it has been observed.
        least, most = cell.observed_distances_m or (np.inf, 0.0)
        reach = min(near, least / _WIDER), max(far, _WIDER * most)
        self.distance_m: tuple[float, float] = cell.limits.distance_m or reach

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draws views of the board.

        The camera is uniform on a spherical cap around the board's normal and turned at random
        about its line of sight; the board's centre is anywhere in the image where the board fits.

        Returns:
            (count, 4, 4) `cam_from_target` [m].
        """
        cell, camera, limits = self._cell, self._cell.camera, self._cell.limits
        tilt = np.arccos(rng.uniform(np.cos(limits.tilt_rad), 1.0, count))
        azimuth, roll = rng.uniform(-np.pi, np.pi, (2, count))
        distance = rng.uniform(*self.distance_m, size=(count, 1))
        middle = 0.5 * (np.array(camera.resolution) - 1.0)
        # Least half size of the board in the image, of which tilt leaves 80 %, with a margin of two
        # standard deviations. A drawn view need not show the board; this only avoids drawing many
        # that cannot.
        across = 0.4 * float((self._high - self._low).min())
        doubt = 2.0 * np.hypot(np.sqrt(2.0) * cell.sigma_m / distance, cell.sigma_rad)
        occupied_px = camera.matrix[:2].mean() * (across / distance + doubt)
        room = np.maximum(middle - limits.edge_px - occupied_px, 0.0)
        aim = middle + rng.uniform(-1.0, 1.0, (count, 2)) * room
        plane = np.nan_to_num(normalise(camera, aim))
        ray = np.column_stack([plane, np.ones(count)])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        # The target's z points away from the camera. The rotation that takes z to the ray is last.
        spun = Rotation.from_euler("ZXZ", np.column_stack([roll, tilt, azimuth]))
        across_ray = np.cross([0.0, 0.0, 1.0], ray)
        sine = np.linalg.norm(across_ray, axis=1, keepdims=True)
        angle = np.arctan2(sine, ray[:, 2:])
        turn = Rotation.from_rotvec(across_ray * angle / np.maximum(sine, 1e-12))
        rotation = np.asarray((turn * spun).as_matrix())
        return compose(rotation, distance * ray - rotation @ self.centre)

    def nearer_to(self, cam_from_target: FloatArray) -> "BoardViews":
        """Restricts the distances to those of (k, 4, 4) good views."""
        distance, nearer = self.distances_m(cam_from_target), copy(self)
        low, high = self.distance_m
        least, most = float(distance.min()) / _WIDER, float(distance.max()) * _WIDER
        nearer.distance_m = max(low, least), min(high, most)
        return nearer

    def shows(self, cam_from_target: FloatArray) -> Mask:
        """Whether the whole print is in the image (k,) of views (k, 4, 4)."""
        return self._window.holds(apply(cam_from_target, self.outline))

    def share(self, base_from_flange: FloatArray, wanted: float) -> FloatArray:
        """Share (k,) of the uncertain cell's draws that show the whole print at poses (k, 4, 4).

        Poses that cannot reach the wanted share any more are not evaluated further: theirs is a
        lower bound.
        """
        in_hand = self._cell.mount == "eye-in-hand"
        flange = invert(base_from_flange) if in_hand else base_from_flange
        counts = np.zeros(len(flange))
        checked, possible = 0, np.arange(len(flange))
        for upto in _CHECKED:
            # The corners are enough for a share: the sides between them are nearly straight.
            outlines = apply(self._z[checked:upto], self.outline[:_CORNERS])
            points = apply(flange[possible], outlines.reshape(-1, 3))
            points = points.reshape(len(possible), *outlines.shape)
            counts[possible] += self._window.holds(
                apply(invert(self._x[checked:upto]), points)
            ).sum(axis=1)
            checked = upto
            possible = possible[(_GUESSES - upto + counts[possible]) / _GUESSES >= wanted]
        share = np.minimum(counts / _GUESSES, np.nextafter(wanted, 0.0))
        share[possible] = counts[possible] / _GUESSES
        return share

    def tilt_rad(self, cam_from_target: FloatArray) -> FloatArray:
        """Angles (k,) between the line of sight to the board's centre and its normal [rad]."""
        centre = cam_from_target[:, :3, :3] @ self.centre + cam_from_target[:, :3, 3]
        along = np.einsum("ki,ki->k", centre, cam_from_target[:, :3, 2])
        return np.asarray(np.arccos(np.clip(along / np.linalg.norm(centre, axis=1), -1.0, 1.0)))

    def distances_m(self, cam_from_target: FloatArray) -> FloatArray:
        """Distances (k,) between the camera and the board's centre [m]."""
        centre = cam_from_target[:, :3, :3] @ self.centre + cam_from_target[:, :3, 3]
        return np.asarray(np.linalg.norm(centre, axis=1))

    def sharp(self, cam_from_target: FloatArray) -> Mask:
        """Whether the whole print (k,) lies within the depths at which the image is sharp."""
        near, far = self._cell.limits.focus_m or (-np.inf, np.inf)
        depth = cam_from_target[:, 2, :3] @ self.outline.T + cam_from_target[:, 2, 3, None]
        return np.asarray(((depth >= near) & (depth <= far)).all(axis=1))


class Occlusion:
    """Occlusion of the lines of sight from the camera to points of the print.

    Args:
        cell: The cell.
        points: (p, 3) the points of the print, in the target frame [m].
    """

    def __init__(self, cell: AnyCell, points: FloatArray) -> None:
        self.cell, self.points = cell, points
        # Those on the last link carry camera or board, and do not move relative to it.
        hand = cell.robot.joint_count
        self.parts = tuple(body for body in arm_bodies(cell.robot) if body.link < hand)

    def behind_boxes(self, base_from_flange: FloatArray) -> Mask:
        """Whether a box hides part of the print (k,) at flange poses (k, 4, 4)."""
        return self._behind([box.body for box in self.cell.boxes], base_from_flange[:, None])

    def behind_arm(self, q: FloatArray) -> Mask:
        """Whether the arm hides part of the print (k,) at joints (k, n) [rad]."""
        return self._behind(self.parts, self.cell.robot.link_frames(q))

    def _behind(self, bodies: Iterable[Body], frames: FloatArray) -> Mask:
        """Whether one of some bodies hides part of the print (k,) at frames of the links."""
        cell, base_from_flange = self.cell, frames[:, -1]
        in_hand = cell.mount == "eye-in-hand"
        base_from_cam = base_from_flange @ cell.x if in_hand else cell.x[None]
        base_from_target = cell.z[None] if in_hand else base_from_flange @ cell.z
        # Starts (k or 1, 1, 3) and ends (k or 1, p, 3) of the lines of sight, in the base [m].
        starts = base_from_cam[:, None, :3, 3]
        ends = self.points @ np.swapaxes(base_from_target[:, :3, :3], 1, 2)
        ends = ends + base_from_target[:, None, :3, 3]
        hidden = np.zeros(len(frames), dtype=bool)
        for body in bodies:
            place = body.link_from_body[None]
            if body.link:
                place = frames[:, body.link - 1] @ place
            blocks = _box_blocks if body.shape == "box" else _capsule_blocks
            hidden |= blocks(starts, ends, place, body.size_m)
        return hidden


def _box_blocks(
    starts: FloatArray, ends: FloatArray, base_from_box: FloatArray, size_m: FloatArray
) -> Mask:
    """Whether any of the lines (k, p) of a row intersects a box at (k or 1, 4, 4)."""
    # Slab method (Kay and Kajiya 1986).
    rotation, middle = base_from_box[:, :3, :3], base_from_box[:, None, :3, 3]
    start, along = (starts - middle) @ rotation, (ends - starts) @ rotation
    along = np.where(along == 0.0, _TINY, along)
    faces = np.stack([(side * size_m - start) / along for side in (-0.5, 0.5)])
    enters, leaves = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
    intersects = (enters <= leaves) & (enters < _FREE_SHARE) & (leaves > 0.0)
    return np.asarray(intersects.any(axis=1))


def _capsule_blocks(
    starts: FloatArray, ends: FloatArray, base_from_capsule: FloatArray, size_m: FloatArray
) -> Mask:
    """Whether any of the lines (k, p) of a row intersects a capsule at (k or 1, 4, 4)."""
    # Closest points of two segments (Ericson 2005, Real-Time Collision Detection, 5.1.9, whose
    # names a, b, c, e, f are kept). Lines that start inside do not count: the camera is really
    # beside the link, whose shape is rough.
    radius, length = size_m
    axis = length * base_from_capsule[:, None, :3, 2]
    foot = base_from_capsule[:, None, :3, 3] - 0.5 * axis
    along, from_foot = _FREE_SHARE * (ends - starts), starts - foot
    a, e = _dot(along, along), max(length**2, _TINY)
    b, c, f = _dot(along, axis), _dot(along, from_foot), _dot(axis, from_foot)
    determinant = np.maximum(a * e - b**2, _TINY * a * e)
    at_line = np.clip((b * f - c * e) / determinant, 0.0, 1.0)
    at_axis = np.clip((b * at_line + f) / e, 0.0, 1.0)
    at_line = np.clip((b * at_axis - c) / a, 0.0, 1.0)
    between = from_foot + at_line[..., None] * along - at_axis[..., None] * axis
    inside = from_foot - np.clip(f / e, 0.0, 1.0)[..., None] * axis
    intersects = (_dot(between, between) < radius**2) & (_dot(inside, inside) > radius**2)
    return np.asarray(intersects.any(axis=1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.sum(a * b, axis=-1))

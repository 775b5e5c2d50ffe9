"""From where a board is seen: views drawn around it, what shades them, guesses that show it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import apply, compose, invert
from visioncal.core.types import Camera, FloatArray, IntArray, Mask, Target
from visioncal.live.planning.cell import PlanCell, board_size_m
from visioncal.robot.batch import chain_frames
from visioncal.robot.bodies import Body, arm_bodies
from visioncal.vision.camera import normalise, project_with_jacobian
from visioncal.vision.targets import extent_m

# How large the board is drawn: the image's half short side over half the print's diagonal.
_NEAREST, _FARTHEST = 0.75, 1.6
# What tilt leaves of a board's short side, and how many standard deviations of where it is in the
# image are left free around it.
_FORESHORTENED, _DOUBTED = 0.8, 2.0
# How far draws reach beyond the distances that turned out well.
_WIDER = 1.05
# The guesses are off by less than so many standard deviations, and a plan goes no farther than so
# many times the distance at which the board would fill the image.
_SURELY, _NEVER_BEYOND = 2.2, 6.0
# How many cells stand for what may really be, how many of them are looked at before those that are
# out of the question are left out, and how many points stand for a side of the print.
_GUESSES, _LOOKED_AT, _CORNERS, _SIDE_POINTS = 100, (5, 15, 40, 100), 4, 2
# By so many rays through each side of the image the distance is found at which the board fills it.
_BORDER_RAYS = 9
# A lens that sees no more than this to its side, in a distance of one, is none.
_NARROWEST = 1e-4
# Rays along each side of the image, and the share by which planes keep off what lies between them.
_RAYS, _OFF = 33, 2e-3

# A line of sight may end on a box, as on the table that a board lies on: it is free up to here.
_LIES_ON, _TINY = 0.99, 1e-12


class Window:
    """The part of space that a camera has in its image.

    A lens bends the image's sides. Points between four planes within the bent sides are in the
    image, points beyond four planes around them are not; only points in between need be projected.
    """

    def __init__(self, camera: Camera, edge_px: float) -> None:
        """Prepares the planes.

        Args:
            camera: The intrinsics.
            edge_px: How far points stay from the image's edge [px].
        """
        self._camera, self._edge_px = camera, edge_px
        whole = _border_tangents(camera, 0.0, _RAYS)
        # Tangents of rays are shorter; beyond, a lens model may fold back into the image.
        self._rays_within = float(np.nanmax(np.linalg.norm(whole, axis=-1))) * (1.0 + 1e-6)
        self._inner, self._outer = _planes(_border_tangents(camera, edge_px, _RAYS))

    def holds(self, points_cam: FloatArray) -> Mask:
        """Whether all of (..., p, 3) points in the camera's frame are in the image (...)."""
        inside = _between(self._inner, points_cam)
        doubtful = ~inside & _between(self._outer, points_cam)
        if doubtful.any():
            inside[doubtful] = self._projected(points_cam[doubtful])
        return inside

    def _projected(self, points_cam: FloatArray) -> Mask:
        flat = points_cam.reshape(-1, 3)
        straight = np.linalg.norm(flat[:, :2], axis=1) < self._rays_within * flat[:, 2]
        px = np.full((len(flat), 2), -np.inf)
        px[straight] = project_with_jacobian(self._camera, flat[straight], lens=False).px
        high = np.array(self._camera.resolution) - 1.0 - self._edge_px
        good = ((px >= self._edge_px) & (px <= high)).all(axis=1)
        return np.asarray(good.reshape(points_cam.shape[:-1]).all(axis=-1))


def _border_tangents(camera: Camera, edge_px: float, rays: int) -> FloatArray:
    """(4, rays, 2) x / z and y / z of rays along the image's sides, `edge_px` inside."""
    # The sides are the upper, lower, left and right one; NaN where the lens has no ray.
    along = np.linspace(-1.0, 1.0, rays)
    ones = np.ones_like(along)
    sides = [(along, -ones), (along, ones), (-ones, along), (ones, along)]
    unit = np.concatenate([np.column_stack(side) for side in sides])
    half = 0.5 * (np.array(camera.resolution) - 1.0)
    return normalise(camera, half + unit * (half - edge_px)).reshape(4, rays, 2)


def _planes(tangents: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (4, 3) of the planes within and around the sides; points between have no negative."""
    if np.isnan(tangents).any():
        # A lens without rays to its corners: no point is surely inside, and any before it may be.
        ahead, aside = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        return np.array([ahead, -ahead, aside, -aside]), np.array([ahead] * 4)
    top, bottom, left, right = tangents
    off = _OFF * np.ptp(tangents.reshape(-1, 2), axis=0)
    inner = [left[:, 0].max(), right[:, 0].min(), top[:, 1].max(), bottom[:, 1].min()]
    outer = [left[:, 0].min(), right[:, 0].max(), top[:, 1].min(), bottom[:, 1].max()]
    inward = np.array([off[0], -off[0], off[1], -off[1]])
    return _normals(np.array(inner) + inward), _normals(np.array(outer) - inward)


def _normals(bounds: FloatArray) -> FloatArray:
    """(4, 3) normals of the planes at least and greatest x / z and y / z."""
    left, right, top, bottom = bounds.tolist()
    return np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]])


def _between(normals: FloatArray, points: FloatArray) -> Mask:
    """Whether all of (..., p, 3) points are between planes."""
    sides = points.reshape(-1, 3) @ normals.T
    return np.asarray((sides >= 0.0).reshape(*points.shape[:-1], 4).all(axis=(-1, -2)))


@dataclass(frozen=True, eq=False)
class CameraAim:
    """A camera that looks at a board.

    Attributes:
        cell: The cell, as it is guessed.
        distance_m: Least and greatest distance between camera and board's centre [m].
        outline: (p, 3) points around the print, its corners first, in the target's frame [m].
        centre: (3,) the print's centre [m].
        window: The part of space that is in the image.
        x: (g, 4, 4) draws of the guessed edge x.
        z: (g, 4, 4) draws of the guessed edge z.
    """

    cell: PlanCell
    distance_m: tuple[float, float]
    outline: FloatArray
    centre: FloatArray
    window: Window
    x: FloatArray
    z: FloatArray

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draws views of the board.

        The camera lies on a cap around the board's normal, uniform on its area, and is turned any
        way about its line of sight; the board's centre is anywhere in the image where the board has
        room.

        Returns:
            (count, 4, 4) `cam_from_target` [m].
        """
        camera, limits = self.cell.camera, self.cell.limits
        tilt = np.arccos(rng.uniform(np.cos(limits.tilt_rad), 1.0, count))
        azimuth, roll = rng.uniform(-np.pi, np.pi, (2, count))
        distance = rng.uniform(*self.distance_m, size=(count, 1))
        middle = 0.5 * (np.array(camera.resolution) - 1.0)
        room = np.maximum(middle - limits.edge_px - self._taken_px(distance), 0.0)
        aim = middle + rng.uniform(-1.0, 1.0, (count, 2)) * room
        plane = np.nan_to_num(normalise(camera, aim))
        ray = np.column_stack([plane, np.ones(count)])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        # The target's z leaves the camera. The turn that takes z to the ray comes last.
        spun = Rotation.from_euler("ZXZ", np.column_stack([roll, tilt, azimuth]))
        across = np.cross([0.0, 0.0, 1.0], ray)
        sine = np.linalg.norm(across, axis=1, keepdims=True)
        angle = np.arctan2(sine, ray[:, 2:])
        turn = Rotation.from_rotvec(across * angle / np.maximum(sine, 1e-12))
        rotation = np.asarray((turn * spun).as_matrix())
        return compose(rotation, distance * ray - rotation @ self.centre)

    def _taken_px(self, distance_m: FloatArray) -> FloatArray:
        """How much of the image's half sides a board (k, 1) takes at least, with some doubt [px].

        A drawn view need not show the board; this only saves drawing many that cannot.
        """
        cell = self.cell
        low, high = extent_m(cell.target)
        across = _FORESHORTENED * 0.5 * float((high - low).min())
        doubt = _DOUBTED * np.hypot(np.sqrt(2.0) * cell.sigma_m / distance_m, cell.sigma_rad)
        return np.asarray(cell.camera.matrix[:2].mean() * (across / distance_m + doubt))

    def nearer_to(self, cam_from_target: FloatArray) -> "CameraAim":
        """The same, drawing distances like those of (k, 4, 4) views that turned out well."""
        distance = self.distances_m(cam_from_target)
        low, high = self.distance_m
        least, most = float(distance.min()) / _WIDER, float(distance.max()) * _WIDER
        return replace(self, distance_m=(max(low, least), min(high, most)))

    def shows(self, cam_from_target: FloatArray) -> Mask:
        """Whether the whole print is in the image (k,) of views (k, 4, 4)."""
        return self.window.holds(apply(cam_from_target, self.outline))

    def share(self, base_from_flange: FloatArray, wanted: float) -> FloatArray:
        """In what share of the guesses' draws poses show the whole print.

        Args:
            base_from_flange: (k, 4, 4) the poses [m].
            wanted: Where the first draws leave no hope of this share, the others are not looked at.

        Returns:
            (k,) shares; where the wanted one is not reached, not all may have been counted.
        """
        seen = np.zeros(len(base_from_flange))
        looked, hope = 0, np.arange(len(base_from_flange))
        for upto in _LOOKED_AT:
            shows = self._drawn_shows(base_from_flange[hope], slice(looked, upto))
            seen[hope] += shows.sum(axis=1)
            looked = upto
            hope = hope[(_GUESSES - upto + seen[hope]) / _GUESSES >= wanted]
        share = np.minimum(seen / _GUESSES, np.nextafter(wanted, 0.0))
        share[hope] = seen[hope] / _GUESSES
        return share

    def _drawn_shows(self, base_from_flange: FloatArray, which: slice) -> Mask:
        in_hand = self.cell.mount == "eye-in-hand"
        flange = invert(base_from_flange) if in_hand else base_from_flange
        # Its corners do for a share, and sides between them are nearly straight.
        outlines = apply(self.z[which], self.outline[:_CORNERS])
        points = apply(flange, outlines.reshape(-1, 3))
        cam_from_here = invert(self.x[which])
        return self.window.holds(apply(cam_from_here, points.reshape(len(flange), *outlines.shape)))

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
        span = self.cell.limits.focus_m
        if span is None:
            return np.ones(len(cam_from_target), dtype=bool)
        depth = cam_from_target[:, 2, :3] @ self.outline.T + cam_from_target[:, 2, 3, None]
        return np.asarray(((depth >= span[0]) & (depth <= span[1])).all(axis=1))


def sight_of(cell: PlanCell, seed: int) -> CameraAim:
    """Prepares the views of a cell, with draws of what its guesses may really be.

    Raises:
        DataError: The lens sees nothing, or as good as nothing.
    """
    border = _border_tangents(cell.camera, cell.limits.edge_px, _BORDER_RAYS)
    seen = np.abs(border[np.isfinite(border).all(axis=-1)]).max(axis=-1, initial=0.0)
    if not len(seen) or seen.min() < _NARROWEST:
        raise DataError(
            "camera: no ray of this lens reaches the border of its image, or all are parallel: "
            f"matrix is {cell.camera.matrix.tolist()}, distortion "
            f"{cell.camera.distortion.tolist()}.",
            culprits=["camera"],
            next_step="Look at the intrinsics that were given.",
        )
    drawn = cell.guesses(_GUESSES, seed)
    low, high = extent_m(cell.target)
    return CameraAim(
        cell,
        cell.limits.distance_m or _distance_m(cell),
        _outline(cell.target),
        np.append(0.5 * (low + high), 0.0),
        Window(cell.camera, cell.limits.edge_px),
        np.array([plan_cell.x for plan_cell in drawn]),
        np.array([plan_cell.z for plan_cell in drawn]),
    )


def _distance_m(cell: PlanCell) -> tuple[float, float]:
    """Distances at which the board fills the image, or has been seen already [m]."""
    near, far = _filling_m(cell)
    if cell.shown_m is None:
        return near, far
    return min(near, cell.shown_m[0] / _WIDER), max(far, _WIDER * cell.shown_m[1])


def _filling_m(cell: PlanCell) -> tuple[float, float]:
    """Distances at which the board fills the image, and stays in it if the guesses are off [m]."""
    # At a distance d the board is off by the errors of both places, by d times the error of the
    # camera's direction, and by half its own size times the error of its own.
    border = _border_tangents(cell.camera, cell.limits.edge_px, _BORDER_RAYS)
    half = float(np.nanmin(np.abs(border).max(axis=-1)))
    radius = 0.5 * board_size_m(cell.target)
    full = radius / half
    farthest = _FARTHEST * full
    for d in np.linspace(full, _NEVER_BEYOND * full, 60):
        turned = cell.sigma_rad * np.hypot(d, radius)
        if half * d > radius + _SURELY * np.sqrt(2.0 * cell.sigma_m**2 + turned**2):
            return _NEAREST * full, max(farthest, 1.15 * float(d))
    return _NEAREST * full, _NEVER_BEYOND * full


def _outline(target: Target) -> FloatArray:
    """(p, 3) points around the print [m]."""
    low, high = extent_m(target)
    knots = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    shares = np.arange(_SIDE_POINTS)[:, None, None] / _SIDE_POINTS
    points = knots + shares * (np.roll(knots, -1, axis=0) - knots)
    return np.pad(points.reshape(-1, 2), ((0, 0), (0, 1)))


@dataclass(frozen=True, eq=False)
class Shade:
    """Lines of sight from the camera to points of the print, and what may stand in them.

    Attributes:
        cell: The cell, as it is guessed.
        points: (p, 3) the points of the print, in the target's frame [m].
        parts: The arm's bodies; not those on which camera or board are mounted, which are where
            they are in every posture.
    """

    cell: PlanCell
    points: FloatArray
    parts: tuple[Body, ...]

    @classmethod
    def of(cls, cell: PlanCell, points: FloatArray) -> "Shade":
        """Prepares the bodies of a cell."""
        parts = (body for body in arm_bodies(cell.robot) if body.link < cell.robot.joint_count)
        return cls(cell, points, tuple(parts))

    def behind_boxes(self, base_from_flange: FloatArray) -> IntArray:
        """Looks for boxes in the lines of sight.

        Args:
            base_from_flange: (k, 4, 4) poses [m].

        Returns:
            (k,) the place of a box that hides a part of the print; -1 where there is none.
        """
        starts, ends = self._lines(base_from_flange)
        found = np.full(len(base_from_flange), -1, dtype=np.int64)
        for place, box in enumerate(self.cell.boxes):
            found[_meet_box(starts, ends, box.base_from_box[None], box.size_m)] = place
        return found

    def behind_arm(self, q: FloatArray) -> IntArray:
        """Looks for the arm itself in the lines of sight.

        Args:
            q: (k, n) joint angles [rad].

        Returns:
            (k,) the place in `parts` of one that hides a part of the print; -1 where there is none.
        """
        chain = self.cell.robot.chain
        frames = chain_frames(chain, chain.effective(q))
        starts, ends = self._lines(frames[:, -1])
        found = np.full(len(q), -1, dtype=np.int64)
        for place, part in enumerate(self.parts):
            body = part.link_from_body[None]
            if part.link:
                body = frames[:, part.link - 1] @ body
            if part.shape == "box":
                hidden = _meet_box(starts, ends, body, part.size_m)
            else:
                hidden = _meet_tube(starts, ends, body, part.size_m)
            found[hidden] = place
        return found

    def _lines(self, base_from_flange: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Begins (k or 1, 1, 3) and ends (k or 1, p, 3) of the lines of sight, in the base [m]."""
        cell = self.cell
        in_hand = cell.mount == "eye-in-hand"
        base_from_cam = base_from_flange @ cell.x if in_hand else cell.x[None]
        base_from_target = cell.z[None] if in_hand else base_from_flange @ cell.z
        ends = self.points @ np.swapaxes(base_from_target[:, :3, :3], 1, 2)
        return base_from_cam[:, None, :3, 3], ends + base_from_target[:, None, :3, 3]


def _meet_box(
    starts: FloatArray, ends: FloatArray, base_from_box: FloatArray, size_m: FloatArray
) -> Mask:
    """Whether one of the lines (k, p) of a row meets a box at (k or 1, 4, 4)."""
    # A line meets a box where the spans in which it is between opposite faces overlap (Kay and
    # Kajiya 1986, slabs).
    rotation, middle = base_from_box[:, :3, :3], base_from_box[:, None, :3, 3]
    start, along = (starts - middle) @ rotation, (ends - starts) @ rotation
    along = np.where(along == 0.0, _TINY, along)
    faces = np.stack([(side * size_m - start) / along for side in (-0.5, 0.5)])
    enters, leaves = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
    meets = (enters <= leaves) & (enters < _LIES_ON) & (leaves > 0.0)
    return np.asarray(meets.any(axis=1))


def _meet_tube(
    starts: FloatArray, ends: FloatArray, base_from_tube: FloatArray, size_m: FloatArray
) -> Mask:
    """Whether one of the lines (k, p) of a row meets a tube with round ends at (k or 1, 4, 4)."""
    # The nearest points of two lines (Ericson 2005, Real-Time Collision Detection, 5.1.9). A line
    # that begins inside is no line of sight: the camera is beside the tube, whose form is a rough
    # one.
    radius, length = size_m
    axis = length * base_from_tube[:, None, :3, 2]
    foot = base_from_tube[:, None, :3, 3] - 0.5 * axis
    along, apart = _LIES_ON * (ends - starts), starts - foot
    far, long = _dot(along, along), max(length**2, _TINY)
    both, by_line, by_axis = _dot(along, axis), _dot(along, apart), _dot(axis, apart)
    across = np.maximum(far * long - both**2, _TINY * far * long)
    at_line = np.clip((both * by_axis - by_line * long) / across, 0.0, 1.0)
    at_axis = np.clip((both * at_line + by_axis) / long, 0.0, 1.0)
    at_line = np.clip((both * at_axis - by_line) / far, 0.0, 1.0)
    between = apart + at_line[..., None] * along - at_axis[..., None] * axis
    inside = apart - np.clip(by_axis / long, 0.0, 1.0)[..., None] * axis
    meets = (_dot(between, between) < radius**2) & (_dot(inside, inside) > radius**2)
    return np.asarray(meets.any(axis=1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.sum(a * b, axis=-1))

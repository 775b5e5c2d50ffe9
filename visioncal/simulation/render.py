"""Rendering of a simulated board: one ray per sub-pixel, through the lens onto the sheet.

An arm that holds a board before a fixed camera is drawn as shaded tubes. Rays are traced at the
knots of a grid: over a hundredth of a radian perspective and distortion are so smooth that a cubic
spline through them is accurate to far below a thousandth of a pixel, at a fraction of the cost.
`LiveView` takes images while the arm stands or moves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from visioncal.core.errors import DataError
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import compose, invert, rotation_angle
from visioncal.core.types import Camera, FloatArray, Image, IntArray
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, forward, link_frames, reach_m
from visioncal.simulation.boards import Sheet, bow_depth_m, centre_m, corners_m, outline_m, unit_m
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.layout import CameraOptions, RandomStream
from visioncal.simulation.optics import project, rays, sees
from visioncal.simulation.textures import SheetTexture, draw_sheet, draw_table, draw_wall, margin_m

Float32Array: TypeAlias = npt.NDArray[np.float32]

# Distance of knots [rad].
_KNOT_RAD = 0.01
# Number of overlapping cubic splines.
_TAPS = 4
# Sub-pixels along a pixel's side.
_SAMPLES = 3
# Rows of pixels that are processed at a time, to stay in the processor's cache.
_BAND_PX = 48
_BLACK_LEVEL, _FLOOR = 4.0, 118.0
# Cosine of an angle beyond every lens's field of view: 84 degrees.
_LEAST_COSINE = 0.1
# Parts closer to the camera's plane are not drawn [m].
_NEAREST_M = 0.15
_SHADES = 18
# Image shift below the accuracy of corner detection [px].
_STILL_PX = 0.003
# Shorter motion blur is averaged from exact images, as it may count as standstill; longer blur from
# shifted ones.
_SHORT_PX = 2.0
_MOST_PARTS = 24
# Substitute for the distance of a board that is not in front of the camera [m].
_FAR_M = 1.0


@dataclass(frozen=True)
class Patch:
    """A rectangle of the image: pixels from (left, top) up to before (right, bottom)."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.right - self.left, self.bottom - self.top


@dataclass(frozen=True, eq=False)
class _Spline:
    """Cubic B-splines along one side of a patch (de Boor 1978); four overlap at any point."""

    coefficients: FloatArray  # (k, k) operator from values at the knots to spline coefficients.
    first: IntArray  # (n,) first of the four splines at each sub-pixel.
    weights: Float32Array  # (n, 4) values of the four splines there.


@dataclass(frozen=True, eq=False)
class Raster:
    """Rays at the knots of a grid over a patch, and their interpolation to sub-pixels."""

    px: FloatArray  # (a, b, 2) knots [px].
    directions: FloatArray  # (a, b, 3) unit vectors in the camera frame.
    down: _Spline  # Splines along columns of pixels.
    across: _Spline  # Splines along rows of pixels.


@dataclass(frozen=True, eq=False)
class Columns:
    """Values of a grid at all sub-pixel columns, as spline coefficients along the columns."""

    mean: np.float32  # Mean of the values, subtracted to preserve single precision.
    coefficients: Float32Array  # (a, columns).


def trace(camera: Camera, patch: Patch, samples: int) -> Raster:
    """Traces rays over a patch, with `samples` sub-pixels along a pixel's side."""
    knot_px = _KNOT_RAD * float(camera.matrix[0])
    x, across = _spline(patch.left, patch.right, knot_px, samples)
    y, down = _spline(patch.top, patch.bottom, knot_px, samples)
    px = np.stack(np.meshgrid(x, y), axis=-1)
    return Raster(px, rays(camera, px), down, across)


def between(raster: Raster, values: FloatArray) -> Float32Array:
    """Interpolates values (a, b) at the knots to (rows, columns) values at the sub-pixels."""
    return between_rows(raster, columns_of(raster, values), slice(0, len(raster.down.first)))


def columns_of(raster: Raster, values: FloatArray) -> Columns:
    """Interpolates values (a, b) at the knots along the rows of knots."""
    mean = values.mean()
    across = raster.across
    coefficients = raster.down.coefficients @ (values - mean) @ across.coefficients.T
    taps = [coefficients.astype(np.float32)[:, across.first + index] for index in range(_TAPS)]
    return Columns(np.float32(mean), np.einsum("tac,ct->ac", taps, across.weights))


def between_rows(raster: Raster, columns: Columns, rows: slice) -> Float32Array:
    """Interpolates along columns: (rows, columns) values at some sub-pixel rows."""
    first, weights = raster.down.first[rows], raster.down.weights[rows]
    values = np.empty((len(first), columns.coefficients.shape[1]), np.float32)
    starts = np.flatnonzero(np.diff(first, prepend=-1)).tolist()
    for start, end in zip(starts, [*starts[1:], len(first)], strict=True):
        four = columns.coefficients[first[start] : first[start] + _TAPS]
        np.matmul(weights[start:end], four, out=values[start:end])
    values += columns.mean
    return values


def _spline(first: int, end: int, knot_px: float, samples: int) -> tuple[FloatArray, _Spline]:
    """Knots over pixels first ... end - 1, and the splines on them."""
    count = max(int((end - first) / knot_px), 3) + 1
    knots = np.linspace(first - 0.5, end - 0.5, count)
    # Pixel centres are at integers.
    sub_pixels = first - 0.5 + (np.arange((end - first) * samples) + 0.5) / samples
    interpolant = make_interp_spline(knots, np.eye(count))
    weights = interpolant.design_matrix(sub_pixels, interpolant.t, interpolant.k)
    return knots, _Spline(
        interpolant.c,
        weights.indices[::_TAPS].astype(np.int64),
        weights.data.reshape(-1, _TAPS).astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A plane behind the board with a periodic texture, under a lamp."""

    texture: Image  # Image of the plane.
    texel_m: float  # Side of a texel [m].
    depth_m: float  # Distance of the plane below the board (a table), or from the camera (a wall).
    lamp_m: float  # Radius of the lamp's spot [m].
    moves: bool  # Whether it moves with the board, as a table does, and not with the camera.


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Data shared by all images of one board by one camera."""

    camera: CameraOptions  # The camera.
    board: Sheet  # Printed board.
    sheet: SheetTexture  # Texture of the board.
    backdrop: Backdrop  # Background.
    sights: Sequence[SimulatedSight]  # Observations of the camera.
    arm: DhArm | None  # Arm that holds the board before a fixed camera; None if not visible.
    joints: FloatArray  # (s, n) postures of the arm at the stops [rad].
    cam_from_base: FloatArray  # (4, 4) pose of the arm's base.
    noise: Callable[[int], np.random.Generator]  # Random generator by view.


def prepare_scene(cell: SimulatedCell, camera: str = "", board: str | None = None) -> RenderScene:
    """Draws the textures of a cell, which takes longer than one of its images.

    Args:
        cell: The cell.
        camera: Name of the camera, if it has one.
        board: Name of the board to show; no other is shown. None for the first.

    Raises:
        DataError: OpenCV does not have the target's dictionary.
    """
    options, optics = cell.options, cell.camera(camera)
    sights = [sight for sight in cell.sights if sight.camera == camera]
    sheet = cell.layout.boards[0] if board is None else cell.board(board)
    index = [camera_at.name for camera_at in cell.layout.cameras].index(camera)
    # The first camera has the same random stream as a single one.
    rng = options.stream(RandomStream.BACKDROP, *((index,) if index else ()))
    seer, holder = frame_name("camera", camera), cell.robot_of(frame_name("target", sheet.name))
    arm, joints, cam_from_base = None, np.zeros((0, 0)), np.eye(4)
    if holder is not None and cell.robot_of(seer) is None:
        arm, joints = cell.robots[holder].arm, cell.robots[holder].joints
        cam_from_base = cell.between(seer, frame_name("base", holder))
    # The texture is as fine as the board's closest image needs.
    target = sheet.target
    nearest = min(float(np.linalg.norm(sight.cam_from_target[:3, 3])) for sight in sights)
    samples = _SAMPLES * float(optics.camera.matrix[0]) * unit_m(target) / max(nearest, 0.05)
    texels = 2 ** int(np.clip(np.round(np.log2(samples)), 4, 10))
    # Limits a texture to about 30 million texels.
    while target.columns * target.rows * texels**2 > 3e7:
        texels //= 2
    return RenderScene(
        camera=optics,
        board=sheet,
        sheet=draw_sheet(target, texels),
        backdrop=Backdrop(draw_table(rng, 1024), 0.0008, 0.006, 0.45, moves=True)
        if arm is None
        else Backdrop(draw_wall(rng, 1024), 0.004, 2.6, 2.0, moves=False),
        sights=sights,
        arm=arm,
        joints=joints,
        cam_from_base=cam_from_base,
        noise=partial(options.stream, RandomStream.IMAGES),
    )


def render(scene: RenderScene, index: int) -> Image:
    """Renders the image of one view.

    Returns:
        (height, width) grey image with the camera's blur, vignetting and noise.

    Raises:
        DataError: There is no such view.
    """
    count = len(scene.sights)
    if not 0 <= index < count:
        raise DataError(f"simulation: there is no view {index} among {count}.")
    sight = scene.sights[index]
    shows_arm = scene.arm is not None and sight.stop >= 0
    joints = scene.joints[sight.stop] if shows_arm else None
    light = light_on(scene, sight.cam_from_target, joints)
    return developed(light, scene.camera, scene.noise(sight.view))


def light_on(
    scene: RenderScene,
    cam_from_target: FloatArray,
    joints: FloatArray | None,
    *,
    samples: int = _SAMPLES,
    shows_board: bool = True,
) -> Float32Array:
    """Light on the sensor.

    Args:
        scene: Prepared scene.
        cam_from_target: (4, 4) pose of the board.
        joints: (n,) posture of a visible arm [rad]; None for no arm.
        samples: Sub-pixels along a pixel's side.
        shows_board: Whether the board's face is visible, at least in part.

    Returns:
        (height, width) light with defocus and vignetting, without noise [grey levels].
    """
    # On a busy machine, several BLAS threads mostly wait for each other.
    with one_blas_thread():
        light, whole, shade = _background(scene, cam_from_target, joints)
        if shows_board:
            _draw_board(light, scene, cam_from_target, samples)
        light *= between(whole, shade)
    blur_px = scene.camera.blur_px
    if blur_px > 0.0:
        light = np.asarray(
            cv2.GaussianBlur(light, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE), np.float32
        )
    light += np.float32(_BLACK_LEVEL)
    return light


def developed(light: Float32Array, camera: CameraOptions, noise: np.random.Generator) -> Image:
    """Image from light (height, width): adds the camera's noise and rounds to grey levels."""
    if camera.image_noise > 0.0:
        grain = noise.standard_normal(light.shape, dtype=np.float32)
        light = light + np.float32(camera.image_noise) * grain
    return np.asarray(np.clip(np.rint(light), 0.0, 255.0), np.uint8)


def encode(image: Image, jpeg_quality: int | None) -> bytes:
    """Encodes an image as JPEG, or as PNG without a quality.

    Raises:
        DataError: OpenCV cannot encode it.
    """
    if jpeg_quality is None:
        done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    else:
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    if not done:
        raise DataError(f"simulation: an image of shape {image.shape} cannot be encoded.")
    return data.tobytes()


def _background(
    scene: RenderScene, cam_from_target: FloatArray, joints: FloatArray | None
) -> tuple[Float32Array, Raster, FloatArray]:
    """Background: its light, knots over the image, and brightness at the knots."""
    camera = scene.camera.camera
    raster = trace(camera, Patch(0, 0, *camera.resolution), 1)
    # The backdrop's plane is z = 0.
    plane_from_cam = compose(np.eye(3), np.array([0.4, 0.3, -scene.backdrop.depth_m]))
    if scene.backdrop.moves:
        lower = compose(np.eye(3), np.array([0.0, 0.0, -scene.backdrop.depth_m]))
        plane_from_cam = lower @ invert(cam_from_target)
    hits = _plane_hits(plane_from_cam, raster.directions, 0.0)
    background = np.asarray(
        cv2.remap(
            scene.backdrop.texture,
            between(raster, hits[..., 0] / scene.backdrop.texel_m),
            between(raster, hits[..., 1] / scene.backdrop.texel_m),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        ),
        np.uint8,
    )
    if scene.arm is not None and joints is not None:
        _draw_arm(background, camera, scene.arm, joints, scene.cam_from_base)
    offset = (hits - scene.backdrop.lamp_m * np.array([-0.3, -0.2])) / scene.backdrop.lamp_m
    distance2 = (offset**2).sum(axis=-1)
    light = background.astype(np.float32)
    if scene.backdrop.moves:
        # Towards the horizon, the table fades into an even floor.
        light -= np.float32(_FLOOR)
        light *= between(raster, np.exp(-((distance2 / 8.0) ** 2)))
        light += np.float32(_FLOOR)
    centre = 0.5 * np.array(camera.resolution) - 0.5
    edge = ((raster.px - centre) ** 2).sum(axis=-1) / (centre**2).sum()
    lamp = 0.78 + 0.30 / (1.0 + distance2)
    return light, raster, lamp * (1.0 - scene.camera.vignetting * edge)


def _draw_board(
    light: Float32Array, scene: RenderScene, cam_from_target: FloatArray, samples: int
) -> None:
    """Draws the sheet over the background, in place."""
    sheet, camera = scene.sheet, scene.camera.camera
    patch = _board_patch(camera, scene.board, cam_from_target)
    if min(patch.size) < 1:
        return
    brightness = 1.0
    if not scene.backdrop.moves:
        # Light on a held board from behind the camera, above and slightly left; the board's z
        # points away from it.
        light_cam = np.array([0.3, 0.6, 0.74])
        brightness = 0.7 + 0.3 * max(float(cam_from_target[:3, 2] @ light_cam), 0.0)
    raster, board, target_from_cam = (
        trace(camera, patch, samples),
        scene.board,
        invert(cam_from_target),
    )
    flat = _plane_hits(target_from_cam, raster.directions, 0.0)
    for _ in range(6 if board.bow_m != 0.0 else 0):
        # The bow is shallow: this converges by the ratio of the sheet's slope to the ray's.
        depth = np.clip(bow_depth_m(board, flat), -0.05, 0.05)
        flat = _plane_hits(target_from_cam, raster.directions, depth)
    flat = flat / board.scale
    # Typical spacing of neighbouring pixels on the sheet, as the root of an area [m].
    right, down = np.diff(flat, axis=1)[:-1], np.diff(flat, axis=0)[:, :-1]
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    knot_px2 = float(np.prod(raster.px[1, 1] - raster.px[0, 0]))
    # Texture level that fits the sub-pixels best, over the whole board.
    spacing = float(np.sqrt(np.median(area) / knot_px2)) / samples
    level = int(np.argmin(np.abs(np.log(np.array(sheet.texel_m) / spacing))))
    # Texel centres are half a texel from the texture's outer corner.
    texels = (flat - sheet.origin_m) / sheet.texel_m[level] - 0.5
    at_x, at_y = (columns_of(raster, texels[..., index]) for index in range(2))
    width, height = patch.size
    for top in range(0, height, _BAND_PX):
        rows = min(_BAND_PX, height - top)
        band = slice(top * samples, (top + rows) * samples)
        seen = cv2.remap(
            sheet.levels[level],
            between_rows(raster, at_x, band),
            between_rows(raster, at_y, band),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0, 0),
        ).astype(np.float32)
        # Each pixel is the mean of exactly `samples` squared sub-pixels.
        pixels = cv2.resize(seen, (width, rows), interpolation=cv2.INTER_AREA)
        window = light[patch.top + top : patch.top + top + rows, patch.left : patch.right]
        window *= 1.0 - pixels[..., 1] / np.float32(255.0)
        window += np.float32(brightness) * pixels[..., 0]


def _board_patch(camera: Camera, board: Sheet, cam_from_target: FloatArray) -> Patch:
    """Bounds of the sheet and its shadow in the image."""
    points = outline_m(board, margin_m(board.target))
    points_cam = points @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    width, height = camera.resolution
    # Points that the lens model folds back, or beside or behind the camera, do not bound the sheet.
    ahead = points_cam[:, 2] > _LEAST_COSINE * np.linalg.norm(points_cam, axis=1)
    if not ahead.all() or not sees(camera, points_cam, -np.inf).all():
        return Patch(0, 0, width, height)
    px = project(camera, points_cam)
    left, top = np.maximum(np.floor(px.min(axis=0)).astype(int) - 2, 0)
    right, bottom = np.minimum(np.ceil(px.max(axis=0)).astype(int) + 3, [width, height])
    return Patch(int(left), int(top), int(right), int(bottom))


def _plane_hits(
    plane_from_cam: FloatArray, directions: FloatArray, depth_m: FloatArray | float
) -> FloatArray:
    """(..., 2) points where camera rays reach z = `depth_m` of a frame [m]."""
    direction = directions @ plane_from_cam[:3, :3].T
    start = plane_from_cam[:3, 3]
    # Rays near or above the horizon are bent down; they are far from the board.
    descent = np.maximum(direction[..., 2], 0.06)
    return np.asarray(start[:2] + direction[..., :2] * ((depth_m - start[2]) / descent)[..., None])


def _draw_arm(
    image: Image, camera: Camera, arm: DhArm, joints: FloatArray, cam_from_base: FloatArray
) -> None:
    """Draws an arm of Universal Robots' shape, scaled by its reach, far parts first."""
    frames, size = link_frames(arm, joints[None])[0], reach_m(arm)
    origin, axis = frames[:, :3, 3], frames[:, :3, 2]
    wide, slim = 0.062 * size, 0.045 * size
    # Upper arm and forearm are offset from the plane of their joints' origins.
    upper, fore = 0.14 * size * axis[1], 0.03 * size * axis[1]
    light, dark = 178.0, 96.0
    # Housings and links: ends in the base [m], radius [m] and grey level.
    tubes = (
        (origin[0], origin[1], wide * 1.15, light),
        (origin[1] - 0.05 * size * axis[1], origin[1] + upper, wide, dark),
        (origin[1] + upper, origin[2] + upper, wide * 0.8, light),
        (origin[2] + upper, origin[2] + fore, wide * 0.95, dark),
        (origin[2] + fore, origin[3] + fore, slim, light),
        (origin[3] + fore, origin[4], slim, dark),
        (origin[4], origin[5], slim, light),
        (origin[5], origin[6], slim * 0.9, dark),
        (origin[6], origin[6] + 0.05 * axis[6], slim * 0.6, 130.0),
    )
    visible = []
    for start, end, radius_m, grey in tubes:
        ends = np.stack([start, end]) @ cam_from_base[:3, :3].T + cam_from_base[:3, 3]
        if ends[:, 2].min() > _NEAREST_M:
            visible.append((float(ends[:, 2].mean()), ends, radius_m, grey))
    for _, ends, radius_m, grey in sorted(visible, key=lambda each: -each[0]):
        radii = camera.matrix[0] * radius_m / ends[:, 2]
        _draw_tube(image, project(camera, ends), radii, grey)


def _draw_tube(image: Image, px: FloatArray, radii: FloatArray, grey: float) -> None:
    """Draws a tapered, round-ended stripe, brightest slightly off its axis."""
    direction = px[1] - px[0]
    length = float(np.linalg.norm(direction))
    normal = np.array([-direction[1], direction[0]]) / max(length, 1e-3)
    # Light comes from above.
    if normal[1] > 0.0:
        normal = -normal
    for shade in range(_SHADES):
        share = 1.0 - shade / _SHADES
        centre_line = px + 0.35 * (1.0 - share) * radii[:, None] * normal
        tone = float(min(grey * (0.45 + 0.65 * np.sqrt(1.0 - share**2)), 235.0))
        side = (share * radii)[:, None] * normal
        outline = np.concatenate([centre_line + side, (centre_line - side)[::-1]])
        # Fixed-point coordinates with four fractional bits keep edges smooth.
        cv2.fillPoly(image, [np.rint(outline * 16).astype(np.int32)], tone, cv2.LINE_AA, 4)
        for centre, radius in zip(centre_line, share * radii, strict=True):
            x, y = np.rint(centre * 16).astype(int)
            cv2.circle(image, (int(x), int(y)), round(radius * 16), tone, -1, cv2.LINE_AA, 4)


class LiveView:
    """Takes images of a cell's board for any posture of its arm.

    Args:
        cell: Cell of one robot, one camera and one board. Its real arm, mountings, optics and noise
            are used, not its views.

    Raises:
        DataError: The cell has two boards, or OpenCV does not have the target's dictionary.
    """

    def __init__(self, cell: SimulatedCell) -> None:
        boards = cell.layout.boards
        if len(boards) != 1:
            raise DataError(
                f"simulation: the cell has {len(boards)} boards; live pictures show one."
            )
        self._cell = cell
        self._before = cell.seen_from("", "", "")
        self._scene = prepare_scene(cell)
        self._count = 0
        # Light of the last stationary posture; only the noise differs between its images.
        self._rest: tuple[FloatArray, Float32Array] | None = None

    def picture(self, joints: FloatArray) -> Image:
        """A (height, width) grey image with motion blur and independent noise.

        The true joint angles (k, n) [rad] are at equal intervals during the exposure; one row
        stands for a stationary arm.
        """
        poses = self.cam_from_target(joints)
        smear_px = float(self._moved_px(poses[:-1], poses[1:]).sum())
        if smear_px < _STILL_PX:
            pose = poses[len(poses) // 2]
            if self._rest is None or self._moved_px(self._rest[0][None], pose[None]) > _STILL_PX:
                self._rest = (pose, self._light(pose, joints[len(joints) // 2]))
            light = self._rest[1]
        else:
            light = self._smeared(joints, smear_px)
        self._count += 1
        noise = self._cell.options.stream(RandomStream.IMAGES, 1, self._count)
        return developed(light, self._cell.camera(), noise)

    def cam_from_target(self, joints: FloatArray) -> FloatArray:
        """True board poses: (k, n) joints [rad] to (k, 4, 4)."""
        return self._before(forward(self._cell.robot.true_arm, joints))

    def _light(self, pose: FloatArray, posture: FloatArray, **more: int) -> Float32Array:
        shows_board = _faces(self._cell, pose)
        return light_on(self._scene, pose, posture, shows_board=shows_board, **more)

    def _smeared(self, joints: FloatArray, smear_px: float) -> Float32Array:
        """Mean light over equal parts of the exposure."""
        parts = int(np.clip(np.ceil(smear_px), 3, _MOST_PARTS))
        positions = (np.arange(parts) + 0.5) / parts * (len(joints) - 1)
        steps = np.arange(len(joints))
        postures = np.stack([np.interp(positions, steps, column) for column in joints.T], axis=1)
        poses = self.cam_from_target(postures)
        if smear_px < _SHORT_PX:
            lights = (self._light(*pair) for pair in zip(poses, postures, strict=True))
        else:
            middle = self.cam_from_target(joints[len(joints) // 2, None])[0]
            sharp = self._light(middle, joints[len(joints) // 2], samples=1)
            lights = (self._shifted(sharp, pose @ invert(middle), middle) for pose in poses)
        total = next(lights).copy()
        for light in lights:
            total += light
        return np.asarray(total / np.float32(parts))

    def _shifted(
        self, light: Float32Array, now_from_middle: FloatArray, middle: FloatArray
    ) -> Float32Array:
        """Transforms an image as if all its content were at the board's distance."""
        # Motion blur is then correct at the board's centre, and symmetric about each corner's true
        # position everywhere.
        camera = self._cell.camera().camera
        raster = trace(camera, Patch(0, 0, *camera.resolution), 1)
        depth = float((middle[:3, :3] @ centre_m(self._cell.board()) + middle[:3, 3])[2])
        plane = compose(np.eye(3), np.array([0.0, 0.0, depth if depth > 0.0 else _FAR_M]))
        plane_from_now = invert(now_from_middle @ plane)
        directions = raster.directions @ plane_from_now[:3, :3].T
        start = plane_from_now[:3, 3]
        hits = start - directions * (start[2] / directions[..., 2])[..., None]
        px = project(camera, hits @ plane[:3, :3].T + plane[:3, 3])
        map_x, map_y = between(raster, px[..., 0]), between(raster, px[..., 1])
        shifted = cv2.remap(light, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shifted, np.float32)

    def _moved_px(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """(k,) bounds of the image motion between board poses (k, 4, 4) [px]."""
        centre = centre_m(self._cell.board())
        before = first[:, :3, :3] @ centre + first[:, :3, 3]
        after = second[:, :3, :3] @ centre + second[:, :3, 3]
        distance = np.maximum(np.linalg.norm(before, axis=1), 0.1)
        shift = np.linalg.norm(after - before, axis=1) / distance
        rotation = rotation_angle(second @ invert(first))
        return np.asarray(self._cell.camera().camera.matrix[0] * (shift + rotation))


def _faces(cell: SimulatedCell, cam_from_target: FloatArray) -> bool:
    """Whether the board's printed side may be in the image, at least in part."""
    board = cell.board()
    points = np.concatenate([corners_m(board), outline_m(board, margin_m(board.target))])
    points_cam = points @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    cosines = points_cam[:, 2] / np.linalg.norm(points_cam, axis=1)
    camera = cell.camera().camera
    ends = (
        np.array(np.meshgrid(*((0.0, index - 1.0) for index in camera.resolution))).reshape(2, 4).T
    )
    # The target's z points into the board.
    in_front = invert(cam_from_target)[2, 3] < 0.0
    return bool(in_front and cosines.max() > rays(camera, ends)[:, 2].min())

"""Rendering of a simulated board: one ray per sub-pixel, through the lens onto the sheet.

Rays are traced at the knots of a grid: over a hundredth of a radian perspective and distortion are
so smooth that a cubic spline through them is accurate to far below a thousandth of a pixel, at a
fraction of the cost. `LiveView` takes images for any posture of the arm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import cv2
import numpy as np
from scipy.interpolate import make_interp_spline

from visioncal.core.errors import DataError
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import apply, compose, invert, rotation_angle
from visioncal.core.types import Camera, FloatArray, Image, Image16
from visioncal.session import frame_name
from visioncal.simulation.arms import forward
from visioncal.simulation.boards import Sheet, bow_depth_m, centre_m, corners_m, outline_m, unit_m
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.layout import CameraOptions, RandomStream
from visioncal.simulation.optics import project, rays, sees
from visioncal.simulation.textures import (
    Float32Array,
    SheetTexture,
    draw_backdrop,
    draw_sheet,
    margin_m,
)

# Sub-pixels along a pixel's side.
_SAMPLES = 3
# Rows of pixels that are processed at a time, to stay in the processor's cache.
_BAND_PX = 48


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
class Raster:
    """Rays at the knots of a grid over a patch, and their interpolation to sub-pixels."""

    px: FloatArray  # (a, b, 2) knots [px].
    directions: FloatArray  # (a, b, 3) unit vectors in the camera frame.
    down: Float32Array  # (rows, a) cubic spline through the knots, at the rows of sub-pixels.
    across: Float32Array  # (columns, b) the same at their columns.

    def between(self, values: FloatArray) -> Float32Array:
        """Interpolates values (a, b) at the knots to (rows, columns) values at the sub-pixels."""
        # Without their mean they keep more digits in single precision.
        mean = values.mean()
        varying = (values - mean).astype(np.float32)
        return np.asarray(self.down @ (varying @ self.across.T) + np.float32(mean))


def trace(camera: Camera, patch: Patch, samples: int = _SAMPLES) -> Raster:
    """Traces rays over a patch, with `samples` sub-pixels along a pixel's side."""
    # Knots are 10 mrad apart.
    knot_px = 0.01 * float(camera.matrix[0])
    x, across = _spline(patch.left, patch.right, knot_px, samples)
    y, down = _spline(patch.top, patch.bottom, knot_px, samples)
    px = np.stack(np.meshgrid(x, y), axis=-1)
    return Raster(px, rays(camera, px), down, across)


def _spline(first: int, end: int, knot_px: float, samples: int) -> tuple[FloatArray, Float32Array]:
    """(k,) knots over pixels first ... end - 1, and (n, k) weights of them at sub-pixels."""
    count = max(int((end - first) / knot_px), 3) + 1
    knots = np.linspace(first - 0.5, end - 0.5, count)
    # Pixel centres are at integers.
    sub_pixels = first - 0.5 + (np.arange((end - first) * samples) + 0.5) / samples
    weights = make_interp_spline(knots, np.eye(count))(sub_pixels)
    return knots, np.asarray(weights, np.float32)


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
    is_held = cell.robot_of(frame_name("target", sheet.name)) is not None
    moves = not (is_held and cell.robot_of(frame_name("camera", camera)) is None)
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
        backdrop=Backdrop(draw_backdrop(rng, 1024, 0.8), 0.0008, 0.006, 0.45, moves=True)
        if moves
        else Backdrop(draw_backdrop(rng, 1024, 8.0), 0.004, 2.6, 2.0, moves=False),
        sights=sights,
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
    light = light_on(scene, sight.cam_from_target)
    return developed(light, scene.camera, scene.noise(sight.view))


def light_on(
    scene: RenderScene, cam_from_target: FloatArray, *, shows_board: bool = True
) -> Float32Array:
    """Light on the sensor.

    Args:
        scene: Prepared scene.
        cam_from_target: (4, 4) pose of the board.
        shows_board: Whether the board's face is visible, at least in part.

    Returns:
        (height, width) light with defocus and vignetting, without noise [grey levels].
    """
    # On a busy machine, several BLAS threads mostly wait for each other.
    with one_blas_thread():
        light, whole, shade = _background(scene, cam_from_target)
        if shows_board:
            _draw_board(light, scene, cam_from_target)
        light *= whole.between(shade)
    blur_px = scene.camera.blur_px
    if blur_px > 0.0:
        light = np.asarray(
            cv2.GaussianBlur(light, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE), np.float32
        )
    # Black level.
    light += np.float32(4.0)
    return light


def developed(light: Float32Array, camera: CameraOptions, noise: np.random.Generator) -> Image:
    """Image from light (height, width): adds the camera's noise and rounds to grey levels."""
    if camera.image_noise > 0.0:
        grain = noise.standard_normal(light.shape, dtype=np.float32)
        light = light + np.float32(camera.image_noise) * grain
    return np.asarray(np.clip(np.rint(light), 0.0, 255.0), np.uint8)


def encode(image: Image | Image16, jpeg_quality: int | None) -> bytes:
    """Encodes an image as JPEG, or as PNG without a quality; raises DataError."""
    if jpeg_quality is None:
        done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    else:
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    if not done:
        raise DataError(f"simulation: an image of shape {image.shape} cannot be encoded.")
    return data.tobytes()


def _background(
    scene: RenderScene, cam_from_target: FloatArray
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
    x, y = (raster.between(hits[..., axis] / scene.backdrop.texel_m) for axis in range(2))
    background = cv2.remap(
        scene.backdrop.texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    offset = (hits - scene.backdrop.lamp_m * np.array([-0.3, -0.2])) / scene.backdrop.lamp_m
    distance2 = (offset**2).sum(axis=-1)
    light = background.astype(np.float32)
    if scene.backdrop.moves:
        # Towards the horizon, the table fades into an even floor.
        light -= np.float32(118.0)
        light *= raster.between(np.exp(-((distance2 / 8.0) ** 2)))
        light += np.float32(118.0)
    centre = 0.5 * np.array(camera.resolution) - 0.5
    edge = ((raster.px - centre) ** 2).sum(axis=-1) / (centre**2).sum()
    lamp = 0.78 + 0.30 / (1.0 + distance2)
    return light, raster, lamp * (1.0 - scene.camera.vignetting * edge)


def _draw_board(light: Float32Array, scene: RenderScene, cam_from_target: FloatArray) -> None:
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
    raster, board, target_from_cam = trace(camera, patch), scene.board, invert(cam_from_target)
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
    spacing = float(np.sqrt(np.median(area) / knot_px2)) / _SAMPLES
    level = int(np.argmin(np.abs(np.log(np.array(sheet.texel_m) / spacing))))
    # Texel centres are half a texel from the texture's outer corner.
    texels = (flat - sheet.origin_m) / sheet.texel_m[level] - 0.5
    middle = texels.mean(axis=(0, 1))
    columns = [
        (texels[..., axis] - middle[axis]).astype(np.float32) @ raster.across.T for axis in range(2)
    ]
    width, height = patch.size
    for top in range(0, height, _BAND_PX):
        rows = min(_BAND_PX, height - top)
        band = slice(top * _SAMPLES, (top + rows) * _SAMPLES)
        seen = cv2.remap(
            sheet.levels[level],
            raster.down[band] @ columns[0] + np.float32(middle[0]),
            raster.down[band] @ columns[1] + np.float32(middle[1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0, 0),
        ).astype(np.float32)
        # Each pixel is the mean of exactly `_SAMPLES` squared sub-pixels.
        pixels = cv2.resize(seen, (width, rows), interpolation=cv2.INTER_AREA)
        window = light[patch.top + top : patch.top + top + rows, patch.left : patch.right]
        window *= 1.0 - pixels[..., 1] / np.float32(255.0)
        window += np.float32(brightness) * pixels[..., 0]


def _board_patch(camera: Camera, board: Sheet, cam_from_target: FloatArray) -> Patch:
    """Bounds of the sheet and its shadow in the image."""
    points_cam = apply(cam_from_target, outline_m(board, margin_m(board.target)))
    width, height = camera.resolution
    # Points that the lens model folds back, or beside or behind the camera (over 84 degrees off),
    # do not bound the sheet.
    ahead = points_cam[:, 2] > 0.1 * np.linalg.norm(points_cam, axis=1)
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
        """A (height, width) grey image with independent noise, at the middle of the exposure.

        The true joint angles (k, n) [rad] are at equal intervals during the exposure; one row
        stands for a stationary arm.
        """
        pose = self.cam_from_target(joints[len(joints) // 2, None])[0]
        # Below, a shift is under the accuracy of corner detection [px].
        if self._rest is None or self._moved_px(self._rest[0], pose) > 0.003:
            shows_board = _faces(self._cell, pose)
            self._rest = (pose, light_on(self._scene, pose, shows_board=shows_board))
        self._count += 1
        noise = self._cell.options.stream(RandomStream.IMAGES, 1, self._count)
        return developed(self._rest[1], self._cell.camera(), noise)

    def cam_from_target(self, joints: FloatArray) -> FloatArray:
        """True board poses: (k, n) joints [rad] to (k, 4, 4)."""
        return self._before(forward(self._cell.robot.true_arm, joints))

    def _moved_px(self, first: FloatArray, second: FloatArray) -> float:
        """Bound of the image motion between board poses (4, 4) [px]."""
        centre = np.append(centre_m(self._cell.board()), 1.0)
        before, after = (first @ centre)[:3], (second @ centre)[:3]
        distance = max(float(np.linalg.norm(before)), 0.1)
        shift = float(np.linalg.norm(after - before)) / distance
        turn = float(rotation_angle(second @ invert(first)))
        return float(self._cell.camera().camera.matrix[0]) * (shift + turn)


def _faces(cell: SimulatedCell, cam_from_target: FloatArray) -> bool:
    """Whether the board's printed side may be in the image, at least in part."""
    board = cell.board()
    points = np.concatenate([corners_m(board), outline_m(board, margin_m(board.target))])
    points_cam = apply(cam_from_target, points)
    cosines = points_cam[:, 2] / np.linalg.norm(points_cam, axis=1)
    camera = cell.camera().camera
    ends = np.array([*product(*((0.0, size - 1.0) for size in camera.resolution))])
    # The target's z points into the board.
    in_front = invert(cam_from_target)[2, 3] < 0.0
    return bool(in_front and cosines.max() > rays(camera, ends)[:, 2].min())

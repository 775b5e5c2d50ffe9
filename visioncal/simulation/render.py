"""Pictures of a simulated board: a ray for each sub-pixel, through the lens, onto the sheet.

The arm that holds a board in front of a fixed camera is drawn as shaded tubes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import compose, invert
from visioncal.core.types import Camera, FloatArray, Image
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, link_frames, reach_m
from visioncal.simulation.boards import Sheet, bow_depth_m, outline_m, unit_m
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.draws import RandomStream
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CameraOptions
from visioncal.simulation.rasters import (
    Float32Array,
    Patch,
    Raster,
    between,
    between_rows,
    columns_of,
    trace,
)
from visioncal.simulation.textures import SheetTexture, draw_sheet, draw_table, draw_wall, margin_m

# Sub-pixels along a pixel's side.
_SAMPLES = 3
# Rows of pixels that are worked on at a time, so that they stay in the processor's cache.
_BAND_PX = 48
_BLACK_LEVEL, _FLOOR = 4.0, 118.0
# No lens here looks so far aside: 84 degrees.
_LEAST_COSINE = 0.1
# Parts nearer than this to the camera's plane are not drawn [m].
_NEAREST_M = 0.15
_SHADES = 18


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A plane behind the board, with a texture that repeats, under a lamp.

    Attributes:
        texture: Its picture.
        texel_m: Side of a texel [m].
        depth_m: How far the plane lies below the board (a table), or before the camera (a wall).
        lamp_m: Radius of the brighter spot [m].
        moves: Whether it moves with the board, as a table does, and not with the camera.
    """

    texture: Image
    texel_m: float
    depth_m: float
    lamp_m: float
    moves: bool


@dataclass(frozen=True, eq=False)
class RenderScene:
    """What all pictures of one board by one camera share.

    Attributes:
        camera: The camera.
        board: The board as it was printed.
        sheet: Its texture.
        backdrop: What is behind the board.
        sights: All that the camera saw.
        arm: The arm with the board, which a camera beside it sees; None where it sees none.
        joints: (s, n) its postures, stop by stop [rad].
        cam_from_base: (4, 4) where it stands.
        noise: The source of a view's noise.
    """

    camera: CameraOptions
    board: Sheet
    sheet: SheetTexture
    backdrop: Backdrop
    sights: Sequence[SimulatedSight]
    arm: DhArm | None
    joints: FloatArray
    cam_from_base: FloatArray
    noise: Callable[[int], np.random.Generator]


def prepare_scene(cell: SimulatedCell, camera: str = "", board: str | None = None) -> RenderScene:
    """Draws the textures of a cell, which takes longer than one of its pictures.

    Args:
        cell: The cell.
        camera: The camera, where it has a name.
        board: Which board the pictures are to show; they show no other. None takes the first.

    Raises:
        DataError: OpenCV does not have the target's dictionary.
    """
    options, optics = cell.options, cell.camera(camera)
    sights = [sight for sight in cell.sights if sight.camera == camera]
    sheet = cell.layout.boards[0] if board is None else cell.board(board)
    place = [camera_at.name for camera_at in cell.layout.cameras].index(camera)
    # The first draws as the only one does.
    rng = options.stream(RandomStream.BACKDROP, *((place,) if place else ()))
    seer, holder = frame_name("camera", camera), cell.robot_of(frame_name("target", sheet.name))
    arm, joints, cam_from_base = None, np.zeros((0, 0)), np.eye(4)
    if holder is not None and cell.robot_of(seer) is None:
        arm, joints = cell.robots[holder].arm, cell.robots[holder].joints
        cam_from_base = cell.between(seer, frame_name("base", holder))
    return RenderScene(
        camera=optics,
        board=sheet,
        sheet=_textured(
            optics.camera, sheet, np.array([sight.cam_from_target for sight in sights])
        ),
        backdrop=_table(rng) if arm is None else _wall(rng),
        sights=sights,
        arm=arm,
        joints=joints,
        cam_from_base=cam_from_base,
        noise=partial(options.stream, RandomStream.IMAGES),
    )


def _textured(camera: Camera, sheet: Sheet, cam_from_target: FloatArray) -> SheetTexture:
    """Draws a board as finely as the nearest of its pictures needs."""
    target = sheet.target
    nearest = float(np.linalg.norm(cam_from_target[:, :3, 3], axis=1).min())
    samples = _SAMPLES * float(camera.matrix[0]) * unit_m(target) / max(nearest, 0.05)
    texels = 2 ** int(np.clip(np.round(np.log2(samples)), 4, 10))
    # A board of many squares stays within some 30 million texels.
    while target.columns * target.rows * texels**2 > 3e7:
        texels //= 2
    return draw_sheet(target, texels)


def _table(rng: np.random.Generator) -> Backdrop:
    return Backdrop(draw_table(rng, 1024), 0.0008, 0.006, 0.45, True)


def _wall(rng: np.random.Generator) -> Backdrop:
    return Backdrop(draw_wall(rng, 1024), 0.004, 2.6, 2.0, False)


def render(scene: RenderScene, index: int) -> Image:
    """Takes the picture of one view.

    Returns:
        (height, width) grey image with the camera's blur, vignetting and noise.

    Raises:
        DataError: There is no such view.
    """
    count = len(scene.sights)
    if not 0 <= index < count:
        raise DataError(f"simulation: there is no view {index} among {count}.")
    sight = scene.sights[index]
    stands = scene.arm is not None and sight.stop >= 0
    joints = scene.joints[sight.stop] if stands else None
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
    """Computes what falls on the sensor.

    Args:
        scene: The prepared scene.
        cam_from_target: (4, 4) the board before the camera.
        joints: (n,) the arm's posture, which a camera beside the arm sees [rad]; None for an arm
            that is not in the picture.
        samples: Sub-pixels along a pixel's side.
        shows_board: Whether the board's face is before the camera, at least in part.

    Returns:
        (height, width) light, defocused and vignetted, without noise [grey levels].
    """
    # Several BLAS threads on a busy machine wait for one another ten times as long as they work.
    with one_blas_thread():
        light, whole, shade = _behind(scene, cam_from_target, joints)
        if shows_board:
            _cover(light, scene, cam_from_target, samples)
        light *= between(whole, shade)
    blur_px = scene.camera.blur_px
    if blur_px > 0.0:
        light = np.asarray(
            cv2.GaussianBlur(light, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE), np.float32
        )
    light += np.float32(_BLACK_LEVEL)
    return light


def developed(light: Float32Array, camera: CameraOptions, noise: np.random.Generator) -> Image:
    """Reads the sensor out: light (height, width) with the camera's noise, in whole grey levels."""
    if camera.image_noise > 0.0:
        grain = noise.standard_normal(light.shape, dtype=np.float32)
        light = light + np.float32(camera.image_noise) * grain
    return np.asarray(np.clip(np.rint(light), 0.0, 255.0), np.uint8)


def encode(image: Image, jpeg_quality: int | None) -> bytes:
    """Encodes a picture as JPEG, or as PNG where no quality is given.

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


def _behind(
    scene: RenderScene, cam_from_target: FloatArray, joints: FloatArray | None
) -> tuple[Float32Array, Raster, FloatArray]:
    """What is behind the board: its light, knots over the image, and how bright each lies."""
    camera = scene.camera.camera
    whole = trace(camera, Patch(0, 0, *camera.resolution), 1)
    plane_from_cam = _plane_from_cam(scene.backdrop, cam_from_target)
    places = _strike(plane_from_cam, whole.directions, 0.0)
    behind = np.asarray(
        cv2.remap(
            scene.backdrop.texture,
            between(whole, places[..., 0] / scene.backdrop.texel_m),
            between(whole, places[..., 1] / scene.backdrop.texel_m),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        ),
        np.uint8,
    )
    if scene.arm is not None and joints is not None:
        _draw_arm(behind, camera, scene.arm, joints, scene.cam_from_base)
    offset = (places - scene.backdrop.lamp_m * np.array([-0.3, -0.2])) / scene.backdrop.lamp_m
    distance2 = (offset**2).sum(axis=-1)
    light = behind.astype(np.float32)
    if scene.backdrop.moves:
        # Far away, towards the horizon, the table ends in an even floor.
        light -= np.float32(_FLOOR)
        light *= between(whole, np.exp(-((distance2 / 8.0) ** 2)))
        light += np.float32(_FLOOR)
    middle = 0.5 * np.array(camera.resolution) - 0.5
    edge = ((whole.px - middle) ** 2).sum(axis=-1) / (middle**2).sum()
    lamp = 0.78 + 0.30 / (1.0 + distance2)
    return light, whole, lamp * (1.0 - scene.camera.vignetting * edge)


def _plane_from_cam(backdrop: Backdrop, cam_from_target: FloatArray) -> FloatArray:
    """(4, 4) pose of the camera before the backdrop, whose plane is z = 0."""
    if not backdrop.moves:
        return compose(np.eye(3), np.array([0.4, 0.3, -backdrop.depth_m]))
    lower = compose(np.eye(3), np.array([0.0, 0.0, -backdrop.depth_m]))
    return lower @ invert(cam_from_target)


def _facing(scene: RenderScene, cam_from_target: FloatArray) -> float:
    """Brightness of the board: where a robot turns it, it catches more or less of the light."""
    if scene.backdrop.moves:
        return 1.0
    # From behind the camera, above and a little from the left; the board's z points away from it.
    light_cam = np.array([0.3, 0.6, 0.74])
    return 0.7 + 0.3 * max(float(cam_from_target[:3, 2] @ light_cam), 0.0)


def _cover(
    light: Float32Array, scene: RenderScene, cam_from_target: FloatArray, samples: int
) -> None:
    """Lays the sheet over what is behind it, in place."""
    sheet, camera = scene.sheet, scene.camera.camera
    patch = _board_patch(camera, scene.board, cam_from_target)
    if min(patch.size) < 1:
        return
    brightness = _facing(scene, cam_from_target)
    raster = trace(camera, patch, samples)
    flat = _strike_sheet(scene.board, raster.directions, cam_from_target)
    # The texel that fits the sub-pixels best, over the whole board.
    spacing = _spacing_m(flat, raster.px) / samples
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
        # Exactly `samples` squared sub-pixels lie around each pixel's centre.
        pixels = cv2.resize(seen, (width, rows), interpolation=cv2.INTER_AREA)
        window = light[patch.top + top : patch.top + top + rows, patch.left : patch.right]
        window *= 1.0 - pixels[..., 1] / np.float32(255.0)
        window += np.float32(brightness) * pixels[..., 0]


def _board_patch(camera: Camera, board: Sheet, cam_from_target: FloatArray) -> Patch:
    """Bounds of the sheet and its shadow in the image."""
    points = outline_m(board, margin_m(board.target))
    points_cam = points @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    width, height = camera.resolution
    # A point so far outside that the lens model folds it back says nothing about the bounds; one
    # beside or behind the camera has no place in the image at all.
    ahead = points_cam[:, 2] > _LEAST_COSINE * np.linalg.norm(points_cam, axis=1)
    if not ahead.all() or not sees(camera, points_cam, -np.inf).all():
        return Patch(0, 0, width, height)
    px = project(camera, points_cam)
    left, top = np.maximum(np.floor(px.min(axis=0)).astype(int) - 2, 0)
    right, bottom = np.minimum(np.ceil(px.max(axis=0)).astype(int) + 3, [width, height])
    return Patch(int(left), int(top), int(right), int(bottom))


def _strike_sheet(board: Sheet, directions: FloatArray, cam_from_target: FloatArray) -> FloatArray:
    """Where rays hit the bowed sheet, (..., 2) in the flat target frame as stated [m]."""
    target_from_cam = invert(cam_from_target)
    flat = _strike(target_from_cam, directions, 0.0)
    if board.bow_m != 0.0:
        for _ in range(6):
            # The bow is shallow: each turn gains the slope of the sheet over that of the ray.
            depth = np.clip(bow_depth_m(board, flat), -0.05, 0.05)
            flat = _strike(target_from_cam, directions, depth)
    return flat / board.scale


def _strike(
    plane_from_cam: FloatArray, directions: FloatArray, depth_m: FloatArray | float
) -> FloatArray:
    """(..., 2) points where rays of the camera reach z = `depth_m` of a frame [m]."""
    aim = directions @ plane_from_cam[:3, :3].T
    start = plane_from_cam[:3, 3]
    # Rays near the horizon and above it are bent down; what they show is far from the board.
    fall = np.maximum(aim[..., 2], 0.06)
    return np.asarray(start[:2] + aim[..., :2] * ((depth_m - start[2]) / fall)[..., None])


def _spacing_m(flat: FloatArray, px: FloatArray) -> float:
    """Typical distance on the sheet of neighbouring pixels, the root of an area [m]."""
    right = np.diff(flat, axis=1)[:-1]
    down = np.diff(flat, axis=0)[:, :-1]
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    knot_px2 = float(np.prod(px[1, 1] - px[0, 0]))
    return float(np.sqrt(np.median(area) / knot_px2))


@dataclass(frozen=True, eq=False)
class _Tube:
    """A round part between two points of the base frame, (3,) each [m]."""

    start: FloatArray
    end: FloatArray
    radius_m: float
    grey: float


def _draw_arm(
    image: Image, camera: Camera, arm: DhArm, joints: FloatArray, cam_from_base: FloatArray
) -> None:
    """Draws an arm into an image, its far parts first."""
    tubes = _tubes(arm, link_frames(arm, joints[None])[0])
    seen = []
    for tube in tubes:
        ends = np.stack([tube.start, tube.end]) @ cam_from_base[:3, :3].T + cam_from_base[:3, 3]
        if ends[:, 2].min() > _NEAREST_M:
            seen.append((float(ends[:, 2].mean()), ends, tube))
    for _, ends, tube in sorted(seen, key=lambda each: -each[0]):
        radii = camera.matrix[0] * tube.radius_m / ends[:, 2]
        _draw_tube(image, project(camera, ends), radii, tube.grey)


def _tubes(arm: DhArm, frames: FloatArray) -> list[_Tube]:
    """Housings and links of an arm of Universal Robots' shape, sized by its reach."""
    size = reach_m(arm)
    origin, axis = frames[:, :3, 3], frames[:, :3, 2]
    wide, slim = 0.062 * size, 0.045 * size
    # Upper arm and forearm lie beside the plane in which their joints' origins are.
    upper, fore = 0.14 * size * axis[1], 0.03 * size * axis[1]
    light, dark = 178.0, 96.0
    return [
        _Tube(origin[0], origin[1], wide * 1.15, light),
        _Tube(origin[1] - 0.05 * size * axis[1], origin[1] + upper, wide, dark),
        _Tube(origin[1] + upper, origin[2] + upper, wide * 0.8, light),
        _Tube(origin[2] + upper, origin[2] + fore, wide * 0.95, dark),
        _Tube(origin[2] + fore, origin[3] + fore, slim, light),
        _Tube(origin[3] + fore, origin[4], slim, dark),
        _Tube(origin[4], origin[5], slim, light),
        _Tube(origin[5], origin[6], slim * 0.9, dark),
        _Tube(origin[6], origin[6] + 0.05 * axis[6], slim * 0.6, 130.0),
    ]


def _draw_tube(image: Image, px: FloatArray, radii: FloatArray, grey: float) -> None:
    """Draws a tapered, round-ended stripe, brightest a little off its middle."""
    along = px[1] - px[0]
    length = float(np.linalg.norm(along))
    across = np.array([-along[1], along[0]]) / max(length, 1e-3)
    # Light comes from above.
    if across[1] > 0.0:
        across = -across
    for shade in range(_SHADES):
        share = 1.0 - shade / _SHADES
        middle = px + 0.35 * (1.0 - share) * radii[:, None] * across
        tone = grey * (0.45 + 0.65 * np.sqrt(1.0 - share**2))
        _fill(image, middle, share * radii, across, float(min(tone, 235.0)))


def _fill(
    image: Image, middle: FloatArray, radii: FloatArray, across: FloatArray, tone: float
) -> None:
    side = radii[:, None] * across
    outline = np.concatenate([middle + side, (middle - side)[::-1]])
    # Fixed-point coordinates with four fractional bits keep edges smooth.
    cv2.fillPoly(image, [np.rint(outline * 16).astype(np.int32)], tone, cv2.LINE_AA, 4)
    for centre, radius in zip(middle, radii, strict=True):
        x, y = np.rint(centre * 16).astype(int)
        cv2.circle(image, (int(x), int(y)), round(radius * 16), tone, -1, cv2.LINE_AA, 4)

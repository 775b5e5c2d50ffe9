"""The arm that holds a board in front of a fixed camera, as shaded tubes."""

from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.types import Camera, FloatArray, Image
from visioncal.simulation.arms import Arm, link_frames, reach_m
from visioncal.simulation.optics import project

# Parts nearer than this to the camera's plane are not drawn [m].
_NEAREST_M = 0.15
_SHADES = 18


@dataclass(frozen=True, eq=False)
class _Tube:
    """A round part between two points of the base frame, (3,) each [m]."""

    start: FloatArray
    end: FloatArray
    radius_m: float
    grey: float


def draw_arm(
    image: Image, camera: Camera, arm: Arm, joints: FloatArray, cam_from_base: FloatArray
) -> None:
    """Draws an arm into an image, its far parts first.

    Args:
        image: (height, width) image, changed in place.
        camera: The camera.
        arm: The arm.
        joints: (n,) its joint angles [rad].
        cam_from_base: (4, 4) where it stands before the camera.
    """
    tubes = _tubes(arm, link_frames(arm, joints[None])[0])
    seen = []
    for tube in tubes:
        ends = np.stack([tube.start, tube.end]) @ cam_from_base[:3, :3].T + cam_from_base[:3, 3]
        if ends[:, 2].min() > _NEAREST_M:
            seen.append((float(ends[:, 2].mean()), ends, tube))
    for _, ends, tube in sorted(seen, key=lambda each: -each[0]):
        radii = camera.matrix[0] * tube.radius_m / ends[:, 2]
        _draw_tube(image, project(camera, ends), radii, tube.grey)


def _tubes(arm: Arm, frames: FloatArray) -> list[_Tube]:
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

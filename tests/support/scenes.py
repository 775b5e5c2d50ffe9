"""Pictures of a standing scene: textured planes at several depths, parts that move, and light.

Rays go backwards through the lens from 2 x 2 places of each pixel; nothing is shared with
`visioncal.vision.scene`.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.types import Camera, FloatArray, Image

CAMERA = Camera(
    "brown", (480, 360), np.array([520.0, 522.0, 236.0, 184.0]), np.array([-0.08, 0.02, 0, 0, 0])
)


def texture(rng: np.random.Generator, side: int = 512) -> FloatArray:
    """Grey clouds and edges of many sizes."""
    grey = np.full((side, side), 120.0, np.float32)
    for cells in (8, 32, 96, 256):
        noise = rng.normal(size=(cells, cells))
        noise = cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
        # Steps give edges, as of things.
        grey += 18.0 * np.where(noise > 0.4, 1.0, np.tanh(noise)).astype(np.float32)
    return grey


@dataclass(frozen=True)
class Scene:
    """A wall, and boxes' faces before it, in the frame of the reference camera."""

    seed: int  # Of its textures and places.
    flat: bool = False  # Whether it is the plane z = 1 m alone.

    def light(self, before_from_now: RigidTransform) -> FloatArray:
        """(h, w) light on the sensor of the moved camera, before anything disturbs it."""
        rng, (width, height) = np.random.default_rng(self.seed), CAMERA.resolution
        rays = _rays() @ before_from_now.rotation.as_matrix().T
        centre, depth = before_from_now.translation, np.full(rays.shape[:2], np.inf)
        seen = np.zeros(rays.shape[:2], np.float32)
        for number in range(1 if self.flat else 5):
            z = 1.0 if self.flat else 1.6 - 0.2 * number
            tilt = np.array([*rng.normal(0.0, 0.0 if self.flat else 0.2, 2), 1.0])
            along = (z - tilt @ centre) / (rays @ tilt)
            hits = centre + rays * along[..., None]
            middle, grain = rng.uniform(-0.4, 0.4, 2), texture(rng)
            near = along < depth
            if number:
                for axis in (0, 1):
                    near &= np.abs(hits[..., axis] - middle[axis]) < 0.2
            texel = (hits[..., :2] / 0.0015).astype(np.float32)
            drawn = cv2.remap(grain, texel, None, cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
            seen, depth = np.where(near, drawn, seen), np.where(near, along, depth)
        seen = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA)
        return cv2.GaussianBlur(seen, (0, 0), 0.7)


@cache
def _rays() -> FloatArray:
    """(2 h, 2 w, 3) rays at unit depth, by a fixed point of the lens's polynomial."""
    fine = [(np.arange(2 * side) - 0.5) / 2 for side in CAMERA.resolution]
    px = np.stack(np.meshgrid(*fine), axis=-1)
    goal = (px - CAMERA.matrix[2:]) / CAMERA.matrix[:2]
    plane, (k1, k2) = goal, CAMERA.distortion[:2]
    # It gains a digit a step.
    for _ in range(12):
        r2 = np.sum(plane**2, axis=-1, keepdims=True)
        plane = goal / (1 + k1 * r2 + k2 * r2**2)
    return np.concatenate([plane, np.ones((*px.shape[:2], 1))], axis=2)


def disturbed(
    light: FloatArray,
    rng: np.random.Generator,
    covered: float = 0.0,
    bright: tuple[float, float] = (0.5, 2.0),
) -> Image:
    """An image: parts that move over a share of it, light with a shadow's edge, and noise."""
    grey, (height, width) = light.copy(), light.shape
    hidden, grain = np.zeros(grey.shape, bool), texture(rng)
    while hidden.mean() < covered:
        w, h = rng.integers(40, 130, 2)
        u, v = rng.integers(-20, width - 20), rng.integers(-20, height - 20)
        u, v, w, h = max(u, 0), max(v, 0), min(w, width - max(u, 0)), min(h, height - max(v, 0))
        at, part = rng.integers(0, 512 - 130, 2), np.s_[v : v + h, u : u + w]
        grey[part] = grain[at[0] : at[0] + h, at[1] : at[1] + w]
        hidden[part] = True
    if bright != (1.0, 1.0):
        u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
        angle, at = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6)
        across = u * np.cos(angle) + v * np.sin(angle) - at
        shade = 1 - 0.4 / (1 + np.exp(-across * rng.uniform(20, 200)))
        grey = grey * shade * np.exp(rng.uniform(*np.log(bright)))
    return np.clip(np.rint(grey + rng.normal(0.0, 2.0, grey.shape)), 0, 255).astype(np.uint8)


def turned(degrees: FloatArray, metres: FloatArray = (0.0, 0.0, 0.0)) -> RigidTransform:
    """The pose `before_from_now` by a rotation vector and a translation."""
    return RigidTransform.from_components(
        np.asarray(metres, float), Rotation.from_rotvec(degrees, degrees=True)
    )

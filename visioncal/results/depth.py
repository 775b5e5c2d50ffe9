"""Depth of a result: how a camera's distances deviate from the true ones, and their correction."""

from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np

from visioncal.core.codec import Array, Matrix, Vector
from visioncal.core.types import Camera, CameraKind, FloatArray
from visioncal.vision.camera import project


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthCamera:
    """A depth camera beside the camera of the images, as the session states it."""

    model: CameraKind  # `brown` or `fisheye`.
    resolution: tuple[int, int]  # Width and height [px].
    matrix: Annotated[FloatArray, Array((4,))]  # fx, fy, cx, cy [px].
    distortion: Vector  # The coefficients in OpenCV's order.
    cam_from_depth: Annotated[FloatArray, Array((4, 4))]  # Its pose in the camera's frame [m].
    sigmas: tuple[float, float] = (0.0, 0.0)  # Of that pose, per axis [rad], [m].

    @property
    def camera(self) -> Camera:
        """Intrinsics of the depth camera."""
        return Camera(self.model, self.resolution, self.matrix, self.distortion)


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthResult:
    """Model of a sensor's depth: `depth` of a camera in calibration.json.

    measured = scale * true + offset + tilt . (u, v) + bowl * r^2, where u and v go from -1 to 1
    over the image, and r is in half widths.
    """

    scale: float  # Measured over true distance.
    offset_m: float  # Offset in the image's middle [m].
    tilt_m: tuple[float, float]  # Change from the middle to the right and the lower edge [m].
    bowl_m: float  # Change from the middle to the left and right edges [m].
    # (5, 5) of scale, offset, tilt and bowl.
    covariance: Annotated[FloatArray, Array((5, 5))]
    # Noise of a pixel's distance d: the root of the sum of squares of the first and of the second
    # times d^2 [m], [1/m].
    noise_m: tuple[float, float]
    view_m: float  # Standard deviation of an offset that changes from view to view [m].
    # (5, 12 + k + m) covariance with both transforms, lens and field; None for a whole cell.
    with_calibration: Matrix | None = None
    ink_m: float = 0.0  # How much deeper black is read than white [m].
    distances_m: tuple[float, float]  # Least and greatest true distance of what it is from [m].
    of: Literal["z", "ray"] = "z"  # Whether distances are along z or along the ray.
    unit_m: float | None = None  # Unit of depth pictures, where stated [m].
    # The camera that u and v are of; None where depth is aligned to the image.
    by: DepthCamera | None = None

    @classmethod
    def exact(cls) -> Self:
        """The model of distances that are taken as they were measured."""
        return cls(
            scale=1.0, offset_m=0.0, tilt_m=(0.0, 0.0), bowl_m=0.0, covariance=np.zeros((5, 5)),
            noise_m=(0.0, 0.0), view_m=0.0, distances_m=(0.0, np.inf),
        )  # fmt: skip

    @property
    def cam_from_depth(self) -> FloatArray:
        """(4, 4) pose of the camera that measures depth, in that of the images."""
        return np.eye(4) if self.by is None else self.by.cam_from_depth

    def true_m(self, measured_m: FloatArray, px: FloatArray, size: tuple[int, int]) -> FloatArray:
        """(n,) true distances of (n,) measured ones at (n, 2) pixels of an image of a size [m]."""
        bent = bending(px, size) @ self.values[1:]
        return np.asarray((measured_m - bent) / self.scale)

    def corrected(self, points_m: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
        """(n, 3) points by true distances, and (n, 2) their pixels.

        Args:
            points_m: (n, 3) as measured, in the frame of the camera that measures depth [m].
            camera: It.
        """
        # In parts that stay in the cache, several times as fast.
        parts = np.array_split(points_m, 1 + len(points_m) // 50_000)
        px = np.concatenate([project(camera, part) for part in parts])
        measured = np.linalg.norm(points_m, axis=1) if self.of == "ray" else points_m[:, 2]
        share = self.true_m(measured, px, camera.resolution) / measured
        return points_m * share[:, None], px

    def by_values(self, true_m: FloatArray, px: FloatArray, size: tuple[int, int]) -> FloatArray:
        """(n, 5) change of measured distances, in true ones, by the model's values."""
        return np.column_stack([true_m, bending(px, size)]) / self.scale

    def noise_at(self, true_m: float) -> float:
        """Standard deviation of one corrected distance by the noise of pixel and view [m]."""
        floor, square = self.noise_m
        return float(np.linalg.norm([floor, square * true_m**2, self.view_m]) / self.scale)

    @property
    def values(self) -> FloatArray:
        """(5,) scale, offset, tilt and bowl, in the order of the covariance."""
        return np.array([self.scale, self.offset_m, *self.tilt_m, self.bowl_m])


def bending(px: FloatArray, size: tuple[int, int]) -> FloatArray:
    """(n, 4) derivatives of measured distances by offset, tilt and bowl, at (n, 2) pixels."""
    u, v = ((2.0 * px + 1.0) / size - 1.0).T
    return np.column_stack([np.ones_like(u), u, v, u**2 + (v * size[1] / size[0]) ** 2])

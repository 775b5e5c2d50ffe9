"""A camera in a result, and how it stands on disk."""

from dataclasses import dataclass
from typing import Annotated

from visioncal.core.types import Camera, CameraKind, FloatArray
from visioncal.results.codec import Array, Matrix, Vector, Written
from visioncal.results.edge import Covariance


@dataclass(frozen=True, eq=False)
class CameraResult:
    """The camera that the result was obtained with.

    Attributes:
        camera: The intrinsics.
        estimated: Whether they were estimated from this session's images.
        covariance: (k, k) of fx, fy, cx, cy and the distortion, where estimated.
        edge_covariance: (k, 6 e) of these with the calibration's edges in the order of its
            `joint_covariance`, where both were estimated together.
    """

    camera: Camera
    estimated: bool
    covariance: FloatArray | None = None
    edge_covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class CameraForm:
    """A camera.

    Attributes:
        model: `brown` or `fisheye`.
        resolution: Width and height [px].
        matrix: fx, fy, cx, cy [px].
        distortion: The coefficients in OpenCV's order.
        estimated: Whether it was estimated from this session's images.
        covariance: (k, k) of matrix and distortion, where estimated.
        edge_covariance: (k, 6 e) of these with the transforms, in the order of `joint_covariance`.
    """

    model: CameraKind
    resolution: tuple[int, int]
    matrix: Annotated[FloatArray, Array((4,))]
    distortion: Vector
    estimated: bool
    covariance: Covariance | None = None
    edge_covariance: Matrix | None = None

    @classmethod
    def of(cls, result: CameraResult) -> "CameraForm":
        """Writes a camera."""
        camera, both = result.camera, (result.covariance, result.edge_covariance)
        return cls(
            camera.model,
            camera.resolution,
            camera.matrix,
            camera.distortion,
            result.estimated,
            *both,
        )

    def result(self, _: str) -> CameraResult:
        """Reads it.

        Raises:
            ValueError: The covariances are not of its intrinsics.
        """
        size = len(self.matrix) + len(self.distortion)
        for it in (self.covariance, self.edge_covariance):
            if it is not None and len(it) != size:
                raise ValueError(f"a covariance has {len(it)} rows; {size} are needed")
        camera = Camera(self.model, self.resolution, self.matrix, self.distortion)
        return CameraResult(camera, self.estimated, self.covariance, self.edge_covariance)


StoredCamera = Annotated[CameraResult, Written(CameraForm.of, CameraForm.result, CameraForm)]

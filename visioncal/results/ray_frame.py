"""The camera's transform in the frame of one ray of its lens, which no lens's model can shift.

A lens that is decentered, or a thin prism, looks like one that is turned: residuals show no
difference, and where its optical axis points is a convention. Where the ray of a pixel points is
none: two calibrations of one camera agree about it, whatever models their lenses have.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.codec import Array, Section
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.results.edge import Edge, StoredEdge, StoredPose
from visioncal.results.lens import CameraResult
from visioncal.vision.camera import normalise

# Steps of central differences [rad], whose truncation is their square.
_STEP = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class RayFrame(Section):
    """The camera's transform with z along the ray of the image's centre: `ray_frame`.

    With another lens in the same place, the camera's transform is `transform` times the inverse of
    that lens's `cam_from_ray`.

    Attributes:
        name: Of the transform, such as `flange_from_ray`.
        px: (2,) the image's centre [px].
        cam_from_ray: (4, 4) the least turn of the camera's z axis into that pixel's ray, by its own
            lens.
        transform: The camera's transform times that, with the covariance of transform and lens.
    """

    name: str
    px: Annotated[FloatArray, Array((2,))]
    cam_from_ray: StoredPose
    transform: StoredEdge


def ray_frame(name: str, edge: Edge, lens: CameraResult) -> RayFrame | None:
    """Carries a camera's transform into the frame of its centre ray.

    Args:
        name: The transform's name, as `flange_from_cam`.
        edge: The transform, the first of its calibration.
        lens: The camera.

    Returns:
        It; None where the lens's distortion cannot be inverted there.
    """
    px = (np.array(lens.camera.resolution) - 1.0) / 2.0
    ray = normalise(lens.camera, lens.in_model(px[None]))[0]
    if not np.isfinite(ray).all():
        return None
    turn = np.eye(4)
    turn[:3, :3] = _turn(ray)
    _, by_lens = lens.rays_by_lens(px[None], np.append(ray, 1.0)[None])
    by_ray = np.array(
        [
            Rotation.from_matrix(_turn(ray - step).T @ _turn(ray + step)).as_rotvec()
            for step in _STEP * np.eye(2)
        ]
    ).T / (2.0 * _STEP)
    jacobian = np.zeros((6, 6 + by_lens.shape[2]))
    jacobian[:, :6] = adjoint(invert(turn))
    jacobian[:3, 6:] = by_ray @ by_lens[0, :2]
    covariance = jacobian @ lens.covariance_with(edge.covariance) @ jacobian.T
    placed = Edge(edge.matrix @ turn, (covariance + covariance.T) / 2.0)
    parent = name.partition("_from_")[0]
    return RayFrame(name=f"{parent}_from_ray", px=px, cam_from_ray=turn, transform=placed)


def _turn(ray: FloatArray) -> FloatArray:
    """(3, 3) the least turn of z into the ray of a point (2,) at unit depth."""
    away = float(np.hypot(*ray))
    about = np.array([-ray[1], ray[0], 0.0]) / max(away, np.finfo(float).tiny)
    return np.asarray(Rotation.from_rotvec(np.arctan(away) * about).as_matrix())

"""Camera in a result: intrinsics, field beyond the lens model, and the frame of its centre ray.

A decentered lens or a thin prism cannot be distinguished from a rotation of the camera, so the
direction of the optical axis depends on the lens model. The direction of a pixel's ray does not:
two calibrations of one camera agree about it with any lens models. Therefore the camera's transform
is also given in the frame of one ray.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.codec import INLINE, Array, Matrix, Section, Vector, WrittenForm
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import Camera, CameraKind, FloatArray
from visioncal.results.depth import DepthResult
from visioncal.results.edge import Covariance, Edge, StoredEdge, StoredPose
from visioncal.session.document import check_coefficients
from visioncal.vision.camera import intrinsics, normalise, project_with_jacobian, with_intrinsics
from visioncal.vision.lens_field import LensLevels, displacements

# Places of p1 and p2 among Brown's intrinsics.
_DECENTRING = (6, 7)

# Steps of central differences [rad], whose truncation is their square.
_STEP = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class LensField(Section):
    """Displacement field beyond the lens model: `field` of a camera in calibration.json.

    A pixel's displacement is linear in m coefficients with unit prior variance, those of the smooth
    field first, then that of breathing: see `vision.lens_field`.
    """

    field_px: float  # Prior standard deviation of the smooth field, per axis [px].
    length: float  # Its correlation length, as a share of the image's width.
    # Standard deviation of the relative change of the focal length as the distance doubles.
    breathing: float
    jitter: float  # Standard deviation of its relative change from view to view.
    distance_m: float  # Mean distance of the views, the reference of breathing [m].
    coefficients: Vector  # (m,) estimated coefficients.
    root: Matrix  # (m, r) square root of their covariance, `root root^T`.
    intrinsics_covariance: Matrix  # (m, k) cross-covariance with matrix and distortion.
    # (m, 6 e) cross-covariance with the transforms in the order of `joint_covariance`.
    edge_covariance: Matrix

    @property
    def levels(self) -> LensLevels:
        """Sizes of the lens's errors."""
        return LensLevels(self.field_px, self.length, self.breathing, self.jitter)


@dataclass(frozen=True, eq=False)
class CameraForm:
    """Intrinsics of a camera."""

    model: CameraKind  # `brown` or `fisheye`.
    resolution: tuple[int, int]  # Width and height [px].
    matrix: Annotated[FloatArray, Array((4,))]  # fx, fy, cx, cy [px].
    distortion: Vector  # The coefficients in OpenCV's order.

    def __post_init__(self) -> None:
        check_coefficients(self.model, len(self.distortion))
        if min(*self.resolution, *self.matrix[:2]) <= 0:
            raise ValueError("resolution, fx and fy must be above 0")


StoredCamera = Annotated[
    Camera, WrittenForm(lambda item: item, lambda item, _: Camera(**vars(item)), CameraForm)
]


@dataclass(frozen=True, eq=False)
class CameraResult:
    """Camera of a result."""

    camera: Annotated[StoredCamera, INLINE]  # The intrinsics.
    estimated: bool  # Whether they were estimated from this session's images.
    # (k, k) of fx, fy, cx, cy and the distortion, where estimated.
    covariance: Covariance | None = None
    # (k, 6 e) cross-covariance of these with the calibration's edges in the order of
    # `joint_covariance`, where both were estimated together.
    edge_covariance: Matrix | None = None
    # Displacement field beyond the lens model; None where it is not significant.
    field: LensField | None = None
    # How its depth deviates from the true one; None where views have none.
    depth: DepthResult | None = None

    def __post_init__(self) -> None:
        size = 4 + len(self.camera.distortion)
        for array in (self.covariance, self.edge_covariance):
            if array is not None and len(array) != size:
                raise ValueError(f"a covariance has {len(array)} rows, but must have {size}")
        if self.field is not None:
            count = self.displacements(np.zeros((1, 2))).shape[2]
            for name in ("coefficients", "root", "intrinsics_covariance", "edge_covariance"):
                rows = len(getattr(self.field, name))
                if rows != count:
                    raise ValueError(f"field.{name} has {rows} rows, but must have {count}")

    def covariance_with(self, edge: FloatArray) -> FloatArray:
        """Joint covariance of the first edges, lens and field; e + k + m rows and columns.

        Calibrations of older versions have no cross-covariance of edge and lens: it is zero then.

        Args:
            edge: (e, e) of the camera's edge, (6, 6), or of the calibration's first ones.
        """
        size, field, first = 4 + len(self.camera.distortion), self.field, len(edge)
        lens, fields = slice(first, first + size), slice(first + size, None)
        count = first + size + (0 if field is None else len(field.coefficients))
        covariance = np.zeros((count, count))
        covariance[:first, :first] = edge
        if self.covariance is not None:
            covariance[lens, lens] = self.covariance
            if self.edge_covariance is not None:
                covariance[lens, :first] = self.edge_covariance[:, :first]
        if field is not None and len(field.coefficients):
            covariance[fields, fields] = field.root @ field.root.T
            covariance[fields, lens] = field.intrinsics_covariance
            covariance[fields, :first] = field.edge_covariance[:, :first]
        low = np.tril(covariance, -1)
        return np.asarray(low + low.T + np.diag(np.diag(covariance)))

    def displacements(self, px: FloatArray, distance_m: float | None = None) -> FloatArray:
        """(n, 2, m) Jacobian of pixel displacements by the field's coefficients [px].

        Args:
            px: (n, 2) the pixels.
            distance_m: Depth of the imaged points; None for the mean distance.
        """
        field = self.field
        if field is None:
            return np.zeros((len(px), 2, 0))
        relative_distance = 0.0 if distance_m is None else distance_m / field.distance_m - 1.0
        return displacements(px, self.camera, relative_distance, field.levels)

    def in_model(self, px: FloatArray, distance_m: float | None = None) -> FloatArray:
        """(n, 2) pixels without the displacement field, as the lens model has them [px]."""
        if self.field is None:
            return px
        return np.asarray(px - self.displacements(px, distance_m) @ self.field.coefficients)

    def beyond_model_px(self) -> tuple[float, float]:
        """Displacements by the field where it was observed, per axis: rms and largest [px].

        At the views' mean distance. Matrix and coefficients cannot take over any of it: the field
        is orthogonal to them over the image.
        """
        if self.field is None or not len(self.field.coefficients):
            return 0.0, 0.0
        px = image_grid(self.camera)
        columns = self.displacements(px)
        displacements = columns @ self.field.coefficients
        before = np.sum(columns**2, axis=(1, 2))
        after = np.sum((columns @ self.field.root) ** 2, axis=(1, 2))
        # The share of the prior variance that the views removed.
        weights = np.clip(1.0 - after / np.where(before > 0.0, before, np.inf), 0.0, 1.0)
        if not weights.any():
            return 0.0, 0.0
        mean_squares = np.average(displacements**2, axis=0, weights=weights)
        # Where the field is poorly determined everywhere, its best determined part counts.
        # Observed: determined to half of the prior variance.
        observed = weights > min(0.5, 0.5 * weights.max())
        return float(np.sqrt(mean_squares.mean())), float(np.abs(displacements[observed]).max())

    def rays_by_lens(
        self, px: FloatArray, rays: FloatArray, distance_m: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Jacobians of points on rays at constant depth, by pixels and by the lens.

        Args:
            px: (n, 2) the pixels.
            rays: (n, 3) points on their rays.
            distance_m: Depth of the points; None for the mean distance.

        Returns:
            (n, 3, 2) by the pixels, and (n, 3, k + m) by the intrinsics and the field.
        """
        projected = project_with_jacobian(self.camera, rays)
        inverse = np.zeros((len(px), 3, 2))
        inverse[:, :2] = np.linalg.inv(projected.jacobian_point[:, :, :2])
        by_field = self.displacements(px, distance_m)
        return inverse, -inverse @ np.concatenate([projected.jacobian_intrinsics, by_field], axis=2)

    def carried(self, jacobian: FloatArray) -> "CameraResult":
        """The camera's result given other edges, by their Jacobian by the present ones."""
        if self.edge_covariance is None and self.field is None:
            return self
        edges, field = self.edge_covariance, self.field
        if field is not None:
            # Without coefficients, the number of edges is not in the file.
            field_covariance = field.edge_covariance.reshape(-1, jacobian.shape[1])
            field = replace(field, edge_covariance=field_covariance @ jacobian.T)
        edges = None if edges is None else edges @ jacobian.T
        return replace(self, edge_covariance=edges, field=field)


def image_grid(camera: Camera) -> FloatArray:
    """(n, 2) pixels of a grid over the image."""
    sides = zip(camera.resolution, (40, 32), strict=True)
    axes = (np.linspace(0.0, side - 1.0, count) for side, count in sides)
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class SensorTilt:
    """Tilt of the sensor that a lens's decentring stands for."""

    rad: float  # Angle between the optical axes of the lens model and of one with a tilted sensor.
    sigma_rad: float  # Its standard deviation by that of the decentring; 0 for a given lens.
    # Tilt that a lens's own decentring passes for, whose sensor is parallel to it (sigma).
    own_rad: float = 0.0


def sensor_tilt(lens: CameraResult) -> SensorTilt | None:
    """The tilted sensor that would explain the decentring p1, p2 of a lens.

    A pinhole camera whose sensor is tilted is one that is turned, with another principal point.
    Only the centre of the radial distortion remains on the lens's axis. Seen from there, it is
    displaced; its derivative by that displacement is Brown's decentring (Brown 1966). The tilt, and
    the changes of all other intrinsics, are those that come nearest to the decentring over the
    image.

    Returns:
        The tilt; None where the model has no decentring, or no tilt explains it.
    """
    if lens.camera.model != "brown":
        return None
    values = intrinsics(lens.camera)
    decentring = values[[*_DECENTRING]]
    values[[*_DECENTRING]] = 0.0
    camera = with_intrinsics(lens.camera, values)
    rays = normalise(camera, image_grid(camera))
    points = np.column_stack([rays, np.ones(len(rays))])[np.isfinite(rays).all(axis=1)]
    projected = project_with_jacobian(camera, points)
    focal, centre = camera.matrix[:2], camera.matrix[2:]
    shown = np.column_stack([(projected.px - centre) / focal, np.ones(len(points))])
    # The camera is turned about x and y before the distortion, and turned back behind it.
    turned = np.cross(np.eye(3)[:2], points[:, None])
    back = np.cross(np.eye(3)[:2], shown[:, None])
    by_tilt = np.swapaxes(
        turned @ np.swapaxes(projected.jacobian_point, 1, 2)
        - focal * (back[:, :, :2] - shown[:, None, :2] * back[:, :, 2:]),
        1,
        2,
    )
    others = np.delete(projected.jacobian_intrinsics, _DECENTRING, axis=2)
    columns = np.concatenate([by_tilt, others], axis=2).reshape(-1, 2 + others.shape[2])
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    decentred = projected.jacobian_intrinsics[:, :, _DECENTRING].reshape(-1, 2)
    fitted = np.linalg.lstsq(columns / scale, decentred, rcond=1e-8)[0] / scale[:, None]
    tilt = fitted[:2] @ decentring
    rad = float(np.linalg.norm(tilt))
    # An axis beside the image is no lens's: decentring with hardly any radial distortion.
    if rad > np.hypot(*camera.resolution) / 2.0 / focal.min():
        return None
    if rad == 0.0:
        return SensorTilt(rad, 0.0)
    along = tilt @ fitted[:2] / rad
    # Sigma of p1 and p2 of lenses whose elements are centred as well as makers can.
    own_rad = 5e-4 * float(np.linalg.norm(along))
    if lens.covariance is None:
        return SensorTilt(rad, 0.0, own_rad)
    return SensorTilt(rad, float(np.sqrt(along @ lens.covariance[6:8, 6:8] @ along)), own_rad)


@dataclass(frozen=True, eq=False, kw_only=True)
class RayFrame(Section):
    """The camera's transform with z along the ray of the image's centre: `ray_frame`.

    For another lens model of the same camera, the camera's transform is `transform` times the
    inverse of that model's `cam_from_ray`.
    """

    name: str  # Name of the transform, such as `flange_from_ray`.
    px: Annotated[FloatArray, Array((2,))]  # (2,) the image's centre [px].
    # (4, 4) the smallest rotation of the camera's z axis into that pixel's ray.
    cam_from_ray: StoredPose
    transform: StoredEdge  # The camera's transform times `cam_from_ray`, with covariance of both.


def ray_frame(name: str, edge: Edge, lens: CameraResult) -> RayFrame | None:
    """The camera's transform in the frame of its centre ray.

    Args:
        name: The transform's name, as `flange_from_cam`.
        edge: The transform, the first of its calibration.
        lens: The camera.

    Returns:
        The transform; None where the lens's distortion cannot be inverted there.
    """
    px = (np.array(lens.camera.resolution) - 1.0) / 2.0
    ray = normalise(lens.camera, lens.in_model(px[None]))[0]
    if not np.isfinite(ray).all():
        return None
    turn = np.eye(4)
    turn[:3, :3] = to_ray(ray)
    _, by_lens = lens.rays_by_lens(px[None], np.append(ray, 1.0)[None])
    by_ray = np.array(
        [
            Rotation.from_matrix(to_ray(ray - step).T @ to_ray(ray + step)).as_rotvec()
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


def to_ray(ray: FloatArray) -> FloatArray:
    """(3, 3) the smallest rotation of z into the ray of a point (2,) at unit depth."""
    tangent = float(np.hypot(*ray))
    axis = np.array([-ray[1], ray[0], 0.0]) / max(tangent, np.finfo(float).tiny)
    return np.asarray(Rotation.from_rotvec(np.arctan(tangent) * axis).as_matrix())

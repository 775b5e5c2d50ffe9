"""A camera in a result, how it stands on disk, and as far as coefficients alone can say it.

A lens that is decentered, or a thin prism, looks like one that is turned: residuals show no
difference, and where its optical axis points is a convention. Where the ray of a pixel points is
none: two calibrations of one camera agree about it, whatever models their lenses have. So the
camera's transform is given in the frame of one ray, too.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.codec import INLINE, Array, Matrix, Section, Vector, WrittenForm
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import Camera, CameraKind, FloatArray
from visioncal.estimation.lens_field import LensLevels, displacements
from visioncal.results.edge import Covariance, Edge, StoredEdge, StoredPose
from visioncal.vision.camera import (
    intrinsics,
    normalise,
    project,
    project_with_jacobian,
    with_intrinsics,
)

# Pixels along the image's width and height to which coefficients are fitted, and steps of that.
_GRID, _STEPS = (40, 32), 5
# A field of less where it was seen changes nothing [px].
_NOTICED_PX = 0.01
# What counts as seen: where the field is known to better than so much of its variance.
_SEEN = 0.5
# Combinations of coefficients that move no pixel stay.
_DETERMINED = 1e-8

# Steps of central differences [rad], whose truncation is their square.
_STEP = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class LensField(Section):
    """What a lens does beyond its model: `field` of a camera in calibration.json.

    A pixel is displaced by m coefficients of variance one beforehand, those of the field first and
    then that of breathing: see `estimation.lens_field`.

    Attributes:
        field_px: Standard deviation of a smooth field over the image, an axis [px].
        length: Its length, as a share of the image's width.
        breathing: Standard deviation of the focal length's change as the distance doubles, as a
            share of it.
        jitter: And from view to view.
        distance_m: The mean distance of the views, about which the lens breathes [m].
        coefficients: (m,) as they were found.
        root: (m, r) of their covariance, `root root^T`.
        intrinsics_covariance: (m, k) with matrix and distortion.
        edge_covariance: (m, 6 e) with the transforms, in the order of `joint_covariance`.
    """

    field_px: float
    length: float
    breathing: float
    jitter: float
    distance_m: float
    coefficients: Vector
    root: Matrix
    intrinsics_covariance: Matrix
    edge_covariance: Matrix

    def columns(self, camera: Camera, px: FloatArray, distance_m: float | None) -> FloatArray:
        """(n, 2, m) by how much the coefficients displace (n, 2) pixels [px].

        Args:
            camera: The lens.
            px: The pixels.
            distance_m: How far along the camera's axis that is which they show; None for the mean.
        """
        levels = LensLevels(self.field_px, self.length, self.breathing, self.jitter)
        far = 0.0 if distance_m is None else distance_m / self.distance_m - 1.0
        return displacements(px, camera, far, levels)


@dataclass(frozen=True, eq=False)
class CameraForm:
    """The intrinsics of a camera.

    Attributes:
        model: `brown` or `fisheye`.
        resolution: Width and height [px].
        matrix: fx, fy, cx, cy [px].
        distortion: The coefficients in OpenCV's order.
    """

    model: CameraKind
    resolution: tuple[int, int]
    matrix: Annotated[FloatArray, Array((4,))]
    distortion: Vector


_StoredCamera = Annotated[
    Camera,
    INLINE,
    WrittenForm(
        lambda item: item,
        lambda item, _: Camera(item.model, item.resolution, item.matrix, item.distortion),
        CameraForm,
    ),
]


@dataclass(frozen=True, eq=False)
class CameraResult:
    """The camera that the result was obtained with.

    Attributes:
        camera: The intrinsics.
        estimated: Whether they were estimated from this session's images.
        covariance: (k, k) of fx, fy, cx, cy and the distortion, where estimated.
        edge_covariance: (k, 6 e) of these with the calibration's edges in the order of its
            `joint_covariance`, where both were estimated together.
        field: What the lens does beyond its model; None where nothing shows that.
    """

    camera: _StoredCamera
    estimated: bool
    covariance: Covariance | None = None
    edge_covariance: Matrix | None = None
    field: LensField | None = None

    def __post_init__(self) -> None:
        """Checks that the covariances are of its intrinsics, and of its field.

        Raises:
            ValueError: They are not.
        """
        size = 4 + len(self.camera.distortion)
        for array in (self.covariance, self.edge_covariance):
            if array is not None and len(array) != size:
                raise ValueError(f"a covariance has {len(array)} rows; {size} are needed")
        if self.field is not None:
            count = self.displacements(np.zeros((1, 2))).shape[2]
            for name in ("coefficients", "root", "intrinsics_covariance", "edge_covariance"):
                rows = len(getattr(self.field, name))
                if rows != count:
                    raise ValueError(f"field.{name} has {rows} rows; {count} are needed")

    def covariance_with(self, edge: FloatArray) -> FloatArray:
        """The (6 + k + m,) squared covariance of the camera's edge, its lens, and its field.

        A calibration of an older version does not hold what edge and lens have in common: they
        count as independent then.

        Args:
            edge: (6, 6) of the edge, the first of the calibration's.
        """
        size, field = 4 + len(self.camera.distortion), self.field
        lens, fields = slice(6, 6 + size), slice(6 + size, None)
        found = np.zeros((6 + size + (0 if field is None else len(field.coefficients)),) * 2)
        found[:6, :6] = edge
        if self.covariance is not None:
            found[lens, lens] = self.covariance
            if self.edge_covariance is not None:
                found[lens, :6] = self.edge_covariance[:, :6]
        if field is not None and len(field.coefficients):
            found[fields, fields] = field.root @ field.root.T
            found[fields, lens] = field.intrinsics_covariance
            found[fields, :6] = field.edge_covariance[:, :6]
        low = np.tril(found, -1)
        return np.asarray(low + low.T + np.diag(np.diag(found)))

    def displacements(self, px: FloatArray, distance_m: float | None = None) -> FloatArray:
        """(n, 2, m) by how much coefficients beyond the model displace pixels [px]."""
        if self.field is None:
            return np.zeros((len(px), 2, 0))
        return self.field.columns(self.camera, px, distance_m)

    def in_model(self, px: FloatArray, distance_m: float | None = None) -> FloatArray:
        """(n, 2) where the lens, were it what its model says, would show what is at pixels [px].

        Args:
            px: (n, 2) the pixels.
            distance_m: How far along the camera's axis that is which they show; None for the mean.
        """
        if self.field is None:
            return px
        return np.asarray(px - self.displacements(px, distance_m) @ self.field.coefficients)

    def rays_by_lens(
        self, px: FloatArray, rays: FloatArray, distance_m: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """How points on rays move at their depth: with pixels, (n, 3, 2), and with the lens.

        Args:
            px: (n, 2) the pixels.
            rays: (n, 3) points on their rays.
            distance_m: As `in_model` has it.

        Returns:
            Both; the latter (n, 3, k + m) by the intrinsics and by what is beyond them.
        """
        seen = project_with_jacobian(self.camera, rays)
        inverse = np.zeros((len(px), 3, 2))
        inverse[:, :2] = np.linalg.inv(seen.by_point[:, :, :2])
        beyond = self.displacements(px, distance_m)
        return inverse, -inverse @ np.concatenate([seen.by_intrinsics, beyond], axis=2)

    def carried(self, jacobian: FloatArray) -> "CameraResult":
        """The same beside other edges, by how these move with those that it has."""
        if self.edge_covariance is None and self.field is None:
            return self
        edges, field = self.edge_covariance, self.field
        if field is not None:
            # Of no coefficients, a file does not say how many edges there were.
            beside = field.edge_covariance.reshape(-1, jacobian.shape[1])
            field = replace(field, edge_covariance=beside @ jacobian.T)
        edges = None if edges is None else edges @ jacobian.T
        return replace(self, edge_covariance=edges, field=field)


@dataclass(frozen=True, eq=False)
class RefittedLens:
    """The lens that readers of matrix and coefficients alone are given.

    Attributes:
        camera: Matrix and coefficients that see rays as the lens and its field do.
        rms_px: What they leave of the field, an axis, where it was seen [px].
        most_px: The largest of it there, an axis [px].
    """

    camera: Camera
    rms_px: float = 0.0
    most_px: float = 0.0


def refitted(lens: CameraResult) -> RefittedLens:
    """Fits matrix and coefficients to a lens and its field, at the views' mean distance.

    Where nothing was seen the field is not known, and nothing is fitted. The camera's frame stays,
    so that its transform goes with the lens.
    """
    camera = lens.camera
    if lens.field is None or not len(lens.field.coefficients):
        return RefittedLens(camera)
    axes = (np.linspace(0.0, at - 1.0, n) for at, n in zip(camera.resolution, _GRID, strict=True))
    px = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    straight = lens.in_model(px)
    rays, weights = normalise(camera, straight), _known(lens, px)
    seen = np.isfinite(rays).all(axis=1) & (weights > 0.0)
    px, straight, rays, weights = px[seen], straight[seen], rays[seen], weights[seen]
    size = len(intrinsics(camera))
    if len(px) < size or _rms(px - straight, weights) < _NOTICED_PX:
        return RefittedLens(camera)
    found, points = camera, np.column_stack([rays, np.ones(len(rays))])
    roots, moved = np.sqrt(weights)[:, None], np.arange(_last(camera))
    for _ in range(_STEPS):
        there = project_with_jacobian(found, points)
        columns = (roots[:, :, None] * there.by_intrinsics[:, :, moved]).reshape(-1, len(moved))
        scale = np.linalg.norm(columns, axis=0)
        away = (roots * (px - there.px)).ravel()
        step = np.linalg.lstsq(columns / scale, away, rcond=_DETERMINED)[0] / scale
        found = with_intrinsics(found, intrinsics(found) + np.pad(step, (0, size - len(step))))
    left = px - project(found, points)
    # Where little is known anywhere, what is known best counts.
    well = weights > min(_SEEN, 0.5 * weights.max())
    most_px = float(np.abs(left[well]).max())
    return RefittedLens(found, _rms(left, weights), most_px)


def _last(camera: Camera) -> int:
    """How many intrinsics are fitted: coefficients at the end that are zero are none of the model.

    Without any, all of them are.
    """
    used = np.flatnonzero(camera.distortion)
    return len(intrinsics(camera)) if not len(used) else 4 + int(used[-1]) + 1


def _known(lens: CameraResult, px: FloatArray) -> FloatArray:
    """(n,) by which share of its variance the field is known at (n, 2) pixels."""
    if lens.field is None:
        return np.zeros(len(px))
    columns = lens.displacements(px)
    before = np.sum(columns**2, axis=(1, 2))
    after = np.sum((columns @ lens.field.root) ** 2, axis=(1, 2))
    return np.asarray(np.clip(1.0 - after / np.where(before > 0.0, before, np.inf), 0.0, 1.0))


def _rms(px: FloatArray, weights: FloatArray) -> float:
    """The weighted RMS of (n, 2) displacements, an axis [px]."""
    return float(np.sqrt(np.sum(weights * np.mean(px**2, axis=1)) / np.sum(weights)))


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

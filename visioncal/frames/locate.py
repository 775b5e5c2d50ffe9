"""The pick: where a feature that an image shows lies in the base, and how well that is known."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.types import Corners, FloatArray, Image, Target
from visioncal.estimation.observability import SIGMA_LIMIT_M
from visioncal.frames.camera_chain import ChainStop, Eye, Plane, Pose, checked_point, point_slope
from visioncal.frames.located import Located
from visioncal.frames.target_in_image import SeenTarget, see
from visioncal.results import Calibration
from visioncal.session.choosing import EYE, Choice
from visioncal.vision.camera import normalise
from visioncal.vision.targets import load_target

# A ray within this angle of a plane [rad] meets it at no place of use.
_PARALLEL = 1e-6


@typed
def locate(
    calibration: Calibration,
    px: FloatArray,
    plane: Plane,
    base_from_flange: Pose | None = None,
    *,
    joints_rad: FloatArray | None = None,
    sigma_px: float | None = None,
    camera: str | None = None,
    robot: str | None = None,
) -> tuple[Located, ...]:
    """Places features of an image in the base, by the plane that they lie in.

    Args:
        calibration: The camera's.
        px: (n, 2) where the features were seen [px], pixel centres at integers.
        plane: What they lie in.
        base_from_flange: Where the robot stood at the image, as it reported it; only for a camera
            on the flange.
        joints_rad: (n,) where that is the calibrated arm's pose by these joints [rad].
        sigma_px: Noise of a feature's coordinate [px]; the calibration's corners' where None.
        camera: Which camera is meant, of a whole cell's calibration.
        robot: In which robot's base; likewise.

    Returns:
        One place a feature. Features of one image share all but the pixels' noise.

    Raises:
        DataError: There is no camera or no pose of the robot, a pixel is outside the image, or its
            ray does not meet the plane in front of the camera.
    """
    eye = Eye.of(calibration.chosen(Choice(camera, robot), EYE))
    noise_px, stop = eye.noise_px(sigma_px), eye.at(base_from_flange, joints_rad)
    px = np.atleast_2d(np.asarray(px, dtype=float))
    rays = _rays(eye, px)
    return tuple(
        _on_plane(eye, stop, plane, ray, at, noise_px) for ray, at in zip(rays, px, strict=True)
    )


def _rays(eye: Eye, px: FloatArray) -> FloatArray:
    """(n, 3) points at unit depth in the camera's frame."""
    if px.shape[1:] != (2,):
        raise DataError(f"locate: pixels have the shape {px.shape}; (n, 2) is needed.")
    size = np.array(eye.camera.resolution)
    inside = np.all((px >= -0.5) & (px <= size - 0.5), axis=1)
    plane = normalise(
        eye.camera, eye.lens.in_model(np.where(inside[:, None], px, eye.camera.matrix[2:]))
    )
    for at, (u, v) in enumerate(px.tolist()):
        if not inside[at]:
            raise DataError(
                f"locate: pixel ({u:.1f}, {v:.1f}) is outside the camera's image of "
                f"{size[0]} x {size[1]}.",
                culprits=[f"pixel {at}"],
                next_step="Give pixels of the full image, as the camera took it.",
            )
        if not np.isfinite(plane[at]).all():
            raise DataError(
                f"locate: the lens's distortion cannot be inverted at pixel ({u:.1f}, {v:.1f}).",
                culprits=[f"pixel {at}"],
                next_step="Calibrate with corners up to the image's edge.",
            )
    return np.concatenate([plane, np.ones((len(px), 1))], axis=1)


def _depth(stop: ChainStop, plane: Plane, ray: FloatArray, label: str) -> float:
    """How far along a ray of unit depth it meets the plane."""
    along = stop.base_from_cam[:3, :3] @ ray
    rise = float(plane.normal @ along)
    gap = plane.offset_m - float(plane.normal @ stop.base_from_cam[:3, 3])
    if abs(rise) < _PARALLEL * np.linalg.norm(along):
        raise DataError(
            f"locate: the ray of {label} runs parallel to the plane.", next_step=_LOOK_AT_PLANE
        )
    depth = gap / rise
    if depth <= 0.0:
        raise DataError(
            f"locate: the ray of {label} runs away from the plane: they meet {-depth:.3g} m "
            "behind the camera.",
            next_step=_LOOK_AT_PLANE,
        )
    return depth


def _on_plane(
    eye: Eye, stop: ChainStop, plane: Plane, ray: FloatArray, px: FloatArray, noise_px: float
) -> Located:
    """Cuts a pixel's ray with the plane, and carries the covariance of both to the cut."""
    label = f"pixel ({px[0]:.1f}, {px[1]:.1f})"
    depth = _depth(stop, plane, ray, label)
    # The ray is that of the mean distance: where the lens breathes, there is another one.
    ray = np.append(normalise(eye.camera, eye.lens.in_model(px[None], depth))[0], 1.0)
    depth = _depth(stop, plane, ray, label)
    along = stop.base_from_cam[:3, :3] @ ray
    rise = float(plane.normal @ along)
    point_cam = depth * ray
    place = stop.point(point_cam)
    # The point stays on the plane: what moves its ray carries it there along the ray.
    kept = np.eye(3) - np.outer(along, plane.normal) / rise
    (by_px,), (by_lens,) = eye.lens.rays_by_lens(px[None], point_cam[None], depth)
    turned = kept @ stop.base_from_cam[:3, :3]
    by_focus = eye.jitter * turned @ by_px @ (px - eye.camera.matrix[2:])
    by_camera = kept @ stop.by_camera(point_cam)
    by_plane = np.outer(along / rise, np.append(-place, 1.0))
    parts = {
        "pixels": _carried(noise_px * turned @ by_px, np.eye(2)),
        "focus": np.outer(by_focus, by_focus),
        "plane": _carried(by_plane, plane.covariance),
        **_camera_parts(eye, stop, by_camera, turned @ by_lens),
    }
    return _located(eye, place, parts, ())


_LOOK_AT_PLANE = (
    "Check the plane (in the base; --plane is in mm) and the robot's pose (base_from_flange, no "
    "inverse)."
)


def _camera_parts(
    eye: Eye, stop: ChainStop, by_camera: FloatArray, by_lens: FloatArray
) -> dict[str, FloatArray]:
    """What the calibration and the robot add to a place, by how it moves with camera and lens."""
    flange_jacobian = by_camera @ stop.flange_jacobian
    by_arm = flange_jacobian @ stop.arm_basis
    # What is left open of a calibrated arm is one with the camera's transform.
    apart = slice(0, eye.posture_size)
    learnt = by_arm.copy()
    learnt[:, apart] = 0.0
    by_calibration = np.concatenate([by_camera, by_lens, learnt], axis=1)
    return {
        "calibration": _carried(by_calibration, eye.shared_covariance),
        "robot": _carried(flange_jacobian, stop.flange_noise),
        "arm": _carried(by_arm[:, apart], np.eye(eye.posture_size)),
    }


def _carried(slope: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(slope @ covariance @ slope.T)


def _located(
    eye: Eye, place: FloatArray, parts: dict[str, FloatArray], warnings: Sequence[str]
) -> Located:
    """Puts the place together; sources that add nothing are left out."""
    kept = {name: part for name, part in parts.items() if np.trace(part) > 0.0}
    kept = kept or {"pixels": np.zeros((3, 3))}
    found = Located(place, kept, _freedom(eye, kept), (*eye.warnings, *warnings))
    worst_m = float(np.sqrt(max(np.linalg.eigvalsh(found.covariance)[-1], 0.0)))
    if worst_m <= SIGMA_LIMIT_M:
        return found
    warning = (
        f"The place is known to {figure(1e3 * worst_m)} mm only in its worst direction (limit "
        f"{1e3 * SIGMA_LIMIT_M:g}), mostly because of the {_SOURCES[found.largest]}."
    )
    return Located(place, kept, found.freedom, (*found.warnings, warning))


def _freedom(eye: Eye, parts: Mapping[str, FloatArray]) -> float:
    """Degrees of freedom of a sum of which a part rests on the robot's noise (Satterthwaite 1946).

    The pixels' noise comes from thousands of corners; plane and target are declared.
    """
    total = sum(float(np.trace(part)) for part in parts.values())
    estimated = sum(float(np.trace(parts[name])) for name in _ESTIMATED & parts.keys())
    return eye.freedom * (total / estimated) ** 2 if estimated > 0.0 else np.inf


# What is as uncertain as the robot's noise is itself.
_ESTIMATED = {"calibration", "robot", "arm"}


_SOURCES = {
    "pixels": "pixel's noise: look from nearer, or less along the plane",
    "focus": "focal length, which changes from view to view: fix the focus",
    "plane": "plane's own uncertainty",
    "calibration": "hand-eye calibration",
    "robot": "robot's noise",
    "arm": "arm's errors, which a kinematic calibration would take out",
    "target": "target's uncertain size",
}


@typed
def locate_target(
    calibration: Calibration,
    seen: Corners | Image,
    target: Target | Path | str,
    base_from_flange: Pose | None = None,
    point_target_m: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
    *,
    joints_rad: FloatArray | None = None,
    sigma_px: float | None = None,
    label: str = "image",
    camera: str | None = None,
    robot: str | None = None,
) -> Located:
    """Places a point of a target that an image shows in the base.

    The target's size counts with its `square_sigma_m`, and as independent of the calibration: of
    the board that was calibrated with, a part of that is counted twice.

    Args:
        calibration: The camera's.
        seen: The target's corners, or the (h, w) grey image to find them in.
        target: What is seen, or its name or file as `load_target` takes it.
        base_from_flange: Where the robot stood at the image, as it reported it; only for a camera
            on the flange.
        point_target_m: (3,) the point in the target's frame [m].
        joints_rad: (n,) where the pose is the calibrated arm's by these joints [rad].
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.
        label: What messages call the image.
        camera: Which camera is meant, of a whole cell's calibration.
        robot: In which robot's base; likewise.

    Raises:
        DataError: There is no camera or no pose of the robot, or the image does not show the
            target.
    """
    eye = Eye.of(calibration.chosen(Choice(camera, robot), EYE))
    stop = eye.at(base_from_flange, joints_rad)
    board = target if isinstance(target, Target) else load_target(target)
    view = see(eye, seen, board, label, sigma_px)
    point = checked_point(point_target_m, "point_target_m")
    places = view.cam_from_target[:, :3, :3] @ point + view.cam_from_target[:, :3, 3]
    pose, point_cam = view.cam_from_target[0], places[0]
    turned = stop.base_from_cam[:3, :3] @ point_slope(pose, point)
    parts = {
        "pixels": _carried(turned, view.covariance[0]),
        "target": _carried((turned @ view.by_scale[0])[:, None], np.array([[view.scale_sigma**2]])),
        **_camera_parts(eye, stop, stop.by_camera(point_cam), turned @ view.by_lens[0]),
    }
    found = _located(eye, stop.point(point_cam), parts, view.warnings)
    rivals = _rivals(view, places, found)
    if not rivals:
        return found
    return Located(found.p_base, found.parts, found.freedom, (*found.warnings, rivals))


def _rivals(view: SeenTarget, places: FloatArray, found: Located) -> str:
    """Says that another pose fits the image as well, where the point would lie elsewhere."""
    away_mm = 1e3 * float(np.linalg.norm(places - places[0], axis=1).max())
    if away_mm <= found.radius95_mm:
        return ""
    why = (
        "The board looks the same when it is turned"
        if len(set(view.turns)) > 1
        else "Seen so flat, the target may as well be tilted the other way"
    )
    return (
        f"{why}: the point would lie {figure(away_mm)} mm away then. Look from another side, from "
        "nearer, or at a board without symmetry."
    )

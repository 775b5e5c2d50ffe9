"""Picks: position in the base of a feature in an image, with its uncertainty."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.directions import SIGMA_LIMIT_M
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.prediction import point_jacobian, through
from visioncal.core.transforms import apply, invert
from visioncal.core.types import Corners, FloatArray, Image, Target
from visioncal.frames.camera_chain import (
    CalibratedCamera,
    CameraPose,
    Plane,
    Pose,
    checked_point,
)
from visioncal.frames.located import Located
from visioncal.results.content import CalibrationContent
from visioncal.results.depth import DepthResult
from visioncal.results.selecting import selected
from visioncal.session.selecting import EYE, Choice
from visioncal.vision.camera import normalise, project
from visioncal.vision.targets import load_target

# Factor beyond the distances of the views that is named: a board of a third of the image reaches
# that much nearer or farther than its middle where it is steeply tilted.
_BEYOND = 1.5


@typed
def locate(
    calibration: CalibrationContent,
    px: FloatArray,
    plane: Plane,
    base_from_flange: Pose | None = None,
    *,
    joints_rad: FloatArray | None = None,
    sigma_px: float | None = None,
    camera: str | None = None,
    robot: str | None = None,
) -> tuple[Located, ...]:
    """Positions in the base of image features on a known plane.

    Args:
        calibration: The camera's.
        px: (n, 2) features in the image [px], pixel centres at integers.
        plane: The plane that they lie in.
        base_from_flange: The flange's pose at the image as reported; only for a camera on the
            flange.
        joints_rad: (n,) joints [rad] where the pose is the calibrated arm's for these joints.
        sigma_px: Noise of a feature's coordinate [px]; the calibration's corner noise where None.
        camera: Name of the camera in a whole cell's calibration.
        robot: Name of the robot in whose base, likewise.

    Returns:
        One position a feature. Features of one image share all errors but the pixel noise.

    Raises:
        DataError: There is no camera or no pose of the robot, a pixel is outside the image, or its
            ray does not meet the plane in front of the camera.
    """
    eye = CalibratedCamera.of(selected(calibration, Choice(camera, robot), EYE))
    noise_px, cam_pose = eye.noise_px(sigma_px), eye.at(base_from_flange, joints_rad)
    px, rays = _rays(eye, px)
    return tuple(
        _on_plane(eye, cam_pose, plane, ray, at, noise_px) for ray, at in zip(rays, px, strict=True)
    )


@typed
def locate_by_depth(
    calibration: CalibrationContent,
    px: FloatArray,
    depth_m: FloatArray | float,
    base_from_flange: Pose | None = None,
    *,
    joints_rad: FloatArray | None = None,
    sigma_px: float | None = None,
    camera: str | None = None,
    robot: str | None = None,
) -> tuple[Located, ...]:
    """Positions in the base of image features at measured distances, which are corrected.

    Args:
        calibration: The camera's, with its depth; without it, distances are taken as exact.
        px: As in `locate`.
        depth_m: (n,) distances as the sensor measured them, along z or the ray as the calibration's
            session has them [m].
        base_from_flange: As in `locate`.
        joints_rad: As in `locate`.
        sigma_px: As in `locate`.
        camera: As in `locate`.
        robot: As in `locate`.

    Raises:
        DataError: As `locate`, or a distance is not above 0.
    """
    eye = CalibratedCamera.of(selected(calibration, Choice(camera, robot), EYE))
    noise_px, cam_pose = eye.noise_px(sigma_px), eye.at(base_from_flange, joints_rad)
    px, rays = _rays(eye, px)
    measured = np.broadcast_to(np.asarray(depth_m, dtype=float), len(px))
    if not (measured > 0.0).all():
        raise DataError(
            f"locate: the distances are {measured.tolist()}, but must be metres above 0.",
            next_step="Take a pixel at which the sensor measured one.",
        )
    model, found, unread = eye.lens.depth, list[Located](), ""
    if model is None:
        model = DepthResult.exact()
        unread = "The calibration's views had no depth: it is taken as it was measured."
    # The depth is by the camera of depth, in whose pixels the model is.
    by, cam_from_depth = (eye.camera if model.by is None else model.by.camera), model.cam_from_depth
    cross = np.zeros((5, len(eye.covariance)))
    if model.with_calibration is not None:
        # Between the camera's edge and the lens is the board's.
        cross = np.delete(model.with_calibration, np.s_[6:12], axis=1)
    for at, ray, metres in zip(px, rays, measured, strict=True):
        along = float(np.linalg.norm(ray)) if model.of == "ray" else 1.0
        placed, where = model.corrected(
            apply(invert(cam_from_depth), (metres / along * ray)[None]), by
        )
        (depth,) = apply(cam_from_depth, placed)[:, 2]
        noise_m = model.noise_at(depth * along) / along
        by_depth = -model.by_values(depth[None] * along, where, by.resolution).T / along
        # The first ray is for the mean distance, as in `_on_plane`.
        unit = np.append(normalise(eye.camera, eye.lens.in_model(at[None], depth))[0], 1.0)
        point_cam, along_ray = depth * unit, cam_pose.base_from_cam[:3, :3] @ unit
        by_values = (np.outer(along_ray, by_depth), model.covariance, cross)
        parts = {
            "depth": noise_m**2 * np.outer(along_ray, along_ray),
            **_ray_parts(eye, cam_pose, at, point_cam, noise_px, depth=by_values),
        }
        warnings = (*filter(None, [unread]), *_distance_warning(eye, point_cam))
        found.append(_located(eye, cam_pose.point(point_cam), parts, warnings))
    return tuple(found)


def seen_distances(
    calibration: CalibrationContent, depth_m: FloatArray, px: FloatArray
) -> FloatArray:
    """Distances at pixels of the image by the picture of a depth camera, NaN where there are none.

    The depth of a camera beside is interpolated between the nearest of its points that are seen
    there.

    Args:
        calibration: The camera's.
        depth_m: (h, w) as measured [m].
        px: (n, 2) pixels of the image.

    Returns:
        (n,) along the image's z, or along its rays where the measured ones are [m].
    """
    eye = CalibratedCamera.of(calibration)
    model = eye.lens.depth
    if model is None or model.by is None:
        u, v = np.clip(np.rint(px), 0, np.array(eye.camera.resolution) - 1).astype(int).T
        return np.asarray(depth_m[v, u])
    rows, columns = np.nonzero(np.isfinite(depth_m))
    normalised = normalise(model.by.camera, np.column_stack([columns, rows]).astype(float))
    rays = np.column_stack([normalised, np.ones(len(normalised))])
    lengths = np.linalg.norm(rays, axis=1, keepdims=True) if model.of == "ray" else 1.0
    points = apply(model.cam_from_depth, rays * depth_m[rows, columns][:, None] / lengths)
    distances = np.linalg.norm(points, axis=1) if model.of == "ray" else points[:, 2]
    seen, found = project(eye.camera, points), np.full(len(px), np.nan)
    # One and a half pixels of the depth picture.
    reach_px = 1.5 * float(np.max(eye.camera.matrix[:2] / model.by.matrix[:2]))
    for at, place in enumerate(px):
        near = np.linalg.norm(seen - place, axis=1) < reach_px
        # Nearer points hide the rest.
        near &= distances < 1.02 * np.min(distances[near], initial=np.inf)
        if np.sum(near) > 2:
            plane = np.column_stack([np.ones(near.sum()), seen[near] - place])
            found[at] = np.linalg.lstsq(plane, distances[near])[0][0]
    return found


def cloud_in_base(
    calibration: CalibrationContent,
    points_cam: FloatArray,
    base_from_flange: Pose | None = None,
    *,
    joints_rad: FloatArray | None = None,
) -> FloatArray:
    """Points of a camera's cloud in the base, with corrected distances.

    Args:
        calibration: The camera's.
        points_cam: (..., 3) in the frame of the camera, or of that which measures depth beside it;
            NaN where there are none [m].
        base_from_flange: As in `locate`.
        joints_rad: As in `locate`.

    Returns:
        (..., 3) [m].
    """
    eye = CalibratedCamera.of(calibration)
    pose, model = eye.at(base_from_flange, joints_rad).base_from_cam, eye.lens.depth
    if model is not None:
        by = eye.camera if model.by is None else model.by.camera
        points_cam = model.corrected(points_cam.reshape(-1, 3), by)[0].reshape(points_cam.shape)
        pose = pose @ model.cam_from_depth
    return np.asarray(points_cam @ pose[:3, :3].T + pose[:3, 3])


def _rays(eye: CalibratedCamera, px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 2) checked pixels, and (n, 3) their rays of unit depth; raises DataError."""
    px = np.atleast_2d(np.asarray(px, dtype=float))
    if px.shape[1:] != (2,):
        raise DataError(f"locate: pixels have the shape {px.shape}, but must have (n, 2).")
    size = np.array(eye.camera.resolution)
    inside = np.all((px >= -0.5) & (px <= size - 0.5), axis=1)
    # Points at unit depth.
    unit = normalise(
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
        if not np.isfinite(unit[at]).all():
            raise DataError(
                f"locate: the lens's distortion cannot be inverted at pixel ({u:.1f}, {v:.1f}).",
                culprits=[f"pixel {at}"],
                next_step="Calibrate with corners up to the image's edge.",
            )
    return px, np.column_stack([unit, np.ones(len(px))])


def _depth(cam_pose: CameraPose, plane: Plane, ray: FloatArray, label: str) -> float:
    """Depth at which a ray meets the plane [m]."""
    along = cam_pose.base_from_cam[:3, :3] @ ray
    rise = float(plane.normal @ along)
    gap = plane.offset_m - float(plane.normal @ cam_pose.base_from_cam[:3, 3])
    if abs(rise) < 1e-6 * np.linalg.norm(along):
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
    eye: CalibratedCamera,
    cam_pose: CameraPose,
    plane: Plane,
    ray: FloatArray,
    px: FloatArray,
    noise_px: float,
) -> Located:
    """Intersects a pixel's ray with the plane, and propagates the covariance of both."""
    label = f"pixel ({px[0]:.1f}, {px[1]:.1f})"
    depth = _depth(cam_pose, plane, ray, label)
    # The first ray is for the mean distance; a lens that breathes has another one at this depth.
    ray = np.append(normalise(eye.camera, eye.lens.in_model(px[None], depth))[0], 1.0)
    depth = _depth(cam_pose, plane, ray, label)
    along = cam_pose.base_from_cam[:3, :3] @ ray
    rise = float(plane.normal @ along)
    point_cam = depth * ray
    p_base = cam_pose.point(point_cam)
    # Projection along the ray onto the plane, where the point stays.
    projection = np.eye(3) - np.outer(along, plane.normal) / rise
    by_plane = np.outer(along / rise, np.append(-p_base, 1.0))
    parts = {
        "plane": through(by_plane, plane.covariance),
        **_ray_parts(eye, cam_pose, px, point_cam, noise_px, projection),
    }
    return _located(eye, p_base, parts, _distance_warning(eye, point_cam))


_LOOK_AT_PLANE = (
    "Check the plane (in the base; --plane is in mm) and the robot's pose (base_from_flange, no "
    "inverse)."
)


def _ray_parts(
    eye: CalibratedCamera,
    cam_pose: CameraPose,
    px: FloatArray,
    point_cam: FloatArray,
    noise_px: float,
    projection: FloatArray | None = None,
    depth: tuple[FloatArray, FloatArray, FloatArray] | None = None,
) -> dict[str, FloatArray]:
    """Covariance parts of a point on the ray of a pixel (2,), by all but its distance.

    `projection` (3, 3) is that of its errors in the base, onto where the point stays; `depth` is
    as in `_camera_parts`.
    """
    onto = np.eye(3) if projection is None else projection
    (by_px,), (by_lens,) = eye.lens.rays_by_lens(px[None], point_cam[None], float(point_cam[2]))
    by_cam = onto @ cam_pose.base_from_cam[:3, :3]
    by_focus = eye.jitter * by_cam @ by_px @ (px - eye.camera.matrix[2:])
    by_camera = onto @ cam_pose.camera_jacobian(point_cam)
    return {
        "pixels": through(noise_px * by_cam @ by_px, np.eye(2)),
        "focus": np.outer(by_focus, by_focus),
        **_camera_parts(eye, cam_pose, by_camera, by_cam @ by_lens, depth),
    }


def _camera_parts(
    eye: CalibratedCamera,
    cam_pose: CameraPose,
    by_camera: FloatArray,
    by_lens: FloatArray,
    depth: tuple[FloatArray, FloatArray, FloatArray] | None = None,
) -> dict[str, FloatArray]:
    """Covariance parts of calibration, robot and arm from the Jacobians of a position (3, 3).

    `depth` has the Jacobian by the values of its model, their covariance, and that with the camera.
    """
    flange_jacobian = by_camera @ cam_pose.flange_jacobian
    by_arm = flange_jacobian @ cam_pose.arm_basis
    # The errors of a calibrated arm are correlated with the camera's transform.
    independent = slice(0, eye.posture_error_count)
    calibrated = by_arm.copy()
    calibrated[:, independent] = 0.0
    by_calibration = np.concatenate([by_camera, by_lens, calibrated], axis=1)
    covariance = eye.shared_covariance
    if depth is not None:
        by_depth, depth_covariance, cross = depth
        by_calibration = np.concatenate([by_calibration, by_depth], axis=1)
        cross = np.pad(cross, ((0, 0), (0, len(covariance) - cross.shape[1])))
        covariance = np.block([[covariance, cross.T], [cross, depth_covariance]])
    return {
        "calibration": through(by_calibration, covariance),
        "robot": through(flange_jacobian, cam_pose.flange_noise),
        "arm": through(by_arm[:, independent], np.eye(eye.posture_error_count)),
    }


def _located(
    eye: CalibratedCamera, p_base: FloatArray, parts: dict[str, FloatArray], warnings: Sequence[str]
) -> Located:
    """Builds the result without the sources of zero variance, and warns of a large sigma."""
    nonzero = {name: part for name, part in parts.items() if np.trace(part) > 0.0}
    nonzero = nonzero or {"pixels": np.zeros((3, 3))}
    # Effective degrees of freedom of the summed covariance (Satterthwaite 1946). Only parts by the
    # robot's noise estimate have finite ones: the pixel noise comes from thousands of corners, and
    # plane and target are declared.
    traces = {name: float(np.trace(part)) for name, part in nonzero.items()}
    estimated = sum(traces[name] for name in _ESTIMATED & traces.keys())
    freedom = eye.noise_dof * (sum(traces.values()) / estimated) ** 2 if estimated > 0.0 else np.inf
    located = Located(p_base, nonzero, freedom, (*eye.warnings, *warnings))
    worst_m = float(np.sqrt(max(np.linalg.eigvalsh(located.covariance)[-1], 0.0)))
    if worst_m <= SIGMA_LIMIT_M:
        return located
    warning = (
        f"The place is known to {figure(1e3 * worst_m)} mm only in its worst direction (limit "
        f"{1e3 * SIGMA_LIMIT_M:g}), mostly because of the {_SOURCES[located.largest]}."
    )
    return replace(located, warnings=(*located.warnings, warning))


def _distance_warning(eye: CalibratedCamera, point_cam: FloatArray) -> tuple[str, ...]:
    """Warns of a point far nearer or farther than anything that the calibration's views showed."""
    distance_m = float(np.linalg.norm(point_cam))
    if eye.distances_m is None:
        return ()
    least_m, most_m = eye.distances_m.tolist()
    if least_m / _BEYOND <= distance_m <= _BEYOND * most_m:
        return ()
    return (
        f"The place is {distance_m:.2f} m from the camera, and the calibration's views looked from "
        f"{least_m:.2f} to {most_m:.2f} m: its sigma goes by the lens's model there, which nothing "
        "has checked. Calibrate with views at this distance.",
    )


# Parts that scale with the robot's estimated noise.
_ESTIMATED = {"calibration", "robot", "arm"}

_SOURCES = {
    "pixels": "pixel's noise: look from nearer, or less along the plane",
    "focus": "focal length, which changes from view to view: fix the focus",
    "depth": "sensor's noise of depth: look from nearer",
    "plane": "plane's own uncertainty",
    "calibration": "hand-eye calibration",
    "robot": "robot's noise",
    "arm": "arm's errors, which a kinematic calibration would take out",
    "target": "target's uncertain size",
}


@typed
def locate_target(
    calibration: CalibrationContent,
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
    """Position in the base of a point of a target in an image.

    A print by which the camera was calibrated has the size and shape that the calibration found.
    The uncertainty of the target's size is its `square_sigma_m`, taken as independent of the
    calibration: for the board of the calibration, a part of it is counted twice.

    Args:
        calibration: The camera's.
        seen: The target's corners, or the (h, w) grey image to find them in.
        target: The target, or its name or file as `load_target` takes it.
        base_from_flange: The flange's pose at the image as reported; only for a camera on the
            flange.
        point_target_m: (3,) the point in the target's frame [m].
        joints_rad: (n,) joints [rad] where the pose is the calibrated arm's for these joints.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.
        label: The image's name in messages.
        camera: Name of the camera in a whole cell's calibration.
        robot: Name of the robot in whose base, likewise.

    Raises:
        DataError: There is no camera or no pose of the robot, or the image does not show the
            target.
    """
    # A pixel waits for no search of images.
    from visioncal.frames.target_in_image import target_pose_candidates

    eye = CalibratedCamera.of(selected(calibration, Choice(camera, robot), EYE))
    cam_pose = eye.at(base_from_flange, joints_rad)
    board = target if isinstance(target, Target) else load_target(target)
    view = target_pose_candidates(eye, seen, board, label, sigma_px)
    point = checked_point(point_target_m)
    candidates_cam = view.cam_from_target[:, :3, :3] @ point + view.cam_from_target[:, :3, 3]
    pose, point_cam = view.cam_from_target[0], candidates_cam[0]
    by_cam = cam_pose.base_from_cam[:3, :3] @ point_jacobian(pose, point)
    parts = {
        "pixels": through(by_cam, view.covariance[0]),
        "target": through((by_cam @ view.by_scale[0])[:, None], np.array([[view.scale_sigma**2]])),
        **_camera_parts(
            eye, cam_pose, cam_pose.camera_jacobian(point_cam), by_cam @ view.by_lens[0]
        ),
    }
    warnings = (*view.warnings, *_distance_warning(eye, point_cam))
    located = _located(eye, cam_pose.point(point_cam), parts, warnings)
    # Another pose may fit the image as well and move the point.
    away_mm = 1e3 * float(np.linalg.norm(candidates_cam - point_cam, axis=1).max())
    if away_mm <= located.radius95_mm:
        return located
    why = (
        "The board looks the same when it is turned"
        if len(set(view.symmetries)) > 1
        else "Seen so flat, the target may as well be tilted the other way"
    )
    warning = (
        f"{why}: the point would lie {figure(away_mm)} mm away then. Look from another side, from "
        "nearer, or at a board without symmetry."
    )
    return replace(located, warnings=(*located.warnings, warning))

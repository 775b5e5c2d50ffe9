"""Detection of wrong points of a rig: exchanged numbers, wrong coordinates in its table.

A pose by most of a view's points (Fischler and Bolles 1981) shows where the others are. A point
that many views place consistently, but not where the table has it, is wrong in the table or
numbered wrongly.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.core.number_format import figure
from visioncal.core.transforms import skew
from visioncal.core.types import Camera, FloatArray, IntArray, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.poses import determines_pose
from visioncal.vision.camera import normalise
from visioncal.vision.targets import first_corners

T = TypeVar("T", bound=Observed)

# Fewest points of a view for a majority; the share of them that must agree, and the fewest: a pose
# takes four, and a fifth verifies it.
_FEWEST, _MOST_AGREE, _LEAST_AGREE = 6, 0.6, 5
# Fewest views of a point, and the share of these in which it must be an outlier.
_VIEWS, _SHARE = 3, 0.8
# Outlier points deviate by more than this [px], and this many times the others' median: tables that
# were measured by hand deviate by a pixel, and a slightly wrong lens as well. A wrong point also
# differs from its table by this many stated sigmas.
_OUTLIER_PX, _TIMES = 3.0, 8.0
_SIGMAS = 6.0
_TRIALS, _SURE = 300, 0.9999
# A point is where another is drawn within this share of its shift.
_NEAR = 0.1


class _Ray(NamedTuple):
    """One point in one view."""

    ray: FloatArray  # (3,) in the camera, z = 1.
    cam_from_rig: FloatArray  # (4, 4) the pose that most points of the view agree on.
    is_outlier: bool
    focal_px: float  # Pixels per unit of x and y of a ray.


def leave_out_wrong_points(observed: T) -> T:
    """Reports and removes points of rigs that are not where their tables have them."""
    boards = observed.session.boards
    firsts = first_corners(tuple(boards.values())).tolist()
    for first, (name, target) in zip(firsts, boards.items(), strict=True):
        positions = _wrong_points(observed, target, first) if target.is_rig else {}
        if not positions:
            continue
        label = name if len(boards) > 1 else target.name
        observed = observed.noting((), (_finding(target, positions, label),))
        wrong = np.array([first + point for point in positions])
        for frame, look in observed.cameras.items():
            kept = {
                view: view_corners.take(~np.isin(view_corners.ids, wrong))
                for view, view_corners in look.corners.items()
            }
            observed = observed.with_camera(frame, replace(look, corners=kept))
    return observed


def _wrong_points(observed: Observed, target: Target, first: int) -> dict[int, FloatArray]:
    """Measured positions of wrong points in the rig's frame [m], by index in the table."""
    table, sigmas_m = np.array(target.points_m), target.point_sigmas_m
    rays: dict[int, list[_Ray]] = defaultdict(list)
    for look in observed.cameras.values():
        for view, corners in look.corners.items():
            of_rig = (corners.ids >= first) & (corners.ids < first + len(table))
            unused = view in observed.reasons or view in observed.held_back
            if look.lens is not None and not unused and of_rig.any():
                indices = corners.ids[of_rig] - first
                found = _rays(indices, corners.px[of_rig], table, look.lens.camera)
                for point, ray in found:
                    rays[point].append(ray)
    positions = {}
    for point, seen in sorted(rays.items()):
        if len(seen) < _VIEWS or np.mean([ray.is_outlier for ray in seen]) < _SHARE:
            continue
        normals = [skew(ray.ray)[:2] for ray in seen]
        poses = [ray.cam_from_rig for ray in seen]
        pairs = list(zip(normals, poses, strict=True))
        factors = np.concatenate([normal @ pose[:3, :3] for normal, pose in pairs])
        values = np.concatenate([-normal @ pose[:3, 3] for normal, pose in pairs])
        position = np.linalg.lstsq(factors, values, rcond=None)[0]
        in_camera = [pose[:3, :3] @ position + pose[:3, 3] for pose in poses]
        left_px = [
            ray.focal_px * np.linalg.norm(place[:2] / place[2] - ray.ray[:2])
            for ray, place in zip(seen, in_camera, strict=True)
        ]
        shift_m = float(np.linalg.norm(position - table[point]))
        least_m = _SIGMAS * (sigmas_m[point] if sigmas_m else 0.0)
        if np.median(left_px) < _OUTLIER_PX and shift_m > least_m:
            positions[point] = position
    # With more points elsewhere than not, it is unknown which are wrong.
    return positions if len(positions) <= (1.0 - _MOST_AGREE) * len(rays) else {}


def _rays(
    indices: IntArray, px: FloatArray, table: FloatArray, camera: Camera
) -> Iterator[tuple[int, _Ray]]:
    """A view's points by the pose that most of them agree on; none without one."""
    plane = normalise(camera, px)
    usable = np.isfinite(plane).all(axis=1)
    indices, plane = indices[usable], plane[usable]
    points = table[indices]
    if len(indices) < _FEWEST or not determines_pose(points):
        return
    focal = float(np.mean(camera.matrix[:2]))
    is_solved, turn, shift, agreeing = cv2.solvePnPRansac(
        points, plane, np.eye(3), None, None, None, False, _TRIALS, _OUTLIER_PX / focal, _SURE,
        flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    least = max(_LEAST_AGREE, int(np.ceil(_MOST_AGREE * len(indices))))
    if not is_solved or agreeing is None or len(agreeing) < least:
        return
    inliers = np.isin(np.arange(len(indices)), agreeing)
    if not determines_pose(points[inliers]):
        return
    for _ in range(2):
        turn, shift = cv2.solvePnPRefineLM(
            points[inliers], plane[inliers], np.eye(3), None, turn, shift
        )
        predicted = cv2.projectPoints(points, turn, shift, np.eye(3), None)[0][:, 0]
        residuals_px = focal * np.linalg.norm(predicted - plane, axis=1)
        limit = max(_OUTLIER_PX, _TIMES * float(np.median(residuals_px[inliers])))
        inliers = np.asarray(residuals_px < limit)
        if np.sum(inliers) < least:
            return
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    for point, ray, is_inlier in zip(indices.tolist(), plane, inliers.tolist(), strict=True):
        yield point, _Ray(np.append(ray, 1.0), pose, not is_inlier, focal)


def _finding(target: Target, positions: dict[int, FloatArray], name: str) -> Finding:
    """Reports the wrong points, and where they are."""
    table, labels = np.array(target.points_m), [str(number) for number in target.point_numbers]
    listing = []
    for point, position in positions.items():
        shift_m = float(np.linalg.norm(position - table[point]))
        away_m = np.linalg.norm(table - position, axis=1)
        nearest = int(np.argmin(away_m))
        if nearest != point and away_m[nearest] < _NEAR * shift_m:
            listing.append(f"{labels[point]} is where it has {labels[nearest]}")
        else:
            at_mm = ", ".join(f"{1e3 * value:.1f}" for value in position)
            listing.append(f"{labels[point]} by {figure(1e3 * shift_m)} mm, at ({at_mm}) mm")
    return Finding(
        "rig_points",
        f"Target {name}: points are elsewhere than its table has them: {', '.join(listing)}, by "
        "the views' other points. They were left out.",
        Remedy("Correct their numbers, or measure them again and correct the table.", CALIBRATE),
    )

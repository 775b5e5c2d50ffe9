"""Detection of wrong points of a rig: exchanged numbers, wrong coordinates in its table.

A pose by most of a view's points (Fischler and Bolles 1981) shows where the others are. A point
that many views place consistently, but not where the table has it, is wrong in the table or
numbered wrongly.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.core.number_format import figure
from visioncal.core.transforms import skew
from visioncal.core.types import Camera, FloatArray, IntArray, Mask, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.numbering import find_numbering
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


@dataclass(frozen=True, eq=False)
class _RigView:
    """One view of a rig, with the pose that most of its points agree on.

    Attributes:
        at: (n,) indices of the seen points in the table.
        rays: (n, 3) rays in the camera, z = 1.
        cam_from_target: (4, 4).
        agrees: (n,) inlier points.
        focal_px: Focal length: pixels per unit of x and y of a ray.
    """

    indices: IntArray
    rays: FloatArray
    cam_from_target: FloatArray
    inliers: Mask
    focal_px: float


def leave_out_wrong_points(observed: T) -> T:
    """Reports and removes points of rigs that are not where their tables have them."""
    targets = tuple(observed.session.boards.values())
    for first, (name, target) in zip(
        first_corners(targets).tolist(), observed.session.boards.items(), strict=True
    ):
        if not target.is_rig:
            continue
        positions = _wrong_points(observed, target, first)
        if not positions:
            continue
        label = name if len(targets) > 1 else target.name
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
    table = np.array(target.points_m)
    rig_views: list[_RigView] = []
    for look in observed.cameras.values():
        if look.lens is None:
            continue
        for view, corners in look.corners.items():
            of_rig = (corners.ids >= first) & (corners.ids < first + len(table))
            if view not in observed.reasons and view not in observed.held_back and of_rig.any():
                indices = corners.ids[of_rig] - first
                rig_views += _rig_views(indices, corners.px[of_rig], table, look.lens.camera)
    return _consistent_positions(rig_views, table, target.point_sigmas_m)


def _consistent_positions(
    rig_views: Sequence[_RigView], table: FloatArray, sigmas_m: Sequence[float]
) -> dict[int, FloatArray]:
    """Positions that most views agree on and that differ from the table."""
    by_point: dict[int, list[tuple[_RigView, int]]] = defaultdict(list)
    for rig_view in rig_views:
        for row, point in enumerate(rig_view.indices.tolist()):
            by_point[point].append((rig_view, row))
    positions = {}
    for point, rows in sorted(by_point.items()):
        is_outlier = [not rig_view.inliers[row] for rig_view, row in rows]
        if len(rows) < _VIEWS or np.mean(is_outlier) < _SHARE:
            continue
        position, left_px = _triangulated(rows)
        shift_m = float(np.linalg.norm(position - table[point]))
        if left_px < _OUTLIER_PX and shift_m > _SIGMAS * (sigmas_m[point] if sigmas_m else 0.0):
            positions[point] = position
    # With more points elsewhere than not, it is unknown which are wrong.
    return positions if len(positions) <= (1.0 - _MOST_AGREE) * len(by_point) else {}


def _rig_views(
    indices: IntArray, px: FloatArray, table: FloatArray, camera: Camera
) -> Iterator[_RigView]:
    """The view with the pose that most of its points agree on; empty without one."""
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
    inliers = np.zeros(len(indices), dtype=bool)
    inliers[agreeing.ravel()] = True
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
    yield _RigView(indices, np.column_stack([plane, np.ones(len(indices))]), pose, inliers, focal)


def _triangulated(rows: Sequence[tuple[_RigView, int]]) -> tuple[FloatArray, float]:
    """Intersection of a point's rays in the rig's frame [m], and the median residual [px]."""
    factors, values = [], []
    for rig_view, row in rows:
        normals = skew(rig_view.rays[row])[:2]
        factors.append(normals @ rig_view.cam_from_target[:3, :3])
        values.append(-normals @ rig_view.cam_from_target[:3, 3])
    position = np.linalg.lstsq(np.concatenate(factors), np.concatenate(values), rcond=None)[0]
    residuals = []
    for rig_view, row in rows:
        point = rig_view.cam_from_target[:3, :3] @ position + rig_view.cam_from_target[:3, 3]
        difference = point[:2] / point[2] - rig_view.rays[row, :2]
        residuals.append(rig_view.focal_px * np.linalg.norm(difference))
    return position, float(np.median(residuals))


def _finding(target: Target, positions: Mapping[int, FloatArray], name: str) -> Finding:
    """Reports the wrong points, and the correction."""
    table, labels = np.array(target.points_m), [str(number) for number in target.point_numbers]
    measured = table.copy()
    for point, position in positions.items():
        measured[point] = position
    numbering = find_numbering(measured, table)
    reordered = set(numbering.moved.tolist()) if numbering.is_wrong else set()
    reordered = reordered if reordered <= set(positions) else set()
    parts, steps = [], []
    if reordered:
        parts.append(f"the numbers of points are not those of its table: {numbering.words(labels)}")
        steps.append("correct the numbers of these points in corners.csv or in the rig's table")
    others = [point for point in positions if point not in reordered]
    if others:
        listing = ", ".join(
            f"{labels[other]} by "
            f"{figure(1e3 * float(np.linalg.norm(positions[other] - table[other])))} mm, at "
            f"({', '.join(f'{1e3 * x:.1f}' for x in positions[other])}) mm"
            for other in others
        )
        parts.append(f"points are elsewhere than its table has them: {listing}")
        steps.append("measure these points again, and correct the rig's table")
    words = f"target {name}: {'; '.join(parts)}, by the views' other points. They were left out."
    step = " and ".join(steps)
    remedy = Remedy(f"{step[0].upper()}{step[1:]}.", CALIBRATE)
    return Finding("rig_points", words[0].upper() + words[1:], remedy)

"""Detection of wrong points of a rig: exchanged numbers, wrong coordinates in its table.

A pose by most of a view's points (Fischler and Bolles 1981) shows where the others are. A point
that most of its views see elsewhere is wrong in the table or numbered wrongly.
"""

from collections import defaultdict
from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np

from visioncal.calibration.stages.observed import Observed
from visioncal.core.number_format import some_of
from visioncal.core.types import Camera, FloatArray, Mask, Target
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.poses import determines_pose
from visioncal.vision.camera import normalise
from visioncal.vision.targets import first_corners

T = TypeVar("T", bound=Observed)

# Fewest points of a view for a majority, and the share of them that must agree.
_FEWEST, _MOST_AGREE = 8, 0.6
# Fewest views of a point, and the share of these in which it must be an outlier.
_VIEWS, _SHARE = 3, 0.8
# Outlier points deviate by more than this [px]: tables that were measured by hand, and a slightly
# wrong lens, deviate by a pixel.
_OUTLIER_PX = 3.0


def leave_out_wrong_points(observed: T) -> T:
    """Reports and removes points of rigs that are not where their tables have them."""
    boards = observed.session.boards
    firsts = first_corners(tuple(boards.values())).tolist()
    for first, (name, target) in zip(firsts, boards.items(), strict=True):
        wrong = _wrong_points(observed, target, first) if target.is_rig else []
        if not wrong:
            continue
        label = name if len(boards) > 1 else target.name
        listing = some_of([str(target.point_numbers[point]) for point in wrong])
        words = (
            f"Target {label}: points are elsewhere than its table has them: {listing}, by the "
            "views' other points. They were left out."
        )
        remedy = "Correct their numbers, or measure them again and correct the table."
        found = Finding("rig_points", words, Remedy(remedy, CALIBRATE))
        observed = observed.noting((), (found,))
        for frame, look in observed.cameras.items():
            kept = {
                view: view_corners.take(~np.isin(view_corners.ids - first, wrong))
                for view, view_corners in look.corners.items()
            }
            observed = observed.with_camera(frame, replace(look, corners=kept))
    return observed


def _wrong_points(observed: Observed, target: Target, first: int) -> list[int]:
    """Indices in the table of the points that most of their views see elsewhere."""
    table = np.array(target.points_m)
    outlying: dict[int, list[bool]] = defaultdict(list)
    for look in observed.cameras.values():
        for view, corners in look.corners.items():
            of_rig = (corners.ids >= first) & (corners.ids < first + len(table))
            if look.lens is None or view in observed.reasons or view in observed.held_back:
                continue
            at = corners.ids[of_rig] - first
            outliers = _outliers(table[at], corners.px[of_rig], look.lens.camera)
            for point, is_outlier in zip(at.tolist(), outliers.tolist(), strict=False):
                outlying[point].append(is_outlier)
    wrong = [
        point
        for point, seen in sorted(outlying.items())
        if len(seen) >= _VIEWS and np.mean(seen) >= _SHARE
    ]
    # With more points elsewhere than not, it is unknown which are wrong.
    return wrong if len(wrong) <= (1.0 - _MOST_AGREE) * len(outlying) else []


def _outliers(points: FloatArray, px: FloatArray, camera: Camera) -> Mask:
    """(n,) points of a view off the pose that most of them agree on; (0,) without such a pose."""
    unknown, plane = np.zeros(0, dtype=bool), normalise(camera, px)
    if len(points) < _FEWEST or not np.isfinite(plane).all() or not determines_pose(points):
        return unknown
    limit = _OUTLIER_PX / float(np.mean(camera.matrix[:2]))
    is_solved, _, _, agreeing = cv2.solvePnPRansac(
        points, plane, np.eye(3), None, reprojectionError=limit, flags=cv2.SOLVEPNP_AP3P
    )
    inliers = np.isin(np.arange(len(points)), agreeing if is_solved else [])
    is_clear = inliers.mean() >= _MOST_AGREE and determines_pose(points[inliers])
    return np.asarray(~inliers) if is_clear else unknown

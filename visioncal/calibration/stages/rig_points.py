"""Points of a rig that are not where its table has them: exchanged numbers, wrong coordinates.

A pose by most of a view's points (Fischler and Bolles 1981) shows the others where they are. What
many views place alike, and elsewhere than the table, is wrong in the table or in the numbers.
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

# Points of a view below which the majority says nothing; what share of them must agree, and how
# many at least: a pose takes four, and one more to be sure of them.
_FEWEST, _MOST_AGREE, _LEAST_AGREE = 6, 0.6, 5
# Views that must show a point, and the share of these that must place it elsewhere.
_VIEWS, _SHARE = 3, 0.8
# A point is elsewhere beyond so many pixels, and so many times what the others deviate by: tables
# that were measured by hand deviate by a pixel, a lens that is not quite right by as much.
_ELSEWHERE_PX, _TIMES = 3.0, 8.0
# ... and beyond so many times the standard deviation that its table states.
_SIGMAS = 6.0
_TRIALS, _SURE = 300, 0.9999


@dataclass(frozen=True, eq=False)
class _RigView:
    """One view of a rig, by the pose that most of its points agree on.

    Attributes:
        at: (n,) which of the rig's points were seen.
        rays: (n, 3) rays in the camera, z = 1.
        cam_from_target: (4, 4).
        agrees: (n,) whether a point is where the pose has it.
        focal_px: Pixels a unit of x and y of a ray.
    """

    at: IntArray
    rays: FloatArray
    cam_from_target: FloatArray
    agrees: Mask
    focal_px: float


def leave_out_wrong_points(seen: T) -> T:
    """Names the points of rigs that are not where their tables have them, and leaves them out."""
    targets = tuple(seen.session.boards.values())
    for first, (name, target) in zip(
        first_corners(targets).tolist(), seen.session.boards.items(), strict=True
    ):
        if target.kind != "points":
            continue
        places = _places_elsewhere(seen, target, first)
        if not places:
            continue
        called = name if len(targets) > 1 else target.name
        seen = seen.noting((), (_said(target, places, called),))
        gone = np.array([first + place for place in places])
        for frame, look in seen.cameras.items():
            kept = {
                view: view_corners.take(~np.isin(view_corners.ids, gone))
                for view, view_corners in look.corners.items()
            }
            seen = seen.with_camera(frame, replace(look, corners=kept))
    return seen


def _places_elsewhere(seen: Observed, target: Target, first: int) -> dict[int, FloatArray]:
    """Where points are in the rig's frame [m], by their places in the table: those elsewhere."""
    table = np.array(target.points_m)
    looks: list[_RigView] = []
    for look in seen.cameras.values():
        if look.lens is None:
            continue
        for view, corners in look.corners.items():
            mine = (corners.ids >= first) & (corners.ids < first + len(table))
            if view not in seen.reasons and view not in seen.held_back and mine.any():
                at = corners.ids[mine] - first
                looks += _looks(at, corners.px[mine], table, look.lens.camera)
    return _agreed(looks, table, target.point_sigmas_m)


def _agreed(
    looks: Sequence[_RigView], table: FloatArray, sigmas_m: Sequence[float]
) -> dict[int, FloatArray]:
    """What most views place alike, and elsewhere than the table."""
    by_point: dict[int, list[tuple[_RigView, int]]] = defaultdict(list)
    for look in looks:
        for row, point in enumerate(look.at.tolist()):
            by_point[point].append((look, row))
    places = {}
    for point, rows in sorted(by_point.items()):
        off = [not look.agrees[row] for look, row in rows]
        if len(rows) < _VIEWS or np.mean(off) < _SHARE:
            continue
        place, left_px = _triangulated(rows)
        moved = float(np.linalg.norm(place - table[point]))
        if left_px < _ELSEWHERE_PX and moved > _SIGMAS * (sigmas_m[point] if sigmas_m else 0.0):
            places[point] = place
    # Where more than the rest is elsewhere, it is not known which are.
    return places if len(places) <= (1.0 - _MOST_AGREE) * len(by_point) else {}


def _looks(at: IntArray, px: FloatArray, table: FloatArray, camera: Camera) -> Iterator[_RigView]:
    """The view by the pose that most of its points agree on; nothing where there is none."""
    plane = normalise(camera, px)
    usable = np.isfinite(plane).all(axis=1)
    at, plane = at[usable], plane[usable]
    points = table[at]
    if len(at) < _FEWEST or not determines_pose(points):
        return
    focal = float(np.mean(camera.matrix[:2]))
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, plane, np.eye(3), None, None, None, False, _TRIALS, _ELSEWHERE_PX / focal, _SURE,
        flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    least = max(_LEAST_AGREE, int(np.ceil(_MOST_AGREE * len(at))))
    if not found or inliers is None or len(inliers) < least:
        return
    agrees = np.zeros(len(at), dtype=bool)
    agrees[inliers.ravel()] = True
    if not determines_pose(points[agrees]):
        return
    for _ in range(2):
        turn, shift = cv2.solvePnPRefineLM(
            points[agrees], plane[agrees], np.eye(3), None, turn, shift
        )
        there = cv2.projectPoints(points, turn, shift, np.eye(3), None)[0][:, 0]
        off_px = focal * np.linalg.norm(there - plane, axis=1)
        limit = max(_ELSEWHERE_PX, _TIMES * float(np.median(off_px[agrees])))
        agrees = np.asarray(off_px < limit)
        if np.sum(agrees) < least:
            return
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    yield _RigView(at, np.column_stack([plane, np.ones(len(at))]), pose, agrees, focal)


def _triangulated(rows: Sequence[tuple[_RigView, int]]) -> tuple[FloatArray, float]:
    """Where the rays of a point meet in the rig's frame [m], and what is left of them [px]."""
    factors, values = [], []
    for look, row in rows:
        across = skew(look.rays[row])[:2]
        factors.append(across @ look.cam_from_target[:3, :3])
        values.append(-across @ look.cam_from_target[:3, 3])
    place = np.linalg.lstsq(np.concatenate(factors), np.concatenate(values), rcond=None)[0]
    left = []
    for look, row in rows:
        there = look.cam_from_target[:3, :3] @ place + look.cam_from_target[:3, 3]
        left.append(look.focal_px * np.linalg.norm(there[:2] / there[2] - look.rays[row, :2]))
    return place, float(np.median(left))


def _said(target: Target, places: Mapping[int, FloatArray], name: str) -> Finding:
    """Says which points are elsewhere, and what would mend it."""
    table, labels = np.array(target.points_m), [str(number) for number in target.point_numbers]
    measured = table.copy()
    for point, place in places.items():
        measured[point] = place
    numbering = find_numbering(measured, table)
    reordered = set(numbering.moved.tolist()) if numbering.is_wrong else set()
    reordered = reordered if reordered <= set(places) else set()
    parts, steps = [], []
    if reordered:
        parts.append(f"the numbers of points are not those of its table: {numbering.words(labels)}")
        steps.append("correct the numbers of these points in corners.csv or in the rig's table")
    others = [place for place in places if place not in reordered]
    if others:
        listing = ", ".join(
            f"{labels[other]} by "
            f"{figure(1e3 * float(np.linalg.norm(places[other] - table[other])))} mm, at "
            f"({', '.join(f'{1e3 * x:.1f}' for x in places[other])}) mm"
            for other in others
        )
        parts.append(f"points are elsewhere than its table has them: {listing}")
        steps.append("measure these points again, and correct the rig's table")
    words = f"target {name}: {'; '.join(parts)}, by the views' other points. They were left out."
    step = " and ".join(steps)
    return Finding(
        "rig_points",
        words[0].upper() + words[1:],
        Remedy(f"{step[0].upper()}{step[1:]}.", CALIBRATE),
    )

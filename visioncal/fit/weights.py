"""How sure corners are: those that disagree with their view, and noise by view.

A view of a flat board is a homography of it, whatever the board's pose is: corners are judged
before any pose is known, and again by the fit, beside the pose that they have by themselves.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from visioncal.core.types import Camera, FloatArray, Mask
from visioncal.fit.linearise import corner_rows, predicted_sightings
from visioncal.fit.pairs import Pair
from visioncal.fit.unknowns import State, Unknowns
from visioncal.model import Cell
from visioncal.vision.camera import normalise
from visioncal.vision.gating import CORNER_FLOOR_PX, CORNER_SIGMAS, VIEW_FLOOR_PX, VIEW_RATIO
from visioncal.vision.targets import corner_positions
from visioncal.vision.viewnoise import weights_by_view

# Wrong corners hide each other from this on, since the fit follows them.
_SUSPECT = 4.0
# Fewest corners among which a wrong one shows.
_FEWEST = 8
# Residuals of exact corners are rounding errors [px].
_EXACT_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Weighed:
    """A cell with the corners that agree within their views, as sure as their weights say."""

    cell: Cell
    sound: Mask  # (n,) sightings of which most corners agree.
    changed: bool  # Whether corners are left out, or weights differ.


@dataclass(frozen=True, eq=False)
class _Judged:
    """The n corners of one sighting, beside what they have in common."""

    agreeing: Mask  # (n,) those that noise explains.
    square: float  # Sum of the squares of their residuals, weighted [px^2].
    freedom: int  # How many of these are not fitted.


def first_weighed(cell: Cell, lenses: Mapping[str, Camera]) -> Weighed:
    """Judges all corners by homographies, under the lenses at a start."""
    judged, planes = {}, on_planes(cell, lenses)
    for at, sighting in enumerate(cell.sightings):
        corners = sighting.corners
        if corners is not None and at in planes:
            straight = planes[at] * lenses[sighting.seer].matrix[:2]
            points = corner_positions(cell.boards[sighting.seen])[corners.ids]
            judged[at] = by_homography(points, straight, corners.weights)
    return _weighed(cell, judged)


def on_planes(cell: Cell, lenses: Mapping[str, Camera]) -> dict[int, FloatArray]:
    """Corners (n, 2) of each image on the plane at unit depth, by row; a camera's all at once."""
    found = dict[int, FloatArray]()
    for camera, lens in lenses.items():
        camera_px = {
            at: sighting.corners.px
            for at, sighting in enumerate(cell.sightings)
            if sighting.seer == camera and sighting.corners is not None
        }
        if camera_px:
            plane = normalise(lens, np.concatenate([*camera_px.values()]))
            ends = np.cumsum([len(px) for px in camera_px.values()])
            found |= zip(camera_px, np.split(plane, ends[:-1]), strict=True)
    return found


def by_homography(points: FloatArray, px: FloatArray, weights: FloatArray | None = None) -> _Judged:
    """Judges the corners of a flat board by a homography (least median of squares, if need be).

    Args:
        points: (n, 3) the corners on the board.
        px: (n, 2) their pixels without distortion; NaN where it cannot be inverted: these agree.
        weights: (n,) of the corners.
    """
    known = np.isfinite(px).all(axis=1)
    agreeing, flat, px = np.ones(len(px), bool), points[known, :2], px[known]
    each = np.ones(len(px)) if weights is None else weights[known]
    if len(px) < _FEWEST or points[:, 2].any():
        return _Judged(agreeing, 0.0, 0)
    inside = np.ones(len(px), bool)
    for method in (0, cv2.LMEDS, 0):
        some = inside if method == 0 else np.ones(len(px), bool)
        found, _ = cv2.findHomography(flat[some], px[some], method)
        if found is None or not found.size:  # Where corners are on a line.
            return _Judged(agreeing, 0.0, 0)
        off = cv2.perspectiveTransform(flat[:, None], found)[:, 0] - px
        lengths = each * np.linalg.norm(off, axis=1)
        if inside.all() and method == 0 and _within(lengths, _SUSPECT).all():
            break
        inside = _within(lengths)
    agreeing[known] = inside
    return _Judged(agreeing, float(np.sum(lengths[inside] ** 2)), 2 * int(inside.sum()) - 8)


def weighed(
    cell: Cell, unknowns: Unknowns, state: State, pairs: tuple[Pair, ...], used: Mask
) -> Weighed:
    """Judges the corners of used sightings at a fit, beside the pose that each has by itself."""
    judged = {}
    for pair in pairs:
        if not pair.corners:
            continue
        seen = predicted_sightings(cell, unknowns, state, pair)
        rows = corner_rows(unknowns, state, pair, seen.poses, pair.twists(seen.by_effects))
        by_pose = np.concatenate([rows.head[:, :, :6], rows.residual[:, :, None]], axis=2)
        each = np.split(by_pose, np.cumsum(pair.counts)[:-1])
        for row, view_rows, corners in zip(pair.rows.tolist(), each, pair.corners, strict=True):
            if used[row]:
                judged[row] = _by_own_pose(view_rows * (corners.stated_px or 1.0))
    return _weighed(cell, judged)


def _by_own_pose(rows: FloatArray) -> _Judged:
    """Judges corners by their (n, 2, 7) rows: derivatives by the pose, and the residual."""
    inside = np.ones(len(rows), bool)
    if len(rows) < _FEWEST:
        return _Judged(inside, 0.0, 0)
    lengths = _beside_pose(rows, inside)
    if not _within(lengths, _SUSPECT).all():
        for _ in range(10):
            # Cauchy's weights find the pose of most: each round divides what a wrong corner pulls.
            far = lengths / (2.0 * max(float(np.median(lengths)), _EXACT_PX))
            lengths = _beside_pose(rows, 1.0 / np.sqrt(1.0 + far**2))
        inside = _within(lengths)
        lengths = _beside_pose(rows, inside)
    return _Judged(inside, float(np.sum(lengths[inside] ** 2)), 2 * int(inside.sum()) - 6)


def _beside_pose(rows: FloatArray, weights: FloatArray | Mask) -> FloatArray:
    """(n,) lengths of residuals beside the pose that fits (n, 2, 7) rows best by weights (n,)."""
    some = (rows * weights[:, None, None]).reshape(-1, 7)
    step = np.linalg.lstsq(some[:, :6], some[:, 6], rcond=None)[0]
    return np.asarray(np.linalg.norm(rows[:, :, 6] - rows[:, :, :6] @ step, axis=1))


def _within(lengths: FloatArray, sigmas: float = CORNER_SIGMAS) -> Mask:
    """(n,) corners of one view whose (n,) residual lengths are those of noise [px]."""
    # The median length of a two-dimensional Gaussian is 1.18 sigma (Rayleigh).
    sigma = float(np.median(lengths)) / np.sqrt(2.0 * np.log(2.0))
    return np.asarray(lengths <= max(sigmas * sigma, CORNER_FLOOR_PX))


def _weighed(cell: Cell, judged: Mapping[int, _Judged]) -> Weighed:
    """Leaves out corners that disagree, and weighs those of each camera by the noise of views."""
    sightings, sound = list(cell.sightings), np.ones(len(cell.sightings), bool)
    changed = False
    for camera in {sightings[row].seer for row in judged}:
        rows = [r for r, at in judged.items() if sightings[r].seer == camera and at.freedom > 0]
        if not rows:
            continue
        squares = np.array([judged[row].square for row in rows])
        freedom = np.array([float(judged[row].freedom) for row in rows])
        sigmas = np.sqrt(2.0 * squares / freedom)
        inside = sigmas <= max(VIEW_RATIO * float(np.median(sigmas)), VIEW_FLOOR_PX)
        sound[np.array(rows)[~inside]] = False
        is_exact = np.median(sigmas) <= _EXACT_PX
        by_view = None if is_exact else weights_by_view(squares[inside], freedom[inside])
        weights = np.ones(len(rows))
        if by_view is not None:
            weights[inside] = by_view
        for row, weight in zip(rows, weights.tolist(), strict=True):
            corners = sightings[row].corners
            if corners is None:
                continue
            kept = corners.take(judged[row].agreeing)
            if weight != 1.0 and kept.stated_px is None:
                kept_weights = 1.0 if kept.weights is None else kept.weights
                kept = replace(kept, weights=kept_weights * np.full(len(kept.ids), weight))
            elif len(kept.ids) == len(corners.ids):
                continue
            changed = True
            sightings[row] = replace(sightings[row], evidence=kept)
    return Weighed(cell.with_sightings(sightings), sound, changed)

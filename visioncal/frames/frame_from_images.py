"""Tool or fixture frame from a session's images, with its verdict."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.calibration.stages.observed import by_reason
from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import ImageFrameLimits
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.types import FloatArray, Progress
from visioncal.core.verdict import AGREEMENT, Finding, Verdict, remarks
from visioncal.estimation.observability import Direction
from visioncal.estimation.placing import worst_of
from visioncal.frames.camera_chain import CalibratedCamera, checked_point
from visioncal.frames.fixture_fit import sigma_findings
from visioncal.frames.naming import PARENTS, FrameKind
from visioncal.frames.session_observations import (
    SessionImages,
    detect_session_target,
    fit_views,
    held_out_views,
    no_usable_image,
    without_label,
)
from visioncal.frames.single_view import Sight, needs_robot
from visioncal.frames.target_in_image import PoseCandidates, target_pose_candidates
from visioncal.frames.target_pose import TargetPose, place_target
from visioncal.results import HELD_BACK, Calibration, Frame, Observation, select_matching
from visioncal.session import Session, View
from visioncal.session.choosing import EYE, Choice

# Key of the detail that identifies the calibration of a frame's camera.
SEEN_BY = "camera_calibrated"
_ORIGIN = (0.0, 0.0, 0.0)
_COUNTED_TWICE = (
    "the sigma holds the camera's own calibration: a pick by the same camera on a plane of this "
    "frame counts it twice"
)
# A target is on the other parent if its scatter exceeds this multiple of the noise, and falls below
# this share of itself against the other parent.
_WILD, _STILL = 10.0, 0.1
# Largest share of unused views without a finding, and the number of reasons listed.
_LOST_SHARE, _LISTED = 0.25, 3
_COMMANDS: dict[FrameKind, str] = {"tool": "tcp", "fixture": "fixture"}


@dataclass(frozen=True, eq=False)
class _PlacedTarget:
    """Estimated pose of a target on a tool or fixture, with its input."""

    kind: FrameKind  # What the target is on.
    shown: SessionImages  # The images.
    seen: TargetPose  # The estimated frame.
    worst: tuple[Direction, Direction]  # Directions of its largest sigmas: offset, rotation.
    views: tuple[View, ...]  # (m,) the views that it was estimated from.
    lost: Mapping[int, str]  # Why other views were not used, by number.


@typed
def seen_frame(
    session: Session,
    calibration: Calibration,
    kind: FrameKind,
    point_target_m: FloatArray | Sequence[float] = _ORIGIN,
    *,
    options: ImageFrameLimits | None = None,
    camera: str | None = None,
    robot: str | None = None,
    target: str | None = None,
    progress: Progress | None = None,
) -> Frame:
    """Estimates a tool's or fixture's frame from images of the target on it.

    The camera's calibration is a part of the frame's covariance. A later pick by the same camera
    counts that part twice, which is on the safe side.

    Args:
        session: The images, of the same camera; its target is the one on the tool or the fixture.
        calibration: The camera's.
        kind: What the target is on.
        point_target_m: (3,) the frame's origin in the target's frame [m], such as the tool's tip;
            its axes are the target's.
        options: Limits of the verdict.
        camera: Name of the camera, where session or calibration is of a whole cell.
        robot: Name of the robot whose base or flange is the parent, likewise.
        target: Name of the session's target, likewise.
        progress: Called during long work.

    Returns:
        `flange_from_tool` or `base_from_fixture`.

    Raises:
        DataError: No image is usable, the target is on another parent, or the session is of another
            camera.
    """
    choice = Choice(camera, robot, target)
    session, calibration = select_matching(session, calibration, choice, EYE, parted=False)
    options = options or ImageFrameLimits()
    point = checked_point(point_target_m, "point_target_m")
    eye, parent = CalibratedCamera.of(calibration), PARENTS[kind]
    shown = detect_session_target(
        session, calibration, parent, among=fit_views(session), progress=progress
    )
    views, looks, lost = _measure(eye, shown)
    lost |= held_out_views(session)
    sights = [sight for sight, view in zip(shown.sights, shown.views, strict=True) if view in views]
    seen = place_target(eye, sights, looks, parent).at(point)
    worst = worst_of(seen.matrix, seen.covariance, kind, parent)
    placed = _PlacedTarget(kind, shown, seen, worst, views, lost)
    _check_parent(eye, placed, sights, looks)
    findings = [
        *(
            replace(remark, is_fatal=remark.words in eye.warnings)
            for remark in remarks(seen.warnings)
        ),
        *sigma_findings(worst, options.sigma_mm, options.sigma_deg, _advice(seen)),
        *view_findings(session, lost),
        *remarks(shown.warnings),
    ]
    return Frame(
        seen.edge,
        True,
        _method(placed, point),
        session.name,
        datetime.now(UTC).isoformat(timespec="seconds"),
        seen.rms_mm,
        _noise_mm(seen),
        tuple(_observations(session, placed)),
        Verdict.by(findings, Finding(AGREEMENT, _praise(placed))),
        _details(placed, point, calibration),
    )


def _measure(
    eye: CalibratedCamera, shown: SessionImages
) -> tuple[tuple[View, ...], list[PoseCandidates], dict[int, str]]:
    """The usable views, their target poses, and why the other views were rejected."""
    views, looks, lost = [], [], dict(shown.lost)
    for sight, view in zip(shown.sights, shown.views, strict=True):
        try:
            looks.append(target_pose_candidates(eye, sight.seen, shown.target, sight.label))
            views.append(view)
        except DataError as error:
            lost[view.number] = without_label(error, sight)
    if not views:
        raise no_usable_image(shown, lost)
    return tuple(views), looks, lost


def _check_parent(
    eye: CalibratedCamera,
    placed: _PlacedTarget,
    sights: Sequence[Sight],
    looks: Sequence[PoseCandidates],
) -> None:
    """Raises an error where the target is fixed to the other parent."""
    other: FrameKind = "fixture" if placed.kind == "tool" else "tool"
    parent, seen = PARENTS[other], placed.seen
    has_poses = all(sight.base_from_flange is not None for sight in sights)
    if seen.scatter < _WILD or (needs_robot(eye, parent) and not has_poses):
        return
    alternative = place_target(eye, sights, looks, parent)
    if alternative.rms_mm < _STILL * seen.rms_mm:
        raise DataError(
            f"session {placed.shown.source!r}: target {placed.shown.target.name} moves by "
            f"{figure(seen.rms_mm)} mm against the {PARENTS[placed.kind]}, and stands still to "
            f"{figure(alternative.rms_mm)} mm against the {parent}: it is on a {other}, not on a "
            f"{placed.kind}.",
            culprits=[placed.shown.source],
            next_step=f"Say visioncal {_COMMANDS[other]} for it.",
        )


def _advice(seen: TargetPose) -> str:
    own, common = (float(np.trace(array[3:, 3:])) for array in (seen.independent, seen.common))
    if own > common:
        return "Take more images, from nearer and from other sides."
    return (
        "Most of it is the same in all images (the camera's calibration, the target's size, the "
        "arm's errors): a better calibration helps, more images do not."
    )


def view_findings(session: Session, lost: Mapping[int, str]) -> Iterator[Finding]:
    """Finding on a session with many unused views."""
    missing = {view: why for view, why in lost.items() if why != HELD_BACK}
    if len(missing) > _LOST_SHARE * len(session.views):
        yield Finding(
            "lost_views",
            f"{len(missing)} of {len(session.views)} views were not used: "
            f"{'; '.join(by_reason(missing)[:_LISTED])}.",
            views=tuple(missing),
        )


def camera_details(calibration: Calibration) -> dict[str, Any]:
    """Details in the record of any frame that a camera has placed."""
    return {SEEN_BY: calibration.created, "note": _COUNTED_TWICE}


def _method(placed: _PlacedTarget, point: FloatArray) -> str:
    count, target = int(placed.seen.inliers.sum()), placed.shown.target
    words = {
        "charuco": "ChArUco board",
        "aprilgrid": "AprilGrid",
        "circles": "grid of circles",
        "points": "rig",
    }
    images = "one image" if count == 1 else f"{count} images"
    note = f"{words.get(target.kind, target.kind)} {target.name} seen in {images}"
    if not point.any():
        return note
    return f"{note}; its point ({', '.join(f'{value:.6g}' for value in 1e3 * point)}) mm"


def _noise_mm(seen: TargetPose) -> float:
    """Noise of one image per axis [mm]: from the scatter, or predicted for a single image."""
    count = int(seen.inliers.sum())
    if count > 1:
        return float(np.sqrt(np.sum(seen.away_mm[seen.inliers] ** 2) / (3 * (count - 1))))
    return float(1e3 * np.sqrt(np.trace(seen.independent[3:, 3:]) / 3))


def _observations(session: Session, placed: _PlacedTarget) -> Iterator[Observation]:
    index_of = {view.number: at for at, view in enumerate(placed.views)}
    for number in (view.number for view in session.views):
        if number not in index_of:
            yield Observation(str(number), used=False, reason=placed.lost[number])
            continue
        at = index_of[number]
        away_mm, agrees = float(placed.seen.away_mm[at]), bool(placed.seen.inliers[at])
        words = mm_and_deg(away_mm, float(placed.seen.away_deg[at]))
        reason = "" if agrees else f"it puts the target {words} from where the others do"
        yield Observation(str(number), agrees, reason, residual_mm=away_mm)


def _praise(placed: _PlacedTarget) -> str:
    seen, worst = placed.seen, placed.worst[0]
    return (
        f"{int(seen.inliers.sum())} images agree to {mm_and_deg(seen.rms_mm, seen.rms_deg)} (rms), "
        f"and {worst.words}, the worst direction, is known to "
        f"{figure(1e3 * worst.sigma)} mm."
    )


def _details(placed: _PlacedTarget, point: FloatArray, calibration: Calibration) -> dict[str, Any]:
    seen = placed.seen
    own = {"point_target_mm": (1e3 * point).tolist()} if point.any() else {}
    return {
        "target": placed.shown.target.name,
        **own,
        "rms_deg": seen.rms_deg,
        "scatter_over_expected": seen.scatter,
        "sigma_by_images_mm": _sigma_mm(seen.independent),
        "sigma_in_common_mm": _sigma_mm(seen.common),
        **camera_details(calibration),
    }


def _sigma_mm(covariance: FloatArray) -> float:
    return float(1e3 * np.sqrt(np.trace(covariance[3:, 3:])))


def depends_on_camera(frame: Frame) -> bool:
    """Whether a frame was placed by a calibrated camera and depends on its calibration."""
    return SEEN_BY in frame.details

"""Tool or fixture frame from a session's images, with its verdict."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.calibration.stages.observed import by_reason
from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import ImageFrameLimits
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.types import FloatArray, Progress
from visioncal.core.verdict import AGREEMENT, Finding, Remedy, Verdict, remarks
from visioncal.frames.camera_chain import CalibratedCamera, checked_point
from visioncal.frames.naming import PARENTS, FrameKind
from visioncal.frames.placing import worst_of
from visioncal.frames.points_frame import sigma_findings
from visioncal.frames.session_observations import (
    detect_session_target,
    no_usable_image,
    without_label,
)
from visioncal.frames.target_in_image import target_pose_candidates
from visioncal.frames.target_pose import TargetPose, needs_robot, place_target
from visioncal.results import HELD_BACK, Calibration, Frame, Observation, select_matching
from visioncal.session import Session, View
from visioncal.session.selecting import EYE, Choice
from visioncal.vision.boards import kind_of

# Key of the detail that identifies the calibration of a frame's camera.
SEEN_BY = "camera_calibrated"
_COUNTED_TWICE = (
    "the sigma holds the camera's own calibration: a pick by the same camera on a plane of this "
    "frame counts it twice"
)
# Scatter of images over the noise from which on they do not belong to their poses.
_WILD = 10.0
_BELONG = Remedy(
    "Look whether images and poses of each row belong together and are read rightly, which doctor "
    "finds; and whether the calibration still holds (visioncal verify).",
    "visioncal doctor SESSION",
)
_COMMANDS: dict[FrameKind, str] = {"tool": "tcp", "fixture": "fixture"}


@typed
def seen_frame(
    session: Session,
    calibration: Calibration,
    kind: FrameKind,
    point_target_m: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
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
        kind: The frame that the target is on.
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
    point = checked_point(point_target_m)
    eye, parent = CalibratedCamera.of(calibration), PARENTS[kind]
    free = [view for view in session.views if not view.holdout]
    shown = detect_session_target(session, calibration, parent, among=free, progress=progress)
    views, sights, looks, lost = [], [], [], dict(shown.lost)
    for sight, view in zip(shown.sights, shown.views, strict=True):
        try:
            looks.append(target_pose_candidates(eye, sight.seen, shown.target, sight.label))
            views.append(view)
            sights.append(sight)
        except DataError as error:
            lost[view.number] = without_label(error, sight)
    if not views:
        raise no_usable_image(shown, lost)
    lost |= {view.number: HELD_BACK for view in session.views if view.holdout}
    seen = place_target(eye, sights, looks, parent).at(point)
    worst = worst_of(seen.matrix, seen.covariance, kind, parent)
    other: FrameKind = "fixture" if kind == "tool" else "tool"
    elsewhere = PARENTS[other]
    has_poses = all(sight.base_from_flange is not None for sight in sights)
    # With so much scatter, the target may be fixed to the other parent, and calm against that.
    if seen.scatter >= _WILD and (has_poses or not needs_robot(eye, elsewhere)):
        alternative = place_target(eye, sights, looks, elsewhere)
        if alternative.rms_mm < 0.1 * seen.rms_mm:
            lying = " A touch test wants an image of a board that lies where the robot works."
            raise DataError(
                f"session {shown.source!r}: target {shown.target.name} moves by "
                f"{figure(seen.rms_mm)} mm against the {parent}, and stands still to "
                f"{figure(alternative.rms_mm)} mm against the {elsewhere}: it is on a {other}, not "
                f"on a {kind}.",
                culprits=[shown.source],
                next_step=f"Run visioncal {_COMMANDS[other]} instead.{lying * (other == 'tool')}",
            )
    independent, common = (
        float(np.trace(array[3:, 3:])) for array in (seen.independent, seen.common)
    )
    advice = (
        "Take more images, from nearer and from other sides."
        if independent > common
        else "Most of it is the same in all images (the camera's calibration, the target's size, "
        "the arm's errors): a better calibration helps, more images do not."
    )
    poor = [*sigma_findings(worst, options.sigma_mm, options.sigma_deg, advice)]
    # Directions that are poorly known follow from images that disagree, and come after these.
    is_bad, step = any(found.is_fatal for found in poor), _BELONG if seen.scatter >= _WILD else None
    findings = [
        *(
            replace(remark, is_fatal=is_bad or remark.words in eye.warnings, do=step)
            for remark in remarks(seen.warnings)
        ),
        *poor,
    ]
    missing = {view: why for view, why in lost.items() if why != HELD_BACK}
    if len(missing) > 0.25 * len(session.views):
        words = f"{len(missing)} of {len(session.views)} views were not used"
        words = f"{words}: {'; '.join(by_reason(missing)[:3])}."
        findings.append(Finding("lost_views", words, views=tuple(missing)))
    findings += remarks(shown.warnings)
    count, board = int(seen.inliers.sum()), shown.target
    images = "one image" if count == 1 else f"{count} images"
    method = f"{kind_of(board).noun} {board.name} seen in {images}"
    details: dict[str, Any] = {"target": board.name}
    if point.any():
        point_mm = 1e3 * point
        method += f"; its point ({', '.join(f'{value:.6g}' for value in point_mm)}) mm"
        details["point_target_mm"] = point_mm.tolist()
    # Noise of one image per axis: from the scatter, or predicted for a single image.
    noise_mm = 1e3 * np.sqrt(independent / 3)
    if count > 1:
        noise_mm = np.sqrt(np.sum(seen.away_mm[seen.inliers] ** 2) / (3 * (count - 1)))
    praise = (
        f"{count} images agree to {mm_and_deg(seen.rms_mm, seen.rms_deg)} (rms), and "
        f"{worst[0].words}, the worst direction, is known to {figure(1e3 * worst[0].sigma)} mm."
    )
    return Frame(
        seen.edge,
        True,
        method,
        session.name,
        datetime.now(UTC).isoformat(timespec="seconds"),
        seen.rms_mm,
        float(noise_mm),
        tuple(_observations(session, views, seen, lost)),
        Verdict.by(findings, Finding(AGREEMENT, praise)),
        details
        | {
            "rms_deg": seen.rms_deg,
            "scatter_over_expected": seen.scatter,
            "sigma_by_images_mm": float(1e3 * np.sqrt(independent)),
            "sigma_in_common_mm": float(1e3 * np.sqrt(common)),
            SEEN_BY: calibration.created,
            "note": _COUNTED_TWICE,
        },
    )


def _observations(
    session: Session, views: Sequence[View], seen: TargetPose, lost: Mapping[int, str]
) -> Iterator[Observation]:
    index_of = {view.number: at for at, view in enumerate(views)}
    for number in (view.number for view in session.views):
        if number not in index_of:
            yield Observation(str(number), used=False, reason=lost[number])
            continue
        at = index_of[number]
        away_mm, agrees = float(seen.away_mm[at]), bool(seen.inliers[at])
        words = mm_and_deg(away_mm, float(seen.away_deg[at]))
        reason = "" if agrees else f"it puts the target {words} from where the others do"
        yield Observation(str(number), agrees, reason, residual_mm=away_mm)


def depends_on_camera(frame: Frame) -> bool:
    """Whether a frame was placed by a calibrated camera and depends on its calibration."""
    return SEEN_BY in frame.details

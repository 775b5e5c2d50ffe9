"""The main path in order: one entry a stage.

A stage is one file in `visioncal.stages`. Its adapter here hands it what it needs of what is known
and adds what it gives.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration import CameraResult, Rms
from visioncal.errors import DataError
from visioncal.estimator.closure import deviations
from visioncal.pipeline.known import Known
from visioncal.robot import Robot
from visioncal.stages.choose import choose_by, choose_poses
from visioncal.stages.detect import detect
from visioncal.stages.handeye import LensUncertainty, robot_part, solve_hand_eye
from visioncal.stages.intrinsics import estimate_intrinsics
from visioncal.stages.judge import Findings, judge
from visioncal.stages.pnp import estimate_poses, given_poses
from visioncal.stages.reported import reported_poses
from visioncal.stages.validate import chain_rms_px, validate
from visioncal.types import FloatArray, Rejection


@dataclass(frozen=True)
class Stage:
    """One step of the way, by the name that progress shows."""

    name: str
    run: Callable[[Known], Known]


def _read_robot(known: Known) -> Known:
    document = known.session.robot_document
    robot = None if document is None else Robot.from_document(document)
    reported = reported_poses(known.session, robot)
    known = replace(known, robot=robot, base_from_flange=reported.base_from_flange)
    return known.noting(reported.rejections, [*known.session.warnings, *reported.warnings])


def _detect(known: Known) -> Known:
    if not any(view.image for view in known.session.views):
        return known
    found = detect(known.session, progress=known.progress)
    known = replace(known, corners=found.corners, resolution=found.resolution)
    return known.noting(found.rejections)


def _intrinsics(known: Known) -> Known:
    session, target = known.session, known.session.target
    if not known.corners or target is None or known.resolution is None:
        return known
    if session.camera is not None:
        held = (
            ['intrinsics = "refine" is not available yet: the given intrinsics were held.']
            if session.intrinsics_mode == "refine"
            else []
        )
        camera = CameraResult(session.camera, estimated=False)
        return replace(known, camera=camera).noting([], held)
    fitted = {view: it for view, it in known.corners.items() if view not in known.held_back}
    result = estimate_intrinsics(fitted, target, known.resolution, session.camera_model)
    camera = CameraResult(result.camera, estimated=True, covariance=result.covariance)
    return replace(known, camera=camera).noting(result.rejections, result.warnings)


def _pnp(known: Known) -> Known:
    target, poses = known.session.target, given_poses(known.session)
    corners = {view: it for view, it in known.corners.items() if view not in known.reasons}
    if corners and target is not None and known.camera is not None:
        result = estimate_poses(corners, target, known.camera.camera)
        seen = {view.view: view for view in result.views}
        known = replace(known, pixel_px=result.sigma_px).noting(result.rejections)
        poses = poses | seen
    elif not poses:
        raise _nothing_seen(known)
    return replace(known, poses=poses)


def _nothing_seen(known: Known) -> DataError:
    """Groups the views by their reason, most frequent first."""
    views = defaultdict(list)
    for view, reason in known.reasons.items():
        views[reason].append(view)
    grouped = sorted(views.items(), key=lambda item: -len(item[1]))
    return DataError(
        f"session {known.session.name!r}: no view shows the target.",
        culprits=[f"views {', '.join(map(str, it))}: {reason}" for reason, it in grouped],
        next_step="Look at an image: is the board in it, and is it the one that the session "
        "declares?",
    )


def _choose(known: Known) -> Known:
    views = [
        view.number
        for view in known.session.views
        if view.number in known.poses
        and view.number in known.base_from_flange
        and view.number not in known.held_back
    ]
    choice = choose_poses(
        [known.poses[view] for view in views], _robot(known, views), known.session.target
    )
    poses = {**known.poses, **{view.view: view for view in choice.views}}
    used = tuple(view.view for view in choice.views)
    return replace(known, poses=poses, used=used).noting(choice.rejections)


def _hand_eye(known: Known) -> Known:
    lens = None
    if known.camera is not None and known.camera.covariance is not None:
        shift = np.array([known.poses[view].by_intrinsics[0] for view in known.used])
        lens = LensUncertainty(known.camera.covariance, shift) if len(shift) else None
    result = solve_hand_eye(known.closure(known.used), known.session.mount, known.solver, lens)
    poses = dict(known.poses)
    for view in known.held_back & poses.keys() & known.base_from_flange.keys():
        robot = _robot(known, [view])[0]
        poses[view] = choose_by(poses[view], robot, result.x, result.z, known.session.target)
    return replace(known, hand_eye=result, poses=poses)


def _validate(known: Known) -> Known:
    result, data = known.solved, known.closure(known.used)
    camera = None if known.camera is None else known.camera.camera
    seen = known.seen(known.used)
    away_m, away_rad = deviations(data.placed(result.x))
    rms = rms_of(away_m, away_rad, chain_rms_px(data, result.x, result.z, seen, camera))
    held_out = validate(data, result, known.solver, seen, camera)
    return replace(known, held_out=held_out, rms=rms)


def _judge(known: Known) -> Known:
    held = known.held_out
    if held is None or known.rms is None:
        raise DataError("pipeline: the verdict comes before the validation.")
    findings = Findings(
        used=len(known.used),
        rejections=[Rejection(view, reason) for view, reason in known.reasons.items()],
        hand_eye=known.solved,
        rms=known.rms,
        held_out=rms_of(held.away_m, held.away_rad, held.rms_px),
        pixel_px=known.pixel_px,
        warnings=known.warnings,
    )
    return replace(known, verdict=judge(findings))


STAGES: tuple[Stage, ...] = (
    Stage("robot", _read_robot),
    Stage("detect", _detect),
    Stage("intrinsics", _intrinsics),
    Stage("pnp", _pnp),
    Stage("choose", _choose),
    Stage("hand-eye", _hand_eye),
    Stage("validate", _validate),
    Stage("judge", _judge),
)


def rms_of(away_m: FloatArray, away_rad: FloatArray, rms_px: FloatArray) -> Rms:
    """Root mean squares over views [m, rad, px]; views without corners have NaN pixels."""
    seen = rms_px[np.isfinite(rms_px)]
    return Rms(
        mm=float(1e3 * np.sqrt(np.mean(away_m**2))),
        deg=float(np.rad2deg(np.sqrt(np.mean(away_rad**2)))),
        px=float(np.sqrt(np.mean(seen**2))) if len(seen) else None,
    )


def _robot(known: Known, views: list[int]) -> FloatArray:
    poses = np.array([known.base_from_flange[view] for view in views]).reshape(-1, 4, 4)
    return robot_part(poses, known.session.mount)

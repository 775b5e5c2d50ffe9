"""A session's observations of its target: corners or images with the flange's poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.detect import detect
from visioncal.calibration.stages.observed import by_reason
from visioncal.calibration.stages.reported_poses import RobotReport, reported_poses
from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Progress, Target
from visioncal.frames.camera_chain import CalibratedCamera, checked_point
from visioncal.frames.locate import locate_target
from visioncal.frames.located import Located
from visioncal.frames.target_pose import Parent, Sight, needs_robot
from visioncal.results import HELD_BACK, Calibration, select_matching
from visioncal.results.picking import check_mount, check_resolution
from visioncal.robot import Robot
from visioncal.session import Session, View
from visioncal.session.selecting import EYE, Choice
from visioncal.session.table import loads_of, reported_matrices
from visioncal.verification.prediction import check_robot

_NO_IMAGE = "it has no image"


@dataclass(frozen=True, eq=False)
class SessionImages:
    """Usable images of a session by the calibrated camera."""

    source: str  # The session's name.
    target: Target  # The target to look for.
    sights: tuple[Sight, ...]  # (m,) usable images, labelled `view 3`.
    views: tuple[View, ...]  # (m,) their views.
    lost: Mapping[int, str]  # Why other views are unusable, by view number.
    warnings: tuple[str, ...]  # Warnings on the session, in sentences.


def detect_session_target(
    session: Session,
    calibration: Calibration,
    parent: Parent,
    *,
    among: Sequence[View] | None = None,
    progress: Progress | None = None,
) -> SessionImages:
    """Detects a session's target in its images.

    Args:
        session: Of the same camera as the calibration; it names the target.
        calibration: The camera's.
        parent: The frame to place the target in. Where the robot is between it and the target, each
            view needs the robot's pose.
        among: The views to use; all where None.
        progress: Called after each image.

    Returns:
        The corners and poses of the usable views.

    Raises:
        DataError: No view is usable, or the session is of another camera.
    """
    check_mount(session, calibration)
    if session.robot_document is not None and calibration.robot is not None:
        check_robot(session, Robot.from_document(session.robot_document), calibration.robot)
    if session.mount == "instrument":
        raise DataError(
            f"session {session.name!r} is of an instrument; a camera sees what is located.",
            culprits=[session.name],
            next_step="Name a session with images of it. visioncal verify checks a calibration by "
            "readings of the instrument.",
        )
    if session.target is None:
        raise DataError(
            f"session {session.name!r} names no target to look for.",
            culprits=["session.toml: target"],
            next_step='Add target = "charuco_9x6_30mm", or what the images show.',
        )
    if session.targets:
        names = ", ".join(session.targets)
        raise DataError(
            f"session {session.name!r} has several targets ({names}); one is looked for at a time.",
            culprits=["session.toml: targets"],
            next_step="Make a session with the rows of the one that is meant.",
        )
    target = session.target
    wanted = session.views if among is None else tuple(among)
    lost = {view.number: _NO_IMAGE for view in wanted if not (view.image or view.has_corners)}
    if needs_robot(CalibratedCamera.of(calibration), parent):
        reported = _flange(session, calibration, wanted)
        poses: Mapping[int, FloatArray] = reported.base_from_flange
        lost = {rejection.view: rejection.reason for rejection in reported.rejections} | lost
    else:
        poses = reported_matrices(wanted)
    detected = detect(session, progress=progress, among=_usable(session, wanted, target, lost))
    lost |= {rejection.view: rejection.reason for rejection in detected.rejections}
    check_resolution(session, calibration, detected.resolution)
    views, sights = _usable(session, wanted, target, lost), []
    for view in views:
        pose = poses.get(view.number)
        joints_rad = None if pose is None else calibrated_joints(view, calibration)
        label = f"view {view.number}"
        sights.append(Sight(label, detected.corners[view.number], pose, view.stop, joints_rad))
    lens, stated = calibration.camera, session.camera
    warnings = [*session.warnings]
    if calibration.arm_is_calibrated and any(view.joints_rad is None for view in session.views):
        warnings.append(
            "The calibration is of a calibrated arm, but views come without joint angles: their "
            "poses are the nominal arm's, off by as much as its errors. Record q1_rad ... too."
        )
    if lens is not None and stated is not None:
        difference = np.abs(stated.matrix - lens.camera.matrix).max()
        if difference > 0.03 * lens.camera.matrix[0]:
            fx, _, cx, _ = stated.matrix
            warnings.append(
                f"The session states a lens of fx {fx:.0f} and cx {cx:.0f} px, and the camera was "
                f"calibrated to {lens.camera.matrix[0]:.0f} and {lens.camera.matrix[2]:.0f}: is it "
                "the same camera? The calibrated lens was used."
            )
    return SessionImages(session.name, target, tuple(sights), views, lost, tuple(warnings))


def calibrated_joints(view: View, calibration: Calibration) -> FloatArray | None:
    """(n,) a view's joints [rad] where the arm is calibrated; else None."""
    arm, joints = calibration.calibrated_robot, view.joints_rad
    if arm is None or not calibration.arm_is_calibrated or joints is None:
        return None
    return joints if len(joints) == arm.joint_count else None


def pose_of(session: Session, view: View, calibration: Calibration) -> FloatArray | None:
    """(4, 4) flange pose at a view, from its joints if need be; None where there is neither.

    Raises:
        DataError: The joints are not those of the model.
    """
    return _flange(session, calibration, (view,)).base_from_flange.get(view.number)


def without_label(error: DataError, sight: Sight) -> str:
    """An image's error as the reason why its view is not used."""
    return error.message.removeprefix(f"{sight.label}: ").rstrip(".")


def no_usable_image(shown: SessionImages, lost: Mapping[int, str]) -> DataError:
    """Error that no image is usable."""
    culprits = by_reason(lost)
    return DataError(
        f"session {shown.source!r}: no image shows target {shown.target.name} as it should be.",
        culprits=culprits,
        next_step=f"First: {culprits[0]}.",
    )


def _flange(session: Session, calibration: Calibration, wanted: tuple[View, ...]) -> RobotReport:
    """The flange's poses at some views, by the calibrated arm where there is one."""
    document = session.robot_document
    robot = calibration.robot if document is None else Robot.from_document(document)
    reported = reported_poses(replace(session, views=wanted), robot)
    poses = dict(reported.base_from_flange)
    for view in wanted:
        joints = calibrated_joints(view, calibration)
        if joints is not None:
            loads = loads_of([view.numbers])
            poses[view.number] = calibration.standing(joints[None], loads)[0]
    return replace(reported, base_from_flange=poses)


def _usable(
    session: Session, wanted: Sequence[View], target: Target, lost: Mapping[int, str]
) -> tuple[View, ...]:
    """The views that are not rejected so far; an error where there are none."""
    views = tuple(view for view in wanted if view.number not in lost)
    if views:
        return views
    culprits = by_reason(lost) or (f"all views: {HELD_BACK}",)
    raise DataError(
        f"session {session.name!r}: no view of {len(wanted)} serves to place target {target.name}.",
        culprits=culprits,
        next_step=f"First: {culprits[0]}.",
    )


@dataclass(frozen=True, eq=False)
class Picks:
    """Positions of a point by each view."""

    found: Mapping[int, Located]  # The positions, by view number.
    lost: Mapping[int, str]  # Why other views give none, by view number.
    warnings: tuple[str, ...] = ()  # Warnings on the session, in sentences.


@typed
def locate_views(
    session: Session,
    calibration: Calibration,
    point_target_m: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
    *,
    among: Sequence[View] | None = None,
    sigma_px: float | None = None,
    camera: str | None = None,
    robot: str | None = None,
    target: str | None = None,
    progress: Progress | None = None,
) -> Picks:
    """Positions in the base of a point of the target, by each view of a session alone.

    Errors that the views share, mainly the camera's transform, are in every position and do not
    average out.

    Args:
        session: Of the same camera as the calibration; it names the target.
        calibration: The camera's.
        point_target_m: (3,) the point in the target's frame [m].
        among: The views to use; all where None.
        sigma_px: Noise of a corner's coordinate [px]; the calibration's where None.
        camera: Name of the camera, where session or calibration is of a whole cell.
        robot: Name of the robot in whose base, likewise.
        target: Name of the session's target, likewise.
        progress: Called after each image.

    Raises:
        DataError: No view is usable, or the point is invalid.
    """
    point = checked_point(point_target_m)
    choice = Choice(camera, robot, target)
    session, calibration = select_matching(session, calibration, choice, EYE, parted=False)
    shown = detect_session_target(session, calibration, "base", among=among, progress=progress)
    located: dict[int, Located] = {}
    lost = dict(shown.lost)
    for view, sight in zip(shown.views, shown.sights, strict=True):
        try:
            located[view.number] = locate_target(
                calibration,
                sight.seen,
                shown.target,
                sight.base_from_flange,
                point,
                joints_rad=sight.joints_rad,
                sigma_px=sigma_px,
                label=sight.label,
            )
        except DataError as error:
            lost[view.number] = without_label(error, sight)
    if not located:
        raise no_usable_image(shown, lost)
    return Picks(located, lost, shown.warnings)

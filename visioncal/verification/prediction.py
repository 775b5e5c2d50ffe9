"""Predicts the stops of a session with a calibration's lens, boards and arm."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from reprlib import repr as shorten

import numpy as np

from visioncal.calibration.pipeline.observed_poses import ObservedPoses
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import STAGES
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, listed
from visioncal.core.transforms import invert, log, robot_part
from visioncal.core.types import FloatArray, IntArray, Progress, Rejection, Target
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT, State
from visioncal.results import CameraResult
from visioncal.results.picking import check_mount, check_resolution
from visioncal.robot import Robot
from visioncal.robot.errors import ArmErrors
from visioncal.session import Session
from visioncal.session.kinds import COLUMN
from visioncal.verification.calibration_prior import CalibrationPrior
from visioncal.verification.misreading import misread_joints
from visioncal.vision.corners import CornerStack, reproject
from visioncal.vision.lens_field import depths_m
from visioncal.vision.targets import numbered_positions, target_document

# Next step for readings of an instrument, which are not verified stop by stop.
COMPARED = "Calibrate the new session, and compare both results with visioncal diff."
_STAGES = {stage.name: stage.run for stage in STAGES}


@dataclass(frozen=True, eq=False)
class PredictedStops:
    """The stops of a session with a calibration's lens, boards and arm."""

    # The session's observations, with the calibration's lens, boards and arm.
    observed: ObservedPoses
    problem: Problem  # The m views of a board, with the calibration's unknowns.
    views: tuple[int, ...]  # (m,) their numbers.
    warnings: tuple[str, ...]  # Warnings, in sentences.
    run: RunState  # The stages that observed them.

    @property
    def stops(self) -> int:
        """Number of stops."""
        return len(self.problem.poses[ROBOT])

    @property
    def boards(self) -> IntArray:
        """(m,) index of each observation's board among the calibration's."""
        return np.array(
            [self.problem.unknown[name] - 1 for name in self.problem.observations.observed]
        )

    def away(self, prior: CalibrationPrior) -> FloatArray:
        """(m, 4, 4) change of its board's edge, on the right, by each observation."""
        return board_changes(self.problem, prior.state)


def predict_stops(
    session: Session,
    prior: CalibrationPrior,
    progress: Progress | None = None,
    without: Mapping[int, str] | None = None,
) -> PredictedStops:
    """Observes a session with a calibration's lens, boards and arm; nothing is estimated.

    Args:
        session: A session of the same cell.
        prior: The calibration as a prior.
        progress: Called with the progress of long work.
        without: Why views are to be left out, by view.

    Raises:
        DataError: The session is of another mount, camera, target or robot, lacks joint angles that
            the calibrated arm needs, or shows no target.
    """
    check_mount(session, prior.calibration)
    if session.mount == "instrument":
        raise DataError(
            f"session {session.name!r} has an instrument's readings, and changes are looked for in "
            "what a camera sees.",
            next_step=COMPARED,
        )
    session, calibrated = _with_calibrated_targets(session, prior), prior.calibration.robot
    if calibrated is not None:
        if session.robot_document is not None:
            # A recording by a plan of the calibrated arm names that.
            arm = prior.calibration.calibrated_robot or calibrated
            check_robot(session, Robot.from_document(session.robot_document), calibrated, arm)
        # The calibrated robot has its base in the frame of the poses.
        session = replace(session, robot_document=calibrated.document)
    run = _STAGES["detect"](_STAGES["robot"](RunState(session, progress)))
    rejected = ((key, why) for key, why in (without or {}).items() if key not in run.held_back)
    return predict_detected(run.noting(Rejection(*pair) for pair in rejected), prior)


def predict_detected(run: RunState, prior: CalibrationPrior) -> PredictedStops:
    """Does what `predict_stops` does, once targets have been detected."""
    detected, lens = run.cameras, prior.calibration.camera
    for frame, look in detected.items():
        if lens is not None and look.resolution is not None:
            check_resolution(run.session, prior.calibration, look.resolution)
            plain = CameraResult(lens.camera, estimated=False)
            run = run.with_camera(frame, replace(look.in_model(lens), lens=plain))
    if lens is not None and lens.field is not None and lens.field.breathing != 0.0:
        # Breathing is corrected to the calibration's mean distance, by rough poses.
        positions = numbered_positions(tuple(run.session.boards.values()))
        rough_poses = _STAGES["pnp"](run).poses
        for frame, look in detected.items():
            shown = {view: each for view, each in look.corners.items() if view in rough_poses}
            if shown:
                stack = CornerStack.of(shown, positions)
                poses = np.array([rough_poses[view].cam_from_target[0] for view in stack.views])
                depths = dict(zip(stack.views, depths_m(stack, poses).tolist(), strict=True))
                corrected = look.in_model(lens, depths).corners
                run = run.with_camera(frame, replace(run.cameras[frame], corners=corrected))
    # Of a sweep the slower views are used, where the error of the clock offset is below the
    # robot's.
    run = replace(_STAGES["clock"](_STAGES["pnp"](run)), clocks={})
    # A joint's zero may be what changed; another reading of the angles is a mistake of the record.
    _STAGES["joints"](replace(run, level="hand-eye"))
    observed = _with_poses(_with_arm(run, prior), prior)
    problem, warnings = observed.problem(observed.used), tuple(_warnings(observed, prior))
    return PredictedStops(observed, problem, observed.used, warnings, run)


def board_changes(problem: Problem, state: State) -> FloatArray:
    """(m, 4, 4) change of its board's edge, on the right, that each observation requires."""
    changes, observed = np.zeros((len(problem), 4, 4)), np.array(problem.observations.observed)
    for board in set(problem.observations.observed):
        of_board = observed == board
        changes[of_board] = problem.change_of(board, state)[of_board]
    return changes


def _with_arm(run: RunState, prior: CalibrationPrior) -> ObservedPoses:
    """Takes over the calibration's arm, with its errors as unknowns of known covariance.

    Raises:
        DataError: They are of joints that the session lacks.
    """
    observed = ObservedPoses.of(run)
    observed = replace(observed, calibrated=replace(observed.robot_arm, model=prior.model))
    arm, session = observed.robot_arm, observed.session
    if prior.fit.arm is None:
        return observed
    if arm.joints_rad is None:
        missing = [view.number for view in session.views if view.joints_rad is None]
        why = f"{counted(len(missing), 'view', ('has', 'have'))} no joint angles."
        step = "Record q1_rad ... with every view."
        if not missing and (found := misread_joints(run)) is not None:
            why, step = f"those here do not belong to it. {found.words}", str(found.do or "")
        raise DataError(
            f"session {session.name!r}: the calibration is of an arm by its joints, and {why}",
            culprits=[f"views.csv: view {index}" for index in missing],
            next_step=step,
        )
    errors = ArmErrors(arm.basis, 1.0, np.inf, of_links=True)
    return replace(observed, calibrated=replace(arm, errors=errors))


def _with_poses(observed: ObservedPoses, prior: CalibrationPrior) -> ObservedPoses:
    """Chooses each view's pose by the calibration, and recomputes it with its lens and boards."""
    mount, targets = observed.session.mount, tuple(prior.targets.values())
    x, *boards = prior.state.edges
    order = {board: at for at, board in enumerate(prior.boards)}
    poses, posed = observed.poses, observed.base_from_flange.keys() - observed.reasons.keys()
    numbers = (view.number for view in observed.session.views)
    views = [view for view in numbers if view in poses and poses[view].board in order]
    views = [view for view in views if view in posed]
    if not views:
        raise DataError(
            f"session {observed.session.name!r}: no view shows the target from a known pose of the "
            "robot.",
            culprits=observed.lost_views,
        )
    chosen = []
    robots = robot_part(observed.arm_at(views).poses, mount)
    for view, robot in zip(views, robots, strict=True):
        board = poses[view].board
        predicted = invert(robot @ x) @ boards[order[board]]
        chosen.append(poses[view].nearest(predicted, targets[board] if targets else None))
    observed = replace(observed, used=tuple(views), boards=prior.boards, free=prior.free)
    observed = observed.posed(chosen, observed.pixel_px)
    corners = {view.view: view.corners for view in chosen if view.corners is not None}
    if (free := observed.free) is not None and len(corners) == len(chosen):
        # With the noise around these poses, by calibrated lens and boards.
        stack = CornerStack.of(corners, free.positions + free.basis @ free.appearance.board)
        placed = np.array([observed.poses[view].cam_from_target[0] for view in corners])
        residuals = reproject(stack, free.appearance.camera, placed).residuals
        observed = observed.posed(chosen, stack.sigma_px(residuals, 6 * len(corners)))
    return observed


def _with_calibrated_targets(session: Session, prior: CalibrationPrior) -> Session:
    """Replaces the session's targets by the calibration's, by their names.

    Raises:
        DataError: They are others, or it is not known which of several is shown.
    """
    calibrated, shown, label = prior.targets, session.boards, f"session {session.name!r}"
    is_seen = any(view.image or view.has_corners for view in session.views)
    if is_seen and (not calibrated or prior.calibration.camera is None):
        raise _other_target(
            f"{label} has images; calibration {prior.calibration.session_name!r} was made from "
            "measured poses.",
            "Give the target's poses (cft_x_m ...) as when it was calibrated.",
        )
    names = ", ".join(name or "one without a name" for name in calibrated)
    # A session's only target has no name: of several calibrated ones, it is that with an equal
    # print.
    only = shown.get("")
    alike = [name for name in calibrated if only and not _differences(prior, name, only)]
    name = alike[0] if len(alike) == 1 else ""
    for shown_name, target in shown.items() if calibrated and not name else ():
        differences = _differences(prior, shown_name, target) if shown_name in calibrated else []
        if differences or shown_name not in calibrated:
            has = f": it has {listed(differences)}" if differences else ""
            raise _other_target(
                f"{label}: target {shown_name or target.name!r} must be one of those of "
                f"the calibration ({names}){has}.",
                "Describe and name it as in the calibration's session, or verify with views of "
                "that target alone. By another target, as a part's label: visioncal calibrate of "
                "these views, and visioncal diff of both results.",
            )
    if len(calibrated) < 2 and len(shown) < 2:
        return session
    if not shown:
        raise _other_target(
            f"{label} does not say which of the targets that were calibrated with ({names}) its "
            "rows show.",
            "Declare them, and name one in each row's column target.",
        )
    views = session.views
    if name:
        views = tuple(replace(view, text={**view.text, COLUMN: name}) for view in views)
    return replace(session, target=None, targets=calibrated, views=views)


def _other_target(message: str, next_step: str) -> DataError:
    return DataError(message, culprits=["session.toml: target"], next_step=next_step)


def _differences(prior: CalibrationPrior, name: str, target: Target) -> list[str]:
    """Differences in print between a target and the calibrated one, without its size's sigma."""
    calibrated, checked = target_document(prior.targets[name]), target_document(target)
    return [
        "image is of another picture"
        if field == "image"
        else f"{field} = {shorten(checked.get(field))}, not {shorten(calibrated.get(field))}"
        for field in {**calibrated, **checked}
        if calibrated.get(field) != checked.get(field) and field != "square_sigma_m"
    ]


def check_robot(session: Session, stated: Robot, calibrated: Robot, *others: Robot) -> None:
    """Refuses a robot other than the calibration's, by the motion of its flange.

    Args:
        session: The session.
        stated: The robot that it names.
        calibrated: The calibration's.
        others: Other models of that which it may name.

    Raises:
        DataError: It differs from all.
    """
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (5, stated.joint_count))
    for model in (calibrated, *others):
        if model.joint_count == stated.joint_count:
            # Motions are compared: the calibrated base may have been moved to the poses' frame.
            model_poses, stated_poses = (robot.base_from_flange(q) for robot in (model, stated))
            between = [invert(array[0]) @ array for array in (model_poses, stated_poses)]
            # Models whose flanges move alike to this [m and rad] are of the same robot: tables have
            # six digits.
            if np.abs(log(invert(between[0]) @ between[1])).max() < 1e-5:
                return
    raise DataError(
        f"session {session.name!r} names robot {stated.name}, which moves its flange otherwise: it "
        f"is another robot, or another tip, than the calibrated {calibrated.name}.",
        culprits=["session.toml: robot.model"],
        next_step="Name the robot and tip as in the calibration's session.",
    )


def _warnings(observed: ObservedPoses, prior: CalibrationPrior) -> Iterator[str]:
    """Warnings on the session."""
    yield from dict.fromkeys(warning.reason for warning in observed.warnings)
    if prior.calibration.thermal is not None:
        cold_c = float(prior.calibration.drift.reference_c.mean())
        yield (
            "The calibrated arm drifts with its temperature, and a check takes it for as warm as "
            f"it was at the start (about {cold_c:.0f} deg C): one at work looks longer, or as if "
            "its joints had slipped. Verify with the arm as warm as then."
        )

"""Why a calibration failed, or came out poor: the misreadings and boards that explain it."""

from dataclasses import dataclass, replace

from visioncal.calibration.pipeline.judging import poor_motion
from visioncal.calibration.pipeline.misread_poses import (
    misread_pose_finding,
    misreadings,
    turned_boards,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.image_checks import because, unseen_cause
from visioncal.calibration.suspects.ranking import explained_by
from visioncal.core.errors import DegenerateError, VisioncalError
from visioncal.core.verdict import Finding


@dataclass(frozen=True, eq=False)
class Misreading:
    """What is known of a misreading of the robot's poses, once they are read."""

    located: RunState  # The run before the fit.
    finding: Finding | None  # The likeliest misreading; None where none is likely.


def sought_misreading(state: RunState) -> tuple[RunState, Misreading]:
    """Looks for misread poses before the fit, and notes those and turned boards.

    Misread joints were reported before: they would mislead this search.
    """
    finding = next(misreadings(state), None)
    sought = Misreading(state, finding)
    if finding is None:
        state = state.noting((), turned_boards(state))
    return replace(state, is_misread=finding is not None), sought


def explained(
    error: VisioncalError, state: RunState, stage: str, sought: Misreading | None
) -> VisioncalError:
    """An error of a stage with its likeliest cause, where known, or the command for more views."""
    cause = unseen_cause(state) or (poor_motion(state) if stage == "intrinsics" else None)
    hint = None if sought is None else sought.finding
    if cause is None and state.mount is None:
        hint = hint or next(misreadings(state), None)
        return error if hint is None else because(error, hint)
    # Lost views are often why the remaining ones do not suffice.
    error = error.with_culprits([view for view in state.lost_views if view not in error.culprits])
    if cause is not None:
        return because(error, cause)
    if sought is None:
        return error
    if (hint := hint or misread_pose_finding(sought.located)) is not None:
        # Directions that are undetermined with misread poses mean nothing.
        return type(error)(hint.words, next_step=str(hint.do))
    robot = sought.located.robot
    if not (isinstance(error, DegenerateError) and sought.located.scenes):
        return error
    plan = (
        "Once [robot] model in session.toml names the arm, visioncal plan SESSION --add 5 proposes "
        "them."
    )
    if robot is not None:
        # A plan tilts the flange, which some arms cannot.
        purpose = "" if state.level in ("auto", "hand-eye") else " --for kinematics"
        plan = f"Let visioncal plan SESSION --add 5{purpose} propose them." * robot.can_tilt
    next_step = f"{error.next_step} {plan}".strip()
    return DegenerateError(error.message, culprits=error.culprits, next_step=next_step)


def with_likely_causes(state: RunState, sought: Misreading | None) -> RunState:
    """Adds to a poor verdict the misreading that explains it, and the board of lost views."""
    verdict = state.verdict
    if verdict is not None and verdict.status != "good" and sought is not None:
        hint = sought.finding
        if hint is None and state.mount is not None:
            hint = misread_pose_finding(sought.located)
        if hint is not None:
            verdict = explained_by(verdict, hint)
            state = replace(state, verdict=verdict)
    if verdict is None or all(finding.kind != "lost_views" for finding in verdict.findings):
        return state
    cause = unseen_cause(state)
    if cause is None or cause.kind != "other_board":
        return state
    return replace(state, verdict=explained_by(verdict, cause))

"""Why a calibration failed, or came out poor: the misreadings and boards that explain it."""

from dataclasses import dataclass, replace
from functools import cached_property

from visioncal.calibration.pipeline.judging import poor_motion
from visioncal.calibration.pipeline.misread_poses import (
    closes,
    misreadings,
    turned_boards,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.image_checks import because, unseen_cause
from visioncal.calibration.suspects.ranking import add_views_remedy, explained_by
from visioncal.core.errors import DegenerateError, VisioncalError
from visioncal.core.verdict import Finding


@dataclass(frozen=True, eq=False)
class Misreading:
    """What is known of a misreading of the robot's poses, once they are read."""

    located: RunState  # The run before the fit.

    @cached_property
    def finding(self) -> Finding | None:
        """The likeliest misreading; None where none is likely."""
        return next(misreadings(self.located), None)


def sought_misreading(state: RunState) -> tuple[RunState, Misreading]:
    """Looks for misread poses before the fit where chains do not close; notes turned boards.

    Misread joints were reported before: they would mislead this search.
    """
    sought = Misreading(state)
    if (state.mount is None or not closes(state)) and sought.finding is not None:
        return replace(state, is_misread=True), sought
    return state.noting((), turned_boards(state)), sought


def explained(
    error: VisioncalError, state: RunState, stage: str, sought: Misreading | None
) -> VisioncalError:
    """An error of a stage with its likeliest cause, where known, or the command for more views."""
    # Lost views are often why the remaining ones do not suffice.
    error = error.with_culprits([view for view in state.lost_views if view not in error.culprits])
    cause = unseen_cause(state) or (poor_motion(state) if stage == "intrinsics" else None)
    if cause is not None:
        return because(error, cause)
    is_pair = state.mount is not None
    if sought is None and is_pair:
        return error
    sought = sought or Misreading(state)
    if (hint := sought.finding) is not None:
        # Directions that are undetermined with misread poses mean nothing.
        return type(error)(hint.words, next_step=str(hint.do))
    robot = sought.located.robot
    can = is_pair and bool(state.scenes) and (robot is None or robot.can_tilt)
    if not (can and isinstance(error, DegenerateError)):
        return error
    purpose = "" if state.level in ("auto", "hand-eye") else " --for kinematics"
    plan = add_views_remedy(error.next_step, modelled=robot is not None, purpose=purpose)
    return DegenerateError(error.message, culprits=error.culprits, next_step=str(plan))


def with_likely_causes(state: RunState, sought: Misreading | None) -> RunState:
    """Adds to a poor verdict the misreading that explains it, and the board of lost views."""
    verdict = state.verdict
    if verdict is None or verdict.status == "good":
        return state
    if sought is not None and (hint := sought.finding) is not None:
        verdict = explained_by(verdict, hint)
    if any(finding.kind == "lost_views" for finding in verdict.findings):
        cause = unseen_cause(state)
        if cause is not None and cause.kind == "other_board":
            verdict = explained_by(verdict, cause)
    return replace(state, verdict=verdict)

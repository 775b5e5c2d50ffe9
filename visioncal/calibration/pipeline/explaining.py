"""Why a calibration failed, or came out poor: the misreadings and boards that explain it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from visioncal.calibration.pipeline.exchanged_names import exchanged_names
from visioncal.calibration.pipeline.judging import poor_motion
from visioncal.calibration.pipeline.misread_poses import (
    may_be_misread,
    misread_pose_finding,
    misreadings,
    turned_boards,
)
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.image_checks import because, unseen_cause
from visioncal.calibration.suspects.ranking import explained_by
from visioncal.core.errors import VisioncalError
from visioncal.core.verdict import Finding

# Advice to add stops or views; and, among that, advice to add stops for calibrating the arm.
_ADD = re.compile(r"\bAdd (?:stops|views|\d+ or more)\b")
_OR_MEASURED = re.compile(r".*Where the arm cannot tilt, (measure that offset for \S+)\..*")
_ARM = re.compile(r"\bAdd (?:stops|views in which the arm)\b")


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
    # Where only some rows are exchanged, the others can still be fitted.
    return replace(state, is_misread=finding is not None and not finding.views), sought


def explained(
    error: VisioncalError, state: RunState, stage: str, sought: Misreading | None
) -> VisioncalError:
    """An error of a stage with its likeliest cause, where that is known."""
    # Lost views are often why the remaining ones do not suffice.
    lost = [view for view in state.lost_views if view not in error.culprits]
    cause = unseen_cause(state) or (poor_motion(state) if stage == "intrinsics" else None)
    if cause is not None:
        return because(error.with_culprits(lost), cause)
    if state.mount is None:
        hint = sought.finding if sought else None
        hint = hint or exchanged_names(state) or next(misreadings(state), None)
        return error if hint is None else because(error, hint)
    return _with_hint(error.with_culprits(lost), sought)


def _with_hint(error: VisioncalError, sought: Misreading | None) -> VisioncalError:
    """Adds the likely misreading of the robot's poses to an error, or a command for more views."""
    if sought is None:
        return error
    located = sought.located
    hint = sought.finding or misread_pose_finding(located)
    if hint is not None:
        # Directions that are undetermined with misread poses mean nothing.
        return type(error)(hint.words, next_step=str(hint.do))
    robot, next_step = located.robot, error.next_step
    if robot is not None and not robot.can_tilt:
        next_step = without_tilting(next_step)
    elif located.scenes:
        (next_step,) = with_proposal([next_step], modelled=robot is not None)
    return type(error)(error.message, culprits=error.culprits, next_step=next_step)


def with_likely_causes(state: RunState, sought: Misreading | None) -> RunState:
    """Adds to a poor verdict the misreading that explains it, and the board of lost views."""
    hint = None if sought is None else sought.finding
    if state.verdict is not None and sought is not None and may_be_misread(state):
        if hint is None and state.mount is not None:
            hint = misread_pose_finding(sought.located)
        if hint is not None:
            state = replace(state, verdict=explained_by(state.verdict, hint))
    verdict = state.verdict
    if verdict is None or all(finding.kind != "lost_views" for finding in verdict.findings):
        return state
    cause = unseen_cause(state)
    if cause is None or cause.kind != "other_board":
        return state
    return replace(state, verdict=explained_by(verdict, cause))


def with_proposal(sentences: Sequence[str], *, modelled: bool) -> tuple[str, ...]:
    """Appends a pointer to `visioncal plan` to the first advice to add views.

    Args:
        sentences: Advice, or a verdict's reasons.
        modelled: Whether the robot's model is known; without it no stop can be proposed.
    """
    for index, sentence in enumerate(sentences):
        if _ADD.search(sentence):
            pointed = f"{sentence} {_proposal(' '.join(sentences), modelled)}"
            return (*sentences[:index], pointed, *sentences[index + 1 :])
    return tuple(sentences)


def without_tilting(advice: str) -> str:
    """Replaces advice to tilt by that to measure the offset, where the advice names one."""
    words = r"This arm cannot tilt: \1, as z_m and sigma_m in session.toml."
    return _OR_MEASURED.sub(words, advice)


def _proposal(words: str, modelled: bool) -> str:
    if not modelled:
        return (
            "Once [robot] model in session.toml names the arm, visioncal plan SESSION --add 5 "
            "proposes them."
        )
    purpose = " --for kinematics" if _ARM.search(words) else ""
    return f"Let visioncal plan SESSION --add 5{purpose} propose them."

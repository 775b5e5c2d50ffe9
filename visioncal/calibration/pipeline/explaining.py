"""Why a calibration failed: the misreadings, boards and motions that explain it."""

from contextlib import suppress

from visioncal.calibration.pipeline.guess_inputs import closes, guess_from_camera_poses
from visioncal.calibration.pipeline.judging import poor_motion
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.image_checks import unseen_cause
from visioncal.calibration.suspects.misread_poses import UNRECORDED, with_misreading
from visioncal.calibration.suspects.ranking import add_views_remedy
from visioncal.calibration.suspects.suspect import UNDONE
from visioncal.core.errors import DegenerateError, VisioncalError
from visioncal.core.types import MOUNTS
from visioncal.core.verdict import Remedy, of_cell


def explained(
    error: VisioncalError, state: RunState, stage: str, *, are_located: bool
) -> VisioncalError | None:
    """An error of a stage by its likeliest cause, or with the command for more views, or None."""
    cause = unseen_cause(state) or (poor_motion(state) if stage == "intrinsics" else None)
    if cause is not None:
        return error.but(f"{cause.words} {error.message}", next_step=str(cause.do or ""))
    is_pair = state.session.has_one_pair
    # Of a whole cell, views that a mistake explains were left out before the fit.
    for found in (at for at in state.warnings if at.kind in UNDONE and not is_pair):
        return error.but(f"{found.words} {error.message}", next_step=str(found.do or ""))
    if is_pair and not are_located:
        return None
    state = with_misreading(state)
    read = state.misread or ()
    for misread in of_cell(read, len(state.robots), len(state.cameras)):
        # Directions that are undetermined with misread poses mean nothing.
        return type(error)(misread.words, next_step=str(misread.do))
    if isinstance(error, DegenerateError) and (words := _open_chain(state)):
        return DegenerateError(words, next_step=str(UNRECORDED))
    plan = more_views(error, state)
    return None if plan is None else error.but(next_step=str(plan))


def _open_chain(state: RunState) -> str:
    """How robot and camera disagree though the motion is ample; empty where they agree.

    The sigmas of a fit that does not close say nothing of the motion.
    """
    if state.mount not in MOUNTS or poor_motion(state) is not None:
        return ""
    if closes(state.base_from_flange, state.poses_of_one_board, state.mount):
        return ""
    with suppress(VisioncalError):
        guess = guess_from_camera_poses(state)
        more = " The poses may be misread in two ways, or not be those of the images."
        return "" if guess.best.fit.closes else guess.sentence + more
    return ""


def more_views(error: VisioncalError, state: RunState) -> Remedy | None:
    """The command for more views where these determine too little; None where it has none."""
    can = state.session.has_one_pair and (state.robot is None or state.robot.can_tilt)
    if not (can and state.scenes and isinstance(error, DegenerateError)):
        return None
    purpose = "" if state.level in ("auto", "hand-eye") else " --for kinematics"
    return add_views_remedy(error.next_step, modelled=state.robot is not None, purpose=purpose)

"""Parts that moved, slipped or were exchanged at some stop, or drifted over the session."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.suspects.lens import changed_lens
from visioncal.calibration.suspects.moved_views import (
    OF_OTHER_FRAMES,
    is_switched,
    other_frame,
    tool_taken_off,
)
from visioncal.calibration.suspects.suspect import ARM_ERRORS, INFLATED, Suspect
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure, mm_and_deg, ranges
from visioncal.core.transforms import exp, pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.steps import DRIFT, FRAME, JOINT, LENS, SIZE, Step, with_step
from visioncal.robot.model import joint_words

_LIMITS = CalibrationLimits()
# Prints of one file agree to less, and a print changes its size by as much with the air.
_OTHER_PRINT = 5e-4
_THINGS = {"cam": "The camera", "target": "The target", "instrument": "The instrument"}


def _found(run: RunState) -> Iterator[Finding]:
    """The likeliest step or drift, and another that may be the cause instead."""
    cell = run.cell_fit.cell
    steps = [
        step
        for step in run.assessment.steps
        if step.kind != SIZE or abs(float(step.value[0])) > _OTHER_PRINT
    ]
    # More than a base or an arm drifts by is of another cause that follows the order of the views.
    moved = [pose_difference(np.eye(4), exp(step.value)) for step in steps if step.kind == DRIFT]
    if not steps or any(
        mm > _LIMITS.arm_errors[0] or deg > _LIMITS.arm_errors[1] for mm, deg in moved
    ):
        return
    step, between = steps[0], "; the result is between before and after."
    last = "; the result has it where it stood last."
    rivals = tuple(_words(other, run) for other in steps[1:2])
    if step.kind == LENS:
        # Another one that is known is in the fit, as scatter.
        if step.of not in run.cell_fit.sizes.zoomed:
            found = changed_lens(run, step)
            yield replace(found, words=f"{found.words[:-1]}{between}", rivals=rivals)
        return
    thing = _THINGS.get(step.of, step.of)
    fasten, note = f"Fasten {thing[0].lower()}{thing[1:]}", ""
    if (
        step.kind == FRAME
        and pose_difference(np.eye(4), exp(step.value))[0] > _LIMITS.arm_errors[0]
    ):
        fasten += ", keep one tool and base frame in the controller"
        note = OF_OTHER_FRAMES
    kind, do = {
        FRAME: ("moved_at_once", fasten),
        JOINT: ("joint_slipped", "Look whether the joint keeps its zero"),
        SIZE: ("board_changed", "Measure both prints, take one of them for all views"),
        DRIFT: ("moved_slowly", "Fasten base and target, let the arm warm up, and record again."),
    }[step.kind]
    is_drift = step.kind == DRIFT
    # Closed forms take no step.
    is_applied = step.kind == FRAME and run.assessment.is_stepped
    yield Finding(
        kind,
        f"{_words(step, run)}{last if is_applied else between}",
        Remedy(do)
        if is_drift
        else _of_tool(run, step, do) or cell.or_separately(do, step.stop, note),
        mahalanobis_sq=0.0 if is_drift else step.gain,
        rivals=rivals,
    )


def _of_tool(run: RunState, step: Step, do: str) -> Remedy | None:
    """Advice to take a tool off the poses after a step, or to `do` something; None for no tool."""
    is_one_step = run.session.has_one_pair and step.kind == FRAME and not step.earlier
    if not (is_one_step and is_switched(exp(step.value))):
        return None
    later = run.cell_fit.cell.views_from(step.stop)
    otherwise = f"{do[0].lower()}{do[1:]}, and record again; or calibrate the {len(later)} views "
    otherwise += f"after it alone (--views {ranges(later)}){OF_OTHER_FRAMES}."
    return tool_taken_off(run.cell_fit, step.of, _edges(run, step), later, otherwise)


def _edges(run: RunState, step: Step) -> tuple[FloatArray, FloatArray]:
    """The frame that was moved before and after a step."""
    fit = run.assessment.sized
    stepped, solved = with_step(fit.problem, fit.solution, step)
    edges = stepped.frames(solved.state)
    *_, before, after = (edges[at] for at in stepped.unknown if at.partition("@")[0] == step.of)
    return before, after


def _words(step: Step, run: RunState) -> str:
    if step.kind == LENS:
        return changed_lens(run, step).words[:-1]
    first, sigma = float(step.value[0]), float(np.sqrt(step.covariance[0, 0]))
    when, thing = run.cell_fit.cell.start_words(step.stop), _THINGS.get(step.of, step.of)
    if step.kind == JOINT:
        arms, index = run.cell_fit.arms, step.candidate.joint
        robot = arms[step.of].nominal
        joint = f"joint {index + 1}" if robot is None else joint_words(index, robot)
        joint += f" of robot {step.of}" * (len(arms) > 1)
        # The reading's change is opposite to the correction that gives the joint's angle.
        changed_deg, sigma_deg = np.rad2deg([abs(first), sigma]).tolist()
        return (
            f"The offset of {joint} steps: {when}, it reads {'+' if first < 0.0 else '-'}"
            f"{figure(changed_deg)} deg (sigma {figure(sigma_deg)}) from what it read before, as "
            "where an encoder slipped, a zero was lost, or another load bends it"
        )
    # A program whose poses are given may go over to another lens, or another origin.
    source = ", or what measures its poses was set otherwise"
    source *= run.cell_fit.linearised_corners is None
    if step.kind == SIZE:
        return (
            f"{thing} is another one: {when}, it is {figure(100.0 * abs(first))} % "
            f"{'larger' if first > 0.0 else 'smaller'} (sigma {figure(100.0 * sigma)} %) than "
            f"before, by the robot's motion{source}"
        )
    far_mm, far_deg = pose_difference(np.eye(4), exp(step.value))
    is_far = run.session.has_one_pair and step.kind == FRAME and far_mm > _LIMITS.arm_errors[0]
    if is_far:
        # A step that is far was linearised at a fit that is far from either part.
        before, after = _edges(run, step)
        far_mm, far_deg = pose_difference(before, after)
    moved = mm_and_deg(far_mm, far_deg)
    if step.kind == DRIFT:
        return (
            "Residuals drift with time: from the first stop to the last, base or target moved by "
            f"{moved}, or the arm grew as it warmed up"
        )
    on_flange = (run.mount == "eye-in-hand") == step.of.startswith("cam")
    # Things beside a robot move relative to its base.
    of_base = "" if on_flange or not run.session.has_one_pair else ", or the robot's base,"
    words, since = f"{thing}{of_base} moved at once: ", "it was"
    for one in step.earlier:
        by = mm_and_deg(*pose_difference(np.eye(4), exp(one.value)))
        words = f"{thing}{of_base} moved at once, twice: "
        words += f"{run.cell_fit.cell.start_words(one.stop)}, it is {by} from where it was, and "
        since = "it was in between"
    words += f"{when}, it is {moved} from where {since}{source}"
    words += run.cell_fit.instead_of(exp(step.value))
    if is_far:
        words += f", or the controller's {'tool' if on_flange else 'base frame'} is another one"
        words += f", by {other_frame(before, after)}"
    return words


# Motion along a camera's axis looks like changes of its focus, which are random in the fit; a
# changing focus does not follow time, and looks like motion in one session of ten thousand.
_EFFECTS = (ARM_ERRORS, "focus")
MOVED_AT_ONCE = Suspect("moved_at_once", _found, 1e-4, True, _EFFECTS, INFLATED)
JOINT_SLIPPED = Suspect("joint_slipped", None, 1e-4, True, _EFFECTS, INFLATED)
BOARD_CHANGED = Suspect(
    "board_changed", None, 1e-4, True, (*_EFFECTS, "board_size", "board_shape"), INFLATED
)
MOVED_SLOWLY = Suspect("moved_slowly", None, 1e-4, True, ("focus",), (ARM_ERRORS,))

"""Steps, drifts and errors of arms that the residuals of a fit show, and their findings."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.suspects.ranking import NO_JOINTS
from visioncal.core.finding_kinds import BOARD_CHANGED, MOVED_FRAME
from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.transforms import exp, pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import PLAN, Finding, Remedy
from visioncal.estimation.arm import LEVER_M, SIGNIFICANT, ArmErrors, stops_of
from visioncal.estimation.pose_errors import find_pose_errors
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, by_noise_alone
from visioncal.estimation.steps import (
    DRIFT,
    FRAME,
    JOINT,
    SIZE,
    Step,
    drift_of,
    evidence,
    find_steps,
    frames_of,
    joints_of,
    sizes_of,
)

# Most steps that are fitted.
_MOST_FITTED = 6
# Largest ratio of the residuals beside a step to others.
_ALIKE = 3.0
# Log-likelihood ratio, doubled, by which one step is clearly likelier: odds of a hundred to one.
_CLEARLY = 2.0 * float(np.log(100.0))
# Kinds of findings by what changed.
_KINDS = {FRAME: MOVED_FRAME, JOINT: "joint_slipped", SIZE: BOARD_CHANGED, DRIFT: "moved_slowly"}


def likely_steps(
    problem: Problem,
    fit: Solution,
    errors: Mapping[str, ArmErrors],
    offsets: Mapping[str, FloatArray],
) -> tuple[Step, ...]:
    """The likeliest step that the residuals show, followed by others about as likely; or a drift.

    The gain of a step is the logarithm, doubled, of its Bayes factor beside the errors of arms.

    Args:
        problem: The inlier observations, with stops in the order of the session.
        fit: Their converged fit.
        errors: Errors of arms whose joints are not known, by robot.
        offsets: (s, 6, n) Jacobian of the flange by joint offsets, for the other robots.
    """
    robots = [robot for robot in problem.robots if len(stops_of(problem, robot)) >= FEWEST_STOPS]
    if not robots:
        return ()
    candidates = frames_of(problem, tuple(problem.unknown)) + sizes_of(problem, fit)
    candidates += joints_of(problem, {name: offsets[name] for name in robots if name in offsets})
    candidates += [drift_of(problem, robot) for robot in robots]
    # A push shifts positions alone, and dominates their noise.
    found = find_steps(problem, fit, candidates, kinds=2)
    drift = next((step for step in found if step.kind == DRIFT), None)
    penalty = 2.0 * float(np.log(len(problem.unknown) * (1 + problem.observations.stops.max())))
    likely = []
    for step in found[:_MOST_FITTED]:
        if step.kind == DRIFT or (drift is not None and step.gain - penalty < drift.gain):
            continue
        gain, apart, there = evidence(problem, fit, step)
        if step.kind in (FRAME, SIZE) and not _leaves_noise(apart, there, step):
            continue
        # What errors of an arm, correlated by posture or time, explain as well is none.
        for robot, arm in errors.items():
            beside = find_pose_errors(apart, there.state, there.noise, robot)
            gain += (beside.gain if beside else 0.0) - arm.gain
        likely.append(replace(step, gain=gain - penalty))
    likely.sort(key=lambda step: -step.gain)
    # Which errors of an arm there are is known less well than that there are some.
    needed = 2.0 * _CLEARLY if any(arm.is_significant for arm in errors.values()) else _CLEARLY
    if likely and likely[0].gain > needed:
        least = max(needed, likely[0].gain - _CLEARLY)
        return tuple(step for step in likely if step.gain > least)
    if drift is None or (drift.of in errors and drift.gain < errors[drift.of].gain):
        return ()
    return (drift,)


def _leaves_noise(problem: Problem, fit: Solution, step: Step) -> bool:
    """Whether the residuals beside a step are as small as elsewhere, once it is fitted."""
    # A few wrong views at an end of the session gain by a step, and stay wrong.
    squares, seen = by_noise_alone(problem, fit), problem.observations
    behind, involved = seen.stops >= step.stop, seen.involves(step.of)
    sides = (involved & ~behind, seen.involves([*problem.unknown][-1]) & behind)
    if step.kind == SIZE:
        sides = (involved & ~behind, involved & behind)
    return all(np.median(squares[side]) < _ALIKE**2 * np.median(squares) for side in sides)


def arm_findings(arm: ArmErrors, *, calibrated: bool) -> Iterator[Finding]:
    """Findings on significant posture-dependent errors of an arm, `calibrated` or not."""
    if not arm.is_significant:
        return
    likely = f"(likelihood ratio {arm.gain:.0f}, noise stays under {SIGNIFICANT:.0f})"
    found = list[tuple[str, Remedy]]()
    if not calibrated and arm.of_links:
        size = mm_and_deg(1e3 * LEVER_M * arm.sigma, float(np.rad2deg(arm.sigma)))
        words = (
            f"Residuals follow the arm's posture {likely}: its links are off from the model by "
            f"typically {size}; they were estimated along."
        )
        step = "Add stops all over the workspace, so that the arm can be calibrated along."
        found.append((words, Remedy(step, f"{PLAN} --for kinematics")))
    if arm.fit_sigmas is not None:
        turn_rad, shift_m = (np.sqrt(3.0) * arm.fit_sigmas).tolist()
        words = (
            f"Residuals follow the arm's posture, or last from stop to stop {likely}: a look near "
            f"the views errs by {mm_and_deg(1e3 * shift_m, float(np.rad2deg(turn_rad)))} (rms). "
            "More views will not help: joint angles or a kinematic calibration of the arm will."
        )
        found.append((words, NO_JOINTS))
    same = "What of these errors looks the same in all views is in no residual, and counts in the"
    for words, do in found:
        all_words = f"{words} {same} covariance."
        yield Finding("arm_errors", all_words, do, until_mm=0.0, mahalanobis_sq=arm.gain)


def step_finding(
    steps: tuple[Step, ...], cell: Cell, joint: Callable[[Step], str]
) -> Iterator[Finding]:
    """Finding on the likeliest step or drift, and on another that may be the cause instead.

    Args:
        steps: The result of `likely_steps`.
        cell: The cell, for the names of its stops.
        joint: Function that gives the joint of a slip in words.
    """
    if not steps:
        return
    step, instead = steps[0], ""
    if steps[1:]:
        instead = f" Or else, as these views leave it open: {_step_words(steps[1], cell, joint)}."
    thing = _thing(step)
    do = {
        FRAME: f"Fasten {thing[0].lower()}{thing[1:]}",
        JOINT: "Look whether the joint keeps its zero",
        SIZE: "Measure both prints, take one of them for all views",
        DRIFT: "Fasten base and target, let the arm warm up",
    }[step.kind]
    is_drift = step.kind == DRIFT
    yield Finding(
        _KINDS[step.kind],
        f"{_step_words(step, cell, joint)}; the result is between before and after.{instead}",
        Remedy(f"{do}, and record again.") if is_drift else cell.or_separately(do, step.stop),
        mahalanobis_sq=0.0 if is_drift else step.gain,
    )


def _thing(step: Step) -> str:
    return {"cam": "The camera", "target": "The target", "instrument": "The instrument"}.get(
        step.of, step.of
    )


def _step_words(step: Step, cell: Cell, joint: Callable[[Step], str]) -> str:
    first, sigma = float(step.value[0]), float(np.sqrt(step.covariance[0, 0]))
    when = cell.start_words(step.stop)
    if step.kind == JOINT:
        # The reading's change is opposite to the correction that gives the joint's angle.
        changed_deg, sigma_deg = np.rad2deg([abs(first), sigma]).tolist()
        return (
            f"The offset of {joint(step)} steps: {when}, it reads {'+' if first < 0.0 else '-'}"
            f"{figure(changed_deg)} deg (sigma {figure(sigma_deg)}) from what it read before, as "
            "where an encoder slipped or a zero was lost"
        )
    if step.kind == SIZE:
        return (
            f"{_thing(step)} is another one: {when}, it is {figure(100.0 * abs(first))} % "
            f"{'larger' if first > 0.0 else 'smaller'} (sigma {figure(100.0 * sigma)} %) than "
            "before, by the robot's motion"
        )
    moved = mm_and_deg(*pose_difference(np.eye(4), exp(step.value)))
    if step.kind == DRIFT:
        return (
            "Residuals drift with time: from the first stop to the last, base or target moved by "
            f"{moved}"
        )
    return f"{_thing(step)} moved at once: {when}, it is {moved} from where it was"

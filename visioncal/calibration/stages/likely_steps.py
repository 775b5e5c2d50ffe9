"""Steps and drifts that the residuals of a fit show."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.pose_errors import find_pose_errors
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import stops_of
from visioncal.estimation.fit import Fit
from visioncal.estimation.joint import target_sizes
from visioncal.estimation.moves import still_frames
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.solve import Solution, fit_problem
from visioncal.estimation.steps import (
    DRIFT,
    FRAME,
    Step,
    drift_of,
    evidence,
    find_steps,
    frames_of,
    joints_of,
    lenses_of,
    sizes_of,
    twice,
)
from visioncal.estimation.unknowns import BOARD, SIZE
from visioncal.robot.errors import ArmErrors
from visioncal.vision.board_shape import SCALE

# Log-likelihood ratio, doubled, by which one step is clearly likelier: odds of a hundred to one.
CLEARLY = 2.0 * float(np.log(100.0))


def steps_of(
    fit: Fit,
    errors: Mapping[str, ArmErrors],
    offsets: Mapping[str, FloatArray],
    lenses: Mapping[str, FloatArray],
) -> tuple[Step, ...]:
    """The likeliest steps of a fit, as `likely_steps`, beside boards of any size.

    A board whose size is held, since errors of an arm are confounded with it, leaves residuals by
    distance. The first views may be nearer than the rest, and a change from then on explains these.
    """
    found = likely_steps(fit.problem, fit.solution, errors, offsets, lenses)
    sized = with_free_sizes(fit)
    if not found or sized is fit:
        return found
    arm_errors = dict[str, ArmErrors]()
    for robot, one in errors.items():
        sized_errors = find_pose_errors(sized.problem, sized.state, sized.noise, robot)
        arm_errors[robot] = one if sized_errors is None else sized_errors
    size = fit.problem.size
    return tuple(
        replace(step, spread=step.spread[:size, :size])
        for step in likely_steps(sized.problem, sized.solution, arm_errors, offsets, lenses)
    )


def with_free_sizes(fit: Fit) -> Fit:
    """A fit that estimates the sizes of boards that it holds or has exact; itself for none."""
    boards = fit.unknowns.all_of(BOARD)
    scales = [fit.unknowns.columns(at)[fit.unknowns.values_of(at) == SCALE] for at in boards]
    columns = np.concatenate([np.zeros(0, dtype=np.int64), *scales])
    held = columns[~fit.problem.moving[columns]]
    targets = [name for name in fit.frames if name.startswith("target")]
    if len(held):
        effects = list[Effect]()
        for effect in fit.problem.effects:
            places = fit.problem.effect_columns[effect.name]
            freed = np.isin(np.arange(places.start, places.stop), held)
            effects.append(replace(effect, held=effect.held & ~freed))
        wide = replace(fit, problem=fit.problem.with_effects(effects))
    elif targets and not len(columns) and SIZE not in fit.problem.effect_columns:
        # Of measured poses, or of points whose table is exact.
        wide = fit.with_columns(target_sizes(fit.problem, dict.fromkeys(targets, np.inf)))
    else:
        return fit
    return replace(wide, solution=fit_problem(wide.problem, wide.state, wide.noise))


def likely_steps(
    problem: Problem,
    fit: Solution,
    errors: Mapping[str, ArmErrors],
    offsets: Mapping[str, FloatArray],
    lenses: Mapping[str, FloatArray],
) -> tuple[Step, ...]:
    """The likeliest step that the residuals show, followed by others about as likely; or a drift.

    Of a frame that was moved twice it is the later one, with the earlier. A step's gain is
    the logarithm, doubled, of its Bayes factor beside the errors of arms.

    Args:
        problem: The inlier observations, with stops in the order of the session.
        fit: The converged fit of the problem.
        errors: Errors of arms whose joints are not known, by robot.
        offsets: (s, 6, n) Jacobian of the flange by joint offsets, for the other robots.
        lenses: (n, 6, 3) Jacobian of the measured poses by changes of a lens, by camera.
    """
    robots = [robot for robot in problem.robots if len(stops_of(problem, robot)) >= FEWEST_STOPS]
    if not robots:
        return ()
    still = still_frames(problem, problem.unknown)
    candidates = frames_of(problem, still) + sizes_of(problem, fit)
    candidates += joints_of(problem, {name: offsets[name] for name in robots if name in offsets})
    candidates += lenses_of(problem, lenses)
    candidates += [drift_of(problem, robot) for robot in robots]
    # A push shifts positions alone, and dominates their noise.
    found = find_steps(problem, fit, candidates, kinds=2)
    drift = next((step for step in found if step.kind == DRIFT), None)
    penalty = 2.0 * float(np.log(len(problem.unknown) * (1 + problem.observations.stops.max())))
    likely = list[_Weighed]()
    # Most steps that are fitted.
    for step in found[:6]:
        if step.kind == DRIFT:
            continue
        try:
            gain, apart, solution = evidence(problem, fit, step)
            double = twice(problem, fit, step, (apart, solution)) if step.kind == FRAME else None
        except (VisioncalError, np.linalg.LinAlgError):
            # A step with which no fit converges is not likelier.
            continue
        single = _weighed(replace(step, gain=gain - penalty), apart, solution, errors)
        if double is not None and (drift is None or double[0].gain - 2.0 * penalty > drift.gain):
            second = replace(double[0], gain=double[0].gain - 2.0 * penalty)
            weighed = _weighed(second, *double[1:], errors)
            if weighed.step.gain - single.step.gain > CLEARLY:
                likely.append(weighed)
                continue
        if drift is None or step.gain - penalty >= drift.gain:
            likely.append(single)
    clear = sorted(
        (one.step for one in likely if one.step.gain > one.needed), key=lambda step: -step.gain
    )
    if clear:
        return tuple(step for step in clear if step.gain > clear[0].gain - CLEARLY)
    if drift is None or (drift.of in errors and drift.gain < errors[drift.of].gain):
        return ()
    return (drift,)


@dataclass(frozen=True, eq=False)
class _Weighed:
    """A step with its gain beside the errors of arms."""

    step: Step
    needed: float  # Its gain, at least, to be clear.


def _weighed(
    step: Step, apart: Problem, solution: Solution, errors: Mapping[str, ArmErrors]
) -> _Weighed:
    """A step by the fit with it: one that errors of arms explain as well is none."""
    gain, needed = step.gain, CLEARLY
    for robot, arm in errors.items():
        remaining = find_pose_errors(apart, solution.state, solution.noise, robot)
        gain += (remaining.gain if remaining else 0.0) - arm.gain
        # A frame's step takes six values, and errors that it leaves are others. Of a board's size,
        # or of a joint, they may be what seems to change.
        left = remaining if step.kind == FRAME else arm
        if left is not None and left.is_significant:
            # The kind of an arm's errors is known less well than their presence.
            needed = 3.0 * CLEARLY
    return _Weighed(replace(step, gain=gain), needed)

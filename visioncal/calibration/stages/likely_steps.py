"""Steps and drifts that the residuals of a fit show."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.pose_errors import find_pose_errors
from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import ArmErrors, stops_of
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution
from visioncal.estimation.steps import (
    DRIFT,
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
# Log-likelihood ratio, doubled, by which one step is clearly likelier: odds of a hundred to one.
_CLEARLY = 2.0 * float(np.log(100.0))


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
        # A change that errors of an arm, correlated by posture or time, explain as well is none.
        for robot, arm in errors.items():
            beside = find_pose_errors(apart, there.state, there.noise, robot)
            gain += (beside.gain if beside else 0.0) - arm.gain
        likely.append(replace(step, gain=gain - penalty))
    likely.sort(key=lambda step: -step.gain)
    # The kind of an arm's errors is known less well than their presence.
    needed = 3.0 * _CLEARLY if any(arm.is_significant for arm in errors.values()) else _CLEARLY
    if likely and likely[0].gain > needed:
        least = max(needed, likely[0].gain - _CLEARLY)
        return tuple(step for step in likely if step.gain > least)
    if drift is None or (drift.of in errors and drift.gain < errors[drift.of].gain):
        return ()
    return (drift,)

"""The robots' arms of a cell: reading, calibration one by one, covariance."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.calibration.stages.likely_steps import with_free_sizes
from visioncal.calibration.stages.pose_errors import find_pose_errors
from visioncal.calibration.stages.random_effects import random_effect_rms
from visioncal.calibration.stages.reported_poses import RobotReport
from visioncal.calibration.stages.thermal import LEVEL, with_drift
from visioncal.core.errors import DataError, DegenerateError, VisioncalError
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import covariance_of_size
from visioncal.estimation.budget import less_noise
from visioncal.estimation.fit import Fit
from visioncal.estimation.intervals import expected_levels
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.steps import DRIFT, FRAME, SIZE, Step, with_step
from visioncal.estimation.unknowns import ARM
from visioncal.robot.arm_model import HEAT, groups_of
from visioncal.robot.errors import ArmErrors

# Name of a sudden step (a frame that moved, a joint that slipped) as a source of uncertainty.
STEP = "what moved at once"


def arms_of(cell: Cell, robots: Mapping[str, RobotReport]) -> dict[str, Arm]:
    """Reads the nominal arms of a cell."""
    arms, session = {}, cell.session
    for name, robot in robots.items():
        key = robot_key(name)
        if key in cell.poses:
            rows = {
                observation.station: observation.robots[name]
                for observation in session.observations
                if name in observation.robots
            }
            has_pose = np.isfinite(cell.poses[key][:, 0, 0]).tolist()
            views = [rows[at] if is_posed else None for at, is_posed in enumerate(has_pose)]
            arms[key] = Arm.of(key, cell.poses[key], views, robot.matched, (session, name))
    return arms


def joint_offsets(arms: Mapping[str, Arm]) -> dict[str, FloatArray]:
    """(s, 6, n) Jacobians of flanges with respect to joint offsets, of arms with a model."""
    jacobians = {name: arm.joint_offsets for name, arm in arms.items()}
    return {name: jacobian for name, jacobian in jacobians.items() if jacobian is not None}


def covariance_from_other_sources(
    fit: Fit, arms: Mapping[str, Arm], steps: Sequence[Step], *, is_fit: bool = True
) -> dict[str, FloatArray]:
    """Covariances (p, p) of a fit from sources other than noise, by source.

    Args:
        fit: The fit.
        arms: The arms. Errors that are not estimated count, and of others the uncertainty of their
            size.
        steps: Steps that the residuals show, likeliest first.
        is_fit: Whether it minimises the problem; a closed form is not biased by held values alone.
    """
    parts, problem = dict[str, FloatArray](), fit.problem
    if len(problem.units[1]):
        levels = expected_levels(problem, fit.state, fit.noise)
        # Where an arm has errors that are not estimated, the noise is what remains beside them, not
        # the expected level of a fit without them.
        unestimated = [
            problem.robots.index(robot)
            for robot, arm in arms.items()
            if arm.errors is not None and arm.errors.is_significant and not arm.errors.is_estimated
        ]
        levels[unestimated] = fit.noise.robots[unestimated]
        noise = replace(fit.noise, robots=levels)
        raised = replace(fit, solution=replace(fit.solution, noise=noise))
        parts["noise_level"] = raised.by_noise - fit.by_noise
    shift = fit.shift * float(is_fit)
    if shift.any():
        parts["held_values"] = np.outer(shift, shift)
    for robot, arm in arms.items():
        suffix = f" of robot {robot}" if len(arms) > 1 else ""
        if arm.errors is not None and not arm.errors.is_estimated:
            parts[f"arm{suffix}"] = misfit_covariance(fit, robot, arm.errors)
        elif arm.errors is not None:
            at, by_noise = fit.unknowns[ARM, robot], fit.by_noise
            parts[f"size of arm errors{suffix}"] = covariance_of_size(at, by_noise, arm.errors)
    if steps and steps[0].kind != DRIFT:
        parts[STEP] = steps[0].spread
    return parts


def misfit_covariance(fit: Fit, robot: str, errors: ArmErrors) -> FloatArray:
    """Covariance (p, p) that arm errors add to a fit that takes them for white noise.

    Where the white noise beside the errors is known, the fit was weighted with too much noise; the
    excess is subtracted. Errors that last in time are estimated; see `with_lasting_errors`.
    """
    response, wide, size = errors.sigma * fit.bias(robot, errors), fit, fit.problem.size
    if errors.time_correlated_count:
        wide = fit.beside_lasting(robot, errors)
    covariance = response @ response.T + (wide.by_noise[:size, :size] - fit.by_noise)
    if errors.white is not None:
        less = less_noise(wide.problem, wide.state, wide.noise, robot, errors.white)
        covariance += less[:size, :size]
    return np.asarray(covariance)


def with_lasting_errors(fit: Fit, arms: Mapping[str, Arm]) -> Fit:
    """The fit at what its unknowns are beside errors of arms that last in time.

    Lasting errors are alike at neighbouring stops: their mean says less than their number suggests.
    Its noise stays that of the stops one by one.
    """
    step = np.zeros(fit.problem.size)
    for robot, arm in arms.items():
        if arm.errors is not None and arm.errors.time_correlated_count:
            step += fit.step_to(fit.beside_lasting(robot, arm.errors))
    return fit.at(fit.state.moved(step)) if step.any() else fit


def one_nominal(arms: Mapping[str, Arm], fit: Fit) -> Iterator[tuple[Arm, Problem, State]]:
    """Each arm, with the problem of a fit where that arm is nominal, and the start of that problem.

    The others are as they are when it is their turn: changed ones stay so for those that follow.
    """
    problem = fit.problem
    values = {effect: problem.values_of(effect.name, fit.state) for effect in problem.effects}
    for name, arm in arms.items():
        nominal, state = arm.without_errors(problem), fit.state
        if nominal.effects != tuple(values):
            start = [values.get(effect, effect.values) for effect in nominal.effects]
            state = State(fit.state.edges, np.concatenate([np.zeros(0), *start]))
        yield arm, nominal, state
        problem = arms[name].applied_to(problem)


def with_drifts(arms: Mapping[str, Arm], fit: Fit, level: str) -> dict[str, Arm]:
    """Estimates drift with temperature, one arm after the other, where the session determines it.

    Raises:
        DataError: Drift is requested, and no arm has the data that it needs.
        DegenerateError: Drift is requested, and the temperature hardly varied.
    """
    changed, refused = dict(arms), list[VisioncalError]()
    for arm, nominal, start in one_nominal(changed, fit) if HEAT in groups_of(level) else ():
        try:
            changed[arm.robot] = with_drift(arm, nominal, start)
        except (DataError, DegenerateError) as error:
            refused.append(error.within(f"robot {arm.robot}"))
    if level == LEVEL and refused and len(refused) == len(changed):
        raise refused[0]
    return changed


def with_pose_errors(arms: Mapping[str, Arm], fit: Fit) -> dict[str, Arm]:
    """Estimates pose-dependent errors of arms without joint angles."""

    def found(name: str) -> ArmErrors | None:
        errors = find_pose_errors(fit.problem, fit.state, fit.noise, name)
        if errors is None or errors.white is None:
            return errors
        # Residuals of a board whose size is held follow the posture, too: beside its size, such
        # errors are to be significant.
        sized = with_free_sizes(fit) if errors.is_significant else fit
        if sized is not fit:
            sized_errors = find_pose_errors(sized.problem, sized.state, sized.noise, name)
            gain = errors.gain if sized_errors is None else min(errors.gain, sized_errors.gain)
            errors = replace(errors, gain=gain)
        return replace(errors, of_session=random_effect_rms(fit.problem, fit.state, name))

    return {
        name: arm if arm.is_modelled else replace(arm, errors=found(name))
        for name, arm in arms.items()
    }


def with_errors_beside_step(
    arms: Mapping[str, Arm], fit: Fit, steps: Sequence[Step]
) -> Mapping[str, Arm]:
    """Estimates pose-dependent errors again beside a sudden step, which they would also explain."""
    is_modelled = all(arm.is_modelled for arm in arms.values())
    if not steps or steps[0].kind not in (FRAME, SIZE) or is_modelled:
        return arms
    found = with_pose_errors(arms, Fit(*with_step(fit.problem, fit.solution, steps[0])))
    # No frame is estimated beside what lasts in time, which would take the step for that.
    return {
        name: arm
        if arm.errors is None
        else replace(arm, errors=replace(arm.errors, time_correlated_count=0))
        for name, arm in found.items()
    }

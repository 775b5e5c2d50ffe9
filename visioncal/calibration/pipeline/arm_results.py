"""The robots' arms of a whole cell: read from its session, calibrated with its frames, worded."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages import diagnose, thermal
from visioncal.calibration.stages.arms import ArmFound, RobotArm
from visioncal.calibration.stages.cause_ranking import MOVED_AT_ONCE
from visioncal.calibration.stages.cell import Cell, robot_key
from visioncal.calibration.stages.diagnose import ResidualTest
from visioncal.calibration.stages.kinematics import doubts, findings
from visioncal.calibration.stages.reported_poses import Reported
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.types import FloatArray
from visioncal.core.verdict import NOTE, Finding, remarks
from visioncal.estimation.arm import covariance_of_size, misfit_covariance
from visioncal.estimation.intervals import expected_levels
from visioncal.estimation.null_space import joint_words
from visioncal.estimation.parts import State
from visioncal.estimation.pose_errors import find_pose_errors
from visioncal.estimation.problem import Problem
from visioncal.estimation.residual_tests import inflation
from visioncal.estimation.slight_steps import Slip, step_covariance, with_step
from visioncal.estimation.solve import (
    Solution,
    covariance_of,
    held_shift,
    robot_likelihood,
)

# What moved at once, as a source of uncertainty.
STEP = "what moved at once"


def arms_of(cell: Cell, robots: Mapping[str, Reported]) -> dict[str, RobotArm]:
    """Reads the arms of a cell, as they are stated."""
    found, session = {}, cell.session
    for name, robot in robots.items():
        key = robot_key(name)
        if key in cell.poses:
            rows = {
                observation.station: observation.robots[name]
                for observation in session.observations
                if name in observation.robots
            }
            stood = np.flatnonzero(np.isfinite(cell.poses[key][:, 0, 0])).tolist()
            views = [rows[index] for index in stood]
            found[key] = RobotArm.of(key, cell.poses[key], views, robot.matched, (session, name))
    return found


def joint_offsets(arms: Mapping[str, RobotArm]) -> dict[str, FloatArray]:
    """(s, 6, n) how flanges move with the offsets of their joints, of arms that are modelled."""
    found = {name: arm.joint_offsets for name, arm in arms.items()}
    return {name: array for name, array in found.items() if array is not None}


def covariance_beside_noise(
    problem: Problem,
    fit: Solution,
    arms: Mapping[str, RobotArm],
    found: Mapping[str, ResidualTest],
    offsets: Mapping[str, FloatArray],
    *,
    is_fit: bool = True,
) -> dict[str, FloatArray]:
    """Covariances (p, p) that a fit has of what is no noise, by their source.

    Args:
        problem: The observations that agree.
        fit: Their fit.
        arms: The arms; errors that are no unknowns count, and how well the size of others is known.
        found: What their residuals show.
        offsets: How flanges move with the offsets of their joints; see `joint_offsets`.
        is_fit: Whether it is at rest: a closed form is pulled by more than what is held.
    """
    parts: dict[str, FloatArray] = {}
    if len(problem.units[1]):
        levels = expected_levels(problem, fit.state, fit.noise)
        for robot, arm in arms.items():
            # Where an arm errs by what is no unknown, the noise is what stays beside that, and not
            # the most likely one of a fit without these errors.
            if arm.errors is not None and arm.errors.is_significant and not arm.errors.is_estimated:
                at = problem.robots.index(robot)
                levels[at] = fit.noise.robots[at]
        more = covariance_of(problem, replace(fit, noise=replace(fit.noise, robots=levels)))
        parts["noise_level"] = more - covariance_of(problem, fit)
    shift = held_shift(problem, fit) * float(is_fit)
    if shift.any():
        parts["held_values"] = np.outer(shift, shift)
    for robot, arm in arms.items():
        if arm.errors is not None and not arm.errors.is_estimated:
            errors = misfit_covariance(problem, fit.state, fit.noise, robot, arm.errors)
            parts[f"arm{_of(arms, robot)}"] = errors
        elif arm.errors is not None:
            covariance = covariance_of(problem, fit)
            parts[f"size of arm errors{_of(arms, robot)}"] = covariance_of_size(
                problem, covariance, robot, arm.errors
            )
    return parts | _beyond_noise(problem, fit, arms, found, offsets)


def _beyond_noise(
    problem: Problem,
    fit: Solution,
    arms: Mapping[str, RobotArm],
    found: Mapping[str, ResidualTest],
    offsets: Mapping[str, FloatArray],
) -> dict[str, FloatArray]:
    """Covariances (p, p) by what residuals show: stops that err alike, and what moved at once."""
    parts: dict[str, FloatArray] = {}
    for robot, test in found.items():
        if test.alike is not None and test.alike.is_significant:
            more = inflation(problem, fit.state, fit.noise, robot, test.alike.factor)
            parts[f"misfit{_of(arms, robot)}"] = more
        if test.step is not None:
            parts[STEP] = step_covariance(problem, fit, test.step, offsets)
    return parts


def _of(arms: Mapping[str, RobotArm], robot: str) -> str:
    """Names, of several robots, the one that a source is of."""
    return "" if len(arms) == 1 else f" of robot {robot}"


def doubts_of_arms(
    arms: Mapping[str, RobotArm],
    found: Mapping[str, ResidualTest],
    results: Mapping[str, ArmFound],
    asked: str,
    cell: Cell,
) -> Iterator[Finding]:
    """Finds what speaks against the robots."""

    def joint(slip: Slip) -> str:
        matched = arms[slip.robot].matched
        words = (
            f"joint {slip.joint + 1}" if matched is None else joint_words(slip.joint, matched.robot)
        )
        return words if len(arms) == 1 else f"{words} of robot {slip.robot}"

    for robot, arm in arms.items():
        mine = _doubts(arm, found.get(robot), asked, cell, joint)
        for finding in (*mine, *results[robot].doubts()):
            yield finding if finding.kind in MOVED_AT_ONCE else finding.of(_called(arms, robot))


def notes_on_arms(arms: Mapping[str, RobotArm], results: Mapping[str, ArmFound]) -> Iterator[str]:
    """Words what was found of the arms and is no reason for doubt."""
    for robot, arm in arms.items():
        drifts = () if arm.thermal is None else thermal.findings(arm.thermal)
        chosen = () if arm.kinematics is None else findings(arm.kinematics)
        for remark in remarks((*drifts, *chosen, *results[robot].notes()), NOTE):
            yield remark.of(_called(arms, robot)).words


def _doubts(
    arm: RobotArm,
    found: ResidualTest | None,
    asked: str,
    cell: Cell,
    joint: Callable[[Slip], str],
) -> Iterator[Finding]:
    if arm.joints_rad is None and asked not in ("auto", "hand-eye"):
        yield Finding(
            "level",
            "It stays as it reports itself: its errors take joint angles and a known model.",
        )
    elif arm.thermal is None and asked == thermal.LEVEL:
        words = "No data show how it drifts with its temperature: that stays in its noise."
        yield Finding("level", words)
    if arm.kinematics is not None:
        yield from doubts(arm.kinematics)
    if found is not None:
        calibrated = arm.model is not None
        aside = "" if arm.heat is None else arm.heat.set_aside
        for doubt in diagnose.doubts(found, arm.errors, cell, joint, calibrated=calibrated):
            if doubt.kind == "moved_slowly" and aside:
                words = f"Whether the arm drifts with its temperature was not looked for: {aside}."
                yield replace(doubt, words=f"{doubt.words} {words}")
            else:
                yield doubt


def _called(arms: Mapping[str, RobotArm], robot: str) -> str:
    """Names, of several robots, the one that a finding is of."""
    return "" if len(arms) == 1 else f"Robot {robot}"


def one_by_one(
    arms: Mapping[str, RobotArm],
    problem: Problem,
    fit: Solution,
    change: Callable[[RobotArm, Problem, State], RobotArm],
) -> dict[str, RobotArm]:
    """Changes one arm after the other, beside the errors of the others.

    Args:
        arms: The arms.
        problem: The observations, with the errors of all arms.
        fit: Their fit.
        change: Makes of an arm, of the observations with that arm as it is stated, and of where
            their unknowns begin, the changed arm.
    """
    found = dict(arms)
    values = {effect: problem.values_of(effect.name, fit.state) for effect in problem.effects}
    for name, arm in arms.items():
        stated = arm.without_errors(problem)
        state = fit.state
        if stated.effects != tuple(values):
            start = [values.get(effect, effect.values) for effect in stated.effects]
            state = State(fit.state.edges, np.concatenate([np.zeros(0), *start]))
        found[name] = change(arm, stated, state)
        problem = found[name].put_into(problem)
    return found


def with_drifts(
    arms: Mapping[str, RobotArm], problem: Problem, fit: Solution, asked: str
) -> dict[str, RobotArm]:
    """Looks for drift with temperature, one arm after the other, beside the errors of the others.

    Raises:
        DataError: It is asked for, and no arm has what it takes.
        DegenerateError: Likewise, and all was observed about equally warm.
    """
    refused = []

    def with_drift(arm: RobotArm, stated: Problem, start: State) -> RobotArm:
        try:
            return arm.with_drift(stated, start, asked)
        except (DataError, DegenerateError) as error:
            refused.append(error.within(f"robot {arm.robot}"))
            return arm

    found = one_by_one(arms, problem, fit, with_drift)
    if refused and len(refused) == len(found):
        raise refused[0]
    return found


def with_errors(
    arms: Mapping[str, RobotArm], problem: Problem, fit: Solution
) -> dict[str, RobotArm]:
    """Looks for errors of each arm that follow its posture, the others being as stated."""
    likelihood = robot_likelihood(problem, fit.state, fit.noise)
    return {
        name: arm.with_errors(likelihood, problem.robots.index(name)) for name, arm in arms.items()
    }


def with_pose_errors(
    arms: Mapping[str, RobotArm], problem: Problem, fit: Solution
) -> dict[str, RobotArm]:
    """Weighs what arms do wrong of which the joints are not known."""
    return {
        name: arm
        if arm.is_modelled
        else replace(arm, errors=find_pose_errors(problem, fit.state, fit.noise, name))
        for name, arm in arms.items()
    }


def beside_steps(
    arms: Mapping[str, RobotArm],
    problem: Problem,
    fit: Solution,
    found: Mapping[str, ResidualTest],
) -> Mapping[str, RobotArm]:
    """Weighs these errors beside what moved or changed at once, which counts by itself.

    Processes over time and postures would explain a step, too.
    """
    step = next((test.step for test in found.values() if test.step), None)
    if step is None or isinstance(step, Slip) or all(arm.is_modelled for arm in arms.values()):
        return arms
    return with_pose_errors(arms, *with_step(problem, fit, step))

"""Residual tests for drift, steps and correlated errors, and their findings."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.suspects.ranking import NO_JOINTS
from visioncal.core.finding_kinds import BOARD_CHANGED, MOVED_FRAME
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.transforms import pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import PLAN, Finding, Remedy
from visioncal.estimation.arm import LEVER_M, SIGNIFICANT, ArmErrors, stops_of
from visioncal.estimation.moves import Move
from visioncal.estimation.pose_errors import find_pose_errors
from visioncal.estimation.problem import Problem
from visioncal.estimation.residual_tests import Drift, Neighbours, drift, neighbours
from visioncal.estimation.slight_steps import (
    Resized,
    Slip,
    differs_elsewhere,
    evidence_gain,
    find_slight_move,
    leaves_noise,
    log_gain,
    resized_board,
    slipped_joint,
)
from visioncal.estimation.solve import Solution

# A change from some stop on: of a frame, a joint's offset or a board's size.
Step: TypeAlias = Move | Slip | Resized
_THINGS = {"cam": "The camera", "target": "The target", "instrument": "The instrument"}
# Fewest stops whose residuals can be tested.
_FEWEST_STOPS = 6
# Log-likelihood ratio, doubled, by which one step is clearly likelier: odds of a hundred to one.
_CLEARLY = 2.0 * float(np.log(100.0))


@dataclass(frozen=True)
class ResidualTest:
    """Deviations of the residuals of one robot's stops from noise."""

    # Correlation of neighbouring stops; None for an arm whose joints are not known, as its
    # covariance includes that.
    neighbours: Neighbours | None
    drift: Drift | None  # Drift of its base or of what it observes; None where noise explains it.
    step: Step | None = None  # Sudden change that explains more than a drift; None without one.
    rival: Step | None = None  # Another step that explains about as much; None without one.


def residual_tests(
    problem: Problem,
    fit: Solution,
    errors: Mapping[str, ArmErrors],
    offsets: Mapping[str, FloatArray] = MappingProxyType({}),
) -> dict[str, ResidualTest]:
    """Tests the residuals of each robot with enough stops for deviations from noise.

    Args:
        problem: The observations, with stops in the order of the session.
        fit: Their converged fit.
        errors: Errors of arms whose joints are not known, by robot.
        offsets: (s, 6, n) Jacobian of the flange by joint offsets, for the other robots.
    """
    robots = [robot for robot in problem.robots if len(stops_of(problem, robot)) >= _FEWEST_STOPS]
    # Robots share frames: steps are searched, and reported, once for all of them.
    slight = _slight_move(problem, fit) if robots else None
    slipped = slipped_joint(
        problem, fit, {robot: offsets[robot] for robot in robots if robot in offsets}
    )
    resized = resized_board(problem, fit) if robots else None
    tests: dict[str, ResidualTest] = {}
    for robot in robots:
        fitted = (problem, fit.state, fit.noise, robot)
        drifted, arm = drift(*fitted), errors.get(robot)
        alike = None if arm else neighbours(*fitted)
        steps = _steps(problem, fit, (slight, slipped, resized), drifted)
        # Motion that arm errors, correlated by posture or time, explain as well is not reported.
        if arm:
            beside_errors = _beside_errors(problem, fit, steps, arm, robot)
            steps = sorted(beside_errors, key=lambda step: -step.mahalanobis_sq)
        if arm and drifted and drifted.mahalanobis_sq < arm.gain:
            drifted = None
        if steps:
            # The step itself makes the errors of neighbouring stops correlate.
            is_reported = any(test.step for test in tests.values())
            first, second = (*steps, None)[:2]
            tests[robot] = ResidualTest(None, None, *(() if is_reported else (first, second)))
        else:
            tests[robot] = ResidualTest(alike, drifted)
    return tests


def _slight_move(problem: Problem, fit: Solution) -> Move | None:
    """The most significant step of a frame; None where noise explains all of them."""
    # A push shifts positions alone, and dominates their noise: with few views, no test by the noise
    # of all residuals finds it.
    frames = tuple(problem.unknown)
    push = find_slight_move(problem, fit, frames, kinds=2)
    if push is None:
        return None
    if (move := find_slight_move(problem, fit, frames)) is not None:
        return move
    gain, *_ = evidence_gain(problem, fit, push)
    return push if gain - _search_penalty(problem) > _CLEARLY else None


def _steps(
    problem: Problem, fit: Solution, candidates: Sequence[Step | None], drifted: Drift | None
) -> list[Step]:
    """Steps that explain the residuals better than a drift does, most likely first."""
    # The move of a frame has six parameters, a joint's offset or a board's size one: each is
    # penalised as in the Bayesian information criterion (Schwarz 1978).
    penalty = _search_penalty(problem)
    per_parameter = float(np.log(problem.observations.directions.sum()))
    likely: list[tuple[float, Step]] = []
    least = log_gain(problem, fit, drifted.mahalanobis_sq) if drifted else 0.0
    for step in candidates:
        gain = log_gain(problem, fit, step.mahalanobis_sq) - penalty if step else -np.inf
        if step is None or gain < least:
            continue
        if not isinstance(step, Slip) and not leaves_noise(problem, fit, step):
            continue
        count = 6 if isinstance(step, Move) else 1
        likely.append((gain - count * per_parameter, replace(step, mahalanobis_sq=gain)))
    likely.sort(key=lambda pair: -pair[0])
    return [step for evidence, step in likely if evidence > likely[0][0] - _CLEARLY]


def _search_penalty(problem: Problem) -> float:
    """Penalty on the gain of a step, which may be at any stop and of any frame or joint."""
    return 2.0 * float(np.log(len(problem.unknown) * (1 + int(problem.observations.stops.max()))))


def _beside_errors(
    problem: Problem, fit: Solution, steps: Sequence[Step], arm: ArmErrors, robot: str
) -> Iterator[Step]:
    """Steps that a robot's errors do not explain, with their gains beside these errors."""
    for step in steps:
        if isinstance(step, Slip):
            if step.mahalanobis_sq >= arm.gain:
                yield step
            continue
        if isinstance(step, Move) and differs_elsewhere(problem, fit, step):
            continue
        gain, apart, there = evidence_gain(problem, fit, step)
        errors = find_pose_errors(apart, there.state, there.noise, robot)
        gain = gain - _search_penalty(problem) + (errors.gain if errors else 0.0) - arm.gain
        if gain > _CLEARLY:
            yield replace(step, mahalanobis_sq=gain)


def residual_findings(
    found: ResidualTest,
    arm: ArmErrors | None,
    cell: Cell,
    joint: Callable[[Slip], str],
    *,
    calibrated: bool,
) -> Iterator[Finding]:
    """Findings on deviations of a robot's residuals from noise.

    Args:
        found: Results of the tests.
        arm: Posture-dependent errors of the arm.
        cell: The cell, for the names of its stops.
        joint: Function that gives the joint of a slip in words.
        calibrated: Whether the arm was calibrated.
    """
    alike, moved = found.neighbours, found.drift
    if arm is not None and arm.is_significant and not calibrated and arm.of_links:
        size = mm_and_deg(1e3 * LEVER_M * arm.sigma, float(np.rad2deg(arm.sigma)))
        yield Finding(
            "arm_errors",
            f"Residuals follow the arm's posture (likelihood ratio {arm.gain:.0f}, noise stays "
            f"under {SIGNIFICANT:.0f}): its links are off from the model by typically {size}; "
            "they were estimated along. What of them looks the same in all views is in no "
            "residual, and counts in the covariance.",
            Remedy(
                "Add stops all over the workspace, so that the arm can be calibrated along.",
                f"{PLAN} --for kinematics",
            ),
            until_mm=0.0,
            mahalanobis_sq=arm.gain,
        )
    if arm is not None and arm.is_significant and arm.fit_sigmas is not None:
        yield _arm_errors_finding(arm, *(np.sqrt(3.0) * arm.fit_sigmas).tolist())
    if found.step is not None:
        yield _step_finding(found.step, found.rival, cell, joint)
    if moved is not None:
        yield Finding(
            "moved_slowly",
            f"Residuals drift with time: from the first stop to the last, base or target moved by "
            f"{_size(moved.moved_m, moved.moved_rad)}.",
            Remedy("Fasten base and target, let the arm warm up, and record again."),
        )
    if alike is not None and alike.is_significant:
        yield Finding(
            "correlated_errors",
            f"Neighbouring stops err alike: leaving them out in blocks moves the answer "
            f"{figure(np.sqrt(alike.factor))} times farther than independent noise would. The "
            "robot's share of the sigmas was multiplied by as much.",
            Remedy("Record again, with the stops in an order of chance."),
        )


def _step_finding(
    step: Step, rival: Step | None, cell: Cell, joint: Callable[[Slip], str]
) -> Finding:
    """Finding on a step, and on a rival that may be the cause instead."""
    instead = (
        f" Or else, as these views leave it open: {_step_words(rival, cell, joint)}."
        if rival
        else ""
    )
    kind, between, do = MOVED_FRAME, "both places", ""
    if isinstance(step, Slip):
        kind, between = "joint_slipped", "before and after"
        do = "Look whether the joint keeps its zero"
    elif isinstance(step, Resized):
        kind, between = BOARD_CHANGED, "both boards"
        do = "Measure both prints, take one of them for all views"
    else:
        thing = _THINGS.get(step.frame, step.frame)
        do = f"Fasten {thing[0].lower()}{thing[1:]}"
    return Finding(
        kind,
        f"{_step_words(step, cell, joint)}; the result is between {between}.{instead}",
        cell.or_separately(do, step.stop),
        mahalanobis_sq=step.mahalanobis_sq,
    )


def _step_words(step: Step, cell: Cell, joint: Callable[[Slip], str]) -> str:
    if isinstance(step, Slip):
        # The reading's change is opposite to the correction that gives the joint's angle.
        reads_deg, sigma_deg = (
            float(np.rad2deg(value)) for value in (-step.step_rad, step.sigma_rad)
        )
        sign = "+" if reads_deg > 0.0 else "-"
        return (
            f"The offset of {joint(step)} steps: {cell.start_words(step.stop)}, it reads "
            f"{sign}{figure(abs(reads_deg))} deg (sigma {figure(sigma_deg)}) from what it read "
            "before, as where an encoder slipped or a zero was lost"
        )
    thing = _THINGS.get(step.frame, step.frame)
    if isinstance(step, Resized):
        return (
            f"{thing} is another one: {cell.start_words(step.stop)}, it is "
            f"{figure(100.0 * abs(step.share))} % {'larger' if step.share > 0.0 else 'smaller'} "
            f"(sigma {figure(100.0 * step.sigma)} %) than before, by the robot's motion"
        )
    shift_mm, turn_deg = pose_difference(np.eye(4), step.change)
    return (
        f"{thing} moved at once: {cell.start_words(step.stop)}, it is "
        f"{mm_and_deg(shift_mm, turn_deg)} from where it was"
    )


def _size(shift_m: float, turn_rad: float) -> str:
    return mm_and_deg(1e3 * shift_m, float(np.rad2deg(turn_rad)))


def _arm_errors_finding(arm: ArmErrors, turn_rad: float, shift_m: float) -> Finding:
    """Finding on an arm whose joints are not known, with the rms error of a look [rad, m]."""
    away = ""
    if arm.far_posture_errors is not None:
        actual, predicted = (
            _size(float(shift), float(turn)) for turn, shift in arm.far_posture_errors
        )
        away = f", at postures away from them by {actual} (left out in turn; predicted {predicted})"
    return Finding(
        "arm_errors",
        "Residuals follow the arm's posture, or last from stop to stop (likelihood ratio "
        f"{arm.gain:.0f}, noise stays under {SIGNIFICANT:.0f}): a look near the views errs by "
        f"{_size(shift_m, turn_rad)} (rms){away}. More views will not help: joint angles or a "
        "kinematic calibration of the arm will. What of its errors looks the same in all views is "
        "in no residual, and counts in the covariance.",
        NO_JOINTS,
        until_mm=0.0,
        mahalanobis_sq=arm.gain,
    )

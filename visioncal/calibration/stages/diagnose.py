"""Whether the residuals are noise: what they show beyond it, in words."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from visioncal.calibration.stages.cause_ranking import BOARD_CHANGED, MOVED_FRAME, NO_JOINTS
from visioncal.calibration.stages.cell import Cell
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
    leaves_noise,
    log_gain,
    resized_board,
    slight_move,
    slipped_joint,
)
from visioncal.estimation.solve import Solution

# What may be otherwise from some stop on.
Step: TypeAlias = Move | Slip | Resized
_THINGS = {"cam": "The camera", "target": "The target", "instrument": "The instrument"}
# Fewer stops than this leave no residuals to be tested.
_FEWEST_STOPS = 6
# Of two steps, one is clearly the likelier where it is so by odds of a hundred to one.
_CLEARLY = 2.0 * float(np.log(100.0))


@dataclass(frozen=True)
class ResidualTest:
    """What the residuals of one robot's stops show beyond noise.

    Attributes:
        alike: Whether neighbouring stops err alike; None of an arm whose joints are not known,
            whose covariance has that.
        moved: How its base or what it looks at crept; None where noise explains it.
        step: What moved at once, and where that explains more than a creep does.
        rival: What explains about as much as that; None where nothing does.
    """

    alike: Neighbours | None
    moved: Drift | None
    step: Step | None = None
    rival: Step | None = None


def misfits(
    problem: Problem,
    fit: Solution,
    errors: Mapping[str, ArmErrors],
    offsets: Mapping[str, FloatArray] = MappingProxyType({}),
) -> dict[str, ResidualTest]:
    """Tests the residuals of each robot's stops for what is no noise; of few stops, none.

    Args:
        problem: The observations, their stops in the order of the session.
        fit: Their fit, at rest.
        errors: Those of arms whose joints are not known, by the robot.
        offsets: (s, 6, n) of the others, how their flanges move with the offsets of their joints.
    """
    robots = [robot for robot in problem.robots if len(stops_of(problem, robot)) >= _FEWEST_STOPS]
    # Frames are those of all robots: what moved is sought once, and said once.
    slight = _slight_move(problem, fit) if robots else None
    slipped = slipped_joint(
        problem, fit, {robot: offsets[robot] for robot in robots if robot in offsets}
    )
    resized = resized_board(problem, fit) if robots else None
    found: dict[str, ResidualTest] = {}
    for robot in robots:
        fitted = (problem, fit.state, fit.noise, robot)
        crept, arm = drift(*fitted), errors.get(robot)
        alike = None if arm else neighbours(*fitted)
        steps = _steps(problem, fit, (slight, slipped, resized), crept)
        # What a process over postures or time explains as well is no motion.
        if arm:
            beside = [*_beside_errors(problem, fit, steps, arm, robot)]
            steps = sorted(beside, key=lambda step: -step.mahalanobis_sq)
        if arm and crept and crept.mahalanobis_sq < arm.gain:
            crept = None
        if steps:
            # Before and after it, neighbours err alike because of it.
            known = any(test.step for test in found.values())
            first, second = (*steps, None)[:2]
            found[robot] = ResidualTest(None, None, *(() if known else (first, second)))
        else:
            found[robot] = ResidualTest(alike, crept)
    return found


def _slight_move(problem: Problem, fit: Solution) -> Move | None:
    """The most significant step of a frame; None where noise explains all of them."""
    # A push is in the noise of places alone, and makes up most of it: no test by the noise of all
    # residuals finds it beside few views.
    frames = tuple(problem.unknown)
    pushed = slight_move(problem, fit, frames, kinds=2)
    if pushed is None:
        return None
    if (found := slight_move(problem, fit, frames)) is not None:
        return found
    gain, *_ = evidence_gain(problem, fit, pushed)
    return pushed if gain - _price(problem) > _CLEARLY else None


def _steps(
    problem: Problem,
    fit: Solution,
    found: Sequence[Step | None],
    crept: Drift | None,
) -> list[Step]:
    """What moved at once, where that explains the residuals better than a creep from end to end."""
    # A joint's or a size's has one number where a frame's has six, of which each must gain by as
    # much as the Bayesian information criterion asks for (Schwarz 1978).
    price = _price(problem)
    each = float(np.log(problem.observations.directions.sum()))
    likely: list[tuple[float, Step]] = []
    least = log_gain(problem, fit, crept.mahalanobis_sq) if crept else 0.0
    for move in found:
        gain = log_gain(problem, fit, move.mahalanobis_sq) - price if move else -np.inf
        if move is None or gain < least:
            continue
        if not isinstance(move, Slip) and not leaves_noise(problem, fit, move):
            continue
        numbers = 6 if isinstance(move, Move) else 1
        likely.append((gain - numbers * each, replace(move, mahalanobis_sq=gain)))
    likely.sort(key=lambda pair: -pair[0])
    return [move for gain, move in likely if gain > likely[0][0] - _CLEARLY]


def _price(problem: Problem) -> float:
    """What a step has to gain more, as it may be at any stop and of any frame or joint."""
    return 2.0 * float(np.log(len(problem.unknown) * (1 + int(problem.observations.stops.max()))))


def _beside_errors(
    problem: Problem, fit: Solution, steps: Sequence[Step], arm: ArmErrors, robot: str
) -> Iterator[Step]:
    """The steps that a robot's errors do not explain, with what they gain beside these."""
    for step in steps:
        if isinstance(step, Slip):
            if step.mahalanobis_sq >= arm.gain:
                yield step
            continue
        if isinstance(step, Move) and differs_elsewhere(problem, fit, step):
            continue
        gain, apart, there = evidence_gain(problem, fit, step)
        errors = find_pose_errors(apart, there.state, there.noise, robot)
        beside = gain - _price(problem) + (errors.gain if errors else 0.0) - arm.gain
        if beside > _CLEARLY:
            yield replace(step, mahalanobis_sq=beside)


def doubts(
    found: ResidualTest,
    arm: ArmErrors | None,
    cell: Cell,
    joint: Callable[[Slip], str],
    *,
    calibrated: bool,
) -> Iterator[Finding]:
    """Finds what of a robot's residuals is no noise, and what it probably is.

    Args:
        found: What the residuals show.
        arm: The errors of an arm whose joints are not known.
        cell: What the session calls its stops.
        joint: Words a joint of a robot.
        calibrated: Whether the arm was.
    """
    alike, moved = found.alike, found.moved
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
    if arm is not None and arm.is_significant and arm.look is not None:
        yield _of_looks(arm, *(np.sqrt(3.0) * arm.look).tolist())
    if found.step is not None:
        yield _at_once(found.step, found.rival, cell, joint)
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


def _at_once(
    step: Step,
    rival: Step | None,
    cell: Cell,
    joint: Callable[[Slip], str],
) -> Finding:
    """Says what moved at once, and what may have in its place."""
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
        cell.or_apart(do, step.stop),
        mahalanobis_sq=step.mahalanobis_sq,
    )


def _step_words(step: Step, cell: Cell, joint: Callable[[Slip], str]) -> str:
    if isinstance(step, Slip):
        # What is to be added to a reading so that it is the joint's angle, the other way round.
        reads_deg, sigma_deg = (
            float(np.rad2deg(value)) for value in (-step.step_rad, step.sigma_rad)
        )
        sign = "+" if reads_deg > 0.0 else "-"
        return (
            f"The offset of {joint(step)} steps: {cell.from_when(step.stop)}, it reads "
            f"{sign}{figure(abs(reads_deg))} deg (sigma {figure(sigma_deg)}) from what it read "
            "before, as where an encoder slipped or a zero was lost"
        )
    thing = _THINGS.get(step.frame, step.frame)
    if isinstance(step, Resized):
        return (
            f"{thing} is another one: {cell.from_when(step.stop)}, it is "
            f"{figure(100.0 * abs(step.share))} % {'larger' if step.share > 0.0 else 'smaller'} "
            f"(sigma {figure(100.0 * step.sigma)} %) than before, by the robot's motion"
        )
    shift_mm, turn_deg = pose_difference(np.eye(4), step.change)
    return (
        f"{thing} moved at once: {cell.from_when(step.stop)}, it is "
        f"{mm_and_deg(shift_mm, turn_deg)} from where it was"
    )


def _size(shift_m: float, turn_rad: float) -> str:
    return mm_and_deg(1e3 * shift_m, float(np.rad2deg(turn_rad)))


def _of_looks(arm: ArmErrors, turned: float, shifted: float) -> Finding:
    """What an arm does wrong whose joints are not known, by how far [rad, m] a look errs."""
    away = ""
    if arm.away is not None:
        there, predicted = (_size(float(place), float(turn)) for turn, place in arm.away)
        away = f", at postures away from them by {there} (left out in turn; predicted {predicted})"
    return Finding(
        "arm_errors",
        "Residuals follow the arm's posture, or last from stop to stop (likelihood ratio "
        f"{arm.gain:.0f}, noise stays under {SIGNIFICANT:.0f}): a look near the views errs by "
        f"{_size(shifted, turned)} (rms){away}. More views will not help: joint angles or a "
        "kinematic calibration of the arm will. What of its errors looks the same in all views is "
        "in no residual, and counts in the covariance.",
        NO_JOINTS,
        until_mm=0.0,
        mahalanobis_sq=arm.gain,
    )

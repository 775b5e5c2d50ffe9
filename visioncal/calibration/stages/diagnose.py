"""Whether the residuals are noise: what they show beyond it, in words."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.cause_ranking import NO_JOINTS
from visioncal.core.number_format import figure
from visioncal.core.transforms import pose_difference
from visioncal.core.verdict import PLAN, Finding, Step
from visioncal.estimation.arm import LEVER_M, SIGNIFICANT, ArmErrors, stops_of
from visioncal.estimation.moves import Move, slight_move
from visioncal.estimation.problem import Problem
from visioncal.estimation.residual_tests import Drift, Neighbours, drift, neighbours
from visioncal.estimation.solve import Solution

_THINGS = {"cam": "The camera", "target": "The target"}
# Fewer stops than this leave no residuals to be tested.
_FEWEST_STOPS = 6
# Noise is left, however much a step explains.
_MOST_EXPLAINED = 0.99


@dataclass(frozen=True)
class ResidualTest:
    """What the residuals of one robot's stops show beyond noise.

    Attributes:
        alike: Whether neighbouring stops err alike; None of an arm whose joints are not known,
            whose covariance has that.
        moved: How its base or what it looks at crept; None where noise explains it.
        step: What moved at once, and where that explains more than a creep does.
    """

    alike: Neighbours | None
    moved: Drift | None
    step: Move | None = None


def misfits(
    problem: Problem, fit: Solution, errors: Mapping[str, ArmErrors]
) -> dict[str, ResidualTest]:
    """Tests the residuals of each robot's stops for what is no noise; of few stops, none.

    Args:
        problem: The observations, their stops in the order of the session.
        fit: Their fit, at rest.
        errors: Those of arms whose joints are not known, by the robot.
    """
    robots = [it for it in problem.robots if len(stops_of(problem, it)) >= _FEWEST_STOPS]
    # Frames are those of all robots: what moved is sought once, and said once.
    slight = slight_move(problem, fit, tuple(problem.unknown)) if robots else None
    found: dict[str, ResidualTest] = {}
    for robot in robots:
        fitted = (problem, fit.state, fit.noise, robot)
        crept, arm = drift(*fitted), errors.get(robot)
        alike = None if arm else neighbours(*fitted)
        step = _step(problem, slight, crept)
        # What a process over postures or time explains as well is no motion.
        if arm and step and step.mahalanobis_sq < arm.gain:
            step = None
        if arm and crept and crept.mahalanobis_sq < arm.gain:
            crept = None
        if step:
            # Before and after it, neighbours err alike because of it.
            known = any(it.step for it in found.values())
            found[robot] = ResidualTest(None, None, None if known else step)
        else:
            found[robot] = ResidualTest(alike, crept)
    return found


def _step(problem: Problem, found: Move | None, crept: Drift | None) -> Move | None:
    """What moved at once, where that explains the residuals better than a creep from end to end.

    A step may be at any stop and of any frame: it must gain by twice the logarithm of these.
    """
    price = 2.0 * np.log(len(problem.unknown) * (1 + int(problem.observations.stops.max())))
    if found is None or (crept and found.mahalanobis_sq < crept.mahalanobis_sq + price):
        return None
    # The noise is that of a fit without the step: with it, twice the logarithm gains more.
    freedom = max(6 * len(problem) - problem.size, 7)
    share = min(found.mahalanobis_sq / freedom, _MOST_EXPLAINED)
    return replace(found, mahalanobis_sq=-freedom * float(np.log1p(-share)) - price)


def doubts(
    found: ResidualTest,
    arm: ArmErrors | None,
    from_when: Callable[[int], str],
    *,
    calibrated: bool,
) -> Iterator[Finding]:
    """Finds what of a robot's residuals is no noise, and what it probably is.

    Args:
        found: What the residuals show.
        arm: The errors of an arm whose joints are not known.
        from_when: Words a stop of the fit in the session's own numbers.
        calibrated: Whether the arm was.
    """
    alike, moved = found.alike, found.moved
    if arm is not None and arm.is_significant and not calibrated and arm.of_links:
        size = (
            f"{figure(1e3 * LEVER_M * arm.sigma)} mm and {figure(float(np.rad2deg(arm.sigma)))} deg"
        )
        yield Finding(
            "arm_errors",
            f"Residuals follow the arm's posture (likelihood ratio {arm.gain:.0f}, noise stays "
            f"under {SIGNIFICANT:.0f}): its links are off from the model by typically {size}; "
            "they were estimated along. What of them looks the same in all views is in no "
            "residual, and counts in the covariance.",
            Step(
                "Add stops all over the workspace, so that the arm can be calibrated along.",
                f"{PLAN} --for kinematics",
            ),
            until_mm=0.0,
            mahalanobis_sq=arm.gain,
        )
    if arm is not None and arm.is_significant and arm.look is not None:
        yield _of_looks(arm, *(np.sqrt(3.0) * arm.look).tolist())
    if found.step is not None:
        shift_mm, turn_deg = pose_difference(np.eye(4), found.step.change)
        frame, stop = found.step.frame, found.step.stop
        yield Finding(
            "moved_at_once",
            f"{_THINGS.get(frame, frame)} moved at once: {from_when(stop)}, it is "
            f"{figure(shift_mm)} mm and {figure(turn_deg)} deg from where it was; the result is "
            "between both places.",
            Step("Fasten it, and record again; or keep only the views before or after."),
            mahalanobis_sq=found.step.mahalanobis_sq,
        )
    if moved is not None:
        yield Finding(
            "moved_slowly",
            f"Residuals drift with time: from the first stop to the last, base or target moved by "
            f"{_size(moved.moved_m, moved.moved_rad)}.",
            Step("Fasten base and target, let the arm warm up, and record again."),
        )
    if alike is not None and alike.is_significant:
        yield Finding(
            "correlated_errors",
            f"Neighbouring stops err alike: leaving them out in blocks moves the answer "
            f"{figure(np.sqrt(alike.factor))} times farther than independent noise would. The "
            "robot's share of the sigmas was multiplied by as much.",
            Step("Record again, with the stops in an order of chance."),
        )


def _size(shift_m: float, turn_rad: float) -> str:
    return f"{figure(1e3 * shift_m)} mm and {figure(float(np.rad2deg(turn_rad)))} deg"


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

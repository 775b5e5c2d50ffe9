"""Stage 8: whether the residuals are noise, and where the uncertainty comes from."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.estimation.appearance import LENS_AND_BOARD, Free
from visioncal.estimation.arm import LEVER_M, SIGNIFICANT, ArmErrors, misfit_covariance, stops_of
from visioncal.estimation.budget import Sources, covariance_by_source, point_covariance, radius95
from visioncal.estimation.intervals import noise_intervals
from visioncal.estimation.misfit import Drift, Neighbours, drift, neighbours
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.parts import ROBOT
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, fit_problem
from visioncal.stages.handeye import HandEyeResult
from visioncal.threads import one_blas_thread
from visioncal.types import FloatArray, IntArray, Mount

# Fewer stops than this leave no residuals to be tested.
_FEWEST_STOPS = 6
# Whose effects' uncertainty is, by their names; that of all others is the clock's.
_OF_EFFECTS = {
    "points": "instrument",
    f"temperature of {ROBOT}": "temperature",
    f"arm of {ROBOT}": "arm",
}


@dataclass(frozen=True)
class Misfit:
    """What the residuals of one robot's stops show beyond noise.

    Attributes:
        alike: Whether neighbouring stops err alike.
        moved: How its base or what it looks at crept; None where noise explains it.
    """

    alike: Neighbours
    moved: Drift | None


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the residuals show beyond noise.

    Attributes:
        point_cam: (3,) the place of work in the camera's frame: the target's middle, as the views
            see it on average [m].
        budget_mm: Standard deviation of such a point's place, by source and as a `total` [mm].
        intervals: (2, 2) 95 % intervals of the noise's levels, rotation [rad] first.
        spectrum: (12,) standard deviations along the principal directions of both edges, ascending,
            in units of the largest that are accepted (5 mm, 0.5 deg).
        radius95_mm: The place of work is right to within this in 95 % of cases [mm].
        inflation: By how much the covariance was multiplied because neighbouring stops err alike.
        arm: Errors that follow the arm's posture.
        warnings: What is no noise, and what it probably is.
    """

    point_cam: FloatArray
    budget_mm: Mapping[str, float]
    radius95_mm: float
    intervals: FloatArray
    spectrum: FloatArray
    inflation: float
    arm: ArmErrors | None
    warnings: tuple[str, ...]


def diagnose(
    result: HandEyeResult,
    mount: Mount,
    free: Free | None,
    arm: ArmErrors | None,
    middle: FloatArray,
    *,
    calibrated: bool = False,
) -> Diagnosis:
    """Looks for what noise does not explain, and splits the uncertainty by its sources.

    Args:
        result: The answer, its stops in the order of the session.
        mount: Where the camera is.
        free: Lens and board, where there are corners.
        arm: Errors that follow the arm's posture, at the same stops.
        middle: (m, 3) of the target that each observation is of, in its frame [m].
        calibrated: Whether the arm's errors are part of the answer, and no reason for doubt.
    """
    problem, state, noise = result.problem, result.state, result.noise
    with one_blas_thread():
        nothing = Misfit(Neighbours(1.0, is_significant=False), None)
        # A closed form is not at rest, and that would pass for a misfit.
        shown = misfits(problem, fit_problem(problem, state)).get(ROBOT, nothing)
        parts = covariance_by_source(problem, state, noise, sources(problem, mount, free))
        size = 6 * len(problem.unknown)
        if arm is not None and not arm.is_estimated:
            of_arm = misfit_covariance(problem, state, noise, ROBOT, arm)
            parts["arm"] = of_arm[:size, :size]
        if result.held.any():
            parts["held_values"] = np.outer(result.held[:size], result.held[:size])
        intervals = noise_intervals(problem, state, noise)[0]
    alike = shown.alike
    inflation = alike.factor if alike.is_significant else 1.0
    if inflation > 1.0:
        parts["misfit"] = (inflation - 1.0) * sum(parts.values(), np.zeros((size, size)))
    camera = problem.measured(state)
    seen = (camera[:, :3, :3] @ middle[:, :, None])[:, :, 0] + camera[:, :3, 3]
    point = seen.mean(axis=0)
    at_work = {
        name: point_covariance(state.edges[0], it[:6, :6], point) for name, it in parts.items()
    }
    at_work["total"] = sum(at_work.values(), np.zeros((3, 3)))
    return Diagnosis(
        point,
        {name: 1e3 * _length(it) for name, it in at_work.items()},
        1e3 * radius95(at_work["total"]),
        intervals,
        _spectrum(inflation * result.covariance[:12, :12]),
        inflation,
        arm,
        tuple(misfit_words(shown, arm, calibrated=calibrated)),
    )


def misfits(problem: Problem, fit: Solution) -> dict[str, Misfit]:
    """Tests the residuals of each robot's stops for what is no noise; of few stops, none.

    Args:
        problem: The observations, their stops in the order of the session.
        fit: Their fit, at rest.
    """
    found = {}
    for robot in problem.robots:
        if len(stops_of(problem, robot)) >= _FEWEST_STOPS:
            fitted = (problem, fit.state, fit.noise, robot)
            found[robot] = Misfit(neighbours(*fitted), drift(*fitted))
    return found


def sources(problem: Problem, mount: Mount, free: Free | None) -> Sources:
    """What makes the result uncertain."""
    owners: dict[str, IntArray] = {}
    for name, at in problem.effect_columns.items():
        columns, of = np.arange(at.start, at.stop), _OF_EFFECTS.get(name, "clock")
        if name == LENS_AND_BOARD and free is not None:
            is_lens = free.columns < free.lens_count
            parts = {"intrinsics": columns[is_lens], "board": columns[~is_lens]}
            owners |= {it: part for it, part in parts.items() if len(part)}
        else:
            owners[of] = np.append(owners.get(of, columns[:0]), columns)
    return Sources(
        dict.fromkeys(
            problem.observations.observers, "instrument" if mount == "instrument" else "pixels"
        ),
        {ROBOT: "poses" if problem.is_combined else "robot"},
        owners,
    )


def _length(spread: FloatArray) -> float:
    # Errors of lens and board hang together; each takes half of what is common, which may leave one
    # of them less than nothing.
    return float(np.sqrt(max(np.trace(spread), 0.0)))


def _spectrum(spread: FloatArray) -> FloatArray:
    limit = np.tile(np.repeat([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], 3), 2)
    values = np.linalg.eigvalsh(spread / np.outer(limit, limit))
    return np.asarray(np.sqrt(np.maximum(values, 0.0)))


def misfit_words(found: Misfit, arm: ArmErrors | None, *, calibrated: bool) -> Iterator[str]:
    """Words what of a robot's residuals is no noise, and what it probably is."""
    alike, moved = found.alike, found.moved
    if arm is not None and arm.is_significant and not calibrated:
        size = f"{1e3 * LEVER_M * arm.sigma:.2g} mm and {np.rad2deg(arm.sigma):.2g} deg"
        told = (
            "they were estimated along"
            if arm.of_links
            else "without joint angles and a known [robot] model they cannot be estimated along"
        )
        yield (
            f"Residuals follow the arm's posture (likelihood ratio {arm.gain:.0f}, noise stays "
            f"under {SIGNIFICANT:.0f}): its links are off from the model by typically {size}; "
            f"{told}. What of them looks the same in all views is in no residual, and counts in "
            "the covariance: a kinematic calibration of the arm would take it out."
        )
    if moved is not None:
        yield (
            f"Residuals drift with time: from the first stop to the last, base or target moved by "
            f"{1e3 * moved.moved_m:.2g} mm and {np.rad2deg(moved.moved_rad):.2g} deg. Fasten them, "
            "let the arm warm up, and record again."
        )
    if alike.is_significant:
        yield (
            f"Neighbouring stops err alike: leaving them out in blocks moves the answer "
            f"{np.sqrt(alike.factor):.2g} times farther than independent noise would. The sigmas "
            "were multiplied by as much."
        )

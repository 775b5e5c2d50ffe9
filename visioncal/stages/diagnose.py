"""Stage 8: whether the residuals are noise, and where the uncertainty comes from."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.estimation.appearance import Free
from visioncal.estimation.arm import LEVER_M, SIGNIFICANT, ArmErrors, misfit_covariance
from visioncal.estimation.boards import Boards
from visioncal.estimation.budget import Sources, covariance_by_source, point_covariance, radius95
from visioncal.estimation.closure import Closure, fit_closure
from visioncal.estimation.intervals import noise_intervals
from visioncal.estimation.misfit import Drift, Neighbours, drift, neighbours
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.problem import ROBOT
from visioncal.stages.handeye import HandEyeResult
from visioncal.threads import one_blas_thread
from visioncal.types import FloatArray, IntArray

# Fewer stops than this leave no residuals to be tested.
FEWEST_STOPS = 6


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
    data: Closure,
    result: HandEyeResult,
    free: Free | None,
    arm: ArmErrors | None,
    middle: FloatArray,
    boards: Boards,
    *,
    drifting: int = 0,
    calibrated: bool = False,
) -> Diagnosis:
    """Looks for what noise does not explain, and splits the uncertainty by its sources.

    Args:
        data: The views, one a stop, in the order of the session.
        result: The answer.
        free: Lens and board, where there are corners.
        arm: Errors that follow the arm's posture, at the same views.
        middle: (3,) of the target, in its frame [m]; or (m, 3) of the one that each stop shows, in
            the frame of the first.
        boards: What the views show, where there are several boards.
        drifting: How many of the unknowns are of the arm's drift with temperature.
        calibrated: Whether the arm's errors are part of the answer, and no reason for doubt.
    """
    edges, noise = result.edges, result.noise
    with one_blas_thread():
        alike, moved = Neighbours(1.0, False), None
        if len(data) >= FEWEST_STOPS:
            # A closed form is not at rest, and that would pass for a misfit.
            rest = fit_closure(data, edges)
            fitted = (data.problem, rest.edges.state, rest.noise.levels, ROBOT)
            alike, moved = neighbours(*fitted), drift(*fitted)
        told = data.problem, edges.state, noise.levels
        parts = covariance_by_source(*told, _sources(data, free, arm, boards, drifting))
        if arm is not None and not arm.is_estimated:
            of_arm = misfit_covariance(*told, ROBOT, arm)
            parts["arm"] = of_arm[:12, :12]
        if result.held.any():
            parts["held_values"] = np.outer(result.held[:12], result.held[:12])
        intervals = noise_intervals(*told)[0]
    inflation = alike.factor if alike.is_significant else 1.0
    if inflation > 1.0:
        parts["misfit"] = (inflation - 1.0) * sum(parts.values(), np.zeros((12, 12)))
    camera = data.under(edges.shared).camera
    seen = (camera[:, :3, :3] @ np.atleast_2d(middle)[:, :, None])[:, :, 0] + camera[:, :3, 3]
    point = seen.mean(axis=0)
    at_work = {name: point_covariance(edges.x, it[:6, :6], point) for name, it in parts.items()}
    at_work["total"] = sum(at_work.values(), np.zeros((3, 3)))
    return Diagnosis(
        point,
        {name: 1e3 * _length(it) for name, it in at_work.items()},
        1e3 * radius95(at_work["total"]),
        intervals,
        _spectrum(inflation * result.covariance[:12, :12]),
        inflation,
        arm,
        tuple(misfit_words(alike, moved, arm, calibrated=calibrated)),
    )


def _sources(
    data: Closure, free: Free | None, arm: ArmErrors | None, boards: Boards, drifting: int
) -> Sources:
    """What makes the result uncertain, and which of the unknowns that views share are whose.

    The arm's errors come last, and before them its drift.
    """
    owners: dict[str, IntArray] = {}
    shared = len(data.unchanged)
    errors = 0 if arm is None or not arm.is_estimated else arm.basis.shape[2]
    if data.mount == "instrument" and shared > errors + drifting:
        # Places of points, of which an instrument's readings of one stop tell by themselves.
        owners["instrument"] = np.arange(shared - errors - drifting)
    if boards.unknowns and data.camera_covariance is not None:
        # All that is known of where boards are beside the chain is from images that show several.
        owners["pixels"] = np.arange(boards.begin, boards.begin + boards.unknowns)
    if free is not None:
        is_lens = free.columns < free.lens_count
        for name, mask in (("intrinsics", is_lens), ("board", ~is_lens)):
            if mask.any():
                owners[name] = np.flatnonzero(mask)
    behind, before = boards.begin + boards.unknowns, shared - errors - drifting
    if data.mount != "instrument" and before > behind:
        owners["clock"] = np.arange(behind, before)
    if drifting:
        owners["temperature"] = np.arange(before, before + drifting)
    if arm is not None and arm.is_estimated:
        owners["arm"] = np.arange(shared - errors, shared)
    first, observers = 6 * len(data.problem.unknown), data.problem.observations.observers
    return Sources(
        dict.fromkeys(observers, "instrument" if data.mount == "instrument" else "pixels"),
        {"robot": "poses" if data.camera_covariance is None else "robot"},
        {name: first + places for name, places in owners.items()},
    )


def _length(spread: FloatArray) -> float:
    # Errors of lens and board hang together; each takes half of what is common, which may leave one
    # of them less than nothing.
    return float(np.sqrt(max(np.trace(spread), 0.0)))


def _spectrum(spread: FloatArray) -> FloatArray:
    limit = np.tile(np.repeat([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], 3), 2)
    values = np.linalg.eigvalsh(spread / np.outer(limit, limit))
    return np.asarray(np.sqrt(np.maximum(values, 0.0)))


def misfit_words(
    alike: Neighbours, moved: Drift | None, arm: ArmErrors | None, *, calibrated: bool
) -> Iterator[str]:
    """Words what of a robot's residuals is no noise, and what it probably is."""
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

"""The arm's drift with temperature, on the way and as calibration.json has it."""

from dataclasses import replace
from typing import Any

import numpy as np

from visioncal.estimation.arm import find_arm_errors
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.problem import ROBOT, State
from visioncal.estimation.solve import starting_noise
from visioncal.pipeline.known import Known
from visioncal.stages.thermal import (
    LEVEL,
    findings,
    is_found,
    refuse_missing,
    refuse_uninformative,
)
from visioncal.thermal import Inputs, Stops, ThermalFit, fit_thermal, inputs_of
from visioncal.thermal.fit import uninformative
from visioncal.types import FloatArray

# Views may be so far before the first and behind the last sample [s].
_BEYOND_S = 300.0
# Joints that are within this of a posture are in it [rad].
_SAME_RAD = 1e-3
# The course that is told is drawn by so many points.
_DRAWN = 200


def with_drift(known: Known) -> Known:
    """Takes up how the arm drifts with its temperature, where the session tells.

    Raises:
        DataError: The level asks for it, and the session lacks what it takes.
        DegenerateError: The level asks for it, and all views were taken about equally warm.
    """
    if known.level not in ("auto", LEVEL):
        return known
    inputs, missing = _told(known)
    if inputs is None:
        if known.level == LEVEL:
            raise refuse_missing(missing)
        return known
    why = uninformative(inputs, _stamps(known))
    if why:
        if known.level == LEVEL:
            raise refuse_uninformative(why)
        return known
    fit = _fit(known, inputs)
    if fit is None:
        return known
    known = replace(known, notes=(*known.notes, *findings(fit)))
    return replace(known, thermal=fit, heated_by=inputs) if is_found(fit) else known


def thermal_document(known: Known) -> dict[str, Any] | None:
    """Writes the drift's coefficients and its course; None where none was found."""
    fit, inputs = known.thermal, known.heated_by
    if fit is None or inputs is None:
        return None
    return fit.model.document() | {
        "not_told": list(fit.not_told),
        "residual_mm": {"without": 1e3 * fit.before_m, "with": 1e3 * fit.after_m},
        "likelihood_ratio": fit.gain,
        "rises_k": fit.rises_k.tolist(),
        "trained_s": float(np.ptp(_stamps(known))),
        "course": _course(known, fit, inputs),
        "seen": _seen(known, fit, inputs),
        "views": _by_view(known, fit, inputs),
    }


def _told(known: Known) -> tuple[Inputs | None, str]:
    """What heats the arm; or None, and what is missing."""
    robot = known.robot
    if robot is None or not known.robot_arm.is_modelled or known.solver != "joint":
        return None, "the joint angles of every view, a known model of the robot and the joint fit"
    used = set(known.used)
    timeless = [it.number for it in known.session.views if it.number in used and it.stamp_s is None]
    inputs, missing = inputs_of(known.session, robot.joint_count)
    if inputs is None:
        return None, missing
    if timeless:
        return None, f"view {timeless[0]} has no stamp_s"
    first_s, last_s = inputs.stamps_s[0], inputs.stamps_s[-1]
    stamps = _stamps(known)
    if stamps.min() < first_s - _BEYOND_S or stamps.max() > last_s + _BEYOND_S:
        return None, (
            f"{inputs.kind} are told from {first_s:.10g} to {last_s:.10g} s, and views were taken "
            f"from {stamps.min():.10g} to {stamps.max():.10g} s"
        )
    return inputs, ""


def _stamps(known: Known) -> FloatArray:
    """(s,) when the used stops were looked at [s]."""
    stamps = {it.number: it.stamp_s for it in known.session.views}
    first = np.unique(known.stops, return_index=True)[1]
    return np.array([stamps[known.used[at]] or 0.0 for at in first])


def _fit(known: Known, inputs: Inputs) -> ThermalFit | None:
    """Fits the drift with the edges and, where they are off, the arm's links."""
    known = replace(known, calibrated=known.robot_arm.erring(None))
    arm = known.arm_at_stops
    q, matched = arm.joints_rad, arm.matched
    if matched is None or q is None:
        return None
    model = ArmModel.of(matched.arm, q, arm.reported)
    problem = known.problem(known.used).merged()
    state = problem.start(known.frames)
    noise, basis = starting_noise(problem), model.columns("links", q)
    links = find_arm_errors(problem, state, noise, ROBOT, basis, of_links=True)
    if links is not None:
        problem = problem.with_effects([*problem.effects, links.effect(ROBOT)])
        state = State(state.edges, problem.start_values)
    stops = Stops(ROBOT, np.arange(len(q)), q, _stamps(known))
    return fit_thermal(problem, state, model.robot, stops, inputs, matched.arm)


def _course(known: Known, fit: ThermalFit, inputs: Inputs) -> list[dict[str, float]]:
    """How far the flange has drifted at the stops' mean posture, and how surely that is known."""
    model, q = fit.model, _typical(_joints(known))
    at_s = np.linspace(inputs.stamps_s[0], inputs.stamps_s[-1], _DRAWN)
    links = model.heating.links_c(inputs, at_s)
    rows = np.tile(q, (len(at_s), 1))
    moved = np.linalg.norm(model.motion(rows, links)[:, :3, 3], axis=1)
    sigma = model.sigma_m(rows, links, model.heating.slopes(inputs, at_s))
    rises = model.rises(links).max(axis=1)
    return [
        {"stamp_s": at, "drift_mm": 1e3 * drift, "sigma_mm": 1e3 * spread, "rise_k": rise}
        for at, drift, spread, rise in zip(
            at_s.tolist(), moved.tolist(), sigma.tolist(), rises.tolist(), strict=True
        )
    ]


def _seen(known: Known, fit: ThermalFit, inputs: Inputs) -> list[dict[str, float]]:
    """How far the stops in that posture see the flange to have moved, by their first view.

    What is left of a stop is taken for its flange's, and counted along the drift's direction: its
    length alone would grow with noise.
    """
    first = np.unique(known.stops, return_index=True)[1]
    views = [known.used[at] for at in first]
    q, stamps_s, model = _joints(known), _stamps(known), fit.model
    there = np.abs(q - _typical(q)).max(axis=1)
    chosen = np.flatnonzero(there < _SAME_RAD)
    problem = replace(known.solved.problem, is_combined=False)
    linear = problem.linear(known.solved.state)
    rows = np.unique(problem.observations.stops, return_index=True)[1][chosen]
    left = -np.linalg.solve(linear.by_errors[rows], linear.residuals[rows, :, None])[:, 3:, 0]
    moved = model.motion(q[chosen], model.heating.links_c(inputs, stamps_s[chosen]))[:, :3, 3]
    # Where it has hardly moved it has no direction: that of the farthest stop serves them all.
    lengths = np.linalg.norm(moved, axis=1)
    far = moved[int(np.argmax(lengths))] / max(float(lengths.max()), 1e-9)
    seen = lengths + left @ far
    return [
        {"view": views[at], "stamp_s": float(stamps_s[at]), "drift_mm": 1e3 * drift}
        for at, drift in zip(chosen.tolist(), seen.tolist(), strict=True)
    ]


def _by_view(known: Known, fit: ThermalFit, inputs: Inputs) -> list[dict[str, float]]:
    """How far the flange had drifted at each used view, and the largest rise of a link."""
    stamps = {it.number: it.stamp_s or 0.0 for it in known.session.views}
    links = fit.model.heating.links_c(inputs, np.array([stamps[it] for it in known.used]))
    moved = np.linalg.norm(known.drift(known.used)[:, :3, 3], axis=1)
    rises = fit.model.rises(links).max(axis=1)
    return [
        {"view": view, "drift_mm": 1e3 * drift, "rise_k": rise}
        for view, drift, rise in zip(known.used, moved.tolist(), rises.tolist(), strict=True)
    ]


def _joints(known: Known) -> FloatArray:
    """(s, n) joint angles at the used stops [rad]."""
    q = known.arm_at_stops.joints_rad
    return np.zeros((0, 0)) if q is None else q


def _typical(q: FloatArray) -> FloatArray:
    """(n,) the posture that most of (s, n) stops are in; of several, the one that most are near."""
    alike = [int((np.abs(q - it).max(axis=1) < _SAME_RAD).sum()) for it in q]
    away = np.abs(q - np.median(q, axis=0)).sum(axis=1)
    return np.asarray(q[np.lexsort((away, -np.array(alike)))[0]])

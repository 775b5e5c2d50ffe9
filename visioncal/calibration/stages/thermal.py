"""Thermal level: drift of an arm with its temperature, estimated with the chain its views close.

Growth of links and drift of zeros per kelvin, time constants and gains are further unknowns beside
frames and errors of the arm. Known properties of steel, aluminium and warm-up are their prior;
coefficients that the views do not determine stay there. Temperatures or currents are read from
streams, or else from columns of views.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.stages.arms import Arm, Drift
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.linalg import covariance_among
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.arm import arm_effect, find_arm_errors, rows_of, stops_of
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import fit_problem, starting_noise
from visioncal.model import Moments
from visioncal.model.effects.heat import Heat
from visioncal.model.heating import FEWEST_SAMPLES, LEAST_RISE_K, is_recorded, usual_heating
from visioncal.results.arm import DriftPoint, DriftResidual, JointDrift, ThermalResult, ViewDrift
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.thermal import Inputs
from visioncal.session.observations import APART_RAD

LEVEL = "thermal"
# Step at convergence [prior sigmas].
_SETTLED = 1e-3
# Kind of findings about what was recorded.
TEMPERATURES = "temperatures"
# No air, nor an arm that is cold, has as much [deg C]; a sensor that moves by so small a part of
# what others do is dead, where these warm up by so much [K]; an arm that begins with so much of its
# whole rise has been at work.
_HOT_C, _DEAD, _WARM_K, _STARTED = 65.0, 1e-3, 10.0, 0.4
# Points of the reported course.
_COURSE_POINTS = 200


def missing_error(
    missing: str = "the joint angles of every view, a known model of the robot and the joint fit",
) -> DataError:
    """The error where the level lacks inputs."""
    return DataError(
        f"level {LEVEL!r} needs to know what heats the arm: {missing}.",
        culprits=["level"],
        next_step="Record temp1_c ... or current1_a ... with stamp_s in streams/NAME.csv, and "
        "stamp_s, q1_rad ... with every view.",
    )


def with_drift(arm: Arm, problem: Problem, start: State) -> Arm:
    """Fits an arm's drift with the frames and, where these have significant errors, its links.

    The problem has this arm as reported.

    Raises:
        DataError: The session lacks data.
        DegenerateError: All views were taken about equally warm.
    """
    robot, used = arm.robot, arm.at(stops_of(problem, arm.robot))
    if used.nominal is None or used.joints_rad is None or arm.joints_rad is None:
        raise missing_error()
    inputs = _checked_inputs(used, used.joints_rad.shape[1])
    model, moments = ArmModel.of(used.nominal, used.joints_rad, used.reported), arm.moments
    with one_blas_thread():
        likelihood = robot_likelihood(problem, start, starting_noise(problem))
        basis = model.columns("links", arm.joints_rad)
        links = find_arm_errors(likelihood, problem.robots.index(robot), basis)
        if links is not None:
            problem = problem.with_effects([*problem.effects, arm_effect(links, robot)])
            start = State(start.edges, problem.start_values)
        cold = fit = fit_problem(problem, start)
        drift = Drift.expected(Heat(robot, model.robot, inputs, used.nominal))
        size = len(drift.values)
        for _ in range(20):
            warm = _warmed(problem, drift, moments)
            values = np.append(fit.state.values[: len(cold.state.values)], drift.values)
            fit = fit_problem(warm, State(fit.state.edges, values), fit.noise)
            step = fit.state.values[-size:] - drift.values
            largest = float(np.abs(step).max())
            values = drift.values + step * min(1.0, 1.0 / max(largest, _SETTLED))
            drift = replace(drift, values=values)
            if largest < _SETTLED:
                break
        warm = _warmed(problem, drift, moments)
        state = State(fit.state.edges, np.append(fit.state.values[:-size], drift.values))
        (before, before_m), (after, after_m) = (
            (
                robot_likelihood(part, at, fit.noise).white[1],
                float(np.sqrt(np.mean(np.sum(residuals[:, 3:] ** 2, axis=1)))),
            )
            for part, at in ((problem, cold.state), (warm, state))
            for residuals in (part.linear(at).residuals[rows_of(part, robot)],)
        )
        covariance = covariance_among(fisher_information(warm, state, fit.noise), warm.counted)
    drift = replace(
        drift,
        covariance=covariance[-size:, -size:],
        gain=2.0 * (before - after),
        before_m=before_m,
        after_m=after_m,
        rise_k=float(np.ptp(_links_c(drift, used), axis=0).max()),
    )
    return replace(arm, thermal=drift)


def _checked_inputs(arm: Arm, joints: int) -> Inputs:
    """The heat sources of an arm that warms up during its stops.

    Raises:
        DataError: The session lacks data.
        DegenerateError: All views were taken about equally warm.
    """
    inputs, at_s = arm.inputs, arm.stamps_s
    if inputs is None:
        raise missing_error(
            f"{FEWEST_SAMPLES} rows of a stream, or of views.csv with a time, with all of temp1_c "
            f"... temp{joints}_c or current1_a ... current{joints}_a"
        )
    if np.isnan(at_s).any():
        raise missing_error(f"view {arm.views[np.isnan(at_s)][0]} has no stamp_s")
    if not is_recorded(inputs, at_s):
        raise missing_error(_apart(inputs, at_s))
    rise_k = float(np.ptp(usual_heating(inputs).links_c(inputs, at_s), axis=0).max())
    if rise_k < LEAST_RISE_K:
        raise DegenerateError(
            f"thermal: the joints warm up by at most {figure(rise_k)} K in the "
            f"{figure(np.ptp(at_s) / 3600.0)} h of the {len(at_s)} used stops, but "
            f"{LEAST_RISE_K:g} K are needed: the views do not show how the arm drifts.",
            culprits=["temperatures"],
            next_step="Begin with a cold robot, let it work for an hour or more, and look at "
            "the same few reference views every five to ten minutes.",
        )
    return inputs


def _apart(inputs: Inputs, at_s: FloatArray) -> str:
    """Words on when heat sources were read, and when views were taken."""
    first_s, last_s = inputs.stamps_s[[0, -1]].tolist()
    return (
        f"{inputs.kind} were read from {first_s:.10g} to {last_s:.10g} s, and views were taken "
        f"from {at_s.min():.10g} to {at_s.max():.10g} s"
    )


def _warmed(problem: Problem, drift: Drift, moments: Moments) -> Problem:
    """A problem of the cold arm with its drift, whose parameters are free."""
    robot = drift.heat.frame
    problem = problem.with_poses(robot, problem.poses[robot] @ drift.motion(moments))
    return problem.with_effects([*problem.effects, drift.effect(moments, is_held=False)])


def _links_c(drift: Drift, arm: Arm) -> FloatArray:
    """(s, n) temperatures of an arm's links at its stops [deg C]."""
    heat, moments = drift.heat, arm.moments
    return drift.model.heating.links_c(heat.inputs, heat.times_s(moments))


def findings(fit: Drift) -> Iterator[str]:
    """States the drift, for the verdict."""
    if not fit.is_found:
        yield (
            f"The joints warmed up by {figure(fit.rise_k)} K, and the views show no "
            "drift with it beyond chance: none is compensated."
        )
        return
    yield (
        f"The arm drifts with its temperature: residuals of {figure(1e3 * fit.before_m)} mm become "
        f"{figure(1e3 * fit.after_m)} mm. Its transforms are those of the arm as it was at the "
        "start; give temperatures to calibration.base_from_flange and to visioncal correct."
    )


def doubts(fit: Drift) -> Iterator[Finding]:
    """Findings about recorded temperatures that contradict what arms are like."""
    inputs = fit.heat.inputs
    if inputs.kind != "temperatures" or not fit.is_found:
        return
    names, signal = fit.model.robot.joint_names, inputs.signal
    rises = np.ptp(signal, axis=0)
    # Motors at work are as hot; the air is not, nor are joints that are cold.
    is_even = inputs.ambient_c.any() or float(np.ptp(signal[0])) < _WARM_K
    coldest = float(inputs.ambient_c[0] if inputs.ambient_c.any() else signal[0].min())
    if is_even and coldest >= _HOT_C:
        yield Finding(
            TEMPERATURES,
            f"The temperatures begin at {figure(coldest)} deg C, and neither the air nor an arm "
            f"that is cold has {_HOT_C:g}: degrees Fahrenheit, of "
            f"{figure((coldest - 32.0) / 1.8)} deg C? Growth per kelvin is then 1.8 times too "
            "small.",
            Remedy("Write temp1_c ... and ambient_c in degrees Celsius: (F - 32) / 1.8."),
        )
    dead = (rises <= _DEAD * rises.max()) & (np.median(rises) >= _WARM_K)
    for at in np.flatnonzero(dead).tolist():
        yield Finding(
            TEMPERATURES,
            f"temp{at + 1}_c stays at {figure(float(signal[0, at]))} deg C while the other joints "
            f"warm up by up to {figure(float(rises.max()))} K: the sensor of {names[at]} is dead, "
            "or its column is another. The drift of that joint is taken for that of others.",
            Remedy(
                f"Record temp{at + 1}_c again; or delete the temperatures, and record currents."
            ),
        )
    above = signal[0] - inputs.ambient_c[0]
    # In so long a time at the start, joints at rest change by less [s, K].
    early = signal[inputs.stamps_s <= inputs.stamps_s[0] + 300.0]
    halves = early[: len(early) // 2], early[len(early) // 2 :]
    is_changing = (
        len(early) > 1 and abs(np.subtract(*(at.mean(axis=0) for at in halves))).max() > 0.25
    )
    started = max(_WARM_K, _STARTED * float(signal.max() - inputs.ambient_c[0]))
    if inputs.ambient_c.any() and is_changing and above.max() > started:
        yield Finding(
            TEMPERATURES,
            f"The arm was warm when its temperatures begin: joints {figure(float(above.min()))} to "
            f"{figure(float(above.max()))} K above the air. Links lag behind their joints by "
            "minutes to half an hour, and are taken to be as warm: drift and its sigma are wrong "
            "by what they were not.",
            Remedy(
                "Begin with an arm that stood still for hours; or let the stream of temperatures "
                "begin some minutes before it moves, before the views."
            ),
        )


def unrecorded(arm: Arm) -> str:
    """Words where heat sources were recorded, and not during the views; else empty."""
    inputs, at_s = arm.inputs, arm.stamps_s[arm.has_pose]
    if inputs is None or np.isnan(at_s).any():
        return ""
    millis = replace(inputs, stamps_s=1e-3 * inputs.stamps_s)
    is_in_millis = is_recorded(millis, at_s)
    if is_recorded(inputs, at_s):
        # Of a thousandth of their time, joints that warm up show nothing.
        links = usual_heating(inputs).links_c(inputs, at_s)
        is_even = np.ptp(links, axis=0).max() < LEAST_RISE_K < _WARM_K < np.ptp(inputs.signal)
        if not (is_even and is_in_millis):
            return ""
    cause = "milliseconds?" if is_in_millis else "another clock, or a part of it?"
    return f"{_apart(inputs, at_s)}: {cause} No drift with temperature was estimated."


def drift_result(fit: Drift, arm: Arm) -> ThermalResult:
    """A drift's coefficients and its course, at an arm's stops, as a section of a calibration."""
    model, inputs, q = fit.model, fit.heat.inputs, arm.moments.joints[arm.robot]
    columns = {
        "reference_c": model.reference_c,
        "growth_per_k": model.growth_per_k,
        "drift_rad_per_k": model.drift_rad_per_k,
        "tau_s": model.heating.tau_s,
    }
    # Sigmas of tau and gain are relative.
    sigmas = np.sqrt(np.diag(model.covariance)).reshape(-1, model.joint_count)
    names = ["growth_sigma_per_k", "drift_sigma_rad_per_k", "tau_sigma", "gain_sigma"]
    if inputs.kind == "currents":
        columns["gain_k_per_a2"] = model.heating.gain_k_per_a2
    columns |= dict(zip(names, sigmas, strict=False))
    # Drift over time in the most frequent posture; of several, in the most central one.
    counts = [int((np.abs(q - each).max(axis=1) < APART_RAD).sum()) for each in q]
    distance = np.abs(q - np.median(q, axis=0)).sum(axis=1)
    typical = q[np.lexsort((distance, -np.array(counts)))[0]]
    at_s = np.linspace(inputs.stamps_s[0], inputs.stamps_s[-1], _COURSE_POINTS)
    links, rows = model.heating.links_c(inputs, at_s), np.tile(typical, (_COURSE_POINTS, 1))
    course = (
        at_s,
        1e3 * np.linalg.norm(model.motion(rows, links)[:, :3, 3], axis=1),
        1e3 * model.sigma_m(rows, links, model.heating.jacobian(inputs, at_s)),
        model.rises(links).max(axis=1),
    )
    drift_m = np.linalg.norm(fit.motion(arm.moments)[:, :3, 3], axis=1)
    rises, views = model.rises(_links_c(fit, arm)).max(axis=1), arm.views.tolist()
    by_view = zip(views, (1e3 * drift_m).tolist(), rises.tolist(), strict=True)
    return ThermalResult(
        heated_by=inputs.kind,
        joints=tuple(
            JointDrift(joint=joint, **{name: float(column[at]) for name, column in columns.items()})
            for at, joint in enumerate(model.robot.joint_names)
        ),
        covariance=model.covariance,
        lengths_m=model.lengths,
        not_determined=fit.not_determined,
        residual_mm=DriftResidual(without=1e3 * fit.before_m, with_drift=1e3 * fit.after_m),
        likelihood_ratio=fit.gain,
        course=tuple(DriftPoint(*row) for row in np.stack(course, axis=1).tolist()),
        views=tuple(ViewDrift(*row) for row in by_view),
    )

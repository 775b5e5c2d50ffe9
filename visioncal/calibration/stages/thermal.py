"""Thermal level: drift of an arm with its temperature, estimated with the chain its views close.

Growth of links and drift of zeros per kelvin, time constants and gains are further unknowns beside
frames and errors of the arm. Known properties of steel, aluminium and warm-up are their prior;
coefficients that the views do not determine stay there. Temperatures or currents are read from
streams, or else from columns of views.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import DETERMINED
from visioncal.core.linalg import covariance_among
from visioncal.core.number_format import figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.arm import arm_effect, find_arm_errors, rows_of
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Effect, State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import fit_problem, starting_noise
from visioncal.model.heating import (
    FEWEST_SAMPLES,
    LEAST_RISE_K,
    is_recorded,
    recorded_inputs,
    sigmas_of,
    usual_arm,
    usual_heating,
)
from visioncal.results.arm import DriftPoint, DriftResidual, JointDrift, ThermalResult, ViewDrift
from visioncal.robot import Robot
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import SIGNIFICANT
from visioncal.robot.thermal import Inputs, ThermalModel
from visioncal.session import Session
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


@dataclass(frozen=True, eq=False)
class HeatedStops:
    """A robot's m stops, with the session that records what heats its arm."""

    session: Session
    robot: str  # The robot's name there.
    q: FloatArray  # (m, n) joint angles [rad].
    views: IntArray  # (m,) a view of each stop.
    stamps_s: FloatArray  # (m,) when that was taken [s]; NaN where unknown.

    def at(self, rows: IntArray) -> Self:
        """Selects stops by their indices."""
        views, stamps_s = self.views[rows], self.stamps_s[rows]
        return replace(self, q=self.q[rows], views=views, stamps_s=stamps_s)

    def inputs(self) -> Inputs:
        """The heat sources of an arm that warms up during the views.

        Raises:
            DataError: The session lacks data.
            DegenerateError: All views were taken about equally warm.
        """
        inputs = inputs_of(self.session, self.q.shape[1], self.robot)
        if np.isnan(self.stamps_s).any():
            raise missing_error(f"view {self.views[np.isnan(self.stamps_s)][0]} has no stamp_s")
        first_s, last_s = inputs.stamps_s[[0, -1]].tolist()
        least_s, most_s = self.stamps_s.min(), self.stamps_s.max()
        if not is_recorded(inputs, self.stamps_s):
            raise missing_error(
                f"{inputs.kind} were read from {first_s:.10g} to {last_s:.10g} s, and views were "
                f"taken from {least_s:.10g} to {most_s:.10g} s"
            )
        links = usual_heating(inputs).links_c(inputs, self.stamps_s)
        rise_k = float(np.ptp(links, axis=0).max())
        if rise_k < LEAST_RISE_K:
            raise DegenerateError(
                f"thermal: the joints warm up by at most {figure(rise_k)} K in the "
                f"{figure((most_s - least_s) / 3600.0)} h of the {len(self.q)} used stops, but "
                f"{LEAST_RISE_K:g} K are needed: the views do not show how the arm drifts.",
                culprits=["temperatures"],
                next_step="Begin with a cold robot, let it work for an hour or more, and look at "
                "the same few reference views every five to ten minutes.",
            )
        return inputs


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


def inputs_of(session: Session, joints: int, robot: str = "") -> Inputs:
    """Reads what heats an arm with some joints; see `recorded_inputs`.

    Raises:
        DataError: Neither temperatures nor currents are known of all joints together.
    """
    inputs = recorded_inputs(session, joints, robot)
    if inputs is None:
        raise missing_error(
            f"{FEWEST_SAMPLES} rows of a stream, or of views.csv with a time, with all of temp1_c "
            f"... temp{joints}_c or current1_a ... current{joints}_a"
        )
    return inputs


@dataclass(frozen=True, eq=False)
class ThermalFit:
    """Drift of an arm."""

    model: ThermalModel  # The arm with its coefficients and their covariance.
    inputs: Inputs  # The heat sources of the arm.
    values: FloatArray  # (p,) deviation of the parameters from their prior, in its sigmas.
    # (p,) posterior over prior sigma of each parameter.
    shares: FloatArray = field(default_factory=lambda: np.zeros(0))
    gain: float = 0.0  # Twice the gain in log-likelihood over an arm without drift.
    before_m: float = 0.0  # Residual of the views without drift, as a root mean square [m].
    after_m: float = 0.0  # The same with drift [m].
    # (n,) range of each link's temperature over the views [K].
    rises_k: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def expected(cls, robot: Robot, nominal: Robot, inputs: Inputs) -> Self:
        """The prior; `robot` is up to the frame of its poses, the lengths of `nominal` grow."""
        model = usual_arm(robot, nominal, inputs)
        return cls(model, inputs, np.zeros_like(sigmas_of(inputs)))

    @property
    def is_found(self) -> bool:
        """Whether drift explains the views significantly."""
        return self.gain > SIGNIFICANT

    @property
    def sigmas(self) -> FloatArray:
        """(p,) the prior's sigmas."""
        return sigmas_of(self.inputs)

    @property
    def not_determined(self) -> tuple[str, ...]:
        """The parameters that stay at their prior, by joint."""
        kinds = ("growth", "drift", "tau", "gain")
        names = [f"{kind} of {joint}" for kind in kinds for joint in self.model.robot.joint_names]
        pairs = zip(names, self.shares, strict=False)
        return tuple(name for name, share in pairs if share > DETERMINED)

    def moved(self, step: FloatArray) -> Self:
        """The drift after a (p,) step of its values."""
        model = self.model.changed(self.sigmas * step)
        return replace(self, model=model, values=self.values + step)

    def links_c(self, stops: HeatedStops) -> FloatArray:
        """(m, n) temperatures of the links [deg C]; those without a time are as at the start."""
        stamps_s = np.nan_to_num(stops.stamps_s, nan=self.inputs.stamps_s[0])
        return self.model.heating.links_c(self.inputs, stamps_s)

    def motion(self, stops: HeatedStops) -> FloatArray:
        """(m, 4, 4) drift of the flange at some stops, in its own frame."""
        return self.model.motion(stops.q, self.links_c(stops))

    def effect(self, robot: str, stops: HeatedStops, stood: Mask, *, held: bool = True) -> Effect:
        """The parameters as an effect on all s stops, of which the (s,) mask `stood` has the m.

        Held values are at zero and count in the covariance with their prior: the information of the
        stops is in the problem itself.
        """
        stamps_s = np.nan_to_num(stops.stamps_s, nan=self.inputs.stamps_s[0])
        heated = self.model.heating.jacobian(self.inputs, stamps_s)
        basis = np.zeros((len(stood), 6, len(self.values)))
        basis[stood] = self.model.basis(stops.q, self.links_c(stops), heated) * self.sigmas
        values = np.zeros_like(self.values) if held else self.values
        prior = PriorInformation(np.eye(len(values)), self.values)
        fixed = np.full(len(values), held)
        return Effect(f"temperature of {robot}", values, prior, fixed, None, {robot: basis})

    def applied_to(self, problem: Problem, robot: str, stops: HeatedStops, stood: Mask) -> Problem:
        """A problem of the cold arm with its drift, whose parameters are free."""
        poses = problem.poses[robot].copy()
        poses[stood] = poses[stood] @ self.motion(stops)
        effect = self.effect(robot, stops, stood, held=False)
        problem = problem.with_poses(robot, poses)
        return problem.with_effects([*problem.effects, effect])


def find_drift(
    problem: Problem, start: State, robot: str, stops: HeatedStops, inputs: Inputs, nominal: Robot
) -> ThermalFit:
    """Fits an arm's drift with the frames and, where these have significant errors, its links.

    Args:
        problem: The observations, with the arm as reported.
        start: Starting values.
        robot: The robot in the problem.
        stops: The robot's stops in the problem, ascending.
        inputs: Heat sources of the arm.
        nominal: The robot's model.
    """
    poses = problem.poses[robot]
    robot_stops = np.isin(
        np.arange(len(poses)), problem.observations.stops[rows_of(problem, robot)]
    )
    model = ArmModel.of(nominal, stops.q, poses[robot_stops])
    basis = np.zeros((len(poses), 6, model.size_of("links")))
    basis[robot_stops] = model.columns("links", stops.q)
    with one_blas_thread():
        likelihood = robot_likelihood(problem, start, starting_noise(problem))
        links = find_arm_errors(likelihood, problem.robots.index(robot), basis)
        if links is not None:
            problem = problem.with_effects([*problem.effects, arm_effect(links, robot)])
            start = State(start.edges, problem.start_values)
        cold = fit = fit_problem(problem, start)
        drift = ThermalFit.expected(model.robot, nominal, inputs)
        size = len(drift.values)
        for _ in range(20):
            warm = drift.applied_to(problem, robot, stops, robot_stops)
            values = np.append(fit.state.values[: len(cold.state.values)], drift.values)
            fit = fit_problem(warm, State(fit.state.edges, values), fit.noise)
            step = fit.state.values[-size:] - drift.values
            largest = float(np.abs(step).max())
            drift = drift.moved(step * min(1.0, 1.0 / max(largest, _SETTLED)))
            if largest < _SETTLED:
                break
        warm = drift.applied_to(problem, robot, stops, robot_stops)
        state = State(fit.state.edges, np.append(fit.state.values[:-size], drift.values))
        costs = [
            robot_likelihood(part, at, fit.noise).white[1]
            for part, at in ((problem, cold.state), (warm, state))
        ]
        information = fisher_information(warm, state, fit.noise)
        covariance = covariance_among(information, warm.counted)[-size:, -size:]
        before_m, after_m = (
            float(np.sqrt(np.mean(np.sum(residuals[rows_of(part, robot), 3:] ** 2, axis=1))))
            for part, residuals in (
                (problem, problem.linear(cold.state).residuals),
                (warm, warm.linear(state).residuals),
            )
        )
    scaled = covariance * np.outer(drift.sigmas, drift.sigmas)
    return replace(
        drift,
        model=replace(drift.model, covariance=scaled),
        shares=np.sqrt(np.diag(covariance)),
        gain=2.0 * (costs[0] - costs[1]),
        before_m=before_m,
        after_m=after_m,
        rises_k=np.ptp(drift.links_c(stops), axis=0),
    )


def findings(fit: ThermalFit) -> Iterator[str]:
    """States the drift, for the verdict."""
    if not fit.is_found:
        yield (
            f"The joints warmed up by {figure(float(fit.rises_k.max()))} K, and the views show no "
            "drift with it beyond chance: none is compensated."
        )
        return
    yield (
        f"The arm drifts with its temperature: residuals of {figure(1e3 * fit.before_m)} mm become "
        f"{figure(1e3 * fit.after_m)} mm. Its transforms are those of the arm as it was at the "
        "start; give temperatures to calibration.base_from_flange and to visioncal correct."
    )


def doubts(fit: ThermalFit) -> Iterator[Finding]:
    """Findings about recorded temperatures that contradict what arms are like."""
    inputs = fit.inputs
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


def unrecorded(heat: HeatedStops) -> str:
    """Words where heat sources were recorded, and not during the views; else empty."""
    inputs = recorded_inputs(heat.session, heat.q.shape[1], heat.robot)
    at_s = heat.stamps_s
    if inputs is None or np.isnan(at_s).any():
        return ""
    first_s, last_s = inputs.stamps_s[[0, -1]].tolist()
    millis = replace(inputs, stamps_s=1e-3 * inputs.stamps_s)
    is_in_millis = is_recorded(millis, at_s)
    if is_recorded(inputs, at_s):
        # Of a thousandth of their time, joints that warm up show nothing.
        links = usual_heating(inputs).links_c(inputs, at_s)
        is_even = np.ptp(links, axis=0).max() < LEAST_RISE_K < _WARM_K < np.ptp(inputs.signal)
        if not (is_even and is_in_millis):
            return ""
    cause = "milliseconds?" if is_in_millis else "another clock, or a part of it?"
    return (
        f"{inputs.kind} were read from {first_s:.10g} to {last_s:.10g} s, and views were taken "
        f"from {at_s.min():.10g} to {at_s.max():.10g} s: {cause} No drift with temperature was "
        "estimated."
    )


def drift_result(fit: ThermalFit, stops: HeatedStops) -> ThermalResult:
    """A drift's coefficients and its course, at a robot's stops, as a section of a calibration."""
    model, inputs = fit.model, fit.inputs
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
    counts = [int((np.abs(stops.q - q).max(axis=1) < APART_RAD).sum()) for q in stops.q]
    distance = np.abs(stops.q - np.median(stops.q, axis=0)).sum(axis=1)
    typical = stops.q[np.lexsort((distance, -np.array(counts)))[0]]
    at_s = np.linspace(inputs.stamps_s[0], inputs.stamps_s[-1], _COURSE_POINTS)
    links, rows = model.heating.links_c(inputs, at_s), np.tile(typical, (_COURSE_POINTS, 1))
    course = (
        at_s,
        1e3 * np.linalg.norm(model.motion(rows, links)[:, :3, 3], axis=1),
        1e3 * model.sigma_m(rows, links, model.heating.jacobian(inputs, at_s)),
        model.rises(links).max(axis=1),
    )
    drift_m = np.linalg.norm(fit.motion(stops)[:, :3, 3], axis=1)
    rises, views = model.rises(fit.links_c(stops)).max(axis=1), stops.views.tolist()
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

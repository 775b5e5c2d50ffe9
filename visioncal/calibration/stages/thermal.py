"""Thermal level: whether temperatures explain how the views drift during a session.

Temperatures or currents are read from its streams, or else from columns of its views.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from visioncal.calibration.stages.thermal_fit import (
    ThermalFit,
    ThermalStops,
    fit_thermal,
    uninformative,
)
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import figure, some_of
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.arm import SIGNIFICANT, find_arm_errors
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.armpair import ArmPair
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import State
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.solve import (
    Solution,
    starting_noise,
)
from visioncal.results.arm import (
    DriftPoint,
    DriftResidual,
    JointDrift,
    ObservedDrift,
    ThermalResult,
    ViewDrift,
)
from visioncal.robot import Robot
from visioncal.robot.thermal import Inputs, Kind, ThermalModel
from visioncal.session import Session
from visioncal.session.kinds import name_of
from visioncal.session.selecting import streams_of
from visioncal.session.streams import STAMP, Stream

LEVEL = "thermal"
NO_JOINTS = "the joint angles of every view, a known model of the robot and the joint fit"
# Largest time of views before the first and after the last sample [s].
_BEYOND_S = 300.0
# Largest difference of joints in one posture [rad].
_SAME_RAD = 1e-3
# Points of the reported course.
_COURSE_POINTS = 200
_ADVICE = (
    "Begin with a cold robot, let it work for an hour or more, and look at the same few reference "
    "views every five to ten minutes."
)
# More samples determine warm-up no better: they are averaged in groups.
_MOST_SAMPLES = 8192
_FEWEST_SAMPLES = 3
_AMBIENT = "ambient_c"
_FORMS: Mapping[Kind, str] = {"temperatures": "temp{}_c", "currents": "current{}_a"}


@dataclass(frozen=True, eq=False)
class Heat:
    """Recorded heating of an arm, and when its views were taken."""

    session: Session  # The session that records it.
    robot: str  # The robot's name there.
    joints: int  # Number of joints.
    views: IntArray  # (m,) a view of each of the arm's m stops.
    stamps_s: FloatArray  # (m,) when that was taken [s]; NaN where unknown.

    def at(self, rows: IntArray) -> Self:
        """Returns it for some of the stops."""
        return replace(self, views=self.views[rows], stamps_s=self.stamps_s[rows])

    @cached_property
    def _read(self) -> tuple[Inputs | None, str]:
        return inputs_of(self.session, self.joints, self.robot)

    @property
    def inputs(self) -> Inputs | None:
        """Temperatures or currents; None where they do not cover all of the stops."""
        return None if self.missing else self._read[0]

    @property
    def missing(self) -> str:
        """What is missing, in words; empty for nothing."""
        inputs, missing = self._read
        if inputs is None:
            return missing
        untimed = self.views[np.isnan(self.stamps_s)].tolist()
        if untimed:
            return f"view {untimed[0]} has no stamp_s"
        first_s, last_s = inputs.stamps_s[[0, -1]].tolist()
        stamps = self.stamps_s
        if stamps.min() < first_s - _BEYOND_S or stamps.max() > last_s + _BEYOND_S:
            return (
                f"{inputs.kind} were read from {first_s:.10g} to {last_s:.10g} s, and views were "
                f"taken from {stamps.min():.10g} to {stamps.max():.10g} s"
            )
        return ""

    @property
    def set_aside(self) -> str:
        """Why recorded inputs cannot be used; empty where they can, or none were recorded."""
        return "" if self._read[0] is None else self.missing


def heating(heat: Heat | None, asked: str) -> Inputs | None:
    """The inputs that heat an arm; None where not requested, or not determined by the session.

    Raises:
        DataError: The level requires it, and the session lacks data.
        DegenerateError: The level requires it, and all views were taken about equally warm.
    """
    if asked not in ("auto", LEVEL):
        return None
    inputs = None if heat is None else heat.inputs
    if heat is None or inputs is None:
        if asked == LEVEL:
            raise _missing_error(NO_JOINTS if heat is None else heat.missing)
        return None
    why = uninformative(inputs, heat.stamps_s)
    if why and asked == LEVEL:
        raise DegenerateError(
            f"thermal: {why}: the views do not show how the arm drifts.",
            culprits=["temperatures"],
            next_step=_ADVICE,
        )
    return None if why else inputs


def _missing_error(missing: str) -> DataError:
    return DataError(
        f"level {LEVEL!r} needs to know what heats the arm: {missing}.",
        culprits=["level"],
        next_step="Record temp1_c ... or current1_a ... with stamp_s in streams/NAME.csv, and "
        "stamp_s, q1_rad ... with every view.",
    )


def find_drift(
    problem: Problem, start: State, stops: ThermalStops, inputs: Inputs, nominal: Robot
) -> ThermalFit:
    """Fits an arm's drift with the frames and, where these have significant errors, its links.

    `problem` has the arm as reported, `nominal` is its model.
    """
    robot, poses = stops.robot, problem.poses[stops.robot]
    model = ArmModel.of(nominal, stops.q, poses[stops.places])
    basis = np.zeros((len(poses), 6, model.size_of("links")))
    basis[stops.places] = model.columns("links", stops.q)
    noise = starting_noise(problem)
    likelihood = robot_likelihood(problem, start, noise)
    links = find_arm_errors(likelihood, problem.robots.index(robot), basis, of_links=True)
    if links is not None:
        problem = problem.with_effects([*problem.effects, links.effect(robot)])
        start = State(start.edges, problem.start_values)
    return fit_thermal(problem, start, model.robot, stops, inputs, nominal)


def is_found(fit: ThermalFit) -> bool:
    """Whether drift explains the views significantly."""
    return fit.gain > SIGNIFICANT


def findings(fit: ThermalFit) -> Iterator[str]:
    """States the drift, for the verdict."""
    if not is_found(fit):
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
    # Currents determine only the product of a gain and a growth.
    measured = fit.model.heating.kind == "temperatures"
    counted = ("growth", "drift") if measured else ("drift",)
    names = [name for name in fit.not_determined if name.startswith(counted)]
    if names:
        yield (
            f"The views do not determine {some_of(names, 6)}: what is known of arms, steel and "
            "aluminium stands for these."
        )


def drift_result(
    fit: ThermalFit, stops: ThermalStops, views: Sequence[int], problem: Problem, solved: Solution
) -> ThermalResult:
    """A drift's coefficients and its course, as a section of a calibration.

    `views` has a view of each stop, `problem` the inlier observations, and `solved` is their fit.
    """
    model = fit.model
    return ThermalResult(
        heated_by=model.heating.kind,
        joints=_joints(model),
        covariance=model.covariance,
        lengths_m=model.lengths,
        not_determined=tuple(fit.not_determined),
        residual_mm=DriftResidual(without=1e3 * fit.before_m, with_drift=1e3 * fit.after_m),
        likelihood_ratio=fit.gain,
        rises_k=tuple(fit.rises_k.tolist()),
        trained_s=float(np.ptp(stops.stamps_s)),
        course=_course(fit, _typical_posture(stops.q)),
        seen=_observed_drift(fit, stops, views, problem, solved.state),
        views=_by_view(fit, stops, views),
    )


def _joints(model: ThermalModel) -> tuple[JointDrift, ...]:
    """The coefficients joint by joint; sigmas of tau and gain are relative."""
    columns = {
        "reference_c": model.reference_c,
        "growth_per_k": model.growth_per_k,
        "drift_rad_per_k": model.drift_rad_per_k,
        "tau_s": model.heating.tau_s,
    }
    sigmas = np.sqrt(np.diag(model.covariance)).reshape(-1, model.joint_count)
    names = ["growth_sigma_per_k", "drift_sigma_rad_per_k", "tau_sigma"]
    if model.heating.kind == "currents":
        columns["gain_k_per_a2"] = model.heating.gain_k_per_a2
        names.append("gain_sigma")
    columns |= dict(zip(names, sigmas, strict=True))
    return tuple(
        JointDrift(joint=joint, **{name: float(column[at]) for name, column in columns.items()})
        for at, joint in enumerate(model.robot.joint_names)
    )


def _by_view(fit: ThermalFit, stops: ThermalStops, views: Sequence[int]) -> tuple[ViewDrift, ...]:
    """Drift of the flange at (m,) views, and the largest temperature rise of a link."""
    drift_m = np.linalg.norm(fit.motion(stops)[:, :3, 3], axis=1)
    rises = fit.model.rises(fit.links_c(stops)).max(axis=1)
    rows = zip(views, (1e3 * drift_m).tolist(), rises.tolist(), strict=True)
    return tuple(ViewDrift(*row) for row in rows)


def _course(fit: ThermalFit, q: FloatArray) -> tuple[DriftPoint, ...]:
    """Drift of the flange at (n,) joint angles over time, with its sigma."""
    model, inputs = fit.model, fit.inputs
    at_s = np.linspace(inputs.stamps_s[0], inputs.stamps_s[-1], _COURSE_POINTS)
    links = model.heating.links_c(inputs, at_s)
    rows = np.tile(q, (len(at_s), 1))
    drift_m = np.linalg.norm(model.motion(rows, links)[:, :3, 3], axis=1)
    sigma_m = model.sigma_m(rows, links, model.heating.jacobian(inputs, at_s))
    rises = model.rises(links).max(axis=1)
    columns = (at_s, 1e3 * drift_m, 1e3 * sigma_m, rises)
    return tuple(DriftPoint(*row) for row in np.stack(columns, axis=1).tolist())


def _observed_drift(
    fit: ThermalFit, stops: ThermalStops, views: Sequence[int], problem: Problem, state: State
) -> tuple[ObservedDrift, ...]:
    """Observed drift of the flange at the stops in the typical posture, by their first view.

    The residual of a stop is attributed to its flange, and projected on the drift's direction: its
    length alone would grow with noise.
    """
    problem = replace(problem, is_combined=False)
    linearised, pair = problem.linear(state), ArmPair.of(problem, state, stops.robot)
    of, members = problem.units
    slots = (members[of[pair.rows]] == problem.robots.index(stops.robot)).argmax(axis=1)
    stop_ids, first = np.unique(problem.observations.stops[pair.rows], return_index=True)
    typical = np.abs(stops.q - _typical_posture(stops.q)).max(axis=1) < _SAME_RAD
    places = np.where(typical, stops.places, -1)
    _, chosen, at_stops = np.intersect1d(places, stop_ids, return_indices=True)
    if not len(chosen):
        return ()
    rows, slots = pair.rows[first[at_stops]], slots[first[at_stops]]
    errors = linearised.by_errors[rows].reshape(len(rows), 6, -1, 6)[np.arange(len(rows)), :, slots]
    # A point alone does not separate a flange's rotation from its position: all counts as position.
    used = problem.observations.has_rotation[rows, None] | (np.arange(6) >= 3)
    of_flange = np.linalg.pinv(errors * used[:, None]) @ linearised.residuals[rows, :, None]
    residual_m = -of_flange[:, 3:, 0]
    drift_m = fit.motion(stops)[chosen, :3, 3]
    # With hardly any drift there is no direction: that of the largest drift is used for all.
    lengths = np.linalg.norm(drift_m, axis=1)
    direction = drift_m[int(np.argmax(lengths))] / max(float(lengths.max()), 1e-9)
    observed_m = lengths + residual_m @ direction
    return tuple(
        ObservedDrift(views[at], float(stops.stamps_s[at]), 1e3 * drift)
        for at, drift in zip(chosen.tolist(), observed_m.tolist(), strict=True)
    )


def _typical_posture(q: FloatArray) -> FloatArray:
    """(n,) the most frequent posture of (s, n) stops; of several, the most central one."""
    counts = [int((np.abs(q - value).max(axis=1) < _SAME_RAD).sum()) for value in q]
    distance = np.abs(q - np.median(q, axis=0)).sum(axis=1)
    return np.asarray(q[np.lexsort((distance, -np.array(counts)))[0]])


def inputs_of(session: Session, joints: int, robot: str = "") -> tuple[Inputs | None, str]:
    """Reads the inputs that heat an arm from a session; temperatures come before currents.

    Returns:
        The inputs; or None, and what is missing.
    """
    tables = [*streams_of(session, robot).values(), _views_as_stream(session, robot)]
    for kind, form in _FORMS.items():
        names = [form.format(at + 1) for at in range(joints)]
        for table in tables:
            stamps_s, heat = table.group(names)
            if len(stamps_s) >= _FEWEST_SAMPLES:
                return _inputs(kind, stamps_s, heat, tables), ""
    return None, _missing_columns(tables, joints)


def _inputs(kind: Kind, stamps_s: FloatArray, heat: FloatArray, tables: Sequence[Stream]) -> Inputs:
    ambient = np.zeros(len(stamps_s))
    for table in tables:
        at_s, air = table.group((_AMBIENT,))
        if len(at_s):
            ambient = np.interp(stamps_s, at_s, air[:, 0])
            break
    heat = heat if kind == "temperatures" else heat**2
    return _averaged(Inputs(kind, stamps_s, heat, ambient))


def _averaged(inputs: Inputs) -> Inputs:
    """Averages neighbouring samples where there are more than warm-up needs."""
    count = len(inputs.stamps_s)
    size = -(-count // _MOST_SAMPLES)
    if size == 1:
        return inputs
    starts = np.arange(0, count, size)
    lengths = np.diff(np.append(starts, count))
    return Inputs(
        inputs.kind,
        np.add.reduceat(inputs.stamps_s, starts) / lengths,
        np.add.reduceat(inputs.signal, starts, axis=0) / lengths[:, None],
        np.add.reduceat(inputs.ambient_c, starts) / lengths,
    )


def _views_as_stream(session: Session, robot: str) -> Stream:
    """A robot's views with a time, as a stream of their numbers."""
    numbers = {
        view.stamp_s: view.numbers
        for view in session.views
        if view.stamp_s is not None and name_of(session.declaration, "robot", view) == robot
    }
    rows = sorted(numbers.items())
    names = sorted({name for _, row in rows for name in row} - {STAMP})
    values = [[stamp_s, *(row.get(name, np.nan) for name in names)] for stamp_s, row in rows]
    return Stream((STAMP, *names), np.array(values).reshape(len(rows), len(names) + 1))


def _missing_columns(tables: Sequence[Stream], joints: int) -> str:
    columns = {name for table in tables for name in table.columns}
    for form in _FORMS.values():
        names = [form.format(at + 1) for at in range(joints)]
        absent = [name for name in names if name not in columns]
        if len(absent) < joints:
            return (
                f"{some_of(absent)} of {names[0]} ... {names[-1]} are missing"
                if absent
                else f"{names[0]} ... {names[-1]} are filled together in fewer than "
                f"{_FEWEST_SAMPLES} rows with a time"
            )
    return (
        f"neither a stream nor timed rows of views.csv have temp1_c ... temp{joints}_c or "
        f"current1_a ... current{joints}_a"
    )

"""Whether temperatures explain how the views move in the course of a session.

They come out of its streams, or else out of columns of its views.
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
from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import Solution, robot_likelihood, starting_noise
from visioncal.results.arm import (
    DriftPoint,
    DriftResidual,
    JointDrift,
    ObservedDrift,
    ThermalResult,
    ViewDrift,
)
from visioncal.robot import Robot
from visioncal.robot.thermal import Inputs, ThermalModel
from visioncal.robot.thermal.heating import Kind
from visioncal.session import Session
from visioncal.session.kinds import name_of
from visioncal.session.selecting import streams_of
from visioncal.session.streams import STAMP, Stream

LEVEL = "thermal"
NO_JOINTS = "the joint angles of every view, a known model of the robot and the joint fit"
# Views may be so far before the first and behind the last sample [s].
_BEYOND_S = 300.0
# Joints that are within this of a posture are in it [rad].
_SAME_RAD = 1e-3
# The reported course is drawn by so many points.
_DRAWN = 200
_ADVICE = (
    "Begin with a cold robot, let it work for an hour or more, and look at the same few reference "
    "views every five to ten minutes."
)
# More samples than this determine warm-up no better: they are averaged in bunches.
_MOST_SAMPLES = 8192
_FEWEST_SAMPLES = 3
_AMBIENT = "ambient_c"
_FORMS: Mapping[Kind, str] = {"temperatures": "temp{}_c", "currents": "current{}_a"}


@dataclass(frozen=True, eq=False)
class Heat:
    """What heats an arm, and when it was looked at.

    Attributes:
        session: The session that records it.
        robot: The robot's name there.
        joints: How many joints it has.
        views: (m,) by which view each of the m stops goes at which it was.
        stamps_s: (m,) when that was taken [s]; NaN where that is not known.
    """

    session: Session
    robot: str
    joints: int
    views: IntArray
    stamps_s: FloatArray

    def at(self, rows: IntArray) -> Self:
        """Returns it for some of the stops."""
        return replace(self, views=self.views[rows], stamps_s=self.stamps_s[rows])

    @cached_property
    def _read(self) -> tuple[Inputs | None, str]:
        return inputs_of(self.session, self.joints, self.robot)

    @property
    def inputs(self) -> Inputs | None:
        """Temperatures or currents; None where they were not recorded at all of the stops."""
        return None if self.missing else self._read[0]

    @property
    def missing(self) -> str:
        """What is missing, in words; empty where nothing is."""
        inputs, missing = self._read
        if inputs is None:
            return missing
        timeless = self.views[np.isnan(self.stamps_s)].tolist()
        if timeless:
            return f"view {timeless[0]} has no stamp_s"
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
        """Why what was recorded of it cannot be used; empty where it can, or none was recorded."""
        return "" if self._read[0] is None else self.missing


def heating(heat: Heat | None, asked: str) -> Inputs | None:
    """What heats an arm; None where that is not asked for, or the session does not determine it.

    Args:
        heat: What is known of it; None where the arm's joints are not known.
        asked: How far the arm is to be calibrated.

    Raises:
        DataError: The level asks for it, and the session lacks what it takes.
        DegenerateError: The level asks for it, and all views were taken about equally warm.
    """
    if asked not in ("auto", LEVEL):
        return None
    inputs = None if heat is None else heat.inputs
    if heat is None or inputs is None:
        if asked == LEVEL:
            raise _missing(NO_JOINTS if heat is None else heat.missing)
        return None
    why = uninformative(inputs, heat.stamps_s)
    if why and asked == LEVEL:
        raise DegenerateError(
            f"thermal: {why}: the views do not show how the arm drifts.",
            culprits=["temperatures"],
            next_step=_ADVICE,
        )
    return None if why else inputs


def _missing(missing: str) -> DataError:
    return DataError(
        f"level {LEVEL!r} needs to know what heats the arm: {missing}.",
        culprits=["level"],
        next_step="Record temp1_c ... or current1_a ... with stamp_s in streams/NAME.csv, and "
        "stamp_s, q1_rad ... with every view.",
    )


def find_drift(
    problem: Problem, start: State, stops: ThermalStops, inputs: Inputs, nominal: Robot
) -> ThermalFit:
    """Fits an arm's drift with the frames and, where they are off, its links.

    Args:
        problem: The observations, with the arm as reported.
        start: Where to start.
        stops: Where it was observed, and when.
        inputs: What heats it.
        nominal: Its model.
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
    """Whether drift explains the views by more than chance."""
    return fit.gain > SIGNIFICANT


def findings(fit: ThermalFit) -> Iterator[str]:
    """Says what was found, for the verdict."""
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
    # Currents determine a gain and a growth by their product alone.
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

    Args:
        fit: The drift.
        stops: Where the arm stood, and when.
        views: (m,) by which views these stops go.
        problem: The observations that agree.
        solved: Their fit.
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
        course=_course(fit, _typical(stops.q)),
        seen=_seen(fit, stops, views, problem, solved.state),
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
    """How far the flange had drifted at (m,) views, and the largest rise of a link."""
    moved = np.linalg.norm(fit.motion(stops)[:, :3, 3], axis=1)
    rises = fit.model.rises(fit.links_c(stops)).max(axis=1)
    rows = zip(views, (1e3 * moved).tolist(), rises.tolist(), strict=True)
    return tuple(ViewDrift(*row) for row in rows)


def _course(fit: ThermalFit, q: FloatArray) -> tuple[DriftPoint, ...]:
    """How far the flange has drifted at (n,) joint angles, and how surely that is known."""
    model, inputs = fit.model, fit.inputs
    at_s = np.linspace(inputs.stamps_s[0], inputs.stamps_s[-1], _DRAWN)
    links = model.heating.links_c(inputs, at_s)
    rows = np.tile(q, (len(at_s), 1))
    moved = np.linalg.norm(model.motion(rows, links)[:, :3, 3], axis=1)
    sigma = model.sigma_m(rows, links, model.heating.jacobian(inputs, at_s))
    rises = model.rises(links).max(axis=1)
    columns = (at_s, 1e3 * moved, 1e3 * sigma, rises)
    return tuple(DriftPoint(*row) for row in np.stack(columns, axis=1).tolist())


def _seen(
    fit: ThermalFit, stops: ThermalStops, views: Sequence[int], problem: Problem, state: State
) -> tuple[ObservedDrift, ...]:
    """How far the stops in the typical posture see the flange to have moved, by their first view.

    What is left of a stop is taken for its flange's, and counted along the drift's direction: its
    length alone would grow with noise.
    """
    problem = replace(problem, is_combined=False)
    linear, pair = problem.linear(state), ArmPair.of(problem, state, stops.robot)
    of, members = problem.units
    slots = (members[of[pair.rows]] == problem.robots.index(stops.robot)).argmax(axis=1)
    where, first = np.unique(problem.observations.stops[pair.rows], return_index=True)
    alike = np.abs(stops.q - _typical(stops.q)).max(axis=1) < _SAME_RAD
    _, chosen, among = np.intersect1d(np.where(alike, stops.places, -1), where, return_indices=True)
    if not len(chosen):
        return ()
    rows, slots = pair.rows[first[among]], slots[first[among]]
    errors = linear.by_errors[rows].reshape(len(rows), 6, -1, 6)[np.arange(len(rows)), :, slots]
    # A point alone does not part a flange's rotation from its place: all counts as place.
    turns = problem.observations.has_rotation[rows, None] | (np.arange(6) >= 3)
    left = -(np.linalg.pinv(errors * turns[:, None]) @ linear.residuals[rows, :, None])[:, 3:, 0]
    moved = fit.motion(stops)[chosen, :3, 3]
    # Where it has hardly moved it has no direction: that of the farthest stop serves them all.
    lengths = np.linalg.norm(moved, axis=1)
    far = moved[int(np.argmax(lengths))] / max(float(lengths.max()), 1e-9)
    seen = lengths + left @ far
    return tuple(
        ObservedDrift(views[at], float(stops.stamps_s[at]), 1e3 * drift)
        for at, drift in zip(chosen.tolist(), seen.tolist(), strict=True)
    )


def _typical(q: FloatArray) -> FloatArray:
    """(n,) the posture that most of (s, n) stops are in; of several, the one that most are near."""
    alike = [int((np.abs(q - value).max(axis=1) < _SAME_RAD).sum()) for value in q]
    away = np.abs(q - np.median(q, axis=0)).sum(axis=1)
    return np.asarray(q[np.lexsort((away, -np.array(alike)))[0]])


def inputs_of(session: Session, joints: int, robot: str = "") -> tuple[Inputs | None, str]:
    """Takes what heats an arm out of a session; temperatures come before currents.

    Args:
        session: The session.
        joints: How many joints the arm has.
        robot: Its name, where the session has several.

    Returns:
        What heats it; or None, and what is missing.
    """
    tables = [*streams_of(session, robot).values(), _of_views(session, robot)]
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
    return _bunched(Inputs(kind, stamps_s, heat, ambient))


def _bunched(inputs: Inputs) -> Inputs:
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


def _of_views(session: Session, robot: str) -> Stream:
    """A robot's views that have a time, as a stream of their numbers."""
    mine = [view for view in session.views if name_of(session.declaration, "robot", view) == robot]
    rows = sorted({view.stamp_s: view.numbers for view in mine if view.stamp_s is not None}.items())
    names = sorted({name for _, row in rows for name in row} - {STAMP})
    values = [[stamp_s, *(row.get(name, np.nan) for name in names)] for stamp_s, row in rows]
    return Stream((STAMP, *names), np.array(values).reshape(len(rows), len(names) + 1))


def _missing_columns(tables: Sequence[Stream], joints: int) -> str:
    there = {name for table in tables for name in table.columns}
    for form in _FORMS.values():
        names = [form.format(at + 1) for at in range(joints)]
        absent = [name for name in names if name not in there]
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

"""A calibrated arm as stops determine it: its parameters, its accuracy, and remarks on both."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from visioncal.calibration.stages import elastic
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.thermal import drift_result
from visioncal.core.choices import Convention
from visioncal.core.number_format import figure, some_of
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import LEVER_M
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Finding, Remedy
from visioncal.estimation.arm import stops_of
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.fit import Fit
from visioncal.estimation.identifiability import (
    Identifiability,
    Jacobians,
    is_linear_zero,
    observability_indices,
    parameter_words,
    undetermined,
)
from visioncal.estimation.one_parameter import FarParameter, far_parameters
from visioncal.estimation.parameters import Parameter, free_parameters, parameter_moves
from visioncal.results.arm import (
    ArmErrorsResult,
    ArmParameter,
    ArmResult,
    ArmSections,
    JointRange,
    Observability,
    WorkspacePlace,
    WorkspaceSigma,
)
from visioncal.robot import Robot
from visioncal.robot.arm_model import RIGID
from visioncal.robot.conversion import convert_table, parallel_axes, table_of
from visioncal.robot.errors import ArmErrors
from visioncal.robot.model import joint_words
from visioncal.robot.tables import DHTable, table_from_document
from visioncal.robot.workspace import postures

# Number of postures of a map of the accuracy.
_PLACES = 200
_FAR_OFF = (
    ("theta", "Zeros are off", "where they were lost, or the model counts from others"),
    ("sine", "Encoders or gears run out", "where they sit eccentrically"),
)


@dataclass(frozen=True, eq=False)
class ArmReport:
    """Findings about an arm."""

    sections: ArmSections = field(default_factory=ArmSections)  # Its sections of a calibration.
    notes: tuple[str, ...] = ()  # Remarks that are no reason for doubt.
    doubts: tuple[Finding, ...] = ()  # Findings against the arm.


def report_of(
    arm: Arm, fit: Fit, middles: Mapping[str, FloatArray], convention: Convention | None = None
) -> ArmReport:
    """Findings about an arm.

    Args:
        arm: The arm.
        fit: The fit of a cell, with the arm's errors among the unknowns.
        middles: (3,) centre of each printed target by its frame, in that frame [m].
        convention: Convention of the arm's table; see `add_parameters`.
    """
    data, levels, found = arm.data(fit, middles), arm.kinematics, ArmReport()
    sections = ArmSections(arm=levels)
    if data is not None and levels is not None:
        found = _calibrated(data, levels, convention)
        sections = found.sections
    if arm.errors is not None and arm.errors.is_likely:
        sections = replace(sections, arm_errors=_size_of(arm.errors))
    if arm.drift is not None:
        used = arm.at(stops_of(fit.problem, arm.robot))
        sections = replace(sections, thermal=drift_result(arm.drift, used))
    return replace(found, sections=sections)


def _calibrated(arm: ArmData, levels: ArmResult, convention: Convention | None) -> ArmReport:
    """Findings about a calibrated arm."""
    model, notes = arm.model, list[str]()
    result = replace(
        levels,
        left_out=(),
        robot=model.robot,
        backlash=elastic.plays_of(model, arm.arm_covariance),
        measured=tuple(
            JointRange(name, float(column.min()), float(column.max()))
            for name, column in zip(model.nominal.joint_names, arm.q.T, strict=True)
        ),
    )
    mistyped = list[Finding]()
    # With backlash and compliance alone the table stays nominal.
    if model.weights.keys() & set(RIGID):
        result, advice, mistyped = add_parameters(result, arm, convention)
        result = replace(result, left_out=levels.left_out)
        notes += [*far_off(result.parameters, model.nominal), *([advice] if advice else [])]
    springs = elastic.elastic_of(arm)
    notes += () if springs is None else elastic.remarks(springs)
    doubts = [*mistyped, *elastic.play_findings(result.backlash)]
    doubts += () if springs is None else elastic.doubts(springs)
    return ArmReport(ArmSections(arm=result, elastic=springs), tuple(notes), tuple(doubts))


def _size_of(errors: ArmErrors) -> ArmErrorsResult:
    """Size of the errors, as a section of a calibration."""
    of: Literal["flange"] | None = None
    sigmas = errors.sigma * np.array([1.0, LEVER_M])
    if errors.fit_sigmas is not None and errors.white is not None:
        of, sigmas = "flange", np.sqrt(np.maximum(errors.fit_sigmas**2 - errors.white**2, 0.0))
    return ArmErrorsResult(
        sigma_mm=1e3 * float(sigmas[1]),
        sigma_deg=float(np.rad2deg(sigmas[0])),
        likelihood_ratio=errors.gain,
        estimated=errors.is_estimated,
        of=of,
    )


def far_off(parameters: Sequence[ArmParameter], robot: Robot) -> Iterator[str]:
    """Names joints whose zero or eccentricity is off by more than makers leave."""
    for name, words, why in _FAR_OFF:
        off = dict[str, float]()
        for at in parameters:
            # A cosine's name contains that of a sine. Makers leave zeros and eccentricities within
            # 2 mrad; one is off by more where ten sigmas show it.
            if name in at.name and at.sigma and abs(at.change) > max(2e-3, 10.0 * at.sigma):
                off[at.joint] = float(np.hypot(off.get(at.joint, 0.0), at.change))
        places = map(robot.joint_names.index, off)
        sizes = [
            f"{joint_words(place, robot)} by {figure(float(np.rad2deg(size)))} deg"
            for place, size in zip(places, off.values(), strict=True)
        ]
        if sizes:
            yield f"{words}: {some_of(sizes, most=3)}, as {why}."


def add_parameters(
    result: ArmResult, arm: ArmData, convention: Convention | None
) -> tuple[ArmResult, str, list[Finding]]:
    """Adds the parameters of an arm that the stops determine, and how accurate the arm is.

    Args:
        result: The arm's section of a calibration.
        arm: The observations of the arm.
        convention: Convention of the table; None for the stated one, or Hayati's where axes are
            nearly parallel, as it has no singularity there.

    Returns:
        The section; which stops to add, empty where none would determine more; and the finding on
        a parameter that explains the errors alone, if one does.
    """
    model, nominal, advice = arm.model, arm.model.nominal, ""
    has_table = "convention" in nominal.document
    before = table_from_document(nominal.document) if has_table else table_of(nominal, "standard")
    if convention is None and parallel_axes(nominal).any():
        convention = "hayati"
    before = convert_table(before, convention or before.convention)
    after = table_of(model.bare, before.convention, like=before)
    parameters = tuple(free_parameters(model, before))
    anywhere = postures(model.robot)
    shares = np.random.default_rng(0).uniform(size=(_PLACES, arm.q.shape[1]))
    near = arm.q.min(axis=0) + shares * np.ptp(arm.q, axis=0)
    with one_blas_thread():
        weight = arm.pair.weight(arm.fit.noise, arm.measured)
        by_stops = Jacobians.of_stops(arm)
        by_errors = _error_jacobians(arm, anywhere, weight)
        counts = Identifiability.of(by_stops, by_errors)
        jacobian = parameter_moves(model, before, parameters)
        not_determined = list[str]()
        if counts.determined < counts.identifiable:
            moves = jacobian[:, model.is_kept]
            named = undetermined(by_stops, by_errors, moves, parameters, nominal)
            not_determined.append(f"these stops do not determine {named}")
            advice = (
                f"The stops determine {counts.determined} of the {counts.identifiable} "
                f"identifiable values of this arm and its frames: {not_determined[-1]}. What is "
                "not determined stays about as stated. Add stops all over the workspace."
            )
        sigmas_mm, near_mm = (1e3 * arm.place_sigmas_m(array) for array in (anywhere, near))
        covariance = arm.arm_covariance
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)).tolist()
    far = [(parameters[at.at], at) for at in far_parameters(arm, parameters, jacobian)]
    mistyped = [*_mistyped(far, before, nominal)]
    links, rows = model.error_rad * model.weights.get("links", 1.0), []
    for parameter, sigma, by_row in zip(parameters, sigmas, jacobian, strict=True):
        stated, identified = parameter.value(before), parameter.value(after)
        rows.append(
            ArmParameter(
                joint=nominal.joint_names[parameter.joint],
                name=parameter.name,
                nominal=stated,
                identified=identified,
                change=identified - stated,
                # A parameter that base or flange absorbs keeps its prior sigma.
                sigma=max(sigma, 0.0 if by_row.any() else links * parameter.unit),
            )
        )
    maps = (
        np.column_stack([model.robot.base_from_flange(q)[:, :3, 3], mm])[:_PLACES].tolist()
        for q, mm in ((anywhere, sigmas_mm), (near, near_mm))
    )
    workspace_map, measured_map = (tuple(WorkspacePlace(*row) for row in rows) for rows in maps)
    result = replace(
        result,
        convention=before.convention,
        parameters=tuple(rows),
        workspace_sigma_mm=WorkspaceSigma(
            float(np.median(sigmas_mm)), float(np.quantile(sigmas_mm, 0.95))
        ),
        workspace_map=workspace_map,
        measured_map=measured_map,
        observability=Observability(
            columns=counts.columns,
            identifiable=counts.identifiable,
            determined=counts.determined,
            **observability_indices(counts.values, len(arm.stops)),
        ),
        not_determined=tuple(not_determined),
    )
    return result, advice, mistyped


def _mistyped(
    far: Sequence[tuple[Parameter, FarParameter]], table: DHTable, robot: Robot
) -> Iterator[Finding]:
    """The finding on a table's parameter that explains an arm's errors alone.

    Lost zeros and eccentric encoders are named by `far_off`.
    """
    if not far or any(name in far[0][0].name for name, *_ in _FAR_OFF):
        return
    first, *others = (_off(*each, table, robot) for each in far)
    either = f" Or {' or '.join(others)}: these stops do not separate them." if others else ""
    words = (
        f"{first[0].upper()}{first[1:]}. This alone explains what the arm errs by: beside it, its "
        f"other parameters are off by {100.0 * far[0][1].rest:.0f} % of what they are without."
    )
    yield Finding(
        "arm_parameter",
        f"{words}{either}",
        Remedy(
            "Compare it with the maker's data sheet, correct the table or .urdf that [robot] model "
            "in session.toml names, and calibrate again; or keep the arm as calibrated."
        ),
        until_mm=0.0,
        mahalanobis_sq=2.0 * far[0][1].gain,
    )


def _off(parameter: Parameter, found: FarParameter, table: DHTable, robot: Robot) -> str:
    """The error of a parameter, in words."""
    stated, size = parameter.value(table), abs(found.change)
    if parameter.kind == "ratio":
        by = f"is off by {figure(100.0 * size)} % (sigma {figure(100.0 * found.sigma)} %)"
    elif is_linear_zero(parameter, robot):
        by = f"is off by {figure(1e3 * size)} mm (sigma {figure(1e3 * found.sigma)} mm)"
    elif parameter.is_length:
        longer = "longer" if abs(stated + found.change) > abs(stated) else "shorter"
        by = (
            f"is {figure(1e3 * size)} mm {longer} than stated (sigma "
            f"{figure(1e3 * found.sigma)} mm): {1e3 * (stated + found.change):.2f} and not "
            f"{1e3 * stated:.2f} mm"
        )
    else:
        size_deg, sigma_deg = np.rad2deg([size, found.sigma]).tolist()
        by = f"is off by {figure(size_deg)} deg (sigma {figure(sigma_deg)} deg)"
    return f"{parameter_words(parameter, robot)} {by}"


def _error_jacobians(arm: ArmData, q: FloatArray, weight: FloatArray) -> Jacobians:
    """Jacobians by frames and arm errors at (k, n) postures, weighted as for the stops' noise."""
    columns, flange = arm.model.basis_without_harmonics(q), arm.model.base_from_flange(q)
    by_flange = weight @ arm.pair.at(flange)[0].by_errors
    errors = by_flange @ (columns * arm.model.error_rad)
    frames = by_flange @ arm.pair.frame_jacobian(flange)
    return Jacobians(frames.reshape(-1, 12), errors.reshape(-1, columns.shape[2]))

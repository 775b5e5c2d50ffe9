"""Assembles a Calibration of one camera and robot, or of a whole cell, from a finished run.

It includes the joint fit, as a later verification of the same cell needs it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np

from visioncal.calibration.pipeline.assessment import held_back_by_arm
from visioncal.calibration.pipeline.cell_fit import within
from visioncal.calibration.pipeline.connectivity import connection_advice
from visioncal.calibration.pipeline.judging import weakest_link
from visioncal.calibration.pipeline.lens_fields import lens_field_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.handeye import compare_solvers
from visioncal.calibration.stages.need import need_met
from visioncal.calibration.stages.readings import Readings
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.appearance import BOARD_NAMES, shape_slices
from visioncal.estimation.arm import misfit_jacobian, stops_of
from visioncal.estimation.armmodel import HARMONICS
from visioncal.estimation.chain import edge_names
from visioncal.results import (
    HELD_BACK,
    Calibration,
    CameraResult,
    CellResult,
    RobotResult,
    SolverResult,
    UnconnectedFrame,
    Validation,
    ViewResult,
)
from visioncal.results.arm import ArmSections
from visioncal.results.sections import (
    BoardResult,
    CellDetails,
    CellJointFit,
    CellUncertainty,
    DenseResult,
    FittedArm,
    ImageBlur,
    InstrumentResult,
    Intervals,
    JointFit,
    PointResult,
    RigResult,
    UncertaintyResult,
)
from visioncal.results.views import rms_of
from visioncal.robot import Robot
from visioncal.session import View, frame_name
from visioncal.session.frames import object_name
from visioncal.vision.targets import target_document

_T = TypeVar("_T")
_OF_LENS = "it serves the camera's lens alone (role = intrinsics)"
_NO_POSE = (
    "no pose of the target: it has neither image nor rows in corners.csv nor cft_ nor meas_ columns"
)
# Columns of views.csv with the conditions under which a view was taken.
CONDITIONS = ("ambient_c", "payload_kg")


def result_of(run: RunState) -> Calibration:
    """Assembles the calibration when all stages have run.

    Raises:
        RuntimeError: One has not.
    """
    findings, verdict = run.findings, run.verdict
    if findings is None or verdict is None:
        raise RuntimeError("a stage is missing")
    session, answer = run.session, run.assessment
    cell = cell_of(run) if run.mount is None else None
    names = _edge_names(run) if cell is None else cell_edges(run)
    size = 6 * len(names)
    was_left_out = np.isfinite(answer.held_out.residual_m).any()
    method = answer.held_out.method if was_left_out else ""
    boards, rigs = shapes_of(run)
    calibration = Calibration(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        mount=session.mount if cell is None else cell.mount,
        edges={name: answer.edges[frame] for frame, name in names.items()},
        joint_covariance=answer.covariance[:size, :size],
        solvers={},
        noise={},
        views=answer.views,
        rms=rms_of(answer.views),
        validation=Validation.of(method, answer.views, by_pair=True),
        verdict=verdict,
        boards=boards,
        rigs=rigs,
        cell=cell,
        dense=_dense(run),
        need=need_met(findings.need, findings.judged_picks, whole=cell is not None),
    )
    return calibration if cell is not None else _complete_pair(calibration, run, names)


def _complete_pair(
    calibration: Calibration, run: RunState, names: Mapping[str, str]
) -> Calibration:
    """Completes the calibration of one camera and one robot, which have no names."""
    # A single target without a name has one section.
    is_unnamed = not run.session.targets
    return replace(
        calibration,
        solvers=_solvers(run, names),
        noise=_noise(run),
        views=_views(run),
        validation=Validation.of(run.assessment.held_out.method, run.assessment.views),
        camera=next(iter(cameras_of(run).values()), None),
        robot=run.robot,
        clock=next((clocked.clock for clocked in run.clocks.values()), None),
        instrument=None if run.readings is None else _instrument(run.readings),
        points=tuple(_points(run)),
        board=next(iter(calibration.boards.values()), None) if is_unnamed else None,
        boards={} if is_unnamed else calibration.boards,
        rig=next(iter(calibration.rigs.values()), None) if is_unnamed else None,
        rigs={} if is_unnamed else calibration.rigs,
        uncertainty=_uncertainty(run),
        means=_means_of(run),
        joint_fit=_joint_fit_of(run),
        **vars(_arm(run)),
    )


def _dense(run: RunState) -> DenseResult | None:
    if run.dense is None:
        return None
    return DenseResult(
        images=tuple(
            ImageBlur(
                view=view,
                sigma_px=found.blur_px,
                motion_px=float(np.hypot(*found.motion_px)),
                motion_deg=float(np.rad2deg(np.arctan2(*found.motion_px[::-1])) % 180.0),
                pixel_noise=found.noise,
            )
            for view, found in run.dense.items()
        )
    )


def _edge_names(run: RunState) -> dict[str, str]:
    """The names of the edges by their child frames, the camera's first."""
    frames, names = run.assessment.problem.unknown, edge_names(run.session.mount)
    if run.mount == "instrument":
        # Of the points that an instrument read, the first is the probe.
        return dict(zip(frames, names, strict=False))
    parents = [name.partition("_from_")[0] for name in names]
    return {frame: f"{parents[min(at, 1)]}_from_{frame}" for at, frame in enumerate(frames)}


def _solvers(run: RunState, names: Mapping[str, str]) -> dict[str, SolverResult]:
    answer, mount = run.assessment, run.session.mount
    solutions = compare_solvers(answer.problem, answer.state, mount, run.solver)
    return {
        name: SolverResult(
            dict(zip(names.values(), solution.edges, strict=False)),
            1e3 * solution.rms_m,
            None if solution.rms_rad is None else float(np.rad2deg(solution.rms_rad)),
        )
        for name, solution in solutions.items()
    }


def _views(run: RunState) -> tuple[ViewResult, ...]:
    """Result of each view of the session, in its order."""
    results = {view.view: view.of_pair for view in run.assessment.views}
    return tuple(
        results.get(view.number) or ViewResult(view.number, used=False, reason=_reason(run, view))
        for view in run.session.views
    )


def _reason(run: RunState, row: View) -> str:
    """Why a row is not an observation of the chain."""
    if row.is_of_lens:
        return _OF_LENS
    return run.reasons.get(row.number) or (HELD_BACK if row.holdout else _NO_POSE)


def _arm(run: RunState) -> ArmSections:
    """The sections on the only robot's arm, with its residuals at held-back views."""
    arm = run.robot_arm
    sections = arm_sections(run, arm.robot)
    if sections.arm is None or arm.model is None:
        return sections
    views = held_back_by_arm(run.cell_fit, run, arm.robot)
    return replace(sections, arm=replace(sections.arm, holdout=views))


def _instrument(readings: Readings) -> InstrumentResult:
    instrument = readings.instrument
    return InstrumentResult(
        words=instrument.words,
        reads="poses" if readings.are_poses else "places",
        sigma_m=instrument.sigma_m,
        sigma_per_m=instrument.sigma_per_m,
        sigma_rad=instrument.sigma_rad if readings.are_poses else None,
    )


def _points(run: RunState) -> Iterator[PointResult]:
    """The positions of the points that an instrument read on the flange."""
    if run.readings is not None and not run.readings.are_poses:
        for frame, edge in run.assessment.edges.items():
            if frame.startswith("point"):
                x_m, y_m, z_m = edge.matrix[:3, 3].tolist()
                name = object_name(frame, "probe")
                yield PointResult(point=name, x_m=x_m, y_m=y_m, z_m=z_m, sigma_mm=edge.sigma_mm)


def _uncertainty(run: RunState) -> UncertaintyResult:
    work, answer = run.accuracy_at_work, run.assessment
    tests = (misfit.neighbours for misfit in answer.residual_tests.values())
    alike = [test.factor for test in tests if test is not None and test.is_significant]
    return UncertaintyResult(
        point_cam_m=work.point_cam,
        distances_m=work.distances_m,
        budget_mm=work.budget_mm,
        radius95_mm=work.radius95_mm,
        noise_95=_of_robot(run, noise_intervals(run)),
        spectrum=work.spectrum,
        inflation=max(alike, default=1.0),
    )


def _noise(run: RunState) -> dict[str, float]:
    """Standard deviations per axis, of corners and flange, or of both together without corners."""
    px = [sigmas["pixel_px"] for sigmas in run.assessment.sigmas.values() if "pixel_px" in sigmas]
    noise = {"pixel_px": px[-1]} if px else {}
    if not noise and run.pixel_px is not None:
        noise["pixel_px"] = run.pixel_px
    if run.readings is not None:
        noise["instrument_mm"] = 1e3 * run.readings.sigma_m
        if run.readings.are_poses:
            noise["instrument_deg"] = float(np.rad2deg(run.readings.instrument.sigma_rad or 0.0))
    return noise | _of_robot(run, run.assessment.sigmas)


def _of_robot(run: RunState, levels: Mapping[str, Mapping[str, _T]]) -> dict[str, _T]:
    """Figures on the noise of the only robot, or on that of robot and camera combined, by name."""
    problem = run.assessment.problem
    of = "combined" if problem.is_combined else "robot"
    return {f"{of}_{name}": level for name, level in levels[problem.robots[0]].items()}


def _joint_fit_of(run: RunState) -> JointFit | None:
    """The unknowns of the fit with their covariance; None for a calibration by an instrument."""
    if run.mount == "instrument":
        return None
    boards, seen = run.session.boards, run.cell_fit.linearised_corners
    unknown = run.assessment.problem.unknown
    names = [board for board in boards if len(boards) < 2 or frame_name("target", board) in unknown]
    return JointFit(
        targets={name: target_document(board) for name, board in boards.items()},
        boards=tuple(names) or ("",),
        looks=() if seen is None else tuple(seen.free.tolist()),
        arm=_fitted_arm(run, run.robot_arm),
        covariance=_covariance(run),
    )


def _means_of(run: RunState) -> dict[str, float]:
    """The means of `CONDITIONS` over the used views, of those that all used views state."""
    views = [view for view in run.session.views if view.number in run.used]
    return {
        name: float(np.mean([view.numbers[name] for view in views]))
        for name in CONDITIONS
        if views and all(name in view.numbers for view in views)
    }


def _fitted_arm(run: RunState, arm: RobotArm) -> FittedArm | None:
    """An arm's errors: their parameters, and their estimates relative to the nominal arm."""
    model, errors = arm.model, arm.errors
    if errors is None or not errors.of_links:
        return None
    # Errors that are not estimated are zero. Estimates of a model are the change from its
    # linearisation point, which its arm contains.
    problem, name = run.assessment.problem, f"arm of {arm.robot}"
    start = problem.start({frame: np.eye(4) for frame in problem.unknown})
    values = problem.values_of(name, run.assessment.state) - problem.values_of(name, start)
    values = values if errors.is_estimated else np.zeros(errors.basis.shape[2])
    if model is None:
        return FittedArm(of="links", values=values)
    # Errors that are not part of its geometry depend on the loads of a stop.
    loaded = bool(model.values_by_stop.any())
    # Functions of the joints are part of the geometry.
    kept = model.is_kept
    functions = model.functions if loaded else None
    return FittedArm(
        of="model",
        values=values[kept],
        weights={name: size for name, size in model.weights.items() if name != HARMONICS},
        flange_from_reported=model.flange_from_reported,
        by_stop=model.values_by_stop[kept] if loaded else None,
        torque_nm=model.torque_nm if loaded else None,
        yielding=model.yielding if loaded else None,
        weight_functions=None if functions is None else functions.parts,
    )


def _covariance(run: RunState) -> FloatArray:
    """Covariance of the written unknowns, and of the arm's errors that are not estimated."""
    answer, arm, written = run.assessment, run.robot_arm, _written_jacobian(run)
    own = written @ answer.covariance @ written.T
    if arm.errors is None or arm.errors.is_estimated or not arm.errors.of_links:
        return own
    problem, state, noise = answer.problem, answer.state, answer.noise
    jacobian = written @ misfit_jacobian(problem, state, noise, arm.robot, arm.errors)
    size, variance = jacobian.shape[1], arm.errors.sigma**2
    # The fit deviates by its Jacobian times the errors; the truth deviates from it the other way.
    cross = -variance * jacobian
    return np.block([[own, cross], [cross.T, variance * np.eye(size)]])


def _written_jacobian(run: RunState) -> FloatArray:
    """(w, p) Jacobian of the unknowns as they are written with respect to those of the fit."""
    # Further boards are written relative to the first; clocks and drift are left out.
    problem, rows = run.assessment.problem, np.eye(run.assessment.problem.size)
    boards = run.assessment.state.edges[1:]
    # z_k exp(d_k) = z exp(d) exp(-d_u) target_1_from_target_k
    further = [
        rows[6:12] - adjoint(invert(boards[0]) @ boards[at]) @ rows[6 * at + 6 : 6 * at + 12]
        for at in range(1, len(boards))
    ]
    nothing, arm = slice(0, 0), f"arm of {run.robot_arm.robot}"
    errors, seen = problem.effect_columns.get(arm, nothing), run.cell_fit.linearised_corners
    optics = run.cell_fit.columns_of(np.zeros(0, dtype=np.int64) if seen is None else seen.free)
    of_errors, model = rows[errors], run.robot_arm.model
    kept = slice(None) if model is None else model.is_kept
    return np.concatenate([rows[:12], rows[optics], *further, of_errors[kept]])


def cell_of(run: RunState) -> CellResult:
    """Assembles the sections of a whole cell, by name, when all stages have run."""
    session, cell, solved, answer = run.session, run.cell, run.cell_fit, run.assessment
    edges = cell_edges(run)
    kept = {
        name: branch.parent
        for name, branch in cell.tree.branches.items()
        if name in solved.cell.tree.branches
    }
    parents = {frame: name.partition("_from_")[0] for frame, name in edges.items()}
    return CellResult(
        reference=cell.reference,
        tree=kept | parents,
        cameras={object_name(name, "camera"): lens for name, lens in cameras_of(run).items()},
        robots=_robots(run),
        targets={
            name or "target": target_document(plate) for name, plate in session.plates.items()
        },
        noise=answer.sigmas,
        moved=answer.moved,
        untied=tuple(
            UnconnectedFrame(name, connection_advice(cell, name)) for name in solved.unconnected
        ),
        weakest=weakest_link(solved.cell, answer.last_edges),
        details=CellDetails({pair.words: clock for pair, clock in answer.clocks(run).items()}),
        joint_fit=fit_section(run),
        uncertainty=CellUncertainty(
            budget_mm={edges[frame]: mm for frame, mm in answer.budget_mm.items()},
            noise_95=noise_intervals(run),
        ),
    )


def cell_edges(run: RunState) -> dict[str, str]:
    """The names of a whole cell's edges by their child frames."""
    branches = run.assessment.problem.tree.branches
    return {
        version.name: f"{branches[key].parent}_from_{version.name}"
        for key, version in run.assessment.versions.items()
    }


def _robots(run: RunState) -> dict[str, RobotResult]:
    session, solved = run.session, run.cell_fit
    models = session.robot_documents
    found = {
        robot_key(name): RobotResult(Robot.from_document(models[name]) if name in models else None)
        for name in session.robots
    }
    for name in solved.arms:
        found[name] = RobotResult(found[name].model, **vars(arm_sections(run, name)))
    return found


def arm_sections(run: RunState, robot: str) -> ArmSections:
    """The result's sections on a robot's arm."""
    solved, answer, first = run.cell_fit, run.assessment, dict[int, int]()
    for row in solved.cell.rows:
        first.setdefault(row.station, row.view)
    stops = stops_of(answer.problem, robot)
    found = answer.arms[robot]
    return solved.arms[robot].at(stops).result(found, [first[index] for index in stops.tolist()])


def noise_intervals(run: RunState) -> dict[str, Intervals]:
    """95 % intervals of the robots' noise levels, by robot and by name."""
    pairs = zip(run.assessment.problem.robots, run.assessment.intervals, strict=True)
    return {
        robot: {
            "translation_mm": _bounds(1e3 * interval_m),
            "rotation_deg": _bounds(np.rad2deg(interval_rad)),
        }
        for robot, (interval_rad, interval_m) in pairs
    }


def _bounds(interval: FloatArray) -> tuple[float, float]:
    low, high = interval.tolist()
    return low, high


def cameras_of(run: RunState) -> dict[str, CameraResult]:
    """The cameras by their frames, with their covariance.

    A camera's covariance, the edges', and their cross covariance are blocks of one matrix. Stated
    intrinsics of which only a part is uncertain (the matrix and not the distortion) have zeros for
    the rest.
    """
    solved, covariance, edges = (
        run.cell_fit,
        run.assessment.covariance,
        6 * len(run.assessment.edges),
    )
    seen, optics = solved.linearised_corners, solved.camera_parameters
    # Measured poses need no camera, but later use of the result may.
    cameras = {
        frame: CameraResult(camera, estimated=False)
        for name, table in run.session.cameras.items()
        if (frame := frame_name("camera", name)) in solved.cell.tree.branches
        and (camera := table.stated) is not None
    }
    if seen is None or optics is None:
        return cameras | dict(run.lenses)
    for name, scene in run.scenes.items():
        lens = optics.lens_of(name)
        free = np.isin(lens, seen.free)
        estimated = scene.estimated or bool(np.isin(lens, seen.moving).any())
        result = CameraResult(optics.camera(name), estimated)
        if free.any():
            columns = solved.columns_of(lens[free])
            own, cross = np.zeros((len(lens),) * 2), np.zeros((len(lens), edges))
            own[np.ix_(free, free)] = covariance[np.ix_(columns, columns)]
            cross[free] = covariance[columns, :edges]
            result = CameraResult(optics.camera(name), estimated, own, cross)
        cameras[name] = replace(result, field=lens_field_of(solved, name, covariance, edges))
    return cameras


def fit_section(run: RunState) -> CellJointFit:
    """The unknowns of a whole cell's fit, with their covariance."""
    solved, covariance, edges = (
        run.cell_fit,
        run.assessment.covariance,
        6 * len(run.assessment.edges),
    )
    seen, optics = solved.linearised_corners, solved.camera_parameters
    arms, of_arms = _calibrated_arms(run)
    if seen is None or optics is None:
        columns = [*range(edges), *of_arms]
        return CellJointFit(
            cameras={}, targets={}, arms=arms, covariance=covariance[np.ix_(columns, columns)]
        )
    columns = [*range(edges), *solved.columns_of(seen.free).tolist(), *of_arms]
    return CellJointFit(
        cameras={
            object_name(name, "camera"): _relative_indices(seen.free, at)
            for name, at in optics.lenses.items()
        },
        targets={
            name: _relative_indices(seen.free, shape) for name, shape in _shape_slices(run).items()
        },
        arms=arms,
        covariance=covariance[np.ix_(columns, columns)],
    )


def _calibrated_arms(run: RunState) -> tuple[dict[str, FittedArm], list[int]]:
    """The errors of the calibrated arms, by name, and their columns in the fit."""
    arms, columns = dict[str, FittedArm](), list[int]()
    effects = run.assessment.problem.effect_columns
    for robot, arm in run.cell_fit.arms.items():
        fitted, effect = _fitted_arm(run, arm), effects.get(f"arm of {arm.robot}")
        if fitted is not None and arm.model is not None and effect is not None:
            arms[robot or "robot"] = fitted
            columns += np.arange(effect.start, effect.stop)[arm.model.is_kept].tolist()
    return arms, columns


def shapes_of(run: RunState) -> tuple[dict[str, BoardResult], dict[str, RigResult]]:
    """The estimated shapes of boards and rigs, by name; exact rigs are left out."""
    solved, covariance = run.cell_fit, run.assessment.covariance
    seen, optics = solved.linearised_corners, solved.camera_parameters
    boards, rigs = dict[str, BoardResult](), dict[str, RigResult]()
    if seen is None or optics is None:
        return boards, rigs
    all_sigmas = np.zeros(len(optics.values))
    all_sigmas[seen.free] = np.sqrt(np.diag(covariance))[solved.columns_of(seen.free)]
    shapes = zip(
        _shape_slices(run).items(), run.session.boards.items(), optics.corners, strict=True
    )
    for (name, shape), (plate, target), corners in shapes:
        if frame_name("target", plate) not in solved.inlier_problem.tree.branches:
            continue
        values, sigmas, free = (
            optics.values[shape],
            all_sigmas[shape],
            _relative_indices(seen.free, shape),
        )
        if not target.is_rig:
            boards[name] = BoardResult(
                shape=dict(zip(BOARD_NAMES, values.tolist(), strict=True)),
                sigma={BOARD_NAMES[at]: float(sigmas[at]) for at in free},
                estimated=tuple(BOARD_NAMES[at] for at in _relative_indices(seen.moving, shape)),
                bend_mm=1e3 * float(np.ptp(corners[:, 2])),
            )
        elif free:
            rigs[name] = RigResult(shape=values.reshape(-1, 3), sigma=sigmas.reshape(-1, 3))
    return boards, rigs


def _shape_slices(run: RunState) -> dict[str, slice]:
    """The slice of each target's shape in the values of lenses and boards, by name."""
    optics = run.cell_fit.camera_parameters
    if optics is None:
        return {}
    targets = tuple(run.session.boards.values())
    names = tuple(name or "target" for name in run.session.plates) or ("target",)
    return dict(zip(names, shape_slices(targets, optics.boards.start), strict=True))


def _relative_indices(indices: IntArray, part: slice) -> tuple[int, ...]:
    """Those of ascending indices that lie in a slice, relative to its start."""
    return tuple(int(value) for value in within(indices, part) - part.start)

"""Assembles a Calibration of one camera and robot, or of a whole cell, and the views' evidence.

It includes the joint fit, as a later verification of the same cell needs it.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.calibration.pipeline.assessment import seen_rows
from visioncal.calibration.pipeline.connectivity import connection_advice
from visioncal.calibration.pipeline.judging import weakest_link
from visioncal.calibration.pipeline.lens_fields import lens_field_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell import robot_key
from visioncal.calibration.stages.handeye import compare_solvers
from visioncal.calibration.stages.need import need_met
from visioncal.calibration.stages.random_effects import of_random_effects
from visioncal.core.transforms import apply, log
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.problem_parts import State
from visioncal.estimation.unknowns import ARM, BOARD, EDGE, LENS, SIZE
from visioncal.results import (
    HELD_BACK,
    Calibration,
    CameraResult,
    CellResult,
    RobotResult,
    UnconnectedFrame,
    Validation,
    ViewResult,
)
from visioncal.results.evidence import ViewEvidence
from visioncal.results.sections import (
    BoardResult,
    CellDetails,
    CellJointFit,
    CellUncertainty,
    FittedArm,
    FittedStops,
    InstrumentResult,
    JointFit,
    PointResult,
    RigResult,
)
from visioncal.results.views import rms_of
from visioncal.robot import Robot
from visioncal.robot.arm_model import HARMONICS
from visioncal.session import frame_name
from visioncal.session.frames import CELL, edge_names, object_name
from visioncal.vision.board_shape import BOARD_NAMES, shaped_corners
from visioncal.vision.camera import project
from visioncal.vision.targets import first_corners, target_document

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
    session, answer, is_pair = run.session, run.assessment, run.session.has_one_pair
    names = _edge_names(run)
    was_left_out = np.isfinite(answer.held_out.residual_m).any()
    cell = None if is_pair else _cell(run, names)
    boards, rigs = _shapes(run)
    calibration = Calibration(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        mount=session.mount if cell is None else cell.mount,
        edges={name: answer.edges[frame] for frame, name in names.items()},
        joint_covariance=answer.ended.covariance(*answer.ended.unknowns.all_of(EDGE)[: len(names)]),
        solvers={},
        noise={},
        views=answer.views,
        rms=rms_of(answer.views),
        validation=Validation.of(
            answer.held_out.method if was_left_out or is_pair else "", answer.views
        ),
        verdict=replace(verdict, findings=tuple(found.in_words() for found in verdict.findings)),
        boards=boards,
        rigs=rigs,
        cell=cell,
        need=need_met(findings.need, findings.judged_picks, whole=cell is not None),
    )
    sections = _sections_of_pair(run, names, boards, rigs) if is_pair else {}
    return replace(calibration, **sections)


def _edge_names(run: RunState) -> dict[str, str]:
    """The names of the edges by their child frames; of a pair, the camera's first."""
    answer = run.assessment
    if run.mount == "instrument":
        # Of the points that an instrument read, the first is the probe.
        return dict(zip(answer.fit.frames, edge_names(run.mount), strict=False))
    problem = answer.fit.problem
    # In the order of the fit, whose covariance has a frame that moved at the end.
    parents = {answer.versions[key]: problem.tree.branches[key].parent for key in problem.unknown}
    if not run.session.has_one_pair:
        return {frame: f"{parent}_from_{frame}" for frame, parent in parents.items()}
    # The root of a pair's frames is the robot's base; its camera and its robot need no names.
    kinds = {CELL: "base"} | {
        frame: kind
        for kind in ("flange", "cam")
        for frame in (*parents, *parents.values())
        if frame.startswith(f"{kind}_")
    }
    return {
        frame: f"{kinds.get(parent, parent)}_from_{kinds.get(frame, frame)}"
        for frame, parent in parents.items()
    }


def _sections_of_pair(
    run: RunState,
    names: Mapping[str, str],
    boards: Mapping[str, BoardResult],
    rigs: Mapping[str, RigResult],
) -> dict[str, Any]:
    """The sections of one camera and one robot, which have no names."""
    session, answer, readings, arm = run.session, run.assessment, run.readings, run.robot_arm
    sections = run.assessment.arms[arm.robot].sections
    used = [view.numbers for view in session.views if view.number in run.used]
    # A single target without a name has one section.
    is_unnamed = not session.targets
    return {
        "solvers": compare_solvers(
            answer.fit.problem, answer.fit.state, session.mount, run.solver, [*names.values()]
        ),
        "noise": _noise(run),
        "views": _views(run),
        "camera": next(iter(_cameras(run).values()), None),
        "robot": run.robot,
        "robot_form": next((robot.form for robot in session.robots.values()), None),
        "clock": next((clocked.clock for clocked in run.clocks.values()), None),
        "instrument": None
        if readings is None
        else InstrumentResult(
            words=readings.instrument.words,
            reads="poses" if readings.are_poses else "places",
            sigma_m=readings.instrument.sigma_m,
            sigma_per_m=readings.instrument.sigma_per_m,
            sigma_rad=readings.instrument.sigma_rad if readings.are_poses else None,
        ),
        "points": tuple(_points(run)),
        "board": next(iter(boards.values()), None) if is_unnamed else None,
        "boards": {} if is_unnamed else boards,
        "rig": next(iter(rigs.values()), None) if is_unnamed else None,
        "rigs": {} if is_unnamed else rigs,
        "uncertainty": run.uncertainty,
        # Of those that all used views state.
        "means": {
            name: float(np.mean([numbers[name] for numbers in used]))
            for name in CONDITIONS
            if used and all(name in numbers for numbers in used)
        },
        "joint_fit": _joint_fit(run),
        **vars(sections),
    }


def _views(run: RunState) -> tuple[ViewResult, ...]:
    """Result of each view of the session, in its order."""
    results = {view.view: view.of_pair for view in run.assessment.views}
    for row in run.session.views:
        why = run.reasons.get(row.number) or (HELD_BACK if row.holdout else _NO_POSE)
        why = _OF_LENS if row.is_of_lens else why
        results.setdefault(row.number, ViewResult(row.number, used=False, reason=why))
    return tuple(results[row.number] for row in run.session.views)


def _points(run: RunState) -> Iterator[PointResult]:
    """The positions of the points that an instrument read on the flange."""
    if run.readings is not None and not run.readings.are_poses:
        for frame, edge in run.assessment.edges.items():
            if frame.startswith("point"):
                x_m, y_m, z_m = edge.matrix[:3, 3].tolist()
                name = object_name(frame, "probe")
                yield PointResult(point=name, x_m=x_m, y_m=y_m, z_m=z_m, sigma_mm=edge.sigma_mm)


def _noise(run: RunState) -> dict[str, float]:
    """Standard deviations per axis, of corners and flange, or of both together without corners."""
    px = [sigmas["pixel_px"] for sigmas in run.assessment.sigmas.values() if "pixel_px" in sigmas]
    px += [] if px or run.pixel_px is None else [run.pixel_px]
    noise = {"pixel_px": px[-1]} if px else {}
    if run.readings is not None:
        noise["instrument_mm"] = 1e3 * run.readings.sigma_m
        if run.readings.are_poses:
            noise["instrument_deg"] = float(np.rad2deg(run.readings.instrument.sigma_rad or 0.0))
    return noise | run.assessment.of_robot(run.assessment.sigmas)


def _joint_fit(run: RunState) -> JointFit | None:
    """The unknowns of the fit with their covariance; None for several points of an instrument."""
    if run.readings is not None and len(run.readings.names) > 1:
        return None
    boards, fit = run.session.boards, run.assessment.ended
    names = [
        name for name, at in run.session.board_frames.items() if len(boards) < 2 or at in fit.frames
    ]
    covariance, by_noise = _fit_covariance(run)
    looks, first = list[int](), 0
    for unknown in fit.unknowns.all_of(LENS, BOARD):
        looks += (first + fit.unknowns.values_of(unknown)).tolist()
        first += len(fit.values(unknown))
    return JointFit(
        targets={name: target_document(board) for name, board in boards.items()},
        boards=tuple(names) or ("",),
        looks=tuple(looks),
        arm=_fitted_arm(run, run.robot_arm),
        covariance=covariance,
        stops=_fitted_stops(run, by_noise),
    )


def _fitted_stops(run: RunState, by_noise: FloatArray) -> FittedStops | None:
    """The residuals of each board at each stop; None where a frame or a clock moved."""
    assessment, other_effects = run.assessment, run.cell_fit.other_effects
    unknown = {effect.name for effect in of_random_effects(other_effects)} | {SIZE}
    is_moved = bool(assessment.moved) or assessment.ended is not assessment.fit
    if is_moved or any(effect.name not in unknown for effect in other_effects):
        return None
    # Of what grew with time or reach, and of a size by which poses were measured, a check knows
    # nothing: it is in the residuals.
    whole, state = assessment.fit.problem, assessment.fit.state
    problem = whole.with_effects([part for part in whole.effects if part.name not in unknown])
    values = [whole.values_of(part.name, state) for part in problem.effects]
    linear = problem.linear(State(state.edges, np.concatenate([np.zeros(0), *values])))
    views = np.array([row.view for row in run.cell_fit.cell.rows])[run.cell_fit.inlier_fit.used]
    (poses, *_), observations = problem.poses.values(), problem.observations
    return FittedStops(
        views=tuple(views.tolist()),
        boards=tuple(problem.unknown[name] - 1 for name in observations.observed),
        poses=log(poses[observations.stops]),
        residuals=np.round(linear.residuals, 9),
        by_noise=by_noise,
    )


def _fitted_arm(run: RunState, arm: Arm) -> FittedArm | None:
    """An arm's errors: their parameters, and their estimates relative to the nominal arm."""
    model, errors = arm.model, arm.errors
    if errors is None or not errors.of_links:
        return None
    # Errors that are not estimated are zero. Estimates of a model are the change from its
    # linearisation point, which its arm contains.
    values = run.assessment.ended.values((ARM, arm.robot))
    values = values if errors.is_estimated else np.zeros(errors.basis.shape[2])
    if model is None:
        return FittedArm(of="links", values=values, hidden=None if errors.is_likely else True)
    # Errors that are not part of its geometry, as functions of the joints are, depend on the loads
    # of a stop.
    loaded, kept = bool(model.values_by_stop.any()), model.is_kept
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


def _fitted_columns(run: RunState, arms: Iterable[Arm]) -> IntArray:
    """Columns of a fit's edges, of free values of lenses and boards, and of arms' errors."""
    fit = run.assessment.ended
    columns = [fit.unknowns.of_kinds(EDGE, LENS)]
    for name in fit.unknowns.of(BOARD):
        kept = np.isin(fit.unknowns.values_of((BOARD, name)), _written(run, name))
        columns.append(fit.unknowns.columns((BOARD, name))[kept])
    for arm in arms:
        errors = fit.unknowns.columns((ARM, arm.robot))
        columns.append(errors if arm.model is None else errors[arm.model.is_kept])
    return np.concatenate(columns)


def _fit_covariance(run: RunState) -> tuple[FloatArray, FloatArray]:
    """Covariance of a fit's unknowns, and of the arm's that are not estimated.

    The second is the part by noise, and by errors that change with time.
    """
    fit, arm, errors = run.assessment.ended, run.robot_arm, run.robot_arm.errors
    columns = _fitted_columns(run, [arm])
    parts = [part[np.ix_(columns, columns)] for part in (fit.whole, fit.by_noise)]
    if errors is None or errors.is_estimated:
        return parts[0], parts[1]
    jacobian = fit.bias(arm.robot, errors)[columns]
    size, variance = jacobian.shape[1], errors.sigma**2
    if errors.time_correlated_count:
        by_noise = fit.beside_lasting(arm.robot, errors).by_noise
        parts[1] = by_noise[np.ix_(columns, columns)]
    if not errors.of_links:
        return parts[0], parts[1]
    # The fit deviates by its Jacobian times the errors; the truth deviates from it the other way.
    cross = -variance * jacobian
    whole = np.block([[parts[0], cross], [cross.T, variance * np.eye(size)]])
    return whole, np.pad(parts[1], (0, size))


def _cell(run: RunState, edges: Mapping[str, str]) -> CellResult:
    """The sections of a whole cell, by name."""
    session, cell, cell_fit, answer = run.session, run.cell, run.cell_fit, run.assessment
    kept = {
        name: branch.parent
        for name, branch in cell.tree.branches.items()
        if name in cell_fit.cell.tree.branches
    }
    models = session.robot_documents
    robots = {
        robot_key(name): RobotResult(
            Robot.from_document(models[name]) if name in models else None, table.form
        )
        for name, table in session.robots.items()
    }
    for name in cell_fit.arms:
        robots[name] = replace(robots[name], **vars(run.assessment.arms[name].sections))
    return CellResult(
        reference=cell.reference,
        tree=kept | {frame: name.partition("_from_")[0] for frame, name in edges.items()},
        cameras={object_name(name, "camera"): lens for name, lens in _cameras(run).items()},
        robots=robots,
        targets={
            name or "target": target_document(plate) for name, plate in session.plates.items()
        },
        noise=answer.sigmas,
        moved=answer.moved,
        untied=tuple(
            UnconnectedFrame(name, connection_advice(name)) for name in cell_fit.unconnected
        ),
        weakest=weakest_link(cell_fit.cell, answer.last_edges),
        details=CellDetails({pair.words: clock for pair, clock in answer.clocks(run).items()}),
        joint_fit=_joint_fit_of_cell(run),
        uncertainty=CellUncertainty(
            budget_mm={edges[frame]: mm for frame, mm in answer.budget_mm.items()},
            noise_95=answer.noise_95,
        ),
    )


def _cameras(run: RunState) -> dict[str, CameraResult]:
    """The cameras by their frames, with their covariance.

    A camera's covariance, the edges', and their cross covariance are blocks of one matrix. Stated
    intrinsics of which only a part is uncertain (the matrix and not the distortion) have zeros for
    the rest.
    """
    fit, edges = run.assessment.ended, run.assessment.ended.unknowns.of_kinds(EDGE)
    # Measured poses need no camera, but later use of the result may.
    cameras = {
        frame: CameraResult(camera, estimated=False)
        for name, table in run.session.cameras.items()
        if (frame := frame_name("camera", name)) in run.cell_fit.cell.tree.branches
        and (camera := table.stated) is not None
    }
    if not fit.unknowns.of(LENS):
        return cameras | dict(run.lenses)
    for name, scene in run.scenes.items():
        lens = (LENS, name)
        free, columns = fit.unknowns.values_of(lens), fit.unknowns.columns(lens)
        estimated = scene.estimated or bool(fit.unknowns.moved[columns].any())
        result = CameraResult(fit.camera(name), estimated, field=lens_field_of(fit, name))
        if len(free):
            size = len(fit.values(lens))
            lens_covariance, cross = np.zeros((size, size)), np.zeros((size, len(edges)))
            lens_covariance[np.ix_(free, free)] = fit.covariance(lens)
            cross[free] = fit.whole[np.ix_(columns, edges)]
            result = replace(result, covariance=lens_covariance, edge_covariance=cross)
        cameras[name] = result
    return cameras


def _joint_fit_of_cell(run: RunState) -> CellJointFit:
    """The unknowns of a whole cell's fit, with their covariance."""
    fit, plates = run.assessment.ended, tuple(run.session.plates) or ("target",)
    arms = {
        robot or "robot": (arm, fitted)
        for robot, arm in run.cell_fit.arms.items()
        if arm.model is not None and arm.robot in fit.unknowns.of(ARM)
        for fitted in [_fitted_arm(run, arm)]
        if fitted is not None
    }
    columns = _fitted_columns(run, [arm for arm, _ in arms.values()])
    return CellJointFit(
        cameras={
            object_name(name, "camera"): tuple(fit.unknowns.values_of((LENS, name)).tolist())
            for name in fit.unknowns.of(LENS)
        },
        targets={
            plate: tuple(_written(run, name).tolist())
            for plate, name in zip(plates, fit.unknowns.of(BOARD), strict=False)
        },
        arms={robot: fitted for robot, (_, fitted) in arms.items()},
        covariance=fit.whole[np.ix_(columns, columns)],
    )


def _written(run: RunState, board: str) -> IntArray:
    """(c,) which of a target's uncertain values a result has: places of a rig's points alone."""
    values = run.assessment.fit.unknowns.values_of((BOARD, board))
    is_rig = run.session.boards[board].is_rig
    return values if is_rig else values[values < len(BOARD_NAMES)]


def _shapes(run: RunState) -> tuple[dict[str, BoardResult], dict[str, RigResult]]:
    """The estimated shapes of boards and rigs, by name; exact rigs are left out."""
    fit, boards, rigs = run.assessment.ended, dict[str, BoardResult](), dict[str, RigResult]()
    names = tuple(name or "target" for name in run.session.plates) or ("target",)
    for name, plate in zip(names, fit.unknowns.of(BOARD), strict=False):
        board, target = (BOARD, plate), run.session.boards[plate]
        values, free = fit.values(board), fit.unknowns.values_of(board)
        sigmas = np.zeros(len(values))
        sigmas[free] = fit.sigmas(board)
        if run.session.board_frames[plate] not in fit.problem.tree.branches:
            continue
        if not target.is_rig:
            # Where single corners are elsewhere, that board is not to be used again.
            values, moved = values[: len(BOARD_NAMES)], fit.unknowns.values_of(board, moved=True)
            written = _written(run, plate)
            boards[name] = BoardResult(
                shape=dict(zip(BOARD_NAMES, values.tolist(), strict=True)),
                sigma={BOARD_NAMES[at]: float(sigmas[at]) for at in written},
                estimated=tuple(BOARD_NAMES[at] for at in np.intersect1d(written, moved)),
                bend_mm=1e3 * float(np.ptp(shaped_corners(target, values)[:, 2])),
            )
        elif len(free):
            rigs[name] = RigResult(shape=values.reshape(-1, 3), sigma=sigmas.reshape(-1, 3))
    return boards, rigs


def view_evidence(run: RunState) -> tuple[ViewEvidence, ...]:
    """Collects the evidence of each view: corners, predictions, poses."""
    cell_fit, boards = run.assessment.went, tuple(run.session.boards.values())
    fit = cell_fit.fit
    state, evidence = fit.state, dict[int, Any]()
    for seen in seen_rows(cell_fit, run):
        poses = zip(seen.problem.measured(state), seen.problem.predicted(state), strict=True)
        for row, view, (measured, predicted) in zip(seen.rows, seen.views, poses, strict=True):
            px = None
            if view.corners is not None and row.seer in fit.unknowns.of(LENS):
                points = fit.camera_parameters.points[view.corners.ids]
                px = project(fit.camera(row.seer), apply(predicted, points))
            evidence[row.view] = (view.corners, px, measured)
    observations = {observation.view.number: observation for observation in run.timed.observations}
    views = []
    for number in (view.number for view in run.session.views):
        pose, observation = run.poses.get(number), observations.get(number)
        corners, px, measured = evidence.get(number) or (
            run.corners.get(number) if pose is None else pose.corners,
            None,
            None if pose is None else pose.cam_from_target[0],
        )
        if corners is not None and len(boards) > 1 and len(corners.ids):
            # From the first of its own board on.
            starts = first_corners(boards)
            first = int(starts[starts <= corners.ids[0]][-1])
            corners = replace(corners, ids=corners.ids - first)
        flange = run.base_from_flange.get(number)
        if observation is not None and len(observation.robots) == 1:
            arm = cell_fit.arms.get(robot_key(next(iter(observation.robots))))
            if arm is not None and arm.has_pose[observation.station]:
                flange = np.asarray(arm.poses[observation.station])
        views.append(ViewEvidence(number, corners, px, flange, measured))
    return tuple(views)

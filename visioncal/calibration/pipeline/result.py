"""What is known when all steps have run, put together as a Calibration, a whole cell too.

With it goes what a later look at the same cell has to know of the joint fit.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np

from visioncal.calibration.pipeline.answer import held_by_both_arms
from visioncal.calibration.pipeline.judging import weakest_link
from visioncal.calibration.pipeline.lens_fields import lens_field_of
from visioncal.calibration.pipeline.network_ties import untied_words
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.solved import within
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
    Untied,
    Validation,
    ViewResult,
)
from visioncal.results.arm import ArmSections
from visioncal.results.sections import (
    BoardResult,
    CellDetails,
    CellJointFit,
    CellUncertainty,
    FittedArm,
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
from visioncal.session.frames import thing_name
from visioncal.vision.targets import target_document

_T = TypeVar("_T")
_OF_LENS = "it serves the camera's lens alone (role = intrinsics)"
_NO_POSE = (
    "no pose of the target: it has neither image nor rows in corners.csv nor cft_ nor meas_ columns"
)
# Columns of views.csv that say under which conditions a view was taken.
CONDITIONS = ("ambient_c", "payload_kg")


def result_of(known: RunState) -> Calibration:
    """Puts together what is known when all steps have run.

    Raises:
        RuntimeError: One has not.
    """
    findings, verdict = known.findings, known.verdict
    if findings is None or verdict is None:
        raise RuntimeError("a step is missing")
    session, answer = known.session, known.solved
    cell = cell_of(known) if known.mount is None else None
    names = _edge_names(known) if cell is None else cell_edges(known)
    size = 6 * len(names)
    was_left_out = np.isfinite(answer.held_out.away_m).any()
    method = answer.held_out.method if was_left_out else ""
    boards, rigs = shapes_of(known)
    found = Calibration(
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
        need=need_met(findings.need, findings.picks, whole=cell is not None),
    )
    return found if cell is not None else _of_pair(found, known, names)


def _of_pair(found: Calibration, known: RunState, names: Mapping[str, str]) -> Calibration:
    """The same of one camera and one robot, which have no names."""
    # Of one target without a name there is one section.
    alone = not known.session.targets
    return replace(
        found,
        solvers=_solvers(known, names),
        noise=_noise(known),
        views=_views(known),
        validation=Validation.of(known.solved.held_out.method, known.solved.views),
        camera=next(iter(cameras_of(known).values()), None),
        robot=known.robot,
        clock=next((clocked.clock.result() for clocked in known.clocks.values()), None),
        instrument=None if known.readings is None else _instrument(known.readings),
        points=tuple(_points(known)),
        board=next(iter(found.boards.values()), None) if alone else None,
        boards={} if alone else found.boards,
        rig=next(iter(found.rigs.values()), None) if alone else None,
        rigs={} if alone else found.rigs,
        uncertainty=_uncertainty(known),
        conditions=_conditions_of(known),
        joint_fit=_joint_fit_of(known),
        **vars(_arm(known)),
    )


def _edge_names(known: RunState) -> dict[str, str]:
    """The names of the edges by the frames that they place, the camera's first."""
    # Of points that an instrument read, the first is the probe.
    frames, first = known.solved.problem.unknown, edge_names(known.session.mount)
    parents = [name.partition("_from_")[0] for name in first]
    names = {frame: f"{parents[min(at, 1)]}_from_{frame}" for at, frame in enumerate(frames)}
    if known.mount == "instrument":
        names = dict(zip(frames, first, strict=False))
    return names


def _solvers(known: RunState, names: Mapping[str, str]) -> dict[str, SolverResult]:
    answer, mount = known.solved, known.session.mount
    found = compare_solvers(answer.problem, answer.state, mount, known.solver)
    return {
        name: SolverResult(
            dict(zip(names.values(), answer.edges, strict=False)),
            1e3 * answer.rms_m,
            None if answer.rms_rad is None else float(np.rad2deg(answer.rms_rad)),
        )
        for name, answer in found.items()
    }


def _views(known: RunState) -> tuple[ViewResult, ...]:
    """What became of each view of the session, in its order."""
    seen = {view.view: view.of_pair for view in known.solved.views}
    return tuple(
        seen.get(view.number) or ViewResult(view.number, used=False, reason=_reason(known, view))
        for view in known.session.views
    )


def _reason(known: RunState, row: View) -> str:
    """Why a row is of no chain."""
    if row.is_of_lens:
        return _OF_LENS
    return known.reasons.get(row.number) or (HELD_BACK if row.holdout else _NO_POSE)


def _arm(known: RunState) -> ArmSections:
    """What was found of the arm."""
    arm = known.robot_arm
    sections = arm_sections(known, arm.robot)
    if sections.arm is None or arm.model is None:
        return sections
    held = held_by_both_arms(known.fitted, known, arm.robot)
    return replace(sections, arm=replace(sections.arm, holdout=held))


def _instrument(readings: Readings) -> InstrumentResult:
    """The instrument as it was taken."""
    instrument = readings.instrument
    return InstrumentResult(
        words=instrument.words,
        reads="poses" if readings.are_poses else "places",
        sigma_m=instrument.sigma_m,
        sigma_per_m=instrument.sigma_per_m,
        sigma_rad=instrument.sigma_rad if readings.are_poses else None,
    )


def _points(known: RunState) -> Iterator[PointResult]:
    """The places of the points that an instrument read on the flange."""
    if known.readings is not None and not known.readings.are_poses:
        for frame, edge in known.solved.edges.items():
            if frame.startswith("point"):
                x_m, y_m, z_m = edge.matrix[:3, 3].tolist()
                name = thing_name(frame, "probe")
                yield PointResult(point=name, x_m=x_m, y_m=y_m, z_m=z_m, sigma_mm=edge.sigma_mm)


def _uncertainty(known: RunState) -> UncertaintyResult:
    work, answer = known.work, known.solved
    tests = (misfit.alike for misfit in answer.misfits.values())
    alike = [test.factor for test in tests if test is not None and test.is_significant]
    return UncertaintyResult(
        point_cam_m=work.point_cam,
        budget_mm=work.budget_mm,
        radius95_mm=work.radius95_mm,
        noise_95=_of_robot(known, noise_intervals(known)),
        spectrum=work.spectrum,
        inflation=max(alike, default=1.0),
    )


def _noise(known: RunState) -> dict[str, float]:
    """Standard deviations per axis: of corners and flange, or of both as one without corners."""
    found = {
        name: value
        for of_frame in known.solved.sigmas.values()
        for name, value in of_frame.items()
        if name == "pixel_px"
    }
    if not found and known.pixel_px is not None:
        found["pixel_px"] = known.pixel_px
    if known.readings is not None:
        found["instrument_mm"] = 1e3 * known.readings.sigma_m
        if known.readings.are_poses:
            found["instrument_deg"] = float(np.rad2deg(known.readings.instrument.sigma_rad or 0.0))
    return found | _of_robot(known, known.solved.sigmas)


def _of_robot(known: RunState, levels: Mapping[str, Mapping[str, _T]]) -> dict[str, _T]:
    """What is known of the levels of the only robot's noise, or of that of robot and camera."""
    problem = known.solved.problem
    of = "combined" if problem.is_combined else "robot"
    return {f"{of}_{name}": level for name, level in levels[problem.robots[0]].items()}


def _joint_fit_of(known: RunState) -> JointFit | None:
    """All unknowns of the fit with their covariance; None where an instrument read them."""
    if known.mount == "instrument":
        return None
    boards, seen = known.session.boards, known.fitted.seen
    placed = known.solved.problem.unknown
    names = [board for board in boards if len(boards) < 2 or frame_name("target", board) in placed]
    return JointFit(
        targets={name: target_document(board) for name, board in boards.items()},
        boards=tuple(names) or ("",),
        looks=() if seen is None else tuple(seen.free.tolist()),
        arm=_fitted_arm(known, known.robot_arm),
        covariance=_covariance(known),
    )


def _conditions_of(known: RunState) -> dict[str, float]:
    """The mean conditions of the used views; those that a used view does not say are left out."""
    views = [view for view in known.session.views if view.number in known.used]
    return {
        name: float(np.mean([view.numbers[name] for view in views]))
        for name in CONDITIONS
        if views and all(name in view.numbers for view in views)
    }


def _fitted_arm(known: RunState, arm: RobotArm) -> FittedArm | None:
    """An arm's errors: of what they are, and their estimates beside the stated arm."""
    model, errors = arm.model, arm.errors
    if errors is None or not errors.of_links:
        return None
    count = errors.basis.shape[2]
    # Errors that only count are where they were stated; those of a model are in its arm already.
    problem, name = known.solved.problem, f"arm of {arm.robot}"
    linearised = problem.start({name: np.eye(4) for name in problem.unknown})
    values = problem.values_of(name, known.solved.state) - problem.values_of(name, linearised)
    values = values if errors.is_estimated else np.zeros(count)
    if model is None:
        return FittedArm(of="links", values=values)
    # What of its errors is not in its geometry goes by the loads of a stop.
    loaded = bool(model.values_by_stop.any())
    # Functions of the joints are in the arm's geometry, as well as they are known.
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


def _covariance(known: RunState) -> FloatArray:
    """The fit's own, and beside it what it has in common with errors that only count in it."""
    answer, arm, written = known.solved, known.robot_arm, _written(known)
    own = written @ answer.covariance @ written.T
    if arm.errors is None or arm.errors.is_estimated or not arm.errors.of_links:
        return own
    jacobian = written @ misfit_jacobian(
        answer.problem, answer.state, answer.noise, arm.robot, arm.errors
    )
    size, variance = jacobian.shape[1], arm.errors.sigma**2
    # The fit is off by its slopes times the errors; the truth is off from the fit the other way.
    between = -variance * jacobian
    return np.block([[own, between], [between.T, variance * np.eye(size)]])


def _written(known: RunState) -> FloatArray:
    """(w, p) how what is written moves with the fit's unknowns."""
    # Further boards are written relative to the first; clocks and drift are left out.
    problem, rows = known.solved.problem, np.eye(known.solved.problem.size)
    placed = known.solved.state.edges[1:]
    # z_k exp(d_k) = z exp(d) exp(-d_u) target_1_from_target_k
    further = [
        rows[6:12] - adjoint(invert(placed[0]) @ placed[at]) @ rows[6 * at + 6 : 6 * at + 12]
        for at in range(1, len(placed))
    ]
    nothing, arm = slice(0, 0), f"arm of {known.robot_arm.robot}"
    errors, seen = problem.effect_columns.get(arm, nothing), known.fitted.seen
    looks = known.fitted.columns_of(np.zeros(0, dtype=np.int64) if seen is None else seen.free)
    of_errors, model = rows[errors], known.robot_arm.model
    kept = slice(None) if model is None else model.is_kept
    return np.concatenate([rows[:12], rows[looks], *further, of_errors[kept]])


def cell_of(known: RunState) -> CellResult:
    """Puts together what is known of a whole cell by name when all steps have run."""
    session, cell, solved, answer = known.session, known.cell, known.fitted, known.solved
    placed = cell_edges(known)
    kept = {
        name: branch.parent
        for name, branch in cell.tree.branches.items()
        if name in solved.cell.tree.branches
    }
    parents = {frame: name.partition("_from_")[0] for frame, name in placed.items()}
    return CellResult(
        reference=cell.reference,
        tree=kept | parents,
        cameras={thing_name(name, "camera"): lens for name, lens in cameras_of(known).items()},
        robots=_robots(known),
        targets={
            name or "target": target_document(plate) for name, plate in session.plates.items()
        },
        noise=answer.sigmas,
        moved=answer.moved,
        untied=tuple(Untied(name, untied_words(cell, name)) for name in solved.untied),
        weakest=weakest_link(solved.cell, answer.last_edges),
        details=_details(known),
        joint_fit=fit_section(known),
        uncertainty=CellUncertainty(
            budget_mm={placed[frame]: mm for frame, mm in answer.budget_mm.items()},
            noise_95=noise_intervals(known),
        ),
    )


def cell_edges(known: RunState) -> dict[str, str]:
    """The names of a whole cell's edges by the frames that they place."""
    branches = known.solved.problem.tree.branches
    named = known.solved.versions.values()
    return {
        version.name: f"{branches[version.key].parent}_from_{version.name}" for version in named
    }


def _robots(known: RunState) -> dict[str, RobotResult]:
    session, solved = known.session, known.fitted
    models = session.robot_documents
    found = {
        robot_key(name): RobotResult(Robot.from_document(models[name]) if name in models else None)
        for name in session.robots
    }
    for name in solved.arms:
        found[name] = RobotResult(found[name].model, **vars(arm_sections(known, name)))
    return found


def arm_sections(known: RunState, robot: str) -> ArmSections:
    """What was found of a robot's arm."""
    solved, answer, first = known.fitted, known.solved, dict[int, int]()
    for row in solved.cell.rows:
        first.setdefault(row.station, row.view)
    stops = stops_of(answer.problem, robot)
    found = answer.arms[robot]
    return solved.arms[robot].at(stops).result(found, [first[index] for index in stops.tolist()])


def _details(known: RunState) -> CellDetails:
    """What was found of clocks."""
    return CellDetails({key.words: at.result() for key, at in known.solved.clocks(known).items()})


def noise_intervals(known: RunState) -> dict[str, Intervals]:
    """95 % intervals of the levels of robots, as the noise names them."""
    pairs = zip(known.solved.problem.robots, known.solved.intervals, strict=True)
    return {
        robot: {
            "translation_mm": _ends(1e3 * shift_m),
            "rotation_deg": _ends(np.rad2deg(turn_rad)),
        }
        for robot, (turn_rad, shift_m) in pairs
    }


def _ends(interval: FloatArray) -> tuple[float, float]:
    """The ends of an interval."""
    low, high = interval.tolist()
    return low, high


def cameras_of(known: RunState) -> dict[str, CameraResult]:
    """The cameras by their frames, as the fit has them, with their covariance.

    A camera's covariance, the edges', and that of both together are blocks of one matrix. Given
    intrinsics of which only a part is uncertain, the matrix and not the distortion, have zeros for
    the rest.
    """
    solved, covariance, edges = known.fitted, known.solved.covariance, 6 * len(known.solved.edges)
    seen, looks = solved.seen, solved.looks
    # Measured poses do without a camera; whoever looks through it later does not.
    found = {
        frame: CameraResult(camera, estimated=False)
        for name, table in known.session.cameras.items()
        if (frame := frame_name("camera", name)) in solved.cell.tree.branches
        and (camera := table.stated) is not None
    }
    if seen is None or looks is None:
        return found | dict(known.lenses)
    for name, scene in known.scenes.items():
        lens = looks.lens_of(name)
        free = np.isin(lens, seen.free)
        estimated = scene.estimated or bool(np.isin(lens, seen.moving).any())
        found[name] = CameraResult(looks.camera(name), estimated)
        if free.any():
            at = solved.columns_of(lens[free])
            own, shared = np.zeros((len(lens),) * 2), np.zeros((len(lens), edges))
            own[np.ix_(free, free)] = covariance[np.ix_(at, at)]
            shared[free] = covariance[at, :edges]
            found[name] = CameraResult(looks.camera(name), estimated, own, shared)
        found[name] = replace(found[name], field=lens_field_of(solved, name, covariance, edges))
    return found


def fit_section(known: RunState) -> CellJointFit:
    """The unknowns of the fit of a whole cell, with their covariance."""
    solved, covariance, edges = known.fitted, known.solved.covariance, 6 * len(known.solved.edges)
    seen, looks = solved.seen, solved.looks
    arms, of_arms = _calibrated_arms(known)
    if seen is None or looks is None:
        columns = [*range(edges), *of_arms]
        return CellJointFit(
            cameras={}, targets={}, arms=arms, covariance=covariance[np.ix_(columns, columns)]
        )
    columns = [*range(edges), *solved.columns_of(seen.free).tolist(), *of_arms]
    return CellJointFit(
        cameras={
            thing_name(name, "camera"): _among(seen.free, at) for name, at in looks.lenses.items()
        },
        targets={name: _among(seen.free, shape) for name, shape in _shapes(known).items()},
        arms=arms,
        covariance=covariance[np.ix_(columns, columns)],
    )


def _calibrated_arms(known: RunState) -> tuple[dict[str, FittedArm], list[int]]:
    """The errors of the arms that were calibrated along, by name, and their columns in the fit."""
    arms, columns, effects = (
        dict[str, FittedArm](),
        list[int](),
        known.solved.problem.effect_columns,
    )
    for robot, arm in known.fitted.arms.items():
        fitted, name = _fitted_arm(known, arm), f"arm of {arm.robot}"
        if fitted is None or arm.model is None or name not in effects:
            continue
        place = effects[name]
        arms[robot or "robot"] = fitted
        columns += np.arange(place.start, place.stop)[arm.model.is_kept].tolist()
    return arms, columns


def shapes_of(known: RunState) -> tuple[dict[str, BoardResult], dict[str, RigResult]]:
    """The boards and the rigs as they were found to be, by name; exact rigs are left out."""
    solved, covariance = known.fitted, known.solved.covariance
    seen, looks = solved.seen, solved.looks
    boards, rigs = dict[str, BoardResult](), dict[str, RigResult]()
    if seen is None or looks is None:
        return boards, rigs
    every = np.zeros(len(looks.values))
    every[seen.free] = np.sqrt(np.diag(covariance))[solved.columns_of(seen.free)]
    shapes = zip(_shapes(known).items(), known.session.boards.items(), looks.corners, strict=True)
    for (name, mine), (plate, target), corners in shapes:
        if frame_name("target", plate) not in solved.part.tree.branches:
            continue
        values, sigmas, free = looks.values[mine], every[mine], _among(seen.free, mine)
        if target.kind != "points":
            boards[name] = BoardResult(
                shape=dict(zip(BOARD_NAMES, values.tolist(), strict=True)),
                sigma={BOARD_NAMES[at]: float(sigmas[at]) for at in free},
                estimated=tuple(BOARD_NAMES[at] for at in _among(seen.moving, mine)),
                bend_mm=1e3 * float(np.ptp(corners[:, 2])),
            )
        elif free:
            rigs[name] = RigResult(shape=values.reshape(-1, 3), sigma=sigmas.reshape(-1, 3))
    return boards, rigs


def _shapes(known: RunState) -> dict[str, slice]:
    """Where each target's shape stands among the values of lenses and boards."""
    looks = known.fitted.looks
    if looks is None:
        return {}
    targets = tuple(known.session.boards.values())
    names = tuple(name or "target" for name in known.session.plates) or ("target",)
    return dict(zip(names, shape_slices(targets, looks.boards.start), strict=True))


def _among(places: IntArray, mine: slice) -> tuple[int, ...]:
    """Which values of a lens or a target are among some, from its own first on."""
    return tuple(int(value) for value in within(places, mine) - mine.start)

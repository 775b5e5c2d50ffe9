"""Running the stages, and putting their results together as a Calibration."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.calibration import Calibration, CameraResult, Edge, SolverResult, Validation
from visioncal.errors import DataError, VisioncalError
from visioncal.estimation.appearance import BOARD_NAMES, LENS_AND_BOARD, Free, shape_slices
from visioncal.evidence import ViewEvidence
from visioncal.pipeline.fit import conditions_document, fit_document
from visioncal.pipeline.guessing import is_suspect, reading_hint
from visioncal.pipeline.known import Known
from visioncal.pipeline.steps import STAGES
from visioncal.pipeline.unseen import held_back
from visioncal.pipeline.views import view_evidence
from visioncal.robot import CONVENTIONS, Convention
from visioncal.session import Session
from visioncal.stages.causes import with_misread
from visioncal.stages.dense import Dense
from visioncal.stages.diagnose import Diagnosis
from visioncal.stages.handeye import SOLVER_NAMES, compare_solvers
from visioncal.stages.kinematics import check_level
from visioncal.stages.need import need_met
from visioncal.stages.proposing import with_proposal
from visioncal.stages.readings import Readings
from visioncal.targets import first_corners
from visioncal.threads import one_blas_thread
from visioncal.types import FloatArray, IntArray, Mask, Progress, SolverName


@dataclass(frozen=True, eq=False)
class Run:
    """A calibration with what was seen and computed on the way to it.

    Attributes:
        calibration: The result.
        evidence: One entry for each view of the session.
        dense: What all pixels have of the images, where they were asked for.
        left_out: By view, how far it is predicted off by a fit without it [m], [px].
    """

    calibration: Calibration
    evidence: tuple[ViewEvidence, ...]
    dense: Dense | None = None
    left_out: Mapping[int, tuple[float, float]] = field(default_factory=dict)


def run(
    session: Session | Path | str,
    *,
    solver: SolverName = "joint",
    level: str = "auto",
    convention: Convention | None = None,
    progress: Progress | None = None,
    dense: Dense | None = None,
) -> Run:
    """Calibrates a session and keeps the evidence; see `calibrate`."""
    if solver not in SOLVER_NAMES:
        raise DataError(f"solver {solver!r} is not one of {', '.join(SOLVER_NAMES)}.")
    check_level(level)
    if convention is not None and convention not in CONVENTIONS:
        raise DataError(f"convention {convention!r} is not one of {', '.join(CONVENTIONS)}.")
    loaded = session if isinstance(session, Session) else Session.load(session)
    with one_blas_thread():
        known = Known(loaded, progress, solver=solver, level=level, convention=convention)
        return _run(replace(known, dense=dense))


def _run(known: Known) -> Run:
    """Takes a session through all stages."""
    progress = known.progress
    seen: Known | None = None
    for at, stage in enumerate(STAGES):
        if progress is not None:
            progress(stage.name, at, len(STAGES))
        try:
            known = stage.run(known)
        except VisioncalError as error:
            # Views that are out of the game are often why the rest does not suffice.
            more = [it for it in known.lost_views if it not in error.culprits]
            raise _with_hint(error.with_culprits(more), seen) from error
        # Joints that are misread explain themselves, and would mislead what is guessed of poses.
        if stage.name == "joints":
            seen = known
    held, left_out = known.held_out, {}
    if held is not None:
        pairs = zip(held.away_m.tolist(), held.rms_px.tolist(), strict=True)
        left_out = dict(zip(known.used, pairs, strict=True))
    calibration = result_of(_with_reading(known, seen))
    return Run(calibration, view_evidence(known), known.dense, left_out)


def _with_hint(error: VisioncalError, seen: Known | None) -> VisioncalError:
    """Adds to an error, once the target's poses are known, what leads on.

    That is how the robot's poses should be read, or else what proposes the views that are missing.
    """
    if seen is None:
        return error
    hint = reading_hint(seen)
    (planned,) = with_proposal([error.next_step], modelled=seen.robot is not None)
    next_step = error.next_step if seen.scene is None else planned
    if hint:
        next_step = f"{hint} {error.next_step}".strip()
    return type(error)(error.message, culprits=error.culprits, next_step=next_step)


def _with_reading(known: Known, seen: Known | None) -> Known:
    """Adds to a poor verdict how the poses should be read, where that explains it."""
    if known.verdict is None or seen is None or not is_suspect(known):
        return known
    hint = reading_hint(seen)
    if not hint:
        return known
    return replace(known, verdict=with_misread(known.verdict, hint))


def result_of(known: Known) -> Calibration:
    """Puts together what is known when all stages have run.

    Raises:
        RuntimeError: One has not.
    """
    held, findings, verdict = known.held_out, known.findings, known.verdict
    if held is None or findings is None or verdict is None:
        raise RuntimeError("a stage is missing")
    session, result = known.session, known.solved
    order, rows = _in_order(known), _rows(known)
    spread = result.covariance[np.ix_(rows, rows)]
    return Calibration(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        mount=session.mount,
        edges={
            name: Edge(
                result.state.edges[it], result.covariance[6 * it : 6 * it + 6, 6 * it : 6 * it + 6]
            )
            for name, it in order.items()
        },
        joint_covariance=spread,
        solvers={
            name: SolverResult(
                {edge: it.edges[at] for edge, at in order.items()},
                1e3 * it.rms_m,
                None if it.rms_rad is None else float(np.rad2deg(it.rms_rad)),
            )
            for name, it in compare_solvers(result, session.mount, known.solver).items()
        },
        noise=_noise(known),
        views=tuple(findings.pairs[0].views),
        rms=findings.rms,
        validation=Validation(held.method, findings.held_out, findings.pairs[0].holdout),
        verdict=verdict,
        camera=_camera(known),
        robot=known.robot,
        stages=_further(known),
        need=need_met(findings.need, findings.picks),
    )


def _in_order(known: Known) -> dict[str, int]:
    """The edges' places by their names, the boards in the order in which the session names them."""
    problem, boards = known.solved.problem, known.boards
    order = [0, *(1 + it for it in sorted(range(len(boards)), key=boards.__getitem__))]
    frames = tuple(problem.unknown)
    parents = [problem.tree.branches[it].parent for it in frames]
    return {f"{parents[it]}_from_{frames[it]}": it for it in order}


def _rows(known: Known) -> IntArray:
    """The unknowns of these edges."""
    return np.concatenate([np.arange(6 * it, 6 * it + 6) for it in _in_order(known).values()])


def _further(known: Known) -> dict[str, Any]:
    """What was refined beside the edges, and where the uncertainty comes from."""
    documents: dict[str, Any] = {}
    if known.clock is not None:
        documents["clock"] = known.clock.document()
    if known.readings is not None:
        documents |= _instrument(known, known.readings)
    if known.free is not None:
        documents |= _shapes(known, known.free)
    documents |= _arm(known)
    if known.diagnosis is not None:
        documents["uncertainty"] = _uncertainty(known, known.diagnosis)
    conditions, fit = conditions_document(known), fit_document(known)
    if conditions:
        documents["conditions"] = conditions
    if fit is not None:
        documents["joint_fit"] = fit
    return documents


def _arm(known: Known) -> dict[str, Any]:
    """What was found of the arm."""
    arm, found = known.robot_arm, known.arm_found
    documents = known.arm_at(known.used).documents(found, known.first_of_stops(known.used))
    if arm.kinematics is not None and found.telling is not None and known.measurable_held_back:
        documents["kinematics"]["holdout"] = held_back(known, arm.kinematics)
    return documents


def _instrument(known: Known, readings: Readings) -> dict[str, Any]:
    """The instrument as it was taken, and the places of the points that it read on the flange."""
    instrument = readings.instrument
    stated = {
        "words": instrument.words,
        "reads": "poses" if readings.are_poses else "places",
        "sigma_m": instrument.sigma_m,
        "sigma_per_m": instrument.sigma_per_m,
        "sigma_rad": instrument.sigma_rad if readings.are_poses else None,
    }
    document: dict[str, Any] = {"instrument": {k: v for k, v in stated.items() if v is not None}}
    if readings.mounting is not None:
        on_flange = readings.mounting.moved(known.solved.state).on_flange
        document["points"] = [
            {"point": name or "probe", **dict(zip(("x_m", "y_m", "z_m"), place, strict=True))}
            | {"sigma_mm": _point_sigma_mm(known.solved.covariance, point)}
            for point, (name, place) in enumerate(
                zip(readings.names, on_flange.tolist(), strict=True)
            )
        ]
    return document


def _point_sigma_mm(spread: FloatArray, point: int) -> float:
    """Root of the trace of a point's covariance on the flange; points but the first are shared."""
    rows = np.eye(len(spread))[9:12]
    if point:
        rows = rows + np.eye(len(spread))[9 + 3 * point : 12 + 3 * point]
    return 1e3 * float(np.sqrt(np.trace(rows @ spread @ rows.T)))


def _shapes(known: Known, free: Free) -> dict[str, Any]:
    """The targets as they were found to be; of rigs those whose points are not exact."""
    boards, documents = known.session.boards, {}
    for kind, describe in (("board", _board), ("rig", _rig)):
        found = {
            name: describe(known, free, at)
            for at, (name, target) in enumerate(boards.items())
            if at in known.boards and (target.kind == "points") is (kind == "rig")
        }
        found = {name: it for name, it in found.items() if it}
        if found:
            documents[f"{kind}s" if known.session.targets else kind] = (
                found if known.session.targets else found[""]
            )
    return documents


def _own(known: Known, free: Free, place: int) -> tuple[slice, Mask, FloatArray]:
    """Where one target's shape stands, which free values are its, and their sigmas."""
    mine = shape_slices(tuple(known.session.boards.values()), free.lens_count)[place]
    columns = (free.columns >= mine.start) & (free.columns < mine.stop)
    sigmas = np.sqrt(np.diag(known.solved.covariance))[_looks(known)][columns]
    return mine, columns, sigmas


def _looks(known: Known) -> slice:
    """The unknowns of lens and board."""
    return known.solved.problem.effect_columns.get(LENS_AND_BOARD, slice(0, 0))


def _rig(known: Known, free: Free, place: int) -> dict[str, Any]:
    """How far the points of a rig were moved, and how well that is known; empty for exact ones."""
    mine, columns, sigmas = _own(known, free, place)
    if not columns.any():
        return {}
    moved = free.after(known.solved.state.values).values[mine]
    return {"shape": moved.reshape(-1, 3).tolist(), "sigma": sigmas.reshape(-1, 3).tolist()}


def _board(known: Known, free: Free, place: int) -> dict[str, Any]:
    """A board as it was found to be, and how well that is known."""
    mine, board, sigmas = _own(known, free, place)
    shape = free.after(known.solved.state.values).values[mine]
    starts = first_corners(tuple(known.session.boards.values()))
    ends = [*starts[1:].tolist(), len(free.positions)]
    bend = free.corners_after(known.solved.state.values)[starts[place] : ends[place], 2]
    names = [BOARD_NAMES[at - mine.start] for at in free.columns[board]]
    return {
        "shape": dict(zip(BOARD_NAMES, shape.tolist(), strict=True)),
        "sigma": dict(zip(names, sigmas.tolist(), strict=True)),
        "estimated": [name for name, it in zip(names, free.anchored[board], strict=True) if not it],
        "bend_mm": 1e3 * float(np.ptp(bend)),
    }


def _uncertainty(known: Known, diagnosis: Diagnosis) -> dict[str, Any]:
    of = "combined" if known.robot_noise is None else "robot"
    degrees, millimetres = np.rad2deg(diagnosis.intervals[0]), 1e3 * diagnosis.intervals[1]
    return {
        "point_cam_m": diagnosis.point_cam.tolist(),
        "budget_mm": dict(diagnosis.budget_mm),
        "radius95_mm": diagnosis.radius95_mm,
        "noise_95": {
            f"{of}_translation_mm": millimetres.tolist(),
            f"{of}_rotation_deg": degrees.tolist(),
        },
        "spectrum": diagnosis.spectrum.tolist(),
        "inflation": diagnosis.inflation,
    }


def _camera(known: Known) -> CameraResult | None:
    """The camera as the whole chain left it, with what is open about it.

    Its covariance, the edges', and that of both together are blocks of one matrix: the joint fit's
    with all that was added to it since, errors of the arm and inflation. Given intrinsics of which
    only a part is open, the matrix and not the distortion, have zeros for the rest.
    """
    result, free, stated = known.solved, known.free, known.session.camera
    if known.camera is None and stated is not None:
        # Measured poses do without it; whoever looks through it later does not.
        return CameraResult(stated, estimated=False)
    if known.camera is None or free is None:
        return known.camera
    columns = free.columns[free.columns < free.lens_count]
    if not len(columns):
        return known.camera
    rows, edges = _looks(known).start + np.searchsorted(free.columns, columns), _rows(known)
    spread, shared = np.zeros((free.lens_count,) * 2), np.zeros((free.lens_count, len(edges)))
    spread[np.ix_(columns, columns)] = result.covariance[np.ix_(rows, rows)]
    shared[columns] = result.covariance[np.ix_(rows, edges)]
    return CameraResult(
        free.after(result.state.values).camera,
        estimated=known.camera.estimated or free.lens_is_free,
        covariance=spread,
        edge_covariance=shared,
    )


def _noise(known: Known) -> dict[str, float]:
    """Standard deviations per axis: of corners and flange, or of both as one without corners."""
    sigma_rad, sigma_m = known.solved.noise.robots[0].tolist()
    of = "combined" if known.robot_noise is None else "robot"
    seen = {} if known.pixel_px is None else {"pixel_px": known.pixel_px}
    if known.readings is not None:
        seen["instrument_mm"] = 1e3 * known.readings.sigma_m
        if known.readings.are_poses:
            seen["instrument_deg"] = float(np.rad2deg(known.readings.instrument.sigma_rad or 0.0))
    return seen | {
        f"{of}_translation_mm": 1e3 * sigma_m,
        f"{of}_rotation_deg": float(np.rad2deg(sigma_rad)),
    }

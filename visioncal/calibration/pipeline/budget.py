"""Left-out residuals of a fit, and its uncertainty budget by source."""

import numpy as np

from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.calibration.stages.random_effects import KINDS
from visioncal.calibration.stages.validate import HeldOutResiduals, needed_frames, pose_residuals
from visioncal.core.directions import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.core.prediction import sigmas_of, through, total_of
from visioncal.core.quantiles import radius95
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import apply_each
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.budget import Sources, covariance_by_source
from visioncal.estimation.fit import Fit
from visioncal.estimation.solve import solve_without
from visioncal.estimation.unknowns import BOARD, EDGE, LENS, LENS_ERRORS, SIZE
from visioncal.results.sections import UncertaintyResult
from visioncal.session import Session
from visioncal.vision.board_shape import shape_basis
from visioncal.vision.targets import corner_positions

# Sources of a single pair that are not clocks.
_SOURCES = {"temperature", "arm", *KINDS}

# Sources of lenses and boards, in the order of a budget.
_OPTICAL = {LENS_ERRORS: "lens_field", LENS: "intrinsics", BOARD: "board", SIZE: "board"}


def left_out(cell_fit: CellFit) -> HeldOutResiduals:
    """Residuals of the inliers, each by a fit without its stop, to first order."""
    fit, part, mount = cell_fit.fit.solution, cell_fit.fit.problem, cell_fit.cell.mount
    used = np.flatnonzero(cell_fit.inlier_fit.used)
    stops = np.unique(part.observations.stops, return_inverse=True)[1]
    needed, count = needed_frames(part), int(stops.max()) + 1
    # Few stops are held out one by one; with more, ten groups suffice, of no neighbours.
    folds = count if count <= 30 else 10
    fold = stops % folds
    away_m, away_rad, rms_px = (np.full(len(part), np.nan) for _ in range(3))
    with one_blas_thread():
        for out in range(folds):
            kept = fold != out
            determined = needed[kept].any(axis=0)
            held = ~kept & ~(needed & ~determined).any(axis=1)
            if not held.any():
                continue
            state = (
                solve_without(part, fit, kept)
                if cell_fit.solver == "joint"
                else closed_form_state(
                    part.subset(kept), cell_fit.solver, fit.state, cell_fit.cell.session.mount
                )
            )
            predicted = part.predicted(state)
            off_m, off_rad = pose_residuals(part, state, predicted)
            away_m[held], away_rad[held] = off_m[held], off_rad[held]
            held_rows = used[held].tolist()
            seen = (
                [cell_fit.cell.rows[at] for at in held_rows],
                [cell_fit.poses[at] for at in held_rows],
            )
            rms_px[held] = cell_fit.pixels(*seen, predicted[held], state)
    method = "leave-one-out" if folds == count else f"{folds}-fold"
    unit = "views" if count == len(part) else "stops"
    of = {None: "", "instrument": ", of the whole fit"}.get(mount, ", of the hand-eye fit")
    return HeldOutResiduals(f"{method} over {unit}{of}", away_m, away_rad, rms_px)


def _by_source(cell_fit: CellFit, fit: Fit) -> dict[str, FloatArray]:
    """Covariances (p, p) of the unknowns by source; their sum is that of all."""
    parts = covariance_by_source(fit.problem, fit.state, fit.noise, _sources(cell_fit, fit))
    return {**parts, **fit.by_source}


def budget_mm(cell_fit: CellFit, fit: Fit) -> dict[str, dict[str, float]]:
    """Standard deviations of unknown frames' positions in their parents, by source, in all [mm]."""
    parts = _by_source(cell_fit, fit)
    firsts = {frame: fit.unknowns[EDGE, frame].start + 3 for frame in fit.frames}
    return {frame: sigmas_of(parts, axes=slice(at, at + 3)) for frame, at in firsts.items()}


def uncertainty_of(cell_fit: CellFit, fit: Fit) -> UncertaintyResult:
    """Uncertainty of a target's middle that one camera locates: mean square of its views.

    Its size, and the pose of what carries the camera, are exact; the lens errs with the transform.

    Returns:
        The section of the result, without intervals of the noise.
    """
    middles, (camera, target) = middles_of(cell_fit.cell), [*fit.frames][:2]
    seen = fit.problem.observations.observed
    points = np.array([middles.get(name, np.zeros(3)) for name in seen])
    points_cam = apply_each(fit.problem.measured(fit.state), points)
    distances_m, point_cam = np.linalg.norm(points_cam, axis=1), points_cam.mean(axis=0)
    by_camera = np.array(fit.seen.observers) == camera
    by_unknowns = fit.located(camera, points[by_camera])[:, 3:]
    parts = {
        name: through(by_unknowns, array).mean(axis=0)
        for name, array in _by_source(cell_fit, fit).items()
    }
    limits = np.tile(np.repeat([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], 3), 2)
    joint = fit.covariance((EDGE, camera), (EDGE, target))
    values = np.linalg.eigvalsh(joint / np.outer(limits, limits))
    return UncertaintyResult(
        point_cam_m=point_cam,
        distances_m=np.array([distances_m.min(), distances_m.max()]),
        budget_mm=sigmas_of(parts),
        radius95_mm=1e3 * radius95(total_of(parts)),
        noise_95={},
        spectrum=np.sqrt(np.maximum(values, 0.0)),
    )


def middles_of(cell: Cell) -> dict[str, FloatArray]:
    """(3,) middle of each printed target in its frame [m], by frame."""
    session = cell.session
    return {
        session.board_frames[name]: corner_positions(board).mean(axis=0)
        for name, board in session.boards.items()
    }


def _sources(cell_fit: CellFit, fit: Fit) -> Sources:
    """Sources of uncertainty by camera, robot and board; without names for a single pair."""
    problem, mount, by_source = fit.problem, cell_fit.cell.mount, dict[str, IntArray]()
    is_pair = cell_fit.cell.session.has_one_pair
    rest = [unknown for unknown in fit.unknowns.parts if unknown.kind not in (EDGE, *_OPTICAL)]
    for unknown in (*rest, *fit.unknowns.all_of(*_OPTICAL)):
        source = _OPTICAL.get(unknown.kind, unknown.kind)
        if is_pair:
            source = source if source in (*_SOURCES, *_OPTICAL.values()) else "clock"
        elif unknown.kind != LENS_ERRORS:
            between = " " if unknown.kind == BOARD else " of "
            source = f"{source}{between}{unknown.name}".strip()
        if len(columns := fit.unknowns.columns(unknown)):
            by_source[source] = np.append(by_source.get(source, columns[:0]), columns)
    observers = problem.observations.observers
    if is_pair:
        kind, robot = "pixels", "poses" if problem.is_combined else "robot"
        kind = "instrument" if mount == "instrument" else kind
        return Sources(
            dict.fromkeys(observers, kind), dict.fromkeys(problem.robots, robot), by_source
        )
    # A sensor that moved remains one sensor.
    seers = {observer: observer.partition("@")[0] for observer in observers}
    of_corners = fit.unknowns.of(LENS)
    sensors = {
        key: f"{'pixels' if frame in of_corners else 'readings'} of {frame}"
        for key, frame in seers.items()
    }
    return Sources(sensors, {robot: f"robot {robot}" for robot in problem.robots}, by_source)


def middle_jacobians(fit: Fit, session: Session) -> dict[str, FloatArray]:
    """(3, b) Jacobians of targets' middles by the columns of all boards [m], by frame."""
    jacobians = {}
    for name, target in session.boards.items():
        values = fit.unknowns.values_of((BOARD, name))
        jacobian = np.zeros((3, len(fit.whole)))
        jacobian[:, fit.unknowns[BOARD, name]] = shape_basis(target).mean(axis=0)[:, values]
        jacobians[session.board_frames[name]] = jacobian[:, fit.unknowns.of_kinds(BOARD, SIZE)]
    return jacobians

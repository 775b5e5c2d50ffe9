"""Left-out residuals of a fit, and its uncertainty budget by source."""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.cell_fit import CellFit, within
from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.calibration.stages.validate import HeldOutResiduals, needed_frames, pose_residuals
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import apply_each
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.appearance import shape_basis, shape_slices
from visioncal.estimation.budget import Sources, covariance_by_source, point_covariance, radius95
from visioncal.estimation.effects import RANDOM_EFFECTS
from visioncal.estimation.effects.lenses import LENSES
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.solve import solve_without
from visioncal.results.sections import UncertaintyResult
from visioncal.session import frame_name
from visioncal.vision.targets import corner_positions

# Sources of a single pair that are not clocks.
_SOURCES = {"temperature", "arm", *(kind.kind for kind in RANDOM_EFFECTS)}


def left_out(cell_fit: CellFit) -> HeldOutResiduals:
    """Residuals of the inliers, each by a fit without its stop, to first order."""
    fit, part, mount = cell_fit.inlier_fit.fit, cell_fit.inlier_problem, cell_fit.cell.mount
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
                if cell_fit.solver == "joint" or mount is None
                else closed_form_state(part.subset(kept), cell_fit.solver, fit.state, mount)
            )
            predicted = part.predicted(state)
            off_m, off_rad = pose_residuals(part, state, predicted)
            away_m[held], away_rad[held] = off_m[held], off_rad[held]
            mine = used[held].tolist()
            seen = [cell_fit.cell.rows[at] for at in mine], [cell_fit.poses[at] for at in mine]
            rms_px[held] = cell_fit.pixels(*seen, predicted[held], state)
    method = "leave-one-out" if folds == count else f"{folds}-fold"
    unit = "views" if count == len(part) else "stops"
    of = {None: "", "instrument": ", of the whole fit"}.get(mount, ", of the hand-eye fit")
    return HeldOutResiduals(f"{method} over {unit}{of}", away_m, away_rad, rms_px)


def _covariances_of_edges(
    cell_fit: CellFit, beside: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Covariances (6 e, 6 e) of the unknown frames, by source and as a `total`."""
    fit, part = cell_fit.inlier_fit.fit, cell_fit.inlier_problem
    parts = covariance_by_source(part, fit.state, fit.noise, _sources(cell_fit))
    size = 6 * len(part.unknown)
    parts |= {name: array[:size, :size] for name, array in beside.items()}
    return parts | {"total": sum(parts.values(), np.zeros((size, size)))}


def _sigma_mm(covariance: FloatArray) -> float:
    # Of two sources that compensate each other, one may have a negative trace.
    return 1e3 * float(max(np.trace(covariance), 0.0) ** 0.5)


def budget_mm(cell_fit: CellFit, beside: Mapping[str, FloatArray]) -> dict[str, dict[str, float]]:
    """Standard deviations of unknown frames' positions in their parents, by source, in all [mm]."""
    parts, part = _covariances_of_edges(cell_fit, beside), cell_fit.inlier_problem
    firsts = {key: part.edge_columns(key).start + 3 for key in part.unknown}
    return {
        key: {name: _sigma_mm(array[at : at + 3, at : at + 3]) for name, array in parts.items()}
        for key, at in firsts.items()
    }


def uncertainty_of(
    cell_fit: CellFit, beside: Mapping[str, FloatArray], covariance: FloatArray
) -> UncertaintyResult:
    """Uncertainty of a target's middle that one camera and one robot locate, by all views' mean.

    Args:
        cell_fit: The fit.
        beside: (p, p) covariances from sources other than noise, by source.
        covariance: (p, p) of its unknowns, from all sources.

    Returns:
        The section of the result, without intervals of the noise.
    """
    part, state = cell_fit.inlier_problem, cell_fit.inlier_fit.fit.state
    middles = middles_of(cell_fit.cell)
    points = np.array([middles.get(name, np.zeros(3)) for name in part.observations.observed])
    points_cam = apply_each(part.measured(state), points)
    distances_m, point_cam = np.linalg.norm(points_cam, axis=1), points_cam.mean(axis=0)
    covariances = {
        name: point_covariance(state.edges[0], edge[:6, :6], point_cam)
        for name, edge in _covariances_of_edges(cell_fit, beside).items()
    }
    limits = np.tile(np.repeat([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], 3), 2)
    values = np.linalg.eigvalsh(covariance[:12, :12] / np.outer(limits, limits))
    return UncertaintyResult(
        point_cam_m=point_cam,
        distances_m=np.array([distances_m.min(), distances_m.max()]),
        budget_mm={name: _sigma_mm(at) for name, at in covariances.items()},
        radius95_mm=1e3 * radius95(covariances["total"]),
        noise_95={},
        spectrum=np.sqrt(np.maximum(values, 0.0)),
    )


def middles_of(cell: Cell) -> dict[str, FloatArray]:
    """(3,) middle of each printed target in its frame [m], by frame."""
    return {
        frame_name("target", name): corner_positions(plate).mean(axis=0)
        for name, plate in cell.session.plates.items()
    }


def _sources(cell_fit: CellFit) -> Sources:
    """Sources of uncertainty by camera, robot and board; without names for a single pair."""
    problem, mount = cell_fit.inlier_fit.problem, cell_fit.cell.mount
    columns = defaultdict[str, list[int]](list)
    for name, column in problem.effect_columns.items():
        if name != LENSES:
            kind = name.partition(" of ")[0]
            source = name if mount is None else kind if kind in _SOURCES else "clock"
            columns[source] += range(column.start, column.stop)
    for name, indices in {"lens_field": cell_fit.field_columns, **_shape_columns(cell_fit)}.items():
        columns[name if mount is None else name.partition(" ")[0]] += indices.tolist()
    by_source = {name: np.array(indices) for name, indices in columns.items() if indices}
    observers = problem.observations.observers
    if mount is not None:
        kind, robot = "pixels", "poses" if problem.is_combined else "robot"
        kind = "instrument" if mount == "instrument" else kind
        return Sources(
            dict.fromkeys(observers, kind), dict.fromkeys(problem.robots, robot), by_source
        )
    # A sensor that moved remains one sensor.
    seers = {observer: observer.partition("@")[0] for observer in observers}
    optics = cell_fit.camera_parameters
    of_corners = () if optics is None else optics.problems
    sensors = {
        key: f"{'pixels' if frame in of_corners else 'readings'} of {frame}"
        for key, frame in seers.items()
    }
    return Sources(sensors, {robot: f"robot {robot}" for robot in problem.robots}, by_source)


def _shape_columns(cell_fit: CellFit) -> dict[str, IntArray]:
    """The problem's columns of the free values of each lens and board."""
    seen, optics = cell_fit.linearised_corners, cell_fit.camera_parameters
    if seen is None or optics is None:
        return {}
    boards = cell_fit.cell.session.boards
    slices = {f"intrinsics of {name}": lens for name, lens in optics.lenses.items()}
    shapes = shape_slices(tuple(boards.values()), optics.boards.start)
    slices |= {f"board {name}".strip(): at for name, at in zip(boards, shapes, strict=True)}
    return {name: cell_fit.columns_of(within(seen.free, at)) for name, at in slices.items()}


def columns_of_boards(cell_fit: CellFit) -> IntArray:
    """The problem's columns of the free values of boards' shapes."""
    columns = (at for name, at in _shape_columns(cell_fit).items() if name.startswith("board"))
    return np.concatenate([np.zeros(0, dtype=np.int64), *columns])


def middle_jacobians(cell_fit: CellFit) -> dict[str, FloatArray]:
    """(3, b) Jacobians of targets' middles with respect to `columns_of_boards` [m], by frame."""
    seen, optics = cell_fit.linearised_corners, cell_fit.camera_parameters
    if seen is None or optics is None:
        return {}
    plates, boards = cell_fit.cell.session.plates, optics.boards
    free, jacobians = within(seen.free, boards), {}
    slices = shape_slices(tuple(plates.values()), boards.start)
    for (name, target), values in zip(plates.items(), slices, strict=True):
        jacobian = np.zeros((3, boards.stop))
        jacobian[:, values] = shape_basis(target).mean(axis=0)
        jacobians[frame_name("target", name)] = jacobian[:, free]
    return jacobians

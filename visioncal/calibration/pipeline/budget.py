"""Observations of a whole cell that no fit has seen, and what its uncertainty is made of."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.pipeline.solved import Solved, within
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.handeye import closed_form_state
from visioncal.calibration.stages.validate import HeldOut, validate
from visioncal.core.transforms import apply_each
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.estimation.appearance import shape_basis, shape_slices
from visioncal.estimation.budget import Sources, covariance_by_source, point_covariance, radius95
from visioncal.estimation.effects.lenses import LENSES
from visioncal.estimation.observability import SIGMA_LIMIT_M, SIGMA_LIMIT_RAD
from visioncal.estimation.parts import State
from visioncal.estimation.solve import solve_without
from visioncal.session import frame_name
from visioncal.vision.targets import corner_positions


def left_out(solved: Solved) -> HeldOut:
    """Residuals of the used observations, each by a fit without its stop."""
    fit, used, mount = solved.agreed.fit, np.flatnonzero(solved.agreed.used), solved.cell.mount
    part = solved.part

    def again(kept: Mask) -> State:
        if solved.solver == "joint" or mount is None:
            return solve_without(part, fit, kept)
        return closed_form_state(part.subset(kept), solved.solver, fit.state, mount)

    def pixels(rows: IntArray, predicted: FloatArray, state: State) -> FloatArray:
        mine = used[rows].tolist()
        seen = [solved.cell.rows[at] for at in mine], [solved.poses[at] for at in mine]
        return solved.pixels(*seen, predicted, state)

    of = {None: "", "instrument": ", of the whole fit"}.get(mount, ", of the hand-eye fit")
    return validate(part, again, pixels, of)


def _covariances_of_edges(
    solved: Solved, beside: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Covariances (6 e, 6 e) of the unknown frames, by source and as a `total`."""
    fit, part = solved.agreed.fit, solved.part
    parts = covariance_by_source(part, fit.state, fit.noise, _sources(solved))
    size = 6 * len(part.unknown)
    parts |= {name: array[:size, :size] for name, array in beside.items()}
    parts["total"] = sum(parts.values(), np.zeros((size, size)))
    return parts


def budget_mm(solved: Solved, beside: Mapping[str, FloatArray]) -> dict[str, dict[str, float]]:
    """Sigmas of each unknown frame's place in its parent, by source and as a `total` [mm]."""
    parts, part = _covariances_of_edges(solved, beside), solved.part
    found: dict[str, dict[str, float]] = {}
    for key in part.unknown:
        at = part.edge_columns(key).start
        place = slice(at + 3, at + 6)
        found[key] = {name: 1e3 * _root_trace(own[place, place]) for name, own in parts.items()}
    return found


def _root_trace(covariance: FloatArray) -> float:
    """Root of the trace: of two sources that make up for each other, one may be under zero."""
    return float(max(np.trace(covariance), 0.0) ** 0.5)


@dataclass(frozen=True, eq=False)
class Work:
    """How well one camera and one robot place what they look at.

    Attributes:
        point_cam: (3,) the target's middle in the camera's frame, as views see it on average [m].
        budget_mm: Standard deviation of such a point's place, by source and as a `total` [mm].
        radius95_mm: The place is right to within this in 95 % of cases [mm].
        spectrum: (12,) standard deviations along the principal directions of both edges, ascending,
            in units of the largest that are accepted (5 mm, 0.5 deg).
    """

    point_cam: FloatArray
    budget_mm: Mapping[str, float]
    radius95_mm: float
    spectrum: FloatArray


def work_of(solved: Solved, beside: Mapping[str, FloatArray], covariance: FloatArray) -> Work:
    """Looks at the uncertainty of one camera and one robot where its views looked.

    Args:
        solved: The fit.
        beside: (p, p) what counts beside its noise, by source.
        covariance: (p, p) of its unknowns, with all that.
    """
    part, state = solved.part, solved.agreed.fit.state
    middles = middles_of(solved.cell)
    middle = np.array([middles.get(name, np.zeros(3)) for name in part.observations.observed])
    point = apply_each(part.measured(state), middle).mean(axis=0)
    at_work = {
        name: point_covariance(state.edges[0], edge[:6, :6], point)
        for name, edge in _covariances_of_edges(solved, beside).items()
    }
    limit = np.tile(np.repeat([SIGMA_LIMIT_RAD, SIGMA_LIMIT_M], 3), 2)
    values = np.linalg.eigvalsh(covariance[:12, :12] / np.outer(limit, limit))
    return Work(
        point,
        {name: 1e3 * _root_trace(array) for name, array in at_work.items()},
        1e3 * radius95(at_work["total"]),
        np.sqrt(np.maximum(values, 0.0)),
    )


def middles_of(cell: Cell) -> dict[str, FloatArray]:
    """(3,) the middle of each printed target by its frame, in that [m]."""
    return {
        frame_name("target", name): corner_positions(plate).mean(axis=0)
        for name, plate in cell.session.plates.items()
    }


def _sources(solved: Solved) -> Sources:
    """What makes the result uncertain, by camera, robot and board; without names where alone."""
    problem, is_pair = solved.agreed.problem, solved.cell.mount is not None
    of_corners = () if solved.looks is None else tuple(solved.looks.problems)
    columns: dict[str, IntArray] = {}
    for name, column in problem.effect_columns.items():
        if name != LENSES:
            called = _of_effect(name) if is_pair else name
            columns[called] = np.append(
                columns.get(called, np.zeros(0, np.int64)), np.arange(column.start, column.stop)
            )
    if len(solved.field_columns):
        columns["lens_field"] = solved.field_columns
    if is_pair:
        kind = "instrument" if solved.cell.mount == "instrument" else "pixels"
        robot = "poses" if problem.is_combined else "robot"
        sensors = dict.fromkeys(problem.observations.observers, kind)
        return Sources(sensors, dict.fromkeys(problem.robots, robot), columns | _looks(solved))
    # One that moved is one sensor all the same.
    seers = {observer: observer.partition("@")[0] for observer in problem.observations.observers}
    return Sources(
        {
            key: f"pixels of {frame}" if frame in of_corners else f"readings of {frame}"
            for key, frame in seers.items()
        },
        {robot: f"robot {robot}" for robot in problem.robots},
        columns | _looks(solved),
    )


def _of_effect(name: str) -> str:
    """What the uncertainty of an effect is of, by its name."""
    kind = name.partition(" of ")[0]
    return {"temperature": "temperature", "arm": "arm"}.get(kind, "clock")


def columns_of_boards(solved: Solved) -> IntArray:
    """The problem's columns of boards' shapes, as far as they are free."""
    found = (look for name, look in _looks(solved).items() if name.startswith("board"))
    return np.concatenate([np.zeros(0, dtype=np.int64), *found])


def middles_moved(solved: Solved) -> dict[str, FloatArray]:
    """(3, b) how the middle of each target moves with `columns_of_boards`, by its frame [m]."""
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return {}
    plates, at = solved.cell.session.plates, looks.boards
    free = within(seen.free, at)
    found = {}
    for (name, target), mine in zip(
        plates.items(), shape_slices(tuple(plates.values()), at.start), strict=True
    ):
        by_shape = np.zeros((3, at.stop))
        by_shape[:, mine] = shape_basis(target).mean(axis=0)
        found[frame_name("target", name)] = by_shape[:, free]
    return found


def _looks(solved: Solved) -> dict[str, IntArray]:
    """Columns of each lens and each board, as far as they are free."""
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return {}
    boards, alone = solved.cell.session.boards, solved.cell.mount is not None
    places = {
        "intrinsics" if alone else f"intrinsics of {name}": lens
        for name, lens in looks.lenses.items()
    }
    if alone:
        places["board"] = looks.boards
        boards = {}
    slices = shape_slices(tuple(boards.values()), looks.boards.start)
    for name, item in zip(boards, slices, strict=True):
        places[f"board {name}".strip()] = item
    free = {name: within(seen.free, place) for name, place in places.items()}
    return {name: solved.columns_of(array) for name, array in free.items() if len(array)}

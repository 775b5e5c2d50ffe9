"""Observations of a whole cell that no fit has seen, and what its uncertainty is made of."""

from collections.abc import Mapping

import numpy as np

from visioncal.estimation.appearance import shape_slices
from visioncal.estimation.budget import Sources, covariance_by_source
from visioncal.estimation.effects.lenses import LENSES
from visioncal.estimation.parts import State
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import solve_problem
from visioncal.pipeline.solving import Solved
from visioncal.stages.validate import HeldOut, validate
from visioncal.types import FloatArray, IntArray


def left_out(solved: Solved) -> HeldOut:
    """Residuals of the used observations, each by a fit without its stop."""
    fit, used = solved.agreed.fit, np.flatnonzero(solved.agreed.used)

    def again(part: Problem) -> State:
        return solve_problem(part, fit.state, fit.noise)[0]

    def pixels(rows: IntArray, state: State) -> FloatArray:
        return solved.chain_px(used[rows], state)

    return validate(solved.agreed.problem.subset(solved.agreed.used), again, pixels)


def budget_mm(solved: Solved, beside: Mapping[str, FloatArray]) -> dict[str, dict[str, float]]:
    """Sigmas of each unknown frame's place in its parent, by source and as a `total` [mm].

    Args:
        solved: The fit.
        beside: (p, p) what counts beside its noise, by source.
    """
    fit, part = solved.agreed.fit, solved.agreed.problem.subset(solved.agreed.used)
    parts = covariance_by_source(part, fit.state, fit.noise, _sources(solved))
    size = 6 * len(part.unknown)
    parts |= {name: it[:size, :size] for name, it in beside.items()}
    parts["total"] = sum(parts.values(), np.zeros((size, size)))
    found: dict[str, dict[str, float]] = {}
    for key in part.unknown:
        at = part.edge_columns(key).start
        place = slice(at + 3, at + 6)
        squares = {name: float(np.trace(it[place, place])) for name, it in parts.items()}
        # Of two that make up for each other, one may count for less than nothing.
        found[key] = {name: 1e3 * max(it, 0.0) ** 0.5 for name, it in squares.items()}
    return found


def _sources(solved: Solved) -> Sources:
    """What makes the result uncertain, by camera, robot and board."""
    problem = solved.agreed.problem
    of_corners = () if solved.looks is None else tuple(solved.looks.problems)
    columns = {
        name: np.arange(problem.size)[it]
        for name, it in problem.effect_columns.items()
        if name != LENSES
    }
    # One that moved is one sensor all the same.
    seers = {it: it.partition("@")[0] for it in problem.observations.observers}
    return Sources(
        {
            key: f"pixels of {frame}" if frame in of_corners else f"readings of {frame}"
            for key, frame in seers.items()
        },
        {robot: f"robot {robot}" for robot in problem.robots},
        columns | _looks(solved),
    )


def columns_of_boards(solved: Solved) -> IntArray:
    """The problem's columns of boards' shapes, as far as they are free."""
    found = (it for name, it in _looks(solved).items() if name.startswith("board"))
    return np.concatenate([np.zeros(0, dtype=np.int64), *found])


def _looks(solved: Solved) -> dict[str, IntArray]:
    """Columns of each lens and each board, as far as they are free."""
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        return {}
    boards = solved.cell.session.boards
    places = {f"intrinsics of {name}": it for name, it in looks.lenses.items()}
    slices = shape_slices(tuple(boards.values()), looks.boards.start)
    for name, it in zip(boards, slices, strict=True):
        places[f"board {name}".strip()] = it
    free = {
        name: seen.free[(seen.free >= it.start) & (seen.free < it.stop)]
        for name, it in places.items()
    }
    return {name: solved.columns_of(it) for name, it in free.items() if len(it)}

"""What is written of a whole cell's lenses, boards and corners beside its frames."""

from typing import Any

import numpy as np

from visioncal.alignment.solving import Solved
from visioncal.estimation.appearance import BOARD_NAMES, shape_slices
from visioncal.estimation.corners import reproject
from visioncal.estimation.problem import State
from visioncal.session import Session
from visioncal.session.frames import thing_name
from visioncal.types import FloatArray, IntArray


def corner_residuals(solved: Solved, state: State, rows: IntArray) -> dict[int, tuple[int, float]]:
    """By view, how many corners its image has, and how far they are off the whole chain [px].

    Args:
        solved: The fit.
        state: Its unknowns, or those of another fit to a part of the observations.
        rows: (m,) the observations.
    """
    looks = solved.looks_at(state)
    if looks is None:
        return {}
    chosen = np.isin(np.arange(len(solved.cell.rows)), rows)
    chain = solved.agreed.problem.subset(chosen).predicted(state)
    predicted = {solved.cell.rows[at].view: it for at, it in zip(rows.tolist(), chain, strict=True)}
    shaped = np.concatenate(looks.corners)
    found: dict[int, tuple[int, float]] = {}
    for name, corners in looks.problems.items():
        kept = np.isin(corners.stack.views, list(predicted))
        stack = corners.stack.keep(kept[corners.stack.view_of])
        if not stack.views:
            continue
        poses = np.array([predicted[it] for it in stack.views])
        off = reproject(stack.with_points(shaped[stack.ids]), looks.camera(name), poses).residuals
        squares = stack.sum_by_view(np.sum(off**2, axis=1)) / stack.counts
        counted = zip(stack.views, stack.counts.tolist(), np.sqrt(squares).tolist(), strict=True)
        found |= {view: (count, px) for view, count, px in counted}
    return found


def fit_sections(
    session: Session, solved: Solved, spread: FloatArray, edges: int
) -> dict[str, Any]:
    """The targets as they were found to be, and the covariance of all that the fit has in common.

    Args:
        session: The session.
        solved: The fit.
        spread: (p, p) covariance of its unknowns.
        edges: How many of them are transforms, which come first.

    Returns:
        `joint_fit`: which values of each camera's lens and each target's shape are among the
        unknowns, cameras first, and the covariance of transforms and these. `boards` and `rigs`
        as one camera's result has them.
    """
    seen, looks = solved.seen, solved.looks
    if seen is None or looks is None:
        transforms = spread[: 6 * edges, : 6 * edges].tolist()
        return {"joint_fit": {"cameras": {}, "targets": {}, "covariance": transforms}}

    def among(mine: slice) -> list[int]:
        """Which values of a lens or a target are free, from its own first on."""
        free = seen.free[(seen.free >= mine.start) & (seen.free < mine.stop)]
        return [int(it) for it in free - mine.start]

    targets = tuple(session.boards.values())
    names = tuple(name or "target" for name in session.plates) or ("target",)
    shapes = dict(zip(names, shape_slices(targets, looks.boards.start), strict=True))
    columns = [*range(6 * edges), *solved.columns_of(seen.free).tolist()]
    fit = {
        "cameras": {thing_name(it, "camera"): among(at) for it, at in looks.lenses.items()},
        "targets": {name: among(it) for name, it in shapes.items()},
        "covariance": spread[np.ix_(columns, columns)].tolist(),
    }
    sigmas = np.zeros(len(looks.values))
    sigmas[seen.free] = np.sqrt(np.diag(spread))[solved.columns_of(seen.free)]
    boards, rigs = {}, {}
    for at, ((name, mine), target) in enumerate(zip(shapes.items(), targets, strict=True)):
        values, known, free = looks.values[mine], sigmas[mine], among(mine)
        if target.kind == "points" and free:
            rigs[name] = {
                "shape": values.reshape(-1, 3).tolist(),
                "sigma": known.reshape(-1, 3).tolist(),
            }
        elif target.kind != "points":
            boards[name] = {
                "shape": dict(zip(BOARD_NAMES, values.tolist(), strict=True)),
                "sigma": {BOARD_NAMES[it]: float(known[it]) for it in free},
                "estimated": [BOARD_NAMES[it] for it in free],
                "bend_mm": 1e3 * float(np.ptp(looks.corners[at][:, 2])),
            }
    parts = {"boards": boards, "rigs": rigs, "joint_fit": fit}
    return {name: it for name, it in parts.items() if it}

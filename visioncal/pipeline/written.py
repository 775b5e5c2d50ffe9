"""What is written of a whole cell's lenses and boards beside its frames."""

from typing import Any

import numpy as np

from visioncal.estimation.appearance import BOARD_NAMES, shape_slices
from visioncal.pipeline.solving import Solved
from visioncal.session import Session
from visioncal.session.frames import thing_name
from visioncal.types import FloatArray


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

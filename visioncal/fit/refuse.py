"""Refusals of cells whose sightings determine nothing, or leave a direction of a frame open.

Of a session, `estimation.observability` says by which fault of the motion.
"""

import numpy as np

from visioncal.core.directions import edge_directions
from visioncal.core.errors import DegenerateError
from visioncal.core.types import FloatArray
from visioncal.estimation.observability import TYPICAL_NOISE, TYPICAL_PX
from visioncal.fit.fit import Fit
from visioncal.fit.mixed import inverse
from visioncal.model import Cell

_ADVICE = (
    "Add 3 or more views in which the flange is tilted by 20 to 40 degrees about different axes, "
    "not only about one axis."
)


def refuse_unjoined(cell: Cell, joined: Cell) -> None:
    """Refuses a cell of whose sightings nothing is left that a fit could use.

    Args:
        cell: As read.
        joined: With the sightings whose poses are known, between frames that are joined.

    Raises:
        DegenerateError: There are none.
    """
    if not any(not (one.is_held or one.is_stated) for one in joined.sightings):
        raise DegenerateError(
            "cell: the sightings are too few, too much alike, or wrong: frames are not determined.",
            culprits=cell.unknown or ("cam",),
            next_step=_ADVICE,
        )


def refuse_open(fit: Fit) -> None:
    """Refuses sightings that leave a direction of a frame open, whatever noise they show.

    The motion is judged by its geometry at a typical noise, with lenses and boards as they are;
    together with these, no direction may be open.

    Raises:
        DegenerateError: The predicted sigma of a direction is over the limit.
    """
    typical = dict(zip(("rad", "m"), TYPICAL_NOISE.robots[0].tolist(), strict=True))
    at = [size.name.partition(" ") for size in fit.unknowns.sizes]
    flanges = np.array([unit in typical and name in fit.unknowns.erring for unit, _, name in at])
    corners = np.array([unit in ("px", "view") for unit, *_ in at], bool)
    level = np.log([typical.get(unit, TYPICAL_PX) for unit, *_ in at])
    least = np.minimum(fit.estimate.logs, level)
    logs = np.where(flanges, level, np.where(corners, least, fit.estimate.logs))
    by_motion = _of_edges(fit, logs)
    logs = np.where(flanges | corners, least, fit.estimate.logs)
    joint_covariance = fit.mixed.at(logs, is_sloped=False).covariance
    for covariance, is_by_motion in ((by_motion, True), (joint_covariance, False)):
        for name in fit.cell.unknown:
            columns = fit.unknowns.columns("edge", name)
            parent = fit.cell.tree.branches[name].parent
            for one in edge_directions(
                fit.edge(name), covariance[np.ix_(columns, columns)], name, parent
            ):
                if one.is_open or (is_by_motion and one.sigma > one.limit):
                    raise DegenerateError(
                        f"cell: {one.words} {one.fault(' at a typical noise')}.",
                        culprits=[one.words],
                        next_step=_ADVICE,
                    )


def _of_edges(fit: Fit, logs: FloatArray) -> FloatArray:
    """Covariance (p, p) of edges at some sizes, all else as it is."""
    units, common = fit.mixed.assembled(logs)
    p = fit.unknowns.count
    for body, (errors, cross) in zip(fit.mixed.bodies, units, strict=True):
        at, solved = np.append(body.columns, p), np.linalg.solve(errors, cross)
        common[at[:, None], at] -= np.tensordot(cross, solved, ((0, 1), (0, 1)))
    edges = [fit.unknowns.columns("edge", name) for name in fit.cell.unknown]
    at, covariance = np.concatenate([np.zeros(0, int), *edges]), np.zeros((p, p))
    covariance[at[:, None], at], _ = inverse(common[at[:, None], at])
    return covariance

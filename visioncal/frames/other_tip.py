"""Another tip by which touches fit a drawing that they do not fit by the stated tool."""

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.limits import CLEAR_RATIO
from visioncal.core.number_format import figure
from visioncal.core.procrustes import align
from visioncal.core.transforms import apply
from visioncal.core.types import FloatArray
from visioncal.estimation.points import GroupFit, Placement, PointProblem, fit_groups
from visioncal.frames.placing import DISAGREE_M, LEAST_NOISE_M
from visioncal.frames.pointfit import PointPairs
from visioncal.frames.touches import Tool


def with_other_tip(
    error: DataError, pairs: PointPairs, poses: FloatArray, tool: Tool | None
) -> DataError:
    """The error of touches that do not fit a drawing, or that they fit it by another tip.

    Args:
        error: The error.
        pairs: The touched points, and those of the drawing.
        poses: (n, 4, 4) of the flange at the touches [m]; NaN where a rotation is not known.
        tool: The stated tool; None where the poses are of its tip.
    """
    # Touches of which nine unknowns leave six coordinates to be checked with.
    if len(pairs) < 5 or not np.isfinite(poses).all():
        return error
    by_tool = align(pairs.measured, pairs.nominal)
    off_m = np.sqrt(np.mean((apply(by_tool[None], pairs.nominal)[0] - pairs.measured) ** 2))
    # Lengths of tools along the flange's z from which the search starts [m].
    fit = min(
        (_fitted(pairs, poses, length) for length in (0.0, 0.1, 0.2, 0.4)), key=lambda at: at.sigma
    )
    if fit.sigma > DISAGREE_M or CLEAR_RATIO * fit.sigma > off_m:
        return error
    tip, reference = fit.state.points[0], "as poses of the tip itself (--tool none)"
    if tool is not None:
        stated = _words(tool.edge.matrix[:3, 3])
        reference = f"with {tool.name}, whose tip is at {stated} mm"
    return DataError(
        f"fixture: another tool touched, or the poses are of another frame: with a tip at "
        f"{_words(tip)} mm in the frame of the poses, the points fit the drawing to "
        f"{figure(1e3 * fit.sigma)} mm per axis, and to {figure(1e3 * off_m)} mm {reference}.",
        culprits=["--tool"],
        next_step="Name the tool that touched with --tool; --tool none is for poses of its tip.",
    )


def _words(point_m: FloatArray) -> str:
    return "({:.1f}, {:.1f}, {:.1f})".format(*(1e3 * point_m))


def _fitted(pairs: PointPairs, poses: FloatArray, length_m: float) -> GroupFit:
    """The fit of the fixture and of one tip that all poses carry."""
    tip = np.array([0.0, 0.0, length_m])
    start = Placement(align(apply(poses, tip[None])[:, 0], pairs.nominal), tip[None])
    problem = PointProblem(
        pairs.nominal,
        np.ones_like(pairs.nominal, dtype=bool),
        np.tile(LEAST_NOISE_M**2 * np.eye(3), (len(poses), 1, 1)),
        lambda: [start],
        carriers=poses,
        points=np.zeros(len(poses), dtype=np.int64),
    )
    return fit_groups(problem)

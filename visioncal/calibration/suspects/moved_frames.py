"""Frames of a whole cell that moved during the session, at once or all the time."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.suspects.moved_views import is_switched, other_frame, tool_taken_off
from visioncal.core.number_format import figure, mm_and_deg, some_of
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.moves import creep_effects
from visioncal.results import Moved
from visioncal.results.edge import Edge
from visioncal.session.frames import object_name

# Two cameras have each other's images where each stands, but for so much of the way between them,
# where the other stood: another lens places it by some percent elsewhere.
_EXCHANGED = 0.05


def moved_findings(
    moves: Sequence[Moved], edges: Mapping[str, Edge], cell_fit: CellFit | None = None
) -> Iterator[Finding]:
    """Findings on frames that moved, by the transforms of the result; exchanged cameras first.

    By the fit, those that a flange carries may have moved since the controller's tool was switched.
    """
    exchanged = set[int]()
    for one, other in combinations(range(len(moves)), 2):
        if (found := _exchanged(moves, one, other, edges)) is not None:
            exchanged |= {one, other}
            yield found
    for at, move in enumerate(moves):
        if at not in exchanged:
            switched = None if cell_fit is None else _of_tool(move, moves, edges, cell_fit)
            yield switched or _moved(move)


def _exchanged(
    moves: Sequence[Moved], first: int, second: int, edges: Mapping[str, Edge]
) -> Finding | None:
    """The finding that two cameras have each other's images from a stop on."""
    pair = moves[first], moves[second]
    if pair[0].frame == pair[1].frame or not all(at.frame.startswith("cam") for at in pair):
        return None

    def after(at: int) -> FloatArray:
        """Where a frame stood after one of its moves: until its next one, or at the end."""
        later = (move.before for move in moves[at + 1 :] if move.frame == moves[at].frame)
        return edges[next(later, moves[at].frame)].matrix

    before = [edges[move.before].matrix for move in pair]
    between_mm = pose_difference(*before)[0]
    now = after(first), after(second)
    away = [pose_difference(*ends)[0] for ends in zip(now, before[::-1], strict=True)]
    if max(away) > _EXCHANGED * between_mm:
        return None
    names = [object_name(move.frame, "camera") for move in pair]
    stop = min(move.first_stop for move in pair)
    return Finding(
        "moved_frame",
        f"From stop {stop} on, or up to there, {pair[0].frame} and {pair[1].frame} have each "
        f"other's images: each stands where the other stood, to {figure(max(away))} mm of "
        f"{figure(between_mm)} mm. The result treats both as moved.",
        Remedy(
            f"In views.csv, exchange {names[0]} and {names[1]} in column camera, in the rows of "
            f"the stops from {stop} on or in those before, and calibrate again.",
            CALIBRATE,
        ),
    )


def _moved(moved: Moved) -> Finding:
    """Finding that a frame moved."""
    what = "was bumped" if moved.frame.startswith("cam") else "moved"
    return Finding(
        "moved_frame",
        f"{moved.frame} {what} between stops {moved.last_stop} and {moved.first_stop}, by "
        f"{mm_and_deg(moved.shift_mm, moved.turn_deg)}. The result has "
        f"{moved.frame} where it stood last, and as {moved.before} where it stood before.",
        Remedy(f"Fasten {moved.frame}, and record again."),
    )


def _of_tool(
    moved: Moved, moves: Sequence[Moved], edges: Mapping[str, Edge], cell_fit: CellFit
) -> Finding | None:
    """The finding that a tool was switched, where all that a flange carries moved with a frame."""
    tree, frame = cell_fit.cell.tree, moved.frame
    flange = tree.branches[frame].parent
    before, after = edges[moved.before].matrix, edges[frame].matrix
    if flange not in tree.flanges.values() or not is_switched(invert(before) @ after):
        return None
    carried = {name for name, at in tree.branches.items() if at.parent == flange}
    if carried - {one.frame for one in moves if one.first_stop == moved.first_stop}:
        return None
    robot = next(name for name, at in tree.flanges.items() if at == flange)
    views = cell_fit.cell.views_of_robot(robot, moved.first_stop)
    plain = _moved(moved)
    otherwise = f"fasten {frame}, and record again."
    do = tool_taken_off(cell_fit, frame, (before, after), views, otherwise)
    if do is None:
        return None
    words = (
        f"{plain.words} Or the controller's tool is another one from stop {moved.first_stop} on, "
    )
    words += f"by {other_frame(before, after)}, as everything on {flange} moved."
    return replace(plain, words=words, do=do)


def crept_findings(cell_fit: CellFit) -> Iterator[Finding]:
    """Finding that frames of a whole cell crept."""
    problem, state = cell_fit.inlier_fit.problem, cell_fit.inlier_fit.fit.state
    crept = sorted(
        (
            (pose_difference(np.eye(4), exp(problem.values_of(at.name, state))), at.frame)
            for at in creep_effects(problem)
        ),
        reverse=True,
    )
    if crept:
        words = ", ".join(f"{frame} by {mm_and_deg(*by)}" for by, frame in crept)
        yield Finding(
            "frame_creeps",
            f"Frames crept during the session, as where mounts give way: {words}. The result has "
            "each where it stood last.",
            Remedy(f"Fasten {some_of([frame for _, frame in crept])}, and record again."),
        )

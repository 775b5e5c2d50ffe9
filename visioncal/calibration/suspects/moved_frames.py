"""Frames of a whole cell that moved during the session, at once or all the time."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.core.number_format import figure, mm_and_deg, some_of
from visioncal.core.transforms import exp, pose_difference
from visioncal.core.types import FloatArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.estimation.moves import creep_effects
from visioncal.results import Moved
from visioncal.results.edge import Edge
from visioncal.session.frames import object_name

# Two cameras have each other's images where each stands, but for so much of the way between them,
# where the other stood: another lens places it by some percent elsewhere.
_EXCHANGED = 0.05


def moved_findings(moves: Sequence[Moved], edges: Mapping[str, Edge]) -> Iterator[Finding]:
    """Findings on frames that moved, by the transforms of the result; exchanged cameras first."""
    exchanged = set[int]()
    for one, other in combinations(range(len(moves)), 2):
        if (found := _exchanged(moves, one, other, edges)) is not None:
            exchanged |= {one, other}
            yield found
    yield from (_moved(move) for at, move in enumerate(moves) if at not in exchanged)


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
    away = [pose_difference(*both)[0] for both in zip(now, before[::-1], strict=True)]
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

"""Where the boards of a session are, stage after stage."""

from dataclasses import replace

import numpy as np

from visioncal.pipeline.known import Known
from visioncal.targets import corner_positions, first_corners
from visioncal.types import Corners, FloatArray, Rejection


def own_numbers(known: Known, corners: Corners) -> Corners:
    """The corners of a view by their numbers on its own board, again."""
    if len(known.session.boards) < 2 or not len(corners.ids):
        return corners
    starts = first_corners(tuple(known.session.boards.values()))
    return replace(corners, ids=corners.ids - int(starts[starts <= corners.ids[0]][-1]))


def without_lost_boards(known: Known) -> Known:
    """Leaves boards out of which no used view is left."""
    agreed = known.agreed
    seen = {known.poses[view].board for view in known.used}
    kept = [at for at, board in enumerate(known.boards) if board in seen]
    if agreed is None or len(kept) == len(known.boards) or not kept:
        return known
    names, boards = tuple(known.session.boards), [known.boards[at] for at in kept]
    lost = [it for it in known.boards if it not in seen]
    gone = [it for it in known.candidates if known.poses[it].board in lost]
    mask = np.array([known.poses[it].board in seen for it in known.candidates])
    why = {it: f"no view of target {names[known.poses[it].board]} is left" for it in gone}
    known = replace(
        known,
        boards=tuple(boards),
        agreed=replace(agreed, mask=agreed.mask[mask]),
        candidates=tuple(it for it in known.candidates if it not in gone),
    )
    doubts = [f"No usable view shows target {names[it]}: it has no place." for it in lost]
    return known.noting([Rejection(*it) for it in why.items()], doubts)


def middles_of(known: Known) -> dict[str, FloatArray]:
    """(3,) the middle of each printed target by its frame, in that [m]."""
    targets = tuple(known.session.boards.values())
    return {
        known.frame_of(it): corner_positions(targets[it]).mean(axis=0)
        for it in known.boards
        if targets
    }


def middles(known: Known) -> FloatArray:
    """(m, 3) middle of the target that each observation is of, in its frame [m]."""
    middle = middles_of(known)
    observed = known.solved.problem.observations.observed
    return np.array([middle.get(it, np.zeros(3)) for it in observed])

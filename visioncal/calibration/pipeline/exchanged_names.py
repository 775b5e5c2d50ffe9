"""Cameras, or robots, whose names are exchanged in all rows of a whole cell."""

from dataclasses import replace
from itertools import combinations

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.starting import agreeing_views
from visioncal.calibration.pipeline.steps import stages_before
from visioncal.calibration.stages.cell import read_cell
from visioncal.calibration.stages.pnp import given_poses
from visioncal.core.errors import VisioncalError
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.session import Session, View, frame_name
from visioncal.session.document import Kind
from visioncal.session.kinds import name_of

# Nothing else makes nearly all views agree of which hardly any did.
_NEARLY_ALL, _HARDLY_ANY = 0.9, 0.3
# Fewer views agree by chance.
_FEWEST = 8


def exchanged_names(known: RunState) -> Finding | None:
    """Says of which two cameras, or robots, of a cell the views are exchanged.

    Each exchange is followed to the first consensus of all frames; no images are searched.

    Args:
        known: What is known of the cell, once its images were searched.

    Returns:
        It; None where no exchange makes nearly all views agree.
    """
    session = known.session
    if known.mount is not None or not known.cameras:
        return None
    seen = known.corners.keys() | session.corners.keys() | given_poses(session).keys()
    there = seen - known.held_back
    rows = [
        observation
        for observation in session.observations
        if observation.view.number in there and not observation.view.is_of_lens
    ]
    before = _agreeing(known)
    kinds: tuple[tuple[Kind, list[str]], ...] = (
        ("camera", [*session.cameras]),
        ("robot", [*session.robots]),
    )
    for kind, names in kinds:
        for pair in combinations(names, 2):
            frames = {frame_name(kind, name) for name in pair}
            # Of robots, what was seen by way of them.
            mine = {
                row.view.number
                for row in rows
                if (row.seer in frames if kind == "camera" else {*pair} & {*row.robots, *row.lacks})
            }
            if len(mine) < _FEWEST or len(mine & before) > _HARDLY_ANY * len(mine):
                continue
            after = _agreeing(_looked(known, kind, pair)) & mine
            if len(after) >= _NEARLY_ALL * len(mine):
                return _finding(kind, pair, (len(after), len(mine), len(mine & before)))
    return None


def _finding(kind: Kind, pair: tuple[str, str], counts: tuple[int, int, int]) -> Finding:
    first, second = pair
    after, total, before = counts
    whose = f"{kind}s {first} and {second}"
    what = "views" if kind == "camera" else "poses"
    return Finding(
        "exchanged_names",
        f"The {what} of {whose} are exchanged: with them exchanged, {after} of {total} views "
        f"agree, as recorded {before}.",
        Remedy(
            f"In the column {kind} of views.csv, write {second} for {first} and {first} for "
            f"{second} in all rows, and calibrate again.",
            CALIBRATE,
        ),
    )


def _looked(known: RunState, kind: Kind, pair: tuple[str, str]) -> RunState | None:
    """What is known before the fit with two names exchanged; None where that cannot be."""
    session = _renamed(known.session, kind, pair)
    looks = dict(known.cameras)
    # Corners of a table are taken up anew: those outside of the other camera's image were left out.
    is_kept = any(view.image for view in session.views)
    if kind == "camera" and is_kept:
        for name, other in (pair, pair[::-1]):
            look = known.cameras.get(frame_name(kind, other))
            if look is None:
                return None
            looks[frame_name(kind, name)] = replace(
                look, table=session.cameras[name], lens=None, pixel_px=None
            )
    state = RunState(session, None, known.threads, level=known.level)
    try:
        for stage in stages_before("joints"):
            is_known = stage.name == "detect" and is_kept
            state = replace(state, cameras=looks) if is_known else stage.run(state)
    except VisioncalError:
        return None
    return state


def _renamed(session: Session, kind: Kind, pair: tuple[str, str]) -> Session:
    other = {pair[0]: pair[1], pair[1]: pair[0]}

    def renamed(view: View) -> View:
        name = name_of(session.declaration, kind, view)
        return replace(view, text={**view.text, kind: other[name]}) if name in other else view

    return replace(session, views=tuple(map(renamed, session.views)))


def _agreeing(known: RunState | None) -> frozenset[int]:
    """The views that agree in the first consensus of the frames; none where there is none."""
    try:
        return frozenset() if known is None else agreeing_views(read_cell(known), known)
    except VisioncalError:
        return frozenset()

"""Detects two cameras, or two robots, of a cell whose names are exchanged in all rows."""

from dataclasses import replace
from itertools import combinations

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.starting import agreeing_views
from visioncal.calibration.run import stages_before
from visioncal.calibration.stages.cell import read_cell
from visioncal.calibration.stages.pnp import stated_poses
from visioncal.core.errors import VisioncalError
from visioncal.core.verdict import CALIBRATE, Finding, Remedy
from visioncal.session import Session, View, frame_name
from visioncal.session.document import Kind
from visioncal.session.kinds import name_of

# Shares of agreeing views: with the names exchanged at least the first, as recorded at most the
# second.
_NEARLY_ALL, _HARDLY_ANY = 0.9, 0.3
# Fewer views may agree by chance.
_FEWEST = 8


def exchanged_names(run: RunState) -> Finding | None:
    """Finding on two cameras, or robots, of a cell whose names are exchanged.

    Each exchange is tested up to the initial frames of the cell; no images are searched again.
    None where no exchange makes nearly all views agree.

    Args:
        run: The run of the cell, after the detection of targets.
    """
    session = run.session
    if run.mount is not None or not run.cameras:
        return None
    seen = run.corners.keys() | session.corners.keys() | stated_poses(session).keys()
    usable = seen - run.held_back
    observations = (row for row in session.observations if row.view.number in usable)
    rows = [row for row in observations if not row.view.is_of_lens]
    before = _agreeing(run)
    kinds: tuple[tuple[Kind, list[str]], ...] = (
        ("camera", [*session.cameras]),
        ("robot", [*session.robots]),
    )
    for kind, names in kinds:
        for pair in combinations(names, 2):
            frames = {frame_name(kind, name) for name in pair}
            # For robots, the views whose chains they are part of.
            affected = {
                row.view.number
                for row in rows
                if (
                    row.seer in frames
                    if kind == "camera"
                    else {*pair} & {*row.robots, *row.missing_robots}
                )
            }
            if len(affected) < _FEWEST or len(affected & before) > _HARDLY_ANY * len(affected):
                continue
            after = _agreeing(_with_exchanged(run, kind, pair)) & affected
            if len(after) >= _NEARLY_ALL * len(affected):
                return _finding(kind, pair, (len(after), len(affected), len(affected & before)))
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


def _with_exchanged(run: RunState, kind: Kind, pair: tuple[str, str]) -> RunState | None:
    """The run before the fit with two names exchanged; None where a stage fails."""
    session = _renamed(run.session, kind, pair)
    looks = dict(run.cameras)
    # Corners from images are reused. Those of a table are read again, as those outside of the other
    # camera's image were dropped.
    is_kept = any(view.image for view in session.views)
    if kind == "camera" and is_kept:
        for name, other in (pair, pair[::-1]):
            look = run.cameras.get(frame_name(kind, other))
            if look is None:
                return None
            looks[frame_name(kind, name)] = replace(
                look, table=session.cameras[name], lens=None, pixel_px=None
            )
    state = RunState(session, None, run.threads, level=run.level)
    try:
        for stage in stages_before("joints"):
            is_done = stage.name == "detect" and is_kept
            state = replace(state, cameras=looks) if is_done else stage.run(state)
    except VisioncalError:
        return None
    return state


def _renamed(session: Session, kind: Kind, pair: tuple[str, str]) -> Session:
    exchanged = {pair[0]: pair[1], pair[1]: pair[0]}

    def renamed(view: View) -> View:
        name = name_of(session.declaration, kind, view)
        return (
            replace(view, text={**view.text, kind: exchanged[name]}) if name in exchanged else view
        )

    return replace(session, views=tuple(map(renamed, session.views)))


def _agreeing(run: RunState | None) -> frozenset[int]:
    """The views that agree with the initial frames; none where there are no such frames."""
    try:
        return frozenset() if run is None else agreeing_views(read_cell(run), run)
    except VisioncalError:
        return frozenset()

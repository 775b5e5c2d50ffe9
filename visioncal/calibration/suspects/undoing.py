"""Mistakes of a record that, undone, make the views agree.

Rows may be shifted from one on, boards read as if they were turned or tilted the other way, poses
repeated, signs of positions lost.

Each hypothesis pairs views with poses of the robot otherwise, or turns boards back. It is compared
with the record as it stands, in which the same views are wrong for no known reason, by likelihoods
whose noise is integrated out. No level of a wrong fit enters, and not even half of the rows need be
right.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from visioncal.calibration.guess.fit import CLOSING_SCORE
from visioncal.calibration.guess.readings import shifted
from visioncal.calibration.guess.recording import CLEAR, EVIDENCE
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cameras import estimate_lenses, locate_targets
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.suspects.mistaken_rows import (
    FEW_APART,
    FEW_VIEWS,
    MANY,
    MISTAKE,
    NEAR_TURN_RAD,
    SHIFTS,
    UNEVEN,
    Undoing,
    chosen_views,
    copied_rows,
    left_out,
    mixed_angle_rows,
    mixed_unit_rows,
    other_signs,
    rows_apart,
    turned_rows,
)
from visioncal.calibration.suspects.record import LEAST, Edges, Record, StopOfRobot, evidence
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import FEWEST_COMPARED
from visioncal.core.number_format import view_words
from visioncal.core.transforms import compose, exp, invert
from visioncal.core.types import FloatArray, IntArray, Mask, Rejection
from visioncal.core.verdict import Finding, Option, mending, or_alone
from visioncal.vision.camera import turned_back

# Share of a flip's angle that its mirror image leaves at most, and a flip's shift without unit:
# perspective of a near marker puts the second pose off the mirror image by a tenth.
_NEARLY = 0.15
# A camera is in its place within this [m].
_IN_PLACE_M = 0.01


def undone(run: RunState, found: Undoing, *, is_named: bool = False) -> RunState:
    """Leaves out the views that a mistake of the record explains, and names it if it is new."""
    views = set(found.found.views)
    left = {view: pose for view, pose in run.poses.items() if view not in views}
    if len(left) <= FEWEST_COMPARED:
        return replace(run, misread=(found.found,))
    run = replace(run, poses=left, misread=run.misread or ())
    reasons = (Rejection(view, f"{found.short}, as the other views show") for view in views)
    return run.noting(reasons, () if is_named else (found.found,))


def likeliest(run: RunState, stops: Mapping[int, StopOfRobot] | None = None) -> Undoing | None:
    """The mistake that is clearly likelier than views wrong for no known reason, if any.

    Of one robot and one camera whose poses stand beside their images, after the stage `pnp`; of a
    pair in a whole cell, rows are counted by all `stops` of the robot.
    """
    if not run.session.has_one_pair or run.misread or waits_for_clock(run.session):
        return None
    record = Record.of(run, stops)
    if len(record.rows) < FEWEST_COMPARED:
        return None
    paired = record.paired(np.arange(len(record.views)))
    fresh = ~record.copies & ~record.lingering
    declared = Edges.by(record, paired, fresh)
    if declared is None:
        return None
    squares = declared.of(paired)
    agrees = evidence(squares[None])[1]
    # Turns that agree do not let a few places that are off count as wrong.
    is_even = (squares < UNEVEN**2 * (np.median(squares, axis=0) + LEAST**2)).all()
    if agrees.all() and is_even and squares.mean() < CLOSING_SCORE**2:
        return None
    shifts = SHIFTS if len(record.views) <= MANY else SHIFTS[: 1 + 2 * FEW_APART]
    pairs = {by: record.paired(shifted(by, len(record.views))) for by in shifts}
    every = [declared]
    every += filter(None, (Edges.by(record, pairs[by], fresh) for by in shifts[1:]))
    # Two losses may leave no half of all rows right, and yet most of one end's.
    halves = np.arange(len(paired)) < 0.5 * len(paired)
    every += filter(None, (Edges.by(record, paired, fresh & half) for half in (halves, ~halves)))
    best = max(every, key=lambda edges: float(evidence(edges.of(paired)[None])[0][0]))
    apart = best.of(paired)
    (base,), (agrees,) = evidence(apart[None])
    rivals = [*copied_rows(record, best, apart, paired, agrees)]
    if len(record.views) >= len(run.session.views):
        # Shifted are all rows, of one point as of others.
        rivals += rows_apart(record, every, pairs, float(base))
    if record.shows == "image":
        rivals += [
            *_flipped(record, best, paired, apart, float(base)),
            *_turned_pictures(run, record, best, paired, apart, float(base)),
            *other_signs(record, best, paired, apart, float(base)),
            *mixed_unit_rows(record, paired, float(base)),
            *mixed_angle_rows(record, paired, float(base)),
            *turned_rows(record, best, paired, apart, float(base)),
        ]
    found = max(rivals, key=lambda rival: rival.odds, default=None)
    return found if found is not None and found.odds > CLEAR else None


def _flipped(
    record: Record, edges: Edges, paired: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Views of a flat board with the other one of the two poses that its image nearly fits.

    The board's normal is reflected about the line of sight (Collins and Bartoli 2014, IPPE).
    """
    seen = record.camera
    sight = seen[..., :3, 3:] / np.linalg.norm(seen[..., :3, 3:], axis=-2, keepdims=True)
    mirror = np.eye(3) - 2.0 * sight @ np.swapaxes(sight, -1, -2)
    other = compose(mirror @ seen[..., :3, :3] @ np.diag([1.0, 1.0, -1.0]), seen[..., :3, 3])
    mirrored = replace(edges, record=replace(record, camera=other)).of(paired)
    odds, wrong = chosen_views(paired, apart, mirrored, base)
    for at in range(len(paired)) if len(paired) <= FEW_VIEWS else ():
        # One view in a few bends the fit.
        camera = record.camera.copy()
        camera[at] = other[at]
        single = Edges.by(replace(record, camera=camera), paired, paired >= 0)
        if single is not None:
            squares = single.of(paired)
            (log,), (agrees,) = evidence(squares[None])
            gain = EVIDENCE * float(log - base) + MISTAKE - float(np.log(len(paired)))
            if gain > odds and squares[agrees].mean() < CLOSING_SCORE**2:
                odds, wrong = gain, np.arange(len(paired)) == at
    # Wrong poses that a mirror brings so near by chance: the turns left have three directions.
    nearly = (apart[:, 0] < _NEARLY**2 * apart[:, 1]) & (mirrored[:, 1] < _NEARLY**2 * apart[:, 1])
    nearly &= ~evidence(apart[None])[1][0] & (paired >= 0)
    gain = MISTAKE + 1.5 * float(np.log(apart[nearly, 1] / (mirrored[nearly, 1] + LEAST**2)).sum())
    if gain > CLEAR > odds:
        odds, wrong = gain, nearly
    views = tuple(record.views[record.rows[wrong]].tolist())
    if not views:
        return
    others = record.views[record.rows[~wrong]].tolist()
    short = "the board's pose is the other one of the two that a flat board's image nearly fits"
    do = or_alone(
        "Have the detector give both poses and take the other one in these views (OpenCV: "
        "solvePnPGeneric), or give images or corners; or calibrate the other views alone.",
        others,
    )
    how = ": tilted the other way about the line of sight."
    yield left_out(odds, short, Finding("flipped_poses", how, do, views))


def _turned_pictures(
    run: RunState, record: Record, edges: Edges, paired: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Views whose picture is turned: the camera is, about the line of sight."""
    for degrees in (180, 90, 270):
        turn = exp(np.array([0.0, 0.0, np.deg2rad(degrees), 0.0, 0.0, 0.0]))
        turned = replace(edges, record=replace(record, camera=invert(turn) @ record.camera))
        if record.is_numbered:
            wrong = (paired >= 0) & (turned.of(paired)[:, 1] < NEAR_TURN_RAD**2)
            wrong &= turned.of(paired)[:, 1] < apart[:, 1]
            odds = _by_pixels(run, record, paired, wrong, degrees // 90, base)
        else:
            squares = turned.of(paired)
            odds, wrong = chosen_views(paired, apart, squares, base)
            # A picture turns about the lens: by more than others scatter, the camera was moved.
            usual = max(9.0 * float(np.median(apart[:, 0])), (_IN_PLACE_M / edges.lever) ** 2)
            if not wrong.any() or np.median(squares[wrong, 0]) > usual:
                continue
        views = tuple(record.views[record.rows[wrong]].tolist())
        if not views:
            continue
        is_end = bool(wrong[int(np.argmax(wrong)) :].all()) and len(views) > 1
        when = f"From view {views[0]} on" if is_end else f"In {view_words(views)}"
        yield Undoing(
            odds - float(np.log(3.0)),
            Finding(
                "turned_pictures",
                f"{when}, the pictures are turned by {degrees} deg, as where the camera's driver "
                "was set otherwise, or the target's poses are. They were left out: the camera's "
                "transform is that of the other pictures, and differs by this turn for pictures "
                "as these.",
                mending("they are turned back", Option("turned", f"{degrees}", views)),
                views,
            ),
            "its picture is turned",
            degrees // 90,
        )


def _by_pixels(
    run: RunState, record: Record, paired: IntArray, wrong: Mask, quarters: int, base: float
) -> float:
    """Log odds that (m,) some views' pictures are turned: with these turned back, and a lens anew.

    Turned back as poses alone, views would not agree: a lens's centre is off the middle of the
    pictures.
    """
    views = {*record.views[record.rows[wrong]].tolist()}
    if not views or len(views) == len(paired):
        return -np.inf
    for frame, look in run.cameras.items():
        if look.resolution is None:
            return -np.inf
        back = {
            view: replace(at, px=turned_back(at.px, look.resolution, quarters))
            for view, at in look.corners.items()
            if view in views
        }
        run = run.with_camera(frame, replace(look, corners={**look.corners, **back}))
    try:
        run = locate_targets(estimate_lenses(run))
    except VisioncalError:
        return -np.inf
    mended = Record.of(run)
    pairs = mended.paired(np.arange(len(mended.views)))
    fitted = Edges.by(mended, pairs, ~mended.copies & ~mended.lingering)
    if fitted is None or len(pairs) < len(paired):
        return -np.inf
    squares = fitted.of(pairs)
    (log,), (agrees,) = evidence(squares[None])
    is_close = squares[agrees].mean() < CLOSING_SCORE**2
    is_close &= bool(np.sum(agrees & wrong) > 0.6 * np.sum(wrong))
    return EVIDENCE * float(log - base) + 2.0 * MISTAKE if is_close else -np.inf

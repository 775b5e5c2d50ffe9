"""Mistakes of a record that, undone, make the views agree.

Rows may be shifted from one on, boards read as if they were turned or tilted the other way, poses
repeated, signs of positions lost.

Each hypothesis pairs views with poses of the robot otherwise, or turns boards back. It is compared
with the record as it stands, in which the same views are wrong for no known reason, by likelihoods
whose noise is integrated out. No level of a wrong fit enters, and not even half of the rows need be
right.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from visioncal.calibration.guess.fit import CLOSING_SCORE
from visioncal.calibration.guess.readings import ROW_ORDERS, shifted
from visioncal.calibration.guess.search import CLEAR, EVIDENCE
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cameras import estimate_lenses, locate_targets
from visioncal.calibration.stages.clocks import waits_for_clock
from visioncal.calibration.suspects.record import LEAST, Edges, Record, evidence
from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import FEWEST_COMPARED, FEWEST_VIEWS
from visioncal.core.number_format import counted, ranges, some_of, view_words
from visioncal.core.transforms import apply, compose, exp, invert, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Rejection
from visioncal.core.verdict import Finding, mending, or_alone
from visioncal.estimation.chain import robot_part
from visioncal.vision.camera import turned_back

# Rows that images and poses are apart, from none on: some lost or doubled pictures.
_SHIFTS = (0, *(sign * by for by in range(1, 7) for sign in (1, -1)))
# Of more views, fewer rows apart are tried: each takes as long as the fit.
_MANY, _FEW_APART = 200, 3
# The prior of a mistake of the record; the probability that a robot reports one pose twice to the
# last digit though it moved.
_MISTAKE, _EQUAL = float(np.log(0.01)), 1e-4
# A turn of a board differs by less from a quarter or half one, and one of a picture whose lens has
# its centre off the middle [rad].
_NEAR_RAD, _NEAR_TURN_RAD = 0.1, 0.3
# Of so few views, one that is wrong bends the fit of all.
_FEW = 7
# Views are alike within so many medians; log-ratios of squares count as one so clear at most.
_UNEVEN = 7.0
_CLIPPED = -2.0 * float(np.log(_UNEVEN)), 2.0 * float(np.log(_UNEVEN))
# A flange is nearer to the base than this, and farther from its origin [m]; other positions are in
# another unit.
_FARTHEST_M, _NEAREST_M = 20.0, 0.01
# A camera is in its place within this [m].
_IN_PLACE_M = 0.01


@dataclass(frozen=True, eq=False)
class Undoing:
    """A mistake of the record that explains views."""

    odds: float  # Its log odds against views that are wrong for no known reason.
    found: Finding  # The finding; its views are left out.
    short: str  # The same as a clause, for each of the views.
    quarters: int = 0  # By how many the views' pictures are turned clockwise.


def undone(run: RunState, found: Undoing) -> RunState:
    """Leaves out the views that a mistake of the record explains, and names it."""
    views = set(found.found.views)
    left = {view: pose for view, pose in run.poses.items() if view not in views}
    if len(left) <= FEWEST_COMPARED:
        return replace(run, misread=(found.found,))
    run = replace(run, poses=left, misread=run.misread or ())
    reasons = (Rejection(view, f"{found.short}, as the other views show") for view in views)
    return run.noting(reasons, (found.found,))


def likeliest(run: RunState) -> Undoing | None:
    """The mistake that is clearly likelier than views wrong for no known reason, if any.

    Of one robot and one camera whose poses stand beside their images, after the stage `pnp`.
    """
    if run.mount is None or run.misread or waits_for_clock(run.session):
        return None
    record = Record.of(run)
    if len(record.rows) < FEWEST_COMPARED:
        return None
    own = record.paired(np.arange(len(record.views)))
    fresh = ~record.copies & ~record.lingering
    declared = Edges.by(record, own, fresh)
    if declared is None:
        return None
    squares = declared.of(own)
    agrees = evidence(squares[None])[1]
    # Turns that agree do not let a few places that are off count as wrong.
    is_even = (squares < _UNEVEN**2 * (np.median(squares, axis=0) + LEAST**2)).all()
    if agrees.all() and is_even and squares.mean() < CLOSING_SCORE**2:
        return None
    shifts = _SHIFTS if len(record.views) <= _MANY else _SHIFTS[: 1 + 2 * _FEW_APART]
    pairs = {by: record.paired(shifted(by, len(record.views))) for by in shifts}
    every = [declared]
    every += filter(None, (Edges.by(record, pairs[by], fresh) for by in shifts[1:]))
    # Two losses may leave no half of all rows right, and yet most of one end's.
    halves = np.arange(len(own)) < 0.5 * len(own)
    every += filter(None, (Edges.by(record, own, fresh & half) for half in (halves, ~halves)))
    best = max(every, key=lambda edges: float(evidence(edges.of(own)[None])[0][0]))
    apart = best.of(own)
    (base,), (agrees,) = evidence(apart[None])
    rivals = [*_copied(record, apart, own, agrees)]
    if len(record.views) == len(run.session.views):
        # Shifted are all rows, of one point as of others.
        rivals += _shifted(record, every, pairs, float(base))
    if record.shows == "image":
        rivals += [
            *_flipped(record, best, own, apart, float(base)),
            *_turned_pictures(run, record, best, own, apart, float(base)),
            *_signed(record, best, own, apart, float(base)),
            *_mixed_units(record, own, float(base)),
            *_mixed_angles(record, own, float(base)),
            *_turned(record, best, own, apart, float(base)),
        ]
    found = max(rivals, key=lambda rival: rival.odds, default=None)
    return found if found is not None and found.odds > CLEAR else None


def _copied(record: Record, apart: FloatArray, own: IntArray, agrees: Mask) -> Iterator[Undoing]:
    """Poses of the robot, or of the target, that are there once more though the other moved."""
    closes = apart[agrees].mean() < CLOSING_SCORE**2
    for copies, pose, but in (
        (
            record.copies,
            "the robot's pose",
            f"the {record.shows}s differ: the log repeated a pose that was read before",
        ),
        (
            record.lingering,
            "the target's pose" if record.shows == "image" else "the reading",
            "the robot moved: the last that was seen lingered",
        ),
    ):
        copied = copies & ~agrees & (own >= 0)
        if not copied.any() or not closes:
            continue
        # Where the robot stands still between views, equal poses say little.
        chance = max(float((copies & agrees).mean()), _EQUAL)
        views = tuple(record.views[record.rows[copied]].tolist())
        others = record.views[record.rows[~copied]].tolist()
        whose = f"{view_words(views).capitalize()} {'have' if len(views) > 1 else 'has'}"
        yield Undoing(
            _MISTAKE - len(views) * float(np.log(chance)),
            Finding(
                "copied_poses",
                f"{whose} {pose} of the row before once more, to the last digit, though {but}. "
                "Left out.",
                or_alone("Record them anew, or calibrate the other views alone.", others),
                views,
            ),
            f"{pose} is that of the row before, once more",
        )


def _flipped(
    record: Record, edges: Edges, own: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Views of a flat board with the other one of the two poses that its image nearly fits.

    The board's normal is reflected about the line of sight (Collins and Bartoli 2014, IPPE).
    """
    seen = record.camera
    sight = seen[..., :3, 3:] / np.linalg.norm(seen[..., :3, 3:], axis=-2, keepdims=True)
    mirror = np.eye(3) - 2.0 * sight @ np.swapaxes(sight, -1, -2)
    other = compose(mirror @ seen[..., :3, :3] @ np.diag([1.0, 1.0, -1.0]), seen[..., :3, 3])
    mirrored = replace(edges, record=replace(record, camera=other)).of(own)
    odds, wrong = _chosen(own, apart, mirrored, base)
    for at in range(len(own)) if len(own) <= _FEW else ():
        # One view in a few bends the fit.
        camera = record.camera.copy()
        camera[at] = other[at]
        alone = Edges.by(replace(record, camera=camera), own, own >= 0)
        if alone is not None:
            squares = alone.of(own)
            (log,), (agrees,) = evidence(squares[None])
            gain = EVIDENCE * float(log - base) + _MISTAKE - float(np.log(len(own)))
            if gain > odds and squares[agrees].mean() < CLOSING_SCORE**2:
                odds, wrong = gain, np.arange(len(own)) == at
    views = tuple(record.views[record.rows[wrong]].tolist())
    if not views:
        return
    others = record.views[record.rows[~wrong]].tolist()
    short = "the board's pose is the other one of the two that a flat board's image nearly fits"
    yield Undoing(
        odds,
        Finding(
            "flipped_poses",
            f"In {view_words(views)} {short}: tilted the other way about the line "
            "of sight. They were left out.",
            or_alone(
                "Have the detector give both poses and take the other one in these views (OpenCV: "
                "solvePnPGeneric), or give images or corners; or calibrate the other views alone.",
                others,
            ),
            views,
        ),
        short,
    )


def _turned_pictures(
    run: RunState, record: Record, edges: Edges, own: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Views whose picture is turned: the camera is, about the line of sight."""
    for degrees in (180, 90, 270):
        turn = exp(np.array([0.0, 0.0, np.deg2rad(degrees), 0.0, 0.0, 0.0]))
        turned = replace(edges, record=replace(record, camera=invert(turn) @ record.camera))
        if record.is_numbered:
            wrong = (own >= 0) & (turned.of(own)[:, 1] < _NEAR_TURN_RAD**2)
            wrong &= turned.of(own)[:, 1] < apart[:, 1]
            odds = _by_pixels(run, record, own, wrong, degrees // 90, base)
        else:
            squares = turned.of(own)
            odds, wrong = _chosen(own, apart, squares, base)
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
                mending("they are turned back", f"--turned {ranges(views)}:{degrees}"),
                views,
            ),
            "its picture is turned",
            degrees // 90,
        )


def _by_pixels(
    run: RunState, record: Record, own: IntArray, wrong: Mask, quarters: int, base: float
) -> float:
    """Log odds that (m,) some views' pictures are turned: with these turned back, and a lens anew.

    As poses alone they would not agree: a lens's centre is off the middle of the pictures.
    """
    views = {*record.views[record.rows[wrong]].tolist()}
    if not views or len(views) == len(own):
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
    if fitted is None or len(pairs) < len(own):
        return -np.inf
    squares = fitted.of(pairs)
    (log,), (agrees,) = evidence(squares[None])
    is_close = squares[agrees].mean() < CLOSING_SCORE**2
    is_close &= bool(np.sum(agrees & wrong) > 0.6 * np.sum(wrong))
    return EVIDENCE * float(log - base) + 2.0 * _MISTAKE if is_close else -np.inf


def _chosen(own: IntArray, apart: FloatArray, other: FloatArray, base: float) -> tuple[float, Mask]:
    """Log odds that some views are otherwise, with other squares (m, 2), and the views (m,).

    Any number of them is as likely, and any choice: they are those that it helps most.
    """
    there, here = (np.where(own < 0, 1.0, at.sum(axis=1)) for at in (other, apart))
    order = np.argsort((there + LEAST**2) / (here + LEAST**2), kind="stable")
    number = np.arange(1, len(own) + 1)
    some = np.argsort(order) < number[:, None]
    squares = np.where(some[..., None], other, apart)
    logs, agrees = evidence(squares)
    choices = gammaln(len(own) + 2) - gammaln(number + 1) - gammaln(len(own) - number + 1)
    odds = EVIDENCE * (logs - base) + _MISTAKE - choices
    at = int(odds.argmax())
    closes = squares[at][agrees[at]].mean() < CLOSING_SCORE**2
    return float(odds[at]), some[at] & agrees[at] & closes


def _signed(
    record: Record, edges: Edges, own: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Views whose position lost the sign of one axis."""
    for axis, name in enumerate("xyz"):
        flanges = robot_part(record.robot, record.mount).copy()
        flanges[:, axis, 3] *= -1.0
        signed = replace(record, robot=robot_part(flanges, record.mount))
        odds, wrong = _chosen(own, apart, replace(edges, record=signed).of(own), base)
        views = tuple(record.views[record.rows[wrong]].tolist())
        if not views:
            continue
        short = f"{name} of the robot's position has the other sign"
        axes = ",".join(f"-{each}" if each == name else each for each in "xyz")
        yield Undoing(
            odds - float(np.log(3.0)),
            Finding(
                "lost_sign",
                f"In {view_words(views)} {short}: with its own, they agree with the others. They "
                "were left out.",
                mending("it has its own", f"--positions {ranges(views)}:{axes}"),
                views,
            ),
            short,
        )


def _mixed_units(record: Record, own: IntArray, base: float) -> Iterator[Undoing]:
    """Views whose position is in millimetres where the others' are in metres, or the reverse.

    The sizes of the positions, or of one axis, tell the rows of either unit, however many they are.
    """
    flanges = robot_part(record.robot, record.mount)
    sizes_m, large = np.linalg.norm(flanges[:, :3, 3], axis=1), "a thousand times as large"
    single = ((1e-3, np.abs(flanges[:, at, 3]) > _FARTHEST_M, large, "xyz"[at]) for at in range(3))
    for factor, wrong, unit, part in (
        (1e-3, sizes_m > _FARTHEST_M, large, "xyz"),
        (1e3, sizes_m < _NEAREST_M, "a thousandth as large", "xyz"),
        *single,
    ):
        is_scaled = wrong[:, None] & np.array([name in part for name in "xyz"])
        scaled = compose(flanges[:, :3, :3], flanges[:, :3, 3] * np.where(is_scaled, factor, 1.0))
        log = _of_changed(record, own, wrong, scaled)
        if log is None:
            continue
        views = tuple(record.views[record.rows[wrong[own] & (own >= 0)]].tolist())
        whose = "the robot's position" if part == "xyz" else f"{part} of the robot's position"
        short = f"{whose} is {unit} as in the others, as where it is in another unit"
        axes = ",".join(f"{factor:g}*{at}_m" if at in part else at for at in "xyz")
        yield Undoing(
            EVIDENCE * float(log - base) + _MISTAKE,
            Finding(
                "mixed_units",
                f"In {view_words(views)} {short}: in the same one, they agree with the others. "
                "They were left out.",
                mending("all have one unit", f"--positions {ranges(views)}:{axes}"),
                views,
            ),
            short,
        )


def _of_changed(record: Record, own: IntArray, wrong: Mask, flanges: FloatArray) -> float | None:
    """Log evidence of other poses of the robot in (n,) some rows; None where most disagree."""
    rows = wrong[own] & (own >= 0)
    if np.sum(rows) < 1 or np.sum(~rows & (own >= 0)) < 1:
        return None
    edges = Edges.by(replace(record, robot=robot_part(flanges, record.mount)), own, own >= 0)
    if edges is None:
        return None
    squares = edges.of(own)
    (log,), (agrees,) = evidence(squares[None])
    is_close = squares[agrees].mean() < CLOSING_SCORE**2
    return float(log) if is_close and np.sum(agrees & rows) > 0.6 * np.sum(rows) else None


def _mixed_angles(record: Record, own: IntArray, base: float) -> Iterator[Undoing]:
    """Views whose angles are in radians where the others' are in degrees.

    Read as degrees, they are of a robot that hardly turns.
    """
    flanges = robot_part(record.robot, record.mount)
    angles = np.where(np.isfinite(flanges[:, 0, 0]), rotation_angle(flanges), np.inf)
    wrong = angles < np.deg2rad(np.pi * np.sqrt(3.0))
    if not wrong.any() or wrong[own].all():
        return
    turned = flanges.copy()
    for form in (
        "rotation-vector",
        *(f"euler-{each}-rad" for each in ("ZYX", "xyz", "ZYZ", "XYZ")),
    ):
        numbers = ROTATION_FORMS[f"{form.removesuffix('-rad')}-deg"].write(flanges[wrong, :3, :3])
        turned[wrong, :3, :3] = ROTATION_FORMS[form].read(numbers)
        log = _of_changed(record, own, wrong, turned)
        if log is None:
            continue
        rows = wrong[own] & (own >= 0)
        views = tuple(record.views[record.rows[rows]].tolist())
        short = "the robot's angles are in radians, and were taken for degrees"
        words = (
            "In the log, write their angles in degrees (times 57.29578) as the others' are, and "
        )
        yield Undoing(
            EVIDENCE * float(log - base) + _MISTAKE,
            Finding(
                "mixed_units",
                f"In {view_words(views)} {short}: in the same unit, they agree with the others. "
                "They were left out.",
                or_alone(
                    f"{words}convert it anew; or calibrate the other views alone.",
                    record.views[record.rows[~rows]].tolist(),
                ),
                views,
            ),
            short,
        )


def _turned(
    record: Record, edges: Edges, own: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Boards that were read as if they were turned in their plane, or some squares on in it."""
    known = np.flatnonzero(own >= 0)
    turned = edges.turned(own)
    for degrees in (180.0, 90.0, 270.0, 0.0):
        angle = np.deg2rad(degrees)
        turn = exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))[:3, :3]
        near = known[rotation_angle(turn.T @ turned[known, :3, :3]) < _NEAR_RAD]
        middle = np.median(turned[near, :2, 3], axis=0) if len(near) else np.zeros(2)
        if not degrees:
            by_squares, middle = _squares_on(record.marks, turned[near, :2, 3])
            near = near[by_squares]
        whole = compose(turn, np.array([*middle, 0.0]))
        if len(near) < (1 if degrees else 2):
            continue
        if degrees and not _is_reading(record, whole, edges.lever):
            continue
        squares = apart.copy()
        squares[near] = edges.squares(invert(whole) @ turned[near])
        (there,), (agrees,) = evidence(squares[None])
        wrong = near[agrees[near]]
        if not len(wrong) or squares[agrees].mean() > CLOSING_SCORE**2:
            continue
        # The middle is known by these views themselves, in two directions of their six.
        noise = float(np.sqrt(squares[agrees, 0].mean() / 3.0 + LEAST**2))
        odds = EVIDENCE * (float(there - base) - 2.0 * float(np.log(2.0 / noise)))
        odds += _MISTAKE - float(np.log(4.0))
        views = tuple(record.views[record.rows[wrong]].tolist())
        centre = np.linalg.solve(np.eye(2) - turn[:2, :2], middle) if degrees else middle
        centre = np.round(1e3 * centre, 2) + 0.0
        about = ",".join(f"{value:g}" for value in (degrees, *centre.tolist()))
        point = f"({centre[0]:.1f}, {centre[1]:.1f}) mm"
        short = f"the board was read turned by {degrees:.0f} deg"
        where, back = "in its plane, about", "it is turned back"
        if not degrees:
            short, where = "the board's corners are numbered some squares on", "by"
            back = "they have their own numbers"
        yield Undoing(
            odds,
            Finding(
                "turned_board",
                f"In {view_words(views)} {short} {where} {point}. They were left out.",
                mending(back, f"--turned {ranges(views)}:{about}"),
                views,
            ),
            short,
        )


def _is_reading(record: Record, turn: FloatArray, lever: float) -> bool:
    """Whether a board may be read so: where its corners were numbered, they are others of its own.

    Else its own middle is in the picture. A turn about another place is that of another frame.
    """
    if not record.is_numbered:
        centre = np.linalg.solve(np.eye(2) - turn[:2, :2], turn[:2, 3])
        return float(np.linalg.norm(centre)) < lever
    between = np.linalg.norm(record.marks[:, None] - record.marks, axis=2)
    away = np.linalg.norm(apply(turn, record.marks)[:, None] - record.marks, axis=2)
    near = 0.2 * float(between[between > 0.0].min(initial=np.inf))
    return float(away.min(axis=1).max()) < near


def _squares_on(marks: FloatArray, shifts: FloatArray) -> tuple[Mask, FloatArray]:
    """(k,) mask of (k, 2) shifts in a board's plane that are by the same squares, and this shift.

    It brings most of the (n, 3) marks onto others.
    """
    between = (marks[:, None] - marks).reshape(-1, 3)[:, :2]
    steps, counts = np.unique(np.round(between, 6), axis=0, return_counts=True)
    steps = steps[(counts > 0.5 * len(marks)) & np.any(steps != 0.0, axis=1)]
    if not len(steps):
        return np.zeros(len(shifts), dtype=bool), np.zeros(2)
    near_m = 0.2 * float(np.linalg.norm(steps, axis=1).min())
    near = np.linalg.norm(shifts[:, None] - steps, axis=2) < near_m
    most = int(near.sum(axis=0).argmax())
    return np.asarray(near[:, most]), np.asarray(steps[most])


def _shifted(
    record: Record, every: list[Edges], pairs: dict[int, IntArray], base: float
) -> Iterator[Undoing]:
    """The likeliest rows at an end of the record, or amid it, in which images and poses are apart.

    By rows.
    """
    count = len(record.rows)
    behind = np.arange(count) >= np.arange(count)[:, None]
    ends = np.concatenate([behind, ~behind[FEWEST_VIEWS:]])
    orders = [record.paired(order(len(record.views))) for order in ROW_ORDERS.values()]
    found = list[tuple[float, int, Mask]]()
    for edges in every:
        squares = {by: edges.of(pair) for by, pair in pairs.items()}
        for by in [*pairs][1:]:
            amid = _apart_amid(record, squares[0], squares[by], by)
            sides = np.concatenate([ends, amid])
            mixed = np.where(sides[..., None], squares[by], squares[0])
            # A pose is of one image: those of rows that stay are their own.
            first = record.rows[sides.argmax(axis=1), None]
            last = record.rows[-1 - sides[:, ::-1].argmax(axis=1), None]
            partnered = sides & (pairs[by] >= first) & (pairs[by] <= last)
            mixed[sides & ~partnered] = np.inf
            logs, agrees = evidence(mixed)
            # Both ends are a free choice.
            logs[len(ends) :] -= float(np.log(count)) / EVIDENCE
            # Of several runs that are apart, one at a time explains its own views.
            explained = np.sum(agrees & partnered, axis=1)
            explains = explained >= np.maximum(2.0, 0.6 * partnered.sum(axis=1))
            # A view that no run explains is in none.
            at = int(np.where(explains, logs - LEAST * sides.sum(axis=1), -np.inf).argmax())
            if explains[at] and mixed[at][agrees[at]].mean() < CLOSING_SCORE**2:
                found.append((float(logs[at]), by, sides[at]))
        # Other orders of the rows are readings of the whole recording.
        for order in orders:
            rival = edges.of(order)
            found.append((float(evidence(rival[None])[0][0]), 0, behind[0]))
    log, by, side = max(found, key=lambda item: item[0])
    if not by:
        return
    # One row, in all views, is a reading of the whole recording, which is tried of images.
    if side.all() and abs(by) == 1 and record.shows == "image":
        return
    views = record.views[record.rows[side]].tolist()
    first, last = views[0], views[-1]
    apart = counted(abs(by), "row")
    rows = f"{apart} {'later' if by > 0 else 'earlier'}"
    when = f"From view {first} on" if side[-1] else f"Up to view {last}"
    when = when if side[-1] or side[0] else f"From view {first} to view {last}"
    when, left = ("In all views", "") if side.all() else (when, " They were left out.")
    # A pose is of one image.
    partners = set(record.rows[side].tolist())
    both = zip(views, pairs[by][side].tolist(), strict=True)
    lost = [str(view) for view, pair in both if pair not in partners]
    dropped = f" No row is left for view {some_of(lost)}." if lost else ""
    yield Undoing(
        EVIDENCE * (log - base) + _MISTAKE - float(np.log(2.0 * count * len(_SHIFTS))),
        Finding(
            "shifted_rows",
            f"{when}, {record.shows}s and poses are {apart} apart: the {record.shows} of each row "
            f"belongs to the robot's pose {rows}.{left}{dropped}",
            mending("each has its own pose", f"--shift {first}-{last}:{by}"),
            tuple(views),
        ),
        f"its {record.shows} belongs to the robot's pose {rows}",
    )


def _apart_amid(record: Record, own: FloatArray, other: FloatArray, by: int) -> Mask:
    """(2, m) the run of views that other poses explain best, and with those whose pose these have.

    Args:
        record: The record.
        own: (m, 2) squares by the poses of their own rows.
        other: The same by those of the rows apart.
        by: By how many rows.
    """
    here, there = (np.where(np.isfinite(at), at, 1.0).sum(axis=1) for at in (own, other))
    gains = np.log((here + LEAST**2) / (there + LEAST**2))
    # A view that neither explains ends the run.
    sums = np.append(0.0, np.cumsum(np.clip(gains, *_CLIPPED) - 1.0))
    last = int(np.argmax(sums - np.minimum.accumulate(sums)))
    rows = record.rows[int(np.argmin(sums[: last + 1])) : last]
    if not len(rows):
        return np.zeros((2, len(own)), dtype=bool)
    first, last = rows[0] + np.array([[0], [min(by, 0)]]), rows[-1] + np.array([[0], [max(by, 0)]])
    return np.asarray((record.rows >= first) & (record.rows <= last))

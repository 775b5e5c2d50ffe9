"""Mistakes of rows of the record: copies, signs, units and orders, with what they explain."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from visioncal.calibration.guess.fit import CLOSING_SCORE
from visioncal.calibration.guess.readings import ROW_ORDERS
from visioncal.calibration.guess.recording import EVIDENCE
from visioncal.calibration.suspects.record import LEAST, Edges, Record, evidence
from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.number_format import counted, some_of, view_words
from visioncal.core.transforms import apply, compose, exp, invert, robot_part, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.core.verdict import Finding, Option, mending, or_alone

# Rows that images and poses are apart, from none on: some lost or doubled pictures.
SHIFTS = (0, *(sign * by for by in range(1, 7) for sign in (1, -1)))
# Of more views, fewer rows apart are tried: each takes as long as the fit.
MANY, FEW_APART = 200, 3
# The prior of a mistake of the record; the probability that a robot reports one pose twice to the
# last digit though it moved.
MISTAKE, _EQUAL = float(np.log(0.01)), 1e-4
# A turn of a board differs by less from a quarter or half one, and one of a picture whose lens has
# its centre off the middle [rad].
_NEAR_RAD, NEAR_TURN_RAD = 0.1, 0.3
# Of so few views, one that is wrong bends the fit of all.
FEW_VIEWS = 7
# Views are alike within so many medians; log-ratios of squares count as one so clear at most.
UNEVEN = 7.0
_CLIPPED = -2.0 * float(np.log(UNEVEN)), 2.0 * float(np.log(UNEVEN))
# A flange is nearer to the base than this, and farther from its origin [m]; other positions are in
# another unit.
_FARTHEST_M, _NEAREST_M = 20.0, 0.01
# The same for inches among metres, and for inches that were read as millimetres.
_INCHES_M = 3.0, 0.1


@dataclass(frozen=True, eq=False)
class Undoing:
    """A mistake of the record that explains views."""

    odds: float  # Its log odds against views that are wrong for no known reason.
    found: Finding  # The finding; its views are left out.
    short: str  # The same as a clause, for each of the views.
    quarters: int = 0  # By how many the views' pictures are turned clockwise.


def left_out(odds: float, short: str, how: Finding) -> Undoing:
    """A mistake of views that are left out, in short, and a finding on how it is one."""
    words = f"In {view_words(how.views)} {short}{how.words} They were left out."
    return Undoing(odds, replace(how, words=words), short)


def copied_rows(
    record: Record, edges: Edges, apart: FloatArray, paired: IntArray, agrees: Mask
) -> Iterator[Undoing]:
    """Poses of the robot, or of the target, that occur twice though the other one moved."""
    closes = apart[agrees].mean() < CLOSING_SCORE**2
    anew, digit = "Record them anew", "to the last digit"
    seen = (
        record.lingering,
        "the target's pose" if record.shows == "image" else "the reading",
        f"{digit}, though the robot moved: the last that was seen lingered",
        anew,
    )
    if record.is_numbered:
        seen = (
            _shown_before(record, edges, apart, agrees),
            "the picture",
            "to within the noise, though the robot moved: the camera gave what it had taken "
            "before, as from a buffer",
            f"Have the camera drop what it holds before each picture. {anew}",
        )
    log = f"the {record.shows}s differ: the log repeated a pose that was read before"
    for copies, pose, but, do in (
        (record.copies, "the robot's pose", f"{digit}, though {log}", anew),
        seen,
    ):
        copied = copies & ~agrees & (paired >= 0)
        if not copied.any() or not closes:
            continue
        # Where the robot stands still between views, equal poses say little.
        chance = max(float((copies & agrees).mean()), _EQUAL)
        views = tuple(record.views[record.rows[copied]].tolist())
        others = record.views[record.rows[~copied]].tolist()
        subject = f"{view_words(views).capitalize()} {'have' if len(views) > 1 else 'has'}"
        yield Undoing(
            MISTAKE - len(views) * float(np.log(chance)),
            Finding(
                "copied_poses",
                f"{subject} {pose} of the row before once more, {but}. Left out.",
                or_alone(f"{do}, or calibrate the other views alone.", others),
                views,
            ),
            f"{pose} is that of the row before, once more",
        )


def _shown_before(record: Record, edges: Edges, apart: FloatArray, agrees: Mask) -> Mask:
    """(m,) views that show what the last one that agrees shows, as all views between them do."""
    order = np.arange(len(agrees))
    # Of views in turn, small motions would add up.
    last = np.append(-1, np.maximum.accumulate(np.where(agrees, order, -1))[:-1])
    between = edges.squares(invert(record.camera[last, :1]) @ record.camera)
    limits = UNEVEN**2 * (np.median(apart[agrees], axis=0) + LEAST**2)
    alike = np.asarray((last >= 0) & (between < limits).all(axis=-1).any(axis=-1))
    for at in np.flatnonzero(last < order - 1):
        alike[at] &= alike[at - 1]
    return alike


def chosen_views(
    paired: IntArray, apart: FloatArray, other: FloatArray, base: float
) -> tuple[float, Mask]:
    """Log odds that some views are otherwise, with other squares (m, 2), and the views (m,).

    Any number of views is as likely, and any choice: the change helps those most that are chosen.
    """
    after, before = (np.where(paired < 0, 1.0, at.sum(axis=1)) for at in (other, apart))
    order = np.argsort((after + LEAST**2) / (before + LEAST**2), kind="stable")
    number = np.arange(1, len(paired) + 1)
    some = np.argsort(order) < number[:, None]
    squares = np.where(some[..., None], other, apart)
    logs, agrees = evidence(squares)
    choices = gammaln(len(paired) + 2) - gammaln(number + 1) - gammaln(len(paired) - number + 1)
    odds = EVIDENCE * (logs - base) + MISTAKE - choices
    at = int(odds.argmax())
    closes = squares[at][agrees[at]].mean() < CLOSING_SCORE**2
    return float(odds[at]), some[at] & agrees[at] & closes


def other_signs(
    record: Record, edges: Edges, paired: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Views whose position lost the sign of one axis."""
    for axis, name in enumerate("xyz"):
        flanges = robot_part(record.robot, record.mount).copy()
        flanges[:, axis, 3] *= -1.0
        signed = replace(record, robot=robot_part(flanges, record.mount))
        odds, wrong = chosen_views(paired, apart, replace(edges, record=signed).of(paired), base)
        views = tuple(record.views[record.rows[wrong]].tolist())
        if not views:
            continue
        short = f"{name} of the robot's position has the other sign"
        axes = ",".join(f"-{each}" if each == name else each for each in "xyz")
        do = mending("it has its own", Option("positions", axes, views))
        how = Finding("lost_sign", ": with its own, they agree with the others.", do, views)
        yield left_out(odds - float(np.log(3.0)), short, how)


def mixed_unit_rows(record: Record, paired: IntArray, base: float) -> Iterator[Undoing]:
    """Views whose position is in millimetres or inches where the others' are in metres, or so.

    The sizes of the positions, or of one axis, tell the rows of either unit, however many they are.
    """
    flanges = robot_part(record.robot, record.mount)
    sizes_m, large = np.linalg.norm(flanges[:, :3, 3], axis=1), "a thousand times as large"
    single = ((1e-3, np.abs(flanges[:, at, 3]) > _FARTHEST_M, large, "xyz"[at]) for at in range(3))
    for factor, wrong, unit, part in (
        (1e-3, sizes_m > _FARTHEST_M, large, "xyz"),
        (1e3, sizes_m < _NEAREST_M, "a thousandth as large", "xyz"),
        (0.0254, sizes_m > _INCHES_M[0], "39.37 times as large (inches)", "xyz"),
        (25.4, sizes_m < _INCHES_M[1], "25.4 times smaller (inches among millimetres)", "xyz"),
        *single,
    ):
        is_scaled = wrong[:, None] & np.array([name in part for name in "xyz"])
        scaled = compose(flanges[:, :3, :3], flanges[:, :3, 3] * np.where(is_scaled, factor, 1.0))
        log = _of_changed(record, paired, wrong, scaled)
        if log is None:
            continue
        views = tuple(record.views[record.rows[wrong[paired] & (paired >= 0)]].tolist())
        subject = "the robot's position" if part == "xyz" else f"{part} of the robot's position"
        short = f"{subject} is {unit} as in the others, as where it is in another unit"
        axes = ",".join(f"{factor:g}*{at}_m" if at in part else at for at in "xyz")
        do = mending("all have one unit", Option("positions", axes, views))
        how = Finding("mixed_units", ": in the same one, they agree with the others.", do, views)
        yield left_out(EVIDENCE * float(log - base) + MISTAKE, short, how)


def _of_changed(record: Record, paired: IntArray, wrong: Mask, flanges: FloatArray) -> float | None:
    """Log evidence of other poses of the robot in (n,) some rows; None where most disagree."""
    rows = wrong[paired] & (paired >= 0)
    if np.sum(rows) < 1 or np.sum(~rows & (paired >= 0)) < 1:
        return None
    edges = Edges.by(replace(record, robot=robot_part(flanges, record.mount)), paired, paired >= 0)
    if edges is None:
        return None
    squares = edges.of(paired)
    (log,), (agrees,) = evidence(squares[None])
    is_close = squares[agrees].mean() < CLOSING_SCORE**2
    return float(log) if is_close and np.sum(agrees & rows) > 0.6 * np.sum(rows) else None


def mixed_angle_rows(record: Record, paired: IntArray, base: float) -> Iterator[Undoing]:
    """Views whose angles are in radians where the others' are in degrees.

    Read as degrees, such angles are of a robot that hardly turns.
    """
    flanges = robot_part(record.robot, record.mount)
    angles = np.where(np.isfinite(flanges[:, 0, 0]), rotation_angle(flanges), np.inf)
    wrong = angles < np.deg2rad(np.pi * np.sqrt(3.0))
    if not wrong.any() or wrong[paired].all():
        return
    turned = flanges.copy()
    for form in (
        "rotation-vector",
        *(f"euler-{each}-rad" for each in ("ZYX", "xyz", "ZYZ", "XYZ")),
    ):
        numbers = ROTATION_FORMS[f"{form.removesuffix('-rad')}-deg"].write(flanges[wrong, :3, :3])
        turned[wrong, :3, :3] = ROTATION_FORMS[form].read(numbers)
        log = _of_changed(record, paired, wrong, turned)
        if log is None:
            continue
        rows = wrong[paired] & (paired >= 0)
        views = tuple(record.views[record.rows[rows]].tolist())
        short = "the robot's angles are in radians, and were taken for degrees"
        do = or_alone(
            "In the log, write their angles in degrees (times 57.29578) as the others' are, and "
            "convert it anew; or calibrate the other views alone.",
            record.views[record.rows[~rows]].tolist(),
        )
        how = Finding("mixed_units", ": in the same unit, they agree with the others.", do, views)
        yield left_out(EVIDENCE * float(log - base) + MISTAKE, short, how)


def turned_rows(
    record: Record, edges: Edges, paired: IntArray, apart: FloatArray, base: float
) -> Iterator[Undoing]:
    """Boards that were read as if they were turned in their plane, or some squares on in it."""
    known = np.flatnonzero(paired >= 0)
    turned = edges.turned(paired)
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
        (log,), (agrees,) = evidence(squares[None])
        wrong = near[agrees[near]]
        if not len(wrong) or squares[agrees].mean() > CLOSING_SCORE**2:
            continue
        # The middle is known by these views themselves, in two directions of their six.
        noise = float(np.sqrt(squares[agrees, 0].mean() / 3.0 + LEAST**2))
        odds = EVIDENCE * (float(log - base) - 2.0 * float(np.log(2.0 / noise)))
        odds += MISTAKE - float(np.log(4.0))
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
        do = mending(back, Option("turned", about, views))
        yield left_out(odds, short, Finding("turned_board", f" {where} {point}.", do, views))


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


def rows_apart(
    record: Record, every: list[Edges], pairs: dict[int, IntArray], base: float
) -> Iterator[Undoing]:
    """The likeliest rows at an end of the record, or amid it, in which images and poses are apart.

    By rows.
    """
    count = len(record.rows)
    behind = np.arange(count) >= np.arange(count)[:, None]
    ends = np.concatenate([behind, ~behind[FEWEST_VIEWS:]])
    orders = np.array([record.paired(order(len(record.views))) for order in ROW_ORDERS.values()])
    found = list[tuple[float, int, Mask]]()
    for edges in every:
        squares = dict(zip(pairs, edges.of(np.array([*pairs.values()])), strict=True))
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
        found += [(log, 0, behind[0]) for log in evidence(edges.of(orders))[0].tolist()]
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
    partners = range(record.rows[side][0], record.rows[side][-1] + 1)
    view_pairs = zip(views, pairs[by][side].tolist(), strict=True)
    lost = [str(view) for view, pair in view_pairs if pair not in partners]
    dropped = f" No row is left for view {some_of(lost)}." if lost else ""
    yield Undoing(
        EVIDENCE * (log - base) + MISTAKE - float(np.log(2.0 * count * len(SHIFTS))),
        Finding(
            "shifted_rows",
            f"{when}, {record.shows}s and poses are {apart} apart: the {record.shows} of each row "
            f"belongs to the robot's pose {rows}.{left}{dropped}",
            mending("each has its own pose", Option("shift", f"{by}", (*range(first, last + 1),))),
            tuple(views),
        ),
        f"its {record.shows} belongs to the robot's pose {rows}",
    )


def _apart_amid(record: Record, stated: FloatArray, other: FloatArray, by: int) -> Mask:
    """(2, m) the run of views that other poses explain best, and with those whose pose these have.

    Args:
        record: The record.
        stated: (m, 2) squares by the poses of the views' rows.
        other: The same by those of the rows apart.
        by: By how many rows.
    """
    before, after = (np.where(np.isfinite(at), at, 1.0).sum(axis=1) for at in (stated, other))
    gains = np.log((before + LEAST**2) / (after + LEAST**2))
    # A view that neither pose explains ends the run.
    sums = np.append(0.0, np.cumsum(np.clip(gains, *_CLIPPED) - 1.0))
    last = int(np.argmax(sums - np.minimum.accumulate(sums)))
    rows = record.rows[int(np.argmin(sums[: last + 1])) : last]
    if not len(rows):
        return np.zeros((2, len(stated)), dtype=bool)
    first, last = rows[0] + np.array([[0], [min(by, 0)]]), rows[-1] + np.array([[0], [max(by, 0)]])
    return np.asarray((record.rows >= first) & (record.rows <= last))

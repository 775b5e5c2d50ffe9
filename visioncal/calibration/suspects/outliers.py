"""Messages on outliers and moved frames: exchanged or wrong observations, by cause."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np

from visioncal.calibration.stages.cell_fit import OTHER_POSTURE, CellFit
from visioncal.calibration.stages.exchanged_rows import exchanged, other_names, other_stops
from visioncal.calibration.stages.validate import pose_residuals
from visioncal.core.limits import CLEAR_RATIO, FEWEST_STOPS, FEWEST_VIEWS, CalibrationLimits
from visioncal.core.number_format import figure, listed, mm_and_deg, ranges, some_of, view_words
from visioncal.core.transforms import (
    exp,
    invert,
    log,
    pose_difference,
    rotation_angle,
)
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy, mending, or_alone
from visioncal.estimation.arm import LEVER_M, TWIST_UNITS
from visioncal.estimation.moves import find_push, observations_over
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.steps import step_of
from visioncal.results import Moved
from visioncal.robot import Robot
from visioncal.session.frames import frame_name, object_name
from visioncal.vision.targets import rotation_transforms

# Kinds of findings, which others name.
EXCHANGED, MISNAMED = "exchanged_views", "misnamed_rows"
# Rows that no chance has fit another name.
_FEWEST_MISNAMED = 2
_EXCHANGE = Remedy("Exchange these rows in views.csv, and calibrate again.", CALIBRATE)
# Views among many outliers of one end that agree by chance, one of so many; what a step that few
# times exceeds the noise leaves of these, and poses that are wrong apart never do.
_BY_CHANCE, _AT_END = 4, 0.6
# Probability below which outliers that are all views of one end are so by no chance.
_ONE_END = 1e-3
_WRONG = "its pose or its reading is wrong, or something had moved"
# An arm's errors have longer tails than noise: views within so many times the limit of outliers, at
# most one to so many that agree, are no mistakes where arms err by as much.
_MARGIN, _MARGINAL_SHARE = 1.5, 10
# By as much an industrial arm may err [mm, deg]; one that states what it repeats to, by so many.
_ARM_ERRS, _REPEATS = CalibrationLimits.arm_errors, 6.0
# A knock moves what is fastened by less [mm, deg].
_KNOCKED = 20.0, 5.0
# Of views before or after a frame of the controller was switched.
OF_OTHER_FRAMES = ": their result is for the tool and the base frame that were active there"
# Another size turns nothing, and a small marker's noise less than so [rad].
_TURNED_RAD = 0.2
# Largest share of the way to another stop at which an arm is, and least share of outliers for which
# that holds: one in hundreds is along that line by chance.
_ON_THE_WAY, _MOST_ON_THE_WAY = 0.4, 0.6
IN_MOTION = Remedy(
    "Wait until the arm stands still before each image, and log the measured pose then; or record "
    "times of images and of a stream of poses (stamp_s, streams): then the delay is estimated."
)
# Errors of an arm as a twist [rad].
_ARM_LEAVES = float(np.hypot(1e-3 * _ARM_ERRS[0] / LEVER_M, np.deg2rad(_ARM_ERRS[1])))


@dataclass(frozen=True)
class PoseFault:
    """A fault of poses or images that explains outliers."""

    found: Finding  # The finding.
    rows: tuple[int, ...]  # The observations that it explains.
    short: str = ""  # The fault as a clause, for each of these; empty where the finding suffices.


def versions(cell_fit: CellFit) -> dict[str, str]:
    """Names in the result of all unknown frames over time, by their names in the problem.

    Where a frame was at the end of the session, it has its own name.
    """
    names = {}
    for frame, parts in _parts(cell_fit).items():
        for _, key in parts[:-1]:
            names[key] = f"{frame}_until_stop_{_stops_of(cell_fit, key)[-1]}"
        names[parts[-1][1]] = frame
    return names


def _parts(cell_fit: CellFit) -> dict[str, list[tuple[int, str]]]:
    """First station and name in the problem of each place of each frame, in the order of time."""
    starts = {move.twin: move.stop for move in cell_fit.inlier_fit.moves}
    parts: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for key in cell_fit.inlier_fit.problem.unknown:
        parts[key.partition("@")[0]].append((starts.get(key, -1), key))
    return {frame: sorted(keys) for frame, keys in parts.items()}


def _stops_of(cell_fit: CellFit, key: str) -> list[int]:
    """The stops of a frame's inliers, in order of time; of all its observations if it has none."""
    observations = cell_fit.inlier_fit.problem.observations
    rows = observations.involves(key)
    used = rows & cell_fit.inlier_fit.used
    stations = observations.stops[used if used.any() else rows]
    return [cell_fit.cell.stops[station] for station in np.unique(stations).tolist()]


def movements(cell_fit: CellFit) -> tuple[Moved, ...]:
    """The frames that moved, in the order of time."""
    named, edges, moved = versions(cell_fit), cell_fit.fit.frames, list[tuple[int, Moved]]()
    for frame, parts in _parts(cell_fit).items():
        for (_, before), (start, after) in pairwise(parts):
            last, first = _stops_of(cell_fit, before)[-1], _stops_of(cell_fit, after)[0]
            away = pose_difference(edges[before], edges[after])
            moved.append((start, Moved(frame, named[before], last, first, *away)))
    return tuple(move for _, move in sorted(moved, key=lambda item: item[0]))


def explained_outliers(
    cell_fit: CellFit,
) -> tuple[tuple[PoseFault, ...], dict[int, str], frozenset[int]]:
    """Faults that explain outliers, the reason why each view is left out, and the marginal ones.

    Exchanged or wrong poses, and what moved; else the stops that a view fits instead of its own.
    """
    outliers, agreed = np.flatnonzero(~cell_fit.inlier_fit.used), cell_fit.inlier_fit
    if not len(outliers):
        return (), {}, frozenset()
    turns = {
        frame_name("target", name): rotation_transforms(target)
        for name, target in cell_fit.cell.session.boards.items()
    }
    fitting = other_stops(agreed.problem, agreed.fit, outliers, agreed.moves, turns)
    circles = exchanged(agreed.problem, fitting)
    faults = [*_exchanged(cell_fit, circles)]
    if cell_fit.cell.mount is not None and not faults:
        # One change of a frame explains a push along the motion, too.
        alike = _end_run(cell_fit).change or _common_change(
            agreed, outliers, 1.0 / CLEAR_RATIO, _ARM_LEAVES
        )
        on_the_way = [*_in_motion(cell_fit, outliers)] if alike is None else []
        faults += on_the_way or _moved_run(cell_fit)
    if cell_fit.cell.mount is None and not faults:
        faults += [*_misnamed(cell_fit, outliers)] or _pushed_base(cell_fit)
    clauses = {row: fault.short for fault in faults if fault.short for row in fault.rows}
    causes = {at: _cause(cell_fit, at, fitting, circles) for at in outliers.tolist()} | clauses
    return tuple(faults), *_reasons(cell_fit, causes)


def _fault(
    cell_fit: CellFit, kind: str, rows: Sequence[int], words: str, do: Remedy, short: str = ""
) -> PoseFault:
    """A fault of some observations, in words in which {views} are theirs."""
    views = tuple(cell_fit.cell.rows[row].view for row in rows)
    words = words.format(views=view_words(views))
    found = Finding(kind, f"{words[0].upper()}{words[1:]}", do, views)
    return PoseFault(found, tuple(rows), short)


def _in_motion(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers at which the arm was on its way from the last stop, or to the next one."""
    inliers, part = cell_fit.inlier_fit, cell_fit.inlier_fit.problem
    (poses, *others), stops = part.poses.values(), part.observations.stops[outliers]
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    linear = part.linear(inliers.fit.state)
    noise = part.total_covariance(linear, inliers.fit.noise)[outliers]
    if others or len(outliers) < FEWEST_VIEWS or not noise.any():
        return
    residuals, by_flange = linear.residuals[outliers], linear.by_flanges[outliers]
    at, found = np.searchsorted(known, stops), list[tuple[int, bool, IntArray, FloatArray]]()
    for by in (-1, 1):
        other = known[np.clip(at + by, 0, len(known) - 1)]
        ways = log(invert(poses[stops]) @ poses[other])
        # Most programs have a tool move along a line.
        ways[:, 3:] = np.einsum(
            "nji,nj->ni", poses[stops][:, :3, :3], poses[other][:, :3, 3] - poses[stops][:, :3, 3]
        )
        moved = (by_flange @ ways[:, :, None])[:, :, 0]
        white = np.linalg.solve(noise, np.stack([residuals, moved], axis=2))
        before, cross, square = (
            np.einsum("ni,ni->n", *pair)
            for pair in (
                (residuals, white[:, :, 0]),
                (moved, white[:, :, 0]),
                (moved, white[:, :, 1]),
            )
        )
        shares = -cross / np.maximum(square, np.finfo(float).tiny)
        left = before - shares**2 * square
        explained = (CLEAR_RATIO**2 * left < before) & (np.abs(shares) < _ON_THE_WAY)
        for is_beyond in (False, True):
            rows = np.flatnonzero(explained & ((shares < 0.0) == is_beyond))
            found.append((by, is_beyond, rows, np.abs(shares[rows])))
    by, is_beyond, rows, shares = max(found, key=lambda item: len(item[2]))
    if len(rows) < max(FEWEST_VIEWS, _MOST_ON_THE_WAY * len(outliers)):
        return
    which = "last" if by < 0 else "next"
    when = {
        (
            -1,
            False,
        ): "the image was taken before the arm had arrived, as of commanded poses",
        (-1, True): "the pose was read before the arm had arrived",
        (1, False): "the image was taken once the arm had left",
        (1, True): "the pose was read once the arm had left",
    }[by, is_beyond]
    low, high = (figure(100.0 * float(share)) for share in (shares.min(), shares.max()))
    how = f"by {low}{f' to {high}' * (low != high)} % of the way to the {which} stop"
    short = f"the arm moved between image and pose, {how}"
    words = f"{{views}} were left out: {short}, along the line between both: {when}."
    yield _fault(cell_fit, "something_moved", outliers[rows].tolist(), words, IN_MOTION, short)


@dataclass(frozen=True, eq=False)
class _EndRun:
    """Outliers that are the views at one end of the session."""

    rows: IntArray  # The outliers there.
    order: IntArray  # (n,) all observations in the order of their stops.
    at: int  # Place among these of the first observation after the change.
    is_first: bool  # Whether it is the end before.
    change: tuple[str, FloatArray] | None  # Common to these; see `_common_change`.

    @property
    def later(self) -> IntArray:
        """Observations after the change, in the session's order."""
        return np.sort(self.order[self.at :])

    @property
    def is_whole(self) -> bool:
        """Whether all views of this end are out."""
        return len(self.rows) == (self.at if self.is_first else len(self.order) - self.at)


def _end_run(cell_fit: CellFit) -> _EndRun:
    inliers = cell_fit.inlier_fit
    order = np.argsort(inliers.problem.observations.stops, kind="stable")
    is_used = inliers.used[order]
    ends = np.append(0, np.cumsum(np.where(is_used, -_BY_CHANCE, 1)))
    first, last = int(ends.argmin()), int(ends.argmax())
    before, after = order[:last][~is_used[:last]], order[first:][~is_used[first:]]
    is_first = len(before) > len(after)
    run, at = (before, last) if is_first else (after, first)
    most = _AT_END if len(run) > FEWEST_VIEWS else 1.0 / CLEAR_RATIO
    change = _common_change(inliers, run, most) if len(run) >= FEWEST_VIEWS else None
    return _EndRun(run, order, at, is_first, change)


def views_apart(cell_fit: CellFit) -> frozenset[int]:
    """Views of one end of the session of which camera, target or a frame was another one."""
    if cell_fit.cell.mount is None or cell_fit.inlier_fit.used.all():
        return frozenset()
    run = _end_run(cell_fit)
    if run.change is None:
        return frozenset()
    return frozenset(cell_fit.cell.rows[row].view for row in run.rows.tolist())


def _moved_run(cell_fit: CellFit) -> Iterator[PoseFault]:
    """Outliers that are the views at one end of the session and agree, as where something moved."""
    inliers, rows, found = cell_fit.inlier_fit, cell_fit.cell.rows, _end_run(cell_fit)
    run, change, order = found.rows, found.change, found.order
    is_used = inliers.used[order]
    words = "Fasten camera and target, keep one board, and one tool and base frame in the "
    words += "controller, and record again"
    if cell_fit.cell.mount == "instrument":
        words = "Leave the instrument where it stands and one probe in one nest, and record again"
    if len(run) == np.sum(~is_used) and found.is_whole:
        # All views of one end and no others: by another pose of each, that is hardly chance.
        by_chance = 2.0 * len(order) / math.comb(len(order), len(run))
        change = change or (("", np.eye(4)) if by_chance < _ONE_END else None)
    if change is not None:
        # Picks come after the session.
        later = [rows[row].view for row in found.later.tolist()]
        when = f"{'before' if found.is_first else 'from'} view {rows[int(order[found.at])].view}"
        when += " on" * (not found.is_first)
        which = "from there on" if found.is_first else "before"
        kept = f" The result is that of the views {which}."
        words += f"; or calibrate the {len(later)} views from there on alone"
        is_far = pose_difference(np.eye(4), change[1])[0] > _ARM_ERRS[0]
        note = OF_OTHER_FRAMES * is_far
        do = or_alone(f"{words}{note}.", later)
        if is_switched(change[1]):
            these = [rows[row].view for row in np.sort(run).tolist()]
            otherwise = f"{words[0].lower()}{words[1:]} (--views {ranges(later)}){note}."
            do = _tool_taken_off(cell_fit, change, these, otherwise) or do
    else:
        # Views here and there, as of every second row.
        run, when = order[~is_used], "in all of these"
        most = 1.0 / CLEAR_RATIO
        if len(run) < FEWEST_VIEWS:
            return
        # Of views here and there, wrong poses alike by chance are no frame.
        if (change := _common_change(inliers, run, most, _ARM_LEAVES)) is None:
            return
        run, change = _alike(inliers, np.sort(run), *change)
        some = [rows[row].view for row in run.tolist()]
        words += ". The result is that of the other views; calibrate these alone, too."
        otherwise = "the result is that of the other views."
        do = _tool_taken_off(cell_fit, change, some, otherwise) or or_alone(words, some)
        kept = ""
    what, how = _changed_words(cell_fit, *change)
    outliers = np.sort(run).tolist()
    if cell_fit.may_be_of_arms(change[1]):
        how += OTHER_POSTURE
    elif change[0] and np.less(pose_difference(np.eye(4), change[1]), _ARM_ERRS).all():
        how += ", or another load bends the arm"
    words = f"{{views}} were left out: {when}, {what} was another one{how}.{kept}"
    yield _fault(cell_fit, "something_moved", outliers, words, do, f"{when}, something had moved")


def _misnamed(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers that fit where their camera or their target has the name of another one."""
    inliers, rows = cell_fit.inlier_fit, cell_fit.cell.rows
    found = other_names(inliers.problem, inliers.fit, outliers, inliers.moves)
    by_names = defaultdict[tuple[str, str], list[int]](list)
    for at, names in found.items():
        own = rows[at].seer, rows[at].seen
        side = int(own[0].partition("@")[0] == names[0])
        by_names[own[side].partition("@")[0], names[side]].append(at)
    several = {names: some for names, some in by_names.items() if len(some) >= _FEWEST_MISNAMED}
    if not several:
        return
    every, edits = sorted(chain.from_iterable(several.values())), list[str]()
    for (stated, other), some in several.items():
        views = [rows[at].view for at in some]
        column = "camera" if stated.startswith("cam") else stated.partition("_")[0]
        edits.append(
            f"{object_name(other, column)} for {object_name(stated, column)} in column {column} of "
            f"{view_words(views)}"
        )
    named = listed([f"{other} in place of {stated}" for stated, other in several])
    short = "the name of its camera or of its target is another one's"
    words = f"{{views}} were left out: they fit with {named}, as rows with exchanged names do."
    do = Remedy(f"In views.csv, write {listed(edits)}, and calibrate again.", CALIBRATE)
    yield _fault(cell_fit, MISNAMED, every, words, do, short)


def _pushed_base(cell_fit: CellFit) -> Iterator[PoseFault]:
    """Outliers from some stop on that agree on one other pose of a robot's base."""
    inliers, cell = cell_fit.inlier_fit, cell_fit.cell
    push = find_push(inliers.problem, inliers.fit, inliers.used)
    if push is None:
        return
    (base, stop, change), stops = push, inliers.problem.observations.stops
    is_over = observations_over(inliers.problem, inliers.fit, base)
    out = np.flatnonzero(is_over & ~inliers.used & (stops >= stop))
    last = cell.stops[stops[is_over & (stops < stop)].max()]
    moved = mm_and_deg(*pose_difference(np.eye(4), exp(change)))
    words = (
        f"between stops {last} and {cell.stops[stop]}, {base} moved by {moved}. The result has it "
        "where it stood first: {views}, later, were left out."
    )
    do = cell.or_separately(f"Fasten {base}", stop)
    yield _fault(cell_fit, "something_moved", out.tolist(), words, do, f"{base} had moved")


def _tool_taken_off(
    cell_fit: CellFit, change: tuple[str, FloatArray], views: Sequence[int], otherwise: str
) -> Remedy | None:
    """Advice by a change that some views have in common; see `tool_taken_off`."""
    frame, step = change
    if not frame:
        return None
    edge = cell_fit.fit.frames[frame]
    return tool_taken_off(cell_fit, frame, (edge, edge @ step), views, otherwise)


def tool_taken_off(
    cell_fit: CellFit,
    frame: str,
    edges: tuple[FloatArray, FloatArray],
    views: Sequence[int],
    otherwise: str,
) -> Remedy | None:
    """Advice to take a tool off some views' poses; None where another frame was another one.

    Args:
        cell_fit: The fit.
        frame: The frame that was another one in these views.
        edges: What it is in the other views, and in these.
        views: The views.
        otherwise: What to do where no tool was active.
    """
    on_camera = "cam" if cell_fit.cell.mount == "eye-in-hand" else "target"
    # Joint angles that belong to the poses rule a tool out.
    has_joints = any(arm.matched is not None for arm in cell_fit.arms.values())
    mount = cell_fit.cell.mount
    if has_joints or not frame.startswith(on_camera) or mount in (None, "instrument"):
        return None
    tool = edges[0] @ invert(edges[1])
    twist = *(1e3 * tool[:3, 3]), *np.rad2deg(log(tool)[:3])
    numbers = ",".join(f"{value:.4f}" for value in twist)
    done = mending("it is taken off their poses", f"--without-tool {ranges(views)}:{numbers}")
    first = f"Look whether a tool was active there. If so, {done.words[0].lower()}{done.words[1:]}"
    return replace(done, words=f"{first} Else {otherwise}")


def is_switched(step: FloatArray) -> bool:
    """Whether a frame of the controller is likelier another one than that something was knocked.

    A knock moves what is fastened by millimetres.
    """
    return bool(np.greater(pose_difference(np.eye(4), step), _KNOCKED).any())


def _changed_words(cell_fit: CellFit, frame: str, step: FloatArray) -> tuple[str, str]:
    """The frame that moved from some view on, and by how much, in words."""
    if not frame:
        known = any(arm.matched is not None for arm in cell_fit.arms.values())
        joint = ", or the zero of a joint," if known else ""
        moved = mm_and_deg(*pose_difference(np.eye(4), step))
        how = f": by about {moved}" if np.any(step != np.eye(4)) else ""
        return f"the camera, the target or a frame of the controller{joint}", how
    thing, edge = ("camera" if frame.startswith("cam") else "target"), cell_fit.fit.frames[frame]
    on_flange = (cell_fit.cell.mount == "eye-in-hand") == (thing == "camera")
    if cell_fit.cell.mount == "instrument":
        on_flange = not frame.startswith("instrument")
        thing = "probe" if on_flange else "instrument"
    of_robot = f"controller's {'tool' if on_flange else 'base frame'}"
    mm, deg = pose_difference(np.eye(4), step)
    moved = mm_and_deg(mm, deg) if deg else f"{figure(mm)} mm"
    how = f": the {thing} by {moved}, or the {of_robot} by {other_frame(edge, edge @ step)}"
    return f"the {thing} or the {of_robot}", how


def other_frame(before: FloatArray, after: FloatArray) -> str:
    """Where poses of another tool, or in another frame, have it: an edge is another one by it."""
    other = before @ invert(after)
    x, y, z = (figure(1e3 * part) for part in other[:3, 3].tolist())
    return f"({x}, {y}, {z}) mm and {figure(pose_difference(np.eye(4), other)[1])} deg"


def _common_change(
    inliers: InlierFit, rows: IntArray, most: float, leaves: float = np.inf
) -> tuple[str, FloatArray] | None:
    """The frame whose step explains most of some outliers, and the step; None where none does.

    It leaves a third of them; up to `most`, as a share, where that is as much as others scatter by;
    and no more than `leaves` [rad], or than others scatter by.

    Its name is empty where another size of the target does, or steps of several frames alike. Rows
    with other poses, or of other images, have none in common.
    """
    some, state = np.isin(np.arange(len(inliers.problem)), rows), inliers.fit.state
    part, others = inliers.problem.subset(some), inliers.part
    are_places = not part.observations.has_rotation.all()
    if are_places and len(part) < FEWEST_STOPS:
        most = 1.0 / CLEAR_RATIO**2
    both = part.measured(state), part.predicted(state)
    turned = float(np.median(rotation_angle(invert(both[0]) @ both[1])))
    measured, predicted = (poses[:, :3, 3] for poses in both)
    sizes = np.sum(measured * (predicted - measured), axis=1) / np.sum(measured**2, axis=1)
    of_size = float(np.ptp(sizes) / max(abs(np.median(sizes)), np.finfo(float).tiny))
    found = list[tuple[float, str, FloatArray]]()
    for frame in filter(lambda name: part.observations.involves(name).all(), part.unknown):
        # Rigid motions explain much of a few places.
        if are_places and len(part) < FEWEST_STOPS and frame.startswith("instrument"):
            continue
        step, away = step_of(part, frame, state)
        usually = step_of(others, frame, state, np.eye(4))[1]
        size = np.linalg.norm(log(step) / TWIST_UNITS)
        left, usual = np.median(away), np.median(usually)
        # Poses that are wrong may have much in common, and differ by far more than noise.
        is_noise = CLEAR_RATIO * left < size or left < CLEAR_RATIO * usual
        is_noise &= bool(left < max(leaves, CLEAR_RATIO * usual))
        found.append((float(left / size) if is_noise else np.inf, frame, step))
    ratio, frame, step = min(found, default=(np.inf, "", np.eye(4)), key=lambda item: item[0])
    # A tool that is longer along the line of sight looks like another size, too.
    is_size = CLEAR_RATIO * of_size < min(1.0, CLEAR_RATIO**2 * ratio) and turned < _TURNED_RAD
    if not are_places and is_size:
        return "", np.eye(4)
    if ratio >= most:
        return None
    is_alone = all(CLEAR_RATIO * ratio < rival for rival, other, _ in found if other != frame)
    return (frame if is_alone else ""), step


def _alike(
    inliers: InlierFit, rows: IntArray, frame: str, step: FloatArray
) -> tuple[IntArray, tuple[str, FloatArray]]:
    """Outliers among (n,) that a step of a frame explains, and this step by them alone."""
    if not frame:
        return rows, (frame, step)
    every, state = np.arange(len(inliers.problem)), inliers.fit.state
    part = inliers.problem.subset(np.isin(every, rows))
    away = step_of(part, frame, state, step)[1]
    rows = rows[CLEAR_RATIO * away < np.linalg.norm(log(step) / TWIST_UNITS)]
    part = inliers.problem.subset(np.isin(every, rows))
    return rows, (frame, step_of(part, frame, state)[0])


def _exchanged(cell_fit: CellFit, circles: Sequence[Sequence[int]]) -> Iterator[PoseFault]:
    """Poses of one robot that are exchanged, and views that fit each other's poses."""
    rows, problem, used = cell_fit.cell.rows, cell_fit.inlier_fit.problem, cell_fit.inlier_fit.used
    if in_turn := [circle for circle in circles if len(circle) > 2]:
        yield _exchanged_in_turn(cell_fit, in_turn)
    pairs = sorted((a, b) for a, b, *others in circles if not others)
    for robot, flange in problem.tree.flanges.items() if cell_fit.cell.mount is None else ():
        by_robot = np.flatnonzero(problem.observations_through(flange)).tolist()
        through = [pair for pair in pairs if pair[0] in by_robot]
        by_stops = Counter(tuple(sorted(rows[at].station for at in pair)) for pair in through)
        for stations, count in by_stops.items():
            at_both = [at for at in by_robot if rows[at].station in stations]
            # One observation of a stop may itself be wrong.
            if count < 2 or used[at_both].any():
                continue
            first, second = (cell_fit.cell.stops[station] for station in stations)
            short = f"the poses of robot {robot} at stops {first} and {second} are exchanged"
            words = f"{short}: {{views}} were left out. Each pose is right at the other's stop."
            do = _exchange(cell_fit, at_both, stations)
            yield _fault(cell_fit, EXCHANGED, at_both, words, do, short)
            pairs = [pair for pair in pairs if pair[0] not in at_both]
    if not pairs:
        return
    if len(pairs) > 2 and len({sum(pair) for pair in pairs}) == 1:
        # Of rows in reverse order, some fit the pose of another one, too.
        first, last = min(pairs)
        within = ((at, first + last - at) for at in range(first, (first + last + 1) // 2))
        pairs = [pair for pair in within if not used[[*pair]].any()]
    views = [(rows[first].view, rows[second].view) for first, second in pairs]
    each = f"{views[0][0]} and {views[0][1]}"
    order = ""
    if len(pairs) > 1:
        each = f"{', '.join(f'{first} with {second}' for first, second in views)}"
        if len({sum(pair) for pair in views}) == 1:
            order = f", as where rows {min(views)[0]} to {min(views)[1]} are in reverse order"
    shown = _shown(cell_fit)
    words = (
        f"views {each} are exchanged: the {shown} of each fits the pose in "
        f"the other's row{order}. They were left out."
    )
    typed = ",".join(f"{first},{second}" for first, second in views)
    do = mending(f"their {shown}s are exchanged", f"--exchange {typed}")
    yield _fault(cell_fit, EXCHANGED, [row for pair in pairs for row in pair], words, do)


def _exchange(cell_fit: CellFit, rows: Sequence[int], stations: Sequence[int]) -> Remedy:
    """Advice to exchange what was seen at two stations of a robot, or its poses there by hand.

    Where it stands alone, and everything that was seen at one station was seen at the other.
    """
    seen = [cell_fit.cell.rows[at] for at in rows]
    at_first, at_second = (
        {(row.seer, row.seen): row.view for row in seen if row.station == station}
        for station in stations
    )
    is_paired = at_first.keys() == at_second.keys() and len(seen) == 2 * len(at_first)
    if len(cell_fit.cell.poses) > 1 or not is_paired:
        return _EXCHANGE
    typed = ",".join(f"{view},{at_second[pair]}" for pair, view in at_first.items())
    return mending("what was seen at the one is at the other", f"--exchange {typed}")


def _exchanged_in_turn(cell_fit: CellFit, circles: Sequence[Sequence[int]]) -> PoseFault:
    """Circles of more than two views, of which each fits the pose of the next."""
    shown, words, typed = _shown(cell_fit), list[str](), list[str]()
    for circle in circles:
        first, *others = (cell_fit.cell.rows[at].view for at in circle)
        words.append(" to ".join(map(str, (first, *others, first))))
        typed += [f"{first},{other}" for other in others]
    text = (
        f"{{views}} are exchanged in turn ({listed(words)}): the {shown} of each fits the pose in "
        "the next one's row. They were left out."
    )
    do = mending(f"their {shown}s are exchanged", f"--exchange {','.join(typed)}")
    return _fault(cell_fit, EXCHANGED, sorted(chain.from_iterable(circles)), text, do)


def _shown(cell_fit: CellFit) -> str:
    """The name of what stands beside a pose of the robot in a row."""
    return "reading" if cell_fit.cell.mount == "instrument" else "image"


def farthest_by_arms(robots: Iterable[Robot]) -> tuple[float, float]:
    """How far a view may be off by an arm's own errors [mm, deg]."""
    pairs = [_ARM_ERRS, *([_REPEATS * at for at in arm.repeatability] for arm in robots)]
    mm, deg = np.max(pairs, axis=0).tolist()
    return mm, deg


def _reasons(cell_fit: CellFit, causes: Mapping[int, str]) -> tuple[dict[int, str], frozenset[int]]:
    """Why outliers are left out, by view, given the likely cause of each; and the marginal ones."""
    inliers, alone = cell_fit.inlier_fit, cell_fit.cell.mount is not None
    directions = np.maximum(inliers.distances.directions, 1)
    distance = np.sqrt(inliers.distances.squares / directions)
    limit = np.sqrt(inliers.distances.limit / directions)
    off_m, off_rad = pose_residuals(inliers.problem, inliers.fit.state)
    marginal, reasons = set[int](), dict[int, str]()
    known = (arm.matched for arm in cell_fit.arms.values())
    robots = [matched.robot for matched in known if matched is not None]
    most_mm, most_deg = farthest_by_arms(robots)
    for at, cause in causes.items():
        row, mm = cell_fit.cell.rows[at], 1e3 * float(off_m[at])
        turned, deg = "", float(np.rad2deg(off_rad[at]))
        if inliers.problem.observations.has_rotation[at]:
            turned = f" and {figure(deg)} deg"
        may_err = cause == _WRONG and mm < most_mm and deg < most_deg
        # A view that is far away is rejected even where the prediction is uncertain.
        beyond = "many times as far as most"
        if distance[at] > limit[at]:
            beyond = f"{figure(distance[at])} times the noise (limit {figure(limit[at])})"
        target = f"the {row.seen.partition('_')[0]}" if alone else row.seen.partition("@")[0]
        if may_err and distance[at] < _MARGIN * limit[at]:
            marginal.add(row.view)
        reasons[row.view] = (
            f"disagrees with the other views: it places {target} {figure(mm)} mm{turned} away, "
            f"{beyond}; {cause}{', or the arm errs so there' if may_err else ''}"
        )
    rows = cell_fit.cell.rows
    used = Counter(row.seer for row, one in zip(rows, inliers.used.tolist(), strict=True) if one)
    out = Counter(row.seer for row in rows if row.view in marginal)
    few = {seer for seer, count in out.items() if _MARGINAL_SHARE * count <= used[seer]}
    return reasons, frozenset(row.view for row in rows if row.view in marginal and row.seer in few)


def _cause(
    cell_fit: CellFit,
    at: int,
    fitting: Mapping[int, Sequence[int]],
    circles: Sequence[Sequence[int]],
) -> str:
    """Likely cause of an outlier, by stops that it fits and by inliers of its stop and target."""
    rows, stops = cell_fit.cell.rows, cell_fit.cell.stops
    for circle in (some for some in circles if at in some):
        own, other = rows[at], rows[circle[(circle.index(at) + 1) % len(circle)]]
        if len(circle) > 2:
            return f"it fits stop {stops[other.station]}, of view {other.view}"
        return (
            f"it fits stop {stops[other.station]}, and view {other.view} fits stop "
            f"{stops[own.station]}: these two rows are exchanged"
        )
    cause, problem = _WRONG, cell_fit.inlier_fit.problem
    of_stop = problem.observations.stops
    by_joints = {name for name, arm in cell_fit.arms.items() if arm.matched is not None}
    reported = (
        problem.poses[name][of_stop[at]]
        for name, flange in problem.tree.flanges.items()
        if name not in by_joints and problem.observations_through(flange)[at]
    )
    if any(np.array_equal(pose, np.eye(4)) for pose in reported):
        return "the robot's pose in its row is all zeros, as of a row that was not filled in"
    mates = np.flatnonzero((of_stop == of_stop[at]) & cell_fit.inlier_fit.used)
    if len(mates):
        cause = f"view {rows[mates[0]].view} of the same stop agrees: its reading is wrong"
    if at in fitting:
        fits = [str(stops[index]) for index in fitting[at]]
        one = "stop" if len(fits) == 1 else "another stop, as"
        cause = f"its {_shown(cell_fit)} is of {one} {some_of(fits, 3)}; {cause}"
    return cause

"""Messages on outliers and moved frames: exchanged or wrong observations, by cause."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, pairwise

import numpy as np

from visioncal.calibration.stages.cell import stop_of
from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.stages.exchanged_rows import (
    exchanged,
    other_names,
    other_robots,
    other_stops,
    shifted_images,
)
from visioncal.calibration.stages.validate import pose_residuals
from visioncal.calibration.suspects.moved_views import (
    KNOCKED,
    PoseFault,
    fault_of,
    of_moved,
    pushed_base,
    turned_back,
)
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import FEWEST_VIEWS, CalibrationLimits
from visioncal.core.number_format import counted, figure, listed, ranges, some_of, view_words
from visioncal.core.transforms import distances, invert, pose_difference
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import CALIBRATE, Option, Remedy, mending
from visioncal.estimation.unknowns import LENS
from visioncal.results import CONTRADICTS, Moved
from visioncal.robot import Robot
from visioncal.session.frames import object_name
from visioncal.vision.pnp import measure_poses
from visioncal.vision.targets import half_turn_of, rotation_transforms

# Kinds of findings, which others name.
EXCHANGED, MISNAMED, SHIFTED = "exchanged_views", "misnamed_rows", "shifted_rows"
# Rows that no chance has fit another name.
_FEWEST_MISNAMED = 2
_EXCHANGE = Remedy("Exchange these rows in views.csv, and calibrate again.", CALIBRATE)
_WRONG = "its pose or its reading is wrong, or something had moved"
# An arm's errors have longer tails than noise: views within so many times the limit of outliers, at
# most one to so many that agree, are no mistakes where arms err by as much.
_MARGIN, _MARGINAL_SHARE = 1.5, 10
# By as much an industrial arm may err [mm, deg]; one that states what it repeats to, by so many.
_ARM_ERRS, _REPEATS = CalibrationLimits.arm_errors, 6.0


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
    session = cell_fit.cell.session
    turns = {
        session.board_frames[name]: rotation_transforms(target)
        for name, target in session.boards.items()
    }
    fitting = other_stops(
        agreed.problem, agreed.fit, outliers, agreed.distances.limit, agreed.moves, turns
    )
    circles = exchanged(agreed.problem, fitting)
    faults = [*_exchanged(cell_fit, circles)]
    faults += _turned(cell_fit, outliers) if not faults else ()
    is_pair = session.has_one_pair
    if not faults and (not is_pair or len(session.boards) > 1):
        faults += _misnamed(cell_fit, outliers)
    if not faults and not is_pair:
        faults += (*_of_other_robots(cell_fit, outliers), *_of_other_images(cell_fit, outliers))
    if not faults:
        faults += of_moved(cell_fit, outliers) if is_pair else pushed_base(cell_fit)
    clauses = {row: fault.short for fault in faults if fault.short for row in fault.rows}
    causes = {at: _cause(cell_fit, at, fitting, circles) for at in outliers.tolist()} | clauses
    return tuple(faults), *_reasons(cell_fit, causes)


def _turned(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers whose boards are turned by 180 deg, as where corners are numbered from their end."""
    problem, state, rows = cell_fit.inlier_fit.problem, cell_fit.fit.state, cell_fit.cell.rows
    steps = invert(problem.predicted(state)[outliers]) @ problem.measured(state)[outliers]
    session = cell_fit.cell.session
    for name, board in session.boards.items():
        frame = session.board_frames[name]
        half_turn, _ = half_turn_of(board)
        away_m, away_rad = distances(half_turn[None], steps)
        seen = np.array([rows[at].seen == frame for at in outliers.tolist()])
        is_turned = seen & (1e3 * away_m < KNOCKED[0]) & (np.rad2deg(away_rad) < KNOCKED[1])
        if not is_turned.any():
            continue
        some = outliers[is_turned].tolist()
        views = [rows[at].view for at in some]
        short = f"{frame} was read turned by 180 deg in its plane"
        words = (
            f"in {{views}} {short}, its corners numbered from the other end. They were left out."
        )
        do = turned_back(board, views)
        yield fault_of(cell_fit, "turned_board", some, words, do, short)


def _misnamed(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers that fit where their camera or their target has the name of another one."""
    inliers, rows = cell_fit.inlier_fit, cell_fit.cell.rows
    targets, lenses = tuple(cell_fit.cell.session.boards.values()), cell_fit.fit.unknowns.of(LENS)

    def seen_by(at: int, observer: str) -> FloatArray:
        """The pose (4, 4) of a row's target by the lens of an observer."""
        corners = cell_fit.poses[at].corners
        if observer != rows[at].seer and observer in lenses and corners is not None:
            # Where the other lens has no ray, the pose is that by the stated one.
            with suppress(VisioncalError):
                lens = cell_fit.fit.camera(observer)
                (view,) = measure_poses({corners.view: corners}, targets, lens, 1.0)
                return np.asarray(view.cam_from_target[0])
        return np.asarray(inliers.problem.observations.measured[at])

    found = other_names(inliers.problem, inliers.fit, outliers, inliers.moves, seen_by)
    by_names = defaultdict[tuple[str, str], list[int]](list)
    for at, names in found.items():
        frames = rows[at].seer, rows[at].seen
        side = int(frames[0].partition("@")[0] == names[0])
        by_names[frames[side].partition("@")[0], names[side]].append(at)
    # Exchanged names, one in place of the other, are one mistake.
    count = Counter(frozenset(names) for names, some in by_names.items() for _ in some)
    several = {
        names: some
        for names, some in by_names.items()
        if count[frozenset(names)] >= _FEWEST_MISNAMED
    }
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
    yield fault_of(cell_fit, MISNAMED, every, words, do, short)


def _of_other_robots(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers at stops at which two robots have each other's poses."""
    inliers, cell = cell_fit.inlier_fit, cell_fit.cell
    found = other_robots(inliers.problem, inliers.fit, outliers)
    for pair in {*found.values()}:
        rows = sorted(at for at, robots in found.items() if robots == pair)
        if len(rows) < _FEWEST_MISNAMED:
            continue
        stops = sorted({cell.stops[cell.rows[at].station] for at in rows})
        found_views = [view for view in cell.session.views if stop_of(view) in stops]
        edits = [
            f"{other} for {robot} in column robot of "
            f"{view_words([view.number for view in found_views if view.cell('robot') == robot])}"
            for robot, other in (pair, pair[::-1])
        ]
        where = f"stop{'s' * (len(stops) > 1)} {ranges(stops)}"
        short = f"robots {listed(pair)} have each other's poses at {where}"
        words = f"{{views}} were left out: {short}."
        do = Remedy(f"In views.csv, write {listed(edits)}, and calibrate again.", CALIBRATE)
        yield fault_of(cell_fit, MISNAMED, rows, words, do, short)


def _of_other_images(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers of one camera whose images are some stops apart, of boards with two arms between."""
    inliers, rows = cell_fit.inlier_fit, cell_fit.cell.rows
    by_camera, tree = defaultdict[str, list[int]](list), cell_fit.cell.tree
    for at in outliers.tolist():
        # Of one arm, pairs alone show whether its poses are apart or images.
        if sum(bool(step.robot) for step in tree.path(rows[at].seer, rows[at].seen)) > 1:
            by_camera[rows[at].seer].append(at)
    for camera, some in by_camera.items():
        by, found = shifted_images(inliers.problem, inliers.fit, np.array(some), inliers.moves)
        if len(found) < FEWEST_VIEWS:
            continue
        seen = [at for at, row in enumerate(rows) if row.seer == camera]
        # A view whose stop has no row is of the same run.
        first, last = seen.index(found[0]), seen.index(found[-1])
        while first > 0 and seen[first - 1] in some:
            first -= 1
        run = seen[first : last + 1]
        apart = tuple(rows[at].view for at in run)
        when = f"to view {apart[-1]}" if last + 1 < len(seen) else "on"
        stop = f"{counted(abs(by), 'stop')} {'later' if by > 0 else 'earlier'}"
        short = f"its image was taken {stop}"
        words = (
            f"from view {apart[0]} {when}, images of {camera} are apart from their rows: each was "
            f"taken {stop}. They were left out."
        )
        option = Option("shift", f"{by}:images", apart)
        do = mending("each image has its own stop", option)
        yield fault_of(cell_fit, SHIFTED, [at for at in run if at in some], words, do, short)


def _exchanged(cell_fit: CellFit, circles: Sequence[Sequence[int]]) -> Iterator[PoseFault]:
    """Poses of one robot that are exchanged, and views that fit each other's poses."""
    rows, problem, used = cell_fit.cell.rows, cell_fit.inlier_fit.problem, cell_fit.inlier_fit.used
    if in_turn := [circle for circle in circles if len(circle) > 2]:
        yield _exchanged_in_turn(cell_fit, in_turn)
    pairs = sorted((a, b) for a, b, *others in circles if not others)
    flanges = {} if cell_fit.cell.session.has_one_pair else problem.tree.flanges
    for robot, flange in flanges.items():
        by_robot = np.flatnonzero(problem.observations_through(flange)).tolist()
        through = [pair for pair in pairs if pair[0] in by_robot]
        by_stops = Counter(tuple(sorted(rows[at].station for at in pair)) for pair in through)
        for stations, count in by_stops.items():
            at_stops = [at for at in by_robot if rows[at].station in stations]
            # One observation of a stop may itself be wrong.
            if count < 2 or used[at_stops].any():
                continue
            first, second = (cell_fit.cell.stops[station] for station in stations)
            short = f"the poses of robot {robot} at stops {first} and {second} are exchanged"
            words = f"{short}: {{views}} were left out. Each pose is right at the other's stop."
            do = _exchange(cell_fit, at_stops, stations)
            yield fault_of(cell_fit, EXCHANGED, at_stops, words, do, short)
            pairs = [pair for pair in pairs if pair[0] not in at_stops]
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
    do = mending(f"their {shown}s are exchanged", Option("exchange", typed))
    yield fault_of(cell_fit, EXCHANGED, [row for pair in pairs for row in pair], words, do)


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
    return mending("what was seen at the one is at the other", Option("exchange", typed))


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
    do = mending(f"their {shown}s are exchanged", Option("exchange", ",".join(typed)))
    return fault_of(cell_fit, EXCHANGED, sorted(chain.from_iterable(circles)), text, do)


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
    inliers, is_single = cell_fit.inlier_fit, cell_fit.cell.session.has_one_pair
    directions = np.maximum(inliers.distances.directions, 1)
    distance = np.sqrt(inliers.distances.squares / directions)
    limit = np.sqrt(inliers.distances.limit / directions)
    off_m, off_rad = pose_residuals(inliers.problem, inliers.fit.state)
    marginal, reasons = set[int](), dict[int, str]()
    robots = [arm.nominal for arm in cell_fit.arms.values() if arm.nominal is not None]
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
        target = f"the {row.seen.partition('_')[0]}" if is_single else row.seen.partition("@")[0]
        if may_err and distance[at] < _MARGIN * limit[at]:
            marginal.add(row.view)
        reasons[row.view] = (
            f"{CONTRADICTS}the other views: it places {target} {figure(mm)} mm{turned} away, "
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
        row, other = rows[at], rows[circle[(circle.index(at) + 1) % len(circle)]]
        if len(circle) > 2:
            return f"it fits stop {stops[other.station]}, of view {other.view}"
        return (
            f"it fits stop {stops[other.station]}, and view {other.view} fits stop "
            f"{stops[row.station]}: these two rows are exchanged"
        )
    cause, problem = _WRONG, cell_fit.inlier_fit.problem
    of_stop = problem.observations.stops
    by_joints = {name for name, arm in cell_fit.arms.items() if arm.nominal is not None}
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

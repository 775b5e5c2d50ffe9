"""Messages on outliers and moved frames: exchanged, wrong or turned observations, by cause."""

import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.pipeline.cell_fit import CellFit
from visioncal.calibration.stages.exchanged_rows import exchanged, other_stops
from visioncal.calibration.stages.turned_images import ImageTurn
from visioncal.calibration.stages.validate import pose_residuals
from visioncal.calibration.suspects.ranking import run_evidence
from visioncal.core.finding_kinds import EXCHANGED
from visioncal.core.number_format import figure, mm_and_deg, some_of
from visioncal.core.transforms import distances, invert, mean_transform, pose_difference
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import CALIBRATE, Finding, Remedy, exchanging, look_at, or_alone
from visioncal.estimation.moves import common_change
from visioncal.estimation.slight_steps import common_size
from visioncal.results import Moved
from visioncal.session.frames import frame_name
from visioncal.vision.targets import rotation_transforms

# A base was pushed where at least so many stops agree on its displacement, to such a share of it.
_FEWEST_STOPS, _ALIKE = 3, 0.5
# Views that a large step explains agree on it to within this share of the step: the uncertainty
# that the fit leaves grows with it.
_SURELY_ALIKE = 0.05
# A robot's pose is wrong where at least so many observations of its stop show it.
_FEWEST = 2
# Most views of a fault, and most stops that fit an observation, that are named.
_LISTED, _NAMED = 8, 3
_EXCHANGE = Remedy("Exchange these rows in views.csv, and calibrate again.", CALIBRATE)


@dataclass(frozen=True)
class PoseFault:
    """A fault of poses or images that explains outliers."""

    found: Finding  # The finding.
    rows: tuple[int, ...]  # The observations that it explains.
    short: str = ""  # The fault as a clause, for each of these; empty where the finding suffices.


@dataclass(frozen=True)
class Version:
    """A frame during a part of the session, in which it did not move."""

    key: str  # Its name in the problem.
    frame: str  # The name of the frame.
    name: str  # Its name in the result: the frame's own for the last.
    start: int  # The first station of it; -1 for the first version.

    @property
    def is_last(self) -> bool:
        """Whether the frame was there at the end of the session."""
        return self.name == self.frame


def versions(solved: CellFit) -> dict[str, Version]:
    """All unknown frames over time, by their names in the problem."""
    starts = {move.twin: move.stop for move in solved.inlier_fit.moves}
    parts: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for key in solved.inlier_fit.problem.unknown:
        parts[key.partition("@")[0]].append((starts.get(key, -1), key))
    versions_by_key = {}
    for frame, keys in parts.items():
        *earlier, (start, last) = sorted(keys)
        for before, key in earlier:
            name = f"{frame}_until_stop_{_stops_of(solved, key)[-1]}"
            versions_by_key[key] = Version(key, frame, name, before)
        versions_by_key[last] = Version(last, frame, frame, start)
    return versions_by_key


def _stops_of(solved: CellFit, key: str) -> list[int]:
    """The stops of a frame's inliers, in order of time; of all its observations if it has none."""
    observations = solved.inlier_fit.problem.observations
    rows = observations.involves(key)
    used = rows & solved.inlier_fit.used
    stations = observations.stops[used if used.any() else rows]
    return [solved.cell.stops[station] for station in np.unique(stations).tolist()]


def movements(solved: CellFit) -> tuple[Moved, ...]:
    """The frames that moved, in the order of time."""
    moved, versions_by_key, edges = [], versions(solved), solved.frames
    for move in sorted(solved.inlier_fit.moves, key=lambda value: value.stop):
        after = versions_by_key[move.twin]
        same_frame = (item for item in versions_by_key.values() if item.frame == after.frame)
        earlier = [item for item in same_frame if item.start < after.start]
        before = max(earlier, key=lambda value: value.start)
        mm, deg = pose_difference(edges[before.key], edges[after.key])
        rivals = tuple(dict.fromkeys(rival.partition("@")[0] for rival in move.rivals))
        moved.append(
            Moved(
                after.frame,
                before.name,
                _stops_of(solved, before.key)[-1],
                _stops_of(solved, move.twin)[0],
                mm,
                deg,
                tuple(rival for rival in rivals if rival != after.frame),
            )
        )
    return tuple(moved)


def moved_finding(moved: Moved) -> Finding:
    """Finding that a frame moved."""
    what = "was bumped" if moved.frame.startswith("cam") else "moved"
    rivals = (
        f" (or {' or '.join(moved.rivals)} did: the session leaves it open)" if moved.rivals else ""
    )
    return Finding(
        "moved_frame",
        f"{moved.frame} {what} between stops {moved.last_stop} and {moved.first_stop}, by "
        f"{mm_and_deg(moved.shift_mm, moved.turn_deg)}{rivals}. The result has "
        f"{moved.frame} where it stood last, and as {moved.before} where it stood before.",
        Remedy(f"Fasten {moved.frame}, and record again."),
    )


def pose_faults(solved: CellFit) -> tuple[PoseFault, ...]:
    """Turned images, exchanged or wrong poses, and pushed robots that explain outliers."""
    outliers = np.flatnonzero(~solved.inlier_fit.used)
    if not len(outliers):
        return ()
    turned = _turned_images(solved)
    explained = {row for fault in turned for row in fault.rows}
    mutual = exchanged(solved.inlier_fit.problem, _fitting_stations(solved, outliers))
    if solved.cell.mount is not None:
        swapped = tuple(_exchanged_views(solved, mutual))
        return (*turned, *swapped, *(() if turned or swapped else _moved_runs(solved)))
    faults = _pushed_bases(solved)
    faults += _exchanged_poses(solved, mutual)
    explained |= {row for fault in faults for row in fault.rows}
    rest = {one: other for one, other in mutual.items() if not {one, other} & explained}
    faults += _exchanged_views(solved, rest)
    explained |= {row for fault in faults for row in fault.rows}
    return (*turned, *faults, *_wrong_poses(solved, explained))


def _turned_images(solved: CellFit) -> list[PoseFault]:
    """Turned or mirrored images, which agree with the others once they are turned back."""
    rows, faults = solved.cell.rows, []
    rows_by_turn: dict[ImageTurn, list[int]] = defaultdict(list)
    for at, row in enumerate(rows):
        if row.view in solved.turned and not solved.inlier_fit.used[at]:
            rows_by_turn[solved.turned[row.view]].append(at)
    images = {view.number: view.image for view in solved.cell.session.views}
    for how, turned_rows in rows_by_turn.items():
        views = _view_numbers(solved, turned_rows)
        named = some_of([*map(str, views)], _LISTED)
        subject = f"The image of view {named} is" if len(views) == 1 else f"Images {named} are"
        them = "it agrees" if len(views) == 1 else "they agree"
        left_out = "It was" if len(views) == 1 else "They were"
        words = f"{subject} {how.words}: turned back, {them} with the others. {left_out} left out."
        step = Remedy("Turn these corners back in corners.csv, and calibrate again.", CALIBRATE)
        if all(images[view] for view in views):
            files = " ".join(f"SESSION/{shlex.quote(images[view])}" for view in views)
            turn = f"mogrify {how.option} {files}"
            step = Remedy("Turn the file back, and calibrate again.", f"{turn} && {CALIBRATE}")
        fault = Finding("turned_images", words, step, views)
        faults.append(PoseFault(fault, tuple(turned_rows), f"its image is {how.words}"))
    return faults


def _moved_runs(solved: CellFit) -> Iterator[PoseFault]:
    """Outliers at one end of the session that one step of a frame explains."""
    # Another active tool frame in the controller looks like a step of what is on the flange, and
    # another base frame like one of what is fixed in the cell.
    inliers, rows = solved.inlier_fit, solved.cell.rows
    problem = inliers.problem
    order = np.argsort(problem.observations.stops, kind="stable")
    used = np.flatnonzero(inliers.used[order])
    before, after = order[: used[0]], order[used[-1] + 1 :]
    run = max(before, after, key=len)
    if len(run) < _FEWEST_STOPS or not problem.observations.has_rotation[run].all():
        return
    steps = _common_steps(solved, run)
    if not steps:
        yield from _other_boards(solved, run, is_behind=run is after)
        return
    (frame, change), *rivals = steps
    edge = inliers.fit.state.edges[problem.unknown[frame]]
    when = _when(solved, run, is_behind=run is after)
    moved = f"the {_body(frame)} stood {_displacement_words(change)}"
    for rival, rival_change in rivals:
        moved += f" (or the {_body(rival)} {_displacement_words(rival_change)})"
    outliers = np.sort(run).tolist()
    advice = "Fasten what moved, and calibrate the views before and after it apart."
    on_flange = problem.tree.body(frame) != problem.tree.root
    if on_flange or len(problem.robots) == 1:
        which = "tool" if on_flange else "base"
        other_mm, other_deg = pose_difference(np.eye(4), edge @ change @ invert(edge))
        moved += (
            f", or the controller reported another {which} frame, "
            f"{mm_and_deg(other_mm, other_deg)} from that of the other views"
        )
        advice = (
            f"Look which {which} frame was active in the controller, and set the same one for all "
            "views; or fasten what moved, and calibrate the views before and after it apart."
        )
    words = f"{_named_views(solved, outliers)} were left out: {when}, as they agree, {moved}."
    views, evidence = _view_numbers(solved, outliers), run_evidence(len(run), len(rows))
    step = or_alone(advice, views)
    finding = Finding("something_moved", f"V{words[1:]}", step, views, mahalanobis_sq=evidence)
    yield PoseFault(finding, tuple(outliers), f"{when}, something had moved")


def _other_boards(solved: CellFit, run: IntArray, *, is_behind: bool) -> Iterator[PoseFault]:
    """Outliers at one end of the session that a board of another size explains."""
    inliers, outliers = solved.inlier_fit, np.sort(run).tolist()
    is_in_run = np.isin(np.arange(len(inliers.used)), run)
    size = common_size(inliers.problem, inliers.fit, is_in_run)
    if size is None or not size[1].all():
        return
    when = _when(solved, run, is_behind=is_behind)
    words = (
        f"{_named_views(solved, outliers)} were left out: {when}, as they agree, the target is "
        f"another one, {figure(100.0 * abs(size[0]))} % "
        f"{'larger' if size[0] > 0.0 else 'smaller'} than that of the other views."
    )
    step = Remedy("Measure both prints, take one of them for all views, and record again.")
    evidence = run_evidence(len(run), len(inliers.used))
    views = _view_numbers(solved, outliers)
    finding = Finding("something_moved", f"V{words[1:]}", step, views, mahalanobis_sq=evidence)
    yield PoseFault(finding, tuple(outliers), f"{when}, the target was another one")


def _when(solved: CellFit, run: IntArray, *, is_behind: bool) -> str:
    """When views at the end, or the beginning, of the session were taken, in words."""
    rows = solved.cell.rows
    if is_behind:
        return f"from view {rows[int(run[0])].view} on"
    last = rows[int(run[-1])].station
    following = min((row for row in rows if row.station > last), key=lambda row: row.station)
    return f"before view {following.view}"


def _common_steps(solved: CellFit, run: IntArray) -> list[tuple[str, FloatArray]]:
    """Frames with a common step that explains some views, and the step; least scatter first."""
    inliers, steps = solved.inlier_fit, []
    is_in_run = np.isin(np.arange(len(inliers.used)), run)
    for frame in inliers.problem.unknown:
        step = common_change(inliers.problem, inliers.fit, frame, is_in_run)
        if step is None:
            continue
        change, explained = step
        changes = inliers.problem.change_of(frame, inliers.fit.state)[run]
        scatter_m = float(np.median(distances(changes, change)[0]))
        if explained.all() or scatter_m < _SURELY_ALIKE * float(np.linalg.norm(change[:3, 3])):
            steps.append((scatter_m, frame, change))
    return [(frame, change) for _, frame, change in sorted(steps, key=lambda item: item[0])]


def _body(frame: str) -> str:
    return frame.partition("_")[0].replace("cam", "camera")


def _displacement_words(change: FloatArray) -> str:
    shift_mm, turn_deg = pose_difference(np.eye(4), change)
    return f"{mm_and_deg(shift_mm, turn_deg)} elsewhere"


def _exchanged_views(solved: CellFit, mutual: Mapping[int, int]) -> Iterator[PoseFault]:
    """Pairs of views of one camera, each of which fits the other's pose."""
    rows = solved.cell.rows
    for first, second in sorted(mutual.items()):
        if first < second:
            words = (
                f"Views {rows[first].view} and {rows[second].view} are exchanged: the image of "
                "each fits the pose in the other's row. They were left out."
            )
            views = (rows[first].view, rows[second].view)
            do = (
                "Write a copy of the session in which their images are exchanged, and calibrate it."
            )
            finding = Finding(EXCHANGED, words, Remedy(do, exchanging(*views)), views)
            yield PoseFault(finding, (first, second))


def _view_numbers(solved: CellFit, rows: Sequence[int]) -> tuple[int, ...]:
    return tuple(solved.cell.rows[row].view for row in rows)


def _named_views(solved: CellFit, rows: Sequence[int]) -> str:
    return f"views {some_of([*map(str, _view_numbers(solved, rows))], _LISTED)}"


def _pushed_bases(solved: CellFit) -> list[PoseFault]:
    """Robots whose observations are all outliers from some stop on, as if the base had moved."""
    # Such observations are left out, and the base stays where it was: unlike other frames, a base
    # is not split in two when it moves, as all that its robot carries hangs on it.
    problem, used = solved.inlier_fit.problem, solved.inlier_fit.used
    stops, faults = problem.observations.stops, []
    for robot, base in problem.tree.bases.items():
        flange = problem.tree.flanges[robot]
        by_robot = problem.observations_through(flange)
        first = int(stops[by_robot & used].max(initial=-1)) + 1
        after = np.flatnonzero(by_robot & ~used & (stops >= first))
        if len(np.unique(stops[after])) < _FEWEST_STOPS:
            continue
        moved = _base_displacement(solved, base, after)
        as_if = f", as if {base} had been pushed by {moved}" if moved else ""
        words = (
            f"All {len(after)} views by way of {flange} from stop "
            f"{solved.cell.stops[int(stops[after].min())]} on disagree with those before{as_if}: "
            f"{base} is where it stood before."
        )
        views = _view_numbers(solved, after.tolist())
        step = Remedy("Fasten it, and calibrate the stops from there on alone.", look_at(views[0]))
        pushed = Finding("something_moved", words, step, views)
        faults.append(PoseFault(pushed, tuple(after.tolist())))
    return faults


def _base_displacement(
    solved: CellFit, base: str, rows: IntArray, of: FloatArray | None = None
) -> str:
    """Mean displacement of a base by some observations, in words; empty where they disagree."""
    changes = solved.inlier_fit.problem.change_of(base, solved.inlier_fit.fit.state)[rows]
    if of is not None:
        changes = invert(of) @ changes @ of
    mean = mean_transform(changes)
    shift_mm, turn_deg = pose_difference(np.eye(4), mean)
    scatter_mm = 1e3 * float(np.median(distances(changes, mean)[0]))
    return mm_and_deg(shift_mm, turn_deg) * (scatter_mm < _ALIKE * shift_mm)


def _wrong_poses(solved: CellFit, explained: set[int]) -> Iterator[PoseFault]:
    """Stops at which all observations through a robot agree that its pose is wrong."""
    problem, used = solved.inlier_fit.problem, solved.inlier_fit.used
    stops = problem.observations.stops
    for robot, base in problem.tree.bases.items():
        by_robot = problem.observations_through(problem.tree.flanges[robot])
        for stop in np.unique(stops[by_robot & ~used]).tolist():
            rows = np.flatnonzero(by_robot & (stops == stop))
            if len(rows) < _FEWEST or used[rows].any() or not explained.isdisjoint(rows.tolist()):
                continue
            moved = _base_displacement(solved, base, rows, problem.poses[robot][stop])
            if moved:
                words = (
                    f"Robot {robot} did not stand at stop {solved.cell.stops[stop]} where "
                    f"its pose says: all {len(rows)} views by way of it disagree with the others, "
                    f"as if the flange had been moved by {moved}, and were left out "
                    f"({_named_views(solved, rows.tolist())})."
                )
                views = _view_numbers(solved, rows.tolist())
                fix = "Correct its pose there in views.csv, or leave the stop out."
                finding = Finding("wrong_pose", words, Remedy(fix, look_at(views[0])), views)
                short = f"the pose of robot {robot} at stop {solved.cell.stops[stop]} is wrong"
                yield PoseFault(finding, tuple(rows.tolist()), short)


def reasons(solved: CellFit, faults: Sequence[PoseFault]) -> dict[int, str]:
    """Why outliers are left out, by view, with the stops that they fit instead."""
    inliers, rows, problem = solved.inlier_fit, solved.cell.rows, solved.inlier_fit.problem
    outliers = np.flatnonzero(~inliers.used)
    if not len(outliers):
        return {}
    residuals_mm_deg, distances_sq = residuals(solved)[outliers], inliers.distances
    directions = np.maximum(distances_sq.directions, 1)
    distance = np.sqrt(distances_sq.squares / directions)
    limit = np.sqrt(distances_sq.limit / directions)
    fitting = _fitting_stations(solved, outliers)
    mutual = exchanged(problem, fitting)
    clauses = {row: fault.short for fault in faults if fault.short for row in fault.rows}
    rest = "the rest of the cell" if solved.cell.mount is None else "the other views"
    reasons_by_view = {}
    for at, (mm, deg) in zip(outliers.tolist(), residuals_mm_deg.tolist(), strict=True):
        turned = f" and {figure(deg)} deg" if problem.observations.has_rotation[at] else ""
        cause = _cause(solved, at)
        if at in clauses:
            cause = clauses[at]
        elif at in mutual:
            other = rows[mutual[at]]
            cause = (
                f"it fits stop {_stop(solved, mutual[at])}, and view {other.view} fits stop "
                f"{_stop(solved, at)}: these two rows are exchanged"
            )
        elif at in fitting:
            stops = [str(solved.cell.stops[index]) for index in fitting[at][:_NAMED]]
            one = "stop" if len(stops) == 1 else "another stop, as"
            cause = f"its image is of {one} {', '.join(stops)}; {cause}"
        # What is far away is rejected even where the prediction is uncertain.
        beyond = (
            f"{figure(distance[at])} times the noise (limit {figure(limit[at])})"
            if distance[at] > limit[at]
            else "many times as far as most"
        )
        target = _target_words(solved, rows[at].seen)
        reasons_by_view[rows[at].view] = (
            f"disagrees with {rest}: it places {target} {figure(mm)} mm{turned} away, {beyond}; "
            f"{cause}"
        )
    return reasons_by_view


def _target_words(solved: CellFit, frame: str) -> str:
    """Name of a target or point in words."""
    if solved.cell.mount is None:
        return frame.partition("@")[0]
    is_probe = frame.startswith("point") and frame not in solved.inlier_fit.problem.points
    return "the probe" if is_probe else f"the {frame.partition('_')[0]}"


def _cause(solved: CellFit, at: int) -> str:
    """Likely cause of an outlier, by the inliers of its stop and of its target."""
    rows, used, problem = solved.cell.rows, solved.inlier_fit.used, solved.inlier_fit.problem
    seen = np.array(problem.observations.observed)
    of_its_target = np.flatnonzero((seen == seen[at]) & used)
    reading = "reading" if rows[at].seer.startswith("instrument") else "image"
    if len(of_its_target) == 1 and len(set(seen.tolist())) > 1:
        other = rows[of_its_target[0]].view
        return f"it and view {other} alone show this target, and either may be wrong"
    stops = problem.observations.stops
    mates = np.flatnonzero((stops == stops[at]) & used)
    if len(mates):
        return (
            f"view {rows[mates[0]].view} of the same stop agrees: the {reading} is wrong, or "
            "something moved in between"
        )
    return f"its pose or its {reading} is wrong, or something had moved"


def _stop(solved: CellFit, row: int) -> int:
    return solved.cell.stops[solved.cell.rows[row].station]


def residuals(solved: CellFit) -> FloatArray:
    """Residuals (n, 2) of the observations, translation and rotation [mm], [deg]."""
    metres, radians = pose_residuals(solved.inlier_fit.problem, solved.inlier_fit.fit.state)
    return np.stack([1e3 * metres, np.rad2deg(radians)], axis=1)


def _fitting_stations(solved: CellFit, outliers: IntArray) -> dict[int, list[int]]:
    """The other stations that outliers fit; see `other_stops`."""
    agreed = solved.inlier_fit
    turns = {
        frame_name("target", name): rotation_transforms(target)
        for name, target in solved.cell.session.boards.items()
    }
    return other_stops(agreed.problem, agreed.used, agreed.fit, outliers, agreed.moves, turns)


def _exchanged_poses(solved: CellFit, mutual: Mapping[int, int]) -> list[PoseFault]:
    """Pairs of poses of one robot that are exchanged."""
    rows, problem, used = solved.cell.rows, solved.inlier_fit.problem, solved.inlier_fit.used
    faults = []
    for robot in problem.robots:
        by_robot = np.flatnonzero(
            problem.observations_through(problem.tree.flanges[robot])
        ).tolist()
        pairs: dict[tuple[int, int], list[int]] = defaultdict(list)
        for at in by_robot:
            if at in mutual:
                both = sorted((rows[at].station, rows[mutual[at]].station))
                pairs[both[0], both[1]].append(at)
        for stations, members in pairs.items():
            at_both = [at for at in by_robot if rows[at].station in stations]
            if len(members) >= 2 * _FEWEST and not used[at_both].any():
                first, second = (solved.cell.stops[station] for station in stations)
                short = f"the poses of robot {robot} at stops {first} and {second} are exchanged"
                words = (
                    f"{short[0].upper()}{short[1:]}: {_named_views(solved, at_both)} were left "
                    "out. Each pose is right at the other's stop."
                )
                finding = Finding(EXCHANGED, words, _EXCHANGE, _view_numbers(solved, at_both))
                faults.append(PoseFault(finding, tuple(at_both), short))
    return faults

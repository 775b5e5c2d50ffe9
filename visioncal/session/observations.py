"""Observations of a session: observer, observed object, and the robots' poses at the stop."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import pose_difference
from visioncal.session.columns import LOAD, POSE
from visioncal.session.document import Declaration
from visioncal.session.frames import observed, robots_between
from visioncal.session.kinds import has_robot_state, name_of
from visioncal.session.table import View

# Largest difference between reports of one robot's pose at one stop [mm, deg, rad].
APART_MM, APART_DEG, APART_RAD = 1.0, 0.1, 2e-3
# Corners of two exposures of one scene differ by the camera's noise in some corner, by more than
# this [px]; a picture that was stored anew in another file does not.
APART_PX = 0.01


@dataclass(frozen=True, eq=False)
class Observation:
    """One observation of a target or point by a camera or instrument at a stop."""

    view: View  # Its row.
    # Number of the cell's state; all rows of a stop share one, unless they give different poses of
    # a robot.
    station: int
    seer: str  # The frame of the camera or instrument.
    seen: str  # The frame of the target or point.
    robots: Mapping[str, View]  # The row with the pose of each robot between the two at this stop.
    missing_robots: tuple[str, ...] = ()  # The robots between the two without a pose at this stop.


def observations_of(
    declaration: Declaration, views: Sequence[View], frames: Mapping[str, str]
) -> tuple[Observation, ...]:
    """Observations in the order of the rows; rows with only a robot's pose have none.

    `frames` has the parent of each frame, by `resolve_frames`.
    """
    index_of = {view.number: at for at, view in enumerate(views)}
    observations, station = [], 0
    for rows, robot_rows in _stops(declaration, views):
        # Rows that contradict the majority's pose are of another state of the cell.
        states: dict[tuple[int, ...], int] = {}
        for view in rows:
            posed_rows = (
                {name_of(declaration, "robot", view): view} if has_robot_state(view) else {}
            )
            strays = {
                name: row for name, row in posed_rows.items() if _differ(row, robot_rows[name])
            }
            by_robot = {**robot_rows, **strays}
            key = tuple(by_robot[name].number for name in sorted(by_robot))
            seer, seen = observed(declaration, view)
            if not seer:
                continue
            if key not in states:
                states[key], station = station, station + 1
            needed = () if view.is_of_lens else robots_between(frames, seer, seen)
            robots = {name: by_robot[name] for name in needed if name in by_robot}
            lacks = tuple(name for name in needed if name not in by_robot)
            observations.append(Observation(view, states[key], seer, seen, robots, lacks))
    return tuple(sorted(observations, key=lambda value: index_of[value.view.number]))


def robot_rows_at_stops(
    declaration: Declaration, views: Sequence[View]
) -> dict[int, Mapping[str, View]]:
    """Rows with the robots' poses at each row's stop: by view number, then by robot."""
    return {
        row.number: robot_rows for rows, robot_rows in _stops(declaration, views) for row in rows
    }


def _still_since(views: Iterable[View]) -> dict[int, int]:
    """First view of each run of one robot's rows in which it stood still, by view number."""
    run_starts: dict[int, int] = {}
    first: View | None = None
    last_s: float | None = None
    for view in views:
        has_times = view.stamp_s is not None and last_s is not None
        # Two minutes apart, the robot may have moved in between.
        is_late = has_times and abs((view.stamp_s or 0.0) - (last_s or 0.0)) > 120.0
        if first is None or moved(first, view) or is_late:
            first = view
        last_s, run_starts[view.number] = view.stamp_s, first.number
    return run_starts


def moved(first: View, second: View) -> bool:
    """Whether two rows differ in pose by more than noise, or in loads."""
    if any(first.numbers.get(name) != second.numbers.get(name) for name in LOAD):
        return True
    before, after = (
        [view.numbers.get(name, math.nan) for name in POSE] for view in (first, second)
    )
    if not math.isnan(before[0] + after[0]):
        units = [[value / math.hypot(*pose[3:]) for value in pose[3:]] for pose in (before, after)]
        # Quaternions q and -q are the same rotation; its angle is twice that between quaternions.
        chord = min(math.dist(units[0], [sign * unit for unit in units[1]]) for sign in (1.0, -1.0))
        # Readings of a robot that stands still are noisy [m, rad].
        return math.dist(before[:3], after[:3]) > 1e-4 or 2.0 * chord > 1e-4
    joints = first.joints_rad, second.joints_rad
    if joints[0] is None or joints[1] is None or joints[0].shape != joints[1].shape:
        return True
    return bool(np.abs(joints[0] - joints[1]).max() > 1e-4)


def stop_warnings(declaration: Declaration, views: Sequence[View]) -> Iterator[str]:
    """Warnings of rows whose pose of a robot contradicts their stop."""
    for rows, robot_rows in _stops(declaration, views):
        for view in rows:
            robot = name_of(declaration, "robot", view)
            if has_robot_state(view) and _differ(view, robot_rows[robot]):
                of = f" of robot {robot}" if robot else ""
                yield (
                    f"views.csv: view {view.number} has another pose{of} than view "
                    f"{robot_rows[robot].number} of the same stop {view.stop}. One of the two "
                    "belongs to another stop."
                )


def _stops(
    declaration: Declaration, views: Sequence[View]
) -> list[tuple[Sequence[View], dict[str, View]]]:
    """Groups rows by stop number; without one, by runs in which their robot stood still.

    Returns:
        The rows of each stop, and for each robot the row with the pose that most of them agree on.
    """
    groups: dict[tuple[int, int], list[View]] = {}
    rows_of: dict[str, list[View]] = {}
    for view in views:
        if view.stop is None and not view.is_of_lens and has_robot_state(view):
            rows_of.setdefault(name_of(declaration, "robot", view), []).append(view)
    since = {
        row: first
        for robot_views in rows_of.values()
        for row, first in _still_since(robot_views).items()
    }
    for view in views:
        is_single = view.stop is None or view.is_of_lens
        key = (1, since.get(view.number, view.number)) if is_single else (0, view.stop or 0)
        groups.setdefault(key, []).append(view)
    return [(rows, _robot_rows(declaration, rows)) for rows in groups.values()]


def _robot_rows(declaration: Declaration, rows: Sequence[View]) -> dict[str, View]:
    rows_of: dict[str, list[View]] = {}
    for view in rows:
        if has_robot_state(view):
            rows_of.setdefault(name_of(declaration, "robot", view), []).append(view)
    majority = {}
    for robot, robot_views in rows_of.items():
        counts = Counter(view.robot_cells for view in robot_views)
        first = {view.robot_cells: view for view in robot_views[::-1]}
        votes = Counter(
            {a: sum(counts[b] for b in counts if not _differ(first[a], first[b])) for a in counts}
        )
        majority[robot] = first[votes.most_common(1)[0][0]]
    return majority


def _differ(first: View, second: View) -> bool:
    """Whether two rows have different poses of one robot."""
    if first.robot_cells == second.robot_cells:
        return False
    before, after = first.matrix(POSE), second.matrix(POSE)
    if before is not None and after is not None:
        mm, deg = pose_difference(before, after)
        return mm > APART_MM or deg > APART_DEG
    joints = first.joints_rad, second.joints_rad
    if joints[0] is None or joints[1] is None or joints[0].shape != joints[1].shape:
        return False
    return bool(np.abs(joints[0] - joints[1]).max() > APART_RAD)

"""The rows of a session as what they are observations of: who saw what, and how robots stood."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.transforms import pose_difference
from visioncal.session.columns import LOAD, POSE, joint_columns
from visioncal.session.document import Declaration
from visioncal.session.frames import observed, robots_between
from visioncal.session.kinds import has_robot_state, name_of
from visioncal.session.table import View

# Reports of one robot at one stop that are farther apart are of two poses [mm, deg, rad].
_APART_MM, _APART_DEG, _APART_RAD = 1.0, 0.1, 2e-3
# Reports of a robot that stands still differ by what its readings tremble: no motion is as small.
_STILL_M, _STILL_RAD = 1e-4, 1e-4
# Views of one pose that were taken farther apart than this are of different visits [s].
LONG_S = 120.0


@dataclass(frozen=True, eq=False)
class Observation:
    """One thing seen by another while the robots stood still.

    Attributes:
        view: Its row.
        station: Which state of the cell it is of; all rows of a stop share one, unless they give
            different poses of a robot.
        seer: The frame of the camera or instrument.
        seen: The frame of the target or point.
        robots: The row with the pose of each robot between the two at this stop.
        lacks: The robots between the two of which no row of the stop has a pose.
    """

    view: View
    station: int
    seer: str
    seen: str
    robots: Mapping[str, View]
    lacks: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _StopRows:
    """The rows of one stop, and for each robot the row whose pose most of them agree with."""

    rows: tuple[View, ...]
    robot_rows: Mapping[str, View]


def observations_of(
    declaration: Declaration, views: Sequence[View], frames: Mapping[str, str]
) -> tuple[Observation, ...]:
    """Lists what was observed, in the order of the rows.

    Args:
        declaration: What the session declares.
        views: Its rows.
        frames: What hangs on what, as `resolve_frames` gives it.

    Returns:
        One observation a row that has one: rows that only have a robot's pose have none.
    """
    place_of = {view.number: at for at, view in enumerate(views)}
    found, station = [], 0
    for stop in _stops(declaration, views):
        # Rows that have other poses than the rest are of a state of the cell of their own.
        states: dict[tuple[int, ...], int] = {}
        for view in stop.rows:
            own = {name_of(declaration, "robot", view): view} if has_robot_state(view) else {}
            strays = {name: row for name, row in own.items() if _differ(row, stop.robot_rows[name])}
            by_robot = {**stop.robot_rows, **strays}
            key = tuple(by_robot[name].number for name in sorted(by_robot))
            seer, seen = observed(declaration, view)
            if not seer:
                continue
            if key not in states:
                states[key], station = station, station + 1
            needed = () if view.is_of_lens else robots_between(frames, seer, seen)
            robots = {name: by_robot[name] for name in needed if name in by_robot}
            lacks = tuple(name for name in needed if name not in by_robot)
            found.append(Observation(view, states[key], seer, seen, robots, lacks))
    return tuple(sorted(found, key=lambda value: place_of[value.view.number]))


def standing(declaration: Declaration, views: Sequence[View]) -> dict[int, Mapping[str, View]]:
    """Of each row, by its view: the rows with the robots' poses at its stop, by robot."""
    found: dict[int, Mapping[str, View]] = {}
    for stop in _stops(declaration, views):
        found |= dict.fromkeys((row.number for row in stop.rows), stop.robot_rows)
    return found


def _still_since(views: Iterable[View]) -> dict[int, int]:
    """Of each row of one robot, by its view: the row since which the robot has not moved."""
    found: dict[int, int] = {}
    first = last = None
    for view in views:
        if first is None or last is None or _moved(first, view) or _long(last, view):
            first = view
        last, found[view.number] = view, first.number
    return found


def _moved(first: View, second: View) -> bool:
    """Whether two rows have poses that differ by more than readings of one pose do, or loads."""
    if any(first.numbers.get(name) != second.numbers.get(name) for name in LOAD):
        return True
    before, after = (
        [view.numbers.get(name, math.nan) for name in POSE] for view in (first, second)
    )
    if not math.isnan(before[0] + after[0]):
        units = [[value / math.hypot(*pose[3:]) for value in pose[3:]] for pose in (before, after)]
        # A quaternion and its negative are the same rotation, by twice the angle between them.
        chord = min(math.dist(units[0], [sign * unit for unit in units[1]]) for sign in (1.0, -1.0))
        return math.dist(before[:3], after[:3]) > _STILL_M or 2.0 * chord > _STILL_RAD
    joints = first.joints_rad, second.joints_rad
    if joints[0] is None or joints[1] is None or joints[0].shape != joints[1].shape:
        return True
    return bool(np.abs(joints[0] - joints[1]).max() > _STILL_RAD)


def _long(first: View, second: View) -> bool:
    """Whether so much time lies between two rows that the robot may have been elsewhere."""
    if first.stamp_s is None or second.stamp_s is None:
        return False
    return abs(second.stamp_s - first.stamp_s) > LONG_S


def stop_warnings(declaration: Declaration, views: Sequence[View]) -> Iterator[str]:
    """Words rows that have another pose of a robot than the rest of their stop."""
    for stop in _stops(declaration, views):
        for view in stop.rows:
            robot = name_of(declaration, "robot", view)
            if has_robot_state(view) and _differ(view, stop.robot_rows[robot]):
                of = f" of robot {robot}" if robot else ""
                yield (
                    f"views.csv: view {view.number} has another pose{of} than view "
                    f"{stop.robot_rows[robot].number} of the same stop {view.stop}. One of the two "
                    "belongs to another stop."
                )


def _stops(declaration: Declaration, views: Sequence[View]) -> list[_StopRows]:
    """Groups rows by their stop; without one, by runs in which their robot stood still."""
    groups: dict[tuple[int, int], list[View]] = {}
    rows_of: dict[str, list[View]] = {}
    for view in views:
        if view.stop is None and not view.is_of_lens and has_robot_state(view):
            rows_of.setdefault(name_of(declaration, "robot", view), []).append(view)
    since = {row: first for mine in rows_of.values() for row, first in _still_since(mine).items()}
    for view in views:
        alone = view.stop is None or view.is_of_lens
        key = (1, since.get(view.number, view.number)) if alone else (0, view.stop or 0)
        groups.setdefault(key, []).append(view)
    return [_StopRows(tuple(rows), _robot_rows(declaration, rows)) for rows in groups.values()]


def _robot_rows(declaration: Declaration, rows: Sequence[View]) -> dict[str, View]:
    """Of each robot, the row with the pose that most rows of a stop agree on."""
    rows_of: dict[str, list[View]] = {}
    for view in rows:
        if has_robot_state(view):
            rows_of.setdefault(name_of(declaration, "robot", view), []).append(view)
    agreed = {}
    for robot, mine in rows_of.items():
        counts, first = (
            Counter(map(_pose_cells, mine)),
            {_pose_cells(view): view for view in mine[::-1]},
        )
        agreeing = Counter(
            {a: sum(counts[b] for b in counts if not _differ(first[a], first[b])) for a in counts}
        )
        agreed[robot] = first[agreeing.most_common(1)[0][0]]
    return agreed


def _pose_cells(view: View) -> tuple[float | None, ...]:
    """What a row says of where its robot stood: most rows of a stop repeat it to the digit."""
    names = (*POSE, *joint_columns(tuple(view.numbers)))
    return tuple(view.numbers.get(name) for name in names)


def _differ(first: View, second: View) -> bool:
    """Whether two rows have different poses of one robot."""
    if _pose_cells(first) == _pose_cells(second):
        return False
    poses = first.base_from_flange(), second.base_from_flange()
    if poses[0] is not None and poses[1] is not None:
        mm, deg = pose_difference(poses[0].as_matrix(), poses[1].as_matrix())
        return mm > _APART_MM or deg > _APART_DEG
    joints = first.joints_rad, second.joints_rad
    if joints[0] is None or joints[1] is None or joints[0].shape != joints[1].shape:
        return False
    return bool(np.abs(joints[0] - joints[1]).max() > _APART_RAD)

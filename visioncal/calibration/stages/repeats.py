"""Rows that repeat others: copies of a reading say nothing new about arm, camera or noise."""

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of
from visioncal.core.types import Corners, FloatArray
from visioncal.core.verdict import LEAST_NEED_MM, REPEATED_READINGS, Finding, Remedy
from visioncal.session import Observation, Session, View
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, joint_columns
from visioncal.session.observations import APART_DEG, APART_MM, APART_RAD

T = TypeVar("T", bound=Observed)

# Corners of two exposures of one scene differ by the camera's noise in some corner, by more than
# this [px]; a picture that was stored anew in another file does not.
_APART_PX = 0.01


@dataclass(frozen=True, eq=False)
class _Row:
    """An observation for comparison with others."""

    view: int  # Its number.
    # What is equal in rows that are compared at all: who observes what, the kinds of numbers, and
    # other measurements such as loads and temperatures.
    alike: Hashable
    stamp_s: float | None  # When it was taken; None where that is not known.
    stop: int | None  # The stop that it states; None where it states none.
    # State of the robots and what was read, in units of what rows of one stop may differ by.
    numbers: FloatArray
    read: int  # How many of these, at the end, were read.
    is_image: bool  # Whether corners were read.

    def is_repeated_by(self, other: "_Row") -> bool:
        """Whether another row, of nearly the same numbers, is a copy of this one.

        Corners and exact numbers are never read twice; others are, at another time or stop.
        """
        stated = ((self.stamp_s, other.stamp_s), (self.stop, other.stop))
        is_apart = any(None not in pair and pair[0] != pair[1] for pair in stated)
        if self.is_image or not is_apart:
            return True
        read = np.s_[len(self.numbers) - self.read :]
        return np.array_equal(self.numbers[read], other.numbers[read])


def without_repeats(seen: T) -> T:
    """Leaves out rows that repeat others, and reports them; of each reading the first row is used.

    The corners are of all cameras, and no pose is known yet.
    """
    try:
        repeated = repeated_rows(seen.timed, seen.corners)
    except DataError:
        # Where the robot is cannot be told yet, and whether it is where it was neither.
        return seen
    if not repeated:
        return seen
    for frame, look in seen.cameras.items():
        unique = {view: px for view, px in look.corners.items() if view not in repeated}
        seen = seen.with_camera(frame, replace(look, corners=unique))
    views = {view.number: view for view in seen.session.views}

    def is_copy(number: int) -> bool:
        one, other = (_read(views[at], seen.corners.get(at)) for at in (number, repeated[number]))
        return one is None or other is None or np.array_equal(one[1], other[1])

    # Readings that differ may be of another time that is not stated, and some of them are equal by
    # the instrument's resolution.
    copies = sum(map(is_copy, repeated))
    kind = "repeated_views" if 2 * copies > len(repeated) else REPEATED_READINGS
    repeats = {view: f"repeats view {earlier}" for view, earlier in repeated.items()}
    return replace(seen, repeats=repeats).noting((), (_finding(kind, repeated),))


def repeated_rows(session: Session, corners: Mapping[int, Corners]) -> dict[int, int]:
    """The earlier view that each repeated one is a copy of, by view, with all cameras' corners."""
    groups = defaultdict(list)
    for row in _rows(session, corners):
        groups[row.alike].append(row)
    repeated: dict[int, int] = {}
    for rows in groups.values():
        numbers = np.array([row.numbers for row in rows])
        # Rows that may be near are those near in the number that differs most.
        widest = numbers[:, np.ptp(numbers, axis=0).argmax()] if numbers.size else np.zeros(1)
        order = np.argsort(widest, kind="stable")
        for at, row in enumerate(rows):
            if row.view in repeated:
                continue
            first, end = np.searchsorted(widest[order], [widest[at] - 1.0, widest[at] + 1.0])
            near = order[first : end + 1]
            near = near[np.abs(numbers[near] - row.numbers).max(axis=1, initial=0.0) <= 1.0]
            later = (rows[index] for index in near.tolist() if index > at)
            for other in later:
                if other.view not in repeated and row.is_repeated_by(other):
                    repeated[other.view] = row.view
    return {view: repeated[view] for view in sorted(repeated)}


def _rows(session: Session, corners: Mapping[int, Corners]) -> Iterator[_Row]:
    for observation in session.observations:
        read = _read(observation.view, corners.get(observation.view.number))
        if read is None:
            continue
        ids, reading = read
        states = [_state(observation.robots[name]) for name in sorted(observation.robots)]
        view, known = observation.view, all(map(len, states)) and not observation.missing_robots
        yield _Row(
            view.number,
            (
                (observation.seer, observation.seen),
                ids,
                len(reading),
                tuple(map(len, states)),
                _others(observation),
                # A robot's pose in its stream is that of the time.
                None if known else view.stamp_s,
            ),
            view.stamp_s,
            view.stop,
            np.concatenate([*states, reading]),
            len(reading),
            bool(ids),
        )


def _read(view: View, found: Corners | None) -> tuple[bytes, FloatArray] | None:
    """Which corners were seen, and what was read; None where nothing is left of it."""
    if found is not None:
        if not len(found.ids):
            return None
        return found.ids.tobytes(), np.ravel(found.px) / _APART_PX
    pose = view.cam_from_target()
    pose = view.instrument_from_probe() if pose is None else pose
    if pose is not None:
        return b"", _entries(pose)
    place = view.reading_m
    return None if place is None else (b"", place * (1e3 / APART_MM))


def _state(row: View) -> FloatArray:
    """Pose and joints of a robot as a row has them, as far as it has them."""
    pose, joints = row.base_from_flange(), row.joints_rad
    parts = [] if pose is None else [_entries(pose)]
    parts += [] if joints is None else [joints / APART_RAD]
    return np.concatenate([np.zeros(0), *parts])


def _entries(pose: RigidTransform) -> FloatArray:
    matrix = pose.as_matrix()
    rotation = matrix[:3, :3].ravel() / np.deg2rad(APART_DEG)
    return np.concatenate([matrix[:3, 3] * (1e3 / APART_MM), rotation])


def _others(observation: Observation) -> tuple[tuple[str, float], ...]:
    """What else the rows of an observation measured: loads, temperatures, torques."""
    rows = [observation.view, *(observation.robots[name] for name in sorted(observation.robots))]
    compared = {*POSE, *MEASURED_CAM_POSE, "stamp_s"}
    return tuple(
        (name, value)
        for row in rows
        for name, value in sorted(row.numbers.items())
        if name not in compared
        and not name.startswith("meas_")
        and name not in joint_columns((name,))
    )


def _finding(kind: str, repeated: Mapping[int, int]) -> Finding:
    copies, originals = list(repeated), list(dict.fromkeys(repeated.values()))
    one = len(repeated) == 1
    rows, repeat = ("row", "repeats") if one else ("rows", "repeat")
    views, their = ("View", "its") if one else ("Views", "their")
    return Finding(
        kind,
        f"{views} {listed(copies)} {repeat} {listed(originals)}: what was read is the same, or "
        f"differs by less than {APART_MM:g} mm and {APART_DEG:g} deg at the same pose and without "
        "a time or a stop of its own. They count once.",
        Remedy(
            f"In views.csv, delete the {rows} of {views.lower()} {listed(copies)}; or, if they "
            f"were read anew, write {their} times into stamp_s, or {their} stops into stop."
        ),
        tuple(copies),
        until_mm=LEAST_NEED_MM,
    )


def listed(views: Sequence[int]) -> str:
    """View numbers in words; consecutive ones as a range."""
    if len(views) > 2 and all(after == before + 1 for before, after in pairwise(views)):
        return f"{views[0]} to {views[-1]}"
    return some_of([str(view) for view in views])

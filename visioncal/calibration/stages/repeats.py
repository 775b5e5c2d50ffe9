"""Rows that repeat others: copies of a reading say nothing new about arm, camera or noise."""

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError
from visioncal.core.finding_kinds import REPEATED_READINGS
from visioncal.core.number_format import some_of
from visioncal.core.types import Corners, FloatArray
from visioncal.core.verdict import LEAST_NEED_MM, Finding, Remedy
from visioncal.session import Observation, Session
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, joint_columns
from visioncal.session.observations import APART_DEG, APART_MM, APART_RAD

T = TypeVar("T", bound=Observed)

# Corners of two exposures of one scene differ by the camera's noise in some corner, by more than
# this [px]; a picture that was stored anew in another file does not.
_APART_PX = 0.01
# Images of one stop that are enough for a mean, and the greatest distance of half of the corners of
# one of them from that of most [px]: beyond, the arm did not stand still.
_MANY, _STANDING_PX = 4, 0.5
# Fewest stops of a camera whose images are averaged: those of fewer are too few views then.
_FEWEST_STOPS = 3


@dataclass(frozen=True, eq=False)
class _Row:
    """An observation for comparison with others."""

    view: int  # Its number.
    # What is equal in rows that are compared at all: who observes what, the kinds of numbers, and
    # other measurements such as loads and temperatures.
    alike: Hashable
    # When it was taken, and the stop that it states; None for what is not known.
    stated: tuple[float | None, int | None]
    state: FloatArray  # State of the robots, in units of what rows of one stop may differ by.
    reading: FloatArray  # What was read, in such units.
    is_image: bool  # Whether corners were read.

    def is_repeated_by(self, other: "_Row") -> bool:
        """Whether another row, of nearly the same numbers, is a copy of this one.

        Corners and exact numbers are never read twice; others are, at another time or stop.
        """
        pairs = zip(self.stated, other.stated, strict=True)
        is_apart = any(None not in pair and pair[0] != pair[1] for pair in pairs)
        return self.is_image or not is_apart or np.array_equal(self.reading, other.reading)


def without_repeats(seen: T) -> T:
    """Leaves out rows that repeat others, and reports them; of each reading the first row is used.

    The corners are of all cameras, and no pose is known yet.
    """
    try:
        repeated, copies = repeated_rows(seen.timed, seen.corners)
    except DataError:
        # Where the robot is cannot be told yet, and whether it is where it was neither.
        return seen
    if not repeated:
        return seen
    for frame, look in seen.cameras.items():
        unique = {view: px for view, px in look.corners.items() if view not in repeated}
        seen = seen.with_camera(frame, replace(look, corners=unique))
    # Readings that differ may be of another time that is not stated, and some of them are equal by
    # the instrument's resolution.
    kind = "repeated_views" if 2 * copies > len(repeated) else REPEATED_READINGS
    originals = listed([*dict.fromkeys(repeated.values())])
    views, repeat, rows, their = (
        ("View", "repeats", "row", "its")
        if len(repeated) == 1
        else ("Views", "repeat", "rows", "their")
    )
    finding = Finding(
        kind,
        f"{views} {listed([*repeated])} {repeat} {originals}: what was read is the same, or "
        f"differs by less than {APART_MM:g} mm and {APART_DEG:g} deg at the same pose and without "
        "a time or a stop of its own. They count once.",
        Remedy(
            f"In views.csv, delete the {rows} of {views.lower()} {listed([*repeated])}; or, if "
            f"they were read anew, write {their} times into stamp_s, or {their} stops into stop."
        ),
        tuple(repeated),
        until_mm=LEAST_NEED_MM,
    )
    repeats = {view: f"repeats view {earlier}" for view, earlier in repeated.items()}
    return replace(seen, repeats=repeats).noting((), (finding,))


def with_stop_means(seen: T) -> T:
    """Takes the mean of the corners of many images of a board at one stop of a camera.

    They share the errors of arm, lens and print, and differ by noise alone. The first view stands
    for all: a film of twelve stops is calibrated as twelve views.
    """
    groups = defaultdict(list)
    try:
        for row in seen.timed.observations:
            if not row.view.is_of_lens:
                at = row.seer, row.seen, row.station, row.view.holdout
                groups[at].append(row.view.number)
    except DataError:
        return seen
    joined = dict[int, int]()
    for frame, look in seen.cameras.items():
        corners = dict(look.corners)
        shown = [
            [look.corners[view] for view in views if view in look.corners]
            for (seer, *_), views in groups.items()
            if seer == frame
        ]
        for own in shown if sum(map(bool, shown)) >= _FEWEST_STOPS else ():
            if len(own) >= _MANY:
                mean, others = _mean_of(own)
                corners[mean.view] = mean
                joined |= dict.fromkeys(others, mean.view)
        left = {view: found for view, found in corners.items() if view not in joined}
        seen = seen.with_camera(frame, replace(look, corners=left))
    means = {
        view: f"counts in the mean of view {first}, of its stop" for view, first in joined.items()
    }
    return replace(seen, repeats={**seen.repeats, **means})


def _mean_of(images: Sequence[Corners]) -> tuple[Corners, list[int]]:
    """Mean of the images of one stop, as the first of them, and the other views that are in it."""
    ids = np.unique(np.concatenate([image.ids for image in images]))
    px, weights = np.full((len(images), len(ids), 2), np.nan), np.zeros((len(images), len(ids)))
    for at, image in enumerate(images):
        places = np.searchsorted(ids, image.ids)
        px[at, places], weights[at, places] = image.px, 1.0
        if image.weights is not None:
            weights[at, places] = image.weights
    middle = np.nanmedian(px, axis=0)
    away = np.nanmedian(np.linalg.norm(px - middle, axis=2), axis=1)
    standing = np.flatnonzero(away < _STANDING_PX)
    count = np.isfinite(px[standing, :, 0]).sum(axis=0)
    seen = 2 * count > len(standing)
    if len(standing) < _MANY or not seen.any():
        return images[0], []
    first = images[standing[0]]
    # Stated noise is that of one image.
    is_stated = first.stated_px is not None or first.weights is not None
    total = np.sqrt(np.sum(weights[standing][:, seen] ** 2, axis=0))
    mean = replace(
        first,
        ids=ids[seen],
        px=np.nanmean(px[standing][:, seen], axis=0),
        weights=total if is_stated else None,
    )
    return mean, [images[at].view for at in standing[1:].tolist()]


def repeated_rows(session: Session, corners: Mapping[int, Corners]) -> tuple[dict[int, int], int]:
    """The earlier view by repeated one, and how many of these are copies of a picture or number.

    `corners` are those of all cameras, by view.
    """
    groups = defaultdict(list)
    for row in _rows(session, corners):
        groups[row.alike].append(row)
    repeated, copies = dict[int, int](), 0
    for rows in groups.values():
        numbers = np.array([np.append(row.state, row.reading) for row in rows])
        # Their pairs that are near in all numbers, by the earlier row.
        for first, later in sorted(cKDTree(numbers).query_pairs(1.0, p=np.inf)):
            row, other = rows[first], rows[later]
            is_new = not {row.view, other.view} & repeated.keys()
            if is_new and row.is_repeated_by(other):
                repeated[other.view] = row.view
                copies += row.is_image or np.array_equal(row.reading, other.reading)
    return {view: repeated[view] for view in sorted(repeated)}, copies


def _rows(session: Session, corners: Mapping[int, Corners]) -> Iterator[_Row]:
    for observation in session.observations:
        view, found = observation.view, corners.get(observation.view.number)
        ids, place = b"", view.reading_m
        pose = view.cam_from_target()
        pose = view.instrument_from_probe() if pose is None else pose
        if found is not None and len(found.ids):
            ids, reading = found.ids.tobytes(), np.ravel(found.px) / _APART_PX
        elif found is None and pose is not None:
            reading = _entries(pose)
        elif found is None and place is not None:
            reading = place * (1e3 / APART_MM)
        else:
            continue
        states = []
        for name in sorted(observation.robots):
            robot = observation.robots[name]
            pose, joints = robot.base_from_flange(), robot.joints_rad
            parts = [] if pose is None else [_entries(pose)]
            parts += [] if joints is None else [joints / APART_RAD]
            states.append(np.concatenate([np.zeros(0), *parts]))
        sizes = tuple(map(len, states))
        # A robot's pose in its stream is that of the time.
        time = None if all(sizes) and not observation.missing_robots else view.stamp_s
        who = (observation.seer, observation.seen)
        yield _Row(
            view.number,
            (who, ids, len(reading), sizes, _others(observation), time),
            (view.stamp_s, view.stop),
            np.concatenate([np.zeros(0), *states]),
            reading,
            bool(ids),
        )


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


def listed(views: Sequence[int]) -> str:
    """View numbers in words; consecutive ones as a range."""
    if len(views) > 2 and all(after == before + 1 for before, after in pairwise(views)):
        return f"{views[0]} to {views[-1]}"
    return some_of([str(view) for view in views])

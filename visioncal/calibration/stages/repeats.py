"""Rows that repeat others: copies of a reading say nothing new about arm, camera or noise."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from visioncal.calibration.stages.observed import Observed
from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.number_format import ranges
from visioncal.core.types import Corners, FloatArray
from visioncal.core.verdict import LEAST_NEED_MM, Finding, Remedy
from visioncal.session import Session, View
from visioncal.session.columns import MEASURED_CAM_POSE, POSE, joint_columns
from visioncal.session.observations import APART_DEG, APART_MM, APART_PX, APART_RAD

T = TypeVar("T", bound=Observed)

# Numbers of a pose (3, 4) by which rows of one stop may differ [rad, m].
_UNITS = np.array([np.deg2rad(APART_DEG)] * 3 + [1e-3 * APART_MM])
# Images of one stop that are enough for a mean.
_MANY = 4


def without_repeats(seen: T) -> T:
    """Leaves out rows that repeat others, and reports them; of each reading the first row is used.

    The corners are of all cameras, and no pose is known yet.
    """
    try:
        repeated = repeated_rows(seen.timed, seen.corners)
    except DataError:
        # The robot's poses are not known yet, and so not which of them are repeated.
        return seen
    if not repeated:
        return seen
    for frame, look in seen.cameras.items():
        unique = {view: px for view, px in look.corners.items() if view not in repeated}
        seen = seen.with_camera(frame, replace(look, corners=unique))
    rows = {view.number: view for view in seen.timed.views}
    # An instrument is read several times at a stop; its last digit may be alike.
    anew = {
        view
        for view, first in repeated.items()
        if rows[view].reading_m is not None and rows[view].stop == rows[first].stop is not None
    }
    repeats = {
        view: "read anew at its stop, which counts once"
        if view in anew
        else f"repeats view {earlier}"
        for view, earlier in repeated.items()
    }
    seen = replace(seen, repeats=repeats)
    repeated = {view: first for view, first in repeated.items() if view not in anew}
    if not repeated:
        return seen
    views, originals = ranges(repeated), ranges(dict.fromkeys(repeated.values()))
    # Readings may be of another time that is not stated.
    finding = Finding(
        "repeated_views" if seen.corners else "repeated_readings",
        f"Views {views} repeat {originals}: what was read is the same, or differs by less than "
        f"{APART_MM:g} mm and {APART_DEG:g} deg at the same pose and without a time or a stop of "
        "its own. They count once.",
        Remedy(
            f"In views.csv, delete the rows of views {views}; or, if they were read anew, write "
            "their times into stamp_s, or their stops into stop."
        ),
        tuple(repeated),
        until_mm=LEAST_NEED_MM,
    )
    return seen.noting((), (finding,))


def with_stop_means(seen: T) -> T:
    """Takes the mean of the corners of many images of a board at one stop of a camera.

    Images of one stop share the errors of arm, lens and print, and differ by noise alone. The first
    view stands for all: a film of twelve stops is calibrated as twelve views.
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
        for stop_corners in shown if sum(map(bool, shown)) >= FEWEST_VIEWS else ():
            if len(stop_corners) >= _MANY:
                mean, others = _mean_of(stop_corners)
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
    # Greatest distance of half of the corners of an image from that of most [px]: beyond, the arm
    # did not stand still.
    standing = np.flatnonzero(away < 0.5)
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


def repeated_rows(session: Session, corners: Mapping[int, Corners]) -> dict[int, int]:
    """The earlier view by repeated one; `corners` are those of all cameras, by view."""
    groups, known = defaultdict(list), dict[int, list[FloatArray]]()
    for row in session.observations:
        view, found = row.view, corners.get(row.view.number)
        measured = [
            _entries(view.matrix(MEASURED_CAM_POSE)),
            _entries(view.instrument_from_probe()),
        ]
        reading = np.concatenate(measured)
        if found is not None:
            reading = found.px.ravel() / APART_PX
        elif not len(reading) and view.reading_m is not None:
            reading = view.reading_m * (1e3 / APART_MM)
        if not len(reading):
            continue
        robots, states = [robot for _, robot in sorted(row.robots.items())], [np.zeros(0)]
        for robot in robots:
            if robot.number not in known:
                # Of its pose and joints, in units of what rows of one stop may differ by.
                q, pose = robot.joints_rad, _entries(robot.matrix(POSE))
                known[robot.number] = [pose, *([] if q is None else [q / APART_RAD])]
            states += known[robot.number]
        # Who observes what, and what else is measured. A robot's pose in its stream is that of the
        # time.
        alike = (
            bool(row.robots),
            *(row.seer, row.seen, None if found is None else found.ids.tobytes()),
            *map(len, states),
            *(_others(one) for one in (view, *robots)),
            view.stamp_s if row.missing_robots else None,
        )
        groups[alike].append((view, np.concatenate([*states, reading])))
    repeated = dict[int, int]()
    for (is_by_robot, *_), rows in groups.items():
        # The pairs that are near in all numbers, by the earlier row.
        tree = cKDTree([numbers for _, numbers in rows])
        exact = [numbers.tobytes() for _, numbers in rows]
        for first, later in sorted(tree.query_pairs(1.0, p=np.inf)):
            (view, _), (other, _) = rows[first], rows[later]
            # Exact numbers are never read twice, and corners only where all stands still;
            # others are, at another time or stop.
            pairs = (view.stamp_s, other.stamp_s), (view.stop, other.stop)
            is_apart = any(None not in pair and pair[0] != pair[1] for pair in pairs)
            is_image = is_by_robot and view.number in corners
            is_copy = is_image or not is_apart or exact[first] == exact[later]
            if is_copy and not {view.number, other.number} & repeated.keys():
                repeated[other.number] = view.number
    return dict(sorted(repeated.items()))


def _entries(pose: FloatArray | None) -> FloatArray:
    """Numbers of a pose in the same units; none for none."""
    return np.zeros(0) if pose is None else np.asarray((pose[:3] / _UNITS).ravel())


def _others(row: View) -> frozenset[tuple[str, float]]:
    """Other measurements of a row: loads, temperatures, torques."""
    names = _others_among(tuple(row.numbers))
    return frozenset((name, row.numbers[name]) for name in names)


@cache
def _others_among(columns: tuple[str, ...]) -> tuple[str, ...]:
    """Columns of neither a pose, a reading, joints nor the time."""
    compared = {*POSE, *MEASURED_CAM_POSE, "stamp_s", *joint_columns(columns)}
    return tuple(name for name in columns if name not in compared and name[:5] != "meas_")

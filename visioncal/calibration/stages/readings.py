"""Readings of a measuring instrument: positions of points on the flange, or poses of a probe."""

from collections import defaultdict
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple, Self

import numpy as np

from visioncal.calibration.stages.observed import Observed, nothing_seen
from visioncal.calibration.stages.pnp import ViewPoses
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted, did_you_mean, figure, some_of
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray, Rejection
from visioncal.estimation.positions import find_mounting, mounting_problem
from visioncal.estimation.procrustes import align, spreads
from visioncal.session import Session, View
from visioncal.session.kinds import (
    Instrument,
    instrument_names,
    is_camera_observation,
    is_instrument_reading,
    name_of,
    stated_instrument,
)

# Largest distance that a tracker reads [m].
_FARTHEST_M = 160.0
# Points are exchanged where the scatter of a stop's residuals exceeds the median by the first
# factor, and is within the second once they are exchanged back.
_EXCHANGED, _USUAL = 5.0, 2.0
# Least scatter of readings [m]: exact ones would be judged by rounding errors.
_LEAST_SCATTER_M = 1e-7
# Points whose width is below this share of their length count as on a line.
_LINE = 0.1


class Reading(NamedTuple):
    """One reading of an instrument."""

    pose: FloatArray  # (4, 4) `instrument_from_probe`; with the identity for a position alone.
    point: int  # Index of the point.


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of an instrument."""

    instrument: Instrument  # Its noise.
    # The points in the order in which they first appear; a single one may have no name.
    names: tuple[str, ...]
    views: Mapping[int, Reading]  # The readings, by view.
    are_poses: bool  # Whether the probe's rotation was read, too.
    rejections: tuple[Rejection, ...]  # Rows that are of no use.

    @property
    def sigma_m(self) -> float:
        """Median noise of a coordinate [m]."""
        places = np.array([reading.pose[:3, 3] for reading in self.views.values()])
        return float(np.median(self.instrument.sigmas_m(places)))

    def without(self, views: Collection[int]) -> Self:
        """Removes the readings of some views."""
        kept = {view: reading for view, reading in self.views.items() if view not in views}
        return replace(self, views=kept)


def read_instrument(session: Session) -> Readings:
    """Collects and checks an instrument's readings.

    Raises:
        DataError: The instrument's noise is not known, readings are in millimetres, some have a
            rotation and some none, or a point's name is missing or misspelt.
    """
    rows = [view for view in session.views if view.reading_m is not None]
    _check_unit(rows)
    are_poses, instrument = _are_poses(rows), _instrument(session, rows)
    names, rejected = _names(rows, are_poses=are_poses)
    lost = {rejection.view for rejection in rejected}
    used = [view for view in rows if view.number not in lost]
    missing = [
        Rejection(view.number, "no reading of the instrument: meas_x_m ... are empty")
        for view in session.views
        if view.reading_m is None
    ]
    return Readings(
        instrument,
        names,
        {view.number: Reading(_probe(view), names.index(view.point)) for view in used},
        are_poses,
        (*missing, *rejected),
    )


def probe_poses(session: Session, readings: Readings) -> dict[int, FloatArray]:
    """Poses (4, 4) of a probe on the flange, in the instrument's frame, by one view of each stop.

    Without a probe they are fitted to all points of a stop, relative to the first complete stop;
    empty with fewer than three points, or with points on a line.
    """
    if readings.are_poses:
        return {view: reading.pose for view, reading in readings.views.items()}
    stop_of, count = _stops(session), len(readings.names)
    stops: dict[Hashable, dict[int, int]] = defaultdict(dict)
    for view, reading in readings.views.items():
        stops[stop_of[view]][reading.point] = view
    views = [[stop[at] for at in range(count)] for stop in stops.values() if len(stop) == count]
    if count < 3 or not views:
        return {}
    positions = np.array([[readings.views[view].pose[:3, 3] for view in group] for group in views])
    extents = spreads(positions[0])[0]
    if extents[1] < _LINE * extents[0]:
        return {}
    return {view[0]: align(at, positions[0]) for view, at in zip(views, positions, strict=True)}


def _stops(session: Session) -> dict[int, Hashable]:
    """The stop of each view."""
    return {observation.view.number: observation.station for observation in session.observations}


def read_instruments(session: Session) -> dict[int, ViewPoses]:
    """Reads all instruments of a cell, by view; for positions alone, the rotation has no meaning.

    Raises:
        DataError: An instrument's noise is not known, or its readings are in millimetres.
    """
    rows: dict[str, list[View]] = {}
    for observation in session.observations:
        if is_instrument_reading(observation.view) and not is_camera_observation(observation.view):
            rows.setdefault(observation.seer, []).append(observation.view)
    sightings = {}
    for of_instrument in rows.values():
        _check_unit(of_instrument)
        instrument = _instrument(session, of_instrument)
        for view in of_instrument:
            probe = _probe(view)
            sigma_m = float(instrument.sigmas_m(probe[None, :3, 3])[0])
            variances = np.repeat([(instrument.sigma_rad or 0.0) ** 2, sigma_m**2], 3)
            sightings[view.number] = ViewPoses(
                view.number, None, probe[None], (0,), np.diag(variances)[None], np.zeros((1, 6, 0))
            )
    return sightings


def exchanged_points(observed: Observed, readings: Readings) -> tuple[Rejection, ...]:
    """Finds readings of one robot's points whose names are exchanged.

    Raises:
        DataError: No view can be used.
        DegenerateError: There are too few stops.
    """
    stop_of, poses = _stops(observed.session), observed.base_from_flange
    views = [view for view in readings.views if view in poses and view not in observed.held_back]
    if not views:
        raise nothing_seen(observed)
    stops = np.unique([stop_of[view] for view in views], return_inverse=True)[1]
    _check_stops(readings, stops)
    problem = mounting_problem(
        np.array([poses[view] for view in views]),
        np.array([readings.views[view].pose[:3, 3] for view in views]),
        np.array([readings.views[view].point for view in views], dtype=np.int64),
    )
    with one_blas_thread():
        mounting, errors = find_mounting(problem, stops)
    # An error of the flange's pose moves all points of a stop alike: only their relative positions
    # count.
    all_rows = [np.flatnonzero(stops == stop) for stop in range(stops.max() + 1)]
    rows_of = [rows for rows in all_rows if len(rows) > 1]
    scatter_m = [_scatter_m(errors[rows]) for rows in rows_of]
    usual_m = max(float(np.median(scatter_m)) if scatter_m else 0.0, _LEAST_SCATTER_M)
    rejections = []
    for rows, before_m in zip(rows_of, scatter_m, strict=True):
        pairs = combinations(rows.tolist(), 2) if before_m > _EXCHANGED * usual_m else ()
        for pair in pairs:
            changed = problem.points.copy()
            changed[list(pair)] = changed[list(pair[::-1])]
            restored = replace(problem, points=changed).linearise(mounting).residuals
            after_m = _scatter_m(restored[rows])
            if after_m < _USUAL * usual_m:
                first, second = (readings.names[problem.points[row]] for row in pair)
                words = (
                    f"the points {first} and {second} are exchanged at this stop: changed back, "
                    f"its points agree to {figure(1e3 * after_m)} mm, not {figure(1e3 * before_m)} "
                    "mm"
                )
                rejections += [Rejection(views[row], words) for row in pair]
                break
    return tuple(rejections)


def _probe(view: View) -> FloatArray:
    """(4, 4) the probe's pose; for a position alone, with the identity as rotation."""
    pose, matrix, read_m = view.instrument_from_probe(), np.eye(4), view.reading_m
    if pose is not None:
        return np.asarray(pose.as_matrix())
    matrix[:3, 3] = np.zeros(3) if read_m is None else read_m
    return matrix


def _instrument(session: Session, rows: Sequence[View]) -> Instrument:
    """The instrument that read some rows."""
    table = session.instruments.get(name_of(session.declaration, "instrument", rows[0]))
    if table is None:
        raise DataError(
            "session.toml: rows have an instrument's readings (meas_x_m ...), but nothing says "
            "how good they are.",
            culprits=["session.toml: instrument"],
            next_step="Add [instrument] with sigma_m (and sigma_per_m), or with one of these as "
            f"its name: {', '.join(instrument_names())}.",
        )
    instrument = stated_instrument(table.name, table.sigma_m, table.sigma_per_m, table.sigma_rad)
    has_rotations = any(row.instrument_from_probe() is not None for row in rows)
    if instrument.sigma_rad is None and has_rotations:
        raise DataError(
            f"session.toml: rows have rotations of a probe (meas_qx ...), but how good they are "
            f"is not known of the instrument {table.name!r}.",
            culprits=["session.toml: instrument.sigma_rad"],
            next_step="State sigma_rad in [instrument], or leave the columns meas_qx ... out.",
        )
    return instrument


def _check_unit(rows: Sequence[View]) -> None:
    distance_m = float(np.median([np.linalg.norm(_probe(view)[:3, 3]) for view in rows]))
    if distance_m > _FARTHEST_M:
        raise DataError(
            f"views.csv: the median distance of the readings (meas_x_m, meas_y_m, meas_z_m) from "
            f"the instrument is {distance_m:.4g} m, and no instrument reads farther than "
            f"{_FARTHEST_M:g} m.",
            culprits=["views.csv: meas_x_m, meas_y_m, meas_z_m"],
            next_step="It looks like millimetres: multiply these columns by 0.001.",
        )


def _are_poses(rows: Sequence[View]) -> bool:
    without = [str(row.number) for row in rows if row.instrument_from_probe() is None]
    if 0 < len(without) < len(rows):
        raise DataError(
            f"views.csv: {len(rows) - len(without)} of {len(rows)} readings have the probe's "
            f"rotation (meas_qx ...); view{'s' if len(without) > 1 else ''} {some_of(without)} "
            "have none.",
            culprits=[f"views.csv: view {name}" for name in without],
            next_step="Fill it in everywhere, or leave its columns out.",
        )
    return not without


def _names(rows: Sequence[View], *, are_poses: bool) -> tuple[tuple[str, ...], list[Rejection]]:
    """The points' names, and rows whose point determines nothing."""
    by_name = defaultdict(list)
    for view in rows:
        by_name[view.point].append(view.number)
    if len(by_name) > 1 and "" in by_name:
        others = [name for name in by_name if name]
        raise DataError(
            f"views.csv: readings name their point ({some_of(others)}), but those of "
            f"view{'s' if len(by_name['']) > 1 else ''} {some_of(list(map(str, by_name[''])))} "
            "do not.",
            culprits=[f"views.csv: view {index}, point" for index in by_name[""]],
            next_step="Fill the column point in everywhere.",
        )
    if are_poses and len(by_name) > 1:
        raise DataError(
            f"views.csv: poses of {len(by_name)} probes ({some_of(list(by_name))}) were read; one "
            "is read in a session.",
            culprits=["views.csv: point"],
            next_step="Split the session, or leave the columns meas_qx ... out: places of several "
            "points are read.",
        )
    alone = {name: views[0] for name, views in by_name.items() if len(views) == 1}
    if len(alone) == len(by_name):
        return tuple(by_name), []
    names = [name for name in by_name if name not in alone]
    for name, number in alone.items():
        hint = did_you_mean(name, names)
        if hint:
            raise DataError(
                f"views.csv: view {number} reads a point {name!r} that no other row names; the "
                f"points are {some_of(names)}.",
                culprits=[f"views.csv: view {number}, point"],
                next_step=hint,
            )
    words = "its point {!r} was read once, and so determines nothing"
    return tuple(names), [Rejection(view, words.format(name)) for name, view in alone.items()]


def _check_stops(readings: Readings, stops: IntArray) -> None:
    """Refuses too few stops to determine the instrument and the points with redundancy."""
    count, points = len(np.unique(stops)), len(readings.names)
    needed = 4 if points == 1 else 3
    if count >= needed:
        return
    what = "point on the flange" if points == 1 else f"{points} points on the flange"
    raise DegenerateError(
        f"instrument: {counted(count, 'usable stop')} of the robot; at least {needed} are needed "
        f"to determine where the instrument stands and where the {what} "
        f"{'is' if points == 1 else 'are'}.",
        culprits=["the instrument's place", f"the {what}"],
        next_step="Read at more stops, with the flange turned about different axes; 20 to 30 "
        "calibrate the arm too.",
    )


def _scatter_m(errors: FloatArray) -> float:
    """RMS deviation of (r, 3) residuals from their mean [m]."""
    return float(np.sqrt(np.mean(np.sum((errors - errors.mean(axis=0)) ** 2, axis=1))))

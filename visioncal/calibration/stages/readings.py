"""Readings of a measuring instrument: positions of points on the flange, or poses of a probe."""

from collections import Counter, defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.calibration.stages.observed import Observed, nothing_seen
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import counted, did_you_mean, some_of
from visioncal.core.procrustes import align
from visioncal.core.types import FloatArray, Rejection
from visioncal.session import Session, View
from visioncal.session.kinds import (
    Instrument,
    is_camera_observation,
    is_instrument_reading,
    known_instruments,
    name_of,
    stated_instrument,
)
from visioncal.vision.pnp import ViewPoses

# Largest distance that a tracker reads [m].
_FARTHEST_M = 160.0


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of an instrument."""

    instrument: Instrument  # Its noise.
    # The points in the order in which they first appear; a single one may have no name.
    names: tuple[str, ...]
    views: Mapping[int, View]  # The rows that are of use, by view.
    are_poses: bool  # Whether the probe's rotation was read, too.
    rejections: tuple[Rejection, ...]  # Rows that are of no use.

    @property
    def sigma_m(self) -> float:
        """Median noise of a coordinate [m]."""
        places = np.array([view.reading_m for view in self.views.values()])
        return float(np.median(self.instrument.sigmas_m(places)))


def read_instrument(session: Session) -> Readings:
    """Collects and checks an instrument's readings; rows that lack what others have are rejected.

    Raises:
        DataError: The instrument's noise is not known, readings are in millimetres, or several
            probes were read.
    """
    rows = [view for view in session.views if view.reading_m is not None]
    instrument = _instrument(session, rows)
    are_poses = any(view.instrument_from_probe() is not None for view in rows)
    of_point = Counter(
        view.point for view in rows if not are_poses or view.instrument_from_probe() is not None
    )
    read_again = [name for name, count in of_point.items() if name and count > 1]
    names, rejections, used = tuple(read_again or of_point), [], []
    if are_poses and len(names) > 1:
        raise DataError(
            f"views.csv: poses of {len(names)} probes ({some_of(names)}) were read; one is read in "
            "a session.",
            culprits=["views.csv: point"],
            next_step="Split the session, or leave the columns meas_qx ... out: places of several "
            "points are read.",
        )
    for view in session.views:
        if view.reading_m is None:
            reason = "no reading of the instrument: meas_x_m ... are empty"
        elif are_poses and view.instrument_from_probe() is None:
            reason = "no rotation of the probe: meas_qx ... are empty, and other rows have them"
        elif view.point not in names and not view.point:
            reason = f"no name in column point, and other rows name one: {some_of(names)}"
        elif view.point not in names:
            hint = did_you_mean(view.point, names)
            reason = f"its point {view.point!r} was read once, and so determines nothing. {hint}"
        else:
            used.append(view)
            continue
        rejections.append(Rejection(view.number, reason.strip()))
    views = {view.number: view for view in used}
    return Readings(instrument, names, views, are_poses, tuple(rejections))


def probe_poses(session: Session, readings: Readings) -> dict[int, FloatArray]:
    """Poses (4, 4) of a probe on the flange, in the instrument's frame, by one view of each stop.

    Without a probe they are fitted to all points of a stop, relative to the first complete stop;
    with fewer than three points they are the places (3,) of the one that was read most.
    """
    if readings.are_poses:
        return {number: _probe(view) for number, view in readings.views.items()}
    stop_of, names = stops_of_views(session), readings.names
    stops: dict[Hashable, dict[str, View]] = defaultdict(dict)
    for number, view in readings.views.items():
        stops[stop_of[number]][view.point] = view
    stopped = [[stop[name] for name in names] for stop in stops.values() if len(stop) == len(names)]
    if len(names) < 3 or not stopped:
        return places_of_one_point(readings)
    positions = np.array([[view.reading_m for view in group] for group in stopped])
    pairs = zip(stopped, positions, strict=True)
    return {group[0].number: align(at, positions[0]) for group, at in pairs}


def places_of_one_point(readings: Readings) -> dict[int, FloatArray]:
    """(3,) places, by view, of the point that was read most, in the instrument's frame [m]."""
    points = [view.point for view in readings.views.values()]
    most = max(readings.names, key=points.count)
    every = readings.views.items()
    return {
        at: _probe(view)[:3, 3] for at, view in every if readings.are_poses or view.point == most
    }


def stops_of_views(session: Session) -> dict[int, Hashable]:
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
        instrument = _instrument(session, of_instrument)
        for view in of_instrument:
            probe = _probe(view)
            sigma_m = float(instrument.sigmas_m(probe[None, :3, 3])[0])
            variances = np.repeat([(instrument.sigma_rad or 0.0) ** 2, sigma_m**2], 3)
            sightings[view.number] = ViewPoses(
                view.number, None, probe[None], (0,), np.diag(variances)[None], np.zeros((1, 6, 0))
            )
    return sightings


def check_readings(observed: Observed, readings: Readings) -> None:
    """Refuses readings that determine neither the instrument nor the points with redundancy.

    Raises:
        DataError: No view can be used.
        DegenerateError: There are too few stops.
    """
    stop_of, points = stops_of_views(observed.session), len(readings.names)
    usable = readings.views.keys() & observed.base_from_flange.keys() - observed.held_back
    if not usable:
        raise nothing_seen(observed)
    count, needed = len({stop_of[view] for view in usable}), 4 if points == 1 else 3
    if count >= needed:
        return
    what = "point on the flange" if points == 1 else f"{points} points on the flange"
    raise DegenerateError(
        f"instrument: {counted(count, 'usable stop')} of the robot, but it takes at least {needed} "
        f"to determine where the instrument stands and where the {what} "
        f"{'is' if points == 1 else 'are'}.",
        culprits=["the instrument's place", f"the {what}"],
        next_step="Read at more stops, with the flange turned about different axes; 20 to 30 "
        "calibrate the arm too.",
    )


def _probe(view: View) -> FloatArray:
    """(4, 4) the probe's pose; for a position alone, with the identity as rotation."""
    pose, matrix, read_m = view.instrument_from_probe(), np.eye(4), view.reading_m
    if pose is not None:
        return pose
    matrix[:3, 3] = np.zeros(3) if read_m is None else read_m
    return matrix


def _instrument(session: Session, rows: Sequence[View]) -> Instrument:
    """The instrument that read some rows, which have to be in metres."""
    distance_m = float(np.median([np.linalg.norm(_probe(view)[:3, 3]) for view in rows]))
    if distance_m > _FARTHEST_M:
        raise DataError(
            f"views.csv: the median distance of the readings (meas_x_m, meas_y_m, meas_z_m) from "
            f"the instrument is {distance_m:.4g} m, and no instrument reads farther than "
            f"{_FARTHEST_M:g} m.",
            culprits=["views.csv: meas_x_m, meas_y_m, meas_z_m"],
            next_step="It looks like millimetres: multiply these columns by 0.001.",
        )
    table = session.instruments.get(name_of(session.declaration, "instrument", rows[0]))
    if table is None:
        raise DataError(
            "session.toml: rows have an instrument's readings (meas_x_m ...), but nothing says "
            "how good they are.",
            culprits=["session.toml: instrument"],
            next_step="Add [instrument] with sigma_m (and sigma_per_m), or with one of these as "
            f"its name: {', '.join(sorted(known_instruments()))}.",
        )
    instrument = stated_instrument(table)
    has_rotations = any(row.instrument_from_probe() is not None for row in rows)
    if instrument.sigma_rad is None and has_rotations:
        raise DataError(
            f"session.toml: rows have rotations of a probe (meas_qx ...), but their sigma "
            f"is not known for the instrument {table.name!r}.",
            culprits=["session.toml: instrument.sigma_rad"],
            next_step="State sigma_rad in [instrument], or leave the columns meas_qx ... out.",
        )
    return instrument

"""What the instruments of a cell read, as sightings of the points that they read."""

from collections.abc import Mapping

import numpy as np

from visioncal.alignment.cell import Cell
from visioncal.errors import DataError
from visioncal.instruments import Instrument, instrument_names, stated_instrument
from visioncal.session import Session, View, frame_name
from visioncal.stages.pnp import ViewPoses
from visioncal.types import FloatArray


def readings(session: Session) -> dict[int, ViewPoses]:
    """The readings by view; of places alone, the rotation is any.

    Raises:
        DataError: An instrument's noise is not known.
    """
    seers = {frame_name("instrument", name): name for name in session.instruments}
    known: dict[str, Instrument] = {}
    found = {}
    for row in session.observations:
        if not row.seer.startswith("instrument"):
            continue
        if row.seer not in known:
            known[row.seer] = _instrument(session, row.seer, seers.get(row.seer))
        found[row.view.number] = _sighting(row.view, known[row.seer])
    return found


def has_rotation(view: View) -> bool:
    """Whether a reading tells a rotation, too."""
    return view.instrument_from_probe() is not None


def _instrument(session: Session, frame: str, name: str | None) -> Instrument:
    if name is None:
        raise DataError(
            f"session.toml: rows have readings of {frame} (meas_x_m ...), but nothing says how "
            "good they are.",
            culprits=["session.toml: instrument"],
            next_step="Add [instrument] with sigma_m (and sigma_per_m), or with one of these as "
            f"its name: {', '.join(instrument_names())}.",
        )
    table = session.instruments[name]
    return stated_instrument(table.name, table.sigma_m, table.sigma_per_m, table.sigma_rad)


def _sighting(view: View, instrument: Instrument) -> ViewPoses:
    probe, place = view.instrument_from_probe(), view.reading_m
    matrix = np.eye(4)
    if place is not None:
        matrix[:3, 3] = place
    if probe is not None:
        if instrument.sigma_rad is None:
            raise DataError(
                f"session.toml: view {view.number} has a rotation of a probe (meas_qx ...), but "
                "how good it is is not known of its instrument.",
                culprits=[f"views.csv: view {view.number}"],
                next_step="State sigma_rad of the instrument, or leave meas_qx ... out.",
            )
        matrix = np.asarray(probe.as_matrix())
    spread = np.zeros((6, 6))
    spread[range(3), range(3)] = (instrument.sigma_rad or 0.0) ** 2
    spread[range(3, 6), range(3, 6)] = instrument.sigmas_m(matrix[None, :3, 3])[0] ** 2
    return ViewPoses(view.number, None, matrix[None], (0,), spread[None], np.zeros((1, 6, 0)))


def places_alone(cell: Cell) -> Mapping[int, bool]:
    """Whether each observation tells a place alone, by view."""
    views = {view.number: view for view in cell.session.views}
    return {
        it.view: it.seer.startswith("instrument") and not has_rotation(views[it.view])
        for it in cell.rows
    }


def nominal_spread() -> FloatArray:
    """Covariance (6, 6) of a pose that was given without one, but for its level [rad^2, m^2]."""
    return np.diag(np.repeat([1e-3, 5e-4], 3) ** 2)

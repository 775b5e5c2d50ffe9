"""Measuring instruments and the noise of their readings, with a table of known systems."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, parse_toml, read_text
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import FloatArray

_FILE = Path(__file__).with_name("instruments.toml")


@dataclass(frozen=True)
class Instrument:
    """Noise of an instrument's readings, as standard deviations."""

    words: str  # Description of the instrument.
    sigma_m: float  # Of each coordinate of a position, at the instrument's origin [m].
    sigma_per_m: float = 0.0  # Its growth with the distance from there [m/m].
    # Of a probe's rotation about each axis; None where unknown [rad].
    sigma_rad: float | None = None

    def sigmas_m(self, places: FloatArray) -> FloatArray:
        """Standard deviations (m,) of each coordinate of (m, 3) measured positions [m]."""
        distance = np.linalg.norm(places, axis=-1)
        return np.asarray(self.sigma_m + self.sigma_per_m * distance)


def instrument_names() -> tuple[str, ...]:
    """Names of the instruments in the table."""
    return tuple(sorted(_table()))


def known_instrument(name: str) -> Instrument | None:
    """Finds an instrument in the table; None where it is not there.

    Raises:
        DataError: It measures only lengths or angles, no positions.
    """
    row = _table().get(name.strip().lower())
    if row is None:
        return None
    words = row.text("words")
    if "measures" in row.content:
        raise DataError(
            f"instrument {name!r}: the {words} measures {row.text('measures')}; readings of "
            "places (meas_x_m, meas_y_m, meas_z_m) are needed.",
            culprits=["session.toml: instrument.name"],
        )
    return Instrument(
        words,
        row.number("sigma_m"),
        row.number("sigma_per_m", 0.0),
        row.number("sigma_rad") if "sigma_rad" in row.content else None,
    )


def stated_instrument(
    name: str, sigma_m: float | None, sigma_per_m: float | None, sigma_rad: float | None
) -> Instrument:
    """Instrument of a session: stated values, with those of the table for the others.

    Raises:
        DataError: The name is unknown and no noise is stated.
    """
    in_table = known_instrument(name)
    if sigma_m is None and in_table is None:
        raise DataError(
            f"session.toml: the instrument {name!r} is not in the table of known ones, and its "
            "noise is not stated.",
            culprits=["session.toml: instrument"],
            next_step=f"{did_you_mean(name, instrument_names())} State sigma_m (and sigma_per_m) "
            f"in [instrument], or name one of {', '.join(instrument_names())}.".strip(),
        )
    base = Instrument(name, 0.0) if in_table is None else in_table
    return Instrument(
        base.words,
        base.sigma_m if sigma_m is None else sigma_m,
        base.sigma_per_m if sigma_per_m is None else sigma_per_m,
        base.sigma_rad if sigma_rad is None else sigma_rad,
    )


@cache
def _table() -> Mapping[str, DocumentTable]:
    rows = parse_toml(read_text(_FILE), _FILE.name)["instrument"]
    return {row["name"]: DocumentTable(row, f"{_FILE.name}, {row['name']}") for row in rows}

"""Tables of an identified dynamic model, for pages and recordings."""

from typing import TYPE_CHECKING

import numpy as np

from visioncal.core.number_format import matched, significant
from visioncal.core.types import FloatArray
from visioncal.present.tables import Table, TableRow

# Its import takes a tenth of a second, which reports of calibrations do not need.
if TYPE_CHECKING:
    from visioncal.dynamics import Identified

_UNITS = {
    "m": "kg",
    "I": "kg m\N{SUPERSCRIPT TWO}",
    "Fc": "N m",
    "Fv": "N m s/rad",
    "offset": "N m",
}
_FIRST_MOMENT = "kg m"
_MARKS = {"2 %": "sure", "10 %": "used"}


def torque_table(identified: "Identified") -> Table:
    """Torque errors of each joint: of the fit, and of predictions for unseen motion."""
    (first, *_), validation = identified.streams, identified.validation
    figures: dict[str, FloatArray | None] = {
        "torque": first.torque_nm,
        "noise": first.noise_nm,
        "fitted": first.rms_nm,
    }
    if validation is not None:
        figures |= {
            "unseen": validation.rms_nm,
            "% of it": 100.0 * validation.shares,
            "as bodies": validation.consistent_rms_nm,
        }
    columns = [
        [significant(None)] * identified.robot.joint_count
        if figure is None
        else list(map(significant, figure.tolist()))
        for figure in figures.values()
    ]
    rows = zip(identified.robot.joint_names, *columns, strict=True)
    return Table.of(("joint", *figures), list(rows))


def base_parameter_table(identified: "Identified") -> Table:
    """Value and sigma of each base parameter."""
    base, rows = identified.base, []
    for name, index, value, sigma, share in zip(
        base.names,
        base.independent,
        identified.values.tolist(),
        identified.sigmas.tolist(),
        identified.determined,
        strict=True,
    ):
        symbol = base.model.names[index]
        unit = next(unit for start, unit in _UNITS.items() if symbol.startswith(start))
        unit = _FIRST_MOMENT if "*" in symbol else unit
        cells = (name, matched(value, sigma), significant(sigma), unit, share)
        rows.append(TableRow(cells, _MARKS.get(share, "rejected")))
    return Table.of(("combination", "value", "sigma", "unit", "known to"), rows, (0, 3, 4))


def link_table(identified: "Identified") -> Table | None:
    """Mass and centre of mass of each link, estimated and by the robot's description."""
    if identified.inertias is None:
        return None
    masses, described = identified.inertias.masses, identified.robot.masses
    rows = []
    for index, joint in enumerate(identified.robot.joint_names):
        centre = ", ".join(f"{value:.1f}" for value in 1e3 * np.asarray(masses.centres_m[index]))
        described_kg = significant(None if described is None else float(described.kg[index]), 3)
        rows.append((joint, significant(float(masses.kg[index]), 3), described_kg, centre))
    titles = ("link behind joint", "mass [kg]", "known before [kg]",
              "centre in the joint's frame [mm]")  # fmt: skip
    return Table.of(titles, rows)

"""What an identification of dynamics says, as tables that page and recording show."""

from typing import TYPE_CHECKING

import numpy as np

from visioncal.core.number_format import matched, significant
from visioncal.core.types import FloatArray
from visioncal.present.tables import Table, TableRow

# A tenth of a second to import, which reports of calibrations need not wait for.
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
    """How well the torques of each joint are fitted, and predicted of a motion not fitted."""
    (first, *_), found = identified.streams, identified.validation
    figures: dict[str, FloatArray | None] = {
        "torque [N m]": first.torque_nm,
        "noise [N m]": first.noise_nm,
        "error, fitted [N m]": first.rms_nm,
    }
    if found is not None:
        figures |= {
            "error, unseen [N m]": found.rms_nm,
            "of the torque [%]": 100.0 * found.shares,
            "as bodies [N m]": found.consistent_rms_nm,
            "known before [N m]": found.known_rms_nm,
        }
    columns = [
        [significant(None)] * identified.robot.joint_count
        if figure is None
        else list(map(significant, figure.tolist()))
        for figure in figures.values()
    ]
    rows = zip(identified.robot.joint_names, *columns, strict=True)
    return Table.of(("joint", *figures), list(rows))


def torque_note(identified: "Identified") -> str:
    """What the columns of `torque_table` are."""
    found = identified.validation
    unseen = "There is no motion beside the fitted one." if found is None else f"{found.label}."
    return (
        "Torque: its standard deviation over the fitted motion. Errors are root mean squares. "
        f"Unseen: {unseen} As bodies: with masses and inertias that real links can have. Known "
        "before: with the inertias of the robot's description, and the friction that goes best "
        "with them."
    )


def base_parameter_table(identified: "Identified") -> Table:
    """What is known of each base parameter."""
    base, rows = identified.base, []
    for name, own, value, sigma, share in zip(
        base.names,
        base.independent,
        identified.values.tolist(),
        identified.sigmas.tolist(),
        identified.determined,
        strict=True,
    ):
        unit = _unit_of(base.model.names[own])
        cells = (name, matched(value, sigma), significant(sigma), unit, share)
        rows.append(TableRow(cells, _MARKS.get(share, "rejected")))
    return Table.of(("combination", "value", "sigma", "unit", "known to"), rows, (0, 3, 4))


def _unit_of(name: str) -> str:
    """The unit of a standard parameter."""
    if "*" in name:
        return _FIRST_MOMENT
    return next(unit for start, unit in _UNITS.items() if name.startswith(start))


def link_table(identified: "Identified") -> Table | None:
    """Each link as a body, with the mass that was known before; None where none was found."""
    if identified.inertias is None:
        return None
    found, known = identified.inertias.masses, identified.robot.masses
    rows = []
    for at, joint in enumerate(identified.robot.joint_names):
        centre = ", ".join(f"{value:.1f}" for value in 1e3 * np.asarray(found.centres_m[at]))
        before = significant(None if known is None else float(known.kg[at]), 3)
        rows.append((joint, significant(float(found.kg[at]), 3), before, centre))
    titles = ("link behind joint", "mass [kg]", "known before [kg]",
              "centre in the joint's frame [mm]")  # fmt: skip
    return Table.of(titles, rows)

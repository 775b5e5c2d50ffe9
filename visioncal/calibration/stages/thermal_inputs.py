"""Temperatures of a session: its streams, or else columns of its views."""

from collections.abc import Mapping, Sequence

import numpy as np

from visioncal.core.files import some_of
from visioncal.core.types import FloatArray
from visioncal.robot.thermal.heating import Inputs, Kind
from visioncal.session import Session
from visioncal.session.kinds import name_of
from visioncal.session.selecting import streams_of
from visioncal.session.streams import STAMP, Stream

# More samples than this determine warm-up no better: they are averaged in bunches.
_MOST_SAMPLES = 8192
_FEWEST_SAMPLES = 3
_AMBIENT = "ambient_c"
_FORMS: Mapping[Kind, str] = {"temperatures": "temp{}_c", "currents": "current{}_a"}


def inputs_of(session: Session, joints: int, robot: str = "") -> tuple[Inputs | None, str]:
    """Takes what heats an arm out of a session; temperatures come before currents.

    Args:
        session: The session.
        joints: How many joints the arm has.
        robot: Its name, where the session has several.

    Returns:
        What heats it; or None, and what is missing.
    """
    tables = [*streams_of(session, robot).values(), _of_views(session, robot)]
    for kind, form in _FORMS.items():
        names = [form.format(at + 1) for at in range(joints)]
        for table in tables:
            stamps_s, heat = table.group(names)
            if len(stamps_s) >= _FEWEST_SAMPLES:
                return _inputs(kind, stamps_s, heat, tables), ""
    return None, _missing(tables, joints)


def _inputs(kind: Kind, stamps_s: FloatArray, heat: FloatArray, tables: Sequence[Stream]) -> Inputs:
    ambient = np.zeros(len(stamps_s))
    for table in tables:
        at_s, air = table.group((_AMBIENT,))
        if len(at_s):
            ambient = np.interp(stamps_s, at_s, air[:, 0])
            break
    heat = heat if kind == "temperatures" else heat**2
    return _bunched(Inputs(kind, stamps_s, heat, ambient))


def _bunched(inputs: Inputs) -> Inputs:
    """Averages neighbouring samples where there are more than warm-up needs."""
    count = len(inputs.stamps_s)
    size = -(-count // _MOST_SAMPLES)
    if size == 1:
        return inputs
    starts = np.arange(0, count, size)
    lengths = np.diff(np.append(starts, count))
    return Inputs(
        inputs.kind,
        np.add.reduceat(inputs.stamps_s, starts) / lengths,
        np.add.reduceat(inputs.signal, starts, axis=0) / lengths[:, None],
        np.add.reduceat(inputs.ambient_c, starts) / lengths,
    )


def _of_views(session: Session, robot: str) -> Stream:
    """A robot's views that have a time, as a stream of their numbers."""
    mine = [it for it in session.views if name_of(session.declaration, "robot", it) == robot]
    rows = sorted({it.stamp_s: it.numbers for it in mine if it.stamp_s is not None}.items())
    names = sorted({name for _, row in rows for name in row} - {STAMP})
    values = [[stamp_s, *(row.get(name, np.nan) for name in names)] for stamp_s, row in rows]
    return Stream((STAMP, *names), np.array(values).reshape(len(rows), len(names) + 1))


def _missing(tables: Sequence[Stream], joints: int) -> str:
    there = {name for table in tables for name in table.columns}
    for form in _FORMS.values():
        names = [form.format(at + 1) for at in range(joints)]
        absent = [name for name in names if name not in there]
        if len(absent) < joints:
            return (
                f"{some_of(absent)} of {names[0]} ... {names[-1]} are missing"
                if absent
                else f"{names[0]} ... {names[-1]} are filled together in fewer than "
                f"{_FEWEST_SAMPLES} rows with a time"
            )
    return (
        f"neither a stream nor timed rows of views.csv have temp1_c ... temp{joints}_c or "
        f"current1_a ... current{joints}_a"
    )

"""Payloads, forces and approach directions in a session's rows."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Loads

_CENTRE = tuple(f"payload_{axis}_m" for axis in "xyz")
_FORCE = tuple(f"force_{axis}_n" for axis in "xyz")
# Approach direction of the joints to a stop, by the cells of column approach.
SIDES = {"+": 1.0, "-": -1.0, "": 0.0}
# Largest plausible payload and force [kg, N].
_HEAVIEST_KG, _STRONGEST_N = 2500.0, 25000.0


def loads_of(rows: Sequence[Mapping[str, float]], approaches: Sequence[str] | None = None) -> Loads:
    """Loads of views by their numbers, zero where not stated, and by their cells of approach."""
    sides = [SIDES.get(approach.strip(), 0.0) for approach in approaches or [""] * len(rows)]

    def read(*names: str) -> FloatArray:
        return np.array([[row.get(name, 0.0) for name in names] for row in rows])

    return Loads(
        read("payload_kg").reshape(-1),
        read(*_CENTRE).reshape(-1, 3),
        read(*_FORCE).reshape(-1, 3),
        np.array(sides),
    )


def load_problems(numbers: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    """Columns of a row with an invalid load, with messages."""
    mass = numbers.get("payload_kg")
    if mass is not None and not 0.0 <= mass <= _HEAVIEST_KG:
        yield "payload_kg", f"{mass:g} kg is no payload; 0 to {_HEAVIEST_KG:g} kg are taken"
    placed = [name for name in _CENTRE if name in numbers]
    if mass is None and placed:
        yield (
            placed[0],
            "it gives a payload's centre, and payload_kg, its mass, is missing; a row "
            "without a payload has payload_kg = 0 or leaves all of them empty",
        )
    for name in _FORCE:
        if abs(numbers.get(name, 0.0)) > _STRONGEST_N:
            yield name, f"{numbers[name]:g} N is no force on a robot's flange; write newtons"

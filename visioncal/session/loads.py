"""Payloads, forces and approach directions in a session's rows."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.robot import Loads

_CENTRE = tuple(f"payload_{axis}_m" for axis in "xyz")
_FORCE = tuple(f"force_{axis}_n" for axis in "xyz")
# Approach direction of the joints to a stop, by the cells of column approach.
SIDES = {"+": 1.0, "-": -1.0, "": 0.0}


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


def load_problems(numbers: Mapping[str, float], approach: str) -> Iterator[tuple[str, str]]:
    """Columns of a row with an invalid load or approach, with messages."""
    if approach not in SIDES:
        yield "approach", f'{approach!r} is no side; "+", "-" or nothing is needed'
    placed = [name for name in _CENTRE if name in numbers]
    if placed and "payload_kg" not in numbers:
        yield (
            placed[0],
            "it gives a payload's centre, and payload_kg, its mass, is missing; a row "
            "without a payload has payload_kg = 0 or leaves all of them empty",
        )

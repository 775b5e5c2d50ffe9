"""Tables whose rows are the robot's and the camera's, in turn or by halves."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visioncal.core.documents.tables import TextTable, is_number
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.interchange.formats.fields import (
    POSE_SIZES,
    Fields,
    appearance,
    fields_of_records,
    position_first,
    split_matrices,
)
from visioncal.interchange.formats.keys import is_image_name

# Cosines of the same turns by two sides differ by less, as a share of all: a degree or two.
_TURN_ALIKE = 0.05


def paired_rows(table: TextTable, path: Path) -> Fields | None:
    """Rows in pairs, one of the robot and one of the camera: every other one, or by halves.

    A column of two words says which is whose; below an empty line in the middle stand the camera's.
    Without either, poses whose rotations are known show by these that two sides stand in turn.
    """
    count, rows = len(table.rows), table.rows
    half, columns = count // 2, range(len(table.columns))
    if count < 2 * FEWEST_VIEWS or count % 2:
        return None
    worded = [at for at in columns if not any(is_number(row[at]) for row in rows)]
    kinds = [row[worded[0]].strip() for row in rows] if worded else []
    first, second = np.arange(half), np.arange(half, count)
    if len(worded) == 1:
        names = tuple(dict.fromkeys(kinds))
        if kinds == [*names] * half and len(names) == 2:
            first, second = np.arange(0, count, 2), np.arange(1, count, 2)
        elif kinds != [name for name in names for _ in range(half)] or len(names) != 2:
            return None
    elif not worded and not table.has_header:
        names, steps = ("robot", "camera"), np.diff(table.lines)
        if steps[half - 1] == 1 or (np.delete(steps, half - 1) != 1).any():
            if not _turn_by_two(rows):
                return None
            first, second = np.arange(0, count, 2), np.arange(1, count, 2)
    else:
        return None
    numbers = [at for at in columns if at not in worded]
    # Of angles beside another side's quaternions the last cell is empty.
    cells = [[row[at] for at in numbers if row[at]] for row in rows]
    sizes = [{len(cells[at]) for at in side.tolist()} for side in (first, second)]
    fits = all(len(counts) == 1 and counts <= {*POSE_SIZES} for counts in sizes)
    fits &= all(is_number(cell) for row in cells for cell in row)
    if not fits or any(map(is_image_name, names)):
        return None
    records = [
        {
            f"{name}_pose": np.array(cells[at], dtype=float)
            for name, at in zip(names, pair, strict=True)
        }
        for pair in zip(first.tolist(), second.tolist(), strict=True)
    ]
    places = [table.place(at) for at in first.tolist()]
    return fields_of_records(records, places, path.stem, path.parent)


def _turn_by_two(rows: Sequence[Sequence[str]]) -> bool:
    """Whether even and odd rows are poses that turn by the same angles, and no copies.

    In a slow motion of one side, a row turns as much like the next one as like the one beside it,
    and lies between its neighbours. In a raster of two sides it does the first as well.
    """
    if not all(is_number(cell) for row in rows for cell in row):
        return False
    numbers = np.array(rows, dtype=float)
    if appearance(numbers) != "pose":
        return False
    is_short = numbers.shape[1] == 7
    turns = position_first(numbers)[:, 3:] if is_short else split_matrices(numbers)[1]
    even, odd = turns[::2], turns[1::2]
    # Cosines of half the angle between two quaternions, of either sign, or traces.
    first, second = (np.abs(side @ side.T) if is_short else side @ side.T for side in (even, odd))
    copied, apart = np.median(np.abs(even - odd)), np.median(np.abs(first - second))
    later = np.median(np.abs(first[1:, 1:] - second[:-1, :-1]))
    across, along = (np.sum(even[: len(side)] * side, axis=1) for side in (odd, even[1:]))
    if is_short:
        across, along = np.abs(across), np.abs(along)
    is_beside = np.median(across) < np.median(along)
    alike = apart < _TURN_ALIKE * np.ptp(first) <= copied
    return bool(alike and (2.0 * apart < later or is_beside))

"""Inferring an AprilGrid from the ids and the places of its tags.

The ids count the tags row by row from the lower left. Hence the number of columns says where each
tag lies, and a hypothesis is right where one view of a plane carries those places to the image.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.finders.aprilgrid import (
    find_aprilgrid,
    grid_tags,
    lacks_a_line,
    laid,
    refined_tags,
    seen_spacing,
)
from visioncal.vision.finders.layout import LAYOUT_MISFIT
from visioncal.vision.finders.result import DetectedCorners
from visioncal.vision.targets import APRILGRID_DICTIONARY, DEFAULT_RELATIVE_SIGMA

# Fewer tags are single ones; no printable grid has more columns.
_LEAST_TAGS, _MOST_COLUMNS = 4, 24
_USUAL_SPACING = 0.3


@dataclass(frozen=True, eq=False)
class Grid:
    """An AprilGrid as an image shows it, with tags of 1 m.

    Attributes:
        target: All but its size.
        whole: Whether it is seen to end above its uppermost row.
        ids: The tags that were read, ascending.
        corners: How many corners the finder of AprilGrids finds.
    """

    target: Target
    whole: bool
    ids: IntArray
    corners: int


def find_grid(image: Image) -> Grid | None:
    """Infers an AprilGrid of Kalibr's family, with borders of one or two modules; None without."""
    read = {border: grid_tags(image, APRILGRID_DICTIONARY, border, np.inf) for border in (2, 1)}
    # With a wrong border a few tags are read, and misplaced.
    border = max(read, key=lambda index: len(read[index][0]))
    ids, px = read[border]
    if len(ids) < _LEAST_TAGS:
        return None
    columns, first = _columns(ids, px, border)
    if not columns:
        return None
    first += columns * int((ids.min() - first) // columns)
    rows = int((ids.max() - first) // columns) + 1
    target = _target(columns, rows, first, border)
    numbers, every = ids - first, np.ones(len(ids), bool)
    quads = refined_tags(image, laid(target, numbers, px, every)[0], _USUAL_SPACING)
    target = replace(target, spacing=round(seen_spacing(target, numbers, quads), 2))
    # Rows that the image cuts off below are counted, as ids begin with 0.
    if first and not lacks_a_line(image, *_one_more(target, numbers, below=True), quads):
        target = replace(target, rows=rows + first // columns, marker_id=first % columns)
    whole = lacks_a_line(image, *_one_more(target, ids - target.marker_id, below=False), quads)
    seen = find_aprilgrid(image, target)
    return Grid(target, whole, ids, len(seen.ids)) if isinstance(seen, DetectedCorners) else None


def _columns(ids: IntArray, px: FloatArray, border: int) -> tuple[int, int]:
    """The number of columns, and an id in the first of them; 0 where no number fits."""
    every = np.ones(len(ids), bool)
    tried = range(1, _MOST_COLUMNS + 1)
    # Ids begin with 0 unless the tags say otherwise.
    for starts in (
        [(item, 0) for item in tried],
        [(item, at) for item in tried for at in range(1, item)],
    ):
        misfits = {}
        for columns, first in starts:
            numbers = ids - first + columns * (first > 0)
            target = _target(columns, int(numbers.max()) // columns + 1, 0, border)
            misfits[columns, first] = laid(target, numbers, px, every)[1]
        best = min(misfits, key=lambda index: misfits[index], default=(0, 0))
        if misfits.get(best, np.inf) <= LAYOUT_MISFIT:
            return best
    return 0, 0


def _one_more(target: Target, numbers: IntArray, *, below: bool) -> tuple[Target, IntArray]:
    """The grid with one row more, and the numbers of its tags there."""
    return replace(target, rows=target.rows + 1), numbers + (target.columns if below else 0)


def _target(columns: int, rows: int, first: int, border: int) -> Target:
    return Target(
        "board",
        "aprilgrid",
        columns,
        rows,
        1.0,
        DEFAULT_RELATIVE_SIGMA,
        dictionary=APRILGRID_DICTIONARY,
        marker_id=first,
        spacing=_USUAL_SPACING,
        border=border,
    )

"""Identification of an AprilGrid from the ids and positions of its tags.

Ids count the tags row by row from the lower left. Each number of columns therefore predicts the
tags' positions; it is right if a homography maps these to the image.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.finders.aprilgrid import (
    find_aprilgrid,
    grid_tags,
    lacks_a_line,
    measured_spacing,
    ordered_tags,
    refined_tags,
)
from visioncal.vision.finders.layout import LAYOUT_MISFIT
from visioncal.vision.finders.result import DetectedCorners
from visioncal.vision.targets import APRILGRID_DICTIONARY, DEFAULT_RELATIVE_SIGMA

# Fewer tags are single markers; no printable grid has more columns.
_LEAST_TAGS, _MOST_COLUMNS = 4, 24
_USUAL_SPACING = 0.3


@dataclass(frozen=True, eq=False)
class Grid:
    """An AprilGrid in an image, with tags of 1 m."""

    target: Target  # The grid, without its size.
    whole: bool  # Whether its end above the uppermost row is visible.
    ids: IntArray  # Ids of the tags that were read, ascending.
    corners: int  # Number of corners that the AprilGrid detector finds.


def find_grid(image: Image) -> Grid | None:
    """Identifies an AprilGrid of Kalibr's family with borders of one or two modules, or None."""
    read = {border: grid_tags(image, APRILGRID_DICTIONARY, border, np.inf) for border in (2, 1)}
    # With the wrong border a few tags are read at wrong positions.
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
    numbers, all_tags = ids - first, np.ones(len(ids), bool)
    quads = refined_tags(image, ordered_tags(target, numbers, px, all_tags)[0], _USUAL_SPACING)
    target = replace(target, spacing=round(measured_spacing(target, numbers, quads), 2))
    # Rows below the image are included, as ids start with 0.
    if first and not lacks_a_line(image, *_one_more(target, numbers, below=True), quads):
        target = replace(target, rows=rows + first // columns, marker_id=first % columns)
    whole = lacks_a_line(image, *_one_more(target, ids - target.marker_id, below=False), quads)
    seen = find_aprilgrid(image, target)
    return Grid(target, whole, ids, len(seen.ids)) if isinstance(seen, DetectedCorners) else None


def _columns(ids: IntArray, px: FloatArray, border: int) -> tuple[int, int]:
    """Number of columns, and an id in the first column; 0 if none fits."""
    all_tags = np.ones(len(ids), bool)
    tried = range(1, _MOST_COLUMNS + 1)
    # Ids start with 0 unless the tags contradict it.
    for starts in (
        [(count, 0) for count in tried],
        [(count, offset) for count in tried for offset in range(1, count)],
    ):
        misfits = {}
        for columns, first in starts:
            numbers = ids - first + columns * (first > 0)
            target = _target(columns, int(numbers.max()) // columns + 1, 0, border)
            misfits[columns, first] = ordered_tags(target, numbers, px, all_tags)[1]
        best = min(misfits, key=lambda key: misfits[key], default=(0, 0))
        if misfits.get(best, np.inf) <= LAYOUT_MISFIT:
            return best
    return 0, 0


def _one_more(target: Target, numbers: IntArray, *, below: bool) -> tuple[Target, IntArray]:
    """The grid with one more row, and its tags' numbers there."""
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

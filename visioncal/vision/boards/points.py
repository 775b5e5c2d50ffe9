"""Rigs of known points, flat or not, which may be corners of tags."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from visioncal.core.documents.columns import Column, TableReader
from visioncal.core.documents.tables import read_table
from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.boards.kind import (
    LEAST_SIGMA_M,
    BoardKind,
    Cells,
    DetectedCorners,
    NotFound,
    dictionary_size,
    file_beside,
    marker_cells,
)
from visioncal.vision.boards.layout import find_tags
from visioncal.vision.boards.marker import APRILGRID_DICTIONARY

# Columns of a rig's table; sigma_m is optional, and so are tag and corner together.
_RIG_COLUMNS = ("point", "x_m", "y_m", "z_m", "sigma_m", "tag", "corner")
_WHOLE_NUMBERS = ("point", "tag", "corner")


class PointsKind(BoardKind):
    """A kind of target whose points are in a table beside its `.toml`."""

    table_columns: ClassVar[tuple[str, ...]]  # Columns of its table, the needed ones first.
    needed_columns: ClassVar[int]  # Number of the needed ones.

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) points [m], in the order of the table."""
        return np.array(target.points_m, dtype=float)

    def loaded(self, document: dict[str, Any], folder: Path) -> dict[str, Any]:
        """The content of its `.toml` with the columns of its table."""
        name = document.get("points")
        if not isinstance(name, str):
            return document
        path = file_beside(folder, "points", name, "table of points")
        table, needed = read_table(path), self.table_columns[: self.needed_columns]
        unknown = [column for column in table.columns if column not in self.table_columns]
        missing = [column for column in needed if column not in table.columns]
        if unknown or missing:
            optional = ", ".join(self.table_columns[self.needed_columns :])
            raise DataError(
                f"{path}: its columns are {', '.join(table.columns)}; {', '.join(needed)} are "
                f"needed, and {optional} where they are known.",
                culprits=[f"{path.name}: {word}" for word in (*missing, *unknown)],
            )
        reader = TableReader(table)
        points = {
            name: reader.whole(name).tolist()
            if name in _WHOLE_NUMBERS
            else reader.numbers(Column(name, is_needed=True))[:, 0].tolist()
            for name in table.columns
        }
        reader.check()
        return document | {"points": points}

    def stored(
        self, document: Mapping[str, Any], stem: str
    ) -> tuple[Mapping[str, Any], dict[str, str | bytes]]:
        """The content of its `.toml`, and its table `STEM.points.csv`."""
        table = f"{stem}.points.csv"
        points = document["points"]
        rows = zip(*points.values(), strict=True)
        return {**document, "points": table}, {
            table: "\n".join([",".join(points), *(",".join(map(repr, row)) for row in rows), ""])
        }


class Rig(PointsKind):
    """A rig of points, in the frame of its table. Points are found if they are corners of tags."""

    name: ClassVar[str] = "points"
    noun = "rig"
    unit = "side"
    fewest = 4
    table_columns, needed_columns = _RIG_COLUMNS, 4
    is_seen_in_part = has_lone_tags = True

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads points, the columns of the rig's table as lists, and dictionary."""
        columns = table.content.get("points")
        if not isinstance(columns, Mapping) or not all(
            column in columns for column in _RIG_COLUMNS[:4]
        ):
            raise table.refuse("points", columns, 'the path of a table (points = "rig.csv")')
        numbers, places_m = points_of(table, columns)
        extent_m = float(np.ptp(places_m, axis=0).max())
        return Target(
            name,
            self.name,
            len(numbers),
            1,
            extent_m,
            0.0,
            points_m=tuple((x, y, z) for x, y, z in places_m.tolist()),
            point_numbers=numbers,
            point_sigmas_m=tuple(map(float, columns.get("sigma_m", ()))),
            **_tags_of_rig(table, columns),
        )

    def document(self, target: Target) -> dict[str, Any]:
        """The rig as the content of a `.toml`, with its table."""
        x_m, y_m, z_m = self.corners(target).T.tolist()
        tags = np.reshape(target.point_tags, (-1, 2)).T.astype(int).tolist()
        columns = (list(target.point_numbers), x_m, y_m, z_m, list(target.point_sigmas_m), *tags)
        rig = dict(zip(_RIG_COLUMNS, columns, strict=True))
        points = {"points": {name: value for name, value in rig.items() if value}}
        return points | ({"dictionary": target.dictionary} if target.point_tags else {})

    def words(self, target: Target, size: str) -> str:
        """The rig in a few words."""
        del target, size
        return f"target of kind {self.name}"

    def cells(self, target: Target) -> tuple[Cells, ...]:
        """Cells of the tags, at the poses given by their corners."""
        ids_of_corners, places = tag_corners(target), self.corners(target)
        if (
            not ids_of_corners
            or np.ptp(places[:, 2]) > 0.0
            or min(array.min() for array in ids_of_corners.values()) < 0
        ):
            raise DataError(
                f"target {target.name} is a rig of points; a board can be printed, or a rig in one "
                "plane z = 0 whose points are all four corners of tags.",
                culprits=[target.name],
            )
        grids = []
        for number, corners in ids_of_corners.items():
            quad = places[corners, :2]
            cells = marker_cells(target.dictionary, number)
            x_side, y_side = quad[1] - quad[0], quad[3] - quad[0]
            side_m = float(np.linalg.norm(x_side))
            square = np.array([[-x_side[1], x_side[0]], quad[2] - quad[0] - x_side])
            if np.abs(square - y_side).max() > 0.02 * side_m:
                raise DataError(
                    f"target {target.name}: the corners of tag {number} are no square, clockwise "
                    "from its upper left.",
                    culprits=[f"tag {number}"],
                )
            turn = np.stack([x_side, y_side], axis=1) / side_m
            grids.append(Cells(quad[0], side_m / len(cells), cells, turn))
        return tuple(grids)

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        return (
            f"{len(target.point_tags) // 4} tags of {target.dictionary}",
            "the origin of the table of their corners",
            "Measure the tags' corners and write them into that table, in metres.",
        )

    def find(self, image: Image, target: Target) -> DetectedCorners | NotFound:
        """Corners of its tags in a (h, w) grey image, or why there are none."""
        if not target.point_tags:
            return NotFound(
                f"target {target.name} is a rig of points, which no image is searched for: "
                "corners.csv has no rows of this view"
            )
        return find_tags(image, target.dictionary, 1, tag_corners(target), self.corners(target))


def points_of(
    table: DocumentTable, columns: Mapping[str, Any]
) -> tuple[tuple[int, ...], FloatArray]:
    """Checked numbers and (n, 3) places [m] of a table's points, by its columns as lists."""
    names = [column for column in _RIG_COLUMNS if column in columns]
    try:
        values = np.array([columns[word] for word in names], dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    for words, step in _rig_problems(names, values):
        culprit = f"{table.label}: points"
        raise DataError(f"{culprit}, its table, {words}.", culprits=[culprit], next_step=step)
    return tuple(values[0].astype(int).tolist()), values[1:4].T


def _rig_problems(names: Sequence[str], values: FloatArray) -> Iterator[tuple[str, str]]:
    """Problems of a table of points, each with an instruction."""
    if values.ndim != 2:
        yield "has rows of several lengths, or cells that are no numbers", "Fill in all cells."
        return
    for column, row in np.argwhere(~np.isfinite(values)).tolist():
        yield (
            f"has {values[column, row]:g} as {names[column]} of row {row + 1}",
            "Write a finite number there, or delete the row.",
        )
    numbers, places_m = values[0].tolist(), values[1:4].T
    if len(numbers) < 4:
        yield f"has {len(numbers)} points", "Give four points or more, which a camera needs."
    first: dict[float, int] = {}
    for row, number in enumerate(numbers):
        if number != round(number) or first.setdefault(number, row) != row:
            again = " again" if first.get(number, row) != row else ""
            yield (
                f"has {number:g}{again} as point of row {row + 1}",
                "Give each point a whole number of its own.",
            )
    spread_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)
    if spread_m[1] <= 1e-6 * spread_m[0]:
        location = "on one line" if spread_m[0] > 0.0 else "in one place"
        yield (
            f"has all points {location}",
            "Give points beside these: no camera shows how they turn.",
        )
    extent_m = float(np.ptp(places_m, axis=0).max())
    if extent_m > FAR_M:
        yield (
            f"reaches over {extent_m:g} m, and a rig over {FAR_M:g} m at most",
            "It looks like millimetres: multiply x_m, y_m, z_m and sigma_m by 0.001.",
        )
    for row, sigma_m in enumerate(values[4].tolist() if "sigma_m" in names else ()):
        if not LEAST_SIGMA_M <= sigma_m <= extent_m:
            yield (
                f"has {sigma_m:g} as sigma_m of row {row + 1}, and not {LEAST_SIGMA_M:g} m to the "
                f"rig's own {extent_m:g} m",
                "Write metres in this range, or leave the column out where they are not known.",
            )


def _tags_of_rig(table: DocumentTable, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Tag corners of a rig's points, and the tags' dictionary."""
    given = [name for name in ("tag", "corner") if name in columns]
    if not given:
        return {}
    if len(given) == 1:
        raise table.refuse(
            "points", f"a table with {given[0]} alone", "tag and corner, or neither,"
        )
    dictionary = table.text("dictionary", APRILGRID_DICTIONARY)
    markers = dictionary_size(table, dictionary)
    pairs = list(zip(columns["tag"], columns["corner"], strict=True))
    counts = Counter(pairs)
    for tag, corner in pairs:
        if tag not in range(markers) or corner not in range(4):
            wrong = f"a table with tag {tag}, corner {corner}"
            raise table.refuse("points", wrong, f"tags 0 to {markers - 1}, corners 0 to 3")
        if counts[tag, corner] > 1:
            twice = f"a table with corner {corner} of tag {tag} twice"
            raise table.refuse("points", twice, "each corner once")
    return {
        "dictionary": dictionary,
        "point_tags": tuple((int(tag), int(corner)) for tag, corner in pairs),
    }


def tag_corners(target: Target) -> dict[int, IntArray]:
    """Point indices (4,) of a rig's tags' corners, by tag id; -1 for corners that are no points."""
    corners_of_tag: dict[int, IntArray] = {}
    for index, (tag, corner) in enumerate(target.point_tags):
        corners_of_tag.setdefault(tag, np.full(4, -1))[corner] = index
    return corners_of_tag

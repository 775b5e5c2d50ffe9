"""Corners found by another program: a table with a row a corner.

It has columns for the image, the pixel and optionally the corner's number, as mrcal's
`corners.vnl`: without numbers, an image has all the board's corners row by row, with `-` for one
that was not found.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from visioncal.core.documents import is_number, read_table
from visioncal.core.documents.values import read_plain_text
from visioncal.core.errors import DataError
from visioncal.core.files import natural
from visioncal.core.number_format import some_of
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.foreign import ForeignRecording, FoundCorners
from visioncal.interchange.formats.reading import DOCUMENTS

# Names of the image, of a corner's number and of its pixel.
_IMAGE = ("image", "img", "filename", "file", "image_name", "image_file", "image_path", "frame")
_POINT = ("point", "point_id", "corner", "corner_id", "charuco_id", "id")
_U, _V = ("u_px", "x_px", "u", "x", "img_loc_x"), ("v_px", "y_px", "v", "y", "img_loc_y")
# How often mrcal halved the image before it found the corner; `-` where it found none.
_LEVEL = "level"


def with_corners(foreign: ForeignRecording, path: Path) -> ForeignRecording:
    """Adds the corners in a file to a recording, by the images' names if possible, else in order.

    Raises:
        DataError: The file holds no corners, or they are not of this recording's images.
    """
    images = list(_of_table(path))
    if not any(corners.ids.size for _, corners in images):
        raise DataError(f"{path} holds no corners.", culprits=[str(path)])
    count = len(foreign.robot)
    names = [Path(name.replace("\\", "/")).name for name, _ in images]
    row_names = [None if image is None else image.name for image in foreign.images]
    notes = foreign.notes
    if all(names) and any(row_names):
        by_name = dict(zip(names, (corners for _, corners in images), strict=True))
        if len(by_name) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise DataError(
                f"{path.name} has corners of {twice} twice; each image is needed once.",
                culprits=[twice],
                next_step="Leave the other camera's images out.",
            )
        if not by_name.keys() & set(row_names):
            raise DataError(
                f"{path.name} has corners of {some_of(names, 3)}; the recording's images are "
                f"{some_of([row for row in row_names if row], 3)}.",
                culprits=[str(path)],
                next_step="Name the column of the images that it is about with --image-column.",
            )
        paired = [by_name.get(row or "") for row in row_names]
    elif len(images) == count:
        if all(names):
            images.sort(key=lambda image: natural(Path(image[0])))
        paired = [corners for _, corners in images]
        notes = (*notes, f"The images of {path.name} are paired with the poses by their order.")
    else:
        raise DataError(
            f"{path.name} has the corners of {len(images)} images, and there are {count} poses of "
            "the robot.",
            culprits=[str(path)],
            next_step="Give as many of both, or a column with each pose's image (--image-column).",
        )
    found = tuple(corners if corners and corners.ids.size else None for corners in paired)
    # Images without found corners are dropped, so that a missing file is not an error.
    pictures = tuple(
        image if image is not None and corners is not None and image.is_file() else None
        for image, corners in zip(foreign.images, found, strict=bool(foreign.images))
    )
    return replace(foreign, corners=found, images=pictures if any(pictures) else (), notes=notes)


def _of_table(path: Path) -> Iterator[tuple[str, FoundCorners]]:
    """Reads the images of a table in the order of their first rows."""
    if path.suffix.lower() in (*DOCUMENTS, ".npz"):
        raise DataError(
            f"{path.name} is no table; one with a row a corner is needed.",
            culprits=[str(path)],
            next_step="Write a .csv with the header filename,id,x,y.",
        )
    columns, rows, places = _table(path)
    lower = [column.lower() for column in columns]

    def column(names: Sequence[str]) -> int:
        return next((lower.index(name) for name in names if name in lower), -1)

    image, point, u, v, level = (column(pair) for pair in (_IMAGE, _POINT, _U, _V, (_LEVEL,)))
    if min(image, u, v) < 0:
        raise DataError(
            f"{path.name} has the columns {', '.join(columns)}; the image, x and y of each corner "
            "are needed.",
            culprits=[str(path)],
            next_step="Begin it with a header such as filename,id,x,y.",
        )
    by_image: dict[str, list[tuple[float, float, float]]] = {}
    counts: dict[str, int] = {}
    for row, place in zip(rows, places, strict=True):
        number = counts[row[image]] = counts.get(row[image], -1) + 1
        image_corners = by_image.setdefault(row[image], [])
        if {"-", "nan"} & {row[u], row[v], row[level] if level >= 0 else ""} or not row[u]:
            continue
        cells = (str(number) if point < 0 else row[point], row[u], row[v])
        if not all(is_number(cell) for cell in cells):
            raise DataError(
                f"{place}: {' '.join(cells)[:60]!r}; numbers are needed.", culprits=[place]
            )
        image_corners.append((float(cells[0]), float(cells[1]), float(cells[2])))
    for name, corners in by_image.items():
        numbers = np.array(corners).reshape(-1, 3)
        yield name, _checked(numbers[:, 0], numbers[:, 1:], f"{path.name}, {name}")


def _table(path: Path) -> tuple[Sequence[str], Sequence[Sequence[str]], Sequence[str]]:
    """Columns of a table, its rows, and the place of each row for messages."""
    if path.suffix.lower() != ".vnl":
        table = read_table(path)
        return table.columns, table.rows, [table.place(at) for at in range(len(table.rows))]
    lines = [
        (at, line.strip()) for at, line in enumerate(read_plain_text(path).splitlines(), start=1)
    ]
    # Comments start with ## or #!; the header with a single #.
    headers = [
        name[1:].split() for _, name in lines if name[:1] == "#" and name[1:2] not in ("#", "!")
    ]
    columns = headers[0] if headers else []
    rows = [
        (f"{path.name}, line {at}", name.split()) for at, name in lines if name and name[0] != "#"
    ]
    short = next((place for place, cells in rows if len(cells) != len(columns)), "")
    if short:
        raise DataError(
            f"{short}: it does not have the columns of the header, {' '.join(columns) or 'none'}.",
            culprits=[short],
            next_step="mrcal's header is: # filename x y level",
        )
    return columns, [cells for _, cells in rows], [place for place, _ in rows]


def _checked(ids: FloatArray, px: FloatArray, where: str) -> FoundCorners:
    if not (np.all(np.isfinite(px)) and np.all((ids % 1 == 0) & (np.abs(ids) < 2**31))):
        raise DataError(
            f"{where}: a corner has no finite place, or its number is not whole.", culprits=[where]
        )
    return FoundCorners(ids.astype(np.int64), px)

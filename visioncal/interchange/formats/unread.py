"""Content of a source that is not read: pictures within arrays, and other series of a file."""

import json
import shlex
from collections.abc import Sequence
from glob import escape
from pathlib import Path

import numpy as np

from visioncal.core.documents.jsons import pictures_in
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, some_of
from visioncal.interchange.formats.fields import Fields
from visioncal.interchange.formats.file_search import DRAWN
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.poses import possible_poses
from visioncal.interchange.formats.sources import Source

# Writes the pictures of .npz files to a folder, and beside them what else they hold.
_UNPACK = """\
import os, pathlib, cv2, numpy
os.makedirs({folder})
for file in pathlib.Path({parent}).glob({pattern}):
    arrays = dict(numpy.load(file))
    pictures = arrays.pop({array}, [])
    for at, picture in enumerate({pictures}):
        cv2.imwrite({folder} + f"/{{{name}}}.png", picture)
    numpy.savez({folder} + f"/{{file.stem}}.npz", **arrays)"""


def check_pictures(source: Source, requested: ImportOptions) -> None:
    """Raises DataError where what a camera saw are pictures in arrays, with how to write them."""
    rows = (fields for part in source.parts for fields in part.rows)
    has_both = not requested.target and any(len([*possible_poses(each)]) > 1 for each in rows)
    if source.images or requested.images or has_both:
        return
    for group in (part.group for part in source.parts if part.group.label.endswith(".npz")):
        found = _of_camera(group.files[0])
        if not found:
            continue
        (array, shape), is_single = next(iter(found.items())), len(group.files) == 1
        is_series = len(shape) - (shape[-1] == 3) == 3
        listed = (f"{name!r} ({' x '.join(map(str, each))})" for name, each in found.items())
        named = source.path if source.path.name else source.path.resolve()
        folder = f"{named if named.is_dir() else named.with_suffix('')}-pictures"
        script = _UNPACK.format(
            folder=json.dumps(folder),
            parent=json.dumps(str(group.files[0].parent)),
            pattern=json.dumps(escape(group.files[0].name) if is_single else "*.npz"),
            array=json.dumps(array),
            pictures="pictures" if is_series else "[pictures] * (len(pictures) > 0)",
            name="at:04d" if is_series else "file.stem",
        )
        command = [folder if Path(word) == source.path else word for word in requested.command]
        raise DataError(
            f"{group.label} has pictures in {some_of([*listed])}, but pictures must be files.",
            culprits=[group.label],
            next_step="Convert the files one by one: each has a series of its own."
            if is_series and not is_single
            else f"Write {array!r} into a folder, with what else there is, and convert that:\n"
            f"python -c {shlex.quote(script)} && {shlex.join(command)}",
        )


def _of_camera(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of an .npz that are pictures, drawn ones only where there are no others.

    Their names say that they were drawn, or all their values are equal, as those of an empty mask.
    """
    found = pictures_in(path)
    kept = {name: shape for name, shape in found.items() if not DRAWN.search(name)}
    if len(kept) > 1:
        with np.load(path) as arrays:
            kept = {name: kept[name] for name in kept if np.ptp(arrays[name])}
    return kept or found


def series_note(fields: Fields, others: Sequence[Fields]) -> tuple[str, ...]:
    """A note on other series of the same fields in the same file, which are not read."""
    own, keys = _series(fields)
    named = ((each, *_series(each)) for each in others)
    alike = {
        series: f"{series} ({counted(len(each), 'row')})"
        for each, series, names in named
        if own and series not in ("", own) and names == keys
    }
    if not alike:
        return ()
    note = f"Of several series {own} is read; left aside: {some_of([*alike.values()])}, for files"
    return (f"{note} of their own.",)


def _series(fields: Fields) -> tuple[str, set[str]]:
    """The name that stands before those of all fields, empty without one, and these."""
    parts = [name.partition(".")[::2] for name in fields.numbers]
    before = {series for series, name in parts if name}
    return before.pop() if len(before) == 1 else "", {name or series for series, name in parts}

"""Content of a source that is not read: pictures within arrays, and other series of a file."""

import json
import shlex
from collections.abc import Sequence

from visioncal.core.documents.jsons import pictures_in
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, some_of
from visioncal.interchange.formats.fields import Fields
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.poses import possible_poses
from visioncal.interchange.formats.sources import Source

# Writes the pictures of .npz files to a folder, and beside them what else they hold.
_UNPACK = """\
import os, pathlib, cv2, numpy
os.makedirs({folder}, exist_ok=True)
for file in pathlib.Path({parent}).glob({pattern}):
    arrays = dict(numpy.load(file))
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
        for name, shape in pictures_in(group.files[0]).items():
            is_series, array = len(shape) - (shape[-1] == 3) == 3, f"arrays.pop({json.dumps(name)})"
            folder = f"{source.path.with_suffix('')}-pictures"
            script = _UNPACK.format(
                folder=json.dumps(folder),
                parent=json.dumps(str(group.files[0].parent)),
                pattern=json.dumps(group.files[0].name if len(group.files) == 1 else "*.npz"),
                pictures=array if is_series else f"[{array}]",
                name="at:04d" if is_series else "file.stem",
            )
            command = [folder if word == str(source.path) else word for word in requested.command]
            raise DataError(
                f"{group.label} has pictures in its array {name!r} ({' x '.join(map(str, shape))}),"
                " but pictures must be files.",
                culprits=[group.label],
                next_step="Write them into a folder, with what else there is, and convert that:\n"
                f"python -c {shlex.quote(script)} && {shlex.join(command)}",
            )


def series_note(fields: Fields, others: Sequence[Fields]) -> tuple[str, ...]:
    """A note on other series of the same fields in the same file, which are not read."""
    own, keys = _series(fields)
    named = ((each, *_series(each)) for each in others)
    alike = {
        series: f"{series} ({counted(len(each), 'row')})"
        for each, series, names in named
        if own and series not in ("", own) and names == keys
    }
    note = f"Of several series {own} is read; left aside: {some_of([*alike.values()])}, for files"
    return (f"{note} of their own.",) * bool(alike)


def _series(fields: Fields) -> tuple[str, set[str]]:
    """The name that stands before those of all fields, empty without one, and these."""
    parts = [name.partition(".")[::2] for name in fields.numbers]
    before = {series for series, name in parts if name}
    return before.pop() if len(before) == 1 else "", {name or series for series, name in parts}

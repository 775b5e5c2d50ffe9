"""What an unknown source holds: files by kind, rows of named values, images and lenses.

`look` describes a source and `rows_in` proposes which of its rows are a recording's.
"""

import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.documents.tables import is_number, read_table
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, some_of
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.file_search import FileGroup, groups_in
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.intrinsics import LENS_KEYS, lenses_in
from visioncal.interchange.formats.poses import joint_names, pose_names, possible_poses
from visioncal.interchange.formats.reading import (
    DOCUMENTS,
    Fields,
    appearance,
    fields_of_document,
    fields_of_records,
    flattened,
    named_by,
    read_document,
    read_fields,
    unnamed_columns,
)


@dataclass(frozen=True, eq=False)
class Part:
    """Files of one kind, and what they hold."""

    group: FileGroup
    fields: Fields | None = None  # Rows of named values, one a file of several; None without.
    # What each of several files holds, by name.
    records: Sequence[Mapping[str, object]] = ()
    fault: DataError | None = None  # Why they cannot be read.
    # Fields of `[camera]` by where they stand.
    lenses: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Source:
    """What a file or folder holds."""

    path: Path
    parts: tuple[Part, ...]

    @property
    def images(self) -> tuple[FileGroup, ...]:
        """The groups of images."""
        return tuple(part.group for part in self.parts if part.group.is_images)

    def lens(self) -> tuple[Mapping[str, Any] | None, tuple[str, ...]]:
        """The only lens, or that of the colour camera, and where it is from; None without."""
        found = {place: lens for part in self.parts for place, lens in part.lenses.items()}
        named = {p: lens for p, lens in found.items() if "rgb" in p.lower() or "colo" in p.lower()}
        different = {str(lens): place for place, lens in (named or found).items()}
        if len(different) == 1:
            place = next(iter(different.values()))
            return found[place], (f"The intrinsics are those of {place}.",)
        note = f"Several intrinsics are left aside: {some_of([*found])}; --intrinsics names a file."
        return None, (note,) * bool(found)

    def words(self) -> str:
        """The text form: a line a kind of file, and one each for its fields."""
        lines = [f"{self.path} holds {counted(len(self.parts), 'kind')} of files:"]
        for part in self.parts:
            lines.append(f"  {part.group.listed()}: {_kind(part)}")
            lines += [f"    {line}" for line in _field_lines(part.fields)]
            lines += [f"    {place}: looks like a lens" for place in part.lenses]
        return "\n".join(lines[:60])


def _kind(part: Part) -> str:
    image = part.group.image if part.group.is_images else None
    if image is not None:
        depth = ", looks like depth" * image.is_depth
        return f"images, {image.size[0]} x {image.size[1]}, {image.words}{depth}"
    if part.fields is not None:
        return f"{counted(len(part.fields), 'row')} of named values"
    return "not read" if part.fault is None else part.fault.message


def _field_lines(fields: Fields | None) -> Iterator[str]:
    """A line a field: its name, the shape of a row, the range, and what it looks like."""
    if fields is None:
        return
    poses = {name: item for item in possible_poses(fields) for name in item.names}
    columns = [name for name, numbers in fields.numbers.items() if numbers.ndim == 1]
    for name, numbers in fields.numbers.items():
        if name in columns and name not in poses:
            continue
        shape = " x ".join(map(str, numbers.shape[1:])) or "1"
        look = "a pose" if name in poses else appearance(numbers) or _sized(numbers)
        finite = numbers[np.isfinite(numbers)]
        span = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ", empty"
        yield f"{name}: {shape}{span}{f': looks like {look}' if look else ''}"
    if plain := [name for name in columns if name not in poses]:
        yield f"numbers {some_of(plain, 20)}"
    if texts := [name for name in fields.texts if name not in fields.numbers]:
        yield f"texts {some_of(texts, 20)}"
    if fields.shape_errors:
        yield f"irregular {some_of([*fields.shape_errors])}"


def _sized(numbers: FloatArray) -> str:
    size = int(np.prod(numbers.shape[1:]))
    return {3: "a position or three angles", 6: "a pose, or six joints"}.get(size, "")


def look(path: Path, form: str | None = None) -> Source:
    """Describes a file or a folder, and those in it; `form` is that of a pendant's lines.

    Reads all of what may hold numbers, and the first image of each kind.
    """
    parts = [_part(group, form) for group in groups_in(path)]
    single = {part.group.files[0].stem: part for part in parts if len(part.group.files) == 1}
    arrays = {name: _array(part.fields) for name, part in single.items() if part.fields}
    for place, lens in lenses_in({k: v for k, v in arrays.items() if v is not None}, path.name):
        # A matrix and coefficients in a file each.
        of_lens = [single[name] for name in arrays if name in LENS_KEYS]
        parts = [replace(part, lenses={place: lens}) if part in of_lens else part for part in parts]
    return Source(path, tuple(parts))


def _array(fields: Fields) -> FloatArray | None:
    """The numbers of a file without names; None where they have some."""
    if [*fields.numbers] == ["matrix"]:
        return fields.numbers["matrix"]
    names = [str(at) for at in range(1, len(fields.numbers) + 1)]
    is_unnamed = bool(names) and [*fields.numbers] == names == [*fields.texts]
    return np.stack([*fields.numbers.values()], axis=1) if is_unnamed else None


def _part(group: FileGroup, form: str | None) -> Part:
    if not group.is_data:
        return Part(group)
    first, *others = group.files
    lenses, records = dict[str, Mapping[str, Any]](), list[Mapping[str, object]]()
    is_document = first.suffix.lower() in DOCUMENTS
    try:
        document = read_document(first) if is_document else None
        lenses = dict(lenses_in(document, group.label)) if is_document else {}
        if others:
            records = [_record(first, document), *map(_record, others)]
            fields = _fields_of(group, records)
        else:
            fields = fields_of_document(document, first) if document else read_fields(first, form)
    except DataError as error:
        return Part(group, fault=error, lenses=lenses)
    return Part(group, fields, records, lenses=lenses)


def _fields_of(group: FileGroup, records: Sequence[Mapping[str, object]]) -> Fields:
    """The rows of several files, one each."""
    places = [file.name for file in group.files]
    folder = group.files[0].parent
    fields = fields_of_records(records, places, group.name, folder, group.numbers)
    return replace(fields, stems=tuple(file.stem for file in group.files))


def _record(path: Path, document: object = None) -> dict[str, object]:
    """What one view's file holds, read unless it was; numbers without a name are its `matrix`."""
    if path.suffix.lower() in DOCUMENTS:
        document = document or read_document(path)
    else:
        table = read_table(path)
        rows = [[float(cell) if is_number(cell) else cell for cell in row] for row in table.rows]
        document = rows[0] if len(rows) == 1 else rows
        if table.has_header and len(rows) == 1:
            document = dict(zip(table.columns, rows[0], strict=True))
    return flattened(document if isinstance(document, Mapping) else {"matrix": document})


def rows_in(source: Source, requested: ImportOptions) -> Fields:
    """The rows of a source that are its recording: of one kind of file, or of several that fit.

    Files of one number, or of as many rows, are joined. Raises DataError, with the description,
    where no rows have the robot's poses or joints, or several do.
    """
    given = (*requested.robot.names, *requested.camera.names, *requested.joints)
    joined = _joined(source)
    usable = [fields for fields in joined if _has(fields, given) and _robot_fields(fields, given)]
    # A robot's program beside a table has the same poses once more.
    tables = [f for f in usable if not f.form]
    named = [f for f in usable if "pose" in f.name.lower() or "robot" in f.name.lower()]
    groups = (joined, usable, tables, named)
    chosen = next((group[0] for group in groups if len(group) == 1), None)
    if chosen is not None:
        return chosen
    faults = [part.fault for part in source.parts if part.fault and not part.lenses]
    if not joined and len(faults) == 1:
        raise faults[0]
    raise unknown(source, requested, joined)


def _has(fields: Fields, given: Sequence[str]) -> bool:
    names = [*fields.numbers, *fields.texts]
    return all(any(f".{name}.".find(f".{each}.") >= 0 for name in names) for each in given)


def _robot_fields(fields: Fields, given: Sequence[str]) -> bool:
    unnamed = unnamed_columns(fields)["robot"]
    return bool(given or pose_names(fields, (), unnamed, "robot", ()) or joint_names(fields, ()))


def unknown(source: Source, requested: ImportOptions, rows: Sequence[Fields] = ()) -> DataError:
    """What is said of a source whose poses are not known, with a command that takes it."""
    possible = [(fields, item) for fields in rows for item in possible_poses(fields)]
    possible.sort(
        key=lambda both: (
            [["robot"], []].index(both[1].sides) if both[1].sides in (["robot"], []) else 2
        )
    )
    step, options = "", list[str]()
    if possible:
        fields, robot = possible[0]
        others = [item for of, item in possible[1:] if of is fields and item.sides != ["robot"]]
        others = [item for item in others if item.sides] or others * (not source.images)
        for whose, item in zip(("robot", "camera"), (robot, *others[:1]), strict=False):
            options += [f"--{whose}-{named_by(fields.places[0])}", ",".join(item.names)]
        step = f"Say {' '.join(options)}, where these are its poses"
        step += f":\n{shlex.join([*requested.command, *options])}" if requested.command else "."
    elif rows:
        word = named_by(rows[0].places[0])
        step = f"Name them with --robot-{word}, or the joint angles with --joint-{word}."
    return DataError(
        f"{source.words()}\nWhich of these are the robot's poses is not known.",
        culprits=[str(source.path)],
        next_step=step or "Write the poses into a CSV with a header, a row a view.",
    )


def _joined(source: Source) -> list[Fields]:
    """Rows of the parts, those that belong together joined: by numbers, names, or their count."""
    keyed: dict[bool, list[tuple[Part, Fields, Sequence[int | str]]]] = defaultdict(list)
    counts: dict[tuple[int, str], list[tuple[Part, Fields]]] = defaultdict(list)
    for part in source.parts:
        fields = part.fields
        if fields is None or (part.lenses and len(part.group.files) == 1 and not _holds(fields)):
            continue
        if fields.stems:
            keyed[bool(fields.views)].append((part, fields, fields.views or fields.stems))
        else:
            counts[len(fields), fields.form].append((part, fields))
    found = [_by_keys(source.path, parts) for parts in keyed.values()]
    found += [_by_rows(source.path, parts) for parts in counts.values()]
    holding = [fields for fields in found if _holds(fields)]
    return holding or found


def _holds(fields: Fields) -> bool:
    return bool(possible_poses(fields) or unnamed_columns(fields)["robot"])


def _by_keys(path: Path, parts: Sequence[tuple[Part, Fields, Sequence[int | str]]]) -> Fields:
    """Joins files of one number or name; rows are those of the files with poses."""
    if len(parts) == 1:
        part, fields, _ = parts[0]
        return _called(fields, path, part)
    main = [item for item in parts if _holds(item[1])] or [*parts]
    keys = [*dict.fromkeys(key for _, _, found in main for key in found)]
    if main[0][1].views:
        keys.sort(key=lambda key: (isinstance(key, str), key))
    rows: dict[int | str, dict[str, object]] = {key: {} for key in keys}
    places: dict[int | str, list[str]] = defaultdict(list)
    stems: dict[int | str, str] = {}
    for part, fields, found in parts:
        each = zip(found, fields.places, part.group.files, part.records, strict=True)
        for key, place, file, record in each:
            if key not in rows:
                continue
            places[key].append(place)
            stems.setdefault(key, file.stem)
            rows[key] |= {
                part.group.name if name == "matrix" else f"{part.group.name}.{name}": value
                for name, value in record.items()
            }
    joined = [" and ".join(places[key]) for key in keys]
    views = tuple(key for key in keys if isinstance(key, int))
    fields = fields_of_records(
        [rows[key] for key in keys], joined, path.resolve().name, path, views
    )
    return replace(fields, stems=tuple(stems[key] for key in keys))


def _called(fields: Fields, path: Path, part: Part) -> Fields:
    """The rows of one kind of file, under the name of the folder."""
    if part.group.files == (path,):
        return fields
    name = path.resolve().name if fields.stems else fields.name
    folder = path if "/" not in part.group.label else part.group.files[0].parent
    return replace(fields, name=name, folder=folder)


def _by_rows(path: Path, parts: Sequence[tuple[Part, Fields]]) -> Fields:
    """Joins single files of as many rows; columns without names are an array of the file's name."""
    if len(parts) == 1:
        return _called(parts[0][1], path, parts[0][0])
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, tuple[str, ...]] = {}
    ragged: dict[str, str] = {}
    for part, fields in parts:
        name = part.group.files[0].stem
        is_unnamed = [*fields.texts] == [str(at) for at in range(1, len(fields.texts) + 1)]
        if is_unnamed and fields.texts:
            numbers[name] = np.stack([*fields.numbers.values()], axis=1)
            texts |= {
                f"{name}.{column}": cells
                for column, cells in fields.texts.items()
                if column not in fields.numbers
            }
            continue
        for column, values in fields.numbers.items():
            numbers[name if column == "matrix" else f"{name}.{column}"] = values
        texts |= {f"{name}.{column}": cells for column, cells in fields.texts.items()}
        ragged |= {f"{name}.{column}": fault for column, fault in fields.shape_errors.items()}
    names = [part.group.files[0].name for part, _ in parts]
    places = tuple(f"row {at + 1} of {' and '.join(names)}" for at in range(len(parts[0][1])))
    return Fields(
        path.resolve().name, path, places, numbers, texts, shape_errors=ragged, is_joined=True
    )

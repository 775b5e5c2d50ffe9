"""Rows of named values, and how rows of several sources belong together."""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from visioncal.core.choices import UNITS_M
from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.documents.pendants import is_marked_pose, line_numbers, read_pose
from visioncal.core.documents.tables import is_number
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M, FEWEST_VIEWS
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows
from visioncal.interchange.formats.keys import HOW, Keys, Match, in_seconds, matched

_TIME_NAMES = ("stamp_s", "t", "time", "timestamp", "stamp", "time_s", "#timestamp")
_NORM_TOLERANCE = 0.01
# A pose with its covariance has fewer numbers; images have more, and corners, in pairs, may have.
MOST_NUMBERS, _MOST_CORNERS = 200, 1_000
# Numbers of a pose: three angles or a quaternion beside a position, and matrices.
POSE_SIZES = (6, 7, 12, 16)


# Names of corners in an image, and the fewest that are a board's.
_CORNERS = re.compile("corner|pixel|im(a?ge?|g)_?(points|pts)|points_?2d", re.IGNORECASE)
_FEWEST_CORNERS = 4


def named_by(place: str) -> str:
    """End of the name of the option that names fields: the `columns` of a table, else a `key`."""
    return "columns" if ", line " in place else "key"


# An ordinal indicator is common for the degree sign, too.
DEGREES = ("deg", "degrees", "°", "º")
ANGLES = (*DEGREES, "rad", "radians")
# q1_rad is a joint; q1 alone is part of a quaternion.
_UNIT = re.compile(
    rf"(?!q[0-9])(.*?)[ _]*+(?:[(\[] *({'|'.join([*UNITS_M, *ANGLES])}) *[)\]]"
    rf"|(?<=_)({'|'.join([*UNITS_M, *ANGLES])}))",
    re.IGNORECASE,
)
_UNITLESS = re.compile(r"\s*+[\[(]\s*+[-1]?+\s*+[\])]$")


def without_unit(name: str) -> tuple[str, str]:
    """A field's name without its unit, and that, or none: `rx(deg)`, `X [mm]`, `x_m`."""
    # A number without a unit has empty brackets: `q_w []`.
    name = _UNITLESS.sub("", name)
    match = _UNIT.fullmatch(name)
    return (match[1], (match[2] or match[3]).lower()) if match and match[1] else (name, "")


@dataclass(frozen=True)
class ShapeFault:
    """A field whose rows differ in shape."""

    words: str  # The first row that differs, and how.
    count: int  # Numbers that most rows have.


@dataclass(frozen=True, eq=False)
class Fields:
    """Named values of n rows."""

    name: str  # Name of the recording.
    folder: Path  # Names of images are relative to it.
    places: tuple[str, ...]  # (n,) place of each row in the source, for messages.
    numbers: Mapping[str, FloatArray]  # (n, ...) arrays by name; NaN where a row has none.
    # (n,) texts by name, of every column of a table and of single numbers.
    texts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    views: tuple[int, ...] = ()  # (n,) the rows' numbers, where their files' names have them.
    # (n,) names of the rows' files without their ending, or of a program's points.
    stems: tuple[str, ...] = ()
    # Faults of fields whose rows differ in shape, by name.
    shape_errors: Mapping[str, "ShapeFault"] = field(default_factory=dict)
    form: str = ""  # A name among `POSE_FORMS` where the rows state the form of the robot's poses.
    notes: tuple[str, ...] = ()  # Remarks on the source, for the user.

    def __len__(self) -> int:
        return len(self.places)

    def rows(self, chosen: Sequence[int]) -> Self:
        """The same values for some rows only."""
        return replace(
            chosen_rows(self, list(chosen), "notes"),
            numbers={name: number[list(chosen)] for name, number in self.numbers.items()},
            texts={name: tuple(text[at] for at in chosen) for name, text in self.texts.items()},
        )

    def find(self, name: str) -> str:
        """Full name of a field, which may be given without the prefix before its last point.

        Raises:
            DataError: There is no such field; the message lists the existing ones.
        """
        names = list(dict.fromkeys([*self.numbers, *self.texts, *self.shape_errors]))
        if name in names:
            return name
        matches = [word for word in names if word.endswith(f".{name}")]
        if len(matches) == 1:
            return matches[0]
        if matches:
            raise DataError(
                f"{self.name}: {name!r} may be {some_of(matches)}: give the full name.",
                culprits=matches,
            )
        raise DataError(
            f"{self.name} has no column or key {name!r}; it has {self.listing()}.",
            culprits=[name],
            next_step=did_you_mean(name, names),
        )

    def column(self, name: str) -> FloatArray:
        """The numbers of a field, (n, k); raises DataError."""
        full = self.find(name)
        if full in self.shape_errors:
            raise DataError(self.shape_errors[full].words, culprits=[full])
        if full not in self.numbers:
            cells = zip(self.places, self.texts[full], strict=True)
            odd = ((place, word) for place, word in cells if word and not is_number(word))
            place, text = next(odd, (self.places[0], ""))
            raise DataError(
                f"{place}: {full} must be a number, but is {text[:40]!r}.",
                culprits=[place],
                next_step=f"Correct the cell, or delete {place}; or leave the whole pose of that "
                "row empty.",
            )
        return self.numbers[full].reshape(len(self), -1)

    @cached_property
    def keys(self) -> "Keys":
        """The key of the rows."""
        names = {"": self.stems} if self.stems else {}
        # The values of a list of their own are no keys.
        for name, cells in self.texts.items() if len({*self.numbers, *self.texts}) > 1 else ():
            numbers = self.numbers.get(name, np.zeros(1))
            # A measured number is no name, and its digits no number.
            if any(cells) and not (numbers[np.isfinite(numbers)] % 1).any():
                names[name] = cells
        stamp = stamp_name(self, ())
        times = {"times": in_seconds(self.column(stamp)[:, 0]).tolist()} if stamp else {}
        return Keys.of(len(self), names, numbers=self.views, **times)

    def listing(self) -> str:
        """Lists the fields with their numbers of values a row, for messages."""
        names = list(dict.fromkeys([*self.numbers, *self.texts]))
        words = [
            f"{name} ({int(np.prod(self.numbers[name].shape[1:]))})"
            if name in self.numbers and self.numbers[name].ndim > 1
            else name
            for name in names
        ]
        return some_of(words, 40)


def fields_of_records(
    records: Sequence[Mapping[str, object]],
    places: Sequence[str],
    name: str,
    folder: Path,
    views: tuple[int, ...] = (),
) -> Fields:
    """Fields of n records of texts and arrays, as `flattened` returns them.

    Texts that are numbers in all filled rows are numbers, too; a value missing in a row is NaN.
    """
    numbers: dict[str, FloatArray] = {}
    texts: dict[str, tuple[str, ...]] = {}
    ragged: dict[str, ShapeFault] = {}
    for key in dict.fromkeys(name for record in records for name in record):
        values = [record.get(key) for record in records]
        arrays = sum(isinstance(value, np.ndarray) and value.ndim > 0 for value in values)
        if 2 * arrays > len(values):
            # A word where others have numbers marks their absence.
            values = [None if isinstance(value, str) else value for value in values]
        values = arrays_in_texts(values)
        if any(isinstance(value, str) for value in values):
            cells = texts[key] = tuple("" if value is None else str(value) for value in values)
            if any(cells) and all(not cell or is_number(cell) for cell in cells):
                numbers[key] = np.array([float(cell) if cell else np.nan for cell in cells])
            continue
        shapes = Counter(value.shape for value in values if isinstance(value, np.ndarray))
        shape = shapes.most_common(1)[0][0] if shapes else ()
        for place, value in zip(places, values, strict=True):
            if value is not None and getattr(value, "shape", None) != shape:
                ragged[key] = ShapeFault(
                    f"{place}: {key} must be a list or matrix of numbers of the shape {shape}, as "
                    "in most rows.",
                    int(np.prod(shape)),
                )
                break
        else:
            empty = np.full(shape, np.nan)
            array = np.array([empty if value is None else value for value in values], float)
            if shape == (2, 4, 4):
                # Both sides of a pair of matrices in one array.
                numbers |= {f"{key}.{at}": array[:, at] for at in (0, 1)}
                continue
            numbers[key] = _without_counts(array)
            if not shape:
                # As cells of a table: whole numbers without a decimal point.
                texts[key] = tuple(
                    "" if np.isnan(each) else str(int(each)) if each % 1 == 0 else repr(each)
                    for each in numbers[key].tolist()
                )
    return Fields(name, folder, tuple(places), numbers, texts, views, shape_errors=ragged)


def _without_counts(numbers: FloatArray) -> FloatArray:
    """(n, k) numbers of a position, a rotation or a pose without columns that count or name rows.

    The first of them counts from zero or one; after it stand whole numbers, as of a marker.
    """
    if numbers.ndim != 2 or len(numbers) < FEWEST_VIEWS or numbers.shape[1] < 4:
        return numbers
    steps = numbers[:, 0] - np.arange(len(numbers))
    if (steps != steps[0]).any() or steps[0] not in (0, 1):
        return numbers
    whole = int(np.argmin([*(numbers % 1 == 0).all(axis=0), False]))
    sizes = (numbers.shape[1] - left for left in range(whole, 0, -1))
    size = next((each for each in sizes if each in (3, *POSE_SIZES)), 0)
    return numbers[:, -size:] if size and not appearance(numbers) else numbers


def arrays_in_texts(values: list[object]) -> list[object]:
    """Values with arrays in the place of texts, where all of these are lists of numbers or poses.

    A pose in a maker's notation becomes its matrix [m].
    """
    texts = [value for value in values if isinstance(value, str) and value]
    if len(texts) < 2 or any(isinstance(value, np.ndarray) for value in values):
        return values
    arrays = dict[str, FloatArray]()
    for text in texts:
        with suppress(DataError):
            numbers = [*separate(text)]
            if len(numbers) > 2:
                arrays[text] = np.array(numbers)
            elif len(text) < MOST_NUMBERS and is_marked_pose(text):
                arrays[text] = read_pose(text, text).pose
        if text not in arrays:
            return values
    return [arrays.get(value) if isinstance(value, str) else value for value in values]


def separate(text: str) -> Iterator[float]:
    """The numbers of a text of nothing else, with blanks, commas or semicolons between."""
    words = [word for word in re.split(r"[\s,|\[\](){}]+", text) if word]
    if all(map(is_number, words)) and (";" not in text and ("." in text or ", " in text)):
        return map(float, words)
    return iter(line_numbers(text))


def appearance(numbers: FloatArray) -> str:
    """Whether (n, ...) numbers are those of a `pose`, `rotation` or `quaternion`; else empty."""
    flat = numbers.reshape(len(numbers), -1)
    flat = flat[np.isfinite(flat).all(axis=1)]
    size = flat.shape[1]
    if not len(flat) or size not in (4, 7, 9, 12, 16):
        return ""
    if size in (4, 7):
        is_unit = _are_unit(flat[:, -4:]) or _are_unit(flat[:, :4])
        return ("quaternion" if size == 4 else "pose") * is_unit
    is_rotation = _are_rotations(flat if size == 9 else split_matrices(flat)[1])
    return ("rotation" if size == 9 else "pose") * bool(is_rotation.mean() > 0.5)


def _are_rotations(flat: FloatArray) -> Mask:
    """Whether each of (n, 9) numbers is a rotation matrix by rows."""
    # Of others the nearest rotations, which take long to compute, are not needed.
    rows_away = np.abs(np.linalg.norm(flat.reshape(-1, 3, 3), axis=2) - 1.0)
    found = np.asarray((rows_away < _NORM_TOLERANCE).all(axis=1))
    found[found] = np.isfinite(ROTATION_FORMS["matrix"].read(flat[found])).all(axis=(1, 2))
    return found


def _are_unit(numbers: FloatArray) -> bool:
    """Whether most (n, k) numbers are unit vectors; others are refused by their row."""
    away = np.abs(np.linalg.norm(numbers, axis=1) - 1.0)
    return bool((away < _NORM_TOLERANCE).sum() * 2 > np.isfinite(away).sum())


def position_first(flat: FloatArray) -> FloatArray:
    """(n, 7) numbers with the position first, whichever four are unit quaternions."""
    is_last = _are_unit(flat[:, -4:]) or not _are_unit(flat[:, :4])
    return flat if is_last else np.roll(flat, 3, axis=1)


def is_small(array: FloatArray) -> bool:
    """Whether an array of a row may be a pose, other numbers of it, or (k, 2) corners."""
    is_pairs = array.ndim > 1 and array.shape[-1] == 2
    return array.size <= (2 * _MOST_CORNERS if is_pairs else MOST_NUMBERS)


def corners_in(fields: Fields) -> tuple[str, FloatArray | None]:
    """The only field of (n, k, 2) corners [px], by its name, and these; else empty and None."""
    found = {
        name: numbers.reshape(len(fields), -1, 2)
        for name, numbers in fields.numbers.items()
        if numbers.ndim > 2 and numbers.shape[-1] == 2 and _CORNERS.search(name)
    }
    found = {name: each for name, each in found.items() if each.shape[1] >= _FEWEST_CORNERS}
    return next(iter(found.items())) if len(found) == 1 else ("", None)


def holds_pose(fields: Fields) -> bool:
    """Whether numbers of a row are those of a pose or a rotation, whatever their names."""
    return any(appearance(numbers) for numbers in fields.numbers.values())


def split_matrices(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Splits (n, 16) or (n, 12) numbers of matrices into (n, 3) positions and (n, 9) rotations."""
    last = np.array([0.0, 0, 0, 1])
    if flat.shape[1] == 12:
        matrices = flat.reshape(-1, 3, 4)
        by_rows = matrices[:, :, 3], matrices[:, :, :3].reshape(-1, 9)
        ways = (by_rows, (flat[:, :3], flat[:, 3:]), (flat[:, 9:], flat[:, :9]))
        places, turns = max(ways, key=lambda way: int(_are_rotations(way[1]).sum()))
        return places.copy(), turns.copy()
    square = flat.reshape(-1, 4, 4)
    by_columns = (square[:, :, 3] == last).all(axis=1) & ~(square[:, 3] == last).all(axis=1)
    matrices = np.where(by_columns[:, None, None], np.swapaxes(square, 1, 2), square)
    wrong = np.isfinite(matrices).all(axis=(1, 2)) & (
        np.abs(matrices[:, 3] - last).max(axis=1) > 1e-6
    )
    # A matrix with another last row is no rigid transform: its zeroed rotation is refused later.
    matrices = np.where(wrong[:, None, None], 0.0, matrices)
    return matrices[:, :3, 3].copy(), matrices[:, :3, :3].reshape(-1, 9).copy()


def joined(
    parts: Sequence[Fields], name: str, folder: Path, *, prefixed: bool = False
) -> list[Fields]:
    """Rows of several sources, those joined that belong together; fields with poses come first.

    `name` and `folder` are those of the joined rows; `prefixed` puts the source's name before each
    field's.
    """
    # Each with its row for every row of the first.
    clusters: list[list[tuple[Fields, IntArray]]] = []
    each = (piece for part in parts for piece in _by_category(part))
    for part in sorted(each, key=lambda item: (not holds_pose(item), -len(item))):
        is_unmatched = True
        for cluster in clusters:
            main = cluster[0][0]
            match = _match(main, part)
            # Rows that name images may do so for several others.
            if match is not None and (is_unmatched or match.how != HOW[-1]):
                cluster.append((part, match.rows))
                is_unmatched = False
                if holds_pose(part):
                    break
        if is_unmatched:
            clusters.append([(part, np.arange(len(part)))])
    return [
        cluster[0][0] if len(cluster) == 1 else _merged(cluster, name, folder, prefixed=prefixed)
        for cluster in clusters
    ]


def _match(main: Fields, part: Fields) -> Match | None:
    """How rows of one source belong to those of another; None where they are not the same rows.

    Small numbers in columns of other names, as those of four cameras beside the counts of forty
    rows, are the same by chance unless most rows have them.
    """
    match = matched(main.keys, part.keys) if main.form == part.form else None
    if match is None or match.how != HOW[1] or match.is_sure:
        return match
    return match if 2 * int((match.rows >= 0).sum()) > max(len(main), len(part)) else None


def _by_category(fields: Fields) -> list[Fields]:
    """The rows of each of several bodies, where a column names these and another counts them."""
    whole = [cells for cells in fields.texts.values() if "." not in "".join(cells)]
    for cells in whole:
        kinds = [*dict.fromkeys(cells)]
        if not 1 < len(kinds) < 9 or len(cells) < 3 * len(kinds) or "" in kinds:
            continue
        for count in whole:
            is_key = len({*zip(cells, count, strict=True)}) == len(cells)
            if is_key and len({*count}) * 2 <= len(cells) < len({*count}) * len(kinds) + 1:
                rows = ([at for at, cell in enumerate(cells) if cell == kind] for kind in kinds)
                return [
                    replace(fields.rows(chosen), name=f"{fields.name}.{kind}")
                    for kind, chosen in zip(kinds, rows, strict=True)
                ]
    return [fields]


def _merged(
    members: Sequence[tuple[Fields, IntArray]], name: str, folder: Path, *, prefixed: bool
) -> Fields:
    numbers, texts = dict[str, FloatArray](), dict[str, tuple[str, ...]]()
    ragged = dict[str, ShapeFault]()
    places: list[list[str]] = [[] for _ in members[0][1]]
    for part, rows in members:
        known = {*numbers, *texts}
        new = {
            key: part.name
            if key == "matrix" and prefixed
            else f"{part.name}." * (prefixed or key in known) + key
            for key in (*part.numbers, *part.texts, *part.shape_errors)
        }
        values = dict(part.numbers)
        if prefixed and is_headerless(part):
            # Columns without names are an array of the file's; the first may count the rows.
            flat = np.stack([*values.values()], axis=1)
            counts = flat[:, 0]
            is_counted = not (counts % 1).any() and bool((np.diff(counts) > 0).all())
            flat = flat[:, 1:] if is_counted and flat.shape[1] - 1 in POSE_SIZES else flat
            new[part.name], values = part.name, {part.name: flat}
        for key, each in values.items():
            numbers[new[key]] = each[rows].astype(float)
            numbers[new[key]][rows < 0] = np.nan
        texts |= {
            new[key]: tuple(cells[at] if at >= 0 else "" for at in rows)
            for key, cells in part.texts.items()
            if key in values or key not in part.numbers
        }
        ragged |= {new[key]: fault for key, fault in part.shape_errors.items()}
        for row in np.flatnonzero(rows >= 0):
            places[row].append(part.places[rows[row]])
    return replace(
        members[0][0],
        name=name,
        folder=folder,
        places=tuple(" and ".join(dict.fromkeys(each)) for each in places),
        numbers=numbers,
        texts=texts,
        shape_errors=ragged,
    )


def unit_by_size(lengths: FloatArray) -> str:
    """The likely unit of lengths whose source says none: no arm and no camera reaches 20 m."""
    return "mm" if np.nanmax(np.abs(lengths), initial=0.0) > FAR_M else "m"


def is_headerless(fields: Fields) -> bool:
    """Whether the columns are those of a table without a header."""
    return bool(fields.texts) and [*fields.texts] == [str(n + 1) for n in range(len(fields.texts))]


def stamp_name(fields: Fields, taken: Collection[str]) -> str:
    """Finds the field of times, one number a row and not `taken`; else empty."""
    for name, numbers in fields.numbers.items():
        if name in taken or numbers.ndim > 1:
            continue
        if name.lower() in _TIME_NAMES:
            return name
        # Numbers that count rows, possibly with gaps, are no times; those of an epoch are larger.
        if name == "1" and is_headerless(fields) and (np.diff(numbers) > 0).all():
            is_time = (numbers % 1 != 0).any() or numbers.max(initial=0.0) >= 1e6
            return name if is_time else ""
    return ""

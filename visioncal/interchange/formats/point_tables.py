"""Tables of measured points by the words of their headings, in any order and language."""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from visioncal.core.conventions import UNITS_M
from visioncal.core.documents.tables import is_number
from visioncal.interchange.formats.fields import Fields, is_headerless, unit_by_size
from visioncal.interchange.formats.file_search import head
from visioncal.interchange.formats.foreign import ImportOptions
from visioncal.interchange.formats.joints import OF_ARMS, joint_names
from visioncal.interchange.formats.poses import pose_names

Words: TypeAlias = frozenset[str]


def word_set(words: str) -> Words:
    """Words of headings that mean the same, given in small letters with spaces between."""
    return frozenset(words.split())


# Words of headings, in small letters.
MEASURED = word_set("meas measured act actual ist gemessen tracker probe medido mesuré")
UNCERTAIN = word_set("u u95 u99 unc uncertainty unsicherheit sigma std stdev sd s incertidumbre")
TURNS, FORCE = word_set("r rot rotation"), word_set("f force kraft fuerza")
PAYLOAD = word_set("payload load last nutzlast mass masse weight gewicht carga")
CENTRE = word_set("cog com centre center schwerpunkt")
OTHER = TURNS | FORCE | UNCERTAIN | PAYLOAD | CENTRE
OTHER |= word_set("robot roboter tcp flange base programmed prog cmd commanded controller")
OTHER |= word_set("nom nominal soll ref reference design cad d dev deviation delta diff error tol")
OTHER |= word_set("tolerance upper lower n normal rms offset abweichung")
# An axis in one word with what is measured, as in Ux, ActX, Rx.
_PREFIX = re.compile(r"(u|u95|unc|s|sd|std|sigma|d|dev|nom|act|meas|r|f|n)([xyz])")
UNITS = {name: name for name in (*UNITS_M, "deg", "rad", "kg", "n")} | {
    word: name
    for name, words in {
        "inch": "in inches zoll",
        "deg": "° º degree degrees",
        "mm": "millimeter millimeters millimetre millimetres",
        "m": "meter meters metre metres",
        "um": "µm μm micron microns",
    }.items()
    for word in words.split()
}
# Names of files of joint angles without headings.
_OF_JOINTS = re.compile("joint|angle|theta|achs|gelenk", re.IGNORECASE)
_UNIT_LINE = re.compile(r"\b(?:units?|length|einheit(?:en)?)\b[\W_]*([^\W_]+)", re.IGNORECASE)


@dataclass(frozen=True)
class Heading:
    """A column's name, taken apart."""

    words: Words  # Without axis and unit.
    axis: str  # x, y or z; else empty.
    unit: str  # Empty where it states none.

    @classmethod
    def of(cls, name: str) -> "Heading":
        """A name, such as `Meas. Z [mm]`, `ActX` or `U95 X`."""
        spaced = re.sub(r"(?<=[a-z0-9])(?=[XYZ]\b)|(?<=[XYZ])(?=[A-Z][a-z])", " ", name)
        words = list[str]()
        for word in re.split(r"[\s_.,;:/()\[\]{}=%-]+", spaced.lower()):
            joined = _PREFIX.fullmatch(word)
            words += joined.groups() if joined else [word] * bool(word)
        axes = [word for word in words if word in ("x", "y", "z")]
        unit = UNITS.get(words[-1], "") if len(words) > 1 else ""
        others = words[: len(words) - bool(unit)]
        return cls(frozenset(others) - {*axes}, axes[0] if len(axes) == 1 else "", unit)


@dataclass(frozen=True, eq=False)
class PointTable:
    """Rows of a file by their headings, and what the robot did in them."""

    fields: Fields
    title: str = ""  # Comments and lines above the rows.
    file: str = ""
    joints: tuple[str, ...] = ()  # Columns of joint angles.
    poses: tuple[str, ...] = ()  # Columns of the robot's poses.

    @classmethod
    def of(cls, fields: Fields, file: Path, requested: ImportOptions) -> "PointTable":
        """The rows of a file, one a point, with the lines above them."""
        lines = head(file).splitlines()[:60]
        sizes = [sum(map(is_number, re.split(r"[\s,;]+", line))) for line in lines]
        first = next((at for at, size in enumerate(sizes) if size > 2), len(lines))
        title = "\n".join(text for at, text in enumerate(lines) if at < first or text[:1] in "/#%")
        fields = _side_by_side(_by_axis(_with_headings(fields)))
        field_names = {*fields.numbers, *fields.texts}
        table = cls(fields, title, file.name)
        taken = tuple(name for name in requested.camera.names if name in field_names)
        taken = taken or next(iter(table.points().values()), ())
        joints = tuple(name for name in requested.joints if name in field_names)
        joints = joints or joint_names(fields, taken)
        if is_headerless(fields) and len(fields.numbers) in OF_ARMS:
            joints = joints or tuple(fields.numbers) * bool(_OF_JOINTS.search(fields.name))
        given = tuple(name for name in requested.robot.names if name in field_names)
        others = (*joints, *(taken if joints or table.is_measured else ()))
        poses = pose_names(fields, given, "robot", others, by_shape=False)
        return replace(table, joints=joints, poses=poses)

    def triples(self) -> dict[Words, tuple[str, ...]]:
        """Columns of x, y and z that share all other words, by these."""
        found = defaultdict[Words, dict[str, str]](dict)
        for name in self.fields.numbers:
            if (heading := Heading.of(name)).axis:
                found[heading.words].setdefault(heading.axis, name)
        return {words: tuple(g[a] for a in "xyz") for words, g in found.items() if len(g) == 3}

    def points(self) -> dict[Words, tuple[str, ...]]:
        """Columns of measured places by their words, the likeliest alone where one is."""
        free = {words: names for words, names in self.triples().items() if not words & OTHER}
        best = {words: names for words, names in free.items() if words & MEASURED}
        return best or ({word_set(""): free[word_set("")]} if word_set("") in free else free)

    @property
    def is_measured(self) -> bool:
        """Whether a heading says that places are measured."""
        return any(words & MEASURED for words in self.points())

    def named(self, kind: Words) -> str:
        """The first column of a kind of names or texts; empty without."""
        return next((n for n in self.fields.texts if Heading.of(n).words & kind), "")

    def unit(self, names: Sequence[str], requested: str | None) -> tuple[str, tuple[str, ...]]:
        """Unit of lengths in some columns, and a note where nothing states it."""
        stated = {Heading.of(name).unit for name in names} & {*UNITS_M}
        above = {UNITS.get(word.lower(), "") for word in _UNIT_LINE.findall(self.title)}
        if requested or len(stated) == 1 or len(stated := above & {*UNITS_M}) == 1:
            return requested or stated.pop(), ()
        unit = unit_by_size(np.hstack([self.fields.column(name) for name in names]))
        note = f"{', '.join(names)} are taken for {unit}; --camera-unit names another unit."
        return unit, (note,)


def _with_headings(fields: Fields) -> Fields:
    """Rows of names, x, y, z and uncertainties without headings, with these."""
    lists = [numbers for numbers in fields.numbers.values() if numbers.ndim == 2]
    is_array = len(fields.numbers) == 1 and lists and not joint_names(fields, ())
    if is_array and lists[0].shape[1] == 3:
        # An array of a file of arrays, which keeps its name.
        axes = {axis: lists[0][:, at] for at, axis in enumerate("xyz")}
        return replace(fields, numbers={**fields.numbers, **axes})
    columns = [*fields.texts]
    names = [name for name in columns if name not in fields.numbers]
    if not names and len(columns) in (4, 7) and not (fields.column(columns[0]) % 1).any():
        names = columns[:1]
    numbers = columns[len(names) :]
    is_list = is_headerless(fields) and [*fields.numbers][-len(numbers) :] == numbers
    if not is_list or len(names) > 3 or len(numbers) not in ((3, 6) if names else (3,)):
        return fields
    headings = [*["collection", "group", "target"][3 - len(names) :], *"xyz"]
    if len(numbers) == 6:
        # PolyWorks writes normals behind places, which are of unit length.
        last = np.hstack([fields.column(name) for name in numbers[3:]])
        is_normal = np.allclose(np.linalg.norm(last, axis=1), 1.0, atol=1e-3)
        headings += [f"{'n' if is_normal else 'u'}{axis}" for axis in "xyz"]
    known = dict(zip(columns, headings, strict=True))
    arrays = {known[name]: fields.numbers[name] for name in numbers}
    texts = {known[name]: cells for name, cells in fields.texts.items()}
    return replace(fields, numbers=arrays, texts=texts)


def _by_axis(fields: Fields) -> Fields:
    """Rows of a report with a row an axis, with a row a point."""
    measured = [name for name in fields.numbers if Heading.of(name).words & MEASURED]
    axes = [cells for cells in fields.texts.values() if {*map(str.lower, cells)} == {*"xyz"}]
    if len(measured) != 1 or len(axes) != 1:
        return fields
    places, heads = fields.column(measured[0])[:, 0], np.char.lower(axes[0])
    starts = np.flatnonzero(heads == "x")
    triples = starts[:, None] + np.arange(3)
    if 3 * len(starts) != len(fields) or (heads[triples] != [*"xyz"]).any():
        return fields
    numbers = {
        measured[0].replace(" ", "_") + f" {a}": places[starts + at] for at, a in enumerate("xyz")
    }
    return replace(fields.rows(starts.tolist()), numbers=numbers)


def _side_by_side(fields: Fields) -> Fields:
    """Rows of several points side by side, with a row a point."""
    measured = PointTable(fields).points()
    if len(measured) < 2:
        return fields
    long = fields.rows(np.repeat(np.arange(len(fields)), len(measured)).tolist())
    columns = [name for names in measured.values() for name in names]
    places = np.hstack([fields.column(name) for name in columns]).reshape(-1, 3)
    units = {Heading.of(name).unit for name in columns}
    end = f" [{units.pop()}]" if len(units) == 1 and "" not in units else ""
    arrays = {name: numbers for name, numbers in long.numbers.items() if name not in columns}
    texts = {name: cells for name, cells in long.texts.items() if name not in columns}
    labels = tuple(" ".join(sorted(words)) for words in measured) * len(fields)
    return replace(
        long,
        numbers=arrays | {f"{axis}{end}": places[:, at] for at, axis in enumerate("XYZ")},
        texts={name: cells for name, cells in texts.items() if name != "target"}
        | {"target": labels},
    )

"""Reads lines of text as rows of named values: logs, programs, makers' notations of poses."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from visioncal.core.conventions import write_pose
from visioncal.core.documents.pendants import PendantPose, is_marked_pose, read_pose
from visioncal.core.documents.tables import is_number
from visioncal.core.errors import DataError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import POSE_SIZES, Fields, fields_of_records, separate

# Robots' programs, of which the poses alone are read.
PROGRAMS = (".dat", ".src", ".ls", ".mod", ".script")
# Field names of a pose by its number of values.
_NAMES = {6: ("x", "y", "z", "rx", "ry", "rz"), 7: ("x", "y", "z", "q1", "q2", "q3", "q4")}
# A word that is no image's name is looked through once.
IMAGE = re.compile(
    r"(?<![^\s,;\"'<>=])[^\s,;\"'<>=]+\.(?:png|jpe?g|tiff?|bmp)(?![\w.])", re.IGNORECASE
)
# Declarations of a program beside targets.
_FRAMES = re.compile("tool|wobj|load|base", re.IGNORECASE)
COMMENTS = ("#", "%", "//", "!")
# The name of a taught point: `DECL E6POS XP1={`, `CONST robtarget p10:=`, `P[1]{`, `P1: X ..`.
_POINT = re.compile(r"([\w\s]++(?:\[\w++)?+)\]?+\s*+[:={]")
_HEADED = re.compile(r"\s*([^\d\W][^:=]*?)\s*[:=]\s*(.*?)\s*")
# A pose of a URScript, a name that is assigned one, and a move.
_LITERAL = r"p\[[^\]\[]*\]"
_ASSIGNED = re.compile(rf"\b(\w+)[ \t]*=[ \t]*({_LITERAL})")
_MOVED = re.compile(rf"\bmove[jlpc]\s*\(\s*(?:get_inverse_kin\s*\(\s*)?({_LITERAL}|\w+)")
# Numbers of a position or a quaternion, a line each below its heading.
_PARTS = ("x", "y", "z", "w")
# A list within a line of text, and one behind the count of its numbers, as `Q[6]{..}` of RobWork.
_INNER = re.compile(r"[\[({]([^\[\](){}]*)[\])}]")
_REMARK = re.compile(r"\s*(?:\[[^\]]*\]|\([^)]*\))")
COUNTED = re.compile(r"\s*\w*\[[0-9]+\]\s*\{")
# Lines with their places.
_Lines: TypeAlias = Sequence[tuple[str, str]]


def _numbers_in(line: str) -> tuple[str, list[float]]:
    """The numbers of a line of nothing else but a name before them, or its lists; with the name."""
    entry = _HEADED.fullmatch(line)
    for name, text in (("matrix", line), *([(entry[1], entry[2])] if entry else [])):
        if numbers := [*separate(text)]:
            return name, numbers
    text = IMAGE.sub(" ", line)
    lists = {match.start(): [*separate(match[1])] for match in _INNER.finditer(text)}
    lists = {at: numbers for at, numbers in lists.items() if len(numbers) > 2}
    # Times and counts before them differ from row to row.
    words = re.findall(r"[^\W\d]+", text[: min(lists, default=0)])
    return " ".join(words[-3:]) or "matrix", [n for numbers in lists.values() for n in numbers]


def _stops(lines: _Lines) -> list[_Lines]:
    """The lines of a log by its pictures, or else by its named poses or its lines of words.

    Pictures and words end their lines where the first has as many numbers above it as usual; else
    begin them, as those do that stand beside numbers.
    """
    inner = [_numbers_in(line) for _, line in lines]
    sizes = {len(numbers) for _, numbers in inner}
    if len(sizes) == 1 and sizes <= {*POSE_SIZES}:
        # Lists alone, one a stop.
        return [[line] for line in lines]
    marked = (is_marked_pose(line) for _, line in lines)
    counts = np.array(
        [6 if is_pose else len(n) for is_pose, (_, n) in zip(marked, inner, strict=True)]
    )
    marks = np.array([IMAGE.search(line) is not None for _, line in lines], dtype=bool)
    if not marks.any():
        named = [name * (len(n) in POSE_SIZES and name != "matrix") for name, n in inner]
        most, count = Counter(filter(None, named)).most_common(1)[0] if any(named) else ("", 0)
        words = Counter(line for (_, line), count in zip(lines, counts, strict=True) if not count)
        # Of headings those that differ are the stops'.
        once = np.array([words[line] == 1 for _, line in lines], dtype=bool)
        same = {count for count in words.values() if count > 1}
        first = next(iter(words), "")
        if not once.any() and len(words) > 1 and len(same) == 1:
            # Headings in turn: the first begins a stop.
            once = np.array([line == first for _, line in lines], dtype=bool)
        # A title may stand above all of them.
        is_regular = same in ({once.sum()}, {once.sum() - 1}) or 2 * once.sum() >= words.total()
        marks = once if is_regular else counts == 0
        marks = np.array(named) == most if count > 2 else marks
    if 2 * len(starts := np.flatnonzero(marks & (counts > 0))) > marks.sum():
        return [lines[at:end] for at, end in pairwise([*starts.tolist(), len(lines)])]
    events = np.flatnonzero(marks | (counts > 0))
    steps = np.diff(marks[events].astype(int), prepend=0)
    tops, below = events[steps > 0], events[steps < 0]
    ends = 2 * counts[: min(tops, default=0)].sum() * len(tops) > counts.sum()
    begins = {0, *(below if ends else tops).tolist(), len(lines)}
    return [lines[at:end] for at, end in pairwise(sorted(begins))]


def _pictured(stop: _Lines) -> str:
    """The first picture that lines name; empty without one."""
    return next((match[0] for _, line in stop if (match := IMAGE.search(line))), "")


def arrays_in(lines: _Lines) -> dict[str, FloatArray]:
    """The numbers of lines by name: their own, or that of the heading above, of two and more.

    Numbers of one letter, as of a quaternion, keep it below their heading, `rotation.w`, which has
    all of them in the order x, y, z, w.
    """
    arrays, heading = defaultdict[str, list[float]](list), "matrix"
    entries = [(*_numbers_in(line), line) for _, line in lines]
    above = list[str]()
    for _, numbers, line in entries:
        entry = None if numbers else _HEADED.fullmatch(line)
        if entry and not entry[2]:
            heading = " ".join(re.findall(r"[^\W\d]+", entry[1])) or "matrix"
        above.append(heading)
    headed = {top for top, (name, row, _) in zip(above, entries, strict=True) if row}
    for top, (name, numbers, line) in zip(above, entries, strict=True):
        is_part = name in _PARTS and len(numbers) == 1
        is_headed = (name == "matrix" or is_part) and len(headed - {"matrix"}) > 1
        named = (f"{top}.{name}" if is_part else top) if is_headed else name
        # A pose or a list that is written again replaces the first.
        is_whole = len(numbers) in POSE_SIZES or (named != "matrix" and "[" in line)
        is_again = is_whole and len(numbers) == len(arrays[named])
        arrays[named] = numbers if is_again else arrays[named] + numbers
    parts = {top: [f"{top}.{name}" for name in _PARTS] for top in dict.fromkeys(above)}
    single = {name for name in chain(*parts.values()) if len(arrays.get(name, ())) == 1}
    # Joined, too, as those of a mapping.
    joined = {
        top: np.array([arrays[name][0] for name in of_top if name in single])
        for top, of_top in parts.items()
        if len(single.intersection(of_top)) > 2
    }
    return joined | {
        name: np.array(row[0] if name in single else row) for name, row in arrays.items() if row
    }


def blocks_of(lines: _Lines, path: Path) -> Fields | None:
    """Rows of several lines each, of a picture or below a line of words; None where none are."""
    rows = list[tuple[str, dict[str, object], dict[str, FloatArray]]]()
    # Counts and remarks in brackets are no part of a heading: `matrix wMe[0] (size 4x4):`.
    lines = [
        (place, _REMARK.sub("", line) if line.rstrip().endswith(":") else line)
        for place, line in lines
    ]
    for stop in _stops(closed(lines)):
        arrays = arrays_in(stop)
        title = next((line for _, line in reversed(stop) if not _numbers_in(line)[1]), "")
        image = _pictured(stop)
        if image or arrays:
            rows.append(
                (stop[0][0], {"image": image} if image else {"title": title.strip(" #:")}, arrays)
            )
    # Settings are written once.
    counts = Counter(name for *_, arrays in rows for name in arrays)
    usual = {name for name, count in counts.items() if 2 * count >= len(rows)}
    records = [
        words | {name: row for name, row in arrays.items() if name in usual}
        for _, words, arrays in rows
    ]
    fields = fields_of_records(records, [place for place, *_ in rows], path.stem, path.parent)
    return fields if len(records) > 2 and fields.numbers else None


def closed(lines: _Lines) -> _Lines:
    """Lines, those joined that one list of a few rows is written in."""
    found, is_open = list[tuple[str, str]](), 0
    for place, line in lines:
        if 0 < is_open < 16 and not re.search(r"[^\W\d]{2}", line):
            found[-1] = (found[-1][0], f"{found[-1][1]} {line}")
            is_open = (is_open + 1) * (found[-1][1].count("[") > found[-1][1].count("]"))
        else:
            found.append((place, line))
            is_open = int(line.count("[") > line.count("]"))
    return found


def placed(text: str, path: Path, comments: tuple[str, ...] = ()) -> _Lines:
    """The filled lines of a text, but for comments."""
    return [
        (f"{path.name}, line {at}", line)
        for at, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.strip().startswith(comments)
    ]


_DECLARED = re.compile(r"\s*+(?:\w++\s++)?(\w++)\s*+:?=([-+0-9.eE,\s]++);?\s*+")


def declared_poses(text: str, path: Path) -> list[Fields]:
    """Poses behind their names, `P00001=1.5,2,3,4,5,6`, by the kinds of names; raises DataError.

    Yaskawa's `///POSTYPE` says of what those below it are.
    """
    kinds = defaultdict[tuple[str, int], list[tuple[str, str, list[float]]]](list)
    system, in_pulses = "", 0
    for place, line in placed(text, path):
        system = line.split()[-1] if line.startswith("///POSTYPE") else system
        match = _DECLARED.fullmatch(line)
        name, text = match.groups() if match else ("", "")
        words, kind = re.split(r"[,\s]+", text.strip()), re.sub("[0-9]+", "", name)
        if kind != name and len(words) in POSE_SIZES and all(map(is_number, words)):
            row = (f"{place} ({name})", name, [*map(float, words)])
            in_pulses += system == "PULSE"
            kinds[kind, len(words)] += [row] * (system != "PULSE")
    if in_pulses and not any(kinds.values()):
        raise DataError(
            f"{path}: its {in_pulses} positions are in pulses of the motors, but must be poses.",
            culprits=[str(path)],
            next_step="Save the job with positions in the base (///POSTYPE BASE, ///RECTAN).",
        )
    found = list[Fields]()
    for (kind, _), rows in kinds.items():
        if len(rows) > 2:
            places, names, numbers = zip(*rows, strict=True)
            records = [{f"{kind.strip('_')}_pose": np.array(row)} for row in numbers]
            fields = fields_of_records(records, places, path.stem, path.parent)
            found.append(replace(fields, stems=names))
    return found


def script_poses(text: str, path: Path) -> Fields | None:
    """Poses to which a URScript moves, in its order; None of other texts, or of fewer than three.

    They are literals p[x, y, z, rx, ry, rz], or names that were assigned one.
    """
    if not re.search(r"^\s*def \w+\(.*\)\s*:", text, re.MULTILINE):
        return None
    assigned = {match[1]: match[2] for match in _ASSIGNED.finditer(text)}
    records, places, names = list[dict[str, object]](), list[str](), list[str]()
    for place, line in placed(text, path, COMMENTS):
        for match in _MOVED.finditer(line):
            numbers = [*separate(assigned.get(match[1], match[1]).lstrip("p"))]
            if len(numbers) == 6:
                records.append(dict(zip(_NAMES[6], map(np.float64, numbers), strict=True)))
                places.append(place)
                names.append(match[1])
    if len(records) < FEWEST_VIEWS:
        return None
    fields = fields_of_records(records, places, path.stem, path.parent)
    is_named = len({*names}) == len(names) and {*names} <= {*assigned}
    stems = tuple(names) if is_named else ()
    return replace(fields, form="ur", stems=stems)


def tool_note(text: str, path: Path) -> tuple[str, ...]:
    """A note on the tool that a URScript sets, of which its poses are; empty where it sets none."""
    assigned = {match[1]: match[2] for match in _ASSIGNED.finditer(text)}
    for match in re.finditer(rf"\bset_tcp\s*\(\s*({_LITERAL}|\w+)", text):
        numbers = np.array([*separate(assigned.get(match[1], match[1]).lstrip("p"))])
        if len(numbers) == 6 and numbers.any():
            away = figure(1e3 * float(np.linalg.norm(numbers[:3])))
            return (
                f"{path.name} sets a tool whose tip is {away} mm from the flange (set_tcp): its "
                "poses are those of the tip, and so is what the result calls the flange.",
            )
    return ()


def pendant_poses(text: str, path: Path, form: str | None) -> Fields | None:
    """Lines with poses in a maker's notation, with names of images; None where there are none."""
    is_program = path.suffix.lower() in PROGRAMS
    if is_program:
        # FANUC writes a pose in several lines.
        text = re.sub(r"\{[^{}]*\}", lambda block: " ".join(block[0].split()), text)
    lines = placed(text, path, COMMENTS)
    if is_program:
        lines = [each for each in lines if is_marked_pose(each[1]) and not _FRAMES.search(each[1])]
    pictures = [] if is_program else [line for _, line in lines if IMAGE.search(line)]
    # A log names pictures above or below their poses, and a table beside them.
    if 0 < 2 * len(pictures) <= len(lines) and not any(map(is_marked_pose, pictures)):
        lines = [
            (place, f"{line} {_pictured(stop)}")
            for stop in _stops(lines)
            for place, line in [each for each in stop if is_marked_pose(each[1])][:1]
        ]
    # The first line may be a header.
    first = next((at for at, (_, line) in enumerate(lines[:2]) if is_marked_pose(line)), None)
    if first is None:
        return None
    lines = lines[first:]
    matches = (_POINT.match(line.strip()) for _, line in lines)
    points = [match[1].split()[-1] + "]" * ("[" in match[1]) if match else "" for match in matches]
    is_named = len({*points}) == len(points)
    records, places, forms = [], list[str](), dict[str, str]()
    poses, notes = _poses_of(lines, form)
    for (place, line), point, pose in zip(lines, points, poses, strict=True):
        places.append(f"{place} ({point})" if is_named else place)
        image = IMAGE.search(line)
        forms.setdefault(pose.form.name, place)
        numbers = write_pose(pose.pose, pose.form)
        record = dict(zip(_NAMES[len(numbers)], numbers, strict=True))
        records.append(record | ({"image": image[0]} if image else {}))
    if len(forms) > 1:
        raise DataError(
            f"{path}: poses in the forms of several makers: {', '.join(forms)}.",
            culprits=[*forms.values()],
            next_step="Put the poses of one robot into a file of their own.",
        )
    fields = fields_of_records(records, places, path.stem, path.parent)
    stems = tuple(points) if is_named else ()
    return replace(fields, stems=stems, form=next(iter(forms)), notes=notes)


def _poses_of(lines: _Lines, form: str | None) -> tuple[list[PendantPose], tuple[str, ...]]:
    """The poses of lines in a maker's notation, and a note where their angles are in radians.

    Degrees of all poses within pi would leave each flange upright, and turn it by a few degrees. A
    form that is stated says its unit.
    """
    written = [(IMAGE.sub(" ", line), place) for place, line in lines]
    poses = [read_pose(line, place, form) for line, place in written]
    in_degrees = not form and all(pose.reading.rotation.startswith("euler") for pose in poses)
    angles = np.array([write_pose(pose.pose, pose.form)[3:] for pose in poses if in_degrees])
    if len(angles) < FEWEST_VIEWS or not 1.0 < np.abs(angles).max() < 1.001 * np.pi:
        return poses, ()
    turned = [read_pose(line, place, form, angle="rad") for line, place in written]
    # A unit that is written remains.
    is_same = turned[0].reading == poses[0].reading
    note = (
        f"No angle is over {np.abs(angles).max():.4g}: they are taken for radians. Where they are "
    )
    note += f"degrees, say --robot-form {poses[0].form.name}."
    return turned, () if is_same else (note,)

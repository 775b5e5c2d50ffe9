"""Breaks one thing of an input, by chance: a byte, a row, a value, a picture, or a file itself.

Those of whole files' bytes are `foreign_damage`'s, with some more. What is broken is chosen by what
a file is, so that most of what comes out is still read for a while.
"""

import json
import os
import random
import re
import shutil
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from support.fuzz import foreign_damage as damage

Chance: TypeAlias = random.Random
Bytes: TypeAlias = Callable[[bytes, Chance], bytes]

# What stands in a field where nobody expects it.
TEXTS = (
    "", " ", "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-0", "0", "-1", "0.5", "1e20",
    "9" * 30, "9" * 400, "9223372036854775808", "1_000", "0x10", "1,5", "1e", "--", "text", "true",
    "null", "größer ∞ 雪", "\x00", "\u202e", "\ud7ff", "'", '"', '"a\nb"', "a,b;c", "\r", "../x",
    "../../../../etc/passwd", "/dev/zero", "/", ".", "x" * 5000, "é" * 200, "=1+1", "%s%n", "{0}",
    "[bold]x[/bold]", "[/]", "<script>", "$(x)", "C:\\x", "con",
)  # fmt: skip
# The same for TOML, where text needs quotes.
LITERALS = (
    *(json.dumps(text) for text in TEXTS if "\x00" not in text),
    "nan", "-inf", "1e308", "-1e308", "-0.0", "0", "-1", "1", "0.5", "9223372036854775808",
    "9" * 400, "true", "[]", "{}", "[1]", "[1, 2, 3, 4, 5, 6, 7, 8, 9]", "[nan, inf, 0, 1]",
    '["a"]', "[[]]", "[[1, 2], [3]]", "{a = 1}", "2026-11-20", "2026-11-20T12:00:00Z", "07:32:00",
    "[" * 200 + "]" * 200, "[" + "1," * 100_000 + "]", "'''x'''", "", "1e", "0x_",
)  # fmt: skip
VALUES = (
    None, True, False, "", "text", "nan", "1.5", "x" * 5000, "\x00", "größer ∞ 雪", "[/]", 0, -1, 1,
    0.5, 1e308, -1e308, 1e-320, -0.0, 2**63, 10**400, float("nan"), float("inf"), [], {}, [[]],
    [1], [1, 2, 3], [None], ["a"], [[1, 2], [3]], {"a": 1}, {"": None}, [0] * 100_000,
)  # fmt: skip
DEEP = 3000
_NUMBER = re.compile(rb"(?<![\w.-])-?\d+(\.\d+)?(e[+-]?\d+)?(?![\w.])")


# --- Tables.


def _rows(data: bytes) -> list[list[str]]:
    """A table's cells; what quotes hold together is taken apart, which breaks it as well."""
    text = data.decode("utf-8", errors="replace")
    return [line.split(",") for line in text.splitlines()] or [[""]]


def _joined(rows: Sequence[Sequence[str]]) -> bytes:
    return "".join(",".join(row) + "\n" for row in rows).encode("utf-8", errors="replace")


def _row(rows: Sequence[object], chance: Chance) -> int:
    """Any row, and the header now and then."""
    return 0 if len(rows) < 2 or chance.random() < 0.1 else chance.randrange(1, len(rows))


def field_replaced(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    for _ in range(chance.choice([1, 1, 1, 5])):
        row = rows[_row(rows, chance)]
        row[chance.randrange(len(row))] = chance.choice(TEXTS)
    return _joined(rows)


def column_replaced(data: bytes, chance: Chance) -> bytes:
    rows, text = _rows(data), chance.choice(TEXTS)
    at = chance.randrange(len(rows[0]))
    for row in rows[1:]:
        row[at : at + 1] = [text]
    return _joined(rows)


def number_scaled(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    row, factor = rows[_row(rows, chance)], chance.choice([-1.0, 1e3, 1e-3, 1e12, 1e-12, 1e150])
    at = chance.randrange(len(row))
    with suppress(ValueError):
        row[at] = repr(float(row[at]) * factor)
    return _joined(rows)


def rows_swapped(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    first, second = _row(rows, chance), _row(rows, chance)
    rows[first], rows[second] = rows[second], rows[first]
    return _joined(rows)


def row_doubled(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    at = _row(rows, chance)
    return _joined([*rows[:at], *[rows[at]] * chance.choice([2, 2, 50]), *rows[at + 1 :]])


def rows_lost(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    kept = chance.choice([0, 1, 2, 3, 4, len(rows) - 1])
    return _joined(
        [rows[index] for index in sorted(chance.sample(range(len(rows)), min(kept, len(rows))))]
    )


def columns_swapped(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    first, second = (chance.randrange(len(rows[0])) for _ in range(2))
    # The names with their numbers, or only the names.
    for row in rows if chance.random() < 0.5 else rows[:1]:
        if max(first, second) < len(row):
            row[first], row[second] = row[second], row[first]
    return _joined(rows)


def column_lost(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    at = chance.randrange(len(rows[0]))
    for row in rows:
        del row[at : at + 1]
    return _joined(rows)


def column_doubled(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    at = chance.randrange(len(rows[0]))
    return _joined([[*row[: at + 1], *row[at:]] for row in rows])


def row_ragged(data: bytes, chance: Chance) -> bytes:
    rows = _rows(data)
    row = rows[_row(rows, chance)]
    if chance.random() < 0.5:
        del row[chance.randrange(len(row)) :]
    else:
        row.extend(chance.choice([[""], ["1"], ["7"] * 10_000]))
    return _joined(rows)


def other_separator(data: bytes, chance: Chance) -> bytes:
    return data.replace(b",", chance.choice([b";", b"\t", b" ", b"|", b", "]))


def other_line_ends(data: bytes, chance: Chance) -> bytes:
    return data.replace(b"\n", chance.choice([b"\r\n", b"\r", b"\n\n", b"\x0b", b""]))


# --- TOML, by its lines.

_KEY = re.compile(rb"^(\s*[\w.\"-]+\s*=\s*)(.+)$", re.MULTILINE)


def toml_value(data: bytes, chance: Chance) -> bytes:
    found = list(_KEY.finditer(data))
    if not found:
        return data
    match = chance.choice(found)
    literal = chance.choice(LITERALS).encode("utf-8", errors="replace")
    return data[: match.start(2)] + literal + data[match.end(2) :]


def toml_table(data: bytes, chance: Chance) -> bytes:
    """A table that is not expected, or one that is, as something else."""
    heads = re.findall(rb"^\[+([^\]]+)\]+", data, re.MULTILINE) or [b"camera"]
    head = chance.choice([*heads, b"camera", b"robot", b"need", b"prior.flange_from_cam", b"clock"])
    new = chance.choice(
        [
            b"[%s]\n",
            b"[%s.x]\n",
            b"[[%s]]\n",
            b"%s = 1\n",
            b"[%s]\nname = 1\n",
            b"[%s]\nz_m = nan\n",
        ]
    )
    line = new % head
    return line + data if chance.random() < 0.5 else data + b"\n" + line


def toml_deep(data: bytes, chance: Chance) -> bytes:
    depth = chance.choice([100, DEEP])
    new = [b"deep = " + b"[" * depth + b"]" * depth, b"a." * depth + b"a = 1"]
    new += [b"deep = " + b"{a = " * depth + b"1" + b"}" * depth, b"[" + b"a." * depth + b"a]"]
    return chance.choice(new) + b"\n" + data


# --- JSON, by its structure.


def _broken(value: object, chance: Chance) -> object:
    """The value with one thing below it broken; a third of the way down at each step."""
    inside = list(value) if isinstance(value, dict) else list(range(len(value))) \
        if isinstance(value, list) else []  # fmt: skip
    if not inside or chance.random() < 0.1:
        return _replaced(value, chance)
    key = chance.choice(inside)
    changed = value.copy()  # type: ignore[attr-defined] # a dict or a list
    if chance.random() < 0.2:
        return _reshaped(changed, key, chance)
    changed[key] = _broken(changed[key], chance)
    return changed


def _replaced(value: object, chance: Chance) -> object:
    if isinstance(value, float) and chance.random() < 0.5:
        return chance.choice([-value, 1e3 * value, 1e12 * value, str(value), [value], value // 1])
    if chance.random() < 0.1:
        deep: object = value
        for _ in range(chance.choice([1, 100, 900])):
            deep = chance.choice([[deep], {"a": deep}])
        return deep
    return chance.choice(VALUES)


def _reshaped(changed: dict | list, key: object, chance: Chance) -> object:  # type: ignore[type-arg]
    how = chance.randrange(4)
    if how == 0:
        del changed[key]  # type: ignore[arg-type]
    elif how == 1 and isinstance(changed, dict):
        changed[f"{key} "] = changed.pop(key)
    elif how == 1:
        changed.extend(changed * chance.choice([1, 1, 1000]))
    elif how == 2 and isinstance(changed, dict):
        changed["unexpected"] = chance.choice(VALUES)
    elif how == 2:
        changed.reverse()
    else:
        changed.clear()
    return changed


def json_value(data: bytes, chance: Chance) -> bytes:
    try:
        document = json.loads(data)
    except ValueError:
        return data
    for _ in range(chance.choice([1, 1, 1, 3])):
        document = _broken(document, chance)
    return json.dumps(document).encode()


def json_number(data: bytes, chance: Chance) -> bytes:
    """A number of more digits than a float has, or of none."""
    return (
        damage.odd_number(data, chance)
        if chance.random() < 0.5
        else damage.huge_number(data, chance)
    )


def json_doubled_key(data: bytes, chance: Chance) -> bytes:
    keys = list(re.finditer(rb'"(\w+)":', data))
    if not keys:
        return data
    match = chance.choice(keys)
    return data[: match.start()] + b'"%s": 1, ' % match.group(1) + data[match.start() :]


# --- Pictures.


def png_header(data: bytes, chance: Chance) -> bytes:
    """A header that claims another size, depth or colour, with a sound checksum."""
    if not data.startswith(b"\x89PNG") or len(data) < 33:
        return data
    width, height, depth, colour = struct.unpack(">IIBB", data[16:26])
    width, height = chance.choice(
        [(30_000, 30_000), (0, 0), (width, 0), (2**31, 1), (2**32 - 1, 2**32 - 1), (width, height)]
    )
    if chance.random() < 0.2:
        depth, colour = chance.choice([(16, 2), (1, 3), (3, 9), (16, 6)])
    chunk = b"IHDR" + struct.pack(">IIBB", width, height, depth, colour) + data[26:29]
    return data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]


def png_of_zeros(_: bytes, chance: Chance) -> bytes:
    """A picture of some hundred million pixels, whole and sound, in 50 kB."""
    width, height = chance.choice([(20_000, 20_000), (60_000, 5_000)])
    body = zlib.compress(bytes((width // 8 + 1) * height), 1)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)), (b"IDAT", body)]
    written = b"\x89PNG\r\n\x1a\n"
    for name, content in [*chunks, (b"IEND", b"")]:
        written += struct.pack(">I", len(content)) + name + content
        written += struct.pack(">I", zlib.crc32(name + content))
    return written


def other_picture(data: bytes, chance: Chance) -> bytes:
    """The same picture with another depth, size, colour or format; read as nothing else was."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    if image is None:
        return data
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    kinds: list[tuple[str, np.ndarray]] = [
        (".png", image.astype(np.uint16) * 257),
        (".png", cv2.cvtColor(image, cv2.COLOR_GRAY2BGRA)),
        (".png", colour),
        (".jpg", colour),
        (".bmp", image),
        (".tiff", image.astype(np.float32) / np.float32(0.0 + 255.0)),
        (".png", cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2))),
        (".png", cv2.resize(image, (1, 1))),
        (".png", np.ascontiguousarray(image.T)),
        (".png", image[:, ::-1].copy()),
        (".png", np.zeros_like(image)),
        (".png", np.full_like(image, 255)),
    ]
    suffix, changed = chance.choice(kinds)
    return bytes(cv2.imencode(suffix, changed)[1])


def no_picture(_: bytes, chance: Chance) -> bytes:
    return chance.choice(
        [
            b"",
            b"\x89PNG\r\n\x1a\n",
            b"\xff\xd8\xff\xe0\x00\x10JFIF",
            b"GIF89a\x01\x00\x01\x00\x80\x00\x00\x00\x00\x00\xff\xff\xff,\x00\x00\x00\x00\x01\x00"
            b"\x01\x00\x00\x02\x02D\x01\x00;",
            b"BM" + b"\xff" * 60,
            b"II*\x00\x08\x00\x00\x00\x01\x00" + b"\xff" * 40,
            b"P5 99999 99999 255\n",
            b"#?RADIANCE\n\n-Y 99999 +X 99999\n",
            b"<svg xmlns='http://www.w3.org/2000/svg'/>",
            b"<html>404</html>",
        ]
    )


# --- Any file.


def inserted(data: bytes, chance: Chance) -> bytes:
    at = chance.randrange(len(data) + 1)
    new = chance.choice([b"\0", b"\xff\xfe", b"\n", b"\xc3", chance.randbytes(20), b"\0" * 5000])
    return data[:at] + new + data[at:]


def marked(data: bytes, _: Chance) -> bytes:
    """With the mark of UTF-8 at its begin, as some editors write it."""
    return b"\xef\xbb\xbf" + data


def text_replaced(data: bytes, chance: Chance) -> bytes:
    """A word or number of any text, by what nobody expects there."""
    words = list(re.finditer(rb"[\w.+-]+", data[:200_000]))
    if not words:
        return data
    match, text = chance.choice(words), chance.choice(TEXTS).encode("utf-8", errors="replace")
    return data[: match.start()] + text + data[match.end() :]


def number_changed(data: bytes, chance: Chance) -> bytes:
    """A number of any text by another one of its kind, which passes for one longer."""
    numbers = list(_NUMBER.finditer(data[:200_000]))
    if not numbers:
        return data
    match = chance.choice(numbers)
    if b"." in match[0] or b"e" in match[0]:
        factor = chance.choice([-1.0, 0.0, 1e3, 1e-3, 1e12, 1e-12, 1e150, 1e300, 1e-300])
        number = repr(float(match[0]) * factor)
    else:
        number = str(
            int(match[0][:300]) * chance.choice([-1, 0, 2, 1000, 10**9]) + chance.choice([0, 1])
        )
    return data[: match.start()] + number.encode() + data[match.end() :]


ANY: tuple[Bytes, ...] = (
    damage.truncated,
    damage.flipped,
    damage.part_moved,
    damage.binary,
    damage.nothing,
    inserted,
)
TEXT: tuple[Bytes, ...] = (
    damage.huge_number,
    damage.odd_number,
    damage.line_doubled,
    damage.line_lost,
    damage.deep,
    damage.other_encoding,
    text_replaced,
    number_changed,
    number_changed,
    marked,
)
TABLE: tuple[Bytes, ...] = (
    field_replaced,
    field_replaced,
    column_replaced,
    number_scaled,
    rows_swapped,
    row_doubled,
    rows_lost,
    columns_swapped,
    column_lost,
    column_doubled,
    row_ragged,
    other_separator,
    other_line_ends,
)
TOML: tuple[Bytes, ...] = (
    toml_value,
    toml_value,
    toml_value,
    number_changed,
    number_changed,
    toml_table,
    toml_deep,
)
JSON: tuple[Bytes, ...] = (
    json_value,
    json_value,
    json_value,
    number_changed,
    json_number,
    json_doubled_key,
)
IMAGE: tuple[Bytes, ...] = (png_header, other_picture, other_picture, no_picture, png_of_zeros)
# By what a file is: what is its own, and what befits others as well.
KINDS: Mapping[str, tuple[tuple[Bytes, ...], tuple[Bytes, ...]]] = {
    "table": (TABLE, (*ANY, *TEXT)),
    "TOML": (TOML, (*ANY, *TEXT)),
    "JSON": (JSON, (*ANY, *TEXT)),
    "image": (IMAGE, ANY),
    "recording": ((damage.truncated, damage.flipped, damage.part_moved, inserted), ANY),
    "text": (TEXT, (*ANY, damage.constructor, damage.laughs)),
    "array": ((damage.flipped, damage.truncated), (*ANY, damage.lying_array, damage.pickled)),
}
_SUFFIXES = {
    ".csv": "table",
    ".toml": "TOML",
    ".json": "JSON",
    ".rrd": "recording",
    ".npz": "array",
    ".png": "image",
    ".jpg": "image",
}
# How often a file itself is broken, and else how often by the rules of what it is.
_AS_FILE, _BY_KIND = 0.15, 0.7


def kind_of(path: Path) -> str:
    """What a file is, by its name: a key of `KINDS`."""
    return _SUFFIXES.get(path.suffix.lower(), "text")


def mutate(input_: Path, chance: Chance, others: Sequence[Path]) -> tuple[str, str]:
    """Breaks one thing of an input.

    Args:
        input_: A file or a folder.
        chance: What is broken depends on it alone.
        others: Sound inputs that it may be exchanged with.

    Returns:
        The kind of what is broken, a key of `KINDS` or `file system`, and what was done to it.
    """
    files = (
        sorted(path for path in input_.rglob("*") if path.is_file())
        if input_.is_dir()
        else [input_]
    )
    kinds = sorted({kind_of(file) for file in files})
    if chance.random() < _AS_FILE:
        path = chance.choice([input_, chance.choice(files), chance.choice(files)])
        return "file system", f"{place(path, chance, others)}: {path.relative_to(input_.parent)}"
    kind = chance.choice(kinds)
    path = chance.choice([file for file in files if kind_of(file) == kind])
    own, common = KINDS[kind]
    mutator = chance.choice(own if chance.random() < _BY_KIND else common)
    path.write_bytes(mutator(path.read_bytes() or b"0", chance))
    return kind, f"{mutator.__name__}: {path.relative_to(input_.parent)}"


def place(path: Path, chance: Chance, others: Sequence[Path]) -> str:
    """Puts something else where a file or folder is, or nothing."""
    mutation = chance.choice(PLACES)
    if path.is_dir() and not path.is_symlink():
        moved = path.rename(path.with_name(path.name + " before"))
    else:
        moved = None
        path.unlink()
    mutation(path, chance, others)
    if moved is not None:
        shutil.rmtree(moved)
    return mutation.__name__


def missing(path: Path, chance: Chance, others: Sequence[Path]) -> None:
    del path, chance, others


def folder_instead(path: Path, *_: object) -> None:
    path.mkdir()


def file_instead(path: Path, chance: Chance, _: Sequence[Path]) -> None:
    path.write_bytes(chance.choice([b"", b"text\n", chance.randbytes(100)]))


def loop(path: Path, *_: object) -> None:
    path.symlink_to(path.name)


def dangling(path: Path, *_: object) -> None:
    path.symlink_to("nowhere")


def outside(path: Path, chance: Chance, _: Sequence[Path]) -> None:
    path.symlink_to(chance.choice(["/etc/passwd", "/", "/proc/self", "..", "/proc/self/mem"]))


def fifo(path: Path, *_: object) -> None:
    os.mkfifo(path)


def endless(path: Path, chance: Chance, _: Sequence[Path]) -> None:
    path.symlink_to(chance.choice(["/dev/zero", "/dev/urandom", "/dev/full", "/dev/null"]))


def another(path: Path, chance: Chance, others: Sequence[Path]) -> None:
    """A sound input of another kind, or of another cell."""
    other = chance.choice(others)
    if other.is_dir():
        shutil.copytree(other, path)
    else:
        shutil.copyfile(other, path)


def unreadable(path: Path, *_: object) -> None:
    """Nothing may be read of it, but by root."""
    path.write_bytes(b"x")
    path.chmod(0)


PLACES = (missing, folder_instead, file_instead, loop, dangling, outside, fifo, endless, unreadable,
          another, another, another)  # fmt: skip

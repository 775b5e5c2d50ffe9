"""Breaks one thing of an input, by chance: a byte, a row, a value, a picture, or a file itself.

What is broken is chosen by what a file is, so that most of what comes out is read for a while. What
was made to break a reader (bombs, pickles, entities, headers that lie) has tests of its own.
"""

import io
import json
import os
import random
import re
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import pyarrow
from pyarrow import parquet
from support.fuzz.looks import moved_looks

Chance: TypeAlias = random.Random
Bytes: TypeAlias = Callable[[bytes, Chance], bytes]

# What stands in a field where nobody expects it.
TEXTS = (
    "", " ", "nan", "inf", "-inf", "1e308", "1e-320", "-0", "0", "-1", "0.5", "1e20", "9" * 30,
    "9" * 400, "9223372036854775808", "1_000", "0x10", "1,5", "1e", "--", "text", "true", "null",
    "größer ∞ 雪", "\x00", "\u202e", "'", '"', '"a\nb"', "a,b;c", "../../../../etc/passwd",
    "/dev/zero", "/", "x" * 5000, "=1+1", "%s%n", "{0}", "[bold]x[/bold]", "<script>", "[]", "{}",
    "[nan, inf, 0, 1]", "[[1, 2], [3]]", "{a = 1}", "2026-11-20", "[" * 200 + "]" * 200,
)  # fmt: skip
VALUES = (
    None, True, "", "text", "nan", "x" * 5000, "\x00", "[/]", 0, -1, 0.5, 1e308, 1e-320, -0.0,
    2**63, 10**400, float("nan"), float("inf"), [], {}, [[]], [1, 2, 3], [None], ["a"],
    [[1, 2], [3]], {"a": 1}, {"": None}, [0] * 100_000,
)  # fmt: skip
_WORD = re.compile(rb"[\w.+-]+")
_NUMBER = re.compile(rb"(?<![\w.-])-?\d+(\.\d+)?(e[+-]?\d+)?(?![\w.])")


# --- Any file.


def truncated(data: bytes, chance: Chance) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def flipped(data: bytes, chance: Chance) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.randrange(1, 30)):
        changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def inserted(data: bytes, chance: Chance) -> bytes:
    at = chance.choice([0, chance.randrange(len(data) + 1)])
    new = [b"\0", b"\xef\xbb\xbf", b"\xff\xfe", b"\n", b"\xc3", chance.randbytes(20), b"\0" * 5000]
    return data[:at] + chance.choice(new) + data[at:]


# --- Text.


def _replaced(data: bytes, chance: Chance, what: re.Pattern[bytes], new: Callable) -> bytes:
    found = list(what.finditer(data[:200_000]))
    if not found:
        return data
    match = chance.choice(found)
    return data[: match.start()] + new(match[0]) + data[match.end() :]


def word_replaced(data: bytes, chance: Chance) -> bytes:
    """A word or number by what nobody expects there."""
    text = chance.choice(TEXTS).encode("utf-8", errors="replace")
    return _replaced(data, chance, _WORD, lambda _: text)


def number_changed(data: bytes, chance: Chance) -> bytes:
    """A number by another one of its kind, which passes for one longer."""

    def other(number: bytes) -> bytes:
        if b"." in number or b"e" in number:
            factor = chance.choice([-1.0, 0.0, 1e3, 1e-3, 1e12, 1e-12, 1e150, 1e300])
            return repr(float(number) * factor).encode()
        return b"%d" % (int(number[:300]) * chance.choice([-1, 0, 2, 1000, 10**9]) + 1)

    return _replaced(data, chance, _NUMBER, other)


def lines_changed(data: bytes, chance: Chance) -> bytes:
    """Lines that are lost, exchanged, or there more than once; of all, few are left."""
    lines = data.split(b"\n")
    a, b = sorted(chance.randrange(len(lines)) for _ in range(2))
    first, second = lines[a], lines[b]
    few = [lines[at] for at in sorted(chance.sample(range(len(lines)), min(4, len(lines))))]
    exchanged = [*lines[:a], second, *lines[a + 1 : b], first, *lines[b + 1 :]]
    ways = [[*lines[:a], *lines[a + 1 :]], exchanged, few]
    ways += [[*lines[:a], *[first] * times, *lines[a + 1 :]] for times in (2, 50)]
    return b"\n".join(chance.choice(ways))


def deep(data: bytes, chance: Chance) -> bytes:
    opening = chance.choice([b"[", b'{"a":', b"- ", b"<a>", b"(", b"{a: ", b"a = [", b"a."])
    return data[: chance.randrange(len(data) + 1)] + opening * chance.choice([100, 100_000])


# --- Tables, TOML and JSON.


def columns_changed(data: bytes, chance: Chance) -> bytes:
    """Columns that are lost, doubled, exchanged or of one value; a row of another length."""
    rows = [line.split(b",") for line in data.splitlines()] or [[b""]]
    a, b = (chance.randrange(len(rows[0])) for _ in range(2))
    how, text = chance.randrange(7), chance.choice(TEXTS).encode("utf-8", errors="replace")
    for row in rows[:1] if how == 0 else rows:
        if max(a, b) >= len(row):
            continue
        if how < 2:  # The names alone, or the numbers with them.
            row[a], row[b] = row[b], row[a]
        elif how == 2:
            row[a : a + 1] = []
        elif how == 3:
            row[a : a + 1] = [row[a]] * 2
        elif how == 4 and row is not rows[0]:
            row[a] = text
    if how == 5:
        row = chance.choice(rows)
        row[a:] = chance.choice([[], [b""], [b"7"] * 10_000])
    between = chance.choice([b";", b"\t", b" ", b"|", b", "]) if how == 6 else b","
    return b"".join(between.join(row) + b"\n" for row in rows)


def json_value(data: bytes, chance: Chance) -> bytes:
    try:
        document = json.loads(data)
    except ValueError:
        return data
    return json.dumps(_broken(document, chance)).encode()


def _broken(value: object, chance: Chance) -> object:
    """The value with one thing below it replaced, lost, renamed, repeated or added."""
    inside = list(value) if isinstance(value, dict) else range(len(value)) \
        if isinstance(value, list) else ()  # fmt: skip
    if not inside or chance.random() < 0.1:
        if isinstance(value, float) and chance.random() < 0.5:
            return chance.choice([-value, 1e3 * value, 1e12 * value, str(value), [value]])
        return chance.choice(VALUES)
    key, changed, how = chance.choice(list(inside)), value.copy(), chance.random()
    if how > 0.2:
        changed[key] = _broken(changed[key], chance)
    elif how > 0.1:
        del changed[key]
    elif isinstance(changed, dict):
        changed[chance.choice([f"{key} ", "unexpected"])] = chance.choice(VALUES)
    else:
        changed.extend(changed * chance.choice([1, 1000]))
    return changed


def json_line(data: bytes, chance: Chance) -> bytes:
    """One of a file's documents, a line each."""
    lines = data.splitlines() or [b""]
    at = chance.randrange(len(lines))
    return b"\n".join([*lines[:at], json_value(lines[at], chance), *lines[at + 1 :], b""])


def looks_moved(data: bytes, chance: Chance) -> bytes:
    """Looks of a cell in which something has moved, which are as valid."""
    looks = [json.loads(line) for line in data.splitlines()]
    moved = moved_looks(looks, np.random.default_rng(chance.randrange(2**32)))
    return b"".join(json.dumps(look).encode() + b"\n" for look in moved)


# --- Pictures, arrays and what else is not text.


def words_changed(data: bytes, chance: Chance) -> bytes:
    """Words of four or eight bytes by sizes and numbers that nobody expects there."""
    changed, reach = bytearray(data), chance.choice([500, 20_000, len(data)])
    hostile = [struct.pack("<q", value) for value in (-1, 0, 1 << 31, 1 << 62, -(1 << 63))]
    hostile += [struct.pack("<d", value) for value in (np.nan, np.inf, 1e300, -1e-310)]
    for _ in range(chance.randrange(1, 4)):
        at, word = 4 * chance.randrange(1 + min(reach, len(data)) // 4), chance.choice(hostile)
        size = chance.choice([4, 8])
        changed[at : at + size] = word[-size:] if chance.random() < 0.2 else word[:size]
    return bytes(changed)


def rows_changed(data: bytes, chance: Chance) -> bytes:
    """A column of a parquet file that is lost, or of other values; or other rows."""
    try:
        table = parquet.read_table(io.BytesIO(data))
    except (OSError, ValueError):
        return data
    columns = table.to_pydict()
    name, count = chance.choice([*columns]), len(table)
    value = chance.choice([None, "text", -1, 2**62, 1e300, float("nan"), [1.0], [[1.0]], b"\0"])
    at = chance.randrange(max(count, 1))
    ways = [
        [value] * count,
        columns[name][::-1],
        [*columns[name][:at], None, *columns[name][at + 1 :]],
    ]
    columns[name] = chance.choice(ways)[:count]
    how = chance.random()
    if how < 0.15:
        del columns[name]
    rows = slice(0 if how > 0.3 else at, None if how > 0.3 else at + chance.randrange(2))
    written = io.BytesIO()
    columns = {key: cells[rows] for key, cells in columns.items()}
    parquet.write_table(pyarrow.table(columns), written)
    return written.getvalue()


def other_picture(data: bytes, chance: Chance) -> bytes:
    """The same picture with another depth, size, colour or format; or the beginning of none."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    if image is None or chance.random() < 0.2:
        begun = [b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0\x00\x10JFIF", b"BM" + b"\xff" * 60]
        return chance.choice([*begun, b"P5 99999 99999 255\n", b"<html>404</html>"])
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    kinds = [
        (".png", image.astype(np.uint16) * 257), (".png", cv2.cvtColor(image, cv2.COLOR_GRAY2BGRA)),
        (".png", colour), (".jpg", colour), (".bmp", image), (".tiff", image / np.float32(255.0)),
        (".png", cv2.resize(image, None, fx=0.5, fy=0.5)), (".png", image[:1, :1]),
        (".png", np.ascontiguousarray(image.T)), (".png", np.zeros_like(image)),
    ]  # fmt: skip
    suffix, changed = chance.choice(kinds)
    return bytes(cv2.imencode(suffix, changed)[1])


ANY: tuple[Bytes, ...] = (truncated, flipped, inserted)
TEXT: tuple[Bytes, ...] = (word_replaced, number_changed, lines_changed, deep)
# By the end of a file's name: what is broken of it alone, and what of others as well.
KINDS: dict[str, tuple[tuple[Bytes, ...], tuple[Bytes, ...]]] = {
    ".csv": ((columns_changed, columns_changed, *TEXT[:3]), (*ANY, *TEXT)),
    ".toml": (TEXT[:2], (*ANY, *TEXT)),
    ".json": ((json_value, json_value, number_changed), (*ANY, *TEXT)),
    ".jsonl": ((looks_moved, looks_moved, json_line), (*ANY, *TEXT)),
    ".png": ((other_picture,), ANY),
    ".parquet": ((rows_changed,), (*ANY, words_changed)),
    **dict.fromkeys(
        (".rrd", ".npz", ".bag", ".mcap", ".db3", ".mp4"),
        ((*ANY, words_changed, words_changed), ANY),
    ),
    "": (TEXT, ANY),
}
# How often a file itself is broken, and else how often by the rules of what it is.
_AS_FILE, _BY_KIND = 0.15, 0.7


def mutate(input_: Path, chance: Chance, others: Sequence[Path]) -> str:
    """Breaks one thing of a file or folder, and says what was done."""
    files = [input_]
    if input_.is_dir():
        files = sorted(path for path in input_.rglob("*") if path.is_file())
    if chance.random() < _AS_FILE:
        path = chance.choice([input_, chance.choice(files)])
        return f"{_placed(path, chance, others)}: {path.relative_to(input_.parent)}"
    ends = {file: file.suffix.lower() if file.suffix.lower() in KINDS else "" for file in files}
    kind = chance.choice(sorted(set(ends.values())))
    path = chance.choice([file for file in files if ends[file] == kind])
    of_kind, common = KINDS[kind]
    mutator = chance.choice(of_kind if chance.random() < _BY_KIND else common)
    path.write_bytes(mutator(path.read_bytes() or b"0", chance))
    return f"{mutator.__name__}: {path.relative_to(input_.parent)}"


def _placed(path: Path, chance: Chance, others: Sequence[Path]) -> str:
    """Puts something else where a file or folder is, or nothing; says what."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    links = {"loop": path.name, "dangling": "nowhere", "outside": "/etc/passwd", "root": "/",
             "memory": "/proc/self/mem", "endless": "/dev/zero"}  # fmt: skip
    how = chance.choice(["missing", "folder", "file", "fifo", "another", "another", *links])
    if how in links:
        path.symlink_to(links[how])
    elif how == "folder":
        path.mkdir()
    elif how == "file":
        path.write_bytes(chance.choice([b"", b"text\n", chance.randbytes(100)]))
    elif how == "fifo":
        os.mkfifo(path)
    elif how == "another":
        other = chance.choice(others)
        (shutil.copytree if other.is_dir() else shutil.copyfile)(other, path)
    return how

"""Types what a message says, as its reader would: edits of files, and commands."""

import json
import re
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import tomli_w
from support.commands import visioncal
from support.fuzz.broken_sessions import edit, edit_rows, scaled

_Found = re.Match[str]


def mended(folder: Path, said: str, out: Path) -> str:
    """Does what a message says and calibrates.

    Args:
        folder: The session, which is changed.
        said: The message; of several steps the first counts.
        out: The folder of the result.

    Returns:
        The verdict's status; `refused` where there is no result, empty where there is nothing to
        type.
    """
    is_edited = _edited(folder, said)
    line = re.search(r"visioncal (?:convert|target check) .*", said)
    if not is_edited and not line:
        return ""
    session = folder
    for words in map(shlex.split, line[0].split(" && ") if line else ()):
        if words[1] == "calibrate":
            break
        if visioncal(*words[1:]).status != 0:
            return "refused"
        session = Path(words[3]) if words[1] == "convert" else session
    if visioncal("calibrate", session, "-o", out).status != 0:
        return "refused"
    return str(json.loads((out / "calibration.json").read_text())["verdict"]["status"])


def _edited(folder: Path, said: str) -> bool:
    """Makes the first edit that a message names; whether it names one."""
    for pattern, made in _EDITS:
        if found := re.search(pattern, said):
            made(folder, found)
            return True
    return _toml_written(folder, said)


def _encoded(folder: Path, found: _Found) -> None:
    table = folder / "views.csv"
    table.write_text(table.read_bytes().decode(found[1]), "utf-8")


def _replaced(folder: Path, found: _Found) -> None:
    edit(folder, lambda text: text.replace(found[2], found[3]), found[1])


def _cell_written(folder: Path, found: _Found) -> None:
    value, view, column = found.groups()
    edit_rows(
        folder, lambda rows: [row | {column: value} if row["view"] == view else row for row in rows]
    )


def _line_deleted(folder: Path, found: _Found) -> None:
    table = folder / "views.csv"
    lines = table.read_text("utf-8").splitlines(keepends=True)
    del lines[int(found[1]) - 1]
    table.write_text("".join(lines), "utf-8")


def _rows_deleted(folder: Path, found: _Found) -> None:
    views = {part.strip() for part in found[1].split(",")}
    edit_rows(folder, lambda rows: [row for row in rows if row["view"] not in views])


def _in_radians(folder: Path, found: _Found) -> None:
    scaled(tuple(f"q{index}_rad" for index in range(1, int(found[1]) + 1)), np.pi / 180.0)(folder)


def _respelt(folder: Path, found: _Found) -> None:
    edit(folder, lambda text: text.replace(f'"{found[1]}"', f'"{found[2]}"'))


_EDITS: tuple[tuple[str, Callable[[Path, _Found], None]], ...] = (
    (r"iconv -f (\S+) -t", _encoded),
    (r"[Ii]n (session\.toml|views\.csv), replace (\S+) by (\S+?)\.?(?:\s|$)", _replaced),
    (r"[Ii]n views\.csv, write (\S+) into the row of view (\d+), column (\w+)", _cell_written),
    (r"delete views\.csv, line (\d+)", _line_deleted),
    (r"delete the rows? of view ([\d, ]+)", _rows_deleted),
    (r"no target named '(\S+)'\. Did you mean (\S+)", _respelt),
    (r"multiply q1_rad to q(\d)_rad by pi / 180", _in_radians),
)
_WRITTEN = r"[Ii]n (\w+\.toml), write (.+?)(?:, which|;|\.(?:\s|$)|, and delete)"


def _toml_written(folder: Path, said: str) -> bool:
    """Writes and deletes fields of .toml files."""
    found = False
    board = re.search(r'target = "(\w+\.toml)"', (folder / "session.toml").read_text("utf-8"))
    if board:
        said = re.sub(r"write (\w+ = \S+) in the board's \.toml", rf"in {board[1]}, write \1", said)
        said = said.replace("its .toml", board[1])
    for name, text in re.findall(_WRITTEN, said):
        document = tomllib.loads((folder / name).read_text("utf-8"))
        table = re.match(r"\[(\w+)\] ", text)
        fields = text[table.end() if table else 0 :].replace(" and ", "\n")
        for key, value in tomllib.loads(fields).items():
            in_camera = key in ("resolution", "matrix", "distortion")
            where = table[1] if table else "camera" if in_camera else ""
            (document[where] if where else document)[key] = value
        (folder / name).write_text(tomli_w.dumps(document), "utf-8")
        found = True
    if "delete matrix and distortion" in said:
        document = tomllib.loads((folder / "session.toml").read_text("utf-8"))
        for key in ("matrix", "distortion"):
            document["camera"].pop(key, None)
        (folder / "session.toml").write_text(tomli_w.dumps(document), "utf-8")
        found = True
    return found

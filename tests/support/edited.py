"""Edits of files that a user would make by hand."""

import csv
from collections.abc import Callable
from pathlib import Path


def changed(folder: Path, name: str, old: str, new: str) -> Path:
    """Replaces a text that has to be in a file of a folder."""
    text = (folder / name).read_text("utf-8")
    assert old in text
    (folder / name).write_text(text.replace(old, new), "utf-8")
    return folder


def rewritten(folder: Path, change: Callable[[int, dict[str, str]], dict[str, str]]) -> None:
    """Puts what a function makes of each row's number and cells in the place of views.csv."""
    path = folder / "views.csv"
    with path.open(newline="", encoding="utf-8") as file:
        rows = [change(at, row) for at, row in enumerate(csv.DictReader(file))]
    lines = [list(rows[0]), *(list(row.values()) for row in rows)]
    path.write_text("\n".join(map(",".join, lines)) + "\n", encoding="utf-8")

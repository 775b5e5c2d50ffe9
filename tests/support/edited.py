"""Edits of files that a user would make by hand."""

import csv
from collections.abc import Callable
from pathlib import Path

Rows = list[dict[str, str]]


def changed(folder: Path, name: str, old: str, new: str) -> Path:
    """Replaces a text that has to be in a file of a folder."""
    text = (folder / name).read_text("utf-8")
    assert old in text
    (folder / name).write_text(text.replace(old, new), "utf-8")
    return folder


def edit_rows(folder: Path, change: Callable[[Rows], Rows], name: str = "views.csv") -> None:
    """Puts what a function makes of the rows of a table in their place."""
    path = folder / name
    with path.open(newline="", encoding="utf-8") as file:
        rows = change([*csv.DictReader(file)])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0]], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def rewritten(folder: Path, change: Callable[[int, dict[str, str]], dict[str, str]]) -> None:
    """Puts what a function makes of each row's number and cells in the place of views.csv."""
    edit_rows(folder, lambda rows: [change(at, row) for at, row in enumerate(rows)])

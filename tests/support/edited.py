"""Edits of files that a user would make by hand."""

from pathlib import Path


def changed(folder: Path, name: str, old: str, new: str) -> Path:
    """Replaces a text that has to be in a file of a folder."""
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))
    return folder

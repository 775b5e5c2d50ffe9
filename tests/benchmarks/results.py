"""Writes the sections of RESULTS.md, one for each benchmark script.

Every script takes `--quick`: the same way with the least of everything, in some seconds, to see
that it still runs. It measures nothing, and leaves RESULTS.md as it is.
"""

import datetime
import fcntl
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

RESULTS = Path(__file__).with_name("RESULTS.md")
_OPTION = "--quick"
QUICK = _OPTION in sys.argv[1:]
# What else is said behind the script's name.
WORDS = tuple(argument for argument in sys.argv[1:] if argument != _OPTION)

_Any = TypeVar("_Any")
_HEAD = """# What the benchmarks measured

Each section between `begin` and `end` marks is written by the command that it names, with the
commit and the date of its run; run that command, or `.ci/nightly --full` for all, to update it.
"""


def few(usual: _Any, quick: _Any) -> _Any:
    """Chooses between what is measured and what `--quick` does."""
    return quick if QUICK else usual


def first(rows: Sequence[_Any], count: int = 1) -> list[_Any]:
    """Takes all rows of a table, or with `--quick` the first ones."""
    return list(rows[: few(len(rows), count)])


def wished(usual: int, quick: int = 1, place: int = 0) -> int:
    """Reads how many seeds or worlds are wished from the words on the command line."""
    return int(WORDS[place]) if place < len(WORDS) else few(usual, quick)


def write_section(name: str, command: str, text: str, path: Path = RESULTS) -> None:
    """Replaces the section called `name`, or appends it; not with `--quick`.

    Args:
        name: The section's heading, which also identifies it.
        command: What to run, from the repository's root, to measure again.
        text: Markdown below the heading.
        path: The file; created where it is absent.
    """
    if QUICK:
        return
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    section = f"{begin}\n## {name}\n\n`{command}`, {_machine()}\n\n{text.strip()}\n{end}\n"
    # Benchmarks that run side by side write one after the other.
    folder = os.open(path.parent, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    try:
        _replace(path, section, begin, end)
    finally:
        os.close(folder)


def _replace(path: Path, section: str, begin: str, end: str) -> None:
    old = path.read_text(encoding="utf-8") if path.exists() else _HEAD
    before, found, rest = old.partition(begin)
    if not found:
        new = f"{old.rstrip()}\n\n{section}"
    else:
        _, closed, after = rest.partition(f"{end}\n")
        if not closed:
            raise ValueError(f"{path}: there is no line {end!r}; mend it by hand.")
        new = before + section + after
    path.write_text(new, encoding="utf-8")


def _machine() -> str:
    packages = (("numpy", "numpy"), ("OpenCV", "opencv-contrib-python-headless"))
    versions = ", ".join(f"{label} {version(package)}" for label, package in packages)
    told = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    at = subprocess.run(told, cwd=RESULTS.parent, capture_output=True, text=True, check=False)
    commit = f"commit {at.stdout.strip()}, " if at.stdout else ""
    return (f"{commit}{datetime.date.today().isoformat()}, on {os.cpu_count()} cores with Python "
            f"{platform.python_version()}, {versions}.")  # fmt: skip

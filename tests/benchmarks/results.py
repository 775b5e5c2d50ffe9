"""Writes the sections of RESULTS.md, one for each benchmark script."""

import os
import platform
from importlib.metadata import version
from pathlib import Path

RESULTS = Path(__file__).with_name("RESULTS.md")

_HEAD = """# What the benchmarks measured

Each section is written by the command that it names; run that command to renew it.
"""


def write_section(name: str, command: str, text: str, path: Path = RESULTS) -> None:
    """Replaces the section called `name`, or appends it.

    Args:
        name: The section's heading, which also identifies it.
        command: What to run, from the repository's root, to measure again.
        text: Markdown below the heading.
        path: The file; created where it is absent.
    """
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    section = f"{begin}\n## {name}\n\n`{command}`, {_machine()}\n\n{text.strip()}\n{end}\n"
    old = path.read_text(encoding="utf-8") if path.exists() else _HEAD
    before, found, rest = old.partition(begin)
    if not found:
        new = f"{old.rstrip()}\n\n{section}"
    else:
        _, closed, after = rest.partition(f"{end}\n")
        if not closed:
            raise ValueError(f"{path}: the section {name!r} has no line {end!r}; mend it by hand.")
        new = before + section + after
    path.write_text(new, encoding="utf-8")


def _machine() -> str:
    packages = (("numpy", "numpy"), ("OpenCV", "opencv-contrib-python-headless"))
    versions = ", ".join(f"{label} {version(package)}" for label, package in packages)
    return f"on {os.cpu_count()} cores with Python {platform.python_version()}, {versions}."

"""Writes the sections of RESULTS.md, one for each benchmark script.

Every script takes `--quick`: the same way with the least of everything, in some seconds, to see
that it still runs. It measures nothing, and leaves RESULTS.md as it is. `--help` says what a script
measures, and any other option is refused.
"""

import datetime
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

RESULTS = Path(__file__).with_name("RESULTS.md")
QUICK = "--quick" in sys.argv[1:]
_OTHERS = {word for word in sys.argv[1:] if word.startswith("-")} - {"--quick"}
# Scripts that take further options read them themselves, and do not come here.
if _OTHERS and Path(sys.argv[0]).resolve().parent == RESULTS.parent:
    script = sys.modules["__main__"].__doc__ or ""
    print(f"{script.strip()}\n\n--quick: the least of everything; RESULTS.md stays as it is.")
    sys.exit(0 if {"--help", "-h"} >= _OTHERS else f"error: no option {', '.join(_OTHERS)}")
# What else is said behind the script's name.
WORDS = tuple(argument for argument in sys.argv[1:] if argument != "--quick")

_Any = TypeVar("_Any")


def few(usual: _Any, quick: _Any) -> _Any:
    """Chooses between what is measured and what `--quick` does."""
    return quick if QUICK else usual


def wished(usual: int, quick: int = 1) -> int:
    """Reads how many seeds or worlds are wished from the words on the command line."""
    return int(WORDS[0]) if WORDS else few(usual, quick)


def write_section(name: str, command: str, text: str) -> None:
    """Replaces the section called `name`, or appends it; not with `--quick`."""
    if QUICK:
        return
    begin, end = f"<!-- begin {name} -->\n", f"<!-- end {name} -->\n"
    before, _, rest = RESULTS.read_text(encoding="utf-8").partition(begin)
    section = f"{begin}## {name}\n\n`{command}`, {_machine()}\n\n{text.strip()}\n{end}"
    RESULTS.write_text(before + section + rest.partition(end)[2], encoding="utf-8")


def _machine() -> str:
    packages = (("numpy", "numpy"), ("OpenCV", "opencv-contrib-python-headless"))
    versions = ", ".join(f"{label} {version(package)}" for label, package in packages)
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    at = subprocess.run(command, cwd=RESULTS.parent, capture_output=True, text=True, check=False)
    commit = f"commit {at.stdout.strip()}, " if at.stdout else ""
    return (f"{commit}{datetime.date.today().isoformat()}, on {os.cpu_count()} cores with Python "
            f"{platform.python_version()}, {versions}.")  # fmt: skip

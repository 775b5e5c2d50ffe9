"""Runs the commands that a message prints, word for word."""

import re
import shlex
from collections.abc import Iterator
from unittest.mock import patch

from support.commands import visioncal

from visioncal.present import viewer

# Commands whose answer may be no, as their help announces.
_ANSWERS = {"verify": (0, 3), "doctor": (0, 3)}
_PLACEHOLDER = re.compile(r"\b(SESSION|FIXED|OUT|NEW|AGAIN)\b")


def printed_commands(said: str) -> tuple[str, ...]:
    """The command lines of a message: those on a line of their own."""
    lines = (line.strip() for line in said.splitlines())
    return tuple(dict.fromkeys(line for line in lines if line.startswith("visioncal ")))


def failures(said: str) -> Iterator[str]:
    """What became of the commands that a message prints and that do not end as they announce."""
    for line in printed_commands(said):
        if _PLACEHOLDER.search(line):
            yield f"{line}: has a placeholder"
        for words in map(shlex.split, line.split(" && ")):
            # A window would stay until somebody closes it.
            with patch.object(viewer, "review_native"):
                done = visioncal(*words[1:])
            if done.status not in _ANSWERS.get(words[1], (0,)):
                yield f"{line}: status {done.status}, {done.err}"
                break

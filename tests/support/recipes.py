"""Reads pages, and runs what they show in the current folder as their readers would."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from support.commands import Done, visioncal

FOLDER = Path(__file__).parents[1] / "cookbook"
BLOCK = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"([+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the word behind it (a file's name), and its text."""

    language: str
    name: str
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(*value) for value in BLOCK.findall(page.read_text(encoding="utf-8"))]


def command_lines(text: str) -> Iterator[list[str]]:
    """The words of each command of a block, without what follows a # on its line."""
    for line in text.replace("\\\n", " ").splitlines():
        if words := shlex.split(line, comments=True):
            yield words


def run(page: Path) -> None:
    """Runs a page in the current folder.

    A block with a name is written under it, `sh` blocks hold visioncal's commands and runs of such
    files, `python` blocks share their names. An `expect` block is what the commands before it
    print, `...` for what is left out; it begins with `exit status N` where that is not 0.
    """
    names: dict[str, Any] = {}
    status, said = 0, ""
    for at, block in enumerate(blocks(page)):
        if block.language == "expect":
            wanted, _, rest = block.text.partition("\n")
            named = re.fullmatch(r"exit status (\d)", wanted)
            assert status == (int(named[1]) if named else 0), f"{page.name}: {said}"
            match(rest if named else block.text, said, page.name)
            status = 0
            continue
        assert status == 0, f"{page.name}, before block {at}: {said}"
        if block.language == "sh":
            said = ""
            for words in command_lines(block.text):
                assert status == 0, f"{page.name}, before {words}: {said}"
                done = visioncal(*words[1:]) if words[0] == "visioncal" else _shell(words)
                status, said = done.status, said + done.out + done.err
        elif block.language == "python":
            exec(compile(block.text, f"{page.name}, block {at}", "exec"), names)
        elif block.name:
            Path(block.name).parent.mkdir(parents=True, exist_ok=True)
            Path(block.name).write_text(block.text, encoding="utf-8")
    assert status == 0, f"{page.name}, at its end: {said}"


def _shell(words: list[str]) -> Done:
    """Runs a file of the page, `sh FILE` after values of its variables."""
    assert words[-2] == "sh", words
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    variables = os.environ | dict(word.split("=", 1) for word in words[:-2]) | {"PATH": path}
    done = subprocess.run(words[-2:], check=False, capture_output=True, text=True, env=variables)
    return Done(done.returncode, done.stdout, done.stderr)


def run_example(text: str, page: str) -> None:
    """Runs a block of lines `$ visioncal ...`, each with what it prints under it."""
    for part in text.split("$ visioncal ")[1:]:
        line, _, expected = part.replace("\\\n", " ").partition("\n")
        done = visioncal(*shlex.split(line, comments=True))
        assert done.status == 0, f"{page}: {line}: {done.err}"
        match(expected, done.out + done.err, page)


def match(expected: str, said: str, page: str) -> None:
    """Asserts that what is expected was said, in its order, wherever lines break."""
    words, at = _words(said), 0
    for part in expected.split("..."):
        wanted = _words(part)
        found = next(
            (
                index
                for index in range(at, len(words) - len(wanted) + 1)
                if all(map(_same, wanted, words[index:]))
            ),
            None,
        )
        assert found is not None, f"{page}: {' '.join(wanted)!r} is not in what was said:\n{said}"
        at = found + len(wanted)


def _words(text: str) -> list[str]:
    """What a page may end a quotation before: commas and semicolons."""
    return [part.rstrip(",;") for part in text.split()]


def _same(wanted: str, word: str) -> bool:
    """Whole numbers are equal; others are so to 5 %, as last digits differ between computers."""
    if wanted == word:
        return True
    ours, theirs = NUMBER.split(wanted), NUMBER.split(word)
    if ours[::2] != theirs[::2]:
        return False
    return all(
        a == b or ("." in a + b and abs(float(a) - float(b)) <= 0.05 * abs(float(a)))
        for a, b in zip(ours[1::2], theirs[1::2], strict=True)
    )

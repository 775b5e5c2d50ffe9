"""Names that no file has, and files that might never end, at every command that reads."""

import os
from pathlib import Path

import pytest
from support.commands import visioncal

COMMANDS = (
    ("calibrate", "{}", "-o", "out"),
    ("convert", "{}", "out"),
    ("report", "{}"),
    ("export", "{}", "--to", "ros"),
    ("diff", "{}", "{}"),
    ("verify", "{}", "--against", "{}"),
    ("locate", "{}", "-c", "{}"),
    ("review", "{}"),
    ("tcp", "{}", "--robot-model", "ur10e"),
    ("dynamics", "identify", "{}"),
    ("target", "check", "{}"),
)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda pair: pair[0])
@pytest.mark.parametrize("name", ["a" * 300, "pipe.rrd", "pipe.json"])
def test_what_cannot_be_read_is_no_bug_and_is_not_waited_for(
    command: tuple[str, ...], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if name.startswith("pipe"):
        os.mkfifo(name)
    done = visioncal(*(word.format(tmp_path / name) for word in command))
    assert done.status == 2
    assert done.err.startswith("error: ")
    assert not (tmp_path / "out").exists()

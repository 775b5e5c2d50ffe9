"""Names that no file has, and files that might never end, at every command that reads."""

import os
import re
from pathlib import Path

import pytest
from support.commands import visioncal

# Names are in figures, too.
DRAWS = True

COMMANDS = (
    ("calibrate", "{}", "-o", "out"),
    ("convert", "{}", "out"),
    ("show", "{}"),
    ("export", "{}", "--to", "ros"),
    ("diff", "{}", "{}"),
    ("verify", "{}", "--against", "{}"),
    ("locate", "{}", "-c", "{}"),
    ("show", "{}", "--viewer"),
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


# What moves a terminal's cursor, colours it, or turns the direction of its text.
STEERING = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]")


@pytest.mark.slow
def test_a_name_does_not_steer_the_terminal(tmp_path: Path) -> None:
    cell, out = tmp_path / "cell", tmp_path / "out"
    assert visioncal("simulate", cell, "--no-images", "--views", 12).status == 0
    document = cell / "session.toml"
    named = r'name = "\u001b[31mred\u0007\u202e\nand \u009b1m"'
    text, count = re.subn("^name = .*$", lambda _: named, document.read_text(), flags=re.M)
    assert count == 1
    document.write_text(text)
    calls = (
        ("doctor", cell),
        ("calibrate", cell, "-o", out),
        ("show", out, "-o", tmp_path / "report.html"),
        ("show", out, "--certificate", "-o", tmp_path / "certificate.html"),
        ("verify", cell, "--against", out, "-o", tmp_path / "check"),
    )
    for call in calls:
        done = visioncal(*call)
        assert done.status == 0
        assert not STEERING.search(done.out + done.err), call
    pages = sorted(tmp_path.rglob("*.html"))
    assert len(pages) >= 3
    assert all("[31mred" in page.read_text() for page in pages)
    assert not [page for page in pages if STEERING.search(page.read_text())]
    # Nor that of a result from elsewhere.
    result = out / "calibration.json"
    document_out = re.sub(r'"name": ".*?\[31mred', r'"name": "\\u001b[31mred', result.read_text())
    assert r"\u001b[31m" in document_out
    result.write_text(document_out)
    done = visioncal("verify", cell, "--against", result)
    assert done.status == 0
    assert not STEERING.search(done.out + done.err)

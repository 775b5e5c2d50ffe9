"""Files are written whole or not at all, and those of a folder together; what cannot be read."""

import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from support.commands import visioncal
from support.killed_calls import ALL, LESS, NAMES, expect_no_leftovers, visible, written
from support.refusals import raised
from support.samples import made_up

from visioncal.calibration.run import Run
from visioncal.core import files
from visioncal.core.documents.toml import find_described, parse_toml
from visioncal.core.errors import DataError
from visioncal.core.files import (
    check_free,
    decode_text,
    read_bytes,
    read_text_inside,
    write_atomically,
)
from visioncal.core.generations import write_generation
from visioncal.interchange.outputs import write_outputs
from visioncal.present import recording
from visioncal.present.report import page
from visioncal.results import Calibration
from visioncal.simulation import CellOptions, simulate, write_session

MOUNT = {"mount": "eye-in-hand"}
posix = pytest.mark.skipif(sys.platform == "win32", reason="links and locks are POSIX's")


@posix
def test_killed_at_any_call_one_generation_is_whole(tmp_path):
    program = Path(__file__).parents[1] / "support" / "killed_calls.py"
    done = subprocess.run(
        [sys.executable, str(program), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # A writer whose calls are not seen is never killed.
    assert all(int(calls) > 5 for calls in done.stdout.split())


def test_on_windows_files_are_renamed_one_by_one(tmp_path, monkeypatch):
    """Without locks, links and flushed folders."""
    monkeypatch.setattr(sys, "platform", "win32")
    for name in ("O_NOFOLLOW", "link", "symlink"):
        monkeypatch.delattr(os, name, raising=False)
    monkeypatch.delattr(files, "fcntl", raising=False)
    for content in (ALL, LESS):
        written(tmp_path, content)
        assert visible(tmp_path) == content
        expect_no_leftovers(tmp_path, content)
    files.flush_folder(tmp_path / "no folder")


@posix
def test_temporary_files_of_a_living_writer_are_left_alone(tmp_path):
    def write(aside):
        # Another one comes and goes meanwhile.
        written(tmp_path, LESS)
        write_atomically(tmp_path / "single.txt", "another")
        for name in NAMES:
            (aside / name).write_text(ALL[name])

    write_generation(tmp_path, NAMES, write)
    assert visible(tmp_path) == ALL | {"single.txt": "another"}
    expect_no_leftovers(tmp_path, visible(tmp_path))


def test_writers_at_once_leave_the_files_of_one(tmp_path):
    contents = [{name: f"{number} {name}" for name in NAMES} for number in range(4)]
    with ThreadPoolExecutor(len(contents)) as pool:
        for _ in range(5):
            list(pool.map(lambda value: written(tmp_path, value), contents))
            assert visible(tmp_path) in contents
    expect_no_leftovers(tmp_path, contents[0])


@pytest.mark.parametrize("refused", ["link", "symlink", "flock"])
def test_without_links_or_locks_the_files_are_renamed(tmp_path, monkeypatch, refused):
    def unsupported(*_, **__):
        raise OSError(95, "Operation not supported")

    written(tmp_path, ALL)
    monkeypatch.setattr("fcntl.flock" if refused == "flock" else f"os.{refused}", unsupported)
    written(tmp_path, LESS)
    assert visible(tmp_path) == LESS
    expect_no_leftovers(tmp_path, LESS)


@posix
def test_a_link_of_the_users_is_replaced_and_what_it_leads_to_stays(tmp_path):
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "there.txt").write_text("theirs")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").symlink_to("../else/there.txt")
    written(tmp_path / "out", ALL)
    assert visible(tmp_path / "out") == ALL
    expect_no_leftovers(tmp_path / "out", ALL)
    assert (tmp_path / "else" / "there.txt").read_text() == "theirs"


@posix
@pytest.mark.parametrize("at", ["before", "after"])
def test_an_error_within_the_switch_leaves_one_generation(tmp_path, monkeypatch, at):
    written(tmp_path, ALL)
    rename, calls = os.replace, []

    def fails(self, target):
        # Of the public names the second cannot be replaced, by a link or by the file itself.
        calls.append(Path(target).name in NAMES and Path(target).parent == tmp_path)
        if calls[-1] and sum(calls) == (2 if at == "before" else len(NAMES) + 2):
            raise OSError(5, "Input/output error")
        rename(self, target)

    with monkeypatch.context() as broken:
        broken.setattr(Path, "replace", fails)
        raised(DataError, "Input/output error", written, tmp_path, LESS)
    assert visible(tmp_path) == (ALL if at == "before" else LESS)
    written(tmp_path, LESS)
    expect_no_leftovers(tmp_path, LESS)


def test_an_error_names_the_file_as_it_would_be_called(tmp_path):
    def write(aside):
        (aside / "report.html").mkdir()
        write_atomically(aside / "report.html", "text")

    with pytest.raises(DataError, match=r"report\.html cannot be written") as caught:
        write_generation(tmp_path, NAMES, write)
    assert caught.value.culprits == (str(tmp_path / "report.html"),)
    assert ".tmp" not in caught.value.message
    assert not list(tmp_path.iterdir())


def breaking(*_, **__):
    raise ValueError("18 mm of 25 mm")


@pytest.mark.parametrize(
    ("module", "name", "file"),
    [(page, "write_report", "report.html"), (recording, "write_recording", "recording.rrd")],
)
def test_a_result_outlives_a_drawing_that_fails(tmp_path, monkeypatch, module, name, file):
    sample = made_up()
    before = write_outputs(tmp_path, sample.session, Run(sample.calibration, sample.evidence))
    later = replace(sample.calibration, created="2026-11-22T00:00:00+00:00")
    monkeypatch.setattr(module, name, breaking)
    done = write_outputs(tmp_path, sample.session, Run(later, sample.evidence))
    assert Calibration.load(tmp_path).created == later.created
    # The earlier drawing does not stand beside the new result as if it were its own.
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        path.name for path in done.files
    )
    assert {item.name for item in before.files} - {item.name for item in done.files} == {file}
    (missing,) = done.failed_drawings
    assert missing.file == tmp_path / file
    assert "ValueError at test_generations.py" in missing.cause
    assert "18 mm of 25 mm" in missing.cause


@pytest.mark.slow
def test_calibrate_ends_with_1_and_the_result_where_a_drawing_fails(tmp_path, monkeypatch):
    cell = write_session(simulate(CellOptions(views=12, seed=1)), tmp_path / "p", images=False)
    out = tmp_path / "out"
    # What is not wanted is left out.
    assert visioncal("calibrate", cell, "-o", out, "--no-report", "--no-recording").status == 0
    assert [path.name for path in out.iterdir()] == ["calibration.json"]
    monkeypatch.setattr(page, "write_report", breaking)
    for more in ((), ("--json",)):
        done = visioncal("calibrate", cell, "-o", out, *more)
        assert done.status == 1
        assert f"{out / 'report.html'} could not be drawn (ValueError" in done.err
        assert f"The result is safe in {out / 'calibration.json'}" in done.err
        assert sorted(path.name for path in out.iterdir()) == ["calibration.json", "recording.rrd"]
        if more:
            assert json.loads(done.out) == json.loads((out / "calibration.json").read_bytes())
        else:
            assert "views used" in done.out


def test_failed_write_leaves_the_old_content_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def full_disk(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    raised(DataError, r"a\.txt cannot be written: No space left", write_atomically, path, "new")
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("a.txt", "old")]


def test_missing_file_and_folder_are_named(tmp_path):
    raised(DataError, r"nowhere\.txt does not exist", read_bytes, tmp_path / "nowhere.txt")
    (tmp_path / "images" / "view10").mkdir(parents=True)
    raised(DataError, r"is a folder, and no file. Check the path", read_bytes, tmp_path / "images")
    raised(DataError, "cannot be written", write_atomically, tmp_path / "missing" / "a.txt", "")


def test_files_that_may_never_end_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    for path in (tmp_path / "pipe.csv", Path("/dev/zero")):
        raised(DataError, "is not a regular file", read_bytes, path)
    (tmp_path / "large.csv").write_bytes(bytes(11))
    assert len(read_bytes(tmp_path / "large.csv", 11)) == 11
    raised(DataError, "has more than", read_bytes, tmp_path / "large.csv", 10)


@pytest.mark.parametrize(
    ("name", "words"),
    [("ä" * 128, "too long"), ("a\0b", "does not exist"), ("a/" * 3000, "too long")],
)
def test_names_that_no_file_has_are_refused(name, words, tmp_path):
    raised(DataError, words, read_bytes, tmp_path / name)


def test_a_link_out_of_a_folder_is_not_followed(tmp_path):
    (tmp_path / "secret.csv").write_text("secret")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "inner.csv").write_text("inner")
    (folder / "alias.csv").symlink_to("inner.csv")
    (folder / "out.csv").symlink_to(tmp_path / "secret.csv")
    (folder / "loop.csv").symlink_to("loop.csv")
    (tmp_path / "link").symlink_to(folder)
    assert read_text_inside(tmp_path / "link", "alias.csv") == "inner"
    raised(DataError, "leads out of its folder", read_text_inside, folder, "out.csv")
    with pytest.raises(DataError):
        read_text_inside(folder, "loop.csv")


def test_text_may_have_a_byte_order_mark_but_must_be_utf8():
    assert decode_text(b"\xef\xbb\xbfview", "x.csv") == "view"
    with pytest.raises(DataError, match=r"x\.csv, line 2: byte 0xe4 is not UTF-8"):
        decode_text(b"view\ngr\xe4n", "x.csv")


def test_toml_errors_give_the_line():
    with pytest.raises(DataError, match=r"x\.toml is not valid TOML: .*line 2"):
        parse_toml("a = 1\nb = [1,, 2]", "x.toml")


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("square_m = 0,03", {"square_m": 0.03}),
        (r'target = "C:\users\b.toml"', {"target": "C:/users/b.toml"}),
        ("mount = \N{LEFT DOUBLE QUOTATION MARK}eye-in-hand\N{RIGHT DOUBLE QUOTATION MARK}", MOUNT),
        ("mount = eye-in-hand", MOUNT),
        ("asymmetric = True", {"asymmetric": True}),
        ("z_m = np.float64(0.0814)", {"z_m": 0.0814}),
        ("b = [1,, 2]", None),
        ('b = "it', None),
    ],
)
def test_the_line_that_is_meant_is_named_where_it_is_clear(line, meant):
    caught = raised(DataError, "is not valid TOML", parse_toml, f"a = 1\n{line}\n", "x.toml")
    said = re.search(r"^Correct line 2 to `(.*?)`\. ", caught.next_step)
    assert (parse_toml(said[1], "x.toml") if said else None) == meant


def test_a_backslash_that_became_another_character_is_named(tmp_path):
    folder = tmp_path / "cell"
    sound = {"what": "target", "shipped": {}, "suffixes": (".toml",), "folder": folder}
    name = parse_toml(r'target = "boards\new.toml"', "x.toml")["target"]
    caught = raised(DataError, r"boards\\new.toml' does not exist", find_described, name, **sound)
    assert "with /" in caught.next_step
    assert all(culprit.isprintable() for culprit in caught.culprits)


def test_a_link_that_leads_nowhere_is_not_replaced_unasked(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    raised(DataError, "nothing is overwritten", check_free, link, force=False)
    check_free(link, force=True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 3000 + "]" * 3000, "nested deeper"),
        (".".join("a" * 100) + " = 1", "nested deeper"),
        (f"a.b = {2**63}", r"a\.b has more than the 64 bits"),
        ("a = " + "9" * 5000, "is not valid TOML"),
    ],
)
def test_malformed_toml_is_refused(text, words):
    raised(DataError, words, parse_toml, text, "x.toml")

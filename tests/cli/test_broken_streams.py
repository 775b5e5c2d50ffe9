"""Commands whose stdout or stderr takes nothing: a full disk, or a reader that has gone."""

import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import pytest

from visioncal.cli.app import main
from visioncal.simulation import CellOptions, simulate, write_session

pytestmark = pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
FILES = ["calibration.json", "recording.rrd", "report.html"]


@pytest.fixture(scope="module")
def pairs(tmp_path_factory) -> Path:
    """A session of pose pairs, which are calibrated in no time."""
    folder = tmp_path_factory.mktemp("pairs") / "cell"
    return write_session(simulate(CellOptions(views=12, seed=1)), folder, images=False)


def full():
    return Path("/dev/full").open("w", encoding="utf-8")


def unread():
    """A pipe whose reader has gone."""
    reading, writing = os.pipe()
    os.close(reading)
    return os.fdopen(writing, "w", encoding="utf-8")


def status(out, err, *arguments) -> int:
    words = ["visioncal", *map(str, arguments)]
    with patch.object(sys, "argv", words), redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_full_disk_behind_stdout_is_one_message_and_status_2(pairs, tmp_path):
    err = io.StringIO()
    with full() as out:
        assert status(out, err, "calibrate", pairs, "-o", tmp_path, "--json") == 2
    assert "stdout cannot be written: No space left on device." in err.getvalue()
    assert names(tmp_path) == FILES


def test_a_full_disk_behind_stderr_takes_no_result_away(pairs, tmp_path):
    out = io.StringIO()
    with full() as err:
        assert status(out, err, "calibrate", pairs, "-o", tmp_path) == 0
    assert names(tmp_path) == FILES


def test_a_reader_that_has_gone_ends_the_command_quietly(pairs, tmp_path):
    err = io.StringIO()
    with unread() as out:
        assert status(out, err, "calibrate", pairs, "-o", tmp_path, "--json") == 141
    assert err.getvalue() == ""
    assert names(tmp_path) == FILES


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["calibrate", "none", "--json"]])
def test_every_command_ends_so(arguments):
    err = io.StringIO()
    with full() as out:
        assert status(out, err, *arguments) == 2
    assert err.getvalue().count("stdout cannot be written") == 1
    with unread() as out:
        assert status(out, io.StringIO(), *arguments) == 141


@pytest.mark.parametrize("arguments", [["calibrate", "none"], ["calibrate", "--nonsense"]])
def test_an_error_that_cannot_be_printed_keeps_its_status(arguments):
    with full() as err:
        assert status(io.StringIO(), err, *arguments) == 2


def test_streams_that_were_closed_before_are_no_error(pairs, tmp_path):
    assert status(None, None, "calibrate", pairs, "-o", tmp_path, "--json") == 0
    assert names(tmp_path) == FILES

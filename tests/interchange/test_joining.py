"""A result written anew with what has joined it."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.kept import assert_same, assert_same_evidence
from support.refusals import raised
from support.samples import made_up, tool_frame, with_frames

from visioncal.calibration.run import Run
from visioncal.cli.calibrate import calibrate_command
from visioncal.cli.result_options import CalibrateOptions
from visioncal.core.errors import DataError
from visioncal.frames.frame_from_images import SEEN_BY
from visioncal.interchange.outputs import write_outputs
from visioncal.interchange.result_files import frames_to_keep, load_stored, rewrite_result
from visioncal.present.recording import read_calibration, read_evidence
from visioncal.results import Calibration, FrameFile, to_document
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session


@pytest.fixture(scope="module")
def sample():
    return made_up()


@pytest.fixture(scope="module")
def outputs(sample, tmp_path_factory):
    """What a calibration writes."""
    folder = tmp_path_factory.mktemp("written")
    write_outputs(folder, sample.session, Run(sample.calibration, sample.evidence))
    return folder


@pytest.fixture
def folder(outputs, tmp_path):
    return Path(shutil.copytree(outputs, tmp_path / "out"))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_all_files_are_as_before_with_the_frames(sample, folder):
    joined = with_frames(sample).calibration
    files = rewrite_result(folder, joined).files
    assert [file.name for file in files] == ["calibration.json", "report.html", "recording.rrd"]
    assert sorted(contents(folder)) == sorted(file.name for file in files)
    expected = to_document(sample.calibration) | {"frames": to_document(joined)["frames"]}
    for calibration in (Calibration.load(folder), read_calibration(folder / "recording.rrd")):
        assert to_document(calibration) == expected
    assert_same(sample.session, Session.load(folder / "recording.rrd"))
    assert_same_evidence(sample.evidence, read_evidence(folder / "recording.rrd"))
    assert load_stored(folder).note == ""
    report = (folder / "report.html").read_text(encoding="utf-8")
    assert "Tools and fixtures" in report
    assert "data:image/jpeg" in report


def test_results_of_another_session_are_refused(sample, folder):
    before = contents(folder)
    other = replace(sample.calibration, session_sha256="0" * 64)
    raised(DataError, "holds the result of another session", rewrite_result, folder, other)
    raised(DataError, "does not exist", rewrite_result, folder / "absent", sample.calibration)
    assert contents(folder) == before


@pytest.fixture
def pairs(tmp_path):
    """A session of pose pairs, which are calibrated in no time."""
    cell = simulate(CellOptions(views=12, seed=1))
    return write_session(cell, tmp_path / "pairs", images=False)


def options(session, out):
    return CalibrateOptions(session=session, out=out)


def test_frames_of_a_replaced_result_are_kept_beside_the_new_one(sample, pairs, tmp_path, capsys):
    out = tmp_path / "out"
    calibrate_command(options(pairs, out))
    assert frames_to_keep(out) is None
    assert not (out / "frames.json").exists()
    # Of what had joined, the fixture was placed by the camera.
    capsys.readouterr()
    joined = with_frames(sample).calibration.frames
    fixture = joined["base_from_fixture"]
    seen = replace(fixture, details={**fixture.details, SEEN_BY: "yesterday"})
    frames = {**joined, "base_from_fixture": seen}
    replace(Calibration.load(out), frames=frames).save(out / "calibration.json")
    FrameFile({"flange_from_old": tool_frame(), "flange_from_tool": tool_frame()}).save(
        out / "frames.json"
    )
    calibrate_command(options(pairs, out))
    assert not Calibration.load(out).frames
    kept = FrameFile.load(out / "frames.json").frames
    assert kept.keys() == {"flange_from_old", *frames}
    assert kept["base_from_fixture"].details[SEEN_BY] == "yesterday"
    printed = capsys.readouterr().err
    assert "flange_from_tool, base_from_fixture had joined the result that this one" in printed
    assert "calibrated before: base_from_fixture." in printed


def test_frames_that_cannot_be_kept_stop_a_new_result(sample, pairs, tmp_path):
    out = tmp_path / "out"
    calibrate_command(options(pairs, out))
    frames = with_frames(sample).calibration.frames
    replace(Calibration.load(out), frames=frames).save(out / "calibration.json")
    (out / "frames.json").write_text("not frames", encoding="utf-8")
    before = contents(out)
    raised(DataError, r"frames\.json, line 1.* is not JSON", calibrate_command, options(pairs, out))
    assert contents(out) == before

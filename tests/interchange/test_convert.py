"""Converting sessions: the same facts in another form, and nothing overwritten."""

from dataclasses import replace
from pathlib import Path

import pytest
from support.commands import visioncal
from support.foreign_samples import streams
from support.samples import made_up

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.interchange.formats import convert
from visioncal.present.recording import write_recording
from visioncal.session import Session


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "cell, größer"
    made_up(5).session.save(path)
    return path


def content(folder):
    """The bytes of every file, by its path in the folder."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_there_and_back_again(folder, tmp_path):
    recording, again = tmp_path / "cell.rrd", tmp_path / "again"
    convert(folder, recording)
    convert(recording, again)
    assert Session.load(recording).digest() == Session.load(folder).digest()
    assert content(again) == content(folder)


def test_a_recording_without_a_whole_view_leaves_no_folder(folder, tmp_path):
    cut, again = tmp_path / "cut.rrd", tmp_path / "again"
    empty = replace(Session.load(folder), views=())
    write_recording(cut, empty, None, (), None)
    with pytest.raises(DataError, match="no view and no stream"):
        convert(cut, again)
    assert not again.exists()


def test_what_a_session_cannot_hold_leaves_no_folder(tmp_path):
    recording = streams(tmp_path / "in")
    rows = recording.source.read_text().splitlines()
    rows[35] = ",".join([*rows[35].split(",")[:2], "-4.4e10", *rows[35].split(",")[3:]])
    recording.source.write_text("\n".join(rows))
    with pytest.raises(DataError, match="is no place in a robot cell"):
        convert(recording.source, tmp_path / "out", requested=recording.requested)
    assert not (tmp_path / "out").exists()


def test_a_recording_of_a_recording_and_a_folder_of_a_folder(folder, tmp_path):
    for first, second in (("a.rrd", "b.RRD"), ("a", "b")):
        convert(folder, tmp_path / first)
        convert(tmp_path / first, tmp_path / second)
        assert Session.load(tmp_path / second).digest() == Session.load(folder).digest()


@pytest.mark.parametrize("name", ["taken", "taken.rrd"])
def test_what_is_there_stays(folder, tmp_path, name):
    taken = tmp_path / name
    taken.write_bytes(b"kept")
    with pytest.raises(DataError, match="exists, and nothing is overwritten"):
        convert(folder, taken)
    assert taken.read_bytes() == b"kept"


def test_force_replaces_a_recording_and_nothing_else(folder, tmp_path):
    (tmp_path / "old.rrd").write_bytes(b"old")
    convert(folder, tmp_path / "old.rrd", force=True)
    assert Session.load(tmp_path / "old.rrd").digest() == Session.load(folder).digest()
    (tmp_path / "file").write_bytes(b"kept")
    (tmp_path / "folder.rrd").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_bytes(b"kept")
    for name in ("file", "folder.rrd", "full"):
        with pytest.raises(DataError, match=name):
            convert(folder, tmp_path / name, force=True)
    assert (tmp_path / "file").read_bytes() == (tmp_path / "full/file").read_bytes() == b"kept"


def test_a_recording_is_not_written_over_itself(folder, tmp_path):
    path = tmp_path / "cell.rrd"
    convert(folder, path)
    before = path.read_bytes()
    with pytest.raises(DataError, match="nothing is overwritten"):
        convert(path, path, force=True)
    assert path.read_bytes() == before


def test_the_recording_that_comes_along_calibrates(tmp_path):
    path = Path(__file__).parents[2] / "recordings" / "ur10e_charuco.rrd"
    assert path.stat().st_size < 3_000_000
    folder = tmp_path / "ur10e_charuco"
    convert(path, folder)
    calibration = calibrate(folder)
    assert calibration.session_sha256 == Session.load(path).digest()
    assert calibration.verdict.status == "good"
    assert calibration.camera is not None
    assert calibration.camera.estimated


@pytest.mark.parametrize("name", ["absent", "empty", "notes.txt"])
def test_what_is_no_session_is_named(tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no session")
    with pytest.raises(DataError, match=name):
        convert(tmp_path / name, tmp_path / "new.rrd")
    assert not (tmp_path / "new.rrd").exists()


def test_the_command_converts_and_refuses(folder, tmp_path):
    done = visioncal("convert", folder, tmp_path / "new.rrd")
    assert done.status == 0, done.err
    assert Session.load(folder).digest() in done.err
    again = visioncal("convert", folder, tmp_path / "new.rrd")
    assert again.status == 2
    assert "--force" in again.err


@pytest.fixture
def misread(tmp_path):
    """A session whose copy in the folder `mm` has its positions in millimetres."""
    session = made_up(9, images=False).session
    cells = [
        [
            repr(1e3 * view.numbers[name]) if name in ("x_m", "y_m", "z_m") else view.cell(name)
            for name in session.columns
        ]
        for view in session.views
    ]
    Session.assemble(session.document, session.columns, cells, session.images).save(tmp_path / "mm")
    return session


def test_a_session_whose_poses_are_misread_is_mended(misread, tmp_path):
    asked = visioncal("convert", tmp_path / "mm", tmp_path / "no", "--guess")
    assert asked.status == 2
    assert "--yes" in asked.err
    assert not (tmp_path / "no").exists()
    done = visioncal("convert", tmp_path / "mm", tmp_path / "mended", "--guess", "--yes")
    assert done.status == 0, done.err
    assert "positions in mm" in done.err
    mended = Session.load(tmp_path / "mended")
    for old, new in zip(misread.views, mended.views, strict=True):
        # Multiplied by 1000 and divided again, each rounded once.
        for name in ("x_m", "y_m", "z_m", "qx", "qw", "cft_x_m"):
            assert new.numbers[name] == pytest.approx(old.numbers[name], abs=1e-14)
        assert new.text == old.text


def test_what_describes_somebody_elses_poses_is_refused_for_a_session(folder, tmp_path):
    done = visioncal("convert", folder, tmp_path / "new", "--robot-unit", "mm")
    assert done.status == 2
    assert "is a session already" in done.err
    assert not (tmp_path / "new").exists()

"""Converting sessions: the same facts in another form, and nothing overwritten."""

from pathlib import Path

import pytest
from support.commands import visioncal
from support.refusals import raised
from support.samples import made_up

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.interchange.formats import convert
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


def test_what_is_there_stays_and_force_replaces_a_recording_alone(folder, tmp_path):
    for name in ("taken", "taken.rrd"):
        (tmp_path / name).write_bytes(b"kept")
        raised(DataError, "exists, and nothing is overwritten", convert, folder, tmp_path / name)
        assert (tmp_path / name).read_bytes() == b"kept"
    convert(folder, tmp_path / "taken.rrd", force=True)
    assert Session.load(tmp_path / "taken.rrd").digest() == Session.load(folder).digest()
    (tmp_path / "folder.rrd").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_bytes(b"kept")
    for name in ("taken", "folder.rrd", "full"):
        raised(DataError, name, convert, folder, tmp_path / name, force=True)
    assert (tmp_path / "taken").read_bytes() == (tmp_path / "full/file").read_bytes() == b"kept"


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


def test_the_command_converts_and_refuses(folder, tmp_path):
    done = visioncal("convert", folder, tmp_path / "new.rrd").good()
    assert Session.load(folder).digest() in done.err
    visioncal("convert", folder, tmp_path / "new.rrd").refused("--force")


def test_a_session_whose_poses_are_misread_is_mended(tmp_path):
    session = made_up(9, images=False).session
    cells = [
        [
            repr(1e3 * view.numbers[name]) if name in ("x_m", "y_m", "z_m") else view.cell(name)
            for name in session.columns
        ]
        for view in session.views
    ]
    Session.assemble(session.document, session.columns, cells, session.images).save(tmp_path / "mm")
    visioncal("convert", tmp_path / "mm", tmp_path / "no", "--guess").refused("--yes")
    assert not (tmp_path / "no").exists()
    done = visioncal("convert", tmp_path / "mm", tmp_path / "mended", "--guess", "--yes").good()
    assert "positions in mm" in done.err
    mended = Session.load(tmp_path / "mended")
    for old, new in zip(session.views, mended.views, strict=True):
        # Multiplied by 1000 and divided again, each rounded once.
        for name in ("x_m", "y_m", "z_m", "qx", "qw", "cft_x_m"):
            assert new.numbers[name] == pytest.approx(old.numbers[name], abs=1e-14)
        assert new.text == old.text


def test_what_describes_somebody_elses_poses_is_refused_for_a_session(folder, tmp_path):
    visioncal("convert", folder, tmp_path / "new", "--robot-unit", "mm").refused(
        "is a session already"
    )
    assert not (tmp_path / "new").exists()

"""Recordings whose images are elsewhere: the same session by its digest, and it says so."""

import cv2
import numpy as np
import pytest
from support.commands import visioncal

from visioncal.calibration.pipeline import run
from visioncal.core.errors import DataError
from visioncal.interchange.outputs import RECORDING, write_outputs
from visioncal.interchange.result_files import rewrite_result
from visioncal.present.recording import read_calibration, read_evidence, read_session
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    folder = tmp_path_factory.mktemp("elsewhere")
    write_session(simulate(CellOptions(views=6, seed=2)), folder / "cell")
    session = Session.load(folder / "cell")
    return session, run(session)


@pytest.mark.parametrize("kept", ["thumbnail", "none"])
def test_the_session_stays_what_it_is_without_its_images(cell, tmp_path, kept):
    session, done = cell
    write_outputs(tmp_path / "full", session, done)
    write_outputs(tmp_path / "out", session, done, images=kept)
    path = tmp_path / "out" / RECORDING
    assert path.stat().st_size < 0.35 * (tmp_path / "full" / RECORDING).stat().st_size
    found = read_session(path)
    assert found.digest() == session.digest()
    assert f"{RECORDING}: the images are elsewhere, and only their digests are kept." in (
        found.warnings
    )
    assert len(read_evidence(path)) == 6
    name = found.views[0].image
    assert not found.images.exists(name)
    with pytest.raises(DataError, match=f"written with --images {kept}. Take the session's folder"):
        found.images.read(name)
    with pytest.raises(DataError, match="none of its 6 images can be read"):
        run(found)
    shown = found.images.shown(name)
    if kept == "thumbnail":
        faint = cv2.imdecode(np.frombuffer(shown, np.uint8), cv2.IMREAD_GRAYSCALE)
        whole = cv2.imdecode(np.frombuffer(session.images.read(name), np.uint8), 0)
        assert faint.shape == whole.shape
        # Faint, but the same picture: JPEG of this quality leaves a few grey levels.
        assert np.abs(faint.astype(float) - whole).mean() < 5.0
    else:
        assert shown is None
    # Written anew, what there is stays what it is.
    rewrite_result(tmp_path / "out", Calibration.load(tmp_path / "out"))
    again = read_session(path)
    assert (again.digest(), again.images.shown(name)) == (session.digest(), shown)
    assert read_calibration(path).session_sha256 == session.digest()


def test_the_command_leaves_images_where_they_are_and_makes_no_folder_without_them(cell, tmp_path):
    session, _ = cell
    done = visioncal("calibrate", session.images.folder, "-o", tmp_path, "--images", "none")
    assert done.status == 0
    assert read_session(tmp_path / RECORDING).digest() == session.digest()
    refused = visioncal("calibrate", tmp_path / RECORDING, "-o", tmp_path / "again")
    assert refused.status == 2
    assert "--images none" in refused.err
    refused = visioncal("convert", tmp_path / RECORDING, tmp_path / "folder")
    assert refused.status == 2
    assert "Take the session's folder, which has its images." in refused.err
    assert not (tmp_path / "folder").exists()
    assert visioncal("convert", tmp_path / RECORDING, tmp_path / "copy.rrd").status == 0

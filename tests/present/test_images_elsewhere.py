"""Recordings whose images are elsewhere: the same session by its digest, and the same result."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.depth_cells import SMALL
from support.marks import slow

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.interchange.outputs import RECORDING, write_outputs
from visioncal.interchange.result_files import rewrite_result
from visioncal.present.recording import read_calibration, read_evidence
from visioncal.results import Calibration, to_document
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session

DRAWS = False


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    folder = tmp_path_factory.mktemp("elsewhere")
    options = CellOptions(camera=SMALL, blur_px=0.5, views=6, seed=2)
    write_session(simulate(options), folder / "cell")
    session = Session.load(folder / "cell")
    return session, run(session)


@pytest.mark.parametrize("kept", [slow("thumbnail"), "none"])
def test_the_session_stays_what_it_is_without_its_images(cell, tmp_path, kept):
    session, done = cell
    write_outputs(tmp_path / "full", session, done, images="full")
    write_outputs(tmp_path / "out", session, done, images=kept)
    path = tmp_path / "out" / RECORDING
    assert path.stat().st_size < 0.35 * (tmp_path / "full" / RECORDING).stat().st_size
    found = Session.load(path)
    assert found.digest() == session.digest()
    assert found.warnings == session.warnings
    assert len(read_evidence(path)) == 6
    name = found.views[0].image
    assert not found.images.exists(name)
    with pytest.raises(DataError, match=f"written with --images {kept}. Take the session's folder"):
        found.images.read(name)
    visioncal("convert", path, tmp_path / "folder").refused("--images full")
    assert not (tmp_path / "folder").exists()
    # What was found in the images is there to the last digit.
    again = run(found).calibration
    assert to_document(replace(again, created="")) == to_document(
        replace(done.calibration, created="")
    )
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
    rewritten = Session.load(path)
    assert (rewritten.digest(), rewritten.images.shown(name)) == (session.digest(), shown)
    assert len(run(rewritten).evidence) == 6
    assert read_calibration(path).session_sha256 == session.digest()


def test_a_run_without_searches_keeps_all_images(cell, tmp_path):
    session, done = cell
    write_outputs(tmp_path, session, replace(done, searches={}))
    found = Session.load(tmp_path / RECORDING)
    name = found.views[0].image
    assert found.images.read(name) == session.images.read(name)

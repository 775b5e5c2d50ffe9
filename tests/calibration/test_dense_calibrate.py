"""`calibrate --dense`: what it gains, when it is kept, what it says, and what it needs."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.smeared import smeared

import visioncal as package
from visioncal.calibration.pipeline import run, run_dense
from visioncal.calibration.stages import dense as stage
from visioncal.calibration.stages.detect import detect
from visioncal.core.errors import DataError
from visioncal.results.sections import CornerResiduals
from visioncal.session.selecting import is_whole_cell
from visioncal.simulation import CellOptions, NetworkOptions, cell_session, simulate
from visioncal.simulation.optics import wide_camera
from visioncal.simulation.options import BOARDS

CAMERA = wide_camera()
# A quarter of the pixels, a robot without noise.
OPTIONS = CellOptions(
    views=10,
    seed=3,
    blur_px=0.5,
    robot_sigma_m=0.0,
    robot_sigma_rad=0.0,
    target=BOARDS["checkerboard"],
    camera=replace(CAMERA, resolution=(640, 400), matrix=CAMERA.matrix / 2),
)


@pytest.fixture(scope="module")
def cell():
    return simulate(OPTIONS)


@pytest.fixture(scope="module")
def session(cell):
    """Of an exact robot: the images alone are smeared, by 6 px."""
    return smeared(cell, motion_px=6.0)


@pytest.fixture
def torch():
    return pytest.importorskip("torch", reason="torch is missing: pip install '.[dense]'")


@pytest.fixture(scope="module")
def both(session):
    pytest.importorskip("torch", reason="torch is missing: pip install '.[dense]'")
    return run(session), run_dense(session)


def off_px(cell, found):
    """Rms of what all corners are off."""
    exact = {
        corners_.view: dict(zip(corners_.ids.tolist(), corners_.px, strict=True))
        for corners_ in cell.exact_corners
    }
    off = [
        value.corners.px
        - np.array([exact[value.view][number] for number in value.corners.ids.tolist()])
        for value in found.evidence
    ]
    return np.sqrt(np.mean(np.concatenate(off) ** 2))


def test_dense_corners_are_nearer_to_the_truth_and_both_predictions_are_told(cell, both):
    plain, found = both
    # The template's blur has two widths; a line has one direction. The pictures are the same, 10
    # views of 54 corners: the ratio is known to a twentieth.
    assert off_px(cell, found) < 0.9 * off_px(cell, plain)
    assert found.calibration.noise["pixel_px"] < 0.9 * plain.calibration.noise["pixel_px"]
    document = found.calibration.dense
    assert document.kept
    held = found.calibration.validation.held_out
    assert document.held_out["dense"] == CornerResiduals(mm=held.mm, px=held.px)
    assert document.held_out["template"].px == plain.calibration.validation.held_out.px
    (told,) = [
        reason for reason in found.calibration.verdict.reasons if reason.startswith("Dense corners")
    ]
    assert told.startswith("Dense corners are kept: with them, views that were left out are")
    assert told.count(" px and ") == told.count(" mm") == 2


def test_blur_is_told_with_its_cause(both):
    found = both[1].calibration
    (told,) = [reason for reason in found.verdict.reasons if "Motion smears" in reason]
    assert told.startswith("Motion smears 10 of 10 images, by up to 6.")
    lengths = [image.motion_px for image in found.dense.images]
    np.testing.assert_allclose(lengths, 6.0, atol=0.5)


def test_every_image_is_explained(session, both):
    found = both[1]
    for seen in found.evidence:
        drawn, rest = (
            cv2.imdecode(np.frombuffer(value, np.uint8), cv2.IMREAD_GRAYSCALE)
            for value in (seen.explained.drawn, seen.explained.rest)
        )
        assert drawn.shape == rest.shape == session.resolution[::-1]
        # An exact robot and exact images: JPEG and the noise are left, four times as strong.
        assert np.std(rest.astype(float)) < 12
        assert seen.explained.words.startswith("**Smeared by motion.**")


def test_a_result_with_dense_corners_can_be_written_and_read(both, tmp_path):
    found = both[1].calibration
    found.save(tmp_path / "calibration.json")
    again = package.Calibration.load(tmp_path)
    assert again.dense == found.dense


def test_dense_corners_that_predict_worse_are_not_kept(session, both, monkeypatch):
    rng = np.random.default_rng(1)

    def poor(*given, **options):
        found = fit(*given, **options)
        return replace(found, px=found.px + rng.normal(0.0, 0.5, found.px.shape))

    fit = stage.fit_corners
    monkeypatch.setattr(stage, "fit_corners", poor)
    found = run_dense(session).calibration
    plain = both[0].calibration
    assert found.edges["flange_from_cam"].transform.translation == pytest.approx(
        plain.edges["flange_from_cam"].transform.translation, abs=1e-12
    )
    assert not found.dense.kept
    assert any(reason.startswith("Dense corners are not kept") for reason in found.verdict.reasons)


@pytest.mark.usefixtures("torch")
def test_an_image_that_cannot_be_fitted_keeps_the_corners_of_the_template(session, monkeypatch):
    fit, calls = stage.fit_corners, []

    def first_fails(*given, **options):
        calls.append(given)
        return None if given[0] is image else fit(*given, **options)

    found = detect(session).corners
    views = session.views[:3]
    read = stage.image_of
    image = read(session, views[0])
    monkeypatch.setattr(
        stage, "image_of", lambda value, view: image if view is views[0] else read(value, view)
    )
    monkeypatch.setattr(stage, "fit_corners", first_fails)
    corners, dense = stage.fit_densely(session, views, found, stage.Dense("cpu"))
    assert set(dense.fits) == {1, 2}
    np.testing.assert_array_equal(corners[0].px, found[0].px)
    # Known less well than those that all pixels have.
    assert np.median(corners[0].weights) < np.median(corners[1].weights)
    assert corners[5] is found[5]


def test_without_the_extra_the_command_that_installs_it_is_told(session, tmp_path, monkeypatch):
    session.save(tmp_path / "s")
    monkeypatch.setitem(sys.modules, "torch", None)
    done = visioncal("calibrate", tmp_path / "s", "-o", tmp_path / "out", "--dense")
    assert done.status == 2
    assert "--dense needs torch" in done.err
    assert "pip install 'visioncal[dense]'" in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("torch")
def test_what_has_no_images_of_a_board_is_refused(cell):
    with pytest.raises(DataError, match="--dense needs images of a checkerboard or a ChArUco"):
        run_dense(cell_session(cell, "pairs", seen="poses"))


def test_a_whole_cell_is_refused():
    whole = cell_session(simulate(NetworkOptions()), "cell", seen="names")
    assert is_whole_cell(whole)
    with pytest.raises(DataError, match="dense corners cannot be asked of a whole cell"):
        package.calibrate(whole, dense=True)


def test_without_the_option_neither_library_is_imported(session, tmp_path):
    session.save(tmp_path / "s")
    code = (
        "import sys; from visioncal import calibrate; "
        f"calibrate({str(tmp_path / 's')!r}); "
        "print(sorted({'torch', 'kornia'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

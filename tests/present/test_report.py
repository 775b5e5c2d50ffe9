"""The report: complete, self-contained, and safe against what sessions may be called."""

import base64
import re
import shutil
from dataclasses import replace
from html import unescape

import cv2
import numpy as np
import pytest
from support.findings import CONTRADICTS, with_contradiction
from support.pages import Page, section
from support.samples import REJECTED, made_up

from visioncal.calibration.run import Run, run
from visioncal.core.errors import DataError
from visioncal.core.number_format import significant
from visioncal.interchange.outputs import write_outputs
from visioncal.interchange.result_files import load_stored
from visioncal.present.advice import suspects
from visioncal.present.recording import write_recording
from visioncal.present.recording.notes import view_markdown
from visioncal.present.report.page import render, write_report
from visioncal.present.report.thumbnails import thumbnail
from visioncal.results.views import worst_view
from visioncal.session import MemoryImages
from visioncal.simulation import CellOptions, simulate, write_session
from visioncal.vision.boards.imaging import decode_image


@pytest.fixture(scope="module")
def sample():
    return made_up()


@pytest.fixture(scope="module")
def html(sample):
    return render(sample.calibration, sample.session, sample.evidence)


def test_views_that_contradict_the_others_are_set_apart(sample):
    html = render(with_contradiction(sample), sample.session, sample.evidence)
    page, rows = Page(html), [" ".join(row.split()) for row in Page(html).rows]
    assert f"view 6 not used {CONTRADICTS}" in rows
    assert any(row.startswith("6 ") and row.endswith(" left out") for row in rows)
    assert any(row.startswith("3 ") and row.endswith(" no") for row in rows)
    assert "Red: left out, since it contradicts the others." in page.words
    # Its picture shows how far off it is.
    assert html[html.index("View 6:") - 2000 : html.index("View 6:")].count("<path d=") > 10
    # Residuals far beyond the others' are clipped, and say how far they reach.
    assert " 14 " in section(page, "Residuals by view", "Residuals over joint angles")


def test_real_contradictions_are_recognised(tmp_path):
    cell = simulate(CellOptions(views=15, wrong_views=1))
    write_session(cell, tmp_path / "cell", images=False)
    calibration = run(tmp_path / "cell").calibration
    assert sum(suspect.contradict for suspect in suspects(calibration)) == 1
    assert "the largest part" in Page(render(calibration, None, ())).words.lower()


@pytest.fixture(scope="module")
def outputs(sample, tmp_path_factory):
    """What a calibration writes."""
    folder = tmp_path_factory.mktemp("out put")
    write_outputs(folder, sample.session, Run(sample.calibration, sample.evidence))
    return folder


@pytest.mark.parametrize("name", ["", "calibration.json", "recording.rrd"])
def test_report_made_again_is_the_same(outputs, tmp_path, name):
    stored = load_stored(outputs / name)
    write_report(
        tmp_path / "again.html",
        stored.calibration,
        stored.session,
        stored.evidence,
        stored.note,
        stored.review,
    )
    assert (tmp_path / "again.html").read_bytes() == (outputs / "report.html").read_bytes()


def test_views_lead_to_the_recording_and_back(sample, outputs):
    page = (outputs / "report.html").read_text(encoding="utf-8")
    worst = worst_view(sample.calibration.views, sample.calibration.rms)
    assert f"visioncal show '{outputs}' --viewer --view {worst}" in unescape(page)
    for view in sample.calibration.views:
        anchor = f"view-{view.view}"
        assert f'id="{anchor}"' in page
        assert f"(report.html#{anchor})" in view_markdown(view)
    # Where there is no recording, nothing leads to it.
    assert "--viewer" not in render(sample.calibration, None, ())


def test_report_without_its_recording_says_so(outputs, tmp_path):
    shutil.copy(outputs / "calibration.json", tmp_path)
    stored = load_stored(tmp_path)
    assert "no recording.rrd" in stored.note
    (tmp_path / "recording.rrd").write_bytes(b"damaged")
    assert str(tmp_path / "recording.rrd") in load_stored(tmp_path).note
    page = Page(render(stored.calibration, stored.session, stored.evidence, stored.note))
    assert stored.note in page.words
    assert "position [mm]" in page.text
    assert "Pictures" not in page.words.replace(stored.note, "")


def test_recording_of_another_result_is_not_mixed_in(sample, outputs, tmp_path):
    shutil.copy(outputs / "recording.rrd", tmp_path)
    replace(sample.calibration, created="2026-11-21T00:00:00+00:00").save(
        tmp_path / "calibration.json"
    )
    stored = load_stored(tmp_path)
    assert "holds another one" in stored.note
    assert stored.session is None


def test_session_alone_has_no_report(sample, tmp_path):
    write_recording(tmp_path / "session.rrd", sample.session, None, (), None)
    with pytest.raises(DataError, match="without a result"):
        load_stored(tmp_path / "session.rrd")


def test_names_and_reasons_are_text(sample, html):
    page = Page(html)
    assert sample.session.name in page.words
    assert REJECTED[6] in page.words
    assert not {"b", "its", "1", "script"} & set(page.tags)
    assert "<b>robot moved" not in html


def test_nothing_is_loaded_from_elsewhere(html):
    for reference in Page(html).references:
        assert reference.startswith(("#", "data:image/")), reference
    assert not re.search(r"url\((?!#)", html)
    assert "@import" not in html


def test_identifiers_of_figures_stay_apart(html):
    identifiers = re.findall(r'\bid="([^"]+)"', html)
    assert len(identifiers) == len(set(identifiers))
    assert {value.removeprefix("#") for value in re.findall(r'xlink:href="(#[^"]+)"', html)} <= set(
        identifiers
    )


def test_pictures_show_the_best_the_worst_and_the_rejected(sample, html):
    words = Page(html).words
    used = [view for view in sample.calibration.views if view.used and view.rms_px is not None]
    best, worst = min(used, key=lambda item: item.rms_px), max(used, key=lambda item: item.rms_px)
    assert f"Best used view: {best.view}," in words
    assert f"Worst used view: {worst.view}," in words
    assert re.search(r"drawn \d+ times longer", words)
    uris = re.findall(r'href="data:image/jpeg;base64,([^"]+)"', html)
    assert len(uris) == 2 + len(REJECTED)
    for uri in uris:
        jpeg = np.frombuffer(base64.b64decode(uri), np.uint8)
        assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR) is not None


def test_spoilt_images_do_not_spoil_the_report(sample):
    files = {view.image: b"no image" for view in sample.session.views[:5]}
    files[sample.session.views[5].image] = b""
    session = replace(sample.session, images=MemoryImages(files))
    html = render(sample.calibration, session, sample.evidence)
    assert "data:image/jpeg" not in html
    assert REJECTED[3] in Page(html).words


def test_pictures_lie_as_their_pixels_are_stored():
    jpeg = cv2.imencode(".jpg", np.zeros((40, 64), np.uint8))[1].tobytes()
    # Exif, big-endian: one entry, the orientation (0x0112), which says "turned by 90 degrees".
    entry = bytes.fromhex("0112 0003 00000001 0006 0000")
    exif = b"Exif\0\0MM\0*" + bytes.fromhex("00000008 0001") + entry + bytes(4)
    turned = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    shown = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape[:2] == (64, 40), "the tag is not read: this test tests nothing"
    picture = thumbnail(decode_image(turned, colour=True), None, "", 0, 1)
    assert (picture.width, picture.height) == (64, 40)


@pytest.mark.parametrize("size", [(65_000, 1), (1, 70_000), (20_000, 3)])
def test_pictures_of_one_row_are_drawn(size):
    """Reduced by their width they have no row left, and a JPEG has a longest side."""
    width, height = size
    picture = thumbnail(np.full((height, width, 3), 200, np.uint8), None, "", 0, 1)
    assert (picture.width, picture.height) == size
    assert picture.jpeg_uri.startswith("data:image/jpeg;base64,/9j/")


def test_many_corners_are_thinned():
    many = made_up(90, images=True)
    html = render(many.calibration, None, many.evidence)
    # 88 views of 40 corners; the other charts have a dot a view.
    assert 1500 < html.count("h0") < 3300


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0996, "0.10"),
        (0.3349, "0.33"),
        (96.4, "96"),
        (1234.5, "1234"),
        (0.0, "0"),
        (2e-9, "<0.0001"),
        (None, "\N{EN DASH}"),
        (float("inf"), "inf"),
    ],
)
def test_significant_digits(value, text):
    assert significant(value) == text

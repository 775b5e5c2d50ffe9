"""The certificate, and whether a result comes out again of its recording."""

from dataclasses import replace

import pypdfium2
import pytest
from support import browser
from support.commands import visioncal
from support.fuzz.broken_sessions import sound_session
from support.pages import Page
from support.samples import made_up
from support.whole_cells import OPTIONS, recorded

import visioncal as package
from visioncal.interchange.result_files import load_stored
from visioncal.present.report.page import write_certificate
from visioncal.simulation import simulate


def test_a_certificate_says_whose_it_is_and_has_room_to_sign(tmp_path):
    sample = made_up()
    page = tmp_path / "certificate.html"
    signed = {"operator": "A. Smith <1>", "serial number, camera": "18443010"}
    write_certificate(page, sample.calibration, sample.session, signed)
    words = Page(page.read_text("utf-8")).words
    for name in (
        "bench <1> & 2",
        "Check before use",
        "serial number, camera 18443010",
        "operator A. Smith <1>",
        "board charuco_9x6_30mm 9 x 6, 30 mm",
        "flange_from_cam (31.000, -12.000, 81.000) mm",
        sample.calibration.session_sha256,
        "Calibrated by, date",
    ):
        assert name in words
    # It is one page, however many views there are: they are counted, not listed.
    many = replace(sample.calibration, views=sample.calibration.views * 50)
    write_certificate(page, many, None, {})
    assert abs(len(Page(page.read_text("utf-8")).words) - len(words)) < 200


@pytest.mark.slow
def test_the_certificate_of_a_whole_cell_names_all_that_is_in_it(tmp_path):
    session = recorded(simulate(replace(OPTIONS, stops=10)))
    page = tmp_path / "certificate.html"
    write_certificate(page, package.calibrate(session), session, {})
    words = Page(page.read_text("utf-8")).words
    for name in (
        "robot model of a ur5e",
        "robot model of b ur5e",
        "cam_left",
        "cam_hand",
        "board of",
    ):
        assert name in words
    assert "mount" not in words


@pytest.mark.skipif(browser.CHROMIUM is None, reason="Chromium is not installed here")
def test_it_prints_on_one_page(tmp_path):
    sample = made_up()
    page = tmp_path / "certificate.html"
    write_certificate(
        page,
        sample.calibration,
        sample.session,
        {"operator": "A. Smith", "serial number, camera": "1"},
    )
    with browser.chromium(tmp_path / "profile") as chromium:
        chromium.visit(page.as_uri())
        (printed,) = pypdfium2.PdfDocument(chromium.printed())
    # A4, in points of 1/72 inch; a browser rounds to a pixel of 3/4 point.
    assert printed.get_size() == pytest.approx((595.3, 841.9), abs=1.0)
    words = printed.get_textpage().get_text_range()
    assert "Checked by, date" in words


def test_a_result_comes_out_again_of_its_recording(tmp_path):
    session = sound_session(tmp_path / "session")
    out = tmp_path / "out"
    assert visioncal("calibrate", session, "-o", out).status == 0
    page = tmp_path / "certificate.html"
    done = visioncal("show", out, "--certificate", "--serial", "robot=7", "-o", page)
    assert done.status == 0
    assert "serial number, robot 7" in Page(page.read_text("utf-8")).words
    assert visioncal("show", out, "--operator", "me").status == 2
    assert visioncal("show", out, "--certificate", "--serial", "7").status == 2
    assert load_stored(out).session is not None

"""Reports and certificates: complete, self-contained, safe against what sessions may be called."""

import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from html import unescape

import cv2
import numpy as np
import pypdfium2
import pytest
from markdown_it import MarkdownIt
from support import browser
from support import whole_cells as two_arms
from support.arm_documents import calibrated
from support.cells import pairs_session
from support.commands import visioncal
from support.findings import with_contradiction, with_findings
from support.marks import slow
from support.pages import Page, section
from support.samples import REJECTED, made_up

from visioncal.calibration.run import Run, run
from visioncal.interchange.outputs import write_outputs
from visioncal.interchange.result_files import load_stored
from visioncal.present.advice import suspects
from visioncal.present.recording.notes import verdict_markdown, view_markdown
from visioncal.present.report.cell_picture import cell_picture
from visioncal.present.report.page import render, write_certificate, write_report
from visioncal.present.report.thumbnails import thumbnail
from visioncal.results import Calibration
from visioncal.results.history import entries_of
from visioncal.results.views import worst_view
from visioncal.session import MemoryImages
from visioncal.simulation import CellOptions, cell_session, simulate, write_session
from visioncal.vision.boards.imaging import decode_image


@pytest.fixture(scope="module")
def sample():
    return made_up()


@pytest.fixture(scope="module")
def html(sample):
    return render(sample.calibration, sample.session, sample.evidence)


def test_views_that_contradict_the_others_are_set_apart(sample):
    html = render(with_contradiction(sample), sample.session, sample.evidence)
    page = Page(html)
    # Its picture shows how far off it is.
    assert html[html.index("View 6:") - 2000 : html.index("View 6:")].count("<path d=") > 10
    # Residuals far beyond the others' are clipped, and say how far they reach.
    assert " 14 " in section(page, "Residuals by view", "Residuals over joint angles")


@pytest.mark.slow
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


def test_notes_show_commands_as_they_are_typed(tmp_path):
    """Back-ticks in a path neither end the code span of a command nor run in the shell."""
    session = tmp_path / "a`b`` ![x](y)"
    write_session(simulate(CellOptions(views=12)), session, images=False)
    visioncal("calibrate", session, "-o", tmp_path / "`out").good()
    calibration = Calibration.load(tmp_path / "`out")
    commands = [step.command for step in calibration.next_steps if step.command]
    shown = re.findall(r"<code>(.*?)</code>", MarkdownIt().render(verdict_markdown(calibration)))
    assert [unescape(command) for command in shown] == commands
    assert str(session) in commands[0] or str(tmp_path / "`out") in commands[0]


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


def test_nothing_is_loaded_from_elsewhere(html):
    for reference in Page(html).references:
        assert reference.startswith(("#", "data:image/")), reference
    assert not re.search(r"url\((?!#)", html)
    assert "@import" not in html


def test_figures_are_drawn_and_their_identifiers_stay_apart(sample):
    arm = with_findings(sample, {"kinematics": calibrated()})
    html = render(arm, sample.session, sample.evidence)
    assert html.count('<svg role="img"') > 2
    identifiers = re.findall(r'\bid="([^"]+)"', html)
    assert len(identifiers) == len(set(identifiers))
    assert {value.removeprefix("#") for value in re.findall(r'xlink:href="(#[^"]+)"', html)} <= set(
        identifiers
    )


@pytest.mark.parametrize("mount", ["eye-in-hand", slow("eye-to-hand"), slow("two arms")])
def test_the_cell_is_pictured_with_each_place_of_camera_and_board(mount):
    options = two_arms.OPTIONS if mount == "two arms" else CellOptions(views=10, mount=mount)
    session = cell_session(simulate(options), "cell", seen="corners")
    found = run(session)
    picture = str(cell_picture(found.calibration, session, found.evidence))
    frames = {*found.calibration.tree.last} - {*found.calibration.tree.flanges} - {"cell"}
    assert {*re.findall("<text[^>]*>([^<]*)</text>", picture)} == frames
    # What moves is drawn in each view, what stands still once, and each arm once.
    lines = Counter(re.findall(r'stroke="var\(--(\w+)\)"', picture))
    if mount == "two arms":
        assert lines["muted"] == 2
    else:
        moves, stands = ("accent", "good") if mount == "eye-in-hand" else ("good", "accent")
        assert lines == {moves: 10, stands: 1, "muted": 1}


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


def test_a_certificate_says_whose_it_is_and_prints_on_one_page_with_room_to_sign(sample, tmp_path):
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
    if browser.CHROMIUM is not None:
        browser.printed(page, tmp_path / "page.pdf")
        (printed,) = pypdfium2.PdfDocument((tmp_path / "page.pdf").read_bytes())
        # A4, in points of 1/72 inch; a browser rounds to a pixel of 3/4 point.
        assert printed.get_size() == pytest.approx((595.3, 841.9), abs=1.0)
        assert "Checked by, date" in printed.get_textpage().get_text_range()
    # However many views there are, they are counted, not listed.
    many = replace(sample.calibration, views=sample.calibration.views * 50)
    write_certificate(page, many, None, {})
    assert abs(len(Page(page.read_text("utf-8")).words) - len(words)) < 200


def test_the_command_writes_a_certificate_of_a_recording(outputs, tmp_path):
    page = tmp_path / "certificate.html"
    visioncal("show", outputs, "--certificate", "--serial", "robot=7", "-o", page).good()
    certificate = outputs / "certificate.html"
    assert f"wrote {certificate}" in visioncal("show", outputs, "--certificate").err
    certificate.unlink()
    assert "serial number, robot 7" in Page(page.read_text("utf-8")).words
    assert visioncal("show", outputs, "--operator", "me").status == 2
    assert visioncal("show", outputs, "--certificate", "--serial", "7").status == 2


@pytest.mark.slow
def test_nothing_that_leaves_states_an_accuracy_where_no_fit_explains_the_views(tmp_path):
    """Console, report, certificate, card, JSON, notes and exports of a bad result."""
    cell, rng = simulate(CellOptions(views=12)), np.random.default_rng(1)
    seen = cell.cam_from_target.copy()
    # Thirty millimetres per axis: no arm repeats so, whatever else is wrong.
    seen[:, :3, 3] += 0.03 * rng.standard_normal((12, 3))
    pairs_session("eye-in-hand", cell.robot.base_from_flange, seen).save(tmp_path / "session")
    out, page = tmp_path / "out", tmp_path / "certificate.html"
    done = visioncal("calibrate", tmp_path / "session", "-o", out)
    assert done.status == 3
    certified = visioncal("show", out, "--certificate", "-o", page)
    assert certified.status == 0
    calibration = Calibration.load(out)
    exported = visioncal("export", out, "--to", "text", "--force").good().out
    pages = [(file.read_text()) for file in (out / "report.html", page)]
    said = {
        "console": done.out, "report": pages[0], "certificate": pages[1], "card": repr(calibration),
        "notebook": calibration._repr_html_(), "notes": verdict_markdown(calibration),
        "export": exported, "reasons": " ".join(calibration.verdict.reasons),
    }  # fmt: skip
    stated = re.compile(
        r"good for|repeats better|Picks err|sigma [\d.]+ mm|± ?\d|&plusmn; ?\d|95 % of"
    )
    for where, text in said.items():
        assert not stated.search(text), where
    for where in ("console", "card", "notes", "certificate", "export"):
        assert "its accuracy is unknown" in said[where], where
    document = json.loads((out / "calibration.json").read_text())
    assert "good_for_mm" not in document["verdict"]
    assert {"unexplained", "no_accuracy"} <= {it["kind"] for it in document["verdict"]["findings"]}
    (entry,) = entries_of(calibration)
    assert entry.figures.keys().isdisjoint({"sigma_mm", "sigma_deg", "radius95_mm"})

"""The report: complete, self-contained, and safe against what sessions may be called."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from samples import REJECTED, Sample, made_up

from visioncal.calibration import Rms, Verdict, VerdictStatus
from visioncal.errors import DataError
from visioncal.report import write_report
from visioncal.report.numbers import matched, significant
from visioncal.report.page import render
from visioncal.report.thumbnails import thumbnail
from visioncal.session import MemoryImages


class Page(HTMLParser):
    """Collects text, references and elements, and checks that elements close."""

    VOID = frozenset(["meta", "link", "br", "img", "hr", "input"])

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text = ""
        self.tags: list[str] = []
        self.references: list[str] = []
        self.rows: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        assert self._open == []
        self.words = " ".join(self.text.split())

    # The names of these are the parser's.
    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.tags.append(tag)
        self.references += [
            value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "action")
        ]
        if tag == "tr":
            self.rows.append("")
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:  # noqa: D102
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:  # noqa: D102
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:  # noqa: D102
        if self._open and self._open[-1] == "style":
            return
        self.text += f" {data}"
        if "tr" in self._open:
            self.rows[-1] += f" {data}"


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made_up()


@pytest.fixture(scope="module")
def html(sample: Sample) -> str:
    return render(sample.calibration, sample.session, sample.evidence)


def test_verdict_comes_first_with_its_reasons(sample: Sample, html: str) -> None:
    words = Page(html).words
    places = [words.index("Check: usable once")]
    places += [words.index(reason) for reason in sample.calibration.verdict.reasons]
    places += [words.index(heading) for heading in ("flange_from_cam", "base_from_target")]
    places += [
        words.index(heading)
        for heading in ("How it was obtained", "Solvers compared", "All views", "Provenance")
    ]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("status", "word"), [("good", "Good:"), ("check", "Check:"), ("bad", "Bad:")]
)
def test_verdict_is_told_by_word_and_colour(
    sample: Sample, status: VerdictStatus, word: str
) -> None:
    verdict = Verdict(status, ("One reason.",))
    html = render(replace(sample.calibration, verdict=verdict), None, ())
    assert f'class="verdict {status}"' in html
    assert word in Page(html).words


def test_every_view_has_a_row(sample: Sample, html: str) -> None:
    rows = [" ".join(row.split()) for row in Page(html).rows]
    for view in sample.calibration.views:
        start = f"{view.view} {'yes' if view.used else 'no'} "
        (row,) = [row for row in rows if row.startswith(start)]
        assert view.reason in row


def test_names_and_reasons_are_text(sample: Sample, html: str) -> None:
    page = Page(html)
    assert sample.session.name in page.words
    assert REJECTED[6] in page.words
    assert not {"b", "its", "1", "script"} & set(page.tags)
    assert "<b>robot moved" not in html


def test_nothing_is_loaded_from_elsewhere(html: str) -> None:
    for reference in Page(html).references:
        assert reference.startswith(("#", "data:image/")), reference
    assert not re.search(r"url\((?!#)", html)
    assert "@import" not in html


def test_identifiers_of_figures_stay_apart(html: str) -> None:
    identifiers = re.findall(r'\bid="([^"]+)"', html)
    assert len(identifiers) == len(set(identifiers))
    assert {it.removeprefix("#") for it in re.findall(r'xlink:href="(#[^"]+)"', html)} <= set(
        identifiers
    )


def test_plots_are_named_with_units(html: str) -> None:
    text = Page(html).text
    for label in ("position [mm]", "orientation [deg]", "reprojection [px]", "image x [px]"):
        assert label in text


def test_pictures_show_the_best_the_worst_and_the_rejected(sample: Sample, html: str) -> None:
    words = Page(html).words
    used = [view for view in sample.calibration.views if view.used and view.rms_px is not None]
    best, worst = min(used, key=lambda it: it.rms_px), max(used, key=lambda it: it.rms_px)
    assert f"Best used view: {best.view}," in words
    assert f"Worst used view: {worst.view}," in words
    assert re.search(r"drawn \d+ times longer", words)
    uris = re.findall(r'href="data:image/jpeg;base64,([^"]+)"', html)
    assert len(uris) == 2 + len(REJECTED)
    for uri in uris:
        jpeg = np.frombuffer(base64.b64decode(uri), np.uint8)
        assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR) is not None


def test_figures_are_those_of_the_calibration(sample: Sample, html: str) -> None:
    words = Page(html).words
    edge = sample.calibration.edges["flange_from_cam"]
    for value in edge.transform.as_matrix().ravel():
        assert f"{value:.9f}" in words
    assert sample.calibration.session_sha256 in words
    assert f"{edge.sigma_mm:.2f} mm" in words


def test_pose_pairs_leave_out_what_does_not_apply() -> None:
    sample = made_up(images=False)
    page = Page(render(sample.calibration, sample.session, sample.evidence))
    for absent in ("camera matrix", "reprojection", "image x [px]", "Pictures", "data:image"):
        assert absent not in page.text
    assert "position [mm]" in page.text


def test_spoilt_images_do_not_spoil_the_report(sample: Sample) -> None:
    files = {view.image: b"no image" for view in sample.session.views[:5]}
    files[sample.session.views[5].image] = b""
    session = replace(sample.session, images=MemoryImages(files))
    html = render(sample.calibration, session, sample.evidence)
    assert "data:image/jpeg" not in html
    assert REJECTED[3] in Page(html).words


def test_pictures_lie_as_their_pixels_are_stored() -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((40, 64), np.uint8))[1].tobytes()
    # Exif, big-endian: one entry, the orientation (0x0112), which says "turned by 90 degrees".
    entry = bytes.fromhex("0112 0003 00000001 0006 0000")
    exif = b"Exif\0\0MM\0*" + bytes.fromhex("00000008 0001") + entry + bytes(4)
    turned = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    shown = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape[:2] == (64, 40), "the tag is not read: this test tests nothing"
    picture = thumbnail(turned, None, "", 0, 1)
    assert picture is not None
    assert (picture.width, picture.height) == (64, 40)


def test_one_used_view_and_no_residuals_still_give_a_report(sample: Sample) -> None:
    views = tuple(
        replace(view, residual_mm=0.0, residual_deg=None, rms_px=None)
        for view in sample.calibration.views[:1]
    )
    poor = replace(sample.calibration, views=views, rms=Rms(0.0, 0.0), solvers={})
    page = Page(render(poor, sample.session, sample.evidence))
    assert "1 of 1" in page.words
    assert "Solvers compared" not in page.words


def test_many_corners_become_a_bitmap() -> None:
    many = made_up(90, images=True)
    html = render(many.calibration, None, many.evidence)
    # As vectors, 88 views of 40 corners would be 3520 uses of a mark.
    assert html.count("<use") < 2500
    # One bitmap of corners, one of the colour bar.
    assert html.count('href="data:image/png') == 2


def test_report_is_whole_or_absent(sample: Sample, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(path, sample.calibration, sample.session, sample.evidence)
    assert path.read_text(encoding="utf-8").endswith("</html>")
    assert [it.name for it in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(DataError, match="cannot be written"):
        write_report(tmp_path / "absent" / "report.html", sample.calibration, None, ())


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (12.3456, 0.1, "12.35"),
        (12.3456, 0.0996, "12.35"),
        (12.3456, 0.0094, "12.3456"),
        (1234.5, 30.0, "1234"),
        (-0.004, 1.0, "0.0"),
        (1.0, 0.0, "1.000000"),
        (1.0, float("nan"), "1.000000"),
    ],
)
def test_value_has_the_digits_of_its_sigma(value: float, sigma: float, text: str) -> None:
    assert matched(value, sigma) == text


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
def test_significant_digits(value: float | None, text: str) -> None:
    assert significant(value) == text

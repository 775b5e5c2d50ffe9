"""Printed boards: their size on paper, what is beside them, and the files that are written."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.boards import MM_PER_INCH, any_page, charuco, checkerboard, printed, raster
from support.commands import visioncal
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.core.types import Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards import DetectedCorners, find_target
from visioncal.vision.printing.drawing import to_png, to_svg
from visioncal.vision.printing.page import EDGE_MM, arrange, pages_named, requested_target
from visioncal.vision.printing.pattern import draw_pattern
from visioncal.vision.targets import corner_positions, load_target, target_names

TARGETS = Path(__file__).parents[2] / "targets"
# Least squares over all corners leave 0.03 % of the finder's errors on a marker's four; the rest of
# a thousandth is what may be wrong with the print.
SCALE_TOLERANCE = 1e-3

ODD = {
    "legacy": charuco(8, 6, "DICT_APRILTAG_36h11", legacy=True),
    "legacy, small": charuco(5, 4, legacy=True),
    "least": charuco(3, 3, square_m=0.05, marker_m=0.035),
    "A3": charuco(14, 9, square_m=0.028, marker_m=0.021),
    "symmetric": checkerboard(8, 6),
    "portrait": checkerboard(6, 9),
    "marker": Target("tag", "marker", 1, 1, 0.048, 1e-5, dictionary="DICT_7X7_50", marker_id=5),
}
BOARDS = {name: load_target(name) for name in target_names()} | ODD


def scales(image, target, size_mm):
    """How many corners are found, and their scale along x and y over the page's."""
    seen = find_target(image, target)
    assert isinstance(seen, DetectedCorners), seen
    # A renderer rounds the page to whole pixels, and stretches what is on it as much.
    px_per_mm = np.array(image.shape[::-1]) / np.array(size_mm)
    places_mm = 1e3 * corner_positions(target)[seen.ids, :2]
    affine = np.linalg.lstsq(
        np.column_stack([places_mm, np.ones(len(places_mm))]), seen.px / px_per_mm, rcond=None
    )[0]
    # A board that looks the same upside down may be numbered from its other end.
    return len(seen.ids), np.abs(np.diag(affine[:2]))


@pytest.mark.parametrize("target", BOARDS.values(), ids=BOARDS)
def test_a_pdf_has_the_size_that_is_asked_for(target):
    page = any_page(target).page
    # The finder of checkerboards takes seconds at 200.
    dpi = 100 if target.kind == "checkerboard" else 200
    count, scale = scales(printed(target, dpi), target, (page.width_mm, page.height_mm))
    assert count == len(corner_positions(target))
    np.testing.assert_allclose(scale, 1.0, rtol=0, atol=SCALE_TOLERANCE)


@pytest.mark.parametrize("name", ["charuco_9x6_30mm", "legacy", "symmetric"])
def test_a_png_has_the_size_that_its_resolution_says(name):
    target, dpi = BOARDS[name], 120
    data = to_png(any_page(target), dpi)
    # The chunk pHYs holds pixels a metre, as whole numbers.
    at = data.index(b"pHYs") + 4
    per_metre = int.from_bytes(data[at : at + 4], "big")
    assert abs(per_metre * MM_PER_INCH / 1000 - dpi) < 0.02
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    size_mm = np.array(image.shape[::-1]) * MM_PER_INCH / dpi
    count, scale = scales(image, target, size_mm)
    assert count == len(corner_positions(target))
    np.testing.assert_allclose(scale, 1.0, rtol=0, atol=SCALE_TOLERANCE)


@pytest.mark.parametrize("name", ["charuco_9x6_30mm", "legacy", "symmetric"])
def test_an_svg_holds_the_outlines_to_a_micrometre(name):
    sheet = any_page(BOARDS[name])
    text = to_svg(sheet).decode()
    width, height = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt" viewBox', text).groups()
    size_mm = np.array([float(width), float(height)]) * MM_PER_INCH / 72
    np.testing.assert_allclose(size_mm, [sheet.page.width_mm, sheet.page.height_mm], atol=1e-3)
    # The white page is the first path, the board the second.
    path = re.findall(r'<path d="([^"]+)"', text)[1]
    points = np.array(re.findall(r"[ML] (\S+) (\S+)", path), dtype=float) * MM_PER_INCH / 72
    loops = [np.vstack([loop, loop[:1]]) for loop in draw_pattern(sheet.target).loops]
    expected = np.array(sheet.origin_mm) + 1e3 * np.concatenate(loops)
    drawn = {tuple(value) for value in np.round(points, 3)}
    # The file's numbers end at a millionth of a point: a micrometre is rounding, here and there.
    for point in expected:
        near = {tuple(np.round(point + step, 3)) for step in (0, [0.001, 0], [0, 0.001])}
        near |= {tuple(np.round(point - step, 3)) for step in ([0.001, 0], [0, 0.001])}
        assert near & drawn, point


@pytest.mark.parametrize("name", target_names())
def test_shipped_pdfs_are_what_the_command_makes(name):
    shipped = (TARGETS / f"{name}.pdf").read_bytes()
    assert len(shipped) < 60_000
    made = printed(BOARDS[name], 100).astype(int)
    shipped_raster = raster(shipped, 100).astype(int)
    assert shipped_raster.shape == made.shape
    # Another version of the fonts' renderer may shade a letter's rim differently, nothing else.
    assert np.abs(shipped_raster - made).max() <= 8


@pytest.mark.parametrize("target", BOARDS.values(), ids=BOARDS)
def test_nothing_is_printed_where_printers_do_not_reach_or_finders_need_white(target):
    sheet = any_page(target)
    image = printed(target, 100)
    per_mm = np.array(image.shape[::-1]) / [sheet.page.width_mm, sheet.page.height_mm]
    edge = int((EDGE_MM - 0.3) * per_mm.min())
    inner = image[edge:-edge, edge:-edge]
    assert inner.min() == 0
    assert image.astype(int).sum() - inner.astype(int).sum() == 255 * (image.size - inner.size)
    left, top, right, bottom = (1e3 * side for side in sheet.pattern.box)
    quiet = 1e3 * sheet.pattern.quiet_m
    grown = np.array([[left - quiet, top - quiet], [right + quiet, bottom + quiet]])
    # A pixel on either side is shaded by the board's rim or by what lies beside the white.
    rim = np.array([[1, 1], [-1, -1]])
    low, high = np.round((grown + sheet.origin_mm) * per_mm).astype(int) + rim
    box = np.array([[left, top], [right, bottom]])
    in_low, in_high = np.round((box + sheet.origin_mm) * per_mm).astype(int) - rim
    ring = image[low[1] : high[1], low[0] : high[0]].copy()
    ring[in_low[1] - low[1] : in_high[1] - low[1], in_low[0] - low[0] : in_high[0] - low[0]] = 255
    assert ring.min() == 255


@pytest.mark.parametrize(
    "request_",
    [
        BoardRequest("charuco", 9, 6),
        BoardRequest("charuco", 7, 10, legacy=True),
        BoardRequest("checkerboard", 9, 6),
        BoardRequest("marker", marker_id=3),
    ],
    ids=str,
)
def test_a_size_left_open_is_the_largest_that_fits(request_):
    pages = pages_named("letter", None)
    target = requested_target(request_, pages)
    side_mm = round(1e3 * target.square_m)
    assert target.square_m == pytest.approx(1e-3 * side_mm, abs=1e-12)
    arrange(target, pages)
    larger = requested_target(replace(request_, square_mm=side_mm + 1), pages)
    raised(DataError, f"of {side_mm} mm, the largest that fits", arrange, larger, pages)


def run(*arguments):
    return visioncal("target", *arguments)


def test_make_writes_four_files_and_replaces_none(tmp_path):
    options = ("--kind", "charuco", "--columns", 5, "--rows", 4, "--square-mm", 30, "--dpi", 72)
    run("make", *options, "-o", tmp_path / "new").good()
    files = {path.name for path in (tmp_path / "new").iterdir()}
    assert files == {f"charuco_5x4_30mm.{word}" for word in ("pdf", "svg", "png", "toml")}
    target = load_target("charuco_5x4_30mm.toml", tmp_path / "new")
    assert (target.columns, target.rows, target.square_m) == (5, 4, 0.03)
    run("make", *options, "-o", tmp_path / "new").refused()
    assert run("make", *options, "-o", tmp_path / "new", "--force").status == 0


CHARUCO = ("--kind", "charuco", "--columns", 9, "--rows", 6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "--kind"),
        (("--kind", "marker", "--id", 1, "--square-mm", 20), "--size-mm"),
        (("charuco_9x6_30mm", "--columns", 5), "--columns would change nothing"),
        ((*CHARUCO, "--square-mm", "inf"), "--square-mm is inf"),
        (("--kind", "checkerboard", "--marker-mm", 5), "--marker-mm would change nothing"),
        (("charuco_13x8_30mm", "--page", "A4"), "does not fit on A4"),
        (("charuco_9x6_30mm", "--dpi", 1e6), "--dpi"),
        (("--kind", "marker", "--id", 1, "--name", "../tag"), "name of files"),
    ],
    ids=str,
)
def test_make_refuses_and_writes_nothing(arguments, message, tmp_path):
    run("make", *arguments, "-o", tmp_path / "out").refused(message)
    assert not (tmp_path / "out").exists()

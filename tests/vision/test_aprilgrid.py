"""AprilGrids: as Kalibr prints them, found to a hundredth of a pixel, told from other pages."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.boards import any_page, aprilgrid, printed
from support.marks import slow
from support.rendered import Shot, photograph

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.interchange.formats.intrinsics import read_target_description
from visioncal.session import Session
from visioncal.simulation import BOARDS, CellOptions, simulate, write_session
from visioncal.vision.boards import DetectedCorners, NotFound, find_target
from visioncal.vision.targets import corner_positions, target_document, target_from_document

GRID = aprilgrid(5, 3)
SHOT = Shot(square_px=50, noise=2)
# Kalibr's code of tag 0, row by row from its upper left; a set bit is light (t36h11 of its
# kalibr_create_target_pdf).
CODE_0 = 0xD5D628584


def test_the_page_is_kalibrs():
    """Tag 0 at the lower left, its code upright, and a square off each corner of each tag."""
    sheet, page = any_page(GRID), printed(GRID, 200)
    per_m = 1e3 * 200 / 25.4

    def grey(x_m, y_m):
        x, y = np.array(sheet.origin_mm) / 1e3 + [x_m, y_m]
        return int(page[int(y * per_m), int(x * per_m)])

    tag, pitch = GRID.square_m, 1.3 * GRID.square_m
    top = 2 * pitch
    for number in range(36):
        row, column = divmod(number, 6)
        light = CODE_0 >> (35 - number) & 1
        assert (grey((column + 2.5) * tag / 10, top + (row + 2.5) * tag / 10) > 128) == light
    for x in range(6):
        for y in range(4):
            assert grey(x * pitch - 0.15 * tag, y * pitch - 0.15 * tag) < 50
    assert grey(1.15 * tag, 0.5 * tag) > 200


def test_corners_are_numbered_by_their_tags():
    places = corner_positions(GRID) / GRID.square_m
    assert len(places) == 4 * 15
    np.testing.assert_allclose(places[0], [0.0, 2.6, 0.0])
    np.testing.assert_allclose(places[4 * 14 + 1], [6.2, 0.0, 0.0])
    assert target_from_document(target_document(GRID), "board") == GRID


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"spacing": 30}, "spacing is 30.0; a share of size_m, such as 0.3, is needed"),
        ({"border": 3}, "border is 3; a whole number from 1 to 2"),
        ({"columns": 30, "rows": 20}, "has 587 tags; 30 x 20 tags from id 0 on need 600"),
    ],
)
def test_a_wrong_field_is_named(change, words):
    with pytest.raises(DataError, match=words):
        target_from_document(target_document(GRID) | change, "mine")


# Errors are rms of a coordinate [px]; the template's own noise is half of what is allowed.
@pytest.mark.parametrize(
    ("shot", "most_px"),
    [
        slow(SHOT, 0.01),
        slow(replace(SHOT, square_px=25), 0.015),
        (replace(SHOT, disc_px=2), 0.015),
        (replace(SHOT, tilt_deg=60), 0.015),
        slow(replace(SHOT, gamma=0.45, bend=0.1), 0.015),
        (replace(SHOT, bayer=True), 0.03),
    ],
)
def test_corners_are_as_exact_as_the_image(shot, most_px):
    image, truth = photograph(GRID, shot, 1)
    seen = find_target(image, GRID)
    assert isinstance(seen, DetectedCorners), seen
    assert len(seen.ids) > 50
    error = seen.px - truth[seen.ids]
    assert np.sqrt(np.mean(error**2)) < most_px
    # Nothing that all corners share: their mean is as good as their number allows.
    assert np.abs(error.mean(axis=0)).max() < 4 * most_px / np.sqrt(len(error))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"columns": 6}, "do not lie as the target describes"),
        ({"rows": 2}, "the grid has tag 1[0-4] besides the target's 5 x 2"),
        ({"spacing": 0.25}, "are 0.30 of their side apart, and the target says spacing = 0.25"),
        slow({"border": 1}, "have a border of 2 modules, and the target says border = 1"),
        ({"marker_id": 30}, r"most tags seen \(0, 1, 2, 3, 4\) are none of the target's"),
    ],
)
def test_another_page_is_named(change, words):
    image = np.pad(photograph(GRID, SHOT, 2)[0], 60, constant_values=210)
    found = find_target(image, replace(GRID, **change))
    assert isinstance(found, NotFound)
    assert found.misfit
    assert re.search(words, found.reason), found.reason


@pytest.mark.parametrize("mount", ["eye-in-hand", slow("eye-to-hand")])
def test_a_cell_is_calibrated_with_it(tmp_path, mount):
    cell = simulate(CellOptions(target=BOARDS["aprilgrid"], views=12, mount=mount, seed=4))
    write_session(cell, tmp_path / "s")
    result = run(Session.load(tmp_path / "s")).calibration
    assert result.verdict.status == "good"
    error = np.concatenate(
        [log(invert(result.edges[name].matrix) @ true) for name, true in cell.transforms.items()]
    )
    # Twelve values, to one case in a thousand.
    assert error @ np.linalg.solve(result.joint_covariance, error) < 32.9


@pytest.mark.slow
def test_a_grid_without_squares_is_to_be_described_as_free_tags(tmp_path):
    side, pitch = 0.03, 0.04
    tags = [(5 + 4 * row + column, column, 3 - row) for row in range(4) for column in range(4)]
    around = side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    points = np.concatenate([pitch * np.array(tag[1:]) + around for tag in tags])
    board = replace(
        BOARDS["tags"],
        points_m=tuple((x, y, 0.0) for x, y in points.tolist()),
        point_numbers=tuple(range(len(points))),
        point_sigmas_m=(),
        point_tags=tuple((tag[0], corner) for tag in tags for corner in range(4)),
    )
    write_session(simulate(CellOptions(target=board, views=4)), tmp_path / "s")
    path = tmp_path / "s" / "target.toml"
    as_printed = path.read_text()
    path.write_text(
        'kind = "aprilgrid"\ncolumns = 4\nrows = 4\nsize_m = 0.03\nspacing = 0.3333\nid = 5\n'
        f'border = 1\ndictionary = "{board.dictionary}"\n'
    )
    with pytest.raises(DataError, match="lack the small dark squares") as caught:
        run(Session.load(tmp_path / "s"))
    assert "marker" not in caught.value.message
    assert "a target of kind points" in caught.value.message
    # What is advised is how such a board is described.
    assert all(
        name in as_printed for name in ('kind = "points"', f'dictionary = "{board.dictionary}"')
    )


def test_the_grid_of_a_kalibr_target_in_one_word():
    expected = {"kind": "aprilgrid", "columns": 6, "rows": 5, "size_m": 0.088, "spacing": 0.3}
    assert read_target_description("aprilgrid_6x5_88mm_0.3") == expected

"""Targets: their files, their corners as OpenCV and the print put them, their pictures."""

from typing import Any

import cv2
import numpy as np
import pytest
from support.boards import charuco, checkerboard
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.present.recording.board import picture
from visioncal.simulation.textures import draw_sheet
from visioncal.vision.boards import NotFound
from visioncal.vision.boards.charuco import CHARUCO, charuco_board
from visioncal.vision.boards.kind import DEFAULT_RELATIVE_SIGMA
from visioncal.vision.printing.pattern import draw_pattern
from visioncal.vision.targets import (
    corner_positions,
    load_target,
    read_target,
    rotation_transforms,
    rotations,
    target_document,
    target_from_document,
    target_names,
)

CHARUCO_TABLE: dict[str, Any] = {
    "kind": "charuco",
    "columns": 9,
    "rows": 6,
    "square_m": 0.03,
    "square_sigma_m": 1e-5,
    "marker_m": 0.022,
    "dictionary": "DICT_5X5_100",
}
MARKER: dict[str, Any] = {
    "kind": "marker",
    "id": 7,
    "size_m": 0.1,
    "dictionary": "DICT_APRILTAG_36h11",
}


@pytest.mark.parametrize("name", target_names())
def test_shipped_targets_load_and_round_trip(name, tmp_path):
    target, document = read_target(name, tmp_path)
    assert target.name == name
    assert target_from_document(target_document(target), name) == target
    assert target_from_document(document, name) == target


def test_a_path_is_relative_to_the_folder_that_names_it(tmp_path):
    (tmp_path / "boards").mkdir()
    (tmp_path / "boards" / "my board.toml").write_text(
        '\ufeffkind = "checkerboard"\ncolumns = 4\nrows = 3\nsquare_m = 0.05\n', encoding="utf-8"
    )
    target = load_target("boards\\my board.toml", tmp_path)
    assert (target.name, target.columns) == ("my board", 4)
    assert target.square_sigma_m == DEFAULT_RELATIVE_SIGMA * 0.05


def test_an_unknown_name_lists_the_names_and_a_near_one():
    caught = raised(DataError, "checkerboard_9x6_25mm", load_target, "charuco_9x6", None)
    assert "Did you mean charuco_9x6_30mm" in caught.message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "chess"}, "kind is 'chess'; \"charuco\" or"),
        ({"columns": 2}, "columns is 2; a whole number from 3 to 100"),
        ({"square_sigma_m": 1e-300}, "is 1e-300; a standard deviation from 1e-08 m"),
        ({"square_sigma_m": 0.04}, r"is 0\.04; .* to the square's own 0\.03 m"),
        ({"marker_m": 0.03}, r"marker_m is 0\.03; less than square_m = 0\.03"),
        ({"dictionary": "DICT_5X5_10"}, "dictionary is 'DICT_5X5_10', which OpenCV does not"),
        ({"columns": 20, "rows": 11}, "has 100 markers; a board of 20 x 11 squares needs 110"),
    ],
)
def test_a_wrong_field_is_named_with_what_it_must_be(change, words):
    raised(DataError, words, target_from_document, CHARUCO_TABLE | change, "mine")


@pytest.mark.parametrize("change", [{"marker_m": 22.0}, {"marker_m": 0.866}, {"square_m": 0.75}])
def test_a_side_in_another_unit_is_refused(change):
    raised(DataError, "in the same unit", target_from_document, CHARUCO_TABLE | change, "mine")


def test_a_marker_needs_an_id_of_its_dictionary():
    assert target_from_document(MARKER, "tag").marker_id == 7
    with pytest.raises(DataError, match="id is 587; a whole number from 0 to 586"):
        target_from_document(MARKER | {"id": 587}, "tag")


@pytest.mark.parametrize(("columns", "rows", "legacy"), [(9, 6, False), (9, 6, True), (5, 7, True)])
def test_charuco_corners_are_opencvs(columns, rows, legacy):
    document = CHARUCO_TABLE | {"columns": columns, "rows": rows, "legacy": legacy}
    target = target_from_document(document, "b")
    board = charuco_board(target)
    # OpenCV keeps single precision: 1e-7 of the board's size.
    np.testing.assert_allclose(corner_positions(target), board.getChessboardCorners(), atol=1e-7)
    assert board.getLegacyPattern() is legacy
    # Markers break every symmetry.
    assert len(rotations(target)) == 1


def test_marker_corners_are_in_opencvs_order_around_the_centre():
    target = target_from_document(MARKER, "tag")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    page = np.full((400, 400), 255, np.uint8)
    page[100:300, 100:300] = cv2.aruco.generateImageMarker(dictionary, 7, 200)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(page)
    assert ids.ravel().tolist() == [7]
    seen = corners[0].reshape(4, 2)
    expected = corner_positions(target)[:, :2] / target.square_m * 200 + 199.5
    # Without refinement the detector's corners are whole pixels.
    np.testing.assert_allclose(seen, expected, atol=1.0)


@pytest.mark.parametrize(
    ("columns", "rows"), [(9, 6), (8, 6), (7, 5), (5, 5), (6, 6), (4, 4), (3, 4), (3, 3)]
)
def test_rotations_are_those_that_leave_the_printed_page_as_it_is(columns, rows):
    target = checkerboard(columns, rows)
    page = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2
    turns = [k for k in range(4) if np.array_equal(np.rot90(page, k), page)]
    assert len(rotations(target)) == len(turns)

    # A colour is looked up at each square's centre, before and after the turn.
    centres = np.stack([*np.mgrid[0 : columns + 1, 0 : rows + 1]], axis=-1).reshape(-1, 2) - 0.5
    for turn in rotation_transforms(target):
        moved = centres * target.square_m @ turn[:2, :2].T + turn[:2, 3]
        there = np.rint(moved / target.square_m + 0.5).astype(int)
        here = np.rint(centres + 0.5).astype(int)
        assert np.array_equal(page[there[:, 1], there[:, 0]], page[here[:, 1], here[:, 0]])
        assert np.linalg.det(turn[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(("columns", "rows"), [(8, 6), (6, 6), (5, 5)])
def test_permutations_belong_to_their_transforms(columns, rows):
    target = checkerboard(columns, rows)
    positions = corner_positions(target)
    pairs = list(zip(rotations(target), rotation_transforms(target), strict=True))
    assert np.array_equal(pairs[0][0], np.arange(columns * rows))
    for permutation, turn in pairs:
        assert sorted(permutation) == list(range(columns * rows))
        turned = positions @ turn[:3, :3].T + turn[:3, 3]
        # Exact but for the rounding of one product and one sum.
        np.testing.assert_allclose(positions[permutation], turned, atol=1e-15)


DICTIONARIES = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


def test_two_copies_of_a_charuco_board_in_an_image_are_named():
    target = charuco(9, 6, square_m=0.025, marker_m=0.018)
    drawn = cv2.resize(picture(target), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    page = np.pad(drawn, 60, constant_values=255)
    seen = CHARUCO.search(np.hstack([page, page]), target)
    assert isinstance(seen, NotFound)
    assert (
        seen.reason == "markers are seen twice: another board with the same markers is in the image"
    )


@pytest.mark.parametrize("name", DICTIONARIES)
def test_any_share_of_the_square_is_drawn_with_any_dictionary(name):
    rng = np.random.default_rng(DICTIONARIES.index(name))
    count = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
    for share in (0.11, 0.35, 0.83, 0.999):
        columns, rows = (int(side) for side in rng.integers(3, 31, 2))
        columns, rows = (columns, rows) if columns * rows // 2 <= count else (3, 3)
        document = {"columns": columns, "rows": rows, "dictionary": name, "legacy": columns % 2 > 0}
        document |= {"marker_m": share * CHARUCO_TABLE["square_m"]}
        target = target_from_document(CHARUCO_TABLE | document, "drawn")
        drawn = picture(target)
        assert drawn.shape[1] * target.rows == drawn.shape[0] * target.columns
        # Half of the squares are dark, or one more; a marker adds no more than its share.
        assert 0.4 < 1.0 - drawn.mean() / 255.0 < 0.6 + 0.5 * share**2
        assert len(draw_pattern(target).loops) > target.columns * target.rows // 2
        # As coarsely as a board far from a camera is drawn.
        assert draw_sheet(target, 16).levels[0].any()

"""Pictures of boards, as reports and recordings show them: any board that may be declared."""

import cv2
import numpy as np
import pytest
from support.boards import charuco

from visioncal.core.types import Target
from visioncal.present.recording.board import picture
from visioncal.simulation.textures import draw_sheet
from visioncal.vision.boards import NotFound
from visioncal.vision.boards.charuco import CHARUCO
from visioncal.vision.boards.kind import marker_cells
from visioncal.vision.printing.pattern import draw_pattern
from visioncal.vision.targets import corner_positions, target_from_document

DICTIONARIES = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


@pytest.mark.parametrize(
    "target",
    [
        charuco(9, 6, square_m=0.025, marker_m=0.018),
        charuco(9, 6, square_m=0.025, marker_m=0.018, legacy=True),
        charuco(5, 14, "DICT_APRILTAG_36h11", square_m=0.04, marker_m=0.029, legacy=True),
        charuco(30, 3, "DICT_4X4_50", square_m=0.005, marker_m=0.0037),
    ],
)
def test_a_charuco_board_is_found_in_its_picture(target):
    drawn, zoom, rim = picture(target), 2, 60
    page = cv2.resize(drawn, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    page = np.pad(page, rim, constant_values=255)
    seen = CHARUCO.search(page, target)
    square_px = zoom * drawn.shape[1] / target.columns
    expected = corner_positions(target)[:, :2] / target.square_m * square_px + rim - 0.5
    assert list(seen.ids) == list(range(len(expected)))
    # The detector is good to a few tenths of a pixel on a page without blur.
    np.testing.assert_allclose(seen.px, expected, atol=0.6)


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
        columns = int(rng.integers(3, 31))
        rows = min(int(rng.integers(3, 31)), 2 * count // columns)
        square_m = float(rng.uniform(0.005, 0.1))
        document = {
            "kind": "charuco",
            "columns": columns,
            "rows": max(rows, 3),
            "square_m": square_m,
            "marker_m": share * square_m,
            "dictionary": name,
            "legacy": bool(rng.integers(2)),
        }
        if columns * max(rows, 3) // 2 > count:
            document["columns"], document["rows"] = 3, 3
        target = target_from_document(document, "drawn")
        drawn = picture(target)
        height, width = drawn.shape
        assert width * target.rows == height * target.columns
        # Half of the squares are dark, or one more; a marker adds no more than its share.
        dark = 1.0 - drawn.mean() / 255.0
        assert 0.4 < dark < 0.6 + 0.5 * share**2
        assert len(draw_pattern(target).loops) > target.columns * target.rows // 2
        # As coarsely as a board far from a camera is drawn.
        assert draw_sheet(target, 16).levels[0].any()


def test_a_marker_is_drawn_by_its_bits():
    target = Target("tag", "marker", 1, 1, 0.1, 1e-4, dictionary="DICT_7X7_50", marker_id=3)
    drawn, dictionary = picture(target), cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_7X7_50)
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(
        np.pad(drawn, 40, constant_values=255)
    )
    assert ids.ravel().tolist() == [3]
    assert marker_cells("DICT_7X7_50", 3).shape == (9, 9)

"""Targets: their files, corners and turns; AprilGrids, circles and dots as by their makers."""

import re
import tomllib
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
from support.boards import any_page, aprilgrid, charuco, checkerboard, circles, printed
from support.commands import visioncal
from support.depth_cells import SMALL as LENS
from support.following import follow
from support.marks import slow
from support.refusals import raised
from support.rendered import Shot, photograph

from visioncal.calibration.run import calibrate, run
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.interchange.formats.intrinsics import read_target_description, target_named
from visioncal.present.recording.board import picture
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    CellOptions,
    prepare_scene,
    render,
    simulate,
    write_session,
)
from visioncal.simulation.textures import draw_sheet
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards import DetectedCorners, NotFound, find_target
from visioncal.vision.boards.charuco import Charuco, charuco_board
from visioncal.vision.boards.kind import DEFAULT_RELATIVE_SIGMA
from visioncal.vision.printing.page import pages_named, requested_target
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
        ({"kind": "chess"}, "kind is 'chess', but must be \"charuco\", "),
        ({"columns": 2}, "columns is 2, but must be a whole number from 3 to 100"),
        ({"square_sigma_m": 1e-300}, "is 1e-300, but must be a standard deviation from 1e-08 m"),
        ({"square_sigma_m": 0.04}, r"is 0\.04, .* to the square's own 0\.03 m"),
        ({"marker_m": 0.03}, r"marker_m is 0\.03, but must be less than square_m = 0\.03"),
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
    with pytest.raises(DataError, match="id is 587, but must be a whole number from 0 to 586"):
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
        turned_cells = np.rint(moved / target.square_m + 0.5).astype(int)
        cells = np.rint(centres + 0.5).astype(int)
        assert np.array_equal(
            page[turned_cells[:, 1], turned_cells[:, 0]], page[cells[:, 1], cells[:, 0]]
        )
        assert np.linalg.det(turn[:3, :3]) == pytest.approx(1.0)
    positions = corner_positions(target)
    pairs = list(zip(rotations(target), rotation_transforms(target), strict=True))
    assert np.array_equal(pairs[0][0], np.arange(columns * rows))
    for permutation, turn in pairs:
        turned = positions @ turn[:3, :3].T + turn[:3, 3]
        # Exact but for the rounding of one product and one sum.
        np.testing.assert_allclose(positions[permutation], turned, atol=1e-15)


DICTIONARIES = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))


def test_two_copies_of_a_charuco_board_in_an_image_are_named():
    target = charuco(9, 6, square_m=0.025, marker_m=0.018)
    drawn = cv2.resize(picture(target), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    page = np.pad(drawn, 60, constant_values=255)
    seen = Charuco().search(np.hstack([page, page]), target)
    assert isinstance(seen, NotFound)
    assert (
        seen.reason == "markers are seen twice: another board with the same markers is in the image"
    )


@pytest.mark.parametrize(
    "name", [slow(name) if at % 3 else name for at, name in enumerate(DICTIONARIES)]
)
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


TAG_GRID = aprilgrid(5, 3)
SHOT = Shot(square_px=50, noise=2)
# Kalibr's code of tag 0, row by row from its upper left; a set bit is light (t36h11 of its
# kalibr_create_target_pdf).
CODE_0 = 0xD5D628584


def test_the_page_is_kalibrs():
    """Tag 0 at the lower left, its code upright, and a square off each corner of each tag."""
    sheet, page = any_page(TAG_GRID), printed(TAG_GRID, 200)
    per_m = 1e3 * 200 / 25.4

    def grey(x_m, y_m):
        x, y = np.array(sheet.origin_mm) / 1e3 + [x_m, y_m]
        return int(page[int(y * per_m), int(x * per_m)])

    tag, pitch = TAG_GRID.square_m, 1.3 * TAG_GRID.square_m
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
    places = corner_positions(TAG_GRID) / TAG_GRID.square_m
    assert len(places) == 4 * 15
    np.testing.assert_allclose(places[0], [0.0, 2.6, 0.0])
    np.testing.assert_allclose(places[4 * 14 + 1], [6.2, 0.0, 0.0])
    assert target_from_document(target_document(TAG_GRID), "board") == TAG_GRID


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"columns": 6}, "do not lie as the target describes"),
        slow({"rows": 2}, "the grid has tag 1[0-4] besides the target's 5 x 2"),
        slow({"spacing": 0.25}, "are 0.30 of their side apart, and the target says spacing = 0.25"),
        ({"marker_id": 30}, r"most tags seen \(0, 1, 2, 3, 4\) are none of the target's"),
    ],
)
def test_another_print_of_a_grid_of_tags_is_named(change, words):
    image = np.pad(photograph(TAG_GRID, SHOT, 2)[0], 60, constant_values=210)
    found = find_target(image, replace(TAG_GRID, **change))
    assert isinstance(found, NotFound)
    assert found.misfit
    assert re.search(words, found.reason), found.reason


def test_kalibrs_own_file_describes_a_board(tmp_path):
    """Its form is that of the wiki of Kalibr, "Calibration targets"."""
    grid = tmp_path / "april_6x4.yaml"
    grid.write_text(
        "target_type: 'aprilgrid' #gridtype\ntagCols: 6  #number of apriltags\ntagRows: 4\n"
        "tagSize: 0.032 #[m]\ntagSpacing: 0.3\ncodeOffset: 0\n"
    )
    read, shipped = load_target(grid), load_target("aprilgrid_6x4_32mm")
    assert replace(read, name=shipped.name, square_sigma_m=shipped.square_sigma_m) == shipped
    squares = tmp_path / "board.yml"
    text = "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: {}\n"
    text += "colSpacingMeters: 0.06\n"
    squares.write_text(text.format(0.06))
    board = load_target(squares)
    assert (board.kind, board.columns, board.rows, board.square_m) == ("checkerboard", 6, 7, 0.06)
    squares.write_text(text.format(0.05))
    raised(DataError, "0.05, but must be as much as colSp", load_target, squares)
    squares.write_text("target_type: circlegrid\n")
    raised(DataError, "target_type is 'circlegrid'", load_target, squares)
    # What is written of a session has a description of our own.
    document = {"schema": 1, "name": "a", "mount": "eye-in-hand", "target": grid.name}
    document["camera"] = {"resolution": [640, 480]}
    (tmp_path / "session.toml").write_text(tomli_w.dumps(document))
    (tmp_path / "views.csv").write_text("view,image\n0,a.png\n")
    Session.load(tmp_path).save(tmp_path / "copy")
    assert Session.load(tmp_path / "copy").target == replace(read, name="april_6x4")


@pytest.mark.parametrize(
    "text",
    [
        "num_X: 9\nnum_Y: 6\nlen_squares: 0.04\nlen_markers: 0.035\nmarkers_dictionary: 2\n",
        "board_squaresX: 9\nboard_squaresY: 6\nboard_square_size: 40\nboard_marker_size: 35.0\n"
        "aruco_dictionary: DICT_4X4_250\nanimate: false\n",
        "name: ChArUco\nparameters: {width: 9, height: 6, square_size: 0.04, marker_size: 0.035, "
        "dictionary_id: 2}\ncamera: {width: 640, height: 480}\n",
    ],
)
def test_the_settings_of_a_program_describe_a_charuco_board(tmp_path, text):
    """Numbers are OpenCV's of its dictionaries; lengths from one on are millimetres."""
    (tmp_path / "board.yaml").write_text(text)
    stated = target_named("charuco_9x6_40mm_35mm_DICT_4X4_250")
    assert replace(load_target(tmp_path / "board.yaml"), name=stated.name) == stated
    (tmp_path / "board.yaml").write_text(text.replace("len_squares", "len").replace("e_size", "e"))
    raised(DataError, "target_type", load_target, tmp_path / "board.yaml")


@pytest.mark.parametrize(
    "text",
    [
        '[{"view": 1, "chessboard_size": [11, 8], "square_size_mm": 20, "pose": null}]',
        '{"trial": "a", "pattern_size": [11, 8], "chessboard_square_size": 0.02}',
        '{"pattern": "plain chessboard", "parameters": '
        '{"width": 11, "height": 8, "square_size": 0.02}}',
    ],
)
def test_records_describe_a_checkerboard(tmp_path, text):
    (tmp_path / "board.json").write_text(text)
    stated = target_named("checkerboard_11x8_20mm")
    assert replace(load_target(tmp_path / "board.json"), name=stated.name) == stated


@pytest.mark.parametrize(
    "text",
    [
        '{"board_size": [7, 5], "square_size": 0.03, "marker_size_px": 20}',
        '{"pattern_size": [4, 11], "pattern_type": "asymmetric_circles", "square_size": 0.02}',
        '{"board_size": [6, 6], "square_size": 0.02, "tag_size": 0.088}',
        '{"pattern_size": [9, 6], "square_size": true}',
        '{"note": "no chessboard", "width": 640, "height": 480, "square_size": 0.02}',
    ],
)
def test_records_of_other_boards_are_no_checkerboard(tmp_path, text):
    (tmp_path / "board.json").write_text(text)
    raised(DataError, "target_type", load_target, tmp_path / "board.json")


def test_the_grid_of_a_kalibr_target_is_described_in_one_word():
    expected = {"kind": "aprilgrid", "columns": 6, "rows": 5, "size_m": 0.088, "spacing": 0.3}
    assert read_target_description("aprilgrid_6x5_88mm_0.3") == expected


SHIFTED, EVEN = circles(4, 7, asymmetric=True, diameter_m=0.014), circles(6, 5)
CIRCLES_SHOT = Shot(square_px=24, noise=2)


def numbered(seen, truth):
    """The centres as found, in the numbering of the truth: an even grid may be turned."""
    away = [np.abs(value - truth).max() for value in (seen.px, seen.px[::-1])]
    return seen.px if away[0] < away[1] else seen.px[::-1]


def test_circles_are_ordered_as_opencvs():
    places = corner_positions(SHIFTED) / SHIFTED.square_m
    expected = [(2 * j + i % 2, i, 0) for i in range(7) for j in range(4)]
    np.testing.assert_allclose(places, expected, atol=1e-12)
    assert target_from_document(target_document(SHIFTED), "board") == SHIFTED


@pytest.mark.parametrize(
    ("target", "count"),
    [(SHIFTED, 1), (circles(4, 6, asymmetric=True), 2), (EVEN, 2), (circles(5, 5), 4)],
)
def test_the_turns_are_those_that_leave_the_page_as_it_is(target, count):
    turns = rotations(target)
    assert len(turns) == count
    assert all(sorted(turn) == list(range(len(turn))) for turn in turns)


# Errors are rms of a coordinate [px]; the template's own noise is half of what is allowed. Those of
# an ellipse's centre would be 0.1 and more in the tilted and the bent picture.
EXACT = [
    slow(TAG_GRID, SHOT, 0.01),
    slow(TAG_GRID, replace(SHOT, square_px=25), 0.015),
    slow(TAG_GRID, replace(SHOT, disc_px=2), 0.015),
    (TAG_GRID, replace(SHOT, tilt_deg=60), 0.015),
    slow(TAG_GRID, replace(SHOT, gamma=0.45, bend=0.1), 0.015),
    slow(TAG_GRID, replace(SHOT, bayer=True), 0.03),
]
for board in (SHIFTED, EVEN):
    EXACT += [
        slow(board, CIRCLES_SHOT, 0.008),
        slow(board, replace(CIRCLES_SHOT, disc_px=3), 0.015),
        (board, replace(CIRCLES_SHOT, tilt_deg=60, square_px=40), 0.01),
        slow(board, replace(CIRCLES_SHOT, bend=0.15, ink_px=1), 0.01),
        slow(board, replace(CIRCLES_SHOT, bayer=True), 0.025),
    ]


@pytest.mark.parametrize(("target", "shot", "most_px"), EXACT)
def test_corners_and_centres_are_as_exact_as_the_image(target, shot, most_px):
    image, truth = photograph(target, shot, 1)
    seen = find_target(image, target)
    assert isinstance(seen, DetectedCorners), seen
    assert len(seen.ids) > 50 if target == TAG_GRID else len(seen.ids) == len(truth)
    error = seen.px - truth[seen.ids] if target == TAG_GRID else numbered(seen, truth) - truth
    assert np.sqrt(np.mean(error**2)) < most_px
    # Nothing that all share: their mean is as good as their number allows.
    assert np.abs(error.mean(axis=0)).max() < 4 * most_px / np.sqrt(len(error))


@pytest.mark.slow
def test_centres_are_exact_where_a_fisheye_sees_them_slanted():
    # 0.11 m before a board of 0.24 m it looks at circles from up to 66 degrees aside.
    cell = simulate(
        CellOptions(target=BOARDS["symmetric-circles"], camera=CAMERAS["fisheye"], views=12, seed=1)
    )
    truth = cell.exact_corners[2].px
    seen = find_target(render(prepare_scene(cell), 2), cell.options.target)
    error = numbered(seen, truth) - truth
    assert np.sqrt(np.mean(error**2)) < 0.015


def test_a_small_board_is_seen_among_larger_dark_things():
    image, truth = photograph(EVEN, replace(CIRCLES_SHOT, square_px=20), 1)
    scene = np.full((500, 900), 200, np.uint8)
    scene[300 : 300 + len(image), 300 : 300 + image.shape[1]] = image
    # Two dozen bars, at places of no lattice.
    for number, height in enumerate(np.random.default_rng(1).integers(10, 200, 24)):
        scene[height : height + 40, 20 + 36 * number : 36 + 36 * number] = 40
    seen = find_target(scene, EVEN)
    assert isinstance(seen, DetectedCorners), seen
    np.testing.assert_allclose(numbered(seen, truth + 300), truth + 300, atol=0.1)


@pytest.mark.parametrize("change", [{"columns": 5}, slow({"asymmetric": False})])
def test_another_page_of_circles_is_refused(change):
    found = find_target(photograph(SHIFTED, CIRCLES_SHOT, 2)[0], replace(SHIFTED, **change))
    assert isinstance(found, NotFound)
    assert "circles is seen" in found.reason


DOTS = requested_target(BoardRequest("dots"), pages_named("A4", None))


@pytest.mark.parametrize(
    ("board", "mount"),
    [
        slow("aprilgrid", "eye-in-hand"),
        slow("aprilgrid", "eye-to-hand"),
        ("circles", "eye-to-hand"),
        slow("circles", "eye-in-hand"),
        slow("symmetric-circles", "eye-in-hand"),
        slow("symmetric-circles", "eye-to-hand"),
        slow("dots", "eye-in-hand"),
        slow("tags", "eye-in-hand"),
    ],
)
def test_a_cell_is_calibrated_with_a_rig_of_points(tmp_path, board, mount):
    target = BOARDS.get(board, DOTS)
    seed = 5 if "circles" in board else 4
    # Dots are too small for a quarter of the pixels.
    lens = {} if board == "dots" else {"camera": LENS, "blur_px": 0.5}
    cell = simulate(CellOptions(target=target, views=12, mount=mount, seed=seed, **lens))
    write_session(cell, tmp_path / "s")
    result = run(Session.load(tmp_path / "s")).calibration
    # Of centres to 0.004 px the lens's last digits may be a point to settle.
    assert result.verdict.status in (
        {"good"} if board in ("aprilgrid", "dots") else {"good", "check"}
    )
    assert sum(view.used for view in result.views) >= 11
    errors, found = [], invert(np.array([edge.matrix for edge in result.edges.values()]))
    camera, board = (cell.transforms[name] for name in result.edges)
    # An even grid has two frames.
    for turn in rotation_transforms(target) if target.kind != "points" else [np.eye(4)]:
        error = log(found @ [camera, board @ turn]).ravel()
        errors.append(error @ np.linalg.solve(result.joint_covariance, error))
    # Twelve values, to one case in a thousand.
    assert min(errors) < 32.9


@pytest.mark.slow
def test_sound_circles_of_few_pixels_are_not_said_to_be_of_another_diameter(tmp_path):
    options = CellOptions(views=17, mount="eye-to-hand", seed=77, camera=CAMERAS["fisheye"])
    cell = simulate(replace(options, target=BOARDS["circles"], robot="generic-6r-1800"))
    write_session(cell, tmp_path / "s")
    result = run(Session.load(tmp_path / "s")).calibration
    assert result.verdict.status == "good"
    assert not any(finding.kind == "print_size" for finding in result.verdict.findings)


@pytest.mark.slow
def test_circles_of_another_diameter_are_named_until_it_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    true = BOARDS["circles"]
    cell = simulate(CellOptions(target=true, views=12, mount="eye-to-hand", seed=5))
    write_session(cell, tmp_path / "s")
    sound = calibrate(tmp_path / "s")
    assert not any(finding.kind == "print_size" for finding in sound.verdict.findings)
    board = tmp_path / "s" / "target.toml"
    described = target_document(true) | {"kind": "circles"}
    board.write_text(tomli_w.dumps(described | {"diameter_m": 15 / 16 * true.diameter_m}))
    toml = tmp_path / "s" / "session.toml"
    toml.write_text(toml.read_text().replace(f'"{true.name}"', '"target.toml"'))
    followed = follow("calibrate", "s", "-o", "out")
    first = followed.runs[0].out
    assert "mm as stated. Their centres were fitted so; write diameter_m = 0.0" in first
    assert "blurred" not in first
    assert "mm as stated" not in followed.last.out
    written = tomllib.loads(board.read_text())["diameter_m"]
    # Pixels take a share of their edges.
    assert written == pytest.approx(true.diameter_m, rel=0.02)
    # It is a remark: the result is as good, and a recording says the same.
    found = Calibration.load(tmp_path / "out")
    assert found.verdict.status == sound.verdict.status
    assert sum(view.used for view in found.views) == sum(view.used for view in sound.views)


@pytest.mark.slow
def test_a_public_set_of_circles_is_sharp(real_data):
    result = calibrate(real_data / "field/sets/ji1024")
    assert [view.used for view in result.views].count(True) == len(result.views) == 16
    words = " ".join(finding.words for finding in result.verdict.findings)
    assert "blurred" not in words
    assert "another one" not in words
    # Of 20 mm between rows; by eye 16 to 17.5 mm.
    (stated,) = re.findall(r"write diameter_m = ([\d.]+) in", words)
    assert 0.016 < float(stated) < 0.0175


@pytest.fixture(scope="module")
def dots(tmp_path_factory):
    """A printed board, by the files that its printing wrote."""
    folder = tmp_path_factory.mktemp("board")
    visioncal("target", "make", "--kind", "dots", "-o", folder).good()
    (path,) = folder.glob("*.toml")
    assert path.with_suffix(".pdf").stat().st_size > 0
    return load_target(path)


def test_a_board_is_as_its_files_describe_it(dots):
    assert target_from_document(target_document(dots), dots.name) == dots
    assert len(corner_positions(dots)) == 14 * 9
    alike = {"points": {**target_document(dots)["points"], "radius_m": [2e-3] * 126}}
    with pytest.raises(DataError, match=r"4 dots of 1\.3 times the usual radius"):
        target_from_document({"kind": "dots", **alike}, "mine")


def test_a_printed_board_is_described_without_a_drawing(tmp_path):
    run = visioncal("target", "make", "charuco_9x6_30mm", "--toml-only", "-o", tmp_path).good()
    assert [file.name for file in tmp_path.iterdir()] == ["charuco_9x6_30mm.toml"]
    assert "Print it" not in run.said


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["wide", "fisheye"])
def test_centres_are_exact_and_rightly_numbered(dots, camera):
    cell = simulate(
        CellOptions(target=dots, camera=CAMERAS[camera], views=4, cut_views=0.0, seed=1)
    )
    scene = prepare_scene(cell)
    for view, exact in enumerate(cell.exact_corners):
        seen = find_target(render(scene, view), dots)
        assert isinstance(seen, DetectedCorners), seen
        # A fisheye sees the rim so aslant that its dots are thin ellipses.
        assert len(seen.ids) >= (0.9 if camera == "wide" else 0.7) * len(exact.ids)
        places = dict(zip(exact.ids.tolist(), exact.px, strict=True))
        error = seen.px - [places[number] for number in seen.ids.tolist()]
        # The centre of an ellipse would be off by 0.05 px and more where it is seen aslant.
        assert np.sqrt(np.mean(error**2)) < 0.015
    assert isinstance(find_target(np.full((400, 600), 200, np.uint8), dots), NotFound)


def test_a_grid_of_circles_needs_no_diameter():
    """It is found in each image; until then, circles cover as much as is usual."""
    described = {"kind": "circles", "columns": 7, "rows": 11, "square_m": 0.02}
    assert target_from_document(described, "circles").diameter_m == pytest.approx(0.01)
    staggered = target_from_document({**described, "asymmetric": True}, "circles")
    assert staggered.diameter_m == pytest.approx(0.01 * np.sqrt(2.0))
    assert target_named("circles_7x11_20mm_asymmetric") == replace(
        staggered, name="circles_7x11_20mm_asymmetric"
    )

"""Boards that name themselves: random photographs, first ids, grids of markers, field cases."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from support.commands import visioncal as command
from support.following import follow
from support.fuzz.broken_sessions import SMALL, Mistake, edit, sound_session
from support.marks import slow
from support.photographed import (
    HARD,
    KINDS,
    Print,
    described,
    dictionary_of,
    is_named,
    photographs,
    print_of,
)

from visioncal.calibration.stages.detect import detect
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.core.errors import DataError
from visioncal.core.types import Target
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.simulation import BOARDS
from visioncal.vision.boards import DetectedCorners, find_target
from visioncal.vision.boards.identify import identify
from visioncal.vision.targets import (
    board_words,
    corner_positions,
    target_document,
    target_from_document,
)

CASES = Path(__file__).parents[3] / "shared/data/field/cases"
# Commands search the same pictures again and again; `identify` is called itself, beside them.
SEARCHES_ONCE = True
# Enough of them for most to be sound.
FEW = Mistake(options=replace(SMALL.options, views=8))
MARKED = ("charuco", "aprilgrid", "gridboard", "marker")


@pytest.mark.parametrize("seed", [0, *(slow(at) for at in range(1, 20))])
def test_a_random_board_is_named_from_three_photographs(seed):
    rng = np.random.default_rng([69, seed])
    board = print_of(KINDS[seed % len(KINDS)], rng)
    images = photographs(board, rng)
    # No image of a plain board shows that it is a mirror image.
    mirrored = board.said["kind"] in MARKED and bool(rng.integers(2))
    images = [np.ascontiguousarray(image[:, ::-1]) for image in images] if mirrored else images
    identity = identify(images)
    assert is_named(board, identity)
    assert identity.is_mirrored == mirrored


@pytest.mark.slow
@pytest.mark.parametrize("seed", [16, 28])
def test_large_circles_in_shifted_rows_are_no_squares(seed):
    rng = np.random.default_rng([303, seed])
    board = print_of("circles", rng)
    assert board.said["asymmetric"]
    assert is_named(board, identify(photographs(board, rng)))


def is_accused(board, images):
    """Whether a sound board is said to be another one; it may be found, or not found."""
    target = target_from_document(described(board), "board")
    session = Session.from_arrays(images, np.tile(np.eye(4), (len(images), 1, 1)), target)
    try:
        detect(session)
    except DataError as error:
        return isinstance(error, OtherBoardError) or "another board" in str(error)
    return False


# Small is far, and a grid of markers is very blurred below.
@pytest.mark.parametrize("kind", [KINDS[0], *map(slow, KINDS[1:])])
@pytest.mark.parametrize(
    "hard", [hard if hard in ("blurred", "hidden in part") else slow(hard) for hard in HARD]
)
def test_no_sound_board_is_accused(kind, hard):
    rng = np.random.default_rng([70, KINDS.index(kind), [*HARD].index(hard)])
    board = print_of(kind, rng)
    assert not is_accused(board, photographs(board, rng, **HARD[hard]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind", "hard"),
    [
        # Detectors' corners make gaps look wider; a single tag is read by chance.
        ([404, 6, 3], "gridboard", "blurred"),
        ([404, 8, 7], "gridboard", "steep"),
        ([404, 11, 3], "aprilgrid", "blurred"),
        # 16 bits are read by chance in a tag of 36.
        ([606, 5, 3], "aprilgrid", "blurred"),
        ([404, 11, 4], "gridboard", "very blurred"),
        # From the side its rows are columns.
        ([9, 4], "circles", "hidden in part"),
    ],
)
def test_sound_boards_that_look_like_others_are_not_accused(seed, kind, hard):
    rng = np.random.default_rng(seed)
    board = print_of(kind, rng)
    assert not is_accused(board, photographs(board, rng, **HARD[hard]))


@pytest.mark.slow
def test_a_board_whose_first_rows_are_covered_begins_at_no_other_id():
    rng = np.random.default_rng(13)
    board = cv2.aruco.CharucoBoard((4, 4), 1.0, 0.7, dictionary_of("DICT_6X6_1000"))
    board.setLegacyPattern(True)
    drawn = board.generateImage((240, 240))
    drawn[:120] = 60
    said = {"kind": "charuco", "columns": 4, "rows": 4, "legacy": True, "family": "6X6"}
    covered = Print(np.pad(drawn, 60, constant_values=255), said)
    images = photographs(covered, rng)
    assert not is_accused(covered, images)


@pytest.mark.slow
@pytest.mark.parametrize("off", [-0.04, 0.04])
def test_a_grid_of_markers_with_other_gaps_is_named(off):
    rng = np.random.default_rng(5)
    board = print_of("gridboard", rng, first=0)
    images = photographs(board, rng)
    # By twice of what differs unnoticed.
    other = replace(board, said=board.said | {"spacing": board.said["spacing"] + off})
    assert is_accused(other, images)


GRID = Target("grid", "gridboard", 4, 3, 0.04, 4e-5, dictionary="DICT_5X5_250", spacing=0.2)
GRID = replace(GRID, marker_id=7)


def test_a_grid_of_markers_has_the_corners_of_opencv():
    ids = np.arange(7, 19, dtype=np.int32)
    board = cv2.aruco.GridBoard((4, 3), 0.04, 0.008, dictionary_of("DICT_5X5_250"), ids)
    drawn = np.pad(board.generateImage((800, 592)), 60, constant_values=255)
    seen = find_target(drawn, GRID)
    assert isinstance(seen, DetectedCorners)
    assert len(seen.ids) == 48
    corners, numbers, _ = cv2.aruco.ArucoDetector(board.getDictionary()).detectMarkers(drawn)
    places, px = board.matchImagePoints(corners, numbers)
    ours = corner_positions(GRID)
    # Ours are refined; OpenCV's err by up to a pixel of the drawing.
    for place, at in zip(places.reshape(-1, 3), px.reshape(-1, 2), strict=True):
        nearest = int(np.argmin(np.linalg.norm(ours - place, axis=1)))
        assert np.linalg.norm(ours[nearest] - place) < 1e-6
        assert np.linalg.norm(seen.px[list(seen.ids).index(nearest)] - at) < 1.5
    # Edges of pixels: the first marker's outer corner is at the drawing's, half a pixel before it.
    assert np.abs(seen.px[0] - 59.5).max() < 0.2


@pytest.mark.parametrize("first", [0, 17])
def test_a_charuco_board_may_begin_at_any_id(first):
    ids = np.arange(first, first + 24, dtype=np.int32)
    board = cv2.aruco.CharucoBoard((8, 6), 0.03, 0.022, dictionary_of("DICT_5X5_100"), ids)
    drawn = np.pad(board.generateImage((960, 720)), 60, constant_values=255)
    document = {"kind": "charuco", "columns": 8, "rows": 6, "square_m": 0.03, "marker_m": 0.022}
    document |= {"dictionary": "DICT_5X5_100", "first_id": first}
    target = target_from_document(document, "board")
    seen = find_target(drawn, target)
    assert isinstance(seen, DetectedCorners)
    assert len(seen.ids) == 35
    exact = 60 - 0.5 + 120 * corner_positions(target)[:, :2] / 0.03
    assert np.abs(seen.px - exact[seen.ids]).max() < 0.1
    assert target_from_document(target_document(target), "board") == target
    assert ("from id 17" in board_words(target)) == (first == 17)
    other = identify(drawn, replace(target, marker_id=-1 if first else 17))
    assert max(other.board.marker_id, 0) == first


def test_a_gap_in_metres_is_read_by_its_own_key():
    document = target_document(GRID)
    spacing = document.pop("spacing")
    again = target_from_document(document | {"spacing_m": spacing * 0.04}, "grid")
    assert again.spacing == pytest.approx(0.2)


def case(name, folder):
    """A copy of a case's session."""
    if not (CASES / name).is_dir():
        pytest.skip("no field cases here")
    shutil.copytree(CASES / name / "session", folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "said", "written"),
    [
        ("aprilgrid-spacing-metres", "looks like metres", "spacing = 0.3"),
        ("charuco-legacy", "8 x 6 squares, DICT_4X4_50, legacy layout", "legacy = true"),
    ],
)
def test_a_board_of_a_field_case_is_named_and_mended(tmp_path, monkeypatch, name, said, written):
    monkeypatch.chdir(tmp_path)
    folder = case(name, tmp_path / "cell")
    followed = follow("calibrate", "cell", "-o", "out")
    assert said in followed.runs[0].refused().said
    assert written in (folder / "board.toml").read_text("utf-8")
    assert len(followed.done) == 1
    assert (tmp_path / "out/calibration.json").is_file()


@pytest.mark.slow
def test_a_grid_of_aruco_markers_is_named_and_written_with_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = case("aruco-grid-board", tmp_path / "cell")
    refused = command("calibrate", "cell", "-o", "out").refused()
    assert 'kind = "gridboard"' in refused.said
    text = (folder / "board.toml").read_text("utf-8")
    (folder / "board.toml").write_text(text.replace("aruco_grid", "gridboard"), "utf-8")
    assert command("calibrate", "cell", "-o", "out").status == 0
    images = sorted((folder / "images").iterdir())[:3]
    said = command("target", "check", *images).good().said
    assert "grid of 4 x 3 markers" in said
    assert "0.20 of their side apart" in said


@pytest.mark.slow
def test_a_checkerboard_of_another_count_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = CASES / "checkerboard-miscounted"
    if not source.is_dir():
        pytest.skip("no field cases here")
    words = ("--mount", "eye-in-hand", "--robot-form", "rotation-vector", "--target")
    command("convert", source, "cell", *words, "checkerboard_9x6_35mm").good()
    followed = follow("calibrate", "cell", "-o", "out")
    said = followed.runs[0].refused().said
    assert "checkerboard of 11 x 8 inner corners" in said
    assert "Write columns = 11 and rows = 8" in said
    # Nothing more is said of the board; how the source writes its rotations is another matter.
    board, *rotations = followed.done
    assert "columns = 11" in board
    assert all("convert cell cell-fixed --guess" in words for words in rotations)
    assert "checkerboard" not in followed.last.said


def test_a_checkerboard_whose_white_is_overexposed_is_named():
    """Light blooms over the corners, where dark squares meet."""
    squares = 480.0 * (np.indices((7, 9)).sum(axis=0) % 2) + 20.0
    image = np.full((480, 640), 500.0)
    image[80:430, 80:530] = np.kron(squares, np.ones((50, 50)))
    shown = np.clip(cv2.GaussianBlur(image, (0, 0), 1.5), 0.0, 255.0).astype(np.uint8)
    assert "checkerboard of 8 x 6 inner corners" in board_words(identify(shown).board)


@pytest.mark.parametrize("seed", [3, *map(slow, range(4, 8))])
def test_dots_that_a_projector_throws_on_a_checkerboard_are_no_marks(seed):
    """As of a depth camera: a dot of 2 px in a quarter of all places, brighter on white."""
    rng = np.random.default_rng(seed)
    board = print_of("checkerboard", rng)
    dots = cv2.resize(1.0 + (rng.random((240, 320)) < 0.25), (640, 480), interpolation=0)
    shown = []
    for image in photographs(board, rng, size=(640, 480), fill=(0.7, 0.8)):
        lit = np.minimum(0.5 * image * dots, 255.0).astype(np.uint8)
        shown.append(cv2.GaussianBlur(lit, (0, 0), 0.7))
    assert is_named(board, identify(shown))


def changed_images(folder, change, every=1):
    """Changes each of so many images of a session."""
    for path in sorted((folder / "images").iterdir())[::every]:
        cv2.imwrite(str(path), change(cv2.imread(str(path))))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "every", "said"),
    [
        (lambda it: 255 - it, 1, "printed in white on black"),
        (lambda it: it[::-1, ::-1], 4, "the pictures are turned by 180 deg"),
        (lambda it: cv2.rotate(it, cv2.ROTATE_90_COUNTERCLOCKWISE), 3, "turned or scaled"),
        (
            lambda it: cv2.resize(it, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
            2,
            "turned or scaled",
        ),
    ],
    ids=["negatives", "upside down", "quarter turns", "half size"],
)
def test_images_that_were_changed_are_mended_as_is_printed(
    tmp_path, monkeypatch, change, every, said
):
    monkeypatch.chdir(tmp_path)
    folder = sound_session(tmp_path / "cell", SMALL)
    changed_images(folder, change, every)
    followed = follow("calibrate", "cell", "-o", "out")
    assert said in followed.runs[0].said
    assert "cell-fixed" in followed.words
    assert followed.last.good().said.startswith("good")


def test_images_upside_down_are_found_by_the_robot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = sound_session(tmp_path / "cell", FEW)
    changed_images(folder, lambda it: it[::-1, ::-1], 4)
    command("convert", "cell", "mended", "--mend-images").good()
    text = (tmp_path / "mended/session.toml").read_text("utf-8")
    assert "turned by a half" in text
    for name in sorted(path.stem for path in (folder / "images").iterdir())[::4]:
        mended = cv2.imread(str(tmp_path / f"mended/images/{name}.png"))
        assert (mended == cv2.imread(str(folder / f"images/{name}.png"))[::-1, ::-1]).all()


def test_sound_images_are_not_mended(tmp_path):
    folder = sound_session(tmp_path / "cell", FEW)
    said = command("convert", folder, tmp_path / "mended", "--mend-images").refused().said
    assert "no image is mirrored" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drawn", "declared", "said"),
    [
        ("charuco", {"kind": "checkerboard", "columns": 8, "rows": 5}, "ChArUco board of 9 x 6"),
        ("checkerboard", {"kind": "charuco", "columns": 10, "rows": 7}, "checkerboard of 9 x 6"),
    ],
)
def test_a_board_of_another_kind_is_no_circle(tmp_path, monkeypatch, drawn, declared, said):
    monkeypatch.chdir(tmp_path)
    folder = sound_session(
        tmp_path / "cell",
        Mistake(options=replace(SMALL.options, target=BOARDS[drawn], views=9)),
    )
    side_m = BOARDS[drawn].square_m
    more = {"marker_m": 0.7 * side_m, "dictionary": "DICT_5X5_100"}
    document = declared | {"square_m": side_m} | (more if declared["kind"] == "charuco" else {})
    (folder / "board.toml").write_text(tomli_w.dumps(document), "utf-8")
    edit(folder, lambda text: re.sub('target = "[^"]*"', 'target = "board.toml"', text))
    followed = follow("calibrate", "cell", "-o", "out")
    assert said in followed.runs[0].refused().said
    # Whether ChArUco's markers hide beside a checkerboard's corners or not: one step, and a result.
    assert len(followed.done) == 1
    assert followed.last.status == 0


@pytest.mark.slow
def test_a_board_whose_first_pictures_are_cut_is_identified_by_others():
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((40, 40))) * 200.0 + 30.0
    print_ = np.pad(squares, 40, constant_values=230.0).astype(np.uint8)
    images = []
    for at in range(6):
        # Of the first three that are looked at, outer squares lie beyond the picture's edge.
        left, top = (-70.0, 60.0) if at % 2 == 0 else (70.0 + 4.0 * at, 40.0)
        turn = np.array([[1.0, 0.04 * at, left], [-0.02 * at, 1.0, top], [1e-4 * at, 0.0, 1.0]])
        images.append(cv2.warpPerspective(print_, turn, (640, 480), borderValue=128))
    declared = target_from_document(
        {"kind": "checkerboard", "columns": 10, "rows": 7, "square_m": 0.03}, "board"
    )
    session = Session.from_arrays(images, np.tile(np.eye(4), (6, 1, 1)), declared)
    with pytest.raises(OtherBoardError, match="9 x 6"):
        detect(session)
    with pytest.raises(DataError, match="No board is seen"):
        identify(images[::2], declared)


@pytest.mark.slow
def test_a_board_that_is_never_seen_is_no_other_one_of_the_session():
    board = cv2.aruco.CharucoBoard(
        (7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    print_ = np.pad(board.generateImage((420, 300)), 30, constant_values=255)
    blank, files = np.full((480, 640), 128, np.uint8), {}
    for at in range(12):
        turn = np.array([[1.0, 0.03 * at, 60.0 + 3 * at], [-0.02 * at, 1.0, 60.0], [0.0, 0.0, 1.0]])
        turn[2, 0] = 1e-4 * at
        seen = cv2.warpPerspective(print_, turn, (640, 480), borderValue=128) if at % 4 else blank
        files[f"{at}.png"] = cv2.imencode(".png", seen)[1].tobytes()
    pose = ("0.1", "0.2", "0.3", "0", "0", "0", "1")
    rows = [
        [str(2 * at + board), str(at), f"{at}.png", name, *pose]
        for at in range(12)
        for board, name in enumerate("ab")
    ]
    shown = {"kind": "charuco", "columns": 7, "rows": 5, "square_m": 0.03, "marker_m": 0.022}
    documents = {
        "a": shown | {"dictionary": "DICT_4X4_50"},
        "b": {"kind": "aprilgrid", "columns": 6, "rows": 6, "size_m": 0.03, "spacing": 0.3},
    }
    document = {
        "schema": 1, "name": "two", "mount": "eye-in-hand", "camera": {"resolution": [640, 480]},
        "targets": {name: {"target": f"{name}.toml"} for name in documents},
    }  # fmt: skip
    columns = ("view", "stop", "image", "target", *POSE)
    session = Session.assemble(
        document, columns, rows, MemoryImages(files), target_document=documents
    )
    assert {view % 2 for view in detect(session).corners} == {0}


def cut_checkerboards(shifts, rim=60):
    """Pictures of 960 x 640 of 9 x 6 inner corners with squares of 84 px, which edges cut."""
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((84, 84))) * 200 + 20
    print_ = np.pad(squares, rim, constant_values=220).astype(np.uint8)
    rng = np.random.default_rng(4)
    images = []
    for right, down, tilt in shifts:
        from_print = np.array([[1.0, 0.03, right], [-0.04, 1.0, down], [tilt, 0.5 * tilt, 1.0]])
        image = cv2.warpPerspective(print_, from_print, (960, 640), borderValue=90)
        image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0.0, 2.0, image.shape)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
    return images


def test_a_checkerboard_is_named_where_its_outermost_squares_are_cut():
    """By all of its inner corners, where each side shows somewhere that no more squares follow."""
    images = cut_checkerboards([(-20.0, -20.0, 1e-4), (-45.0, -30.0, 2e-4), (-10.0, 0.0, 1.5e-4)])
    for image in images:
        assert "9 x 6 inner corners" in board_words(identify(image).board)
    assert identify(images).shown > 1


def test_a_checkerboard_whose_end_is_not_shown_may_have_more():
    """Of two sides of 9 x 6 squares the picture shows no end; and of parts no name is given."""
    (image,) = cut_checkerboards([(-20.0, -20.0, 1e-4)])
    part = image[:, : image.shape[1] * 7 // 12]
    identity = identify(part)
    assert identity.shown == 0
    assert "may have more columns or rows" in identity.notes[0]


def test_a_smaller_board_with_a_narrow_rim_is_no_part_of_the_stated_one(monkeypatch):
    """The paper ends a third of a square beyond the squares, on a dark table."""
    searched = []
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_, **__: searched.append(1))
    shifts = [(20.0, 10.0, 1e-4), (30.0, 15.0, 2e-4), (10.0, 20.0, 1.5e-4)]
    images = cut_checkerboards(4 * shifts, rim=27)
    target = Target("board", "checkerboard", 12, 8, 0.03, 3e-5)
    with pytest.raises(OtherBoardError, match="checkerboard of 9 x 6"):
        detect(Session.from_arrays(images, np.tile(np.eye(4), (12, 1, 1)), target))
    assert not searched


@pytest.mark.parametrize("stated", [(9, 7), (10, 7), slow((8, 5))])
def test_other_counts_of_a_checkerboard_are_named_before_any_long_search(stated, monkeypatch):
    searched = []
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_, **__: searched.append(1))
    cut, whole = (-120.0, -20.0, 1e-4), (-20.0, -20.0, 1e-4)
    images = cut_checkerboards(8 * [cut] + 4 * [whole])
    target = Target("board", "checkerboard", *stated, 0.03, 3e-5)
    with pytest.raises(OtherBoardError, match="checkerboard of 9 x 6") as caught:
        detect(Session.from_arrays(images, np.tile(np.eye(4), (12, 1, 1)), target))
    assert not searched
    assert ("its squares, of which" in str(caught.value)) == (stated == (10, 7))


def test_a_declared_checkerboard_is_found_beside_a_larger_one():
    """A poster of squares behind it is seen first, and is no other board than declared."""
    rng, images = np.random.default_rng(6), []
    for shift in (0, 4, 8):
        image = np.full((580, 800), 110, np.uint8)
        for columns, rows, side, x, y in ((12, 9, 36, 20, 20), (8, 6, 18, 580 + shift, 420)):
            squares = np.indices((rows, columns)).sum(axis=0) % 2
            print_ = np.kron(squares, np.ones((side, side))) * 200 + 20
            print_ = np.pad(print_, side, constant_values=220)
            image[y : y + print_.shape[0], x : x + print_.shape[1]] = print_
        noisy = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0.0, 2.0, image.shape)
        images.append(np.clip(noisy, 0, 255).astype(np.uint8))
    target = Target("board", "checkerboard", 7, 5, 0.03, 3e-5)
    found = detect(Session.from_arrays(images, np.tile(np.eye(4), (3, 1, 1)), target))
    assert sorted(found.corners) == [0, 1, 2]


@pytest.mark.parametrize("rim", [3, *map(slow, (6, 9))])
def test_a_board_printed_close_to_its_edge_is_named_by_its_own_lines(rim):
    """OpenCV's search for any count takes the rim's edge for a line of corners."""
    side, size, rng = 60, (1920, 1080), np.random.default_rng(rim)
    rows, columns = np.indices((8 * side, 10 * side)) // side
    board = np.where((rows + columns) % 2 == 0, 25, 225).astype(np.uint8)
    board = cv2.copyMakeBorder(board, rim, rim, side, side, cv2.BORDER_CONSTANT, value=225)
    height, width = board.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    share = 0.78 * size[1] / height
    placed = share * (corners - [width / 2, height / 2]) + np.array(size) / 2
    placed = (placed + rng.uniform(-10, 10, (4, 2))).astype(np.float32)
    image = cv2.warpPerspective(
        board,
        cv2.getPerspectiveTransform(corners, placed),
        size,
        dst=np.full(size[::-1], 60, np.uint8),
        flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_TRANSPARENT,
    )
    identity = identify(cv2.GaussianBlur(image, (0, 0), 1.0))
    assert (identity.board.kind, identity.board.columns, identity.board.rows) == (
        "checkerboard",
        9,
        7,
    )
    assert identity.corners_seen == 63

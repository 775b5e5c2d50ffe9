"""Detection, and naming a board in a photograph: what is found, and the reason where nothing is."""

import json
import struct
import tomllib
import zlib
from collections import Counter
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from support.boards import charuco as charuco_of
from support.boards import checkerboard as checkerboard_of
from support.boards import circles, printed
from support.commands import visioncal
from support.marks import slow
from support.refusals import raised

from visioncal.calibration.stages.detect import detect, other_sizes, unshown_rows
from visioncal.cli.target import to_toml
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp
from visioncal.core.types import Camera, Image, Target
from visioncal.session import MemoryImages, Session, View
from visioncal.simulation import BOARDS, CellOptions, prepare_scene, project, render, simulate
from visioncal.simulation.render import light_on
from visioncal.vision.boards import DetectedCorners, NotFound, find_target, kind_of
from visioncal.vision.boards.charuco import charuco_board
from visioncal.vision.boards.identify import identify
from visioncal.vision.boards.imaging import blur_at_corners, decode_image, poor_image_reason
from visioncal.vision.targets import (
    corner_positions,
    load_target,
    target_from_document,
    target_names,
)


def encoded(image, ending=".png"):
    return cv2.imencode(ending, image)[1].tobytes()


def images_of(options, count=4):
    cell = simulate(options)
    scene = prepare_scene(cell)
    return cell, [render(scene, at) for at in range(count)]


@pytest.fixture(scope="module")
def charuco():
    return images_of(CellOptions(views=4, cut_views=0.0, seed=2))


@pytest.fixture(scope="module")
def checkerboard():
    return images_of(CellOptions(views=4, target=BOARDS["checkerboard"], seed=3))


def session_of(files, target, resolution=(1280, 800)):
    document = {
        "schema": 1,
        "name": "made up",
        "mount": "eye-in-hand",
        "camera": {"resolution": list(resolution), "model": "brown"},
    }
    views = tuple(View(at, image=name) for at, name in enumerate(files))
    present = {name: data for name, data in files.items() if data is not None}
    return Session(document, ("view", "image"), views, target, None, MemoryImages(present))


@pytest.mark.slow
def test_corner_0_of_a_checkerboard_has_the_dark_square_outside(checkerboard):
    cell, images = checkerboard
    for image in images:
        upright = find_target(image, cell.options.target)
        turned = find_target(np.ascontiguousarray(image[::-1, ::-1]), cell.options.target)
        mirrored_back = np.array(image.shape[::-1]) - 1 - turned.px
        # The detector's own bias depends on the direction of its scan: about 0.05 px.
        np.testing.assert_allclose(mirrored_back, upright.px, atol=0.5)


def test_steep_views_keep_their_corners():
    tilt = np.deg2rad(66)
    options = CellOptions(views=3, tilt_rad=(tilt, tilt + 0.01), cut_views=0.0, seed=5)
    cell, images = images_of(options, 3)
    checked = cv2.aruco.CharucoDetector(charuco_board(cell.options.target))
    ours, opencvs = [], []
    for image in images:
        seen, ids = find_target(image, cell.options.target), checked.detectBoard(image)[1]
        ours.append(len(seen.ids) if isinstance(seen, DetectedCorners) else 0)
        opencvs.append(0 if ids is None else len(ids))
    assert all(count >= other for count, other in zip(ours, opencvs, strict=True))
    # With its own check of the markers OpenCV drops the first of these boards altogether.
    assert opencvs[0] == 0
    assert ours[0] >= 20


def test_small_markers_are_read_in_a_larger_copy(charuco):
    cell, images = charuco
    target, counts = cell.options.target, []
    for image in images:
        # Squares of some 15 px, with markers whose modules have two.
        side = np.median(np.linalg.norm(np.diff(find_target(image, target).px, axis=0), axis=1))
        by = 15.0 / side
        small = cv2.resize(image, None, fx=by, fy=by, interpolation=cv2.INTER_AREA)
        seen, whole = find_target(small, target), find_target(image, target)
        plain = kind_of(target).search(small, target)
        counts.append([0 if isinstance(at, NotFound) else len(at.ids) for at in (plain, seen)])
        ids, at, of = np.intersect1d(seen.ids, whole.ids, return_indices=True)
        away = seen.px[at] - ((whole.px[of] + 0.5) * by - 0.5)
        assert len(ids) >= 20
        # Corners of squares of 15 px are found to a twentieth of a pixel, and none is another.
        assert np.abs(away).max() < 0.5
        assert np.sqrt(np.mean(away**2)) < 0.05
    # As they are, fewer than two thirds of these are read.
    assert all(plain < seen / 1.5 for plain, seen in counts)


def test_a_board_that_the_image_cuts_needs_no_thorough_search(charuco, monkeypatch):
    cell, images = charuco
    target, searches = cell.options.target, []
    kind = type(kind_of(target))
    search = kind.search

    def counted(self, image, target, *, quick=False):
        searches.append(quick)
        return search(self, image, target, quick=quick)

    monkeypatch.setattr(kind, "search", counted)
    whole = find_target(images[0], target)
    left, within = (int(at) for at in np.quantile(whole.px[:, 0], (0.0, 0.3)))
    cut = find_target(np.ascontiguousarray(images[0][:, within:]), target)
    shown = whole.ids[whole.px[:, 0] > within + 5]
    assert searches == [True, True]
    assert len(np.setdiff1d(shown, cut.ids)) <= 0.2 * len(shown)
    covered = images[0].copy()
    covered[:, left - 40 : within] = 255
    find_target(covered, target)
    assert searches == [True, True, True, False]


def test_lone_markers_are_found(charuco):
    _, images = charuco
    target = Target("m", "marker", 1, 1, 0.022, 1e-5, dictionary="DICT_5X5_100", marker_id=3)
    assert find_target(images[0], target).px.shape == (4, 2)
    missing = find_target(images[0], replace(target, marker_id=99))
    assert isinstance(missing, NotFound)
    assert "99" in missing.reason


def test_every_unusable_view_gets_its_reason(charuco):
    _, images = charuco
    good = encoded(images[0])
    blurred = cv2.GaussianBlur(images[1], (0, 0), 4.5)
    row = images[2].copy()
    row[:, :] = 128
    jpeg = encoded(images[3], ".jpg")
    files = {
        "good.png": (good, ""),
        "missing.png": (None, "missing"),
        "empty.png": (b"", "empty"),
        "text.png": (b"no image at all", "decoded"),
        "cut.png": (good[: len(good) // 2], "cut short"),
        "cut.jpg": (jpeg[: len(jpeg) // 2], "cut short"),
        "damaged.png": (good[:9000] + bytes([good[9000] ^ 64]) + good[9001:], "damaged"),
        "uniform.png": (encoded(row), "uniform"),
        "blurred.png": (encoded(blurred), "blurred"),
        "good.jpg": (jpeg, ""),
    }
    given = {name: data for name, (data, _) in files.items()}
    found, names = detect(session_of(given, BOARDS["charuco"])), [*files]
    assert [names[view] for view in found.corners] == ["good.png", "good.jpg"]
    assert len(found.rejections) == len(files) - 2
    for rejection in found.rejections:
        _, word = files[names[rejection.view]]
        assert word
        assert word in rejection.reason


def test_too_few_corners_and_corners_on_one_line_are_no_board(charuco, monkeypatch):
    cell, images = charuco
    target = cell.options.target
    seen = find_target(images[0], target)
    # Only the board's first two rows of squares stay: one row of corners lies between them.
    places = corner_positions(target)[seen.ids, :2]
    homography, _ = cv2.findHomography(places, seen.px)
    strip = np.array([[0, 0], [9, 0], [9, 2], [0, 2]]) * target.square_m
    outline = cv2.perspectiveTransform(strip[None], homography)[0]
    mask = cv2.fillConvexPoly(np.zeros_like(images[0]), outline.astype(np.int32), 255)
    one_row = np.where(mask > 0, images[0], np.uint8(200))
    found = detect(
        session_of({"row.png": encoded(one_row), "whole.png": encoded(images[0])}, target)
    )
    assert list(found.corners) == [1]
    assert "on one line" in found.rejections[0].reason
    monkeypatch.setattr(type(kind_of(target)), "fewest", 41)
    refused = detect(
        session_of({"row.png": encoded(one_row), "whole.png": encoded(images[0])}, target)
    )
    assert "too few corners: 8 of 40, needs 40" in refused.rejections[0].reason
    assert list(refused.corners) == [1]


@pytest.mark.parametrize(
    ("declared", "correction"),
    [
        slow({"legacy": True}, "Write legacy = false in"),
        ({"columns": 6, "rows": 9}, "Write columns = 9 and rows = 6 in"),
        slow({"marker_id": 17}, "Write first_id = 0 in"),
        slow({"dictionary": "DICT_4X4_100"}, 'Write dictionary = "DICT_5X5_50" in'),
    ],
)
def test_another_layout_than_declared_is_named(charuco, declared, correction):
    cell, images = charuco
    files = {f"{at}.png": encoded(image) for at, image in enumerate(images)}
    session = session_of(files, replace(cell.options.target, **declared))
    words = "another board than declared: ChArUco board of 9 x 6"
    caught = raised(DataError, words, detect, session)
    assert caught.next_step.startswith(correction)


def test_images_of_another_size_are_named(charuco):
    cell, images = charuco
    images = [*images[:3], cv2.resize(images[3], (640, 400))]
    session = session_of(
        {f"{at}.png": encoded(it) for at, it in enumerate(images)}, cell.options.target
    )
    (found,) = other_sizes(detect(session))
    assert (found.kind, found.views) == ("image_sizes", (3,))
    assert "1 of 4 images are turned or scaled: view 3, such as 640 x 400 px" in found.words


def test_negatives_are_named(charuco):
    cell, images = charuco
    # One small image is searched for a second alone.
    files = {"0.png": encoded(255 - cv2.resize(images[0], (640, 400)))}
    session = session_of(files, cell.options.target, (640, 400))
    raised(DataError, "printed in white on black", detect, session)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("described", "kind"), [(4, "aprilgrid"), (6, "aprilgrid"), (8, "charuco")]
)
def test_an_aprilgrid_with_more_rows_than_printed_is_named(described, kind):
    cell, images = images_of(CellOptions(views=6, target=BOARDS[kind], cut_views=0.0, seed=3), 6)
    files = {f"{at}.png": encoded(image) for at, image in enumerate(images)}
    session = session_of(files, replace(cell.options.target, rows=described))
    found = [*unshown_rows(session, detect(session))]
    # A ChArUco board's frame begins at its first marker, whatever rows follow.
    assert len(found) == (described == 6)
    for finding in found:
        assert "the upper 2 of the 6 rows" in finding.words
        assert "begins 83.2 mm above" in finding.words
        assert "write rows = 4 in" in finding.do.words


def seen_by_a_fisheye(target, turn, depth_m, resolution, *matrix):
    """An image of a board before a wide lens, and where its corners are."""
    camera = Camera("fisheye", resolution, np.array(matrix), np.zeros(4))
    options = CellOptions(camera=camera, target=target, views=1, image_noise=0.0)
    middle = 0.5 * target.square_m * np.array([target.columns, target.rows, 0.0])
    pose = compose(turn := exp(np.array([*turn, 0, 0, 0]))[:3, :3], [0, 0, depth_m] - turn @ middle)
    light = light_on(prepare_scene(simulate(options)), pose)
    exact = project(camera, corner_positions(target) @ pose[:3, :3].T + pose[:3, 3])
    return light.astype(np.uint8), exact


@pytest.mark.slow
@pytest.mark.parametrize("declared", [{}, {"columns": 18}, {"legacy": True}])
def test_a_large_board_that_a_wide_lens_bends_is_judged_by_neighbours(declared):
    target = Target("wide", "charuco", 20, 10, 0.03, 3e-5, 0.02, "DICT_5X5_250")
    image, exact = seen_by_a_fisheye(target, [0.5, 0.4, 0.6], 0.35, (1024, 768), 520, 519, 503, 378)
    seen = find_target(image, replace(target, **declared))
    if declared:
        assert isinstance(seen, NotFound)
        assert seen.misfit
    else:
        # Wrong numbering would be off by a square.
        assert np.abs(seen.px - exact[seen.ids]).max() < 2.0


def test_an_image_of_another_size_is_named_with_the_sizes(charuco):
    cell, images = charuco
    small = cv2.resize(images[1], (640, 400))
    session = session_of(
        {"a.png": encoded(images[0]), "b.png": encoded(small)}, cell.options.target
    )
    # Neither is usual, and the larger is kept: `resolution` in session.toml would not change that.
    found = detect(session)
    assert found.resolution == (1280, 800)
    assert [rejection.view for rejection in found.rejections] == [1]
    assert "640 x 400 px, and the camera's images are 1280 x 800" in found.rejections[0].reason


def claiming(width, height):
    """A small png whose header claims a size, with sums that agree."""
    png = encoded(np.zeros((8, 8), np.uint8))
    header = b"IHDR" + struct.pack(">II", width, height) + png[24:29]
    return png[:12] + header + zlib.crc32(header).to_bytes(4, "big") + png[33:]


def test_a_size_that_no_sensor_has_is_refused_before_it_is_decoded(charuco, monkeypatch):
    cell, images = charuco
    decoded = []
    plain = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda *args: decoded.append(args) or plain(*args))
    bomb = claiming(30000, 30000)
    files = {"a.png": encoded(images[0]), "b.png": bomb}
    found = detect(session_of(files, cell.options.target))
    assert list(found.corners) == [0]
    assert "too large: images have up to 179 million pixels" in found.rejections[0].reason
    assert len(decoded) == 1


@pytest.mark.parametrize("ending", [".png", ".jpg", ".tif", ".bmp", ".webp"])
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_images_of_all_endings_are_decoded_or_named(ending, shape):
    data = encoded(np.zeros(shape, np.uint8), ending)
    assert decode_image(data).shape == (48, 64)
    assert "unreadable" in decode_image(data[:20])


def test_an_image_that_is_no_picture_shows_no_board(charuco, checkerboard):
    for cell, _ in (charuco, checkerboard):
        for shape in ((1, 5), (3, 30000), (24000, 3)):
            assert isinstance(find_target(np.zeros(shape, np.uint8), cell.options.target), NotFound)


def test_blur_is_measured_in_pixels(charuco):
    cell, images = charuco
    corners = cell.exact_corners[0].px
    before = blur_at_corners(images[0], corners)
    for sigma in (1.0, 2.0, 3.0):
        blurred = cv2.GaussianBlur(images[0], (0, 0), sigma)
        # Variances add; pixels, noise and oblique edges leave the measure good to a sixth.
        assert blur_at_corners(blurred, corners) == pytest.approx(np.hypot(before, sigma), rel=0.17)


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 45.0])
def test_motion_is_seen_along_which_half_of_the_edges_stay_sharp(turn_deg):
    """A motion of 24 px along rows leaves edges of 24 / sqrt(12) px, at any turn of the board."""
    squares = np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.full((40, 40), 200)) + 25
    turn = cv2.getRotationMatrix2D((160, 160), turn_deg, 1.0)
    sharp = cv2.warpAffine(squares.astype(np.uint8), turn, (320, 320), flags=cv2.INTER_AREA)
    sharp = cv2.GaussianBlur(sharp, (0, 0), 0.7)
    assert poor_image_reason(sharp, 4.0) == ""
    assert "blurred" in poor_image_reason(cv2.blur(sharp, (24, 1)), 4.0)
    assert "along one direction" in poor_image_reason(
        cv2.blur(squares.astype(np.uint8), (24, 1)), 4.0
    )


SHIPPED = {name: load_target(name) for name in target_names()}
MARKED = {name: target for name, target in SHIPPED.items() if target.kind in ("charuco", "marker")}
# One of each kind.
FIRST = {target.kind: name for name, target in MARKED.items()}.values()
ODD = {
    "legacy": charuco_of(9, 6, legacy=True),
    "legacy, tags": charuco_of(8, 6, "DICT_APRILTAG_36h11", legacy=True),
    "least": charuco_of(3, 3),
    "short codes": charuco_of(7, 5, "DICT_APRILTAG_16h5"),
    "original": charuco_of(9, 7, "DICT_ARUCO_ORIGINAL"),
    "upright": charuco_of(5, 8, "DICT_7X7_100"),
}


@lru_cache(maxsize=64)
def print_named(target):
    """The identity of a print at 4 pixels a millimetre."""
    return identify(printed(target, 100))


def assert_named(identity, target):
    assert identity.board.kind == target.kind
    if target.kind == "marker":
        assert identity.marker_ids == (target.marker_id,)
    else:
        assert (identity.board.columns, identity.board.rows) == (target.columns, target.rows)
        # With an odd number of rows there is one layout.
        assert identity.board.legacy == (target.legacy and target.rows % 2 == 0)
    if target.dictionary:
        assert target.dictionary in (identity.board.dictionary, *identity.larger)


def assert_share(identity, target):
    """A rendered marker's side is within the 3 % that photographs are good for, and a pixel."""
    error = identity.board.marker_m - target.marker_m / target.square_m
    assert abs(error) < 0.06


# Another board of their kind is named, too.
ALIKE = {"apriltag_36h11_id0_120mm", "charuco_13x8_30mm", "charuco_14x9_20mm", "legacy, tags"}


@pytest.mark.parametrize(
    "target",
    [
        pytest.param(target, marks=pytest.mark.slow if name in ALIKE else (), id=name)
        for name, target in (MARKED | ODD).items()
    ],
)
def test_a_print_is_named(target):
    identity = print_named(target)
    assert_named(identity, target)
    assert identity.corners_seen == identity.corners
    if target.kind == "charuco":
        assert_share(identity, target)


@pytest.mark.parametrize("tilt_rad", [slow((0.05, 0.3)), slow((0.6, 0.8)), (0.9, 1.05)], ids=str)
@pytest.mark.parametrize("name", ["charuco_9x6_30mm", slow("legacy"), slow("least")])
def test_a_tilted_board_is_named(name, tilt_rad):
    target = (MARKED | ODD)[name]
    options = CellOptions(target=target, views=2, tilt_rad=tilt_rad, cut_views=0.0, seed=3)
    identity = identify(render(prepare_scene(simulate(options)), 1))
    assert_named(identity, target)
    assert_share(identity, target)


def test_a_board_that_the_image_cuts_is_at_least_so_large():
    page = printed(SHIPPED["charuco_9x6_30mm"], 100)
    # Rows are 30 mm, 118 pixels, and start below 14 mm: two and a half of six are left.
    identity = identify(page[: 55 + 3 * 118 - 59])
    assert identity.board.columns == 9
    assert 2 <= identity.board.rows <= 3
    sideways = identify(page[:, :-300])
    # Columns follow from the ids, the last ones unseen too.
    board = sideways.board
    assert (board.columns, board.rows) == (9, 6)
    assert sideways.corners_seen < sideways.corners


@pytest.mark.slow
@pytest.mark.parametrize("sigma_px", [0.0, 3.0, 12.0])
def test_an_image_without_a_board_is_refused(sigma_px):
    noise = np.random.default_rng(1).normal(0.0, 1.0, (600, 800))
    if sigma_px:
        noise = cv2.GaussianBlur(noise, (0, 0), sigma_px)
    image = np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)
    raised(DataError, "No board is seen", identify, image)


@pytest.mark.parametrize("target", [checkerboard_of(9, 6), slow(circles(5, 9, asymmetric=True))])
def test_a_board_without_markers_is_named_by_its_counts(target):
    identity = identify(printed(target, 100))
    assert_named(identity, target)
    assert identity.board.asymmetric == target.asymmetric
    described = identity.target("again", target.square_m)
    # A pixel of a print at 4 pixels a millimetre.
    assert described.diameter_m == pytest.approx(target.diameter_m, abs=2.5e-4)


@pytest.mark.parametrize("name", [name if name in FIRST else slow(name) for name in MARKED])
def test_a_description_loads_once_the_size_is_known(name):
    target = SHIPPED[name]
    identity = print_named(target)
    document = tomllib.loads(to_toml(identity, target.square_m, "photo.png"))
    described = target_from_document(document, name)
    assert (described.kind, described.square_m) == (target.kind, target.square_m)
    # A pixel of a print at 4 pixels a millimetre.
    assert described.marker_m == pytest.approx(target.marker_m, abs=2.5e-4)


VISP = "visp_franka_hand_eye/data-eye-to-hand/*.png"
DOOSAN = "doosan_a0509_charuco/intrinsics_images/*.jpg"
RIC = "sessions/ric_charuco_eye_to_hand/images/*.png"


# A marker's side is over a square's.
@pytest.mark.parametrize(
    ("pattern", "kind", "columns", "rows", "dictionary", "share"),
    [
        slow(VISP, "marker", 1, 1, "DICT_APRILTAG_36h11", 0.0),
        slow(DOOSAN, "charuco", 7, 5, "DICT_4X4_50", 22 / 30),
        slow(RIC, "charuco", 5, 7, "DICT_6X6_250", 18.256 / 36.195),
    ],
)
def test_real_photographs_are_named(real_data, pattern, kind, columns, rows, dictionary, share):
    files = sorted(real_data.glob(pattern))
    assert len(files) >= 8
    # Neighbours in a recording look alike: every second one is named.
    files = files[::2]
    named = [identify(decode_image(file.read_bytes())) for file in files]
    boards = [identity.board for identity in named]
    found = Counter((board.kind, board.columns, board.rows) for board in boards)
    # A board is as large as its markers that are read: where those of its last row are too small,
    # it lacks that row.
    assert found.most_common(1)[0][0] == (kind, columns, rows)
    assert found[kind, columns, rows] >= 0.75 * len(files)
    assert found.keys() <= {(kind, columns, rows), (kind, columns, rows - 1)}
    assert all(dictionary in (identity.board.dictionary, *identity.larger) for identity in named)
    # Two standard deviations: of 22 photographs one may be farther off.
    far = sum(abs(board.marker_m - share) > 0.06 * share + 0.02 for board in boards)
    assert far <= 0.05 * len(named)


def run(*arguments):
    return visioncal("target", "check", *arguments)


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    path = tmp_path_factory.mktemp("photos") / "board [1].png"
    cv2.imwrite(str(path), printed(SHIPPED["charuco_9x6_30mm"], 100))
    return path


def test_check_prints_json(photo):
    document = json.loads(run(photo, "--json", "--square-mm", 30).out)
    assert (document["kind"], document["columns"], document["rows"]) == ("charuco", 9, 6)
    assert document["corners_seen"] == document["corners"] == 40
    assert document["target"]["square_m"] == 0.03
    assert document["dictionary"] == "DICT_5X5_50"
    assert "DICT_5X5_100" in document["same_markers"]


def test_check_refuses_what_is_no_image_and_no_size(photo, tmp_path):
    (tmp_path / "notes.png").write_bytes(b"not an image")
    assert "decoded" in run(tmp_path / "notes.png").said
    (tmp_path / "print.pdf").write_bytes(b"%PDF-1.4")
    assert "a page of a PDF" in run(tmp_path / "print.pdf").said
    for size_mm in (30000, "nan", "inf", -3):
        assert f"--square-mm is {size_mm}" in run(photo, "--square-mm", size_mm).said


@pytest.mark.parametrize("surround", [90, 235])
def test_a_checkerboard_cut_within_its_outermost_squares_is_found(surround):
    """As a print that fills its sheet: the cut squares are 0.45 of the others."""
    image = np.full((480, 640), surround, dtype=np.uint8)
    squares = 225 * (np.indices((5, 7)).sum(axis=0) % 2) + 20
    cut = np.kron(squares, np.ones((60, 60)))[33:-33, 33:-33]
    image[100 : 100 + len(cut), 120 : 120 + cut.shape[1]] = cut
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    board = checkerboard_of(6, 4)
    found = kind_of(board).search(image, board)
    rows, columns = np.indices((4, 6))
    true = np.stack([146.5 + 60 * columns, 126.5 + 60 * rows], axis=-1).reshape(-1, 2)
    # From one end or the other, by the dark corner.
    away = [np.abs(found.px - order).max() for order in (true, true[::-1])]
    assert min(away) < 0.2


@pytest.fixture
def outlined(monkeypatch):
    """Images in which outlines of squares are looked for; the other search finds nothing."""
    images, search = list[Image](), cv2.findChessboardCorners
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, **__: (False, None))
    monkeypatch.setattr(
        cv2,
        "findChessboardCorners",
        lambda image, *args, **options: images.append(image) or search(image, *args, **options),
    )
    return images


def test_outlines_of_squares_are_searched_in_a_small_copy(outlined):
    """In the noise of a whole image of many pixels the search takes most of a minute."""
    image = np.full((1500, 2400), 235, dtype=np.uint8)
    squares = 210 * (np.indices((5, 7)).sum(axis=0) % 2) + 20
    image[300:1200, 400:1660] = np.kron(squares, np.ones((180, 180)))
    board = checkerboard_of(6, 4)
    found = kind_of(board).search(cv2.GaussianBlur(image, (0, 0), 1.0), board)
    rows, columns = np.indices((4, 6))
    true = np.stack([579.5 + 180 * columns, 479.5 + 180 * rows], axis=-1).reshape(-1, 2)
    assert min(np.abs(found.px - order).max() for order in (true, true[::-1])) < 1.5
    assert max(image.shape[1] for image in outlined) <= 1500


def test_outlines_of_small_squares_are_searched_in_the_whole_image(outlined):
    """As of 16 px in 1920 x 1080, among less noise than the image has."""
    rng = np.random.default_rng(0)
    squares = 200.0 * (np.indices((7, 9)).sum(axis=0) % 2) + 20.0
    image = np.full((1080, 1920), 220.0)
    image[500:612, 900:1044] = np.kron(squares, np.ones((16, 16)))
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0.0, 3.0, image.shape)
    image = np.clip(image, 0.0, 255.0).astype(np.uint8)
    board = checkerboard_of(8, 6)
    assert isinstance(kind_of(board).search(image, board), DetectedCorners)
    assert np.std(outlined[0][:400]) < 0.5 * np.std(image[:400])


@pytest.mark.parametrize("turns", range(4))
def test_a_grid_of_circles_leaves_no_row_of_the_plate_over(turns):
    """Of 7 x 11 circles, 5 x 14 are a grid, too: of seven rows the last is left over."""
    board, part = circles(7, 11, asymmetric=True), circles(5, 14, asymmetric=True)
    places = kind_of(board).corners(board)[:, :2] / board.square_m * 24.0 + 60.0
    image = np.full((360, 440), 220, dtype=np.uint8)
    for at in places:
        cv2.circle(image, np.rint(at).astype(int).tolist(), 9, 30, -1, cv2.LINE_AA)
    image = np.ascontiguousarray(np.rot90(image, turns))
    seen, _ = kind_of(board).seen_in(image)
    assert (seen.columns, seen.rows, seen.asymmetric) == (7, 11, True)
    assert isinstance(kind_of(part).search(image, part), NotFound)


@pytest.mark.parametrize("asymmetric", [False, True])
def test_a_blob_that_continues_a_grid_of_circles_is_not_part_of_it(asymmetric):
    """A screw where the next circle would be."""
    board = circles(7, 6, asymmetric=asymmetric)
    places = kind_of(board).corners(board)[:, :2] / board.square_m * 36.0 + 70.0
    blob = places[-1] + (places[1] - places[0])
    image = np.full((400, 640), 220, dtype=np.uint8)
    for at in (*places, blob):
        cv2.circle(image, np.rint(at).astype(int).tolist(), 9, 30, -1, cv2.LINE_AA)
    found = kind_of(board).search(image, board)
    assert found.px == pytest.approx(np.rint(places), abs=0.3)

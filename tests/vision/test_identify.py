"""Naming a board in a photograph: on paper, in renders, cut off, and in real images."""

import json
import tomllib
from collections import Counter
from functools import lru_cache

import cv2
import numpy as np
import pytest
from support.boards import charuco, checkerboard, circles, printed
from support.commands import visioncal
from support.marks import slow
from support.refusals import raised

from visioncal.core.errors import DataError
from visioncal.simulation import CellOptions, prepare_scene, render, simulate
from visioncal.vision.boards.identify import identify, to_toml
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.targets import load_target, target_from_document, target_names

SHIPPED = {name: load_target(name) for name in target_names()}
MARKED = {name: target for name, target in SHIPPED.items() if target.kind in ("charuco", "marker")}
ODD = {
    "legacy": charuco(9, 6, legacy=True),
    "legacy, tags": charuco(8, 6, "DICT_APRILTAG_36h11", legacy=True),
    "least": charuco(3, 3),
    "short codes": charuco(7, 5, "DICT_APRILTAG_16h5"),
    "original": charuco(9, 7, "DICT_ARUCO_ORIGINAL"),
    "upright": charuco(5, 8, "DICT_7X7_100"),
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


@pytest.mark.parametrize(
    "target",
    [
        pytest.param(target, marks=pytest.mark.slow if name == "legacy, tags" else (), id=name)
        for name, target in (MARKED | ODD).items()
    ],
)
def test_a_print_is_named(target):
    identity = print_named(target)
    assert_named(identity, target)
    assert identity.corners_seen == identity.corners
    if target.kind == "charuco":
        assert_share(identity, target)


@pytest.mark.parametrize("tilt_rad", [(0.05, 0.3), slow((0.6, 0.8)), (0.9, 1.05)], ids=str)
@pytest.mark.parametrize("name", ["charuco_9x6_30mm", "legacy", "least"])
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


@pytest.mark.parametrize("sigma_px", [0.0, 3.0, 12.0])
def test_an_image_without_a_board_is_refused(sigma_px):
    noise = np.random.default_rng(1).normal(0.0, 1.0, (1000, 1400))
    if sigma_px:
        noise = cv2.GaussianBlur(noise, (0, 0), sigma_px)
    image = np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)
    raised(DataError, "No marker is read", identify, image)


@pytest.mark.parametrize("target", [checkerboard(9, 6), circles(5, 9, asymmetric=True)])
def test_a_board_without_markers_has_to_be_stated(target):
    caught = raised(DataError, "they must be stated", identify, printed(target, 100))
    assert f'kind = "{target.kind}", columns' in caught.next_step
    assert 'target = "board.toml" in session.toml' in caught.next_step


@pytest.mark.parametrize("name", MARKED)
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
        (VISP, "marker", 1, 1, "DICT_APRILTAG_36h11", 0.0),
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

"""AprilGrids, circles and dots: numbered as their makers do, exact, told from other pages."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.boards import any_page, aprilgrid, circles, printed
from support.commands import visioncal
from support.marks import slow
from support.rendered import Shot, photograph

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.interchange.formats.intrinsics import read_target_description
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
from visioncal.vision.boards import DetectedCorners, NotFound, find_target
from visioncal.vision.boards.kind import BoardRequest
from visioncal.vision.printing.page import pages_named
from visioncal.vision.printing.request import requested_target
from visioncal.vision.targets import (
    corner_positions,
    load_target,
    rotation_transforms,
    rotations,
    target_document,
    target_from_document,
)

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
        ({"columns": 6}, "do not lie as the target describes"),
        ({"rows": 2}, "the grid has tag 1[0-4] besides the target's 5 x 2"),
        ({"spacing": 0.25}, "are 0.30 of their side apart, and the target says spacing = 0.25"),
        ({"marker_id": 30}, r"most tags seen \(0, 1, 2, 3, 4\) are none of the target's"),
    ],
)
def test_another_page_is_named(change, words):
    image = np.pad(photograph(GRID, SHOT, 2)[0], 60, constant_values=210)
    found = find_target(image, replace(GRID, **change))
    assert isinstance(found, NotFound)
    assert found.misfit
    assert re.search(words, found.reason), found.reason


def test_the_grid_of_a_kalibr_target_in_one_word():
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
    slow(GRID, SHOT, 0.01),
    slow(GRID, replace(SHOT, square_px=25), 0.015),
    (GRID, replace(SHOT, disc_px=2), 0.015),
    (GRID, replace(SHOT, tilt_deg=60), 0.015),
    slow(GRID, replace(SHOT, gamma=0.45, bend=0.1), 0.015),
    (GRID, replace(SHOT, bayer=True), 0.03),
]
for board in (SHIFTED, EVEN):
    EXACT += [
        (board, CIRCLES_SHOT, 0.008),
        slow(board, replace(CIRCLES_SHOT, disc_px=3), 0.015),
        (board, replace(CIRCLES_SHOT, tilt_deg=60, square_px=40), 0.01),
        slow(board, replace(CIRCLES_SHOT, bend=0.15, ink_px=1), 0.01),
        (board, replace(CIRCLES_SHOT, bayer=True), 0.025),
    ]


@pytest.mark.parametrize(("target", "shot", "most_px"), EXACT)
def test_corners_and_centres_are_as_exact_as_the_image(target, shot, most_px):
    image, truth = photograph(target, shot, 1)
    seen = find_target(image, target)
    assert isinstance(seen, DetectedCorners), seen
    assert len(seen.ids) > 50 if target == GRID else len(seen.ids) == len(truth)
    error = seen.px - truth[seen.ids] if target == GRID else numbered(seen, truth) - truth
    assert np.sqrt(np.mean(error**2)) < most_px
    # Nothing that all share: their mean is as good as their number allows.
    assert np.abs(error.mean(axis=0)).max() < 4 * most_px / np.sqrt(len(error))


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


@pytest.mark.parametrize("change", [{"columns": 5}, {"asymmetric": False}])
def test_another_page_of_circles_is_refused(change):
    found = find_target(photograph(SHIFTED, CIRCLES_SHOT, 2)[0], replace(SHIFTED, **change))
    assert isinstance(found, NotFound)
    assert "circles is seen" in found.reason


DOTS = requested_target(BoardRequest("dots"), pages_named("A4", None))


@pytest.mark.parametrize(
    ("board", "mount"),
    [
        ("aprilgrid", "eye-in-hand"),
        slow("aprilgrid", "eye-to-hand"),
        ("circles", "eye-to-hand"),
        slow("circles", "eye-in-hand"),
        slow("symmetric-circles", "eye-in-hand"),
        slow("symmetric-circles", "eye-to-hand"),
        ("dots", "eye-in-hand"),
    ],
)
def test_a_cell_is_calibrated_with_it(tmp_path, board, mount):
    target = BOARDS.get(board, DOTS)
    seed = 5 if "circles" in board else 4
    cell = simulate(CellOptions(target=target, views=12, mount=mount, seed=seed))
    write_session(cell, tmp_path / "s")
    result = run(Session.load(tmp_path / "s")).calibration
    # Of centres to 0.004 px the lens's last digits may be a point to settle.
    assert result.verdict.status in (("good", "check") if "circles" in board else ("good",))
    assert sum(view.used for view in result.views) >= 11
    errors = []
    # An even grid has two frames.
    for turn in rotation_transforms(target):
        turns = {name: turn if name.endswith("target") else np.eye(4) for name in cell.transforms}
        error = np.concatenate(
            [
                log(invert(result.edges[name].matrix) @ true @ turns[name])
                for name, true in cell.transforms.items()
            ]
        )
        errors.append(error @ np.linalg.solve(result.joint_covariance, error))
    # Twelve values, to one case in a thousand.
    assert min(errors) < 32.9


@pytest.fixture(scope="module")
def dots(tmp_path_factory):
    """A printed board, by the files that its printing wrote."""
    folder = tmp_path_factory.mktemp("board")
    visioncal("target", "make", "--kind", "dots", "-o", folder).good()
    (path,) = folder.glob("*.toml")
    assert path.with_suffix(".pdf").stat().st_size > 0
    return load_target(path)


def test_a_board_is_what_its_files_say(dots):
    assert target_from_document(target_document(dots), dots.name) == dots
    assert len(corner_positions(dots)) == 14 * 9
    alike = {"points": {**target_document(dots)["points"], "radius_m": [2e-3] * 126}}
    with pytest.raises(DataError, match=r"4 dots of 1\.3 times the usual radius"):
        target_from_document({"kind": "dots", **alike}, "mine")


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

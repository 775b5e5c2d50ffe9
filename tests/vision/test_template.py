"""Corners by the template and of smeared images, and the maps that they start from."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.boards import charuco, checkerboard, circles
from support.marks import slow
from support.rendered import Shot, photograph

from visioncal.core.limits import MAX_BLUR_PX
from visioncal.core.types import Target
from visioncal.simulation import BOARDS, CellOptions, simulate
from visioncal.simulation.optics import CAMERAS, project
from visioncal.vision.boards import DetectedCorners, NotFound, find_target, kind_of
from visioncal.vision.boards.maps import OpticalAxis, maps_about
from visioncal.vision.boards.template import Refined, refine_tags
from visioncal.vision.dense import find_densely

# Columns and rows differ by an odd number: the checkerboard has one numbering.
CHECKERBOARD, CHARUCO = checkerboard(6, 5), charuco(6, 5)
CIRCLES = circles(4, 7, asymmetric=True, diameter_m=0.014)
SMALL = Shot(square_px=20, noise=2)


def detected(target, image):
    return kind_of(target).search(image, target)


def refine(image, target, ids, px):
    """Corners of a board, by its template."""
    return kind_of(target).refine(image, target, ids, px)


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors))))


# Errors are rms of a coordinate [px]; the template's own noise is a third to a half of what is
# allowed, the detectors' errors are three times as much.
@pytest.mark.parametrize(
    ("target", "shot", "most_px"),
    [
        (CHECKERBOARD, SMALL, 0.01),
        (CHECKERBOARD, replace(SMALL, disc_px=2), 0.015),
        (CHECKERBOARD, replace(SMALL, motion_px=6), 0.015),
        (CHECKERBOARD, replace(SMALL, gamma=0.45, jpeg=85), 0.015),
        (CHECKERBOARD, replace(SMALL, bayer=True), 0.02),
        (CHECKERBOARD, replace(SMALL, tilt_deg=60, square_px=30), 0.015),
        slow(CHECKERBOARD, replace(SMALL, square_px=60, bend=0.15, noise=1), 0.006),
        (CHARUCO, replace(SMALL, square_px=36, jpeg=75, uneven=0.5), 0.015),
        (CHARUCO, replace(SMALL, square_px=36, motion_px=5), 0.015),
        (replace(CHARUCO, legacy=True, rows=6), replace(SMALL, square_px=36), 0.01),
    ],
)
def test_corners_are_as_exact_as_the_image(target, shot, most_px):
    image, truth = photograph(target, shot, 1)
    seen = detected(target, image)
    refined = refine(image, target, seen.ids, seen.px)
    assert refined.fitted.all()
    error = refined.px - truth[seen.ids]
    assert rms(error) < most_px
    assert rms(error) < 0.65 * rms(seen.px - truth[seen.ids])
    # Nothing that all corners share: their mean is as good as their number allows.
    assert np.abs(error.mean(axis=0)).max() < 4 * most_px / np.sqrt(len(error))


@pytest.mark.parametrize("target", [CHECKERBOARD, CHARUCO])
def test_noise_gives_the_standard_deviation(target):
    image, truth = photograph(target, Shot(square_px=36, noise=10), 2)
    seen = detected(target, image)
    refined = refine(image, target, seen.ids, seen.px)
    scaled = (refined.px - truth[seen.ids]) / refined.sigma_px[:, None]
    # 40 to 60 coordinates tell a mean square to a quarter; the pixels' own shape adds residuals.
    assert 0.4 < np.mean(scaled**2) < 1.6


def test_the_start_may_be_off_by_more_than_a_pixel():
    image, truth = photograph(CHECKERBOARD, replace(SMALL, square_px=36), 3)
    start = truth + np.random.default_rng(0).uniform(-1.5, 1.5, truth.shape)
    refined = refine(image, CHECKERBOARD, np.arange(30), start)
    assert rms(refined.px - truth) < 0.01


@pytest.mark.parametrize("target", [slow(CHECKERBOARD), CHARUCO])
def test_a_covered_corner_is_left_to_the_detector(target):
    image, truth = photograph(target, replace(SMALL, square_px=40), 1)
    ids = np.arange(len(truth))
    u, v = np.rint(truth[7]).astype(int)
    covered = image.copy()
    covered[v - 3 : v + 30, u - 4 : u + 30] = 120
    refined = refine(covered, target, ids, truth + 0.25)
    assert not refined.fitted[7]
    np.testing.assert_array_equal(refined.px[7], truth[7] + 0.25)
    assert np.isnan(refined.sigma_px[7])
    fitted = refined.fitted
    # The cover reaches into the patches of three others at most, and bends no map.
    assert fitted.sum() >= len(truth) - 4
    assert np.abs(refined.px - truth)[fitted].max() < 0.1
    assert np.median(np.abs(refined.px - truth)[fitted]) < 0.006


def test_a_corner_at_the_edge_of_the_image_is_exact_or_left_to_the_detector():
    image, truth = photograph(CHECKERBOARD, replace(SMALL, square_px=40), 1)
    ids = np.arange(30)
    for inside in (2, 6, 10, 14):
        left = int(truth[:, 0].min()) - inside
        refined = refine(
            np.ascontiguousarray(image[:, left:]), CHECKERBOARD, ids, truth - [left, 0]
        )
        fitted = refined.fitted
        assert fitted.sum() >= 29
        assert fitted.all() == (inside > 4)
        assert np.abs(refined.px + np.array([left, 0]) - truth)[fitted].max() < 0.02


@pytest.mark.parametrize("square_px", [20, slow(80)])
def test_circles_of_another_diameter_are_as_exact_and_no_blur(square_px):
    image, truth = photograph(CIRCLES, replace(SMALL, square_px=square_px), 1)
    sound = find_target(image, CIRCLES)
    for stated in (0.75, 0.94, 1.25):
        found = find_target(image, replace(CIRCLES, diameter_m=stated * CIRCLES.diameter_m))
        assert rms(found.px - truth) < 1.1 * rms(sound.px - truth) < 0.02
        assert found.blur_px == pytest.approx(sound.blur_px, abs=0.05)
        # Pixels take a share of the edge of circles of 14 px.
        assert found.drawn_m == pytest.approx(CIRCLES.diameter_m, rel=0.015)


@pytest.mark.parametrize("stated", [0.85, *map(slow, (1.0, 1.15))])
def test_blurred_circles_are_blurred_whatever_their_stated_diameter(stated):
    image, _ = photograph(CIRCLES, replace(SMALL, square_px=45), 1)
    blurred = cv2.GaussianBlur(image, (0, 0), 6.0)
    # A motion of 21 px has the standard deviation of a uniform distribution, in one direction.
    smeared = cv2.filter2D(image, -1, np.full((1, 21), 1 / 21, np.float32))
    target = replace(CIRCLES, diameter_m=stated * CIRCLES.diameter_m)
    assert find_target(blurred, target).blur_px > MAX_BLUR_PX
    assert find_target(smeared, target).blur_px == pytest.approx(21 / 12**0.5, rel=0.2)


@pytest.mark.slow
def test_a_misfit_of_the_template_is_no_blur_where_edges_are_sharp(monkeypatch):
    image, truth = photograph(CIRCLES, replace(SMALL, square_px=60), 1)
    board = type(kind_of(CIRCLES))
    wide = Refined(truth, np.full(len(truth), 0.1), np.full(2, 9.0))
    monkeypatch.setattr(board, "refine", lambda *_: wide)
    assert find_target(image, CIRCLES).blur_px < 2.0
    blurred = cv2.GaussianBlur(image, (0, 0), 6.0)
    assert find_target(blurred, CIRCLES).blur_px > MAX_BLUR_PX


def test_too_few_corners_stay_where_they_are():
    image, truth = photograph(CHECKERBOARD, SMALL, 1)
    for ids in (np.arange(3), np.arange(6)):
        refined = refine(image, CHECKERBOARD, ids, truth[ids])
        assert not refined.fitted.any()
        np.testing.assert_array_equal(refined.px, truth[ids])
    nothing = refine(np.full_like(image, 90), CHECKERBOARD, np.arange(30), truth)
    assert not nothing.fitted.any()
    np.testing.assert_array_equal(nothing.px, truth)
    assert np.isnan(nothing.blur_px).all()


def test_a_corner_unlike_the_print_is_left_out_of_a_view():
    image, truth = photograph(CHECKERBOARD, replace(SMALL, square_px=40), 1)
    u, v = np.rint(truth[14]).astype(int)
    cv2.circle(image, (int(u) + 5, int(v) - 4), 6, 250, -1)
    seen = find_target(image, CHECKERBOARD)
    assert isinstance(seen, DetectedCorners)
    assert seen.ids.tolist() == [*range(14), *range(15, 30)]
    assert np.abs(seen.px - truth[seen.ids]).max() < 0.03


def test_where_few_corners_are_like_the_print_the_detector_serves(monkeypatch):
    image, truth = photograph(CHECKERBOARD, replace(SMALL, square_px=40), 1)
    seen = DetectedCorners(np.arange(30), truth + 0.1)
    monkeypatch.setattr(type(kind_of(CHECKERBOARD)), "search", lambda *_, **__: seen)
    for covered, fits in ((0.3, True), (0.7, False), (1.0, False)):
        blank = image.copy()
        blank[:, : int(covered * image.shape[1])] = 120
        found = find_target(blank, CHECKERBOARD)
        assert (found.weights is None) == fits
        if fits:
            assert np.abs(found.px - truth[found.ids]).max() < 0.03
        else:
            np.testing.assert_array_equal(found.px, seen.px)
            assert (found.weights == 0.1).all()


@pytest.mark.slow
@pytest.mark.parametrize("target", [CHECKERBOARD, CHARUCO])
def test_a_board_that_a_quick_search_misses_is_searched_thoroughly(target, monkeypatch):
    image, truth = photograph(target, replace(SMALL, square_px=40), 1)
    kind = type(kind_of(target))
    plain = kind.search
    seen = kind_of(target).search(image, target, quick=True)
    assert len(seen.ids) == len(truth)
    assert rms(seen.px - truth) < 0.3
    parts = (
        NotFound("not seen"),
        # One corner is missing, and all are where the template fits none.
        DetectedCorners(seen.ids[1:], seen.px[1:]),
        DetectedCorners(seen.ids, seen.px + 15.0),
    )
    for part in parts:
        calls = []

        def search(*args, quick=False, part=part, calls=calls):
            return part if quick else (calls.append(1) or plain(*args))

        monkeypatch.setattr(kind, "search", search)
        found = find_target(image, target)
        assert calls == [1]
        assert found.ids.tolist() == seen.ids.tolist()
        assert rms(found.px - truth) < 0.02


def marker(dictionary):
    return Target("m", "marker", 1, 1, 0.1, 1e-5, dictionary=dictionary, marker_id=3)


def outward(error, truth):
    """By how much corners are off along the diagonals of their marker [px]."""
    away = truth - truth.mean(axis=0)
    return np.sum(error * away, axis=1) / np.linalg.norm(away, axis=1)


# OpenCV's corners are off by 0.1 to 0.9 px, all of them inwards. Where sides count as straight, the
# lens of the last shot moves corners outwards by 0.02 px.
@pytest.mark.parametrize(
    ("dictionary", "shot", "white"),
    [
        ("DICT_6X6_50", Shot(square_px=60, bend=0), 1.0),
        slow("DICT_6X6_50", Shot(square_px=100, bend=0), 0.4),
        ("DICT_6X6_50", Shot(square_px=80, bend=0, disc_px=2), 1.0),
        ("DICT_APRILTAG_36h11", Shot(square_px=100, bend=0, tilt_deg=60), 1.0),
        slow("DICT_APRILTAG_36h11", Shot(square_px=120, bend=0, uneven=0.3), 1.0),
        slow("DICT_6X6_50", Shot(square_px=150, bend=0.005), 1.0),
    ],
)
def test_the_corners_of_a_single_marker_are_not_drawn_inwards(dictionary, shot, white):
    target, off, scaled = marker(dictionary), [], []
    for seed in range(6):
        image, truth = photograph(target, shot, seed)
        if white < 1.0:
            centre, paper = truth.mean(axis=0), np.zeros_like(image)
            rim = np.rint(centre + (1 + 2 * white / 8) * (truth - centre))
            cv2.fillConvexPoly(paper, rim.astype(np.int32), 1)
            image[paper == 0] = 110
        seen = find_target(image, target)
        assert seen.weights is None
        off.append(outward(seen.px - truth, truth))
        sigma_px = refine_tags(image, 8, seen.px[None]).sigma_px
        scaled.append((seen.px - truth) / sigma_px[:, None])
    assert np.abs(np.mean(off)) < 0.01
    # 48 coordinates tell a mean square to a fifth.
    assert 0.4 < np.mean(np.square(scaled)) < 1.8


def test_a_marker_too_small_for_the_template_keeps_the_detectors_corners():
    image, truth = photograph(marker("DICT_6X6_50"), Shot(square_px=20, tilt_deg=0, noise=8), 1)
    seen = find_target(image, marker("DICT_6X6_50"))
    assert set(seen.weights) <= {0.1, 1.0}
    assert (seen.weights == 0.1).any()
    # OpenCV has them to a pixel or so.
    assert np.abs(seen.px - truth).max() < 1.5


LARGE_SHOT = Shot(square_px=32, noise=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "shot"),
    [
        (CHECKERBOARD, replace(LARGE_SHOT, motion_px=20)),
        (CHECKERBOARD, replace(LARGE_SHOT, disc_px=9, uneven=0.3)),
        (CHARUCO, replace(LARGE_SHOT, disc_px=8)),
    ],
)
def test_corners_of_smeared_images_are_within_their_sigmas(target, shot):
    image, truth = photograph(target, shot, 1)
    found = find_densely(image, target)
    assert len(found.ids) >= 0.8 * len(truth)
    errors = found.px - truth[found.ids]
    # What the Gaussian leaves of a disc counts as noise, which widens the sigmas; it may double
    # them. Of a chi-square with 32 degrees of freedom or more, 1.9 is above 99.7 %.
    assert np.mean((errors / found.sigma_px[:, None]) ** 2) < 1.9
    # Half a percent of a square, 0.15 mm of 30, is what a pose of 20 corners can use.
    assert np.median(found.sigma_px) < 0.005 * shot.square_px
    if shot.motion_px:
        assert found.motion_px == pytest.approx(shot.motion_px, abs=1.5)
    else:
        # A disc's sigma along an axis is half its radius; no edge is wider than the radius.
        assert 0.4 * shot.disc_px < found.width_px < shot.disc_px


@pytest.mark.slow
def test_another_board_or_none_gives_no_corners():
    image = photograph(CHARUCO, replace(LARGE_SHOT, motion_px=14), 1)[0]
    assert find_densely(image, charuco(6, 5, "DICT_4X4_50")) is None
    assert find_densely(image, charuco(7, 5)) is None
    noise = np.random.default_rng(0).normal(128, 20, (300, 400)).clip(0, 255)
    assert find_densely(noise.astype(np.uint8), CHARUCO) is None


TAGS = BOARDS["tags"]
SIDE_M = 0.05


# Polynomials alone leave 0.006 and 0.15 px.
@pytest.mark.parametrize(
    ("camera", "most_px"), [(CAMERAS["wide"], 0.0015), (CAMERAS["fisheye"], 0.006)]
)
@pytest.mark.parametrize("cut_px", [(0, 0), (100, 50)])
def test_maps_follow_the_sides_of_tags_through_a_lens(camera, most_px, cut_px):
    cell = simulate(CellOptions(target=TAGS, camera=camera, views=20, seed=1))
    # An image that was cut has its middle beside the lens's axis.
    axis = OpticalAxis.of(camera.resolution[::-1], np.array(cut_px))
    errors = []
    for corners, cam_from_target in zip(cell.exact_corners, cell.cam_from_target, strict=True):
        places = np.array(TAGS.points_m)[corners.ids]
        whole = np.flatnonzero(corners.ids % 4 == 0)[np.newaxis].T + np.arange(4)
        whole = whole[(whole[:, 3] < len(places))]
        whole = whole[corners.ids[whole[:, 3]] == corners.ids[whole[:, 0]] + 3].ravel()
        # A tenth of a side further round, where the template looks.
        further = places[whole] + 0.1 * (
            places[np.roll(whole.reshape(-1, 4), -1, axis=1).ravel()] - places[whole]
        )
        beside_px = project(camera, further @ cam_from_target[:3, :3].T + cam_from_target[:3, 3])
        board, px = places[whole, :2] / SIDE_M, corners.px[whole]
        every = np.arange(len(px))
        on_board = maps_about(board, px, every >= 0, every, axis)[0]
        off = on_board(beside_px[:, None])[:, 0] - (further[:, :2] / SIDE_M - board)
        scale = np.linalg.norm(np.diff(px[:2], axis=0)) / np.linalg.norm(np.diff(board[:2], axis=0))
        errors.append(scale * off)
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < most_px

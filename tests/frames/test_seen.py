"""A tool or a fixture placed by a target on it: one image or several, and the wrong ones named."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from support.cells import exact
from support.marks import slow
from support.picks import Stand, calibration_of, corners_at, really
from support.plates import CENTRES, looking, marked_plate

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, exp, invert, log
from visioncal.core.types import Target
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.fixture_from_markers import measure_markers
from visioncal.frames.target_in_image import target_pose_candidates
from visioncal.frames.target_pose import Sight, candidate_places, place_seen
from visioncal.simulation import BOARDS, CellOptions, simulate
from visioncal.vision.camera import intrinsics, with_intrinsics

BOARD = BOARDS["charuco"]
MARKER = Target("marker", "marker", 1, 1, 0.06, 6e-5, dictionary="DICT_5X5_100", marker_id=3)
IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
# Mount, and the frame that the target is placed in.
TREES = [(IN_HAND, "base"), (IN_HAND, "flange"), (TO_HAND, "base"), (TO_HAND, "flange")]


def cell_of(mount, **options):
    return simulate(CellOptions(mount=mount, **{"views": 12, "pixel_sigma_px": 0.1} | options))


@lru_cache
def calibrated_cell(mount, seed):
    made = cell_of(mount, seed=seed)
    return made, calibration_of(made)


@pytest.fixture(scope="module", params=[IN_HAND, TO_HAND])
def cell(request):
    return calibrated_cell(request.param, 2)


def place_of(cell, parent, rng, target=BOARD):
    """A place (4, 4) in the parent where the camera sees the target about as at calibration."""
    x, z = cell.transforms.values()
    near = exp(rng.normal(0.0, np.repeat([0.05, 0.005], 3)))
    if target.kind == "marker":
        near = compose(np.eye(3), np.array([0.12, 0.08, 0.0])) @ near
    if (cell.options.mount == IN_HAND) == (parent == "base"):
        return z @ near
    return x @ cell.cam_from_target[1] @ near


def sights_of(cell, parent, place, rng, count=6, target=BOARD):
    """Images of a target that sits at a place of the parent, at stops of the calibration."""
    x, sights = next(iter(cell.transforms.values())), []
    for at in range(count):
        reported = cell.robot.base_from_flange[at]
        flange = really(cell, reported, rng)
        base_from_cam = flange @ x if cell.options.mount == IN_HAND else x
        base_from_target = flange @ place if parent == "flange" else place
        corners = corners_at(cell, Stand(reported, base_from_cam), base_from_target, target, rng)
        sights.append(Sight(f"image {at}", corners, reported))
    return sights


@pytest.mark.parametrize(("mount", "parent"), TREES)
def test_what_moves_a_sight_agrees_with_central_differences(mount, parent):
    cell = simulate(exact(CellOptions(mount=mount, views=8, seed=1)))
    calibration = calibration_of(cell)
    eye, rng = CalibratedCamera.of(calibration), np.random.default_rng(0)
    place = place_of(cell, parent, rng)
    (sight,) = sights_of(cell, parent, place, rng, count=1)

    def placed(eye, sight=sight, target=BOARD):
        return candidate_places(
            eye, sight, target_pose_candidates(eye, sight.seen, target, "image", 0.1), parent
        )[0].matrix

    here = candidate_places(
        eye, sight, target_pose_candidates(eye, sight.seen, BOARD, "image", 0.1), parent
    )[0]
    np.testing.assert_allclose(here.matrix, place, atol=1e-8)
    size = np.concatenate([np.full(6, 1e-3), np.full(4, 1.0), np.full(5, 1e-3)])
    steps = [1e-2 * value for value in np.diag(size)]
    differences = []
    for step in steps:
        camera = eye.camera
        ahead, behind = (
            replace(
                eye,
                edge=eye.edge @ exp(sign * step[:6]),
                lens=replace(
                    eye.lens, camera=with_intrinsics(camera, intrinsics(camera) + sign * step[6:])
                ),
            )
            for sign in (1, -1)
        )
        differences.append(log(invert(placed(behind)) @ placed(ahead)) / 2)
    larger, smaller = (
        replace(BOARD, square_m=BOARD.square_m * (1 + sign * 1e-4)) for sign in (1, -1)
    )
    scale = log(invert(placed(eye, target=smaller)) @ placed(eye, target=larger)) / 2e-4
    analytic = here.by_common[:, :15] @ np.array(steps).T
    # The fit of a pose stops at steps of 1e-6, whose next ones are a hundred times smaller.
    np.testing.assert_allclose(analytic, np.array(differences).T, atol=3e-8)
    np.testing.assert_allclose(here.by_common[:, len(eye.covariance)], scale, atol=1e-4)
    for at, twist in enumerate(1e-4 * np.eye(6)):
        ahead, behind = (
            replace(sight, base_from_flange=sight.base_from_flange @ exp(sign * twist))
            for sign in (1, -1)
        )
        slope = log(invert(placed(eye, behind)) @ placed(eye, ahead)) / 2e-4
        np.testing.assert_allclose(here.flange_jacobian[:, at], slope, atol=1e-6)


@pytest.mark.parametrize(
    ("mount", "parent", "target"),
    [
        (*TREES[0], BOARD),
        slow(*TREES[1], MARKER),
        slow(*TREES[2], MARKER),
        (*TREES[3], BOARD),
    ],
)
def test_places_follow_their_stated_covariance(mount, parent, target):
    surprises = []
    for seed in range(5):
        cell, calibration = calibrated_cell(mount, seed)
        rng = np.random.default_rng(seed)
        place = place_of(cell, parent, rng, target)
        found = place_seen(
            calibration, sights_of(cell, parent, place, rng, 6, target), target, parent
        )
        assert found.inliers.all()
        error = log(invert(place) @ found.matrix)
        surprises.append(error @ np.linalg.solve(found.covariance, error) / 6)
    # Five of six degrees of freedom: sqrt(2 / 30) = 0.26; the target is of the exact size, which
    # counts as known to 0.1 %, and takes one of the six.
    assert 0.4 < np.mean(surprises) < 2.0


def test_more_images_do_not_make_the_common_part_smaller(cell):
    made, calibration = cell
    parent = "base" if made.options.mount == IN_HAND else "flange"
    rng = np.random.default_rng(3)
    place = place_of(made, parent, rng)
    sights = sights_of(made, parent, place, rng, count=12)
    few, many = (place_seen(calibration, sights[:count], BOARD, parent) for count in (3, 12))
    own, common = (
        [np.sqrt(np.trace(getattr(target_pose, name)[3:, 3:])) for target_pose in (few, many)]
        for name in ("independent", "common")
    )
    # Twelve images average what is their own to half of what three do, more or less as they are
    # placed; the target's size and the calibration stay.
    assert own[1] < 0.7 * own[0]
    assert common[1] > 0.6 * common[0]
    np.testing.assert_allclose(many.covariance, many.independent + many.common)


def test_images_of_one_stop_share_the_robots_error(cell):
    made, calibration = cell
    parent = "base" if made.options.mount == IN_HAND else "flange"
    rng = np.random.default_rng(9)
    (sight,) = sights_of(made, parent, place_of(made, parent, rng), rng, count=1)
    eye = CalibratedCamera.of(calibration)
    (place, *_) = candidate_places(
        eye, sight, target_pose_candidates(eye, sight.seen, BOARD, "image", 0.1), parent
    )
    robot = place.flange_jacobian @ eye.flange_noise @ place.flange_jacobian.T
    same = [replace(sight, label=f"image {at}") for at in range(4)]
    found = place_seen(calibration, same, BOARD, parent, sigma_px=0.1)
    # The pixels' noise is averaged, that of the one stop is not.
    np.testing.assert_allclose(found.independent, place.pixels / 4 + robot, rtol=1e-6, atol=1e-20)
    assert "of one stop of the robot" in found.warnings[0]
    # Poses that were read anew differ a little: the stop's number tells that it is one.
    moved = sight.base_from_flange @ exp(np.full(6, 1e-6))
    numbered = [replace(value, stop=5) for value in same[:3]]
    numbered.append(replace(same[3], base_from_flange=moved, stop=5))
    found = place_seen(calibration, numbered, BOARD, parent, sigma_px=0.1)
    # To the share of a micrometre in a lever of half a metre.
    np.testing.assert_allclose(found.independent, place.pixels / 4 + robot, rtol=1e-4, atol=1e-16)


def test_a_marker_seen_flat_on_may_be_tilted_the_other_way():
    cell = cell_of(TO_HAND, seed=6, pixel_sigma_px=0.3, views=8)
    calibration, rng = calibration_of(cell), np.random.default_rng(6)
    x = cell.transforms["base_from_cam"]
    small = replace(MARKER, square_m=0.03, square_sigma_m=3e-5)
    at = Stand(None, x)

    def sight(label, tilt):
        place = x @ looking(tilt, 0.0, 0.9)
        return Sight(label, corners_at(cell, at, place, small, rng))

    flat = place_seen(calibration, [sight("flat", (0.15, 0.1))], small, "base")
    assert any("tilted the other way" in warning for warning in flat.warnings)


def test_a_symmetric_board_may_be_turned(cell):
    made, calibration = cell
    parent = "base" if made.options.mount == IN_HAND else "flange"
    board = replace(BOARDS["checkerboard"], columns=7, rows=5)
    rng = np.random.default_rng(7)
    place = place_of(made, parent, rng)
    sights = sights_of(made, parent, place, rng, 3, board)
    turned = sights[1].seen
    last = board.columns * board.rows - 1
    # A detector begins at either end.
    sights[1] = replace(
        sights[1], seen=replace(turned, ids=last - turned.ids[::-1], px=turned.px[::-1])
    )
    found = place_seen(calibration, sights, board, parent)
    assert found.inliers.all()
    assert any("the same when it is turned" in warning for warning in found.warnings)
    # The first image's numbering is kept.
    assert 1e3 * np.linalg.norm((invert(place) @ found.matrix)[:3, 3]) < 3.0


@pytest.fixture(scope="module")
def marked():
    return marked_plate()


def test_markers_are_measured_points_with_a_common_part(marked):
    calibration, base_from_plate, sights = marked
    found = measure_markers(calibration, sights, list(CENTRES), "DICT_5X5_100", 0.04, sigma_px=0.1)
    assert found.names == ("0", "7", "21", "30")
    assert found.seen_in == (4, 4, 4, 4)
    on_plate = np.array([[x, y, 0.0] for x, y in CENTRES.values()])
    true = on_plate @ base_from_plate[:3, :3].T + base_from_plate[:3, 3]
    error = (found.points - true).ravel()
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
    # Twelve degrees of freedom; the calibration's own error is left out here, and counts.
    assert error @ np.linalg.solve(found.covariance, error) < 12 * 3
    assert 1e3 * np.abs(error).max() < 0.5
    # The robot and the camera move all markers alike: neighbours are correlated.
    assert found.common[:3, 3:6].trace() > 0.3 * found.common[:3, :3].trace()
    fewer = measure_markers(calibration, sights[:1], [7], "DICT_5X5_100", 0.04, sigma_px=0.1)
    assert np.trace(fewer.independent[0]) > np.trace(found.independent[1])


def test_a_marker_that_is_in_no_image_is_named(marked):
    calibration, _, sights = marked
    with pytest.raises(DataError, match="marker 50 of DICT_5X5_100 is in none of the 4 images"):
        measure_markers(calibration, sights, [0, 50], "DICT_5X5_100", 0.04)
    with pytest.raises(DataError, match=r"metres, such as 0\.04"):
        measure_markers(calibration, sights, [0], "DICT_5X5_100", 40.0)

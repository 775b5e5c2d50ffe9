"""Intrinsics from views of a board: the truth is met within the covariance that is stated."""

import cv2
import numpy as np
import pytest
from support.marks import slow

from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.intrinsics import estimate_intrinsics
from visioncal.core.errors import DataError, DegenerateError
from visioncal.session import Session
from visioncal.simulation import CellOptions, fisheye_camera, simulate, wide_camera
from visioncal.vision.camera import intrinsics
from visioncal.vision.targets import corner_positions

NOISE_PX = 0.1


def estimate(cell, model="brown", without=()):
    corners = {corner.view: corner for corner in cell.corners if corner.view not in without}
    camera = cell.options.camera
    return estimate_intrinsics(corners, [cell.options.target], camera.resolution, model)


def cell_with(camera, seed, **changes):
    return simulate(CellOptions(camera=camera, seed=seed, pixel_sigma_px=NOISE_PX, **changes))


@pytest.mark.parametrize(
    ("camera", "model"),
    [(wide_camera(), "brown"), slow(fisheye_camera(), "fisheye")],
    ids=["brown", "fisheye"],
)
def test_errors_follow_the_stated_covariance(camera, model):
    seeds = 24
    surprises, sigmas = [], []
    for seed in range(seeds):
        result = estimate(cell_with(camera, seed), model)
        error, count = intrinsics(result.camera) - intrinsics(camera), len(intrinsics(camera))
        surprises.append(error @ np.linalg.solve(result.covariance, error))
        sigmas.append(result.sigma_px)
    # The mean of `seeds` chi-square variables over their freedom has the standard deviation
    # sqrt(2 / (seeds count)) = 0.10 or less; five of it on either side.
    tolerance = 5 * np.sqrt(2 / (seeds * count))
    assert np.mean(surprises) / count == pytest.approx(1.0, abs=tolerance)
    # About 1,500 corner coordinates a cell leave the noise known to 2 %, 24 cells to 0.4 %.
    assert np.mean(sigmas) == pytest.approx(NOISE_PX, rel=0.02)


def test_agrees_with_opencv():
    cell = cell_with(wide_camera(), 1)
    places = corner_positions(cell.options.target)
    _, matrix, distortion, *_ = cv2.calibrateCamera(
        [places[corner.ids].astype(np.float32) for corner in cell.corners],
        [corner.px.astype(np.float32) for corner in cell.corners],
        cell.options.camera.resolution,
        None,
        None,
    )
    ours = estimate(cell).camera
    # Both minimise the same sum; OpenCV stops its iteration early and reads float32 pixels.
    np.testing.assert_allclose(ours.matrix, matrix[[0, 1, 0, 1], [0, 1, 2, 2]], atol=0.05)
    np.testing.assert_allclose(ours.distortion, distortion.ravel(), atol=5e-4)


def test_a_few_wrong_corners_do_no_harm_and_a_wrong_view_is_named():
    cell = cell_with(wide_camera(), 3)
    corners = {corner.view: corner for corner in cell.corners}
    for view in (2, 5):
        corners[view].px[3] += 6.0
    rng = np.random.default_rng(0)
    corners[7].px[:] += rng.normal(0.0, 12.0, corners[7].px.shape)
    result = estimate(cell)
    clean = estimate(cell_with(wide_camera(), 3), without=(7,))
    assert [rejection.view for rejection in result.rejections] == [7]
    assert "residual too large" in result.rejections[0].reason
    # Two corners of 700 less: the estimate moves by a small part of its sigma.
    sigma = np.sqrt(np.diag(clean.covariance))
    shift = intrinsics(result.camera) - intrinsics(clean.camera)
    assert np.all(np.abs(shift) < 0.5 * sigma)


def test_frontal_views_are_warned_of_or_refused():
    frontal = {"tilt_rad": (0.0, 0.05), "distance_m": (0.5, 0.6)}
    result = estimate(cell_with(wide_camera(), 4, **frontal))
    (warning,) = result.warnings
    assert "The corners alone determine the focal length to" in warning.reason
    flat = {"tilt_rad": (0.0, 0.002), "distance_m": (0.5, 0.505), "roll_rad": 0.0}
    with pytest.raises(DegenerateError, match="focal length open to"):
        estimate(cell_with(wide_camera(), 4, **flat))


def test_a_robot_that_never_moved_is_named_before_the_lens_that_this_leaves_open():
    flat = {"tilt_rad": (0.0, 0.002), "distance_m": (0.5, 0.505), "roll_rad": 0.0}
    cell = cell_with(wide_camera(), 4, **flat)
    seen, rng = cell.corners[0], np.random.default_rng(0)
    corners = [(seen.ids, seen.px + NOISE_PX * rng.normal(size=seen.px.shape)) for _ in range(12)]
    session = Session.from_corners(
        corners,
        np.tile(cell.robot.base_from_flange[0], (12, 1, 1)),
        cell.options.target,
        wide_camera().resolution,
        mount="eye-in-hand",
    )
    with pytest.raises(DegenerateError, match=r"all from one pose of the robot\. intr") as refused:
        calibrate(session)
    assert "flange is tilted by 20 to 40 degrees" in str(refused.value.next_step)


@pytest.mark.parametrize(("views", "words"), [(1, "1 view shows"), (2, "2 views show")])
def test_two_views_are_too_few(views, words):
    cell = cell_with(wide_camera(), 6, views=views)
    with pytest.raises(DataError, match=f"{words} the target, and at least 3"):
        estimate(cell)

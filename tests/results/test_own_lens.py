"""A transform that holds with its own lens only."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.cells import calibrated, showing

from visioncal.calibration.pipeline.result import result_of
from visioncal.core.transforms import invert, log
from visioncal.interchange.exports import document
from visioncal.present.report.page import write_certificate
from visioncal.results.lens import sensor_tilt
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.boards import corners_m
from visioncal.vision.camera import matrix_3x3

NAME = "flange_from_cam"
# A sensor tilted by a degree about each of its axes, behind a lens that is not decentred.
TILT_DEG = np.array([1.0, 1.0])
ORDINARY = CellOptions(
    views=20, state_intrinsics=False, pixel_sigma_px=0.05, robot_sigma_m=5e-5, robot_sigma_rad=1e-4
)


@pytest.fixture(scope="module")
def cell():
    """A cell whose camera shows what it sees by a tilted sensor, without decentring."""
    cell = simulate(replace(ORDINARY, seed=1))
    rng, camera, board = np.random.default_rng(1), cell.options.camera, corners_m(cell.board())
    # OpenCV's 14 coefficients.
    lens = np.zeros(14)
    lens[[0, 1, 4]], lens[12:] = camera.distortion[[0, 1, 4]], np.deg2rad(TILT_DEG)
    shown, zero = [], np.zeros(3)
    for pose, corners in zip(cell.cam_from_target, cell.corners, strict=True):
        points = board[corners.ids] @ pose[:3, :3].T + pose[:3, 3]
        px, _ = cv2.projectPoints(points, zero, zero, matrix_3x3(camera), lens)
        noise = rng.normal(0.0, cell.options.pixel_sigma_px, (len(points), 2))
        shown.append(replace(corners, px=px[:, 0] + noise))
    return showing(cell, shown)


@pytest.fixture(scope="module")
def result(cell):
    return result_of(calibrated(cell, joints=False))


def test_a_tilted_sensor_is_a_condition_with_its_size(cell, result):
    (condition,) = result.conditions
    assert condition.kind == "own-lens"
    error_deg = np.rad2deg(
        np.linalg.norm(log(invert(result.edges[NAME].matrix) @ cell.transforms[NAME])[:3])
    )
    assert error_deg == pytest.approx(np.linalg.norm(TILT_DEG), rel=0.1)
    assert error_deg > 10.0 * result.edges[NAME].sigma_deg
    tilt = sensor_tilt(result.camera)
    # The noise, and a tenth for the orders of distortion that decentring does not follow.
    within = 3.0 * tilt.sigma_rad + 0.1 * np.deg2rad(error_deg)
    assert tilt.rad == pytest.approx(np.deg2rad(error_deg), abs=within)


def test_every_output_carries_it(result, tmp_path):
    (condition,) = result.conditions
    write_certificate(tmp_path / "page.html", result, None, {})
    assert "own lens" in (tmp_path / "page.html").read_text()
    assert "own lens" in result._repr_html_()
    for name in ("ur", "kuka", "urdf", "easy-handeye", "zivid"):
        assert condition.words in document(result, name).warnings, name

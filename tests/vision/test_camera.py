"""The camera model against OpenCV and against central differences."""

import cv2
import numpy as np
import pytest
from support.slopes import jacobian

from visioncal.core.types import Camera
from visioncal.vision.camera import (
    intrinsics,
    matrix_3x3,
    normalise,
    project,
    project_with_jacobian,
    with_intrinsics,
)

MATRIX = np.array([900.0, 905.0, 640.5, 399.0])
CAMERAS = {
    "brown 5": Camera("brown", (1280, 800), MATRIX, np.array([-0.2, 0.06, 1e-3, -8e-4, 0.01])),
    "brown 8": Camera(
        "brown", (1280, 800), MATRIX, np.array([0.3, -0.1, 1e-3, -8e-4, 0.01, 0.4, -0.05, 0.02])
    ),
    "fisheye": Camera("fisheye", (1280, 800), MATRIX, np.array([0.05, -0.01, 4e-3, -1e-3])),
}


@pytest.fixture(params=CAMERAS.values(), ids=CAMERAS)
def camera(request):
    return request.param


@pytest.fixture
def points():
    rng = np.random.default_rng(1)
    return rng.uniform([-0.3, -0.2, 0.5], [0.3, 0.2, 0.9], (60, 3))


def test_projects_as_opencv_does(camera, points):
    function = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    expected, _ = function(
        points[:, None], np.zeros(3), np.zeros(3), matrix_3x3(camera), camera.distortion
    )
    # Two double-precision evaluations of one formula with values near 1,000 px.
    np.testing.assert_allclose(project(camera, points), expected.reshape(-1, 2), atol=1e-9)


def test_normalise_inverts_project(camera, points):
    plane = normalise(camera, project(camera, points))
    np.testing.assert_allclose(plane, points[:, :2] / points[:, 2:], atol=1e-12)


def test_jacobians_agree_with_central_differences(camera, points):
    projection = project_with_jacobian(camera, points)
    # Central differences: truncation about step^2 times third derivatives (1e3 px), rounding
    # about 1e-13 px / step; 1e-5 balances the two near 1e-7 relative to slopes of 1e3 px.
    step, tolerance = 1e-5, 1e-4
    slopes = jacobian(lambda by: project(camera, points + by), 3, step)
    np.testing.assert_allclose(projection.jacobian_point, slopes, atol=tolerance)
    values = intrinsics(camera)

    def through(by):
        return project(with_intrinsics(camera, values + by), points)

    slopes = jacobian(through, len(values), step)
    np.testing.assert_allclose(projection.jacobian_intrinsics, slopes, atol=tolerance)


def test_points_behind_the_camera_are_not_projected(camera):
    assert np.isnan(project(camera, np.array([[0.1, 0.1, -0.5]]))).all()


def test_a_pixel_beyond_the_fold_of_a_distortion_has_no_ray():
    folding = Camera("brown", (1280, 800), MATRIX, np.array([-2.0, 0.0, 0.0, 0.0, 0.0]))
    plane = normalise(folding, np.array([[1279.0, 799.0], [640.0, 400.0]]))
    assert np.isnan(plane[0]).all()
    assert np.isfinite(plane[1]).all()

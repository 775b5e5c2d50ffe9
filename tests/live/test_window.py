"""A camera's window agrees with the projection of each point."""

import numpy as np
import pytest

from visioncal.core.types import Camera
from visioncal.live.planning.visibility import FieldOfView
from visioncal.vision.camera import project

SIZE = (1280, 800)
MATRIX = np.array([600.0, 610.0, 650.0, 390.0])
LENSES = [
    ("brown", [0.0, 0.0, 0.0, 0.0, 0.0]),
    ("brown", [-0.28, 0.09, 1e-3, -5e-4, -0.01]),
    ("brown", [0.12, -0.05, 0.0, 2e-3, 0.0]),
    ("fisheye", [0.05, -0.01, 2e-3, 0.0]),
]


@pytest.mark.parametrize(("model", "distortion"), LENSES)
@pytest.mark.parametrize("edge_px", [0.0, 60.0])
def test_points_are_inside_where_they_project_inside(model, distortion, edge_px):
    camera = Camera(model, SIZE, MATRIX, np.array(distortion))
    rng = np.random.default_rng(0)
    # Directions well over the image's corners, and behind the camera.
    points = np.column_stack([rng.uniform(-1.5, 1.5, (20000, 2)), np.ones(20000)])
    points *= rng.uniform(0.2, 2.0, (20000, 1)) * rng.choice([-1.0, 1.0], (20000, 1), p=[0.1, 0.9])
    px = project(camera, points)
    high = np.array(SIZE) - 1.0 - edge_px
    inside = ((px >= edge_px) & (px <= high)).all(axis=1)
    holds = FieldOfView(camera, edge_px).holds(points[:, None])
    # A ray beyond the fold of a lens model comes back into the image; the window leaves it out.
    np.testing.assert_array_equal(holds, inside & _before_the_fold(camera, points))
    assert 0.1 < holds.mean() < 0.9


def test_all_points_of_a_group_must_be_inside():
    window = FieldOfView(Camera("brown", SIZE, MATRIX, np.zeros(5)), 0.0)
    ahead, aside = np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 1.0])
    groups = np.array([[ahead, ahead], [ahead, aside]])
    assert window.holds(groups).tolist() == [True, False]
    assert window.holds(groups[:0]).shape == (0,)


def _before_the_fold(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Whether the projection still moves outwards with the ray."""
    farther = points * [1.0 + 1e-6, 1.0 + 1e-6, 1.0]
    middle = camera.matrix[2:]
    with np.errstate(invalid="ignore"):
        return np.linalg.norm(project(camera, farther) - middle, axis=1) > np.linalg.norm(
            project(camera, points) - middle, axis=1
        )

"""Maps from pixels to a board, against lenses that are known."""

import numpy as np
import pytest

from visioncal.simulation import BOARDS, CellOptions, simulate
from visioncal.simulation.optics import fisheye_camera, project, wide_camera
from visioncal.vision.boards.maps import OpticalAxis, maps_about

TAGS = BOARDS["tags"]
SIDE_M = 0.05


# Polynomials alone leave 0.006 and 0.15 px.
@pytest.mark.parametrize(
    ("camera", "most_px"), [(wide_camera(), 0.0015), (fisheye_camera(), 0.006)]
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
        beside = places[whole] + 0.1 * (
            places[np.roll(whole.reshape(-1, 4), -1, axis=1).ravel()] - places[whole]
        )
        beside_px = project(camera, beside @ cam_from_target[:3, :3].T + cam_from_target[:3, 3])
        board, px = places[whole, :2] / SIDE_M, corners.px[whole]
        every = np.arange(len(px))
        on_board = maps_about(board, px, every >= 0, every, axis)[0]
        off = on_board(beside_px[:, None])[:, 0] - (beside[:, :2] / SIDE_M - board)
        scale = np.linalg.norm(np.diff(px[:2], axis=0)) / np.linalg.norm(np.diff(board[:2], axis=0))
        errors.append(scale * off)
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < most_px

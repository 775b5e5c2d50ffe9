"""Boards of random dots: printed, found in rendered images, and a cell calibrated with one."""

import numpy as np
import pytest
from support.commands import visioncal

from visioncal.core.errors import DataError
from visioncal.simulation import CAMERAS, CellOptions, prepare_scene, render, simulate
from visioncal.vision.boards import DetectedCorners, NotFound, find_target
from visioncal.vision.targets import (
    corner_positions,
    load_target,
    target_document,
    target_from_document,
)


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A printed board, by the files that its printing wrote."""
    folder = tmp_path_factory.mktemp("board")
    done = visioncal("target", "make", "--kind", "dots", "-o", folder)
    assert done.status == 0, done.err
    (path,) = folder.glob("*.toml")
    assert path.with_suffix(".pdf").stat().st_size > 0
    return load_target(path)


def test_a_board_is_what_its_files_say(board):
    assert target_from_document(target_document(board), board.name) == board
    assert len(corner_positions(board)) == 14 * 9
    alike = {"points": {**target_document(board)["points"], "radius_m": [2e-3] * 126}}
    with pytest.raises(DataError, match=r"4 dots of 1\.3 times the usual radius"):
        target_from_document({"kind": "dots", **alike}, "mine")


@pytest.mark.parametrize("camera", ["wide", "fisheye"])
def test_centres_are_exact_and_rightly_numbered(board, camera):
    cell = simulate(
        CellOptions(target=board, camera=CAMERAS[camera], views=4, cut_views=0.0, seed=1)
    )
    scene = prepare_scene(cell)
    for view, exact in enumerate(cell.exact_corners):
        seen = find_target(render(scene, view), board)
        assert isinstance(seen, DetectedCorners), seen
        # A fisheye sees the rim so aslant that its dots are thin ellipses.
        assert len(seen.ids) >= (0.9 if camera == "wide" else 0.7) * len(exact.ids)
        places = dict(zip(exact.ids.tolist(), exact.px, strict=True))
        error = seen.px - [places[number] for number in seen.ids.tolist()]
        # The centre of an ellipse would be off by 0.05 px and more where it is seen aslant.
        assert np.sqrt(np.mean(error**2)) < 0.015
    assert isinstance(find_target(np.full((400, 600), 200, np.uint8), board), NotFound)

"""Corners of another detector, numbered or counted otherwise than the drawing of the target."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import slow

import visioncal
from visioncal.core.errors import DataError
from visioncal.core.types import Target
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate
from visioncal.vision.targets import load_target

SQUARE = Target("board", "charuco", 6, 6, 0.03, 1e-6, marker_m=0.022, dictionary="DICT_5X5_100")


def bottom_up(ids, columns, rows):
    return columns * (rows - 1 - ids // columns) + ids % columns


def by_column(ids, columns, rows):
    return rows * (ids % columns) + ids // columns


def renumbered(order, target, mount="eye-in-hand"):
    """A sound cell, and its session with the corners numbered in another order."""
    cell = simulate(CellOptions(mount=mount, views=16, seed=3, target=target))
    inset = 1 if target.kind == "charuco" else 0
    columns, rows = target.columns - inset, target.rows - inset
    seen = [(order(view.ids, columns, rows), view.px) for view in cell.corners]
    session = Session.from_corners(
        seen, cell.robot.base_from_flange, target, cell.stated[""].resolution, mount=mount
    )
    return cell, session


@pytest.mark.parametrize(
    ("order", "target", "mount"),
    [
        (bottom_up, load_target("checkerboard_9x6_25mm"), "eye-to-hand"),
        slow(by_column, SQUARE, "eye-in-hand"),
    ],
)
def test_numbers_that_turn_the_board_over_are_named(order, target, mount):
    cell, session = renumbered(order, target, mount)
    found = visioncal.calibrate(session)
    assert found.verdict.status == "check"
    cause = found.verdict.causes[0]
    assert cause.kind == "corner_numbers"
    assert cause.words.startswith("corners.csv numbers the corners of the board as if it was seen")
    assert "row by row from corner 0" in str(cause.do)
    # The board's z axis points at the camera, and the camera is where it is.
    board = "base_from_target" if mount == "eye-in-hand" else "flange_from_target"
    assert found.edges[board].matrix[:3, 2] @ cell.transforms[board][:3, 2] < -0.99
    (camera,) = set(cell.transforms) - {board}
    assert np.linalg.norm((found.edges[camera].matrix - cell.transforms[camera])[:3, 3]) < 1e-3
    assert [finding.kind for finding in visioncal.doctor(session).findings] == ["corner_numbers"]


def test_a_marker_numbered_counterclockwise_is_named():
    marker = replace(load_target("aruco_4x4_50_id0_120mm"), square_sigma_m=1e-6)
    _, session = renumbered(lambda ids, *_: ids[::-1], marker)
    causes = visioncal.calibrate(session).verdict.causes
    assert "counterclockwise" in causes[0].words


@pytest.mark.slow
def test_numbers_as_drawn_are_not_accused():
    for order in (lambda ids, *_: ids, lambda ids, columns, rows: columns * rows - 1 - ids):
        _, session = renumbered(order, load_target("checkerboard_9x6_25mm"))
        assert visioncal.calibrate(session).verdict.status == "good"
        assert visioncal.doctor(session).is_sound


def test_corners_outside_the_stated_image_are_refused():
    cell = simulate(CellOptions(views=12, seed=3))
    assert cell.stated[""].resolution == (1280, 800)
    flange, target = cell.robot.base_from_flange, cell.options.target
    for size, moved in (((640, 400), 0.0), ((1280, 800), [-1280, 0])):
        seen = [(view.ids, view.px + moved) for view in cell.corners]
        session = Session.from_corners(seen, flange, target, size, mount="eye-in-hand")
        with pytest.raises(DataError, match="lie outside the image of") as refused:
            visioncal.calibrate(session)
        px = np.concatenate([px for _, px in seen])
        assert f"u_px is {px[:, 0].min():.1f} to {px[:, 0].max():.1f}" in refused.value.message
        assert "Correct resolution" in refused.value.next_step
        said = refused.value.message
        (found,) = (item for item in visioncal.doctor(session).findings if item.words == said)
        assert found.do.words == refused.value.next_step

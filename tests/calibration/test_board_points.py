"""Corners that are elsewhere on the board in all views are named, and counted in the result."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.cells import calibrated, error_of, known_of, showing
from support.marks import slow

from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.board_points import point_errors
from visioncal.core.quantiles import FALSE_ALARM
from visioncal.simulation import BOARDS, CellOptions, simulate
from visioncal.vision.targets import corner_positions

BOARD = BOARDS["checkerboard"]
COLUMNS = len(np.unique(corner_positions(BOARD)[:, 0].round(6)))
ROW = np.arange(len(corner_positions(BOARD))) // COLUMNS


def with_print(cell, shifts_m):
    """A cell whose board has corners (c, 2) elsewhere, by the homography of each view."""
    positions, found = corner_positions(cell.options.target)[:, :2], []
    for corners in cell.corners:
        flat = positions[corners.ids]
        plane, _ = cv2.findHomography(flat, corners.px)
        moved = flat + shifts_m[corners.ids]
        seen = (cv2.perspectiveTransform(at[:, None], plane)[:, 0] for at in (moved, flat))
        found.append(replace(corners, px=corners.px + np.subtract(*seen)))
    return showing(cell, found)


def on_board_state(cell):
    """A cell's state with lenses, and the poses of its boards."""
    known = known_of(cell)
    for stage in STAGES:
        if stage.name in ("intrinsics", "pnp"):
            known = stage.run(known)
    return known


def on_board(cell):
    """The errors of the places of a cell's corners, by its images."""
    known = on_board_state(cell)
    lens = known.lenses["cam"].camera
    poses = {view: pose.cam_from_target[0] for view, pose in known.poses.items()}
    corners = {view: known.corners[view] for view in poses}
    return point_errors(known.session.boards[""], lens, corners, poses)


@pytest.mark.parametrize("shift_mm", [0.36, slow(0.72)])
def test_a_row_that_was_glued_back_is_named_and_harms_no_result(shift_mm):
    shifts = 1e-3 * shift_mm * np.outer(ROW == 2, [0.55, 0.83])
    cell = with_print(simulate(CellOptions(target=BOARD, pixel_sigma_px=0.06, seed=3)), shifts)
    known = calibrated(cell)
    first = known.verdict.findings[0]
    assert (known.verdict.status, first.kind) == ("check", "board_shape")
    words = f"row 3 of its corners {shift_mm:.2f} mm from where the others have them"
    assert words in first.words
    off = error_of(cell, known)[:6]
    covariance = known.assessment.fit.whole[:6, :6]
    assert off @ np.linalg.solve(covariance, off) < 22.5  # 99.9 % of chi-square with 6 degrees.


def test_a_print_that_is_off_everywhere_has_its_size():
    shifts = np.random.default_rng(4).normal(0.0, 2e-4, (len(ROW), 2))
    found = on_board(with_print(simulate(CellOptions(target=BOARD, seed=4)), shifts))
    assert found.p_value < FALSE_ALARM
    assert found.sigma_m == pytest.approx(2e-4, rel=0.25)


@pytest.mark.parametrize("at", [0, 5, 11])
def test_a_board_that_stands_still_before_a_fixed_camera_is_not_loose(at):
    """Each corner then lies at one place of the image, where the lens may err as the print may."""
    cell = simulate(CellOptions(target=BOARD, pixel_sigma_px=0.01, seed=4))
    known, rng = on_board_state(cell), np.random.default_rng(at)
    view = sorted(known.corners)[at]
    corners, pose = known.corners[view], known.poses[view].cam_from_target[0]
    seen = {
        time: replace(corners, px=corners.px + rng.normal(0.0, 0.005, corners.px.shape))
        for time in range(20)
    }
    found = point_errors(BOARD, known.lenses["cam"].camera, seen, dict.fromkeys(seen, pose))
    # All are off by 0.01 px; the print would be by as much on the board, which tilts by 45 deg at
    # most; its estimate of some 50 directions scatters by a tenth.
    metres_by_px = pose[2, 3] / known.lenses["cam"].camera.matrix[0]
    assert found.sigma_m < 1.3 * np.sqrt(2.0) * 0.01 * metres_by_px


@pytest.mark.parametrize("every", [1, slow(2)])
def test_corners_under_glare_are_left_out(every):
    cell = simulate(CellOptions(target=BOARD, pixel_sigma_px=0.06, roll_rad=2.0, seed=5))
    wrong = np.flatnonzero(np.arange(len(ROW)) % COLUMNS < 2)
    seen = [
        replace(at, px=at.px + 0.5 * np.outer(np.isin(at.ids, wrong), [index % every == 0, 0.0]))
        for index, at in enumerate(cell.corners)
    ]
    glared = showing(cell, seen)
    known = calibrated(glared)
    used = np.concatenate([pose.corners.ids for pose in known.poses.values()])
    assert set(wrong.tolist()).isdisjoint(used.tolist())
    assert known.verdict.status == "good"
    assert "unsteady_corners" in {finding.kind for finding in known.verdict.findings}
    off, covariance = error_of(glared, known)[:6], known.assessment.fit.whole[:6, :6]
    assert off @ np.linalg.solve(covariance, off) < 22.5


@pytest.mark.parametrize("name", ["charuco", "checkerboard", slow("aprilgrid"), "circles"])
def test_sound_boards_have_no_unsteady_corners(name):
    for seed in range(2):
        bow_m = 5e-4 * (seed % 2)
        found = on_board(simulate(CellOptions(target=BOARDS[name], seed=seed, board_bow_m=bow_m)))
        assert found.p_value > FALSE_ALARM
        assert not len(found.unsteady)

"""The target's pose in each view: its covariance, its rivals, and the gate of its corners."""

from dataclasses import replace

import numpy as np
import pytest

from visioncal.calibration.stages.init_frames import init_frames
from visioncal.calibration.stages.pnp import estimate_poses
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import Corners
from visioncal.estimation.chain import chain
from visioncal.estimation.closed_form import SOLVERS
from visioncal.simulation import BOARDS, CellOptions, project, simulate, wide_camera
from visioncal.vision.targets import corner_positions, rotations

NOISE_PX = 0.2


def corners_of(cell):
    return {corner.view: corner for corner in cell.corners}


def poses_of(cell, corners=None):
    return estimate_poses(corners or corners_of(cell), [cell.options.target], cell.options.camera)


def chosen_of(result, cell):
    """The views with the one pose that the robot's motion leaves to each."""
    first = np.array([view.cam_from_target[0] for view in result.views])
    problem = chain("eye-in-hand", cell.robot.base_from_flange, first)
    return init_frames(problem, result.views, {"target": cell.options.target})


def test_poses_follow_their_stated_covariance():
    surprises = []
    for seed in range(10):
        cell = simulate(CellOptions(seed=seed, pixel_sigma_px=NOISE_PX))
        result = poses_of(cell)
        assert result.sigma_px == pytest.approx(NOISE_PX, rel=0.1)
        for view in result.views:
            error = log(invert(cell.cam_from_target[view.view]) @ view.cam_from_target[0])
            surprises.append(error @ np.linalg.solve(view.covariance[0], error) / 6)
    # 200 poses of 6 degrees of freedom: standard deviation sqrt(2 / 1200) = 0.04; five of it,
    # and the curvature that a linear covariance neglects.
    assert np.mean(surprises) == pytest.approx(1.0, abs=0.2)


def test_both_planar_solutions_are_kept_while_ambiguous():
    # A small board far away: perspective hardly tells the tilt's sign.
    far = CellOptions(
        views=12,
        seed=1,
        pixel_sigma_px=0.5,
        distance_m=(1.2, 1.5),
        tilt_rad=(0.15, 0.4),
        robot="ur10e",
        target=replace(BOARDS["checkerboard"], columns=4, rows=3, name="small"),
    )
    cell = simulate(far)
    result = poses_of(cell)
    rivals = [view for view in result.views if len(view.cam_from_target) == 2]
    assert len(rivals) >= 3
    choice = chosen_of(result, cell)
    wrong_by_image = 0
    for view in choice.views:
        candidates = result.views[view.view].cam_from_target
        away = np.linalg.norm(log(invert(cell.cam_from_target[view.view]) @ candidates), axis=1)
        assert np.array_equal(view.cam_from_target[0], candidates[away.argmin()])
        wrong_by_image += int(away.argmin() != 0)
    # The image alone picks the mirrored pose in some views, or the test would show nothing.
    assert wrong_by_image >= 1
    assert len(choice.views) >= 8
    assert len(choice.views) + len(choice.rejections) == len(result.views)


def test_near_views_of_a_large_board_have_one_pose():
    cell = simulate(CellOptions(seed=2, pixel_sigma_px=0.05, tilt_rad=(0.4, 0.7)))
    assert all(len(view.cam_from_target) == 1 for view in poses_of(cell).views)


def test_a_pose_that_both_starts_run_into_has_no_rival():
    # Corners so exact that a pose costs more where the one fit left it than where the other did.
    cell = simulate(CellOptions(seed=9, pixel_sigma_px=0.01, tilt_rad=(0.1, 0.3)))
    for view in poses_of(cell).views:
        first, *others = view.cam_from_target
        assert all(np.linalg.norm(log(invert(first) @ other)[:3]) > 1e-3 for other in others)


def test_wrong_corners_are_left_out_and_wrong_views_named():
    cell = simulate(CellOptions(seed=4, pixel_sigma_px=0.1))
    corners = corners_of(cell)
    corners[1].px[0] += [5.0, -3.0]
    corners[6].px[:] = np.roll(corners[6].px, 3, axis=0)
    result = poses_of(cell, corners)
    assert [rejection.view for rejection in result.rejections] == [6]
    view = next(view for view in result.views if view.view == 1)
    assert len(view.corners.ids) == len(corners[1].ids) - 1
    assert corners[1].ids[0] not in view.corners.ids


@pytest.mark.parametrize("size", [(9, 7), (7, 7), (6, 6)])
def test_symmetric_boards_are_made_consistent_by_the_motion(size):
    columns, rows = size
    target = replace(BOARDS["checkerboard"], name="symmetric", columns=columns, rows=rows)
    cell = simulate(CellOptions(views=14, seed=7, target=target, pixel_sigma_px=0.1))
    turns = rotations(target)
    assert len(turns) > 1
    rng = np.random.default_rng(0)
    corners = {}
    for view_corners in cell.corners:
        # A detector numbers the corners from any end that looks alike.
        ids = turns[rng.integers(len(turns))][view_corners.ids]
        order = np.argsort(ids)
        corners[view_corners.view] = Corners(
            view_corners.view, ids[order], view_corners.px[order], view_corners.blur_px
        )
    result = poses_of(cell, corners)
    choice = chosen_of(result, cell)
    assert not choice.rejections
    camera = np.array([view.cam_from_target[0] for view in choice.views])
    answer = SOLVERS["park"](cell.robot.base_from_flange, camera)
    placed = cell.robot.base_from_flange @ answer.x @ camera
    # Views agree to the noise, not to within a board's width.
    assert np.ptp(placed[:, :3, 3], axis=0).max() < 2e-3
    # The camera's transform does not depend on which end is called first.
    assert np.linalg.norm(answer.x[:3, 3] - cell.transforms["flange_from_cam"][:3, 3]) < 1e-3
    positions = corner_positions(target)
    for view, pose in zip(choice.views, camera, strict=True):
        points = positions[view.corners.ids] @ pose[:3, :3].T + pose[:3, 3]
        # Renumbered with their pose, the corners project onto themselves.
        away = project(cell.options.camera, points) - view.corners.px
        assert np.abs(away).max() < 1.0


def test_a_turn_of_all_views_alike_is_only_a_change_of_the_targets_frame():
    target = replace(BOARDS["checkerboard"], name="symmetric", columns=9, rows=7)
    cell = simulate(CellOptions(views=8, seed=9, target=target, pixel_sigma_px=0.1))
    choice = chosen_of(poses_of(cell), cell)
    assert len({view.turns for view in choice.views}) == 1


def test_a_start_far_off_finds_the_same_poses():
    from visioncal.estimation.corners import CornerStack
    from visioncal.estimation.poses import fit_poses

    cell = simulate(CellOptions(views=6, seed=5, pixel_sigma_px=0.1))
    stack = CornerStack.of(corners_of(cell), corner_positions(cell.options.target))
    push = exp(np.tile([0.2, -0.15, 0.1, 0.02, -0.03, 0.05], (6, 1)))
    near = fit_poses(stack, wide_camera(), cell.cam_from_target)
    far = fit_poses(stack, wide_camera(), cell.cam_from_target @ push)
    # Both run to the same minimum, where steps fall under 1e-10.
    np.testing.assert_allclose(far.cam_from_target, near.cam_from_target, atol=1e-8)

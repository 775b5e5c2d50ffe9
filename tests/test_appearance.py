"""Lens and board as unknowns of all views: derivatives, and what is set free when."""

from dataclasses import replace

import numpy as np
import pytest
from cells import calibrated, error_of, known_of

from visioncal.camera import intrinsics
from visioncal.estimator.appearance import BOARD_NAMES, SCALE, Appearance, board_basis, compress
from visioncal.estimator.corners import CornerStack
from visioncal.simulation import CellOptions, fine_camera, simulate
from visioncal.targets import corner_positions
from visioncal.transforms import invert, log
from visioncal.types import Target

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)


def compressed(cell, change=None):
    """The cell's corners under its true lens and a flat board, both changed by a vector."""
    positions = corner_positions(cell.options.target)
    stack = CornerStack.of({it.view: it for it in cell.corners}, positions)
    appearance = Appearance(cell.options.camera, np.zeros(len(BOARD_NAMES)))
    if change is not None:
        appearance = appearance.moved(change)
    return compress(stack, board_basis(positions), appearance, cell.cam_from_target)


def test_poses_and_cost_follow_lens_and_board_as_their_derivatives_say():
    cell = simulate(replace(FINE, views=6, seed=1, pixel_sigma_px=0.02))
    middle = compressed(cell)
    size = len(intrinsics(cell.options.camera)) + len(BOARD_NAMES)
    # Steps that move corners by about a tenth of a pixel.
    steps = np.concatenate([np.full(4, 0.1), np.full(5, 1e-3), np.full(2, 1e-5), np.full(7, 1e-5)])
    for at in range(size):
        shift = np.zeros(size)
        shift[at] = steps[at]
        ahead, behind = compressed(cell, shift), compressed(cell, -shift)
        centre = invert(middle.cam_from_target)
        slope = (log(centre @ ahead.cam_from_target) - log(centre @ behind.cam_from_target)) / (
            2 * steps[at]
        )
        # Gauss-Newton's derivative leaves out residual times curvature: 0.02 px of residual over
        # hundreds of pixels of board, and the steps' own curvature: a percent of the largest.
        limit = 0.01 * np.abs(slope).max()
        np.testing.assert_allclose(middle.by_shared[:, :, at], slope, atol=limit)
        cost = np.sum(ahead.residuals**2) - np.sum(behind.residuals**2)
        pull, curvature = 4 * steps[at] * middle.shared_pull[at], middle.shared_information[at, at]
        if at != 9 + SCALE:
            # Of a symmetric difference the third order is left: small beside the second.
            assert cost == pytest.approx(pull, abs=0.02 * 2 * curvature * steps[at] ** 2)


def test_the_corners_alone_do_not_tell_the_size():
    middle = compressed(simulate(replace(FINE, views=6, seed=1)))
    grown = compressed(simulate(replace(FINE, views=6, seed=1)), np.eye(18)[9 + SCALE] * 0.01)
    assert np.all(middle.shared_information[9 + SCALE] == 0.0)
    # Fits to the same pixels settle to 1e-8 m, which is a millionth of a pixel.
    np.testing.assert_allclose(grown.residuals, middle.residuals, atol=1e-4)


@pytest.mark.parametrize("given", [True, False], ids=["lens given", "lens estimated"])
def test_a_flat_board_of_the_stated_size_stays_so(given):
    for seed in range(4):
        known = calibrated(simulate(replace(FINE, state_intrinsics=given, seed=seed)))
        moving = known.free.columns[~known.free.anchored]
        assert len(moving) == (0 if given else 9)
        assert np.all(known.free.after(known.solved.edges.shared).board == 0.0)


@pytest.mark.parametrize("given", [True, False], ids=["lens given", "lens estimated"])
def test_a_bent_board_is_noticed_and_costs_nothing(given):
    errors = {0.0: [], 3e-4: []}
    for bow_m, kept in errors.items():
        for seed in range(4):
            options = replace(FINE, state_intrinsics=given, seed=seed, board_bow_m=bow_m)
            known = calibrated(simulate(options))
            assert any("not flat" in it for it in known.warnings) == (bow_m > 0.0)
            kept.append(error_of(simulate(options), known)[:6])
    flat, bent = (np.sqrt(np.mean(np.square(it), axis=0)) for it in errors.values())
    lengths = [np.linalg.norm(it[part]) for it in (flat, bent) for part in (slice(3), slice(3, 6))]
    # The same noise in both: what differs is the price of seven more unknowns.
    assert lengths[2] < 1.2 * lengths[0]
    assert lengths[3] < 1.2 * lengths[1]


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_board_of_another_size_is_noticed_by_the_robot(mount):
    cell = simulate(replace(FINE, mount=mount, seed=3, board_scale=1.002))
    known = calibrated(cell)
    (sentence,) = [it for it in known.warnings if "robot's motion" in it]
    assert "0.2" in sentence
    assert "larger than stated" in sentence
    error = error_of(cell, known)[:6]
    # Within what a board known to 0.1 % allows, not off by 0.2 % of 0.6 m.
    assert error @ np.linalg.solve(known.solved.covariance[:6, :6], error) < 22.5


def test_given_intrinsics_that_do_not_fit_are_refined_or_held_as_asked():
    cell = simulate(replace(FINE, seed=5, views=15))
    off = np.array([6.0, 6.0, -8.0, 5.0])
    wrong = replace(cell.options.camera, matrix=cell.options.camera.matrix + off)
    told = replace(cell, options=replace(cell.options, camera=wrong))
    known = calibrated(told)
    assert any("given intrinsics do not fit" in it for it in known.warnings)
    refined = known.free.after(known.solved.edges.shared).camera
    lens = 12 + np.flatnonzero(known.free.columns < known.free.lens_count)
    sigma = np.sqrt(np.diag(known.solved.covariance))[lens[:4]]
    assert np.all(np.abs(refined.matrix - cell.options.camera.matrix) < 4.0 * sigma)
    table = {"intrinsics": "hold"}
    document = known_of(told).session.document
    session = replace(
        known_of(told).session, document=document | {"camera": document["camera"] | table}
    )
    held = calibrated(told, session=session)
    assert held.free.after(held.solved.edges.shared).camera.matrix == pytest.approx(wrong.matrix)


def test_too_few_corners_leave_the_lens_alone():
    marker = Target("tag", "marker", 1, 1, 0.12, 1e-4, dictionary="DICT_4X4_50", marker_id=0)
    cell = simulate(replace(FINE, seed=2, views=15, target=marker))
    document = known_of(cell).session.document
    camera = document["camera"] | {"intrinsics": "refine"}
    session = replace(known_of(cell).session, document=document | {"camera": camera})
    known = calibrated(cell, session=session)
    assert not known.free.lens_is_free
    assert any('"refine" was not done: 60 corners in 15 views' in it for it in known.warnings)

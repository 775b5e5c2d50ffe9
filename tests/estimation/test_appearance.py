"""Lens and board as unknowns of all views: derivatives, and what is set free when."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.cells import calibrated, error_of, known_of, showing
from support.marks import slow

from visioncal.core.transforms import invert, log
from visioncal.core.types import Target
from visioncal.estimation.appearance import (
    BOARD_NAMES,
    SCALE,
    Appearance,
    board_basis,
    boards_basis,
    compress,
)
from visioncal.estimation.corners import CornerStack
from visioncal.estimation.poses import reproject
from visioncal.simulation import CellOptions, fine_camera, simulate
from visioncal.vision.camera import intrinsics, project
from visioncal.vision.targets import corner_positions

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)
MOUNTS = ("eye-in-hand", "eye-to-hand")


def compressed(cell, change=None):
    """The cell's corners under its true lens and a flat board, both changed by a vector."""
    positions = corner_positions(cell.options.target)
    stack = CornerStack.of({corner.view: corner for corner in cell.corners}, positions)
    appearance = Appearance(cell.options.camera, np.zeros(len(BOARD_NAMES)))
    if change is not None:
        appearance = appearance.moved(change)
    scales = np.array([9 + SCALE])
    return compress(stack, board_basis(positions), appearance, cell.cam_from_target, scales)


def test_poses_and_cost_follow_lens_and_board_as_their_derivatives_say():
    cell = simulate(replace(FINE, views=6, seed=1, pixel_sigma_px=0.02))
    middle = compressed(cell)
    size = len(intrinsics(cell.options.camera)) + len(BOARD_NAMES)
    # Steps that move corners by about a tenth of a pixel.
    steps = np.concatenate([np.full(4, 0.1), np.full(5, 1e-3), np.full(10, 1e-5)])
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
        gradient, curvature = (
            4 * steps[at] * middle.shared_gradient[at],
            middle.shared_information[at, at],
        )
        if at != 9 + SCALE:
            # Of a symmetric difference the third order is left: small beside the second.
            assert cost == pytest.approx(gradient, abs=0.02 * 2 * curvature * steps[at] ** 2)


def test_the_poses_take_their_share_of_the_information_and_no_more():
    cell = simulate(replace(FINE, views=6, seed=0))
    found = compressed(cell)
    positions = corner_positions(cell.options.target)
    stack = CornerStack.of(
        {view_corners.view: view_corners for view_corners in cell.corners}, positions
    )
    now = reproject(stack, cell.options.camera, found.cam_from_target)
    by_board = now.by_pose[:, :, 3:] @ board_basis(positions)[stack.ids]
    by_shared = np.concatenate([now.by_intrinsics, by_board], axis=2)
    left = 0.0
    for view in range(6):
        mine = stack.view_of == view
        span = np.linalg.qr(np.concatenate(now.by_pose[mine]))[0]
        rows = np.concatenate(by_shared[mine])
        rows -= span @ (span.T @ rows)
        left += rows.T @ rows
    open_ones = np.flatnonzero(np.arange(len(left)) != 9 + SCALE)
    among = np.ix_(open_ones, open_ones)
    scale = np.sqrt(np.diag(left)[open_ones])
    scale = scale[:, None] * scale
    # The poses are at rest to 1e-8, and what they take is a million times what they leave.
    np.testing.assert_allclose(
        np.linalg.eigvalsh(found.shared_information[among] / scale),
        np.linalg.eigvalsh(left[among] / scale),
        rtol=1e-4,
    )


def test_the_corners_alone_do_not_tell_the_size():
    middle = compressed(simulate(replace(FINE, views=6, seed=1)))
    grown = compressed(simulate(replace(FINE, views=6, seed=1)), np.eye(19)[9 + SCALE] * 0.01)
    assert np.all(middle.shared_information[9 + SCALE] == 0.0)
    # Fits to the same pixels settle to 1e-8 m, which is a millionth of a pixel.
    np.testing.assert_allclose(grown.residuals, middle.residuals, atol=1e-4)


def mahalanobis_sq(cell, known, size=12) -> float:
    """Squared error of the edges in units of the stated covariance: chi-square if that is true."""
    error = error_of(cell, known)[:size]
    return float(error @ np.linalg.solve(known.assessment.covariance[:size, :size], error))


@pytest.mark.parametrize(
    "given",
    [True, slow(False)],
    ids=["lens given", "lens estimated"],
)
def test_a_bent_board_is_noticed_and_costs_nothing(given):
    stated = {0.0: [], 3e-4: []}
    errors_sq = []
    for bow_m, sigmas_sq in stated.items():
        for seed in range(2):
            options = replace(FINE, state_intrinsics=given, seed=seed, board_bow_m=bow_m)
            known = calibrated(simulate(options))
            assert any("not flat" in warning.reason for warning in known.warnings) == (bow_m > 0.0)
            sigmas_sq.append(np.diag(known.assessment.covariance)[:6])
            if bow_m > 0.0:
                errors_sq.append(mahalanobis_sq(simulate(options), known, size=6))
    flat, bent = (np.sqrt(np.mean(sigmas_sq, axis=0)) for sigmas_sq in stated.values())
    # Seven more unknowns take 1 to 2 % of sigma over 16 seeds; and what is stated is true.
    assert np.all(bent < 1.05 * flat)
    assert sum(errors_sq) < chi2.ppf(0.999, 6 * len(errors_sq))


# A true covariance exceeds it in one run of a thousand.
UNLIKELY = chi2.ppf(0.999, 12)


def printed_anew(cell, change):
    """The cell's corners, on a board whose flat corners are where a (3, 3) matrix has them."""
    flat, camera = corner_positions(cell.options.target), cell.options.camera

    def seen(value, pose, places):
        return project(camera, places[value.ids] @ pose[:3, :3].T + pose[:3, 3])

    corners = tuple(
        replace(
            corner, px=corner.px + seen(corner, pose, flat @ change.T) - seen(corner, pose, flat)
        )
        for corner, pose in zip(cell.corners, cell.cam_from_target, strict=True)
    )
    return showing(cell, corners)


@pytest.mark.parametrize(
    ("mount", "change", "words"),
    [
        (MOUNTS[0], np.diag([-5e-4, 5e-4, 0.0]), "longer along its y than along its x, by 0.1 %"),
        slow(
            MOUNTS[1],
            [[0, 7.5e-4, 0], [7.5e-4, 0, 0], [0, 0, 0]],
            "rows and columns meet at 89.91",
        ),
    ],
    ids=["stretched", "sheared"],
)
def test_a_board_that_is_printed_askew_is_named_and_costs_nothing(mount, change, words):
    cell = printed_anew(simulate(replace(FINE, mount=mount, seed=4)), np.eye(3) + change)
    known = calibrated(cell)
    (finding,) = [warning for warning in known.warnings if warning.kind == "board_shape"]
    assert words in finding.reason
    assert "not flat" not in finding.reason
    assert mahalanobis_sq(cell, known) < UNLIKELY


def test_a_board_within_what_is_stated_is_measured_and_not_accused():
    cell = simulate(replace(FINE, seed=3, board_scale=1.002))
    known = calibrated(cell)
    (sentence,) = [reason for reason in known.verdict.reasons if "robot's motion" in reason]
    assert "% larger than stated" in sentence
    assert "The stated size allows this (to within 0.1 %)" in sentence
    assert "mm" not in sentence
    assert known.verdict.status == "good"
    assert mahalanobis_sq(cell, known) < UNLIKELY


@pytest.mark.parametrize(
    ("joints", "scale", "mount"),
    [
        slow(True, 0.97, "eye-to-hand"),
        (False, 0.97, "eye-in-hand"),
        slow(False, 1.01, "eye-to-hand"),
    ],
)
def test_a_size_that_is_contradicted_is_dropped_and_no_arm_is_blamed(mount, scale, joints):
    """As after printing with `fit to page`: the robot's measure is all that is left."""
    cell = simulate(replace(FINE, mount=mount, seed=3, board_scale=scale))
    known = calibrated(cell, joints=joints)
    assert any("The result takes the robot's scale" in reason for reason in known.verdict.reasons)
    assert known.verdict.status == "check"
    assert known.robot_arm.errors is None or not known.robot_arm.errors.is_significant
    assert mahalanobis_sq(cell, known) < UNLIKELY
    # Left as stated, the camera would be off by 5 mm and more.
    assert np.linalg.norm(error_of(cell, known)[3:6]) < 0.5e-3


@pytest.mark.slow
def test_a_size_that_is_held_counts_by_what_the_views_say_against_it():
    """Sizes drawn as the file states them, an arm too coarse to measure them."""
    rng = np.random.default_rng(1)
    coarse = replace(FINE, robot_sigma_m=3e-4, robot_sigma_rad=5e-4)
    seen = []
    for seed in range(12):
        scale = 1.0 + 1e-3 * rng.standard_normal()
        cell = simulate(replace(coarse, seed=seed, board_scale=scale))
        seen.append(mahalanobis_sq(cell, calibrated(cell)))
    # Twelve chi-squares of twelve: 144 +- 17, and 199 in one of a thousand.
    assert sum(seen) < chi2.ppf(0.999, 144)
    assert sum(seen) > chi2.ppf(0.001, 144)


def with_lens(cell, off, **table):
    """What is known at the end where the session states a lens that is off by (4,) pixels."""
    wrong = replace(cell.options.camera, matrix=cell.options.camera.matrix + off)
    told = replace(cell, stated={"": wrong})
    session = known_of(told).session
    camera = session.document["camera"] | table
    return calibrated(
        told, session=replace(session, document=session.document | {"camera": camera})
    )


def lens_is_free(known):
    """Whether the fit moves the intrinsics."""
    return np.isin(
        known.cell_fit.camera_parameters.lens_of("cam"), known.cell_fit.linearised_corners.moving
    ).any()


def test_right_intrinsics_and_a_flat_board_are_refined_without_a_doubt():
    cell = simulate(FINE)
    known = with_lens(cell, np.zeros(4), intrinsics="refine")
    assert lens_is_free(known)
    assert known.verdict.status == "good"
    assert mahalanobis_sq(cell, known) < UNLIKELY


@pytest.mark.parametrize(("off_px", "status"), [(0.02, "good"), (0.5, "check")])
def test_intrinsics_that_are_off_by_less_than_images_show_are_no_doubt(off_px, status):
    # Corners as exact as centres of circles: both moves are beyond chance.
    cell = simulate(replace(FINE, seed=2, pixel_sigma_px=0.002))
    known = with_lens(cell, off_px * np.array([1.0, -1.0, 1.0, 0.5]))
    assert known.verdict.status == status
    named = any("do not fit these images" in reason for reason in known.verdict.reasons)
    assert named == (status == "check")
    assert mahalanobis_sq(cell, known) < UNLIKELY


def test_memory_is_linear_in_the_points_of_an_exact_rig():
    places = np.random.default_rng(0).normal(size=(3000, 3))
    rig = Target(
        "rig",
        "points",
        len(places),
        1,
        8.0,
        0.0,
        points_m=tuple(map(tuple, places.tolist())),
        point_numbers=tuple(range(len(places))),
    )
    tracemalloc.start()
    basis = boards_basis([rig])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert basis.shape == (3000, 3, 0)
    # A few copies of the places; a square of all coordinates has 9,000 numbers for each of them.
    assert peak < 100 * places.nbytes

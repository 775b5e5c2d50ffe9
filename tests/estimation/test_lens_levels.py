"""What lenses do beyond their models: its elimination from corners, and its sizes by REML."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.cells import calibrated, known_of

from visioncal.estimation.appearance import Appearance, compress
from visioncal.estimation.corners import reproject
from visioncal.estimation.lens_field import LensLevels, displacements, distances, field_modes
from visioncal.estimation.mixed import LikelihoodValue, MixedModel
from visioncal.simulation import CellOptions, fine_camera, simulate

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1, views=8, seed=1)
LEVELS = LensLevels(field=1.5, length=0.35, breathing=0.05, jitter=0.01)


@pytest.fixture(scope="module")
def corners():
    """The corners of one camera as the fit has them, with their poses."""
    looks = calibrated(simulate(FINE), joints=False).cell_fit.camera_parameters
    (problem,) = looks.problems.values()
    return replace(problem.with_levels(LEVELS), levels=LEVELS), looks


def test_a_field_of_size_one_has_it_all_over_the_image():
    px = np.random.default_rng(0).uniform(0, [1280, 1024], (500, 2))
    for length in (0.07, 0.2, 0.35):
        variances = np.sum(field_modes(px, (1280, 1024), length) ** 2, axis=1)
        # A hundredth of the variance is left out, most of it at the edges.
        assert np.mean(variances) == pytest.approx(1.0, abs=0.02)
        assert np.min(variances) > 0.8


def test_what_is_eliminated_is_noise_that_corners_share(corners):
    """The Schur complement of the whole problem by a dense covariance, as generalised squares."""
    problem, looks = corners
    stack, poses = problem.stack, looks.poses
    appearance = Appearance(looks.camera("cam"), looks.values[looks.boards])
    found = compress(stack, problem.basis, appearance, poses, levels=LEVELS)
    bare = replace(stack, zooms=None)
    now = reproject(bare, appearance.camera, poses)
    shared = np.concatenate([now.by_intrinsics, now.by_point @ problem.basis[stack.ids]], axis=2)
    far = distances(bare, poses)[bare.view_of]
    beyond = displacements(bare.px, appearance.camera, far, LEVELS)
    bare.weigh(beyond)
    beyond = beyond.reshape(2 * len(stack.px), -1)
    views = len(stack.views)
    by_poses = np.zeros((len(stack.px), 2, 6 * views))
    covariance = np.eye(2 * len(stack.px)) + beyond @ beyond.T
    for view in range(views):
        rows = stack.view_of == view
        by_poses[rows, :, 6 * view : 6 * view + 6] = now.by_pose[rows]
        zoom = np.where(rows[:, None], stack.zooms, 0.0).ravel()
        covariance += np.outer(zoom, zoom)
    jacobian = np.concatenate([by_poses, shared], axis=2).reshape(len(covariance), -1)
    normal = jacobian.T @ np.linalg.solve(covariance, jacobian)
    inner, size = normal[: 6 * views, : 6 * views], 6 * views
    left = normal[size:, size:] - normal[size:, :size] @ np.linalg.solve(
        inner, normal[:size, size:]
    )
    # All but the board's scale, which views alone do not tell; linearised where poses are the best
    # ones by other weights.
    kept = np.arange(len(left)) != len(now.by_intrinsics[0, 0])
    scale = np.sqrt(np.diag(left)[kept])
    apart = (found.shared_information - left)[np.ix_(kept, kept)] / np.outer(scale, scale)
    assert np.abs(apart).max() < 1e-2


def test_how_poses_follow_a_board_is_the_same_with_any_focus(corners):
    """A larger board farther away looks the same, whatever corners are weighed by."""
    problem, looks = corners
    appearance = Appearance(looks.camera("cam"), looks.values[looks.boards])
    scale = problem.scale
    plain, zoomed = (
        compress(stack, problem.basis, appearance, looks.poses).by_shared[:, :, scale]
        for stack in (replace(problem.stack, zooms=None), problem.stack)
    )
    # Poses that fit best by other weights are a little elsewhere, by less than 1 mm.
    np.testing.assert_allclose(zoomed, plain, atol=1e-3)


def test_a_level_that_rises_far_is_not_given_up_for_what_its_first_step_gains():
    """Residuals (100,) of known variance 1 + 99, of which the search starts with a hundredth."""

    def at(logs):
        v = np.exp(2.0 * logs)
        share = v / (1.0 + v)
        value = 50.0 * np.log(1.0 + v) + 50.0 * 100.0 / (1.0 + v)
        slope = 100.0 * share * (1.0 - 100.0 / (1.0 + v))
        return LikelihoodValue(float(value[0]), slope, 200.0 * np.diag(share**2))

    best = np.array([0.5 * np.log(99.0)])
    low, high = np.array([-9.0]), np.array([9.0])
    model, enough = SimpleNamespace(at=at, prior=None), at(best).value + 1.0
    likely = MixedModel.maximised(model, np.array([-2.3]), low, high, enough, 1e-7)
    assert likely.value == pytest.approx(at(best).value, abs=1e-6)


def test_a_focus_that_is_fixed_neither_breathes_nor_jitters():
    cell = simulate(replace(FINE, views=12))
    session = known_of(cell).session
    camera = session.document["camera"] | {"focus": "fixed"}
    fixed = calibrated(
        cell,
        joints=False,
        session=replace(session, document=session.document | {"camera": camera}),
    )
    (problem,) = fixed.cell_fit.camera_parameters.problems.values()
    levels = problem.levels
    assert (levels.breathing, levels.jitter) == (0.0, 0.0)

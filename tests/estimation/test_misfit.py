"""Whether residuals are noise, how sure the noise's levels are, and the error budget."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, error_of, reporting, showing
from support.marks import slow
from support.problems import observed, world

from visioncal.calibration.run import calibrate
from visioncal.calibration.stages import refine
from visioncal.core.transforms import exp, invert, log
from visioncal.estimation.arm import ArmErrors, covariance_of_size
from visioncal.estimation.budget import point_covariance, radius95
from visioncal.estimation.intervals import noise_intervals
from visioncal.estimation.mixed import profile_interval
from visioncal.estimation.solve import (
    covariance_of,
)
from visioncal.session.columns import POSE
from visioncal.simulation import CellOptions, fine_camera, simulate
from visioncal.simulation.records import cell_session

FINE = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)
MOUNTS = ("eye-in-hand", "eye-to-hand")


def with_moving_base(cell, twist):
    """The cell with its base creeping by a twist from the first view to the last."""
    share = np.linspace(-0.5, 0.5, len(cell.robot.base_from_flange))[:, None]
    return reporting(cell, base_from_flange=exp(share * twist) @ cell.robot.base_from_flange)


def answered(cell):
    known = calibrated(cell, joints=False)
    return known.assessment, known


def told(result):
    return result.problem, result.state, result.noise


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_creeping_base_is_noticed_and_its_way_told(mount):
    cell = simulate(replace(FINE, mount=mount, seed=0))
    result, _ = answered(cell)
    assert not result.steps
    moved = with_moving_base(cell, np.array([0, 0, 0, 0.0, 3e-4, 0]))
    _, known = answered(moved)
    kinds = {warning.kind for warning in known.warnings}
    assert kinds & {"base_creeps", "moved_slowly"}


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_bump_is_told_from_a_creep(mount):
    cell = simulate(replace(FINE, mount=mount, seed=0))
    lifted = np.where(np.arange(20) < 9, 0.0, 1e-3)[:, None] * np.eye(6)[5]
    moved = reporting(cell, base_from_flange=exp(lifted) @ cell.robot.base_from_flange)
    _, known = answered(moved)
    (words,) = [warning.reason for warning in known.warnings if "moved at once" in warning.reason]
    assert "from view 9 on" in words
    assert not any("drift with time" in warning.reason for warning in known.warnings)


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_bump_is_in_the_covariance(mount):
    """The answer is between both places, and as far from each as it says."""
    squares = []
    cell = simulate(replace(FINE, mount=mount, seed=0))
    on_flange = next(
        transform for name, transform in cell.transforms.items() if name.startswith("flange")
    )
    later = on_flange @ exp(np.array([0.001, 0, 0, 0, 1.6e-3, 1.2e-3]))
    flange = cell.robot.base_from_flange.copy()
    flange[10:] = flange[10:] @ on_flange @ invert(later)
    result, known = answered(reporting(cell, base_from_flange=flange))
    assert [cause.kind for cause in known.verdict.causes][:1] == ["moved_at_once"]
    assert not {"weak_motion", "place", "calibration"} & {
        finding.kind for finding in known.verdict.findings
    }
    edge = result.edges["cam" if mount == "eye-in-hand" else "target"]
    for true in (on_flange, later):
        away = log(invert(true) @ edge.matrix)
        squares.append(away @ np.linalg.solve(edge.covariance, away) / 6.0)
    # Without the bump in it, the covariance is a tenth of what it has to be.
    assert np.mean(squares) < 1.5


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_joint_that_slips_between_images_is_named(mount, tmp_path):
    cell = simulate(CellOptions(mount=mount, views=24, seed=3))
    session = cell_session(cell, "slipped", seen="poses")
    views = []
    for at, view in enumerate(session.views):
        numbers = {name: number for name, number in view.numbers.items() if name not in POSE}
        numbers["q3_rad"] += np.deg2rad(0.15 * (at >= 12))
        views.append(replace(view, numbers=numbers))
    columns = tuple(column for column in session.columns if column not in POSE)
    replace(session, columns=columns, views=tuple(views)).save(tmp_path / "slipped")
    verdict = calibrate(tmp_path / "slipped").verdict
    cause = verdict.causes[0]
    assert (verdict.status, cause.kind) == ("check", "joint_slipped")
    assert "joint 3 (elbow_joint) steps: from view 12 on, it reads +0.1" in cause.words


def test_stops_that_err_in_groups_are_noticed():
    rng = np.random.default_rng(0)
    cell = simulate(replace(FINE, views=30, seed=1))
    group = np.repeat(rng.standard_normal((10, 6)) * np.repeat([4e-4, 2e-4], 3), 3, axis=0)
    together = reporting(cell, base_from_flange=cell.robot.base_from_flange @ exp(group))
    result, known = answered(together)
    assert any("last from stop to stop" in warning.reason for warning in known.warnings)
    # Of three stops that err alike, the mean is as good as that of one.
    white = covariance_of(result.problem, result.fit)
    assert 1.5 < np.trace(result.covariance[3:6, 3:6]) / np.trace(white[3:6, 3:6]) < 6.0


@pytest.mark.slow
def test_intervals_of_the_noise_hold_the_truth():
    inside, count = np.zeros(2), 20
    truth = np.array([5e-5, 3e-5])
    for seed in range(count):
        result, _ = answered(simulate(replace(FINE, seed=seed, views=12)))
        low, high = noise_intervals(*told(result))[0].T
        assert np.all(low <= result.noise.robots[0])
        assert np.all(result.noise.robots[0] <= high)
        inside += (low <= truth) & (truth <= high)
    # 95 % of 20 are 19; under 16 comes in one run of four hundred.
    assert np.all(inside >= 16)


def test_an_interval_is_about_the_level_that_was_found():
    """Also where another one, far away, is likelier; each look at the likelihood is a fit."""
    looks = []

    def profile(logarithm):
        looks.append(logarithm)
        return 2.0 * min((logarithm - np.log(1e-4)) ** 2, (logarithm - np.log(1e-2)) ** 2 - 5.0)

    low, high = profile_interval(profile, 1e-4, -10.0)
    # Chi-square of one is under 3.84 in 95 %: 0.98 in logarithms either way, sought to 0.02.
    assert np.log([low, high]) == pytest.approx(np.log(1e-4) + np.array([-0.98, 0.98]), abs=0.03)
    assert len(looks) <= 9


def test_an_interval_ends_where_the_likelihood_rises_steeply():
    """A small noise beside a known one, ten times as large: flat below, steep above."""

    def profile(logarithm):
        variance = 1.0 + np.exp(2.0 * logarithm)
        return 50.0 * (np.log(variance) + 1.01 / variance)

    low, high = profile_interval(profile, 0.1, profile(np.log(0.1)))
    assert low == 0.0
    rise = 2.0 * (profile(np.log(high)) - profile(np.log(0.1)))
    # Sought to 0.02 in its logarithm, over which the rise changes by a tenth.
    assert rise == pytest.approx(1.96**2, rel=0.15)


def test_the_size_of_an_arms_errors_is_known_as_well_as_these_are_told():
    rng = np.random.default_rng(0)
    problem = observed(world(rng, stops=8), rng)
    # Six errors, of which four are told.
    errors = ArmErrors(np.zeros((8, 6, 6)), 1e-3, 100.0, True)
    erring = problem.with_effects([errors.effect("a")])
    arm = erring.effect_columns["arm of a"]
    covariance = np.zeros((erring.size, erring.size))
    covariance[arm, arm] = np.diag([1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0])
    # The place of a frame makes up for one that is not told.
    covariance[0, arm.start] = covariance[arm.start, 0] = -5e-7
    covariance[0, 0] = 3e-7
    more = covariance_of_size(erring, covariance, "a", errors)
    # Student's t of four degrees has twice the variance of the normal.
    np.testing.assert_allclose(np.diag(more[arm, arm]), [1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0])
    assert more[0, arm.start] == pytest.approx(-5e-7)
    # Of the frame's variance, the part that the error makes up for.
    assert more[0, 0] == pytest.approx(2.5e-7)


def test_a_point_is_as_uncertain_as_its_scatter():
    rng = np.random.default_rng(3)
    edge, point = exp(rng.normal(size=6)), np.array([0.1, -0.2, 0.6])
    root = rng.normal(size=(6, 6)) * 1e-4
    steps = rng.standard_normal((20000, 6)) @ root.T
    seen = (edge @ exp(steps))[:, :3, :3] @ point + (edge @ exp(steps))[:, :3, 3]
    # 20000 draws tell a variance to 1 %.
    expected = point_covariance(edge, root @ root.T, point)
    np.testing.assert_allclose(np.cov(seen.T), expected, atol=0.04 * np.abs(expected).max())


@pytest.mark.parametrize("variances", [(1, 1, 1), (1, 0.1, 0.01), (1, 0, 0)])
def test_95_percent_lie_within_the_radius(variances):
    draws = np.random.default_rng(0).standard_normal((200000, 3)) ** 2 @ np.array(variances, float)
    radius = radius95(np.diag(np.array(variances, float)))
    # Imhof's fit is good to 1 %; 200000 draws to 0.1 %.
    assert np.mean(draws < radius**2) == pytest.approx(0.95, abs=0.004)


def through_a_wavy_lens(cell, sigma_px, rng):
    """The cell with corners displaced by a smooth field, which no lens model has."""
    waves = rng.normal(size=(2, 200, 2)) / (0.2 * cell.stated[""].resolution[0])
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 200))
    weights = rng.normal(size=(2, 200)) * np.sqrt(2 / 200) * sigma_px

    def moved(px):
        return px + np.stack(
            [np.cos(px @ waves[name].T + phases[name]) @ weights[name] for name in (0, 1)], axis=1
        )

    return showing(cell, tuple(replace(corner, px=moved(corner.px)) for corner in cell.corners))


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_lens_beyond_its_model_is_counted_and_named(mount, monkeypatch):
    squared, away, without, named = [], [], [], 0
    for seed in range(2):
        cell = simulate(replace(FINE, mount=mount, seed=seed, robot_sigma_m=1e-5))
        cell = through_a_wavy_lens(cell, 0.25, np.random.default_rng(seed))
        known = calibrated(cell, joints=False)
        squared.append(mahalanobis_sq_of_place(cell, known))
        away.append(error_of(cell, known)[3:6])
        named += any(warning.kind == "lens_field" for warning in known.findings.warnings)
        with monkeypatch.context() as patched:
            patched.setattr(refine, "with_sizes", lambda _, fitted, *__: (fitted, {}))
            without.append(error_of(cell, calibrated(cell, joints=False))[3:6])
    # 6 components: a mean squared error over the covariance of 3.7 is one in a thousand.
    assert np.mean(squared) / 3 < 3.7
    # What the field explains is not left to the place: a third of the error without it (0.3).
    assert np.sum(np.square(away)) < 0.25 * np.sum(np.square(without))
    # A field of 2.5 times the noise; a board that fills a part of the image shows a part of it.
    assert named >= 1


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_a_focus_that_follows_the_distance_is_counted_and_named(mount):
    squared, named = [], 0
    for seed in range(2):
        cell = simulate(replace(FINE, mount=mount, seed=seed))
        known = calibrated(breathing(cell, 0.01), joints=False)
        squared.append(mahalanobis_sq_of_place(cell, known))
        named += [warning.kind for warning in known.findings.warnings] == ["focus"]
    # 6 components: 3.7 is one in a thousand. Left out of the model, it is above 100.
    assert np.mean(squared) / 3 < 3.7
    assert named == 2


def mahalanobis_sq_of_place(cell, known):
    away, covariance = error_of(cell, known)[3:6], known.assessment.covariance[3:6, 3:6]
    return float(away @ np.linalg.solve(covariance, away))


def breathing(cell, share):
    """Images of a lens whose focal length follows the distance."""
    far = np.array([value[2, 3] for value in cell.cam_from_target])
    zooms = share * (far / far.mean() - 1.0)
    centre = cell.options.camera.matrix[2:]
    corners = [
        replace(corner, px=corner.px + zoom * (corner.px - centre))
        for corner, zoom in zip(cell.corners, zooms, strict=True)
    ]
    return showing(cell, corners)

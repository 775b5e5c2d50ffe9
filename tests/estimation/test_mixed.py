"""Sizes of noise, lenses and errors of arms: the mixed model, its likelihood, and intervals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from support.cells import calibrated, known_of
from support.marks import slow
from support.problems import observed as observed_world
from support.problems import world
from support.slopes import jacobian

from visioncal.calibration.pipeline.arm_results import misfit_covariance
from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.pose_errors import find_pose_errors
from visioncal.core.levenberg_marquardt import Linearised, levenberg_marquardt
from visioncal.core.prediction import point_jacobian, through
from visioncal.core.quantiles import radius95
from visioncal.core.transforms import LEVER_M, exp, invert, log
from visioncal.core.types import Corners
from visioncal.estimation.appearance import Appearance, compress
from visioncal.estimation.arm import arm_effect, covariance_of_size
from visioncal.estimation.chain import chain
from visioncal.estimation.fit import Fit
from visioncal.estimation.mixed import (
    MixedModel,
    PriorInformation,
    SizePrior,
    Units,
    profile_interval,
)
from visioncal.estimation.problem_parts import ROBOT
from visioncal.estimation.solve import covariance_of, fit_problem
from visioncal.robot import load_robot
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import ArmErrors, link_basis, pose_basis
from visioncal.simulation import CAMERAS, CellOptions, cell_session, simulate
from visioncal.vision.board_shape import BOARD_NAMES, SCALE, board_basis
from visioncal.vision.camera import intrinsics
from visioncal.vision.corners import CornerStack, reproject
from visioncal.vision.field_modes import field_modes
from visioncal.vision.gating import gate
from visioncal.vision.lens_field import LensLevels, displacements, distances
from visioncal.vision.poses import determines_pose
from visioncal.vision.targets import corner_positions
from visioncal.vision.viewnoise import weights_by_view

# Sizes: the noise of units, two of their errors, and of two groups of common unknowns, of which one
# has a share of the other, too.
SIZES, UNKNOWNS = 5, 9


def positive(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) + np.eye(shape[-1])


class _Example:
    """A model of units and of a prior, beside its rows one by one."""

    def __init__(self, scale=1.0):
        rng = np.random.default_rng(0)

        shape, sizes = (9, 5), np.arange(3)
        away, slopes = scale * rng.normal(size=shape), rng.normal(size=(*shape, UNKNOWNS))
        known = 0.1 * positive(rng, *shape)
        self.units = Units(away, slopes, known, positive(rng, len(sizes), *shape), sizes)
        self.known = np.pad(rng.normal(size=(2, 5)), ((0, 0), (0, UNKNOWNS - 5)))
        self.shares = np.zeros((UNKNOWNS, SIZES))
        self.shares[5:7, 3], self.shares[7:, 4], self.shares[8, 3] = 1.0, [1.0, 2.0], 0.5
        self.prior = SizePrior.of_ratios([(1, 2)], SIZES)
        self.model = MixedModel(
            self.units,
            PriorInformation(self.known.T @ self.known, np.zeros(UNKNOWNS)),
            self.shares,
            self.prior,
        )

    def covariance(self, logs):
        squares = np.exp(2.0 * logs)
        blocks = [
            self.units.known[at] + np.tensordot(squares[:3], self.units.parts[:, at], axes=1)
            for at in range(len(self.units.residuals))
        ]
        noise = block_diag(*blocks, np.eye(2))
        return noise + (self.jacobian * (self.shares @ squares)) @ self.jacobian.T

    @property
    def jacobian(self):
        return np.concatenate([self.units.jacobian.reshape(-1, UNKNOWNS), self.known])

    @property
    def residuals(self):
        return np.append(self.units.residuals.ravel(), np.zeros(2))

    def projection(self, logs):
        """P of the restricted likelihood, and the information on the flat unknowns."""
        weights = np.linalg.inv(self.covariance(logs))
        flat = self.jacobian[:, ~self.shares.any(axis=1)]
        information = flat.T @ weights @ flat
        absorbed = weights @ flat @ np.linalg.solve(information, flat.T @ weights)
        return weights - absorbed, information

    def value(self, logs):
        matrix, information = self.projection(logs)
        determinants = sum(np.linalg.slogdet(it)[1] for it in (self.covariance(logs), information))
        squares = self.residuals @ matrix @ self.residuals
        return 0.5 * (determinants + squares) + self.prior.at(logs).value


LOGS = np.log([0.5, 0.8, 0.3, 1.2, 0.7])


def test_the_curvature_is_the_average_information():
    example = _Example()
    matrix, _ = example.projection(LOGS)
    pulled = matrix @ example.residuals
    working = jacobian(lambda by: example.covariance(LOGS + by) @ pulled, SIZES)
    expected = 0.5 * working.T @ matrix @ working + example.prior.at(LOGS).curvature
    np.testing.assert_allclose(example.model.at(LOGS).curvature, expected, atol=1e-6)


def test_the_unknowns_are_the_best_prediction_with_its_covariance():
    example = _Example()
    estimate = example.model.at(LOGS, is_sloped=False)
    squares, is_random = np.exp(2.0 * LOGS), example.shares.any(axis=1)
    variances = np.where(is_random, example.shares @ squares, 0.0)
    slopes = example.jacobian
    noise = example.covariance(LOGS) - (slopes * variances) @ slopes.T
    information = slopes.T @ np.linalg.solve(noise, slopes)
    information[is_random, is_random] += 1.0 / variances[is_random]
    gradient = slopes.T @ np.linalg.solve(noise, example.residuals)
    np.testing.assert_allclose(estimate.values, np.linalg.solve(information, gradient), atol=1e-9)
    np.testing.assert_allclose(
        estimate.root @ estimate.root.T, np.linalg.inv(information), atol=1e-9
    )


def test_the_most_likely_sizes_have_no_slope_between_their_bounds():
    example = _Example(scale=3.0)
    found = example.model.maximised(LOGS, np.log(1e-3), np.log(1e3))
    inside = found.logs > np.log(2e-3)
    assert inside.sum() >= 3
    # The search ends where a step gains a millionth of log-likelihood.
    assert np.abs(found.gradient[inside]).max() < 1e-2
    assert example.value(found.logs) <= example.value(LOGS)


@pytest.mark.parametrize("true_size", [0.0, 3.0])
def test_the_likeliest_size_of_more_unknowns_is_that_of_the_likelihood(true_size):
    """In steps of a fifth, with all other sizes held, of errors that the first units share."""
    example, rng = _Example(), np.random.default_rng(1)
    units = example.units
    moved = rng.normal(size=(*units.residuals.shape, 8))
    units.residuals[:] += moved @ (true_size * rng.normal(size=8))
    everywhere = np.ones(len(moved), dtype=bool)
    size, gain = example.model.likely_size(example.model.at(LOGS), moved, everywhere)
    without = example.value(LOGS)

    def value_with(value):
        added = value**2 * np.einsum("uik,vjk->uivj", moved, moved).reshape(45, 45)
        original = example.covariance
        example.covariance = lambda logs: original(logs) + np.pad(added, (0, 2))
        try:
            return example.value(LOGS)
        finally:
            del example.covariance

    sizes = np.exp(np.arange(np.log(1e-4), np.log(1e2), 0.1))
    values = np.array([value_with(value) for value in sizes])
    # Between two sizes that are tried, a value is hardly larger.
    assert gain == pytest.approx(max(without - values.min(), 0.0), abs=0.1)
    if true_size:
        assert size == pytest.approx(sizes[values.argmin()], rel=0.15)
    else:
        assert size < 0.5


def test_a_size_of_zero_is_found_beside_a_large_one():
    """Only the first coordinate errs: what both have of their own is lost in the rounding."""
    common = np.random.default_rng(2).normal(0.0, 1.0, (40, 1))
    parts = np.zeros((2, 40, 2, 2))
    parts[0, :, 0, 0] = parts[1, :, 0, 0] = parts[1, :, 1, 1] = 1.0
    units = Units(
        np.hstack([common, np.zeros((40, 1))]),
        np.tile([[1.0], [0.0]], (40, 1, 1)),
        np.zeros((40, 2, 2)),
        parts,
        np.arange(2),
    )
    model = MixedModel(units, PriorInformation.flat(1), np.zeros((1, 2)))
    found = model.maximised(np.log([3.0, 3.0]), np.log(1e-10), np.log(1e2))
    assert np.isfinite(found.value)
    # Forty of them tell a size to a ninth.
    assert np.exp(found.logs[0]) == pytest.approx(1.0, rel=0.4)
    assert np.exp(found.logs[1]) < 1e-5


LEVELS = LensLevels(field=1.5, length=0.35, breathing=0.05, jitter=0.01, motion=1e-3)


@pytest.fixture(scope="module")
def corners():
    """The corners of one camera as the fit has them, with their poses."""
    looks = calibrated(simulate(FINE), joints=False).cell_fit.fit.camera_parameters
    (problem,) = looks.problems.values()
    return replace(problem.with_levels(LEVELS), levels=LEVELS), looks


def test_a_field_of_size_one_has_it_all_over_the_image():
    px = np.random.default_rng(0).uniform(0, [1280, 1024], (500, 2))
    for length in (0.07, 0.2, 0.35):
        variances = np.sum(field_modes(px, (1280, 1024), length).at(slice(None)) ** 2, axis=1)
        # A hundredth of the variance is left out, most of it at the edges.
        assert np.mean(variances) == pytest.approx(1.0, abs=0.02)
        assert np.min(variances) > 0.8


@pytest.mark.slow
def test_eliminated_unknowns_are_noise_that_corners_share(corners):
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
        zooms = np.where(rows[:, None, None], stack.zooms, 0.0).reshape(len(covariance), -1)
        covariance += zooms @ zooms.T
    slopes = np.concatenate([by_poses, shared], axis=2).reshape(len(covariance), -1)
    normal = slopes.T @ np.linalg.solve(covariance, slopes)
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


def test_a_focus_that_is_fixed_neither_breathes_nor_jitters():
    cell = simulate(replace(FINE, views=12))
    session = known_of(cell).session
    camera = session.document["camera"] | {"focus": "fixed"}
    fixed = calibrated(
        cell, joints=False, session=replace(session, document=session.document | {"camera": camera})
    )
    (problem,) = fixed.cell_fit.fit.camera_parameters.problems.values()
    levels = problem.levels
    assert (levels.breathing, levels.jitter) == (0.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("draws", [range(2, 3), range(2, 9)], ids=str)
def test_a_focus_that_chance_explains_leaves_the_flange_its_noise(draws):
    """Else errors along the lens's axis alone shrink the noise of all directions."""
    for seed in draws:
        cell = simulate(replace(FINE, pixel_sigma_px=0.003, views=12, seed=seed))
        session = cell_session(cell, "cell", seen="corners")
        camera = session.document["camera"] | {"focus": "fixed"}
        fixed = replace(session, document=session.document | {"camera": camera})
        found, known = (calibrate(each).noise["robot_translation_mm"] for each in (session, fixed))
        # What is left of it is far less than the uncertainty of the noise, a sixth.
        assert found == pytest.approx(known, rel=0.02)


X, Z = exp(np.array([0.1, -0.2, 0.3, 0.03, -0.05, 0.09])), exp(np.array([0, 0, 0, 0.6, 0.1, 0.0]))
SIGMAS = np.repeat([3e-4, 2e-4], 3)


def white(rng, poses):
    return rng.normal(size=(len(poses), 6))


def lasting(rng, poses):
    """Noise of stop after stop that remembers nine tenths of its last value."""
    found = white(rng, poses)
    for at in range(1, len(found)):
        found[at] = 0.9 * found[at - 1] + np.sqrt(1 - 0.9**2) * found[at]
    return found


def smooth(rng, poses):
    """Errors that follow where the flange is, over some 0.3 m."""
    waves, phases = rng.normal(size=(6, 3)) / 0.3, rng.uniform(0, 6, 6)
    return np.sqrt(2.0) * np.sin(poses[:, :3, 3] @ waves.T + phases)


def fitted(errors, seed, stops=22):
    """A problem of one camera on one robot, with its fit."""
    rng = np.random.default_rng(seed)
    views = exp(rng.normal(size=(stops, 6)) * np.repeat([0.4, 0.15], 3)) @ exp(
        np.array([np.pi, 0, 0, 0, 0, 0.5])
    )
    poses = Z @ invert(views) @ invert(X)
    reported = poses @ exp(SIGMAS * errors(rng, poses))
    measured = views @ exp(2e-5 * rng.normal(size=(stops, 6)))
    problem = chain("eye-in-hand", reported, measured, np.tile(4e-10 * np.eye(6), (stops, 1, 1)))
    state = problem.start({"cam": X, "target": Z})
    return problem, fit_problem(problem, state)


@pytest.mark.parametrize("errors", [slow(white), smooth])
def test_errors_are_as_large_as_the_covariance_says(errors):
    before, after = [], []
    for seed in range(12):
        problem, fit = fitted(errors, seed)
        found = find_pose_errors(problem, fit.state, fit.noise, ROBOT)
        covariance = covariance_of(problem, fit)[:6, :6]
        away = log(invert(fit.state.edges[0]) @ X)
        before.append(away @ np.linalg.solve(covariance, away) / 6)
        more = misfit_covariance(Fit(problem, fit), ROBOT, found)[:6, :6]
        after.append(away @ np.linalg.solve(covariance + more, away) / 6)
    # A mean of 72 squares is known to 0.17, and levels of few stops leave some 0.3. Seen 0.8 and
    # 0.4: of a smooth error, what looks the same in all views is counted though there is none.
    assert 0.3 < np.mean(after) < 1.6
    if errors is white:
        # A model that is not needed costs an eighth of a sigma here.
        assert np.mean(after) > 0.65 * np.mean(before)
    else:
        assert np.mean(before) > 1.5 * np.mean(after)


def test_noise_is_no_error_of_the_arm_and_what_lasts_is():
    for seed in range(4):
        for errors in (white, lasting):
            problem, fit = fitted(errors, seed)
            found = find_pose_errors(problem, fit.state, fit.noise, ROBOT)
            assert found.is_significant if errors is lasting else not found.is_likely
    # Too few stops say nothing.
    problem, fit = fitted(white, 0, stops=5)
    assert find_pose_errors(problem, fit.state, fit.noise, ROBOT) is None


@pytest.mark.slow
def test_frames_are_estimated_beside_what_lasts_in_time():
    """Neighbouring stops err alike: their mean counts for less than independent ones."""
    before, after, squares = [], [], []
    for seed in range(20):
        problem, solution = fitted(lasting, seed, stops=40)
        fit = Fit(problem, solution)
        errors = find_pose_errors(problem, solution.state, solution.noise, ROBOT)
        moved = fit.state.moved(fit.step_to(fit.beside_lasting(ROBOT, errors)))
        before.append(log(invert(fit.state.edges[0]) @ X))
        after.append(log(invert(moved.edges[0]) @ X))
        covariance = (fit.by_noise + misfit_covariance(fit, ROBOT, errors))[:6, :6]
        squares.append(after[-1] @ np.linalg.solve(covariance, after[-1]) / 6)
    rms = [np.sqrt(np.mean(np.array(away)[:, 3:] ** 2)) for away in (before, after)]
    # The errors differ by half of themselves, a ratio of 60 numbers by 0.06. Seen 0.85; the true
    # process gives no less.
    assert rms[1] < 0.95 * rms[0]
    # A mean of 120 squares is known to 0.13, and levels of few stops leave some 0.3. Seen 0.7.
    assert 0.3 < np.mean(squares) < 1.5


def bent(curvature: float, seen: list[float]):
    """Residuals x + 1 and c x^2 + x - 1 (Dennis and Schnabel 1983, example 10.2.4).

    The least cost is at zero, where steps without damping err by a factor of -c.
    """

    def linearise(at: float) -> Linearised[float]:
        residuals = np.array([at + 1.0, curvature * at**2 + at - 1.0])
        slopes = np.array([1.0, 2.0 * curvature * at + 1.0])
        information, gradient = slopes @ slopes, slopes @ residuals
        seen.append(at)

        def change(damping: float) -> float:
            return -gradient / (information * (1.0 + damping))

        def fall(damping: float) -> float:
            step = change(damping)
            return float(-2.0 * gradient * step - information * step**2)

        return Linearised(at, float(residuals @ residuals), lambda by: at + change(by), fall)

    return linearise


@pytest.mark.parametrize("curvature", [-0.5, -3.0, -30.0])
def test_levenberg_marquardt_rests_at_the_least_cost_in_few_steps(curvature):
    seen: list[float] = []
    found, settled = levenberg_marquardt(0.9, bent(curvature, seen), settled=1e-10)
    assert settled
    # About (1 - c) x^2 is what the cost is above its least, and 1e-10 of it 2e-6 at most. Damping
    # that falls to a tenth after each step downwards rests 5e-6 to 1e-3 away, in 17 to 27 steps.
    assert abs(found) < 2e-6
    assert len(seen) < 25


FINE = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1)


def test_an_interval_is_about_the_level_that_was_found():
    """Also where another one, far away, is likelier; each look at the likelihood is a fit."""
    looks = []

    def two(logarithm):
        looks.append(logarithm)
        return 2.0 * min((logarithm - np.log(1e-4)) ** 2, (logarithm - np.log(1e-2)) ** 2 - 5.0)

    low, high = profile_interval(two, 1e-4, -10.0)
    # Chi-square of one is under 3.84 in 95 %: 0.98 in logarithms either way, sought to 0.02.
    assert np.log([low, high]) == pytest.approx(np.log(1e-4) + np.array([-0.98, 0.98]), abs=0.03)
    assert len(looks) <= 9

    def steep(logarithm):
        """A small noise beside a known one, ten times as large: flat below, steep above."""
        variance = 1.0 + np.exp(2.0 * logarithm)
        return 50.0 * (np.log(variance) + 1.01 / variance)

    low, high = profile_interval(steep, 0.1, steep(np.log(0.1)))
    assert low == 0.0
    rise = 2.0 * (steep(np.log(high)) - steep(np.log(0.1)))
    # Sought to 0.02 in its logarithm, over which the rise changes by a tenth.
    assert rise == pytest.approx(1.96**2, rel=0.15)


def test_weights_of_views_are_what_noise_asks_for():
    rng = np.random.default_rng(1)
    freedom = rng.integers(20, 120, 40).astype(float)
    sigma = np.exp(0.4 * rng.standard_normal(40))
    squares = sigma**2 * rng.chisquare(freedom)
    scaled = sigma * weights_by_view(squares, freedom)
    # A variance of 70 degrees of freedom is known to 17 %, its root to 8 %.
    assert np.std(np.log(scaled)) < 0.12
    # Drawn towards all: less is made of a view than its residuals alone would.
    by_residuals = np.log(np.sqrt(squares / freedom))
    assert np.std(np.log(weights_by_view(squares, freedom))) < np.std(by_residuals)
    # Views of one noise weigh alike: one of ten thousand is called uneven by chance.
    for each in (8.0, 100.0):
        all_of = np.full(20, each)
        assert all(weights_by_view(rng.chisquare(all_of), all_of) is None for _ in range(100))
    # And so do those that say nothing.
    for squares, of in (([1.0], [50.0]), ([1, 0, 900], [50] * 3), ([1, 2, 900], [50, 0, 50])):
        assert weights_by_view(np.array(squares, float), np.array(of, float)) is None


def test_the_sigma_of_the_size_of_an_arms_errors_is_right():
    rng = np.random.default_rng(0)
    problem = observed_world(world(rng, stops=8), rng)
    # Six errors, of which four are told.
    errors = ArmErrors(np.zeros((8, 6, 6)), 1e-3, 100.0, True)
    erring = problem.with_effects([arm_effect(errors, "a")])
    arm = erring.effect_columns["arm of a"]
    covariance = np.zeros((erring.size, erring.size))
    covariance[arm, arm] = np.diag([1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0])
    # The place of a frame makes up for one that is not told.
    covariance[0, arm.start] = covariance[arm.start, 0] = -5e-7
    covariance[0, 0] = 3e-7
    more = covariance_of_size(arm, covariance, errors)
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
    expected = through(point_jacobian(edge, point), root @ root.T)
    np.testing.assert_allclose(np.cov(seen.T), expected, atol=0.04 * np.abs(expected).max())


@pytest.mark.parametrize("variances", [(1, 1, 1), (1, 0.1, 0.01), (1, 0, 0)])
def test_95_percent_lie_within_the_radius(variances):
    draws = np.random.default_rng(0).standard_normal((200000, 3)) ** 2 @ np.array(variances, float)
    radius = radius95(np.diag(np.array(variances, float)))
    # Imhof's fit is good to 1 %; 200000 draws to 0.1 %.
    assert np.mean(draws < radius**2) == pytest.approx(0.95, abs=0.004)


@pytest.mark.parametrize("tool_m", [0.0, 0.1])
def test_the_mean_of_noise_is_no_tool(tool_m):
    robot, rng, tool = load_robot("ur5e"), np.random.default_rng(0), np.eye(4)
    tool[2, 3] = tool_m
    q = rng.uniform(-1.5, 1.5, (25, 6))
    noise = exp(rng.normal(size=(25, 6)) * np.repeat([5e-5, 3e-5], 3))
    found = ArmModel.of(robot, q, robot.base_from_flange(q) @ tool @ noise).flange_from_reported
    if tool_m:
        # Five times the standard deviation of a mean of 25.
        np.testing.assert_allclose(found, tool, atol=5e-5)
    else:
        np.testing.assert_array_equal(found, np.eye(4))


def test_links_base_and_flange_move_the_flange_as_their_bases_say():
    robot, step = load_robot("ur5e"), 1e-6
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (3, 6))
    of_links, of_poses = link_basis(robot, q), pose_basis(robot.base_from_flange(q))
    twists = step * np.diag(np.repeat([1.0, LEVER_M], 3))
    for row, links in enumerate(robot.link_frames(q)):
        for at, twist in enumerate(twists):
            frames = [*links[:6], np.eye(4), links[-1]]
            moved = [link @ exp(twist) @ invert(link) @ links[-1] for link in frames]
            slopes = log(invert(links[-1]) @ np.array(moved)) / step
            # The first order of a step of 1e-6.
            np.testing.assert_allclose(of_links[row, :, at::6], slopes[:6].T, atol=1e-5)
            found = of_poses[row][:, [6 + at, at]]
            np.testing.assert_allclose(found, slopes[6:].T, atol=1e-5)


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
    centre = invert(middle.cam_from_target)

    def moved(by):
        found = compressed(cell, by * steps)
        return np.append(log(centre @ found.cam_from_target), np.sum(found.residuals**2))

    *slopes, cost = jacobian(moved, size, 1.0)
    slopes = np.reshape(slopes, middle.by_shared.shape) / steps
    # Gauss-Newton's derivative leaves out residual times curvature: 0.02 px of residual over
    # hundreds of pixels of board, and the steps' own curvature: a percent of the largest.
    away = np.abs(middle.by_shared - slopes).max(axis=(0, 1))
    assert np.all(away < 0.01 * np.abs(slopes).max(axis=(0, 1)))
    # Of a symmetric difference the third order is left: small beside the second.
    away = np.abs(cost - 2 * steps * middle.shared_gradient)
    limit = 0.02 * np.diagonal(middle.shared_information) * steps**2
    assert np.all(np.delete(away - limit, 9 + SCALE) < 0.0)


def test_corners_alone_do_not_determine_the_size():
    middle = compressed(simulate(replace(FINE, views=6, seed=1)))
    grown = compressed(simulate(replace(FINE, views=6, seed=1)), np.eye(19)[9 + SCALE] * 0.01)
    assert np.all(middle.shared_information[9 + SCALE] == 0.0)
    # Fits to the same pixels settle to 1e-8 m, which is a millionth of a pixel.
    np.testing.assert_allclose(grown.residuals, middle.residuals, atol=1e-4)


GRID = np.array([[x, y, 0.0] for y in range(5) for x in range(8)])


def test_two_corners_off_every_line_determine_a_pose():
    for ids in ([0, 1, 8, 9], [0, 1, 2, 8, 10], [0, 1, 2, 3, 12, 13]):
        assert determines_pose(GRID[ids])
    # Of the last three all but one lie in a row, or on a diagonal.
    rows = [0, 1, 2, 3, 4]
    for ids in (rows[:3], [*rows, 5], [*rows, 13], [13, *rows], [0, 9, 18, 27, 3]):
        assert not determines_pose(GRID[ids])


def test_wrong_corners_and_views_go_and_noise_passes():
    corners = {view: Corners(view, np.arange(40), np.zeros((40, 2)), 0.7) for view in range(6)}
    stack, rng = CornerStack.of(corners, GRID), np.random.default_rng(0)
    for _ in range(50):
        noise = rng.normal(0.0, 0.1, (240, 2))
        passed = gate(stack, noise)
        assert passed.is_open
        assert not passed.reasons
    wrong, other, few, quiet = (noise.copy() for _ in range(4))
    wrong[45] += [4.0, 3.0]
    assert np.flatnonzero(~gate(stack, wrong).mask).tolist() == [45]
    # A view of another board goes as a whole.
    other[stack.view_of == 2] *= 30.0
    passed = gate(stack, other)
    assert set(passed.reasons) == {2}
    assert passed.mask.tolist() == (stack.view_of != 2).tolist()
    # 24 of the 40 corners of view 2.
    few[80:104] += 20.0
    assert "only 16 of 40 corners fit one pose" in gate(stack, few).reasons[2]
    # Small errors are no reason however quiet the rest.
    quiet *= 1e-3
    quiet[3] += [0.3, 0.3]
    assert gate(stack, quiet).is_open


def test_likelihood_and_slope_are_those_of_all_rows():
    example = _Example()
    for logs in (LOGS, LOGS + 0.4):
        assert example.model.at(logs).value == pytest.approx(example.value(logs), abs=1e-9)
    slopes = jacobian(lambda by: example.value(LOGS + by), SIZES, 1e-5)
    assert example.model.at(LOGS).gradient == pytest.approx(slopes, abs=1e-6)

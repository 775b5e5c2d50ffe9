"""Lens, poses and both edges from what is measured: the fits, their covariance, what is refused."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from support.cells import calibrated, error_of, known_of, pairs_session, showing
from support.edges import solved
from support.marks import seeds
from support.misfits import misfit
from support.refusals import raised

import visioncal
from visioncal.calibration.pipeline.starting import find_start
from visioncal.calibration.run import STAGES
from visioncal.calibration.stages.cell import read_cell
from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.transforms import compose, exp, invert, log, robot_part
from visioncal.core.types import Corners
from visioncal.estimation.chain import chain
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import fit_problem, solve_problem
from visioncal.session import Session
from visioncal.simulation import BOARDS, CAMERAS, CellOptions, measured_poses, project, simulate
from visioncal.vision.camera import intrinsics
from visioncal.vision.intrinsics import estimate_intrinsics
from visioncal.vision.pnp import estimate_poses
from visioncal.vision.targets import corner_positions, rotations

NOISE = Noise.of_robot(1e-3, 5e-4)
FLAT = {"tilt_rad": (0.0, 0.002), "distance_m": (0.5, 0.505), "roll_rad": 0.0}


@pytest.mark.slow
@pytest.mark.parametrize("draws", seeds(2, 8))
def test_the_whole_chain_states_its_errors_honestly(draws):
    surprises, noises, sigmas = [], [], np.array([5e-5, 3e-5])
    options = CellOptions(pixel_sigma_px=0.1, robot_sigma_rad=sigmas[0], robot_sigma_m=sigmas[1])
    for seed in draws:
        known = calibrated(cell := simulate(replace(options, seed=seed)))
        error, covariance = error_of(cell, known), known.assessment.fit.whole[:12, :12]
        surprises.append(error @ np.linalg.solve(covariance, error) / 12)
        noises.append(known.assessment.fit.noise.robots[0])
        assert known.pixel_px == pytest.approx(0.1, rel=0.1)
    # A chi-square of 12 over 12 has the standard deviation 0.41: four of the mean's. The estimated
    # noise raises the expectation by some percent (F against chi-square).
    assert np.mean(surprises) == pytest.approx(1.05, abs=1.63 / np.sqrt(len(draws)))
    # A level has some 8 degrees of freedom a cell at the worst: a quarter; four of the mean's.
    levels = np.sqrt(np.mean(np.square(noises), axis=0))
    assert levels == pytest.approx(sigmas, rel=1.02 / np.sqrt(len(draws)))


def some_places(count, seed=0):
    return some_motion(count, seed)[:, :3, 3]


def turned(turns, seed=0):
    return compose(Rotation.from_rotvec(turns).as_matrix(), some_places(len(turns), seed))


def problem_of(cell, camera=None):
    seen = cell.cam_from_target if camera is None else camera
    return chain(cell.options.mount, cell.robot.base_from_flange, seen)


def state_of(*edges):
    return State(np.array(edges), np.zeros(0))


def made_up(robot, x, z, noise=NOISE, seed=0, mount="eye-in-hand"):
    """A chain whose residuals have just this noise."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat(noise.robots[0], 3)
    errors = exp(rng.standard_normal((len(robot), 6)) * sigma)
    return chain(mount, robot_part(robot, mount), invert(robot @ x) @ z @ errors)


def some_edges(seed=0):
    rng = np.random.default_rng(seed)
    return [
        compose(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3)) for _ in range(2)
    ]


def some_motion(count, seed=0, tilt=0.5):
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.uniform(-tilt, tilt, (count, 3))).as_matrix()
    return compose(rotation, rng.uniform(-0.3, 0.3, (count, 3)))


@pytest.mark.slow
def test_noise_and_errors_are_as_stated():
    x, z = some_edges(1)
    robot = some_motion(20, 1)
    surprises, sigmas = [], []
    for seed in range(100):
        data = made_up(robot, x, z, seed=seed)
        sigmas.append(fit_problem(data, state_of(x, z)).noise.robots[0])
        result = solved(data)
        error = log(invert(np.array([x, z])) @ result.state.edges).ravel()
        surprises.append(error @ np.linalg.solve(result.covariance, error) / 12)
    # Variances, not deviations, are unbiased; 100 runs of 54 degrees of freedom: 2 %.
    variances = np.mean(np.square(sigmas), axis=0)
    np.testing.assert_allclose(variances, NOISE.robots[0] ** 2, rtol=0.08)
    # Mean of 100 chi-square of 12: 0.04; the estimated noise adds 1 / 27 to the expectation
    # (F against chi-square).
    assert np.mean(surprises) == pytest.approx(1.04, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("runs", seeds(1, 2))
@pytest.mark.parametrize(("of_flange", "name"), [(True, "robot"), (False, "combined")])
def test_the_noise_of_pose_pairs_is_where_it_arises(of_flange, name, runs):
    """Of a servo arm at its flange; of a poor detection at the target, 0.3 m from the camera."""
    rng, squares = np.random.default_rng(4), []
    x, z = exp(np.array([0.3, -0.1, 1.5, 0.03, -0.05, 0.02])), exp(np.array([0, 3, 0, 0.3, 0, 0.1]))
    for _ in runs:
        cam_from_target = exp(rng.uniform(-1, 1, (24, 6)) * [0.6, 0.6, 1.5, 0.05, 0.05, 0.05])
        cam_from_target[:, 2, 3] += 0.3
        noise = exp(rng.normal(0.0, [0.05] * 3 + [0.005] * 3, (24, 6)))
        flange = z @ invert(x @ cam_from_target)
        seen = cam_from_target if of_flange else cam_from_target @ noise
        reported = flange @ noise if of_flange else flange
        found = visioncal.calibrate(pairs_session("eye-in-hand", reported, seen))
        assert {level.partition("_")[0] for level in found.noise} == {name}
        squares.append(misfit(found.edges["flange_from_cam"], x))
    # Chi-squares of six degrees of freedom each: exceeded in one case of a thousand.
    assert sum(squares) < stats.chi2.isf(1e-3, 6 * len(runs))


def test_the_fit_is_the_least_squares_solution_from_far_starts_too():
    x, z = some_edges(2)
    data = made_up(some_motion(15, 2), x, z)
    near, rested = solve_problem(data, state_of(x, z), NOISE)
    assert rested
    push = exp(np.array([0.15, -0.1, 0.1, 0.05, -0.03, 0.04]))
    far, _ = solve_problem(data, state_of(x @ push, z @ push), NOISE)
    # The cost is settled to 1e-10 of itself, the edges to 1e-5 of their sigma of about 1e-4.
    np.testing.assert_allclose(far.edges, near.edges, atol=1e-8)
    linear = data.linear(near)
    jacobian, weights = linear.jacobian, np.repeat(NOISE.robots[0] ** -2.0, 3)
    gradient = np.einsum("mij,i,mi->j", jacobian, weights, linear.residuals)
    information = np.einsum("mij,i,mik->jk", jacobian, weights, jacobian)
    # In units of the edges' sigma the gradient of a settled fit is nothing.
    assert np.abs(gradient * np.sqrt(np.diag(np.linalg.inv(information)))).max() < 1e-4


@pytest.mark.slow
def test_three_views_do_not_pass_for_exact():
    for seed in range(20):
        cell = simulate(CellOptions(views=3, seed=seed, pixel_sigma_px=0.1))
        try:
            result = solved(problem_of(cell, measured_poses(cell)))
        except DegenerateError:
            continue
        # Nine equations of translation can be fitted away by nine unknowns; the noise stays.
        assert np.all(result.noise.robots > 1e-6)


def one_axis(seed, wobble_rad=0.0, count=12):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turns = np.outer(rng.uniform(-1, 1, count), axis) + wobble_rad * rng.normal(size=(count, 3))
    return compose(Rotation.from_rotvec(turns).as_matrix(), rng.uniform(-0.3, 0.3, (count, 3)))


def far_one_of_thousands(_):
    """All other views, and any even choice of them, differ by 0.1 deg only: in position alone."""
    turns = np.outer(1e-3 * np.linspace(-1, 1, 2000), [0.0, 0.0, 1.0])
    turns[777] *= 1000.0
    return turned(turns)


def hardly_turned(seed, noise_rad=2e-4):
    return turned(noise_rad * np.random.default_rng(seed).normal(size=(10, 3)), seed)


@pytest.mark.parametrize(
    ("motion", "mount", "seeds", "words"),
    [
        (one_axis, "eye-in-hand", 10, "camera's offset along the tool's"),
        (far_one_of_thousands, "eye-in-hand", 1, "all 2000 used views turn about the tool's z"),
        (partial(hardly_turned, noise_rad=0.0), "eye-in-hand", 6, "differ in position only"),
        (hardly_turned, "eye-in-hand", 6, "differ in position only"),
        (hardly_turned, "eye-to-hand", 6, "differ in position only"),
        (
            lambda _: some_motion(0),
            "eye-in-hand",
            1,
            "0 usable stops of the robot, but it takes at least 3",
        ),
        (
            lambda _: some_motion(1),
            "eye-in-hand",
            1,
            "1 usable stop of the robot, but it takes at least 3",
        ),
        (
            lambda _: np.repeat(some_motion(1), 12, axis=0),
            "eye-in-hand",
            1,
            "all from one pose of the robot",
        ),
    ],
    ids=["axis", "2000", "places", "places, noise", "to hand", "0", "1", "one pose"],
)
def test_motion_that_leaves_an_edge_open_is_refused_by_name(motion, mount, seeds, words):
    for seed in range(seeds):
        data = made_up(motion(seed), *some_edges(seed), seed=seed, mount=mount)
        caught = raised(DegenerateError, words, solved, data)
        asks = "measure that offset" in caught.next_step
        assert not (asks and "position" in words)


def test_near_views_have_one_pose_and_no_pose_has_itself_for_a_rival():
    cell = simulate(CellOptions(seed=2, pixel_sigma_px=0.05, tilt_rad=(0.4, 0.7)))
    assert all(len(view.cam_from_target) == 1 for view in poses_of(cell).views)
    # Corners so exact that a pose costs more where the one fit left it than where the other did.
    cell = simulate(CellOptions(seed=9, pixel_sigma_px=0.01, tilt_rad=(0.1, 0.3)))
    for view in poses_of(cell).views:
        first, *others = view.cam_from_target
        assert all(np.linalg.norm(log(invert(first) @ other)[:3]) > 1e-3 for other in others)


def test_a_lens_that_views_leave_open_is_refused():
    raised(DegenerateError, "focal length open to", estimate, cell_with(CAMERAS["wide"], 4, **FLAT))
    for views, words in ((1, "1 view shows"), (2, "2 views show")):
        with pytest.raises(DataError, match=f"{words} the target, but it takes at least 3"):
            estimate(cell_with(CAMERAS["wide"], 6, views=views))


@pytest.mark.slow
def test_a_robot_that_never_moved_is_named_before_the_lens_that_this_leaves_open():
    cell, rng = cell_with(CAMERAS["wide"], 4, **FLAT), np.random.default_rng(0)
    seen = cell.corners[0]
    session = Session.from_corners(
        [(seen.ids, seen.px + 0.1 * rng.normal(size=seen.px.shape)) for _ in range(12)],
        np.tile(cell.robot.base_from_flange[0], (12, 1, 1)),
        cell.options.target,
        CAMERAS["wide"].resolution,
        mount="eye-in-hand",
    )
    refused = raised(
        DegenerateError, r"all from one pose of the robot\. intr", visioncal.calibrate, session
    )
    assert "flange is tilted by 20 to 40 degrees" in str(refused.next_step)


@pytest.mark.slow
def test_healthy_motion_is_never_refused_small_tilts_included():
    for seed in range(60):
        rng = np.random.default_rng(seed)
        x, z = some_edges(seed)
        tilt = np.deg2rad(rng.uniform(5, 40))
        data = made_up(
            some_motion(int(rng.integers(8, 30)), seed, tilt), x, z, Noise.of_robot(3e-4, 2e-4)
        )
        result = solved(data)
        sigma = np.sqrt(np.diag(result.covariance))
        # 5.5 sigma of six components over 60 sets: once in thousands of runs of this test.
        assert np.all(np.abs(log(invert(x) @ result.state.edges[0])) < 5.5 * sigma[:6])


def test_the_geometry_of_the_stops_decides_and_not_how_little_noise_the_data_show():
    x, z = some_edges(2)
    motion, messages = one_axis(2, np.deg2rad(0.3)), set()
    for share in (1e-3, 0.1, 1.0):
        noise = Noise.of_robot(share * np.deg2rad(0.05), share * 1e-4)
        with pytest.raises(DegenerateError, match="at a typical noise") as refused:
            solved(made_up(motion, x, z, noise))
        figure = re.search(r"predicted sigma of ([\d.]+) mm", str(refused.value))
        messages.add(float(figure[1]))
    # The poses at which it is predicted differ by the noise itself.
    assert max(messages) < 1.1 * min(messages)


def corners_of(cell):
    return {corner.view: corner for corner in cell.corners}


def poses_of(cell, corners=None):
    return estimate_poses(corners or corners_of(cell), [cell.options.target], cell.options.camera)


def chosen_of(cell):
    """The views with the one pose that the robot's motion leaves to each."""
    known = known_of(cell, joints=False)
    for stage in STAGES:
        if stage.name in ("intrinsics", "pnp"):
            known = stage.run(known)
    return find_start(read_cell(known), known, is_solved=False)


@pytest.mark.slow
def test_poses_follow_their_stated_covariance():
    surprises = []
    for seed in range(10):
        cell = simulate(CellOptions(seed=seed, pixel_sigma_px=0.1))
        result = poses_of(cell)
        assert result.sigma_px == pytest.approx(0.1, rel=0.1)
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
    choice = chosen_of(cell)
    wrong_by_image = 0
    for view in choice.poses:
        candidates = result.views[view.view].cam_from_target
        away = np.linalg.norm(log(invert(cell.cam_from_target[view.view]) @ candidates), axis=1)
        assert np.array_equal(view.cam_from_target[0], candidates[away.argmin()])
        wrong_by_image += int(away.argmin() != 0)
    # The image alone picks the mirrored pose in some views, or the test would show nothing.
    assert wrong_by_image >= 1
    assert len(choice.poses) >= 8
    assert len(choice.poses) + len(choice.cell.reasons) == len(result.views)


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
    choice = chosen_of(showing(cell, corners.values()))
    assert not choice.cell.reasons
    camera = np.array([view.cam_from_target[0] for view in choice.poses])
    answer = SOLVERS["park"](cell.robot.base_from_flange, camera)
    placed = cell.robot.base_from_flange @ answer.x @ camera
    # Views agree to the noise, not to within a board's width.
    assert np.ptp(placed[:, :3, 3], axis=0).max() < 2e-3
    # The camera's transform does not depend on which end is called first.
    assert np.linalg.norm(answer.x[:3, 3] - cell.transforms["flange_from_cam"][:3, 3]) < 1e-3
    positions = corner_positions(target)
    for view, pose in zip(choice.poses, camera, strict=True):
        points = positions[view.corners.ids] @ pose[:3, :3].T + pose[:3, 3]
        # Renumbered with their pose, the corners project onto themselves.
        away = project(cell.options.camera, points) - view.corners.px
        assert np.abs(away).max() < 1.0


def estimate(cell, without=()):
    corners = {corner.view: corner for corner in cell.corners if corner.view not in without}
    camera = cell.options.camera
    return estimate_intrinsics(corners, [cell.options.target], camera.resolution, "brown")


def cell_with(camera, seed, **changes):
    return simulate(CellOptions(camera=camera, seed=seed, pixel_sigma_px=0.1, **changes))


@pytest.mark.slow
def test_errors_of_a_lens_follow_the_stated_covariance():
    seeds, camera, surprises, sigmas = 24, CAMERAS["wide"], [], []
    for seed in range(seeds):
        result = estimate(cell_with(camera, seed))
        error, count = intrinsics(result.camera) - intrinsics(camera), len(intrinsics(camera))
        surprises.append(error @ np.linalg.solve(result.covariance, error))
        sigmas.append(result.sigma_px)
    # The mean of `seeds` chi-square variables over their freedom has the standard deviation
    # sqrt(2 / (seeds count)) = 0.10 or less; five of it on either side.
    tolerance = 5 * np.sqrt(2 / (seeds * count))
    assert np.mean(surprises) / count == pytest.approx(1.0, abs=tolerance)
    # About 1,500 corner coordinates a cell leave the noise known to 2 %, 24 cells to 0.4 %.
    assert np.mean(sigmas) == pytest.approx(0.1, rel=0.02)


def test_a_few_wrong_corners_do_no_harm_and_a_wrong_view_is_named():
    cell = cell_with(CAMERAS["wide"], 3)
    corners = {corner.view: corner for corner in cell.corners}
    for view in (2, 5):
        corners[view].px[3] += 6.0
    rng = np.random.default_rng(0)
    corners[7].px[:] += rng.normal(0.0, 12.0, corners[7].px.shape)
    result = estimate(cell)
    clean = estimate(cell_with(CAMERAS["wide"], 3), without=(7,))
    assert [rejection.view for rejection in result.rejections] == [7]
    assert "residual too large" in result.rejections[0].reason
    # Two corners of 700 less: the estimate moves by a small part of its sigma.
    sigma = np.sqrt(np.diag(clean.covariance))
    shift = intrinsics(result.camera) - intrinsics(clean.camera)
    assert np.all(np.abs(shift) < 0.5 * sigma)

"""Wrong views are found, named and left out; right ones are kept."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, error_of, reporting, showing
from support.edges import inliers_of
from support.marks import slow

from visioncal.core.transforms import exp
from visioncal.estimation.chain import chain
from visioncal.estimation.outliers import distances
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import (
    Solution,
    fit_problem,
    solve_problem,
)
from visioncal.simulation import CellOptions, fine_camera, simulate, wide_camera

WORLDS = {
    "fine, given": CellOptions(camera=fine_camera(), pixel_sigma_px=0.1),
    "wide, estimated": CellOptions(
        camera=wide_camera(), pixel_sigma_px=0.1, state_intrinsics=False, mount="eye-to-hand"
    ),
}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("wrong", [0, 6])
def test_just_the_wrong_views_are_left_out(world, wrong):
    cell = simulate(replace(WORLDS[world], wrong_views=wrong))
    known = calibrated(cell)
    assert set(range(20)) - set(known.used) == set(cell.wrong_views)
    for view in cell.wrong_views:
        assert "times the noise" in known.reasons[view]
    error, covariance = error_of(cell, known), known.assessment.covariance[:12, :12]
    # Chi-square of 12 stays under 39 in all but one case of ten thousand.
    assert error @ np.linalg.solve(covariance, error) < 39.0


def test_what_is_far_off_is_left_out_where_the_others_agree_to_nothing_good():
    """Poses to 10 mm and 1 deg, which is more than any result may be off, and one to 100 deg."""
    cell = simulate(replace(WORLDS["fine, given"], views=60, seed=4))
    rng = np.random.default_rng(0)
    noise = np.repeat([np.deg2rad(1.0), 0.01], 3) * rng.standard_normal((60, 6))
    noise[17, 1] += np.deg2rad(100.0)
    found = inliers_of(
        chain("eye-in-hand", cell.robot.base_from_flange, cell.cam_from_target @ exp(noise))
    )
    assert np.flatnonzero(~found.used).tolist() == [17]


def test_a_stop_is_right_or_wrong_as_a_whole():
    cell = simulate(replace(WORLDS["fine, given"], seed=1, wrong_views=1))
    known = calibrated(cell)
    (wrong,) = cell.wrong_views
    problem = known.cell_fit.inlier_fit.problem.with_effects([])
    doubled = problem.observations.take(np.repeat(np.arange(20), 2))
    found = inliers_of(replace(problem, observations=doubled))
    assert np.flatnonzero(~found.used).tolist() == [2 * wrong, 2 * wrong + 1]


def looked_at_again(problem, times=2, seed=5):
    """Each stop looked at several times, with the camera's own noise each time."""
    seen = problem.observations.take(np.repeat(np.arange(len(problem)), times))
    noise = np.random.default_rng(seed).standard_normal((len(seen), 6))
    moved = exp((np.linalg.cholesky(seen.covariance) @ noise[:, :, None])[:, :, 0])
    return replace(problem, observations=replace(seen, measured=seen.measured @ moved))


def with_measured(problem, measured):
    return replace(problem, observations=replace(problem.observations, measured=measured))


@pytest.mark.parametrize(("times", "measured"), [slow(2, True), (3, False)])
def test_a_wrong_image_does_not_take_a_sound_one_of_its_stop_with_it(times, measured):
    known = calibrated(simulate(replace(WORLDS["fine, given"], seed=1)))
    problem = looked_at_again(known.assessment.problem.with_effects([]), times)
    if measured:
        unknown = np.zeros_like(problem.observations.covariance)
        seen = replace(
            problem.observations, covariance=unknown, is_uneven=np.ones(len(unknown), dtype=bool)
        )
        problem = replace(problem, observations=seen, is_combined=True)
    assert inliers_of(problem).used.all()
    wrong = problem.observations.measured.copy()
    wrong[4 * times + 1] = problem.observations.measured[11 * times]
    found = inliers_of(with_measured(problem, wrong))
    assert np.flatnonzero(~found.used).tolist() == [4 * times + 1]


def test_a_square_is_the_distance_from_what_the_others_predict():
    known = calibrated(simulate(replace(WORLDS["fine, given"], seed=3, views=12)))
    problem = known.assessment.problem.with_effects([])
    state = State(known.assessment.state.edges, np.zeros(0))
    everything = np.ones(12, dtype=bool)
    fit = fit_problem(problem, state)
    inside = distances(problem, everything, fit)
    for view in (0, 7):
        others = everything.copy()
        others[view] = False
        # The same noise, so that the deletion identity holds to the fit's own curvature.
        state, _ = solve_problem(problem.subset(others), fit.state, fit.noise)
        without = distances(problem, others, Solution(state, fit.noise))
        assert without.squares[view] == pytest.approx(inside.squares[view], rel=1e-3)


def test_rows_that_are_exchanged_and_an_image_of_another_row_are_named():
    cell = simulate(CellOptions(seed=3))
    poses = cell.robot.base_from_flange.copy()
    poses[[4, 9]] = poses[[9, 4]]
    corners = [
        replace(cell.corners[2], view=7) if view_corners.view == 7 else view_corners
        for view_corners in cell.corners
    ]
    known = calibrated(reporting(showing(cell, corners), base_from_flange=poses), joints=False)
    verdict = known.verdict
    assert verdict.status == "check"
    (words,) = [reason for reason in verdict.reasons if "exchanged" in reason]
    assert words.startswith("Views 4 and 9 are exchanged: the image of each fits the pose in the")
    (words,) = [reason for reason in verdict.reasons if reason.startswith("View 7 was left out")]
    assert "its image is of stop 2; its pose or its reading is wrong" in words
    assert set(known.reasons) == {4, 7, 9}

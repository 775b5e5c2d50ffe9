"""The arm's own errors: which of them are told, and what the calibrated arm is worth."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import calibrated, error_of, known_of, reporting
from support.marks import slow
from support.wrong_arms import GOOD, WRONG_LINKS, error_m, target_in_camera

import visioncal
from visioncal.calibration.pipeline.budget import middles_of
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.stages.kinematics import select_errors
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp, invert, log
from visioncal.core.types import MOUNTS
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.armpair import ArmPair
from visioncal.estimation.problem_parts import ROBOT, State
from visioncal.estimation.workspace import postures
from visioncal.simulation import simulate


def place_sigmas_m(known):
    """(k,) predicted sigmas of the place of what the arm carries, over its workspace [m]."""
    answer, arm = known.assessment, known.robot_arm
    middles = middles_of(known.cell_fit.cell)
    data = arm.data(answer.problem, answer.fit, answer.covariance, middles)
    return data.place_sigmas_m(postures(arm.model.robot))


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_an_arm_off_by_a_millimetre_is_calibrated_all_over_its_workspace(mount):
    shares = []
    for seed in range(4):
        cell = simulate(replace(WRONG_LINKS, mount=mount, seed=seed, branches=True))
        known, nominal = calibrated(cell), calibrated(cell, joints=False)
        assert known.robot_arm.kinematics.level == "geometry"
        assert nominal.robot_arm.model is None
        assert known.verdict.status in ("good", "check")
        after = error_m(cell, known, known.robot_arm.model.robot)
        shares.append(after / error_m(cell, nominal, known.robot))
    # Thirty views leave 5 % of what a fit of the edges alone leaves; four worlds scatter by half.
    assert np.median(shares) < 0.08


def test_offsets_alone_are_told_from_wrong_links():
    cell = simulate(replace(GOOD, offset_sigma_rad=1e-3, seed=1))
    known = calibrated(cell)
    assert known.robot_arm.kinematics.level == "offsets"
    by_name = {level.level: level for level in known.robot_arm.kinematics.result.levels}
    assert by_name["offsets"].held_out_mm < 0.3 * by_name["nominal"].held_out_mm
    # Those of the first and the last joint hide in base and tool; the others are told to 0.1 mrad.
    found = known.robot_arm.model.robot.chain.functions[1:5, 0]
    true = (cell.robot.true_arm.offset - cell.robot.arm.offset)[1:5]
    assert found == pytest.approx(true, abs=3e-4)


@pytest.mark.slow
def test_links_that_are_off_by_little_count_in_the_covariance():
    # Off by hardly more than the arm repeats to, in all parameters alike: offsets of the joints
    # explain most of what twelve views show, and leave the first and the last link for exact.
    little = replace(GOOD, views=12, dh_sigma_m=5e-5, dh_sigma_rad=5e-5)
    squares = 0.0
    for seed in (1, 9, 13):
        cell = simulate(replace(little, seed=seed))
        known = calibrated(cell)
        assert known.robot_arm.kinematics.level == "geometry"
        error = error_of(cell, known)
        squares += error @ np.linalg.solve(known.assessment.covariance[:12, :12], error)
    # Chi-square of 36 degrees of freedom but for one in a thousand; under offsets it is 118.
    assert squares < 68.0


@pytest.mark.slow
def test_a_wrong_gear_ratio_is_told():
    cell = simulate(replace(WRONG_LINKS, seed=2, views=40, branches=True))
    reported = cell.robot.joints.copy()
    reported[:, 1:4] *= 1.0 - 1e-3
    robot = known_of(cell).robot
    geared = reporting(cell, joints=reported, base_from_flange=robot.base_from_flange(reported))
    known = calibrated(geared)
    assert known.robot_arm.kinematics.level == "eccentricity"
    assert "ratios" in known.robot_arm.kinematics.errors
    # Told to a tenth beside errors of all links.
    assert known.robot_arm.model.robot.chain.functions[1:4, 1] == pytest.approx(1.001, abs=2e-4)


def test_an_arm_with_long_links_is_not_taken_for_a_small_board():
    sure = replace(WRONG_LINKS.target, square_sigma_m=1e-6 * WRONG_LINKS.target.square_m)
    cell = simulate(replace(WRONG_LINKS, seed=3, target=sure))
    known = calibrated(cell)
    # As if nothing but errors of one size could be, this arm makes the board 0.16 % smaller, at
    # three sigma; what was measured to a millionth is kept.
    assert 9 in known.cell_fit.linearised_corners.free
    assert known.cell_fit.linearised_corners.held.all()
    sigma = float(np.sqrt(np.mean(place_sigmas_m(known) ** 2)))
    assert error_m(cell, known, known.robot_arm.model.robot) < 2.0 * sigma


def test_a_right_arm_stays_nominal():
    known = calibrated(simulate(replace(GOOD, seed=3)))
    assert known.robot_arm.kinematics.level == "nominal"
    assert known.robot_arm.model is None
    assert [level.level for level in known.robot_arm.kinematics.result.levels] == ["nominal"]


def test_without_joints_no_level_can_be_asked_for():
    cell = simulate(replace(WRONG_LINKS, views=12))
    assert calibrated(cell, joints=False).robot_arm.kinematics is None
    with pytest.raises(DataError, match="needs the joint angles of every view"):
        calibrated(cell, joints=False, level="kinematics")


@pytest.mark.parametrize("mount", [MOUNTS[0], slow(MOUNTS[1])])
def test_predictions_move_as_their_derivatives_say(mount):
    known = calibrated(simulate(replace(WRONG_LINKS, mount=mount, seed=4)))
    arm, edges = known.robot_arm.at(np.arange(3)), known.assessment.state.edges
    model, q = arm.model, arm.joints_rad
    size, step = 12 + len(model.values), 1e-6
    middle = target_in_camera(mount, *edges, model.robot.base_from_flange(q))
    problem = known.assessment.problem.with_effects([])
    pair = ArmPair.of(problem, State(edges, np.zeros(0)), ROBOT)
    jacobian = pair.jacobian(model.base_from_flange(q), model.basis(q))[1]
    for at in range(size):
        change = np.zeros(size)
        change[at] = step
        ends = [
            log(
                invert(middle)
                @ target_in_camera(
                    mount,
                    *(edges @ exp(array[:12].reshape(2, 6))),
                    model.moved(array[12:]).robot.base_from_flange(q),
                )
            )
            for array in (change, -change)
        ]
        # Steps are composed with values of some mrad, whose product is left out.
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(jacobian[:, :, at], abs=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("mount", MOUNTS)
def test_the_workspace_sigma_holds_the_error(mount):
    sure = replace(WRONG_LINKS.target, square_sigma_m=1e-5 * WRONG_LINKS.target.square_m)
    cell = simulate(replace(WRONG_LINKS, seed=7, mount=mount, target=sure))
    known = calibrated(cell)
    sigma = float(np.sqrt(np.mean(place_sigmas_m(known) ** 2)))
    # One world's error along the weakest direction, at three sigma.
    assert error_m(cell, known, known.robot_arm.model.robot) < 3.0 * sigma


def test_the_result_holds_the_calibrated_arm(tmp_path):
    cell = simulate(replace(WRONG_LINKS, seed=7))
    known = calibrated(cell)
    file = tmp_path / "calibration.json"
    result_of(known).save(file)
    result = visioncal.Calibration.load(file)
    found = result.arm
    q = postures(known.robot)[:5]
    calibrated_poses = known.robot_arm.model.robot.base_from_flange(q)
    # RigidTransform makes rotations orthonormal anew, to the last digits.
    assert result.base_from_flange(q).as_matrix() == pytest.approx(calibrated_poses, abs=1e-14)
    assert found.level == "geometry"
    assert found.levels[0].level == "nominal"
    changes = {
        (parameter.joint, parameter.name): parameter.change for parameter in found.parameters
    }
    # A UR's second and third axes are parallel, and so get Hayati's beta.
    assert ("shoulder_lift_joint", "beta_rad") in changes
    assert 1e-5 < max(map(abs, changes.values())) < 0.02
    assert found.observability.identifiable == 30
    # The nominal model stays what it was.
    assert np.array_equal(result.robot.base_from_flange(q), known.robot.base_from_flange(q))


@pytest.mark.slow
def test_a_level_that_explains_too_little_is_told():
    cell = simulate(replace(WRONG_LINKS, seed=1))
    known = calibrated(cell, level="offsets")
    assert known.robot_arm.kinematics.level == "offsets"
    assert any(
        "speak for more than the arm's offsets" in reason for reason in known.verdict.reasons
    )
    assert known.verdict.status != "good"
    right = calibrated(simulate(replace(GOOD, seed=3)), level="kinematics")
    assert right.robot_arm.kinematics.level == "nominal"
    assert any("The arm stays as stated" in reason for reason in right.verdict.reasons)


def test_columns_whose_squares_are_no_numbers_leave_the_arm_as_stated():
    known = calibrated(simulate(replace(WRONG_LINKS, views=14, seed=0)))
    arm, fit = known.robot_arm, known.cell_fit.inlier_fit.fit
    assert arm.joints_rad is not None
    nominal = ArmModel.of(known.robot, arm.joints_rad, arm.reported)
    bases = {
        name: nominal.columns(name, arm.joints_rad, arm.loads)
        for name in ("offsets", "links", "eccentricity")
    }
    problem = arm.without_errors(known.cell_fit.inlier_problem)
    state = State(fit.state.edges, problem.start_values)
    assert select_errors(problem, state, ROBOT, bases, 1.0, "auto", fit.noise).level == "geometry"
    bases["offsets"] = 1e200 * bases["offsets"]
    assert select_errors(problem, state, ROBOT, bases, 1.0, "auto", fit.noise).level == "nominal"

"""Arms whose joints err by functions of their angles: what is found of them, and how sure."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import arm_found
from support.later import ANYHOW, Change, known_again, lot
from support.marks import slow
from support.tracked import known_of

from visioncal import correct
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.check import check
from visioncal.calibration.verification.prediction import predict_detected
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.solve import Solution
from visioncal.results import Calibration
from visioncal.results.arm import FUNCTIONS, ArmResult
from visioncal.simulation.arms import forward
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    InstrumentRecord,
    random_postures,
    session_of,
    tracked,
)

# Long functions, which few harmonics carry, are quickly found.
OPTIONS = InstrumentOptions(
    stops=40,
    poses=True,
    dh_sigma_m=5e-4,
    dh_sigma_rad=7e-4,
    offset_sigma_rad=7e-4,
    function_sigma_rad=3e-4,
    function_length_rad=0.25,
)


@pytest.fixture(scope="module")
def shop() -> InstrumentRecord:
    return tracked(OPTIONS)


@pytest.fixture(scope="module")
def known(shop: InstrumentRecord) -> RunState:
    return known_of(session_of(shop))


Q = random_postures(tracked(OPTIONS).arm, 200, np.random.default_rng(1))


def away_m(shop: InstrumentRecord, known: RunState) -> FloatArray:
    """(m, 3) how far the probe is predicted off at postures all over the workspace."""
    x, z = known.assessment.state.edges[:2]
    model = known.robot_arm.model
    found = invert(x) @ model.base_from_flange(Q) @ z
    true = invert(shop.base_from_instrument) @ forward(shop.true_arm, Q) @ shop.flange_from_probe
    return (invert(found) @ true)[:, :3, 3]


def sigmas_m(known: RunState) -> FloatArray:
    """(m,) what is predicted of that."""
    answer = known.assessment
    fit = Solution(answer.state, answer.noise)
    return known.robot_arm.data(answer.problem, fit, answer.covariance, {}).place_sigmas_m(Q)


def test_they_are_found_and_make_the_arm_better_where_it_never_was(shop, known):
    kinematics = known.robot_arm.kinematics
    assert kinematics.level == FUNCTIONS
    # One size from some hundred values, a length from a grid of factors of two.
    assert kinematics.errors["harmonics"].sigma == pytest.approx(3e-4, rel=0.4)
    assert 0.12 <= kinematics.functions.length_rad <= 0.5
    without = known_of(session_of(shop), level="offsets")
    ours, theirs = (float(np.sqrt(np.mean(away_m(shop, value) ** 2))) for value in (known, without))
    assert ours < 0.5 * theirs


def test_the_predicted_error_is_the_error(shop, known):
    squared = np.sum(away_m(shop, known) ** 2, axis=1)
    # One arm: errors at 200 postures are of some dozen values that stops hardly tell.
    assert 0.4 < np.mean(squared) / np.mean(sigmas_m(known) ** 2) < 2.0


def test_left_out_stops_fit_worse_and_no_one_complains(known):
    chosen = known.robot_arm.kinematics.result.levels[-1]
    assert chosen.held_out_mm > chosen.rms_mm
    assert chosen.held_out_mm < 0.3 * known.robot_arm.kinematics.result.levels[0].held_out_mm
    assert "optimism" not in [finding.kind for finding in known.verdict.findings]


def test_the_arm_of_the_result_has_them(known):
    section = result_of(known).arm
    assert isinstance(section, ArmResult)
    assert section.level == FUNCTIONS
    assert section.robot.chain.harmonics is not None
    q = np.random.default_rng(4).uniform(-2.0, 2.0, (5, 6))
    model = known.robot_arm.model
    np.testing.assert_allclose(
        section.robot.base_from_flange(q), model.bare.base_from_flange(q), atol=1e-12
    )
    # Numbers of a table, not harmonics, are what stops are asked to tell.
    assert section.observability.identifiable < 80


def test_an_arm_without_them_has_none():
    shop = tracked(replace(OPTIONS, function_sigma_rad=0.0, seed=2))
    kinematics = known_of(session_of(shop)).robot_arm.kinematics
    assert kinematics.level != FUNCTIONS
    assert kinematics.functions is None


@slow
def test_places_alone_tell_of_them():
    options = replace(OPTIONS, poses=False, stops=60)
    shop = tracked(options)
    known = known_of(session_of(shop))
    assert known.robot_arm.kinematics.level == FUNCTIONS


def test_where_it_carries_over_is_what_is_predicted_there(known):
    found = arm_found(known).sections.arm.carries_over
    assert found.measured_mm == known.robot_arm.kinematics.result.chosen.held_out_mm
    # The wave's own noise and another session's share come on top of what is not known of the arm.
    squares = [found.session_mm**2, 1e6 * np.mean(sigmas_m(known) ** 2)]
    assert found.sigma_mm**2 > squares[0]
    assert found.sigma_mm < found.nominal_mm
    assert found.better_share > 0.9
    assert found.words in known.verdict.reasons


def test_stops_near_one_another_tell_less_elsewhere_and_the_arm_as_stated_is_worse():
    small = dict.fromkeys(("dh_sigma_m", "dh_sigma_rad", "offset_sigma_rad"), 2e-4)
    options = replace(OPTIONS, function_sigma_rad=0.0, **small)
    q = np.array([0.3, -1.2, 1.4, -0.4, 1.2, 0.1])
    near = q + 0.15 * np.random.default_rng(5).standard_normal((24, 6))
    shop = tracked(options, near)
    known = known_of(session_of(shop), level="kinematics")
    found = arm_found(known).sections.arm.carries_over
    assert found.sigma_mm > 3.0 * found.measured_mm
    # One arm of errors that few values tell of: its error is within a factor of what is predicted.
    ours = 1e3 * float(np.sqrt(np.mean(np.sum(away_m(shop, known) ** 2, axis=1))))
    assert 0.4 < ours / found.sigma_mm < 1.5


@pytest.mark.slow
def test_a_check_of_an_unchanged_cell_passes_and_a_bump_is_seen(tmp_path):
    options = replace(ANYHOW, function_sigma_rad=3e-4, function_length_rad=0.12)
    place = lot(options, 20)
    assert place.calibration.arm.level == FUNCTIONS
    # Through the file: harmonics are in the arm, not among the unknowns.
    place.calibration.save(tmp_path / "calibration.json")
    prior = CalibrationPrior.of(Calibration.load(tmp_path / "calibration.json"))
    rng = np.random.default_rng(0)
    found = [check(predict_detected(known_again(place.cell, rng), prior), prior) for _ in range(4)]
    assert all(item.passed and not item.named for item in found)
    # Chi-square of thirty directions; views that were left out err by more than the stops of a cell
    # that is well known, so that it comes out small.
    assert 4.0 < np.mean([item.misfit for item in found]) < 45.0
    bump = Change(camera=np.array([0.0, 0.0, 0.0, 0.0, 4e-3, 0.0]))
    bumped = check(predict_detected(known_again(place.cell, rng, bump), prior), prior)
    assert not bumped.passed
    assert [suspect.name for suspect in bumped.named] == ["camera"]


def test_corrected_targets_reach_where_functions_would_have_led_them_astray(shop, known):
    result, q = result_of(known), 0.9 * Q[:40]
    x, z = known.assessment.state.edges[:2]
    stated = known.robot_arm.kinematics.nominal.fit.state.edges
    wanted = known.robot.base_from_flange(q)
    sent = correct(result, wanted, q)
    assert sent.reached.all()

    def away_mm(joints, frames):
        there = invert(frames[0]) @ wanted @ frames[1]
        real = forward(shop.true_arm, joints) @ shop.flange_from_probe
        error = invert(there) @ invert(shop.base_from_instrument) @ real
        return 1e3 * float(np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, axis=1))))

    # As stated, with the frames that go with that arm, they are off by millimetres.
    assert away_mm(q, stated) > 1.0
    assert away_mm(sent.q, (x, z)) < 0.15

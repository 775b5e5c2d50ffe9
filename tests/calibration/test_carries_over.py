"""What a calibrated arm is worth where it never was, and how sure that is."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import arm_found
from support.tracked import known_of

from visioncal import correct
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.solve import Solution
from visioncal.simulation.arms import forward
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    InstrumentRecord,
    random_postures,
    session_of,
    tracked,
)

OPTIONS = InstrumentOptions(
    stops=40,
    poses=True,
    dh_sigma_m=5e-4,
    dh_sigma_rad=7e-4,
    offset_sigma_rad=7e-4,
    eccentricity_sigma_rad=3e-4,
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


def test_the_arm_is_better_where_it_never_was(shop, known):
    assert known.robot_arm.kinematics.level == "eccentricity"
    without = known_of(session_of(shop), level="offsets")
    ours, theirs = (float(np.sqrt(np.mean(away_m(shop, value) ** 2))) for value in (known, without))
    assert ours < 0.5 * theirs


def test_the_predicted_error_is_the_error(shop, known):
    squared = np.sum(away_m(shop, known) ** 2, axis=1)
    # One arm: errors at 200 postures are of some dozen values that stops hardly tell.
    assert 0.4 < np.mean(squared) / np.mean(sigmas_m(known) ** 2) < 2.0


def test_where_it_carries_over_is_what_is_predicted_there(known):
    found = arm_found(known).sections.arm.carries_over
    assert found.measured_mm == known.robot_arm.kinematics.result.chosen.held_out_mm
    # The wave's own noise and another session's share come on top of what is not known of the arm.
    squares = [found.session_mm**2, 1e6 * np.mean(sigmas_m(known) ** 2)]
    assert found.sigma_mm**2 > squares[0]
    assert found.sigma_mm < found.nominal_mm
    assert found.better_share > 0.9
    assert {region.region for region in found.regions} >= {"box", "beside"}
    assert found.words in known.verdict.reasons


def test_stops_near_one_another_tell_less_elsewhere_and_the_arm_as_stated_is_worse():
    small = dict.fromkeys(("dh_sigma_m", "dh_sigma_rad", "offset_sigma_rad"), 2e-4)
    options = replace(OPTIONS, eccentricity_sigma_rad=0.0, **small)
    q = np.array([0.3, -1.2, 1.4, -0.4, 1.2, 0.1])
    near = q + 0.15 * np.random.default_rng(5).standard_normal((24, 6))
    shop = tracked(options, near)
    known = known_of(session_of(shop), level="kinematics")
    found = arm_found(known).sections.arm.carries_over
    assert found.sigma_mm > 3.0 * found.measured_mm
    # One arm of errors that few values tell of: its error is within a factor of what is predicted.
    ours = 1e3 * float(np.sqrt(np.mean(np.sum(away_m(shop, known) ** 2, axis=1))))
    assert 0.4 < ours / found.sigma_mm < 1.5


def test_corrected_targets_reach_where_the_arm_as_stated_would_not(shop, known):
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

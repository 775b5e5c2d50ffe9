"""Play in the joints, told by stops that were approached from both sides."""

from dataclasses import replace

import numpy as np
import pytest
from support.cells import arm_found, calibrated, reporting
from support.marks import slow
from support.wrong_arms import COBOT, GOOD, SAGGING

from visioncal.calibration.pipeline.result import result_of
from visioncal.simulation import simulate

PLAY = (3e-4, 5e-4, 4e-4, 6e-4, 3e-4, 4e-4)


@pytest.fixture(scope="module")
def worn():
    """A sagging arm with play, every other stop approached from the other side."""
    return calibrated(simulate(replace(SAGGING, backlash_rad=PLAY, seed=2)))


def test_play_is_told_and_is_no_stiffness(worn):
    assert worn.robot_arm.kinematics.level == "elastic"
    plays = arm_found(worn).sections.arm.backlash
    for play, true in zip(plays, PLAY, strict=True):
        assert play.is_sure
        # Six draws, at three and a half sigma.
        assert abs(play.deadband_rad - true) < 3.5 * play.sigma_rad
    springs = arm_found(worn).sections.elastic.joints
    for at in (1, 2):
        assert (
            abs(springs[at].compliance_rad_per_nm - 1.0 / COBOT[at])
            < 3.5 * springs[at].sigma_rad_per_nm
        )
    assert any("Joints have play: shoulder_pan_joint" in reason for reason in worn.verdict.reasons)


def test_play_is_in_the_result(worn):
    rows = result_of(worn).arm.backlash
    assert [row.joint for row in rows] == list(worn.robot.joint_names)
    assert rows[1].deadband_rad == pytest.approx(PLAY[1], rel=0.2)


@pytest.mark.parametrize("way", [1.0, slow(-1.0)], ids=["from", "to"])
def test_an_arm_that_is_right_but_for_its_play(way):
    cell = simulate(replace(GOOD, views=40, backlash_rad=PLAY, seed=3))
    # Some write the side that the joints moved to; a dead-band is a width all the same.
    known = calibrated(reporting(cell, approach=way * cell.robot.approach))
    assert known.robot_arm.kinematics.level == "backlash"
    told = [play.deadband_rad for play in arm_found(known).sections.arm.backlash]
    assert told == pytest.approx(PLAY, abs=1.5e-4)
    # In the middle of its play the arm is the one that was stated.
    q = known.robot_arm.joints_rad
    away = known.robot_arm.model.base_from_flange(q) - known.robot.base_from_flange(q)
    assert np.abs(away).max() < 1e-9
    result = result_of(known)
    assert result.arm_is_calibrated
    assert result.standing(q) == pytest.approx(known.robot.base_from_flange(q), abs=1e-9)


@pytest.mark.slow
def test_stops_from_one_side_tell_no_play():
    cell = simulate(replace(SAGGING, backlash_rad=PLAY, seed=2))
    known = calibrated(reporting(cell, approach=np.ones(len(cell.robot.approach))))
    assert arm_found(known).sections.arm.backlash == ()

"""Streams and clocks of whole cells: a camera that sees a moving robot by a clock of its own."""

from dataclasses import replace

import numpy as np
import pytest
from support.swept_cells import AHEAD_S, cell_of, swept_session

from visioncal.calibration.run import calibrate
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.simulation.layout import NetworkOptions

CLOCK = "cam_side and robot b"


@pytest.fixture(scope="module")
def swept():
    arms = (replace(robot, offset_sigma_rad=1e-3) for robot in NetworkOptions().robots)
    cell = cell_of(NetworkOptions(tuple(arms), stops=16, seed=4))
    return cell, *swept_session(cell)


@pytest.fixture(scope="module")
def found(swept):
    _, session, corners = swept
    return calibrate(session, corners=corners)


def test_the_offset_of_one_camera_is_found_by_the_motion(found):
    clock = found.cell.details.clocks[CLOCK]
    assert clock.method == "motion"
    assert clock.sigma_s < 1e-4
    # Three sigma: one run in 370. What the motion tells of the arm as stated is off by more.
    assert abs(clock.camera_minus_robot_s - AHEAD_S) < 3 * clock.sigma_s


def test_the_clock_of_one_camera_and_robot_goes_with_them(found):
    assert found.of("side", "b").clock == found.cell.details.clocks[CLOCK]
    assert found.of("left", "b").clock is None


def test_a_camera_that_saw_nothing_else_is_placed_as_its_covariance_says(swept, found):
    cell, session, _ = swept
    edge = found.between("cam_left", "cam_side")
    away = log(invert(cell.between("cam_left", "cam_side")) @ edge.matrix)
    # Chi-square of 6 beyond 22 is 0.1 %.
    assert away @ np.linalg.solve(edge.covariance, away) < 22.0
    # Its lens is estimated, with a field and a focus of its own.
    assert edge.sigma_mm < 0.3
    used = [view for view in found.views if view.seer == "cam_side" and view.used]
    assert len(used) > 30
    assert found.session_sha256 == session.digest()


def test_a_clock_of_no_camera_is_refused(swept):
    _, session, corners = swept
    document = {**session.document, "clocks": {"sied": {"camera_minus_robot_s": 0.02}}}
    with pytest.raises(DataError, match=r"clocks\.sied is of no camera"):
        calibrate(replace(session, document=document), corners=corners)


@pytest.mark.slow
def test_rows_whose_motion_tells_no_offset_are_left_out_and_say_so(swept):
    """Some frames of the sweep: too few to say when."""
    _, session, corners = swept
    timed = [view for view in session.views if view.stamp_s is not None]
    views = tuple(view for view in session.views if view.stamp_s is None or view in timed[:5])
    found = calibrate(replace(session, views=views), corners=corners)
    lost = [view for view in found.views if view.seer == "cam_side"]
    assert len(lost) == 5
    assert all(not view.used and "clock" in view.reason for view in lost)
    assert "cam_side" in {untied.frame for untied in found.cell.untied}
    assert any(reason.startswith(CLOCK) for reason in found.verdict.reasons)

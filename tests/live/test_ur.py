"""The UR driver through the real client library, against a simulated controller.

Limits of time are generous where a computer may be busy; alone, each fault is told within 0.6 s.
"""

import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import pytest
from support.refusals import raised

from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import MovingArm
from visioncal.live.drivers.ur import UrArm
from visioncal.live.simulated.controller import spawn
from visioncal.live.simulated.machine import ControllerOptions
from visioncal.simulation.arms import forward

pytest.importorskip("rtde_control", reason="ur-rtde is not installed (the extra `ur`)")

TCP = (0.01, -0.02, 0.15, 0.1, 0.2, -0.3)
STEP = np.array([0.3, -0.1, 0.1, 0.0, 0.05, -0.2])
# A motion of many seconds, in which something happens.
FAR, SLOW = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.1
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def controller():
    with spawn(ControllerOptions(tcp=TCP)) as running:
        yield running


def wait_while(condition, limit_s=PATIENCE_S):
    """Waits; returns how long it took [s]."""
    began = time.monotonic()
    while condition():
        assert time.monotonic() - began < limit_s
        time.sleep(0.005)
    return time.monotonic() - began


def stands(controller):
    return not controller.state([time.monotonic()]).dq.any()


@pytest.mark.usefixtures("patient")
def test_an_arm_moves_reports_its_pose_and_stops(controller):
    with closing(UrArm(controller.host)) as arm:
        assert isinstance(arm, MovingArm)
        assert arm.name == f"UR10e at {controller.host}"
        assert arm.model == "ur10e"
        before = arm.state()
        goal = before.q + STEP
        arm.start_move(goal, speed=0.5, acceleration=1.0)
        assert arm.moving()
        wait_while(arm.moving)
        after = arm.state()
        assert after.q == pytest.approx(goal)
        # 0.3 rad at 0.5 rad/s and 1 rad/s^2 take 1.1 s: the limits of speed are kept.
        assert after.stamp_s - before.stamp_s > 1.1
        arm.start_move(goal + FAR, speed=0.2, acceleration=1.0)
        wait_while(lambda: np.abs(arm.state().dq).max() < 0.1)
        arm.halt()
        wait_while(arm.moving)
        assert np.abs(arm.state().q - goal - FAR).max() > 0.05
        arm.halt()


@pytest.mark.usefixtures("patient")
def test_a_state_is_the_flange_in_the_controllers_base(controller):
    with closing(UrArm(controller.host)) as arm:
        state = arm.state()
    believed = ControllerOptions().believed_arm
    # The pose went through rotation vectors and the tool offset: rounding alone is left.
    assert state.base_from_flange == pytest.approx(forward(believed, state.q[None])[0], abs=1e-9)
    assert state.flange_from_tool[:3, 3] == pytest.approx(TCP[:3])
    assert state.payload_kg == 0.6
    assert state.payload_m == pytest.approx([0.0, 0.0, 0.04])
    assert state.safety == "normal"
    assert state.currents_a.shape == state.temperatures_c.shape == (6,)


@pytest.mark.usefixtures("patient")
def test_a_state_is_stamped_with_the_time_at_which_the_arm_was_there(controller):
    with closing(UrArm(controller.host)) as arm:
        # States at rest: the shortest delay of many is found in spite of a busy computer.
        start = [arm.state() for _ in range(50)][-1].q
        arm.start_move(start + STEP, speed=0.4, acceleration=4.0)
        states = []
        while arm.moving():
            states.append(arm.state())
        arm.start_move(start, speed=1.0, acceleration=4.0)
        wait_while(arm.moving)
    stamps = [state.stamp_s for state in states]
    assert np.all(np.diff(stamps) > 0.0)
    truth = controller.state(stamps)
    fast = [place for place, state in enumerate(states) if abs(state.dq[0]) > 0.3]
    assert len(fast) > 5
    late = [(truth.q[index, 0] - states[index].q[0]) / states[index].dq[0] for index in fast]
    # States take well under a millisecond.
    assert np.median(np.abs(late)) < 4e-3


@pytest.mark.usefixtures("patient")
def test_watching_needs_no_remote_control_and_moves_nothing(controller):
    controller.inject("remote-off")
    try:
        raised(DriverError, "local control", UrArm, controller.host)
        with closing(UrArm(controller.host, watch_only=True)) as arm:
            before = arm.state()
            assert before.flange_from_tool[:3, 3] == pytest.approx(TCP[:3])
            assert not arm.moving()
            with pytest.raises(DriverError, match="only watched"):
                arm.start_move(before.q, speed=1.0, acceleration=1.0)
            ends = controller.guide(before.q + 0.1, speed=SLOW, acceleration=1.0)
            wait_while(lambda: not arm.moving())
            time.sleep(max(0.0, ends - time.monotonic()))
            wait_while(arm.moving)
            assert arm.state().q == pytest.approx(before.q + 0.1)
            arm.halt()
    finally:
        controller.inject("none")


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(
    ("fault", "message", "safety"),
    [
        ("protective-stop", "PROTECTIVE_STOP.*Enable Robot", "protective-stop"),
        ("remote-off", "local control.*Remote Control", "normal"),
    ],
)
def test_a_motion_that_is_stopped_is_reported_with_what_to_press(
    controller, fault, message, safety
):
    with closing(UrArm(controller.host)) as arm:
        arm.start_move(arm.state().q + FAR, speed=SLOW, acceleration=1.0)
        assert arm.moving()
        controller.inject(fault)
        try:
            raised(DriverError, message, wait_while, arm.moving)
            assert arm.state().safety == safety
            with pytest.raises(DriverError, match=message):
                arm.start_move(arm.state().q, speed=SLOW, acceleration=1.0)
            arm.halt()
            wait_while(lambda: not stands(controller))
        finally:
            controller.inject("none")
        # Once it is freed, it goes on with no new connection.
        wait_while(lambda: arm.state().safety != "normal")
        arm.start_move(arm.state().q + 0.01, speed=SLOW, acceleration=1.0)
        wait_while(arm.moving)


@pytest.mark.usefixtures("patient")
def test_a_controller_that_dies_in_a_motion_is_noticed():
    with spawn() as controller, closing(UrArm(controller.host)) as arm:
        arm.start_move(arm.state().q + FAR, speed=SLOW, acceleration=1.0)
        assert arm.moving()
        controller.inject("link-lost")
        raised(DriverError, r"is lost: .*switched off, or its cable is out", wait_while, arm.moving)
        raised(DriverError, "is lost", arm.state)
        raised(DriverError, "is lost", arm.start_move, FAR, speed=SLOW, acceleration=1.0)
        arm.halt()


def test_a_controller_that_falls_silent_in_a_motion_is_noticed():
    with spawn() as controller, closing(UrArm(controller.host)) as arm:
        arm.start_move(arm.state().q + FAR, speed=SLOW, acceleration=1.0)
        controller.inject("silent")
        raised(DriverError, "has sent nothing for", wait_while, arm.moving)
        arm.halt()


WALKER = f"""
import sys, time
import numpy as np
from visioncal.live.drivers.ur import UrArm
arm = UrArm(sys.argv[1])
arm.start_move(arm.state().q + np.array({FAR.tolist()}), speed={SLOW}, acceleration=1.0)
print("moving", flush=True)
time.sleep(60.0)
"""


def test_the_arm_stops_where_the_computer_that_moves_it_dies(controller):
    walker = subprocess.Popen([sys.executable, "-c", WALKER, controller.host], stdout=-1)
    try:
        assert walker.stdout.readline().strip() == b"moving"
        # It need not ask for anything to be heard: twice as long as the controller waits.
        time.sleep(2.0)
        assert not stands(controller)
    finally:
        walker.kill()
        walker.communicate()
    # The motion would take eight seconds more.
    assert wait_while(lambda: not stands(controller), limit_s=5.0) < 5.0


@pytest.mark.usefixtures("patient")
def test_a_wrong_motion_is_refused_before_it_is_sent(controller):
    with closing(UrArm(controller.host)) as arm:
        with pytest.raises(DriverError, match="must have six joint angles"):
            arm.start_move(np.zeros(7), speed=1.0, acceleration=1.0)
        raised(DriverError, "at 9 rad/s", arm.start_move, np.zeros(6), speed=9.0, acceleration=1.0)
    arm.close()
    raised(DriverError, "was closed", arm.state)

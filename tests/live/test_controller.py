"""The simulated controller: motions, the truth and its process."""

import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from visioncal.core.errors import DriverError
from visioncal.live.simulated.controller import DASHBOARD_PORT, ControllerOptions, Motion, spawn
from visioncal.simulation.arms import forward

OPTIONS = ControllerOptions(seed=3)


@pytest.fixture(scope="module")
def controller():
    with spawn(OPTIONS) as running:
        yield running


@pytest.mark.parametrize("distance", [2.0, 0.05], ids=["trapezoid", "triangle"])
def test_a_motion_keeps_speed_and_acceleration_and_takes_the_shortest_time(distance):
    goal = distance * np.array([0.5, -1.0, 0.0])
    motion = Motion(0.0, np.zeros(3), goal, speed=0.8, acceleration=1.5)
    times = np.linspace(0.0, motion.ends_s, 2001)
    q, dq = (np.array(rows) for rows in zip(*map(motion.at, times), strict=True))
    assert q[0] == pytest.approx(0.0)
    assert q[-1] == pytest.approx(goal)
    # All joints arrive together.
    assert q[:, 0] == pytest.approx(-0.5 * q[:, 1])
    place, speed = -q[:, 1], -dq[:, 1]
    assert speed[0] == speed[-1] == 0.0
    assert speed.max() <= 0.8 + 1e-12
    assert np.abs(np.diff(speed) / np.diff(times)).max() <= 1.5 * (1 + 1e-9)
    # Central differences of a quadratic are exact but at the two kinks: a kink is off by a*dt/4.
    slope = np.gradient(place, times)
    assert np.abs(slope - speed).max() < 1.5 * times[1]
    shortest = distance / 0.8 + 0.8 / 1.5 if distance > 1 else 2 * np.sqrt(distance / 1.5)
    assert motion.ends_s == pytest.approx(shortest)


def test_the_truth_is_the_real_arm_and_stays_known(controller):
    began = time.monotonic()
    before = controller.state([began])
    goal = before.q[0] + 0.05
    ends = controller.guide(goal, speed=1.0, acceleration=4.0)
    time.sleep(max(0.0, ends - time.monotonic()))
    times = np.linspace(began, ends, 50)
    past = controller.state(times.tolist())
    assert past.q[0] == pytest.approx(before.q[0])
    # 1e-5 rad is the joints' repeatability; five sigma.
    assert past.q[-1] == pytest.approx(goal, abs=1e-4)
    # Fixed errors of 0.3 mm and 0.5 mrad a joint move the flange by a millimetre or so.
    shift = past.base_from_flange[:, :3, 3] - forward(OPTIONS.believed_arm, past.q)[:, :3, 3]
    assert 1e-4 < np.linalg.norm(shift, axis=1).max() < 1e-2


def test_a_taken_address_is_told(controller):
    with pytest.raises(DriverError, match="address already in use"):
        spawn(host=controller.host)


def test_a_controller_ends_with_the_process_that_started_it():
    code = (
        "import os\n"
        "from visioncal.live.simulated.controller import spawn\n"
        "running = spawn()\n"
        "print(running.host, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    parent = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False
    )
    host = parent.stdout.strip()
    # It ends within milliseconds; the limit is for a busy computer.
    ends_s = time.monotonic() + 20.0
    while _is_open(host):
        assert time.monotonic() < ends_s
        time.sleep(0.01)


def _is_open(host):
    with socket.socket() as probe:
        return probe.connect_ex((host, DASHBOARD_PORT)) == 0

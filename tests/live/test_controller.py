"""The simulated controller: motions, the script's commands, the truth and its process."""

import subprocess
import sys
import time

import numpy as np
import pytest

from visioncal.core.errors import DriverError
from visioncal.live.simulated.arm import ControllerOptions, Machine, Motion, matrix_of
from visioncal.live.simulated.controller import _is_free, spawn
from visioncal.live.simulated.script import DONE, READY, ControlScript
from visioncal.live.simulated.server import PORTS
from visioncal.simulation.arms import forward

OPTIONS = ControllerOptions(seed=3)


@pytest.fixture(scope="module")
def controller():
    with spawn(OPTIONS) as running:
        yield running


@pytest.mark.parametrize("distance", [2.0, 0.05], ids=["trapezoid", "triangle"])
def test_a_motion_keeps_speed_and_acceleration_and_takes_the_shortest_time(distance):
    goal = distance * np.array([0.5, -1.0, 0.0])
    motion = Motion(np.zeros(3), goal, speed=0.8, acceleration=1.5)
    times = np.linspace(0.0, motion.duration_s, 2001)
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
    assert motion.duration_s == pytest.approx(shortest)


def test_no_way_at_all_is_over_at_once():
    motion = Motion(np.ones(6), np.ones(6))
    assert motion.duration_s == 0.0
    assert motion.at(0.0)[0] == pytest.approx(np.ones(6))


def test_braking_goes_on_from_where_it_began():
    speeds = np.array([0.5, -1.0, 0.0, 0.0, 0.0, 0.0])
    brake = Motion.braking(np.ones(6), speeds, 2.0)
    assert brake.duration_s == pytest.approx(0.5)
    assert brake.at(0.0)[0] == pytest.approx(np.ones(6))
    assert brake.at(0.0)[1] == pytest.approx(speeds)
    q, dq = brake.at(0.5)
    # Half of speed times time.
    assert q[:2] == pytest.approx([1.125, 0.75])
    assert dq == pytest.approx(np.zeros(6))


def test_poses_are_rotation_vectors_in_the_controllers_base():
    machine = Machine(ControllerOptions(), 0.0)
    q, _ = machine.joints(0.0)
    expected = forward(machine.believed, q[None])[0] @ matrix_of(machine.options.tcp)
    assert matrix_of(machine.tool_pose(q)) == pytest.approx(expected, abs=1e-12)


def test_what_was_is_known_for_a_minute():
    machine = Machine(ControllerOptions(), 0.0)
    home, _ = machine.joints(0.0)
    for number in range(200):
        machine.start(Motion(machine.joints(float(number))[0], home + 0.1 * (number % 2)), number)
    assert len(machine._history) == 61
    assert machine.joints(150.5)[0][0] == pytest.approx(home[0] + 0.1, abs=0.1)
    assert machine.joints(150.9)[0] == pytest.approx(home, abs=1e-12)


class Client:
    """What a client does with the registers, tick after tick of a time of its own."""

    def __init__(self):
        self.machine = Machine(ControllerOptions(), 0.0)
        self.script = ControlScript(self.machine)
        self.now_s = 0.0
        self.script.begin(0.0)

    @property
    def registers(self):
        """The script's registers."""
        return self.script.registers

    def tick(self, count=1):
        """Lets ticks pass."""
        for _ in range(count):
            self.now_s += 0.008
            self.script.tick(self.now_s)

    def command(self, number, doubles=(), *, asynchronous=False, most=2000):
        """Gives a command, waits and clears it; tells whether it was done."""
        assert self.registers.int_out[0] == READY
        self.registers.double_in[: len(doubles)] = doubles
        self.registers.int_in[:2] = [number, int(asynchronous)]
        for _ in range(most):
            self.tick()
            if self.registers.int_out[0] == DONE:
                break
        done = self.registers.int_out[0] == DONE
        self.registers.int_in[0] = 0
        self.tick()
        return done


def test_a_controller_that_slept_does_not_call_its_client_silent():
    client = Client()
    client.command(35, [1.0])
    client.now_s += 5.0
    client.tick()
    assert client.machine.program == "playing"


def test_a_safety_stop_ends_the_motion_where_it_is():
    client = Client()
    q, _ = client.machine.joints(0.0)
    client.command(1, [*(q + 1.0), 1.0, 2.0], asynchronous=True)
    client.tick(60)
    client.machine.apply_fault("protective-stop", client.now_s)
    client.tick(60)
    stood, speed = client.machine.joints(client.now_s)
    assert speed == pytest.approx(np.zeros(6))
    assert 0.0 < (stood - q)[0] < 1.0


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


def test_the_channel_of_the_truth_refuses_what_it_does_not_know(controller):
    with pytest.raises(DriverError, match="there is no fault 'earthquake'"):
        controller.inject("earthquake")


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
    assert host
    # It ends within milliseconds; the limit is for a busy computer.
    ends_s = time.monotonic() + 20.0
    while not all(_is_free(host, port) for port in PORTS):
        assert time.monotonic() < ends_s
        time.sleep(0.01)

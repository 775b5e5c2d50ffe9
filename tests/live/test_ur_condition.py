"""What a UR controller tells over plain connections: its condition and its tool; and stalls."""

import socket
import sys
import threading
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from support.refusals import raised

from visioncal.core import extras
from visioncal.core.errors import DriverError
from visioncal.live.drivers.protocols import Stopwatch
from visioncal.live.drivers.ur import UrArm
from visioncal.live.drivers.ur_net import check_states_come, read_condition, read_tool_offset
from visioncal.live.simulated.controller import free_host, spawn
from visioncal.live.simulated.machine import ControllerOptions

OPTIONS = ControllerOptions(seed=3, tcp=(0.01, -0.02, 0.15, 0.1, 0.2, -0.3))


@pytest.fixture(scope="module")
def controller():
    """A controller. Its faults are taken back by each test."""
    with spawn(OPTIONS) as running:
        yield running


def test_a_healthy_controller_passes_every_check(controller):
    condition = read_condition(controller.host)
    condition.check_moves()
    check_states_come(controller.host)
    assert condition.model == "UR10e"
    assert condition.version == (5, 11, 6)
    assert read_tool_offset(controller.host) == [0.01, -0.02, 0.15, 0.1, 0.2, -0.3]


FAULTS = [
    ("protective-stop", "PROTECTIVE_STOP.*Enable Robot"),
    ("emergency-stop", "EMERGENCY_STOP.*pull out the emergency-stop button"),
    ("remote-off", "local control.*Remote Control at the upper right"),
    ("power-off", "mode is POWER_OFF.*circle at the lower left"),
]


@pytest.mark.parametrize(("fault", "message"), FAULTS, ids=[name for name, _ in FAULTS])
def test_the_state_that_keeps_an_arm_from_moving_is_named_with_the_button_to_press(
    controller, fault, message
):
    controller.inject(fault)
    try:
        raised(DriverError, message, read_condition(controller.host).check_moves)
    finally:
        controller.inject("none")
    read_condition(controller.host).check_moves()


@pytest.mark.slow
def test_a_frozen_controller_is_reported_as_silent(controller):
    controller.inject("silent")
    try:
        raised(DriverError, "does not answer: timed out", read_condition, controller.host)
        raised(DriverError, "sends no states", check_states_come, controller.host)
    finally:
        controller.inject("none")


@contextmanager
def listening(host, port, greeting):
    """Something else that listens at a port of a controller."""
    with socket.create_server((host, port)) as server:

        def greet():
            try:
                link, _ = server.accept()
            except OSError:
                return
            with link:
                link.sendall(greeting)
                # Until the client goes.
                link.recv(1000)

        thread = threading.Thread(target=greet)
        thread.start()
        yield
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


@pytest.mark.parametrize(
    ("version", "message"),
    [
        ("URSoftware 1.8.16941", "answers 'URSoftware 1.8.16941'.*four numbers"),
        ("URSoftware 3.2.0.1000", "has PolyScope 3.2.0; ur-rtde needs 3.4"),
        ("URSoftware 10.7.0.1000", "has PolyScope 10.7.0"),
    ],
)
def test_an_unfit_version_is_reported(version, message):
    host, banner = free_host(), "Connected: Universal Robots Dashboard Server"
    with (
        listening(host, 29999, f"{banner}\n{version}\n".encode()),
        pytest.raises(DriverError, match=message) as refusal,
    ):
        read_condition(host)
    assert refusal.value.next_step


def test_closed_ports_and_unknown_names_are_distinguished():
    raised(DriverError, r"port 29999 \(the dashboard\) is closed", read_condition, free_host())
    with pytest.raises(DriverError, match=r"no-such-robot\.invalid cannot be reached"):
        read_condition("no-such-robot.invalid")


def test_polyscope_x_is_watched_without_a_dashboard_and_not_driven():
    pytest.importorskip("rtde_control", reason="ur-rtde is not installed (the extra `ur`)")
    with spawn(replace(OPTIONS, polyscope=(10, 7, 0, 1000))) as running:
        raised(DriverError, "PolyScope X 10.7.0.*not driven.*--arm socket", UrArm, running.host)
        with closing(UrArm(running.host, watch_only=True)) as arm:
            state = arm.state()
            assert "PolyScope X 10.7.0" in arm.name
        truth = running.state([state.stamp_s])
        # The controller's model of the arm is off by what its errors are, about a millimetre.
        assert np.abs(state.q - truth.q[0]).max() < 5e-3
        assert state.flange_from_tool[2, 3] == pytest.approx(OPTIONS.tcp[2])
        assert state.payload_kg is not None
        running.inject("power-off")
        with pytest.raises(DriverError, match="does not know where its joints are"):
            UrArm(running.host, watch_only=True)


def test_a_missing_client_library_is_reported_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    monkeypatch.setitem(extras._NEWEST_PYTHON, "ur", sys.version_info[:2])
    with pytest.raises(DriverError, match=r"rtde_receive cannot be imported.*pip install 'ur-rtde"):
        UrArm("127.0.0.1")
    monkeypatch.setitem(extras._NEWEST_PYTHON, "ur", (3, 10))
    with pytest.raises(DriverError, match=r"no release for this Python, 3\.\d+: .*Python 3\.10"):
        UrArm("127.0.0.1")


def test_the_time_of_a_stall_is_left_out():
    times = iter([100.0, 100.05, 100.1, 107.0, 107.05, 200.0, 200.1])
    watch = Stopwatch(lambda: next(times))
    # Two steps as they are, the stall as 0.2 s.
    assert [round(watch.read(), 6) for _ in range(4)] == [0.05, 0.1, 0.3, 0.35]
    watch.restart()
    assert round(watch.read(), 6) == 0.1


def test_another_service_at_the_port_is_no_controller():
    host = free_host()
    with (
        listening(host, 29999, b"SSH-2.0-OpenSSH_9.2\r\n"),
        pytest.raises(DriverError, match="greets with 'SSH-"),
    ):
        read_condition(host)
    with (
        listening(host, 30004, b"HTTP/1.1 400 Bad Request\r\n\r\n" + b" " * 0x4854),
        pytest.raises(DriverError, match="does not speak version 2 of RTDE"),
    ):
        check_states_come(host)

"""What a UR controller tells over plain connections: condition, tool, maker's calibration."""

import socket
import sys
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from visioncal.core.errors import DataError, DriverError
from visioncal.live.drivers.ur import UrArm
from visioncal.live.drivers.ur_factory import factory_document, read_factory_dh, read_factory_file
from visioncal.live.drivers.ur_net import check_states_come, connect, resolve
from visioncal.live.drivers.ur_primary import read_tool_offset
from visioncal.live.drivers.ur_status import read_condition
from visioncal.live.rehearsal.controller import free_host, spawn
from visioncal.live.rehearsal.options import ControllerOptions, believed_arm
from visioncal.robot import Robot, load_robot
from visioncal.simulation.arms import ArmErrors, forward

MEASURED = ArmErrors(length_m=1e-3, angle_rad=1e-3, offset_rad=1e-3)
OPTIONS = ControllerOptions(seed=3, factory=MEASURED, tcp=(0.01, -0.02, 0.15, 0.1, 0.2, -0.3))


@pytest.fixture(scope="module")
def controller():
    """A controller that knows its maker's calibration. Its faults are taken back by each test."""
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
    ("local-control", "local control.*Remote Control at the upper right"),
    ("power-off", "mode is POWER_OFF.*circle at the lower left"),
]


@pytest.mark.parametrize(("fault", "message"), FAULTS, ids=[it for it, _ in FAULTS])
def test_what_keeps_an_arm_from_moving_is_said_with_what_to_press(controller, fault, message):
    controller.truth.inject(fault)
    try:
        with pytest.raises(DriverError, match=message):
            read_condition(controller.host).check_moves()
    finally:
        controller.truth.inject("release")
        controller.truth.inject("remote-control")
    read_condition(controller.host).check_moves()


def test_a_frozen_controller_is_said_to_be_silent(controller):
    controller.truth.inject("freeze")
    try:
        with pytest.raises(DriverError, match="does not answer: timed out"):
            read_condition(controller.host)
        with pytest.raises(DriverError, match="sends no states"):
            check_states_come(controller.host)
    finally:
        controller.truth.inject("thaw")


@pytest.mark.parametrize(
    ("banner", "message"),
    [
        ("URSoftware 1.8.16941", "answers 'URSoftware 1.8.16941'.*four numbers"),
        ("URSoftware 3.2.0.1000", "has PolyScope 3.2.0; ur-rtde needs 3.4"),
        ("URSoftware 10.7.0.1000", "has PolyScope 10.7.0"),
    ],
)
def test_an_unfit_version_is_told(banner, message):
    with spawn(ControllerOptions(polyscope=banner)) as old:
        with pytest.raises(DriverError, match=message) as refusal:
            read_condition(old.host)
        assert refusal.value.next_step


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


def test_closed_ports_and_unknown_names_are_told_apart():
    with pytest.raises(DriverError, match=r"port 29999 \(the dashboard\) is closed"):
        read_condition(free_host())
    with pytest.raises(DriverError, match=r"'no-such-robot.invalid' is not known"):
        resolve("no-such-robot.invalid")


def test_an_address_that_nobody_has_is_unreachable(monkeypatch):
    def no_route(*_, **__):
        raise OSError(113, "No route to host")

    monkeypatch.setattr(socket, "create_connection", no_route)
    with pytest.raises(DriverError, match=r"cannot be reached .* No route to host.*cable"):
        connect("192.0.2.1", 29999, "the dashboard")


def test_a_missing_client_library_is_told_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    with pytest.raises(DriverError, match=r"rtde_receive cannot be imported.*pip install 'ur-rtde"):
        UrArm("127.0.0.1")


def test_the_makers_calibration_gives_the_controllers_own_kinematics(controller):
    table = read_factory_dh(controller.host)
    robot = Robot.from_document(factory_document(table, "ur10e"))
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 6))
    believed = believed_arm(OPTIONS)
    assert robot.base_from_flange(q) == pytest.approx(forward(believed, q), abs=1e-9)
    assert np.abs(robot.base_from_flange(q) - load_robot("ur10e").base_from_flange(q)).max() > 1e-3


def test_the_controllers_file_tells_the_same_calibration(tmp_path):
    path = tmp_path / "calibration.conf"
    path.write_text(
        "[mounting]\n"
        "delta_theta = [ 1e-4, -0.27, 0.0, 0.0, 0.0, 0.0 ]\n"
        "delta_a = [ 0.0, 2e-4, 0.0, 0.0, 0.0, 0.0 ]\n"
        "delta_d = [ 1e-5, 12.5, -12.5, 0.0, 0.0, 0.0 ]\n"
        "delta_alpha = [ 0.0, 3e-4, 0.0, 0.0, 0.0, 0.0 ]\n"
        "# 0 == notInitialized, 1 == Linearised\n"
        "calibration_status = 1  # Linearised\n"
        "joint_checksum = [ 0xa1, 0xb2, 0xc3, 0xd4, 0xe5, 0xf6 ]\n",
        encoding="utf-8",
    )
    table = read_factory_file(path, "ur10e")
    assert table.theta_rad[:2] == pytest.approx([1e-4, -0.27])
    assert table.a_m[1] == pytest.approx(-0.6127 + 2e-4)
    assert table.d_m[:3] == pytest.approx([0.1807 + 1e-5, 12.5, -12.5])
    assert table.alpha_rad[:2] == pytest.approx([np.pi / 2, 3e-4])
    assert table.checksum == (0xA1, 0xB2, 0xC3, 0xD4, 0xE5, 0xF6)
    Robot.from_document(factory_document(table, "ur10e"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[other]\n", "is no calibration of a UR: 'mounting'"),
        ("[mounting]\ndelta_theta = [ a ]\n", "could not convert"),
    ],
)
def test_another_file_is_no_calibration(tmp_path, text, message):
    path = tmp_path / "calibration.conf"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=message):
        read_factory_file(path, "ur10e")

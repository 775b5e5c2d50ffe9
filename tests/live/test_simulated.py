"""The simulated cell that `demo --live` drives: its controller, its camera, and the whole chain."""

import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from support.commands import visioncal
from support.live_cell import FakeClock

from visioncal.cli import demo
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.live.drivers.protocols import CameraDevice
from visioncal.live.drivers.ur_net import DASHBOARD_PORT
from visioncal.live.simulated.cell import GUESS_M, GUESS_RAD, Bench, SimulatedCamera
from visioncal.live.simulated.controller import spawn
from visioncal.live.simulated.machine import ControllerOptions, Motion
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import CellOptions, prepare_scene, read_truth, render, simulate
from visioncal.simulation.arms import forward
from visioncal.simulation.render import LiveView
from visioncal.vision.boards import KINDS
from visioncal.vision.boards.kind import DetectedCorners

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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_controller_ends_with_the_process_that_started_it():
    code = "import os; from visioncal.live.simulated.controller import spawn; running = spawn()\n"
    code += "print(running.host, flush=True); os.kill(os.getpid(), 9)"
    words = [sys.executable, "-c", code]
    host = subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()
    assert host
    # It ends within milliseconds; the limit is for a busy computer.
    ends_s = time.monotonic() + 20.0
    while True:
        with socket.socket() as probe:
            if probe.connect_ex((host, DASHBOARD_PORT)) != 0:
                break
        assert time.monotonic() < ends_s
        time.sleep(0.01)


TARGET = CellOptions().target


def a_cell(**options):
    # No repeatability: the cell's own pictures are of the true arm at the reported joints.
    still = {"robot_sigma_m": 0.0, "robot_sigma_rad": 0.0}
    bent = {"dh_sigma_m": 3e-4, "dh_sigma_rad": 3e-4}
    return simulate(CellOptions(views=3, seed=3, **{**still, **bent, **options}))


def errors_px(image, exact):
    found = KINDS["charuco"].search(image, TARGET)
    assert isinstance(found, DetectedCorners)
    ids, rows, exact_rows = np.intersect1d(found.ids, exact.ids, return_indices=True)
    assert len(ids) > 0.8 * len(exact.ids)
    return found.px[rows] - exact.px[exact_rows]


def test_at_rest_corners_are_as_good_as_in_a_written_session():
    cell = a_cell(mount="eye-to-hand")
    scene, live = prepare_scene(cell), LiveView(cell)
    written = [errors_px(render(scene, index), cell.exact_corners[index]) for index in range(3)]
    taken = [
        errors_px(live.picture(cell.robot.joints[name, None]), cell.exact_corners[name])
        for name in (0, 1, 2)
    ]
    # Both are the detector's noise on other grain: over 100 corners their rms differ by some 15 %.
    assert np.std(np.vstack(taken)) < 1.3 * np.std(np.vstack(written))


def a_camera(true_joints=None, **options):
    """A camera, with a clock that passes only where somebody waits."""
    cell, time = a_cell(**options), FakeClock(100.003)
    joints_of = true_joints or (lambda moments: np.tile(cell.robot.joints[0], (len(moments), 1)))
    camera = SimulatedCamera(cell, joints_of, rate_hz=10.0, exposure_s=0.02, clock=time)
    return cell, time, camera


def test_pictures_come_at_even_times_and_begin_after_the_call():
    _, time, camera = a_camera()
    assert isinstance(camera, CameraDevice)
    stamps = []
    for _ in range(3):
        request_s = time.seconds
        frame = camera.frame()
        assert frame.stamp_s - 0.5 * frame.exposure_s >= request_s - 1e-9
        stamps.append(frame.stamp_s)
    assert np.diff(stamps) == pytest.approx([0.1, 0.1])


def test_the_arm_is_asked_for_the_time_of_exposure():
    moments_s = []

    def joints_of(moments):
        moments_s.extend(moments)
        return np.tile(cell.robot.joints[0], (len(moments), 1))

    cell, _, camera = a_camera(joints_of)
    frame = camera.frame()
    assert min(moments_s) == pytest.approx(frame.stamp_s - 0.01)
    assert max(moments_s) == pytest.approx(frame.stamp_s + 0.01)


@pytest.mark.slow
@pytest.mark.usefixtures("patient")
def test_a_recording_is_as_near_to_the_truth_as_stated(tmp_path):
    pytest.importorskip("rtde_control", reason="ur-rtde is not installed (the extra `ur`)")
    visioncal("demo", "--live", "-o", tmp_path, "--views", 6).good()
    views = Session.load(tmp_path / "session").views
    assert [view.number for view in views] == [1, 2, 3, 4, 5, 6]
    # The truth of each view is what its camera saw: at the true board, by the true camera.
    truth = read_truth(tmp_path / "session")
    seen = (
        invert(truth.base_from_flange @ truth.transforms["flange_from_cam"])
        @ (truth.transforms["base_from_target"])
    )
    np.testing.assert_allclose(seen, truth.cam_from_target, atol=1e-12)
    # The arm is off by its joint offsets alone, of 0.3 mrad at up to a metre each.
    off = [
        np.linalg.norm(flange[:3, 3] - [view.numbers[name] for name in ("x_m", "y_m", "z_m")])
        for flange, view in zip(truth.base_from_flange, views, strict=True)
    ]
    assert 1e-5 < max(off) < 3e-3
    for name in ("plan/plan.json", "result/calibration.json", "result/recording.rrd"):
        assert (tmp_path / name).stat().st_size > 0
    found = Calibration.load(tmp_path / "result")
    assert found.arm is not None
    # An error of 2 mm is more than the sigmas explain.
    true_x = truth.transforms["flange_from_cam"]
    aside = exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2e-3]))
    truth.transforms["flange_from_cam"] = true_x @ aside
    squared, limit = demo.chi_square(found, truth)
    assert squared > limit


@pytest.mark.slow
@pytest.mark.usefixtures("patient")
def test_a_slip_of_an_encoder_is_recovered_in_a_rehearsal(tmp_path):
    pytest.importorskip("rtde_control", reason="ur-rtde is not installed (the extra `ur`)")
    done = visioncal("demo", "--live", "--fault", "encoder-slip", "-o", tmp_path).good()
    assert "joint 3 (elbow_joint) off by +0.4 deg" in done.out
    assert len(Session.load(tmp_path / "recovery/stops").views) == 15


def test_the_cell_is_guessed_as_roughly_as_stated():
    cell, again = Bench(5), Bench(5)
    for guess, true, same in zip(
        (cell.known.x, cell.known.z),
        cell.truth.transforms.values(),
        (again.known.x, again.known.z),
        strict=True,
    ):
        mm, deg = pose_difference(true, guess)
        # A screw of a few degrees is longer than its chord by a thousandth.
        assert mm == pytest.approx(1e3 * GUESS_M, rel=2e-3)
        assert deg == pytest.approx(np.rad2deg(GUESS_RAD), rel=1e-9)
        np.testing.assert_array_equal(guess, same)
    assert np.abs(cell.truth.robot.true_arm.offset).min() > 0.0

"""Recording a live cell, driven or guided, by calls and as a user runs it."""

import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.live_cell import FakeArm, fake_devices, fake_plan
from support.mjpeg import NetworkCamera, number_of, served
from support.recorded import QUICK, REPEATABILITY_M, facts_of, recorded
from support.refusals import raised

from visioncal.calibration.run import run
from visioncal.cli import live_cell
from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import compose
from visioncal.live.capture import devices
from visioncal.live.capture import journal as journal_module
from visioncal.live.capture.assessment import JointPoseCheck
from visioncal.live.capture.cell import HostClock, LiveCell
from visioncal.live.capture.journal import Journal
from visioncal.live.capture.options import CaptureOptions, Stillness
from visioncal.live.capture.recording import (
    Capture,
    checked_path,
    follow,
    missed_stops,
    motion_summary,
)
from visioncal.live.capture.take import image_motion_px
from visioncal.planning.cell import Box
from visioncal.planning.plan import PlanRequest, make_plan
from visioncal.planning.plan_file import plan_document, read_plan
from visioncal.planning.purposes import purpose_of
from visioncal.session import Session


@pytest.fixture(scope="module")
def plan():
    return fake_plan(5)


@pytest.mark.slow
def test_a_recording_is_a_session_that_calibrates(tmp_path):
    plan = fake_plan(12)
    arm, camera = fake_devices(plan)
    camera.factory = camera.lens
    steps = recorded(tmp_path / "live", plan, arm, camera, CaptureOptions(frames=2))
    session = Session.load(tmp_path / "live")
    assert session.warnings == ()
    assert [view.number for view in session.views] == [stop.view for stop in plan.stops]
    assert session.document["robot"]["model"] == "robot.toml"
    assert session.document["target"] == "charuco_9x6_30mm"
    row = session.views[0]
    assert {"current6_a", "temp6_c", "payload_z_m", "stamp_s", "q6_rad"} <= row.numbers.keys()
    assert row.text["safety"] == "normal"
    assert row.text["tcp"] == "0 0 0 0 0 0 1"
    assert row.text["device_exposure_us"] == "10000.0"
    # What was predicted becomes less with every view once something is determined.
    known = [step.accuracy.mm for step in steps if step.accuracy and not step.accuracy.is_open]
    assert len(known) > 5
    assert known == sorted(known, reverse=True)
    result = run(session).calibration
    truth = plan.cell.x
    off = result.transforms["flange_from_cam"].translation - truth[:3, 3]
    # Twelve small images with a tenth of a pixel of noise place the camera to well under 1 mm.
    assert np.linalg.norm(off) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [False, True], ids=["told by the arm", "seen in the image"])
def test_a_moving_arm_gives_no_view(plan, tmp_path, hidden):
    arm, camera = fake_devices(plan, trembling_s=0.8, tremble_rad=4e-3, hidden=hidden)
    recorded(tmp_path / "live", plan, arm, camera, CaptureOptions())
    session = Session.load(tmp_path / "live")
    assert len(session.views) == len(plan.stops)
    for view in session.views:
        stamp = view.stamp_s - camera.arm.clock.unix_offset_s()
        at = min(camera.exposures, key=lambda exposure: abs(exposure - stamp))
        # Stamps are written to the microsecond.
        assert abs(at - stamp) < 2e-6
        away = camera.exposures[at][:3, 3] - view.base_from_flange().as_matrix()[:3, 3]
        # It trembles by a millimetre and more at first, and the views waited for its end.
        assert np.linalg.norm(away) < REPEATABILITY_M


def test_an_arm_that_never_rests_gives_no_view(plan, tmp_path):
    arm, camera = fake_devices(plan, trembling_s=1e6, tremble_rad=1e-3)
    with pytest.raises(DataError, match=r"3 stops in a row.*nothing came to rest in 1 s"):
        recorded(
            tmp_path / "live", plan, arm, camera, replace(QUICK, still=Stillness(patience_s=1.0))
        )
    assert not (tmp_path / "live" / "session.toml").exists()


@pytest.mark.parametrize(
    ("failure", "words"), [("gone", "link is lost"), ("emergency-stop", "emergency stop: .*")]
)
def test_a_failure_on_the_way_halts_and_leaves_a_session(plan, tmp_path, failure, words):
    arm, camera = fake_devices(plan)
    start, moves = arm.start_move, []

    def failing(q, **pace):
        start(q, **pace)
        moves.append(arm.clock.now())
        if len(moves) == 4:
            arm.failure, arm.fails_at = failure, 0.5

    arm.start_move = failing
    caught = raised(DriverError, words, recorded, tmp_path / "live", plan, arm, camera)
    assert arm.halted == 1
    # The watchdog looks every 20 ms, the failure came half a second after the start.
    assert arm.clock.now() - moves[-1] < 0.6
    assert "3 views are safe in" in caught.message
    assert "--resume" in caught.next_step or "cable" in caught.next_step
    assert len(Session.load(tmp_path / "live").views) == 3


@pytest.mark.slow
def test_a_board_that_is_lost_once_is_reported_and_three_times_ends(plan, tmp_path):
    arm, camera = fake_devices(plan)
    # The first move goes to the first stop.
    camera.hidden_at = (2,)
    steps = recorded(tmp_path / "once", plan, arm, camera)
    lost = missed_stops(steps)
    assert list(lost) == [2]
    assert "uniform" in lost[2]
    assert len(Session.load(tmp_path / "once").views) == len(plan.stops) - 1
    arm, camera = fake_devices(plan)
    camera.hidden_at = (2, 3, 4)
    with pytest.raises(DataError, match="no view at 3 stops in a row") as caught:
        recorded(tmp_path / "often", plan, arm, camera)
    assert "Look at the board" in caught.value.next_step
    assert "1 view is safe" in caught.value.message


def test_stale_joint_angles_are_no_view(plan, tmp_path):
    arm, camera = fake_devices(plan)
    start = arm.start_move

    def until_stale(q, **pace):
        start(q, **pace)
        # The watchdog would notice joints that do not arrive; here only a view reads them stale.
        arm.stale = ""

    arm.start_move = until_stale
    frame = camera.frame

    def stale_views(**words):
        if arm.moves == 3 and not arm.moving():
            arm.stale = "joints"
        return frame(**words)

    camera.frame = stale_views
    steps = recorded(tmp_path / "live", plan, arm, camera)
    lost = missed_stops(steps)
    assert list(lost) == [3]
    assert "joint" in lost[3]


def test_joints_and_poses_of_other_moments_disagree(plan):
    arm, _ = fake_devices(plan)
    check, states = JointPoseCheck(plan.cell.robot), []
    # Another base than the model's, and a tool on its flange, are no disagreement.
    offset = compose(np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.2]))
    for stop in plan.stops[:3]:
        arm.q0 = stop.q
        state = arm.state()
        states.append(replace(state, base_from_flange=offset @ state.base_from_flange))
    first, second, third = states
    assert check.why_not(first) == check.why_not(second) == ""
    for stale in ({"q": second.q}, {"base_from_flange": second.base_from_flange}):
        assert "one of them is stale" in check.why_not(replace(third, **stale))
    assert check.why_not(third) == ""
    assert "4 joints, and ur5e has 6" in check.why_not(replace(first, q=np.zeros(4)))


def test_an_arm_that_hangs_or_ends_elsewhere_is_reported(plan, tmp_path):
    arm, camera = fake_devices(plan)
    arm.moving = lambda: arm.clock.sleep(0.01) or True
    with pytest.raises(DriverError, match=r"still moving after .* s, where .* s were expected"):
        recorded(tmp_path / "hangs", plan, arm, camera)
    assert arm.halted == 1
    arm, camera = fake_devices(plan)
    arm.start_move = lambda *_, **__: None
    with pytest.raises(DriverError, match=r"the motion ended .* deg before its goal in joint"):
        recorded(tmp_path / "elsewhere", plan, arm, camera)


def test_ways_from_elsewhere_are_checked(plan):
    first, second = plan.stops[:2]
    assert len(checked_path(plan, first, first.q)) == 1
    assert np.array_equal(checked_path(plan, second, first.q)[-1], second.q)
    # A box where the goal's flange is lets no way lead there.
    far = next(stop for stop in plan.stops if np.abs(stop.q - first.q).max() > 0.5)
    flange = plan.cell.robot.base_from_flange(far.q[None])[0]
    box = Box("post", compose(np.eye(3), flange[:3, 3]), np.full(3, 0.02))
    walled = replace(plan, cell=replace(plan.cell, boxes=(box,)))
    raised(DataError, r"no clear way leads there .*post", checked_path, walled, far, first.q + 0.1)


def test_a_plan_for_another_arm_is_not_driven(plan):
    arm, camera = fake_devices(plan)
    other = fake_plan(3)
    moved = FakeArm(other.cell, arm.clock, plan.stops[0].q)
    state, offset = moved.state, compose(np.eye(3), np.array([0.3, 0.0, 0.0]))
    moved.state = lambda: replace(said := state(), base_from_flange=offset @ said.base_from_flange)
    with pytest.raises(DataError, match=r"its flange is 300 mm and 0 deg from where the model"):
        motion_summary(LiveCell(moved, camera, arm.clock), plan, (), QUICK)


def test_images_that_move_are_measured_to_a_hundredth_of_a_pixel():
    _, camera = fake_devices(fake_plan(1))
    camera.noise = 0.0
    still = camera.frame().image
    assert image_motion_px(still, still) == 0.0
    moved = np.roll(still, 3, axis=1)
    # Points at the rim leave the image; the others say three pixels.
    assert image_motion_px(still, moved) == pytest.approx(3.0, abs=0.05)
    assert image_motion_px(still, np.full_like(still, 90)) == float("inf")
    assert image_motion_px(np.full_like(still, 90), still) == 0.0
    camera.noise = 2.0
    # Fresh noise of two levels moves the median point by far less than what is taken for still.
    assert image_motion_px(camera.frame().image, camera.frame().image) < 0.05


def test_a_disk_without_room_is_reported_before_on_the_way_and_while_it_is_written(
    plan, tmp_path, monkeypatch
):
    usage, write, written = shutil.disk_usage(tmp_path), journal_module.write_atomically, []
    free = {"free": 1_000_000}
    monkeypatch.setattr(journal_module.shutil, "disk_usage", lambda _: usage._replace(**free))
    arm, camera = fake_devices(plan)
    words = r"1\.5 MB must be free for 5 views"
    raised(DataError, words, recorded, tmp_path / "before", plan, arm, camera)
    assert arm.moves == 0

    def counted(path, data):
        written.append(path)
        free["free"] = 1000 if len(written) > 8 else usage.free
        write(path, data)

    def full(path, data):
        if path.name == "003.png":
            error = DataError("cannot be written")
            raise error from OSError(errno.ENOSPC, "No space left on device")
        write(path, data)

    for name, writes, words, views in (
        ("way", counted, r"live: too little room: 0\.0 MB are free.* for the next view", 3),
        ("written", full, r"too little room.* for 003\.png", 2),
    ):
        free["free"] = usage.free
        monkeypatch.setattr(journal_module, "write_atomically", writes)
        folder, (arm, camera) = tmp_path / name / "live", fake_devices(plan)
        folder.parent.mkdir()
        raised(DataError, words, recorded, folder, plan, arm, camera)
        assert arm.halted == 1
        assert len(Session.load(folder).views) >= views


@pytest.mark.slow
def test_a_killed_recording_loses_nothing(tmp_path):
    folder, acknowledged = tmp_path / "live", set()
    program = Path(__file__).parents[1] / "support" / "recorded.py"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, str(program), str(folder), "6"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        for line in process.stdout:
            if line.strip().isdigit():
                acknowledged.add(int(line))
                if len(acknowledged) == 3:
                    process.kill()
    session = Session.load(folder)
    assert acknowledged <= {view.number for view in session.views}
    # One may be on the disk whose acknowledgement was cut off.
    assert len(session.views) <= 4
    assert all(
        session.images.read(view.image).endswith(b"IEND\xaeB`\x82") for view in session.views
    )
    plan = fake_plan(6)
    recorded(folder, plan, *fake_devices(plan), resume=True)
    assert [view.number for view in Session.load(folder).views] == [1, 2, 3, 4, 5, 6]


@pytest.mark.slow
def test_remains_of_a_killed_process_are_removed(plan, tmp_path):
    arm, camera = fake_devices(plan)
    camera.hidden_at = (5,)
    folder = tmp_path / "live"
    recorded(folder, plan, arm, camera)
    leftovers = [folder / f".{32 * '1'}.tmp", folder / "images" / f".{32 * '2'}.tmp"]
    for file in leftovers:
        file.write_bytes(b"half")
    # An image whose row did not come is written again.
    (folder / "images" / "005.png").write_bytes(b"half")
    recorded(folder, plan, *fake_devices(plan), resume=True)
    assert not any(leftover.exists() for leftover in leftovers)
    assert len(Session.load(folder).views) == len(plan.stops)


def test_folders_of_something_else_are_left_alone(plan, tmp_path):
    arm, camera = fake_devices(plan)
    folder = tmp_path / "live"
    recorded(folder, plan, arm, camera)
    caught = raised(DataError, "exists and is not empty", recorded, folder, plan, arm, camera)
    assert "--resume" in caught.next_step
    camera.name, arm.name = "another camera", "fake ur10e"
    with pytest.raises(DataError, match='arm was "fake ur5e" and is "fake ur10e"; camera was'):
        recorded(folder, plan, arm, camera, resume=True)
    arm, camera = fake_devices(plan)
    with pytest.raises(DataError, match=r"plan was 00000000\.\.\. and is 11111111\.\.\."):
        recorded(folder, replace(plan, digest="1" * 64), arm, camera, resume=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="exists and is not empty"):
        recorded(tmp_path / "mine", plan, arm, camera, resume=True)


class Hand:
    """Leads an arm to the next place as soon as a view is there; in the end it presses Ctrl-C."""

    def __init__(self, arm, places):
        self.arm, self.places = arm, iter(places)

    def __call__(self, _):
        """Leads it on."""
        place = next(self.places, None)
        if place is None:
            raise KeyboardInterrupt
        self.arm.start_move(place, speed=2.0, acceleration=4.0)


def test_an_arm_that_is_led_on_before_it_settles_gives_no_view_twice(plan, tmp_path):
    arm, camera = fake_devices(plan)
    capture = _capture(tmp_path / "live", plan, arm, camera)
    frame = camera.frame

    def led(**words):
        # The first frame of all: the hand goes on to another place, and from there to a third.
        if camera.frames == 0:
            arm.start_move(plan.stops[1].q, speed=2.0, acceleration=4.0)
        return frame(**words)

    camera.frame = led
    capture.watch = Hand(arm, [plan.stops[1].q + 0.001, plan.stops[2].q])
    state, last = arm.state, plan.stops[2].q

    def led_on():
        # After some seconds at the place that has its view it goes to a third.
        if arm.moves == 2 and arm.clock.now() - arm.begun > 5.0:
            arm.start_move(last, speed=2.0, acceleration=4.0)
        return state()

    arm.state = led_on
    follow(capture, 2)
    poses = [view.base_from_flange().translation for view in Session.load(tmp_path / "live").views]
    assert np.linalg.norm(poses[1] - poses[0]) > 0.02


def test_ctrl_c_ends_a_guided_recording(plan, tmp_path):
    arm, camera = fake_devices(plan)
    capture = _capture(tmp_path / "live", plan, arm, camera)
    capture.watch = Hand(arm, [plan.stops[1].q])
    assert len(follow(capture, 0)) == 2
    assert len(Session.load(tmp_path / "live").views) == 2


def _capture(folder, plan, arm, camera):
    journal = Journal.begin(folder, facts_of(plan, arm, camera), arm.clock.unix_offset_s(), 0)
    cell = LiveCell(arm, camera, arm.clock)
    planned = plan.cell
    return Capture(cell, planned.target, planned.robot, camera.lens, journal, QUICK, None)


ARM, CAMERA = ("--arm", "fake:here"), ("--camera", "fake")
FAST = ("--frames", 1, "--settle-s", 0.03)


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A plan's file, and what is read back of it."""
    found = fake_plan(3)
    request = PlanRequest(purpose_of("hand-eye"), 4, candidates=30, start_q=found.start_q)
    plan = make_plan(found.cell, request)
    folder = tmp_path_factory.mktemp("plans") / "plan"
    folder.mkdir()
    document = plan_document(plan, {"kind": "robot ur5e"})
    (folder / "plan.json").write_text(json.dumps(document), encoding="utf-8")
    return folder, plan


@pytest.fixture
def cell(planned, monkeypatch):
    """Devices in the place of real ones, with their own clock."""
    plan = read_plan(planned[0])
    arm, camera = fake_devices(plan)
    _use(monkeypatch, arm, camera)
    return arm, camera


def _use(monkeypatch, arm, camera):
    monkeypatch.setattr(
        devices, "ARMS", {"fake": lambda *_, **__: arm, "manual": lambda *_, **__: arm}
    )
    monkeypatch.setattr(devices, "CAMERAS", {"fake": lambda *_: camera})
    monkeypatch.setattr(live_cell, "HostClock", lambda: arm.clock)


def record(out, *more):
    return visioncal("record", "-o", out, *ARM, *CAMERA, *FAST, *more)


def test_a_plan_is_read_back_as_it_was_made(planned):
    folder, plan = planned
    for path in (folder, folder / "plan.json"):
        read = read_plan(path)
        for stop, its in zip(read.stops, plan.stops, strict=True):
            assert (stop.view, stop.words) == (its.view, its.words)
            assert np.array_equal(stop.q, its.q)
            assert np.array_equal(stop.via, its.via)
        assert np.array_equal(read.start_q, plan.request.start_q)
        assert (read.cell.limits, read.cell.target) == (plan.cell.limits, plan.cell.target)
        assert read.cell.robot.name == "ur5e"
        assert np.array_equal(read.cell.noise.robots, plan.cell.noise.robots)
        assert np.array_equal([read.cell.x, read.cell.z], [plan.cell.x, plan.cell.z])
    document = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    assert read.digest == document["inputs_sha256"]


def test_a_plan_is_driven_and_reported_line_by_line(planned, cell, tmp_path):
    done = record(tmp_path / "live", "--plan", planned[0], "--yes").good()
    assert "4 stops to drive at 0.4 rad/s, about" in done.err
    assert "the way is clear of all that was declared" in done.err
    lines = [line for line in done.err.splitlines() if line.startswith("[")]
    assert [line[:5] for line in lines] == ["[1/4]", "[2/4]", "[3/4]", "[4/4]"]
    assert "predicted sigma" in lines[-1]
    assert re.search(r"-> next: view \d, for [0-9.]+ mm$", lines[-2])
    assert "visioncal calibrate" in done.err
    assert len(Session.load(tmp_path / "live").views) == 4
    assert cell[0].halted == 0


def test_nothing_moves_without_a_word(planned, cell, tmp_path):
    arm = cell[0]
    with patch.object(sys, "stdin", io.StringIO("y\n")):
        done = record(tmp_path / "live", "--plan", planned[0])
    assert done.status == 2
    assert "stdin is not a terminal" in done.err
    assert "--yes" in done.err
    assert arm.moves == 0
    # Refused, and at the input's end.
    for place, typed in (("other", "n\n"), ("third", "")):
        _at_terminal(typed, tmp_path / place, "--plan", planned[0]).refused("without consent")
        assert arm.moves == 0


def _at_terminal(typed, out, *more):
    terminal = io.StringIO(typed)
    terminal.isatty = lambda: True
    with patch.object(sys, "stdin", terminal):
        return record(out, *more)


@pytest.mark.usefixtures("cell")
def test_each_motion_has_its_consent(planned, tmp_path, monkeypatch):
    # Two motions were allowed, and then nobody answered.
    done = _at_terminal("y\nwhat\ny\n", tmp_path / "live", "--plan", planned[0]).refused()
    assert done.err.count("[y]es, [a]ll that follow, [n]o") == 4
    assert "2 views are safe" in done.err
    plan = read_plan(planned[0])
    arm, camera = fake_devices(plan)
    arm.q0 = plan.stops[2].q
    _use(monkeypatch, arm, camera)
    done = _at_terminal("a\n", tmp_path / "live", "--plan", planned[0], "--resume").good()
    assert done.err.count("[y]es, [a]ll that follow, [n]o") == 1


def test_a_dry_run_moves_nothing_and_writes_nothing(planned, cell, tmp_path):
    done = record(tmp_path / "live", "--plan", planned[0], "--dry-run").good()
    assert "4 stops to drive" in done.err
    assert "Nothing was moved" in done.err
    assert cell[0].moves == 0
    assert not (tmp_path / "live").exists()


def test_a_signal_ends_it_like_ctrl_c(planned, cell, tmp_path):
    arm, camera = cell
    frame = camera.frame

    def signalled(**words):
        if arm.moves == 3:
            signal.raise_signal(signal.SIGTERM)
        return frame(**words)

    camera.frame = signalled
    record(tmp_path / "live", "--plan", planned[0], "--yes").refused(
        "stopped by Ctrl-C or a signal; the arm was halted"
    )
    assert arm.halted == 1
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.slow
def test_stops_without_a_view_end_in_status_2(planned, cell, tmp_path):
    cell[1].hidden_at = (2,)
    record(tmp_path / "live", "--plan", planned[0], "--yes").refused(
        "1 of 4 stops gave no view", "not taken:"
    )
    assert len(Session.load(tmp_path / "live").views) == 3


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), "guide the arm by hand: --follow and --target"),
        (("--target", "charuco_9x6_30mm"), "needs a plan to drive an arm"),
        (("--plan", "PLAN", "--mount", "eye-to-hand"), "the plan says that already"),
        (("--plan", "PLAN", "--speed", "9"), "up to 1.5 rad/s"),
        (("--plan", "PLAN", "--follow", "--dry-run"), "a guided arm is not driven"),
    ],
)
def test_impossible_options_are_refused_before_a_device_is_asked(planned, tmp_path, more, words):
    more = [planned[0] if value == "PLAN" else value for value in more]
    record(tmp_path / "live", *more).refused(words)


def test_devices_and_pictures_that_do_not_fit_are_named(planned, cell, tmp_path):
    visioncal(
        "record", "-o", tmp_path / "live", "--arm", "fak", *CAMERA, "--plan", planned[0]
    ).refused("--arm: the device is 'fak', but must be one of fake, manual. Did you mean fake?")
    camera = cell[1]
    camera.lens = replace(camera.lens, resolution=(320, 200))
    record(tmp_path / "live", "--plan", planned[0], "--yes").refused(
        "the plan is for pictures of 640 x 400 px, and the camera gives 320 x 200"
    )


@pytest.mark.slow
def test_a_recording_that_ends_before_its_first_view_leaves_no_folder(planned, cell, tmp_path):
    """The same command can be given again; it said that its folder was not empty."""
    live, sent = tmp_path / "live", ("--plan", planned[0], "--yes")
    cell[1].hidden_at = range(9)
    record(live, *sent).refused("No view was taken")
    record(live, *sent, "--resume").refused("Then record again")
    assert not live.exists()


def test_a_guided_arm_is_followed(planned, cell, tmp_path):
    arm, stops = cell[0], iter(read_plan(planned[0]).stops)
    state, rested = arm.state, [arm.clock.now()]

    def led():
        # Who leads the arm goes on some time after each rest, however long the way there was.
        now = arm.clock.now()
        if arm.moving():
            rested[0] = now
        if now - rested[0] > 2.0:
            rested[0] = now
            arm.start_move(next(stops).q, speed=2.0, acceleration=4.0)
        return state()

    arm.state = led
    # One place at which nothing is seen is told, and the person goes elsewhere.
    cell[1].hidden_at = (2,)
    more = ("--follow", "--target", "charuco_9x6_30mm", "--robot", "ur5e", "--views", 3)
    done = record(tmp_path / "live", *more).good()
    assert "[1/3] view 1:" in done.err
    assert "not taken:" in done.err
    assert "-> next:" in done.err
    session = Session.load(tmp_path / "live")
    assert len(session.views) == 3
    assert session.robot_name == "ur5e"


@pytest.mark.slow
def test_each_view_of_a_network_camera_shows_where_the_arm_stood(planned, tmp_path, monkeypatch):
    arm, camera = fake_devices(read_plan(planned[0]))
    arm.clock = HostClock()
    start_move = arm.start_move
    arm.start_move = lambda q, **_: start_move(q, speed=20.0, acceleration=100.0)
    monkeypatch.setattr(devices, "ARMS", {"fake": lambda *_, **__: arm})
    sent = NetworkCamera(lambda: camera.frame().image)
    with served(sent) as url:
        words = ("--camera", f"uvc:{url}", "--plan", planned[0], "--yes", "--json")
        done = visioncal("record", "-o", tmp_path / "live", *ARM, *FAST, *words)
    assert done.status == 0, done.err
    session = Session.load(tmp_path / "live")
    assert len(session.views) == 4
    # One picture after the other was exposed, and the flange was there.
    true_flanges = list(camera.exposures.values())
    for view in session.views:
        number = number_of(cv2.imread(str(tmp_path / "live" / view.image)))
        off = view.base_from_flange().translation - true_flanges[number][:3, 3]
        assert np.linalg.norm(off) < REPEATABILITY_M


def test_a_file_that_is_no_plan_is_named(tmp_path):
    file = tmp_path / "plan.json"
    raised(DataError, "does not exist", read_plan, tmp_path)
    for text, words in (
        ("{", "is not JSON"),
        ('{"schema": 1}', "not a plan that this version can read"),
        ('{"stops": [], "cell": {}, "request": {}, "schema": 1}', "cell.mount is missing"),
        ('{"stops": [], "cell": {}, "schema": 7}', "schema is 7"),
    ):
        file.write_text(text)
        raised(DataError, words, read_plan, file)

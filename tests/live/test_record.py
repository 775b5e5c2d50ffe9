"""`visioncal record`, as a user runs it: what it asks, says, writes and refuses."""

import io
import json
import re
import signal
import sys
from dataclasses import replace
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.live_cell import fake_devices, fake_plan
from support.mjpeg import NetworkCamera, number_of, served
from support.recorded import REPEATABILITY_M
from support.refusals import raised

from visioncal.cli import record as record_module
from visioncal.core.errors import DataError
from visioncal.live.capture import devices
from visioncal.live.capture.cell import HostClock
from visioncal.live.planning.plan import PlanRequest, make_plan
from visioncal.live.planning.plan_file import plan_document, read_plan
from visioncal.live.planning.purposes import purpose_of
from visioncal.session import Session

ARM, CAMERA = ("--arm", "fake:here"), ("--camera", "fake")
QUICK = ("--frames", 1, "--settle-s", 0.03)


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
    monkeypatch.setattr(record_module, "HostClock", lambda: arm.clock)


def record(out, *more):
    return visioncal("record", "-o", out, *ARM, *CAMERA, *QUICK, *more)


def test_a_plan_is_read_back_as_it_was_made(planned):
    folder, plan = planned
    for path in (folder, folder / "plan.json"):
        read = read_plan(path)
        for mine, its in zip(read.stops, plan.stops, strict=True):
            assert (mine.view, mine.words) == (its.view, its.words)
            assert np.array_equal(mine.q, its.q)
            assert np.array_equal(mine.via, its.via)
        assert np.array_equal(read.start_q, plan.request.start_q)
        assert (read.cell.limits, read.cell.target) == (plan.cell.limits, plan.cell.target)
        assert read.cell.robot.name == "ur5e"
        assert np.array_equal(read.cell.noise.robots, plan.cell.noise.robots)
        assert np.array_equal([read.cell.x, read.cell.z], [plan.cell.x, plan.cell.z])
    document = json.loads((folder / "plan.json").read_text(encoding="utf-8"))
    assert read.digest == document["inputs_sha256"]


def test_a_plan_is_driven_and_told_line_by_line(planned, cell, tmp_path):
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
    assert "stdin is no terminal" in done.err
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


def test_stops_without_a_view_end_in_status_2(planned, cell, tmp_path):
    cell[1].hidden_at = (2,)
    record(tmp_path / "live", "--plan", planned[0], "--yes").refused(
        "1 of 4 stops gave no view", "not taken:"
    )
    assert len(Session.load(tmp_path / "live").views) == 3


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ((), "--plan or --target is needed"),
        (("--target", "charuco_9x6_30mm"), "an arm is driven by a plan"),
        (("--plan", "PLAN", "--mount", "eye-to-hand"), "the plan says that already"),
        (("--plan", "PLAN", "--speed", "9"), "up to 1.5 rad/s"),
        (("--plan", "PLAN", "--follow", "--dry-run"), "a guided arm is not driven"),
    ],
)
def test_what_cannot_be_is_refused_before_a_device_is_asked(planned, tmp_path, more, words):
    more = [planned[0] if value == "PLAN" else value for value in more]
    record(tmp_path / "live", *more).refused(words)


def test_devices_and_pictures_that_do_not_fit_are_named(planned, cell, tmp_path):
    visioncal(
        "record", "-o", tmp_path / "live", "--arm", "fak", *CAMERA, "--plan", planned[0]
    ).refused("'fak' is no kind of device; fake, manual are. Did you mean fake?")
    camera = cell[1]
    camera.lens = replace(camera.lens, resolution=(320, 200))
    record(tmp_path / "live", "--plan", planned[0], "--yes").refused(
        "the plan is for pictures of 640 x 400 px, and the camera gives 320 x 200"
    )


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


def test_each_view_of_a_network_camera_shows_where_the_arm_stood(planned, tmp_path, monkeypatch):
    arm, camera = fake_devices(read_plan(planned[0]))
    arm.clock = HostClock()
    start_move = arm.start_move
    arm.start_move = lambda q, **_: start_move(q, speed=20.0, acceleration=100.0)
    monkeypatch.setattr(devices, "ARMS", {"fake": lambda *_, **__: arm})
    sent = NetworkCamera(lambda: camera.frame().image)
    with served(sent) as url:
        words = ("--camera", f"uvc:{url}", "--plan", planned[0], "--yes", "--json")
        done = visioncal("record", "-o", tmp_path / "live", *ARM, *QUICK, *words)
    assert done.status == 0, done.err
    session = Session.load(tmp_path / "live")
    assert len(session.views) == 4
    # One picture after the other was exposed, and the flange was there.
    true_flanges = list(camera.exposures.values())
    for view in session.views:
        number = number_of(cv2.imread(str(tmp_path / "live" / view.image)))
        off = view.base_from_flange().translation - true_flanges[number][:3, 3]
        assert np.linalg.norm(off) < REPEATABILITY_M


def test_what_is_no_plan_is_named(tmp_path):
    file = tmp_path / "plan.json"
    raised(DataError, "does not exist", read_plan, tmp_path)
    for text, words in (
        ("{", "is no JSON"),
        ('{"schema": 1}', "not a plan that this version can read"),
        ('{"stops": [], "cell": {}, "request": {}, "schema": 1}', "cell.mount is missing"),
        ('{"stops": [], "cell": {}, "schema": 7}', "schema is 7"),
    ):
        file.write_text(text)
        raised(DataError, words, read_plan, file)

"""What a recording leaves on the disk, whatever ends it, and how it goes on."""

import errno
import shutil
from dataclasses import replace

import pytest
from support.killed import kill_and_resume
from support.live_cell import fake_devices, fake_plan
from support.recorded import recorded

from visioncal.core.errors import DataError, DriverError
from visioncal.live.capture import journal as journal_module
from visioncal.live.planning.plan_file import PlanFile
from visioncal.session import Session


@pytest.fixture(scope="module")
def plan() -> PlanFile:
    return fake_plan(5)


def test_ctrl_c_halts_and_a_resumed_recording_is_complete(plan, tmp_path):
    arm, camera = fake_devices(plan)
    state, asked = arm.state, []

    def interrupted():
        asked.append(1)
        if len(asked) == 400:
            raise KeyboardInterrupt
        return state()

    arm.state = interrupted
    with pytest.raises(DriverError, match=r"Ctrl-C or a signal; the arm was halted\. . views? "):
        recorded(tmp_path / "live", plan, arm, camera)
    assert arm.halted == 1
    some = len(Session.load(tmp_path / "live").views)
    assert 0 < some < len(plan.stops)
    arm, camera = fake_devices(plan)
    steps = recorded(tmp_path / "live", plan, arm, camera, resume=True)
    assert len(steps) == len(plan.stops) - some
    numbers = [view.number for view in Session.load(tmp_path / "live").views]
    assert sorted(numbers) == [stop.view for stop in plan.stops]


def test_a_full_disk_is_told_and_leaves_the_session(plan, tmp_path, monkeypatch):
    arm, camera = fake_devices(plan)
    usage, write, written = shutil.disk_usage, journal_module.write_atomically, []

    def room(folder):
        free = 1000 if len(written) > 8 else usage(folder).free
        return usage(folder)._replace(free=free)

    def counted(path, data):
        written.append(path)
        write(path, data)

    monkeypatch.setattr(journal_module, "write_atomically", counted)
    monkeypatch.setattr(journal_module.shutil, "disk_usage", room)
    # It is told on the way, not when the next view is there.
    words = r"live: too little room: 0\.0 MB are free.* for the next view"
    with pytest.raises(DataError, match=words):
        recorded(tmp_path / "live", plan, arm, camera)
    assert arm.halted == 1
    assert len(Session.load(tmp_path / "live").views) >= 3


def test_a_disk_that_fills_while_it_is_written_leaves_the_session(plan, tmp_path, monkeypatch):
    arm, camera = fake_devices(plan)
    write = journal_module.write_atomically

    def full(path, data):
        if path.name == "003.png":
            error = DataError("cannot be written")
            raise error from OSError(errno.ENOSPC, "No space left on device")
        write(path, data)

    monkeypatch.setattr(journal_module, "write_atomically", full)
    with pytest.raises(DataError, match=r"too little room.* for 003\.png"):
        recorded(tmp_path / "live", plan, arm, camera)
    assert len(Session.load(tmp_path / "live").views) == 2


def test_a_killed_recording_loses_nothing(tmp_path):
    # The moments are random, and on a busy machine some kills come before the first view: what is
    # asserted holds for any of them.
    ends = kill_and_resume(tmp_path / "live", stops=8, kills=2, seed=7, most_s=0.6)
    assert ends


def test_what_a_killed_process_left_is_removed(plan, tmp_path):
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
    with pytest.raises(DataError, match="exists and is not empty") as caught:
        recorded(folder, plan, arm, camera)
    assert "--resume" in caught.value.next_step
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


def test_a_disk_without_room_for_all_views_is_told_before_anything_moves(
    plan, tmp_path, monkeypatch
):
    arm, camera = fake_devices(plan)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(
        journal_module.shutil, "disk_usage", lambda _: usage._replace(free=1_000_000)
    )
    with pytest.raises(DataError, match=r"1\.5 MB are needed for 5 views"):
        recorded(tmp_path / "live", plan, arm, camera)
    assert arm.moves == 0
    # With room made, it begins.
    monkeypatch.undo()
    recorded(tmp_path / "live", plan, arm, camera)

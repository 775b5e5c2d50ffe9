"""The table of a recording's views: edits under kills, and requests while a trial runs."""

import shutil
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from visioncal import Session
from visioncal.core.documents.pendants import read_pose
from visioncal.core.errors import DataError
from visioncal.core.types import Corners
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.journal import CaptureFacts, Journal, RecordedCell, posed
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.folder import FolderCamera
from visioncal.live.drivers.manual import ManualArm
from visioncal.live.drivers.protocols import ArmState, Frame
from visioncal.live.page import outcome
from visioncal.live.page import station as stations
from visioncal.live.page.outcome import Outcome
from visioncal.live.page.state import Setup, Task, Visitor
from visioncal.live.page.station import Station
from visioncal.vision.boards.imaging import decode_image
from visioncal.vision.targets import load_target

BOARD = load_target("charuco_9x6_30mm")
FACTS = CaptureFacts("eye-in-hand", BOARD, None, "s", "arm", "camera", (40, 30), None, {}, "")


def wait_until(holds) -> None:
    """Waits for something that comes at all."""
    for _ in range(3000):
        if holds():
            return
        time.sleep(0.01)
    pytest.fail("It did not come.")


class Killed(BaseException):
    """The process ends here."""


def state(x_m: float) -> ArmState:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return ArmState(0.0, pose, typed=f"X {x_m} m")


def taken(grey: int, x_m: float) -> TakenView:
    frame = Frame(np.full((30, 40), grey, np.uint8), 0.0, name=f"{grey}.png")
    return TakenView(frame, state(x_m), SimpleNamespace(blur_px=0.7), 0.0)


def pairs(folder: Path) -> list[tuple[int, int, float]]:
    """Number, grey level and position of each row of the session on the disk."""
    if not (folder / "views.csv").is_file():
        return []
    session = Session.load(folder)
    return [
        (
            view.number,
            int(decode_image((folder / view.image).read_bytes())[0, 0]),
            view.numbers["x_m"],
        )
        for view in session.views
    ]


def reposed(journal: Journal) -> None:
    journal.rewrite([posed(view, state(0.9)) for view in journal.views[:1]])


def exchanged(journal: Journal) -> None:
    first, second, third = journal.views
    journal.rewrite([posed(first, second), posed(second, first), third])


EDITS = {
    "taken": lambda journal: journal.store({4: taken(40, 0.4), 5: taken(50, 0.5)}),
    "taken again": lambda journal: journal.store({2: taken(25, 0.25), 4: taken(40, 0.4)}),
    "removed and typed": reposed,
    "exchanged": exchanged,
    "all undone": lambda journal: journal.rewrite([]),
}


@pytest.mark.parametrize("name", EDITS)
def test_a_kill_at_any_moment_of_an_edit_leaves_the_table_before_or_after(
    name, tmp_path, monkeypatch
):
    journal = Journal.begin(tmp_path / "start", FACTS, 0.0, 0)
    for number in (1, 2, 3):
        journal.store({number: taken(10 * number, 0.1 * number)})
    before, seen = pairs(tmp_path / "start"), []
    for moment in range(40):
        folder = tmp_path / f"{moment}"
        shutil.copytree(tmp_path / "start", folder)
        journal, steps = Journal.resume(folder, FACTS, 0.0, 0), []

        def dying(act, steps=steps, moment=moment):
            def acts(*words, **more):
                steps.append(words)
                if len(steps) > moment:
                    raise Killed
                return act(*words, **more)

            return acts

        with monkeypatch.context() as patch:
            for act in ("replace", "unlink"):
                patch.setattr(Path, act, dying(getattr(Path, act)))
            with suppress(Killed):
                EDITS[name](journal)
        seen.append(pairs(folder))
        # What goes on with it finds the same, under the images' own names.
        views = Journal.resume(folder, FACTS, 0.0, 0).views
        assert [view.image for view in views] == [f"images/{view.number:03d}.png" for view in views]
        assert pairs(folder) == seen[-1]
        if len(steps) <= moment:
            break
    after = seen[-1]
    assert before != after
    assert (
        after
        == {
            "taken": [*before, (4, 40, 0.4), (5, 50, 0.5)],
            "taken again": [before[0], (2, 25, 0.25), before[2], (4, 40, 0.4)],
            "removed and typed": [(1, 10, 0.9)],
            "exchanged": [(1, 10, 0.2), (2, 20, 0.1), before[2]],
            "all undone": [],
        }[name]
    )
    assert all(table in (before, after) for table in seen)


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """A station with a folder of pictures, whose trials wait; and its folder."""
    inbox, out, judged = tmp_path / "inbox", tmp_path / "out", Event()
    inbox.mkdir()
    for number in range(1, 10):
        cv2.imwrite(str(inbox / f"shot{number}.png"), np.full((30, 40), 20 * number, np.uint8))
    # Every picture shows the board; the number of each that is searched is noted.
    looks = []

    def found(image, _target, view):
        looks.append(int(image.flat[0]) // 20)
        px = np.array([[5.0, 5.0], [30.0, 5.0], [5.0, 20.0], [30.0, 20.0]])
        return Corners(view, np.arange(4), px, 0.7), None

    def ask(_words, folder, views):
        judged.wait()
        return Outcome("green", "good", (), "", folder or tmp_path, views, {"verdict": {}})

    for name, stand_in in (("find_corners", found), ("ask_command", ask)):
        monkeypatch.setattr(stations, name, stand_in)
    for user in ("recording", "take"):
        monkeypatch.setattr(f"visioncal.live.capture.{user}.find_corners", found)

    @contextmanager
    def begun():
        cell = LiveCell(ManualArm(lambda _: ""), FolderCamera(str(inbox)))
        facts = CaptureFacts.of(cell, "out", RecordedCell("eye-in-hand", BOARD, None), None)
        yield cell, Journal.resume(out, facts, 0.0, 0)

    recorded = RecordedCell("eye-in-hand", BOARD, None)
    task = Task(begun, recorded, None, (), 0, CaptureOptions(), (), tmp_path / "result")
    station = Station(lambda _: task, Setup(), begins=True)
    wait_until(lambda: station.snapshot.due == "shot1.png")
    yield SimpleNamespace(station=station, out=out, judged=judged, looks=looks)
    judged.set()
    station.close()


def takes(station: Station, visitor: Visitor, *places: int) -> None:
    lines = [f"X {100 * place} Y 0 Z 500 A 0 B 0 C 0" for place in places]
    station.take(visitor, [read_pose(line, "line", "kuka") for line in lines], lines, visitor.seen)


def answered(visitor: Visitor, count: int) -> None:
    wait_until(lambda: visitor.answers == count)


def test_the_session_keeps_the_form_in_which_all_poses_were_typed(recording):
    station, visitor = recording.station, Visitor(recording.station.snapshot)
    lines = {"kuka": "X 900 Y 0 Z 500 A 10 B 0 C 180", "fanuc": "X 900 Y 0 Z 500 W 180 P 0 R 10"}
    lines |= {"ros": "0.9 0 0.5 0 0 0 1"}
    takes(station, visitor, 1, 2)
    answered(visitor, 1)
    # A library is no maker, and poses in two forms are of none.
    for count, (form, kept) in enumerate(
        (("fanuc", None), ("kuka", "kuka"), ("ros", None), ("kuka", "kuka")), 2
    ):
        station.repose(visitor, 1, read_pose(lines[form], "line", form), lines[form])
        answered(visitor, count)
        assert not visitor.refusal
        table = Session.load(recording.out).declaration.robot
        assert (table and table.form) == kept
    station.mend(visitor, "not wanted", 2)
    answered(visitor, 6)
    station.repose(visitor, 1, read_pose(lines["ros"], "line", "ros"), lines["ros"])
    answered(visitor, 7)
    assert Session.load(recording.out).declaration.robot is None


def test_a_resumed_recording_goes_on_in_its_form(tmp_path):
    def typed(form):
        view = taken(10, 0.1)
        return replace(view, state=replace(view.state, pose_form=form))

    Journal.begin(tmp_path / "cell", FACTS, 0.0, 0).store({1: typed("kuka")})
    toml = tmp_path / "cell" / "session.toml"
    edited = toml.read_text() + "\n[need]\nmm = 0.5\n"
    toml.write_text(edited)
    journal = Journal.resume(tmp_path / "cell", FACTS, 0.0, 0)
    assert journal.form == "kuka"
    journal.store({2: typed("kuka")})
    # Whoever adds to the file meanwhile keeps it.
    assert toml.read_text() == edited
    assert Session.load(tmp_path / "cell").robots[""].form == "kuka"
    journal.store({3: typed("abb")})
    session = Session.load(tmp_path / "cell")
    assert (session.robots[""].form, session.need.mm) == (None, 0.5)


def test_a_recording_without_a_view_may_go_on_with_other_devices(tmp_path):
    """Who chose the wrong camera at first was refused until the folder was removed."""
    folder, other = tmp_path / "cell", replace(FACTS, camera="another")
    Journal.begin(folder, FACTS, 0.0, 0)
    journal = Journal.resume(folder, other, 0.0, 0)
    journal.store({1: taken(10, 0.1)})
    assert Session.load(folder).camera_name == "another"
    with pytest.raises(DataError, match='camera was "another" and is "camera"'):
        Journal.resume(folder, FACTS, 0.0, 0)
    journal.rewrite([])
    Journal.resume(folder, FACTS, 0.0, 0).store({1: taken(10, 0.1)})
    assert Session.load(folder).camera_name == "camera"
    assert len(Journal.resume(folder, FACTS, 0.0, 0).views) == 1


def test_requests_while_a_trial_runs_are_all_done_at_once(recording):
    station, visitor = recording.station, Visitor(recording.station.snapshot)
    takes(station, visitor, *range(1, 9))
    answered(visitor, 1)
    wait_until(lambda: station.snapshot.due == "shot9.png")
    looks = len(recording.looks)
    # Pressed faster than the page is drawn, while the trial cannot end.
    for _ in range(3):
        station.mend(visitor, "not wanted")
    station.mend(visitor, "exchanged", 1)
    answered(visitor, 5)
    assert "Choose a view" in visitor.refusal
    station.mend(visitor, "exchanged", 1, 2)
    answered(visitor, 6)
    assert visitor.refusal == ""
    assert [row.number for row in station.snapshot.views] == [1, 2, 3, 4, 5]
    # No picture is searched anew but those that are due: the last ones, each once, however long
    # each is due.
    wait_until(lambda: station.snapshot.due == "shot6.png")
    searched = recording.looks[looks:]
    assert {*searched} <= {6, 7, 8, 9}
    assert len(searched) == len({*searched})
    assert station.snapshot.trial is None
    recording.judged.set()
    wait_until(lambda: station.snapshot.trial is not None and not station.snapshot.outdated)
    assert len(station.snapshot.trial.views) == 5
    visitor.seen = station.snapshot
    takes(station, visitor, 20)
    wait_until(lambda: len(station.snapshot.views) == 6)


def test_a_second_browser_is_refused_with_the_reason(recording):
    station = recording.station
    first, second = Visitor(station.snapshot), Visitor(station.snapshot)
    takes(station, first, 1)
    answered(first, 1)
    takes(station, second, 2)
    answered(second, 1)
    assert "Another browser" in second.refusal
    # What the second typed was not taken.
    assert second.lines == ()
    wait_until(lambda: station.snapshot.due == "shot2.png")
    second.seen = station.snapshot
    takes(station, second, 2)
    answered(second, 2)
    assert (second.refusal, len(station.snapshot.views)) == ("", 2)


def test_poses_and_pictures_that_are_one_apart_are_moved(recording):
    station, visitor = recording.station, Visitor(recording.station.snapshot)

    def poses() -> list[tuple[str, float]]:
        views = Session.load(recording.out).views
        return [(view.text["picture"], round(10 * view.numbers["x_m"])) for view in views]

    def done(count: int) -> None:
        answered(visitor, count)
        assert visitor.refusal == ""
        visitor.seen = station.snapshot

    # The second picture belongs to no pose: from it on, each has the next one's.
    takes(station, visitor, 1, 3, 4)
    done(1)
    station.mend(visitor, "no pose", 2)
    done(2)
    assert poses() == [("shot1.png", 1), ("shot3.png", 3)]
    # The last pose is typed again, with the picture that is due.
    assert visitor.returned.startswith("X 400")
    wait_until(lambda: station.snapshot.left_out == ("shot2.png",))
    # A pose that was typed twice, in other words: it has no picture.
    visitor.seen = station.snapshot
    takes(station, visitor, 9, 4)
    done(3)
    station.mend(visitor, "no picture", 4)
    done(4)
    assert poses() == [("shot1.png", 1), ("shot3.png", 3), ("shot4.png", 4)]
    wait_until(lambda: station.snapshot.due == "shot5.png")
    # A picture that was left out may be chosen for the next pose.
    station.choose(visitor, "shot2.png")
    done(5)
    wait_until(lambda: station.snapshot.due == "shot2.png")
    visitor.seen = station.snapshot
    takes(station, visitor, 2, 5)
    done(6)
    assert poses()[-2:] == [("shot2.png", 2), ("shot5.png", 5)]


@pytest.mark.parametrize(("folder", "flags"), [(None, 0x4000), (Path("out"), 0)])
def test_on_windows_a_trial_has_a_lower_priority_too(monkeypatch, folder, flags):
    started = {}

    def popen(words, creationflags, **options):
        started[words[-2]] = creationflags
        return subprocess.Popen([sys.executable, "-c", "print('{\"error\"')"], **options)

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(outcome.os, "setpriority")
    stand_in = SimpleNamespace(
        PIPE=subprocess.PIPE, BELOW_NORMAL_PRIORITY_CLASS=0x4000, Popen=popen
    )
    monkeypatch.setattr(outcome, "subprocess", stand_in)
    assert outcome.ask_command(["calibrate", "cell"], folder, ()).title == "failed"
    assert [*started.values()] == [flags]

"""`visioncal dynamics record`: an arm's joints at the controller's rate, moved by another."""

import itertools

import numpy as np
import pytest
from support.commands import visioncal as run

from visioncal.cli import dynamics
from visioncal.core.errors import DriverError
from visioncal.live.capture.motions import record_motion
from visioncal.live.drivers.protocols import ArmState
from visioncal.live.simulated.controller import spawn
from visioncal.live.simulated.machine import ControllerOptions
from visioncal.session import Session

RATE_HZ = 100.0


class Scripted:
    """Joints at rest, in motion from `begin_s` to `end_s`, with a short rest in between."""

    name = "scripted arm"

    def __init__(self, begin_s, end_s):
        self.begin_s, self.end_s, self.at = begin_s, end_s, 0

    def state(self):
        """The next one."""
        now_s = self.at / RATE_HZ
        self.at += 1
        middle = 0.5 * (self.begin_s + self.end_s)
        moves = self.begin_s <= now_s < self.end_s and not middle < now_s < middle + 1.0
        dq = np.array([0.3, -0.1]) * moves
        reported = {"q": np.array([now_s, 0.0]), "dq": dq, "currents_a": np.array([1.0, 2.0])}
        return ArmState(now_s, np.eye(4), controller_s=now_s, **reported)


def test_a_motion_is_recorded_from_before_its_begin_to_behind_its_end():
    stream = record_motion(Scripted(5.0, 12.0), RATE_HZ, rest_s=2.0)
    assert stream.columns == (
        *("stamp_s", "q1_rad", "q2_rad", "dq1_rad_s", "dq2_rad_s", "current1_a", "current2_a"),
    )
    # A second of rest before and behind; the rest of a second in the middle is no end.
    assert stream.stamps_s[0] == pytest.approx(4.0, abs=0.02)
    assert stream.stamps_s[-1] == pytest.approx(13.0, abs=0.02)
    assert np.diff(stream.stamps_s) == pytest.approx(1.0 / RATE_HZ)


def test_an_arm_that_never_moves_is_named():
    with pytest.raises(DriverError, match="scripted arm has not moved for 3 s"):
        record_motion(Scripted(50.0, 51.0), RATE_HZ, patience_s=3.0)


def test_other_arms_and_streams_that_are_there_are_refused(tmp_path):
    run("dynamics", "record", tmp_path / "s", "--arm", "abb:1.2.3.4").refused("must be ur:HOST")
    (tmp_path / "s" / "streams").mkdir(parents=True)
    (tmp_path / "s" / "streams" / "excite.csv").write_text("stamp_s\n1\n")
    run("dynamics", "record", tmp_path / "s", "--arm", "ur:1.2.3.4").refused("excite.csv exists")


@pytest.mark.usefixtures("patient")
def test_a_ur_is_recorded_through_its_client_library(tmp_path, monkeypatch):
    pytest.importorskip("rtde_receive", reason="ur-rtde is not installed (the extra `ur`)")
    with spawn(ControllerOptions(rate_hz=500.0)) as controller:
        home = np.array(ControllerOptions().q)

        def recorded(arm, rate_hz, **options):
            """Moves the arm once some states at rest were taken."""
            state, rested = arm.state, itertools.count(1)

            def sampled():
                found = state()
                if next(rested) == 100:
                    controller.guide(home + 0.4, speed=0.4, acceleration=1.0)
                return found

            monkeypatch.setattr(arm, "state", sampled)
            return record_motion(arm, rate_hz, **options)

        monkeypatch.setattr(dynamics, "record_motion", recorded)
        arguments = ("--arm", f"ur:{controller.host}", "--rest-s", "1.0")
        first = run("dynamics", "record", tmp_path / "s", *arguments)
    assert first.status == 0, first.err
    session = Session.load(tmp_path / "s")
    assert session.robot_name == "ur10e"
    stream = session.streams["excite"]
    moved = stream["q1_rad"][-1] - stream["q1_rad"][0]
    assert moved == pytest.approx(0.4, abs=1e-3)
    assert stream["dq1_rad_s"].max() == pytest.approx(0.4, abs=0.02)
    # Steps are the controller's own 2 ms, or some of them where a computer is busy.
    cycles = np.diff(stream.stamps_s) / 0.002
    assert cycles.min() > 0.9
    assert cycles == pytest.approx(np.round(cycles), abs=1e-6)
    assert np.abs(stream["current2_a"]).min() > 0.5

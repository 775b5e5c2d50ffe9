"""Rehearsing a calibration: a simulated cell, driven and seen through the real client libraries."""

import importlib.util
import json

import numpy as np
import pytest
from support.cells import calibrated
from support.commands import visioncal

from visioncal.calibration.pipeline.result import result_of
from visioncal.cli import rehearse as command
from visioncal.core.errors import DriverError
from visioncal.core.transforms import exp, pose_difference
from visioncal.live.capture.core import CaptureEvent, Times
from visioncal.live.capture.drive import JointPace
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.take import Missed
from visioncal.live.planning.plan_file import PlanFile, Stop
from visioncal.live.planning.purposes import purpose_of
from visioncal.live.rehearsal.cell import GUESS_M, GUESS_RAD, RehearsalOptions, rehearsed_cell
from visioncal.live.rehearsal.witness import check_edges, pace_of
from visioncal.results.compare import edge_errors
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate

EXTRAS = ("rtde_control", "rtde_receive", "depthai")
MISSING = [extra for extra in EXTRAS if importlib.util.find_spec(extra) is None]


@pytest.mark.slow
@pytest.mark.usefixtures("patient")
@pytest.mark.skipif(bool(MISSING), reason=f"pip install '.[ur,oak]' brings {', '.join(MISSING)}")
def test_a_rehearsal_through_a_protective_stop_is_as_near_to_the_truth_as_it_says(tmp_path):
    out = tmp_path / "rehearsal"
    words = ("--views", 6, "--fault", "protective-stop", "--json")
    done = visioncal("rehearse", "-o", out, *words)
    assert done.status == 0, done.err
    told = json.loads(done.out)
    assert told == json.loads((out / "rehearsal.json").read_text())
    assert told["passed"]
    # A tip that knows the truth comes as near to what the camera located as was predicted.
    assert told["touch_test"]["passed"]
    assert len(told["touch_test"]["gaps_mm"]) == 5
    assert told["arm_level"] == "offsets"
    # Three views before the stop, or more where a busy computer is late with it; the others by
    # going on.
    assert 3 <= told["fault"]["views_kept"] < 6
    assert "protective stop" in told["fault"]["message"].lower().replace("_", " ")
    assert "--resume" in told["fault"]["next_step"]
    assert [view.number for view in Session.load(out / "session").views] == [1, 2, 3, 4, 5, 6]
    # What a UR repeats to.
    assert told["most_away_at_exposure_mm"] < 0.05
    for name in ("plan/plan.json", "result/calibration.json", "result/recording.rrd"):
        assert (out / name).stat().st_size > 0


def test_without_the_client_library_the_command_that_installs_it_is_told(tmp_path, monkeypatch):
    def missing(needed: str, extras: dict[str, str]) -> None:
        words = f"pip install the extras {', '.join(extras)}"
        raise DriverError(f"{extras[needed]} is missing", next_step=words)

    monkeypatch.setattr(command, "refuse_without", missing)
    done = visioncal("rehearse", "-o", tmp_path / "out")
    assert done.status == 2
    assert "the extras ur, oak" in done.err
    assert not (tmp_path / "out").exists()


def test_a_session_of_something_else_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "refuse_without", lambda *_: None)
    (tmp_path / "session").mkdir()
    (tmp_path / "session" / "views.csv").write_text("precious")
    done = visioncal("rehearse", "-o", tmp_path)
    assert done.status == 2
    assert "is not of a rehearsal" in done.err
    assert (tmp_path / "session" / "views.csv").read_text() == "precious"


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_cell_is_guessed_as_roughly_as_is_said(mount):
    cell = rehearsed_cell(RehearsalOptions(mount=mount, seed=5))
    again = rehearsed_cell(RehearsalOptions(mount=mount, seed=5))
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


def test_errors_are_weighed_by_what_the_calibration_says():
    cell = simulate(CellOptions(views=12, seed=4))
    found = result_of(calibrated(cell))
    fair = check_edges(found, cell.transforms)
    assert fair.passed
    assert fair.freedom == 12
    aside = exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2e-3]))
    true_x = cell.transforms["flange_from_cam"]
    away = {**cell.transforms, "flange_from_cam": true_x @ aside}
    assert not check_edges(found, away).passed
    # 2 mm more along an axis are at least 2 mm less what was wrong before.
    before = edge_errors(found, cell.transforms)["flange_from_cam"].mm
    assert edge_errors(found, away)["flange_from_cam"].mm > 2.0 - before


def test_what_a_recording_adds_is_told_from_motion_driving_and_settling():
    known = rehearsed_cell(RehearsalOptions()).known
    q = [np.zeros(6), np.full(6, 0.5), np.full(6, 1.5)]
    # The second stop is reached by way of another posture.
    stops = (Stop(1, q[0], np.zeros((0, 6))), Stop(2, q[2], np.array([q[1]])))
    plan = PlanFile(known, purpose_of("hand-eye"), stops, None, "0" * 64)
    taking = CaptureOptions(speed=1.0, acceleration=1.0)
    ways = [0.0, JointPace(1.0, 1.0).path_duration_s(q[:3])]
    times = [Times(ways[0] + 0.1, 0.5, 0.2), Times(ways[1] + 0.3, 0.7, 0.4)]
    steps = [CaptureEvent(1, 1, 2, Missed("none"), "", None, "", time) for time in times]
    pace = pace_of(steps, plan, q[0], taking)
    assert pace.views == 2
    assert pace.motion_s == pytest.approx(sum(ways) / 2)
    assert pace.settling_s == pytest.approx(0.6)
    assert pace.driving_s == pytest.approx(0.2)
    assert pace.added_s == pytest.approx(0.3)
    assert pace.most_added_s == pytest.approx(0.4)

"""`visioncal demo --live`: a simulated cell, driven through the real client library."""

import sys

import numpy as np
import pytest
from support.commands import visioncal

from visioncal.cli import demo
from visioncal.core.transforms import exp, invert, pose_difference
from visioncal.live.simulated.cell import GUESS_M, GUESS_RAD, Bench
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import read_truth


@pytest.mark.slow
@pytest.mark.usefixtures("patient")
def test_a_recording_is_as_near_to_the_truth_as_it_says(tmp_path):
    pytest.importorskip("rtde_control", reason="ur-rtde is not installed (the extra `ur`)")
    done = visioncal("demo", "--live", "-o", tmp_path, "--views", 6)
    assert done.status == 0, done.err
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


def test_without_the_client_library_the_command_that_installs_it_is_told(tmp_path, monkeypatch):
    # As where it is not installed.
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    done = visioncal("demo", "--live", "-o", tmp_path / "out")
    assert done.status == 2
    assert "pip install 'ur-rtde" in done.err
    assert not (tmp_path / "out").exists()


def test_the_cell_is_guessed_as_roughly_as_is_said():
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

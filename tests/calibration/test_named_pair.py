"""One camera and one robot that have names: the result has those of a pair."""

from pathlib import Path

from support.commands import visioncal

from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, RobotAt, cell_session, simulate
from visioncal.simulation.layout import CELL


def test_two_boards_of_a_named_camera_and_robot_have_a_result_that_can_be_written(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    options = NetworkOptions(
        robots=(RobotAt("a", (-0.6, 0.0, 0.0)),),
        cameras=(CameraAt("hand", "a"),),
        boards=(
            BoardAt("floor", CELL, place_m=(0.0, 0.1, 0.0)),
            BoardAt("wall", CELL, place_m=(0.0, -0.3, 0.1)),
        ),
        stops=20,
        seed=1,
    )
    cell_session(simulate(options), "cell", seen="corners").save(tmp_path / "cell")
    assert [*Session.load("cell").robots] == ["a"]
    visioncal("calibrate", "cell", "-o", "out").good()
    edges = [*Calibration.load(Path("out")).edges]
    assert edges == ["flange_from_cam", "base_from_target_floor", "base_from_target_wall"]
    visioncal("export", "out", "--to", "ros").good()

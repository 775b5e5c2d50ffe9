"""A whole cell from its pictures: `visioncal align` on a folder, and on its recording."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import visioncal
from support.drawn import column

from visioncal.core.transforms import log
from visioncal.present.recording import paths, read_evidence
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    BoardAt,
    CameraAt,
    NetworkOptions,
    RobotAt,
    simulate,
    wide_camera,
    write_session,
)

SMALL = replace(wide_camera(), resolution=(640, 480), matrix=np.array([560.0, 559.0, 321.0, 238.0]))
LARGE = replace(wide_camera(), resolution=(800, 600), matrix=np.array([760.0, 761.0, 398.0, 301.0]))
PLAIN = replace(BOARDS["checkerboard"], name="6x5", columns=6, rows=5)
OPTIONS = NetworkOptions(
    robots=(RobotAt("a", (-0.6, 0.0, 0.0)), RobotAt("b", (0.6, 0.05, 0.02))),
    cameras=(
        CameraAt("left", place_m=(0.0, -0.5, 0.9), camera=LARGE),
        CameraAt("right", place_m=(0.1, 0.45, 0.95), camera=SMALL, state_intrinsics=False),
    ),
    boards=(
        BoardAt(
            "plate_a", "a", target=replace(BOARDS["checkerboard"], name="6x5", columns=6, rows=5)
        ),
        BoardAt("plate_b", "b", target=replace(BOARDS["charuco"], name="5x4", columns=5, rows=4)),
    ),
    stops=8,
    lens_views=6,
    swapped_rows=1,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_session(simulate(OPTIONS), tmp_path_factory.mktemp("cell") / "cell")


@pytest.fixture(scope="module")
def out(folder, tmp_path_factory) -> Path:
    found = tmp_path_factory.mktemp("out")
    assert visioncal("calibrate", folder, "-o", found).status == 0
    return found


def test_pictures_of_several_cameras_are_one_cell(out):
    cell, found = simulate(OPTIONS), Calibration.load(out)
    for frame in ("base_b", "cam_left", "cam_right"):
        edge = found.between("base_a", frame)
        off = log((np.linalg.inv(edge.matrix) @ cell.between("base_a", frame))[None])[0]
        # Six squared sigmas are exceeded once in 4e5; pictures of small boards are not ideal.
        assert off @ np.linalg.solve(edge.covariance, off) < 60.0, frame
    # Both rows whose pictures were exchanged are left out.
    left_out = {view.view: view.reason for view in found.views if not view.used}
    for view in cell.wrong_views:
        assert "disagrees" in left_out[view]
    assert found.cell.lenses["cam_right"].estimated
    assert not found.cell.lenses["cam_left"].estimated


def test_what_was_detected_lies_over_the_image_of_the_camera_that_saw_it(folder, out):
    recording, views = out / "recording.rrd", Session.load(folder).views
    seen = read_evidence(recording)
    assert [view.view for view in seen] == [view.number for view in views]
    frames = column(recording, paths.DETECTED, "CoordinateFrame:frame")
    of_camera = {row: f"image_of_cam_{view.text['camera']}" for row, view in enumerate(views)}
    assert {row: str(frame[0]) for row, frame in frames.items()} == of_camera
    assert "Worst used view" in (out / "report.html").read_text()


@pytest.mark.slow
def test_the_recording_is_the_session_and_holds_the_result(folder, out, tmp_path):
    recording = out / "recording.rrd"
    assert Session.load(recording).digest() == Session.load(folder).digest()
    assert visioncal("calibrate", recording, "-o", tmp_path / "again").status == 0
    texts = [(value / "calibration.json").read_text() for value in (out, tmp_path / "again")]
    # Commands name the session that each was made from, and the folder that it was written to.
    paths = {str(recording): str(folder), str(tmp_path / "again"): str(out)}
    for path, same in paths.items():
        texts = [text.replace(path, same) for text in texts]
    one, other = map(json.loads, texts)
    assert one | {"created": ""} == other | {"created": ""}
    assert visioncal("show", recording, "-o", tmp_path / "report.html").status == 0
    pages = [value.read_text() for value in (tmp_path / "report.html", out / "report.html")]
    assert pages[0].replace(str(tmp_path), str(out)) == pages[1]

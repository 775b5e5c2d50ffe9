"""Recordings of aligned cells: the session and the result lie in them without loss."""

from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.aligned_cells import cell_result

from visioncal.calibration.run import Run
from visioncal.core.transforms import invert, pose_difference
from visioncal.interchange.outputs import write_outputs
from visioncal.present.recording import read_calibration, read_session
from visioncal.present.recording.scene import Scene
from visioncal.results import Edge, ViewResult, to_document
from visioncal.simulation import BoardAt, CameraAt, NetworkOptions, cell_session, simulate

OPTIONS = NetworkOptions(
    cameras=(CameraAt("top"), CameraAt("hand", "a")),
    boards=(BoardAt("plate", "b"), BoardAt("floor")),
    stops=4,
)


@pytest.fixture(scope="module")
def cell():
    return simulate(OPTIONS)


@pytest.fixture(scope="module")
def session(cell):
    return cell_session(cell, "cell", seen="poses")


def true_result(cell, session):
    """What calibrating a simulated cell would give, were it exact."""
    origin = invert(cell.mountings["base_a"])
    edges = {
        f"{cell.parents[name]}_from_{name}": Edge(
            origin @ transform if cell.parents[name] == "cell" else transform, 1e-8 * np.eye(6)
        )
        for name, transform in cell.mountings.items()
        if name != "base_a"
    }
    views = tuple(
        ViewResult(
            observation.view.number,
            observation.view.number % 5 > 0,
            residual_mm=0.1,
            seer=observation.seer,
            seen=observation.seen,
            stop=observation.station,
        )
        for observation in session.observations
    )
    found = cell_result(edges, 1e-8 * np.eye(6 * len(edges)), views, tree=session.frames)
    return replace(found, session_name=session.name, session_sha256=session.digest())


def test_frames_are_drawn_where_they_were(cell, session):
    scene = Scene.of(session, true_result(cell, session), {})
    for observation in session.observations:
        seer = scene.in_cell(observation.seer, observation.view.number)
        seen = scene.in_cell(observation.seen, observation.view.number)
        mm, _ = pose_difference(invert(seer) @ seen, observation.view.cam_from_target().as_matrix())
        # The pose of a small board as it was measured is off by a few millimetres along the sight.
        assert mm < 6.0
    assert scene.in_cell("cam_nowhere", 0) is None


def test_session_and_result_come_back_from_the_recording(cell, session, tmp_path):
    found = true_result(cell, session)
    files = write_outputs(tmp_path / "out", session, Run(found, ())).files
    assert [file.name for file in files] == ["calibration.json", "report.html", "recording.rrd"]
    recording = tmp_path / "out" / "recording.rrd"
    assert read_session(recording).digest() == session.digest()
    assert to_document(read_calibration(recording)) == to_document(found)
    drawn = {chunk.entity_path for chunk in RrdReader(recording).stream()}
    for entity in ("/cameras/top", "/targets/plate/sheet", "/robots/b/links", "/network"):
        assert entity in drawn

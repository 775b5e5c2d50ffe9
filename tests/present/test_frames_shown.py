"""Tools and fixtures in the report and in the recording."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.kept import assert_same_evidence
from support.pages import Page, section
from support.samples import (
    BASE_FROM_FIXTURE,
    DOUBT,
    DOUBTFUL_TOUCH,
    FLANGE_FROM_TOOL,
    WRONG_REASON,
    WRONG_TOUCH,
    Sample,
    fixture_frame,
    made_up,
    tool_frame,
    with_frames,
)

from visioncal.present.recording import (
    paths,
    read_calibration,
    read_evidence,
    write_recording,
)
from visioncal.present.recording.accuracy import SIGMAS_95
from visioncal.present.report.content import edge_facts
from visioncal.present.report.page import render
from visioncal.present.report.plots import frame_plot
from visioncal.results import Calibration, Frame, Verdict, to_document


@pytest.fixture(scope="module")
def sample() -> Sample:
    return with_frames(made_up())


@pytest.fixture(scope="module")
def page(sample: Sample) -> Page:
    return Page(render(sample.calibration, sample.session, sample.evidence))


@pytest.fixture(scope="module")
def recorded(sample: Sample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    write_recording(path, sample.session, sample.calibration, sample.evidence, None)
    return path


def with_frame(sample: Sample, frame: Frame) -> Calibration:
    return replace(sample.calibration, frames={"flange_from_tool": frame})


def of_frames(page: Page) -> str:
    return section(page, "Tools and fixtures", "Where the uncertainty comes from")


def of_tool(page: Page) -> str:
    return of_frames(page).partition("base_from_fixture")[0]


def test_frames_have_their_verdict_pose_and_origin(page):
    words = of_tool(page)
    assert re.search(r"flange_from_tool \S+ Check before use", words)
    assert f"Touch {WRONG_TOUCH} is not used: {WRONG_REASON}. Repeat it." in words
    assert "The pose of the tool in the frame of the flange." in words
    for value in FLANGE_FROM_TOOL.as_matrix().ravel():
        assert f"{value:.9f}" in words
    assert "method pivot about one point, axes from touches" in words
    assert "source touches <b>1</b>.csv" in words
    assert "created 2026-11-20 12:13 UTC" in words
    assert "observations 11 used of 12" in words
    assert "residual, rms 0.31 mm" in words
    assert "noise, per axis 0.21 mm" in words


def test_sigmas_are_along_the_axes_of_the_parent(sample):
    frame = sample.calibration.frames["flange_from_tool"]
    turn, covariance = frame.edge.matrix[:3, :3], frame.edge.covariance
    expected_mm = 1e3 * np.sqrt(np.diag(turn @ covariance[3:, 3:] @ turn.T))
    shown = [fact.note for fact in edge_facts("flange_from_tool", frame.edge)[:3]]
    found_mm = [float(re.search(r"[\d.]+", name)[0]) for name in shown]
    # Two digits are shown.
    np.testing.assert_allclose(found_mm, expected_mm, rtol=0.05)


def test_wrong_observations_are_named_and_red(sample, page):
    rows = [" ".join(row.split()) for row in page.rows]
    assert f"point {WRONG_TOUCH} not used {WRONG_REASON}" in rows
    assert f"point {DOUBTFUL_TOUCH} used {DOUBT}" in rows
    assert f"{WRONG_TOUCH} point 6.4 left out" in rows
    assert f"{DOUBTFUL_TOUCH} point 0.90 look" in rows
    assert any(re.fullmatch(r"11 point 0\.\d+ yes", row) for row in rows)
    html = render(sample.calibration, None, ())
    frames = html[html.index("Tools and fixtures</h2>") :]
    for mark in ("left-out", "look"):
        assert len(re.findall(f'<tr class="{mark}">', frames)) == 2
    # The bar of the wrong touch ends at the scale of the others and says how far it reaches.
    plot = str(frame_plot("tool", sample.calibration.frames["flange_from_tool"]))
    assert "var(--bad)" in plot
    assert ">6.4<" in plot


def test_a_rotation_that_was_not_measured_is_not_given_as_one(page):
    words = of_frames(page).partition("The pose of the fixture")[2]
    assert "rotation not measured taken as that of the robot's base" in words
    assert "rotation vector" not in words
    assert "sigma 0.15 mm 4" in words


def test_doubtful_frames_are_among_the_next_steps(sample):
    steps = [step.words for step in sample.calibration.next_steps]
    assert [step for step in steps if "flange_from_tool" in step]
    assert not [step for step in steps if "base_from_fixture" in step]
    good = replace(sample.calibration, verdict=Verdict("good"))
    assert "what was found of flange_from_tool" in good.next_steps[-1].words


def test_frames_without_observations_or_residuals_still_have_a_report(sample):
    bare = replace(tool_frame(), observations=(), details={}, verdict=Verdict("good"))
    words = of_frames(Page(render(with_frame(sample, bare), None, ())))
    assert "observations 0 used of 0" in words
    assert "off by" not in words
    seen = replace(
        fixture_frame(),
        observations=tuple(
            replace(observation, residual_mm=None) for observation in tool_frame().observations
        ),
    )
    words = of_frames(Page(render(with_frame(sample, seen), None, ())))
    assert "off by [mm]" not in words


def test_recordings_give_the_frames_back(sample, recorded):
    calibration = read_calibration(recorded)
    assert calibration is not None
    assert to_document(calibration) == to_document(sample.calibration)
    assert to_document(calibration)["frames"].keys() == sample.calibration.frames.keys()
    assert_same_evidence(sample.evidence, read_evidence(recorded))


def static(path: Path, entity: str, component: str) -> np.ndarray:
    """Reads one component that was logged once, for all views."""
    found = []
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            assert chunk.is_static
            found += [value for value in batch.column(component).to_pylist() if value is not None]
    (only,) = found
    return np.array(only)


@pytest.mark.parametrize(
    ("child", "parent", "expected"),
    [("tool", "flange", FLANGE_FROM_TOOL), ("fixture", "base", BASE_FROM_FIXTURE)],
)
def test_frames_hang_where_they_belong(recorded, child, parent, expected):
    entity = f"{paths.FRAMES}/{child}"
    assert static(recorded, entity, "Transform3D:parent_frame").tolist() == [parent]
    assert static(recorded, entity, "Transform3D:child_frame").tolist() == [child]
    place_m = static(recorded, entity, "Transform3D:translation")[0]
    # Columns first, as rerun keeps matrices.
    turn = static(recorded, entity, "Transform3D:mat3x3")[0].reshape(3, 3).T
    # Single precision of lengths under 1 m.
    np.testing.assert_allclose(place_m, expected.translation, atol=1e-6)
    np.testing.assert_allclose(turn, expected.rotation.as_matrix(), atol=1e-6)
    assert static(recorded, entity, "CoordinateFrame:frame").tolist() == [child]


def test_the_ellipsoid_holds_95_percent():
    points = np.random.default_rng(2).normal(size=(200_000, 3))
    # The share's standard deviation is 0.0005.
    assert np.mean(np.linalg.norm(points, axis=1) < SIGMAS_95) == pytest.approx(0.95, abs=0.002)


def test_exact_frames_have_no_ellipsoid(sample, tmp_path):
    frame = fixture_frame()
    exact = replace(frame, edge=replace(frame.edge, covariance=np.zeros((6, 6))))
    calibration = replace(sample.calibration, frames={"base_from_fixture": exact})
    write_recording(tmp_path / "cell.rrd", sample.session, calibration, sample.evidence, None)
    entities = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "cell.rrd").stream()}
    assert f"{paths.FRAMES}/fixture" in entities
    assert not [entity for entity in entities if entity.startswith(f"{paths.FRAMES}/fixture/")]

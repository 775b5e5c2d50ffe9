"""Tools and fixtures in the report and in the recording."""

import re

import numpy as np
import pytest
from support.drawn import column
from support.kept import assert_same_evidence
from support.samples import (
    BASE_FROM_FIXTURE,
    FLANGE_FROM_TOOL,
    made_up,
    with_frames,
)

from visioncal.present.recording import (
    paths,
    read_calibration,
    read_evidence,
    write_recording,
)
from visioncal.present.report.content import edge_facts
from visioncal.results import to_document


@pytest.fixture(scope="module")
def sample():
    return with_frames(made_up())


@pytest.fixture(scope="module")
def recorded(sample, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    write_recording(path, sample.session, sample.calibration, sample.evidence, None)
    return path


def test_sigmas_are_along_the_axes_of_the_parent(sample):
    frame = sample.calibration.frames["flange_from_tool"]
    turn, covariance = frame.edge.matrix[:3, :3], frame.edge.covariance
    expected_mm = 1e3 * np.sqrt(np.diag(turn @ covariance[3:, 3:] @ turn.T))
    shown = [fact.note for fact in edge_facts("flange_from_tool", frame.edge)[:3]]
    found_mm = [float(re.search(r"[\d.]+", name)[0]) for name in shown]
    # Two digits are shown.
    np.testing.assert_allclose(found_mm, expected_mm, rtol=0.05)


def test_recordings_give_the_frames_back(sample, recorded):
    calibration = read_calibration(recorded)
    assert calibration is not None
    assert to_document(calibration) == to_document(sample.calibration)
    assert to_document(calibration)["frames"].keys() == sample.calibration.frames.keys()
    assert_same_evidence(sample.evidence, read_evidence(recorded))


@pytest.mark.parametrize(
    ("child", "parent", "expected"),
    [("tool", "flange", FLANGE_FROM_TOOL), ("fixture", "base", BASE_FROM_FIXTURE)],
)
def test_frames_hang_where_they_belong(recorded, child, parent, expected):
    entity = f"{paths.FRAMES}/{child}"
    assert column(recorded, entity, "Transform3D:parent_frame")[0].tolist() == [parent]
    assert column(recorded, entity, "Transform3D:child_frame")[0].tolist() == [child]
    place_m = column(recorded, entity, "Transform3D:translation")[0][0]
    # Columns first, as rerun keeps matrices.
    turn = column(recorded, entity, "Transform3D:mat3x3")[0][0].reshape(3, 3).T
    # Single precision of lengths under 1 m.
    np.testing.assert_allclose(place_m, expected.translation, atol=1e-6)
    np.testing.assert_allclose(turn, expected.rotation.as_matrix(), atol=1e-6)
    assert column(recorded, entity, "CoordinateFrame:frame")[0].tolist() == [child]

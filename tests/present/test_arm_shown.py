"""The calibrated arm in the report and in the recording."""

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.arm_documents import calibrated, stays_stated, with_holdout
from support.drawn import column
from support.findings import with_findings
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import notes, paths, read_calibration, write_recording
from visioncal.present.viewer import blueprint
from visioncal.results import to_document


@pytest.fixture(scope="module")
def sample():
    return made_up()


def with_arm(sample, document):
    return with_findings(sample, {"kinematics": document})


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"levels": []}, "kinematics: level 'geometry' is not among the levels"),
        ({"level": "elastic"}, "kinematics: level 'elastic' is not among the levels"),
        ({"parameters": [{"joint": "a"}]}, r"kinematics.parameters\[0\].name is missing"),
        (["no table"], r"kinematics is \['no table'\]; a table is needed"),
    ],
)
def test_an_arm_that_cannot_be_read_is_named(sample, wrong, words):
    document = calibrated() | wrong if isinstance(wrong, dict) else wrong
    with pytest.raises(DataError, match=words):
        with_arm(sample, document)


def test_a_recording_tells_and_draws_the_arm(sample, tmp_path):
    calibration = with_arm(sample, with_holdout())
    path = tmp_path / "recording.rrd"
    layout = blueprint(sample.session, calibration)
    write_recording(path, sample.session, calibration, sample.evidence, layout)
    read = read_calibration(path)
    assert read is not None
    assert to_document(read) == to_document(calibration)
    entities = {str(chunk.entity_path) for chunk in RrdReader(path).stream()}
    assert paths.ARM_NOTE in entities
    assert "Arm" in [tab.name for tab in layout.root_container.contents]


def test_the_arm_is_drawn_as_calibrated(sample, tmp_path):
    path = tmp_path / "recording.rrd"
    calibration = with_arm(sample, calibrated())
    write_recording(path, sample.session, calibration, sample.evidence, None)
    q = sample.session.views[4].joints_rad
    ours = calibration.calibrated_robot.link_frames(q)[:, :3, 3]
    drawn = column(path, f"{paths.ROBOT}/links", "Capsules3D:translations")[4]
    np.testing.assert_allclose(drawn, [np.zeros(3), *ours[:-1]], atol=1e-6)


def test_a_stated_arm_has_no_tab_but_a_word(sample):
    calibration = with_arm(sample, stays_stated())
    layout = blueprint(sample.session, calibration)
    assert "Arm" not in [tab.name for tab in layout.root_container.contents]
    assert "The arm stays as stated" in notes.result_markdown("figures", calibration)

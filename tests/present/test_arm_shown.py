"""The calibrated arm in the report and in the recording."""

import re

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.arm_documents import calibrated, stays_stated, with_holdout
from support.drawn import column
from support.findings import with_findings
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import notes, paths, read_calibration, write_recording
from visioncal.present.recording.accuracy import ArmPicture
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
    wanted = (paths.ARM_NOTE, paths.WORKSPACE, paths.NOMINAL_ARM, paths.UNSEEN_MM)
    for entity in wanted:
        assert any(name.startswith(entity) for name in entities), entity
    assert "Arm" in [tab.name for tab in layout.root_container.contents]
    stated = column(path, f"{paths.UNSEEN_MM}/as_stated", "Scalars:scalars")
    held = column(path, f"{paths.UNSEEN_MM}/as_stated_held_back", "Scalars:scalars")
    assert (set(stated), set(held)) == ({0, 1, 2, 4, 5}, {7, 8})
    assert held[8] == pytest.approx([1.0])


def test_places_of_the_workspace_are_coloured_by_their_sigma(sample, tmp_path):
    path = tmp_path / "recording.rrd"
    document = calibrated()
    write_recording(path, sample.session, with_arm(sample, document), sample.evidence, None)
    entity = f"{paths.WORKSPACE}/sigma_of_a_tool_s_place"
    places = column(path, entity, "Points3D:positions")[0]
    given = [[value["x_m"], value["y_m"], value["z_m"]] for value in document["workspace_map"]]
    # Single precision of places within 2 m.
    np.testing.assert_allclose(places, given, atol=1e-6)
    shades = column(path, entity, "Points3D:colors")[0] >> 16 & 255
    greens = shades[np.argsort([value["sigma_mm"] for value in document["workspace_map"]])]
    # From violet to yellow: the greens of the worst are the brightest.
    assert greens[-5:].min() > greens[:20].max()
    assert column(path, f"{paths.WORKSPACE}/legend", "Points3D:labels")[0][0].endswith(" mm")


def test_the_arm_is_drawn_as_calibrated_and_the_stated_one_off_it(sample, tmp_path):
    path = tmp_path / "recording.rrd"
    calibration = with_arm(sample, calibrated())
    write_recording(path, sample.session, calibration, sample.evidence, None)
    q = sample.session.views[4].joints_rad
    ours = calibration.calibrated_robot.link_frames(q)[:, :3, 3]
    stated = calibration.robot.link_frames(q)[:, :3, 3]
    drawn = column(path, f"{paths.ROBOT}/links", "Capsules3D:translations")[4]
    np.testing.assert_allclose(drawn, [np.zeros(3), *ours[:-1]], atol=1e-6)
    picture = ArmPicture.of(sample.session, calibration, 1.0)
    assert picture is not None
    assert picture.factor > 1
    entities = {str(chunk.entity_path) for chunk in RrdReader(path).stream()}
    (entity,) = (entity for entity in entities if entity.startswith(paths.NOMINAL_ARM))
    factor = int(re.findall(r"(\d+)x", entity)[0])
    (strip,) = column(path, entity, "LineStrips3D:strips")[4]
    expected = [np.zeros(3), *(ours + factor * (stated - ours))]
    # Single precision; the sample's flange is the robot's own.
    np.testing.assert_allclose(strip, expected, atol=1e-5)


def test_a_stated_arm_has_no_tab_but_a_word(sample):
    calibration = with_arm(sample, stays_stated())
    layout = blueprint(sample.session, calibration)
    assert "Arm" not in [tab.name for tab in layout.root_container.contents]
    assert "No level was taken" in notes.result_markdown("figures", calibration)
    assert ArmPicture.of(sample.session, calibration, 1.0) is None

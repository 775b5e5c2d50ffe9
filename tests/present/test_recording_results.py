"""Results in recordings: exact, appended without a touch to what is there, the last one counts."""

import random
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning
from support.kept import (
    KEPT,
    assert_same,
    assert_same_evidence,
    cells,
    kept_calibration,
    kept_evidence,
)
from support.samples import Sample, made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import (
    RecordingWriter,
    append_results,
    paths,
    read_calibration,
    read_evidence,
    read_session,
    write_recording,
)
from visioncal.present.recording.frames import scan
from visioncal.present.viewer import blueprint
from visioncal.results import Calibration, Verdict, to_document


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made_up()


@pytest.fixture
def captured(sample: Sample, tmp_path: Path) -> Path:
    """A recording as a capture leaves it: without a result."""
    path = tmp_path / "captured.rrd"
    with RecordingWriter(path, sample.session, announced=9) as writer:
        for view in sample.session.views:
            writer.add_view(cells(sample.session, view), sample.session.images.read(view.image))
    return path


def test_results_come_back_exactly(sample: Sample, tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    # In another order than the views': the report goes by it.
    evidence = sample.evidence[::-1]
    write_recording(path, sample.session, sample.calibration, evidence, None)
    calibration = read_calibration(path)
    assert calibration is not None
    sample.calibration.save(tmp_path / "calibration.json")
    alone = Calibration.load(tmp_path / "calibration.json")
    assert to_document(calibration) == to_document(alone)
    assert_same_evidence(evidence, read_evidence(path))


def test_results_of_the_kept_recording_open() -> None:
    kept = KEPT / "recording_format_2.rrd"
    calibration = read_calibration(kept)
    assert calibration is not None
    ours, theirs = to_document(kept_calibration()), to_document(calibration)
    # The version is that of the program that writes the document.
    assert {**theirs, "visioncal": ""} == {**ours, "visioncal": ""}
    assert_same_evidence(kept_evidence(), read_evidence(kept))


def test_session_alone_has_no_results(captured: Path) -> None:
    assert read_calibration(captured) is None
    assert read_evidence(captured) == ()


def test_results_are_appended_and_the_last_one_counts(sample: Sample, captured: Path) -> None:
    before = captured.read_bytes()[: scan(captured).end]
    layout = blueprint(sample.session)
    append_results(captured, sample.session, sample.calibration, sample.evidence, layout)
    better = replace(sample.calibration, verdict=Verdict("good"))
    append_results(captured, sample.session, better, sample.evidence[:4])
    assert captured.read_bytes().startswith(before)
    calibration = read_calibration(captured)
    assert calibration is not None
    assert calibration.verdict.status == "good"
    assert_same_evidence(sample.evidence[:4], read_evidence(captured))
    session = read_session(captured)
    assert_same(sample.session, session)
    assert session.warnings == sample.session.warnings
    assert list(captured.parent.iterdir()) == [captured]


def test_rerun_reads_what_was_appended_as_one_recording(sample: Sample, captured: Path) -> None:
    layout = blueprint(sample.session)
    append_results(captured, sample.session, sample.calibration, sample.evidence, layout)
    with warnings.catch_warnings():
        # What was appended is not in the footer, so there is none any more.
        warnings.simplefilter("ignore", RerunWarning)
        reader = RrdReader(captured)
    assert len(reader.recordings()) == 1
    assert len(reader.blueprints()) == 1
    entities = {chunk.entity_path for chunk in reader.stream()}
    assert {paths.IMAGE, paths.CALIBRATION, paths.DETECTED} <= entities


def test_interrupted_append_leaves_the_results_before(sample: Sample, captured: Path) -> None:
    append_results(captured, sample.session, sample.calibration, sample.evidence)
    first = captured.stat().st_size
    better = replace(sample.calibration, verdict=Verdict("good"))
    append_results(captured, sample.session, better, sample.evidence[:4])
    data = captured.read_bytes()
    rng = random.Random(6)
    for size in [first + 1, *(rng.randrange(first, len(data)) for _ in range(8))]:
        captured.write_bytes(data[:size])
        assert_same(sample.session, read_session(captured))
        calibration = read_calibration(captured)
        assert calibration is not None
        assert calibration.verdict == sample.calibration.verdict
        assert_same_evidence(sample.evidence, read_evidence(captured))
    # What was cut is dropped by the next one.
    append_results(captured, sample.session, better, ())
    assert read_evidence(captured) == ()
    assert read_session(captured).warnings == sample.session.warnings


def test_results_of_another_session_are_refused(sample: Sample, captured: Path) -> None:
    before = captured.read_bytes()
    other = made_up(5)
    with pytest.raises(DataError, match="holds 9 views"):
        append_results(captured, other.session, other.calibration, other.evidence)
    with pytest.raises(DataError, match="The evidence names view 9"):
        append_results(captured, sample.session, None, [replace(sample.evidence[0], view=9)])
    assert captured.read_bytes() == before


def test_changed_result_is_noticed(sample: Sample, captured: Path) -> None:
    append_results(captured, sample.session, sample.calibration, sample.evidence)
    data = captured.read_bytes()
    assert data.count(b"2026-11-20T10:11:12") == 1
    captured.write_bytes(data.replace(b"2026-11-20T10:11:12", b"2026-11-20T10:11:13"))
    with pytest.raises(DataError, match="its last result was changed"):
        read_calibration(captured)
    assert_same(sample.session, read_session(captured))

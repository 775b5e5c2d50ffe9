"""Results in recordings: exact, and of several the last one counts."""

import random
from dataclasses import replace
from pathlib import Path

import pytest
from support.kept import (
    assert_same,
    assert_same_evidence,
    cells,
)
from support.samples import Sample, made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import (
    RecordingWriter,
    read_calibration,
    read_evidence,
    read_session,
    write_recording,
)
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


def with_results(path: Path, sample: Sample, *results) -> list[int]:
    """Records a session with some results, each with its evidence; the sizes after each."""
    sizes = []
    with RecordingWriter(path, sample.session, announced=9) as writer:
        writer.add_session(sample.session)
        for calibration, evidence in results:
            writer.add_results(sample.session, calibration, evidence)
            sizes.append(path.stat().st_size)
    return sizes


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


def test_session_alone_has_no_results(captured: Path) -> None:
    assert read_calibration(captured) is None
    assert read_evidence(captured) == ()


def test_the_last_one_of_several_results_counts(sample: Sample, tmp_path: Path) -> None:
    better = replace(sample.calibration, verdict=Verdict("good"))
    path = tmp_path / "recording.rrd"
    sizes = with_results(
        path, sample, (sample.calibration, sample.evidence), (better, sample.evidence[:4])
    )
    calibration = read_calibration(path)
    assert calibration is not None
    assert calibration.verdict.status == "good"
    assert_same_evidence(sample.evidence[:4], read_evidence(path))
    session = read_session(path)
    assert_same(sample.session, session)
    assert session.warnings == sample.session.warnings
    # Where the second one is cut, the first one counts.
    data = path.read_bytes()
    rng = random.Random(6)
    for size in [sizes[0] + 1, *(rng.randrange(sizes[0], sizes[1]) for _ in range(8))]:
        path.write_bytes(data[:size])
        assert_same(sample.session, read_session(path))
        calibration = read_calibration(path)
        assert calibration is not None
        assert calibration.verdict == sample.calibration.verdict
        assert_same_evidence(sample.evidence, read_evidence(path))


def test_evidence_of_other_views_is_refused(sample: Sample, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="The evidence names view 9"):
        with_results(
            tmp_path / "recording.rrd", sample, (None, [replace(sample.evidence[0], view=9)])
        )


def test_changed_result_is_noticed(sample: Sample, tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    with_results(path, sample, (sample.calibration, sample.evidence))
    data = path.read_bytes()
    assert data.count(b"2026-11-20T10:11:12") == 1
    path.write_bytes(data.replace(b"2026-11-20T10:11:12", b"2026-11-20T10:11:13"))
    with pytest.raises(DataError, match="its last result was changed"):
        read_calibration(path)
    assert_same(sample.session, read_session(path))

"""Reads the result and its evidence of a recording."""

from pathlib import Path

from visioncal.present.recording import codec, paths
from visioncal.present.recording.stored import record_of
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence


def read_calibration(path: Path) -> Calibration | None:
    """Reads the result of a recording.

    Returns:
        The result; None if there is none.

    Raises:
        DataError: The file cannot be read, or the result is damaged.
    """
    record = record_of(path, paths.CALIBRATION)
    text = record and record["calibration"]
    return Calibration.from_json(text, str(path)) if text else None


def read_evidence(path: Path) -> tuple[ViewEvidence, ...]:
    """Reads the evidence of the views, exactly as it was written.

    Returns:
        The evidence in its original order; empty if there is none.

    Raises:
        DataError: The file cannot be read, or the evidence is damaged.
    """
    record = record_of(path, paths.CALIBRATION)
    return () if record is None else codec.evidence_of(record)

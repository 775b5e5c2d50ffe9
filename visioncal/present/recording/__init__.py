"""Recordings: a session and its results in one `.rrd`, which the rerun viewer opens.

The facts of the session lie in it without loss, beside what is drawn of them; see `codec`. What was
changed or cut off after it was written is noticed; see `frames`.
"""

from visioncal.present.recording.reader import read_session
from visioncal.present.recording.results import read_calibration, read_evidence
from visioncal.present.recording.writer import RecordingWriter, write_recording

__all__ = [
    "RecordingWriter",
    "read_calibration",
    "read_evidence",
    "read_session",
    "write_recording",
]

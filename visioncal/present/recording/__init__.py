"""Recordings: a session and its results in one `.rrd` file, which the rerun viewer opens.

The session's data is stored without loss beside its drawing; see `codec`. Changes and truncation
after writing are detected; see `rrd_messages`.
"""

from visioncal.present.recording.reader import read_calibration, read_evidence
from visioncal.present.recording.writer import write_recording

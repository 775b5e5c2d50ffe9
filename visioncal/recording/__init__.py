"""Recordings: a session and its results in one `.rrd`, which the rerun viewer opens.

The facts of the session lie in it without loss, beside what is drawn of them; see `codec`.
"""

from visioncal.recording.codec import read_session
from visioncal.recording.writer import write_recording

__all__ = ["read_session", "write_recording"]

"""Rerun streams that write to a file, with a check that the data was written."""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from threading import Thread
from typing import Any, Self, TypeAlias

import numpy as np
import rerun as rr
from rerun.blueprint import BlueprintLike
from rerun_bindings import flush_and_cleanup_orphaned_recordings

from visioncal.core.errors import DataError
from visioncal.present.recording import paths
from visioncal.present.recording.rrd_messages import scan

# Place on a timeline: the view's row, or a time on that of motions.
Row: TypeAlias = int | np.timedelta64

# Free space that one more view and the end of the file need at most.
_ROOM_BYTES = 100_000_000
# Timeout of a flush [s]. Without it, a flush never returns once rerun's writer has ended, as on a
# full disk.
_WRITTEN_S = 30.0


class Recorder:
    """A rerun stream that writes to a file.

    Attributes:
        stream: Stream to log to.
    """

    def __init__(self, path: Path) -> None:
        """Starts the file.

        Args:
            path: The `.rrd`; an existing file is replaced.

        Raises:
            OSError: The file cannot be created.
        """
        self._path, self._is_lost = path, False
        self.stream = rr.RecordingStream(paths.APPLICATION)
        _check_room(path.parent)
        try:
            self.stream.save(path)
        except RuntimeError as error:
            # This is how rerun reports a file that it cannot create.
            raise OSError(str(error)) from error

    def lay_out(self, blueprint: BlueprintLike | None) -> None:
        """Adds the viewer layout of the recording, if there is one.

        It is made active because a browser has started to draw by the time it arrives.
        """
        if blueprint is not None:
            self.stream.send_blueprint(blueprint, make_active=True, make_default=True)

    def at(self, row: int) -> None:
        """Sets the row (the view's index in the session) of what is logged next; raises OSError."""
        _check_room(self._path.parent)
        self.stream.set_time(paths.TIMELINE, sequence=row)

    def keep(self) -> None:
        """Flushes to the operating system; raises OSError."""
        try:
            self.stream.flush(timeout_sec=_WRITTEN_S)
        except (RuntimeError, ValueError) as error:
            self._is_lost = True
            raise OSError(f"the disk may be full, or files may not be so large: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Writes the end of the file, and waits until it is on the disk; raises OSError."""
        ending = Thread(target=_end, args=(self.stream,), daemon=True)
        ending.start()
        ending.join(0.0 if self._is_lost else _WRITTEN_S)
        if ending.is_alive():
            # Python's exit would wait for it as well.
            rr.unregister_shutdown()
        if kind is not None:
            return
        # Rerun does not raise when it could not write.
        try:
            scan(self._path)
        except DataError as error:
            raise OSError("its end is missing; the disk may be full") from error
        with self._path.open("r+b") as file:
            os.fsync(file.fileno())


def _end(stream: rr.RecordingStream) -> None:
    """Ends a stream, and the threads of streams to which nobody refers any more.

    Rerun keeps two threads a stream until the process ends: thousands in a fleet's.
    """
    stream.disconnect()
    flush_and_cleanup_orphaned_recordings()


def send_rows(
    stream: rr.RecordingStream,
    entity: str,
    rows: Iterable[Row],
    columns: Iterable[rr.ComponentColumn],
    timeline: str = paths.TIMELINE,
) -> None:
    """Logs an entity for many views, by row, in one message, whatever the stream's time.

    This takes a tenth of the time of single messages. Each component has one partition per view.
    """
    is_time = timeline == paths.MOTION_TIMELINE
    unit: dict[str, Any] = {"duration" if is_time else "sequence": rows}
    time = rr.TimeColumn(timeline, **unit)
    rr.send_columns(entity, [time], columns, recording=stream)


def _check_room(folder: Path) -> None:
    """Raises early: on a full disk, rerun's thread dies and waiting for it hangs."""
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < _ROOM_BYTES:
        raise OSError(f"{free_bytes / 1e6:.0f} MB are free, but must be {_ROOM_BYTES / 1e6:.0f}")

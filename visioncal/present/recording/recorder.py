"""Opens a stream of rerun that writes to a file, and finds out whether it could."""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from threading import Thread
from typing import Self

import rerun as rr
from rerun.blueprint import BlueprintLike

from visioncal.present.recording import paths
from visioncal.present.recording.frames import scan

# Room for one more view, however large its image, and for the end of the file.
_ROOM_BYTES = 100_000_000
# So long rerun may take to write what was logged last [s]. Where its writer has ended, as on a full
# disk, it would be waited for without end.
_WRITTEN_S = 30.0


class Recorder:
    """A stream of rerun that writes to a file.

    Attributes:
        stream: Where to log.
    """

    def __init__(self, path: Path) -> None:
        """Begins the file.

        Args:
            path: The `.rrd`; one that is there is replaced.

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
        """Adds the layout to open the recording in, if there is one.

        It is a hundred kilobytes, and comes after the facts: a cut within it loses none of them.
        It is made active because a browser has begun to draw by the time it arrives.
        """
        if blueprint is not None:
            self.stream.send_blueprint(blueprint, make_active=True, make_default=True)
            # Not between the parts of what comes next.
            self.keep()

    def at(self, row: int) -> None:
        """Says which view is logged next, by its place in the session.

        Raises:
            OSError: There is too little room for another view.
        """
        _check_room(self._path.parent)
        self.stream.set_time(paths.TIMELINE, sequence=row)

    def keep(self) -> None:
        """Hands what was logged to the operating system: it survives the death of the process.

        Raises:
            OSError: It could not be written.
        """
        try:
            self.stream.flush(timeout_sec=_WRITTEN_S)
        except (RuntimeError, ValueError) as error:
            self._is_lost = True
            raise OSError(f"the disk may be full, or files may not be so large: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Writes the end of the file, and waits until it is on the disk.

        Raises:
            OSError: The file could not be written.
        """
        ending = Thread(target=self.stream.disconnect, daemon=True)
        ending.start()
        ending.join(0.0 if self._is_lost else _WRITTEN_S)
        if ending.is_alive():
            # It would be waited for when Python ends, too.
            rr.unregister_shutdown()
        if kind is not None:
            return
        # Rerun only prints that it could not write.
        if not scan(self._path).finished:
            raise OSError("its end is missing; the disk may be full")
        with self._path.open("r+b") as file:
            os.fsync(file.fileno())


def send_rows(
    stream: rr.RecordingStream,
    entity: str,
    rows: Iterable[int],
    columns: Iterable[rr.ComponentColumn],
) -> None:
    """Logs what an entity shows in many views as one message, whatever the stream's time is.

    A tenth of the time that as many messages take.

    Args:
        stream: Where to.
        entity: What is shown.
        rows: The places of the views in the session.
        columns: Of each component, a part a view.
    """
    time = rr.TimeColumn(paths.TIMELINE, sequence=rows)
    rr.send_columns(entity, [time], columns, recording=stream)


def _check_room(folder: Path) -> None:
    """Stops in time: on a full disk, rerun's own thread dies and whoever waits for it hangs."""
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < _ROOM_BYTES:
        raise OSError(f"{free_bytes / 1e6:.0f} MB are free, {_ROOM_BYTES / 1e6:.0f} are needed")

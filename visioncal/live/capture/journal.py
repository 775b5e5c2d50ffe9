"""Storage of views on disk: each is complete and flushed before the next one is taken."""

import errno
import json
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import tomli_w

from visioncal.core.errors import DataError
from visioncal.core.files import flush_folder, named_errors, read_bytes, read_toml, write_atomically
from visioncal.core.temporary_files import remove_abandoned
from visioncal.core.version import __version__
from visioncal.live.capture.facts import CaptureFacts, view_of
from visioncal.live.capture.take import TakenView
from visioncal.session import Session, View
from visioncal.session.table import write_csv

# File that names devices and plan; written before the first view.
PROVENANCE = "recorded.toml"
_IMAGES, _TABLE = "images", "views.csv"
# Low compression: noise hardly compresses, and speed matters more.
_PNG_EFFORT = 1
# Reserve for tables, folders and the disk's own use.
_SPARE_BYTES = 256_000
# Length of a digest, which messages shorten.
_DIGEST = 64


class Journal:
    """Session folder that grows view by view.

    The table of views is replaced atomically for each view, after its image is on the disk: at any
    moment the folder holds a session of all acknowledged views, or, before the first, none. If the
    process is killed, at most the view that is being written is lost.
    """

    def __init__(self, folder: Path, facts: CaptureFacts, unix_offset_s: float) -> None:
        """Uses a folder that `begin` or `resume` has prepared."""
        self.folder = folder
        self.views: tuple[View, ...] = ()
        self._columns: tuple[str, ...] = ()
        self._facts, self._offset_s = facts, unix_offset_s

    @classmethod
    def begin(
        cls, folder: Path, facts: CaptureFacts, unix_offset_s: float, views: int
    ) -> "Journal":
        """Begins a session in a new or empty folder.

        Args:
            folder: The folder.
            facts: Facts of the recording.
            unix_offset_s: Offset from the host's monotonic clock to UNIX time [s].
            views: Number of views to come; 0 where it is not known.

        Raises:
            DataError: The folder holds something, cannot be written, or has no room for the views.
        """
        with named_errors(folder):
            occupied = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
        if occupied:
            recorded = (folder / PROVENANCE).is_file()
            raise DataError(
                f"{folder} exists and is not empty; a session is recorded into a new folder.",
                culprits=[str(folder)],
                next_step="Go on with its recording by --resume, or choose another name."
                if recorded
                else "Choose another name.",
            )
        journal = cls(folder, facts, unix_offset_s)
        with named_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        width, height = facts.resolution
        journal._check_room(views * width * height, f"{views} views")
        with named_errors(folder):
            (folder / _IMAGES).mkdir(exist_ok=True)
        document = {"visioncal": __version__, **facts.provenance(), "settings": facts.settings}
        journal._write(PROVENANCE, tomli_w.dumps(document))
        return journal

    @classmethod
    def resume(
        cls, folder: Path, facts: CaptureFacts, unix_offset_s: float, views: int
    ) -> "Journal":
        """Resumes a session, or begins it where nothing was recorded; arguments are as for `begin`.

        Partly written files of a killed process are removed.

        Raises:
            DataError: The folder holds another recording, or something else.
        """
        path = folder / PROVENANCE
        for place in (folder, folder / _IMAGES):
            remove_abandoned(place)
        if not path.is_file():
            with named_errors(folder), suppress(FileNotFoundError):
                (folder / _IMAGES).rmdir()
            return cls.begin(folder, facts, unix_offset_s, views)
        _check_same(read_toml(path, str(path)), facts, folder)
        journal = cls(folder, facts, unix_offset_s)
        with named_errors(folder):
            (folder / _IMAGES).mkdir(exist_ok=True)
        if (folder / _TABLE).is_file():
            session = Session.load(folder)
            journal.views, journal._columns = session.views, session.columns
        return journal

    def append(self, number: int, taken: TakenView) -> View:
        """Writes a view; when this returns, it is flushed to the disk.

        Raises:
            DataError: It cannot be written; the session is unchanged.
        """
        image = f"{_IMAGES}/{number:03d}.png"
        view = view_of(number, image, taken, self._facts, self._offset_s)
        _, png = cv2.imencode(".png", taken.frame.image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_EFFORT])
        data = png.tobytes()
        self._check_room(len(data), f"view {number}")
        self._write(image, data)
        if not self.views:
            for name, text in self._facts.texts().items():
                self._write(name, text)
        views = (*self.views, view)
        columns = self._columns or _columns(view)
        self._write(_TABLE, write_csv(columns, views))
        self.views, self._columns = views, columns
        return view

    def check_room(self) -> None:
        """Checks that the disk has room for one more view.

        Raises:
            DataError: It has not.
        """
        width, height = self._facts.resolution
        self._check_room(width * height, "the next view")

    def image(self, view: View) -> bytes:
        """Reads the image of a view that is on the disk."""
        return read_bytes(self.folder / view.image)

    def _write(self, name: str, data: bytes | str) -> None:
        path = self.folder / name
        try:
            write_atomically(path, data)
            with named_errors(path):
                flush_folder(path.parent)
        except DataError as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
                raise self._full(len(data), path.name) from error
            raise

    def _check_room(self, needed: int, what: str) -> None:
        with named_errors(self.folder):
            free = shutil.disk_usage(self.folder).free
        if free < needed + _SPARE_BYTES:
            raise self._full(needed, what)

    def _full(self, needed: int, what: str) -> DataError:
        free = shutil.disk_usage(self.folder).free
        return DataError(
            f"{self.folder}: too little room: {free / 1e6:.1f} MB are free, and "
            f"{(needed + _SPARE_BYTES) / 1e6:.1f} MB are needed for {what}.",
            culprits=[str(self.folder)],
            next_step="Make room on that disk and go on with --resume.",
        )


def _columns(view: View) -> tuple[str, ...]:
    return ("view", "image", *view.numbers, *view.text)


def _check_same(before: dict[str, Any], facts: CaptureFacts, folder: Path) -> None:
    """Refuses to resume a recording of other devices or another plan."""
    now = facts.provenance()
    differ = [name for name, value in now.items() if before.get(name) != value]
    if not differ:
        return
    words = "; ".join(
        f"{name} was {_short(before.get(name))} and is {_short(now[name])}" for name in differ
    )
    raise DataError(
        f"{folder} was recorded of something else: {words}.",
        culprits=[f"{folder / PROVENANCE}: {name}" for name in differ],
        next_step="Go on with the same, or record into a new folder.",
    )


def _short(value: object) -> str:
    if isinstance(value, str) and len(value) == _DIGEST:
        return f"{value[:8]}..."
    return json.dumps(value) if value not in ("", None) else "none"

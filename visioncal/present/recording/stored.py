"""Reads the session of a recording, and its chunks."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pyarrow as pa

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.core.files import sha256
from visioncal.core.types import Searched
from visioncal.present.recording import codec, paths
from visioncal.present.recording.rrd_messages import (
    CHUNK,
    MessageFrame,
    read_payload,
    record_batch,
    scan,
)
from visioncal.session.images import MISSING, ImageStore
from visioncal.session.streams import Stream

_AGAIN = "Take the recording again from its origin, or calibrate the session's folder."
# Errors of chunks whose names or shapes were damaged in ways that Arrow cannot detect.
_DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError)


def session_content(path: Path) -> tuple[dict[str, Any], dict[str, Stream]]:
    """Reads the session of a recording.

    Returns:
        Arguments of `Session.assemble`, and the streams, of a session with the same data and the
        same digest as the one that was written. Its images are read on demand.

    Raises:
        DataError: The file is missing, is no recording of a session, was cut off, is of another
            format, or has damaged session data; the message names the image.
    """
    record = record_of(path, paths.SESSION)
    if record is None:
        raise DataError(
            f"{path} holds no session of visioncal.",
            culprits=[str(path)],
            next_step="Give the .rrd that visioncal wrote.",
        )
    names, kept = codec.image_names(record), cast("ImagesKept", record["images"])
    digests = dict(zip(names, record["digests"], strict=True))
    digests = {name: digest for name, digest in digests.items() if digest}
    places: dict[str, _Place] = {}
    for frame, _, batch in chunks(path, (paths.IMAGE,)):
        for row, position in codec.image_places(batch).items():
            # A damaged row number can be of any size.
            name = names[row] if 0 <= row < len(names) else ""
            if kept != "full" or sha256(codec.image_at(batch, position)) == digests.get(name):
                places[name] = _Place(frame, position)
    lost = [name for name in digests if kept == "full" and name not in places]
    if lost:
        what = f"the image {', '.join(lost)} cannot be read or does not match its SHA-256"
        raise _damaged(path, what, lost)
    searches = codec.searches_of(record)
    depths = {name: content.tobytes() for name, content in record.get("depths", {}).items()}
    images = RecordedImages(path, kept, digests, places, searches, depths)
    return codec.content_of(record, images)


def record_of(path: Path, entity: str) -> codec.Record | None:
    """The record of an entity; None if the file is no recording of visioncal's."""
    is_ours = False
    for _, found, batch in chunks(path, (paths.SESSION, paths.CALIBRATION)):
        is_ours = True
        try:
            record = codec.read_record(batch, path)
        except _DAMAGE:
            continue
        if found == entity:
            return record
    if is_ours:
        what = "session" if entity == paths.SESSION else "result"
        raise _damaged(path, f"its {what} cannot be read or was changed after it was written", [])
    return None


def chunks(
    path: Path, entities: Container[str]
) -> Iterator[tuple[MessageFrame, str, pa.RecordBatch]]:
    """Unpacks the readable chunks of some entities: message, entity path and rows of each."""
    for frame in scan(path):
        if frame.kind == CHUNK:
            try:
                chunk = record_batch(read_payload(path, frame), entities)
            except ValueError:
                continue
            if chunk is not None:
                yield frame, *chunk


def _damaged(path: Path, what: str, culprits: Sequence[str]) -> DataError:
    return DataError(
        f"{path} is damaged: {what}.", culprits=culprits or [str(path)], next_step=_AGAIN
    )


@dataclass(frozen=True)
class _Place:
    """Place of an image: a row of a chunk."""

    frame: MessageFrame
    position: int


@dataclass(frozen=True, eq=False)
class RecordedImages(ImageStore):
    """Images of a recording, which are read on demand; or what it keeps in their place."""

    path: Path  # The recording.
    kept: ImagesKept  # Their form in it, beside their digests.
    digests: Mapping[str, str]  # SHA-256 of the images' bytes, by name.
    places: Mapping[str, _Place]  # Places of the stored images or faint copies, by name.
    # Corners found in each image, by its name and that of the board in the session's `boards`.
    searches: Mapping[tuple[str, str], Searched]
    # Depth files, and the images beside them, by name.
    depths: Mapping[str, bytes] = field(default_factory=dict)

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image or depth file; raises DataError."""
        if path in self.depths:
            return self.depths[path]
        if path not in self.digests:
            raise DataError(f"The session has no image {path}.", culprits=[path])
        if self.kept != "full":
            raise DataError(
                f"{path} {self.absence(path)}.",
                culprits=[path],
                next_step="Take the session's folder, which has its images; calibrate --images "
                "full writes recordings with all of them.",
            )
        data = self._stored(path)
        if sha256(data) != self.digests[path]:
            raise self._replaced(path)
        return data

    def _stored(self, path: str) -> bytes:
        place = self.places[path]
        try:
            chunk = record_batch(read_payload(self.path, place.frame), (paths.IMAGE,))
            return b"" if chunk is None else codec.image_at(chunk[1], place.position)
        except _DAMAGE as error:
            raise self._replaced(path) from error

    def _replaced(self, path: str) -> DataError:
        return DataError(
            f"{self.path}: the image {path} no longer exists: the recording was changed or "
            "replaced since it was loaded.",
            culprits=[path],
            next_step="Load it again.",
        )

    def sha256(self, path: str) -> str:
        """Digest of an image's bytes; empty without an image."""
        return sha256(self.depths[path]) if path in self.depths else self.digests.get(path, "")

    def shown(self, path: str) -> bytes | None:
        """A faint copy of an image; None if there is none."""
        return self._stored(path) if self.kept == "thumbnail" and path in self.places else None

    def search_of(self, path: str, board: str) -> Searched | None:
        """Corners of a board in an image; None where it was not searched."""
        return self.searches.get((path, board))

    def absence(self, path: str) -> str:
        """Why the image cannot be read, in words; empty where it can."""
        if path in self.depths:
            return ""
        if path not in self.digests:
            return MISSING
        if self.kept == "full":
            return ""
        return f"is not in {self.path.name}, which was written with --images {self.kept}"

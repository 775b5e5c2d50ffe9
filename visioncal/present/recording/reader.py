"""Reads the session of a recording, also of a truncated one."""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import pyarrow as pa

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.core.files import parse_toml, sha256
from visioncal.core.types import Searched
from visioncal.present.recording import codec, paths
from visioncal.present.recording.rrd_messages import (
    CHUNK,
    MessageFrame,
    Scan,
    read_payload,
    record_batch,
    scan,
)
from visioncal.session import Session, Stream
from visioncal.session.corners import CornerTable
from visioncal.session.images import ImageStore

_AGAIN = "Take the recording again from its origin, or calibrate the session's folder."
_UNREADABLE = "cannot be read or was changed after it was written"
_SHOWN_ROWS = 10
_ELSEWHERE: Mapping[str, ImagesKept] = {"thumbnail": "thumbnail", "none": "none"}
# Errors of chunks whose names or shapes were damaged in ways that Arrow cannot detect.
_DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError)


def read_session(path: Path) -> Session:
    """Reads the session of a recording.

    Returns:
        The session, with the same data and the same digest as the one that was written. Its images
        are read on demand. If the recording was cut off, the session has its complete views, and a
        warning about what was lost.

    Raises:
        DataError: The file is missing, is no recording of a session, was cut off before its first
            view, is of another format, or has damaged session data; the message names the row or
            the image.
    """
    scanned = scan(path)
    records = _read_records(scanned)
    complete = _complete_rows(path, records)
    cells = [records.header.cells(records.rows[row]) for row in complete]
    seals = records.header.stream_seals
    damaged = [
        name
        for name, seal in seals.items()
        if name not in records.streams or codec.fact_seal(records.streams[name]) != seal
    ]
    if damaged:
        what = f"the stream {', '.join(damaged)} {_UNREADABLE}"
        raise _damaged(path, what, damaged)
    corners = records.corners
    if not records.header.corners:
        corners = None
    elif corners is None or codec.fact_seal(corners) != records.header.corners:
        what = "the corners of its views cannot be read or were changed after it was written"
        raise _damaged(path, what, ["corners"])
    else:
        view_column = records.header.columns.index("view")
        corners = corners.of_views([int(row[view_column]) for row in cells])
    session = Session.assemble(
        parse_toml(records.header.session_toml, "session.toml"),
        records.header.columns,
        cells,
        _images_of(path, records, complete),
        target_document=codec.from_json(records.header.target_json),
        robot_document=codec.from_json(records.header.robot_json),
        corners=corners,
    ).with_streams({name: records.streams[name] for name in seals})
    warnings = (*session.warnings, *_losses(scanned, records, len(complete)))
    return replace(session, warnings=warnings)


def _images_of(path: Path, records: "_Records", complete: Sequence[int]) -> ImageStore:
    """Images of complete rows, or the substitute for images that are stored elsewhere."""
    found = {records.image_name(at): records.images[at] for at in complete if at in records.images}
    images = RecordedImages(path, found)
    kept = _ELSEWHERE.get(records.header.images)
    if kept is None:
        return images
    digests = {
        records.image_name(index): digest
        for index in complete
        if (digest := records.rows[index].image_sha256)
    }
    pictures = {name: partial(images.read, name) for name in images.places}
    return ExternalImages(path, kept, digests, pictures, records.searches or {})


@dataclass(frozen=True)
class _Image:
    """Position of an image, as a row of a chunk, and the SHA-256 of its bytes."""

    frame: MessageFrame
    position: int
    digest: str


@dataclass(frozen=True, eq=False)
class RecordedImages(ImageStore):
    """Images that are read from a recording on demand."""

    path: Path  # The recording.
    places: Mapping[str, _Image]  # Position of each image in it, by name.

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file.

        Raises:
            DataError: There is no such image, or the recording has changed since it was loaded.
        """
        if path not in self.places:
            raise DataError(f"The session has no image {path}.", culprits=[path])
        image = self.places[path]
        changed = DataError(
            f"{self.path}: the image {path} is not there any more: the recording was changed or "
            "replaced since it was loaded.",
            culprits=[path],
            next_step="Load it again.",
        )
        try:
            chunk = record_batch(read_payload(self.path, image.frame), (paths.IMAGE,))
            data = b"" if chunk is None else codec.image_at(chunk[1], image.position)
        except _DAMAGE as error:
            raise changed from error
        if sha256(data) != image.digest:
            raise changed
        return data

    def sha256(self, path: str) -> str:
        """Digest of the bytes of an image; empty where there is none."""
        return self.places[path].digest if path in self.places else ""

    def absence(self, path: str) -> str:
        """Why there is no such image, in words; empty if there is one."""
        return "" if path in self.places else "is missing"


@dataclass(frozen=True, eq=False)
class _Records:
    """The records of a session's data."""

    header: codec.Header  # Data that holds for all rows.
    rows: Mapping[int, codec.StoredRow]  # Rows by number.
    images: Mapping[int, _Image]  # Images by row number.
    streams: Mapping[str, Stream]  # Streams by name.
    corners: CornerTable | None  # Corners of an external detector; None if there are none.
    # What was found in images, by their names and those of their boards; None where they are there.
    searches: Mapping[tuple[str, str], Searched] | None
    closed: int | None  # Number of rows by the end mark; None without the mark.
    damaged: int  # Number of chunks that could not be read.

    def image_name(self, row: int) -> str:
        cells = self.header.cells(self.rows[row])
        return dict(zip(self.header.columns, cells, strict=True))["image"]


def chunks(
    scanned: Scan, entities: Container[str], damaged: list[MessageFrame]
) -> Iterator[tuple[MessageFrame, str, pa.RecordBatch]]:
    """Unpacks the chunks of some entities in file order: message, entity path and rows of each.

    Messages that cannot be unpacked are appended to `damaged`.
    """
    for frame in scanned.frames:
        if frame.kind == CHUNK:
            try:
                chunk = record_batch(read_payload(scanned.path, frame), entities)
            except ValueError:
                damaged.append(frame)
                continue
            if chunk is not None:
                yield frame, *chunk


def _read_records(scanned: Scan) -> _Records:
    header: codec.Header | None = None
    rows: dict[int, codec.StoredRow] = {}
    images: dict[int, _Image] = {}
    streams: dict[str, Stream] = {}
    corners: CornerTable | None = None
    damaged: list[MessageFrame] = []
    closed: int | None = None
    searches: dict[tuple[str, str], Searched] | None = None
    entities = {paths.SESSION, paths.STREAMS, paths.CORNERS, paths.SEARCHES, paths.ROWS}
    entities |= {paths.IMAGE, paths.END}
    for frame, entity, batch in chunks(scanned, entities, damaged):
        try:
            if entity == paths.SESSION:
                header = codec.read_header(batch, scanned.path)
            elif entity == paths.STREAMS:
                streams |= codec.read_samples(batch)
            elif entity == paths.CORNERS:
                corners = codec.read_corners(batch)
            elif entity == paths.SEARCHES:
                searches = codec.read_searches(batch)
            elif entity == paths.ROWS:
                # Of two rows with one number, the later one has a damaged number.
                rows = codec.read_rows(batch) | rows
            elif entity == paths.IMAGE:
                images |= {
                    row: _Image(frame, position, sha256(codec.image_at(batch, position)))
                    for row, position in codec.image_places(batch).items()
                }
            else:
                closed = codec.read_end(batch)
        except _DAMAGE:
            damaged.append(frame)
    if header is None:
        raise _no_header(scanned, damaged)
    return _Records(header, rows, images, streams, corners, searches, closed, len(damaged))


def _no_header(scanned: Scan, damaged: Sequence[MessageFrame]) -> DataError:
    next_step = _AGAIN
    if damaged:
        problem = "is damaged: the session's declaration cannot be read"
    elif scanned.finished:
        problem = "holds no session of visioncal"
        next_step = "Give the .rrd that visioncal wrote."
    else:
        problem = "was cut off before the session's declaration was complete: no view is in it"
    return DataError(
        f"{scanned.path} {problem}.", culprits=[str(scanned.path)], next_step=next_step
    )


def _damaged(path: Path, what: str, culprits: Sequence[str]) -> DataError:
    return DataError(f"{path} is damaged: {what}.", culprits=culprits, next_step=_AGAIN)


def _complete_rows(path: Path, records: _Records) -> list[int]:
    """Numbers of the rows that are complete with their images."""
    # Views are written one after another: what is missing before the last trace of a view, or from
    # a closed recording, was damaged, not cut off.
    rows, images, closed = records.rows, records.images, records.closed
    # The last view of a recording that was cut off may lack its row or its image.
    written = max([*rows, *images], default=0) if closed is None else closed
    # A damaged row number can be very large.
    missing = [
        f"row {row + 1}"
        for row in islice((row for row in range(written) if row not in rows), _SHOWN_ROWS)
    ]
    if missing:
        raise _damaged(path, f"{', '.join(missing)} of the table {_UNREADABLE}", missing)
    if records.header.images:
        return sorted(rows)
    absent = [row for row in rows if rows[row].image_sha256 and row not in images]
    changed = [
        row for row in rows if row in images and images[row].digest != rows[row].image_sha256
    ]
    changed += [row for row in absent if row < written]
    if changed:
        names = [records.image_name(row) for row in sorted(changed)]
        what = f"the image {', '.join(names)} cannot be read or does not match its SHA-256"
        raise _damaged(path, what, names)
    return sorted(set(rows) - set(absent))


def _losses(scanned: Scan, records: _Records, complete: int) -> Iterator[str]:
    """Sentences about what was lost from the recording."""
    name, announced = scanned.path.name, records.header.rows
    has_images = any(row.image_sha256 for row in records.rows.values())
    if records.header.images and has_images and not records.searches:
        yield f"{name}: the images are elsewhere, and only their digests are kept."
    if records.closed is not None:
        if scanned.cut:
            yield (
                f"{name}: the end of the file is missing; all {complete} views are there, but "
                "results that were added last may not be."
            )
    elif announced == codec.UNKNOWN:
        with_image = {key for key, row in records.rows.items() if row.image_sha256}
        is_begun = not records.header.images and with_image != set(records.images)
        lost = " A view that had been begun is lost." if scanned.cut or is_begun else ""
        yield (
            f"{name}: the recording was not closed: its writer was stopped, or the file was cut "
            f"off. {complete} views are complete.{lost}"
        )
    elif complete < announced:
        yield (
            f"{name}: the recording was not closed, or was cut off: {announced - complete} of "
            f"{announced} views are lost, {complete} are complete."
        )
    else:
        yield (f"{name}: the recording was not closed, but all {announced} views are complete.")
    if records.damaged:
        yield (
            f"{name}: {records.damaged} of its messages cannot be read. The session is whole; what "
            "is drawn of it, or its results, may not be."
        )


@dataclass(frozen=True, eq=False)
class ExternalImages(ImageStore):
    """Images of a session whose recording was written without them."""

    path: Path  # The recording.
    kept: ImagesKept  # What the recording stores of them: `thumbnail` or `none`.
    digests: Mapping[str, str]  # SHA-256 of the images' bytes, by name.
    pictures: Mapping[str, Callable[[], bytes]]  # Readers of the faint copies, by image name.
    # What was found in each image, by its name and that of the board in the session's `boards`.
    searches: Mapping[tuple[str, str], Searched]

    def read(self, path: str) -> bytes:
        """Raises an error: the image is not in the recording.

        Raises:
            DataError: Always.
        """
        raise DataError(
            f"{path} {self.absence(path)}.",
            culprits=[path],
            next_step="Take the session's folder, which has its images; calibrate --images full "
            "writes recordings with all of them.",
        )

    def sha256(self, path: str) -> str:
        """Digest of an image's bytes; empty without an image."""
        return self.digests.get(path, "")

    def shown(self, path: str) -> bytes | None:
        """A faint copy of an image; None if there is none."""
        return self.pictures[path]() if path in self.pictures else None

    def search_of(self, path: str, board: str) -> Searched | None:
        """What was found of a board in an image; None where it was not searched."""
        return self.searches.get((path, board))

    def absence(self, path: str) -> str:
        """Why the image cannot be read, in words."""
        if path not in self.digests:
            return "is missing"
        return f"is not in {self.path.name}, which was written with --images {self.kept}"

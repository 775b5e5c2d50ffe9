"""Reads the session that a recording holds, also where the recording was cut off."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import pyarrow as pa

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.core.files import parse_toml, sha256
from visioncal.present.recording import codec, paths
from visioncal.present.recording.elsewhere import ImagesElsewhere
from visioncal.present.recording.frames import (
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
_SHOWN_ROWS = 10
_ELSEWHERE: Mapping[str, ImagesKept] = {"thumbnail": "thumbnail", "none": "none"}
# What a chunk can raise whose names or shapes were damaged in a way that Arrow cannot notice.
_DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError)


def read_session(path: Path) -> Session:
    """Reads the session that a recording holds.

    Returns:
        The session, with the same facts and the same digest as the one that was written. Its
        images are read when they are asked for. Where the recording was cut off, the session has
        the views that are complete, and a warning that says what was lost.

    Raises:
        DataError: The file is missing, is no recording of a session, was cut off before its first
            view, is of a newer format, or is damaged where the session's facts are; the message
            names the row or the image.
    """
    scanned = scan(path)
    records = _read_records(scanned)
    complete = _complete_rows(path, records)
    cells = [records.header.cells(records.rows[row]) for row in complete]
    session = Session.assemble(
        parse_toml(records.header.session_toml, "session.toml"),
        records.header.columns,
        cells,
        _images_of(path, records, complete),
        target_document=codec.from_json(records.header.target_json),
        robot_document=codec.from_json(records.header.robot_json),
        corners=_corners_of(path, records, cells),
    ).with_streams(_whole_streams(path, records))
    warnings = (*session.warnings, *_losses(scanned, records, len(complete)))
    return replace(session, warnings=warnings)


def _images_of(path: Path, records: "_Records", complete: Sequence[int]) -> ImageStore:
    """The images of these rows, or what there is of those that are elsewhere."""
    images = RecordedImages(path, records.images_by_name(complete))
    kept = _ELSEWHERE.get(records.header.images)
    if kept is None:
        return images
    digests = {records.image_name(index): records.rows[index].image_sha256 for index in complete}
    pictures = {name: partial(images.read, name) for name in images.places}
    return ImagesElsewhere(
        path, kept, {k: digest for k, digest in digests.items() if digest}, pictures
    )


@dataclass(frozen=True)
class _Image:
    """Where an image is: a row of a chunk. And the SHA-256 of its bytes."""

    frame: MessageFrame
    place: int
    digest: str


@dataclass(frozen=True, eq=False)
class RecordedImages(ImageStore):
    """Images that stay in a recording until they are asked for.

    Attributes:
        path: The recording.
        places: Where in it they are, by name.
    """

    path: Path
    places: Mapping[str, _Image]

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file.

        Raises:
            DataError: There is no such image, or the recording is not what it was any more.
        """
        if path not in self.places:
            raise DataError(f"The session has no image {path}.", culprits=[path])
        image = self.places[path]
        moved = DataError(
            f"{self.path}: the image {path} is not there any more: the recording was changed or "
            "replaced since it was loaded.",
            culprits=[path],
            next_step="Load it again.",
        )
        try:
            found = record_batch(read_payload(self.path, image.frame), (paths.IMAGE,))
            data = b"" if found is None else codec.image_at(found[1], image.place)
        except _DAMAGE as error:
            raise moved from error
        if sha256(data) != image.digest:
            raise moved
        return data

    def sha256(self, path: str) -> str:
        """Digest of the bytes of an image; empty where there is none."""
        return self.places[path].digest if path in self.places else ""

    def absence(self, path: str) -> str:
        """Says why there is no such image; empty where there is one."""
        return "" if path in self.places else "is missing"


@dataclass(frozen=True, eq=False)
class _Records:
    """What was found of a session.

    Attributes:
        header: What holds for all rows.
        rows: The rows, by their places in the session.
        images: The images, by the places of their rows.
        streams: What was read many times a second, by name.
        corners: The corners that another detector found; None where they were not found.
        closed: How many rows there are by the mark behind the last one; None without the mark.
        damaged: How many chunks could not be read.
    """

    header: codec.Header
    rows: Mapping[int, codec.StoredRow]
    images: Mapping[int, _Image]
    streams: Mapping[str, Stream]
    corners: CornerTable | None
    closed: int | None
    damaged: int

    @property
    def begun(self) -> bool:
        """Whether the last view lacks its row or its image."""
        if self.header.images:
            return False
        with_image = {key for key, row in self.rows.items() if row.image_sha256}
        return with_image != set(self.images)

    def image_name(self, row: int) -> str:
        """The name of the image of a row."""
        cells = self.header.cells(self.rows[row])
        return dict(zip(self.header.columns, cells, strict=True))["image"]

    def images_by_name(self, rows: Sequence[int]) -> dict[str, _Image]:
        """The images of these rows."""
        return {self.image_name(row): self.images[row] for row in rows if row in self.images}


def chunks(
    scanned: Scan, entities: Container[str], damaged: list[MessageFrame]
) -> Iterator[tuple[MessageFrame, str, pa.RecordBatch]]:
    """Unpacks the chunks of some entities, in the order of the file.

    Args:
        scanned: The recording.
        entities: The paths of the entities.
        damaged: Receives the messages that cannot be unpacked, whatever they held.

    Returns:
        Message, path of the entity, and rows of each chunk.
    """
    for frame in scanned.frames:
        if frame.kind == CHUNK:
            try:
                found = record_batch(read_payload(scanned.path, frame), entities)
            except ValueError:
                damaged.append(frame)
                continue
            if found is not None:
                yield frame, *found


def _read_records(scanned: Scan) -> _Records:
    found: tuple[int, codec.Header] | None = None
    rows: dict[int, codec.StoredRow] = {}
    images: dict[int, _Image] = {}
    streams: dict[str, Stream] = {}
    corners: CornerTable | None = None
    damaged: list[MessageFrame] = []
    closed: int | None = None
    entities = (
        paths.SESSION,
        paths.STREAMS,
        paths.CORNERS,
        paths.ROWS,
        paths.IMAGE,
        paths.END,
    )
    for frame, entity, batch in chunks(scanned, entities, damaged):
        try:
            if entity == paths.SESSION:
                found = codec.read_header(batch, scanned.path)
            elif entity == paths.STREAMS:
                streams |= codec.read_samples(batch)
            elif entity == paths.CORNERS:
                corners = codec.read_corners(batch)
            elif entity == paths.ROWS:
                # Of two rows at one place, the later one was damaged into being there.
                rows = codec.read_rows(batch) | rows
            elif entity == paths.IMAGE:
                images |= _images(frame, batch)
            else:
                closed = codec.read_end(batch)
        except _DAMAGE:
            damaged.append(frame)
    if found is None:
        raise _no_header(scanned, damaged)
    version, header = found
    if version == 1 and scanned.finished:
        # The first format had no mark of its own.
        closed = header.rows
    return _Records(header, rows, images, streams, corners, closed, len(damaged))


def _images(frame: MessageFrame, batch: pa.RecordBatch) -> dict[int, _Image]:
    return {
        row: _Image(frame, place, sha256(codec.image_at(batch, place)))
        for row, place in codec.image_places(batch).items()
    }


def _no_header(scanned: Scan, damaged: Sequence[MessageFrame]) -> DataError:
    next_step = _AGAIN
    if damaged:
        what = "is damaged: the session's declaration cannot be read"
    elif scanned.finished:
        what, next_step = "holds no session of visioncal", "Give the .rrd that visioncal wrote."
    else:
        what = "was cut off before the session's declaration was complete: no view is in it"
    return DataError(f"{scanned.path} {what}.", culprits=[str(scanned.path)], next_step=next_step)


def _whole_streams(path: Path, records: _Records) -> dict[str, Stream]:
    """The streams that were written, in the order of the header."""
    found, seals = records.streams, records.header.stream_seals
    damaged = [
        name
        for name, seal in seals.items()
        if name not in found or codec.fact_seal(found[name]) != seal
    ]
    if damaged:
        raise DataError(
            f"{path} is damaged: the stream {', '.join(damaged)} cannot be read or was changed "
            "after it was written.",
            culprits=damaged,
            next_step=_AGAIN,
        )
    return {name: found[name] for name in seals}


def _corners_of(
    path: Path, records: _Records, cells: Sequence[Sequence[str]]
) -> CornerTable | None:
    """The corners of the views that are complete; None where the session has none."""
    seal, found = records.header.corners, records.corners
    if not seal:
        return None
    if found is None or codec.fact_seal(found) != seal:
        raise DataError(
            f"{path} is damaged: the corners of its views cannot be read or were changed after it "
            "was written.",
            culprits=["corners"],
            next_step=_AGAIN,
        )
    at = records.header.columns.index("view")
    return found.of_views([int(row[at]) for row in cells])


def _complete_rows(path: Path, records: _Records) -> list[int]:
    """The places of the rows that are there with their images."""
    # Views are written one after the other, so what is missing before the last trace of a view, or
    # from a recording that was closed, was damaged rather than cut off.
    rows, images, closed = records.rows, records.images, records.closed
    # The last view of a recording that was cut off may lack its row or its image.
    sure = max([*rows, *images], default=0) if closed is None else closed
    # A damaged place can be a very large number.
    missing = [
        f"row {row + 1}"
        for row in islice((row for row in range(sure) if row not in rows), _SHOWN_ROWS)
    ]
    if missing:
        raise DataError(
            f"{path} is damaged: {', '.join(missing)} of the table cannot be read or was changed "
            "after it was written.",
            culprits=missing,
            next_step=_AGAIN,
        )
    if records.header.images:
        return sorted(rows)
    absent = [row for row in rows if rows[row].image_sha256 and row not in images]
    changed = [
        row for row in rows if row in images and images[row].digest != rows[row].image_sha256
    ]
    changed += [row for row in absent if row < sure]
    if changed:
        raise _changed_images(path, [records.image_name(row) for row in sorted(changed)])
    return sorted(set(rows) - set(absent))


def _changed_images(path: Path, names: Sequence[str]) -> DataError:
    return DataError(
        f"{path} is damaged: the image {', '.join(names)} cannot be read or does not match its "
        "SHA-256.",
        culprits=names,
        next_step=_AGAIN,
    )


def _losses(scanned: Scan, records: _Records, complete: int) -> Iterator[str]:
    """Words what is not in the recording any more."""
    name, announced = scanned.path.name, records.header.rows
    if records.header.images:
        yield f"{name}: the images are elsewhere, and only their digests are kept."
    if records.closed is not None:
        if scanned.cut:
            yield (
                f"{name}: the end of the file is missing; all {complete} views are there, but "
                "results that were added last may not be."
            )
    elif announced == codec.UNKNOWN:
        begun = " A view that had been begun is lost." if scanned.cut or records.begun else ""
        yield (
            f"{name}: the recording was not closed: its writer was stopped, or the file was cut "
            f"off. {complete} views are complete.{begun}"
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

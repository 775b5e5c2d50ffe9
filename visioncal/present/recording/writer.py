"""Writes recordings of sessions: view by view during capture, or as a whole."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Self

from rerun.blueprint import BlueprintLike

from visioncal.core.choices import ImagesKept
from visioncal.core.documents.tables import TextTable
from visioncal.core.errors import DataError
from visioncal.core.files import named_errors, replacing_file, sha256
from visioncal.core.types import Searched
from visioncal.present.recording import codec
from visioncal.present.recording.reader import ExternalImages
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.results import log_results
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.kinds import check_images_can_be_used
from visioncal.session.table import View, read_views
from visioncal.vision.finders.imaging import decode_image, faint_jpeg


class RecordingWriter:
    """Writes a recording while its session is captured.

    A view survives the death of the process once `add_view` returns. A recording that an exception
    interrupts opens as one that was cut off.

        with RecordingWriter(path, session, announced=20) as writer:
            writer.add_view(["1", "images/001.png", "0.4", ...], png)
    """

    def __init__(
        self,
        path: Path,
        session: Session,
        *,
        announced: int | None = None,
        blueprint: BlueprintLike | None = None,
        label: Path | None = None,
        images: ImagesKept = "full",
        searches: Mapping[tuple[str, str], Searched] | None = None,
    ) -> None:
        """Starts the file.

        Args:
            path: The `.rrd`. It must not exist, unless `label` is given.
            session: Data that holds for all views; its own views are not written.
            announced: Number of views to come, by which readers can state how many were lost.
            blueprint: Viewer layout of the recording.
            label: Final path that messages name, where `path` is a temporary one.
            images: What is stored of the images beside their digests.
            searches: What was found in each image, by its name and that of its board in the
                session's `boards`: the session can be calibrated again without its images.

        Raises:
            DataError: The file exists or cannot be written.
        """
        self._label = label or path
        self._session = session
        self._numbers: set[int] = set()
        self._images: dict[str, str] = {}
        self._kept = images
        self._searches = searches or {}
        with named_errors(self._label):
            if label is None:
                path.open("xb").close()
            self._recorder = Recorder(path)
            self._recorder.stream.send_recording_name(session.name)
            rows = codec.UNKNOWN if announced is None else announced
            header = codec.Header.of(session, rows, "" if self._kept == "full" else self._kept)
            codec.log_header(self._recorder.stream, header)
            for index, (name, samples) in enumerate(session.streams.items()):
                self._recorder.at(index)
                codec.log_samples(self._recorder.stream, name, samples)
            if session.corner_table is not None:
                codec.log_corners(self._recorder.stream, session.corner_table)
            if self._searches:
                codec.log_searches(self._recorder.stream, self._searches)
            self._recorder.keep()
            self._recorder.lay_out(blueprint)

    def add_view(self, cells: Sequence[str], image: bytes | None) -> None:
        """Adds one view.

        Args:
            cells: One text per column of the session, as in views.csv.
            image: Bytes of the file that the column `image` names; None without a name or a file.

        Raises:
            DataError: A cell is wrong, the view's number is already there, its image differs from
                an earlier view's of the same name, or the file cannot be written. Earlier views
                remain.
        """
        view = self._checked(cells)
        self._log(view, "" if image is None else self._checked_digest(view, sha256(image)), image)

    def _log(self, view: View, image_sha256: str, shown: bytes | None) -> None:
        row, recorder = len(self._numbers), self._recorder
        name = view.image if self._kept == "full" else f"{view.image}.jpg"
        with named_errors(self._label):
            recorder.at(row)
            codec.log_row(
                recorder.stream, codec.StoredRow.of(self._session.columns, view, image_sha256)
            )
            codec.log_image(recorder.stream, name, shown)
            recorder.keep()
        self._numbers.add(view.number)

    def add_results(
        self, session: Session, calibration: Calibration | None, evidence: Sequence[ViewEvidence]
    ) -> None:
        """Adds results.

        Args:
            session: The session with all of its views.
            calibration: Result of the session; None draws the cell as recorded.
            evidence: Evidence of the views, in any order.

        Raises:
            DataError: The file cannot be written.
        """
        with named_errors(self._label):
            log_results(self._recorder, session, calibration, evidence)

    def add_session(self, session: Session) -> None:
        """Adds all views of a session.

        Raises:
            DataError: An image cannot be read, or the file cannot be written.
        """
        images = session.images
        for view in session.views:
            cells = [view.cell(column) for column in session.columns]
            has_image = bool(view.image) and images.exists(view.image)
            if self._kept == "full":
                self.add_view(cells, images.read(view.image) if has_image else None)
                continue
            row, shown = self._checked(cells), None
            if view.image and self._kept == "thumbnail":
                found = self._searches.get((view.image, session.board_of(view)))
                shown = (found and found.faint_jpeg) or images.shown(view.image)
                if shown is None and has_image:
                    pixels = decode_image(images.read(view.image), colour=True)
                    shown = None if isinstance(pixels, str) else faint_jpeg(pixels)
            digest = images.sha256(view.image) if view.image else ""
            self._log(row, digest and self._checked_digest(row, digest), shown)

    def draw(self, log: Callable[[Recorder], None]) -> None:
        """Adds a drawing that belongs to no view.

        Raises:
            DataError: The file cannot be written.
        """
        with named_errors(self._label):
            log(self._recorder)
            self._recorder.keep()

    @property
    def _where(self) -> str:
        """Name of the row that is added, for messages."""
        return f"row {len(self._numbers) + 1}"

    def _checked(self, cells: Sequence[str]) -> View:
        """Checks a row: it must be readable again."""
        where, corners = self._where, self._session.corner_table is not None
        table = TextTable("", self._session.columns, (tuple(cells),), (len(self._numbers) + 1,))
        (view,) = read_views(table, with_corners=corners)
        check_images_can_be_used(self._session.declaration, [view])
        if view.number in self._numbers:
            raise DataError(
                f"{where}: view {view.number} is already there; each view has a number of its own.",
                culprits=[f"view {view.number}"],
            )
        return view

    def _checked_digest(self, view: View, digest: str) -> str:
        """The SHA-256 of a view's image, which must have a name of its own."""
        where = self._where
        if not view.image:
            raise DataError(f"{where}: it has an image but does not name it.", culprits=[where])
        if self._images.setdefault(view.image, digest) != digest:
            raise DataError(
                f"{where}: another image is already there by the name {view.image}.",
                culprits=[view.image],
            )
        return digest

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes the recording, with the end mark unless an error occurred.

        Raises:
            DataError: The file cannot be written.
        """
        with named_errors(self._label):
            if kind is None:
                codec.log_end(self._recorder.stream, len(self._numbers))
            self._recorder.__exit__(kind)


def write_recording(
    path: Path,
    session: Session,
    calibration: Calibration | None,
    evidence: Sequence[ViewEvidence],
    blueprint: BlueprintLike | None,
    images: ImagesKept = "full",
    searches: Mapping[int, Searched] | None = None,
) -> None:
    """Writes a session and its results as one recording.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        session: The session; `read_session` returns it.
        calibration: Result of the session, if there is one.
        evidence: Evidence of the views, in any order.
        blueprint: Viewer layout, as by `viewer.blueprint`; None for the viewer's own.
        images: What is stored of the images beside their digests. They are stored whole where the
            session could not be calibrated again without them: unless all searched ones are in
            `searches`.
        searches: What was found in each image, by view.

    Raises:
        DataError: The file cannot be written, or an image of the session cannot be read.
    """
    store, by_view = session.images, searches or {}
    searched = [view for view in session.views if view.image and not view.has_corners]
    found = {
        (view.image, session.board_of(view)): search
        for view in searched
        if (
            search := by_view.get(view.number)
            or store.search_of(view.image, session.board_of(view))
        )
        is not None
    }
    if all(store.exists(view.image) for view in searched) and any(
        (view.image, session.board_of(view)) not in found for view in searched
    ):
        images = "full"
    elif isinstance(store, ExternalImages):
        images = store.kept
    with (
        replacing_file(path) as aside,
        RecordingWriter(
            aside,
            session,
            announced=len(session.views),
            blueprint=blueprint,
            label=path,
            images=images,
            searches={} if images == "full" else found,
        ) as writer,
    ):
        writer.add_session(session)
        writer.add_results(session, calibration, evidence)

"""Writes a session to a recording: view by view as it is captured, or as a whole."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from rerun.blueprint import BlueprintLike

from visioncal.core.choices import ImagesKept
from visioncal.core.errors import DataError
from visioncal.core.files import named_errors, sha256, written_beside
from visioncal.present.recording import codec
from visioncal.present.recording.elsewhere import ImagesElsewhere, faint_picture
from visioncal.present.recording.recorder import Recorder
from visioncal.present.recording.results import log_results
from visioncal.results import Calibration
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.checks import check_images_can_be_used
from visioncal.session.table import TextRow, View, read_views


class RecordingWriter:
    """Writes a recording while its session is captured.

    A view survives the death of the process as soon as `add_view` returns. A recording that is left
    by an exception opens as one that was cut off.

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
    ) -> None:
        """Begins the file.

        Args:
            path: The `.rrd`. It must not exist, unless it is written aside for another.
            session: What holds for all views; those that it has are not written.
            announced: How many views are to come, so that a reader can say how many were lost.
            blueprint: The layout to open the recording in.
            label: The path that it is written aside for, which messages name; None for none.
            images: What is kept of the images beside their digests. Of a session whose images are
                elsewhere it is what there is.

        Raises:
            DataError: The file exists or cannot be written.
        """
        self._label = label or path
        self._session = session
        self._numbers: set[int] = set()
        self._images: dict[str, str] = {}
        elsewhere = session.images
        self._kept = elsewhere.kept if isinstance(elsewhere, ImagesElsewhere) else images
        with named_errors(self._label):
            if label is None:
                path.open("xb").close()
            self._recorder = Recorder(path)
            self._recorder.stream.send_recording_name(session.name)
            rows = codec.UNKNOWN if announced is None else announced
            header = codec.Header.of(session, rows, "" if self._kept == "full" else self._kept)
            codec.log_header(self._recorder.stream, header)
            for place, (name, samples) in enumerate(session.streams.items()):
                self._recorder.at(place)
                codec.log_samples(self._recorder.stream, name, samples)
            if session.corner_table is not None:
                codec.log_corners(self._recorder.stream, session.corner_table)
            self._recorder.keep()
            self._recorder.lay_out(blueprint)

    def add_view(self, cells: Sequence[str], image: bytes | None) -> None:
        """Adds one view.

        Args:
            cells: One text for each of the session's columns, as views.csv has them.
            image: The bytes of the file that the column `image` names; None where it names none,
                or one that is missing.

        Raises:
            DataError: A cell is wrong, the view's number is already there, its image is another
                than an earlier view has by the same name, or the file cannot be written. The views
                before stay as they are.
        """
        view = self._checked(cells)
        digest = "" if image is None else self._digest_of(view, image)
        shown = image
        if image is not None and self._kept != "full":
            shown = faint_picture(image) if self._kept == "thumbnail" else None
        self._log(view, digest, shown)

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
        """Adds what was computed.

        Args:
            session: The session with all of its views.
            calibration: Its result; None draws the cell as it was recorded.
            evidence: What was seen and computed of the views, in any order.

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
            if isinstance(images, ImagesElsewhere):
                checked = self._checked(cells)
                self._log(checked, images.sha256(view.image), images.shown(view.image))
            else:
                known = bool(view.image) and images.exists(view.image)
                self.add_view(cells, images.read(view.image) if known else None)

    def draw(self, log: Callable[[Recorder], None]) -> None:
        """Adds what is drawn and belongs to no view.

        Raises:
            DataError: The file cannot be written.
        """
        with named_errors(self._label):
            log(self._recorder)
            self._recorder.keep()

    @property
    def _where(self) -> str:
        """What messages call the row that is added."""
        return f"row {len(self._numbers) + 1}"

    def _checked(self, cells: Sequence[str]) -> View:
        """Refuses a row that could be written but not be read again."""
        where, corners = self._where, self._session.corner_table is not None
        rows = [TextRow(where, tuple(cells))]
        (view,) = read_views(self._session.columns, rows, "views.csv", with_corners=corners)
        check_images_can_be_used(self._session.declaration, [view])
        if view.number in self._numbers:
            raise DataError(
                f"{where}: view {view.number} is already there; each view has a number of its own.",
                culprits=[f"view {view.number}"],
            )
        return view

    def _digest_of(self, view: View, image: bytes) -> str:
        """SHA-256 of a view's image; refuses one without a name, or with another's."""
        where = self._where
        if not view.image:
            raise DataError(f"{where}: it has an image but does not name it.", culprits=[where])
        digest = sha256(image)
        if self._images.setdefault(view.image, digest) != digest:
            raise DataError(
                f"{where}: another image is already there by the name {view.image}.",
                culprits=[view.image],
            )
        return digest

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes the recording, with a mark that all views are there unless an error left it.

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
) -> None:
    """Writes a session and its results as one recording.

    Args:
        path: The `.rrd` to write; it appears whole or not at all.
        session: What was recorded; `read_session` gives it back.
        calibration: Its result, if there is one.
        evidence: What was seen and computed of the views, in any order.
        blueprint: The layout to open it in, as `viewer.blueprint` makes it; the viewer
            makes its own where None.
        images: What is kept of the images beside their digests.

    Raises:
        DataError: The file cannot be written, or an image of the session cannot be read.
    """
    with (
        written_beside(path) as aside,
        RecordingWriter(
            aside,
            session,
            announced=len(session.views),
            blueprint=blueprint,
            label=path,
            images=images,
        ) as writer,
    ):
        writer.add_session(session)
        writer.add_results(session, calibration, evidence)

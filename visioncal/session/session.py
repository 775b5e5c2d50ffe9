"""Session: the recording of a cell, read from a folder and written to one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, Unpack

import numpy.typing as npt

from visioncal.core.arguments import typed
from visioncal.core.documents.tables import TextTable
from visioncal.core.documents.toml import parse_toml
from visioncal.core.errors import DataError
from visioncal.core.files import read_text_inside
from visioncal.core.summaries import html_card, text_card
from visioncal.core.types import Image, Image16, Target
from visioncal.session.arrays import CellArguments, Poses, of_corners, of_images
from visioncal.session.content import SessionContent
from visioncal.session.corners import read_corners
from visioncal.session.images import FolderImages, MemoryImages
from visioncal.session.reading import session_text
from visioncal.session.saving import digest_of, save_session
from visioncal.session.selecting import Choice, is_whole_cell, keep_views, select
from visioncal.session.streams import Stream, read_streams
from visioncal.session.table import check_times, parse_csv
from visioncal.vision.boards.picture import with_weights

_NO_VIEWS = TextTable("", ("view",), (), ())


@dataclass(frozen=True, eq=False)
class Session(SessionContent):
    """Recording of a cell. The content is kept as it was read; transforms are derived."""

    @classmethod
    @typed
    def load(
        cls,
        path: Path | str,
        *,
        target_document: Mapping[str, Any] | None = None,
        table: TextTable | None = None,
    ) -> Self:
        """Loads a session from a folder or an `.rrd` recording.

        A missing image is no error here: its view is rejected later. Where there are streams,
        views.csv may be absent.

        Args:
            path: The folder or the recording.
            target_document: Replaces the folder's target, or targets by name.
            table: Replaces the folder's views.csv.

        Raises:
            DataError: A file is missing, or a field, row or column of one is wrong.
        """
        path = Path(path)
        if path.suffix.lower() == ".rrd":
            # Imported here, since recordings depend on sessions.
            from visioncal.present.recording.stored import session_content

            content, streams = session_content(path)
            return cls.assemble(**content).with_streams(streams)
        document = parse_toml(session_text(path), "session.toml")
        streams = read_streams(path)
        # Streams are enough for identifying an arm's dynamics.
        if table is None and (not streams or (path / "views.csv").exists()):
            table = parse_csv(read_text_inside(path, "views.csv"), "views.csv")
        session = cls.build(
            document,
            _NO_VIEWS if table is None else table,
            FolderImages(path),
            folder=path,
            target_document=target_document,
            corners=read_corners(path),
        )
        check_times(session.views)
        return session.with_streams(streams)

    @classmethod
    def of_streams(cls, document: Mapping[str, Any], streams: Mapping[str, Stream]) -> Self:
        """Builds a session with streams and without views, with the checks of `load`.

        Raises:
            DataError: A field or a column is wrong.
        """
        return cls.build(document, _NO_VIEWS, MemoryImages({})).with_streams(streams)

    @classmethod
    @typed
    def from_arrays(
        cls,
        images: Sequence[Image | Image16 | bytes],
        base_from_flange: Poses,
        board: Target | str,
        **cell: Unpack[CellArguments],
    ) -> Self:
        """Builds a session of images in memory.

        Args:
            images: (h, w) or (h, w, 3) arrays of uint8, blue first, or the bytes of image files.
            base_from_flange: (n, 4, 4), or n transforms: the flange's pose at each.
            board: The board in the images, or the name of a built-in one.
            **cell: Options `mount`, `camera` (estimated by default), `robot` (a built-in model),
                `q` (n, j) [rad], `name`.

        Raises:
            DataError: The arrays do not match, or one has a wrong form.
        """
        return cls.assemble(**of_images(images, base_from_flange, board, **cell))

    @classmethod
    @typed
    def from_corners(
        cls,
        corners: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
        base_from_flange: Poses,
        board: Target | str,
        resolution: tuple[int, int],
        **cell: Unpack[CellArguments],
    ) -> Self:
        """Builds a session of corners by another detector.

        Args:
            corners: For each view the (k,) numbers of its corners and their (k, 2) positions [px];
                None for both, or empty ones, where nothing was found.
            base_from_flange: As in `from_arrays`.
            board: As in `from_arrays`.
            resolution: (width, height) of the images [px].
            **cell: As in `from_arrays`.

        Raises:
            DataError: The arrays do not match, or one has a wrong form.
        """
        return cls.assemble(**of_corners(corners, base_from_flange, board, resolution, **cell))

    def __repr__(self) -> str:
        return text_card(f"Session {self.name!r}", self._facts)

    def _repr_html_(self) -> str:
        return html_card(f"Session {self.name}", self._facts, says=self.warnings)

    @property
    def has_one_pair(self) -> bool:
        """Whether it has one camera or instrument and one robot: no whole cell."""
        return not is_whole_cell(self)

    @property
    def _facts(self) -> dict[str, str]:
        images = sum(bool(view.image) for view in self.views)
        return {
            "mount": self.mount,
            "views": f"{len(self.views)}, {images} with images",
            "boards": ", ".join(board.name for board in self.boards.values()) or "none",
            "robots": ", ".join(
                robot or (self.robot_name or "poses alone") for robot in self.robots
            ),
            **({"streams": ", ".join(self.streams)} if self.streams else {}),
        }

    @typed
    def of(
        self, camera: str | None = None, robot: str | None = None, target: str | None = None
    ) -> Self:
        """Selects one camera, one robot and one target of a whole cell.

        The result has the rows in which this camera observes this target, with the robot's poses at
        their stops.

        Args:
            camera: Name of the camera or its frame; optional where unambiguous.
            robot: Name of the robot between camera and target; optional where unambiguous.
            target: Name of the target; optional where unambiguous.

        Raises:
            DataError: There is none of that name, the choice is ambiguous, or this robot is not
                between camera and target.
        """
        return select(self, Choice(camera, robot, target))

    @typed
    def only(self, views: Sequence[int]) -> Self:
        """Selects views, such as those before something moved.

        In a whole cell, the robots' rows at their stops are kept, too.

        Args:
            views: The views' numbers.

        Raises:
            DataError: The session has no such view, or none is given.
        """
        return keep_views(self, views)

    def with_weights(self, folder: Path) -> Self:
        """A session whose pictures are matched in hard views by the weights of a folder, too."""
        targets = {name: with_weights(one, folder) for name, one in self.targets.items()}
        first = self.target and with_weights(self.target, folder)
        return replace(self, target=first, targets=targets)

    @typed
    def needing(
        self, mm: float | None = None, deg: float | None = None, *, corrected: bool = False
    ) -> Self:
        """The session with another required accuracy; a value of None keeps the declared one.

        Args:
            mm: Required accuracy of picks [mm].
            deg: The same in rotation [deg].
            corrected: Whether targets are corrected for a calibrated arm; False keeps what is
                declared.

        Raises:
            DataError: A value is not a number above 0.
        """
        stated_need: dict[str, float | bool] = {"corrected": True} if corrected else {}
        for name, value in (("mm", mm), ("deg", deg)):
            if value is not None:
                stated_need[name] = float(value)
        if not stated_need:
            return self
        table = {**self.document.get("need", {}), **stated_need}
        session = replace(self, document={**self.document, "need": table})
        _ = session.declaration  # checks it
        return session

    @typed
    def save(self, folder: Path | str) -> None:
        """Writes the session atomically as a self-contained folder.

        Files of targets and robots are written into it; built-in ones remain names. Image files are
        copied byte by byte; missing ones are skipped.

        Raises:
            DataError: The folder exists and is not empty, or cannot be written; a recording is
                named; or the session is of a recording without its images.
        """
        if Path(folder).suffix == ".rrd":
            raise DataError(
                f"{folder}: a session is saved as a folder.",
                culprits=[str(folder)],
                next_step="Save it as a folder, and convert that: visioncal convert FOLDER "
                f"{Path(folder).name}.",
            )
        save_session(self, Path(folder))

    def digest(self) -> str:
        """Computes the SHA-256 digest of the session's content, independent of its storage.

        It depends on the contents of target and robot files, not on their names, nor on folders,
        formatting and the spelling of numbers.
        """
        return digest_of(self)

"""A session: what was recorded of a cell, read from a folder and written to one."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import tomli_w

from visioncal.errors import DataError
from visioncal.files import parse_toml, read_text, write_atomically
from visioncal.robot import read_robot_document, robot_file
from visioncal.session import columns as known
from visioncal.session.boards import COLUMN, check_targets_named, read_targets, target_warnings
from visioncal.session.checks import check_images_can_be_used, view_warnings
from visioncal.session.digest import digest_facts, is_file
from visioncal.session.document import Declaration, declaration_warnings, read_declaration
from visioncal.session.images import FolderImages, ImageStore, MemoryImages, inside_path
from visioncal.session.streams import (
    FOLDER,
    Stream,
    check_stream,
    gap_warnings,
    read_streams,
    write_stream,
)
from visioncal.session.table import Row, View, parse_csv, read_views, write_csv
from visioncal.types import Camera, CameraKind, Mount, Target

# The columns of a session without views.
ALONE = ("view",)


@dataclass(frozen=True, eq=False)
class Session:
    """What was recorded of a cell. The content is kept as it was read; transforms are derived.

    Attributes:
        document: The content of session.toml.
        columns: The columns of views.csv, in its order.
        views: Its rows, in its order.
        target: The printed target, where the session names one; of several, the first.
        target_document: The content of the target's `.toml`; of several, the contents by name.
        images: Where the images' bytes come from.
        warnings: What is allowed but suspicious, in words for the user.
        robot_document: The robot's model as `Robot.from_document` reads it; None where the session
            names no robot or one that is unknown, which a warning says.
        targets: Several printed targets by name, in the session's order; empty for one or none.
        streams: What was read many times a second beside the views, by name.
    """

    document: Mapping[str, Any]
    columns: tuple[str, ...]
    views: tuple[View, ...]
    target: Target | None
    target_document: Mapping[str, Any] | None
    images: ImageStore
    warnings: tuple[str, ...] = ()
    robot_document: Mapping[str, Any] | None = None
    targets: Mapping[str, Target] = field(default_factory=dict)
    streams: Mapping[str, Stream] = field(default_factory=dict)

    @classmethod
    def load(
        cls, path: Path | str, *, target_document: Mapping[str, Any] | None = None
    ) -> "Session":
        """Loads a session's folder, or the `.rrd` recording of one.

        An image that is missing is no error here: the view that needs it is named later. Where
        there are streams, views.csv may be absent.

        Args:
            path: The folder or the recording.
            target_document: Taken in the place of a folder's own target, or targets by name.

        Raises:
            DataError: A file is missing, or a field, row or column of one is wrong.
        """
        path = Path(path)
        if path.suffix.lower() == ".rrd":
            # Recordings are built on sessions; only this one call goes the other way.
            from visioncal.recording import read_session

            return read_session(path)
        if not path.is_dir():
            raise DataError(
                f"{path} is no session: a folder with session.toml and views.csv, or an .rrd "
                "recording, is needed.",
                culprits=[str(path)],
            )
        document = parse_toml(read_text(path / "session.toml"), "session.toml")
        streams = read_streams(path)
        columns: tuple[str, ...] = ALONE
        rows: tuple[Row, ...] = ()
        # What an arm's drives needed is told by streams alone.
        if not streams or (path / "views.csv").exists():
            columns, rows = parse_csv(read_text(path / "views.csv"), "views.csv")
        session = _build(
            document,
            columns,
            rows,
            FolderImages(path),
            folder=path,
            target_document=target_document,
        )
        return session.with_streams(streams)

    @classmethod
    def of_streams(cls, document: Mapping[str, Any], streams: Mapping[str, Stream]) -> "Session":
        """Builds a session that has streams and no views, with the checks of `load`.

        Raises:
            DataError: A field or a column is wrong.
        """
        return _build(document, ALONE, (), MemoryImages({})).with_streams(streams)

    @classmethod
    def assemble(
        cls,
        document: Mapping[str, Any],
        columns: Sequence[str],
        cells: Sequence[Sequence[str]],
        images: ImageStore,
        *,
        target_document: Mapping[str, Any] | None = None,
        robot_document: Mapping[str, Any] | None = None,
    ) -> "Session":
        """Builds a session from facts that were kept elsewhere, with the checks of `load`.

        Args:
            document: The content of session.toml.
            columns: The columns of views.csv.
            cells: Its rows, one text for each column, as `View.cell` gives them.
            images: Where the images' bytes come from.
            target_document: The content of the target's `.toml`, of several the contents by name;
                needed where `document` names a file rather than a target that comes with visioncal.
            robot_document: The robot's model; needed likewise.

        Raises:
            DataError: A field, row or column is wrong.
        """
        rows = [Row(f"row {place}", tuple(row)) for place, row in enumerate(cells, start=1)]
        return _build(
            document,
            tuple(columns),
            rows,
            images,
            target_document=target_document,
            robot_document=robot_document,
        )

    def with_streams(self, streams: Mapping[str, Stream]) -> "Session":
        """Returns the session with streams beside its views, in the order of their names.

        Raises:
            DataError: A stream is wrong; see `check_stream`.
        """
        for name, stream in streams.items():
            check_stream(name, stream)
        ordered = dict(sorted(streams.items()))
        return replace(self, streams=ordered, warnings=(*self.warnings, *gap_warnings(ordered)))

    def save(self, folder: Path | str) -> None:
        """Writes the session as a folder that needs no other file; whole or not at all.

        Targets and robots that were files are written into it; those that come with visioncal
        stay names. Image files are copied byte by byte; missing ones stay missing.

        Raises:
            DataError: The folder exists and is not empty, or cannot be written.
        """
        folder = Path(folder).absolute()
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise DataError(
                f"{folder} exists and is not empty; a session is written to a new folder.",
                culprits=[str(folder)],
                next_step="Choose another name, or remove it first.",
            )
        aside = folder.parent / f".{uuid4().hex}.tmp"
        try:
            aside.mkdir(parents=True)
            try:
                self._write_into(aside)
                if folder.exists():
                    folder.rmdir()
                aside.replace(folder)
            finally:
                shutil.rmtree(aside, ignore_errors=True)
        except OSError as error:
            raise DataError(
                f"{folder} cannot be written: {error.strerror or error}.", culprits=[str(folder)]
            ) from error

    def digest(self) -> str:
        """Computes the SHA-256 digest of the session's facts.

        It is equal for every storage of the same facts: folders, their formatting, the spelling of
        numbers and the names of a target's or a robot's file do not enter, their contents do.
        """
        return digest_facts(
            self.document,
            self.target_document,
            self.robot_document,
            self.columns,
            self.views,
            self.images,
            self.streams,
        )

    @cached_property
    def declaration(self) -> Declaration:
        """The content of session.toml, typed: the clock, the priors, the instrument."""
        return read_declaration(self.document, "session.toml", observed=bool(self.views))

    @property
    def name(self) -> str:
        """The session's name."""
        return self.declaration.name

    @property
    def mount(self) -> Mount:
        """What observes whom: a camera in the hand or one that looks at it, or an instrument."""
        declared = self.declaration.mount
        return "instrument" if declared is None or self.is_read_by_instrument else declared

    @cached_property
    def is_read_by_instrument(self) -> bool:
        """Whether an instrument's readings are all that was observed: a camera comes before it."""
        seen = any(view.image or view.cam_from_target() is not None for view in self.views)
        return not seen and any(view.reading_m is not None for view in self.views)

    @property
    def boards(self) -> Mapping[str, Target]:
        """The printed targets by name; an only one has an empty name."""
        if self.targets or self.target is None:
            return self.targets
        return {"": self.target}

    def board_of(self, view: View) -> str:
        """Names the target among `boards` that a view shows."""
        return view.text.get(COLUMN, "").strip() if self.targets else ""

    @property
    def camera(self) -> Camera | None:
        """The camera's intrinsics; None where the session leaves them to be estimated."""
        table = self.declaration.camera
        if table is None or table.matrix is None or table.distortion is None:
            return None
        if table.resolution is None:
            return None
        width, height = table.resolution
        matrix, distortion = np.array(table.matrix, float), np.array(table.distortion, float)
        return Camera(table.model, (width, height), matrix, distortion)

    @property
    def camera_model(self) -> CameraKind:
        """The model of the camera's lens, known or to be estimated."""
        return "brown" if self.declaration.camera is None else self.declaration.camera.model

    @property
    def camera_name(self) -> str:
        """The camera's name; `camera` where the session gives none."""
        return "camera" if self.declaration.camera is None else self.declaration.camera.name

    @property
    def resolution(self) -> tuple[int, int] | None:
        """(width, height) of the images [px], if declared."""
        table = self.declaration.camera
        if table is None or table.resolution is None:
            return None
        return table.resolution[0], table.resolution[1]

    @property
    def intrinsics_mode(self) -> str:
        """What to do with given intrinsics: `auto`, `hold` or `refine`."""
        return "auto" if self.declaration.camera is None else self.declaration.camera.intrinsics

    @property
    def robot_name(self) -> str | None:
        """The robot's model as the session names it: a built-in name or a path."""
        return None if self.declaration.robot is None else self.declaration.robot.model

    @property
    def robot_tip(self) -> str | None:
        """The frame that the reported poses are of, if declared."""
        return None if self.declaration.robot is None else self.declaration.robot.tip

    def _image_paths(self) -> tuple[str, ...]:
        """The images' paths, each once, in the order of the views."""
        return tuple(dict.fromkeys(view.image for view in self.views if view.image))

    def _write_into(self, folder: Path) -> None:
        document = dict(self.document)
        texts: dict[str, str] = {}
        if self.target_document is not None:
            texts |= self._place_targets(document, self.target_document)
        if self.robot_document is not None and is_file(self.robot_name):
            name, content = robot_file(self.robot_document, str(self.robot_name))
            model = _place_inside(str(self.robot_name), name)
            document["robot"] = {**document["robot"], "model": model}
            texts[model] = content
        texts["session.toml"] = tomli_w.dumps(document)
        if self.views or not self.streams:
            texts["views.csv"] = write_csv(self.columns, self.views)
        texts |= {f"{FOLDER}/{name}.csv": write_stream(it) for name, it in self.streams.items()}
        for path in self._image_paths():
            if self.images.exists(path):
                _write_below(folder, path, self.images.read(path))
        for path, text in texts.items():
            _write_below(folder, path, text)

    def _place_targets(
        self, document: dict[str, Any], contents: Mapping[str, Any]
    ) -> dict[str, str]:
        """Names targets that were files by paths in the folder, and returns their texts by path."""
        if is_file(self.declaration.target):
            document["target"] = _place_inside(str(self.declaration.target), "target.toml")
            return {document["target"]: tomli_w.dumps(contents)}
        texts, several = {}, len(self.declaration.targets) > 1
        for name, table in self.declaration.targets.items():
            if is_file(table.target):
                path = _place_inside(table.target, f"target_{name}.toml")
                kept = {**table.model_dump(), "target": path}
                document["targets"] = {**document["targets"], name: kept}
                texts[path] = tomli_w.dumps(contents[name] if several else contents)
        return texts


def _build(
    document: Mapping[str, Any],
    columns: tuple[str, ...],
    rows: Sequence[Row],
    images: ImageStore,
    *,
    folder: Path | None = None,
    target_document: Mapping[str, Any] | None = None,
    robot_document: Mapping[str, Any] | None = None,
) -> Session:
    """Checks the facts of a session and puts them together."""
    declaration = read_declaration(document, "session.toml", observed=bool(rows))
    views = read_views(columns, rows, "views.csv")
    warnings = [
        *declaration_warnings(declaration, "session.toml"),
        *known.column_warnings(columns, "views.csv"),
        *view_warnings(views),
        *target_warnings(declaration, views),
    ]
    targets, target_document = read_targets(declaration, folder, target_document)
    check_images_can_be_used(declaration, views)
    check_targets_named(declaration, views)
    robot = declaration.robot
    if robot is not None and robot_document is None:
        try:
            robot_document = read_robot_document(robot.model, tip=robot.tip, folder=folder)
            if robot.gravity_m_s2 is not None:
                robot_document |= {"gravity_m_s2": robot.gravity_m_s2}
        except DataError as error:
            warnings.append(f"session.toml: robot.model: {error}")
    return Session(
        document,
        columns,
        views,
        next(iter(targets.values()), None),
        target_document,
        images,
        tuple(warnings),
        robot_document,
        targets if len(targets) > 1 else {},
    )


def _place_inside(path: str, fallback: str) -> str:
    """Keeps a path that stays inside the session's folder; others become `fallback`."""
    try:
        return inside_path(path)
    except DataError:
        return fallback


def _write_below(folder: Path, path: str, data: bytes | str) -> None:
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / path, data)

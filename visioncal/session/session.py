"""A session: what was recorded of a cell, read from a folder and written to one."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import numpy.typing as npt
import tomli_w

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_TOML_BYTES, parse_toml, read_text_inside
from visioncal.core.shown import html_card, text_card
from visioncal.core.types import Camera, Corners, Image, Image16, Mount, Need, Target
from visioncal.session import columns as known
from visioncal.session.arrays import CellArguments, Poses, of_corners, of_images
from visioncal.session.boards import COLUMN, read_targets, target_warnings
from visioncal.session.checks import check_images_can_be_used, check_times, view_warnings
from visioncal.session.choosing import Choice
from visioncal.session.corners import (
    FILE,
    CornerTable,
    check_points,
    corners_by_view,
    read_corners,
    with_corners,
    write_corners,
)
from visioncal.session.digest import digest_facts
from visioncal.session.document import Declaration, declaration_warnings, read_declaration
from visioncal.session.frames import check_frames, frame_name, resolve_frames, robots_of
from visioncal.session.images import IMAGE_ENDINGS, FolderImages, ImageStore, MemoryImages
from visioncal.session.kinds import (
    check_kinds_named,
    is_seen,
    kind_warnings,
    outside_warnings,
    read_robots,
)
from visioncal.session.observations import Observation, observations_of, stop_warnings
from visioncal.session.saving import placed_files, write_folder
from visioncal.session.selecting import keep_views, select
from visioncal.session.streams import (
    FOLDER,
    Stream,
    check_stream,
    gap_warnings,
    read_streams,
    write_stream,
)
from visioncal.session.table import TextRow, View, parse_csv, read_views, write_csv
from visioncal.session.tables import CameraTable, InstrumentTable, RobotTable

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
            names no robot or one that is unknown, which a warning says. Of several, the models by
            name.
        targets: Several printed targets by name, in the session's order; empty for one or none.
        streams: What was read many times a second beside the views, by name.
        corner_table: The corners that another detector found; None where there are none.
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
    corner_table: CornerTable | None = None

    @classmethod
    @typed
    def load(
        cls,
        path: Path | str,
        *,
        target_document: Mapping[str, Any] | None = None,
        table: tuple[tuple[str, ...], tuple[TextRow, ...]] | None = None,
    ) -> "Session":
        """Loads a session's folder, or the `.rrd` recording of one.

        An image that is missing is no error here: the view that needs it is named later. Where
        there are streams, views.csv may be absent.

        Args:
            path: The folder or the recording.
            target_document: Taken in the place of a folder's own target, or targets by name.
            table: The columns and rows taken in the place of a folder's own views.csv.

        Raises:
            DataError: A file is missing, or a field, row or column of one is wrong.
        """
        path = Path(path)
        if path.suffix.lower() == ".rrd":
            # Recordings are built on sessions; only this one call goes the other way.
            from visioncal.present.recording import read_session

            return read_session(path)
        if not path.exists():
            raise DataError(
                f"{path} does not exist; a session's folder, or an .rrd recording, is needed.",
                culprits=[str(path)],
                next_step="Check the path and its spelling.",
            )
        # What calibrate writes lies together, and is taken for its folder.
        folder = path.parent if path.name == "calibration.json" else path
        recording = folder / "recording.rrd"
        if recording.is_file() and not (folder / "session.toml").exists():
            raise DataError(
                f"{path} is no session, but a result.",
                culprits=[str(path)],
                next_step=f"Its recording is the session: name {recording}.",
            )
        if not path.is_dir():
            raise DataError(
                f"{path} is no session: a folder with session.toml and views.csv, or an .rrd "
                "recording, is needed.",
                culprits=[str(path)],
                next_step=f"Name its folder: {path.parent}."
                if (path.parent / "session.toml").is_file()
                else "",
            )
        if not (path / "session.toml").exists() and any(
            file.suffix.lower() in IMAGE_ENDINGS for file in path.iterdir()
        ):
            raise DataError(
                f"{path} is a folder of pictures, and no session: it has no session.toml.",
                culprits=[str(path)],
                next_step="With a table of the robot's poses they become one: visioncal convert "
                f"TABLE my-session --images {shlex.quote(str(path))} --target BOARD --mount "
                "eye-in-hand (or eye-to-hand).",
            )
        document = parse_toml(
            read_text_inside(path, "session.toml", MOST_TOML_BYTES), "session.toml"
        )
        streams = read_streams(path)
        columns: tuple[str, ...] = ALONE
        rows: tuple[TextRow, ...] = ()
        # Streams alone have what an arm's drives needed.
        if table is not None:
            columns, rows = table
        elif not streams or (path / "views.csv").exists():
            columns, rows = parse_csv(read_text_inside(path, "views.csv"), "views.csv")
        session = _build(
            document,
            columns,
            rows,
            FolderImages(path),
            folder=path,
            target_document=target_document,
            corners=read_corners(path),
        )
        check_times(session.views)
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
        corners: CornerTable | None = None,
    ) -> "Session":
        """Builds a session from facts that were kept elsewhere, with the checks of `load`.

        Args:
            document: The content of session.toml.
            columns: The columns of views.csv.
            cells: Its rows, one text for each column, as `View.cell` gives them.
            images: Where the images' bytes come from.
            target_document: The content of the target's `.toml`, of several the contents by name;
                needed where `document` names a file rather than a target that comes with visioncal.
            robot_document: The robot's model, of several the models by name; needed likewise.
            corners: The corners that another detector found.

        Raises:
            DataError: A field, row or column is wrong.
        """
        rows = [TextRow(f"row {place}", tuple(row)) for place, row in enumerate(cells, start=1)]
        return _build(
            document,
            tuple(columns),
            rows,
            images,
            target_document=target_document,
            robot_document=robot_document,
            corners=corners,
        )

    @classmethod
    @typed
    def from_arrays(
        cls,
        images: Sequence[Image | Image16 | bytes],
        base_from_flange: Poses,
        board: Target | str,
        **cell: Unpack[CellArguments],
    ) -> "Session":
        """Builds a session of images in memory.

        Args:
            images: (h, w) or (h, w, 3) arrays of uint8, blue first, or the bytes of image files.
            base_from_flange: (n, 4, 4), or n transforms: where the robot stood at each.
            board: What they show: a board, or the name of one that comes with visioncal.
            **cell: What else is known: `mount`, `camera` (estimated where left out), `robot` (a
                built-in model), `q` (n, j) [rad], `name`.

        Raises:
            DataError: The arrays do not match, or one is of another form.
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
    ) -> "Session":
        """Builds a session of corners that another detector found.

        Args:
            corners: For each view the (k,) numbers of its corners and their (k, 2) places [px];
                None for both, or empty ones, where nothing was found.
            base_from_flange: As in `from_arrays`.
            board: Likewise.
            resolution: (width, height) of the images [px].
            **cell: Likewise.

        Raises:
            DataError: The arrays do not match, or one is of another form.
        """
        return cls.assemble(**of_corners(corners, base_from_flange, board, resolution, **cell))

    def __repr__(self) -> str:
        return text_card(f"Session {self.name!r}", self._facts)

    def _repr_html_(self) -> str:
        return html_card(f"Session {self.name}", self._facts, says=self.warnings)

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
    ) -> "Session":
        """Returns the session of one camera, one robot and one target of a whole cell.

        It has the rows in which this camera saw this target, with the robot's poses of their stops.

        Args:
            camera: Its name, or its frame's; may be left out where only one fits.
            robot: The robot that moves one of them before the other; likewise.
            target: The target; likewise.

        Raises:
            DataError: There is no such thing, several are meant, or this robot does not part these.
        """
        return select(self, Choice(camera, robot, target))

    @typed
    def only(self, views: Sequence[int]) -> "Session":
        """Returns the session of some views alone, as those before something moved.

        Of a whole cell, the rows of robots at their stops stay, too.

        Args:
            views: Their numbers.

        Raises:
            DataError: The session has no such view, or none is meant.
        """
        return keep_views(self, views)

    def with_streams(self, streams: Mapping[str, Stream]) -> "Session":
        """Returns the session with streams beside its views, in the order of their names.

        Raises:
            DataError: A stream is wrong; see `check_stream`.
        """
        for name, stream in streams.items():
            check_stream(name, stream)
        ordered = dict(sorted(streams.items()))
        return replace(self, streams=ordered, warnings=(*self.warnings, *gap_warnings(ordered)))

    @typed
    def needing(self, mm: float | None = None, deg: float | None = None) -> "Session":
        """Returns the session of a task that needs something else; what is None stays as declared.

        Args:
            mm: How near picks have to come [mm].
            deg: The same in rotation [deg].

        Raises:
            DataError: One is no number above 0.
        """
        both = (("mm", mm), ("deg", deg))
        asked = {name: float(value) for name, value in both if value is not None}
        for name, value in asked.items():
            if not 0.0 < value < np.inf:
                raise DataError(
                    f"the need in {name} is {value!r}; a number above 0 is needed.",
                    culprits=[f"--need-{name}"],
                    next_step=f"Give how near picks have to come, as --need-{name} 0.5.",
                )
        if not asked:
            return self
        table = {**self.document.get("need", {}), **asked}
        return replace(self, document={**self.document, "need": table})

    @property
    def need(self) -> Need | None:
        """What the task needs; None where nothing is said of it."""
        table = self.declaration.need
        return None if table is None else table.need

    @typed
    def save(self, folder: Path | str) -> None:
        """Writes the session as a folder that needs no other file; whole or not at all.

        Targets and robots that were files are written into it; those that come with visioncal
        stay names. Image files are copied byte by byte; missing ones stay missing.

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
        document, texts = placed_files(
            self.declaration, self.document, self.target_document, self.robot_document
        )
        texts["session.toml"] = tomli_w.dumps(document)
        if self.views or not self.streams:
            texts["views.csv"] = write_csv(self.columns, self.views)
        if self.corner_table is not None:
            texts[FILE] = write_corners(self.corner_table)
        texts |= {
            f"{FOLDER}/{name}.csv": write_stream(stream) for name, stream in self.streams.items()
        }
        paths = dict.fromkeys(view.image for view in self.views if view.image)
        write_folder(Path(folder), texts, self.images, tuple(paths))

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
            self.corner_table,
        )

    @cached_property
    def corners(self) -> Mapping[int, Corners]:
        """The corners that another detector found, by view, each numbered as its target's are."""
        if self.corner_table is None:
            return {}
        shown = [view for view in self.views if view.has_corners]
        board_of = {view.number: self.boards[self.board_of(view)] for view in shown}
        return corners_by_view(self.corner_table, shown, self.declaration, board_of)

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
        """What observes whom: a camera in the hand or one that looks at it, or an instrument.

        Of several cameras that are not declared alike, it is that of none in the hand.
        """
        declared = self.declaration.mount
        if self.is_read_by_instrument or (declared is None and not self.cameras):
            return "instrument"
        if declared is not None:
            return declared
        on = [self.frames[frame_name("camera", camera)] for camera in self.cameras]
        return "eye-in-hand" if all(name.startswith("flange") for name in on) else "eye-to-hand"

    @property
    def is_network(self) -> bool:
        """Whether it has several cameras, robots or instruments, or says what hangs on what."""
        return self.declaration.is_network

    @cached_property
    def cameras(self) -> Mapping[str, CameraTable]:
        """The cameras by the names that rows give them; that of `[camera]` is empty."""
        found = self.declaration.named("camera").items()
        return {name: table for name, table in found if isinstance(table, CameraTable)}

    @cached_property
    def robots(self) -> Mapping[str, RobotTable]:
        """The robots by name; that of `[robot]`, and of poses without a robot, is empty."""
        in_streams = any(stream.has_robot_state for stream in self.streams.values())
        return robots_of(self.declaration, self.views, in_streams=in_streams)

    @cached_property
    def instruments(self) -> Mapping[str, InstrumentTable]:
        """The instruments by name; that of `[instrument]` is empty."""
        found = self.declaration.named("instrument").items()
        return {name: table for name, table in found if isinstance(table, InstrumentTable)}

    @cached_property
    def plates(self) -> Mapping[str, Target]:
        """The targets by the names that session.toml gives them, also where there is one."""
        names = list(self.declaration.named("target"))
        return dict(zip(names, self.boards.values(), strict=False))

    @property
    def robot_documents(self) -> Mapping[str, Mapping[str, Any]]:
        """The robots' models by name, of those whose models are known."""
        if self.robot_document is None:
            return {}
        if len(self.robots) > 1:
            return self.robot_document
        return dict.fromkeys(self.robots, self.robot_document)

    @cached_property
    def frames(self) -> Mapping[str, str]:
        """What each frame hangs on, by name: bases, flanges, cameras, targets, instruments, points.

        Raises:
            DataError: What is said contradicts itself, or something is neither said nor follows.
        """
        return resolve_frames(self.declaration, self.views, self.robots)

    @cached_property
    def observations(self) -> tuple[Observation, ...]:
        """What saw what while which robots stood how.

        Raises:
            DataError: See `frames`.
        """
        return observations_of(self.declaration, self.views, self.frames)

    @cached_property
    def is_read_by_instrument(self) -> bool:
        """Whether an instrument's readings are all that was observed: a camera comes before it."""
        seen = any(is_seen(view) for view in self.views)
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
        table = self.declaration.only_camera
        return None if table is None else table.stated

    @property
    def camera_name(self) -> str:
        """The camera's name; `camera` where the session gives none."""
        return (
            "camera" if self.declaration.only_camera is None else self.declaration.only_camera.name
        )

    @property
    def resolution(self) -> tuple[int, int] | None:
        """(width, height) of the images [px], if declared."""
        table = self.declaration.only_camera
        return None if table is None else table.size

    @property
    def robot_name(self) -> str | None:
        """The robot's model as the session names it: a built-in name or a path."""
        return None if self.declaration.only_robot is None else self.declaration.only_robot.model


def _build(
    document: Mapping[str, Any],
    columns: tuple[str, ...],
    rows: Sequence[TextRow],
    images: ImageStore,
    *,
    folder: Path | None = None,
    target_document: Mapping[str, Any] | None = None,
    robot_document: Mapping[str, Any] | None = None,
    corners: CornerTable | None = None,
) -> Session:
    """Checks the facts of a session and puts them together."""
    declaration = read_declaration(document, "session.toml", observed=bool(rows))
    views = read_views(columns, rows, "views.csv", with_corners=corners is not None)
    targets, target_document = read_targets(declaration, folder, target_document)
    several = targets if len(targets) > 1 else {}
    if corners is not None:
        columns, views, corners = with_corners(columns, views, corners, tuple(several))
    check_images_can_be_used(declaration, views)
    warnings = [
        *declaration_warnings(declaration, "session.toml"),
        *known.column_warnings(columns, "views.csv"),
        *view_warnings(views),
        *kind_warnings(declaration, views),
        *target_warnings(declaration, target_document),
    ]
    check_kinds_named(declaration, views)
    check_frames(declaration, views)
    if declaration.is_network:
        warnings += stop_warnings(declaration, views)
    robot_document, unknown = read_robots(declaration, folder, robot_document)
    warnings += [*unknown, *outside_warnings(declaration, folder)]
    session = Session(
        document,
        columns,
        views,
        next(iter(targets.values()), None),
        target_document,
        images,
        tuple(warnings),
        robot_document,
        several,
        corner_table=corners,
    )
    if corners is not None:
        seen = (view for view in views if view.has_corners)
        shown = {view.number: session.board_of(view) for view in seen}
        check_points(corners, [shown[index] for index in corners.views.tolist()], session.boards)
    return session

"""A foreign recording as its numbers are written, its format, and the user's options for it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.errors import DataError
from visioncal.core.number_format import known_name
from visioncal.core.types import FloatArray, IntArray, Mask, Mount, Progress, chosen_rows, evenly
from visioncal.session import ImageStore

# Parts of a reading that may be unstated: `rotation`, `angles` (their order and unit), `unit`,
# `inverse`, and which `images` are theirs.
Unstated: TypeAlias = frozenset[str]
Side: TypeAlias = Literal["robot", "camera"]


@dataclass(frozen=True)
class PoseImportOptions:
    """Location and convention of poses; None or empty leaves it to the source."""

    # Columns of a table, keys of JSON or arrays of an .npz: position first.
    names: tuple[str, ...] = ()
    form: str | None = None  # A name among `POSE_FORMS` or `ROTATION_FORMS`.
    unit: str | None = None  # A name among `UNITS_M`.
    inverse: bool | None = None  # Whether the inverse of the pose is written.
    # The robot's own form, among `POSE_FORMS`, in which poses are whose names fit it.
    usual: str | None = None

    @property
    def rotation(self) -> str:
        """Form of the rotations by the stated form of poses; empty where none is stated."""
        form = self.form or ""
        return POSE_FORMS[form].rotation if form in POSE_FORMS else form

    def over(self, source: Self) -> Self:
        """Completes the options by those of the source where they leave the choice to it."""
        stated = {name: value for name, value in vars(self).items() if value not in ((), None)}
        return replace(source, **stated)

    def reading(self, declared: Reading) -> Reading:
        """The declared reading with the user's options in its place; raises DataError."""
        reading = declared
        if self.form is not None:
            known_name("form of poses", self.rotation, [*POSE_FORMS, *ROTATION_FORMS])
            unit = POSE_FORMS[self.form].unit if self.form in POSE_FORMS else reading.unit
            reading = replace(reading, rotation=self.rotation, unit=unit)
        if self.unit is not None:
            known_name("unit of length", self.unit, UNITS_M)
            reading = replace(reading, unit=self.unit)
        if self.inverse is not None:
            reading = replace(reading, inverse=self.inverse)
        return reading


@dataclass(frozen=True)
class ImportOptions:
    """All options for a foreign recording."""

    robot: PoseImportOptions = PoseImportOptions()  # Of the robot's poses, `base_from_flange`.
    # Of the measured poses of the target, `cam_from_target`.
    camera: PoseImportOptions = PoseImportOptions()
    joints: tuple[str, ...] = ()  # Columns or keys of the joint angles.
    joints_deg: bool = False
    image: str | None = None  # The column or key that names each row's image.
    camera_file: Path | None = None  # A second file, which holds the camera's poses.
    mount: Mount | None = None
    target: str | None = None  # A shipped name, the path of a `.toml`, or a one-word description.
    intrinsics: str | None = None  # The path of a file with intrinsics, or `estimate`.
    images: Path | None = None
    resolution: tuple[int, int] | None = None  # (width, height) [px].
    instrument: str | None = None  # A known instrument's name, or its sigma [mm].
    robot_model: str | None = None  # A built-in robot's name, or the path of a .urdf or a DH .toml.
    tip: str | None = None  # The frame that the poses are of.
    # The words of the command, which messages repeat with what is to be added.
    command: tuple[str, ...] = field(default=(), compare=False)
    # Called during long reading.
    progress: Progress | None = field(default=None, compare=False, repr=False)

    @property
    def arm(self) -> dict[str, str] | None:
        """The fields of `[robot]` in session.toml; None where no robot is named."""
        if self.robot_model is None:
            return None
        return {"model": self.robot_model} | ({} if self.tip is None else {"tip": self.tip})

    def with_poses(self, robot: PoseImportOptions, camera: PoseImportOptions) -> Self:
        """Completes the options by the source's statements on its poses."""
        return replace(self, robot=self.robot.over(robot), camera=self.camera.over(camera))


@dataclass(frozen=True, eq=False)
class ForeignStream:
    """The robot's poses over time, on a clock of its own."""

    stamps_s: FloatArray  # (k,) times [s], ascending.
    poses: PoseNumbers  # (k,) `base_from_flange`.
    joints_rad: FloatArray | None = None  # (k, j) joint angles [rad], NaN in a row without.


@dataclass(frozen=True, eq=False)
class ForeignRecording:
    """A recording in a foreign format: n rows, each an observation at one robot pose."""

    name: str  # Of the source, for messages.
    robot: PoseNumbers  # `base_from_flange` of each row.
    # `cam_from_target` of each row; None where images are used instead.
    camera: PoseNumbers | None = None
    # (n,) the image of each row; None in a row without one, empty where there are none.
    images: tuple[Path | None, ...] = ()
    store: ImageStore | None = None  # Where these are, if they are no files.
    # (n,) the corners of the whole board in each row, (k, 2) [px] by their numbers, where another
    # program found them; None in a row without, empty where there are none.
    corners: tuple[FloatArray | None, ...] = ()
    # (n, j) joint angles [rad], NaN in a row without; None where they were not recorded.
    joints_rad: FloatArray | None = None
    stamps_s: FloatArray | None = None  # (n,) times [s]; None where they were not recorded.
    mount: Mount | None = None  # How the camera is mounted, where the source states it.
    # The content of a target's `.toml`, where the source describes one.
    target: Mapping[str, Any] | None = None
    # The fields of `[camera]` in session.toml, where the source has intrinsics.
    lens: Mapping[str, Any] | None = None
    # The same of `[cameras.NAME]`, of several.
    lenses: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    # The fields of `[instrument]`.
    instrument: Mapping[str, Any] | None = None
    # The robot's description, where the source holds it; see `Robot.from_document`.
    robot_document: Mapping[str, Any] | None = None
    # The fields of `[robot]` in session.toml, where the user or a URDF beside names a robot.
    arm: Mapping[str, Any] | None = None
    views: tuple[int, ...] = ()  # (n,) the rows' numbers in the source; 0, 1, ... where empty.
    # The robot's poses, where they are not those of the rows but a stream beside them.
    stream: ForeignStream | None = None
    # The form of the robot's poses, where the user or the source states a maker's.
    form: str = ""
    # Makers' forms whose names the robot's columns have.
    makers: tuple[str, ...] = ()
    # Further columns of views.csv with their (n,) cells.
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Assumptions and omissions, in sentences for the user.
    # The assumed reading of the poses of each side.
    unstated: Mapping[Side, Unstated] = field(default_factory=dict)
    # The same source otherwise read, the likeliest first; each with how unlikely it is beside this.
    rivals: tuple[tuple[int, "ForeignRecording"], ...] = ()
    doubt: DataError | None = None  # The error where nothing decides between these.
    fields: tuple[str, ...] = ()  # Those of the robot's poses.
    # The same error with the fields that it shall propose.
    proposing: Callable[[Sequence[str]], DataError] | None = None
    title: str = ""  # The session's name, where it is not that of the source.


def frames_to_take(
    order: IntArray, still: IntArray, moved: Mask, most: int
) -> tuple[IntArray, str]:
    """The frames that become views: one a stop, or of a motion without stops evenly; and how.

    Args:
        order: (n,) numbers of all frames, by time.
        still: (m,) those at which the robot stood.
        moved: (m - 1,) whether it has moved from each of these to the next.
        most: Most frames of a motion without stops.
    """
    runs = np.split(still, np.flatnonzero(moved) + 1)
    if len(runs) >= 5:
        # The middle of each rest, where clocks that differ a little have no effect.
        chosen, how = np.array([run[len(run) // 2] for run in runs]), "one a stop of the robot"
    else:
        chosen, how = order[evenly(len(order), most)], "of a motion without stops"
    return chosen, f"{len(chosen)} of {len(order)} frames are views, {how}."


def rows_of(foreign: ForeignRecording, rows: IntArray) -> ForeignRecording:
    """The given rows of a recording, in the given order."""
    views = foreign.views or tuple(range(len(foreign.robot)))
    return replace(
        chosen_rows(replace(foreign, views=views), rows, "notes", "rivals", "makers", "fields"),
        robot=foreign.robot.rows(rows),
        camera=None if foreign.camera is None else foreign.camera.rows(rows),
        columns={
            name: tuple(cells[index] for index in rows) for name, cells in foreign.columns.items()
        },
    )


@dataclass(frozen=True)
class ForeignFormat:
    """A foreign format of recordings, which is read and never written."""

    name: str  # Its name on the command line.
    words: str  # Its description, for messages.
    # Whether an existing path looks like this format; never raises DataError.
    recognises: Callable[[Path], bool]
    # Reads the recording at a path, with the user's options for its poses already applied.
    read: Callable[[Path, ImportOptions], ForeignRecording]

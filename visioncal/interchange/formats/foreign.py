"""A foreign recording as its numbers are written, and the description of a foreign format."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from visioncal.core.conventions import PoseNumbers
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.interchange.formats.import_options import ImportOptions


@dataclass(frozen=True, eq=False)
class ForeignSweep:
    """Two streams of one motion, each with its own clock.

    Attributes:
        robot_s: (n,) times [s], ascending.
        robot: (n,) `base_from_flange`.
        camera_s: (k,) times [s], ascending.
        camera: (k,) `cam_from_target`.
    """

    robot_s: FloatArray
    robot: PoseNumbers
    camera_s: FloatArray
    camera: PoseNumbers


@dataclass(frozen=True, eq=False)
class FoundCorners:
    """Corners found by another program in one image: (k,) ids on the target, (k, 2) pixels [px]."""

    ids: IntArray
    px: FloatArray


@dataclass(frozen=True, eq=False)
class ForeignRecording:
    """A recording in a foreign format: n rows, each an observation at one robot pose.

    Attributes:
        robot: `base_from_flange` of each row.
        camera: `cam_from_target` of each row; None where images are used instead.
        images: (n,) the image of each row; None in a row without one, empty where there are none.
        corners: (n,) corners found by another program in each row's image; None in a row without,
            empty where there are none.
        joints_rad: (n, j) joint angles [rad], NaN in a row without; None where they were not
            recorded.
        stamps_s: (n,) times [s]; None where they were not recorded.
        mount: How the camera is mounted, where the source states it.
        target: The content of a target's `.toml`, where the source describes one.
        lens: The fields of `[camera]` in session.toml, where the source has intrinsics.
        arm: The fields of `[robot]` in session.toml, where the user names a robot.
        views: (n,) the rows' numbers in the source; 0, 1, ... where empty.
        sweep: Two streams with separate clocks, of which the rows are a sample; None where the
            source has one clock.
        columns: Further columns of views.csv with their (n,) cells.
        notes: Assumptions and omissions, in sentences for the user.
    """

    name: str
    robot: PoseNumbers
    camera: PoseNumbers | None = None
    images: tuple[Path | None, ...] = ()
    corners: tuple[FoundCorners | None, ...] = ()
    joints_rad: FloatArray | None = None
    stamps_s: FloatArray | None = None
    mount: Mount | None = None
    target: Mapping[str, Any] | None = None
    lens: Mapping[str, Any] | None = None
    arm: Mapping[str, Any] | None = None
    views: tuple[int, ...] = ()
    sweep: ForeignSweep | None = None
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def rows_of(foreign: ForeignRecording, rows: IntArray) -> ForeignRecording:
    """Some rows of a recording, in the given order."""
    count = len(foreign.robot)
    return replace(
        foreign,
        robot=foreign.robot.rows(rows),
        camera=None if foreign.camera is None else foreign.camera.rows(rows),
        images=tuple(foreign.images[index] for index in rows) if foreign.images else (),
        corners=tuple(foreign.corners[index] for index in rows) if foreign.corners else (),
        joints_rad=None if foreign.joints_rad is None else foreign.joints_rad[rows],
        stamps_s=None if foreign.stamps_s is None else foreign.stamps_s[rows],
        views=tuple((foreign.views or tuple(range(count)))[index] for index in rows),
        columns={
            name: tuple(cells[index] for index in rows) for name, cells in foreign.columns.items()
        },
    )


@dataclass(frozen=True)
class ForeignFormat:
    """A foreign format of recordings, which is read and never written.

    Attributes:
        name: Its name on the command line.
        words: Its description, for messages.
        recognises: Whether an existing path looks like this format; never raises DataError.
        read: Reads the recording at a path, with the user's options for its poses already applied.
    """

    name: str
    words: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, ImportOptions], ForeignRecording]

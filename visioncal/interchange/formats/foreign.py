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
    """Two streams of one motion, each with its own clock."""

    robot_s: FloatArray  # (n,) times [s], ascending.
    robot: PoseNumbers  # (n,) `base_from_flange`.
    camera_s: FloatArray  # (k,) times [s], ascending.
    camera: PoseNumbers  # (k,) `cam_from_target`.


@dataclass(frozen=True, eq=False)
class FoundCorners:
    """Corners found by another program in one image: (k,) ids on the target, (k, 2) pixels [px]."""

    ids: IntArray
    px: FloatArray


@dataclass(frozen=True, eq=False)
class ForeignRecording:
    """A recording in a foreign format: n rows, each an observation at one robot pose."""

    name: str
    robot: PoseNumbers  # `base_from_flange` of each row.
    # `cam_from_target` of each row; None where images are used instead.
    camera: PoseNumbers | None = None
    # (n,) the image of each row; None in a row without one, empty where there are none.
    images: tuple[Path | None, ...] = ()
    # (n,) corners found by another program in each row's image; None in a row without, empty where
    # there are none.
    corners: tuple[FoundCorners | None, ...] = ()
    # (n, j) joint angles [rad], NaN in a row without; None where they were not recorded.
    joints_rad: FloatArray | None = None
    stamps_s: FloatArray | None = None  # (n,) times [s]; None where they were not recorded.
    mount: Mount | None = None  # How the camera is mounted, where the source states it.
    # The content of a target's `.toml`, where the source describes one.
    target: Mapping[str, Any] | None = None
    # The fields of `[camera]` in session.toml, where the source has intrinsics.
    lens: Mapping[str, Any] | None = None
    # The fields of `[robot]` in session.toml, where the user names a robot.
    arm: Mapping[str, Any] | None = None
    views: tuple[int, ...] = ()  # (n,) the rows' numbers in the source; 0, 1, ... where empty.
    # Two streams with separate clocks, of which the rows are a sample; None where the source has
    # one clock.
    sweep: ForeignSweep | None = None
    # Further columns of views.csv with their (n,) cells.
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Assumptions and omissions, in sentences for the user.


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
    """A foreign format of recordings, which is read and never written."""

    name: str  # Its name on the command line.
    words: str  # Its description, for messages.
    # Whether an existing path looks like this format; never raises DataError.
    recognises: Callable[[Path], bool]
    # Reads the recording at a path, with the user's options for its poses already applied.
    read: Callable[[Path, ImportOptions], ForeignRecording]

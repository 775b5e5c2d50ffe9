"""What every camera of a cell saw: its corners, its lens, and the poses that each image allows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.alignment.cell import Cell
from visioncal.alignment.reading import readings
from visioncal.errors import DataError, VisioncalError
from visioncal.session import Session, View, frame_name
from visioncal.session.tables import CameraTable
from visioncal.stages.detect import detect
from visioncal.stages.intrinsics import estimate_intrinsics
from visioncal.stages.pnp import ViewPoses, estimate_poses, given_poses
from visioncal.targets import first_corners
from visioncal.types import Camera, Corners, Progress


@dataclass(frozen=True, eq=False)
class CameraLook:
    """What one camera saw.

    Attributes:
        table: What the session says of it.
        camera: Its intrinsics, as stated or estimated.
        estimated: Whether they were estimated from its images.
        views: The poses of its images, those of its lens alone among them.
    """

    table: CameraTable
    camera: Camera
    estimated: bool
    views: tuple[ViewPoses, ...]


@dataclass(frozen=True, eq=False)
class Looked:
    """What all cameras saw.

    Attributes:
        cameras: By the camera's frame.
        poses: The poses of all views, with those that the session gives itself and what
            instruments read.
        reasons: Why views cannot be used.
        warnings: What the images do not determine, in words.
    """

    cameras: Mapping[str, CameraLook]
    poses: Mapping[int, ViewPoses]
    reasons: Mapping[int, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def look_around(
    cell: Cell, corners: Mapping[int, Corners] | None, progress: Progress | None
) -> Looked:
    """Looks at all images.

    Args:
        cell: The cell.
        corners: What was found before, by view, each by its own board's numbers; None to look.
        progress: Told of images.

    Raises:
        DataError: A camera's images are of another size, or too few to estimate its lens.
    """
    session = cell.session
    looked = Looked({}, {**given_poses(session), **readings(cell)})
    for name, table in session.cameras.items():
        frame = frame_name("camera", name)
        mine = _images_of(session, frame)
        if mine:
            looked = _with_camera(session, looked, frame, table, mine, corners, progress)
    return looked


def _images_of(session: Session, frame: str) -> list[View]:
    seers = {it.view.number: it.seer for it in session.observations}
    seen = (it for it in session.views if it.image or it.has_corners)
    return [it for it in seen if seers.get(it.number) == frame]


def _with_camera(
    session: Session,
    looked: Looked,
    frame: str,
    table: CameraTable,
    views: Sequence[View],
    corners: Mapping[int, Corners] | None,
    progress: Progress | None,
) -> Looked:
    targets = tuple(session.boards.values())
    resolution = None if table.resolution is None else (table.resolution[0], table.resolution[1])
    reasons: dict[int, str] = {}
    if corners is None:
        found = detect(session, progress=progress, among=views)
        reasons |= {it.view: it.reason for it in found.rejections}
        _check_resolution(frame, resolution, found.resolution)
        resolution, corners = found.resolution, found.corners
    mine = _numbered_through(session, views, corners)
    if not mine or resolution is None:
        return replace(looked, reasons={**looked.reasons, **reasons})
    camera, unknowns = stated_camera(table, resolution), 0
    warnings: tuple[str, ...] = ()
    estimated = camera is None
    try:
        if camera is None:
            lens = estimate_intrinsics(mine, targets, resolution, table.model)
            camera, unknowns, warnings = lens.camera, len(lens.covariance), lens.warnings
            mine = {it: mine[it] for it in mine if it not in {bad.view for bad in lens.rejections}}
            reasons |= {it.view: it.reason for it in lens.rejections}
        poses = estimate_poses(mine, targets, camera, unknowns)
    except VisioncalError as error:
        raise type(error)(
            f"{frame}: {error.message}", culprits=error.culprits, next_step=error.next_step
        ) from error
    reasons |= {it.view: it.reason for it in poses.rejections}
    look = CameraLook(table, camera, estimated, poses.views)
    return Looked(
        {**looked.cameras, frame: look},
        {**looked.poses, **{it.view: it for it in poses.views}},
        {**looked.reasons, **reasons},
        (*looked.warnings, *(f"{frame}: {it}" for it in warnings)),
    )


def _numbered_through(
    session: Session, views: Sequence[View], corners: Mapping[int, Corners]
) -> dict[int, Corners]:
    """The corners of some views, those of several boards numbered through."""
    starts = dict(
        zip(session.boards, first_corners(tuple(session.boards.values())).tolist(), strict=True)
    )
    mine = [it for it in views if it.number in corners]
    first = {it.number: starts[session.board_of(it)] for it in mine}
    return {it: replace(corners[it], ids=corners[it].ids + first[it]) for it in first}


def stated_camera(table: CameraTable, resolution: tuple[int, int]) -> Camera | None:
    """The intrinsics as they are stated; None where they are to be estimated."""
    if table.matrix is None or table.distortion is None:
        return None
    matrix, distortion = np.array(table.matrix, float), np.array(table.distortion, float)
    return Camera(table.model, resolution, matrix, distortion)


def _check_resolution(frame: str, stated: tuple[int, int] | None, found: tuple[int, int]) -> None:
    if stated is not None and stated != found:
        raise DataError(
            f"{frame}: its images are {found[0]} x {found[1]} px, but its resolution is stated as "
            f"{stated[0]} x {stated[1]} px.",
            culprits=[f"session.toml: cameras, {frame}: resolution"],
            next_step="Correct the resolution, or the column camera of these rows.",
        )

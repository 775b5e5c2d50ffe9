"""Sessions from arrays in memory: images, corners and poses."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypedDict, Unpack

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from visioncal.core.errors import DataError
from visioncal.core.number_format import known_name
from visioncal.core.transforms import LAST_ROW, rigid_fault
from visioncal.core.types import Camera, FloatArray, Image, Image16, IntArray, Mount, Target
from visioncal.session.columns import POSE
from visioncal.session.corners import CornerTable
from visioncal.session.images import MemoryImages
from visioncal.vision.boards.imaging import encode_png
from visioncal.vision.targets import target_document

Poses: TypeAlias = RigidTransform | FloatArray | Sequence[RigidTransform]
_KEPT_PLACE = (
    "A view in which nothing was found keeps its place: give (None, None) for its corners."
)


class CellArguments(TypedDict, total=False):
    """Optional arguments that describe a cell."""

    mount: Mount  # Mount of the camera; eye-in-hand by default.
    camera: Camera | Mapping[str, Any]  # Its intrinsics, as in session.toml; estimated by default.
    robot: str  # The robot's model, by a built-in name.
    q: npt.ArrayLike  # (n, j) joint angles [rad].
    name: str  # The session's name.


def of_images(
    images: Sequence[Image | Image16 | bytes],
    poses: Poses,
    board: Target | str,
    **cell: Unpack[CellArguments],
) -> dict[str, Any]:
    """Arguments of `Session.assemble` for images; see `Session.from_arrays`."""
    matrices = _matrices(poses, "images", len(images))
    paths = [f"images/{at:03d}.png" for at in range(len(images))]
    files = {
        path: image if isinstance(image, bytes) else encode_png(image)
        for path, image in zip(paths, images, strict=True)
    }
    return _content(matrices, board, cell, {"image": paths}, MemoryImages(files))


def of_corners(
    corners: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    poses: Poses,
    board: Target | str,
    resolution: tuple[int, int],
    **cell: Unpack[CellArguments],
) -> dict[str, Any]:
    """Arguments of `Session.assemble` for corners; see `Session.from_corners`."""
    matrices = _matrices(poses, "corners", len(corners))
    table = CornerTable.of_lists([_corners(at, *corner) for at, corner in enumerate(corners)])
    content = _content(matrices, board, cell, {}, MemoryImages({}), resolution)
    return {**content, "corners": table}


def _corners(view: int, ids: npt.ArrayLike, px: npt.ArrayLike) -> tuple[int, IntArray, FloatArray]:
    """Checked numbers (k,) and positions (k, 2) of a view's corners; None counts as no corners."""
    name = f"corners[{view}]"
    numbers = np.asarray([] if ids is None else ids)
    places = np.asarray([] if px is None else px, dtype=float)
    if places.size != 2 * numbers.size or (places.size and places.shape[-1] != 2):
        raise DataError(
            f"{name}: {numbers.size} ids and px of the shape {places.shape}; (k,) ids and (k, 2) "
            "px are needed, one place for each id.",
            culprits=[name],
            next_step="Take both from one call of the detector.",
        )
    numbers, places = numbers.ravel(), places.reshape(-1, 2)
    if not np.array_equal(numbers, np.floor(numbers)):
        raise DataError(f"{name}: its ids are no whole numbers.", culprits=[name])
    if not np.isfinite(places).all():
        raise DataError(
            f"{name}: px has numbers that are not finite.",
            culprits=[name],
            next_step="Leave corners that were not found out of ids and px.",
        )
    return view, numbers.astype(np.int64), places


def _matrices(poses: Poses, what: str, count: int) -> FloatArray:
    """(n, 4, 4) the checked poses of the views."""
    given = poses.as_matrix() if isinstance(poses, RigidTransform) else poses
    matrices = [
        np.array(value.as_matrix() if isinstance(value, RigidTransform) else value, float)
        for value in given
    ]
    if len(matrices) != count:
        raise DataError(
            f"{count} {what} and {len(matrices)} poses in base_from_flange: each view has one of "
            "each, in the same order.",
            culprits=[what, "base_from_flange"],
            next_step=_KEPT_PLACE if what == "corners" else "",
        )
    for at, matrix in enumerate(matrices):
        # Entries may be rounded to three decimals.
        if fault := rigid_fault(matrix, 5e-3):
            name = f"base_from_flange[{at}]"
            raise DataError(f"{name} must be a rigid transform, but {fault}.", culprits=[name])
    stacked = np.array(matrices).reshape(-1, 4, 4)
    stacked[:, 3] = LAST_ROW
    return stacked


def _content(
    matrices: FloatArray,
    board: Target | str,
    cell: CellArguments,
    columns: Mapping[str, Sequence[str]],
    images: MemoryImages,
    resolution: tuple[int, int] | None = None,
) -> dict[str, Any]:
    count, known = len(matrices), [*CellArguments.__annotations__]
    for name in cell.keys() - known:
        known_name("argument", name, known)
    if not count:
        raise DataError("There are no views.", culprits=["base_from_flange"])
    q = np.asarray(cell.get("q", np.zeros((count, 0))), dtype=float)
    if q.ndim != 2 or len(q) != count:
        raise DataError(
            f"q has the shape {q.shape} beside {count} poses, but must have (n, j), the joint "
            "angles [rad] of each view.",
            culprits=["q"],
        )
    camera: Camera | Mapping[str, Any] | None = cell.get("camera")
    if camera is None:
        camera = {} if resolution is None else {"resolution": resolution}
    elif isinstance(camera, Camera):
        camera = vars(camera)
    document: dict[str, Any] = {
        "schema": 1,
        "name": cell.get("name", "session"),
        "mount": cell.get("mount", "eye-in-hand"),
        "camera": {
            str(name): np.asarray(value).tolist()
            for name, value in camera.items()
            if value is not None
        },
    }
    document["target"] = "target.toml" if isinstance(board, Target) else board
    transforms = RigidTransform.from_matrix(matrices)
    numbers = np.hstack([transforms.translation, transforms.rotation.as_quat()])
    names = ["view", *columns, *POSE]
    names += [f"q{at}_rad" for at in range(1, q.shape[1] + 1)]
    if "robot" in cell:
        document["robot"] = {"model": cell["robot"]}
    rows = [
        [str(at), *(column[at] for column in columns.values()), *map(repr, [*pose, *joints])]
        for at, (pose, joints) in enumerate(zip(numbers.tolist(), q.tolist(), strict=True))
    ]
    return {
        "document": document,
        "columns": names,
        "cells": rows,
        "images": images,
        "target_document": target_document(board) if isinstance(board, Target) else None,
        "corners": None,
    }

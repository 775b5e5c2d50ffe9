"""Sessions of what a program has in memory: arrays of images, corners and poses."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypedDict, Unpack

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform

from visioncal.core.errors import DataError
from visioncal.core.types import Camera, FloatArray, Image, Mount, Target
from visioncal.session.columns import POSE
from visioncal.session.corners import CornerTable
from visioncal.session.images import MemoryImages
from visioncal.vision.finders.imaging import encode_png
from visioncal.vision.targets import target_document

Poses: TypeAlias = RigidTransform | FloatArray


class Cell(TypedDict, total=False):
    """What else is known of a cell.

    Attributes:
        mount: Where the camera is; eye-in-hand where left out.
        camera: Its intrinsics; left out, they are estimated.
        robot: The robot's model, by a built-in name.
        q: (n, j) joint angles [rad].
        name: The session's name.
    """

    mount: Mount
    camera: Camera
    robot: str
    q: npt.ArrayLike
    name: str


class Facts(TypedDict):
    """What `Session.assemble` takes."""

    document: Mapping[str, Any]
    columns: Sequence[str]
    cells: Sequence[Sequence[str]]
    images: MemoryImages
    target_document: Mapping[str, Any] | None
    corners: CornerTable | None


def of_images(
    images: Sequence[Image | bytes], poses: Poses, board: Target | str, **cell: Unpack[Cell]
) -> Facts:
    """The facts of a session of images; see `Session.from_arrays`."""
    paths = [f"images/{at:03d}.png" for at in range(len(images))]
    files = {
        path: it if isinstance(it, bytes) else encode_png(it)
        for path, it in zip(paths, images, strict=True)
    }
    return _facts(poses, board, cell, {"image": paths}, MemoryImages(files))


def of_corners(
    corners: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    poses: Poses,
    board: Target | str,
    resolution: tuple[int, int],
    **cell: Unpack[Cell],
) -> Facts:
    """The facts of a session of corners; see `Session.from_corners`."""
    points = [np.asarray(ids, dtype=np.int64).ravel() for ids, _ in corners]
    table = CornerTable(
        np.repeat(np.arange(len(points)), [len(it) for it in points]),
        np.concatenate(points) if points else np.zeros(0, dtype=np.int64),
        np.concatenate([np.asarray(px, dtype=float).reshape(-1, 2) for _, px in corners]),
        ("",) * sum(map(len, points)),
    )
    facts = _facts(poses, board, cell, {}, MemoryImages({}), resolution)
    return {**facts, "corners": table}


def _facts(
    poses: Poses,
    board: Target | str,
    cell: Cell,
    columns: Mapping[str, Sequence[str]],
    images: MemoryImages,
    resolution: tuple[int, int] | None = None,
) -> Facts:
    matrices = poses.as_matrix() if isinstance(poses, RigidTransform) else np.asarray(poses, float)
    count = len(matrices) if matrices.ndim == 3 else 0
    if matrices.shape != (count, 4, 4) or any(len(it) != count for it in columns.values()):
        seen = ", ".join(f"{len(it)} of {name}" for name, it in columns.items())
        raise DataError(
            f"base_from_flange has the shape {matrices.shape}, beside {seen or 'the corners'}; "
            "(n, 4, 4) is needed, one pose a view.",
            culprits=["base_from_flange"],
        )
    document: dict[str, Any] = {
        "schema": 1,
        "name": cell.get("name", "session"),
        "mount": cell.get("mount", "eye-in-hand"),
        "camera": _camera(cell.get("camera"), resolution),
    }
    if isinstance(board, Target):
        document["target"] = "target.toml"
    else:
        document["target"] = board
    transforms = RigidTransform.from_matrix(matrices)
    numbers = np.hstack([transforms.translation, transforms.rotation.as_quat()])
    names = ["view", *columns, *POSE]
    q = np.asarray(cell.get("q", np.zeros((count, 0))), dtype=float).reshape(count, -1)
    names += [f"q{at}_rad" for at in range(1, q.shape[1] + 1)]
    if "robot" in cell:
        document["robot"] = {"model": cell["robot"]}
    rows = [
        [str(at), *(it[at] for it in columns.values()), *map(repr, [*pose, *joints])]
        for at, (pose, joints) in enumerate(zip(numbers.tolist(), q.tolist(), strict=True))
    ]
    content = target_document(board) if isinstance(board, Target) else None
    return {
        "document": document,
        "columns": names,
        "cells": rows,
        "images": images,
        "target_document": content,
        "corners": None,
    }


def _camera(camera: Camera | None, resolution: tuple[int, int] | None) -> dict[str, Any]:
    if camera is None:
        return {} if resolution is None else {"resolution": list(resolution)}
    return {
        "resolution": list(camera.resolution),
        "model": camera.model,
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
    }

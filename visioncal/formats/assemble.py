"""A session out of what someone else recorded."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.conventions import PoseNumbers, Reading
from visioncal.documents import is_number
from visioncal.errors import DataError
from visioncal.files import read_bytes
from visioncal.formats.boards import described_target, target_name
from visioncal.formats.foreign import Foreign, rows_of
from visioncal.formats.intrinsics import read_intrinsics
from visioncal.formats.wishes import Wishes
from visioncal.robot import read_robot_document
from visioncal.session import MemoryImages, Session
from visioncal.session import columns as known
from visioncal.types import Mask, Mount

# Quaternions nearer to unit length than this are kept as they are written.
_UNIT_NORM = 1e-3


@dataclass(frozen=True, eq=False)
class FileImages:
    """Images that lie anywhere, by the paths that the session gives them."""

    files: Mapping[str, Path]

    def read(self, path: str) -> bytes:
        """Reads the bytes of one image file."""
        if path not in self.files:
            raise DataError(f"The session has no image {path}.", culprits=[path])
        return read_bytes(self.files[path])

    def exists(self, path: str) -> bool:
        """Tells whether there is such an image."""
        return path in self.files and self.files[path].is_file()


def wished(foreign: Foreign, wishes: Wishes) -> Foreign:
    """Changes a recording into what the user says of it.

    Raises:
        DataError: A name that the user gives is not known, or a file that he names is wrong.
    """
    foreign = replace(foreign, robot=wishes.robot.applied_to(foreign.robot))
    if foreign.camera is not None:
        foreign = replace(foreign, camera=wishes.camera.applied_to(foreign.camera))
    if wishes.mount is not None:
        foreign = replace(foreign, mount=wishes.mount)
    if wishes.target is not None:
        foreign = replace(foreign, target=described_target(wishes.target))
    if wishes.robot_model is not None or wishes.tip is not None:
        arm = dict(foreign.arm or {})
        arm |= {"model": wishes.robot_model} if wishes.robot_model is not None else {}
        arm |= {"tip": wishes.tip} if wishes.tip is not None else {}
        if "model" not in arm:
            raise DataError("--tip needs the robot that it is of; name it with --robot-model.")
        foreign = replace(foreign, arm=arm)
    return replace(foreign, lens=_lens(foreign, wishes))


def _lens(foreign: Foreign, wishes: Wishes) -> Mapping[str, Any] | None:
    lens = dict(foreign.lens or {})
    if wishes.intrinsics == "estimate":
        lens = {it: lens[it] for it in ("name", "model", "resolution") if it in lens}
    elif wishes.intrinsics is not None:
        lens = read_intrinsics(Path(wishes.intrinsics))
    if wishes.resolution is not None:
        lens["resolution"] = list(wishes.resolution)
    return lens or None


def assemble(foreign: Foreign, *, mount: Mount | None = None) -> Session:
    """Builds the session of a recording, as its numbers are read and its mount is stated.

    Args:
        foreign: The recording; `replace` it to try another reading, mount or order of rows.
        mount: Taken where the recording states none.

    Returns:
        The session; what was assumed stands among its warnings.

    Raises:
        DataError: No mount is known, no row says what the camera saw, or a number is wrong.
    """
    mount = foreign.mount or mount
    if mount is None:
        raise DataError(
            f"{foreign.name}: how the camera is mounted is not known.",
            culprits=["mount"],
            next_step="Say --mount eye-in-hand or --mount eye-to-hand.",
        )
    foreign = spoken(foreign)
    rows = _written(foreign)
    document: dict[str, Any] = {"schema": 1, "name": foreign.name, "mount": mount}
    files = {path: file for row in rows for path, file in row.image.items()}
    if files:
        document["camera"] = _camera(foreign, list(files.values()))
    target = foreign.target if files else None
    if target is not None:
        document["target"] = target_name(target) or "target.toml"
    robot = _robot(foreign, document)
    if foreign.camera_minus_robot_s:
        document["clock"] = {"camera_minus_robot_s": foreign.camera_minus_robot_s}
    columns = list(dict.fromkeys(name for row in rows for name in row.cells))
    cells = [[row.cells.get(name, "") for name in columns] for row in rows]
    session = Session.assemble(
        document,
        columns,
        cells,
        FileImages(files) if files else MemoryImages({}),
        target_document=target,
        robot_document=robot,
    )
    notes = list(foreign.notes)
    missing = [file.name for path, file in files.items() if not session.images.exists(path)]
    if missing:
        notes.append(f"{len(missing)} of {len(files)} images are missing: {_some(missing)}.")
    return replace(session, warnings=(*notes, *session.warnings))


@dataclass(frozen=True)
class _Row:
    """One row of views.csv, and the file of its image by the path in the session."""

    cells: dict[str, str]
    image: dict[str, Path]


def spoken(foreign: Foreign) -> Foreign:
    """Leaves out the rows that say nothing, and what of the others is not used.

    Raises:
        DataError: No row says what a camera saw, or images show a target that is not known.
    """
    notes: list[str] = []
    foreign = _with_one_witness(foreign, notes)
    points = foreign.columns.get("point", ())
    saw = np.zeros(len(foreign.robot), dtype=bool)
    for cells in (foreign.images, points):
        saw |= np.array([bool(it) for it in cells] or [False])
    if foreign.camera is not None:
        numbers = np.hstack([foreign.camera.positions, foreign.camera.rotations])
        saw |= np.isfinite(numbers).all(axis=1)
    silent = [foreign.robot.places[it] for it in np.flatnonzero(~saw)]
    if len(silent) == len(saw):
        raise DataError(
            f"{foreign.name} has {len(saw)} poses of the robot, but neither images nor poses of "
            "the target: nothing says what a camera saw.",
            culprits=[foreign.robot.places[0]],
            next_step="Name the images with --images, or the target's poses with --camera-columns "
            "or --camera-file. Touches of a point need a column `point`.",
        )
    if silent:
        notes.append(
            f"{len(silent)} of {len(saw)} rows are left out, as they have neither an image nor a "
            f"pose of the target: {_some(silent)}."
        )
    return replace(rows_of(foreign, np.flatnonzero(saw)), notes=(*foreign.notes, *notes))


def _with_one_witness(foreign: Foreign, notes: list[str]) -> Foreign:
    """Chooses between images and stored poses of the target where there are both."""
    if not foreign.images:
        return foreign
    if foreign.target is not None:
        if foreign.camera is not None:
            notes.append(
                "The stored poses of the target are left aside: the images tell them better."
            )
        return replace(foreign, camera=None)
    if foreign.camera is None:
        raise DataError(
            f"{foreign.name} has images, but what target they show is not known.",
            culprits=["target"],
            next_step="Say --target with a name in targets/, a .toml, or a description such as "
            "checkerboard_9x6_23.6mm.",
        )
    notes.append("The images are left aside: no --target says what they show.")
    return replace(foreign, images=())


def _written(foreign: Foreign) -> list[_Row]:
    count = len(foreign.robot)
    images = _image_paths(foreign)
    robot = pose_cells(foreign.robot, known.POSE)
    camera: list[dict[str, str]] = [{}] * count
    if foreign.camera is not None:
        camera = pose_cells(foreign.camera, known.MEASURED_CAM_POSE)
    extra = _extra_columns(foreign)
    rows = []
    for at in range(count):
        image = images[at]
        cells = {"view": str(foreign.views[at] if foreign.views else at)}
        if foreign.images:
            cells["image"] = "" if image is None else image[0]
        cells |= _scalars(foreign, at) | robot[at] | camera[at]
        cells |= {name: column[at] for name, column in extra.items()}
        rows.append(_Row(cells, dict([image]) if image is not None else {}))
    return rows


def _scalars(foreign: Foreign, at: int) -> dict[str, str]:
    cells = {}
    if foreign.stamps_s is not None and np.isfinite(foreign.stamps_s[at]):
        cells["stamp_s"] = repr(float(foreign.stamps_s[at]))
    if foreign.joints_rad is not None:
        for number, angle in enumerate(foreign.joints_rad[at], start=1):
            cells[f"q{number}_rad"] = repr(float(angle))
    return cells


def pose_cells(numbers: PoseNumbers, names: Sequence[str]) -> list[dict[str, str]]:
    """Writes poses so that reading them gives the same numbers; nothing for a row without one."""
    poses = numbers.poses()
    values = np.full((len(numbers), 7), np.nan)
    there: Mask = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    if there.any():
        transforms = RigidTransform.from_matrix(poses[there])
        values[there] = np.hstack([transforms.translation, transforms.rotation.as_quat()])
    if numbers.reading == Reading():
        # Written as our own are: nothing is computed where the numbers can stay as they are.
        norms = np.linalg.norm(numbers.rotations, axis=1, keepdims=True)
        stated = np.hstack([numbers.positions, numbers.rotations])
        values = np.where(np.abs(norms - 1.0) < _UNIT_NORM, stated, values)
    return [
        dict(zip(names, (repr(float(it)) for it in row), strict=True)) if is_pose else {}
        for row, is_pose in zip(values, there, strict=True)
    ]


def _extra_columns(foreign: Foreign) -> dict[str, tuple[str, ...]]:
    """Names the other columns so that none is taken for one of ours that it is not."""
    written = {"view", "image", "stamp_s", *known.POSE, *known.MEASURED_CAM_POSE}
    written |= set(known.joint_columns(tuple(foreign.columns)))
    return {
        name if name not in written and _is_meant(name, cells) else f"source_{name}": cells
        for name, cells in foreign.columns.items()
    }


def _is_meant(name: str, cells: Sequence[str]) -> bool:
    """Tells whether a column with a name that sessions know holds what they mean by it."""
    filled = {it for it in cells if it}
    if name == "role":
        return filled <= {"fit", "holdout"}
    if name == "stop":
        return all(it.isascii() and it.isdecimal() and len(it) < 10 for it in filled)
    if name in known.SELECTORS:
        return len(filled) < 2
    finite = (is_number(it) and np.isfinite(float(it)) for it in filled)
    return not known.is_number(name) or all(finite)


def _image_paths(foreign: Foreign) -> list[tuple[str, Path] | None]:
    """Names the images in the session; images of one name from several folders get a number."""
    if not foreign.images:
        return [None] * len(foreign.robot)
    names = Counter(it.name for it in set(foreign.images) if it is not None)
    paths: list[tuple[str, Path] | None] = []
    for at, file in enumerate(foreign.images):
        if file is None:
            paths.append(None)
            continue
        name = file.name if names[file.name] == 1 else f"{at}_{file.name}"
        paths.append((f"images/{name}", file))
    return paths


def _camera(foreign: Foreign, files: Sequence[Path]) -> dict[str, Any]:
    lens = {it: value for it, value in (foreign.lens or {}).items() if value is not None}
    if "resolution" not in lens:
        size = next((it for file in files if (it := _image_size(file)) is not None), None)
        if size is not None:
            lens["resolution"] = list(size)
        elif "matrix" in lens:
            raise DataError(
                f"{foreign.name}: the intrinsics do not say for which size of image they hold, and "
                "no image can be read.",
                culprits=["resolution"],
                next_step="Say --resolution WIDTH,HEIGHT.",
            )
    return lens


def _image_size(file: Path) -> tuple[int, int] | None:
    if not file.is_file():
        return None
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(read_bytes(file), np.uint8), flags)
    return None if image is None else (int(image.shape[1]), int(image.shape[0]))


def _robot(foreign: Foreign, document: dict[str, Any]) -> dict[str, Any] | None:
    """Names the robot's model in the document, and reads it."""
    if foreign.arm is None:
        return None
    arm = {it: str(value) for it, value in foreign.arm.items()}
    robot = read_robot_document(arm["model"], tip=arm.get("tip"))
    suffix = Path(arm["model"]).suffix.lower()
    document["robot"] = arm | ({"model": f"robot{suffix}"} if suffix in (".toml", ".urdf") else {})
    return robot


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")

"""Sessions that are broken in the usual ways: what people get wrong in their first hour.

Every mistake is planted into the same sound session of rendered images, as files that a user would
have: a table without joint angles, and a session.toml.
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation
from support.edited import Rows, edit_rows

from visioncal.simulation import CAMERAS, CellOptions, simulate, write_session

POSITION, QUATERNION = ("x_m", "y_m", "z_m"), ("qx", "qy", "qz", "qw")


_CELL = replace(CellOptions(), views=15, seed=11)


@dataclass(frozen=True)
class Mistake:
    """A mistake; without one, the cell itself is one, or nothing is wrong."""

    plant: Callable[[Path], object] = lambda _: None  # Breaks a sound session's folder.
    options: CellOptions = _CELL  # What the cell is otherwise like.
    joints: bool = False  # Whether its table has joint angles, and its session.toml a robot.


# Nothing is wrong, and pictures have a quarter of the pixels.
_LENS = CAMERAS["wide"]
SMALL = Mistake(
    options=replace(
        _CELL, camera=replace(_LENS, resolution=(640, 400), matrix=_LENS.matrix / 2), blur_px=0.5
    )
)


@cache
def _rendered(options: CellOptions) -> TemporaryDirectory:
    """A folder with the session of a cell: its images are rendered once a process."""
    made = TemporaryDirectory()
    write_session(simulate(options), Path(made.name) / "session")
    return made


def sound_session(folder: Path, mistake: Mistake | None = None) -> Path:
    """Writes the session into which a mistake is planted."""
    mistake = mistake or Mistake()
    shutil.copytree(Path(_rendered(mistake.options).name) / "session", folder)
    if not mistake.joints:
        edit(folder, lambda text: text.replace('[robot]\nmodel = "ur10e"\ntip = "flange"\n', ""))
        edit_rows(folder, lambda rows: [_without(row, "q1_rad", 6) for row in rows])
    return folder


def broken_session(folder: Path, mistake: Mistake) -> Path:
    """Writes a session with a mistake in it."""
    mistake.plant(sound_session(folder, mistake))
    return folder


def edit(folder: Path, change: Callable[[str], str], name: str = "session.toml") -> None:
    """Changes a text file of a session."""
    file = folder / name
    before = file.read_text("utf-8")
    after = change(before)
    assert after != before
    file.write_text(after, "utf-8")


def _without(row: dict[str, str], column: str, count: int = 1) -> dict[str, str]:
    names = [f"q{index}_rad" for index in range(1, count + 1)] if count > 1 else [column]
    return {name: cell for name, cell in row.items() if name not in names}


def _poses(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Changes the poses, as (n, 4, 4)."""

    def planted(folder: Path) -> None:
        def changed(rows: Rows) -> Rows:
            poses = np.tile(np.eye(4), (len(rows), 1, 1))
            poses[:, :3, 3] = _numbers(rows, POSITION)
            poses[:, :3, :3] = Rotation.from_quat(_numbers(rows, QUATERNION)).as_matrix()
            poses = change(poses)
            _write(rows, POSITION, poses[:, :3, 3])
            _write(rows, QUATERNION, Rotation.from_matrix(poses[:, :3, :3]).as_quat())
            return rows

        edit_rows(folder, changed)

    return planted


def _numbers(rows: Rows, names: tuple[str, ...]) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows])


def _write(rows: Rows, names: tuple[str, ...], numbers: np.ndarray) -> None:
    for row, values in zip(rows, numbers.tolist(), strict=True):
        row |= dict(zip(names, map(repr, values), strict=True))


def scaled(names: tuple[str, ...], factor: float) -> Callable[[Path], None]:
    def changed(rows: Rows) -> Rows:
        _write(rows, names, factor * _numbers(rows, names))
        return rows

    return lambda folder: edit_rows(folder, changed)


def _rotations(form: Callable[[Rotation], np.ndarray]) -> Callable[[Path], None]:
    """Writes rotations of another form into the columns of quaternions."""

    def changed(rows: Rows) -> Rows:
        numbers = form(Rotation.from_quat(_numbers(rows, QUATERNION)))
        padded = np.hstack([numbers, np.zeros((len(rows), 4 - numbers.shape[1]))])
        _write(rows, QUATERNION, padded)
        return rows

    return lambda folder: edit_rows(folder, changed)


def _rotation_vectors(folder: Path) -> None:
    """Columns rx, ry, rz as Universal Robots' controllers have them."""

    def changed(rows: Rows) -> Rows:
        vectors = Rotation.from_quat(_numbers(rows, QUATERNION)).as_rotvec()
        _write(rows, ("rx", "ry", "rz"), vectors)
        return [{k: name for k, name in row.items() if k not in QUATERNION} for row in rows]

    edit_rows(folder, changed)


def _renamed(names: Mapping[str, str]) -> Callable[[Path], None]:
    def changed(rows: Rows) -> Rows:
        return [{names.get(k, k): name for k, name in row.items()} for row in rows]

    return lambda folder: edit_rows(folder, changed)


def _moved_cells(order: Callable[[int], list[int]]) -> Callable[..., None]:
    """Puts poses into other rows."""

    def changed(rows: Rows) -> Rows:
        cells = [{name: row[name] for name in (*POSITION, *QUATERNION)} for row in rows]
        return [row | cells[index] for row, index in zip(rows, order(len(rows)), strict=True)]

    return lambda folder: edit_rows(folder, changed)


def _swapped(count: int) -> list[int]:
    return [0, 1, 2, 9, *range(4, 9), 3, *range(10, count)]


def _cell(column: str, at: tuple[int, ...], value: str) -> Callable[[Path], None]:
    def changed(rows: Rows) -> Rows:
        return [row | {column: value} if index in at else row for index, row in enumerate(rows)]

    return lambda folder: edit_rows(folder, changed)


def _text(change: Callable[[str], str]) -> Callable[[Path], None]:
    return lambda folder: edit(folder, change, "views.csv")


def _toml(old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: edit(folder, lambda text: text.replace(old, new))


def _bytes(change: Callable[[str], bytes]) -> Callable[[Path], None]:
    def planted(folder: Path) -> None:
        file = folder / "views.csv"
        file.write_bytes(change(file.read_text("utf-8")))

    return planted


def _german(text: str) -> str:
    return text.replace(",", ";").replace(".", ",").replace(",png", ".png")


def _images(
    change: Callable[[np.ndarray], np.ndarray], among: Callable[[int], bool] = lambda _: True
) -> Callable[[Path], None]:
    def planted(folder: Path) -> None:
        for at, file in enumerate(sorted((folder / "images").iterdir())):
            if among(at):
                cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)))

    return planted


def _smaller(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, (960, 600), interpolation=cv2.INTER_AREA)


def _deleted(folder: Path) -> None:
    for name in ("004.png", "009.png"):
        (folder / "images" / name).unlink()


def _as_jpg(folder: Path) -> None:
    for file in (folder / "images").iterdir():
        cv2.imwrite(str(file.with_suffix(".jpg")), cv2.imread(str(file)))
        file.unlink()


def _board(**changes: object) -> Callable[[Path], None]:
    """Declares a board of another make than the printed one, in a file beside the session."""
    declared = {"kind": "charuco", "columns": 9, "rows": 6, "square_m": 0.03}
    declared |= {"marker_m": 0.022, "dictionary": "DICT_5X5_100"} | changes
    if declared["kind"] == "checkerboard":
        del declared["marker_m"], declared["dictionary"]

    def planted(folder: Path) -> None:
        (folder / "board.toml").write_text(tomli_w.dumps(declared))
        edit(folder, lambda text: text.replace('"charuco_9x6_30mm"', '"board.toml"'))

    return planted


def _tilted(angle: float) -> np.ndarray:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xyz", [angle, 0.3, 0.2]).as_matrix()
    turned[:3, 3] = [0.02, -0.05, 0.18]
    return turned


_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])

# The mistakes by name; of those with a `Mistake`, the cell differs.
BROKEN: Mapping[str, Mistake] = {
    name: plant if isinstance(plant, Mistake) else Mistake(plant)
    for name, plant in {
        # The poses.
        "positions in millimetres": scaled(POSITION, 1e3),
        "the other mount": _toml("eye-in-hand", "eye-to-hand"),
        "quaternion with w first": _rotations(lambda value: value.as_quat()[:, [3, 0, 1, 2]]),
        "Euler angles in degrees in quaternion columns": _rotations(
            lambda value: value.as_euler("ZYX", degrees=True)
        ),
        "Euler angles in radians in quaternion columns": _rotations(
            lambda value: value.as_euler("xyz")
        ),
        "rotation vectors in quaternion columns": _rotations(lambda value: value.as_rotvec()),
        "columns rx, ry, rz": _rotation_vectors,
        "columns x, y, z": _renamed({"x_m": "x", "y_m": "y", "z_m": "z"}),
        "inverse poses": _poses(np.linalg.inv),
        "a left-handed frame": _poses(lambda array: _MIRROR @ array @ _MIRROR),
        "rows shifted by one": _moved_cells(lambda n: [*range(1, n), 0]),
        "two rows exchanged": _moved_cells(_swapped),
        "the same pose in all rows": _moved_cells(lambda n: [0] * n),
        "one pose typed wrong": _cell("z_m", (6,), "0.9"),
        "poses of the tool": Mistake(_poses(lambda array: array @ _tilted(0.4)), joints=True),
        "poses in base_link": Mistake(
            _poses(lambda array: np.diag([-1.0, -1.0, 1.0, 1.0]) @ array), joints=True
        ),
        "joint angles in degrees": Mistake(
            scaled(tuple(f"q{index}_rad" for index in range(1, 7)), 180 / np.pi), joints=True
        ),
        "another robot": Mistake(_toml('"ur10e"', '"ur5e"'), joints=True),
        # The table.
        "semicolons": _text(lambda text: text.replace(",", ";")),
        "decimal commas": _text(_german),
        "a byte-order mark": _bytes(lambda text: text.encode("utf-8-sig")),
        "UTF-16": _bytes(lambda text: text.encode("utf-16")),
        "empty rows": _text(lambda text: text + "," * text.splitlines()[0].count(",") + "\n"),
        "no number (NaN)": _cell("x_m", (5,), "nan"),
        "a view's number twice": _cell("view", (5,), "4"),
        "an image twice": _cell("image", (5,), "images/004.png"),
        # session.toml.
        "[cam] for [camera]": _toml("[camera]", "[cam]"),
        "a misspelt board": _toml("charuco_9x6_30mm", "charuco_9x6_30"),
        "eye_in_hand": _toml("eye-in-hand", "eye_in_hand"),
        "width and height exchanged": _toml("1280,\n    800", "800,\n    1280"),
        "the lens of other images": _images(_smaller),
        "images turned clockwise": _images(lambda it: cv2.rotate(it, cv2.ROTATE_90_CLOCKWISE)),
        "images turned counterclockwise": _images(
            lambda it: cv2.rotate(it, cv2.ROTATE_90_COUNTERCLOCKWISE)
        ),
        "the lens of larger images": lambda folder: (
            _images(_smaller)(folder),
            _toml("1280,\n    800", "960,\n    600")(folder),
        )[0],
        # The images and the board.
        "two images missing": Mistake(_deleted, SMALL.options),
        "images named .jpg": _as_jpg,
        "images in another folder": lambda folder: (folder / "images").rename(folder / "frames"),
        "another kind of board": _board(kind="checkerboard", columns=8, rows=5),
        "another size of board": _board(columns=7, rows=5),
        "another dictionary": _board(dictionary="DICT_6X6_250"),
        "another layout of markers": _board(legacy=True),
        "squares in millimetres": _board(square_m=30.0, marker_m=22.0),
        "squares of another size": _board(square_m=0.036, marker_m=0.0264),
        "one image upside down": _images(
            lambda it: cv2.rotate(it, cv2.ROTATE_180), lambda at: at == 7
        ),
        "mirrored images": _images(lambda it: it[:, ::-1]),
        "blurred images": _images(lambda it: cv2.GaussianBlur(it, (0, 0), 9.0)),
        # The motion.
        "two views": lambda folder: edit_rows(folder, lambda rows: rows[:2]),
        "turns about one axis": Mistake(options=replace(_CELL, motion="one_axis")),
        "no turns": Mistake(options=replace(_CELL, motion="translation")),
        "too little motion": Mistake(options=replace(_CELL, tilt_rad=(0.0, 0.01), roll_rad=0.01)),
    }.items()
}

"""Sessions that are broken in the usual ways: what people get wrong in their first hour.

Every mistake is planted into the same sound session of rendered images, as files that a user would
have: a table without joint angles, and a session.toml.
"""

import csv
import io
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.simulation import CellOptions, simulate, write_session

POSITION, QUATERNION = ("x_m", "y_m", "z_m"), ("qx", "qy", "qz", "qw")
Rows = list[dict[str, str]]


_CELL = replace(CellOptions(), views=15, seed=11)


@dataclass(frozen=True)
class Mistake:
    """A mistake, and what the first sentence about it has to name."""

    plant: Callable[[Path], None]  # Breaks a sound session's folder.
    # Words (a regular expression) of which one tells the cause; - where all is to be well.
    names: str
    options: CellOptions = _CELL  # What the cell is otherwise like.
    joints: bool = False  # Whether its table has joint angles, and its session.toml a robot.


@cache
def _rendered(options: CellOptions) -> TemporaryDirectory:
    """A folder with the session of a cell: its images are rendered once a process."""
    made = TemporaryDirectory()
    write_session(simulate(options), Path(made.name) / "session")
    return made


def sound_session(folder: Path, mistake: Mistake) -> Path:
    """Writes the session into which a mistake is planted."""
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


def edit_rows(folder: Path, change: Callable[[Rows], Rows]) -> None:
    """Changes the rows of views.csv."""
    text = (folder / "views.csv").read_text("utf-8")
    rows = change(list(csv.DictReader(io.StringIO(text))))
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    (folder / "views.csv").write_text(out.getvalue(), "utf-8")


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


def _moved_cells(names: tuple[str, ...], order: Callable[[int], list[int]]) -> Callable[..., None]:
    """Puts cells of some columns into other rows."""

    def changed(rows: Rows) -> Rows:
        cells = [{name: row[name] for name in names} for row in rows]
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


def _deleted(folder: Path) -> None:
    for name in ("004.png", "009.png"):
        (folder / "images" / name).unlink()


def _as_jpg(folder: Path) -> None:
    for file in (folder / "images").iterdir():
        cv2.imwrite(str(file.with_suffix(".jpg")), cv2.imread(str(file)))
        file.unlink()


def _elsewhere(folder: Path) -> None:
    (folder / "images").rename(folder / "frames")


def _board(**changes: object) -> Callable[[Path], None]:
    """Declares a board of another make than the printed one, in a file beside the session."""
    declared = {
        "kind": "charuco",
        "columns": 9,
        "rows": 6,
        "square_m": 0.03,
        "marker_m": 0.022,
        "dictionary": "DICT_5X5_100",
    }
    document = declared | changes
    if document["kind"] == "checkerboard":
        document = {
            k: value for k, value in document.items() if k not in ("marker_m", "dictionary")
        }
    lines = (
        f"{k} = {str(value).lower() if isinstance(value, bool) else repr(value)}\n"
        for k, value in document.items()
    )

    def planted(folder: Path) -> None:
        (folder / "board.toml").write_text("".join(lines).replace("'", '"'))
        edit(folder, lambda text: text.replace('"charuco_9x6_30mm"', '"board.toml"'))

    return planted


def _poor(**changes: object) -> CellOptions:
    return replace(_CELL, **changes)


def _tilted(angle: float) -> np.ndarray:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xyz", [angle, 0.3, 0.2]).as_matrix()
    turned[:3, 3] = [0.02, -0.05, 0.18]
    return turned


def _nothing(_: Path) -> None:
    """The cell itself is the mistake."""


def _few(folder: Path) -> None:
    edit_rows(folder, lambda rows: rows[:2])


_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])

BROKEN: Mapping[str, Mistake] = {
    # The poses.
    "positions in millimetres": Mistake(scaled(POSITION, 1e3), "positions in mm"),
    "the other mount": Mistake(_toml("eye-in-hand", "eye-to-hand"), "mount"),
    "quaternion with w first": Mistake(
        _rotations(lambda value: value.as_quat()[:, [3, 0, 1, 2]]), "w, x, y, z"
    ),
    "Euler angles in degrees in quaternion columns": Mistake(
        _rotations(lambda value: value.as_euler("ZYX", degrees=True)), "Euler"
    ),
    "Euler angles in radians in quaternion columns": Mistake(
        _rotations(lambda value: value.as_euler("xyz")), "Euler"
    ),
    "rotation vectors in quaternion columns": Mistake(
        _rotations(lambda value: value.as_rotvec()), "rotation vector"
    ),
    "columns rx, ry, rz": Mistake(_rotation_vectors, "rx,ry,rz"),
    "columns x, y, z": Mistake(_renamed({"x_m": "x", "y_m": "y", "z_m": "z"}), "x,y,z"),
    "inverse poses": Mistake(_poses(np.linalg.inv), "inverse"),
    "a left-handed frame": Mistake(
        _poses(lambda array: _MIRROR @ array @ _MIRROR), "handed|mirror"
    ),
    "rows shifted by one": Mistake(
        _moved_cells((*POSITION, *QUATERNION), lambda n: [*range(1, n), 0]), "one row"
    ),
    "two rows exchanged": Mistake(_moved_cells((*POSITION, *QUATERNION), _swapped), "disagree"),
    "the same pose in all rows": Mistake(
        _moved_cells((*POSITION, *QUATERNION), lambda n: [0] * n), "one position"
    ),
    "one pose typed wrong": Mistake(_cell("z_m", (6,), "0.9"), "view 6"),
    "poses of the tool": Mistake(
        _poses(lambda array: array @ _tilted(0.4)), "tool|flange", joints=True
    ),
    "poses in base_link": Mistake(
        _poses(lambda array: np.diag([-1.0, -1.0, 1.0, 1.0]) @ array),
        "base_link|turned|180",
        joints=True,
    ),
    "joint angles in degrees": Mistake(
        scaled(tuple(f"q{index}_rad" for index in range(1, 7)), 180 / np.pi),
        "degrees",
        joints=True,
    ),
    "another robot": Mistake(_toml('"ur10e"', '"ur5e"'), "ur10e|ur5e|model", joints=True),
    # The table.
    "semicolons": Mistake(_text(lambda name: name.replace(",", ";")), "-"),
    "decimal commas": Mistake(_text(_german), "-"),
    "a byte-order mark": Mistake(_bytes(lambda name: name.encode("utf-8-sig")), "-"),
    "UTF-16": Mistake(_bytes(lambda name: name.encode("utf-16")), "UTF-16|UTF-8"),
    "empty rows": Mistake(
        _text(lambda name: name + "," * name.splitlines()[0].count(",") + "\n"), "-"
    ),
    "no number (NaN)": Mistake(_cell("x_m", (5,), "nan"), "view 5|line 7"),
    "a view's number twice": Mistake(_cell("view", (5,), "4"), "already|twice"),
    "an image twice": Mistake(_cell("image", (5,), "images/004.png"), "view 5"),
    # session.toml.
    "[cam] for [camera]": Mistake(_toml("[camera]", "[cam]"), "cam"),
    "a misspelt board": Mistake(_toml("charuco_9x6_30mm", "charuco_9x6_30"), "charuco_9x6_30mm"),
    "eye_in_hand": Mistake(_toml("eye-in-hand", "eye_in_hand"), "eye-in-hand"),
    "width and height exchanged": Mistake(
        lambda folder: edit(folder, lambda name: name.replace("1280,\n    800", "800,\n    1280")),
        "resolution|1280 x 800",
    ),
    "the lens of other images": Mistake(
        _images(lambda array: cv2.resize(array, (960, 600), interpolation=cv2.INTER_AREA)),
        "960 x 600",
    ),
    "images turned clockwise": Mistake(
        _images(lambda array: cv2.rotate(array, cv2.ROTATE_90_CLOCKWISE)),
        "resolution",
    ),
    "images turned counterclockwise": Mistake(
        _images(lambda array: cv2.rotate(array, cv2.ROTATE_90_COUNTERCLOCKWISE)),
        "resolution",
    ),
    "the lens of larger images": Mistake(
        lambda folder: (
            _images(lambda array: cv2.resize(array, (960, 600), interpolation=cv2.INTER_AREA))(
                folder
            ),
            _toml("1280,\n    800", "960,\n    600")(folder),
        )[0],
        "lens|matrix|intrinsics|focal",
    ),
    # The images and the board.
    "two images missing": Mistake(_deleted, "images/004.png|missing|two images|2 of 15"),
    "images named .jpg": Mistake(_as_jpg, "missing"),
    "images in another folder": Mistake(_elsewhere, "missing"),
    "another kind of board": Mistake(
        _board(kind="checkerboard", columns=8, rows=5), "ChArUco|charuco"
    ),
    "another size of board": Mistake(_board(columns=7, rows=5), "9 x 6|columns = 9"),
    "another dictionary": Mistake(_board(dictionary="DICT_6X6_250"), "DICT_5X5"),
    "another layout of markers": Mistake(_board(legacy=True), "legacy"),
    "squares in millimetres": Mistake(_board(square_m=30.0, marker_m=22.0), "millimetre|30 m"),
    "squares of another size": Mistake(_board(square_m=0.036, marker_m=0.0264), "board|square"),
    "one image upside down": Mistake(
        _images(lambda array: cv2.rotate(array, cv2.ROTATE_180), lambda at: at == 7), "view 7"
    ),
    "mirrored images": Mistake(_images(lambda array: array[:, ::-1]), "mirror"),
    "blurred images": Mistake(
        _images(lambda array: cv2.GaussianBlur(array, (0, 0), 9.0)),
        "blurred",
    ),
    # The motion.
    "two views": Mistake(_few, "2 views|views"),
    "turns about one axis": Mistake(_nothing, "turn about", options=_poor(motion="one_axis")),
    "no turns": Mistake(_nothing, "turn|rotat", options=_poor(motion="translation")),
    "too little motion": Mistake(
        _nothing,
        "turn|motion|tilt",
        options=_poor(tilt_rad=(0.0, 0.01), roll_rad=0.01),
    ),
}

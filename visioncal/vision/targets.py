"""Targets, printed ones and rigs of known points: files, corners and symmetries.

The target's frame: for a ChArUco board the origin is the outer corner of square 0, for a
checkerboard inner corner 0, for circles the first one's centre, for an AprilGrid the outer corner
of the tag at the upper left, for a single marker its centre. x runs along columns, y along rows
(down the printed page), and z into the board. A rig of points has the frame of its table.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np

from visioncal.core import transforms
from visioncal.core.arguments import typed
from visioncal.core.documents.columns import Column, TableReader
from visioncal.core.documents.tables import read_table
from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, find_described, is_inside, read_toml
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import apply
from visioncal.core.types import FloatArray, IntArray, Mask, Target, TargetKind

# Relative sigma of a square by default: the scale error of office printers.
DEFAULT_RELATIVE_SIGMA = 1e-3

# Smallest sigma, even for squares etched in glass.
LEAST_SIGMA_M = 1e-8

# Largest printed square [m]. Larger numbers are in millimetres, those up to the second limit in
# centimetres or inches, as no square of so few millimetres is printed.
LARGEST_M, _LARGEST_IN_CM = 1.0, 4.0

# Usual range of marker side over square side; ratio at which markers cannot be read; smallest
# square with such markers [m]; other units [m].
_MARKERS, _UNREADABLE, _SMALLEST_SQUARE_M = (0.4, 0.95), 0.1, 5e-3
_UNITS = {"mm": 1e-3, "inches": 0.0254, "cm": 1e-2}

# Keys of target descriptions.
_SIZES = {"square_m", "square_sigma_m", "marker_m", "size_m", "diameter_m", "spacing", "border"}
KEYS = _SIZES | {"kind", "columns", "rows", "dictionary", "legacy", "id", "asymmetric", "points"}

# Columns of a rig's table; sigma_m is optional, and so are tag and corner together.
RIG_COLUMNS = ("point", "x_m", "y_m", "z_m", "sigma_m", "tag", "corner")
_WHOLE_NUMBERS = ("point", "tag", "corner")
# Largest rig [m], beyond which numbers are in millimetres; minimum points for a pose.
_LARGEST_RIG_M, _FEWEST_POINTS = 20.0, 4
# Ratio of the second to the first singular value below which points are collinear.
_ON_ONE_LINE = 1e-6

# Fewer squares do not determine a pose robustly; more do not fit a printable board.
FEWEST_SQUARES, _MAX_SQUARES = 3, 100

# One tag's four corners suffice. Kalibr's pages have tags of this family with borders of two
# modules, and gaps of at most a tag's side.
_MIN_TAGS, _MOST_SPACING, _MOST_BORDER = 1, 1.0, 2
APRILGRID_DICTIONARY = "DICT_APRILTAG_36h11"
# A marker's corners, clockwise from its upper left, in units of its side.
_CLOCKWISE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
# Largest diameter over spacing of circles, so that their edges remain separate.
_WIDEST = 0.85
# Kinds that can be detected in part; so can rigs of tags.
DETECTABLE_IN_PART: frozenset[TargetKind] = frozenset(("charuco", "aprilgrid"))


def _shipped() -> dict[str, Path]:
    """Boards that come with visioncal, by name."""
    package = Path(__file__).resolve().parent
    # A wheel has the boards inside the package; a source tree has them beside it.
    for folder in (package / "boards", package.parents[1] / "targets"):
        if folder.is_dir():
            return {path.stem: path for path in folder.glob("*.toml")}
    return {}


def target_names() -> tuple[str, ...]:
    """Names of the boards that come with visioncal."""
    return tuple(sorted(_shipped()))


@typed
def load_target(name_or_path: str | Path, folder: str | Path | None = None) -> Target:
    """Loads a target.

    Args:
        name_or_path: A name from `target_names()`, or the path of a `.toml`.
        folder: Base of relative paths; None for the working directory.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    return read_target(str(name_or_path), None if folder is None else Path(folder))[0]


def read_target(name_or_path: str, folder: Path | None) -> tuple[Target, dict[str, Any]]:
    """Loads a target as `load_target` does.

    Returns:
        The target, and the content of its file as it was read.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    path = find_described(
        name_or_path, what="target", shipped=_shipped(), suffixes=(".toml",), folder=folder
    )
    document = read_toml(path, path.name)
    rig = document.get("points")
    if document.get("kind") == "points" and isinstance(rig, str):
        document["points"] = _read_rig(path.parent, rig.replace("\\", "/"))
    return target_from_document(document, path.stem), document


def _read_rig(folder: Path, name: str) -> dict[str, list[Any]]:
    """Reads the table of a rig's points by columns, from the folder of the rig's description."""
    path = folder / name
    if not is_inside(path, folder):
        raise DataError(
            f"points = {name!r} leads out of the folder of the target's file.",
            culprits=["points"],
            next_step="Copy the table of points beside the target's file.",
        )
    table = read_table(path)
    unknown = [column for column in table.columns if column not in RIG_COLUMNS]
    missing = [column for column in RIG_COLUMNS[:4] if column not in table.columns]
    if unknown or missing:
        raise DataError(
            f"{path}: its columns are {', '.join(table.columns)}; point, x_m, y_m, z_m and, where "
            "it is known, sigma_m are needed; tag and corner where they are corners of tags.",
            culprits=[f"{path.name}: {word}" for word in (*missing, *unknown)],
        )
    reader = TableReader(table)
    read: dict[str, list[Any]] = {
        name: reader.whole(name).tolist()
        if name in _WHOLE_NUMBERS
        else reader.numbers(Column(name, is_needed=True))[:, 0].tolist()
        for name in table.columns
    }
    reader.check()
    return read


def rig_csv(points: Mapping[str, Sequence[float]]) -> str:
    """Text of a rig's table, from its columns."""
    columns = [column for column in RIG_COLUMNS if column in points]
    rows = zip(*(points[column] for column in columns), strict=True)
    return "\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows), ""])


def misspelt_keys(document: Mapping[str, Any]) -> Iterator[str]:
    """Hints for unknown keys of a target's description that resemble known ones."""
    for key in sorted(document.keys() - KEYS):
        if hint := did_you_mean(key, KEYS):
            yield f"{key} is no known name and was not read. {hint}"


def target_from_document(document: Mapping[str, Any], name: str) -> Target:
    """Builds a target from the content of its `.toml`.

    The default of `square_sigma_m` is 0.1 % of the side, the scale error of office printers.

    Args:
        document: kind, columns, rows, square_m, square_sigma_m, marker_m, dictionary, legacy; for a
            single marker kind, id, size_m, dictionary; for an AprilGrid kind, columns, rows,
            size_m, spacing and, unless Kalibr's, id, dictionary, border; for circles kind, columns,
            rows, square_m, diameter_m, asymmetric; for a rig kind and points, the columns of its
            table as lists.
        name: Name of the target.

    Raises:
        DataError: A field is missing, of another type, or out of range.
    """
    try:
        return _described(DocumentTable(document, f"target {name}"), name)
    except DataError as error:
        hint = error.next_step or " ".join(misspelt_keys(document))
        raise type(error)(error.message, culprits=error.culprits, next_step=hint) from error


def _described(table: DocumentTable, name: str) -> Target:
    kind = table.choice("kind", get_args(TargetKind))
    if kind == "marker":
        return _marker(table, name)
    if kind == "aprilgrid":
        return _aprilgrid(table, name)
    if kind == "points":
        return _rig(table, name)
    if kind == "circles":
        return _circles(table, name)
    columns = table.integer("columns", FEWEST_SQUARES, _MAX_SQUARES)
    rows = table.integer("rows", FEWEST_SQUARES, _MAX_SQUARES)
    if kind == "charuco":
        _check_one_unit(table)
    square_m = _size(table, "square_m")
    sigma_m = _sigma(table, square_m)
    if kind == "checkerboard":
        return Target(name, "checkerboard", columns, rows, square_m, sigma_m)
    marker_m = table.number("marker_m", positive=True)
    # OpenCV compares the sides in single precision.
    if marker_m >= square_m or not 0.0 < np.float32(marker_m) < np.float32(square_m):
        raise table.refuse("marker_m", marker_m, f"less than square_m = {square_m!r}")
    dictionary = table.text("dictionary")
    markers, needed = _dictionary_size(table, dictionary), columns * rows // 2
    if markers < needed:
        raise DataError(
            f"{table.label}: dictionary {dictionary} has {markers} markers; a board of "
            f"{columns} x {rows} squares needs {needed}.",
            culprits=[f"{table.label}: dictionary"],
        )
    legacy = table.flag("legacy", default=False)
    return Target(name, "charuco", columns, rows, square_m, sigma_m, marker_m, dictionary, legacy)


def _size(table: DocumentTable, key: str) -> float:
    size_m = table.number(key, positive=True)
    if size_m > _LARGEST_IN_CM:
        raise table.refuse(
            key, size_m, f"a length in metres, such as {1e-3 * size_m:g} for {size_m:g} mm,"
        )
    if size_m > LARGEST_M:
        cm, inches = f"{1e-2 * size_m:g} for {size_m:g} cm", f"{0.0254 * size_m:g} for inches"
        raise table.refuse(key, size_m, f"metres: {cm}, {inches}")
    return size_m


def _check_one_unit(table: DocumentTable) -> None:
    """Raises an error if squares and markers have different units, judged by their ratio."""
    square, marker = (table.number(name, positive=True) for name in ("square_m", "marker_m"))
    if _UNREADABLE * square < marker < square:
        return
    low, high = _MARKERS
    for unit, size_m in _UNITS.items():
        for key, marker_m, square_m in (
            ("square_m", marker, square * size_m),
            ("marker_m", marker * size_m, square),
        ):
            corrected = square_m if key == "square_m" else marker_m
            if low * square_m < marker_m < high * square_m and square_m > _SMALLEST_SQUARE_M:
                raise DataError(
                    f"{table.label}: square_m is {square:g} and marker_m is {marker:g}; one is in "
                    f"another unit: with {key} in {unit}, and not in metres, a marker is "
                    f"{marker_m / square_m:.2f} of a square, as usual.",
                    culprits=[f"{table.label}: {key}"],
                    next_step=f"In the target's .toml, write {key} = {corrected:.6g}.",
                )


def _sigma(table: DocumentTable, size_m: float) -> float:
    sigma_m = table.number("square_sigma_m", DEFAULT_RELATIVE_SIGMA * size_m, positive=True)
    if not LEAST_SIGMA_M <= sigma_m <= size_m:
        needed = f"a standard deviation from {LEAST_SIGMA_M:g} m to the square's own {size_m:g} m"
        raise table.refuse("square_sigma_m", sigma_m, needed)
    return sigma_m


def _marker(table: DocumentTable, name: str) -> Target:
    size_m = _size(table, "size_m")
    sigma_m = _sigma(table, size_m)
    dictionary = table.text("dictionary")
    marker_id = table.integer("id", 0, _dictionary_size(table, dictionary) - 1)
    return Target(name, "marker", 1, 1, size_m, sigma_m, dictionary=dictionary, marker_id=marker_id)


def _aprilgrid(table: DocumentTable, name: str) -> Target:
    columns = table.integer("columns", _MIN_TAGS, _MAX_SQUARES)
    rows = table.integer("rows", _MIN_TAGS, _MAX_SQUARES)
    size_m = _size(table, "size_m")
    sigma_m = _sigma(table, size_m)
    spacing = table.number("spacing", positive=True)
    if spacing > _MOST_SPACING:
        raise table.refuse("spacing", spacing, "a share of size_m, such as 0.3,")
    dictionary = table.text("dictionary", APRILGRID_DICTIONARY)
    markers = _dictionary_size(table, dictionary)
    first = table.integer("id", 0, markers - 1, 0)
    if first + columns * rows > markers:
        raise DataError(
            f"{table.label}: dictionary {dictionary} has {markers} tags; {columns} x {rows} tags "
            f"from id {first} on need {first + columns * rows}.",
            culprits=[f"{table.label}: columns"],
        )
    border = table.integer("border", 1, _MOST_BORDER, _MOST_BORDER)
    return Target(
        name,
        "aprilgrid",
        columns,
        rows,
        size_m,
        sigma_m,
        dictionary=dictionary,
        marker_id=first,
        spacing=spacing,
        border=border,
    )


def _circles(table: DocumentTable, name: str) -> Target:
    columns = table.integer("columns", FEWEST_SQUARES, _MAX_SQUARES)
    rows = table.integer("rows", FEWEST_SQUARES, _MAX_SQUARES)
    square_m = _size(table, "square_m")
    asymmetric = table.flag("asymmetric", default=False)
    diameter_m = table.number("diameter_m", positive=True)
    # Distance of the nearest circles.
    spacing_m = square_m * np.sqrt(2.0) if asymmetric else square_m
    if diameter_m >= _WIDEST * spacing_m:
        needed = f"less than {_WIDEST:g} of the distance of neighbours, {spacing_m:g} m,"
        raise table.refuse("diameter_m", diameter_m, needed)
    return Target(
        name,
        "circles",
        columns,
        rows,
        square_m,
        _sigma(table, square_m),
        diameter_m=diameter_m,
        asymmetric=asymmetric,
    )


def _rig(table: DocumentTable, name: str) -> Target:
    columns = table.content.get("points")
    if not isinstance(columns, Mapping) or not all(column in columns for column in RIG_COLUMNS[:4]):
        raise table.refuse("points", columns, 'the path of a table (points = "rig.csv")')
    names = [column for column in RIG_COLUMNS if column in columns]
    lists = [columns[word] for word in names]
    try:
        values = np.array(lists, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    for words, step in _rig_problems(names, values):
        culprit = f"{table.label}: points"
        raise DataError(f"{culprit}, its table, {words}.", culprits=[culprit], next_step=step)
    numbers, places_m = values[0], values[1:4].T
    sigmas_m = values[names.index("sigma_m")] if "sigma_m" in names else np.zeros(0)
    extent_m = float(np.ptp(places_m, axis=0).max())
    return Target(
        name,
        "points",
        len(numbers),
        1,
        extent_m,
        0.0,
        points_m=tuple((x, y, z) for x, y, z in places_m.tolist()),
        point_numbers=tuple(numbers.astype(int).tolist()),
        point_sigmas_m=tuple(sigmas_m.tolist()),
        **_tags_of_rig(table, columns),
    )


def _rig_problems(names: Sequence[str], values: FloatArray) -> Iterator[tuple[str, str]]:
    """Problems of a table of points, each with an instruction.

    Args:
        names: Columns of the table, point, x_m, y_m and z_m first.
        values: (columns, n) cells; of another shape if the rows are uneven.
    """
    if values.ndim != 2:
        yield "has rows of several lengths, or cells that are no numbers", "Fill in all cells."
        return
    for column, row in np.argwhere(~np.isfinite(values)).tolist():
        yield (
            f"has {values[column, row]:g} as {names[column]} of row {row + 1}",
            "Write a finite number there, or delete the row.",
        )
    numbers, places_m = values[0].tolist(), values[1:4].T
    if len(numbers) < _FEWEST_POINTS:
        yield f"has {len(numbers)} points", "Give four points or more, which a camera needs."
    first: dict[float, int] = {}
    for row, number in enumerate(numbers):
        if number != round(number) or first.setdefault(number, row) != row:
            again = " again" if first.get(number, row) != row else ""
            yield (
                f"has {number:g}{again} as point of row {row + 1}",
                "Give each point a whole number of its own.",
            )
    spread_m = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)
    if spread_m[1] <= _ON_ONE_LINE * spread_m[0]:
        location = "on one line" if spread_m[0] > 0.0 else "in one place"
        yield (
            f"has all points {location}",
            "Give points beside these: no camera tells how they turn.",
        )
    extent_m = float(np.ptp(places_m, axis=0).max())
    if extent_m > _LARGEST_RIG_M:
        yield (
            f"reaches over {extent_m:g} m, and a rig over {_LARGEST_RIG_M:g} m at most",
            "It looks like millimetres: multiply x_m, y_m, z_m and sigma_m by 0.001.",
        )
    for row, sigma_m in enumerate(values[4].tolist() if "sigma_m" in names else ()):
        if not LEAST_SIGMA_M <= sigma_m <= extent_m:
            yield (
                f"has {sigma_m:g} as sigma_m of row {row + 1}, and not {LEAST_SIGMA_M:g} m to the "
                f"rig's own {extent_m:g} m",
                "Write metres in this range, or leave the column out where they are not known.",
            )


def _tags_of_rig(table: DocumentTable, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Tag corners of a rig's points, and the tags' dictionary."""
    given = [name for name in ("tag", "corner") if name in columns]
    if not given:
        return {}
    if len(given) == 1:
        raise table.refuse(
            "points", f"a table with {given[0]} alone", "tag and corner, or neither,"
        )
    dictionary = table.text("dictionary", APRILGRID_DICTIONARY)
    markers = _dictionary_size(table, dictionary)
    pairs = list(zip(columns["tag"], columns["corner"], strict=True))
    counts = Counter(pairs)
    for tag, corner in pairs:
        if tag not in range(markers) or corner not in range(4):
            given_here = f"a table with tag {tag}, corner {corner}"
            raise table.refuse("points", given_here, f"tags 0 to {markers - 1}, corners 0 to 3,")
        if counts[tag, corner] > 1:
            twice = f"a table with corner {corner} of tag {tag} twice"
            raise table.refuse("points", twice, "each corner once,")
    return {
        "dictionary": dictionary,
        "point_tags": tuple((int(tag), int(corner)) for tag, corner in pairs),
    }


def _dictionary_size(table: DocumentTable, name: str) -> int:
    """Number of markers of one of OpenCV's dictionaries."""
    names = [entry for entry in dir(cv2.aruco) if entry.startswith("DICT_")]
    if name not in names:
        raise DataError(
            f"{table.label}: dictionary is {name!r}, which OpenCV does not have.",
            culprits=[f"{table.label}: dictionary"],
            next_step=did_you_mean(name.upper(), names)
            or "The names look like DICT_5X5_100 or DICT_APRILTAG_36h11.",
        )
    return len(aruco_dictionary(name).bytesList)


def aruco_dictionary(name: str) -> cv2.aruco.Dictionary:
    """One of OpenCV's dictionaries by name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def metres(millimetres: float) -> float:
    """Converts millimetres to metres without rounding twice: 23.6 becomes 0.0236."""
    return float(Decimal(str(millimetres)) / 1000)


# Keys of each kind's description, and fields of targets with other names.
_OF_SQUARES = "columns rows square_m square_sigma_m"
_FORMS: Mapping[TargetKind, str] = {
    "checkerboard": _OF_SQUARES,
    "charuco": f"{_OF_SQUARES} marker_m dictionary legacy",
    "circles": f"{_OF_SQUARES} diameter_m asymmetric",
    "aprilgrid": "columns rows size_m square_sigma_m spacing dictionary id border",
    "marker": "id size_m square_sigma_m dictionary",
}
_NAMES = {"id": "marker_id", "size_m": "square_m"}


def target_document(target: Target) -> dict[str, Any]:
    """A target as the content of a `.toml`, which `target_from_document` can read."""
    if target.kind == "points":
        x_m, y_m, z_m = corner_positions(target).T.tolist()
        tags = np.reshape(target.point_tags, (-1, 2)).T.astype(int).tolist()
        columns = (list(target.point_numbers), x_m, y_m, z_m, list(target.point_sigmas_m), *tags)
        rig = dict(zip(RIG_COLUMNS, columns, strict=True))
        document = {
            "kind": "points",
            "points": {name: value for name, value in rig.items() if value},
        }
        return document | ({"dictionary": target.dictionary} if target.point_tags else {})
    fields = {key: getattr(target, _NAMES.get(key, key)) for key in _FORMS[target.kind].split()}
    return {"kind": target.kind, **fields}


def board_words(target: Target, least: str = "") -> str:
    """A target in a few words, without its size; `least` precedes columns and rows."""
    size = f"{least}{target.columns} x {target.rows}"
    match target.kind:
        case "checkerboard":
            return f"checkerboard of {size} inner corners"
        case "charuco":
            layout = ", legacy layout" if target.legacy else ""
            return f"ChArUco board of {size} squares, {target.dictionary}{layout}"
        case "marker":
            return f"marker {target.marker_id} of {target.dictionary}"
        case "circles":
            return f"{'asymmetric' if target.asymmetric else 'symmetric'} grid of {size} circles"
        case "aprilgrid":
            return f"AprilGrid of {size} tags, {target.dictionary} from id {target.marker_id}"
        case _:
            return f"target of kind {target.kind}"


def corner_positions(target: Target) -> FloatArray:
    """Positions of the target's corners.

    Returns:
        (n, 3) positions in the target's frame [m], by corner id. A marker's four corners are in
        OpenCV's order, clockwise from its top left; those of an AprilGrid likewise on the page, tag
        by tag in the order of their ids; the points of a rig are in the order of its table.
    """
    side = target.square_m
    if target.kind == "points":
        return np.array(target.points_m, dtype=float)
    if target.kind == "marker":
        return np.asarray(side * (_CLOCKWISE - np.array([0.5, 0.5, 0.0])))
    if target.kind == "aprilgrid":
        places = np.pad((1.0 + target.spacing) * _tag_places(target), ((0, 0), (0, 1)))
        return np.asarray(side * (places[:, None] + _CLOCKWISE).reshape(-1, 3))
    if target.kind == "circles":
        places = circle_places(target.columns, target.rows, asymmetric=target.asymmetric)
        return np.asarray(side * np.pad(places, ((0, 0), (0, 1))), dtype=float)
    inset = 1 if target.kind == "charuco" else 0
    rows, columns = np.mgrid[inset : target.rows, inset : target.columns]
    flat = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
    return np.asarray(side * flat, dtype=float)


def _tag_places(target: Target) -> IntArray:
    """(t, 2) columns and rows of an AprilGrid's tags, by id."""
    # As on Kalibr's pages, the first tag is at the lower left and ids run along the rows.
    rows, columns = np.divmod(np.arange(target.columns * target.rows), target.columns)
    return np.stack([columns, target.rows - 1 - rows], axis=1)


def circle_places(columns: int, rows: int, *, asymmetric: bool) -> IntArray:
    """(n, 2) columns and rows of circles, row by row; for an asymmetric grid in half columns."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    return np.stack([2 * column + row % 2 if asymmetric else column, row], axis=1)


def point_numbers(target: Target) -> tuple[int, ...]:
    """Users' numbers of a target's corners, in the order of `corner_positions`."""
    return target.point_numbers or tuple(range(len(corner_positions(target))))


def numbered_positions(targets: Sequence[Target]) -> FloatArray:
    """(c, 3) corners of several targets, concatenated, each in its own target's frame."""
    return np.concatenate([np.zeros((0, 3)), *map(corner_positions, targets)])


def tag_corners(target: Target) -> dict[int, IntArray]:
    """Point indices (4,) of a rig's tags' corners, by tag id; -1 for corners that are no points."""
    corners_of_tag: dict[int, IntArray] = {}
    for index, (tag, corner) in enumerate(target.point_tags):
        corners_of_tag.setdefault(tag, np.full(4, -1))[corner] = index
    return corners_of_tag


def first_corners(targets: Sequence[Target]) -> IntArray:
    """Indices (b,) of the targets' first corners in the concatenation of all corners."""
    counts = [len(corner_positions(target)) for target in targets]
    return np.cumsum([0, *counts], dtype=np.int64)[:-1]


def extent_m(target: Target) -> tuple[FloatArray, FloatArray]:
    """Low and high x, y of the printed pattern in the target's frame, (2,) each [m]."""
    side = target.square_m
    if target.kind == "points":
        places = corner_positions(target)[:, :2]
        return places.min(axis=0), places.max(axis=0)
    if target.kind == "marker":
        return np.full(2, -0.5 * side), np.full(2, 0.5 * side)
    if target.kind == "aprilgrid":
        # There are small squares around the outermost tags too.
        count = np.array([target.columns, target.rows])
        high = side * (count * (1.0 + target.spacing))
        return np.full(2, -side * target.spacing), high
    if target.kind == "circles":
        places, radius = corner_positions(target)[:, :2], target.diameter_m / 2
        return places.min(axis=0) - radius, places.max(axis=0) + radius
    # A checkerboard's origin is its first inner corner, one square inside.
    low = np.full(2, 0.0 if target.kind == "charuco" else -side)
    return low, side * np.array([target.columns, target.rows], dtype=float)


def marker_cells(dictionary_name: str, marker_id: int, border: int = 1) -> Mask:
    """(n, n) mask of a marker's dark cells, including a border of `border` cells."""
    dictionary = aruco_dictionary(dictionary_name)
    size = dictionary.markerSize
    code = dictionary.bytesList[marker_id : marker_id + 1]
    bits = np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(code, size))
    return np.pad(bits == 0, border, constant_values=True)


def marked_squares(target: Target) -> IntArray:
    """(m, 2) light squares of a ChArUco board as column and row, by marker id.

    Raises:
        DataError: The target is of another kind.
    """
    # Markers are on the light squares.
    places = np.asarray(charuco_board(target).getObjPoints(), dtype=float)[..., :2]
    return np.asarray(np.floor(places.mean(axis=1) / target.square_m), dtype=np.int64)


# Cached, as OpenCV warns of a narrow rim around the markers whenever it builds the board.
@lru_cache(maxsize=64)
def charuco_board(target: Target) -> cv2.aruco.CharucoBoard:
    """OpenCV's board for a ChArUco target.

    Raises:
        DataError: The target is of another kind.
    """
    if target.kind != "charuco":
        raise DataError(f"target {target.name} is a {target.kind}; a charuco board is needed.")
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows),
        target.square_m,
        target.marker_m,
        aruco_dictionary(target.dictionary),
    )
    board.setLegacyPattern(target.legacy)
    return board


def rotation_transforms(target: Target) -> FloatArray:
    """Rotations in the plane that map the printed pattern to itself.

    Markers break every symmetry. The squares of a checkerboard of c x r inner corners have the
    colour of (column + row) mod 2 over c + 1 columns and r + 1 rows. A half turn maps square (i, j)
    to (c - i, r - j) and keeps the colours if c + r is even; a quarter turn maps it to (c - j, i)
    and requires c = r, even. Circles have no colours: a symmetric grid is invariant under a half
    turn, and so is an asymmetric one with an even number of rows.

    Returns:
        (k, 4, 4) `target_from_turned`, the identity first.
    """
    if target.kind not in ("checkerboard", "circles"):
        return np.eye(4)[None]
    places = corner_positions(target)
    odd = np.rint(places / target.square_m).sum(axis=1) % 2
    turns = []
    for quarters, (cosine, sine) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        turned = places @ turn.T
        shift = (np.ptp(places, axis=0) - turned.min(axis=0) - turned.max(axis=0)) / 2
        distances = np.linalg.norm(turned[:, None] + shift - places, axis=2)
        fits = distances.min(axis=1).max() < 0.1 * target.square_m
        # A quarter turn exchanges the colours of the squares around a corner.
        colours = (odd[distances.argmin(axis=1)] + odd + quarters) % 2
        if fits and (target.kind == "circles" or not colours.any()):
            turns.append(transforms.compose(turn, shift))
    return np.stack(turns)


def rotations(target: Target) -> tuple[IntArray, ...]:
    """Corner permutations under the symmetries of the printed pattern.

    Returns:
        Permutations p, the identity first, one for each of `rotation_transforms`: after that
        transform, corner i is where corner p[i] was.
    """
    positions = corner_positions(target)
    permutations = []
    for turn in rotation_transforms(target):
        turned = apply(turn, positions)
        distance = np.linalg.norm(turned[:, None] - positions[None], axis=-1)
        permutations.append(np.asarray(distance.argmin(axis=1), dtype=np.int64))
    return tuple(permutations)

"""Targets, printed ones and rigs of known points: files, corners and symmetries.

The target's frame: for a ChArUco board the origin is the outer corner of square 0, for a
checkerboard inner corner 0, for circles the first one's centre, for an AprilGrid the outer corner
of the tag at the upper left, for a single marker its centre. x runs along columns, y along rows
(down the printed page), and z into the board. A rig of points has the frame of its table.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.documents.toml import DocumentTable, find_described, read_toml
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import apply, compose
from visioncal.core.types import Corners, FloatArray, IntArray, Target
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.boards.kind import dictionary_numbered

# Edges of a unit box as one line strip.
_BOX = np.array(
    [
        *((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0)),
        *((1, 0, 1), (1, 1, 1), (1, 1, 0), (1, 1, 1), (0, 1, 1), (0, 1, 0), (0, 1, 1), (0, 0, 1)),
    ]
)
# Keys of target descriptions.
KEYS = {"kind", "points", "spacing_m"}.union(*(kind.keys.split() for kind in KINDS.values()))
# Advice for a grid of ArUco markers.
_GRID = ("gridboard", 'Write kind = "gridboard" with columns, rows, size_m, spacing, dictionary.')


def _shipped() -> dict[str, Path]:
    """Boards that come with visioncal, by name."""
    package = Path(__file__).resolve().parent
    # A wheel has the boards inside the package; a source tree has them beside it.
    for folder in (package / "printed", package.parents[1] / "targets"):
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


def target_name(document: Mapping[str, Any]) -> str | None:
    """Name of the shipped target with this content; None where there is none."""
    shipped = ((name, read_target(name, None)[1]) for name in target_names())
    return next((name for name, content in shipped if content == document), None)


def read_target(name_or_path: str, folder: Path | None) -> tuple[Target, dict[str, Any]]:
    """Loads a target as `load_target` does.

    Returns:
        The target, and the content of its file as it was read.

    Raises:
        DataError: There is no such target, or its description is wrong.
    """
    path = find_described(
        name_or_path,
        what="target",
        shipped=_shipped(),
        suffixes=(".toml", ".yaml", ".yml", ".json"),
        folder=folder,
    )
    document = read_toml(path, path.name) if path.suffix == ".toml" else _of_kalibr(path)
    if document.get("kind") in KINDS:
        document = KINDS[document["kind"]].loaded(document, path.parent)
    return target_from_document(document, path.stem), document


# Keys of ChArUco boards in programs' settings: `num_X`, `board_squaresX`, `len_squares`.
_IN_SETTINGS = {
    "columns": r"(?:.*(?:num|squares|count|n|size)_?x|columns|cols)",
    "rows": r"(?:.*(?:num|squares|count|n|size)_?y|rows)",
    "square_m": r"(?!.*[xy]$).*(?:(?:len|size|side).*square|square.*(?:len|size|side)).*",
    "marker_m": r".*(?:(?:len|size|side).*marker|marker.*(?:len|size|side)).*",
    "dictionary": r".*dict(?:ionary)?(?:_?id|_?name)?",
}
# Keys of both counts of a checkerboard's inner corners: `chessboard_size`, `pattern_size`.
_COUNTS = re.compile(r".*(?:chess|checker|pattern|board).*(?:size|shape|corners)", re.IGNORECASE)

# Words of settings of boards that are no checkerboard.
_NO_CHECKERBOARD = re.compile(r"marker|aruco|tag|dict|circle", re.IGNORECASE)
_CHECKERBOARD = re.compile(r"chess|checker", re.IGNORECASE)
# Counts that no other key has; the width and height of a picture are larger.
_BY_SIZE, _MOST_COUNTED = {"columns": "width", "rows": "height"}, 100


def _of_settings(stated: Mapping[str, Any]) -> dict[str, Any] | None:
    """The content of a `.toml` of a board by a program's settings; None of others.

    Lengths are in metres, from one on in millimetres; a number is a dictionary of OpenCV's. A
    checkerboard has its counts in a list or is called one, and has neither markers nor a
    dictionary.
    """
    found: dict[str, Any] = {"kind": "charuco"}
    for field, pattern in _IN_SETTINGS.items():
        keys = [key for key in stated if re.fullmatch(pattern, str(key), re.IGNORECASE)]
        keys = keys or [key for key in stated if str(key).lower() == _BY_SIZE.get(field)]
        numbers = [key for key in keys if type(stated[key]) in (int, float)]
        keys = numbers if field.endswith("_m") else keys
        if len(keys) == 1:
            value = stated[keys[0]]
            if field.endswith("_m"):
                value = value if value < 1.0 else value / 1e3
            if field == "dictionary" and isinstance(value, int):
                value = dictionary_numbered(value)
            if field not in ("columns", "rows") or (type(value) is int and value < _MOST_COUNTED):
                found[field] = value
    if len(found) > len(_IN_SETTINGS):
        return found
    lists = [value for key, value in stated.items() if _COUNTS.fullmatch(str(key))]
    counts = [each for each in lists if isinstance(each, list) and [*map(type, each)] == [int, int]]
    words = " ".join(map(str, (*stated, *stated.values())))
    if _CHECKERBOARD.search(words) and found.keys() >= {"columns", "rows"}:
        counts.append([found.pop("columns"), found.pop("rows")])
    is_plain = found.keys() == {"kind", "square_m"} and len(counts) == 1
    is_plain = is_plain and _NO_CHECKERBOARD.search(words) is None
    columns, rows = counts[0] if is_plain else (0, 0)
    return {**found, "kind": "checkerboard", "columns": columns, "rows": rows} if columns else None


def _of_kalibr(path: Path) -> dict[str, Any]:
    """The content of a `.toml` by Kalibr's target `.yaml` (its wiki, "Calibration targets").

    Or by the settings of a program.
    """
    # Imported here, as few boards are described so.
    from visioncal.core.documents.structured import read_yaml

    stated = read_yaml(path)
    # Records of views, each with its board.
    stated = stated[0] if isinstance(stated, list) and stated else stated
    whole = stated if isinstance(stated, Mapping) else {}
    # The board's may stand below a name, as `parameters`.
    below = ({**whole, **each} for each in whole.values() if isinstance(each, Mapping))
    settings = next(filter(None, map(_of_settings, (whole, *below))), None)
    if settings is not None:
        return settings
    table = DocumentTable(whole, str(path))
    if "target_type" not in table.content:
        raise DataError(
            f"{path} describes no board: it must have its counts and lengths, as columns, rows and "
            "square_size (of a ChArUco marker_size and dictionary, too), or Kalibr's target_type.",
            culprits=[str(path)],
            next_step="Describe the board in a word instead: --target checkerboard_9x6_23.6mm.",
        )
    kind = table.choice("target_type", ("aprilgrid", "checkerboard"))
    if kind == "aprilgrid":
        keys = {"columns": "tagCols", "rows": "tagRows", "size_m": "tagSize"}
        keys["spacing"] = "tagSpacing"
    else:
        keys = {"columns": "targetCols", "rows": "targetRows", "square_m": "colSpacingMeters"}
        if table.number("rowSpacingMeters") != table.number("colSpacingMeters"):
            row, needed = table.number("rowSpacingMeters"), "as much as colSpacingMeters"
            raise table.refuse("rowSpacingMeters", row, needed)
    return {"kind": kind, **{field: table.content.get(key) for field, key in keys.items()}}


def misspelt_keys(document: Mapping[str, Any]) -> Iterator[str]:
    """Hints for unknown keys of a target's description that resemble known ones."""
    for key in sorted(document.keys() - KEYS):
        if hint := did_you_mean(key, KEYS):
            yield f"{key} is not known and was not read. {hint}"


def target_from_document(document: Mapping[str, Any], name: str) -> Target:
    """Builds a target from the content of its `.toml`.

    The default of `square_sigma_m` is 0.1 % of the side, the scale error of office printers.

    Args:
        document: kind, columns, rows, square_m, square_sigma_m, marker_m, dictionary, legacy; for a
            single marker kind, id, size_m, dictionary; for an AprilGrid kind, columns, rows,
            size_m, spacing and, unless Kalibr's, first_id, dictionary, border; for a grid of
            markers the same, with its dictionary; for circles kind, columns,
            rows, square_m, diameter_m, asymmetric; for a rig kind and points, the columns of its
            table as lists.
        name: Name of the target.

    Raises:
        DataError: A field is missing, of another type, or out of range.
    """
    try:
        table = DocumentTable(document, f"target {name}")
        kind = str(document.get("kind"))
        if kind not in KINDS and "aruco" in kind and document.keys() & {"columns", "markers_x"}:
            raise table.refuse("kind", kind, *_GRID)
        return KINDS[table.choice("kind", tuple(KINDS))].read(table, name)
    except DataError as error:
        hint = error.next_step or " ".join(misspelt_keys(document))
        raise error.but(next_step=hint) from error


def target_document(target: Target) -> dict[str, Any]:
    """A target as the content of a `.toml`, which `target_from_document` can read."""
    return {"kind": target.kind, **kind_of(target).document(target)}


def stored_target(
    document: Mapping[str, Any], stem: str
) -> tuple[Mapping[str, Any], dict[str, str | bytes]]:
    """The content of `STEM.toml` for a `target_document`, and its other files by name."""
    return KINDS[document["kind"]].stored(document, stem)


def board_words(target: Target) -> str:
    """A target in a few words, without its size."""
    return kind_of(target).words(target, f"{target.columns} x {target.rows}")


def corner_positions(target: Target) -> FloatArray:
    """Positions of the target's corners.

    Returns:
        (n, 3) positions in the target's frame [m], by corner id. A marker's four corners are in
        OpenCV's order, clockwise from its top left; those of an AprilGrid likewise on the page, tag
        by tag in the order of their ids; the points of a rig are in the order of its table.
    """
    return kind_of(target).corners(target)


def point_numbers(target: Target) -> tuple[int, ...]:
    """Users' numbers of a target's corners, in the order of `corner_positions`."""
    return target.point_numbers or tuple(range(len(corner_positions(target))))


def numbered_positions(targets: Sequence[Target]) -> FloatArray:
    """(c, 3) corners of several targets, concatenated, each in its own target's frame."""
    return np.concatenate([np.zeros((0, 3)), *map(corner_positions, targets)])


def first_corners(targets: Sequence[Target]) -> IntArray:
    """Indices (b,) of the targets' first corners in the concatenation of all corners."""
    counts = [len(corner_positions(target)) for target in targets]
    return np.cumsum([0, *counts], dtype=np.int64)[:-1]


def first_numbers(boards: Mapping[str, Target]) -> dict[str, int]:
    """Numbers of boards' first corners where those of all are numbered through, by their names."""
    return dict(zip(boards, first_corners(tuple(boards.values())).tolist(), strict=True))


def otherwise(target: Target, corners: Sequence[Corners]) -> dict[str, object]:
    """Keys of a description that a detector's corners contradict, as they should be."""
    return kind_of(target).otherwise(target, [at.ids for at in corners], [at.px for at in corners])


def is_seen_in_part(target: Target) -> bool:
    """Whether some of its corners can be detected without the others."""
    return kind_of(target).is_seen_in_part


def extent_m(target: Target) -> tuple[FloatArray, FloatArray]:
    """Low and high x, y of the printed pattern in the target's frame, (2,) each [m]."""
    return kind_of(target).extent_m(target)


def outline(target: Target) -> FloatArray:
    """(4, 3) corners of the printed pattern in the target's frame [m], clockwise on the page.

    For a rig: the cross-section in the middle of its bounding box.
    """
    low, high = extent_m(target)
    middle_z = float(np.mean([end[:, 2] for end in _bounds(target)]))
    corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
    return np.pad(corners, ((0, 0), (0, 1)), constant_values=middle_z)


def closed_outline(target: Target, parts: int = 1) -> FloatArray:
    """(k, 3) outline as a line strip [m]; for a rig, the edges of its bounding box.

    Lenses bend its sides in images: each consists of that many equal parts.
    """
    low, high = _bounds(target)
    corners = outline(target)[[0, 1, 2, 3, 0]]
    if target.is_rig:
        corners = low + _BOX * (high - low)
    shares = np.arange(parts)[:, None] / parts
    sides = [begin + shares * (end - begin) for begin, end in pairwise(corners)]
    return np.vstack([*sides, corners[-1:]])


def _bounds(target: Target) -> tuple[FloatArray, FloatArray]:
    """Low and high corners (1, 3) of the bounding box of a target's corners [m]."""
    corners_m = corner_positions(target)
    return corners_m.min(axis=0, keepdims=True), corners_m.max(axis=0, keepdims=True)


def half_turn_of(target: Target) -> tuple[FloatArray, tuple[float, float]]:
    """The half turn (4, 4) of a target in its plane about its middle, and that middle [m].

    A target whose corners are numbered from the other end has its frame turned so.
    """
    corners = corner_positions(target)
    x, y, _ = (0.5 * (corners.min(axis=0) + corners.max(axis=0))).tolist()
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    turn[:2, 3] = 2.0 * x, 2.0 * y
    return turn, (x, y)


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
    symmetric = kind_of(target).symmetric
    if not symmetric:
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
        if fits and (symmetric == "places" or not colours.any()):
            turns.append(compose(turn, shift))
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

"""Photographs of random boards, drawn by OpenCV and NumPy alone: what an identifier has to name.

Boards are drawn flat, seen in perspective before a cluttered wall, blurred and covered with noise.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

KINDS = ("charuco", "checkerboard", "aprilgrid", "gridboard", "circles", "marker")
# Pixels of a square, a marker or a distance of circles in the drawing.
_UNIT = 60
_FAMILIES = ("4X4", "5X5", "6X6", "7X7")


@dataclass(frozen=True, eq=False)
class Print:
    """A drawn board, and what is to be said of it."""

    drawn: np.ndarray  # Grey levels, with white around the board.
    said: dict[str, Any]  # Keys of its description.


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """One of OpenCV's dictionaries by name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def print_of(kind: str, rng: np.random.Generator, *, first: int | None = None) -> Print:
    """A random board of a kind; boards of markers begin at `first`, or mostly at 0."""
    columns, rows = int(rng.integers(4, 13)), int(rng.integers(4, 9))
    first = int(rng.choice([0, 0, 0, rng.integers(1, 120)])) if first is None else first
    family = str(rng.choice(_FAMILIES))
    name = f"DICT_{family}_1000"
    said: dict[str, Any] = {"kind": kind, "columns": columns, "rows": rows}
    if kind == "charuco":
        legacy = bool(rng.integers(2))
        # Whole pixels around markers: OpenCV draws some others outside of its image.
        share = 1.0 - (2 * round(_UNIT * rng.uniform(0.1, 0.2)) + 1e-3) / _UNIT
        ids = np.arange(columns * rows // 2, dtype=np.int32) + first
        board = cv2.aruco.CharucoBoard((columns, rows), 1.0, share, dictionary_of(name), ids)
        board.setLegacyPattern(legacy)
        drawn = board.generateImage((_UNIT * columns, _UNIT * rows))
        said |= {"legacy": legacy and rows % 2 == 0, "first_id": first, "family": family}
    elif kind == "gridboard":
        gap = float(rng.uniform(0.15, 0.6))
        columns, rows = min(columns, 8), min(rows, 6)
        ids = np.arange(columns * rows, dtype=np.int32) + first
        board = cv2.aruco.GridBoard((columns, rows), 1.0, gap, dictionary_of(name), ids)
        sides = np.array([columns, rows]) * (1.0 + gap) - gap
        # A margin takes what rounding adds to the last marker.
        size = np.rint(_UNIT * sides).astype(int) + 2
        drawn = board.generateImage(size.tolist(), marginSize=1)[1:-1, 1:-1]
        said |= {"columns": columns, "rows": rows, "first_id": first, "family": family}
        said |= {"spacing": gap}
    elif kind == "checkerboard":
        squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
        drawn = np.kron(squares, np.ones((_UNIT, _UNIT))) * 255
    elif kind == "circles":
        drawn, said = _circles(rng, columns, rows, said)
    elif kind == "marker":
        number = int(rng.integers(0, 50))
        drawn = cv2.aruco.generateImageMarker(dictionary_of(name), number, 4 * _UNIT)
        said = {"kind": kind, "id": number, "family": family}
    else:
        columns, rows = min(columns, 8), min(rows, 6)
        first = min(first, 400)
        drawn = _aprilgrid(columns, rows, first, int(border := rng.integers(1, 3)))
        said |= {"columns": columns, "rows": rows, "first_id": first, "border": int(border)}
    return Print(np.pad(drawn.astype(np.uint8), _UNIT, constant_values=255), said)


def _circles(
    rng: np.random.Generator, columns: int, rows: int, said: dict[str, Any]
) -> tuple[np.ndarray, dict[str, Any]]:
    asymmetric = bool(rng.integers(2))
    columns = min(columns, 7) if asymmetric else columns
    step = _UNIT // 2 if asymmetric else _UNIT
    width = (2 * columns + 1 if asymmetric else columns + 1) * step
    drawn = np.full((step * (rows + 1), width), 255, np.uint8)
    radius = round(step * float(rng.uniform(0.22, 0.32)) * (1.3 if asymmetric else 1.0))
    for row in range(rows):
        for column in range(columns):
            x = (2 * column + row % 2 if asymmetric else column) + 1
            cv2.circle(drawn, (step * x, step * (row + 1)), radius, 0, -1, cv2.LINE_AA)
    return drawn, said | {"columns": columns, "asymmetric": asymmetric}


def _aprilgrid(columns: int, rows: int, first: int, border: int) -> np.ndarray:
    """Kalibr's order and its small squares; tags are upside down on its pages."""
    gap = round(0.3 * _UNIT)
    pitch = _UNIT + gap
    drawn = np.full((pitch * rows + gap, pitch * columns + gap), 255, np.uint8)
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for row in range(rows + 1):
        for column in range(columns + 1):
            y, x = pitch * row, pitch * column
            drawn[y : y + gap, x : x + gap] = 0
            if row < rows and column < columns:
                number = first + columns * (rows - 1 - row) + column
                tag = cv2.aruco.generateImageMarker(tags, number, _UNIT, borderBits=border)
                drawn[y + gap : y + pitch, x + gap : x + pitch] = tag[::-1, ::-1]
    return drawn


def photographs(
    board: Print,
    rng: np.random.Generator,
    *,
    count: int = 3,
    size: tuple[int, int] = (1280, 1024),
    fill: tuple[float, float] = (0.5, 0.8),
    tilt: float = 0.6,
    blur: tuple[float, float] = (0.4, 1.0),
    noise: float = 4.0,
    turned: bool = True,
    hidden: float = 0.0,
) -> list[np.ndarray]:
    """Grey photographs of a board.

    Args:
        board: The board.
        rng: Random generator.
        count: Number of photographs.
        size: Width and height [px].
        fill: Range of the board's larger extent as a share of the image's smaller side.
        tilt: Largest tilt [rad].
        blur: Range of the blur's sigma [px].
        noise: Sigma of the noise [grey levels].
        turned: Whether the camera is turned about its axis at random.
        hidden: Largest share of the board that a dark thing covers from one side.
    """
    return [
        _photograph(board.drawn, rng, size, fill, tilt, blur, noise, turned, hidden)
        for _ in range(count)
    ]


def _photograph(drawn, rng, size, fill, tilt, blur, noise, turned, hidden):
    height, width = drawn.shape
    extent = float(max(height, width))
    focal = 1.2 * max(size)
    x, y = rng.uniform(-tilt, tilt, 2)
    about = rng.uniform(-np.pi, np.pi) if turned else rng.uniform(-0.1, 0.1)
    turn = cv2.Rodrigues(np.array([0.0, 0.0, about]))[0] @ cv2.Rodrigues(np.array([x, y, 0.0]))[0]
    depth = focal * extent / (rng.uniform(*fill) * min(size))
    corners = np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) / 2
    places = np.c_[corners, np.zeros(4)] @ turn.T + np.array([0.0, 0.0, depth])
    px = focal * places[:, :2] / places[:, 2:]
    # Inside the image where it fits.
    low, high = px.min(axis=0), px.max(axis=0)
    room = np.maximum((np.array(size) - (high - low)) / 2, 0.0)
    px += np.array(size) / 2 - (low + high) / 2 + rng.uniform(-room, room)
    source = corners + np.array([width, height]) / 2
    flat = cv2.getPerspectiveTransform(source.astype(np.float32), px.astype(np.float32))
    if hidden:
        # From any side, and by any share up to this one.
        side = int(rng.integers(4))
        drawn = np.rot90(drawn, side).copy()
        drawn[:, : round(rng.uniform(0.2, 1.0) * hidden * drawn.shape[1])] = 60
        drawn = np.rot90(drawn, -side)
    # Twice the size against aliasing.
    twice = np.diag([2.0, 2.0, 1.0]) @ flat
    large = (2 * size[0], 2 * size[1])
    seen = cv2.warpPerspective(drawn, twice, large, flags=cv2.INTER_AREA)
    shown = cv2.warpPerspective(np.full_like(drawn, 255), twice, large, flags=cv2.INTER_NEAREST)
    wall = cv2.resize(
        rng.uniform(40, 200, (24, 30)), large, interpolation=cv2.INTER_CUBIC
    ) + cv2.resize(rng.uniform(-25, 25, (120, 150)), large, interpolation=cv2.INTER_NEAREST)
    light = np.where(shown > 0, 25 + 0.8 * seen, wall).astype(np.float32)
    light *= np.linspace(rng.uniform(0.7, 1.0), rng.uniform(0.7, 1.0), large[0], dtype=np.float32)
    light = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), rng.uniform(*blur))
    return np.clip(light + rng.normal(0.0, noise, light.shape), 0, 255).astype(np.uint8)


def described(board: Print) -> dict[str, Any]:
    """The right description of a board, with sides of 30 mm."""
    said = {**board.said}
    kind, family = said["kind"], said.pop("family", "")
    said |= {"dictionary": f"DICT_{family}_1000"} if family else {}
    if kind == "charuco":
        return said | {"square_m": 0.03, "marker_m": 0.021}
    if kind == "checkerboard":
        return said | {"square_m": 0.03}
    if kind == "circles":
        return said | {"square_m": 0.03, "diameter_m": 0.0165}
    return {"spacing": 0.3} | said | {"size_m": 0.03}


# What makes sound boards hard to find.
HARD: dict[str, dict[str, Any]] = {
    "small": {"fill": (0.12, 0.25)},
    "far": {"fill": (0.06, 0.1)},
    "hidden in part": {"hidden": 0.5},
    "blurred": {"blur": (2.5, 5.0)},
    "very blurred": {"blur": (5.0, 9.0)},
    "noisy": {"noise": 25.0},
    "cut off": {"fill": (1.3, 1.7)},
    "steep": {"tilt": 1.1},
}


def is_named(board: Print, identity) -> bool:
    """Whether an identity says what a board is."""
    found, said = identity.board, board.said
    right = found.kind == said["kind"]
    if "columns" in said:
        counts, expected = (found.columns, found.rows), (said["columns"], said["rows"])
        # No image shows which way a plain grid is meant.
        plain = said["kind"] == "checkerboard" or said.get("asymmetric") is False
        right &= counts == expected or (plain and counts == expected[::-1])
    if "first_id" in said:
        right &= max(found.marker_id, 0) == said["first_id"]
    if "family" in said:
        right &= found.dictionary.startswith(f"DICT_{said['family']}_")
    if "id" in said:
        right &= found.marker_id == said["id"]
    if "legacy" in said:
        right &= (found.legacy and found.rows % 2 == 0) == said["legacy"]
    if "spacing" in said:
        right &= abs(found.spacing - said["spacing"]) < 0.05
    return bool(
        right
        and all(getattr(found, key) == said[key] for key in ("border", "asymmetric") if key in said)
    )

"""Images of ordinary cells: lenses after OpenCV, printed boards, and what a camera sees of them."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

# Pixels between the nodes at which a lens is inverted; cubics between them are off by under 1e-3.
NODES_PX = 8
MOST_TEXELS = 4000


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera's intrinsics, in OpenCV's parameters."""

    model: str
    resolution: tuple[int, int]
    matrix: np.ndarray
    distortion: np.ndarray

    @property
    def k(self) -> np.ndarray:
        """(3, 3) the matrix as OpenCV has it."""
        fx, fy, cx, cy = self.matrix
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """(n, 2) pixels of (n, 3) points in the camera's frame, all of them before it."""
        rays, zero = np.ascontiguousarray(points[:, None]), np.zeros(3)
        if self.model == "fisheye":
            return cv2.fisheye.projectPoints(rays, zero, zero, self.k, self.distortion)[0][:, 0]
        return cv2.projectPoints(rays, zero, zero, self.k, self.distortion)[0][:, 0]

    def plane_of(self, px: np.ndarray) -> np.ndarray:
        """(n, 2) places at depth 1 of (n, 2) pixels."""
        places = np.ascontiguousarray(px[:, None], dtype=float)
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-11)
        if self.model == "fisheye":
            return cv2.fisheye.undistortPoints(places, self.k, self.distortion, None, None, None,
                                               ends)[:, 0]  # fmt: skip
        return cv2.undistortPointsIter(places, self.k, self.distortion, None, None, ends)[:, 0]


@dataclass(frozen=True, eq=False)
class Print:
    """A printed board: what its .toml says, and the side that its squares really have [m]."""

    document: dict
    true_m: float

    @property
    def kind(self) -> str:
        """charuco, checkerboard or marker."""
        return self.document["kind"]

    @cached_property
    def size(self) -> tuple[int, int]:
        """Squares along x and y, with a checkerboard's outer ones."""
        more = {"charuco": 0, "checkerboard": 1}.get(self.kind)
        if more is None:
            return 1, 1
        return self.document["columns"] + more, self.document["rows"] + more

    @cached_property
    def origin(self) -> np.ndarray:
        """Where the target's frame begins, in squares from the print's upper left corner."""
        return np.array(
            {"charuco": 0.0, "checkerboard": 1.0, "marker": 0.5}[self.kind] * np.ones(2)
        )

    @cached_property
    def corners(self) -> np.ndarray:
        """(n, 3) the places that are found in images, in the target's frame [m]."""
        columns, rows = self.size
        if self.kind == "marker":
            grid = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        else:
            x, y = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
            grid = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
        flat = self.true_m * (grid - self.origin)
        return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)

    @cached_property
    def centre(self) -> np.ndarray:
        """(3,) the print's middle, in the target's frame [m]."""
        return np.append(self.true_m * (0.5 * np.array(self.size) - self.origin), 0.0)

    @property
    def dictionary(self) -> cv2.aruco.Dictionary:
        """The markers."""
        name = self.document["dictionary"]
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))

    def half_turns(self) -> list[np.ndarray]:
        """The motions (4, 4) of the board that leave a checkerboard's corners as they are."""
        turns = [np.eye(4)]
        columns, rows = self.size
        if self.kind != "checkerboard" or (columns + rows) % 2:
            return turns
        steps = (1, 2, 3) if columns == rows else (2,)
        middle = self.true_m * 0.5 * np.array([columns - 2, rows - 2, 0.0])
        for step in steps:
            turn = np.eye(4)
            c, s = np.cos(step * np.pi / 2), np.sin(step * np.pi / 2)
            turn[:2, :2] = np.round([[c, -s], [s, c]])
            turn[:3, 3] = middle - turn[:3, :3] @ middle
            turns.append(turn)
        return turns

    def texture(self, square_px: float, blur_px: float) -> tuple[np.ndarray, int, float]:
        """The print with its white margin, its texels a square, and the margin [squares].

        It is blurred as the image will be, so that sampling it makes no steps. A blur on paper
        moves no corner, whatever the lens.
        """
        columns, rows = self.size
        margin = 0.6 if self.kind != "marker" else 0.3
        sides = np.array([columns, rows]) + 2.0 * margin
        n = int(min(np.ceil(2.5 * square_px), MOST_TEXELS / sides.max()))
        n = max(20, 20 * round(n / 20))  # so that both margins are whole texels
        image = np.full((rows * n, columns * n), 255, np.uint8)
        if self.kind == "marker":
            image = self._marker(self.document["id"], n)
        elif self.kind == "checkerboard":
            dark = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0
            image[np.kron(dark, np.ones((n, n), bool))] = 0
        else:
            self._draw_charuco(image, n)
        padded = np.pad(image, round(margin * n), constant_values=255)
        return cv2.GaussianBlur(padded, (0, 0), max(0.5, blur_px * n / square_px)), n, margin

    def _draw_charuco(self, image: np.ndarray, n: int) -> None:
        """Squares without a marker are dark; OpenCV's board says which have one."""
        columns, rows = self.size
        ratio = self.document["marker_m"] / self.document["square_m"]
        board = cv2.aruco.CharucoBoard((columns, rows), 1.0, ratio, self.dictionary)
        board.setLegacyPattern(self.document.get("legacy", False))
        dark = np.ones((rows, columns), bool)
        side = max(1, round(ratio * n))
        for number, corners in zip(board.getIds().ravel(), board.getObjPoints(), strict=True):
            left, top = np.round(n * corners[0, :2]).astype(int)
            image[top : top + side, left : left + side] = self._marker(int(number), side)
            column, row = np.floor(corners.mean(axis=0)[:2]).astype(int)
            dark[row, column] = False
        image[np.kron(dark, np.ones((n, n), bool))] = 0

    def _marker(self, number: int, side: int) -> np.ndarray:
        bits = self.dictionary.markerSize + 2
        small = self.dictionary.generateImageMarker(number, bits, borderBits=1)
        at = (np.arange(side) * bits) // side
        return small[np.ix_(at, at)]


@dataclass(frozen=True)
class Light:
    """How an image is exposed: grey levels, blur and noise."""

    dark: float
    bright: float
    ground: float
    blur_px: float
    noise: float


def background(rng: np.random.Generator, lens: Lens, light: Light) -> np.ndarray:
    """A wall with a gradient across it, and a few things before it."""
    width, height = lens.resolution
    across = np.linspace(-1.0, 1.0, width, dtype=np.float32) * rng.uniform(-15, 15)
    down = np.linspace(-1.0, 1.0, height, dtype=np.float32) * rng.uniform(-15, 15)
    image = np.add.outer(down, across) + np.float32(light.ground)
    for _ in range(rng.integers(0, 5)):
        left, top = rng.integers(0, [width, height])
        size = (rng.uniform(0.05, 0.3, 2) * [width, height]).astype(int)
        image[top : top + size[1], left : left + size[0]] += np.float32(rng.uniform(-30, 30))
    return image


@lru_cache(maxsize=4)
def _texture(board: Print, square_px: float, blur_px: float) -> tuple[np.ndarray, int, float]:
    return board.texture(square_px, blur_px)


def draw(image: np.ndarray, lens: Lens, board: Print, cam_from_target: np.ndarray,
         light: Light, square_px: float) -> tuple[slice, slice] | None:  # fmt: skip
    """Draws a board into an image, in place; gives the rows and columns that it may cover."""
    box = _box(lens, board, cam_from_target)
    if box is None:
        return None
    left, top, right, bottom = box
    printed, n, margin = _texture(board, square_px, light.blur_px)
    # A texel's middle is half a texel from its edge.
    u, v = (n * (square + margin) - 0.5 for square in _squares(lens, board, cam_from_target, box))
    grey = cv2.remap(printed, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, 255)
    high, wide = printed.shape
    on = (u > -0.5) & (u < wide - 0.5) & (v > -0.5) & (v < high - 0.5)
    scale = (light.bright - light.dark) / 255.0
    part = image[top:bottom, left:right]
    part[on] = light.dark + scale * grey[on]
    return slice(top, bottom), slice(left, right)


def exposed(rng: np.random.Generator, image: np.ndarray, light: Light,
            where: list[tuple[slice, slice]] | None) -> np.ndarray:  # fmt: skip
    """Adds noise, everywhere or where it matters alone, and rounds."""
    out = np.clip(image, 0, 255).astype(np.uint8)
    for rows, columns in [(slice(None), slice(None))] if where is None else where:
        part = image[rows, columns]
        noisy = part + np.float32(light.noise) * rng.standard_normal(part.shape, dtype=np.float32)
        out[rows, columns] = np.clip(np.rint(noisy), 0, 255)
    return out


def _box(lens: Lens, board: Print, pose: np.ndarray) -> tuple[int, int, int, int] | None:
    """The part of the image that a board with its margin may cover: left, top, right, bottom."""
    columns, rows = board.size
    around = np.linspace(0.0, 1.0, 9)
    x, y = np.meshgrid(-1 + (columns + 2) * around, -1 + (rows + 2) * around)
    flat = board.true_m * (np.stack([x.ravel(), y.ravel()], axis=1) - board.origin)
    points = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    # Beyond the image a lens is not declared, and may fold back.
    width, height = lens.resolution
    edge = lens.plane_of(np.array([[0, 0], [width - 1, 0], [0, height - 1],
                                   [width - 1, height - 1.0]]))  # fmt: skip
    reach = 1.02 * np.abs(edge).max(axis=0)
    plane = seen[:, :2] / np.maximum(seen[:, 2:], 1e-3)
    plane = np.clip(plane, -reach, reach)
    px = lens.project(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
    low = np.clip(np.floor(px.min(axis=0)) - 4, 0, [width, height]).astype(int)
    high = np.clip(np.ceil(px.max(axis=0)) + 5, 0, [width, height]).astype(int)
    if (high - low < 8).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _squares(lens: Lens, board: Print, pose: np.ndarray,
             box: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Where the pixels of a box look on the board, in squares from its upper left corner: x, y."""
    spans = ((box[0], box[2]), (box[1], box[3]))
    nodes = [np.arange(low - NODES_PX, high + 2 * NODES_PX, NODES_PX) for low, high in spans]
    x, y = np.meshgrid(*nodes)
    plane = lens.plane_of(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    # The board's plane in the camera's frame; its x and y are the first two rows of the inverse.
    to_board = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    on = rays @ to_board.T
    squares = on[:, :2] / on[:, 2:] / board.true_m + board.origin
    across, down = (
        CubicSpline(places, np.eye(len(places)))(np.arange(low, high)).astype(np.float32)
        for places, (low, high) in zip(nodes, spans, strict=True)
    )
    u, v = (down @ column.reshape(x.shape).astype(np.float32) @ across.T for column in squares.T)
    return u, v

"""Pictures of printed boards whose corners are known to a ten-thousandth of a pixel.

Each sub-pixel gets the share of its area that is light, so that edges lie exactly where they are;
optics (disc, line of motion), the sensor's pixels, tone, noise and files follow one another as they
do in a camera. Nothing here is shared with what finds corners.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from visioncal.core.types import Target
from visioncal.vision.boards.charuco import marked_squares
from visioncal.vision.boards.kind import marker_cells
from visioncal.vision.targets import corner_positions

SAMPLES = 4
FOCAL_PX = 1300.0
# The white margin around a print [squares]; a quarter of that around a marker, which is one square.
MARGIN = 1


@dataclass(frozen=True)
class Shot:
    """How a board is photographed."""

    square_px: float = 40.0  # Mean side of its squares in the image.
    tilt_deg: float = 25.0  # How far it is turned out of the image's plane, about a random axis.
    disc_px: float = 0.0  # Radius of the disc of defocus.
    motion_px: float = 0.0  # Length of the line that all moves along during the exposure.
    noise: float = 2.0  # Standard deviation of a pixel [grey levels of 255].
    gamma: float = 1.0  # Exponent of the tone curve.
    jpeg: int = 0  # Quality of the file; none where 0.
    ink_px: float = 0.0  # How far the dark squares' edges are moved outwards.
    uneven: float = 0.0  # By how much of itself the light falls off across the image.
    bayer: bool = False  # Whether a colour sensor's mosaic is interpolated and turned into grey.
    bend: float = 0.02  # Radial distortion at the image's edge, as a share of the radius.
    levels: tuple[float, float] = (30.0, 210.0)  # Grey levels of dark and light.


@lru_cache(maxsize=16)
def _print(target: Target):
    """Lines of the cells along x and y [squares], and which cells are light, (rows, columns)."""
    if target.kind == "checkerboard":
        columns, rows = target.columns + 1, target.rows + 1
        light = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 1
        lines = np.arange(columns + 1.0) - 1, np.arange(rows + 1.0) - 1
    elif target.kind == "circles":
        places = corner_positions(target)[:, :2] / target.square_m
        lines = tuple(
            np.array([end[0], end[1]])
            for end in (
                (places[:, axis].min() - 0.5, places[:, axis].max() + 0.5) for axis in (0, 1)
            )
        )
        light = np.ones((1, 1), bool)
    elif target.kind == "aprilgrid":
        lines, light = _aprilgrid(target)
    elif target.kind == "marker":
        light = ~marker_cells(target.dictionary, target.marker_id)
        lines = (np.arange(len(light) + 1) / len(light) - 0.5,) * 2
    else:
        columns, rows = target.columns, target.rows
        share = target.marker_m / target.square_m
        side = len(marker_cells(target.dictionary, 0))
        cuts = np.concatenate([[0.0], (1 - share) / 2 + share * np.arange(side + 1) / side])
        n = len(cuts)
        light = np.zeros((rows * n, columns * n), bool)
        for number, (column, row) in enumerate(marked_squares(target).tolist()):
            square = np.ones((n, n), bool)
            square[1:-1, 1:-1] = ~marker_cells(target.dictionary, number)
            light[row * n : (row + 1) * n, column * n : (column + 1) * n] = square
        lines = tuple(
            np.append((np.arange(count)[:, None] + cuts).ravel(), count)
            for count in (columns, rows)
        )
    light = np.pad(light, 1, constant_values=True)
    return lines, light.astype(float)


def _aprilgrid(target: Target):
    """Rows of tags, turned as on Kalibr's pages, between rows of small squares."""
    side, gap = 6 + 2 * target.border, target.spacing
    cuts = np.append(-gap, np.arange(side) / side)
    n, pitch = len(cuts), 1.0 + gap
    lines = tuple(
        np.append(
            (pitch * np.arange(count)[:, None] + cuts).ravel(), [pitch * count - gap, pitch * count]
        )
        for count in (target.columns, target.rows)
    )
    light = np.ones((target.rows * n + 1, target.columns * n + 1), bool)
    light[::n, ::n] = False
    for number in range(target.columns * target.rows):
        row, column = target.rows - 1 - number // target.columns, number % target.columns
        cells = marker_cells(target.dictionary, target.marker_id + number, target.border)
        light[row * n + 1 : (row + 1) * n, column * n + 1 : (column + 1) * n] = ~cells[::-1, ::-1]
    return lines, light


def photograph(target: Target, shot: Shot, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Takes a picture: (h, w) grey levels, and the (n, 2) corners in the target's order [px]."""
    rng = np.random.default_rng(seed)
    lines, light = _print(target)
    low, high = (np.array([line[end] for line in lines]) for end in (0, -1))
    axis = np.array([np.cos(roll := rng.uniform(0, 2 * np.pi)), np.sin(roll), 0.0])
    tilt = Rotation.from_rotvec(np.deg2rad(shot.tilt_deg) * axis)
    turn = tilt * Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)
    middle = np.append((low + high) / 2, 0.0)
    place = np.array([0.0, 0.0, FOCAL_PX / shot.square_px]) - turn.apply(middle)
    # (3, 3) from the board [squares] to the image before its lens bends it [px].
    flat = np.stack([*turn.as_matrix().T[:2], place], axis=1)
    flat = np.diag([FOCAL_PX, FOCAL_PX, 1.0]) @ flat
    edges = np.array([[low[0], low[1]], [high[0], low[1]], high, [low[0], high[1]]])
    margin = MARGIN / 4 if target.kind == "marker" else MARGIN
    edges = edges + margin * np.sign(edges - (low + high) / 2)
    bounds = cv2.perspectiveTransform(edges[None], flat)[0]
    origin = bounds.min(axis=0) - rng.uniform(3, 4, 2)
    width, height = np.ceil(bounds.max(axis=0) - origin + 4).astype(int)
    flat = np.array([[1, 0, -origin[0]], [0, 1, -origin[1]], [0, 0, 1]]) @ flat
    lens = _Lens(np.array([width - 1, height - 1]) / 2, shot.bend)
    truth = corner_positions(target)[:, :2] / target.square_m
    truth = lens.bent(cv2.perspectiveTransform(truth[None], flat)[0])

    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    u = (np.arange(width)[:, None] + steps).ravel()
    v = (np.arange(height)[:, None] + steps).ravel()
    places = lens.straight(np.stack(np.meshgrid(u, v)), axis=0)
    x, y, z = (row[0] * places[0] + row[1] * places[1] + row[2] for row in np.linalg.inv(flat))
    x, y = x / z, y / z
    ink = shot.ink_px / shot.square_px
    if target.kind == "circles":
        picture = _discs(x, y, target, ink)
    else:
        picture = _covered(x, y, lines, light, ink)
    picture = _through(picture, shot, rng.uniform(0, np.pi))
    picture = picture.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
    return _read_out(picture, shot, rng), truth


@dataclass(frozen=True, eq=False)
class _Lens:
    middle: np.ndarray
    bend: float

    def straight(self, px: np.ndarray, axis: int = -1) -> np.ndarray:
        """Places before the lens bends them; `axis` has both coordinates."""
        off = px - (self.middle if axis else self.middle[:, None, None])
        bend = self.bend / (self.middle @ self.middle)
        return px + bend * off * (off**2).sum(axis=axis, keepdims=True)

    def bent(self, px: np.ndarray) -> np.ndarray:
        found = px.copy()
        for _ in range(60):
            found += px - self.straight(found)
        return found


def _covered(x, y, lines, light, ink):
    """Share of each sub-pixel that is light."""
    near = [_nearest(value, line) for value, line in zip((x, y), lines, strict=True)]
    (at_x, off_x), (at_y, off_y) = near
    slopes_x, slopes_y = _slopes(x), _slopes(y)
    picture = light[at_y + (off_y > 0), at_x + (off_x > 0)]
    # Elsewhere, no edge comes into the sub-pixel.
    cut = (np.abs(off_x) < _reach(slopes_x) + abs(ink)) | (
        np.abs(off_y) < _reach(slopes_y) + abs(ink)
    )
    at_x, off_x, at_y, off_y = (value[cut] for value in (at_x, off_x, at_y, off_y))
    wide_x, wide_y = _spreads(slopes_x, cut), _spreads(slopes_y, cut)
    cells = [[light[at_y + j, at_x + i] for i in (0, 1)] for j in (0, 1)]
    # Dark grows by the ink: an edge from dark to light moves towards the light side.
    share_x = [_beyond(wide_x, off_x - ink * (row[1] - row[0])) for row in cells]
    rise = np.where(off_x > 0, cells[1][1] - cells[0][1], cells[1][0] - cells[0][0])
    share_y = _beyond(wide_y, off_y - ink * rise)
    upper, lower = (
        row[0] + (row[1] - row[0]) * share for row, share in zip(cells, share_x, strict=True)
    )
    picture[cut] = upper + (lower - upper) * share_y
    return picture


def _discs(x, y, target, ink):
    """Likewise around circles, whose edges are straight within a sub-pixel."""
    places = corner_positions(target)[:, :2] / target.square_m
    radius = target.diameter_m / target.square_m / 2 + ink
    # Farther away, it does not matter how far.
    most = 1.5 * radius
    board = np.column_stack([x.ravel(), y.ravel()])
    found = KDTree(places).query(board, distance_upper_bound=most)[0]
    away = np.minimum(found, most).reshape(x.shape)
    slopes = _slopes(away)
    share, cut = (away > radius).astype(float), np.abs(away - radius) < _reach(slopes)
    share[cut] = _beyond(_spreads(slopes, cut), away[cut] - radius)
    return share


def _nearest(places, lines):
    """Index of the nearest line, and how far beyond it each place is."""
    middles = (lines[:-1] + lines[1:]) / 2
    at = np.searchsorted(middles, places)
    return at, places - lines[at]


def _slopes(field):
    """By how much a field changes from sub-pixel to sub-pixel, downwards and to the right."""
    return [np.maximum(np.abs(value), 1e-9) for value in np.gradient(field)]


def _reach(slopes):
    """Half of what a sub-pixel's places spread over, or a thousandth more."""
    return 0.5005 * (slopes[0] + slopes[1])


def _spreads(slopes, cut):
    """Both even spreads (2, k) of the places in some sub-pixels, the larger first."""
    down, right = (value[cut] for value in slopes)
    large = np.maximum(down, right)
    return np.stack([large, np.maximum(np.minimum(down, right), 1e-3 * large)])


def _beyond(wide, off):
    """Share of a sub-pixel beyond a straight line: its places are the sum of two even spreads."""
    large, small = wide
    outer, inner = (large + small) / 2, (large - small) / 2
    parts = ((off + outer, 1), (off + inner, -1), (off - inner, -1), (off - outer, 1))
    share = sum(sign * np.maximum(value, 0.0) ** 2 for value, sign in parts) / (2 * large * small)
    return np.clip(share, 0.0, 1.0)


def _through(picture, shot, direction):
    """The optics: a little blur that every lens has, defocus, and a line of motion."""
    picture = cv2.GaussianBlur(picture, (0, 0), 0.35 * SAMPLES, borderType=cv2.BORDER_REPLICATE)
    half = np.array([np.cos(direction), np.sin(direction)]) * shot.motion_px * SAMPLES / 2
    for kernel in (disc_kernel(shot.disc_px * SAMPLES), line_kernel(half)):
        if kernel.size > 1:
            picture = cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return picture


def _kernel(reach, inside):
    """A kernel from (n, n) finely sampled places that are inside or not."""
    side, fine = 2 * int(np.ceil(reach)) + 3, 9
    steps = (np.arange(side * fine) + 0.5) / fine - side / 2
    kernel = inside(*np.meshgrid(steps, steps)).reshape(side, fine, side, fine).mean(axis=(1, 3))
    return kernel / kernel.sum()


def disc_kernel(radius):
    if radius <= 0:
        return np.ones((1, 1))
    return _kernel(radius, lambda x, y: (x**2 + y**2 <= radius**2).astype(float))


def line_kernel(half):
    length = np.linalg.norm(half)
    if length <= 0:
        return np.ones((1, 1))
    along = half / length
    return _kernel(
        length,
        lambda x, y: (
            (np.abs(x * along[0] + y * along[1]) <= length)
            & (np.abs(x * along[1] - y * along[0]) <= 0.5)
        ).astype(float),
    )


def _read_out(picture, shot, rng):
    """From light to grey levels in a file."""
    height, width = picture.shape
    dark, bright = shot.levels
    slope = (
        np.linspace(1.0 - shot.uneven, 1.0, width)
        * np.linspace(1.0, 1.0 - shot.uneven / 2, height)[:, None]
    )
    linear = (dark + (bright - dark) * picture) * slope / 255.0
    levels = 255.0 * linear**shot.gamma + shot.noise * rng.standard_normal(picture.shape)
    image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    if shot.bayer:
        colour = cv2.demosaicing(_mosaic(levels), cv2.COLOR_BayerBG2BGR)
        image = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    if shot.jpeg:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, shot.jpeg])[1]
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    return image


def _mosaic(levels):
    """What a colour sensor reads: red and blue pixels answer less to the light than green ones."""
    answer = np.array([[0.75, 1.0], [1.0, 0.6]])
    tiled = np.tile(answer, (levels.shape[0] // 2 + 1, levels.shape[1] // 2 + 1))
    return np.clip(np.rint(levels * tiled[: levels.shape[0], : levels.shape[1]]), 0, 255).astype(
        np.uint8
    )

"""Finding grids of circles: blobs that lie on a lattice, and which of its points the grid has."""

from collections import deque
from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import cv2
import numpy as np
from scipy.spatial import cKDTree

from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.targets import circle_places

# Dark is darker than its surroundings, so wide as a share of the image's shorter side, by so many
# levels. Blobs have areas [px] and fill the ellipse of their moments; a square fills 0.955 of it,
# and a circle of few pixels somewhat less than all: their median separates them.
_SURROUNDINGS, _DARKER, _LEAST_AREA, _FILL, _ROUND = 0.12, 12, 12.0, 0.88, 0.97
# The inner edge of a blob has so much of its width.
_INNER = 0.5
# Neighbours on a lattice are not wider or narrower in any direction by more.
_ALIKE = 1.6
# A lattice is looked for from so many blobs; its neighbours lie within so much of a step from where
# the steps before lead, and its first steps are among so many nearest blobs.
_SEEDS, _OFF, _NEAREST = 16, 0.3, 8
# Fewer blobs are no grid.
_LEAST = 9
# The diameter that is seen may differ by so much from the stated one, as a share of it, and by so
# many pixels: ink and light spread.
_DIAMETER, _SPREAD_PX = 0.2, 3.0
# Bases of a lattice: by which matrices one leads to another.
_BASES = np.array(
    [
        pair
        for pair in product(range(-2, 3), repeat=4)
        if pair[0] * pair[3] - pair[1] * pair[2] in (1, -1)
    ]
).reshape(-1, 2, 2)
# From a basis of a staggered grid, whose circles lie where column and row are both even or odd.
_STAGGER = np.array([[1, 1], [1, -1]])


@dataclass(frozen=True, eq=False)
class Circles:
    """A grid of circles in an image.

    Attributes:
        columns: Circles along x, in each row.
        rows: Rows.
        asymmetric: Whether every second row is shifted by half a step.
        px: (n, 2) about where the centres are, row by row [px].
        share: The diameter over the distance of neighbouring columns or rows.
        diameter_px: Its median [px].
    """

    columns: int
    rows: int
    asymmetric: bool
    px: FloatArray
    share: float
    diameter_px: float


def find_circles(image: Image, target: Target) -> DetectedCorners | NotFound:
    """Finds the centres of a grid of circles, to a pixel or so.

    Where the grid looks the same after a turn, the one that turns least against the image is taken.

    Args:
        image: (h, w) grey image.
        target: A grid of circles.

    Returns:
        The centres, or why there are none.
    """
    seen = seen_grids(image)
    for circles in seen:
        if (circles.columns, circles.rows, circles.asymmetric) == (
            target.columns,
            target.rows,
            target.asymmetric,
        ):
            share = target.diameter_m / target.square_m
            if abs(circles.share / share - 1.0) > _DIAMETER + _SPREAD_PX / circles.diameter_px:
                return NotFound(
                    f"the circles' diameter is {circles.share:.2f} of square_m, and the target "
                    f"says {share:.2f}",
                    misfit=True,
                )
            return DetectedCorners(np.arange(len(circles.px)), circles.px)
    layout = "asymmetric" if target.asymmetric else "symmetric"
    wanted = f"{layout} grid of {target.columns} x {target.rows} circles"
    if not seen:
        return NotFound(f"no board: no {wanted} is seen")
    found = seen[0]
    return NotFound(
        f"{_article(found.asymmetric)} grid of {found.columns} x {found.rows} circles is seen, "
        f"and the target is {_article(target.asymmetric)} one of {target.columns} x {target.rows}",
        misfit=True,
    )


def _article(asymmetric: bool) -> str:
    return "an asymmetric" if asymmetric else "a symmetric"


def seen_grids(image: Image) -> tuple[Circles, ...]:
    """Finds a grid of circles in all its numberings, those first that turn least from upright.

    Args:
        image: (h, w) grey image.

    Returns:
        The same circles in any order in which they are a grid; none where they are not.
    """
    blobs = _blobs(image)
    if len(blobs.px) < _LEAST:
        return ()
    lattice, members = _lattice(blobs)
    if len(members) < _LEAST or np.median(blobs.fill[members]) < _ROUND:
        return ()
    px, diameters = blobs.px[members], blobs.diameters[members]
    grids = []
    for basis, asymmetric in product(_BASES, (False, True)):
        grid = _grid(lattice @ (basis @ _STAGGER if asymmetric else basis), px, asymmetric)
        if grid is not None:
            columns, rows, order = grid
            places = circle_places(columns, rows, asymmetric=asymmetric)
            share = _share(places, px[order], diameters[order])
            width = float(np.median(diameters))
            if share > 0.0:
                grids.append(Circles(columns, rows, asymmetric, px[order], share, width))
    return tuple(sorted(grids, key=lambda value: abs(_turn(value))))


def _turn(grid: Circles) -> float:
    """The angle of the first row against the image's rows [rad]."""
    along = grid.px[grid.columns - 1] - grid.px[0]
    return float(np.arctan2(along[1], along[0]))


@dataclass(frozen=True, eq=False)
class _Blobs:
    """Dark blobs: their middles (n, 2) [px], and the second moments (n, 2, 2) of each [px^2].

    `fill` (n,) says which share of the ellipse of its moments each fills.
    """

    px: FloatArray
    moments: FloatArray
    fill: FloatArray

    def at(self, chosen: IntArray) -> Self:
        """Some of them."""
        return replace(
            self, px=self.px[chosen], moments=self.moments[chosen], fill=self.fill[chosen]
        )

    @property
    def diameters(self) -> FloatArray:
        """(n,) diameters of circles of the same area [px]."""
        return np.asarray(4.0 * np.linalg.det(self.moments) ** 0.25)

    def alike(self, one: int, other: int) -> bool:
        """Whether two blobs could be the same shape, seen from about the same side."""
        ratios = np.linalg.eigvals(np.linalg.solve(self.moments[one], self.moments[other])).real
        return bool(np.abs(np.log(np.maximum(ratios, 1e-9))).max() < 2.0 * np.log(_ALIKE))


def _blobs(image: Image) -> _Blobs:
    """Dark blobs that fill the ellipse of their moments."""
    block = 2 * int(_SURROUNDINGS * min(image.shape) / 2) + 3
    dark = cv2.adaptiveThreshold(
        image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, _DARKER
    )
    middles, moments, fills = [], [], []
    for contour in cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        of = cv2.moments(contour)
        area = of["m00"]
        if area < _LEAST_AREA:
            continue
        covariance = np.array([[of["mu20"], of["mu11"]], [of["mu11"], of["mu02"]]]) / area
        ellipse = 4.0 * np.pi * np.sqrt(max(np.linalg.det(covariance), 0.0))
        if area < _FILL * ellipse or ellipse <= 0.0:
            continue
        fills.append(area / ellipse)
        middles.append((of["m10"] / area, of["m01"] / area))
        # A contour runs through the outermost dark pixels' centres, half a pixel inside the edge.
        radius = np.sqrt(area / np.pi)
        moments.append(((radius + 0.5) / radius) ** 2 * covariance)
    found = _Blobs(np.reshape(middles, (-1, 2)), np.reshape(moments, (-1, 2, 2)), np.array(fills))
    # What is larger than its surroundings has an edge inside too, not far from the outer one.
    found = found.at(np.argsort(-found.diameters, kind="stable"))
    pairs = cKDTree(found.px).query_pairs(2.0) if len(found.px) else set()
    wide = found.diameters
    inner = [max(pair) for pair in pairs if wide[max(pair)] > _INNER * wide[min(pair)]]
    return found.at(np.setdiff1d(np.arange(len(found.px)), inner))


def _lattice(blobs: _Blobs) -> tuple[IntArray, IntArray]:
    """The largest set of points that lie on one lattice: (n, 2) steps, and which points, (n,)."""
    px, tree = blobs.px, cKDTree(blobs.px)
    best: dict[tuple[int, int], int] = {}
    # The largest come first; letters and scratches are smaller than a board's circles.
    for seed in range(min(_SEEDS, len(px))):
        steps = _first_steps(px, tree, seed)
        grown = _grown(blobs, tree, seed, steps) if steps is not None else {}
        best = grown if len(grown) > len(best) else best
    return np.array(list(best), dtype=np.int64).reshape(-1, 2), np.array(list(best.values()), int)


def _first_steps(px: FloatArray, tree: cKDTree, seed: int) -> FloatArray | None:
    """Two steps (2, 2) that lead from a point to others, forwards and backwards [px]."""
    near = tree.query(px[seed], k=min(_NEAREST + 1, len(px)))[1][1:]
    steps: list[FloatArray] = []
    for other in near.tolist():
        step = px[other] - px[seed]
        length = float(np.linalg.norm(step))
        if tree.query(px[seed] - step)[0] > _OFF * length:
            continue
        slant = [abs(float(step[0] * array[1] - step[1] * array[0])) for array in steps]
        if all(value > _OFF * length * float(np.linalg.norm(steps[0])) for value in slant):
            steps.append(step)
        if len(steps) == 2:
            return np.array(steps)
    return None


def _grown(
    blobs: _Blobs, tree: cKDTree, seed: int, steps: FloatArray
) -> dict[tuple[int, int], int]:
    """The points that steps lead to, each from its neighbour, by their place on the lattice."""
    px = blobs.px
    places, taken = {(0, 0): seed}, {seed}
    waiting = deque([((0, 0), steps)])
    while waiting:
        place, local = waiting.popleft()
        for axis, sign in product((0, 1), (1, -1)):
            there = (place[0] + sign * (axis == 0), place[1] + sign * (axis == 1))
            away, other = tree.query(px[places[place]] + sign * local[axis])
            if there in places or other in taken:
                continue
            if away > _OFF * np.linalg.norm(local[axis]):
                continue
            if not blobs.alike(places[place], int(other)):
                continue
            places[there] = int(other)
            taken.add(int(other))
            onward = local.copy()
            onward[axis] = sign * (px[other] - px[places[place]])
            waiting.append((there, onward))
    return places


def _grid(places: IntArray, px: FloatArray, asymmetric: bool) -> tuple[int, int, IntArray] | None:
    """Columns, rows and the order of points whose (n, 2) places fill a grid, right-handed."""
    places = places - places.min(axis=0)
    width, rows = (places.max(axis=0) + 1).tolist()
    columns = width // 2 if asymmetric else width
    if columns * rows != len(places) or columns < 2 or rows < 2:
        return None
    wanted = circle_places(columns, rows, asymmetric=asymmetric)
    order = np.lexsort((places[:, 0], places[:, 1]))
    if not np.array_equal(places[order], wanted):
        return None
    x, y = px[order[columns - 1]] - px[order[0]], px[order[-columns]] - px[order[0]]
    return (columns, rows, order) if x[0] * y[1] - x[1] * y[0] > 0 else None


def _share(places: IntArray, px: FloatArray, diameters: FloatArray) -> float:
    """Median diameter over the distance of neighbours, as areas have it; 0 where none is seen."""
    homography = np.asarray(cv2.findHomography(places.astype(float), px)[0], dtype=float)
    if homography.shape != (3, 3):
        return 0.0
    ends = places[:, None] + 0.25 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    there = cv2.perspectiveTransform(ends.reshape(1, -1, 2), homography)[0].reshape(-1, 4, 2)
    across, down = 2.0 * (there[:, 0] - there[:, 1]), 2.0 * (there[:, 2] - there[:, 3])
    areas = np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0])
    return float(np.median(diameters / np.sqrt(areas)))

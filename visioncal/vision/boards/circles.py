"""Grids of circles: blobs on a lattice."""

from collections import deque
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from scipy.spatial import cKDTree

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.types import FloatArray, Image, IntArray, Target, chosen_rows
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.imaging import shrunk
from visioncal.vision.boards.kind import (
    COUNTS,
    MM,
    DetectedCorners,
    NotFound,
    counts_of,
    side_metres,
    sigma_of,
    size_of,
)
from visioncal.vision.boards.prints import Print
from visioncal.vision.boards.template import Refined
from visioncal.vision.poses import FEWEST_CORNERS

# Largest diameter over spacing of circles, so that their edges remain separate; that of those named
# without being declared; that of requested ones, as much dark as white between them.
_WIDEST, _NAMED, _USUAL_DIAMETER = 0.85, 0.75, 0.5
# Tolerance of predicted neighbours in steps.
_OFF = 0.3
# Minimum number of blobs.
_LEAST = 9
# Transformations between bases of one lattice.
_BASES = np.array(
    [
        pair
        for pair in product(range(-2, 3), repeat=4)
        if pair[0] * pair[3] - pair[1] * pair[2] in (1, -1)
    ]
).reshape(-1, 2, 2)
# Basis of a staggered grid: circles lie where column and row are both even or both odd.
_STAGGER = np.array([[1, 1], [1, -1]])


class CircleGrid(Board):
    """A grid of circles. Its origin is the first one's centre; it has no markers."""

    name: ClassVar[str] = "circles"
    noun = "grid of circles"
    options = "--columns --rows --square-mm --diameter-mm --asymmetric --name"
    keys = f"{Board.keys} diameter_m asymmetric"
    in_a_word = rf"{COUNTS}_(?P<square_m>{MM})mm(?P<asymmetric>_asymmetric)?"
    side = (
        "distance from one row of circles to the next, between centres (of staggered rows half of "
        "that between circles of a row)"
    )
    sides, unit = "a distance of rows", "distance"
    symmetric: ClassVar[Literal["", "squares", "places"]] = "places"

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads columns, rows, square_m, square_sigma_m, asymmetric and diameter_m.

        The diameter is found in each image: it may be left out.
        """
        columns, rows = counts_of(table)
        square_m = size_of(table, "square_m")
        asymmetric = table.flag("asymmetric")
        # Distance of the nearest circles.
        spacing_m = square_m * np.sqrt(2.0) if asymmetric else square_m
        diameter_m = table.number("diameter_m", _USUAL_DIAMETER * spacing_m, positive=True)
        if diameter_m >= _WIDEST * spacing_m:
            needed = f"less than {_WIDEST:g} of the distance of neighbours, {spacing_m:g} m"
            raise table.refuse("diameter_m", diameter_m, needed)
        return Target(
            name,
            self.name,
            columns,
            rows,
            square_m,
            sigma_of(table, square_m),
            diameter_m=diameter_m,
            asymmetric=asymmetric,
        )

    def corners(self, target: Target) -> FloatArray:
        """(n, 3) centres [m], row by row."""
        places = circle_places(target.columns, target.rows, asymmetric=target.asymmetric)
        return np.asarray(target.square_m * np.pad(places, ((0, 0), (0, 1))), dtype=float)

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        return f"{'asymmetric' if target.asymmetric else 'symmetric'} grid of {size} circles"

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print [m]."""
        low, high = super().extent_m(target)
        return low - target.diameter_m / 2, high + target.diameter_m / 2

    def discs(self, target: Target) -> FloatArray:
        """(n, 3) centres and radii of the circles [m]."""
        places = self.corners(target)
        places[:, 2] = target.diameter_m / 2
        return places

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        side_mm, steps = 1e3 * target.square_m, target.rows - 1
        words = self.words(target, f"{target.columns} x {target.rows}")
        return (
            f"{words} of {1e3 * target.diameter_m:g} mm, rows {side_mm:g} mm apart",
            "the centre of the circle at the top left",
            "Measure from the first row's centres to the last one's, meant to be "
            f"{steps * side_mm:g} mm; divide by {steps} and write the result into square_m, in "
            "metres.",
        )

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested board."""
        document = super().requested(request, square_mm)
        diameter_mm = request.diameter_mm
        if diameter_mm is None:
            spacing = 1.4 if request.asymmetric else 1.0
            diameter_mm = round(_USUAL_DIAMETER * spacing * square_mm, 6)
        return document | {
            "diameter_m": side_metres("--diameter-mm", diameter_mm),
            "asymmetric": request.asymmetric,
        }

    def file_name(self, target: Target, side: str) -> str:
        """Name of a target with sides of `side`."""
        return super().file_name(target, side) + ("_asymmetric" if target.asymmetric else "")

    def around(self, target: Target, ids: IntArray, squares: FloatArray) -> Print:
        """The print around centres, half way to the next circle."""
        del squares
        half = float(np.sqrt(0.5)) if target.asymmetric else 0.5
        radii = np.full(len(ids), target.diameter_m / target.square_m / 2)
        return Print(np.ones(len(ids)), np.inf, half, radii)

    def refine(self, image: Image, target: Target, ids: IntArray, px: FloatArray) -> Refined:
        """Refines (n, 2) detected centres [px] with these (n,) ids by the template."""
        if len(px) >= FEWEST_CORNERS:
            places = self.corners(target)[ids]
            scale = np.linalg.norm(px - px.mean(axis=0)) / np.linalg.norm(
                places - places.mean(axis=0)
            )
            # Circles of a larger diameter are fitted at half the image size [px].
            if scale * target.diameter_m > 40.0:
                # Half of the size has edges of enough pixels.
                half = self.refine(shrunk(image, 2), target, ids, (px - 0.5) / 2)
                half_px = (2 * half.px + 0.5, 2 * half.sigma_px, 2 * half.blur_px)
                return Refined(*half_px, half.grown)
        return super().refine(image, target, ids, px)

    def search(
        self, image: Image, target: Target, *, quick: bool = False
    ) -> DetectedCorners | NotFound:
        """Centres in a (h, w) grey image, to about a pixel, or why there are none.

        Circles are dark on light or, where no such grid is seen, light on dark. For a symmetric
        grid, the numbering with the least rotation in the image is used.
        """
        del quick
        for picture in (image, 255 - image):
            px = _centres(picture, target)
            if px is not None:
                return DetectedCorners(np.arange(len(px)), px)
        size = f"{target.columns} x {target.rows}"
        return NotFound(f"no board: no {self.words(target, size)} is seen")

    def seen_in(self, image: Image) -> tuple[Target, bool] | None:
        """The grid of circles of any count in a (h, w) grey image; see `BoardKind`."""
        for picture in (image, 255 - image):
            blobs, lattice, members = _circles(picture)
            px, grids = blobs.px[members], list[tuple[int, float, Target]]()
            for turn, asymmetric in product(_BASES if len(members) else (), (False, True)):
                places = lattice @ (turn @ _STAGGER if asymmetric else turn)
                across, down = (np.ptp(places, axis=0) + 1).tolist()
                columns, rows = (across // 2 if asymmetric else across), down
                board = Target("board", self.name, columns, rows, 1.0, 0.001, asymmetric=asymmetric)
                order = _order(places, px, board) if min(columns, rows) >= 3 else None
                if order is not None:
                    share = _diameter(
                        chosen_rows(blobs, members[order]), self.corners(board)[:, :2]
                    )
                    # Blurred squares of a checkerboard are wider.
                    if share < _NAMED * (1.4 if asymmetric else 1.0):
                        board = replace(board, diameter_m=share)
                        # The one that leaves the fewest circles over.
                        grids.append((-len(order), _turn_rad(px[order], columns), board))
            if grids:
                return min(grids, key=lambda grid: grid[:2])[2], True
        return None


def circle_places(columns: int, rows: int, *, asymmetric: bool) -> IntArray:
    """(n, 2) columns and rows of circles, row by row; for an asymmetric grid in half columns."""
    row, column = np.divmod(np.arange(columns * rows), columns)
    return np.stack([2 * column + row % 2 if asymmetric else column, row], axis=1)


def _centres(image: Image, target: Target) -> FloatArray | None:
    """(n, 2) centres of a grid's dark circles in a grey image [px]; None where none is seen."""
    blobs, lattice, members = _circles(image)
    px, turns = blobs.px[members], _BASES @ _STAGGER if target.asymmetric else _BASES
    orders = [_order(lattice @ turn, px, target) for turn in turns] if len(members) else []
    grids = [px[order] for order in orders if order is not None]
    return min(grids, key=lambda grid: _turn_rad(grid, target.columns), default=None)


def _turn_rad(grid: FloatArray, columns: int) -> float:
    """Angle of the first row of a grid of (n, 2) points [px] in the image."""
    along = grid[columns - 1] - grid[0]
    return abs(float(np.arctan2(along[1], along[0])))


def _circles(image: Image) -> tuple["Blobs", IntArray, IntArray]:
    """Dark blobs of a grey image, and the lattice and indices of those that are circles."""
    blobs = find_blobs(image)
    lattice, members = _lattice(blobs) if len(blobs.px) >= _LEAST else (np.zeros((0, 2), int),) * 2
    # The median separates circles from squares, which fill 0.955 of the ellipse of their moments.
    if len(members) < _LEAST or np.median(blobs.fill[members]) < 0.97:
        return blobs, np.zeros((0, 2), int), np.zeros(0, int)
    return blobs, lattice, members


def _diameter(circles: "Blobs", places: FloatArray) -> float:
    """Diameter of circles at (n, 2) places, in the unit of these."""
    flat = np.asarray(cv2.findHomography(places, circles.px)[0], float)
    ends = [cv2.perspectiveTransform((places + step)[None], flat)[0] for step in 0.5 * np.eye(2)]
    steps = np.stack(ends, axis=-1) - cv2.perspectiveTransform(places[None], flat)[0][..., None]
    scales = 2.0 * np.sqrt(np.abs(np.linalg.det(steps)))
    return round(float(np.median(circles.diameters / scales)), 5)


@dataclass(frozen=True, eq=False)
class Blobs:
    """Dark blobs: centres (n, 2) [px], and second moments (n, 2, 2) [px^2].

    `fill` (n,) is the share of the ellipse of its moments that each fills.
    """

    px: FloatArray
    moments: FloatArray
    fill: FloatArray

    @property
    def diameters(self) -> FloatArray:
        """(n,) diameters of circles of the same area [px]."""
        return np.asarray(4.0 * np.linalg.det(self.moments) ** 0.25)

    def alike(self, first: int, second: int) -> bool:
        """Whether two blobs could be the same shape in a similar view.

        Their widths differ by a factor of 1.6 at most, in any direction.
        """
        ratios = np.linalg.eigvals(np.linalg.solve(self.moments[first], self.moments[second])).real
        return bool(np.abs(np.log(np.maximum(ratios, 1e-9))).max() < 2.0 * np.log(1.6))


def find_blobs(image: Image) -> Blobs:
    """Dark blobs of a (h, w) grey image that look like ellipses, the largest first."""
    # The threshold's window as a share of the image's shorter side, and grey levels below its mean.
    block = 2 * int(0.12 * min(image.shape) / 2) + 3
    dark = cv2.adaptiveThreshold(
        image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, 12
    )
    centres, moments, fills = [], [], []
    for contour in cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        contour_moments = cv2.moments(contour)
        area = contour_moments["m00"]
        # The least area of a blob [px].
        if area < 12.0:
            continue
        covariance = (
            np.array(
                [
                    [contour_moments["mu20"], contour_moments["mu11"]],
                    [contour_moments["mu11"], contour_moments["mu02"]],
                ]
            )
            / area
        )
        ellipse = 4.0 * np.pi * np.sqrt(max(np.linalg.det(covariance), 0.0))
        # Blobs fill the ellipse of their moments: squares 0.955 of it, circles of few pixels a
        # little less than all.
        if area < 0.88 * ellipse or ellipse <= 0.0:
            continue
        fills.append(area / ellipse)
        centres.append((contour_moments["m10"] / area, contour_moments["m01"] / area))
        # A contour passes through the outermost dark pixels' centres, half a pixel inside the edge.
        radius = np.sqrt(area / np.pi)
        moments.append(((radius + 0.5) / radius) ** 2 * covariance)
    blobs = Blobs(np.reshape(centres, (-1, 2)), np.reshape(moments, (-1, 2, 2)), np.array(fills))
    # Blobs larger than the threshold's window also have an inner edge close to the outer one.
    blobs = chosen_rows(blobs, np.argsort(-blobs.diameters, kind="stable"))
    pairs = cKDTree(blobs.px).query_pairs(2.0) if len(blobs.px) else set()
    widths = blobs.diameters
    # A blob's inner edge is at least half as wide as its outer one.
    inner = [max(pair) for pair in pairs if widths[max(pair)] > 0.5 * widths[min(pair)]]
    return chosen_rows(blobs, np.setdiff1d(np.arange(len(blobs.px)), inner))


def _lattice(blobs: Blobs) -> tuple[IntArray, IntArray]:
    """Largest set of points on one lattice: (n, 2) lattice coordinates, and point indices (n,)."""
    px, tree = blobs.px, cKDTree(blobs.px)
    best: dict[tuple[int, int], int] = {}
    lattices = 0
    # Largest first: letters and scratches are smaller than a board's circles.
    for seed in range(min(400, len(px))):
        # Many blobs around a small board are larger than its circles.
        if seed >= 16 and lattices >= 4:
            break
        steps = _first_steps(px, tree, seed)
        grown = _grown(blobs, tree, seed, steps) if steps is not None else {}
        lattices += len(grown) >= _LEAST
        best = grown if len(grown) > len(best) else best
    return np.array(list(best), dtype=np.int64).reshape(-1, 2), np.array(list(best.values()), int)


def _first_steps(px: FloatArray, tree: cKDTree, seed: int) -> FloatArray | None:
    """Two steps (2, 2) [px] to neighbours of a point that has opposite neighbours as well."""
    neighbours = tree.query(px[seed], k=min(9, len(px)))[1][1:]
    steps: list[FloatArray] = []
    for neighbour in neighbours.tolist():
        step = px[neighbour] - px[seed]
        length = float(np.linalg.norm(step))
        if tree.query(px[seed] - step)[0] > _OFF * length:
            continue
        cross_products = [abs(float(step[0] * array[1] - step[1] * array[0])) for array in steps]
        if all(value > _OFF * length * float(np.linalg.norm(steps[0])) for value in cross_products):
            steps.append(step)
        if len(steps) == 2:
            return np.array(steps)
    return None


def _grown(blobs: Blobs, tree: cKDTree, seed: int, steps: FloatArray) -> dict[tuple[int, int], int]:
    """Points reached by repeated steps, by their lattice coordinates."""
    px = blobs.px
    places, used = {(0, 0): seed}, {seed}
    waiting = deque([((0, 0), steps)])
    while waiting:
        coordinates, local = waiting.popleft()
        for axis, sign in product((0, 1), (1, -1)):
            neighbour = (coordinates[0] + sign * (axis == 0), coordinates[1] + sign * (axis == 1))
            distance, blob = tree.query(px[places[coordinates]] + sign * local[axis])
            if neighbour in places or blob in used:
                continue
            if distance > _OFF * np.linalg.norm(local[axis]):
                continue
            if not blobs.alike(places[coordinates], int(blob)):
                continue
            places[neighbour] = int(blob)
            used.add(int(blob))
            updated = local.copy()
            updated[axis] = sign * (px[blob] - px[places[coordinates]])
            waiting.append((neighbour, updated))
    return places


def _order(places: IntArray, px: FloatArray, target: Target) -> IntArray | None:
    """Order of those points that fill the target's grid, right-handed; None for another grid.

    (n, 2) places are coordinates of all points.
    """
    expected = circle_places(target.columns, target.rows, asymmetric=target.asymmetric)
    wider = np.ptp(places, axis=0) - np.ptp(expected, axis=0)
    # A screw or a hole beside a grid may continue it; a whole row of circles is a larger grid's.
    most = min(len(expected) // 10, target.columns - 1, target.rows - 1)
    if not 0 <= len(places) - len(expected) <= most or (wider < 0).any():
        return None
    at = {place: index for index, place in enumerate(map(tuple, places.tolist()))}
    first = expected + places.min(axis=0)
    tried = (first + by for by in product(*(range(each + 1) for each in wider.tolist())))
    grids = [grid for grid in tried if all(tuple(place) in at for place in grid.tolist())]
    if len(grids) != 1:
        return None
    order = np.array([at[tuple(place)] for place in grids[0].tolist()])
    x = px[order[target.columns - 1]] - px[order[0]]
    y = px[order[-target.columns]] - px[order[0]]
    return order if x[0] * y[1] - x[1] * y[0] > 0 else None

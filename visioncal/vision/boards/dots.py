"""Boards of random dots, listed in a table; four larger dots give the correspondences."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar, cast

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Image, IntArray, Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards.board import Board
from visioncal.vision.boards.circles import find_blobs
from visioncal.vision.boards.kind import DetectedCorners, NotFound, sigma_of
from visioncal.vision.boards.points import PointsKind, points_of
from visioncal.vision.boards.prints import Print

_COLUMNS = ("point", "x_m", "y_m", "radius_m")
# Radii of a requested board's dots and of its four larger ones, and the largest shift of a dot from
# the middle of its cell [cells]; cells along x and y.
_RADIUS, _LARGER, _SHIFT, _CELLS = 0.14, 0.22, 0.2, (14, 9)
# Number of larger dots, and least radius of these over the median.
_LARGE, _LEAST_RATIO = 4, 1.3
# Tolerance of predicted dots, as a share of the distance to the next one; rounds of matching.
_OFF, _ROUNDS = 0.35, 8


@dataclass(frozen=True)
class DotsTarget(Target):
    """A board of dots: its `square_m` is the mean distance of neighbours."""

    radii_m: tuple[float, ...] = ()  # Radius of each dot [m].


def _radii_m(target: Target) -> FloatArray:
    return np.array(cast("DotsTarget", target).radii_m)


class Dots(PointsKind, Board):
    """A board of dots, in the frame of its table."""

    name: ClassVar[str] = "dots"
    keys = "points radius_m square_sigma_m"
    noun, sides, unit = "board of dots", "a distance of dots", "distance"
    options = "--columns --rows --square-mm --name"
    is_seen_in_part = True
    table_columns, needed_columns = _COLUMNS, 3

    def read(self, table: DocumentTable, name: str) -> Target:
        """Reads points, the columns of its table as lists, radius_m and square_sigma_m."""
        columns = table.content.get("points")
        if not isinstance(columns, Mapping) or not {*_COLUMNS[:3]} <= {*columns}:
            raise table.refuse("points", columns, 'the path of a table (points = "dots.csv")')
        count = len(columns["point"])
        flat = {name: columns[name] for name in _COLUMNS[:3]} | {"z_m": [0.0] * count}
        numbers, places = points_of(table, flat)
        radii = columns.get("radius_m")
        radii = [table.number("radius_m", positive=True)] * count if radii is None else radii
        if len(radii) != count or not all(0.0 < radius < 1.0 for radius in radii):
            raise table.refuse("points", radii, "a radius above 0 for each point [m]")
        apart = cdist(places, places) + np.diag(np.full(count, np.inf))
        if (apart <= np.add.outer(radii, radii)).any():
            raise table.refuse("points", min(apart.ravel()), "a distance of dots above their size")
        if np.sort(radii)[-_LARGE] < _LEAST_RATIO * np.median(radii):
            raise DataError(
                f"{table.label}: {_LARGE} dots of {_LEAST_RATIO} times the usual radius are "
                "needed.",
                culprits=[f"{table.label}: points"],
                next_step="Print such a board with visioncal target make --kind dots.",
            )
        pitch_m = float(np.median(apart.min(axis=1)))
        return DotsTarget(
            name,
            self.name,
            count,
            1,
            pitch_m,
            sigma_of(table, pitch_m),
            points_m=tuple((x, y, 0.0) for x, y, _ in places.tolist()),
            point_numbers=numbers,
            radii_m=tuple(map(float, radii)),
        )

    def document(self, target: Target) -> dict[str, Any]:
        """The board as the content of a `.toml`, with its table."""
        x_m, y_m, _ = self.corners(target).T.tolist()
        columns = (list(target.point_numbers), x_m, y_m, _radii_m(target).tolist())
        points = dict(zip(_COLUMNS, columns, strict=True))
        return {"points": points, "square_sigma_m": target.square_sigma_m}

    def words(self, target: Target, size: str) -> str:
        """The board in a few words."""
        del size
        return f"board of {len(target.points_m)} dots"

    def extent_m(self, target: Target) -> tuple[FloatArray, FloatArray]:
        """Low and high x, y of the print [m]."""
        places, radii = self.corners(target)[:, :2], _radii_m(target)[:, None]
        return (places - radii).min(axis=0), (places + radii).max(axis=0)

    def discs(self, target: Target) -> FloatArray:
        """(n, 3) centres and radii of the dots [m]."""
        return np.column_stack([self.corners(target)[:, :2], _radii_m(target)])

    def scaled(self, target: Target, factor: float) -> Target:
        """A board that is larger by a factor."""
        return replace(
            cast("DotsTarget", target),
            square_m=factor * target.square_m,
            points_m=tuple((factor * x, factor * y, 0.0) for x, y, _ in target.points_m),
            radii_m=tuple((factor * _radii_m(target)).tolist()),
        )

    def on_sheet(self, target: Target) -> tuple[str, str, str]:
        """The words on a printed sheet."""
        large = _large(target)
        apart = cdist(large_m := self.corners(target)[large], large_m)
        first, second = np.unravel_index(int(apart.argmax()), apart.shape)
        numbers = [target.point_numbers[large[at]] for at in (first, second)]
        return (
            self.words(target, ""),
            "the origin of its table",
            f"Measure from the centre of dot {numbers[0]} to that of dot {numbers[1]}, two of the "
            f"larger ones, meant to be {1e3 * apart.max():.3f} mm; multiply x_m and y_m of the "
            "table by what you measured over that.",
        )

    def requested(self, request: BoardRequest, square_mm: float) -> dict[str, Any]:
        """The description of a requested board: a dot at random in each cell."""
        pitch_m = super().requested(request, square_mm)["square_m"]
        columns, rows = request.columns or _CELLS[0], request.rows or _CELLS[1]
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        shifts = np.random.default_rng([columns, rows]).uniform(-_SHIFT, _SHIFT, cells.shape)
        x_m, y_m = np.round(pitch_m * (cells + 0.5 + shifts), 6).T.tolist()
        # Inside, so that a view that cuts the board off has all four.
        ends = [(count // 5, count - 1 - count // 5) for count in (columns, rows)]
        large = np.all([np.isin(cells[:, axis], ends[axis]) for axis in (0, 1)], axis=0)
        radii = np.round(pitch_m * np.where(large, _LARGER, _RADIUS), 6).tolist()
        points = dict(zip(_COLUMNS, ([*range(len(cells))], x_m, y_m, radii), strict=True))
        return {"points": points}

    def file_name(self, target: Target, side: str) -> str:
        """Name of a board."""
        del side
        low, high = self.extent_m(target)
        return f"dots_{len(target.points_m)}_{1e3 * (high - low)[0]:.0f}mm"

    def around(self, target: Target, ids: IntArray, squares: FloatArray) -> Print:
        """The print around centres, up to the next dot's edge."""
        del squares
        places, radii = self.corners(target), _radii_m(target)
        apart = cdist(places, places) + np.diag(np.full(len(places), np.inf)) - radii
        unit = target.square_m
        return Print(np.ones(len(ids)), np.inf, float(apart.min()) / unit, radii[ids] / unit)

    def search(
        self, image: Image, target: Target, *, quick: bool = False
    ) -> DetectedCorners | NotFound:
        """Centres in a (h, w) grey image, to about a pixel, or why there are none.

        Blobs that are larger than their neighbours take the place of the four larger dots in every
        order; the homography that predicts most others is kept, and refined by what it finds.
        """
        del quick
        blobs = find_blobs(image)
        if len(blobs.px) < 8:
            return NotFound("no board: no dots are seen")
        places, tree = self.corners(target)[:, :2], cKDTree(blobs.px)
        around = tree.query(blobs.px, min(7, len(blobs.px)))[1][:, 1:]
        ratios = blobs.diameters / np.median(blobs.diameters[around], axis=1)
        large, radii = _large(target), _radii_m(target)
        unlike = np.abs(np.log(ratios * np.median(radii) / radii[large].mean()))
        tried = np.argsort(unlike)[:9]
        large_places = _round_about(places[large])
        best, most, predicted = np.zeros((0, 2), int), 0, np.zeros((0, 2))
        for chosen in combinations(tried[unlike[tried] < 0.25].tolist(), _LARGE):
            px = _round_about(blobs.px[list(chosen)])
            for turn in range(_LARGE):
                flat = cv2.getPerspectiveTransform(large_places, np.roll(px, turn, axis=0))
                pairs = _matched(_mapped(np.asarray(flat, float), places), tree)
                if len(pairs) > most:
                    best, most = pairs, len(pairs)
        for at in range(_ROUNDS if most >= _LARGE else 0):
            fit = np.asarray(cv2.findHomography(places[best[:, 0]], blobs.px[best[:, 1]])[0], float)
            if fit.shape != (3, 3):
                break
            predicted = _mapped(fit, places)
            shifts = blobs.px[best[:, 1]] - predicted[best[:, 0]]
            # Matched neighbours that predict how the lens shifts a dot.
            near = cKDTree(places[best[:, 0]]).query(places, min(3, len(best)))[1]
            predicted = predicted + shifts[near].reshape(len(places), -1, 2).mean(axis=1)
            # In the last round a wrong dot is as far from its place as any.
            best = _matched(predicted, tree, 0.12 if at == _ROUNDS - 1 else _OFF)
        shown = ((predicted > 0) & (predicted < image.shape[::-1])).all(axis=1).sum()
        if len(best) < max(8, 0.6 * shown):
            return NotFound(f"no board: no {self.words(target, '')} with its larger ones is seen")
        return DetectedCorners(best[:, 0], blobs.px[best[:, 1]])


def _large(target: Target) -> IntArray:
    """(4,) indices of the four larger dots."""
    return np.sort(np.argsort(-_radii_m(target), kind="stable")[:_LARGE])


def _round_about(places: FloatArray) -> npt.NDArray[np.float32]:
    """(4, 2) places in their order around their middle."""
    x, y = (places - places.mean(axis=0)).T
    return places[np.argsort(np.arctan2(y, x))].astype(np.float32)


def _mapped(flat: FloatArray, places: FloatArray) -> FloatArray:
    """(n, 2) places by a homography; behind the camera far outside the image."""
    at = np.column_stack([places, np.ones(len(places))]) @ flat.T
    depth = np.where(at[:, 2:] * np.sign(at[0, 2]) > 0.0, at[:, 2:], 1e-9)
    return np.asarray(at[:, :2] / depth)


def _matched(predicted: FloatArray, tree: cKDTree, off: float = _OFF) -> IntArray:
    """(m, 2) dots and blobs at (n, 2) predicted pixels, each once."""
    apart = cKDTree(predicted).query(predicted, 2)[0][:, 1]
    distances, blobs = tree.query(predicted)
    dots = np.flatnonzero(distances < off * apart)
    unique, counts = np.unique(blobs[dots], return_counts=True)
    kept = dots[np.isin(blobs[dots], unique[counts == 1])]
    return np.stack([kept, blobs[kept]], axis=1)

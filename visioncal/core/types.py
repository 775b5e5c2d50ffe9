"""Data types shared by all packages."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

# Defined where options can use them without importing numpy.
from visioncal.core.choices import MOUNTS as MOUNTS
from visioncal.core.choices import CameraMount as CameraMount
from visioncal.core.choices import Mount as Mount

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
Mask: TypeAlias = npt.NDArray[np.bool_]
Image: TypeAlias = npt.NDArray[np.uint8]
Image16: TypeAlias = npt.NDArray[np.uint16]

CameraKind: TypeAlias = Literal["brown", "fisheye"]
TargetKind: TypeAlias = Literal[
    "charuco", "checkerboard", "aprilgrid", "circles", "marker", "points"
]


# Called with a stage's name, its steps done, and its steps in all.
Progress: TypeAlias = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Need:
    """Required accuracy of picks; both limits apply, where both are given.

    Attributes:
        mm: Greatest position error [mm]; None for no limit.
        deg: Greatest rotation error [deg]; None for no limit.
        at: Where it applies: at the views' targets, or at a point (x, y, z) in the base frame [m].
        corrected: Whether targets are corrected for a calibrated arm before they are sent.
    """

    mm: float | None = None
    deg: float | None = None
    at: Literal["views"] | tuple[float, float, float] = "views"
    corrected: bool = False


@dataclass(frozen=True)
class Target:
    """A printed target or a rig of known points, as its `.toml` declares it.

    Its frame is defined in core/README.md; that of a rig is the one of its table.

    Attributes:
        name: The name by which sessions refer to it.
        kind: Kind of pattern; `points` for a rig, whose points are detected by other programs.
        columns: Squares (ChArUco), inner corners (checkerboard), tags (AprilGrid) or circles along
            x; 1 for a marker, and the points for a rig.
        rows: The same along y; 1 for a marker and for a rig.
        square_m: Side of a square; of the marker itself for a single marker and for an AprilGrid,
            the distance of rows of circles, and the greatest extent of a rig [m].
        square_sigma_m: Standard deviation of that side [m]; 0 for a rig.
        marker_m: Side of the markers inside a ChArUco board [m]; 0 elsewhere.
        dictionary: ArUco dictionary by OpenCV's name, as `DICT_5X5_100`; empty without markers.
        legacy: Whether a ChArUco board has the layout that OpenCV printed before 4.6.
        marker_id: The id of a single marker, and the least one of an AprilGrid; -1 elsewhere.
        spacing: White between the tags of an AprilGrid, as a share of a tag's side; 0 elsewhere.
        border: Dark modules around the bits of an AprilGrid's tags; 1 elsewhere.
        diameter_m: Diameter of the circles of a grid [m]; 0 elsewhere.
        asymmetric: Whether every second row of them is shifted by half of their distance in a row,
            which is twice that of the rows.
        points_m: Positions of a rig's points [m]; empty elsewhere.
        point_numbers: Their numbers in the rig's table.
        point_sigmas_m: Standard deviation of each position per axis [m]; empty if exact.
        point_tags: For points that are corners of tags, the tag's id and the corner, from 0 to 3
            clockwise from the upper left; else empty.
    """

    name: str
    kind: TargetKind
    columns: int
    rows: int
    square_m: float
    square_sigma_m: float
    marker_m: float = 0.0
    dictionary: str = ""
    legacy: bool = False
    marker_id: int = -1
    spacing: float = 0.0
    border: int = 1
    diameter_m: float = 0.0
    asymmetric: bool = False
    points_m: tuple[tuple[float, float, float], ...] = ()
    point_numbers: tuple[int, ...] = ()
    point_sigmas_m: tuple[float, ...] = ()
    point_tags: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera's intrinsics.

    Attributes:
        model: `brown` (OpenCV's 5 or 8 coefficients) or `fisheye` (4 coefficients).
        resolution: (width, height) [px].
        matrix: (4,) fx, fy, cx, cy [px].
        distortion: (5,), (8,) or (4,) coefficients in OpenCV's order.
    """

    model: CameraKind
    resolution: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray


@dataclass(frozen=True, eq=False)
class Corners:
    """Detected corners of the target in one image.

    Attributes:
        view: The view's number.
        ids: (n,) corner numbers, ascending, in the target's numbering; in sessions with several
            targets the calibration numbers their corners consecutively.
        px: (n, 2) corner positions [px], pixel centres at integers.
        blur_px: Blur of the edges, as a Gaussian's sigma [px]; 0 for externally detected corners.
        weights: (n,) typical over each corner's standard deviation; None for equal ones.
        stated_px: Stated standard deviation of a typical corner's coordinate [px]; None if it is to
            be estimated.
    """

    view: int
    ids: IntArray
    px: FloatArray
    blur_px: float
    weights: FloatArray | None = None
    stated_px: float | None = None

    def take(self, rows: IntArray | Mask) -> "Corners":
        """The corners of (m,) rows or of an (n,) mask."""
        weights = None if self.weights is None else self.weights[rows]
        return replace(self, ids=self.ids[rows], px=self.px[rows], weights=weights)


@dataclass(frozen=True)
class Rejection:
    """A view that is not used, and the reason, worded for the user."""

    view: int
    reason: str

"""Plain frozen data that travels between the layers; it carries no behaviour of its own."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

# Options name them, and help does not wait for numpy.
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
    """How near picks have to come; a pick is to meet both, where both are given.

    Attributes:
        mm: Distance from where it is meant [mm]; None where any will do.
        deg: Angle from how it is meant [deg]; likewise.
        at: Where that counts: where the views looked, or a place (x, y, z) in the base [m].
    """

    mm: float | None = None
    deg: float | None = None
    at: Literal["views"] | tuple[float, float, float] = "views"


@dataclass(frozen=True)
class Target:
    """A printed target or a rig of known points, as its `.toml` declares it.

    Its frame is defined in core/README.md; that of a rig is the one that its table is in.

    Attributes:
        name: The name under which a session asks for it.
        kind: What is printed; `points` for a rig, of which detectors of others find the points.
        columns: Squares (ChArUco), inner corners (checkerboard), tags (AprilGrid) or circles along
            x; 1 for a marker, and the points for a rig.
        rows: The same along y; 1 for a marker and for a rig.
        square_m: Side of a square; of the marker itself for a single marker and for an AprilGrid,
            the distance of rows of circles, and the greatest extent of a rig [m].
        square_sigma_m: How well that side is known, as a standard deviation [m]; 0 for a rig.
        marker_m: Side of the markers inside a ChArUco board [m]; 0 elsewhere.
        dictionary: ArUco dictionary by OpenCV's name, as `DICT_5X5_100`; empty without markers.
        legacy: Whether a ChArUco board has the layout that OpenCV printed before 4.6.
        marker_id: The id of a single marker, and the least one of an AprilGrid; -1 elsewhere.
        spacing: White between the tags of an AprilGrid, as a share of a tag's side; 0 elsewhere.
        border: Dark modules around the bits of an AprilGrid's tags; 1 elsewhere.
        diameter_m: Diameter of the circles of a grid [m]; 0 elsewhere.
        asymmetric: Whether every second row of them is shifted by half of their distance in a row,
            which is twice that of the rows.
        points_m: Places of a rig's points [m]; empty elsewhere.
        point_numbers: The numbers that its table gives them.
        point_sigmas_m: How well each place is known per axis, as a standard deviation [m]; empty
            where they are exact.
        point_tags: The id of the tag of which each point is a corner, and which one, from 0 to 3
            clockwise from the upper left; empty where the points are none of tags.
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
    """What was found of the target in one image.

    Attributes:
        view: The view's number.
        ids: (n,) corner numbers, ascending, in the target's numbering; where a session has several
            targets, the calibration numbers their corners through.
        px: (n, 2) corner positions [px], pixel centres at integers.
        blur_px: Width of the edges that were seen, as a Gaussian's sigma [px]; 0 where others
            found the corners.
        weights: (n,) by how much more than `stated_px` each corner is known, as the ratio of
            standard deviations; None for corners that are known alike.
        stated_px: Standard deviation of a typical corner's coordinate, as it is stated; None where
            it is to be estimated [px].
    """

    view: int
    ids: IntArray
    px: FloatArray
    blur_px: float
    weights: FloatArray | None = None
    stated_px: float | None = None

    def take(self, rows: IntArray | Mask) -> "Corners":
        """Returns those of (m,) rows or of an (n,) mask."""
        weights = None if self.weights is None else self.weights[rows]
        return replace(self, ids=self.ids[rows], px=self.px[rows], weights=weights)


@dataclass(frozen=True)
class Rejection:
    """A view that is not used, and why, in words for the user."""

    view: int
    reason: str

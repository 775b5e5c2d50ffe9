"""Data types shared by all packages."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeAlias, TypeVar, cast, get_args, get_origin

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

_T = TypeVar("_T")

CameraKind: TypeAlias = Literal["brown", "fisheye"]


def scalar_of(hint: Any) -> Any:  # noqa: ANN401 - a type
    """Scalar type of an annotation such as `FloatArray`; None for what is no array."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        return get_args(inner[1])[0]
    # From NumPy 2.5 on, which needs Python 3.12, it is an alias that does not stand for another.
    return inner[0] if inner and origin is npt.NDArray else None


def chosen_rows(record: _T, rows: Any, *others: str) -> _T:  # noqa: ANN401 - any index
    """A dataclass with some rows of all its arrays and tuples, but of `others`, in their order.

    `rows` are indices, a mask or a slice.
    """
    owner: Any = record
    picked: dict[str, object] = {}
    for name in (entry.name for entry in fields(owner) if entry.name not in others):
        value = getattr(owner, name)
        if isinstance(value, np.ndarray):
            picked[name] = value[rows]
        elif isinstance(value, tuple) and value:
            picked[name] = tuple(value[at] for at in np.arange(len(value))[rows])
    return cast(_T, replace(owner, **picked))


def evenly(count: int, most: int) -> IntArray:
    """Numbers up to a count, evenly distributed, and at most so many; none below one."""
    return np.unique(np.linspace(0, count - 1, max(min(count, most), 0)).astype(np.int64))


def interpolated(at: FloatArray, places: FloatArray, values: FloatArray) -> FloatArray:
    """(m, n) columns of (k, n) values at (k,) places, interpolated linearly at (m,) places."""
    return np.stack([np.interp(at, places, column) for column in values.T], axis=1)


# Called with a stage's name, its steps done, and its steps in all.
Progress: TypeAlias = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Need:
    """Required accuracy of picks; both limits apply, where both are given."""

    mm: float | None = None  # Greatest position error [mm]; None for no limit.
    deg: float | None = None  # Greatest rotation error [deg]; None for no limit.
    # Where it applies: at the views' targets, or at a point (x, y, z) in the base frame [m].
    at: Literal["views"] | tuple[float, float, float] = "views"
    # Whether targets are corrected for a calibrated arm before they are sent.
    corrected: bool = False


@dataclass(frozen=True)
class Target:
    """A printed target or a rig of known points, as its `.toml` declares it.

    Its frame is defined in core/README.md; that of a rig is the one of its table.
    """

    name: str  # The name by which sessions refer to it.
    # Kind of pattern, one of `vision.boards.KINDS`.
    kind: str
    # Squares (ChArUco), inner corners (checkerboard), tags (AprilGrid) or circles along x; 1 for a
    # marker, and the points for a rig.
    columns: int
    rows: int  # The same along y; 1 for a marker and for a rig.
    # Side of a square; of the marker itself for a single marker and for an AprilGrid, the distance
    # of rows of circles, and the greatest extent of a rig [m].
    square_m: float
    square_sigma_m: float  # Standard deviation of that side [m]; 0 for a rig.
    marker_m: float = 0.0  # Side of the markers inside a ChArUco board [m]; 0 elsewhere.
    # ArUco dictionary by OpenCV's name, as `DICT_5X5_100`; empty without markers.
    dictionary: str = ""
    legacy: bool = False  # Whether a ChArUco board has the layout that OpenCV printed before 4.6.
    # The id of a single marker, or the first of a board's; -1 elsewhere, and for ChArUco's 0.
    marker_id: int = -1
    # White between the markers of a grid, as a share of a tag's side; 0 elsewhere.
    spacing: float = 0.0
    border: int = 1  # Dark modules around the bits of an AprilGrid's tags; 1 elsewhere.
    diameter_m: float = 0.0  # Diameter of the circles of a grid [m]; 0 elsewhere.
    # Whether every second row of them is shifted by half of their distance in a row, which is twice
    # that of the rows.
    asymmetric: bool = False
    # Positions of a rig's points [m]; empty elsewhere.
    points_m: tuple[tuple[float, float, float], ...] = ()
    point_numbers: tuple[int, ...] = ()  # Their numbers in the rig's table.
    # Standard deviation of each position per axis [m], of a printed board in its plane; empty if
    # exact.
    point_sigmas_m: tuple[float, ...] = ()
    # For points that are corners of tags, the tag's id and the corner, from 0 to 3 clockwise from
    # the upper left; else empty.
    point_tags: tuple[tuple[int, int], ...] = ()

    @property
    def is_rig(self) -> bool:
        """Whether its points were measured one by one, so that it has no size of its own."""
        return bool(self.points_m) and not self.square_sigma_m


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera's intrinsics."""

    model: CameraKind  # `brown` (OpenCV's 5 or 8 coefficients) or `fisheye` (4 coefficients).
    resolution: tuple[int, int]  # (width, height) [px].
    matrix: FloatArray  # (4,) fx, fy, cx, cy [px].
    distortion: FloatArray  # (5,), (8,) or (4,) coefficients in OpenCV's order.


@dataclass(frozen=True, eq=False)
class Corners:
    """Detected corners of the target in one image."""

    view: int  # The view's number.
    # (n,) corner numbers, ascending, in the target's numbering; in sessions with several targets
    # the calibration numbers their corners consecutively.
    ids: IntArray
    px: FloatArray  # (n, 2) corner positions [px], pixel centres at integers.
    # Blur of the edges, as a Gaussian's sigma [px]; 0 for externally detected corners.
    blur_px: float
    # (n,) typical over each corner's standard deviation; None for equal ones.
    weights: FloatArray | None = None
    # Stated standard deviation of a typical corner's coordinate [px]; None if it is to be
    # estimated.
    stated_px: float | None = None
    drawn_m: float | None = None  # Diameter of circles in the image, by their distances [m].

    def take(self, rows: IntArray | Mask) -> "Corners":
        """The corners of (m,) rows or of an (n,) mask."""
        return chosen_rows(self, rows)


@dataclass(frozen=True)
class Rejection:
    """A view that is not used, and the reason, worded for the user."""

    view: int
    reason: str


@dataclass(frozen=True, eq=False)
class Searched:
    """Result of searching one image for one target."""

    found: Corners | Rejection  # The corners, or why there are none.
    size: tuple[int, int] | None  # (width, height) of the image [px]; None where it cannot be read.
    misfit: bool = False  # Whether markers were seen whose layout is not the target's.
    faint_jpeg: bytes | None = None  # A copy to look at; None where none was asked for.

"""What identifies a board in a photograph: decoded markers, and the target that they show."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, Target
from visioncal.vision.boards.kind import DEFAULT_RELATIVE_SIGMA, aruco_dictionary
from visioncal.vision.boards.template import SQUARE

# Dictionaries by family, smallest first. Each contains the markers of the previous ones under the
# same ids, so that the largest decodes all.
FAMILIES: dict[str, tuple[str, ...]] = {
    **{
        bits: tuple(f"DICT_{bits}_{count}" for count in (50, 100, 250, 1000))
        for bits in ("4X4", "5X5", "6X6", "7X7")
    },
    "original": ("DICT_ARUCO_ORIGINAL",),
    "mip": ("DICT_ARUCO_MIP_36h12",),
    **{code: (f"DICT_APRILTAG_{code}",) for code in ("16h5", "25h9", "36h10", "36h11")},
}
# Fewer markers are single ones.
LEAST_MARKERS = 4
# Pixels per module in the comparison of a marker with its ideal, and white margin that it includes
# [modules]: half of the required one.
_MODULE_PX, _RING = 4, 0.5


@dataclass(frozen=True)
class Identity:
    """An identified target, without its size."""

    board: Target  # The target, with sides of 1 m; its rows are those that the image shows.
    corners_seen: int  # Number of corners that the detector of this kind finds.
    corners: int  # Number of corners of the target.
    # Other dictionaries that contain the same markers; that of the target is the smallest.
    larger: tuple[str, ...] = ()
    # Decoded ids, ascending; for single markers, the target's first.
    marker_ids: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()  # Remarks, in sentences.

    @property
    def is_single(self) -> bool:
        """Whether it is a single marker."""
        return self.board.columns * self.board.rows == 1

    def target(self, name: str, square_m: float) -> Target:
        """The target, with the measured side of a square, or of a single marker [m]."""
        return replace(
            self.board,
            name=name,
            square_m=square_m,
            square_sigma_m=DEFAULT_RELATIVE_SIGMA * square_m,
            marker_m=round(self.board.marker_m * square_m, 5),
        )


@dataclass(frozen=True, eq=False)
class Marker:
    """A decoded marker."""

    family: str  # Its family, a key of `FAMILIES`.
    number: int  # Its id.
    px: FloatArray  # (4, 2) corners in OpenCV's order [px].
    likeness: float  # Correlation of its image with the ideal marker, -1 to 1.

    @cached_property
    def centre(self) -> FloatArray:
        """Intersection of its diagonals, (2,), which is invariant under perspective [px]."""
        a, b, c, d = self.px
        across = np.stack([c - a, b - d], axis=1)
        if np.linalg.det(across) == 0.0:
            return np.asarray(self.px.mean(axis=0))
        return np.asarray(a + np.linalg.solve(across, b - a)[0] * (c - a))

    @cached_property
    def side_px(self) -> float:
        """Mean length of its sides [px]."""
        return float(np.linalg.norm(self.px - np.roll(self.px, 1, axis=0), axis=1).mean())


def decoded(image: Image) -> list[Marker]:
    """Markers of all families (Garrido-Jurado et al. 2014; OpenCV), with false positives.

    A lattice or the markers' likeness separates these.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionaries = [aruco_dictionary(names[-1]) for names in FAMILIES.values()]
    detector = cv2.aruco.ArucoDetector(dictionaries, parameters)
    corners, ids, _, family_indices = detector.detectMarkersMultiDict(image)
    if not corners:
        return []
    families = list(FAMILIES)
    markers = []
    for px, number, index in zip(corners, np.ravel(ids), np.ravel(family_indices), strict=True):
        quad, family = np.asarray(px, dtype=float).reshape(4, 2), families[int(index)]
        likeness = _likeness(image, quad, family, int(number))
        markers.append(Marker(family, int(number), quad, likeness))
    return markers


def _likeness(image: Image, px: FloatArray, family: str, number: int) -> float:
    """Correlation of the image of a marker with the ideal marker."""
    side, ring = modules(family) * _MODULE_PX, round(_RING * _MODULE_PX)
    ideal = cv2.aruco.generateImageMarker(aruco_dictionary(FAMILIES[family][-1]), number, side)
    ideal = np.pad(ideal, ring, constant_values=255)
    # Pixel centres are at integers; the marker's edge is half a pixel before the first one.
    frame = ring - 0.5 + side * SQUARE
    flat_from_image = cv2.getPerspectiveTransform(px.astype(np.float32), frame.astype(np.float32))
    seen = cv2.warpPerspective(
        image, flat_from_image, ideal.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    return float(cv2.matchTemplate(seen, ideal, cv2.TM_CCOEFF_NORMED)[0, 0]) if np.ptp(seen) else 0


def modules(family: str) -> int:
    """Number of modules along a marker's side, including its dark border."""
    return int(aruco_dictionary(FAMILIES[family][0]).markerSize) + 2


def holding(family: str, count: int) -> tuple[str, ...]:
    """Dictionaries of a family with at least `count` markers, smallest first."""
    names = FAMILIES[family]
    return tuple(name for name in names if len(aruco_dictionary(name).bytesList) >= count)

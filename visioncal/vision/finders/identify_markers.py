"""Decoding of markers of all families, and rejection of false positives."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image
from visioncal.vision.targets import aruco_dictionary

# Dictionaries by family, smallest first. Each contains the markers of the previous ones under the
# same ids, so that the largest decodes all.
FAMILIES: dict[str, tuple[str, ...]] = {
    **{
        bits: tuple(f"DICT_{bits}_{count}" for count in (50, 100, 250, 1000))
        for bits in ("4X4", "5X5", "6X6", "7X7")
    },
    "original": ("DICT_ARUCO_ORIGINAL",),
    "mip": ("DICT_ARUCO_MIP_36h12",),
    "16h5": ("DICT_APRILTAG_16h5",),
    "25h9": ("DICT_APRILTAG_25h9",),
    "36h10": ("DICT_APRILTAG_36h10",),
    "36h11": ("DICT_APRILTAG_36h11",),
}
# Pixels per module in the comparison of a marker with its ideal.
_MODULE_PX = 4
# White margin included in the comparison [modules]: half of the required one.
_RING = 0.5
# Minimum correlation with the ideal marker. Strong lens distortion lowers it to 0.55. Codes of
# sixteen bits occur by chance in other markers' squares, with up to 0.8; longer codes do not.
_LIKE, _SHORT_LIKE = 0.5, 0.83
_SHORT_MODULES = 6


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
        diagonal_ac, diagonal_bd = c - a, d - b
        cross_product = diagonal_ac[0] * diagonal_bd[1] - diagonal_ac[1] * diagonal_bd[0]
        if cross_product == 0.0:
            return np.asarray(self.px.mean(axis=0))
        share = ((b - a)[0] * diagonal_bd[1] - (b - a)[1] * diagonal_bd[0]) / cross_product
        return np.asarray(a + share * diagonal_ac)

    @cached_property
    def side_px(self) -> float:
        """Mean length of its sides [px]."""
        return float(np.linalg.norm(self.px - np.roll(self.px, 1, axis=0), axis=1).mean())


def decode_markers(image: Image) -> tuple[Marker, ...]:
    """Markers of all families in a (h, w) grey image (Garrido-Jurado et al. 2014; OpenCV).

    They include false positives, which a lattice or `Marker.likeness` separates.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionaries = [aruco_dictionary(names[-1]) for names in FAMILIES.values()]
    detector = cv2.aruco.ArucoDetector(dictionaries, parameters)
    corners, ids, _, family_indices = detector.detectMarkersMultiDict(image)
    if not corners:
        return ()
    families = list(FAMILIES)
    markers = []
    for px, number, index in zip(corners, np.ravel(ids), np.ravel(family_indices), strict=True):
        quad = np.asarray(px, dtype=float).reshape(4, 2)
        family = families[int(index)]
        likeness = _likeness(image, quad, family, int(number))
        markers.append(Marker(family, int(number), quad, likeness))
    return tuple(markers)


def genuine(markers: tuple[Marker, ...]) -> tuple[Marker, ...]:
    """Markers that resemble their ideal; of several at one position, the most similar."""
    kept: list[Marker] = []
    for marker in sorted(markers, key=lambda candidate: -candidate.likeness):
        apart = all(
            np.linalg.norm(marker.centre - other.centre) > max(marker.side_px, other.side_px) / 2
            for other in kept
        )
        short = modules_along(marker.family) <= _SHORT_MODULES
        if marker.likeness > (_SHORT_LIKE if short else _LIKE) and apart:
            kept.append(marker)
    return tuple(kept)


def holding(family: str, count: int) -> tuple[str, ...]:
    """Dictionaries of a family with at least `count` markers, smallest first."""
    names = FAMILIES[family]
    return tuple(name for name in names if len(aruco_dictionary(name).bytesList) >= count)


def modules_along(family: str) -> int:
    """Number of modules along a marker's side, including its dark border."""
    return int(aruco_dictionary(FAMILIES[family][0]).markerSize) + 2


def _likeness(image: Image, px: FloatArray, family: str, number: int) -> float:
    dictionary = aruco_dictionary(FAMILIES[family][-1])
    side = modules_along(family) * _MODULE_PX
    ring = round(_RING * _MODULE_PX)
    ideal = cv2.aruco.generateImageMarker(dictionary, number, side)
    ideal = np.pad(ideal, ring, constant_values=255).astype(np.float32)
    # Pixel centres are at integers; the marker's edge is half a pixel before the first one.
    frame = ring - 0.5 + side * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    flat_from_image = cv2.getPerspectiveTransform(px.astype(np.float32), frame.astype(np.float32))
    seen = cv2.warpPerspective(
        image, flat_from_image, ideal.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float32)
    seen -= seen.mean()
    ideal -= ideal.mean()
    scale = float(np.linalg.norm(seen) * np.linalg.norm(ideal))
    return float((seen * ideal).sum()) / scale if scale > 0.0 else 0.0

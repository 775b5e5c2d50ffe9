"""Markers in an image, and whether they lie on a plane as a target describes them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray
from visioncal.vision.boards.imaging import resized
from visioncal.vision.boards.kind import DetectedCorners, NotFound, aruco_dictionary
from visioncal.vision.boards.template import SQUARE, refine_tags

# Largest rms distance of markers from a homography, in marker sides. Lens distortion and noise stay
# under 0.1; another layout moves every second row by more than a side.
LAYOUT_MISFIT = 0.35
# Markers that prove another board: one or two are read by chance, and one determines a homography.
LAYOUT_MARKERS = 3
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
# Pixels per module in the comparison of a marker with its ideal.
_MODULE_PX = 4


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
        """Mean length of the marker's sides [px]."""
        return float(np.linalg.norm(self.px - np.roll(self.px, 1, axis=0), axis=1).mean())

    @property
    def is_genuine(self) -> bool:
        """Whether the marker resembles its ideal."""
        # Strong lens distortion lowers the likeness to 0.55. Codes of sixteen bits occur by chance
        # in other markers' squares, with up to 0.8; longer codes do not.
        return self.likeness > (0.83 if self.family in ("4X4", "16h5") else 0.5)


def decoded(
    image: Image, border: int = 1, darker: float | None = None, scale: float = 1.0
) -> list[Marker]:
    """Markers of all families (Garrido-Jurado et al. 2014; OpenCV), with false positives.

    A lattice or the markers' likeness separates these; of several at one position, the most similar
    is kept. The rest is as in `read_markers`.
    """
    parameters = _parameters(border, darker)
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionaries = [aruco_dictionary(names[-1]) for names in FAMILIES.values()]
    detector = cv2.aruco.ArucoDetector(dictionaries, parameters)
    corners, ids, _, family_indices = detector.detectMarkersMultiDict(resized(image, scale))
    families, found = list(FAMILIES), list[Marker]()
    for px, number, index in zip(
        corners, np.ravel(ids) if corners else (), np.ravel(family_indices), strict=False
    ):
        quad = (np.asarray(px, dtype=float).reshape(4, 2) + 0.5) / scale - 0.5
        family = families[int(index)]
        likeness = _likeness(image, quad, family, int(number), border)
        found.append(Marker(family, int(number), quad, likeness))
    kept: list[Marker] = []
    for marker in sorted(found, key=lambda candidate: -candidate.likeness):
        if all(
            np.linalg.norm(marker.centre - other.centre) > max(marker.side_px, other.side_px) / 2
            for other in kept
        ):
            kept.append(marker)
    return kept


def _likeness(image: Image, px: FloatArray, family: str, number: int, border: int) -> float:
    """Correlation of the image of a marker with the ideal marker."""
    dictionary = aruco_dictionary(FAMILIES[family][-1])
    # White margin that the comparison includes [modules]: half of the required one.
    side, ring = (dictionary.markerSize + 2 * border) * _MODULE_PX, round(0.5 * _MODULE_PX)
    ideal = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=border)
    ideal = np.pad(ideal, ring, constant_values=255)
    # Pixel centres are at integers; the marker's edge is half a pixel before the first one.
    frame = ring - 0.5 + side * SQUARE
    flat_from_image = cv2.getPerspectiveTransform(px.astype(np.float32), frame.astype(np.float32))
    seen = cv2.warpPerspective(
        image, flat_from_image, ideal.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    return float(cv2.matchTemplate(seen, ideal, cv2.TM_CCOEFF_NORMED)[0, 0]) if np.ptp(seen) else 0


def holding(family: str, count: int) -> tuple[str, ...]:
    """Dictionaries of a family with at least `count` markers, smallest first."""
    names = FAMILIES[family]
    return tuple(name for name in names if len(aruco_dictionary(name).bytesList) >= count)


def read_markers(
    image: Image,
    dictionary: str,
    border: int = 1,
    *,
    darker: float | None = None,
    scale: float = 1.0,
    refined: bool = False,
) -> tuple[list[int], FloatArray]:
    """Markers of a dictionary in a (h, w) grey image (Garrido-Jurado et al. 2014; OpenCV).

    Args:
        image: The image.
        dictionary: OpenCV's name of the dictionary.
        border: Dark modules around their bits.
        darker: Grey levels by which dark has to be below its surroundings; None for the usual.
        scale: Factor by which the image is enlarged first.
        refined: Whether OpenCV refines the corners.

    Returns:
        Their ids, which may repeat, and (t, 4, 2) corners in OpenCV's order [px].
    """
    if min(image.shape) < 2:
        return [], np.zeros((0, 4, 2))
    given = _parameters(border, darker)
    if refined:
        given.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(dictionary), given)
    px, ids, _ = detector.detectMarkers(resized(image, scale))
    found = [] if ids is None else [int(number) for number in np.ravel(ids)]
    return found, (np.asarray(np.reshape(px, (-1, 4, 2)), dtype=float) + 0.5) / scale - 0.5


def _parameters(border: int, darker: float | None) -> "cv2.aruco.DetectorParameters":
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    if darker is not None:
        parameters.adaptiveThreshConstant = darker
    return parameters


def once(ids: Iterable[int], px: Iterable[FloatArray]) -> dict[int, FloatArray]:
    """Corners (4, 2) by id, of the markers that are seen once."""
    numbers = list(ids)
    pairs = zip(numbers, px, strict=True)
    return {number: quad for number, quad in pairs if numbers.count(number) == 1}


def side_share(places: Sequence[FloatArray], quads: Sequence[FloatArray]) -> tuple[float, float]:
    """Side of a grid's markers as a share of the grid's step, and its scatter; NaN where unknown.

    The corners of two markers in one line lie at 0, s, d and d + s. Their cross-ratio
    (AC BD) / (BC AD) = d^2 / (d^2 - s^2) is invariant under projection, and almost under lens
    distortion.

    Args:
        places: For each image, (t, 2) places of its markers [steps], in their own directions.
        quads: For each image, (t, 4, 2) corners of these markers [px].
    """
    found = list[float]()
    for at, px in zip(places, quads, strict=True):
        steps = np.rint(at - at[:, None]).astype(int)
        for axis, sides in ((0, ([0, 1], [3, 2])), (1, ([0, 3], [1, 2]))):
            inline = (steps[..., 1 - axis] == 0) & (steps[..., axis] > 0)
            inline &= steps[..., axis] <= 2
            for first, second in np.argwhere(inline).tolist():
                for side in sides:
                    a, b, c, d = px[[first, first, second, second], side * 2]
                    ac, bd, bc, ad = (float(np.hypot(*at)) for at in (c - a, d - b, c - b, d - a))
                    share = np.sqrt(max(1.0 - bc * ad / max(ac * bd, 1e-9), 0.0))
                    found.append(float(steps[first, second, axis] * share))
    if not found:
        return np.nan, np.nan
    quarter, middle, last = np.percentile(found, [25, 50, 75])
    return float(middle), float(last - quarter)


def layout_misfit(on_board: FloatArray, in_image: FloatArray) -> float:
    """Rms distance of markers from their positions on a plane, in marker sides.

    A wide-angle lens bends a large board by more than a side, but not a few neighbours: if the
    whole board does not fit a plane, each marker is judged with its neighbours.

    Above `LAYOUT_MISFIT`, which no correct layout exceeds, it is a lower bound: a search over many
    layouts does not need the exact value.

    Args:
        on_board: (m, 4, 2) corners of the markers on the board, in any unit.
        in_image: (m, 4, 2) detected corners [px].
    """
    board_misfit = _off_plane(on_board, in_image)
    if board_misfit <= LAYOUT_MISFIT:
        return board_misfit
    centres = in_image.mean(axis=1)
    distances = np.linalg.norm(centres[:, None] - centres, axis=2)
    # Enough to include the rows above and below.
    neighbours = np.argsort(distances, axis=1)[:, :9]
    squares, limit = 0.0, len(neighbours) * LAYOUT_MISFIT**2
    for index in neighbours:
        squares += _off_plane(on_board[index], in_image[index]) ** 2
        if squares > limit:
            break
    return float(np.sqrt(squares / len(neighbours)))


def _off_plane(on_board: FloatArray, in_image: FloatArray) -> float:
    """Rms distance of (n, 4, 2) marker corners from a homography, in marker sides."""
    on_plane, px = on_board.reshape(-1, 2), in_image.reshape(-1, 2)
    homography = np.asarray(cv2.findHomography(on_plane, px)[0])
    if homography.shape != (3, 3):
        return 0.0
    predicted = cv2.perspectiveTransform(on_plane[None], homography)[0]
    sides = np.linalg.norm(np.diff(in_image, axis=1), axis=2)
    errors = np.linalg.norm(predicted - px, axis=1)
    return float(np.sqrt(np.mean(errors**2)) / np.median(sides))


def find_tags(
    image: Image,
    dictionary: str,
    border: int,
    corner_ids: Mapping[int, IntArray],
    places: FloatArray,
) -> DetectedCorners | NotFound:
    """Corners of lone tags in a (h, w) grey image, or why there are none.

    Args:
        image: The image.
        dictionary: OpenCV's name of the tags' dictionary.
        border: Dark modules around their bits.
        corner_ids: (4,) indices of each tag's corners among `places`; -1 for none.
        places: (n, 3) places [m].
    """
    numbers, found_px = read_markers(image, dictionary, border)
    quads = {key: px for key, px in once(numbers, found_px).items() if key in corner_ids}
    if not quads:
        seen = f"; seen instead: {', '.join(map(str, numbers[:5]))}" if numbers else ""
        return NotFound(
            f"no tag of the target's, of {dictionary}, is seen{seen}",
            misfit=len(numbers) >= LAYOUT_MARKERS,
        )
    points = np.array([corner_ids[quad] for quad in quads])
    quads_px = np.array([*quads.values()])
    count = int(aruco_dictionary(dictionary).markerSize) + 2 * border
    # Two complete tags or more in the plane z = 0.
    if len(quads) > 1 and points.min() >= 0 and not np.ptp(places[:, 2]):
        flat = places[points, :2]
        side = float(np.linalg.norm(flat[:, 1] - flat[:, 0], axis=1).mean())
        if layout_misfit(flat / side, quads_px) > LAYOUT_MISFIT:
            return NotFound(
                "the tags do not lie as the target describes them",
                misfit=len(quads) >= LAYOUT_MARKERS,
            )
        parts = [refine_tags(image, count, quads_px, flat)]
    else:
        parts = [refine_tags(image, count, quad[None]) for quad in quads_px]
    points = points.ravel()
    fitted = np.concatenate([part.fitted for part in parts]) & (points >= 0)
    if not fitted.any():
        return NotFound("no corner of the tags seen is like the print")
    px = np.concatenate([part.px for part in parts])[fitted]
    order = np.argsort(points[fitted])
    blur_px = float(np.nanmedian([part.blur_px.max() for part in parts]))
    return DetectedCorners(points[fitted][order], px[order], blur_px=blur_px)

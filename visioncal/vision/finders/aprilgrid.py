"""Finding AprilGrids, and checking whether they are as described."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.finders.layout import LAYOUT_MISFIT, layout_misfit
from visioncal.vision.finders.result import DetectedCorners, NotFound
from visioncal.vision.targets import aruco_dictionary

LACKS_SQUARES = "the tags lack the small dark squares at their corners that an AprilGrid has"
# The squares at a tag's corners touch it, and OpenCV sees a tag only where white surrounds it.
# Where two dark corners meet, the image is grey: counted as white where dark has to be darker than
# its surroundings by so many levels, and in twice as many pixels, of which grey gets enough. The
# last copy serves pictures of little contrast too.
_DARKER, _LITTLE, _ENLARGED = 25.0, 7.0, 2
# Where so many of the tags are read, their border is as stated.
_MANY = 0.5
# With another border so many times as many are read where that is right.
_MORE = 1.25
# So many tags check a homography's eight unknowns, and make one of their own lines.
_LEAST_TAGS = 2
# Half-widths of the windows in which corners are refined, as a share of the white between tags, and
# their bounds [px].
_WINDOW, _WINDOWS_PX = 0.35, (2, 6)
_ENDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-2)
# The white between tags that is seen may differ by so much from the stated one [sides]; so many
# sides in line have to be seen, and half of them within so much.
_SPACING, _LEAST_SPACINGS, _SCATTER = 0.02, 4, 0.05
# Places along a tag's side, and so far inside it, in its dark border [sides].
_ALONG, _INSIDE = (0.06, 0.35, 0.65, 0.94), 0.06
# An outer line of tags is missing where so many places on its near side are lighter than grey; the
# tags of so many lines beside it show where it would be.
_MOST_OF, _NEAR_LINES = 0.8, 2


def find_aprilgrid(image: Image, target: Target) -> DetectedCorners | NotFound:
    """Finds the corners of an AprilGrid's tags.

    Args:
        image: (h, w) grey image.
        target: An AprilGrid target.

    Returns:
        The corners, or why there are none.
    """
    many = _MANY * target.columns * target.rows
    ids, px = grid_tags(image, target.dictionary, target.border, many)
    border = NotFound(
        f"the tags have a border of {3 - target.border} modules, and the target says border = "
        f"{target.border}",
        misfit=True,
    )
    if len(ids) < many and _has_other_border(image, target, ids):
        return border
    if not len(ids):
        return NotFound(f"no board: no tag of {target.dictionary} is seen")
    numbers = ids - target.marker_id
    own = (numbers >= 0) & (numbers < target.columns * target.rows)
    if own.sum() <= 0.5 * len(own):
        others = ", ".join(map(str, ids[~own][:5].tolist()))
        return NotFound(f"most tags seen ({others}) are none of the target's", misfit=True)
    px, misfit = laid(target, numbers, px, own)
    if misfit > LAYOUT_MISFIT:
        return NotFound("the tags do not lie as the target describes them", misfit=True)
    size = f"the target's {target.columns} x {target.rows}"
    if not own.all() and layout_misfit(_places(target, numbers), px) <= LAYOUT_MISFIT:
        return NotFound(f"the grid has tag {ids[~own][0]} besides {size}", misfit=True)
    numbers, px = numbers[own], px[own]
    if lacks_a_line(image, target, numbers, px):
        return NotFound(f"the grid ends before {size} tags: an outer line is missing", misfit=True)
    if not _has_squares(image, px, target.spacing):
        return NotFound(LACKS_SQUARES, misfit=True)
    px = refined_tags(image, px, target.spacing)
    spacing = seen_spacing(target, numbers, px)
    if abs(spacing - target.spacing) > _SPACING:
        if _has_other_border(image, target, ids):
            return border
        return NotFound(
            f"the tags are {spacing:.2f} of their side apart, and the target says spacing = "
            f"{target.spacing:g}",
            misfit=True,
        )
    return DetectedCorners((4 * numbers[:, None] + np.arange(4)).ravel(), px.reshape(-1, 2))


def free_tags_step(target: Target) -> str:
    """What to type for a grid of tags without squares: they are free tags."""
    side = f"{target.square_m:g}"
    return (
        f'Describe it as free tags: in its .toml, kind = "points", points = "tags.csv", dictionary '
        f'= "{target.dictionary}" and nothing else; tags.csv beside it has the header '
        "point,x_m,y_m,z_m,tag,corner and a row for each corner of a tag, 0 to 3 clockwise from "
        f"the upper left, such as 0,0,0,0,{target.marker_id},0 and then "
        f"1,{side},0,0,{target.marker_id},1 (x to the right, y down, measured on the print)."
    )


def grid_tags(
    image: Image, dictionary: str, border: int, enough: float
) -> tuple[IntArray, FloatArray]:
    """Finds tags whose corners other dark squares touch, those that are seen once.

    Args:
        image: (h, w) grey image.
        dictionary: OpenCV's name of their family.
        border: Dark modules around the bits.
        enough: Of so many, no more are looked for in other ways.

    Returns:
        (t,) ids, ascending, and (t, 4, 2) corners in OpenCV's order, to a pixel or two [px].
    """
    corners: dict[int, FloatArray] = {}
    for work in _copies(image):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        parameters.adaptiveThreshConstant = work.darker
        detector = cv2.aruco.ArucoDetector(aruco_dictionary(dictionary), parameters)
        px, ids, _ = detector.detectMarkers(work.image)
        found = [] if ids is None else [int(number) for number in ids.ravel()]
        # Where a pixel of the copy has its centre in the image.
        quads = (np.reshape(px, (-1, 4, 2)) + 0.5) / work.scale - 0.5
        once = {
            index: quad for index, quad in zip(found, quads, strict=True) if found.count(index) == 1
        }
        corners = once | corners
        if len(corners) >= enough:
            break
    numbers = sorted(corners)
    found_px = np.reshape([corners[number] for number in numbers], (-1, 4, 2))
    return np.array(numbers, dtype=np.int64), found_px


@dataclass(frozen=True, eq=False)
class _Copy:
    """A copy of an image in which OpenCV may see tags, its scale, and by how much dark is dark."""

    image: Image
    scale: float
    darker: float


def _copies(image: Image) -> Iterator[_Copy]:
    """The image enlarged; smoothed, for what moved; and with less dark, for ink that spread."""
    large = cv2.resize(image, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC)
    yield _Copy(np.asarray(large, np.uint8), _ENLARGED, _DARKER)
    yield _Copy(np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8), 1.0, _DARKER)
    yield _Copy(np.asarray(cv2.dilate(image, np.ones((3, 3), np.uint8)), np.uint8), 1.0, _LITTLE)


def laid(target: Target, numbers: IntArray, px: FloatArray, own: Mask) -> tuple[FloatArray, float]:
    """Orders the corners of tags as on the page, and says how far the tags are from their places.

    Args:
        target: The grid.
        numbers: (t,) the tags' numbers on it.
        px: (t, 4, 2) their corners in OpenCV's order [px].
        own: (t,) mask of those that count.

    Returns:
        (t, 4, 2) the corners, and the misfit of `layout_misfit`; 0 of one tag.
    """
    # Kalibr's pages have the tags upside down; others are recognised by where the tags lie.
    turned = [np.roll(px, turn, axis=1) for turn in (2, 0, 1, 3)]
    if own.sum() < _LEAST_TAGS:
        return turned[0], 0.0
    places = _places(target, numbers[own])
    misfits = [layout_misfit(places, array[own]) for array in turned]
    return turned[int(np.argmin(misfits))], min(misfits)


def _has_other_border(image: Image, target: Target, ids: IntArray) -> bool:
    """Whether many more tags are read with the other border: with a wrong one some are."""
    many = max(_MORE * len(ids), _MANY * target.columns * target.rows)
    other = grid_tags(image, target.dictionary, 3 - target.border, many)[0]
    return len(other) >= many


def _has_squares(image: Image, px: FloatArray, spacing: float) -> bool:
    """Whether there is dark off the corners of tags (t, 4, 2) [px], and white off their sides."""
    centre = px.mean(axis=1, keepdims=True)
    sides = (px + np.roll(px, -1, axis=1)) / 2
    inside, outside = 0.9, 1.0 + spacing
    places = [
        centre + inside * (px - centre),
        *(centre + outside * (array - centre) for array in (px, sides)),
    ]
    top = np.array(image.shape[::-1]) - 1
    at = (np.clip(np.rint(place), 0, top).astype(int) for place in places)
    dark, squares, white = (float(np.median(image[value[..., 1], value[..., 0]])) for value in at)
    return squares < (dark + white) / 2


def _places(target: Target, numbers: IntArray) -> FloatArray:
    """(t, 4, 2) the corners of tags [sides]; rows go on where numbers are none of the target's."""
    rows, columns = np.divmod(numbers, target.columns)
    first = np.stack([columns, target.rows - 1 - rows], axis=1) * (1.0 + target.spacing)
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return np.asarray(first[:, None] + square)


def refined_tags(image: Image, px: FloatArray, spacing: float) -> FloatArray:
    """Refines the (t, 4, 2) corners of tags [px], each a saddle between two dark squares."""
    sides = np.linalg.norm(px - np.roll(px, 1, axis=1), axis=2)
    window = int(np.clip(_WINDOW * spacing * sides.min(), *_WINDOWS_PX))
    start = px.reshape(-1, 1, 2).astype(np.float32)
    found = cv2.cornerSubPix(image, start.copy(), (window, window), (-1, -1), _ENDS)
    # Some find no saddle and go astray.
    strays = np.linalg.norm(found - start, axis=2, keepdims=True) > 2 * window
    return np.where(strays, start, found).reshape(px.shape).astype(float)


def seen_spacing(target: Target, numbers: IntArray, px: FloatArray) -> float:
    """The white between tags [sides], as stated where too few of them are side by side.

    Four corners of two tags in line lie at 0, 1, 1 + s and 2 + s. No view of the plane changes
    their cross-ratio (AC BD) / (BC AD) = (1 + s)^2 / (s (2 + s)), and a lens hardly does.
    """
    index = {number: at for at, number in enumerate(numbers.tolist())}
    lines: list[FloatArray] = []
    for number, at in index.items():
        right = number + 1 if (number + 1) % target.columns else -1
        for beside, sides in (
            (right, [[0, 1], [3, 2]]),
            (number + target.columns, [[3, 0], [2, 1]]),
        ):
            if beside in index:
                lines += [np.concatenate([px[at][side], px[index[beside]][side]]) for side in sides]
    if len(lines) < _LEAST_SPACINGS:
        return target.spacing
    a, b, c, d = np.moveaxis(np.array(lines), 1, 0)
    far, near = (
        np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
        for one, other in ((c - a, d - b), (c - b, d - a))
    )
    quarter, middle, last = np.percentile(np.sqrt(far / np.maximum(far - near, 1e-9)), [25, 50, 75])
    # Corners that scatter, as in blurred images, show nothing.
    return target.spacing if last - quarter > _SCATTER else float(middle) - 1.0


def lacks_a_line(image: Image, target: Target, numbers: IntArray, px: FloatArray) -> bool:
    """Whether all tags of an outer row or column are missing, and the image shows paper there.

    What is dark in their place may hide them.
    """
    rows, columns = np.divmod(np.arange(target.columns * target.rows), target.columns)
    # Rows count from below. Of a missing tag the side is looked at that is nearest to the others.
    near, far = _INSIDE, 1.0 - _INSIDE
    lines = (
        (rows, 0, [(value, near) for value in _ALONG]),
        (rows, target.rows - 1, [(value, far) for value in _ALONG]),
        (columns, 0, [(far, value) for value in _ALONG]),
        (columns, target.columns - 1, [(near, value) for value in _ALONG]),
    )
    return any(_lacks(image, target, numbers, px, *line) for line in lines)


def _lacks(
    image: Image,
    target: Target,
    numbers: IntArray,
    px: FloatArray,
    across: IntArray,
    end: int,
    rim: Sequence[tuple[float, float]],
) -> bool:
    """Whether a line is missing: the tags whose number `across` it is `end`."""
    line = np.flatnonzero(across == end)
    # The nearest tags show where those would be, whatever the lens.
    beside = np.abs(across[numbers] - end) <= _NEAR_LINES
    if np.isin(line, numbers).any() or beside.sum() < _LEAST_TAGS:
        return False
    flat = _places(target, numbers[beside])
    found = cv2.findHomography(flat.reshape(-1, 2), px[beside].reshape(-1, 2))[0]
    homography = np.asarray(found, dtype=float)
    if homography.shape != (3, 3):
        return False
    white = 0.5 + (0.5 + target.spacing / 2) * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    dark, light = (
        float(np.nanmedian(_levels(image, flat[:, 0], array, homography)))
        for array in (np.array(rim), white)
    )
    missing = _levels(image, _places(target, line)[:, 0], np.array(rim), homography)
    # Nothing is said of what is outside the image.
    return float(np.mean(missing > (dark + light) / 2)) > _MOST_OF


def _levels(
    image: Image, corners: FloatArray, inside: FloatArray, homography: FloatArray
) -> FloatArray:
    """(t, k) grey levels at k places from the (t, 2) upper left corners of tags [sides]."""
    # NaN outside the image.
    places = (corners[:, None] + inside).reshape(1, -1, 2)
    px = np.rint(cv2.perspectiveTransform(places, homography)[0])
    shown = ((px >= 0) & (px < image.shape[::-1])).all(axis=1)
    x, y = np.where(shown[:, None], px, 0).astype(int).T
    return np.where(shown, image[y, x].astype(float), np.nan).reshape(len(corners), -1)

"""Identification of an unknown board in a photograph, by the ids and positions of its markers.

A checkerboard or a grid of circles has no markers, and has to be described.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import cv2
import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.number_format import listed, some_of
from visioncal.core.types import FloatArray, Image, IntArray, Target, TargetKind
from visioncal.vision.finders.aprilgrid import (
    find_aprilgrid,
    grid_tags,
    lacks_a_line,
    measured_spacing,
    ordered_tags,
    refined_tags,
)
from visioncal.vision.finders.charuco import find_charuco
from visioncal.vision.finders.imaging import check_grey, poor_image_reason
from visioncal.vision.finders.layout import LAYOUT_MISFIT
from visioncal.vision.finders.result import DetectedCorners
from visioncal.vision.targets import (
    APRILGRID_DICTIONARY,
    DEFAULT_RELATIVE_SIGMA,
    aruco_dictionary,
)

# Dictionaries by family, smallest first. Each contains the markers of the previous ones under the
# same ids, so that the largest decodes all.
_FAMILIES: dict[str, tuple[str, ...]] = {
    **{
        bits: tuple(f"DICT_{bits}_{count}" for count in (50, 100, 250, 1000))
        for bits in ("4X4", "5X5", "6X6", "7X7")
    },
    "original": ("DICT_ARUCO_ORIGINAL",),
    "mip": ("DICT_ARUCO_MIP_36h12",),
    **{code: (f"DICT_APRILTAG_{code}",) for code in ("16h5", "25h9", "36h10", "36h11")},
}
# Wider edges hide the bits of small markers [px].
_MAX_BLUR_PX = 6.0
_LISTED = 12
# Images with at least twice these sides are also searched at this size.
_USUAL_PIXELS, _MUCH_LARGER = 2e6, 0.5

# Pixels per module in the comparison of a marker with its ideal, and white margin that it includes
# [modules]: half of the required one.
_MODULE_PX, _RING = 4, 0.5
# Minimum correlation with the ideal marker. Strong lens distortion lowers it to 0.55. Codes of
# sixteen bits occur by chance in other markers' squares, with up to 0.8; longer codes do not.
_LIKE, _SHORT_LIKE, _SHORT_MODULES = 0.5, 0.83, 6

# Fewer markers are single ones. Printable boards have fewer columns.
_LEAST_MARKERS, _LEAST_COLUMNS, _MOST_COLUMNS, _MOST_GRID_COLUMNS = 4, 3, 40, 24
# Steps between markers up to this length, and this close to whole squares, are counted [squares].
_NEAR, _OFF = 2.5, 0.3
_SHARES, _SHARE_STEPS = (0.25, 0.98), 3
# A marker's corners around its centre [sides].
_AROUND = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
# Largest number of rows; share of the squares below a row that are to be seen, and of the contrast
# above it.
_MOST_ROWS, _HALF = 100, 0.5
# Number of markers in place that prove a board without its corners; number of layouts listed.
_SURE_MARKERS, _MOST_TIED = 8, 4
# Error of a marker's side over a square's by lens and paper; sum of the shifts of two opposite
# corners by blur, over-exposure and ink [px].
_SHARE_SIGMA, _OUTLINE_PX = 0.03, 1.0
_USUAL_SPACING = 0.3

# What to type for a board that its picture does not identify.
DESCRIBE_IT = (
    "Where the board is a checkerboard, write board.toml with its own figures for kind = "
    '"checkerboard", columns = 9, rows = 6 (inner corners), square_m = 0.025 (measured); where it '
    'is a grid of circles, kind = "circles", columns = 4, rows = 11, square_m = 0.02 (between '
    'rows), diameter_m = 0.015, asymmetric = true; and target = "board.toml" in session.toml.'
)


@dataclass(frozen=True)
class Identity:
    """An identified target, without its size."""

    kind: TargetKind  # Kind of target.
    columns: int  # Squares (ChArUco), tags or inner corners (checkerboard) along x; 1 for a marker.
    rows: int  # Likewise along y.
    whole: bool  # Whether the board's end is visible; otherwise it may be larger.
    corners_seen: int  # Number of corners that the detector of this kind finds.
    corners: int  # Number of corners of the target.
    dictionary: str = ""  # Smallest dictionary that contains the markers; empty without markers.
    larger: tuple[str, ...] = ()  # Other dictionaries that contain the same markers.
    # Whether a ChArUco board has OpenCV's layout before 4.6; with an odd number of rows both
    # layouts are the same.
    legacy: bool = False
    marker_share: float = 0.0  # Marker side over square side; 0 except for ChArUco.
    marker_share_sigma: float = 0.0  # Its standard deviation.
    # Decoded ids, ascending; for single markers, the target's first.
    marker_ids: tuple[int, ...] = ()
    first_id: int = -1  # Smallest id of an AprilGrid.
    spacing: float = 0.0  # Gap between its tags, as a share of their side.
    border: int = 1  # Number of dark modules around its tags' bits.
    notes: tuple[str, ...] = ()  # Remarks, in sentences.

    def target(self, name: str, square_m: float) -> Target:
        """The target, with the measured side of a square, or of a single marker [m]."""
        return Target(
            name,
            self.kind,
            self.columns,
            self.rows,
            square_m,
            DEFAULT_RELATIVE_SIGMA * square_m,
            marker_m=round(self.marker_share * square_m, 5),
            dictionary=self.dictionary,
            legacy=self.legacy,
            marker_id=self.marker_ids[0] if self.kind == "marker" else self.first_id,
            spacing=self.spacing,
            border=self.border,
        )


@dataclass(frozen=True, eq=False)
class _Marker:
    """A decoded marker."""

    family: str  # Its family, a key of `_FAMILIES`.
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


@typed
def identify(image: Image) -> Identity:
    """Identifies the target in an image by its markers: ChArUco, AprilGrid or a single marker.

    Args:
        image: (h, w) grey image.

    Returns:
        The target with the most corners; its notes list other visible ones.

    Raises:
        DataError: No markers are seen, as of checkerboards and circles, or the image is not grey.
    """
    check_grey(image, "image")
    identity = _identity(image)
    if identity is not None:
        return identity
    # In images much larger than the detectors are made for, details hide the board.
    scale = (_USUAL_PIXELS / image.size) ** 0.5
    if scale < _MUCH_LARGER:
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        identity = _identity(np.asarray(small, np.uint8))
        if identity is not None:
            note = f"It is found only in the picture reduced to {small.shape[1]} pixels in width."
            return replace(identity, notes=(note, *identity.notes))
    why = poor_image_reason(image, _MAX_BLUR_PX)
    height, width = image.shape
    raise DataError(
        f"No marker is read in this image of {width} x {height} pixels"
        + (f": {why}." if why else ".")
        + " A board is identified by its markers: one of OpenCV's ArUco and AprilTag dictionaries, "
        f"or {_LEAST_MARKERS} of a ChArUco board or an AprilGrid; {len(_decoded(image))} patterns "
        "looked like a marker. A checkerboard or a grid of circles has none, and must be stated.",
        culprits=["image"],
        next_step=f"{DESCRIBE_IT} Where it has markers, take a sharp picture of the whole board, "
        "with white around it, evenly lit, nearer, and tilted by less than 60 degrees.",
    )


def _identity(image: Image) -> Identity | None:
    """The target with the most corners; None if there is none."""
    markers = _decoded(image)
    boards = {}
    for family in sorted({marker.family for marker in markers}):
        board = _charuco(image, [marker for marker in markers if marker.family == family])
        if board is not None:
            boards[family] = board
    single = _single([marker for marker in _genuine(markers) if marker.family not in boards])
    grid = _aprilgrid(image)
    candidates = [*boards.values(), *([grid] if grid else [])]
    if not candidates:
        return single
    best = max(candidates, key=lambda candidate: candidate.corners_seen)
    # A grid's tags are not single markers.
    if single is None or best.kind == "aprilgrid":
        return best
    note = f"Beside it, marker {single.marker_ids[0]} of {single.dictionary} is seen."
    return replace(best, notes=(*best.notes, note))


def _decoded(image: Image) -> list[_Marker]:
    """Markers of all families (Garrido-Jurado et al. 2014; OpenCV), with false positives.

    A lattice or the markers' likeness separates these.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionaries = [aruco_dictionary(names[-1]) for names in _FAMILIES.values()]
    detector = cv2.aruco.ArucoDetector(dictionaries, parameters)
    corners, ids, _, family_indices = detector.detectMarkersMultiDict(image)
    if not corners:
        return []
    families = list(_FAMILIES)
    markers = []
    for px, number, index in zip(corners, np.ravel(ids), np.ravel(family_indices), strict=True):
        quad, family = np.asarray(px, dtype=float).reshape(4, 2), families[int(index)]
        likeness = _likeness(image, quad, family, int(number))
        markers.append(_Marker(family, int(number), quad, likeness))
    return markers


def _likeness(image: Image, px: FloatArray, family: str, number: int) -> float:
    """Correlation of the image of a marker with the ideal marker."""
    side, ring = _modules(family) * _MODULE_PX, round(_RING * _MODULE_PX)
    ideal = cv2.aruco.generateImageMarker(aruco_dictionary(_FAMILIES[family][-1]), number, side)
    ideal = np.pad(ideal, ring, constant_values=255)
    # Pixel centres are at integers; the marker's edge is half a pixel before the first one.
    frame = ring - 0.5 + side * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    flat_from_image = cv2.getPerspectiveTransform(px.astype(np.float32), frame.astype(np.float32))
    seen = cv2.warpPerspective(
        image, flat_from_image, ideal.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    return float(cv2.matchTemplate(seen, ideal, cv2.TM_CCOEFF_NORMED)[0, 0]) if np.ptp(seen) else 0


def _modules(family: str) -> int:
    """Number of modules along a marker's side, including its dark border."""
    return int(aruco_dictionary(_FAMILIES[family][0]).markerSize) + 2


def _genuine(markers: Sequence[_Marker]) -> list[_Marker]:
    """Markers that resemble their ideal; of several at one position, the most similar."""
    kept: list[_Marker] = []
    for marker in sorted(markers, key=lambda candidate: -candidate.likeness):
        apart = all(
            np.linalg.norm(marker.centre - other.centre) > max(marker.side_px, other.side_px) / 2
            for other in kept
        )
        short = _modules(marker.family) <= _SHORT_MODULES
        if marker.likeness > (_SHORT_LIKE if short else _LIKE) and apart:
            kept.append(marker)
    return kept


def _holding(family: str, count: int) -> tuple[str, ...]:
    """Dictionaries of a family with at least `count` markers, smallest first."""
    names = _FAMILIES[family]
    return tuple(name for name in names if len(aruco_dictionary(name).bytesList) >= count)


def _charuco(image: Image, markers: Sequence[_Marker]) -> Identity | None:
    """Identifies a ChArUco board from the markers of one family, with false positives.

    The ids count the white squares row by row: columns and layout predict the step from each marker
    to its neighbours. Steps are measured in the frame of the marker itself, where perspective and
    lens hardly count. Where too few rows are seen to determine the columns, several layouts predict
    them; corners decide, or a note names the others.
    """
    if len(markers) < _LEAST_MARKERS:
        return None
    ids = np.array([marker.number for marker in markers])
    px = np.array([marker.px for marker in markers])
    centres = np.array([marker.centre for marker in markers])
    sides = np.stack(
        [px[:, 1] + px[:, 2] - px[:, 0] - px[:, 3], px[:, 2:].sum(1) - px[:, :2].sum(1)]
    )
    own_from_px = 2.0 * np.linalg.pinv(np.moveaxis(sides, 0, -1))
    # (n, n, 2) steps [marker sides].
    steps = np.einsum("iab,ijb->ija", own_from_px, centres - centres[:, None])
    lengths = np.abs(steps).max(axis=2) + np.diag(np.full(len(ids), np.inf))
    sides_away = max(float(np.median(lengths.min(axis=1))), 1e-9)
    agreeing = {}
    # The nearest marker is one square away along both axes, or two where some are not read.
    for share in (1.0 / sides_away, 2.0 / sides_away):
        whole = np.rint(share * steps)
        near = whole.any(axis=2) & (share * lengths < _NEAR)
        near &= (np.abs(share * steps - whole) < _OFF).all(axis=2)
        for columns, legacy in product(range(_LEAST_COLUMNS, _MOST_COLUMNS + 1), (False, True)):
            places = _places(ids, columns, legacy=legacy)
            pairs = near & (places - places[:, None] == whole).all(axis=2)
            agreeing[share, columns, legacy] = pairs
    most = max(int(pairs.sum()) for pairs in agreeing.values())
    tied = [layout for layout, pairs in agreeing.items() if pairs.sum() == most]
    boards = []
    for share, columns, legacy in tied[:_MOST_TIED]:
        fits = agreeing[share, columns, legacy].any(axis=1)
        # At most half of the markers may be false positives.
        if fits.sum() >= max(_LEAST_MARKERS, len(ids) / 2):
            fitting = [markers[index] for index in np.flatnonzero(fits).tolist()]
            boards.append(_charuco_of(image, fitting, columns, share, legacy=legacy))
    found = sorted(filter(None, boards), key=lambda board: -board.corners_seen)
    rivals = [board for board in found[1:] if board.corners_seen == found[0].corners_seen]
    if not rivals:
        return next(iter(found), None)
    layouts = ", ".join(
        f"{rival.columns} x {rival.rows}{' in the legacy layout' if rival.legacy else ''}"
        for rival in rivals
    )
    note = f"What is seen of it fits {layouts} as well: show more of the board."
    return replace(found[0], whole=False, notes=(note, *found[0].notes))


def _places(ids: IntArray, columns: int, *, legacy: bool) -> FloatArray:
    """Squares (x, y) of the markers with these ids, (n, 2)."""
    # Two rows together have one marker per column, the first row the smaller half unless legacy.
    first = (columns + legacy) // 2
    pair, within = np.divmod(ids, columns)
    lower = within >= first
    place = np.where(lower, within - first, within)
    # In the upper row of a pair the markers are in the odd columns, or the even ones if legacy.
    start = np.where(lower == legacy, 1, 0)
    return np.stack([2 * place + start, 2 * pair + lower], axis=1).astype(float)


def _charuco_of(
    image: Image, markers: Sequence[_Marker], columns: int, share: float, *, legacy: bool
) -> Identity | None:
    """The board of a layout that markers fit, with the corners of its detector; None without.

    Args:
        image: (h, w) grey image.
        markers: The markers.
        columns: Number of squares along x.
        share: Marker side over square side, approximately.
        legacy: Whether square 0 holds a marker.
    """
    ids = np.array([marker.number for marker in markers])
    squares = _places(ids, columns, legacy=legacy)
    rows = int(squares[:, 1].max()) + 1
    quads = np.array([marker.px for marker in markers])
    for _ in range(_SHARE_STEPS):
        places = (squares + 0.5)[:, None] + share * _AROUND
        fit = cv2.findHomography(places.reshape(-1, 2), quads.reshape(-1, 2))[0]
        px_from_board = np.asarray(fit, dtype=float)
        if px_from_board.shape != (3, 3) or np.linalg.matrix_rank(px_from_board) < 3:
            return None
        seen_places = cv2.perspectiveTransform(quads, np.linalg.inv(px_from_board))
        areas = [cv2.contourArea(quad.astype(np.float32)) for quad in seen_places]
        share = float(np.sqrt(np.median(areas)))
    rows, whole = _rows(image, px_from_board, columns, rows, share)
    if legacy and rows % 2:
        # A legacy board with an odd number of rows does not start with a marker.
        rows, whole = rows + 1, False
    names = _holding(markers[0].family, max(columns * rows // 2, int(ids.max()) + 1))
    if not _SHARES[0] < share < _SHARES[1] or not names:
        return None
    notes = []
    if not whole:
        notes.append(f"The board may go on below row {rows}: its end there is not in the image.")
    if len(names) > 1:
        notes.append(f"{listed(names[1:])} hold the same markers: any of them finds this board.")
    if rows % 2 and whole:
        notes.append("With an odd number of rows the legacy layout is the same as the present one.")
    square_px = float(np.median([marker.side_px for marker in markers])) / share
    identity = Identity(
        "charuco",
        columns,
        rows,
        whole,
        corners_seen=0,
        corners=(columns - 1) * (rows - 1),
        dictionary=names[0],
        larger=names[1:],
        legacy=legacy,
        marker_share=share,
        marker_share_sigma=float(np.hypot(_SHARE_SIGMA * share, _OUTLINE_PX / square_px)),
        marker_ids=tuple(sorted(set(ids.tolist()))),
        notes=tuple(notes),
    )
    seen = find_charuco(image, identity.target("board", 1.0))
    if isinstance(seen, DetectedCorners):
        return replace(identity, corners_seen=len(seen.ids))
    if len(markers) < _SURE_MARKERS:
        return None
    return replace(
        identity, notes=(f"Its corners are not found in this image: {seen.reason}.", *notes)
    )


def _rows(
    image: Image, px_from_board: FloatArray, columns: int, least: int, share: float
) -> tuple[int, bool]:
    """Counts rows beyond the decoded markers, and whether the image shows the board's end.

    Below the last row the squares do not alternate. Their rims are compared, beside any markers.
    """
    squares, rim = np.arange(columns), (1.0 - share) / 4
    for rows in range(least, _MOST_ROWS):
        sides = np.array([rows - rim, rows + rim])
        places = np.stack(np.meshgrid(squares + 0.5, sides), axis=-1)
        px = cv2.perspectiveTransform(places, px_from_board).astype(np.float32)
        inside = np.asarray((px > 0) & (px < np.array(image.shape[::-1]) - 1))
        shown = np.all(inside, axis=(0, 2))
        if shown[::2].mean() < _HALF or shown[1::2].mean() < _HALF:
            return rows, False
        levels = cv2.remap(image, px[:, shown, 0], px[:, shown, 1], cv2.INTER_LINEAR)
        even = squares[shown] % 2 == 0
        above, below = np.median(levels[:, even], axis=1) - np.median(levels[:, ~even], axis=1)
        if -np.sign(above) * below < _HALF * abs(above):
            return rows, True
    return _MOST_ROWS, False


def _aprilgrid(image: Image) -> Identity | None:
    """Identifies an AprilGrid of Kalibr's family with borders of one or two modules, or None.

    Ids count the tags row by row from the lower left. Each number of columns therefore predicts the
    tags' positions; it is right if a homography maps these to the image.
    """
    read = {border: grid_tags(image, APRILGRID_DICTIONARY, border, np.inf) for border in (2, 1)}
    # With the wrong border a few tags are read at wrong positions.
    border = max(read, key=lambda index: len(read[index][0]))
    ids, px = read[border]
    if len(ids) < _LEAST_MARKERS:
        return None
    columns, first = _grid_columns(ids, px, border)
    if not columns:
        return None
    first += columns * int((ids.min() - first) // columns)
    rows = int((ids.max() - first) // columns) + 1
    target = _grid(columns, rows, first, border)
    numbers, all_tags = ids - first, np.ones(len(ids), bool)
    quads = refined_tags(image, ordered_tags(target, numbers, px, all_tags)[0], _USUAL_SPACING)
    target = replace(target, spacing=round(measured_spacing(target, numbers, quads), 2))
    # Rows below the image are included, as ids start with 0.
    below = replace(target, rows=rows + 1)
    if first and not lacks_a_line(image, below, numbers + columns, quads):
        rows, first = rows + first // columns, first % columns
        target = replace(target, rows=rows, marker_id=first)
    whole = lacks_a_line(image, replace(target, rows=rows + 1), ids - first, quads)
    seen = find_aprilgrid(image, target)
    if not isinstance(seen, DetectedCorners):
        return None
    notes = [
        "The white between its tags is estimated by the image, to a hundredth of their side: "
        "measure it to be sure."
    ]
    if not whole:
        notes.append(f"The board may go on above row {rows}, counted from below.")
    return Identity(
        "aprilgrid",
        columns,
        rows,
        whole,
        len(seen.ids),
        4 * columns * rows,
        dictionary=target.dictionary,
        marker_ids=tuple(ids.tolist()),
        first_id=first,
        spacing=target.spacing,
        border=border,
        notes=tuple(notes),
    )


def _grid_columns(ids: IntArray, px: FloatArray, border: int) -> tuple[int, int]:
    """Number of columns, and an id in the first column; 0 if none fits."""
    all_tags, tried = np.ones(len(ids), bool), range(1, _MOST_GRID_COLUMNS + 1)
    # Ids start with 0 unless the tags contradict it.
    for starts in (
        [(count, 0) for count in tried],
        [(count, offset) for count in tried for offset in range(1, count)],
    ):
        misfits = {}
        for columns, first in starts:
            numbers = ids - first + columns * (first > 0)
            target = _grid(columns, int(numbers.max()) // columns + 1, 0, border)
            misfits[columns, first] = ordered_tags(target, numbers, px, all_tags)[1]
        best = min(misfits, key=lambda key: misfits[key], default=(0, 0))
        if misfits.get(best, np.inf) <= LAYOUT_MISFIT:
            return best
    return 0, 0


def _grid(columns: int, rows: int, first: int, border: int) -> Target:
    """An AprilGrid of tags of 1 m."""
    identity = Identity("aprilgrid", columns, rows, True, 0, 0, APRILGRID_DICTIONARY)
    return replace(identity, first_id=first, spacing=_USUAL_SPACING, border=border).target("", 1.0)


def _single(markers: Sequence[_Marker]) -> Identity | None:
    """The largest marker of the family with the most markers, the most similar first; or None."""
    if not markers:
        return None
    by_family: dict[str, list[_Marker]] = {}
    for marker in markers:
        by_family.setdefault(marker.family, []).append(marker)
    # The family of the most similar marker wins ties.
    members = max(by_family.values(), key=len)
    largest = max(members, key=lambda member: member.side_px)
    others = tuple(sorted(member.number for member in members if member is not largest))
    ids = (largest.number, *others)
    names = _holding(largest.family, max(ids) + 1)
    notes = []
    if others:
        notes.append(
            f"Also seen: {some_of([*map(str, others)], _LISTED)}. A target is one marker, and the "
            "largest is taken; where they are a board's, show more of it; where they lie freely, "
            'describe them by a table of their corners (kind = "points").'
        )
    if len(names) > 1:
        notes.append(f"{listed(names[1:])} hold the same markers: any of them finds this one.")
    return Identity(
        "marker",
        1,
        1,
        whole=True,
        corners_seen=4,
        corners=4,
        dictionary=names[0],
        larger=names[1:],
        marker_ids=ids,
        notes=tuple(notes),
    )

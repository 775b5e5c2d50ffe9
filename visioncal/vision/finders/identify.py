"""Identification of an unknown target in a photograph."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.number_format import listed, some_of
from visioncal.core.types import Image, Target, TargetKind
from visioncal.vision.finders.charuco import find_charuco
from visioncal.vision.finders.circles import seen_grids
from visioncal.vision.finders.identify_aprilgrid import find_grid
from visioncal.vision.finders.identify_charuco import LEAST_MARKERS, Lattice, find_lattices
from visioncal.vision.finders.identify_checkerboard import find_squares
from visioncal.vision.finders.identify_markers import Marker, decode_markers, genuine, holding
from visioncal.vision.finders.imaging import check_grey, poor_image_reason
from visioncal.vision.finders.result import DetectedCorners
from visioncal.vision.targets import DEFAULT_RELATIVE_SIGMA

# Wider edges hide the bits of small markers [px].
_MAX_BLUR_PX = 6.0
_LISTED = 12
# Images with at least twice these sides are also searched at this size.
_USUAL_PIXELS, _MUCH_LARGER = 2e6, 0.5
# Number of markers on one lattice that prove a board without its corners.
_SURE_MARKERS = 8
# Dark squares look like staggered circles as wide as the rows' spacing; blur widens printed circles
# from 0.7 to 0.9.
_WIDE = 0.95
_MAYBE_CHARUCO = (
    "The light squares are not plain: rather a ChArUco board whose markers are too blurred to "
    "read. Take a sharper picture."
)


@dataclass(frozen=True)
class Identity:
    """An identified target, without its size."""

    kind: TargetKind  # Kind of target.
    columns: int  # Squares (ChArUco) or inner corners (checkerboard) along x; 1 for a marker.
    rows: int  # Likewise along y; rows of tags for an AprilGrid.
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
    asymmetric: bool = False  # Whether every second row of circles is shifted.
    diameter_share: float = 0.0  # Circles' diameter over the spacing of rows; 0 without circles.
    # Approximate side of a checkerboard's squares, or spacing of rows of circles [px].
    square_px: float = 0.0
    notes: tuple[str, ...] = ()  # Remarks, in sentences.

    @property
    def is_filled(self) -> bool:
        """Whether a checkerboard's light squares may contain markers."""
        return _MAYBE_CHARUCO in self.notes

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
            diameter_m=round(self.diameter_share * square_m, 5),
            asymmetric=self.asymmetric,
        )


@typed
def identify(image: Image) -> Identity:
    """Identifies the target in an image: ChArUco, AprilGrid, checkerboard, circles or marker.

    Args:
        image: (h, w) grey image.

    Returns:
        The target with the most corners; its notes list other visible ones.

    Raises:
        DataError: There is no target, or the image is not grey.
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
            square_px = identity.square_px / scale
            return replace(identity, square_px=square_px, notes=(note, *identity.notes))
    why = poor_image_reason(image, _MAX_BLUR_PX)
    height, width = image.shape
    raise DataError(
        f"No target is seen in this image of {width} x {height} pixels"
        + (f": {why}." if why else ".")
        + " Looked for were ChArUco boards and single markers of OpenCV's ArUco and AprilTag "
        "dictionaries, AprilGrids, grids of circles, and checkerboards of 3 x 3 inner corners or "
        "more; "
        f"{len(decode_markers(image))} patterns looked like a marker.",
        culprits=["image"],
        next_step="Take a sharp picture of the whole board, with white around it, evenly lit, "
        "nearer, and tilted by less than 60 degrees.",
    )


def _identity(image: Image) -> Identity | None:
    """The target with the most corners; None if there is none."""
    markers = decode_markers(image)
    boards = _charucos(image, markers)
    singles = _singles(tuple(marker for marker in genuine(markers) if marker.family not in boards))
    grids = _aprilgrids(image)
    candidates = [*boards.values(), *grids]
    if not candidates:
        squares = _checkerboards(image)
        # Staggered circles look like a checkerboard, and dark squares of a blurred board like
        # circles; content in the light squares proves squares.
        circles = [] if any(square.is_filled for square in squares) else _circles(image)
        if squares and any(
            circle.asymmetric and circle.diameter_share > _WIDE for circle in circles
        ):
            circles = []
        candidates = circles or [*squares, *singles]
    if not candidates:
        return None
    best = max(candidates, key=lambda candidate: candidate.corners_seen)
    # A grid's tags are not single markers.
    other_markers = () if best.kind == "aprilgrid" else singles
    others = (candidate for candidate in (*candidates, *other_markers) if candidate is not best)
    return replace(best, notes=(*best.notes, *dict.fromkeys(_notes_beside(others))))


def _notes_beside(others: Iterable[Identity]) -> Iterator[str]:
    for other in others:
        if other.kind == "marker":
            yield f"Beside it, marker {other.marker_ids[0]} of {other.dictionary} is seen."
        elif other.is_filled:
            yield f"Squares are seen around it. {_MAYBE_CHARUCO}"


def _charucos(image: Image, markers: tuple[Marker, ...]) -> dict[str, Identity]:
    """Best board of each marker family."""
    by_family = {}
    for family in sorted({marker.family for marker in markers}):
        members = [marker for marker in markers if marker.family == family]
        lattices = find_lattices(image, members) if len(members) >= LEAST_MARKERS else ()
        identities = [_charuco(image, family, lattice) for lattice in lattices]
        boards = [identity for identity in identities if identity is not None]
        if boards:
            by_family[family] = _decided(boards)
    return by_family


def _decided(boards: list[Identity]) -> Identity:
    """The board with the most corners among several that the same markers fit."""
    best = max(boards, key=lambda board: board.corners_seen)
    rivals = [
        board for board in boards if board is not best and board.corners_seen == best.corners_seen
    ]
    if not rivals:
        return best
    layouts = ", ".join(
        f"{rival.columns} x {rival.rows}{' in the legacy layout' if rival.legacy else ''}"
        for rival in rivals
    )
    note = f"What is seen of it fits {layouts} as well: show more of the board."
    return replace(best, whole=False, notes=(note, *best.notes))


def _charuco(image: Image, family: str, lattice: Lattice) -> Identity | None:
    """Identifies a board, and confirms it by the detector that calibrations use."""
    ids = tuple(sorted({marker.number for marker in lattice.markers}))
    names = holding(family, max(lattice.columns * lattice.rows // 2, ids[-1] + 1))
    if not names:
        return None
    identity = Identity(
        "charuco",
        lattice.columns,
        lattice.rows,
        lattice.rows_certain,
        corners_seen=0,
        corners=(lattice.columns - 1) * (lattice.rows - 1),
        dictionary=names[0],
        larger=names[1:],
        legacy=lattice.legacy,
        marker_share=lattice.share,
        marker_share_sigma=lattice.share_sigma,
        marker_ids=ids,
        notes=tuple(_charuco_notes(lattice, names)),
    )
    seen = find_charuco(image, identity.target("board", 1.0))
    if isinstance(seen, DetectedCorners):
        return replace(identity, corners_seen=len(seen.ids))
    if len(lattice.markers) < _SURE_MARKERS:
        return None
    note = f"Its corners are not found in this image: {seen.reason}."
    return replace(identity, notes=(note, *identity.notes))


def _charuco_notes(lattice: Lattice, names: tuple[str, ...]) -> Iterator[str]:
    if not lattice.rows_certain:
        yield f"The board may go on below row {lattice.rows}: its end there is not in the image."
    if len(names) > 1:
        yield f"{listed(names[1:])} hold the same markers: any of them finds this board."
    if lattice.rows % 2 and lattice.rows_certain:
        yield "With an odd number of rows the legacy layout is the same as the present one."


def _checkerboards(image: Image) -> list[Identity]:
    squares = find_squares(image)
    if squares is None:
        return []
    count = squares.columns * squares.rows
    notes = []
    if squares.filled:
        notes.append(_MAYBE_CHARUCO)
    if squares.cut:
        notes.append("The board may go on outside the image.")
    if not squares.found:
        notes.append("The search for just this board fails in this image.")
    if (squares.columns + squares.rows) % 2 == 0:
        notes.append(
            "This board looks the same upside down; one with an even and an odd number is better."
        )
    seen = count if squares.found else 0
    whole = not squares.cut and squares.found
    return [
        Identity(
            "checkerboard",
            squares.columns,
            squares.rows,
            whole,
            seen,
            count,
            square_px=squares.square_px,
            notes=tuple(notes),
        )
    ]


def _aprilgrids(image: Image) -> list[Identity]:
    grid = find_grid(image)
    if grid is None:
        return []
    target = grid.target
    notes = [
        "The white between its tags is estimated by the image, to a hundredth of their side: "
        "measure it to be sure."
    ]
    if not grid.whole:
        notes.append(f"The board may go on above row {target.rows}, counted from below.")
    return [
        Identity(
            "aprilgrid",
            target.columns,
            target.rows,
            grid.whole,
            grid.corners,
            4 * target.columns * target.rows,
            dictionary=target.dictionary,
            marker_ids=tuple(grid.ids.tolist()),
            first_id=target.marker_id,
            spacing=target.spacing,
            border=target.border,
            notes=tuple(notes),
        )
    ]


def _circles(image: Image) -> list[Identity]:
    # Of the possible numberings, one that is at least as wide as high.
    grids = sorted(
        seen_grids(image), key=lambda value: not value.asymmetric and value.columns < value.rows
    )
    if not grids:
        return []
    grid = grids[0]
    notes = ["The circles' diameter is estimated by the image, which corners hardly depend on."]
    if not grid.asymmetric or grid.rows % 2 == 0:
        notes.append(
            "This board looks the same upside down; an asymmetric one of an odd number of rows is "
            "better."
        )
    return [
        Identity(
            "circles",
            grid.columns,
            grid.rows,
            whole=True,
            corners_seen=len(grid.px),
            corners=len(grid.px),
            asymmetric=grid.asymmetric,
            diameter_share=grid.share,
            square_px=grid.diameter_px / grid.share,
            notes=tuple(notes),
        )
    ]


def _singles(markers: tuple[Marker, ...]) -> list[Identity]:
    """The largest marker of the family with the most markers."""
    if not markers:
        return []
    members: list[Marker] = []
    # The most similar marker comes first; its family wins ties.
    for family in dict.fromkeys(marker.family for marker in markers):
        family_markers = [marker for marker in markers if marker.family == family]
        members = family_markers if len(family_markers) > len(members) else members
    largest = max(members, key=lambda member: member.side_px)
    others = tuple(sorted(member.number for member in members if member is not largest))
    ids = (largest.number, *others)
    names = holding(largest.family, max(ids) + 1)
    notes = []
    if others:
        notes.append(
            f"Also seen: {some_of([*map(str, others)], _LISTED)}. A target is one marker, and the "
            "largest is taken; where they are a board's, show more of it; where they lie freely, "
            'describe them by a table of their corners (kind = "points").'
        )
    if len(names) > 1:
        notes.append(f"{listed(names[1:])} hold the same markers: any of them finds this one.")
    return [
        Identity(
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
    ]

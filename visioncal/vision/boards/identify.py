"""Identification of the board in photographs, whatever it is and whatever was declared."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.number_format import listed, some_of
from visioncal.core.types import FloatArray, Image, IntArray, Mask, Target
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.boards.aprilgrid import DARKER, ENLARGED
from visioncal.vision.boards.gridboard import GridBoard
from visioncal.vision.boards.imaging import check_grey, poor_image_reason, resized
from visioncal.vision.boards.kind import DEFAULT_RELATIVE_SIGMA, DetectedCorners, NotFound
from visioncal.vision.boards.layout import FAMILIES, Marker, decoded, holding, side_share
from visioncal.vision.targets import board_words

# Images that are searched for any board: at first, and where none shows the declared one.
LOOKED_AT, LOOKED_AT_LAST = 3, 12
# Least share of a board's corners in an image that identifies it.
_LEAST_CORNERS = 0.2
# Fewer markers are single ones.
_LEAST_MARKERS = 4
_MAY_HAVE_MORE = "On some side no image shows where it ends: it may have more columns or rows."


@dataclass(frozen=True)
class Identity:
    """An identified target, without its size."""

    board: Target  # The target, with sides of 1 m; its rows are those that the images show.
    corners_seen: int  # Number of corners that the detector of this kind finds in one image.
    corners: int  # Number of corners of the target.
    # Other dictionaries that contain the same markers; that of the target is the smallest.
    larger: tuple[str, ...] = ()
    # Decoded ids, ascending; for single markers, the target's first.
    marker_ids: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()  # Remarks, in sentences.
    is_mirrored: bool = False  # Whether only the mirror images of the pictures show it.
    shown: int = 1  # Number of the images that show it.
    # Whether only negatives of the images show it, as of a print in white on black.
    is_negative: bool = False

    @property
    def is_single(self) -> bool:
        """Whether the target is a single marker."""
        return self.board.columns * self.board.rows == 1

    @property
    def is_shown(self) -> bool:
        """Whether an image shows enough of its corners to identify it."""
        return self.corners_seen >= _LEAST_CORNERS * self.corners

    def target(self, name: str, square_m: float) -> Target:
        """The target, with the measured side of a square, or of a marker or a tag [m]."""
        board = kind_of(self.board).scaled(self.board, square_m)
        return replace(
            board,
            name=name,
            square_sigma_m=DEFAULT_RELATIVE_SIGMA * square_m,
            marker_m=round(board.marker_m, 5),
            diameter_m=round(board.diameter_m, 5),
        )


@typed
def identify(images: Image | Sequence[Image], declared: Target | None = None) -> Identity:
    """Identifies the target in one image or in several of the same board.

    Boards of markers are known by the ids and places of these, in the images or in their mirror
    images; checkerboards and grids of circles by their counts. Of a checkerboard, an image must
    show on each side where it ends; else its note says that it may have more, and `shown` is 0.

    Args:
        images: (h, w) grey images.
        declared: The target that is expected: it is preferred to others that fit as well.

    Returns:
        The target with the most corners; its notes list other visible ones.

    Raises:
        DataError: No target is seen, or an image is not grey.
    """
    pictures = [images] if isinstance(images, np.ndarray) else [*images]
    for picture in pictures:
        check_grey(picture)
    sets = [pictures]
    # Images with more pixels are looked at in a copy of about so many first: details hide boards.
    if max(picture.size for picture in pictures) > 8e6:
        small = [resized(each, min((2e6 / each.size) ** 0.5, 1.0)) for each in pictures]
        sets = [small, pictures]
    for shown in sets:
        look = _Look(shown, declared)
        identity = next(look.boards(), None) or look.single() or next(look.plain(whole=False), None)
        if identity is not None:
            return identity
    for shown in sets:
        negatives = [np.asarray(cv2.bitwise_not(picture), np.uint8) for picture in shown]
        look = _Look(negatives, declared)
        identity = next(look.of_markers(0), None)
        if identity is None and (identity := next(look.of_markers(2, 1), None)) is not None:
            # Searched last, as it takes longest and hardly any get here.
            identity = identity if next(look.plain(), None) is None else None
        if identity is not None:
            return replace(identity, is_negative=True)
    # Wider edges hide the bits of small markers.
    why = poor_image_reason(pictures[0], 6.0)
    height, width = pictures[0].shape
    raise DataError(
        f"No board is seen in this image of {width} x {height} pixels"
        + (f": {why}." if why else ".")
        + " A board is known by its markers, one of OpenCV's ArUco and AprilTag dictionaries or "
        f"{_LEAST_MARKERS} of a board; checkerboards and grids of circles are known where all of "
        "them is seen. Boards of dots and rigs of points have to be stated.",
        culprits=["image"],
        next_step="Take a sharp picture of the whole board, with white around it, evenly lit, "
        "nearer, and tilted by less than 60 degrees.",
    )


def identify_plain(images: Sequence[Image]) -> Identity | None:
    """Identifies a board without markers that (h, w) grey images show whole; quick."""
    return next(_Look(images, None).plain(), None)


@dataclass(frozen=True, eq=False)
class _Look:
    """Images of one board, and what is expected."""

    pictures: Sequence[Image]
    declared: Target | None
    # Markers of each image or its mirror image, by how they are read.
    read: dict[tuple[int, bool], list[list[Marker]]] = field(default_factory=dict)

    def boards(self) -> Iterator[Identity]:
        """Boards; the quickest search first, and mirror images where the images show none."""
        yield from self.of_markers(0)
        yield from self.plain()
        yield from self.of_markers(2, 1)

    def of_markers(self, *borders: int) -> Iterator[Identity]:
        """Boards of markers with such borders, in the images or in their mirror images."""
        for mirrored, border in product((False, True), borders):
            yield from self._of_markers(border, mirrored=mirrored)

    def plain(self, *, whole: bool = True) -> Iterator[Identity]:
        """Boards without markers: the one that most images show, of these the largest.

        Args:
            whole: Whether an image must show on each side that it ends there.
        """
        for kind in KINDS:
            seen = [one for one in self._plain if one is not None and one[0].kind == kind]
            counts = [(board.columns, board.rows, board.asymmetric) for board, _ in seen]
            found = [at for at, (_, ends) in enumerate(seen) if ends or not whole]
            if found:
                at = max(found, key=lambda at: (counts.count(counts[at]), counts[at]))
                corners = seen[at][0].columns * seen[at][0].rows
                shown = counts.count(counts[at]) if whole else 0
                notes = () if whole else (_MAY_HAVE_MORE,)
                yield Identity(seen[at][0], corners, corners, notes=notes, shown=shown)

    @cached_property
    def _plain(self) -> list[tuple[Target, bool] | None]:
        """Board without markers of each image, by the first kind that sees one; see `seen_in`."""
        looks = ((kind.seen_in(image) for kind in KINDS.values()) for image in self.pictures)
        return [next((one for one in look if one is not None), None) for look in looks]

    def shown(self, *, mirrored: bool) -> list[Image]:
        """The images or their mirror images."""
        return [np.ascontiguousarray(image[:, :: -1 if mirrored else 1]) for image in self.pictures]

    def _markers(self, border: int, *, mirrored: bool) -> list[list[Marker]]:
        """Markers of each image; with a border, of those with dark squares at their corners."""
        if (border, mirrored) not in self.read:
            more = (border, DARKER, ENLARGED) if border else ()
            shown = self.shown(mirrored=mirrored)
            self.read[border, mirrored] = [decoded(image, *more) for image in shown]
        return self.read[border, mirrored]

    def _of_markers(self, border: int, *, mirrored: bool) -> Iterator[Identity]:
        """The board of markers whose detector finds the most corners."""
        looks = self._markers(border, mirrored=mirrored)
        boards = list[Identity]()
        for family in sorted({marker.family for look in looks for marker in look}):
            grid = _Grid(family, looks, [image.shape for image in self.pictures], self.declared)
            if np.bincount(grid.image_of).max() >= _LEAST_MARKERS:
                boards += self._found(grid, border, mirrored=mirrored)
        if not boards:
            return
        best = max(boards, key=lambda board: board.corners_seen)
        used = {best.board.dictionary, *best.larger}
        for marker in (marker for look in looks for marker in look if marker.is_genuine):
            if not used & {*FAMILIES[marker.family]}:
                name = holding(marker.family, marker.number + 1)[0]
                note = f"Beside it, marker {marker.number} of {name} is seen."
                best = replace(best, notes=(*best.notes, note))
                break
        yield best

    def _found(self, grid: "_Grid", border: int, *, mirrored: bool) -> Iterator[Identity]:
        """The board that markers of one family show, with the corners of its detector."""
        if not grid.is_clear:
            return
        layout, order = grid.tied[0], grid.fullest_first
        places, kind = grid.places(layout), KINDS[layout.kind]
        shown = [grid.fits & (grid.image_of == at) for at in order]
        shares = [side_share([places[at]], [grid.px[at]])[0] for at in shown]
        # Blur draws detected corners inwards, least in the sharpest image.
        share = max((one for one in shares if np.isfinite(one)), default=0.0)
        # A legacy board with an odd number of rows does not start with a marker.
        has_squares, ids = "marker_m" in kind.keys, grid.ids[grid.fits]
        legacy = has_squares and layout.variant > 0
        rows = layout.rows + (legacy and layout.rows % 2)
        count = layout.first + layout.columns * rows // (2 if has_squares else 1)
        names = holding(grid.family, max(count, int(ids.max()) + 1))
        # Of tags with squares at their corners, the bits of another border read by chance. Least
        # correlation of tags with their ideals.
        blurred = kind.name == "aprilgrid" and np.median(grid.likeness[grid.fits]) < 0.65
        if not names or blurred or not 0.2 < share < 0.98:
            return
        expected = "" if self.declared is None else self.declared.dictionary
        dictionary = expected if expected in names else names[0]
        others = tuple(name for name in names if name != dictionary)
        board = Target("board", kind.name, layout.columns, rows, 1.0, DEFAULT_RELATIVE_SIGMA)
        board = replace(board, dictionary=dictionary, legacy=legacy, marker_id=layout.first)
        notes = [*grid.rivals]
        if has_squares:
            board = replace(board, marker_m=round(share, 5), marker_id=layout.first or -1)
            notes.append("The markers' side is by the image, to about 3 %: measure it to be sure.")
        else:
            spacing = round(1.0 / share - 1.0, 3)
            board = replace(board, border=max(border, 1), spacing=spacing)
        if others:
            notes.append(f"{listed(others)} hold the same markers: any of them finds this board.")
        fullest = self.shown(mirrored=mirrored)[order[0]]
        seen = (kind.located if isinstance(kind, GridBoard) else kind.find)(fullest, board)
        if isinstance(seen, NotFound):
            # So many markers in place prove a board without its corners, but for the squares at
            # the tags of an AprilGrid.
            if shown[0].sum() < 2 * _LEAST_MARKERS or kind.name == "aprilgrid":
                return
            notes.insert(0, f"Its corners are not found in this image: {seen.reason}.")
        elif isinstance(kind, GridBoard):
            refined, _ = side_share(*([part] for part in kind.whole(board, seen.ids, seen.px)))
            board = replace(board, spacing=round(1.0 / refined - 1.0, 3)) if refined > 0 else board
        yield Identity(
            board,
            len(seen.ids) if isinstance(seen, DetectedCorners) else 0,
            len(kind.corners(board)),
            others,
            tuple(sorted(set(ids.tolist()))),
            tuple(notes),
            mirrored,
            sum(int(mask.sum() >= _LEAST_MARKERS) for mask in shown),
        )

    def single(self) -> Identity | None:
        """A marker that resembles its ideal: the declared one, or the largest."""
        expected = -1 if self.declared is None else self.declared.marker_id
        singles = [one for mirrored in (False, True) for one in self._single(mirrored, expected)]

        def doubt(one: Identity) -> tuple[bool, bool]:
            # Of short codes, many a mirror image is another marker of the largest dictionary.
            return expected not in (-1, one.board.marker_id), not one.larger

        return min(singles, key=doubt, default=None)

    def _single(self, mirrored: bool, expected: int) -> Iterator[Identity]:
        """The largest marker of the family with the most markers."""
        looks = self._markers(0, mirrored=mirrored)
        markers = [marker for look in looks for marker in look if marker.is_genuine]
        if not markers:
            return
        families = [marker.family for marker in markers]
        # The family of the most similar marker wins ties.
        best = max(markers, key=lambda one: (families.count(one.family), one.likeness))
        members = [marker for marker in markers if marker.family == best.family]
        largest = max(members, key=lambda one: (one.number == expected, one.side_px))
        others = sorted({one.number for one in members} - {largest.number})
        ids = (largest.number, *others)
        names, notes = holding(largest.family, max(ids) + 1), []
        if others:
            notes.append(
                f"Also seen: {some_of([*map(str, others)], 12)}. A target is one marker, and the "
                "largest is taken; where they are a board's, show more of it; where they lie "
                'freely, describe them by a table of their corners (kind = "points").'
            )
        if len(names) > 1:
            notes.append(f"{listed(names[1:])} hold the same markers: any of them finds this one.")
        board = Target("board", "marker", 1, 1, 1.0, DEFAULT_RELATIVE_SIGMA, dictionary=names[0])
        board = replace(board, marker_id=largest.number)
        shown = sum(any(one.number == largest.number for one in look) for look in looks)
        yield Identity(board, 4, 4, names[1:], ids, tuple(notes), mirrored, shown)


class _Layout(NamedTuple):
    """How the markers of a board are numbered."""

    kind: str
    columns: int
    variant: int  # Of its places; the second one of a ChArUco board is the legacy layout.
    first: int  # The first marker's id; until it is chosen, its remainder by the columns.
    rows: int = 0


class _Grid:
    """Markers of one family in several images, and the layouts that most of them fit.

    Ids count the places of a board row by row: columns and layout predict the step from each marker
    to its neighbours. Steps are measured in the frame of the marker itself, where perspective and
    lens hardly count.
    """

    def __init__(
        self,
        family: str,
        looks: Sequence[Sequence[Marker]],
        shapes: Sequence[tuple[int, ...]],
        declared: Target | None,
    ) -> None:
        found = [(at, one) for at, look in enumerate(looks) for one in look if one.family == family]
        self.family, self.shapes, self.declared = family, shapes, declared
        self.image_of = np.array([at for at, _ in found])
        self.ids = np.array([marker.number for _, marker in found])
        self.px = np.array([marker.px for _, marker in found])
        self.centres = np.array([marker.centre for _, marker in found])
        self.likeness = np.array([marker.likeness for _, marker in found])
        self.near = [*map(np.concatenate, zip(*map(self._steps, range(len(looks))), strict=True))]

    def _steps(self, image: int) -> tuple[IntArray, FloatArray]:
        """Pairs (m, 2) of near markers of an image, and the whole steps (m, 2) between them."""
        rows = np.flatnonzero(self.image_of == image)
        if len(rows) < 2:
            return np.zeros((0, 2), np.int64), np.zeros((0, 2))
        px, centres = self.px[rows], self.centres[rows]
        sides = np.stack(
            [px[:, 1] + px[:, 2] - px[:, 0] - px[:, 3], px[:, 2:].sum(1) - px[:, :2].sum(1)]
        )
        marker_from_px = 2.0 * np.linalg.pinv(np.moveaxis(sides, 0, -1))
        steps = np.einsum("iab,ijb->ija", marker_from_px, centres - centres[:, None])
        lengths = np.abs(steps).max(axis=2) + np.diag(np.full(len(rows), np.inf))
        # The nearest marker is one step away, where it is read.
        unit = max(float(np.quantile(lengths.min(axis=1), 0.25)), 1e-9)
        whole = np.rint(steps / unit)
        # Steps between markers up to this length, and this close to whole ones, are counted
        # [steps].
        near = whole.any(axis=2) & (lengths < 2.5 * unit)
        near &= (np.abs(steps / unit - whole) < 0.3).all(axis=2)
        near &= (whole == -np.swapaxes(whole, 0, 1)).all(axis=2)
        return rows[np.argwhere(near)], whole[near]

    def _agreeing(self, places: FloatArray) -> Mask:
        """(m,) mask of near pairs whose steps (n, 2) places predict."""
        pairs, whole = self.near
        return np.asarray((places[pairs[:, 1]] - places[pairs[:, 0]] == whole).all(axis=1))

    def places(self, layout: _Layout, ids: IntArray | None = None) -> FloatArray:
        """(n, 2) places of markers in the steps of a layout."""
        numbers = (self.ids if ids is None else ids) - layout.first
        return KINDS[layout.kind].marker_places(numbers, layout.columns)[layout.variant]

    def _fits(self, layout: _Layout) -> Mask:
        """(n,) mask of markers that a layout fits."""
        pairs = self.near[0][self._agreeing(self.places(layout))]
        return np.isin(np.arange(len(self.ids)), pairs[:, 0])

    @cached_property
    def tied(self) -> list[_Layout]:
        """Layouts that predict the most steps, the likeliest first."""
        votes: dict[_Layout, int] = {}
        for kind in KINDS.values():
            # Printable boards of markers have fewer columns.
            for columns in range(1, 41):
                for rest in range(columns):
                    variants = kind.marker_places(self.ids - rest, columns)
                    for variant, places in enumerate(variants):
                        layout = _Layout(kind.name, columns, variant, rest)
                        votes[layout] = int(self._agreeing(places).sum())
        most = max(1, *votes.values())
        tied = [self._from_first(layout) for layout, count in votes.items() if count == most]
        return [layout for _, layout in sorted(tied)]

    def _from_first(self, layout: _Layout) -> tuple[tuple[bool, bool, int, int], _Layout]:
        """A layout with its first id, the declared, 0, or the least seen; and how doubtful it is.

        Rows before those that are seen are believed where no image would show them.
        """
        fits, declared = self._fits(layout), self.declared
        lowest = int(self.ids[fits].min())
        usual = [0] if declared is None else [max(declared.marker_id, 0), 0]
        stated = declared and (declared.kind, declared.columns)
        nearest = lowest - (lowest - layout.first) % layout.columns
        row_before = np.arange(max(lowest - layout.columns, 0), lowest)
        for first in usual:
            if first <= lowest and (first - nearest) % layout.columns == 0:
                layout = self._counted(layout._replace(first=first), fits)
                # Of the declared board, rows may be covered.
                if declared and layout[:2] == stated and layout.rows <= declared.rows:
                    break
                if not self._would_be_seen(layout, fits, row_before[row_before >= first]):
                    break
        else:
            layout = self._counted(layout._replace(first=nearest), fits)
        is_other = layout[:2] != stated or layout.first not in usual
        is_other |= declared is not None and declared.legacy and not layout.variant
        return (is_other, layout.first > 0, layout.columns, lowest - layout.first), layout

    def _counted(self, layout: _Layout, fits: Mask) -> _Layout:
        """A layout with the rows up to its last marker that fits."""
        return layout._replace(rows=int(np.abs(self.places(layout)[fits, 1]).max()) + 1)

    def _would_be_seen(self, layout: _Layout, fits: Mask, ids: IntArray) -> bool:
        """Whether an image would show most markers of these ids, if there were any."""
        for at, shape in enumerate(self.shapes):
            shown = fits & (self.image_of == at)
            if shown.sum() >= _LEAST_MARKERS and len(ids):
                flat = cv2.findHomography(self.places(layout)[shown], self.centres[shown])[0]
                if flat is not None:
                    px = cv2.perspectiveTransform(self.places(layout, ids)[None], flat)[0]
                    if ((px > 0) & (px < shape[::-1])).all(axis=1).mean() > 0.5:
                        return True
        return False

    @cached_property
    def fits(self) -> Mask:
        """(n,) mask of markers that the likeliest layout fits."""
        return self._fits(self.tied[0])

    @property
    def fullest_first(self) -> list[int]:
        """Indices of the images, those with the most fitting markers first."""
        counts = np.bincount(self.image_of[self.fits], minlength=len(self.shapes))
        return [int(at) for at in np.argsort(-counts, kind="stable")]

    @property
    def is_clear(self) -> bool:
        """Whether enough markers of an image fit the likeliest layout."""
        if not self.tied:
            return False
        seen = self.image_of == self.fullest_first[0]
        # At most half of the markers may be false positives.
        return bool((self.fits & seen).sum() >= max(_LEAST_MARKERS, seen.sum() / 2))

    @property
    def rivals(self) -> Iterator[str]:
        """A note on other numbers of columns that fit as well."""
        kind, columns, *_ = self.tied[0]
        others = {one.columns for one in self.tied if one.kind == kind and not one.first}
        if more := [str(count) for count in sorted(others - {columns})[:4]]:
            yield f"Its visible part fits {listed(more)} columns as well: show more of the board."


def with_article(identity: Identity) -> str:
    """The target in a few words, with an indefinite article."""
    words = describe(identity)
    return f"{'an' if words[0].lower() in 'aeiou' else 'a'} {words}"


def describe(identity: Identity) -> str:
    """The target in a few words."""
    board = identity.board
    details = [board_words(board)]
    if board.marker_m:
        details.append(f"markers of {board.marker_m:.3f} of a square")
    if board.spacing:
        details.append(f"{board.spacing:.2f} of their side apart")
    if board.diameter_m:
        details.append(f"circles of {board.diameter_m:.2f} of the distance of rows")
    if not identity.is_single:
        details.append(f"{identity.corners_seen} of {identity.corners} corners seen")
    details += ["in mirrored pictures"] * identity.is_mirrored
    details += ["in negatives"] * identity.is_negative
    return ", ".join(details)

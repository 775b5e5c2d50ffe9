"""Layout of a board, its rulers and its text on a page."""

import re
import textwrap
from dataclasses import dataclass

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Target
from visioncal.vision.board_request import BoardRequest
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.printing.pattern import Pattern, draw_pattern
from visioncal.vision.targets import target_from_document

# Width and height in portrait [mm] (ISO 216; ANSI Y14.1).
_PAGES_MM = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
_OWN_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*x\s*(\d+(?:\.\d+)?)(?:\s*mm)?", re.IGNORECASE)
_LEAST_MM, _MOST_MM = 20.0, 3000.0  # Sides of a page.
# Smaller squares are limited by the printer's resolution [mm].
_SMALLEST_MM = 5

# Margin that office printers leave white.
EDGE_MM = 5.0
# Length of a ruler beyond its last tick, for the arrow and its letter.
ARROW_MM = 8.0

FONT_PT = 7.0  # Size of the text.
LINE_MM = 3.1  # Distance of its lines.
# Gap of the text to the quiet zone.
_GAP_MM = 0.5


@dataclass(frozen=True)
class Page:
    """A sheet of paper: its name for messages, and its width and height [mm]."""

    name: str
    width_mm: float
    height_mm: float

    def __str__(self) -> str:
        return f"{self.name} ({self.width_mm:g} x {self.height_mm:g} mm)"


@dataclass(frozen=True, eq=False)
class Sheet:
    """A page with its printed content, in mm from its top left corner, y down."""

    target: Target  # The target.
    pattern: Pattern  # Its dark shapes.
    page: Page  # The paper.
    origin_mm: tuple[float, float]  # Origin of the target's frame.
    # Lengths of the rulers along x and y; they start at the origin's coordinates.
    ruler_mm: tuple[float, float]
    lines: tuple[str, ...]  # Lines of text below the board.
    text_mm: tuple[float, float]  # Top left corner of the text.


def pages_named(text: str, landscape: bool | None) -> tuple[Page, ...]:
    """Pages by name or size.

    Args:
        text: A name, such as `A4`, or a size, such as `500x300` (width x height, mm).
        landscape: True for landscape, False for portrait. None allows both for a named page, and
            keeps a size as given.

    Returns:
        The pages that the text allows, landscape first.

    Raises:
        DataError: There is no such page, or its size is out of range.
    """
    names = {name.lower(): name for name in _PAGES_MM}
    custom = _OWN_SIZE.fullmatch(text.strip())
    if custom is not None:
        sides, name = (float(custom[1]), float(custom[2])), "page"
    elif text.strip().lower() in names:
        name = names[text.strip().lower()]
        sides = _PAGES_MM[name]
    else:
        raise DataError(
            f"There is no page named {text!r}; the names are {', '.join(_PAGES_MM)}.",
            culprits=[text],
            next_step=f"{did_you_mean(text, names)} A size of your own is given as 500x300, width "
            "x height in mm.".strip(),
        )
    if not all(_LEAST_MM <= side <= _MOST_MM for side in sides):
        raise DataError(
            f"The page {text} is out of range: {_LEAST_MM:g} to {_MOST_MM:g} mm a side are "
            "possible.",
            culprits=[text],
        )
    long, short = max(sides), min(sides)
    if landscape is None and custom is not None:
        return (Page(name, *sides),)
    wide, tall = Page(name, long, short), Page(name, short, long)
    if landscape is None:
        return wide, tall
    return (wide,) if landscape else (tall,)


def arrange(target: Target, pages: tuple[Page, ...]) -> Sheet:
    """Arranges a target on the first page with enough room; raises DataError."""
    pattern = draw_pattern(target)
    for page in pages:
        if _fits(target, pattern, page):
            return _centred(target, pattern, page)
    left, top, right, bottom = pattern.box
    width_mm, height_mm = _needed_mm(target, pattern, pages[0])
    largest = largest_side_mm(target, pages)
    smaller = (
        f", or a {kind_of(target).unit} of {largest} mm, the largest that fits" if largest else ""
    )
    raise DataError(
        f"{target.name} does not fit on {', '.join(map(str, pages))}: the print measures "
        f"{1e3 * (right - left):g} x {1e3 * (bottom - top):g} mm, and with the white around it, "
        f"the rulers and the text it needs {width_mm:.1f} x {height_mm:.1f} mm.",
        culprits=[target.name],
        next_step=f"Take a larger page (--page){smaller}.",
    )


def largest_side_mm(target: Target, pages: tuple[Page, ...]) -> int:
    """Largest square side that fits one of the pages [mm], whole; 0 if none does.

    For a marker it is the marker's own side; markers scale with squares.
    """
    fits, fails = 0, 1 + int(max(max(page.width_mm, page.height_mm) for page in pages))
    while fails - fits > 1:
        middle = (fits + fails) // 2
        scale = 1e-3 * middle / target.square_m
        tried = kind_of(target).scaled(target, scale)
        pattern = draw_pattern(tried)
        if any(_fits(tried, pattern, page) for page in pages):
            fits = middle
        else:
            fails = middle
    return fits


def _fits(target: Target, pattern: Pattern, page: Page) -> bool:
    width_mm, height_mm = _needed_mm(target, pattern, page)
    return width_mm <= page.width_mm and height_mm <= page.height_mm


def _needed_mm(target: Target, pattern: Pattern, page: Page) -> tuple[float, float]:
    """Width and height that a board takes with the white around it, rulers and text."""
    left, top, right, bottom = (1e3 * side for side in pattern.box)
    before, behind = _margins_mm(pattern)
    lines = _lines(target, _text_width_mm(right - left, page))
    below = 1e3 * pattern.quiet_m + _GAP_MM + LINE_MM * len(lines) + EDGE_MM
    return before + right - left + behind, before + bottom - top + below


def _margins_mm(pattern: Pattern) -> tuple[float, float]:
    """Margins at the print's left and top, and at its right."""
    quiet_mm = 1e3 * pattern.quiet_m
    # 4 mm for a ruler, its ticks and its label.
    return EDGE_MM + 4.0 + quiet_mm, max(EDGE_MM, quiet_mm)


def _centred(target: Target, pattern: Pattern, page: Page) -> Sheet:
    """Centres the print on a page with enough room."""
    before, behind = _margins_mm(pattern)
    left, top, right, bottom = (1e3 * side for side in pattern.box)
    width, height = right - left, bottom - top
    x = min(max((page.width_mm - width) / 2, before), page.width_mm - width - behind)
    y = (page.height_mm - _needed_mm(target, pattern, page)[1]) / 2 + before
    text_width = _text_width_mm(width, page)
    lines = _lines(target, text_width)
    ruler_x = _ruler_mm(page.width_mm - (x - left))
    ruler_y = _ruler_mm(page.height_mm - LINE_MM * len(lines) - (y - top))
    # The text stays below the board, and below a ruler that is longer than the board.
    below_board = y + height + 1e3 * pattern.quiet_m + _GAP_MM
    below_ruler = y - top + ruler_y + ARROW_MM
    return Sheet(
        target,
        pattern,
        page,
        origin_mm=(x - left, y - top),
        ruler_mm=(ruler_x, ruler_y),
        lines=lines,
        text_mm=(
            max(EDGE_MM, min(x, x + width / 2 - text_width / 2)),
            max(below_board, below_ruler),
        ),
    )


def _ruler_mm(room_mm: float) -> float:
    """Length of a ruler that starts at this distance from the paper's edge."""
    # Whole steps of 10 mm, up to 100.
    whole = 10.0 * ((room_mm - EDGE_MM - ARROW_MM) // 10.0)
    return min(max(whole, 0.0), 100.0)


def _text_width_mm(width_mm: float, page: Page) -> float:
    # Below a narrow board the text is wider.
    return min(max(width_mm, 170.0), page.width_mm - 2 * EDGE_MM)


def _lines(target: Target, width_mm: float) -> tuple[str, ...]:
    # A letter's width, rounded up [mm].
    letters = max(int(width_mm / 1.3), 10)
    words, origin, measure = kind_of(target).on_sheet(target)
    texts = (
        f"{target.name}: {words}",
        f"Frame: origin at {origin}, level with the zeros of both rulers; x to the right, y "
        "down, z into the page.",
        "Print at 100 %, not fitted to the page, and check both rulers. " + measure,
    )
    return tuple(line for text in texts for line in textwrap.wrap(text, letters))


def requested_target(request: BoardRequest, pages: tuple[Page, ...]) -> Target:
    """Builds the requested target.

    Args:
        request: Requirements. An open side becomes the largest in whole millimetres that fits one
            of the pages; an open marker side three quarters of its square's, in whole millimetres.
        pages: Pages that it may be printed on.

    Raises:
        DataError: A requirement is missing or cannot be met.
    """
    if request.side_mm is not None:
        return _described(request, request.side_mm)
    smallest = _described(request, _SMALLEST_MM)
    largest = largest_side_mm(smallest, pages)
    if largest < _SMALLEST_MM:
        # Raises an error with the required size.
        arrange(smallest, pages)
    return _described(request, largest)


def _described(request: BoardRequest, square_mm: float) -> Target:
    document = {"kind": request.kind, **KINDS[request.kind].requested(request, square_mm)}
    target = target_from_document(document, request.name or request.kind)
    if request.name:
        return target
    name = kind_of(target).file_name(target, f"{1e3 * target.square_m:g}mm")
    return target_from_document(document, name)

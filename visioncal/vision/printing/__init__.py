"""Printable boards: a target's dark shapes on a page, written at exact size."""

from visioncal.vision.printing.files import write_board
from visioncal.vision.printing.page import Page, Sheet, arrange, pages_named
from visioncal.vision.printing.pattern import Pattern, draw_pattern
from visioncal.vision.printing.request import BoardRequest, requested_target, side_metres

__all__ = [
    "BoardRequest",
    "Page",
    "Pattern",
    "Sheet",
    "arrange",
    "draw_pattern",
    "pages_named",
    "requested_target",
    "side_metres",
    "write_board",
]

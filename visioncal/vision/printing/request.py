"""Targets from partial requirements: sizes left open become the largest that fit."""

from visioncal.core.types import Target
from visioncal.vision.boards import KINDS, kind_of
from visioncal.vision.boards.kind import BoardRequest
from visioncal.vision.printing.page import Page, arrange, largest_side_mm
from visioncal.vision.targets import target_from_document

# Smaller squares are limited by the printer's resolution.
_LEAST_MM = 5


def requested_target(request: BoardRequest, pages: tuple[Page, ...]) -> Target:
    """Builds the requested target.

    Args:
        request: Requirements. An open side becomes the largest in whole millimetres that fits one
            of the pages; an open marker side three quarters of its square's, in whole millimetres.
        pages: Pages that it may be printed on.

    Raises:
        DataError: A requirement is missing or cannot be met.
    """
    if request.square_mm is not None:
        return _target(request, request.square_mm)
    smallest = _target(request, _LEAST_MM)
    largest = largest_side_mm(smallest, pages)
    if largest < _LEAST_MM:
        # Raises an error with the required size.
        arrange(smallest, pages)
    return _target(request, largest)


def _target(request: BoardRequest, square_mm: float) -> Target:
    document = {"kind": request.kind, **KINDS[request.kind].requested(request, square_mm)}
    target = target_from_document(document, request.name or request.kind)
    if request.name:
        return target
    name = kind_of(target).file_name(target, f"{1e3 * target.square_m:g}mm")
    return target_from_document(document, name)

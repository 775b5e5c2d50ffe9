"""Boards on paper, as tests look at them."""

from functools import lru_cache

import numpy as np
import pypdfium2

from visioncal.core.types import Image, Target
from visioncal.vision.printing.drawing import to_pdf
from visioncal.vision.printing.page import Sheet, arrange, pages_named

MM_PER_INCH = 25.4


def any_page(target: Target) -> Sheet:
    """The target on A4, or on A3 where A4 is too small."""
    return arrange(target, (*pages_named("A4", None), *pages_named("A3", None)))


def raster(pdf: bytes, dpi: float) -> Image:
    """The first page in grey."""
    document = pypdfium2.PdfDocument(pdf)
    try:
        bitmap = document[0].render(scale=dpi / 72, grayscale=True)
        return np.ascontiguousarray(bitmap.to_numpy()).squeeze()
    finally:
        document.close()


@lru_cache(maxsize=64)
def printed(target: Target, dpi: float) -> Image:
    """The target's page in grey. Read only."""
    return raster(to_pdf(any_page(target)), dpi)


def charuco(columns: int, rows: int, dictionary: str = "DICT_5X5_100", **options) -> Target:
    """A ChArUco board of squares of 30 mm with markers of 22 mm."""
    measures = {"square_m": 0.03, "square_sigma_m": 1e-5, "marker_m": 0.022} | options
    return Target("board", "charuco", columns, rows, dictionary=dictionary, **measures)


def checkerboard(columns: int, rows: int, square_m: float = 0.025) -> Target:
    """A checkerboard."""
    return Target("board", "checkerboard", columns, rows, square_m, 1e-5)


def aprilgrid(columns: int, rows: int, **options) -> Target:
    """An AprilGrid of tags of 32 mm, as Kalibr prints them."""
    measures = {"square_m": 0.032, "square_sigma_m": 1e-5, "marker_id": 0} | options
    layout = {"spacing": 0.3, "border": 2, "dictionary": "DICT_APRILTAG_36h11"} | measures
    return Target("board", "aprilgrid", columns, rows, **layout)


def circles(columns: int, rows: int, **options) -> Target:
    """A grid of circles of 12 mm, in rows 20 mm apart."""
    measures = {"square_m": 0.02, "square_sigma_m": 1e-5, "diameter_m": 0.012} | options
    return Target("board", "circles", columns, rows, **measures)

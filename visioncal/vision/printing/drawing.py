"""Drawing of a sheet as PDF, SVG and PNG, each at exact size.

PDF and SVG have coordinates to a millionth of a point. The dark area of a board is one path with a
single fill, so that renderers show no seams between neighbouring cells.
"""

import io
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D, Transform

from visioncal.core.choices import UNITS_M
from visioncal.core.threads import DRAWING
from visioncal.core.types import FloatArray
from visioncal.vision.boards import kind_of
from visioncal.vision.printing.page import FONT_PT, LINE_MM, Sheet

_MM_PER_INCH = 1e3 * UNITS_M["inch"]
_PT_PER_MM = 72.0 / _MM_PER_INCH
_FONT = "DejaVu Sans"
_GREY = "#444444"


def to_pdf(sheet: Sheet) -> bytes:
    """Draws a sheet as a PDF of one page."""
    return _saved(sheet, "pdf", {"CreationDate": None, "Creator": "visioncal", "Producer": None})


def to_svg(sheet: Sheet) -> bytes:
    """Draws a sheet as SVG, with text as shapes that need no font."""
    return _saved(sheet, "svg", {"Date": None, "Creator": "visioncal"})


def to_png(sheet: Sheet, dpi: float) -> bytes:
    """Draws a sheet as PNG, with anti-aliased edges that keep sub-pixel positions."""
    return _saved(sheet, "png", {"Software": "visioncal"}, dpi)


def not_in_font(text: str) -> str:
    """Characters of a text that the sheets' font does not have."""
    font = get_font(findfont(_FONT))
    return "".join(character for character in text if not font.get_char_index(ord(character)))


def _saved(
    sheet: Sheet, kind: str, metadata: dict[str, str | None], dpi: float | None = None
) -> bytes:
    # They give the same bytes for the same sheet, whatever the user's settings.
    settings: dict[Any, Any] = {
        "font.family": _FONT,
        "path.simplify": False,
        "pdf.compression": 9,
        "pdf.fonttype": 3,
        "svg.fonttype": "path",
        "svg.hashsalt": "visioncal",
        "savefig.bbox": None,
        "savefig.facecolor": "white",
        "savefig.transparent": False,
        "text.usetex": False,
    }
    with DRAWING, mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(settings)
        buffer = io.BytesIO()
        _figure(sheet).savefig(buffer, format=kind, dpi=dpi or "figure", metadata=metadata)
    return buffer.getvalue()


def _figure(sheet: Sheet) -> Figure:
    page = sheet.page
    figure = Figure(figsize=(page.width_mm / _MM_PER_INCH, page.height_mm / _MM_PER_INCH))
    # From mm, y down from the page's top left corner, to inches, y up from the bottom left one.
    inches_from_mm = Affine2D().translate(0.0, -page.height_mm).scale(1.0, -1.0)
    on_page = inches_from_mm.scale(1.0 / _MM_PER_INCH) + figure.dpi_scale_trans
    origin = np.array(sheet.origin_mm)
    _fill(figure, [origin + 1e3 * loop for loop in sheet.pattern.loops], "black", on_page)
    picture = kind_of(sheet.target).picture(sheet.target)
    if picture is not None:
        left, top, right, bottom = 1e3 * np.array(sheet.pattern.box) + np.tile(origin, 2)
        size = np.array([page.width_mm, page.height_mm])
        place = np.array([left, page.height_mm - bottom, right - left, bottom - top])
        axes = figure.add_axes(tuple((place / np.tile(size, 2)).tolist()))
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="none")
        axes.set_axis_off()
    for axis in (0, 1):
        _draw_ruler(figure, sheet, axis, on_page)
    x, y = sheet.text_mm
    for number, line in enumerate(sheet.lines):
        figure.text(
            x,
            y + LINE_MM * number,
            line,
            transform=on_page,
            fontsize=FONT_PT,
            color="black" if number == 0 else _GREY,
            va="top",
            # A name may contain characters that matplotlib would parse as formulas.
            parse_math=False,
        )
    return figure


def _fill(figure: Figure, loops: list[FloatArray], colour: str, on_page: Transform) -> None:
    """Fills loops [mm] as one path."""
    paths = [Outline(np.vstack([loop, loop[:1]]), closed=True) for loop in loops]
    patch = PathPatch(Outline.make_compound_path(*paths), facecolor=colour, linewidth=0.0)
    patch.set_transform(on_page)
    # Snapping would move edges to whole pixels.
    patch.set_snap(False)
    figure.add_artist(patch)


def _draw_ruler(figure: Figure, sheet: Sheet, axis: int, on_page: Transform) -> None:
    """Draws the ruler along one axis of the target's frame, outside the quiet zone."""
    length = sheet.ruler_mm[axis]
    across = 1 - axis
    side = 1e3 * (sheet.pattern.box[across] - sheet.pattern.quiet_m) - 0.8

    def at(along: float, away: float) -> FloatArray:
        position = np.array(sheet.origin_mm)
        position[axis] += along
        position[across] += side - away
        return position

    # Lines of half a point.
    half = 0.5 / _PT_PER_MM / 2
    tip = length + 4.0
    head = tip - 2.2
    # Lines are filled rectangles, which every renderer positions exactly.
    bars = [_bar(at(-half, -half), at(head, half))]
    for tick in np.arange(0.0, length + 1.0, 10.0):
        tall = 2.4 if tick in (0.0, length) else 0.8
        bars.append(_bar(at(tick - half, 0.0), at(tick + half, tall)))
    bars.append(np.array([at(tip, 0.0), at(head, 0.6), at(head, -0.6)]))
    _fill(figure, bars, _GREY, on_page)
    labels = [("xy"[axis], length + 5.5, 0.0)]
    if length > 0.0:
        labels.append((f"{length:g} mm", length / 2, 1.2 + FONT_PT / _PT_PER_MM / 2.6))
    for text, along, away in labels:
        position = at(along, away)
        figure.text(
            float(position[0]),
            float(position[1]),
            text,
            transform=on_page,
            fontsize=FONT_PT - 1,
            color=_GREY,
            ha="center",
            va="center_baseline" if text in "xy" else "center",
            rotation=90 if axis and text not in "xy" else 0,
        )


def _bar(corner: FloatArray, opposite: FloatArray) -> FloatArray:
    (x, y), (far_x, far_y) = corner, opposite
    return np.array([[x, y], [far_x, y], [far_x, far_y], [x, far_y]])

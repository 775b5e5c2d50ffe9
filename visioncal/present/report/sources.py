"""Plots of what makes a result uncertain: sources, directions, and the board's shape."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray, IntArray, Target
from visioncal.present.facts import SOURCES
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes
from visioncal.present.report.svg import Figure
from visioncal.results.sections import BoardResult, UncertaintyResult

_WIDTH_IN = 5.0
# Mean width of a letter, rounded up.
_LETTER_IN = 0.068
# Steps of colour, and cells of the map of a board across it.
_LEVELS, _CELLS = 13, 96
# Height over width of the picture of an upright board.
_TALLEST = 0.8
# Less depth than this is rounding.
_LEAST_DEPTH_MM = 1e-6


def budget(found: UncertaintyResult) -> Markup:
    """Bars of the standard deviation that each source contributes where the views look."""
    names = [*found.parts_mm, "total"]
    values = [*found.parts_mm.values(), found.total_mm]
    labels = [
        f"{significant(value)} ({found.percent(name)})" for name, value in found.parts_mm.items()
    ]
    labels.append(significant(found.total_mm))
    top = max(values) or 1.0
    words = [SOURCES.get(name, name) for name in names]
    figure = Figure(_WIDTH_IN, 0.32 * len(names) + 0.6)
    margins = Margins(0.2 + _LETTER_IN * max(map(len, words)))
    ((box,),) = boxes(figure, 1, 1, margins)
    # Room for the labels beside the longest bar.
    panel = Panel(figure, box, Scale(0.0, 1.55 * top), Scale(len(names) - 0.5, -0.5))
    panel.x_axis("sigma of the point's place [mm]", 4)
    panel.y_axis("", [(float(row), word) for row, word in enumerate(words)], grid=False)
    for row, (value, label) in enumerate(zip(values, labels, strict=True)):
        end, high = float(panel.x_at(value)), panel.y_at([row + 0.3, row - 0.3]).tolist()
        bar = f"M{box.left:.1f} {high[0]:.1f}V{high[1]:.1f}H{end:.1f}V{high[0]:.1f}z"
        colour = svg.INK if names[row] == "total" else svg.ACCENT
        figure.path(bar, fill=colour, opacity=0.9)
        figure.text(end + 4.0, 0.5 * sum(high), label, size=svg.SMALL, rise="middle")
    return figure.inline("Bars: standard deviation by source")


def directions(found: UncertaintyResult) -> Markup:
    """Standard deviations of both edges along their principal directions, against the limit."""
    values = found.spectrum[found.spectrum > 0.0]
    if not len(values):
        return Markup("")
    low, high = min(1e-2, 0.5 * float(values.min())), max(2.5, 1.5 * float(values.max()))
    figure = Figure(_WIDTH_IN, 1.0)
    ((box,),) = boxes(figure, 1, 1, Margins(left=0.15))
    panel = Panel(figure, box, Scale(low, high, decades=True), Scale(-1.0, 1.0))
    panel.x_axis("sigma / largest accepted", 8)
    panel.marks(values, np.zeros(len(values)), "|", svg.ACCENT, 18.0)
    panel.post(1.0, svg.BAD, 1.4)
    at = float(panel.x_at(1.0)) + 4.0
    figure.text(at, box.top + 9.0, "limit", size=svg.SMALL, colour=svg.BAD)
    return figure.inline("Sigmas of the directions, and the limit")


def board_shape(board: BoardResult, target: Target, name: str = "") -> Markup:
    """How far each place of a board lies behind its mean plane; empty for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    reach = float(np.abs(depth_mm).max())
    if not board.is_bent or reach < _LEAST_DEPTH_MM:
        return Markup("")
    (left, right), (above, below) = ((value.min(), value.max()) for value in (x_mm, y_mm))
    share = (below - above) / (right - left)
    figure = Figure(_WIDTH_IN, 0.7 + 0.75 * _WIDTH_IN * min(share, _TALLEST))
    ((box,),) = boxes(figure, 1, 1, Margins(right=0.85))
    # Wider by half a cell at each side: a cell lies about its place.
    columns = _CELLS
    rows = max(round(columns * share), 2)
    x, y = np.linspace(left, right, columns), np.linspace(above, below, rows)
    half_x, half_y = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    panel = Panel(
        figure,
        box.shaped((below - above + 2.0 * half_y) / (right - left + 2.0 * half_x)),
        Scale(left - half_x, right + half_x),
        Scale(below + half_y, above - half_y),
    )
    panel.x_axis("target x [mm]", grid=False)
    panel.y_axis("target y [mm]", 5, grid=False)
    depths = _between(x_mm, y_mm, depth_mm, *np.meshgrid(x, y))
    steps, colours = svg.shades(depths.ravel(), -reach, reach, svg.COOLWARM, _LEVELS)
    _draw_map(panel, steps.reshape(depths.shape), colours)
    panel.marks(x_mm, y_mm, "dot", "#202020", 1.4)
    panel.colour_bar(Scale(-reach, reach), svg.COOLWARM, "depth [mm]")
    return figure.inline(f"Depth of the board {name}".strip() + " over its plane")


def _between(
    x: FloatArray, y: FloatArray, depth: FloatArray, to_x: FloatArray, to_y: FloatArray
) -> FloatArray:
    """Depths between the corners: a bent board's is a polynomial of the third degree."""
    terms = [(a, b) for a in range(4) for b in range(4 - a)]
    centre, size = np.array([x.mean(), y.mean()]), max(np.ptp(x), np.ptp(y))

    def powers(u: FloatArray, v: FloatArray) -> FloatArray:
        u, v = (u - centre[0]) / size, (v - centre[1]) / size
        return np.stack([u**a * v**b for a, b in terms], axis=-1)

    found = np.linalg.lstsq(powers(x, y), depth, rcond=None)[0]
    return np.asarray(powers(to_x, to_y) @ found)


def _draw_map(panel: Panel, steps: IntArray, colours: Sequence[str]) -> None:
    """Fills cells, those side by side of one colour as one."""
    box, (rows, columns) = panel.box, steps.shape
    wide, high = (box.right - box.left) / columns, (box.bottom - box.top) / rows
    data: dict[str, list[str]] = {colour: [] for colour in colours}
    for row in range(rows):
        ends = [*np.flatnonzero(np.diff(steps[row])) + 1, columns]
        for first, last in zip([0, *ends], ends, strict=False):
            # A little larger, that nothing shows through between them.
            size = f"h{(last - first) * wide + 0.2:.2f}v{high + 0.2:.2f}H"
            start = f"{box.left + first * wide:.2f}"
            part = f"M{start} {box.top + row * high:.2f}{size}{start}z"
            data[colours[steps[row, first]]].append(part)
    for colour, parts in data.items():
        panel.figure.path("".join(parts), fill=colour)

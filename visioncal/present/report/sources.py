"""Plots of the uncertainty: sources, directions, and the board's shape."""

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
# Number of colours, and of cells across the map of a board.
_LEVELS, _CELLS = 13, 96
# Largest height over width of a map.
_TALLEST = 0.8
# Smaller depths are rounding errors.
_LEAST_DEPTH_MM = 1e-6


def budget(uncertainty: UncertaintyResult) -> Markup:
    """Standard deviation by source, of a point where the views look."""
    names = [*uncertainty.parts_mm, "total"]
    values = [*uncertainty.parts_mm.values(), uncertainty.total_mm]
    labels = [
        f"{significant(value)} ({uncertainty.percent(name)})"
        for name, value in uncertainty.parts_mm.items()
    ]
    labels.append(significant(uncertainty.total_mm))
    top = max(values) or 1.0
    names_shown = [SOURCES.get(name, name) for name in names]
    figure = Figure(_WIDTH_IN, 0.32 * len(names) + 0.6)
    margins = Margins(0.2 + _LETTER_IN * max(map(len, names_shown)))
    ((box,),) = boxes(figure, 1, 1, margins)
    # Room for the labels beside the longest bar.
    panel = Panel(figure, box, Scale(0.0, 1.55 * top), Scale(len(names) - 0.5, -0.5))
    panel.x_axis("sigma of the point's place [mm]", 4)
    panel.y_axis("", [(float(row), word) for row, word in enumerate(names_shown)], grid=False)
    for row, (value, label) in enumerate(zip(values, labels, strict=True)):
        end, y = float(panel.x_at(value)), panel.y_at([row + 0.3, row - 0.3]).tolist()
        bar = f"M{box.left:.1f} {y[0]:.1f}V{y[1]:.1f}H{end:.1f}V{y[0]:.1f}z"
        colour = svg.INK if names[row] == "total" else svg.ACCENT
        figure.path(bar, fill=colour, opacity=0.9)
        figure.text(end + 4.0, 0.5 * sum(y), label, size=svg.SMALL, rise="middle")
    return figure.inline("Bars: standard deviation by source")


def directions(uncertainty: UncertaintyResult) -> Markup:
    """Standard deviations of the edges' principal directions, relative to the limit."""
    values = uncertainty.spectrum[uncertainty.spectrum > 0.0]
    if not len(values):
        return Markup("")
    low, high = min(1e-2, 0.5 * float(values.min())), max(2.5, 1.5 * float(values.max()))
    figure = Figure(_WIDTH_IN, 1.0)
    ((box,),) = boxes(figure, 1, 1, Margins(left=0.15))
    panel = Panel(figure, box, Scale(low, high, decades=True), Scale(-1.0, 1.0))
    panel.x_axis("sigma / largest accepted", 8)
    panel.marks(values, np.zeros(len(values)), "|", svg.ACCENT, 18.0)
    panel.post(1.0, svg.BAD, 1.4)
    label_x = float(panel.x_at(1.0)) + 4.0
    figure.text(label_x, box.top + 9.0, "limit", size=svg.SMALL, colour=svg.BAD)
    return figure.inline("Sigmas of the directions, and the limit")


def board_shape(board: BoardResult, target: Target, name: str = "") -> Markup:
    """Depth of a board behind its mean plane; empty for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    max_depth_mm = float(np.abs(depth_mm).max())
    if not board.is_bent or max_depth_mm < _LEAST_DEPTH_MM:
        return Markup("")
    (left, right), (above, below) = ((value.min(), value.max()) for value in (x_mm, y_mm))
    share = (below - above) / (right - left)
    figure = Figure(_WIDTH_IN, 0.7 + 0.75 * _WIDTH_IN * min(share, _TALLEST))
    ((box,),) = boxes(figure, 1, 1, Margins(right=0.85))
    # Half a cell wider at each side: cells are centred at their points.
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
    depths = _interpolate(x_mm, y_mm, depth_mm, *np.meshgrid(x, y))
    steps, colours = svg.shades(depths.ravel(), -max_depth_mm, max_depth_mm, svg.COOLWARM, _LEVELS)
    _draw_map(panel, steps.reshape(depths.shape), colours)
    panel.marks(x_mm, y_mm, "dot", "#202020", 1.4)
    panel.colour_bar(Scale(-max_depth_mm, max_depth_mm), svg.COOLWARM, "depth [mm]")
    return figure.inline(f"Depth of the board {name}".strip() + " over its plane")


def _interpolate(
    x: FloatArray, y: FloatArray, depth: FloatArray, query_x: FloatArray, query_y: FloatArray
) -> FloatArray:
    """Interpolates depths with a cubic polynomial, the shape of a bent board."""
    terms = [(a, b) for a in range(4) for b in range(4 - a)]
    centre, size = np.array([x.mean(), y.mean()]), max(np.ptp(x), np.ptp(y))

    def powers(u: FloatArray, v: FloatArray) -> FloatArray:
        u, v = (u - centre[0]) / size, (v - centre[1]) / size
        return np.stack([u**a * v**b for a, b in terms], axis=-1)

    coefficients = np.linalg.lstsq(powers(x, y), depth, rcond=None)[0]
    return np.asarray(powers(query_x, query_y) @ coefficients)


def _draw_map(panel: Panel, steps: IntArray, colours: Sequence[str]) -> None:
    """Fills cells, adjacent ones of one colour as one rectangle."""
    box, (rows, columns) = panel.box, steps.shape
    width, height = (box.right - box.left) / columns, (box.bottom - box.top) / rows
    data: dict[str, list[str]] = {colour: [] for colour in colours}
    for row in range(rows):
        ends = [*np.flatnonzero(np.diff(steps[row])) + 1, columns]
        for first, last in zip([0, *ends], ends, strict=False):
            # Slightly overlapping, so that no gaps show.
            size = f"h{(last - first) * width + 0.2:.2f}v{height + 0.2:.2f}H"
            start = f"{box.left + first * width:.2f}"
            part = f"M{start} {box.top + row * height:.2f}{size}{start}z"
            data[colours[steps[row, first]]].append(part)
    for colour, parts in data.items():
        panel.figure.path("".join(parts), fill=colour)

"""Plots of the uncertainty: sources, directions, and the board's shape."""

import numpy as np
from matplotlib.figure import Figure

from visioncal.core.number_format import significant
from visioncal.core.types import Target
from visioncal.present.facts import SOURCES
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    INK,
    MIDDLE_IN,
    SMALL,
    colour_bar,
    drawn,
    few_ticks,
    logarithmic,
    panels,
)
from visioncal.results.sections import BoardResult, UncertaintyResult

# Smaller depths are rounding errors.
_LEAST_DEPTH_MM = 1e-6


@drawn
def budget(uncertainty: UncertaintyResult) -> tuple[Figure, str]:
    """Standard deviation by source, of a point where the views look."""
    parts = uncertainty.parts_mm
    labels = [f"{significant(mm)} ({uncertainty.percent(name)})" for name, mm in parts.items()]
    labels.append(significant(uncertainty.total_mm))
    values = [*parts.values(), uncertainty.total_mm]
    names = [*(SOURCES.get(name, name) for name in parts), "total"]
    figure, ((axes,),) = panels(MIDDLE_IN, 0.32 * len(names) + 0.6)
    colours = [ACCENT] * len(parts) + [INK]
    bars = axes.barh(range(len(names)), values, 0.6, color=colours, alpha=0.9)
    axes.bar_label(bars, labels, padding=4.0, fontsize=SMALL)
    # Room for the labels beside the longest bar.
    axes.set(xlim=(0.0, 1.55 * max(values) or 1.0), ylim=(len(names) - 0.5, -0.5))
    axes.set_yticks(range(len(names)), names)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("sigma of the point's place [mm]")
    few_ticks(axes, 4)
    return figure, "Bars: standard deviation by source"


@drawn
def directions(uncertainty: UncertaintyResult) -> tuple[Figure, str] | None:
    """Standard deviations of the edges' principal directions, relative to the limit."""
    values = uncertainty.spectrum[uncertainty.spectrum > 0.0]
    if not len(values):
        return None
    low, high = min(1e-2, 0.5 * float(values.min())), max(2.5, 1.5 * float(values.max()))
    figure, ((axes,),) = panels(MIDDLE_IN, 1.0)
    logarithmic(axes.xaxis)
    axes.set(xlim=(low, high), ylim=(-1.0, 1.0), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("sigma / largest accepted")
    axes.plot(values, np.zeros(len(values)), "|", color=ACCENT, markersize=18.0)
    axes.axvline(1.0, color=BAD, linewidth=1.4)
    axes.annotate("limit", (1.0, 0.6), xytext=(4.0, 0.0), textcoords="offset points",
                  fontsize=SMALL, color=BAD)  # fmt: skip
    return figure, "Sigmas of the directions, and the limit"


@drawn
def board_shape(board: BoardResult, target: Target, name: str = "") -> tuple[Figure, str] | None:
    """Depth of a board behind its mean plane; None for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    reach = float(np.abs(depth_mm).max())
    if not board.is_bent or reach < _LEAST_DEPTH_MM:
        return None
    figure, ((axes,),) = panels(MIDDLE_IN, 0.7 * MIDDLE_IN)
    levels = np.linspace(-reach, reach, 14)
    shown = axes.tricontourf(x_mm, y_mm, depth_mm, levels, cmap="coolwarm")
    axes.plot(x_mm, y_mm, "o", color="#202020", markersize=1.4)
    # y points down on the printed page.
    axes.invert_yaxis()
    axes.set(xlabel="target x [mm]", ylabel="target y [mm]", aspect="equal")
    axes.grid(visible=False)
    colour_bar(axes, shown, "depth [mm]")
    return figure, f"Depth of the board {name}".strip() + " over its plane"

"""Plots of what makes a result uncertain: sources, directions, and the board's shape."""

import numpy as np
from markupsafe import Markup
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from matplotlib.tri import Triangulation, UniformTriRefiner

from visioncal.core.number_format import significant
from visioncal.core.types import Target
from visioncal.present.recording.words import SOURCES
from visioncal.present.report import svg
from visioncal.results.sections import BoardResult, UncertaintyResult

_WIDTH_IN = 5.0
# Mean width of a letter, rounded up.
_LETTER_IN = 0.068
_LEVELS, _FINER = 13, 3
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
    with svg.style():
        words = [SOURCES.get(it, it) for it in names]
        margins = svg.Margins(0.2 + _LETTER_IN * max(map(len, words)))
        figure = svg.new_figure(_WIDTH_IN, 0.32 * len(names) + 0.6, margins)
        axes = figure.subplots()
        colours = [svg.ACCENT] * len(found.parts_mm) + [svg.INK]
        axes.barh(range(len(names)), values, height=0.6, color=colours, alpha=0.9)
        for row, (value, label) in enumerate(zip(values, labels, strict=True)):
            axes.annotate(
                label, (value, row), (4, 0), textcoords="offset points", fontsize=8, va="center"
            )
        axes.set_yticks(range(len(names)), words)
        axes.set_ylim(len(names) - 0.5, -0.5)
        # Room for the labels beside the longest bar.
        axes.set_xlim(0.0, 1.55 * top)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("sigma of the point's place [mm]")
        return svg.inline(figure, "budget", "Bars: standard deviation by source")


def directions(found: UncertaintyResult) -> Markup:
    """Standard deviations of both edges along their principal directions, against the limit."""
    values = found.spectrum[found.spectrum > 0.0]
    if not len(values):
        return Markup("")
    with svg.style():
        figure = svg.new_figure(_WIDTH_IN, 1.0, svg.Margins(left=0.15))
        axes = figure.subplots()
        axes.plot(values, np.zeros(len(values)), "|", color=svg.ACCENT, markersize=18,
                  markeredgewidth=1.6)  # fmt: skip
        axes.axvline(1.0, color=svg.BAD, linewidth=1.4)
        axes.annotate(
            "limit", (1.0, 1.0), (4, -9), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8, color=svg.BAD,
        )  # fmt: skip
        axes.set_xscale("log")
        axes.set_xlim(min(1e-2, 0.5 * float(values.min())), max(2.5, 1.5 * float(values.max())))
        axes.set_ylim(-1.0, 1.0)
        axes.yaxis.set_major_locator(NullLocator())
        axes.xaxis.set_major_locator(LogLocator(numticks=8))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.spines["left"].set_visible(False)
        axes.set_xlabel("sigma / largest accepted")
        return svg.inline(
            figure,
            "spectrum",
            "Sigmas of the directions, and the limit",
        )


def board_shape(board: BoardResult, target: Target, name: str = "") -> Markup:
    """How far each place of a board lies behind its mean plane; empty for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    reach = float(np.abs(depth_mm).max())
    if not board.is_bent or reach < _LEAST_DEPTH_MM:
        return Markup("")
    width, height = np.ptp(x_mm), np.ptp(y_mm)
    with svg.style():
        figure = svg.new_figure(_WIDTH_IN, 0.7 + 0.75 * _WIDTH_IN * min(height / width, _TALLEST))
        axes = figure.subplots()
        levels = np.linspace(-reach, reach, _LEVELS)
        finer, smooth_mm = UniformTriRefiner(Triangulation(x_mm, y_mm)).refine_field(
            depth_mm, subdiv=_FINER
        )
        smooth_mm = np.clip(smooth_mm, -reach, reach)
        filled = axes.tricontourf(finer, smooth_mm, levels, cmap="coolwarm")
        axes.plot(x_mm, y_mm, ".", color="#202020", markersize=2.0, clip_on=False)
        bar = figure.colorbar(filled, ax=axes, shrink=0.85)
        bar.locator = MaxNLocator(5)
        bar.update_ticks()
        bar.set_label("depth [mm]")
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.grid(visible=False)
        axes.set_xlabel("target x [mm]")
        axes.set_ylabel("target y [mm]")
        slug = f"board_{name}".removesuffix("_")
        return svg.inline(figure, slug, f"Depth of the board {name}".strip() + " over its plane")

"""Figures by matplotlib as inline SVG, with real text and the colours of the page's theme."""

import io
import re
from collections.abc import Callable, Sequence
from functools import wraps
from threading import Lock
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter

from visioncal.core.types import FloatArray

# The page's colours for light screens; in the SVG they are its variables, which dark screens and
# print define otherwise.
INK, MUTED, LINE = "#1c2733", "#5c6b7a", "#cfd6dd"
ACCENT, GOOD, BAD, CHECK, CARD = "#1f6fb2", "#2e7d32", "#c62828", "#b26a00", "#fefefe"
_VARIABLES = {
    INK: "ink", MUTED: "muted", LINE: "line", ACCENT: "accent", GOOD: "good", BAD: "bad",
    CHECK: "check", CARD: "card",
}  # fmt: skip
SMALL = 8.0  # Size of small text [pt].
# Widths at which the text of a figure matches the page's [inches].
WIDE_IN, MIDDLE_IN = 9.2, 5.0
_STYLE: Any = {
    "svg.fonttype": "none", "font.family": "sans-serif",
    "font.size": 9.0, "axes.titlesize": 9.0, "axes.labelsize": 9.0, "legend.fontsize": SMALL,
    "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": LINE, "xtick.color": LINE,
    "ytick.color": LINE, "xtick.labelcolor": MUTED, "ytick.labelcolor": MUTED, "grid.color": LINE,
    "grid.linewidth": 0.6, "axes.grid": True, "axes.axisbelow": True, "axes.spines.top": False,
    "axes.spines.right": False, "legend.frameon": False, "figure.dpi": 72.0,
    "figure.facecolor": "none", "axes.facecolor": "none",
    "axes.xmargin": 0.06, "axes.ymargin": 0.06, "image.cmap": "plasma",
    "text.parse_math": False, "axes.formatter.useoffset": False,
}  # fmt: skip
# matplotlib's settings belong to the process, and threads may write reports at once.
_LOCK = Lock()
_Given = ParamSpec("_Given")


def drawn(draw: Callable[_Given, tuple[Figure, str] | None]) -> Callable[_Given, Markup]:
    """Decorates a function that returns a figure and its description, or None for no figure.

    The result is an `<svg>` element that scales with its container; empty without a figure.
    """

    @wraps(draw)
    def inline(*args: _Given.args, **kwargs: _Given.kwargs) -> Markup:
        # A matplotlibrc in the current folder may name programs, such as LaTeX, and change figures.
        with _LOCK, mpl.rc_context():
            mpl.rcdefaults()
            mpl.rcParams.update(_STYLE)
            done = draw(*args, **kwargs)
            return Markup("") if done is None else _svg(*done)

    return inline


def _svg(figure: Figure, words: str) -> Markup:
    buffer = io.StringIO()
    figure.set_dpi(144.0)
    # Identifiers come from content and salt: the same everywhere, and other ones in each figure.
    mpl.rcParams["svg.hashsalt"] = words
    # `Figure.savefig` would draw twice.
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # Numbered names of groups would be there once a figure; none is referred to.
    text = re.sub(r' id="[a-zA-Z0-9.]+_[0-9]+"|<metadata>.*?</metadata>', "", text, flags=re.S)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    opening = f'<svg role="img" aria-label="{escape(words)}"'
    text = re.sub(r'<svg((?: (?!height)[^>]*?)?) height="[^"]*"', rf"{opening}\1", text, count=1)
    for colour, name in _VARIABLES.items():
        text = text.replace(colour, f"var(--{name})")
    # matplotlib escapes all texts.
    return Markup(text)


def panels(
    width_in: float,
    height_in: float,
    rows: int = 1,
    columns: int = 1,
    margins_in: tuple[float, float, float, float] = (0.8, 0.45, 0.06, 0.06),
    **options: Any,  # noqa: ANN401 - see there
) -> tuple[Figure, np.ndarray]:
    """A figure and its (rows, columns) axes; `options` are those of `Figure.subplots`.

    The margins are left, bottom, right and top: matplotlib's own layout takes as long as drawing.
    """
    figure = Figure((width_in, height_in))
    left, bottom, right, top = np.array(margins_in) / (2 * [width_in, height_in])
    figure.subplots_adjust(left, bottom, 1.0 - right, 1.0 - top, wspace=0.12, hspace=0.16)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def scattered(axes: Axes, xy: FloatArray, values: FloatArray, **options: Any) -> PathCollection:  # noqa: ANN401
    """Draws (n, 2) points coloured by (n,) values, with options of `Axes.scatter`.

    Many of them become a bitmap.
    """
    # Above this number of marks a bitmap is smaller than vectors.
    many = len(xy) > 2500
    return axes.scatter(xy[:, 0], xy[:, 1], c=values, linewidths=0.0, rasterized=many, **options)


def colour_bar(axes: Axes, shown: ScalarMappable, title: str) -> None:
    """Draws the colour scale of what was drawn beside its axes."""
    bar = axes.figure.colorbar(shown, ax=axes, shrink=0.8, aspect=16.0, label=title)
    bar.outline.set_visible(False)


def legend(figure: Figure, entries: Sequence[tuple[str, str, str]]) -> None:
    """A legend above all axes, of (sign, colour, text); signs are markers, `line` and `ring`."""
    shapes: dict[str, dict[str, Any]] = {
        "line": {"linestyle": "-"}, "ring": {"marker": "o", "fillstyle": "none"}
    }  # fmt: skip
    handles = [
        Line2D([], [], color=colour, label=words, markersize=5.0,
               **{"linestyle": ""} | shapes.get(sign, {"marker": sign}))
        for sign, colour, words in entries
    ]  # fmt: skip
    figure.legend(handles=handles, loc="upper right", ncols=len(handles), handletextpad=0.3,
                  columnspacing=1.2, borderaxespad=0.0)  # fmt: skip


def right_label(axes: Axes, y: float, words: str, colour: str = INK, rise: str = "center") -> None:
    """Writes words to the right of the axes, at a value."""
    axes.annotate(words, (1.0, y), xytext=(5.0, 0.0), xycoords=("axes fraction", "data"),
                  textcoords="offset points", fontsize=SMALL, color=colour, va=rise,
                  annotation_clip=False)  # fmt: skip


def logarithmic(axis: Axis) -> None:
    """Makes an axis logarithmic, with plain numbers at its ticks."""
    is_x = isinstance(axis, XAxis)
    axis.axes.set(**{"xscale" if is_x else "yscale": "log"})
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def few_ticks(axes: Axes, x: int | None = None, y: int | None = None) -> None:
    """Limits the number of steps between ticks."""
    for axis, count in ((axes.xaxis, x), (axes.yaxis, y)):
        if count is not None:
            axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))

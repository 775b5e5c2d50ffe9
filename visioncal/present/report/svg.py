"""Figures as inline SVG whose text stays text and whose colours follow the page's theme."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from markupsafe import Markup, escape
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.typing import RcKeyType

from visioncal.core.threads import DRAWING

# Drawn with these stand-ins, figures get the page's own colours, in light, dark and print alike.
INK, MUTED, LINE = "#010101", "#020202", "#030303"
ACCENT, GOOD, BAD, CHECK = "#040404", "#050505", "#060606", "#070707"
CARD = "#080808"
_THEME = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    LINE: "var(--line)",
    ACCENT: "var(--accent)",
    GOOD: "var(--good)",
    BAD: "var(--bad)",
    CHECK: "var(--check)",
    CARD: "var(--card)",
}

_STYLE: dict[RcKeyType, Any] = {
    "svg.fonttype": "none",
    "path.simplify": False,
    "lines.solid_capstyle": "butt",
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "axes.edgecolor": LINE,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": LINE,
    "ytick.color": LINE,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}
_NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


@contextmanager
def style() -> Iterator[None]:
    """Applies the report's style while figures are drawn, by one thread at a time."""
    with DRAWING, mpl.rc_context(_STYLE):
        yield


@dataclass(frozen=True)
class Margins:
    """Room around a figure's axes for their labels [inches]."""

    left: float = 0.62
    right: float = 0.1
    bottom: float = 0.5
    top: float = 0.1


def new_figure(width_in: float, height_in: float, margins: Margins | None = None) -> Figure:
    """A figure of its own, known to no global registry.

    Args:
        width_in: Its width [inches].
        height_in: Likewise.
        margins: Where its labels are as large as is known beforehand; they are measured where None,
            which takes as long as drawing it.
    """
    if margins is None:
        return Figure(figsize=(width_in, height_in), layout="constrained")
    figure = Figure(figsize=(width_in, height_in))
    figure.subplots_adjust(
        margins.left / width_in,
        margins.bottom / height_in,
        1.0 - margins.right / width_in,
        1.0 - margins.top / height_in,
    )
    return figure


def inline(figure: Figure, name: str, words: str) -> Markup:
    """Renders a figure as an `<svg>` element for an HTML page.

    Args:
        figure: What to draw.
        name: Unique within the page; it keeps the identifiers of its figures apart.
        words: What it shows, for those who do not see it.

    Returns:
        The element, scaling with its container.
    """
    buffer = io.StringIO()
    with DRAWING, mpl.rc_context({"svg.hashsalt": name}):
        # What `savefig` calls, without the drawing that it measures constrained layouts by.
        canvas = FigureCanvasSVG(figure)
        canvas.print_svg(buffer, metadata=_NO_METADATA)  # type: ignore[no-untyped-call]
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # HTML needs no namespaces, and groups would repeat their identifiers in every figure.
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = re.sub(r"<style[^>]*>.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*" height="[^"]*"', r"\1", text, count=1)
    text = text.replace("<svg", f'<svg role="img" aria-label="{escape(words)}"', 1)
    text = text.replace("'DejaVu Sans'", "inherit")
    for stand_in, variable in _THEME.items():
        text = text.replace(stand_in, variable)
    # The text comes from our own numbers and labels, which the backend has escaped.
    return Markup(text)

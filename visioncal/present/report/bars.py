"""Bars of residuals, one for each view or observation, with the marks of those not used."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.ticker import MaxNLocator

from visioncal.core.number_format import significant
from visioncal.present.report import svg

_ROOM, _WIDTH = 1.25, 0.7


@dataclass(frozen=True)
class Bar:
    """One of them.

    Attributes:
        label: What it is, for the axis.
        value: Its height; None where that is unknown.
        used: Whether it was used; the scale is that of the used ones.
        colour: Of the bar and its mark.
    """

    label: str
    value: float | None
    used: bool
    colour: str


def draw(
    axes: Axes,
    bars: Sequence[Bar],
    rms: float | None,
    most_labels: int = 25,
    limit: float | None = None,
) -> None:
    """Draws bars side by side; what exceeds the used ones' scale is clipped.

    Args:
        axes: Where to.
        bars: From left to right.
        rms: Root mean square over the used ones, drawn as a line; None draws none.
        most_labels: How many labels have room below them.
        limit: Where doubt begins; a line where the scale holds it, else words. None for nothing.
    """
    known = [(place, bar, bar.value) for place, bar in enumerate(bars) if bar.value is not None]
    unknown = [it for it in enumerate(bars) if it[1].value is None and not it[1].used]
    used = [value for _, bar, value in known if bar.used]
    top = _ROOM * max(used or [value for _, _, value in known], default=1.0) or 1.0
    if known:
        places, shown, values = zip(*known, strict=True)
        colours = [bar.colour for bar in shown]
        # One shape for all: a thousand rectangles take a second to be made.
        heights, half = np.minimum(values, top), _WIDTH / 2
        corners = [
            [(at - half, 0.0), (at - half, it), (at + half, it), (at + half, 0.0)]
            for at, it in zip(places, heights.tolist(), strict=True)
        ]
        axes.add_collection(PolyCollection(corners, facecolors=colours, alpha=0.9))
    for place, bar, value in known:
        if not bar.used:
            _mark(axes, place, bar, value, top)
    for place, bar in unknown:
        axes.plot(place, 0.05 * top, "x", color=bar.colour, markersize=5)
    if rms is not None:
        axes.axhline(rms, color=svg.INK, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.annotate(
            f"rms {significant(rms)}", (1.0, rms), (4, 0), xycoords=("axes fraction", "data"),
            textcoords="offset points", fontsize=8, va="center",
        )  # fmt: skip
    if limit is not None:
        _draw_limit(axes, limit, top)
    axes.set_ylim(0.0, top * 1.2)
    axes.set_xlim(-0.7, len(bars) - 0.3)
    axes.grid(visible=False, axis="x")
    axes.yaxis.set_major_locator(MaxNLocator(4))
    step = max(1, -(-len(bars) // most_labels))
    labelled = range(0, len(bars), step)
    axes.set_xticks(list(labelled), [bars[place].label for place in labelled])


def _draw_limit(axes: Axes, limit: float, top: float) -> None:
    words, place = f"doubt from {limit:g}", (1.0, 1.0)
    if limit < top * 1.1:
        axes.axhline(limit, color=svg.BAD, linewidth=0.9, linestyle=(0, (1, 2)))
        axes.annotate(
            words, (0.0, limit), (4, 2), xycoords=("axes fraction", "data"),
            textcoords="offset points", fontsize=8, color=svg.BAD,
        )  # fmt: skip
        return
    axes.annotate(
        f"{words} \N{UPWARDS ARROW}", place, (0, -2), xycoords="axes fraction",
        textcoords="offset points", fontsize=8, ha="right", va="top", color=svg.MUTED,
    )  # fmt: skip


def _mark(axes: Axes, place: int, bar: Bar, value: float, top: float) -> None:
    """Marks one that was not used, with its value where that lies beyond the scale."""
    clipped = value > top
    axes.plot(place, min(value, top), "^" if clipped else "x", color=bar.colour, markersize=5)
    if clipped:
        axes.annotate(
            significant(value), (place, top), (0, 5), textcoords="offset points",
            fontsize=8, color=bar.colour, ha="center",
        )  # fmt: skip

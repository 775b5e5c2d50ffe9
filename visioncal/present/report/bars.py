"""Bars of residuals, one for each view or observation, with the marks of those not used."""

from collections.abc import Sequence
from dataclasses import dataclass

from visioncal.core.number_format import significant
from visioncal.present.report import svg
from visioncal.present.report.axes import Box, Panel, Scale
from visioncal.present.report.svg import Figure

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
    figure: Figure,
    box: Box,
    bars: Sequence[Bar],
    rms: float | None,
    most_labels: int = 25,
    limit: float | None = None,
    *,
    titles: tuple[str, str] = ("", ""),
    labelled: bool = True,
    turned: bool = False,
) -> None:
    """Draws bars side by side; what exceeds the used ones' scale is clipped.

    Args:
        figure: Where to.
        box: Where in it.
        bars: From left to right.
        rms: Root mean square over the used ones, drawn as a line; None draws none.
        most_labels: How many labels have room below them.
        limit: Where doubt begins; a line where the scale holds it, else words. None for nothing.
        titles: Of the axis below and of that at the left.
        labelled: Whether bars have labels.
        turned: Whether these stand upright.
    """
    known = [(place, bar, bar.value) for place, bar in enumerate(bars) if bar.value is not None]
    used = [value for _, bar, value in known if bar.used]
    top = _ROOM * max(used or [value for _, _, value in known], default=1.0) or 1.0
    panel = Panel(figure, box, Scale(-0.7, len(bars) - 0.3), Scale(0.0, 1.2 * top))
    step = max(1, -(-len(bars) // most_labels))
    ticks = [(float(place), bars[place].label) for place in range(0, len(bars), step)]
    panel.x_axis(titles[0], ticks, grid=False, words=labelled, turned=turned)
    panel.y_axis(titles[1])
    for colour in dict.fromkeys(bar.colour for _, bar, _ in known):
        shown = [(place, value) for place, bar, value in known if bar.colour == colour]
        panel.bars(
            [index for index, _ in shown], [min(value, top) for _, value in shown], _WIDTH, colour
        )
    for place, bar, value in known:
        if not bar.used:
            _mark(panel, place, bar, value, top)
    for place, bar in enumerate(bars):
        if bar.value is None and not bar.used:
            panel.marks([place], [0.05 * top], "x", bar.colour, 5.0)
    if rms is not None:
        panel.level(rms, svg.INK, dash=svg.DASHED)
        words, at = f"rms {significant(rms)}", float(panel.y_at(rms))
        figure.text(box.right + 4.0, at, words, size=svg.SMALL, rise="middle")
    if limit is not None:
        _draw_limit(panel, limit, top)


def _draw_limit(panel: Panel, limit: float, top: float) -> None:
    words, box = f"doubt from {limit:g}", panel.box
    if limit < top * 1.1:
        panel.level(limit, svg.BAD, dash=svg.DOTTED)
        above = float(panel.y_at(limit)) - 2.0
        panel.figure.text(box.left + 4.0, above, words, size=svg.SMALL, colour=svg.BAD)
        return
    panel.figure.text(
        box.right, box.top + 2.0, f"{words} \N{UPWARDS ARROW}", size=svg.SMALL, colour=svg.MUTED,
        anchor="end", rise="top",
    )  # fmt: skip


def _mark(panel: Panel, place: int, bar: Bar, value: float, top: float) -> None:
    """Marks one that was not used, with its value where that lies beyond the scale."""
    clipped = value > top
    panel.marks([place], [min(value, top)], "^" if clipped else "x", bar.colour, 5.0)
    if clipped:
        x, y = float(panel.x_at(place)), float(panel.y_at(top)) - 5.0
        panel.figure.text(x, y, significant(value), size=svg.SMALL, colour=bar.colour,
                          anchor="middle")  # fmt: skip

"""Axes of the report's figures: scales, ticks, panels and marks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.present.report import svg
from visioncal.present.report.svg import Figure

Places: TypeAlias = Sequence[float] | FloatArray

_THIN, _TICK_PT, _GAP_PT = 0.6, 3.0, 2.5
_STEPS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_MOST_DECIMALS = 6
# Free room at both ends, as a share of a scale's span.
_ROOM = 0.05
# Height of a colour bar as a share of its panel's, its width and distance [points], and steps.
_BAR_SHARE, _BAR_PT, _BAR_GAP_PT, _BAR_STEPS = 0.85, 9.0, 9.0, 48


@dataclass(frozen=True)
class Scale:
    """Values along an axis, from its start at the left or at the bottom.

    Attributes:
        low: Value at the start; larger than `high` if the axis is reversed.
        high: Value at the end.
        decades: Whether it is logarithmic.
    """

    low: float
    high: float
    decades: bool = False

    def shares(self, values: Places | float) -> FloatArray:
        """Positions of values, from 0 to 1."""
        positions = np.asarray(values, dtype=float)
        low, high = self.low, self.high
        if self.decades:
            positions, low, high = np.log10(positions), math.log10(low), math.log10(high)
        return np.asarray((positions - low) / ((high - low) or 1.0))

    def ticks(self, most: int, whole: bool = False) -> list[float]:
        """Round values along the axis, in at most `most` steps."""
        low, high = min(self.low, self.high), max(self.low, self.high)
        if self.decades:
            return _decades(low, high, most)
        if not high > low:
            return [low]
        exponent = math.floor(math.log10((high - low) / most))
        for step in (step * 10.0**power for power in (exponent, exponent + 1) for step in _STEPS):
            if whole and step != round(step):
                continue
            first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
            if (high - low) / step <= most + 1e-6:
                # Rounded: three steps of 0.1 add up to 0.30000000000000004.
                return [round(index * step, 12) for index in range(first, last + 1)]
        return [low, high]


def spanning(values: FloatArray) -> Scale:
    """A scale that holds the values with room at both ends; NaN are ignored."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    spare = _ROOM * (high - low) or 0.5
    return Scale(low - spare, high + spare)


def _decades(low: float, high: float, most: int) -> list[float]:
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    step = max(1, -(-(last - first) // most))
    # Intermediate values, where few powers of ten lie inside.
    for digits in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)):
        candidates = [
            digit * 10.0**power for power in range(first, last + 1, step) for digit in digits
        ]
        inside = [value for value in candidates if low <= value <= high]
        if len(inside) > 1:
            break
    return inside


def tick_words(values: Sequence[float]) -> list[str]:
    """Tick labels with the decimals that they need."""
    for decimals in range(_MOST_DECIMALS + 1):
        if all(math.isclose(round(value, decimals), value, abs_tol=1e-12) for value in values):
            texts = [f"{value:.{decimals}f}" for value in values]
            break
    else:
        texts = [f"{value:g}" for value in values]
    return [text.replace("-", "\N{MINUS SIGN}") for text in texts]


@dataclass(frozen=True)
class Margins:
    """Room around a figure's panels for their labels [inches]."""

    left: float = 0.62
    right: float = 0.1
    bottom: float = 0.5
    top: float = 0.1


@dataclass(frozen=True)
class Box:
    """A rectangle of a figure [points]."""

    left: float
    top: float
    right: float
    bottom: float

    def shaped(self, height_over_width: float) -> "Box":
        """The largest box of this shape in the upper left corner."""
        width, height = self.right - self.left, self.bottom - self.top
        width = min(width, height / height_over_width)
        return Box(self.left, self.top, self.left + width, self.top + width * height_over_width)


def boxes(
    figure: Figure,
    rows: int,
    columns: int,
    margins: Margins,
    gaps_in: tuple[float, float] = (0.15, 0.15),
    shares: Sequence[float] | None = None,
) -> list[list[Box]]:
    """Splits a figure into rows and columns of panels.

    `gaps_in` are between columns and between rows [inches]; `shares` are relative column widths.
    """
    left, top = 72.0 * margins.left, 72.0 * margins.top
    gap_x, gap_y = 72.0 * gaps_in[0], 72.0 * gaps_in[1]
    wide = figure.width - left - 72.0 * margins.right - gap_x * (columns - 1)
    high = (figure.height - top - 72.0 * margins.bottom - gap_y * (rows - 1)) / rows
    widths = wide * np.array(shares or [1.0] * columns) / sum(shares or [columns])
    starts = left + np.concatenate([[0.0], np.cumsum(widths + gap_x)[:-1]])
    return [
        [
            Box(float(start), y, float(start + width), y + high)
            for start, width in zip(starts, widths, strict=True)
        ]
        for y in (top + row * (high + gap_y) for row in range(rows))
    ]


class Panel:
    """A part of a figure with two scales."""

    def __init__(self, figure: Figure, box: Box, x: Scale, y: Scale) -> None:
        self.figure, self.box, self.x, self.y = figure, box, x, y

    def x_at(self, values: Places | float) -> FloatArray:
        """Horizontal positions of values in the figure [points]."""
        return self.box.left + self.x.shares(values) * (self.box.right - self.box.left)

    def y_at(self, values: Places | float) -> FloatArray:
        """Vertical positions of values in the figure [points]."""
        return self.box.bottom - self.y.shares(values) * (self.box.bottom - self.box.top)

    def x_axis(
        self,
        title: str = "",
        ticks: Sequence[tuple[float, str]] | int = 7,
        *,
        grid: bool = True,
        words: bool = True,
        whole: bool = False,
        turned: bool = False,
    ) -> None:
        """Draws the axis below.

        Args:
            title: Title of the axis.
            ticks: Positions with labels, or the largest number of steps.
            grid: Whether grid lines go up from the ticks.
            words: Whether ticks have labels.
            whole: Whether only whole numbers have ticks.
            turned: Whether labels are vertical.
        """
        box, labelled = self.box, self._ticks(self.x, ticks, whole)
        positions = self.x_at([value for value, _ in labelled]).tolist()
        if grid:
            lines = "".join(
                f"M{position:.1f} {box.bottom:.1f}V{box.top:.1f}" for position in positions
            )
            self.figure.path(lines, stroke=svg.LINE, width=_THIN)
        data = "".join(f"M{position:.1f} {box.bottom:.1f}v{_TICK_PT}" for position in positions)
        data += f"M{box.left:.1f} {box.bottom:.1f}H{box.right:.1f}"
        self.figure.path(data, stroke=svg.LINE, width=0.8)
        below = box.bottom + _TICK_PT + _GAP_PT
        for position, (_, text) in zip(positions, labelled if words else (), strict=bool(words)):
            if turned:
                self.figure.text(position + 0.36 * svg.SIZE, below, text, colour=svg.MUTED,
                                 anchor="end", turned=True)  # fmt: skip
            else:
                self.figure.text(
                    position, below, text, colour=svg.MUTED, anchor="middle", rise="top"
                )
        if title:
            centre, title_y = 0.5 * (box.left + box.right), below + 1.45 * svg.SIZE
            self.figure.text(centre, title_y, title, anchor="middle", rise="top")

    def y_axis(
        self,
        title: str = "",
        ticks: Sequence[tuple[float, str]] | int = 4,
        *,
        grid: bool = True,
        words: bool = True,
    ) -> None:
        """Draws the axis at the left; see `x_axis`."""
        box, labelled = self.box, self._ticks(self.y, ticks, whole=False)
        positions = self.y_at([value for value, _ in labelled]).tolist()
        if grid:
            lines = "".join(
                f"M{box.left:.1f} {position:.1f}H{box.right:.1f}" for position in positions
            )
            self.figure.path(lines, stroke=svg.LINE, width=_THIN)
        data = "".join(f"M{box.left:.1f} {position:.1f}h-{_TICK_PT}" for position in positions)
        data += f"M{box.left:.1f} {box.bottom:.1f}V{box.top:.1f}"
        self.figure.path(data, stroke=svg.LINE, width=0.8)
        label_x = box.left - _TICK_PT - _GAP_PT
        for position, (_, text) in zip(positions, labelled if words else (), strict=bool(words)):
            self.figure.text(label_x, position, text, colour=svg.MUTED, anchor="end", rise="middle")
        if title:
            length = max((len(text) for _, text in labelled), default=0) if words else 0
            title_x = label_x - 0.62 * svg.SIZE * length - 6.0
            centre = 0.5 * (box.top + box.bottom)
            for row, line in enumerate(reversed(title.split("\n"))):
                self.figure.text(title_x - 1.2 * svg.SIZE * row, centre, line, anchor="middle",
                                 turned=True)  # fmt: skip

    @staticmethod
    def _ticks(
        scale: Scale, ticks: Sequence[tuple[float, str]] | int, whole: bool
    ) -> Sequence[tuple[float, str]]:
        if not isinstance(ticks, int):
            return ticks
        values = scale.ticks(ticks, whole)
        words = [f"{value:g}" for value in values] if scale.decades else tick_words(values)
        return list(zip(values, words, strict=True))

    def frame(self) -> None:
        """Draws the box around the panel."""
        box = self.box
        data = f"M{box.left:.1f} {box.top:.1f}H{box.right:.1f}V{box.bottom:.1f}"
        self.figure.path(data + f"H{box.left:.1f}z", stroke=svg.LINE, width=0.8)

    def title(self, words: str, anchor: str = "middle") -> None:
        """Writes a title above the panel."""
        box = self.box
        x = 0.5 * (box.left + box.right) if anchor == "middle" else box.left
        self.figure.text(x, box.top - 5.0, words, anchor=anchor)

    def line(self, x: Places, y: Places, colour: str, width: float = 1.6) -> None:
        """Draws a line through points; NaN interrupts it."""
        self.figure.path(
            svg.polyline(self.x_at(x), self.y_at(y)), stroke=colour, width=width, cap="butt"
        )

    def band(self, x: FloatArray, low: FloatArray, high: FloatArray, colour: str) -> None:
        """Fills the area between two lines, faintly."""
        places = np.concatenate([self.x_at(x), self.x_at(x)[::-1]])
        heights = np.concatenate([self.y_at(low), self.y_at(high)[::-1]])
        self.figure.path(svg.polyline(places, heights) + "z", fill=colour, opacity=0.2)

    def level(self, y: float, colour: str, width: float = 0.9, dash: str = "") -> None:
        """Draws a horizontal line at a value."""
        y_at = float(self.y_at(y))
        data = f"M{self.box.left:.1f} {y_at:.1f}H{self.box.right:.1f}"
        self.figure.path(data, stroke=colour, width=width, dash=dash)

    def post(self, x: float, colour: str, width: float = 0.9) -> None:
        """Draws a vertical line at a value."""
        x_at = float(self.x_at(x))
        self.figure.path(
            f"M{x_at:.1f} {self.box.bottom:.1f}V{self.box.top:.1f}", stroke=colour, width=width
        )

    def bars(self, x: Places, y: Places, width: float, colour: str) -> None:
        """Draws bars from zero upwards, centred at `x`, of a width in its units."""
        lefts, rights = self.x_at(np.subtract(x, width / 2)), self.x_at(np.add(x, width / 2))
        foot = float(self.y_at(0.0))
        rows = zip(lefts.tolist(), rights.tolist(), self.y_at(y).tolist(), strict=True)
        data = "".join(f"M{a:.1f} {foot:.1f}V{top:.1f}H{b:.1f}V{foot:.1f}z" for a, b, top in rows)
        self.figure.path(data, fill=colour, opacity=0.9)

    def marks(
        self, x: Places, y: Places, shape: str, colour: str, size: float = 5.5, opacity: float = 1.0
    ) -> None:
        """Draws a mark at each point, all as one path.

        Args:
            x: Horizontal coordinates.
            y: Vertical coordinates.
            shape: `dot`, `ring`, `x`, `^`, `square`, `|` or `-`.
            colour: Colour of the marks.
            size: Size of the marks [points].
            opacity: Opacity of the marks.
        """
        half = 0.5 * size
        arc = f"a{half:g} {half:g} 0 1 0"
        strokes = {
            "dot": (0.0, 0.0, "h0"),
            "ring": (-half, 0.0, f"{arc} {size:g} 0{arc} -{size:g} 0"),
            "x": (-half, -half, f"l{size:g} {size:g}m0 -{size:g}l-{size:g} {size:g}"),
            "^": (-half, half, f"h{size:g}l-{half:g} -{size:g}z"),
            "square": (-half, -half, f"h{size:g}v{size:g}h-{size:g}z"),
            "|": (0.0, -half, f"v{size:g}"),
            "-": (-half, 0.0, f"h{size:g}"),
        }  # fmt: skip
        dx, dy, pen = strokes[shape]
        places = zip((self.x_at(x) + dx).tolist(), (self.y_at(y) + dy).tolist(), strict=True)
        data = "".join(f"M{a:.1f} {b:.1f}{pen}" for a, b in places if a == a and b == b)
        if shape in ("^", "square"):
            self.figure.path(data, fill=colour, opacity=opacity)
        else:
            # A stroke of zero length with round ends is a dot.
            width = {"dot": size, "|": 1.5, "-": 2.8}.get(shape, 1.0)
            self.figure.path(data, stroke=colour, width=width, opacity=opacity,
                             cap="round" if shape == "dot" else "")  # fmt: skip

    def colour_bar(self, scale: Scale, colours: Sequence[tuple[int, int, int]], title: str) -> None:
        """Draws the colour scale at the right."""
        box, figure = self.box, self.figure
        height = _BAR_SHARE * (box.bottom - box.top)
        left, top = box.right + _BAR_GAP_PT, 0.5 * (box.top + box.bottom - height)
        part = height / _BAR_STEPS
        names = svg.shades(np.zeros(0), 0.0, 1.0, colours, _BAR_STEPS)[1]
        for step, name in enumerate(reversed(names)):
            # Slightly overlapping, so that no gaps show.
            size = f"h{_BAR_PT}v{part + (0.3 if step < _BAR_STEPS - 1 else 0.0):.2f}h-{_BAR_PT}z"
            figure.path(f"M{left:.1f} {top + step * part:.2f}{size}", fill=name)
        values = scale.ticks(5)
        labels = tick_words(values)
        for value, text in zip(values, labels, strict=True):
            y = top + height * (1.0 - float(scale.shares(value)))
            figure.path(f"M{left + _BAR_PT:.1f} {y:.1f}h{_TICK_PT}", stroke=svg.LINE, width=0.8)
            figure.text(left + _BAR_PT + _TICK_PT + 2.0, y, text, colour=svg.MUTED, rise="middle")
        title_x = left + _BAR_PT + _TICK_PT + 0.62 * svg.SIZE * max(map(len, labels), default=0)
        figure.text(title_x + 1.5 * svg.SIZE, 0.5 * (box.top + box.bottom), title, anchor="middle",
                    turned=True)  # fmt: skip

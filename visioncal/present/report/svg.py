"""Figures as inline SVG with real text and the colours of the page's theme.

They are written directly: a plotting library takes longer to load than a calibration.
"""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup, escape

from visioncal.core.types import FloatArray

# The page defines the colours for light, dark and print.
INK, MUTED, LINE = "var(--ink)", "var(--muted)", "var(--line)"
ACCENT, GOOD, BAD, CHECK = "var(--accent)", "var(--good)", "var(--bad)", "var(--check)"
CARD = "var(--card)"
# Dashes and gaps of lines [points].
DASHED, DOTTED = "3.6 2.7", "0.9 1.8"
SIZE, SMALL = 9.0, 8.0
# Colour scales of matplotlib at equal steps, from low to high (red, green, blue).
PLASMA = (
    (13, 8, 135), (76, 2, 161), (126, 3, 168), (170, 35, 149), (204, 71, 120), (230, 108, 92),
    (248, 149, 64), (253, 197, 39), (240, 249, 33),
)  # fmt: skip
COOLWARM = (
    (59, 76, 192), (98, 130, 234), (141, 176, 254), (185, 208, 249), (221, 220, 220),
    (245, 196, 172), (244, 152, 122), (221, 95, 75), (180, 4, 38),
)  # fmt: skip
# Vertical offset of text, in font sizes.
_RISES = {"baseline": 0.0, "middle": 0.36, "top": 0.8, "bottom": -0.25}
_POINTS_AN_INCH = 72.0


class Figure:
    """A figure; positions are in points (1/72 inch) from its upper left corner, y downwards."""

    def __init__(self, width_in: float, height_in: float) -> None:
        self.width, self.height = _POINTS_AN_INCH * width_in, _POINTS_AN_INCH * height_in
        self._parts: list[str] = []

    def path(
        self,
        data: str,
        *,
        fill: str = "none",
        stroke: str = "none",
        width: float = 1.0,
        dash: str = "",
        opacity: float = 1.0,
        cap: str = "",
    ) -> None:
        """Adds a path; an empty one is ignored.

        Args:
            data: Path commands, as in SVG's `d`.
            fill: Fill colour.
            stroke: Line colour.
            width: Line width [points].
            dash: Lengths of dashes and gaps [points]; empty for a solid line.
            opacity: Opacity of fill and line.
            cap: Shape of line ends; empty for butt ends.
        """
        if not data:
            return
        style = f"fill:{fill}"
        if stroke != "none":
            style += f";stroke:{stroke};stroke-width:{width:g}"
            style += f";stroke-dasharray:{dash}" if dash else ""
            style += f";stroke-linecap:{cap}" if cap else ""
        style += f";opacity:{opacity:g}" if opacity < 1.0 else ""
        self._parts.append(f'<path d="{data}" style="{style}"/>')

    def text(
        self,
        x: float,
        y: float,
        words: str,
        *,
        size: float = SIZE,
        colour: str = INK,
        anchor: str = "start",
        rise: str = "baseline",
        turned: bool = False,
        bold: bool = False,
    ) -> None:
        """Adds a line of text.

        Args:
            x: Horizontal position [points].
            y: Vertical position [points].
            words: The text; markup is kept.
            size: Font size [points].
            colour: Text colour.
            anchor: Horizontal alignment at `x`: `start`, `middle` or `end`.
            rise: Vertical alignment at `y`: `baseline`, `middle`, `top` or `bottom`.
            turned: Whether the text reads upwards.
            bold: Whether it is bold.
        """
        shift = _RISES[rise] * size
        transform = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
        weight = ";font-weight:bold" if bold else ""
        style = f"font-size:{size:.3g}px;fill:{colour};text-anchor:{anchor}{weight}"
        position = f'x="{x:.1f}" y="{y + shift:.1f}"'
        self._parts.append(f'<text {position}{transform} style="{style}">{escape(words)}</text>')

    def legend(
        self, x: float, y: float, entries: Sequence[tuple[str, str, str]], anchor: str = "end"
    ) -> None:
        """Adds a legend of (sign, colour, text) in one line; `x` is its end, or start [points]."""
        parts = (
            f'<tspan style="fill:{colour}">{sign}</tspan> {escape(words)}'
            for sign, colour, words in entries
        )
        # All texts are escaped.
        words = Markup("\N{NO-BREAK SPACE}\N{NO-BREAK SPACE} ".join(parts))
        self.text(x, y, words, size=SMALL, anchor=anchor)

    def image(self, left: float, top: float, width: float, height: float, uri: str) -> None:
        """Adds a bitmap stretched to a box [points]."""
        box = f'x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}"'
        self._parts.append(f'<image {box} preserveAspectRatio="none" href="{uri}"/>')

    def inline(self, words: str) -> Markup:
        """The figure as an `<svg>` element that scales with its container, described by `words`."""
        # Numbers and colours are our own; all texts are escaped.
        return Markup(
            f'<svg role="img" aria-label="{escape(words)}" '
            f'viewBox="0 0 {self.width:.1f} {self.height:.1f}">{"".join(self._parts)}</svg>'
        )


def polyline(x: FloatArray, y: FloatArray) -> str:
    """Path commands of a line through (n,) points [points]; NaN interrupts it."""
    parts, pen = [], "M"
    for x_at, y_at in zip(x.tolist(), y.tolist(), strict=True):
        if x_at != x_at or y_at != y_at:
            pen = "M"
            continue
        parts.append(f"{pen}{x_at:.1f} {y_at:.1f}")
        pen = "L"
    return "".join(parts)


def rounded(left: float, top: float, width: float, height: float, radius: float) -> str:
    """Path commands of a box with round corners [points]."""
    r, h, v = f"{radius:g}", f"{width - 2 * radius:.1f}", f"{height - 2 * radius:.1f}"
    arc = f"a{r} {r} 0 0 1 "
    outline = f"h{h}{arc}{r} {r}v{v}{arc}-{r} {r}h-{h}{arc}-{r} -{r}v-{v}{arc}{r} -{r}z"
    return f"M{left + radius:.1f} {top:.1f}{outline}"


def shades(
    values: FloatArray, low: float, high: float, scale: Sequence[tuple[int, int, int]], count: int
) -> tuple[np.ndarray, list[str]]:
    """Steps of values on a colour scale, and the colours of all steps.

    The scale runs from `low` to `high`; values beyond an end have its colour.
    """
    steps = np.linspace(0.0, len(scale) - 1.0, count)
    stops = np.arange(float(len(scale)))
    parts = [np.interp(steps, stops, column) for column in np.transpose(scale)]
    colours = [f"#{int(r):02x}{int(g):02x}{int(b):02x}" for r, g, b in zip(*parts, strict=True)]
    share = (values - low) / ((high - low) or 1.0)
    return np.clip((share * count).astype(int), 0, count - 1), colours

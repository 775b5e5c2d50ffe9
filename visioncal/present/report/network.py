"""The network of an aligned cell as a graph: what hangs on what, who saw whom, how well known."""

from collections.abc import Mapping

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from visioncal.core.number_format import significant
from visioncal.present.recording.cellmap import Pair, pairs, places, spans, weakest_frame
from visioncal.present.report import svg
from visioncal.results import Alignment

# Sizes of a frame's box, in the units of the drawing.
_BOX_W, _BOX_H = 1.36, 0.44
# The size of a frame's name, and how many letters of it have room.
_NAME_SIZE, _NAME_LENGTH = 7.5, 15
_INCHES, _NARROWEST_IN = 0.72, 7.0


def graph(found: Alignment) -> Markup:
    """Draws the network: bodies as boxes, their frames in them, and who saw whom between.

    Returns:
        The figure. In each frame's box stands the sigma of its place on what it hangs on.
    """
    bodies, frames = spans(found), places(found)
    right = max(span[1] for span in bodies.values())
    with svg.style():
        wide = _INCHES * (right + 0.3)
        figure = svg.new_figure(max(wide, _NARROWEST_IN), _INCHES * 4.5)
        axes = figure.subplots()
        axes.set_axis_off()
        spare = 0.5 * max(_NARROWEST_IN / _INCHES - (right + 0.3), 0.0)
        axes.set_xlim(-0.15 - spare, right + 0.15 + spare)
        axes.set_ylim(-0.6, 3.5)
        for name, span in bodies.items():
            _draw_body(axes, found, name, span)
        for flange, robot in found.robots.items():
            _draw_robot(axes, frames, bodies, found.frames[flange], (flange, robot))
        for pair in pairs(found):
            if pair.seer in frames and pair.seen in frames:
                _draw_pair(axes, pair, frames)
        worst = weakest_frame(found)
        for name, place in frames.items():
            _draw_frame(axes, found, name, place, is_worst=name == worst)
        return svg.inline(figure, "network", "The network of frames: who saw whom, sigma of each")


def _draw_body(axes: Axes, found: Alignment, name: str, span: tuple[float, float]) -> None:
    axes.add_patch(
        FancyBboxPatch(
            (span[0], -0.35),
            span[1] - span[0],
            3.25,
            boxstyle="round,pad=0.08",
            facecolor="none",
            edgecolor=svg.LINE,
            linewidth=1.2,
        )
    )
    words = f"cell, the frame of {found.reference}" if name == "cell" else name
    axes.text(0.5 * sum(span), 3.2, words, ha="center", va="center", weight="bold")


def _draw_frame(
    axes: Axes, found: Alignment, name: str, place: tuple[float, float], *, is_worst: bool
) -> None:
    x, y = place
    colour = svg.CHECK if is_worst else svg.INK
    axes.add_patch(
        FancyBboxPatch(
            (x - 0.5 * _BOX_W, y - 0.5 * _BOX_H),
            _BOX_W,
            _BOX_H,
            boxstyle="round,pad=0.02",
            facecolor=svg.CARD,
            edgecolor=colour,
            linewidth=1.8 if is_worst else 0.9,
            zorder=4,
        )
    )
    size = min(_NAME_SIZE, _NAME_SIZE * _NAME_LENGTH / len(name))
    axes.text(x, y + 0.1, name, ha="center", va="center", fontsize=size, zorder=5)
    worth = "the reference"
    if name != found.reference:
        edge = found.edge_of(name)
        worth = f"{significant(edge.sigma_mm)} mm"
        if edge.oriented:
            worth += f", {significant(edge.sigma_deg)}\N{DEGREE SIGN}"
    axes.text(x, y - 0.1, worth, ha="center", va="center", fontsize=7, color=colour, zorder=5)


def _draw_robot(
    axes: Axes,
    frames: Mapping[str, tuple[float, float]],
    bodies: Mapping[str, tuple[float, float]],
    base: str,
    named: tuple[str, str],
) -> None:
    """An arrow from a robot's base to the box of its flange."""
    flange, robot = named
    if base not in frames:
        return
    x, y = frames[base]
    span = bodies[flange]
    end = span[1] + 0.08 if span[1] < x else span[0] - 0.08
    start = x - 0.5 * _BOX_W if end < x else x + 0.5 * _BOX_W
    arrow = FancyArrowPatch(
        (start, y),
        (end, y),
        arrowstyle="-|>",
        mutation_scale=11,
        linewidth=1.6,
        linestyle=(0, (4, 2)),
        color=svg.MUTED,
        shrinkA=0,
        shrinkB=0,
        zorder=3,
    )
    axes.add_patch(arrow)
    axes.text(
        0.5 * (start + end), y + 0.1, f"robot {robot}", ha="center", fontsize=7, color=svg.MUTED
    )


def _draw_pair(axes: Axes, pair: Pair, frames: Mapping[str, tuple[float, float]]) -> None:
    """A line between a camera and what it saw, as wide as it is often."""
    (x, y), (to_x, to_y) = frames[pair.seer], frames[pair.seen]
    # Lines leave towards where they go, so that those of one frame part at once.
    lean = max(-0.4, min(0.4, 0.08 * (to_x - x)))
    start, end = (x + lean, y - 0.5 * _BOX_H), (to_x - lean, to_y + 0.5 * _BOX_H)
    colour = svg.BAD if not pair.used else svg.ACCENT
    width = 0.8 + 0.5 * min(pair.used, 40) ** 0.5
    axes.plot(
        [start[0], end[0]], [start[1], end[1]], color=colour, linewidth=width, alpha=0.55, zorder=2
    )
    # Nearer to the board, the lines of one camera have parted.
    at = 0.72
    words = f"{pair.used}" + (f" (\N{MINUS SIGN}{pair.left_out})" if pair.left_out else "")
    axes.text(
        start[0] + at * (end[0] - start[0]),
        start[1] + at * (end[1] - start[1]),
        words,
        ha="center",
        va="center",
        fontsize=7,
        color=svg.BAD if pair.left_out else svg.INK,
        bbox={"boxstyle": "round,pad=0.15", "facecolor": svg.CARD, "edgecolor": "none"},
        zorder=3,
    )

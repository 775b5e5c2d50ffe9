"""The network of a cell's frames: parents, who saw whom, and the sigma of each."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from visioncal.core.number_format import counted, significant
from visioncal.core.types import FloatArray
from visioncal.present.facts import DEGREE
from visioncal.present.network_layout import (
    SeenPair,
    layout,
    pairs,
    sigma_words,
    weakest_frame,
)
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    CARD,
    CHECK,
    INK,
    LINE,
    MUTED,
    drawn,
    panels,
)
from visioncal.present.tables import Table
from visioncal.results import Calibration
from visioncal.results.tree import FrameTree
from visioncal.session.frames import CELL

_KINDS = {
    "robot": "flange",
    "camera": "cam",
    "board": "target",
    "instrument": "instrument",
    "point": "point",
}
# Size of a frame's box, in units of the drawing.
_BOX_W, _BOX_H = 1.36, 0.44
# Font size of a frame's name, and the number of letters that fit.
_NAME_SIZE, _NAME_LENGTH = 7.5, 15
_INCHES, _NARROWEST_IN = 0.72, 7.0
# Size of other labels [points].
_SMALL = 7.0


def kinds(tree: FrameTree) -> str:
    """Number of robots, cameras, boards and the like, in words."""
    words = []
    for kind, start in _KINDS.items():
        count = sum(name.startswith(start) for name in tree.last)
        if count:
            words.append(counted(count, kind))
    return ", ".join(words)


def known_in_each_other(tree: FrameTree) -> Iterator[Table]:
    """Sigmas between frames of one body, the cell or a flange [mm, deg]."""
    for body in (CELL, *tree.flanges):
        carried = [
            name
            for name, parent in tree.last.items()
            if parent == body and name not in tree.flanges
        ]
        frames = carried if body == CELL else [body, *carried]
        if len(frames) > 1:
            # Nothing has a position in a point's frame, whose axes are arbitrary.
            oriented = [frame for frame in frames if _is_oriented(tree, frame)]
            rows = [(a, *(_between(tree, a, b) for b in frames)) for a in oriented]
            yield Table.of(("the cell" if body == CELL else body, *frames), rows)


def _between(tree: FrameTree, first: str, second: str) -> str:
    if first == second:
        return ""
    edge = tree.between(first, second)
    degrees = f", {significant(edge.sigma_deg)}{DEGREE}" if _is_oriented(tree, second) else ""
    return f"{significant(edge.sigma_mm)} mm{degrees}"


def _is_oriented(tree: FrameTree, frame: str) -> bool:
    """Whether a frame's rotation was measured, or is a reference for others."""
    return frame in (*tree.flanges, tree.reference) or tree.edge_of(frame).oriented


@drawn
def graph(calibration: Calibration) -> tuple[Figure, str]:
    """Draws the network: bodies as boxes with their frames, and who saw whom between them.

    Each frame's box has the sigma of its pose on its parent.
    """
    tree = calibration.tree
    bodies, frames = layout(tree)
    right = max(span[1] for span in bodies.values())
    margin = 0.5 * max(_NARROWEST_IN / _INCHES - (right + 0.3), 0.0)
    figure, ((axes,),) = panels(max(_INCHES * (right + 0.3), _NARROWEST_IN), _INCHES * 4.5)
    axes.set(xlim=(-0.15 - margin, right + 0.15 + margin), ylim=(-0.6, 3.5))
    axes.set_axis_off()
    for name, (left, end) in bodies.items():
        _box(axes, (left, -0.35), (end, 2.9), 0.08, facecolor="none", edgecolor=LINE, lw=1.2)
        words = f"cell, the frame of {tree.reference}" if name == CELL else name
        axes.text(0.5 * (left + end), 3.2, words, ha="center", va="center", weight="bold")
    seen = [
        pair for pair in pairs(calibration.views) if pair.seer in frames and pair.seen in frames
    ]
    for pair in seen:
        colour = ACCENT if pair.used else BAD
        # More observations make it wider.
        width = 0.8 + 0.5 * min(pair.used, 40) ** 0.5
        axes.plot(*_ends(pair, frames).T, color=colour, linewidth=width, alpha=0.55)
    for flange, robot in tree.flanges.items():
        base = tree.parents[flange]
        if base in frames:
            _draw_robot(axes, frames[base], bodies[flange], robot)
    for pair in seen:
        # Close to the board, where the lines of one camera have separated.
        start, end = _ends(pair, frames)
        words = f"{pair.used}" + (f" (\N{MINUS SIGN}{pair.left_out})" if pair.left_out else "")
        axes.text(*(start + 0.72 * (end - start)), words, size=_SMALL, ha="center", va="center",
                  color=BAD if pair.left_out else INK,
                  bbox={"facecolor": CARD, "edgecolor": "none", "pad": 1.5})  # fmt: skip
    worst = weakest_frame(tree)
    for name, place in frames.items():
        _draw_frame(axes, tree, name, place, is_worst=name == worst)
    return figure, "The network of frames: who saw whom, sigma of each"


def _box(
    axes: Axes,
    low: tuple[float, float],
    high: tuple[float, float],
    pad: float,
    **style: Any,  # noqa: ANN401
) -> None:
    """Draws a box with round corners, in a patch's style, around two opposite ones."""
    size = high[0] - low[0], high[1] - low[1]
    axes.add_patch(FancyBboxPatch(low, *size, boxstyle=f"round,pad={pad}", **style))


def _draw_frame(
    axes: Axes, tree: FrameTree, name: str, place: tuple[float, float], *, is_worst: bool
) -> None:
    x, y = place
    colour = CHECK if is_worst else INK
    low, high = (x - 0.5 * _BOX_W, y - 0.5 * _BOX_H), (x + 0.5 * _BOX_W, y + 0.5 * _BOX_H)
    _box(axes, low, high, 0.02, facecolor=CARD, edgecolor=colour, lw=1.8 if is_worst else 0.9,
         zorder=3)  # fmt: skip
    size = min(_NAME_SIZE, _NAME_SIZE * _NAME_LENGTH / len(name))
    style: Any = {"ha": "center", "va": "center", "zorder": 4}
    axes.text(x, y + 0.1, name, size=size, **style)
    axes.text(x, y - 0.1, sigma_words(tree, name), size=_SMALL, color=colour, **style)


def _draw_robot(
    axes: Axes, place: tuple[float, float], span: tuple[float, float], robot: str
) -> None:
    """Draws an arrow from a robot's base to the body of its flange."""
    x, y = place
    end = span[1] + 0.08 if span[1] < x else span[0] - 0.08
    start = x - 0.5 * _BOX_W if end < x else x + 0.5 * _BOX_W
    arrow = {"arrowstyle": "-|>", "color": MUTED, "linewidth": 1.6, "linestyle": "--"}
    axes.annotate("", (end, y), (start, y), arrowprops=arrow)
    axes.text(0.5 * (start + end), y + 0.1, f"robot {robot}", size=_SMALL, color=MUTED, ha="center")


def _ends(pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> FloatArray:
    """(2, 2) end points of the line between a camera and what it saw."""
    (x, y), (to_x, to_y) = frames[pair.seer], frames[pair.seen]
    # Lines start towards their targets, so that those of one frame separate at once.
    lean = max(-0.4, min(0.4, 0.08 * (to_x - x)))
    return np.array([[x + lean, y - 0.5 * _BOX_H], [to_x - lean, to_y + 0.5 * _BOX_H]])

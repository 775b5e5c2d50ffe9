"""The network of a cell's frames: parents, who saw whom, and the sigma of each."""

from collections.abc import Iterator, Mapping

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import counted, significant
from visioncal.core.types import FloatArray
from visioncal.present.facts import DEGREE
from visioncal.present.network_layout import (
    SeenPair,
    pairs,
    places,
    sigma_words,
    spans,
    weakest_frame,
)
from visioncal.present.report import svg
from visioncal.present.report.axes import Box, Panel, Scale
from visioncal.present.report.svg import Figure
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
# Size of other labels, and of arrow heads [points].
_SMALL, _HEAD_PT = 7.0, 6.0


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


def graph(calibration: Calibration) -> Markup:
    """Draws the network: bodies as boxes with their frames, and who saw whom between them.

    Returns:
        The figure. Each frame's box has the sigma of its pose on its parent.
    """
    tree = calibration.tree
    bodies, frames = spans(tree), places(tree)
    right = max(span[1] for span in bodies.values())
    width_in = _INCHES * (right + 0.3)
    figure = Figure(max(width_in, _NARROWEST_IN), _INCHES * 4.5)
    margin = 0.5 * max(_NARROWEST_IN / _INCHES - (right + 0.3), 0.0)
    box = Box(0.0, 0.0, figure.width, figure.height)
    panel = Panel(figure, box, Scale(-0.15 - margin, right + 0.15 + margin), Scale(-0.6, 3.5))
    for name, span in bodies.items():
        _draw_body(panel, tree, name, span)
    seen = [
        pair for pair in pairs(calibration.views) if pair.seer in frames and pair.seen in frames
    ]
    for pair in seen:
        _draw_pair(panel, pair, frames)
    for flange, robot in tree.flanges.items():
        _draw_robot(panel, frames, bodies, tree.parents[flange], (flange, robot))
    for pair in seen:
        _count_pair(panel, pair, frames)
    worst = weakest_frame(tree)
    for name, place in frames.items():
        _draw_frame(panel, tree, name, place, is_worst=name == worst)
    return figure.inline("The network of frames: who saw whom, sigma of each")


def _box(panel: Panel, left: float, low: float, right: float, high: float, pad: float) -> str:
    """Path commands of a box with round corners, in the panel's units."""
    x, y = panel.x_at([left - pad, right + pad]), panel.y_at([high + pad, low - pad])
    radius = float(panel.x_at(pad) - panel.x_at(0.0))
    size = float(x[1] - x[0]), float(y[1] - y[0])
    return svg.rounded(float(x[0]), float(y[0]), *size, radius)


def _draw_body(panel: Panel, tree: FrameTree, name: str, span: tuple[float, float]) -> None:
    outline = _box(panel, span[0], -0.35, span[1], 2.9, 0.08)
    panel.figure.path(outline, stroke=svg.LINE, width=1.2)
    words = f"cell, the frame of {tree.reference}" if name == CELL else name
    x, y = float(panel.x_at(0.5 * sum(span))), float(panel.y_at(3.2))
    panel.figure.text(x, y, words, anchor="middle", rise="middle", bold=True)


def _draw_frame(
    panel: Panel, tree: FrameTree, name: str, place: tuple[float, float], *, is_worst: bool
) -> None:
    x, y = place
    colour = svg.CHECK if is_worst else svg.INK
    half_width, half_height = 0.5 * _BOX_W, 0.5 * _BOX_H
    outline = _box(panel, x - half_width, y - half_height, x + half_width, y + half_height, 0.02)
    panel.figure.path(outline, fill=svg.CARD, stroke=colour, width=1.8 if is_worst else 0.9)
    size = min(_NAME_SIZE, _NAME_SIZE * _NAME_LENGTH / len(name))
    centre = float(panel.x_at(x))
    lines = ((0.1, name, size, svg.INK), (-0.1, sigma_words(tree, name), _SMALL, colour))
    for rise, words, font_size, ink in lines:
        height = float(panel.y_at(y + rise))
        panel.figure.text(centre, height, words, size=font_size, colour=ink, anchor="middle",
                          rise="middle")  # fmt: skip


def _draw_robot(
    panel: Panel,
    frames: Mapping[str, tuple[float, float]],
    bodies: Mapping[str, tuple[float, float]],
    base: str,
    flange_and_robot: tuple[str, str],
) -> None:
    """Draws an arrow from a robot's base to the body of its flange."""
    flange, robot = flange_and_robot
    if base not in frames:
        return
    x, y = frames[base]
    span = bodies[flange]
    end = span[1] + 0.08 if span[1] < x else span[0] - 0.08
    start = x - 0.5 * _BOX_W if end < x else x + 0.5 * _BOX_W
    (tail, tip), height = panel.x_at([start, end]).tolist(), float(panel.y_at(y))
    # The head's length is negative if it points to the left.
    head = _HEAD_PT if tip > tail else -_HEAD_PT
    panel.figure.path(f"M{tail:.1f} {height:.1f}H{tip - head:.1f}", stroke=svg.MUTED, width=1.6,
                      dash="6.4 3.2")  # fmt: skip
    point = f"M{tip:.1f} {height:.1f}l{-head:g} -{0.5 * _HEAD_PT:g}v{_HEAD_PT:g}z"
    panel.figure.path(point, fill=svg.MUTED)
    middle, above = 0.5 * (tail + tip), float(panel.y_at(y + 0.1))
    panel.figure.text(middle, above, f"robot {robot}", size=_SMALL, colour=svg.MUTED,
                      anchor="middle")  # fmt: skip


def _ends(pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> FloatArray:
    """(2, 2) end points of the line between a camera and what it saw."""
    (x, y), (to_x, to_y) = frames[pair.seer], frames[pair.seen]
    # Lines start towards their targets, so that those of one frame separate at once.
    lean = max(-0.4, min(0.4, 0.08 * (to_x - x)))
    return np.array([[x + lean, y - 0.5 * _BOX_H], [to_x - lean, to_y + 0.5 * _BOX_H]])


def _draw_pair(panel: Panel, pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> None:
    """Draws a line between a camera and what it saw; more observations make it wider."""
    x, y = _ends(pair, frames).T
    colour = svg.BAD if not pair.used else svg.ACCENT
    width = 0.8 + 0.5 * min(pair.used, 40) ** 0.5
    line = svg.polyline(panel.x_at(x), panel.y_at(y))
    panel.figure.path(line, stroke=colour, width=width, opacity=0.55)


def _count_pair(panel: Panel, pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> None:
    """Writes the number of observations on the line."""
    # Close to the board, where the lines of one camera have separated.
    start, end = _ends(pair, frames)
    position = start + 0.72 * (end - start)
    x, y = float(panel.x_at(position[0])), float(panel.y_at(position[1]))
    words = f"{pair.used}" + (f" (\N{MINUS SIGN}{pair.left_out})" if pair.left_out else "")
    half = 0.3 * _SMALL * len(words) + 1.5
    background = svg.rounded(x - half, y - 0.65 * _SMALL, 2.0 * half, 1.3 * _SMALL, 1.5)
    panel.figure.path(background, fill=svg.CARD)
    colour = svg.BAD if pair.left_out else svg.INK
    panel.figure.text(x, y, words, size=_SMALL, colour=colour, anchor="middle", rise="middle")

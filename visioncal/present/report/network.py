"""The network of a whole cell's frames: what hangs on what, who saw whom, how well known."""

from collections.abc import Iterator, Mapping

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import counted, significant
from visioncal.core.types import FloatArray
from visioncal.present.cellmap import SeenPair, pairs, places, sigma_words, spans, weakest_frame
from visioncal.present.facts import DEGREE
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
# Sizes of a frame's box, in the units of the drawing.
_BOX_W, _BOX_H = 1.36, 0.44
# The size of a frame's name, and how many letters of it have room.
_NAME_SIZE, _NAME_LENGTH = 7.5, 15
_INCHES, _NARROWEST_IN = 0.72, 7.0
# Of the other words, and of the heads of arrows [points].
_SMALL, _HEAD_PT = 7.0, 6.0


def kinds(tree: FrameTree) -> str:
    """How many robots, cameras, boards and the like there are, in words."""
    words = []
    for kind, start in _KINDS.items():
        count = sum(name.startswith(start) for name in tree.last)
        if count:
            words.append(counted(count, kind))
    return ", ".join(words)


def known_in_each_other(tree: FrameTree) -> Iterator[Table]:
    """How well frames of one body, the cell or a flange, are known in each other [mm, deg]."""
    for body in (CELL, *tree.flanges):
        carried = [
            name for name, on in tree.last.items() if on == body and name not in tree.flanges
        ]
        frames = carried if body == CELL else [body, *carried]
        if len(frames) > 1:
            # In the frame of a point alone nothing has a place: its axes are chosen.
            turned = [frame for frame in frames if _is_turned(tree, frame)]
            rows = [(a, *(_between(tree, a, b) for b in frames)) for a in turned]
            yield Table.of(("the cell" if body == CELL else body, *frames), rows)


def _between(tree: FrameTree, first: str, second: str) -> str:
    if first == second:
        return ""
    edge = tree.between(first, second)
    degrees = f", {significant(edge.sigma_deg)}{DEGREE}" if _is_turned(tree, second) else ""
    return f"{significant(edge.sigma_mm)} mm{degrees}"


def _is_turned(tree: FrameTree, frame: str) -> bool:
    """Whether a frame's rotation was measured, or is what others are given in."""
    return frame in (*tree.flanges, tree.reference) or tree.edge_of(frame).oriented


def graph(calibration: Calibration) -> Markup:
    """Draws the network: bodies as boxes, their frames in them, and who saw whom between.

    Returns:
        The figure. In each frame's box stands the sigma of its place on what it hangs on.
    """
    tree = calibration.tree
    bodies, frames = spans(tree), places(tree)
    right = max(span[1] for span in bodies.values())
    wide = _INCHES * (right + 0.3)
    figure = Figure(max(wide, _NARROWEST_IN), _INCHES * 4.5)
    spare = 0.5 * max(_NARROWEST_IN / _INCHES - (right + 0.3), 0.0)
    box = Box(0.0, 0.0, figure.width, figure.height)
    panel = Panel(figure, box, Scale(-0.15 - spare, right + 0.15 + spare), Scale(-0.6, 3.5))
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
    """Commands of a box with round corners, given in the panel's units."""
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
    half_w, half_h = 0.5 * _BOX_W, 0.5 * _BOX_H
    outline = _box(panel, x - half_w, y - half_h, x + half_w, y + half_h, 0.02)
    panel.figure.path(outline, fill=svg.CARD, stroke=colour, width=1.8 if is_worst else 0.9)
    size = min(_NAME_SIZE, _NAME_SIZE * _NAME_LENGTH / len(name))
    at = float(panel.x_at(x))
    lines = ((0.1, name, size, svg.INK), (-0.1, sigma_words(tree, name), _SMALL, colour))
    for rise, words, letters, ink in lines:
        height = float(panel.y_at(y + rise))
        panel.figure.text(at, height, words, size=letters, colour=ink, anchor="middle",
                          rise="middle")  # fmt: skip


def _draw_robot(
    panel: Panel,
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
    (tail, tip), height = panel.x_at([start, end]).tolist(), float(panel.y_at(y))
    # The head's length is negative where it points to the left.
    head = _HEAD_PT if tip > tail else -_HEAD_PT
    panel.figure.path(f"M{tail:.1f} {height:.1f}H{tip - head:.1f}", stroke=svg.MUTED, width=1.6,
                      dash="6.4 3.2")  # fmt: skip
    point = f"M{tip:.1f} {height:.1f}l{-head:g} -{0.5 * _HEAD_PT:g}v{_HEAD_PT:g}z"
    panel.figure.path(point, fill=svg.MUTED)
    middle, above = 0.5 * (tail + tip), float(panel.y_at(y + 0.1))
    panel.figure.text(middle, above, f"robot {robot}", size=_SMALL, colour=svg.MUTED,
                      anchor="middle")  # fmt: skip


def _ends(pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> FloatArray:
    """(2, 2) where the line between a camera and what it saw begins and ends."""
    (x, y), (to_x, to_y) = frames[pair.seer], frames[pair.seen]
    # Lines leave towards where they go, so that those of one frame part at once.
    lean = max(-0.4, min(0.4, 0.08 * (to_x - x)))
    return np.array([[x + lean, y - 0.5 * _BOX_H], [to_x - lean, to_y + 0.5 * _BOX_H]])


def _draw_pair(panel: Panel, pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> None:
    """A line between a camera and what it saw, as wide as it is often."""
    x, y = _ends(pair, frames).T
    colour = svg.BAD if not pair.used else svg.ACCENT
    width = 0.8 + 0.5 * min(pair.used, 40) ** 0.5
    line = svg.polyline(panel.x_at(x), panel.y_at(y))
    panel.figure.path(line, stroke=colour, width=width, opacity=0.55)


def _count_pair(panel: Panel, pair: SeenPair, frames: Mapping[str, tuple[float, float]]) -> None:
    """How often it saw it, on the line."""
    # Nearer to the board, the lines of one camera have parted.
    start, end = _ends(pair, frames)
    at = start + 0.72 * (end - start)
    x, y = float(panel.x_at(at[0])), float(panel.y_at(at[1]))
    words = f"{pair.used}" + (f" (\N{MINUS SIGN}{pair.left_out})" if pair.left_out else "")
    half = 0.3 * _SMALL * len(words) + 1.5
    ground = svg.rounded(x - half, y - 0.65 * _SMALL, 2.0 * half, 1.3 * _SMALL, 1.5)
    panel.figure.path(ground, fill=svg.CARD)
    colour = svg.BAD if pair.left_out else svg.INK
    panel.figure.text(x, y, words, size=_SMALL, colour=colour, anchor="middle", rise="middle")

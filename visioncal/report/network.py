"""The network of an aligned cell as a graph: what hangs on what, who saw whom, how well known."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from visioncal.calibration import Alignment
from visioncal.recording.numbers import significant
from visioncal.report import svg

# Sizes in the units of the drawing: a place for a frame, its box, and the gap between bodies.
_STEP, _BOX_W, _BOX_H, _GAP = 1.5, 1.36, 0.44, 0.8
# Heights of what sees, of what is seen, and of the robots' bases.
_TOP, _MIDDLE, _BOTTOM = 2.5, 1.05, 0.1
_INCHES, _NARROWEST_IN = 0.72, 7.0
_SEERS = ("cam", "instrument")


@dataclass(frozen=True)
class Pair:
    """All that one frame saw of another.

    Attributes:
        seer: The one.
        seen: The other.
        used: How many observations the fit used.
        left_out: How many it did not.
        rms_mm: Root mean square of what those used are off [mm]; None where none was used.
        rms_deg: The same in rotation [deg].
    """

    seer: str
    seen: str
    used: int
    left_out: int
    rms_mm: float | None
    rms_deg: float | None


def pairs(found: Alignment) -> tuple[Pair, ...]:
    """Lists who saw whom, and how well that fits."""
    rows: dict[tuple[str, str], list[int]] = {}
    for at, it in enumerate(found.sights):
        rows.setdefault((it.seer, it.seen), []).append(at)
    listed = []
    for (seer, seen), mine in rows.items():
        used = [found.sights[at] for at in mine if found.sights[at].used]
        rms = (_rms([it.residual_mm for it in used]), _rms([it.residual_deg for it in used]))
        listed.append(Pair(seer, seen, len(used), len(mine) - len(used), *rms))
    return tuple(listed)


def _rms(values: Sequence[float | None]) -> float | None:
    known = [it for it in values if it is not None]
    return float(sum(it * it for it in known) / len(known)) ** 0.5 if known else None


@dataclass(frozen=True, eq=False)
class _Body:
    """Frames that never move before each other: those of the cell, or of one flange."""

    name: str
    top: tuple[str, ...]
    middle: tuple[str, ...]
    bottom: tuple[str, ...]

    @property
    def width(self) -> float:
        return _STEP * max(len(self.top), len(self.middle), len(self.bottom), 1)

    def places(self, left: float) -> Iterator[tuple[str, float, float]]:
        """Each frame with the middle of its box."""
        rows = ((self.top, _TOP), (self.middle, _MIDDLE), (self.bottom, _BOTTOM))
        for names, height in rows:
            start = left + 0.5 * (self.width - _STEP * len(names))
            for at, name in enumerate(names):
                yield name, start + _STEP * (at + 0.5), height


def weakest_frame(found: Alignment) -> str:
    """The frame whose place on its parent is known worst, of those as they hang last."""
    former = {it.before for it in found.moved}
    edges = {it: found.edge_of(it) for it in _edged(found) if it not in former}
    return max(edges, key=lambda it: edges[it].sigma_mm, default="")


def _edged(found: Alignment) -> list[str]:
    return [it for it in found.frames if it not in found.robots]


def _bodies(found: Alignment) -> list[_Body]:
    """The flanges with the cell in their middle; frames as they hung before are left out."""
    former = {it.before for it in found.moved}
    flanges = list(found.robots)
    half = (len(flanges) + 1) // 2
    bodies = []
    for name in [*flanges[:half], "cell", *flanges[half:]]:
        mine = [it for it in _edged(found) if found.frames[it] == name and it not in former]
        top = tuple(it for it in mine if it.startswith(_SEERS))
        bottom = tuple(it for it in mine if it.startswith("base"))
        middle = tuple(it for it in mine if it not in top and it not in bottom)
        bodies.append(_Body(name, top, middle, bottom))
    return bodies


def graph(found: Alignment) -> Markup:
    """Draws the network: bodies as boxes, their frames in them, and who saw whom between.

    Returns:
        The figure. In each frame's box stands the sigma of its place on what it hangs on.
    """
    bodies = _bodies(found)
    left, spans = 0.0, {}
    places: dict[str, tuple[float, float]] = {}
    for body in bodies:
        spans[body.name] = (left, left + body.width)
        places |= {name: (x, y) for name, x, y in body.places(left)}
        left += body.width + _GAP
    with svg.style():
        wide = _INCHES * (left - _GAP + 0.3)
        figure = svg.new_figure(max(wide, _NARROWEST_IN), _INCHES * 4.5)
        axes = figure.subplots()
        axes.set_axis_off()
        spare = 0.5 * max(_NARROWEST_IN / _INCHES - (left - _GAP + 0.3), 0.0)
        axes.set_xlim(-0.15 - spare, left - _GAP + 0.15 + spare)
        axes.set_ylim(-0.6, 3.5)
        for name, span in spans.items():
            _draw_body(axes, found, name, span)
        for flange, robot in found.robots.items():
            _draw_robot(axes, places, spans, found.frames[flange], (flange, robot))
        for pair in pairs(found):
            if pair.seer in places and pair.seen in places:
                _draw_pair(axes, pair, places)
        worst = weakest_frame(found)
        for name, place in places.items():
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
    axes.text(x, y + 0.1, name, ha="center", va="center", fontsize=7.5, zorder=5)
    worth = "the reference"
    if name != found.reference:
        edge = found.edge_of(name)
        worth = f"{significant(edge.sigma_mm)} mm"
        if edge.oriented:
            worth += f", {significant(edge.sigma_deg)}\N{DEGREE SIGN}"
    axes.text(x, y - 0.1, worth, ha="center", va="center", fontsize=7, color=colour, zorder=5)


def _draw_robot(
    axes: Axes,
    places: Mapping[str, tuple[float, float]],
    spans: Mapping[str, tuple[float, float]],
    base: str,
    named: tuple[str, str],
) -> None:
    """An arrow from a robot's base to the box of its flange."""
    flange, robot = named
    if base not in places:
        return
    x, y = places[base]
    span = spans[flange]
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


def _draw_pair(axes: Axes, pair: Pair, places: Mapping[str, tuple[float, float]]) -> None:
    """A line between a camera and what it saw, as wide as it is often."""
    (x, y), (to_x, to_y) = places[pair.seer], places[pair.seen]
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

"""The network of an aligned cell as it is drawn: its bodies side by side, and who saw whom."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from visioncal.core.number_format import significant
from visioncal.results import Rms, ViewResult
from visioncal.results.tree import FrameTree
from visioncal.results.views import left_out_rms, rms_of

# How far frames stand apart, and the gap between bodies, in the units of the drawing.
STEP, GAP = 1.5, 0.8
# Heights of what sees, of what is seen, and of the robots' bases.
_TOP, _MIDDLE, _BOTTOM = 2.5, 1.05, 0.1
_SEERS = ("cam", "instrument")


@dataclass(frozen=True)
class SeenPair:
    """All that one frame saw of another.

    Attributes:
        seer: The one.
        seen: The other.
        used: How many observations the fit used.
        left_out: How many it did not.
        rms: Residuals of those used; None where none was.
        unseen: The same by fits that were made without their stops; None where that is not known.
    """

    seer: str
    seen: str
    used: int
    left_out: int
    rms: Rms | None
    unseen: Rms | None


def pairs(views: Iterable[ViewResult]) -> tuple[SeenPair, ...]:
    """Lists who saw whom, and how well that fits."""
    rows: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        rows.setdefault((view.seer, view.seen), []).append(view)
    listed = []
    for (seer, seen), mine in rows.items():
        used = sum(view.used for view in mine)
        unseen = any(view.used and view.left_out_mm is not None for view in mine)
        rms = (rms_of(mine) if used else None, left_out_rms(mine) if unseen else None)
        listed.append(SeenPair(seer, seen, used, len(mine) - used, *rms))
    return tuple(listed)


@dataclass(frozen=True, eq=False)
class RigidGroup:
    """Frames that never move before each other: those of the cell, or of one flange."""

    name: str
    top: tuple[str, ...]
    middle: tuple[str, ...]
    bottom: tuple[str, ...]

    @property
    def width(self) -> float:
        """How much room it takes."""
        return STEP * max(len(self.top), len(self.middle), len(self.bottom), 1)

    def places(self, left: float) -> Iterator[tuple[str, float, float]]:
        """Each frame with the middle of its box."""
        rows = ((self.top, _TOP), (self.middle, _MIDDLE), (self.bottom, _BOTTOM))
        for names, height in rows:
            start = left + 0.5 * (self.width - STEP * len(names))
            for at, name in enumerate(names):
                yield name, start + STEP * (at + 0.5), height


def weakest_frame(tree: FrameTree) -> str:
    """The frame whose place on its parent is known worst, of those as they hang last."""
    edges = {name: tree.edge_of(name) for name in _edged(tree)}
    return max(edges, key=lambda index: edges[index].sigma_mm, default="")


def sigma_words(tree: FrameTree, frame: str) -> str:
    """How well the place of a frame on what it hangs on is known."""
    if frame == tree.reference:
        return "the reference"
    edge = tree.edge_of(frame)
    turned = f", {significant(edge.sigma_deg)}\N{DEGREE SIGN}" if edge.oriented else ""
    return f"{significant(edge.sigma_mm)} mm{turned}"


def _edged(tree: FrameTree) -> list[str]:
    return [name for name in tree.last if name not in tree.flanges]


def bodies(tree: FrameTree) -> list[RigidGroup]:
    """The flanges with the cell in their middle; frames as they hung before are left out."""
    flanges = list(tree.flanges)
    half = (len(flanges) + 1) // 2
    found_bodies = []
    for name in [*flanges[:half], "cell", *flanges[half:]]:
        mine = [word for word in _edged(tree) if tree.parents[word] == name]
        top = tuple(name for name in mine if name.startswith(_SEERS))
        bottom = tuple(name for name in mine if name.startswith("base"))
        middle = tuple(name for name in mine if name not in top and name not in bottom)
        found_bodies.append(RigidGroup(name, top, middle, bottom))
    return found_bodies


def spans(tree: FrameTree) -> dict[str, tuple[float, float]]:
    """Where each body begins and ends, from left to right."""
    left, found_spans = 0.0, {}
    for body in bodies(tree):
        found_spans[body.name] = (left, left + body.width)
        left += body.width + GAP
    return found_spans


def places(tree: FrameTree) -> dict[str, tuple[float, float]]:
    """Where each frame stands in the drawing, upwards; bodies themselves have none."""
    begins = spans(tree)
    return {
        name: (x, y) for body in bodies(tree) for name, x, y in body.places(begins[body.name][0])
    }

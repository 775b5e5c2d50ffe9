"""The network of an aligned cell as it is drawn: its bodies side by side, and who saw whom."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from visioncal.results import Alignment

# How far frames stand apart, and the gap between bodies, in the units of the drawing.
STEP, GAP = 1.5, 0.8
# Heights of what sees, of what is seen, and of the robots' bases.
_TOP, _MIDDLE, _BOTTOM = 2.5, 1.05, 0.1
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
        unseen_mm: The same of fits that were made without their stops [mm].
        unseen_deg: And in rotation [deg].
    """

    seer: str
    seen: str
    used: int
    left_out: int
    rms_mm: float | None
    rms_deg: float | None
    unseen_mm: float | None
    unseen_deg: float | None


def pairs(found: Alignment) -> tuple[Pair, ...]:
    """Lists who saw whom, and how well that fits."""
    rows: dict[tuple[str, str], list[int]] = {}
    for at, it in enumerate(found.sights):
        rows.setdefault((it.seer, it.seen), []).append(at)
    listed = []
    for (seer, seen), mine in rows.items():
        used = [found.sights[at] for at in mine if found.sights[at].used]
        names = ("residual_mm", "residual_deg", "left_out_mm", "left_out_deg")
        away = (rms([getattr(it, name) for it in used]) for name in names)
        listed.append(Pair(seer, seen, len(used), len(mine) - len(used), *away))
    return tuple(listed)


def rms(values: Sequence[float | None]) -> float | None:
    """Root mean square of those that are known; None of none."""
    known = [it for it in values if it is not None]
    return float(sum(it * it for it in known) / len(known)) ** 0.5 if known else None


@dataclass(frozen=True, eq=False)
class Body:
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


def weakest_frame(found: Alignment) -> str:
    """The frame whose place on its parent is known worst, of those as they hang last."""
    former = {it.before for it in found.moved}
    edges = {it: found.edge_of(it) for it in _edged(found) if it not in former}
    return max(edges, key=lambda it: edges[it].sigma_mm, default="")


def _edged(found: Alignment) -> list[str]:
    return [it for it in found.frames if it not in found.robots]


def bodies(found: Alignment) -> list[Body]:
    """The flanges with the cell in their middle; frames as they hung before are left out."""
    former = {it.before for it in found.moved}
    flanges = list(found.robots)
    half = (len(flanges) + 1) // 2
    found_bodies = []
    for name in [*flanges[:half], "cell", *flanges[half:]]:
        mine = [it for it in _edged(found) if found.frames[it] == name and it not in former]
        top = tuple(it for it in mine if it.startswith(_SEERS))
        bottom = tuple(it for it in mine if it.startswith("base"))
        middle = tuple(it for it in mine if it not in top and it not in bottom)
        found_bodies.append(Body(name, top, middle, bottom))
    return found_bodies


def spans(found: Alignment) -> dict[str, tuple[float, float]]:
    """Where each body begins and ends, from left to right."""
    left, found_spans = 0.0, {}
    for body in bodies(found):
        found_spans[body.name] = (left, left + body.width)
        left += body.width + GAP
    return found_spans


def places(found: Alignment) -> dict[str, tuple[float, float]]:
    """Where each frame stands in the drawing, upwards; bodies themselves have none."""
    begins = spans(found)
    return {
        name: (x, y) for body in bodies(found) for name, x, y in body.places(begins[body.name][0])
    }

"""Layout of the drawing of an aligned cell's network: bodies side by side, and who saw whom."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from visioncal.core.number_format import significant
from visioncal.results import Rms, ViewResult
from visioncal.results.tree import FrameTree
from visioncal.results.views import left_out_rms, rms_of

# Spacing of frames, and gap between bodies, in units of the drawing.
STEP, GAP = 1.5, 0.8
# Heights of sensors, of targets, and of robot bases.
_TOP, _MIDDLE, _BOTTOM = 2.5, 1.05, 0.1
_SEERS = ("cam", "instrument")


@dataclass(frozen=True)
class SeenPair:
    """All observations of one frame by another."""

    seer: str  # Observing frame.
    seen: str  # Observed frame.
    used: int  # Number of observations that the fit used.
    left_out: int  # Number of observations that it did not use.
    rms: Rms | None  # Residuals of the used ones; None if there are none.
    # Their residuals by fits without their stops (cross-validation); None where unknown.
    unseen: Rms | None


def pairs(views: Iterable[ViewResult]) -> tuple[SeenPair, ...]:
    """Observations grouped by observing and observed frame, with their residuals."""
    rows: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        rows.setdefault((view.seer, view.seen), []).append(view)
    summaries = []
    for (seer, seen), group in rows.items():
        used = sum(view.used for view in group)
        unseen = any(view.used and view.left_out_mm is not None for view in group)
        rms = (rms_of(group) if used else None, left_out_rms(group) if unseen else None)
        summaries.append(SeenPair(seer, seen, used, len(group) - used, *rms))
    return tuple(summaries)


@dataclass(frozen=True, eq=False)
class RigidGroup:
    """Frames that are fixed to each other: those of the cell, or of one flange."""

    name: str
    top: tuple[str, ...]
    middle: tuple[str, ...]
    bottom: tuple[str, ...]

    @property
    def width(self) -> float:
        """Width in units of the drawing."""
        return STEP * max(len(self.top), len(self.middle), len(self.bottom), 1)

    def places(self, left: float) -> Iterator[tuple[str, float, float]]:
        """Name and centre (x, y) of each frame's box."""
        rows = ((self.top, _TOP), (self.middle, _MIDDLE), (self.bottom, _BOTTOM))
        for names, height in rows:
            start = left + 0.5 * (self.width - STEP * len(names))
            for column, name in enumerate(names):
                yield name, start + STEP * (column + 0.5), height


def weakest_frame(tree: FrameTree) -> str:
    """The frame whose pose on its parent has the largest sigma, at the end of the session."""
    edges = {name: tree.edge_of(name) for name in _placed(tree)}
    return max(edges, key=lambda frame: edges[frame].sigma_mm, default="")


def sigma_words(tree: FrameTree, frame: str) -> str:
    """Sigma of a frame's pose on its parent, in words."""
    if frame == tree.reference:
        return "the reference"
    edge = tree.edge_of(frame)
    rotation = f", {significant(edge.sigma_deg)}\N{DEGREE SIGN}" if edge.oriented else ""
    return f"{significant(edge.sigma_mm)} mm{rotation}"


def _placed(tree: FrameTree) -> list[str]:
    """Frames with an edge to their parent, at the end of the session."""
    return [name for name in tree.last if name not in tree.flanges]


def bodies(tree: FrameTree) -> list[RigidGroup]:
    """The cell between the flanges, with the frames on each at the end of the session."""
    flanges = list(tree.flanges)
    half = (len(flanges) + 1) // 2
    groups = []
    for body in [*flanges[:half], "cell", *flanges[half:]]:
        frames = [frame for frame in _placed(tree) if tree.parents[frame] == body]
        top = tuple(frame for frame in frames if frame.startswith(_SEERS))
        bottom = tuple(frame for frame in frames if frame.startswith("base"))
        middle = tuple(frame for frame in frames if frame not in top and frame not in bottom)
        groups.append(RigidGroup(body, top, middle, bottom))
    return groups


def spans(tree: FrameTree) -> dict[str, tuple[float, float]]:
    """Left and right end of each body, from left to right."""
    left, ends = 0.0, {}
    for body in bodies(tree):
        ends[body.name] = (left, left + body.width)
        left += body.width + GAP
    return ends


def places(tree: FrameTree) -> dict[str, tuple[float, float]]:
    """Position of each frame in the drawing, y upwards; bodies have none."""
    begins = spans(tree)
    return {
        name: (x, y) for body in bodies(tree) for name, x, y in body.places(begins[body.name][0])
    }

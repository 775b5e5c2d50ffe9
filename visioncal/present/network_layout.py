"""Layout of the drawing of an aligned cell's network: bodies side by side, and who saw whom."""

from collections.abc import Iterable
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


def layout(
    tree: FrameTree,
) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]]:
    """Places in the drawing of the cell, which stands between the flanges, at the session's end.

    Returns:
        Left and right end of each body, the cell or a flange with what it carries, from left to
        right; and the centre (x, y) of each frame's box, y upwards.
    """
    flanges, left = list(tree.flanges), 0.0
    half = (len(flanges) + 1) // 2
    spans: dict[str, tuple[float, float]] = {}
    places: dict[str, tuple[float, float]] = {}
    for body in [*flanges[:half], "cell", *flanges[half:]]:
        frames = [frame for frame in _placed(tree) if tree.parents[frame] == body]
        top = [frame for frame in frames if frame.startswith(_SEERS)]
        bottom = [frame for frame in frames if frame.startswith("base")]
        middle = [frame for frame in frames if frame not in top and frame not in bottom]
        width = STEP * max(len(top), len(middle), len(bottom), 1)
        for names, height in ((top, _TOP), (middle, _MIDDLE), (bottom, _BOTTOM)):
            start = left + 0.5 * (width - STEP * len(names))
            places |= {
                name: (start + STEP * (column + 0.5), height) for column, name in enumerate(names)
            }
        spans[body] = (left, left + width)
        left += width + GAP
    return spans, places

"""The network of a cell: who saw whom, and how well each frame is known."""

from collections.abc import Iterable
from dataclasses import dataclass

from visioncal.core.number_format import significant
from visioncal.results import Rms, ViewResult
from visioncal.results.tree import FrameTree
from visioncal.results.views import left_out_rms, rms_of


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


def sigma_words(tree: FrameTree, frame: str) -> str:
    """Sigma of a frame's pose on its parent, in words."""
    if frame == tree.reference:
        return "the reference"
    edge = tree.edge_of(frame)
    rotation = f", {significant(edge.sigma_deg)}\N{DEGREE SIGN}" if edge.oriented else ""
    return f"{significant(edge.sigma_mm)} mm{rotation}"

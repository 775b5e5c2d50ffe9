"""Which views to look at."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import listed, significant
from visioncal.results import Calibration, ViewResult

# Views whose residual is this many times the median are named, as by the verdict.
_STANDS_OUT = CalibrationLimits.outlier
# So begins the reason of a view that was left out because pose and image do not go together.
_CONTRADICTS = "disagrees with "

# So many views of one reason are named.
_MOST_LISTED = 12


@dataclass(frozen=True)
class Suspects:
    """Views that share what is to be said of them.

    Attributes:
        views: Their numbers.
        used: Whether they are in the fit nevertheless.
        why: What is wrong with them, in words.
        of: Who saw whom in them; empty of one camera.
    """

    views: tuple[int, ...]
    used: bool
    why: str
    of: str = ""

    @property
    def contradict(self) -> bool:
        """Whether they were left out because they contradict the others."""
        return not self.used and self.why.startswith(_CONTRADICTS)

    @property
    def words(self) -> str:
        """Them, with what is wrong: `views 3 and 6 (cam_top of target): blurred`."""
        of = f" ({self.of})" if self.of else ""
        return f"{view_list(self.views)}{of}: {self.why}"


def suspects(calibration: Calibration) -> tuple[Suspects, ...]:
    """The used views that stand out, and then those that were not used, by their reasons.

    In a good result none stands out: that one view sees the board less well than others is no
    doubt.
    """
    found, by_pair = calibration.views, dict[str, list[ViewResult]]()
    for other in found if calibration.verdict.status != "good" else ():
        by_pair.setdefault(_of(other), []).append(other)
    outlying = (
        Suspects((view,), used=True, why=why, of=of)
        for of, mine in by_pair.items()
        for view, why in _outlying(mine).items()
    )
    return (*outlying, *left_out(found))


def left_out(found: Iterable[ViewResult]) -> Iterator[Suspects]:
    """Those of some views that were not used, by their reasons."""
    by_reason: dict[tuple[str, str], list[int]] = {}
    for view in found:
        if not view.used:
            by_reason.setdefault((_of(view), view.reason), []).append(view.view)
    for (of, why), views in by_reason.items():
        yield Suspects(tuple(views), used=False, why=why, of=of)


def _of(view: ViewResult) -> str:
    return f"{view.seer} of {view.seen}" if view.seer else ""


def outlying_views(found: Sequence[Suspects]) -> tuple[int, ...]:
    """Numbers of the used views among suspects, ascending."""
    return tuple(sorted(view for item in found if item.used for view in item.views))


def contradicts(view: ViewResult) -> bool:
    """Whether a view was left out because it contradicts the others."""
    return not view.used and view.reason.startswith(_CONTRADICTS)


def named(view: ViewResult) -> str:
    """The number of a view, and who saw whom where that has names."""
    of = _of(view)
    return f"{view.view} ({of})" if of else str(view.view)


def mark_of(view: ViewResult) -> str:
    """What became of a view: `used`, `left-out` for contradicting others, or `rejected`."""
    if view.used:
        return "used"
    return "left-out" if contradicts(view) else "rejected"


def _outlying(views: Sequence[ViewResult]) -> dict[int, str]:
    """Words for the used views whose residual is many times as long as the median, by view."""
    kinds: list[tuple[str, Callable[[ViewResult], float | None]]] = [
        ("mm", lambda view: view.residual_mm),
        ("deg", lambda view: view.residual_deg),
    ]
    words: dict[int, list[str]] = {}
    for unit, value_of in kinds:
        values = {
            view.view: value
            for view in views
            if view.used and (value := value_of(view)) is not None
        }
        median = float(np.median(list(values.values()))) if values else 0.0
        for view, value in values.items():
            if value > _STANDS_OUT * median > 0.0:
                words.setdefault(view, []).append(
                    f"{significant(value)} {unit} (median {significant(median)})"
                )
    return {view: f"off by {' and '.join(word)}" for view, word in words.items()}


def view_list(views: Sequence[int]) -> str:
    """Names views in a sentence: `view 3`, or `views 3, 6 and 9`."""
    if len(views) == 1:
        return f"view {views[0]}"
    if len(views) > _MOST_LISTED:
        return f"{len(views)} views, as {', '.join(map(str, views[:_MOST_LISTED]))}"
    return f"views {listed([*map(str, views)])}"

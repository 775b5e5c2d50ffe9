"""Which views to look at."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import significant
from visioncal.results import Calibration, ViewResult

# Views whose residual is this many times the median are named, as by the verdict.
_STANDS_OUT = CalibrationLimits.outlier
# So begins the reason of a view that was left out because pose and image do not go together.
_CONTRADICTS = "disagrees with the other views"

# So many views of one reason are named.
_MOST_LISTED = 12


@dataclass(frozen=True)
class Suspects:
    """Views that share what is to be said of them.

    Attributes:
        views: Their numbers.
        used: Whether they are in the fit nevertheless.
        why: What is wrong with them, in words.
    """

    views: tuple[int, ...]
    used: bool
    why: str

    @property
    def contradict(self) -> bool:
        """Whether they were left out because they contradict the others."""
        return not self.used and self.why.startswith(_CONTRADICTS)


def suspects(calibration: Calibration) -> tuple[Suspects, ...]:
    """The used views that stand out, and then those that were not used, by their reasons.

    In a good result none stands out: that one view sees the board less well than others is no
    doubt.
    """
    outlying = {} if calibration.verdict.status == "good" else _outlying(calibration.views)
    by_reason: dict[str, list[int]] = {}
    for view in calibration.views:
        if not view.used:
            by_reason.setdefault(view.reason, []).append(view.view)
    return (
        *(Suspects((view,), used=True, why=why) for view, why in outlying.items()),
        *(Suspects(tuple(it), used=False, why=why) for why, it in by_reason.items()),
    )


def outlying_views(found: Sequence[Suspects]) -> tuple[int, ...]:
    """Numbers of the used views among suspects, ascending."""
    return tuple(sorted(view for it in found if it.used for view in it.views))


def contradicts(view: ViewResult) -> bool:
    """Whether a view was left out because it contradicts the others."""
    return not view.used and view.reason.startswith(_CONTRADICTS)


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
    return {view: f"off by {' and '.join(it)}" for view, it in words.items()}


def listed(views: Sequence[int]) -> str:
    """Names views in a sentence: `view 3`, or `views 3, 6 and 9`."""
    if len(views) == 1:
        return f"view {views[0]}"
    if len(views) > _MOST_LISTED:
        return f"{len(views)} views, as {', '.join(map(str, views[:_MOST_LISTED]))}"
    return f"views {', '.join(map(str, views[:-1]))} and {views[-1]}"

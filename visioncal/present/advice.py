"""Views that deserve a look: outliers of the fit, and views that were left out of it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import listed, significant
from visioncal.results import Calibration, ViewResult

# A used view is listed if its residual exceeds this many medians, as in the verdict.
_OUTLIER_FACTOR = CalibrationLimits.outlier

# At most this many views are listed by number.
_MOST_LISTED = 12


@dataclass(frozen=True)
class FlaggedViews:
    """Views that share a finding."""

    views: tuple[int, ...]  # View numbers.
    used: bool  # Whether the fit uses them nevertheless.
    why: str  # The finding, in words.
    # The observing and the observed frame, as `cam_top of target`; empty for one camera.
    of: str = ""
    contradict: bool = False  # Whether they were left out because they contradict the other views.

    @property
    def words(self) -> str:
        """Views and finding: `views 3 and 6 (cam_top of target): blurred`."""
        of = f" ({self.of})" if self.of else ""
        return f"{view_list(self.views)}{of}: {self.why}"


def suspects(calibration: Calibration) -> tuple[FlaggedViews, ...]:
    """Outlying used views, then the views that were not used, grouped by reason.

    A good result has no outlying views: that one view sees the board less well is no reason for
    doubt.
    """
    by_pair = dict[str, list[ViewResult]]()
    for view in calibration.views if calibration.verdict.status != "good" else ():
        by_pair.setdefault(_pair_words(view), []).append(view)
    outlying = (
        FlaggedViews((number,), used=True, why=why, of=of)
        for of, pair_views in by_pair.items()
        for number, why in _outlying(pair_views).items()
    )
    return (*outlying, *left_out(calibration.views))


def left_out(views: Iterable[ViewResult]) -> Iterator[FlaggedViews]:
    """Views that were not used, grouped by reason."""
    by_reason: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        if not view.used:
            by_reason.setdefault((_pair_words(view), view.reason), []).append(view)
    for (of, why), alike in by_reason.items():
        numbers = tuple(view.view for view in alike)
        yield FlaggedViews(numbers, False, why, of, contradict=alike[0].contradicts)


def _pair_words(view: ViewResult) -> str:
    return f"{view.seer} of {view.seen}" if view.seer else ""


def named(view: ViewResult) -> str:
    """A view's number, with the observing and the observed frame if they have names."""
    of = _pair_words(view)
    return f"{view.view} ({of})" if of else str(view.view)


def _outlying(views: Sequence[ViewResult]) -> dict[int, str]:
    """Words for the used views whose residual exceeds a multiple of the median, by view."""
    words: dict[int, list[str]] = {}
    for unit, name in (("mm", "residual_mm"), ("deg", "residual_deg")):
        measured = {view.view: getattr(view, name) for view in views if view.used}
        values = {view: value for view, value in measured.items() if value is not None}
        median = float(np.median(list(values.values()))) if values else 0.0
        for view, value in values.items():
            if value > _OUTLIER_FACTOR * median > 0.0:
                words.setdefault(view, []).append(
                    f"{significant(value)} {unit} (median {significant(median)})"
                )
    return {view: f"off by {' and '.join(word)}" for view, word in words.items()}


def view_list(views: Sequence[int]) -> str:
    """Views in a sentence: `view 3`, or `views 3, 6 and 9`."""
    if len(views) == 1:
        return f"view {views[0]}"
    if len(views) > _MOST_LISTED:
        return f"{len(views)} views, as {', '.join(map(str, views[:_MOST_LISTED]))}"
    return f"views {listed([*map(str, views)])}"

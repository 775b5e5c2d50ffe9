"""The figure of a cell's years: where each transform was, with its sigma, and what happened."""

from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np
from matplotlib import dates
from matplotlib.figure import Figure

from visioncal.core.number_format import percent
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    CHECK,
    GOOD,
    INK,
    MUTED,
    SMALL,
    WIDE_IN,
    drawn,
    few_ticks,
    legend,
    panels,
)
from visioncal.results.history import Entry
from visioncal.results.years import YEAR_DAYS, Course

_DATES: Any = dates
# Marks of acts, along the lower edge.
_MARKS = {"calibrated": "^", "verified": "o", "tool": "s", "fixture": "D", "touched": "x"}
_AXES = {"x": ACCENT, "y": GOOD, "z": CHECK}


@drawn
def years(name: str, courses: Sequence[Course], acts: Sequence[Entry]) -> tuple[Figure, str]:
    """Each transform's course since its first entry, in its parent: position, and any rotation.

    Args:
        name: Name of the cell.
        courses: Its transforms; those of one entry are left out.
        acts: All its acts, in the order of time.
    """
    shown = [course for course in courses if len(course.entries) > 1]
    height_in = 1.75 * len(shown) + 0.75
    figure, grid = panels(WIDE_IN, height_in, len(shown), 2, (0.75, 0.35, 0.1, 0.5), sharex=True)
    figure.subplots_adjust(wspace=0.2, hspace=0.3)
    for course, row in zip(shown, grid, strict=True):
        times = _DATES.date2num([entry.time for entry in course.entries])
        marked: dict[tuple[str, str], list[datetime]] = {}
        for act in acts:
            if course.name in act.edges or not act.edges:
                sign = _MARKS[act.kind], BAD if act.status == "bad" else MUTED
                marked.setdefault(sign, []).append(act.time)
        for axes, first, scale, unit in zip(
            row, (-3, -6), (1e3, np.rad2deg(1.0)), ("mm", "deg"), strict=True
        ):
            if -first > course.offsets.shape[1]:
                axes.set_axis_off()
                continue
            part = slice(first, first + 3 or None)
            values, sigmas = scale * course.offsets[:, part], scale * course.sigmas[:, part]
            for at, colour in enumerate(_AXES.values()):
                value, band = values[:, at], sigmas[:, at]
                axes.fill_between(times, value - band, value + band, color=colour, alpha=0.18,
                                  linewidth=0.0)  # fmt: skip
                axes.plot(times, value, ".-", color=colour, linewidth=1.2, markersize=4.0)
            for step in course.steps:
                middle = times[step.at - 1 : step.at + 1].mean()
                axes.axvline(middle, color=BAD, linestyle="--", linewidth=1.0)
                axes.annotate(percent(step.probability), (middle, 1.0), xytext=(2.0, -2.0),
                              xycoords=("data", "axes fraction"), textcoords="offset points",
                              fontsize=SMALL, color=BAD, va="top")  # fmt: skip
            if course.drift is not None:
                # Through the entries since the latest step.
                begin = max((step.at for step in course.steps), default=0)
                rate = scale * course.drift.vector[part] / YEAR_DAYS
                line = values[begin:].mean(axis=0) + np.outer(
                    times[begin:] - times[begin:].mean(), rate
                )
                axes.plot(times[begin:], line, color=INK, linestyle=":", linewidth=1.2)
            for (mark, colour), when in marked.items():
                axes.plot(_DATES.date2num(when), [0.03] * len(when), mark, color=colour,
                          transform=axes.get_xaxis_transform(), markersize=4.0,
                          clip_on=False)  # fmt: skip
            axes.set_ylabel(f"{'position' if unit == 'mm' else 'rotation'} [{unit}]")
            # Stated, since matplotlib's search for a free place takes a seventh of the time.
            axes.set_title(course.name, loc="left", color=INK, y=1.0)
            few_ticks(axes, y=4)
            locator = _DATES.AutoDateLocator(maxticks=7)
            axes.xaxis.set_major_locator(locator)
            axes.xaxis.set_major_formatter(_DATES.ConciseDateFormatter(locator))
    kinds = {act.kind for act in acts}
    legend(
        figure,
        [
            *(("line", colour, axis) for axis, colour in _AXES.items()),
            *((mark, MUTED, kind) for kind, mark in _MARKS.items() if kind in kinds),
        ],
    )
    words = f"The years of {name}: position and rotation of its transforms since the first entry"
    return figure, words

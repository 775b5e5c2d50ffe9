"""The page of a fleet and its years: a row a cell, the worst first, and the course of each."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import pairwise

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import figure, percent, significant
from visioncal.present.report.templates import template
from visioncal.results.history import Entry
from visioncal.results.years import Change, Course, courses

# Days after which a cell should have been checked again; weeks of notice of a need that will be
# missed; days for which a step, or a sigma that grew, is a reason to look; and by how much it grew.
_UNCHECKED_DAYS, _NOTICE_WEEKS, _RECENT_DAYS, _GREW = 90, 26, 365, 1.5
_STATES = ("good", "check", "bad", "no result")
_CHECKS = ("calibrated", "verified", "touched")


@dataclass(frozen=True)
class Matter:
    """What is to be said of a cell."""

    rank: int  # Its place among the matters of all cells; the least comes first.
    words: str  # A sentence with figures.
    next_step: str = ""  # What to do.


@dataclass(frozen=True, eq=False)
class FleetRow:
    """A cell on the page."""

    name: str  # Name of the cell.
    entries: tuple[Entry, ...]  # Its acts in the order of time; none for a failure.
    matters: tuple[Matter, ...]  # What is to be said of it, the worst first; never empty.
    status: str = "no result"  # One of `_STATES`.
    courses: tuple[Course, ...] = ()
    link: str = ""  # Where its result lies, relative to the page.

    @property
    def icon(self) -> str:
        """The status as the page's icons have it."""
        return "bad" if self.status == "no result" else self.status

    @property
    def checked(self) -> str:
        """When it was checked for the last time, in words; empty for never."""
        times = [entry.time for entry in self.entries if entry.kind in _CHECKS]
        return _day(times[-1]) if times else ""

    @property
    def calibrated(self) -> Entry | None:
        """Its latest calibration; None where it has none."""
        found = [entry for entry in self.entries if entry.kind == "calibrated"]
        return found[-1] if found else None

    @cached_property
    def drawing(self) -> Markup:
        """The figure of its years; empty before there are two entries of a transform."""
        if all(len(course.entries) < 2 for course in self.courses):
            return Markup("")
        # A page of one day does not wait for the plots.
        from visioncal.present.report.yearplots import years

        return years(self.name, self.courses, self.entries)


def row_of(
    name: str, entries: Sequence[Entry], now: datetime | None = None, link: str = ""
) -> FleetRow:
    """The row of a cell.

    Args:
        name: Its name.
        entries: Its acts in the order of time; one at least.
        now: The time; None for a page of one day, which does not ask when it was checked.
        link: Where its result lies, relative to the page.
    """
    latest = _latest(entries)
    worst = max(latest, key=lambda entry: _STATES.index(entry.status))
    row = FleetRow(name, tuple(entries), (), worst.status, courses(entries), link)
    said = [_verdict(row, worst), *_changes(row, now or entries[-1].time)]
    checks = [entry for entry in entries if entry.kind in _CHECKS]
    if now is not None and checks and (now - checks[-1].time).days > _UNCHECKED_DAYS:
        said.append(
            Matter(
                5,
                f"Nothing has checked it since {_day(checks[-1].time)}, "
                f"{(now - checks[-1].time).days} days ago.",
                "Five stops are enough: visioncal verify SESSION --against OUT.",
            )
        )
    return replace(row, matters=tuple(sorted(said, key=lambda matter: matter.rank)))


def failed_row(name: str, words: str, next_step: str) -> FleetRow:
    """The row of a session without a result."""
    return FleetRow(name, (), (Matter(0, words, next_step),))


def fleet_page(rows: Sequence[FleetRow], kind: str, name: str, table: str = "") -> str:
    """Renders the page as HTML text, the worst rows first.

    Args:
        rows: The cells.
        kind: What it is a page of.
        name: Its heading.
        table: The same as a table, relative to the page; empty for none.
    """
    ordered = sorted(rows, key=lambda row: (row.matters[0].rank, row.name))
    states = Counter(row.status for row in rows)
    return template("fleet.html.j2", has_result=False).render(
        kind=kind,
        name=name,
        subtitle="",
        notes=(),
        rows=ordered,
        states=[(state, states[state]) for state in _STATES],
        table=table,
        figure=lambda value: "" if value is None else significant(value),
    )


def page_of_history(entries: Sequence[Entry], name: str, now: datetime) -> str:
    """The page of a history's entries, in the order of time; see `fleet_page`."""
    by_cell: dict[str, list[Entry]] = {}
    for entry in entries:
        by_cell.setdefault(entry.cell, []).append(entry)
    rows = [row_of(cell, acts, now) for cell, acts in by_cell.items()]
    return fleet_page(rows, "History", name)


def _latest(entries: Sequence[Entry]) -> tuple[Entry, ...]:
    """The act that counts: the latest check, and the latest of each tool and fixture."""
    latest = {}
    for entry in entries:
        latest["" if entry.kind in _CHECKS else next(iter(entry.edges), "")] = entry
    return tuple(latest.values())


def _verdict(row: FleetRow, worst: Entry) -> Matter:
    """The verdict's first reason; of a bad one since when."""
    if worst.status != "bad":
        return Matter(7 if worst.status == "good" else 6, worst.reason)
    before = [entry for entry in row.entries if entry.edges.keys() >= worst.edges.keys()]
    sound = [entry for entry in before if entry.status != "bad" and entry.at < worst.at]
    since = f" It was {sound[-1].status} on {_day(sound[-1].time)}." if sound else ""
    return Matter(1, f"{worst.reason}{since}")


def _changes(row: FleetRow, now: datetime) -> Iterator[Matter]:
    for course in row.courses:
        moved = [step for step in course.steps if _is_recent(course, step, now)]
        for step in moved[-1:]:
            lengths = f"{figure(1e3 * float(np.linalg.norm(step.vector[-3:])))} mm"
            if len(step.vector) == 6:
                turn = float(np.rad2deg(np.linalg.norm(step.vector[:3])))
                lengths += f" and {figure(turn)} deg"
            yield Matter(
                3,
                f"{course.name} stepped by {lengths} {_between(course, step)}.",
                "Look at what holds it, and whether something has hit it.",
            )
        if course.drift is not None:
            yield _drifting(row, course, course.drift, now)
        # The latest only: what has fallen again is no matter.
        for step in course.sigma_steps[-1:]:
            ratio = float(np.exp(step.vector[0]))
            if ratio > _GREW and _is_recent(course, step, now):
                sigmas = [entry.edges[course.name].sigma_mm for entry in course.entries]
                before, after = sigmas[: step.at], sigmas[step.at :]
                yield Matter(
                    4,
                    f"The sigma of {course.name} rose from {figure(float(np.median(before)))} to "
                    f"{figure(float(np.median(after)))} mm {_between(course, step)}.",
                    "Look at what is new since: the board and its print, the lens, the stops.",
                )


def _drifting(row: FleetRow, course: Course, drift: Change, now: datetime) -> Matter:
    needs = [entry.need.mm for entry in row.entries if entry.need and entry.need.mm]
    good = course.entries[-1].good_for_mm
    speed = f"{figure(1e3 * float(np.linalg.norm(drift.vector[-3:])))} mm a year"
    words = f"{course.name} creeps by {speed} ({percent(drift.probability)})"
    times = course.missed(needs[-1], good) if needs else None
    if times is None:
        return Matter(6, f"{words}; no need is stated that it would miss.")
    likely, early, late = times
    # The last years of a calendar are no forecast.
    until = "or never" if (late - now).days > 10 * 365 else f"to {_day(late)}"
    missed = f"the need of {figure(needs[-1])} mm"
    weeks = (likely - now).days / 7.0
    when = f"{_day(likely)} (95 %: {_day(early)} {until})"
    words += (
        f": picks by its latest pose have missed {missed} since {when}."
        if weeks < 0.0
        else f": by its latest pose {missed} will be missed in {weeks:.0f} weeks, on {when}."
    )
    step = "Place it again before then, and look for what gives way."
    return Matter(2 if weeks < _NOTICE_WEEKS else 6, words, step)


def _is_recent(course: Course, step: Change, now: datetime) -> bool:
    return (now - course.entries[step.at].time).days <= _RECENT_DAYS


def _between(course: Course, step: Change) -> str:
    (before, after), *_ = pairwise(course.entries[step.at - 1 : step.at + 1])
    days = f"between {_day(before.time)} and {_day(after.time)}"
    return f"{days} ({percent(step.probability)})"


def _day(time: datetime) -> str:
    return f"{time.day} {time:%b %Y}"

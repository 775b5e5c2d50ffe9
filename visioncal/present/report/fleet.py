"""The page of a fleet and its years: a row a cell, the worst first, and the course of each."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import figure, percent, significant
from visioncal.present.report.templates import template
from visioncal.results.history import Entry
from visioncal.results.years import Change, Course, courses

_STATES = ("good", "check", "bad", "no result")
_CHECKS = ("calibrated", "verified", "touched")


@dataclass(frozen=True, order=True)
class Matter:
    """A remark on a cell."""

    rank: int  # Its place among the matters of all cells; the least comes first.
    words: str  # In sentences, with what to do.


@dataclass(frozen=True, eq=False)
class FleetRow:
    """A cell on the page."""

    name: str  # Name of the cell.
    entries: tuple[Entry, ...] = ()  # Its acts in the order of time; none for a failure.
    # The time; None on a page of one day, which does not ask when a cell was checked.
    now: datetime | None = None
    link: str = ""  # Where its result lies, relative to the page.
    failure: str = ""  # Why there are no entries, and what to do.

    @cached_property
    def courses(self) -> tuple[Course, ...]:
        """Courses of the cell's transforms over the years."""
        return courses(self.entries)

    @cached_property
    def worst(self) -> Entry | None:
        """The worst act that counts: of the last check, and of the last of each tool and fixture.

        None for a failure.
        """
        latest = {}
        for entry in self.entries:
            latest["" if entry.kind in _CHECKS else next(iter(entry.edges))] = entry
        by_status = sorted(latest.values(), key=lambda entry: _STATES.index(entry.status))
        return by_status[-1] if by_status else None

    @property
    def status(self) -> str:
        """One of `_STATES`."""
        return "no result" if self.worst is None else self.worst.status

    def last(self, *kinds: str) -> Entry | None:
        """The cell's last act of the given kinds; None without one."""
        return next((entry for entry in reversed(self.entries) if entry.kind in kinds), None)

    @property
    def checked(self) -> str:
        """When it was checked for the last time, in words; empty for never."""
        last = self.last(*_CHECKS)
        return "" if last is None else _day(last.time)

    @cached_property
    def matters(self) -> list[Matter]:
        """Remarks on the cell, the worst first; never empty."""
        worst, last = self.worst, self.last(*_CHECKS)
        if worst is None:
            return [Matter(0, self.failure)]
        rank, since = {"bad": 1, "check": 6, "good": 7}[worst.status], ""
        same = (entry for entry in self.entries if entry.edges.keys() == worst.edges.keys())
        sound = [entry for entry in same if entry.status != "bad" and entry.at < worst.at]
        if rank == 1 and sound:
            since = f" It was {sound[-1].status} on {_day(sound[-1].time)}."
        now = self.now or self.entries[-1].time
        said = [Matter(rank, f"{worst.reason}{since}"), *self._changes(now)]
        days = 0 if last is None or self.now is None else (now - last.time).days
        # A cell should have been checked again after so many days.
        if days > 90:
            words = f"Nothing has checked it since {self.checked}, {days} days ago."
            advice = "Five stops are enough: visioncal verify SESSION --against OUT."
            said.append(Matter(5, f"{words} {advice}"))
        return sorted(said)

    def _changes(self, now: datetime) -> Iterator[Matter]:
        for course in self.courses:
            # The latest step only: what has fallen again is no matter.
            for step in course.steps[-1:]:
                if _is_recent(course, step, now):
                    lengths = f"{figure(1e3 * float(np.linalg.norm(step.vector[-3:])))} mm"
                    if len(step.vector) == 6:
                        turn = float(np.rad2deg(np.linalg.norm(step.vector[:3])))
                        lengths += f" and {figure(turn)} deg"
                    yield Matter(
                        3,
                        f"{course.name} stepped by {lengths} {_between(course, step)}. Look at "
                        "what holds it, and whether something has hit it.",
                    )
            if course.drift is not None:
                yield self._drifting(course, course.drift, now)
            for step in course.sigma_steps[-1:]:
                if np.exp(step.vector[0]) > 1.5 and _is_recent(course, step, now):
                    sigmas = [entry.edges[course.name].sigma_mm for entry in course.entries]
                    sides = sigmas[: step.at], sigmas[step.at :]
                    before, after = (figure(float(np.median(side))) for side in sides)
                    yield Matter(
                        4,
                        f"The sigma of {course.name} rose from {before} to {after} mm "
                        f"{_between(course, step)}. Look at what is new since: the board and its "
                        "print, the lens, the stops.",
                    )

    def _drifting(self, course: Course, drift: Change, now: datetime) -> Matter:
        needs = [entry.need.mm for entry in self.entries if entry.need and entry.need.mm]
        speed = f"{figure(1e3 * float(np.linalg.norm(drift.vector[-3:])))} mm a year"
        words = f"{course.name} creeps by {speed} ({percent(drift.probability)})"
        if not needs:
            return Matter(6, f"{words}; no need is stated that it would miss.")
        likely, early, late = course.missed(drift, needs[-1])
        # Ten years from now is no forecast.
        until = "or never" if (late - now).days > 3650 else f"to {_day(late)}"
        when = f"{_day(likely)} (95 %: {_day(early)} {until})"
        weeks, need = (likely - now).days / 7.0, f"the need of {figure(needs[-1])} mm"
        # Weeks of notice of a need that will be missed.
        return Matter(
            2 if weeks < 26 else 6,
            f"{words}: by its latest pose {need} "
            + (f"is missed since {when}. " if weeks < 0 else "")
            + (f"will be missed in {weeks:.0f} weeks, on {when}. " if weeks >= 0 else "")
            + "Place it again before, and look for what gives way.",
        )

    @cached_property
    def drawing(self) -> Markup:
        """The figure of its years; empty before there are two entries of a transform."""
        if all(len(course.entries) < 2 for course in self.courses):
            return Markup("")
        # A page of one day does not wait for the plots.
        from visioncal.present.report.yearplots import years

        return years(self.name, self.courses, self.entries)


def fleet_page(rows: Sequence[FleetRow], kind: str, name: str, table: str = "") -> str:
    """Renders the page as HTML text, the worst rows first.

    Args:
        rows: The cells.
        kind: What it is a page of.
        name: Its heading.
        table: The same as a table, relative to the page; empty for none.
    """
    states = Counter(row.status for row in rows)
    return template("fleet.html.j2", has_result=False).render(
        kind=kind,
        name=name,
        subtitle="",
        notes=(),
        rows=sorted(rows, key=lambda row: (row.matters[0].rank, row.name)),
        states=[(state, states[state]) for state in _STATES],
        table=table,
        # Cells whose years are drawn, the worst: each takes a third of a second.
        drawn=40,
        figure=lambda value: "" if value is None else significant(value),
    )


def page_of_history(entries: Sequence[Entry], name: str, now: datetime) -> str:
    """The page of a history's entries, in the order of time; see `fleet_page`."""
    by_cell: dict[str, list[Entry]] = {}
    for entry in entries:
        by_cell.setdefault(entry.cell, []).append(entry)
    rows = [FleetRow(cell, tuple(acts), now) for cell, acts in by_cell.items()]
    return fleet_page(rows, "History", name)


def _is_recent(course: Course, step: Change, now: datetime) -> bool:
    # Days for which a step, or a sigma that grew, is a reason to look.
    return (now - course.entries[step.at].time).days <= 365


def _between(course: Course, step: Change) -> str:
    before, after = (_day(course.entries[at].time) for at in (step.at - 1, step.at))
    return f"between {before} and {after} ({percent(step.probability)})"


def _day(time: datetime) -> str:
    return f"{time.day} {time:%b %Y}"

"""Texts in Markdown and plots of a result: verdict, figures, and residuals of every view."""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, Literal

import rerun as rr
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.core.types import Target
from visioncal.present import advice, arms, details, facts
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.present.tables import Fact, Table
from visioncal.present.words import said, templates_of
from visioncal.results import Calibration, ViewResult
from visioncal.session import View

_Part = Literal["verdict", "figures", "solvers", "tools", "arms"]
_DOCUMENTS: dict[str, _Part] = {
    paths.VERDICT: "verdict",
    paths.FIGURES: "figures",
    paths.SOLVERS: "solvers",
    paths.TOOLS: "tools",
    paths.ARM_NOTE: "arms",
}
_PLOTS = {
    paths.POSITION_MM: "residual_mm",
    paths.ORIENTATION_DEG: "residual_deg",
    paths.REPROJECTION_PX: "rms_px",
}
_MARKS = (
    (paths.USED, "used", colours.USED, rr.components.MarkerShape.Circle, 3.5),
    (paths.REJECTED, "not used", colours.REJECTED, rr.components.MarkerShape.Cross, 6.0),
    (
        paths.BEYOND,
        "not used, beyond the scale",
        colours.REJECTED,
        rr.components.MarkerShape.Up,
        6.0,
    ),
)
# End of a plot's scale, as a multiple of the used views' largest residual.
_ROOM = 1.25
# Marks of rows that are set in bold.
_BOLD = ("taken", "sure")


def log_static(
    stream: rr.RecordingStream, calibration: Calibration, targets: Mapping[str, Target]
) -> None:
    """Logs the verdict, further texts, and the style of the residual plots."""
    for entity, part in _DOCUMENTS.items():
        text = result_markdown(part, calibration, targets)
        if text:
            stream.log(entity, markdown(text), static=True)
    # A point in the verdict's colour, as an empty view would say that it is empty.
    point = rr.Points2D([[0.0, 0.0]], colors=colours.VERDICT[calibration.verdict.status])
    stream.log(paths.VERDICT_STRIP, point, static=True)
    for seer in dict.fromkeys(view.seer for view in calibration.views):
        for plot in _PLOTS:
            for name, label, colour, marker, size in _MARKS:
                points = rr.SeriesPoints(
                    colors=colour, markers=marker, marker_sizes=size, names=label
                )
                stream.log(f"{paths.part_of(plot, seer)}/{name}", points, static=True)


def log_views(
    stream: rr.RecordingStream,
    sights: Mapping[int, ViewResult],
    rows: Mapping[int, View],
    unposed: Mapping[int, Sequence[str]] = MappingProxyType({}),
) -> None:
    """Logs residuals and status of the views, by row; `unposed` are robots without a pose."""
    by_seer: dict[str, dict[int, ViewResult]] = defaultdict(dict)
    for row, sight in sights.items():
        by_seer[sight.seer][row] = sight
    for seer, seer_sights in by_seer.items():
        for plot, attribute in _PLOTS.items():
            _log_residuals(stream, paths.part_of(plot, seer), seer_sights, attribute)
    texts = [
        view_markdown(sights[row], () if view.is_of_lens else unposed.get(row, ()))
        if row in sights
        # Without any observation of the cell.
        else f"# View {view.number}\n\n"
        + ("for the lens alone" if view.is_of_lens else "it has a robot's pose alone")
        for row, view in rows.items()
    ]
    columns = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))
    send_rows(stream, paths.VIEW_NOTE, rows, columns)


def _log_residuals(
    stream: rr.RecordingStream, plot: str, sights: Mapping[int, ViewResult], attribute: str
) -> None:
    """Logs one kind of residual of the views, by row."""
    values = {row: getattr(sight, attribute) for row, sight in sights.items()}
    used = [value for row, value in values.items() if value is not None and sights[row].used]
    # Views that were not used must not compress the scale.
    end, marks = _ROOM * max(used, default=math.inf), defaultdict[str, dict[int, float]](dict)
    for row, value in values.items():
        if sights[row].used:
            if value is not None:
                marks[paths.USED][row] = float(value)
        # Marked on the axis if unknown: a gap would suggest that there is no such view.
        elif (value or 0.0) > end:
            marks[paths.BEYOND][row] = end
        else:
            marks[paths.REJECTED][row] = float(value or 0.0)
    for name, marked in marks.items():
        log_scalars(stream, f"{plot}/{name}", marked)


def log_scalars(stream: rr.RecordingStream, entity: str, values: Mapping[int, float]) -> None:
    """Logs one number per view, by row."""
    if values:
        send_rows(stream, entity, values, rr.Scalars.columns(scalars=list(values.values())))


def result_markdown(
    part: _Part,
    calibration: Calibration,
    targets: Mapping[str, Target] = MappingProxyType({}),
) -> str:
    """A document on a result; empty where there is nothing to say.

    Args:
        part: The verdict with the transforms and the views left out; figures of residuals, noise
            and uncertainty; the solvers compared; tools and fixtures; the arms.
        calibration: The result.
        targets: Boards as the session states them, by their names in results.
    """
    text = str(getattr(_documents(), part)(calibration, targets)).strip()
    return re.sub(r"\n{3,}", "\n\n", text)


@cache
def _documents() -> Any:  # noqa: ANN401 - a module of macros
    environment = templates_of(
        "present/recording",
        autoescape=True,
        finalize=lambda value: value if isinstance(value, Markup) else Markup(plain(str(value))),
    )
    environment.globals |= vars(facts) | vars(arms) | vars(details) | vars(advice)
    environment.globals["said"] = said
    environment.globals |= {
        "facts": lambda them: Markup("\n".join(fact_lines(them))),
        "table": lambda table: Markup("\n".join(table_lines(table))),
    }
    return environment.get_template("notes.md.j2").module


def view_markdown(sight: ViewResult, unposed: Sequence[str] = ()) -> str:
    """Status and residuals of one view; `unposed` are the robots without a pose at its stop."""
    state = "used" if sight.used else "not used"
    lines = [f"# View {sight.view}: {state} ([report](report.html#view-{sight.view}))", ""]
    if sight.reason:
        lines += [plain(sight.reason), ""]
    figures = (
        ("reprojection", sight.rms_px, "px"),
        ("position residual", sight.residual_mm, "mm"),
        ("orientation residual", sight.residual_deg, "deg"),
    )
    parts = [] if sight.corners is None else [f"corners {sight.corners}"]
    parts += [
        f"{label} {significant(value, 3)} {unit}"
        for label, value, unit in figures
        if value is not None
    ]
    pair = f"Stop {sight.stop}, {plain(sight.seer)} of {plain(sight.seen)}: " if sight.seer else ""
    lines.append(pair + ", ".join(parts))
    if unposed:
        names = ", ".join(map(plain, unposed))
        lines += ["", f"The pose of {names} is not known at this stop: drawn as it was last."]
    return "\n".join(lines)


def plain(text: str) -> str:
    """Escapes text from outside: in Markdown, the viewer would load pictures and follow links."""
    return re.sub(r"([\\`*_{}\[\]()#+\-.!|<>~&])", r"\\\1", " ".join(text.split()))


def markdown(text: str) -> rr.TextDocument:
    """A text document that viewers render as Markdown."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def fact_lines(facts: Iterable[Fact]) -> Iterator[str]:
    """Facts as a list."""
    for fact in facts:
        note = f" ({plain(fact.note)})" if fact.note else ""
        yield f"- {plain(fact.label)}: {plain(fact.value)}{note}"


def table_lines(table: Table | None) -> Iterator[str]:
    """A table, after an empty line; nothing for None."""
    if table is None:
        return
    yield ""
    yield _line(map(plain, table.titles))
    yield _line("---" if column in table.words else "---:" for column in range(len(table.titles)))
    for row in table.rows:
        first, *rest = map(plain, row.cells)
        is_bold = row.mark in _BOLD or not rest
        rest = rest or [""] * (len(table.titles) - 1)
        yield _line([f"**{first}**" if is_bold else first, *rest])


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"

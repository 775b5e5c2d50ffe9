"""Text and plots of a result: the verdict, the solvers, and the residuals of every view."""

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType

import rerun as rr

from visioncal.core.number_format import significant
from visioncal.core.types import Target
from visioncal.core.verdict import Step, Verdict
from visioncal.present.facts import (
    Fact,
    arm_facts,
    board_facts,
    noise_facts,
    residual_rows,
    solver_rows,
    summary,
)
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.present.words import SOURCES, level_reason
from visioncal.results import Calibration, Edge, ViewResult

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
# The scale of a plot ends here, in largest residuals of the used views.
_ROOM = 1.25


def log_static(
    stream: rr.RecordingStream, calibration: Calibration, targets: Mapping[str, Target]
) -> None:
    """Logs the verdict, the comparison of the solvers, and how the residuals' plots look."""
    log_verdict(stream, calibration.verdict, verdict_markdown(calibration))
    for entity, text in (
        (paths.FIGURES, figures_markdown(calibration, targets)),
        (paths.SOLVERS, solvers_markdown(calibration)),
    ):
        stream.log(entity, markdown(text), static=True)
    for plot in _PLOTS:
        for name, label, colour, marker, size in _MARKS:
            points = rr.SeriesPoints(colors=colour, markers=marker, marker_sizes=size, names=label)
            stream.log(f"{plot}/{name}", points, static=True)


def log_verdict(stream: rr.RecordingStream, verdict: Verdict, text: str) -> None:
    """Logs a verdict's text, and a point in its colour: a view of nothing says that it is empty."""
    stream.log(paths.VERDICT, markdown(text), static=True)
    point = rr.Points2D([[0.0, 0.0]], colors=colours.VERDICT[verdict.status])
    stream.log(paths.VERDICT_STRIP, point, static=True)


def _scales(views: Collection[ViewResult]) -> dict[str, float]:
    """By plot, where its scale ends: views that were not used must not flatten the others."""
    ends = {}
    for plot, attribute in _PLOTS.items():
        known = [getattr(view, attribute) for view in views if view.used]
        ends[plot] = _ROOM * max((it for it in known if it is not None), default=math.inf)
    return ends


def log_views(stream: rr.RecordingStream, views: Mapping[int, ViewResult]) -> None:
    """Logs the views' residuals and what became of them.

    Args:
        stream: Where to.
        views: What became of each view, by its place in the session.
    """
    ends, marks = _scales(views.values()), defaultdict[str, dict[int, float]](dict)
    for row, view in views.items():
        for plot, attribute in _PLOTS.items():
            name, value = paths.USED if view.used else paths.REJECTED, getattr(view, attribute)
            if value is None and not view.used:
                # Marked on the axis: a gap would look as if there were no such view.
                value = 0.0
            if not view.used and value > ends[plot]:
                name, value = paths.BEYOND, ends[plot]
            if value is not None:
                marks[f"{plot}/{name}"][row] = float(value)
    for entity, values in marks.items():
        log_scalars(stream, entity, values)
    texts = [view_markdown(it) for it in views.values()]
    columns = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))
    send_rows(stream, paths.VIEW_NOTE, views, columns)


def log_scalars(stream: rr.RecordingStream, entity: str, values: Mapping[int, float]) -> None:
    """Logs a number of each of some views, by their places in the session."""
    if values:
        send_rows(stream, entity, values, rr.Scalars.columns(scalars=list(values.values())))


def verdict_markdown(calibration: Calibration) -> str:
    """The verdict with its reasons, the transforms, and the views that were left out."""
    verdict = calibration.verdict
    lines = [*verdict_lines(verdict), *step_lines(calibration.next_steps)]
    lines += [
        f"- {plain(name)}: {it.verdict.headline}, see Tools and fixtures."
        for name, it in calibration.frames.items()
        if it.verdict.status != "good"
    ]
    lines += further_lines(verdict)
    lines += [
        "",
        "| transform | x, y, z [mm] | rotation vector [deg] | sigma |",
        "|---|---|---|---|",
    ]
    lines += [f"| {plain(name)} {edge_line(it)}" for name, it in calibration.placed.items()]
    known = calibration.budget
    if known is not None:
        lines += ["", plain(" ".join(summary(calibration, known)))]
    rejected = [view for view in calibration.views if not view.used]
    used = len(calibration.views) - len(rejected)
    lines += ["", f"{used} of {len(calibration.views)} views used."]
    lines += [f"- View {view.view}: {plain(view.reason)}" for view in rejected]
    return "\n".join(lines)


def verdict_lines(verdict: Verdict) -> Iterator[str]:
    """The verdict in a few words, and what is read first."""
    yield from (f"# {verdict.headline}", "")
    yield from (f"- {plain(it)}" for it in verdict.top)


def step_lines(steps: Sequence[Step]) -> Iterator[str]:
    """What to do next, commands as they are typed."""
    if steps:
        yield from ("", "## What to do next", "")
    for at, it in enumerate(steps, 1):
        yield f"{at}. {plain(it.words)}" + (f"  \n   `{it.command}`" if it.command else "")


def further_lines(verdict: Verdict) -> Iterator[str]:
    """What else was found."""
    if verdict.rest:
        yield from ("", "## What else was found", "")
    yield from (f"- {plain(it)}" for it in verdict.rest)


def edge_line(edge: Edge) -> str:
    """A row of a table: position, rotation and sigma of a transform."""
    position = ", ".join(f"{value:.2f}" for value in 1e3 * edge.transform.translation)
    if not edge.oriented:
        return f"| {position} | not measured | {edge.sigma_mm:.2g} mm |"
    turn = ", ".join(f"{value:.3f}" for value in edge.transform.rotation.as_rotvec(degrees=True))
    return f"| {position} | {turn} | {edge.sigma_mm:.2g} mm, {edge.sigma_deg:.2g} deg |"


def figures_markdown(
    calibration: Calibration, targets: Mapping[str, Target] = MappingProxyType({})
) -> str:
    """The residuals of the fit and of what it had not seen, the noise, and what else was found.

    Args:
        calibration: The result.
        targets: The boards by name, as far as they are known.
    """
    lines = ["# Residuals, rms", "", "| views | mm | deg | px |", "|---|---:|---:|---:|"]
    for label, rms in residual_rows(calibration):
        cells = map(significant, (rms.mm, rms.deg, rms.px))
        lines.append(f"| {plain(label)} | {' | '.join(cells)} |")
    lines += ["", "# Noise, per axis", "", *fact_lines(noise_facts(calibration))]
    return "\n".join([*lines, *_findings_lines(calibration, targets)])


def _findings_lines(found: Calibration, targets: Mapping[str, Target]) -> Iterator[str]:
    known = found.budget
    if known is not None:
        yield from ("", "# Where the uncertainty comes from", "")
        yield plain(" ".join(summary(found, known)))
        yield from ("", "| source | sigma mm | of the variance |", "|---|---:|---:|")
        for name, value in known.parts_mm.items():
            label = plain(SOURCES.get(name, name))
            yield f"| {label} | {significant(value)} | {known.percent(name)} |"
        yield f"| total | {significant(known.total_mm)} | |"
    for name, board in found.named_boards.items():
        if facts := board_facts(found, board, targets.get(name)):
            yield from ("", f"# Board {plain(name)}".strip(), "", *fact_lines(facts))
    if found.arm_errors is not None:
        yield from ("", "# Arm", "", *fact_lines(arm_facts(found.arm_errors)))
    if found.arm is not None:
        yield from ("", "# Level of the arm", "", plain(level_reason(found.arm)))


def fact_lines(facts: Iterable[Fact]) -> Iterator[str]:
    """Facts as a list."""
    for it in facts:
        note = f" ({plain(it.note)})" if it.note else ""
        yield f"- {plain(it.label)}: {plain(it.value)}{note}"


def solvers_markdown(calibration: Calibration) -> str:
    """A table of the solvers: their residuals, and how far their edges are from the result's."""
    titles = ["solver", "rms mm", "rms deg"]
    titles += [f"{plain(it)} off by {unit}" for it in calibration.edges for unit in ("mm", "deg")]
    lines = ["# Solvers compared", "", f"| {' | '.join(titles)} |"]
    lines.append("|---" + "|---:" * (len(titles) - 1) + "|")
    for label, found, away in solver_rows(calibration):
        figures = (found.rms_mm, found.rms_deg, *(it for pair in away for it in pair))
        lines.append(f"| {' | '.join([plain(label), *map(significant, figures)])} |")
    return "\n".join(lines)


def view_markdown(view: ViewResult) -> str:
    """What became of one view."""
    state = "used" if view.used else "not used"
    lines = [f"# View {view.view}: {state} ([report](report.html#view-{view.view}))", ""]
    if view.reason:
        lines += [plain(view.reason), ""]
    figures = (
        ("corners", view.corners, ""),
        ("reprojection", view.rms_px, " px"),
        ("position residual", view.residual_mm, " mm"),
        ("orientation residual", view.residual_deg, " deg"),
    )
    known = [f"{label} {value:.3g}{unit}" for label, value, unit in figures if value is not None]
    return "\n".join([*lines, ", ".join(known)])


def plain(text: str) -> str:
    """Escapes text from outside: the viewer would load pictures and follow links in Markdown."""
    return re.sub(r"([\\`*_{}\[\]()#+\-.!|<>~&])", r"\\\1", " ".join(text.split()))


def markdown(text: str) -> rr.TextDocument:
    """A text that viewers render as Markdown."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)

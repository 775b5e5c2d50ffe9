"""The verdict as Markdown, and the residuals of every view as plots and text."""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import rerun as rr

from visioncal.core.number_format import significant
from visioncal.present import advice
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.present.words import said
from visioncal.results import Calibration, ViewResult
from visioncal.session import View

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


def log_static(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Logs the verdict, and the style of the residual plots."""
    stream.log(paths.VERDICT, markdown(verdict_markdown(calibration)), static=True)
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
    unposed: Mapping[int, Sequence[str]],
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
    end, marks = 1.25 * max(used, default=math.inf), defaultdict[str, dict[int, float]](dict)
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
        if marked:
            scalars = rr.Scalars.columns(scalars=list(marked.values()))
            send_rows(stream, f"{plot}/{name}", marked, scalars)


def verdict_markdown(calibration: Calibration) -> str:
    """The verdict with its reasons and next steps, the transforms, and the views left out."""
    judged, cell, budget = calibration.verdict, calibration.cell, calibration.budget
    turned = calibration.rotation_words
    steps = [
        f"{at}. {plain(step.words)}" + (f"  \n   {code(step.command)}" if step.command else "")
        for at, step in enumerate(calibration.next_steps, 1)
    ]
    frames = [
        f"{name}: {frame.verdict.headline}, see the report"
        for name, frame in calibration.frames.items()
        if frame.verdict.status != "good"
    ]
    places = [
        f"{name}: {edge.place_words()}, {judged.accuracy(edge.sigma_words)}; {turned(name, edge)}"
        for name, edge in calibration.placed.items()
    ]
    used = sum(view.used for view in calibration.views)
    words = [] if cell is None or not judged.has_accuracy else [cell.weakest]
    words += said("summary", calibration, budget) if budget and judged.has_accuracy else []
    words.append(f"{used} of {len(calibration.views)} views used.")
    parts = [
        [f"# {judged.headline}", *_bullets([*judged.top, *frames])],
        ["## What to do next", *steps],
        ["## What it is valid for", *_bullets(calibration.unstated_conditions)],
        ["## What else was found", *_bullets(judged.rest)],
        ["## Transforms", *_bullets(places)],
        ["## Views", *map(plain, words)],
    ]
    parts[-1] += _bullets(group.words for group in advice.left_out(calibration.views))
    return "\n\n".join("\n\n".join(part) for part in parts if part[1:])


def _bullets(sentences: Iterable[str]) -> list[str]:
    lines = "\n".join(f"- {plain(sentence)}" for sentence in sentences)
    return [lines] if lines else []


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


def code(text: str) -> str:
    """A code span, which ends at as many back-ticks as it began with: more than are in a row."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if "`" in text else f"`{text}`"


def markdown(text: str) -> rr.TextDocument:
    """A text document that viewers render as Markdown."""
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)

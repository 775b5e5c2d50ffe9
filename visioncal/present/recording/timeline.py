"""Recordings of day 2: figures of stops, looks or years on one timeline, with what was found."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from visioncal.core.files import replacing_file
from visioncal.core.number_format import percent
from visioncal.core.transforms import apply
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.present.recording import colours, paths
from visioncal.present.recording.notes import markdown
from visioncal.present.recording.recorder import Recorder
from visioncal.results.history import Entry
from visioncal.verification import Check
from visioncal.vision.camera import project

_FIGURES, _LOG, _NOTE = "/figures", "/log", "/note"


@dataclass(frozen=True, eq=False)
class Moment:
    """A stop, a look, or an entry of the years."""

    # Its number, its seconds, or its date.
    at: int | float | datetime
    figures: Mapping[str, float]  # By name, as `residual [mm]`.
    words: str = ""  # Findings there; empty for none.
    is_alarm: bool = False
    seen_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2) corners [px].
    predicted_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # Where expected.


def write_timeline(path: Path, name: str, moments: Sequence[Moment], note: str) -> None:
    """Writes moments as a recording, whole or not at all; raises DataError.

    Args:
        path: The `.rrd`.
        name: Its name in the viewer.
        moments: In their order, all of one kind of time.
        note: What was found as a whole, in Markdown.
    """
    with replacing_file(path) as aside, Recorder(aside) as recorder:
        stream = recorder.stream
        stream.send_recording_name(name)
        has_image = any(len(each.seen_px) for each in moments)
        recorder.lay_out(_blueprint(moments, has_image=has_image))
        stream.log(_NOTE, markdown(note), static=True)
        in_image = rr.CoordinateFrame(paths.IMAGE_FRAME)
        for each in moments:
            if isinstance(each.at, datetime):
                stream.set_time("time", timestamp=each.at)
            elif isinstance(each.at, float):
                stream.set_time("time", duration=each.at)
            else:
                stream.set_time(paths.TIMELINE, sequence=each.at)
            for label, value in each.figures.items():
                stream.log([_FIGURES[1:], _unit(label), *label.split("/")], rr.Scalars(value))
            if each.words:
                level = rr.TextLogLevel.ERROR if each.is_alarm else rr.TextLogLevel.INFO
                stream.log(_LOG, rr.TextLog(each.words, level=level))
            if has_image:
                # Rerun's origin is the image's corner, not the first pixel's centre.
                for entity, px, colour in (
                    (paths.DETECTED, each.seen_px, colours.DETECTED),
                    (paths.PREDICTED, each.predicted_px, colours.PREDICTED),
                ):
                    radii = rr.Radius.ui_points(3.0)
                    stream.log(entity, in_image, rr.Points2D(px + 0.5, colors=colour, radii=radii))
        recorder.keep()


def _unit(label: str) -> str:
    """The plot that a figure belongs to: that of its unit, or its own."""
    unit = re.search(r"(?:_|\[)(mm|deg|px)\]?$", label)
    return unit[1] if unit else label.rpartition("/")[2]


def _time(at: float | datetime) -> rr.TimeRangeBoundary:
    """A moment's time, as a boundary of a plot."""
    if isinstance(at, int):
        return rr.TimeRangeBoundary.absolute(seq=at)
    seconds = at.timestamp() if isinstance(at, datetime) else at
    return rr.TimeRangeBoundary.absolute(seconds=seconds)


def _blueprint(moments: Sequence[Moment], *, has_image: bool) -> rrb.Blueprint:
    # Figures of different units would hide each other in one plot.
    counts = Counter(unit for each in moments for unit in {*map(_unit, each.figures)})
    axis = None
    if len({each.at for each in moments}) > 1:
        # Of a year the viewer shows a minute, unless it is told.
        span = rr.TimeRange(start=_time(moments[0].at), end=_time(moments[-1].at))
        axis = rrb.TimeAxis(view_range=span)
    # Most plots, of the units that most moments have.
    views: list[rrb.View] = [
        rrb.TimeSeriesView(
            name=unit, origin=f"{_FIGURES}/{unit}", axis_x=axis, plot_legend=rrb.Corner2D.RightTop
        )
        for unit, count in counts.most_common(3)
        if count > 1 or len(moments) == 1
    ]
    if has_image:
        views.append(rrb.Spatial2DView(name="Predicted and found", origin=paths.IMAGE))
    kinds = (TextLogColumnKind.LogLevel, TextLogColumnKind.Body)
    columns = rrb.TextLogColumns(text_log_columns=[TextLogColumn(kind) for kind in kinds])
    words = rrb.Vertical(
        rrb.TextDocumentView(name="What was found", origin=_NOTE),
        rrb.TextLogView(name="Alarms and causes", origin=_LOG, columns=columns),
    )
    content = rrb.Horizontal(rrb.Vertical(*views), words)
    panels = (
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.TimePanel(state=rrb.PanelState.Collapsed),
    )
    return rrb.Blueprint(content, *panels)


def record_check(path: Path, check: Check, verdict: Verdict) -> None:
    """Records a check: corners as found and as predicted, residuals by stop, and the verdict."""
    predicted, free = check.predicted, check.predicted.observed.free
    problem, cause = predicted.problem, check.named[0].name if check.named else ""
    poses = problem.predicted(check.prior.state)
    moments = []
    for at, view in enumerate(predicted.views):
        figures, seen, expected = dict[str, float](), np.zeros((0, 2)), np.zeros((0, 2))
        for label, residuals in (("residual", check.residuals), ("change undone", check.remaining)):
            rotation, translation = np.linalg.norm(residuals[at].reshape(2, 3), axis=1)
            figures[f"{label} [mm]"] = 1e3 * float(translation)
            figures[f"{label} [deg]"] = float(np.rad2deg(rotation))
        corners = predicted.observed.poses[view].corners
        if corners is not None and free is not None:
            points = free.positions + free.basis @ free.appearance.board
            seen = corners.px
            expected = project(free.appearance.camera, apply(poses[at], points[corners.ids]))
        words = f"{figures['residual [mm]']:.2g} mm"
        words += f", by the {cause}" if cause else ", agrees"
        moments.append(Moment(view, figures, words, bool(cause), seen, expected))
    word = "holds" if check.passed else "does not hold any more"
    lines = [f"# The calibration {word}", *(f"- {line}" for line in (*verdict.top, *verdict.rest))]
    name = f"check of {check.calibration.session_name}"
    write_timeline(path, name, moments, "\n".join([*lines, *map(str, verdict.next_steps)]))


def record_looks(path: Path, answers: Sequence[Mapping[str, Any]], name: str) -> None:
    """Records a guard's answers: its figures over time, its alarms and their causes."""
    moments, held = list[Moment](), True
    for answer in answers:
        if "time_s" not in answer:
            continue
        numbers = {key: float(value) for key, value in answer.items()
                   if isinstance(value, int | float) and not isinstance(value, bool)}  # fmt: skip
        holds = bool(answer.get("holds", True))
        causes = ", ".join(
            f"{cause['cause']} ({percent(cause['probability'])})"
            for cause in answer.get("causes", ())
        )
        news = causes if held and not holds else str(answer.get("reason", ""))
        moments.append(Moment(numbers.pop("time_s"), numbers, news, held and not holds))
        held = holds
    found = next((each.words for each in moments if each.is_alarm), "nothing has changed")
    write_timeline(path, name, moments, f"# {len(moments)} looks\n\n{found}")


def record_years(path: Path, entries: Sequence[Entry], name: str) -> None:
    """Records a site's history: the figures of each cell's acts, and their verdicts."""
    moments = [
        Moment(
            entry.time,
            {f"{entry.cell}/{label}": value for label, value in entry.figures.items()},
            f"{entry.time:%Y-%m-%d} {entry.cell}: {entry.kind}, {entry.status}: {entry.reason}",
            entry.status == "bad",
        )
        for entry in sorted(entries, key=lambda entry: entry.time)
    ]
    bad = sum(each.is_alarm for each in moments)
    write_timeline(path, name, moments, f"# {len(moments)} acts\n\n{bad} of them bad.")

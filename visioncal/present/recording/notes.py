"""Texts and plots of a result: verdict, figures, and residuals of every view."""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from types import MappingProxyType

import rerun as rr

from visioncal.core.number_format import significant
from visioncal.core.types import Target
from visioncal.core.verdict import Verdict
from visioncal.present import advice, arms, facts
from visioncal.present.details import frame_facts, observation_table
from visioncal.present.recording import colours, paths
from visioncal.present.recording.markdown import fact_lines, markdown, plain, table_lines
from visioncal.present.recording.recorder import send_rows
from visioncal.results import Calibration, Frame, ViewResult
from visioncal.results.arm import ArmResult, ArmSections
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
# End of a plot's scale, as a multiple of the used views' largest residual.
_ROOM = 1.25


def log_static(
    stream: rr.RecordingStream, calibration: Calibration, targets: Mapping[str, Target]
) -> None:
    """Logs the verdict, further texts, and the style of the residual plots."""
    log_verdict(stream, calibration.verdict, verdict_markdown(calibration))
    for entity, text in (
        (paths.FIGURES, figures_markdown(calibration, targets)),
        (paths.SOLVERS, solvers_markdown(calibration)),
        (paths.TOOLS, tools_markdown(calibration)),
        (paths.ARM_NOTE, arms_markdown(calibration)),
    ):
        if text:
            stream.log(entity, markdown(text), static=True)
    for seer in dict.fromkeys(view.seer for view in calibration.views):
        for plot in _PLOTS:
            for name, label, colour, marker, size in _MARKS:
                points = rr.SeriesPoints(
                    colors=colour, markers=marker, marker_sizes=size, names=label
                )
                stream.log(f"{paths.part_of(plot, seer)}/{name}", points, static=True)


def log_verdict(stream: rr.RecordingStream, verdict: Verdict, text: str) -> None:
    """Logs a verdict's text, and a point in its colour, as an empty view would say it is empty."""
    stream.log(paths.VERDICT, markdown(text), static=True)
    point = rr.Points2D([[0.0, 0.0]], colors=colours.VERDICT[verdict.status])
    stream.log(paths.VERDICT_STRIP, point, static=True)


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
        else _unseen_markdown(view)
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


def verdict_markdown(calibration: Calibration) -> str:
    """Verdict with its reasons, the transforms, and the views left out."""
    return "\n".join(_verdict_lines(calibration))


def _verdict_lines(calibration: Calibration) -> Iterator[str]:
    verdict, cell, budget = calibration.verdict, calibration.cell, calibration.budget
    yield from (f"# {verdict.headline}", "", *_list(verdict.top))
    if calibration.next_steps:
        yield from ("", "## What to do next", "")
    for number, step in enumerate(calibration.next_steps, 1):
        yield f"{number}. {plain(step.words)}" + (
            f"  \n   `{step.command}`" if step.command else ""
        )
    for name, frame in calibration.frames.items():
        if frame.verdict.status != "good":
            yield f"- {plain(name)}: {frame.verdict.headline}, see Tools and fixtures."
    if calibration.unstated_conditions:
        yield from ("", "## What it is valid for", "", *_list(calibration.unstated_conditions))
    if verdict.rest:
        yield from ("", "## What else was found", "", *_list(verdict.rest))
    if cell is not None:
        yield from ("", plain(cell.weakest), "")
        yield from _list(": ".join(row.cells) for row in facts.moved_table(cell).rows)
        yield f"The frame of the cell is that of {plain(cell.reference)}."
    yield from table_lines(facts.edge_table(calibration.placed))
    if budget is not None:
        yield from ("", plain(" ".join(facts.summary(calibration, budget))))
    used = sum(view.used for view in calibration.views)
    yield from ("", f"{used} of {len(calibration.views)} views used.")
    yield from _list(suspects.words for suspects in advice.left_out(calibration.views))


def _list(sentences: Iterable[str]) -> Iterator[str]:
    return (f"- {plain(sentence)}" for sentence in sentences)


def figures_markdown(
    calibration: Calibration, targets: Mapping[str, Target] = MappingProxyType({})
) -> str:
    """Residuals of fit and validation, noise, uncertainty budget, boards and arms."""
    return "\n".join(_figure_lines(calibration, targets))


def _figure_lines(calibration: Calibration, targets: Mapping[str, Target]) -> Iterator[str]:
    yield from ("# Residuals, rms", *table_lines(facts.residual_table(calibration)))
    yield from table_lines(facts.pair_table(calibration))
    yield from ("", "# Noise, per axis", "", *fact_lines(facts.noise_facts(calibration)))
    sources, budget = facts.source_table(calibration), calibration.budget
    if sources is not None:
        yield from ("", "# Where the uncertainty comes from", "")
        if budget is not None:
            yield plain(" ".join(facts.summary(calibration, budget)))
        yield from table_lines(sources)
    for name, board in calibration.named_boards.items():
        if board_lines := facts.board_facts(calibration, board, targets.get(name)):
            yield from ("", f"# Board {plain(name)}".strip(), "", *fact_lines(board_lines))
    for name, arm in calibration.by_name.robots.items():
        of = plain(facts.of(name))
        if arm.arm_errors is not None:
            yield from ("", f"# Arm{of}", "", *fact_lines(arms.error_facts(arm.arm_errors)))
        if arm.arm is not None:
            yield from ("", f"# Level of the arm{of}", "", plain(arms.level_reason(arm.arm)))


def solvers_markdown(calibration: Calibration) -> str:
    """Comparison of the solvers: residuals, and distances from the result."""
    table = facts.solver_table(calibration)
    return "" if table is None else "\n".join(["# Solvers compared", *table_lines(table)])


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


def _unseen_markdown(view: View) -> str:
    """Text of a view without any observation of the cell."""
    reason = "for the lens alone" if view.is_of_lens else "it has a robot's pose alone"
    return f"# View {view.number}\n\n{reason}"


def tools_markdown(calibration: Calibration) -> str:
    """All tools and fixtures: verdict, pose, observations and figures."""
    return "\n".join(chain.from_iterable(_tool(*frame) for frame in calibration.frames.items()))


def _tool(name: str, frame: Frame) -> Iterator[str]:
    yield from (f"# {plain(name)}: {frame.verdict.headline}", "", *_list(frame.verdict.reasons))
    yield from (*table_lines(facts.edge_table({name: frame.edge})), "")
    for observation in frame.observations:
        if observation.reason or not observation.used:
            reason = f": {plain(observation.reason)}" if observation.reason else ""
            state = "used" if observation.used else "not used"
            yield f"- **{plain(f'{observation.kind} {observation.name}'.strip())} {state}**{reason}"
    if frame.observations:
        yield from table_lines(observation_table(frame))
    yield from ("", *fact_lines(frame_facts(frame)), "")


def arms_markdown(calibration: Calibration) -> str:
    """Model level and drift of each arm."""
    return "\n".join(
        chain.from_iterable(
            _arm(facts.of(name), arm) for name, arm in calibration.by_name.robots.items()
        )
    )


def _arm(of: str, sections: ArmSections) -> Iterator[str]:
    if sections.arm is not None:
        yield from (f"# The arm{plain(of)}", "", *_levels(sections.arm))
    if sections.arm is not None and sections.elastic is not None:
        yield from ("", "## Joints that bend", *table_lines(arms.spring_table(sections.elastic)))
        yield from ("", *fact_lines(arms.spring_facts(sections.elastic)))
    if sections.thermal is not None:
        yield from ("", f"# Drift with temperature{plain(of)}", "")
        yield plain(arms.drift_sentence(sections.thermal))
        yield from table_lines(arms.drift_table(sections.thermal))


def _levels(arm: ArmResult) -> Iterator[str]:
    """Model level with its reason, parameters, and observability of an arm."""
    yield from (f"{plain(sentence)}\n" for sentence in arms.arm_sentences(arm))
    yield from table_lines(arms.level_table(arm))
    yield from ("", "Ratio: twice the gain in log-likelihood over the arm as stated.")
    if arm.left_out:
        yield ""
        yield (
            "The plots show the views that were left out in turn, and as diamonds those that the "
            "session holds back: in orange by the arm as stated, in blue by the calibrated one. "
            "The orange line in the cell is the arm as stated, its departure magnified as its "
            "entity says."
        )
    if arm.parameters:
        yield from ("", "## Parameters", "", plain(arms.parameter_note(arm)))
        for table in arms.parameter_tables(arm):
            yield from table_lines(table)
    if arm.observability is not None:
        yield from ("", "## What the stops determine", "")
        yield from fact_lines(arms.identifiability_facts(arm))
    yield from _list(arm.not_determined or ())
    if arm.stops:
        yield from ("", "## Influence of each stop", "")
        yield "By how much the mean variance over the workspace would grow without it:"
        yield from table_lines(arms.stop_table(arm))

"""Text and plots of a result: the verdict, its figures, and the residuals of every view."""

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
# The scale of a plot ends here, in largest residuals of the used views.
_ROOM = 1.25


def log_static(
    stream: rr.RecordingStream, calibration: Calibration, targets: Mapping[str, Target]
) -> None:
    """Logs the verdict, what else is to be said, and how the residuals' plots look."""
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
    """Logs a verdict's text, and a point in its colour: a view of nothing says that it is empty."""
    stream.log(paths.VERDICT, markdown(text), static=True)
    point = rr.Points2D([[0.0, 0.0]], colors=colours.VERDICT[verdict.status])
    stream.log(paths.VERDICT_STRIP, point, static=True)


def log_views(
    stream: rr.RecordingStream,
    sights: Mapping[int, ViewResult],
    rows: Mapping[int, View],
    unposed: Mapping[int, Sequence[str]] = MappingProxyType({}),
) -> None:
    """Logs the views' residuals and what became of them.

    Args:
        stream: Where to.
        sights: What became of each view, by its place in the session.
        rows: All views, by their places.
        unposed: The robots whose pose is not known at a view, by its place.
    """
    by_seer: dict[str, dict[int, ViewResult]] = defaultdict(dict)
    for row, sight in sights.items():
        by_seer[sight.seer][row] = sight
    for seer, mine in by_seer.items():
        for plot, attribute in _PLOTS.items():
            _log_residuals(stream, paths.part_of(plot, seer), mine, attribute)
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
    """Logs a residual of the views, by their places in the session."""
    values = {row: getattr(sight, attribute) for row, sight in sights.items()}
    used = [value for row, value in values.items() if value is not None and sights[row].used]
    # Views that were not used must not flatten the others.
    end, marks = _ROOM * max(used, default=math.inf), defaultdict[str, dict[int, float]](dict)
    for row, value in values.items():
        if sights[row].used:
            if value is not None:
                marks[paths.USED][row] = float(value)
        # Marked on the axis where it is unknown: a gap would look as if there were no such view.
        elif (value or 0.0) > end:
            marks[paths.BEYOND][row] = end
        else:
            marks[paths.REJECTED][row] = float(value or 0.0)
    for name, marked in marks.items():
        log_scalars(stream, f"{plot}/{name}", marked)


def log_scalars(stream: rr.RecordingStream, entity: str, values: Mapping[int, float]) -> None:
    """Logs a number of each of some views, by their places in the session."""
    if values:
        send_rows(stream, entity, values, rr.Scalars.columns(scalars=list(values.values())))


def verdict_markdown(calibration: Calibration) -> str:
    """The verdict with its reasons, the transforms, and the views that were left out."""
    return "\n".join(_verdict_lines(calibration))


def _verdict_lines(calibration: Calibration) -> Iterator[str]:
    verdict, cell, known = calibration.verdict, calibration.cell, calibration.budget
    yield from (f"# {verdict.headline}", "", *_list(verdict.top))
    if calibration.next_steps:
        yield from ("", "## What to do next", "")
    for at, step in enumerate(calibration.next_steps, 1):
        yield f"{at}. {plain(step.words)}" + (f"  \n   `{step.command}`" if step.command else "")
    for name, frame in calibration.frames.items():
        if frame.verdict.status != "good":
            yield f"- {plain(name)}: {frame.verdict.headline}, see Tools and fixtures."
    if verdict.rest:
        yield from ("", "## What else was found", "", *_list(verdict.rest))
    if cell is not None:
        yield from ("", plain(cell.weakest), "")
        yield from _list(": ".join(row.cells) for row in facts.moved_table(cell).rows)
        yield f"The frame of the cell is that of {plain(cell.reference)}."
    yield from table_lines(facts.edge_table(calibration.placed))
    if known is not None:
        yield from ("", plain(" ".join(facts.summary(calibration, known))))
    used = sum(view.used for view in calibration.views)
    yield from ("", f"{used} of {len(calibration.views)} views used.")
    yield from _list(suspects.words for suspects in advice.left_out(calibration.views))


def _list(sentences: Iterable[str]) -> Iterator[str]:
    return (f"- {plain(sentence)}" for sentence in sentences)


def figures_markdown(
    calibration: Calibration, targets: Mapping[str, Target] = MappingProxyType({})
) -> str:
    """The residuals of the fit and of what it had not seen, the noise, and what else was found.

    Args:
        calibration: The result.
        targets: The boards by name, as far as they are known.
    """
    return "\n".join(_figure_lines(calibration, targets))


def _figure_lines(found: Calibration, targets: Mapping[str, Target]) -> Iterator[str]:
    yield from ("# Residuals, rms", *table_lines(facts.residual_table(found)))
    yield from table_lines(facts.pair_table(found))
    yield from ("", "# Noise, per axis", "", *fact_lines(facts.noise_facts(found)))
    sources, known = facts.source_table(found), found.budget
    if sources is not None:
        yield from ("", "# Where the uncertainty comes from", "")
        if known is not None:
            yield plain(" ".join(facts.summary(found, known)))
        yield from table_lines(sources)
    for name, board in found.named_boards.items():
        if said := facts.board_facts(found, board, targets.get(name)):
            yield from ("", f"# Board {plain(name)}".strip(), "", *fact_lines(said))
    for name, arm in found.by_name.robots.items():
        of = plain(facts.of(name))
        if arm.arm_errors is not None:
            yield from ("", f"# Arm{of}", "", *fact_lines(arms.error_facts(arm.arm_errors)))
        if arm.arm is not None:
            yield from ("", f"# Level of the arm{of}", "", plain(arms.level_reason(arm.arm)))


def solvers_markdown(calibration: Calibration) -> str:
    """A table of the solvers: their residuals, and how far their edges are from the result's."""
    table = facts.solver_table(calibration)
    return "" if table is None else "\n".join(["# Solvers compared", *table_lines(table)])


def view_markdown(sight: ViewResult, unposed: Sequence[str] = ()) -> str:
    """What became of one view.

    Args:
        sight: That.
        unposed: The robots without a pose at its stop.
    """
    state = "used" if sight.used else "not used"
    lines = [f"# View {sight.view}: {state} ([report](report.html#view-{sight.view}))", ""]
    if sight.reason:
        lines += [plain(sight.reason), ""]
    figures = (
        ("reprojection", sight.rms_px, "px"),
        ("position residual", sight.residual_mm, "mm"),
        ("orientation residual", sight.residual_deg, "deg"),
    )
    known = [] if sight.corners is None else [f"corners {sight.corners}"]
    known += [
        f"{label} {significant(value, 3)} {unit}"
        for label, value, unit in figures
        if value is not None
    ]
    of = f"Stop {sight.stop}, {plain(sight.seer)} of {plain(sight.seen)}: " if sight.seer else ""
    lines.append(of + ", ".join(known))
    if unposed:
        names = ", ".join(map(plain, unposed))
        lines += ["", f"The pose of {names} is not known at this stop: drawn as it was last."]
    return "\n".join(lines)


def _unseen_markdown(view: View) -> str:
    """A view in which nothing of the cell was observed."""
    what = "for the lens alone" if view.is_of_lens else "it has a robot's pose alone"
    return f"# View {view.number}\n\n{what}"


def tools_markdown(calibration: Calibration) -> str:
    """All tools and fixtures, each with its verdict, its pose, its observations and its figures."""
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
    """What is known of each arm of which levels were tried, and of its drift."""
    return "\n".join(
        chain.from_iterable(
            _arm(facts.of(name), arm) for name, arm in calibration.by_name.robots.items()
        )
    )


def _arm(of: str, found: ArmSections) -> Iterator[str]:
    if found.arm is not None:
        yield from (f"# The arm{plain(of)}", "", *_levels(found.arm))
    if found.arm is not None and found.elastic is not None:
        yield from ("", "## Joints that bend", *table_lines(arms.spring_table(found.elastic)))
        yield from ("", *fact_lines(arms.spring_facts(found.elastic)))
    if found.thermal is not None:
        yield from ("", f"# Drift with temperature{plain(of)}", "")
        yield plain(arms.drift_sentence(found.thermal))
        yield from table_lines(arms.drift_table(found.thermal))


def _levels(found: ArmResult) -> Iterator[str]:
    """Which level was taken and why, and what is known of the arm then."""
    yield from (f"{plain(sentence)}\n" for sentence in arms.arm_sentences(found))
    yield from table_lines(arms.level_table(found))
    yield from ("", "Ratio: twice the gain in log-likelihood over the arm as stated.")
    if found.left_out:
        yield ""
        yield (
            "The plots show the views that were left out in turn, and as diamonds those that the "
            "session holds back: in orange by the arm as stated, in blue by the calibrated one. "
            "The orange line in the cell is the arm as stated, its departure magnified as its "
            "entity says."
        )
    if found.parameters:
        yield from ("", "## Parameters", "", plain(arms.parameter_note(found)))
        for table in arms.parameter_tables(found):
            yield from table_lines(table)
    if found.observability is not None:
        yield from ("", "## What the stops determine", "")
        yield from fact_lines(arms.identifiability_facts(found))
    yield from _list(found.not_determined or ())
    if found.stops:
        yield from ("", "## Influence of each stop", "")
        yield "By how much the mean variance over the workspace would grow without it:"
        yield from table_lines(arms.stop_table(found))

"""Text and plots of a result: the verdict, the solvers, and the residuals of every view."""

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence

import rerun as rr

from visioncal.core.transforms import pose_difference
from visioncal.core.verdict import Step, Verdict
from visioncal.present.recording import colours, paths
from visioncal.present.recording.recorder import send_rows
from visioncal.present.words import SOURCES, level_reason
from visioncal.results import Calibration, Edge, Rms, ViewResult
from visioncal.results.arm import ArmErrorsResult
from visioncal.results.sections import BoardResult, UncertaintyResult

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


def log_static(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Logs the verdict, the comparison of the solvers, and how the residuals' plots look."""
    log_verdict(stream, calibration.verdict, verdict_markdown(calibration))
    for entity, text in (
        (paths.FIGURES, figures_markdown(calibration)),
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
        lines += ["", _work_line(known)]
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


def _work_line(known: UncertaintyResult) -> str:
    largest = plain(next(iter(known.parts_mm)))
    return (
        f"Where the views look, a point is placed to {known.total_mm:.2g} mm (sigma; 95 % within "
        f"{known.radius95_mm:.2g} mm); the largest part comes from the "
        f"{largest.replace('_', ' ')}."
    )


def figures_markdown(calibration: Calibration) -> str:
    """The residuals of the fit and of what it had not seen, the noise, and what else was found."""
    lines = ["# Residuals, rms", "", "| views | mm | deg | px |", "|---|---:|---:|---:|"]
    validation = calibration.validation
    lines.append(_rms_line("used, as fitted", calibration.rms))
    lines.append(_rms_line(f"left out in turn ({plain(validation.method)})", validation.held_out))
    if validation.holdout is not None:
        lines.append(_rms_line("declared hold-out", validation.holdout))
    known = calibration.uncertainty
    intervals = {} if known is None else known.noise_95
    lines += ["", "# Noise, per axis", "", "| standard deviation | | 95 % |", "|---|---:|---:|"]
    for name, value in calibration.noise.items():
        low_high = " to ".join(f"{it:.2g}" for it in intervals.get(name, ()))
        lines.append(f"| {_noise_label(name)} | {value:.2g} | {low_high} |")
    arm = calibration.arm
    level = [] if arm is None else ["", "# Level of the arm", "", plain(level_reason(arm))]
    return "\n".join([*lines, *_findings_lines(calibration), *level])


def _findings_lines(found: Calibration) -> Iterator[str]:
    known = found.budget
    if known is not None:
        yield from ("", "# Where the uncertainty comes from", "", _work_line(known), "")
        yield from ("| source | sigma mm | of the variance |", "|---|---:|---:|")
        for name, value in known.parts_mm.items():
            label = plain(SOURCES.get(name, name))
            yield f"| {label} | {value:.2g} | {known.percent(name)} |"
        yield f"| total | {known.total_mm:.2g} | |"
    for name, board in found.named_boards.items():
        if board.sigma:
            yield from ("", f"# Board {plain(name)}".strip(), "", _board_line(board))
    if found.arm_errors is not None:
        yield from ("", "# Arm", "", _arm_line(found.arm_errors))


def _board_line(board: BoardResult) -> str:
    scale = "as stated"
    if "scale" in board.estimated:
        sigma = board.sigma["scale"]
        away = 100 * board.shape["scale"]
        scale = f"{away:+.2g} % against the stated one (sigma {100 * sigma:.1g} %)"
    bend = "none: flat within what is seen"
    if board.is_bent:
        bend = f"its corners lie within {board.bend_mm:.2g} mm of depth"
    return f"Size: {scale}. Bend: {bend}."


def _arm_line(arm: ArmErrorsResult) -> str:
    treated = "were estimated along" if arm.estimated else "could not be estimated along"
    what = "its links are" if arm.of is None else "its flange is"
    return (
        f"Residuals follow the arm's posture: {what} typically off by {arm.sigma_mm:.2g} mm "
        f"and {arm.sigma_deg:.2g} deg (likelihood ratio {arm.likelihood_ratio:.0f}, noise stays "
        f"under 15). These errors {treated}."
    )


def _noise_label(name: str) -> str:
    """`robot_translation_mm` as words with the unit: `robot translation [mm]`."""
    words, _, unit = name.rpartition("_")
    return plain(f"{words.replace('_', ' ')} [{unit}]")


def _rms_line(label: str, rms: Rms) -> str:
    px = "" if rms.px is None else f"{rms.px:.2g}"
    deg = "" if rms.deg is None else f"{rms.deg:.2g}"
    return f"| {label} | {rms.mm:.2g} | {deg} | {px} |"


def solvers_markdown(calibration: Calibration) -> str:
    """A table of the solvers: their residuals, and how far their edges are from the result's."""
    edges = list(calibration.edges)
    titles = ["solver", "rms mm", "rms deg"]
    titles += [f"{plain(name)} off by {unit}" for name in edges for unit in ("mm", "deg")]
    lines = ["# Solvers compared", "", f"| {' | '.join(titles)} |"]
    lines.append("|---" + "|---:" * (len(titles) - 1) + "|")
    for solver, result in calibration.solvers.items():
        deg = "" if result.rms_deg is None else f"{result.rms_deg:.3g}"
        cells = [plain(solver), f"{result.rms_mm:.3g}", deg]
        for name in edges:
            if name in result.transforms:
                ours, theirs = calibration.transforms[name], result.transforms[name]
                differences = pose_difference(ours.as_matrix(), theirs.as_matrix())
                # Rounding errors of the result's own row are no difference.
                cells += [f"{it:.2g}" if it > 1e-9 else "0" for it in differences]
            else:
                cells += ["", ""]
        lines.append(f"| {' | '.join(cells)} |")
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

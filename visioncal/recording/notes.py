"""Text and plots of a result: the verdict, the solvers, and the residuals of every view."""

import re

import rerun as rr

from visioncal.calibration import Calibration, Edge, Rms, ViewResult
from visioncal.recording import colours, paths
from visioncal.transforms import pose_difference

_HEADLINES = {"good": "Good", "check": "Check before use", "bad": "Bad: do not use"}
_PLOTS = {
    paths.POSITION_MM: "residual_mm",
    paths.ORIENTATION_DEG: "residual_deg",
    paths.REPROJECTION_PX: "rms_px",
}


def log_static(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Logs the verdict, the comparison of the solvers, and how the residuals' plots look."""
    for entity, text in (
        (paths.VERDICT, verdict_markdown(calibration)),
        (paths.FIGURES, figures_markdown(calibration)),
        (paths.SOLVERS, solvers_markdown(calibration)),
    ):
        stream.log(entity, _markdown(text), static=True)
    for plot in _PLOTS:
        for name, label, colour, marker, size in (
            (paths.USED, "used", colours.USED, rr.components.MarkerShape.Circle, 3.5),
            (paths.REJECTED, "not used", colours.REJECTED, rr.components.MarkerShape.Cross, 6.0),
        ):
            points = rr.SeriesPoints(colors=colour, markers=marker, marker_sizes=size, names=label)
            stream.log(f"{plot}/{name}", points, static=True)


def log_view(stream: rr.RecordingStream, view: ViewResult) -> None:
    """Logs one view's residuals and what became of it, at the stream's current time."""
    name = paths.USED if view.used else paths.REJECTED
    for plot, attribute in _PLOTS.items():
        value = getattr(view, attribute)
        if value is None and not view.used:
            # Marked on the axis: a gap would look as if there were no such view.
            value = 0.0
        if value is not None:
            stream.log(f"{plot}/{name}", rr.Scalars(float(value)))
    stream.log(paths.VIEW_NOTE, _markdown(view_markdown(view)))


def verdict_markdown(calibration: Calibration) -> str:
    """The verdict with its reasons, the transforms, and the views that were left out."""
    verdict = calibration.verdict
    lines = [f"# {_HEADLINES[verdict.status]}", ""]
    lines += [f"- {plain(reason)}" for reason in verdict.reasons]
    lines += [
        "",
        "| transform | x, y, z [mm] | rotation vector [deg] | sigma |",
        "|---|---|---|---|",
    ]
    lines += [_edge_line(name, edge) for name, edge in calibration.edges.items()]
    rejected = [view for view in calibration.views if not view.used]
    used = len(calibration.views) - len(rejected)
    lines += ["", f"{used} of {len(calibration.views)} views used."]
    lines += [f"- View {view.view}: {plain(view.reason)}" for view in rejected]
    return "\n".join(lines)


def _edge_line(name: str, edge: Edge) -> str:
    position = ", ".join(f"{value:.2f}" for value in 1e3 * edge.transform.translation)
    turn = ", ".join(f"{value:.3f}" for value in edge.transform.rotation.as_rotvec(degrees=True))
    sigma = f"{edge.sigma_mm:.2g} mm, {edge.sigma_deg:.2g} deg"
    return f"| {plain(name)} | {position} | {turn} | {sigma} |"


def figures_markdown(calibration: Calibration) -> str:
    """The residuals of the fit and of what it had not seen, and the noise."""
    lines = ["# Residuals, rms", "", "| views | mm | deg | px |", "|---|---:|---:|---:|"]
    validation = calibration.validation
    lines.append(_rms_line("used, as fitted", calibration.rms))
    lines.append(_rms_line(f"left out in turn ({plain(validation.method)})", validation.held_out))
    if validation.holdout is not None:
        lines.append(_rms_line("declared hold-out", validation.holdout))
    lines += ["", "# Noise, per axis", "", "| standard deviation | |", "|---|---:|"]
    lines += [
        f"| {_noise_label(name)} | {value:.2g} |" for name, value in calibration.noise.items()
    ]
    return "\n".join(lines)


def _noise_label(name: str) -> str:
    """`robot_translation_mm` as words with the unit: `robot translation [mm]`."""
    words, _, unit = name.rpartition("_")
    return plain(f"{words.replace('_', ' ')} [{unit}]")


def _rms_line(label: str, rms: Rms) -> str:
    px = "" if rms.px is None else f"{rms.px:.2g}"
    return f"| {label} | {rms.mm:.2g} | {rms.deg:.2g} | {px} |"


def solvers_markdown(calibration: Calibration) -> str:
    """A table of the solvers: their residuals, and how far their edges are from the result's."""
    edges = list(calibration.edges)
    titles = ["solver", "rms mm", "rms deg"]
    titles += [f"{plain(name)} off by {unit}" for name in edges for unit in ("mm", "deg")]
    lines = ["# Solvers compared", "", f"| {' | '.join(titles)} |"]
    lines.append("|---" + "|---:" * (len(titles) - 1) + "|")
    for solver, result in calibration.solvers.items():
        cells = [plain(solver), f"{result.rms_mm:.3g}", f"{result.rms_deg:.3g}"]
        for name in edges:
            if name in result.transforms:
                ours, theirs = calibration.transforms[name], result.transforms[name]
                differences = pose_difference(ours.as_matrix(), theirs.as_matrix())
                cells += [_difference(value) for value in differences]
            else:
                cells += ["", ""]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _difference(value: float) -> str:
    """A difference from the result; rounding errors of the result's own row are none."""
    return f"{value:.2g}" if value > 1e-9 else "0"


def view_markdown(view: ViewResult) -> str:
    """What became of one view."""
    lines = [f"# View {view.view}: {'used' if view.used else 'not used'}", ""]
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


def _markdown(text: str) -> rr.TextDocument:
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)

"""Charts of the report as SVG: residuals by view and over joints, and coverage.

They are lines, dots and words in the page's colours; matplotlib, whose import takes as long as all
else in a report, draws those of arms and boards.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup, escape

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import significant
from visioncal.core.transforms import invert, log
from visioncal.core.types import Camera, FloatArray
from visioncal.present.cell_poses import CellPoses
from visioncal.present.coverage import coverage_charts
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence
from visioncal.results.views import rms_of
from visioncal.session import Session, frame_name

# Width of a drawing, and room for labels to its left and right [px].
WIDTH, _LEFT, _RIGHT = 900.0, 70.0, 105.0
# Height of a panel with its gap, and of its scale [px].
_PANEL, _SCALE = 120.0, 92.0
# Distance of words above each other [px].
LINE_HEIGHT = 14.0
# Ends of lines, by which one without length is a dot.
_ROUND = 'style="stroke-linecap:round"'
_COLOURS = ("accent", "check", "good")
_LIMITS = CalibrationLimits()
# Kinds of residuals: label, attributes of a view and of `Rms`, and where doubt begins.
_MEASURES: tuple[tuple[str, str, str, float | None], ...] = (
    ("position [mm]", "residual_mm", "mm", _LIMITS.scatter_mm[0]),
    ("orientation [deg]", "residual_deg", "deg", _LIMITS.scatter_deg[0]),
    ("reprojection [px]", "rms_px", "px", None),
)
# Titles of the charts of the coverage.
_CHARTS = {
    "image": "corners in the image",
    "directions": "viewing directions",
    "rotation_axes": "rotation axes of the flange",
}


@dataclass
class Drawing:
    """Parts of an `<svg>` element, with the colours' names of the page."""

    parts: list[str] = field(default_factory=list)

    def path(self, colour: str, width: float, path: str, style: str = "") -> None:
        """Draws a path."""
        self.parts.append(
            f'<path d="{path}" fill="none" stroke="var(--{colour})" stroke-width="{width:.3g}" '
            f"{style}/>"
        )

    def text(self, x: float, y: float, words: str, anchor: str = "middle", more: str = "") -> None:
        """Writes words around a place, or before or after it (`end`, `start`)."""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" {more}>{escape(words)}</text>'
        )

    def svg(self, words: str, height: float) -> Markup:
        """The element, which scales with its container."""
        return Markup(
            f'<svg role="img" aria-label="{escape(words)}" viewBox="0 0 {WIDTH:g} {height:g}" '
            f'font-size="12" fill="var(--ink)">{"".join(self.parts)}</svg>'
        )


@dataclass
class Panel:
    """A scale from `low` to `high` in a drawing, whose zero is at the bottom or in the middle."""

    drawing: Drawing
    top: float  # Its upper end [px].
    low: float
    high: float

    def y(self, value: FloatArray | float) -> FloatArray:
        """Places of values in the drawing [px]."""
        share = (np.asarray(value, dtype=float) - self.low) / (self.high - self.low)
        return np.asarray(self.top + _SCALE * (1.0 - share))

    def draw_scale(self, label: str) -> None:
        """Draws lines at round values, with their figures."""
        wanted = (self.high - self.low) / 4
        decade = 10.0 ** np.floor(np.log10(wanted))
        step = decade * next(step for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= wanted)
        for value in step * np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1):
            y = float(self.y(value))
            self.drawing.path("line", 1.0, f"M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}")
            self.drawing.text(_LEFT - 6.0, y + 4.0, f"{value + 0.0:.6g}", "end")
        middle = self.top + 0.5 * _SCALE
        self.drawing.text(14.0, middle, label, more=f'transform="rotate(-90 14 {middle:.1f})"')

    def draw_level(self, value: float, words: str, colour: str, dashes: str) -> None:
        """Draws a dashed line at a value of at least zero, with words to its right."""
        y = float(self.y(value))
        style = f'stroke-dasharray="{dashes}"'
        self.drawing.path(colour, 1.2, f"M{_LEFT} {y:.1f}H{WIDTH - _RIGHT}", style)
        self.drawing.text(WIDTH - _RIGHT + 5.0, y + 4.0, words, "start")


def dots(x: Iterable[float], y: Iterable[float]) -> str:
    """A path that has a dot at each place, with round ends."""
    return "".join(f"M{across:.1f} {down:.1f}h0" for across, down in zip(x, y, strict=True))


def residuals(calibration: Calibration, outlying: Collection[int] = ()) -> Markup:
    """Residuals of all views: every kind for one camera, positions by camera for a cell.

    Args:
        calibration: The result.
        outlying: Numbers of used views to highlight, beside the unused ones.
    """
    is_cell = calibration.cell is not None
    by_seer: dict[str, list[ViewResult]] = {}
    for view in calibration.views:
        by_seer.setdefault(view.seer, []).append(view)
    shown = [
        (seer, views, measure)
        for seer, views in by_seer.items()
        for measure in (_MEASURES[:1] if is_cell else _MEASURES)
        if any(getattr(view, measure[1]) is not None for view in views)
    ]
    if not shown:
        return Markup("")
    drawing, pitch = Drawing(), _PANEL + 20.0 if is_cell else _PANEL
    for index, (seer, views, (label, name, unit, limit)) in enumerate(shown):
        values = np.array([getattr(view, name) for view in views], dtype=float)
        top = index * pitch + 22.0
        used = values[[view.used for view in views]]
        # Views that were not used do not compress the scale.
        scaled = used if len(used) else values
        high = 1.5 * float(scaled[np.isfinite(scaled)].max(initial=0.0)) or 1.0
        panel = Panel(drawing, top, 0.0, high)
        panel.draw_scale(label)
        _draw_views(panel, views, values, outlying)
        rms = getattr(rms_of(views), unit)
        if rms is not None:
            panel.draw_level(rms, f"rms {significant(rms)}", "ink", "5 4")
        if limit is not None and not is_cell:
            words, y = f"doubt from {limit:g}", float(panel.y(limit))
            if limit < panel.high:
                panel.draw_level(limit, "", "bad", "1 4")
            else:
                words, y = f"{words} \N{UPWARDS ARROW}", top
            if rms is not None and abs(y - panel.y(rms)) < LINE_HEIGHT:
                y += LINE_HEIGHT if limit < rms else -LINE_HEIGHT
            drawing.text(WIDTH - _RIGHT + 5.0, y + 4.0, words, "start")
        drawing.text(_LEFT, top - 8.0, seer, "start")
        # With several cameras, each panel has other views.
        if is_cell or index == len(shown) - 1:
            step = max(1, -(-len(views) // 25))
            for x, view in [*zip(_places(len(views)), views, strict=True)][::step]:
                drawing.text(x, top + _SCALE + 16.0, str(view.view))
    height = pitch * len(shown) + 40.0
    drawing.text(0.5 * (_LEFT + WIDTH - _RIGHT), height - 4.0, "view")
    return drawing.svg("Bars: residuals of each view", height)


def _places(count: int) -> FloatArray:
    """Centres of equal parts of a panel's width [px]."""
    return _LEFT + (np.arange(count) + 0.5) * (WIDTH - _LEFT - _RIGHT) / count


def _draw_views(
    panel: Panel, views: Sequence[ViewResult], values: FloatArray, outlying: Collection[int]
) -> None:
    """Draws a bar a view, and a mark at each that was not used."""
    drawing, places = panel.drawing, _places(len(views))
    bars: dict[str, str] = {}
    for view, x, value in zip(views, places, values, strict=True):
        left_out = "bad" if view.contradicts else "muted"
        colour = ("check" if view.view in outlying else "accent") if view.used else left_out
        height = min(np.nan_to_num(value), panel.high)
        bars[colour] = bars.get(colour, "") + f"M{x:.1f} {panel.y(0.0):.1f}V{panel.y(height):.1f}"
        if not view.used:
            beyond = f"\N{BLACK UP-POINTING TRIANGLE} {significant(float(value))}"
            mark = beyond if value > panel.high else "\N{MULTIPLICATION SIGN}"
            drawing.text(x, float(panel.y(height)) - 3.0, mark, more=f'fill="var(--{colour})"')
    width = 0.7 * (WIDTH - _LEFT - _RIGHT) / len(views)
    for colour, path in bars.items():
        drawing.path(colour, width, path)


def coverage(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """Coverage of the image, of viewing directions and of rotation axes, side by side."""
    charts = coverage_charts(calibration, evidence)
    if not charts:
        return Markup("")
    used = {view.view for view in calibration.views if view.used}
    drawing, side = Drawing(), WIDTH / 3.0
    for index, chart in enumerate(charts):
        ends = np.vstack([*chart.lines])
        middle, reach = 0.5 * (ends.max(axis=0) + ends.min(axis=0)), np.ptp(ends, axis=0).max()
        scale, at = 0.82 * side / reach, np.array([(index + 0.5) * side, 0.5 * side + 14.0])
        origin = at - scale * middle
        drawing.text(float(at[0]), 14.0, _CHARTS[chart.name])
        for line in chart.lines:
            corners = (f"{x:.1f} {y:.1f}" for x, y in scale * line + origin)
            drawing.path("line", 1.0, "M" + "L".join(corners))
        for place, words in chart.words:
            x, y = (scale * np.array(place) + origin).tolist()
            drawing.text(x, y + 4.0, words)
        for is_used, colour in ((True, "accent"), (False, "bad")):
            points = [xy for view, xy in chart.points.items() if (view in used) is is_used]
            if points:
                places = scale * np.vstack(points) + origin
                path = dots(*places[:: -(-len(places) // 3000)].T)
                drawing.path(colour, 2.2 if chart.name == "image" else 5.0, path, _ROUND)
    return drawing.svg("Coverage: corners, viewing directions, rotation axes", side + 20.0)


def depth_cells(
    evidence: Sequence[ViewEvidence], calibration: Calibration, camera: str
) -> FloatArray | None:
    """(n, 5) the cells of depth of a camera in all views; None without any."""
    seer = frame_name("camera", camera)
    camera_views = {view.view for view in calibration.views if not camera or view.seer == seer}
    parts = [
        view.depth for view in evidence if view.depth is not None and view.view in camera_views
    ]
    return np.concatenate(parts) if parts else None


def depth_deviations(camera: Camera, cells: FloatArray) -> Markup:
    """Deviations of (n, 5) cells of depth over the image, as measured and as corrected."""
    drawing, (width, height) = Drawing(), camera.resolution
    scale = 0.42 * WIDTH / width
    px = cells[:, :2]
    for index, (words, away_m) in enumerate(
        zip(("measured", "corrected"), cells.T[3:], strict=True)
    ):
        most_m = max(float(np.quantile(np.abs(away_m), 0.98)), 1e-6)
        x, y = scale * px.T[0] + (0.04 + 0.5 * index) * WIDTH, scale * px.T[1] + 24.0
        most = f"the largest dots are off by {significant(1e3 * most_m)} mm"
        drawing.text((0.25 + 0.5 * index) * WIDTH, 14.0, f"{words}: {most}")
        for step in np.linspace(0.2, 1.0, 5):
            sized = np.abs(np.clip(away_m / most_m, -1.0, 1.0))
            for is_long, colour in ((True, "bad"), (False, "accent")):
                shown = (sized > step - 0.2) & (sized <= step) & ((away_m > 0.0) == is_long)
                drawing.path(colour, 7.0 * step, dots(x[shown], y[shown]), _ROUND)
    return drawing.svg("Deviations of depth over the image", scale * height + 34.0)


def residuals_over_joints(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int] = (),
) -> Markup:
    """Residuals of the used views along the target's axes, over each joint's angle in turn.

    Args:
        calibration: The result.
        session: Session with the joint angles.
        evidence: Poses of the views.
        outlying: Numbers of used views to leave out, as they would compress the scale.
    """
    if session is None or not evidence:
        return Markup("")
    pairs = [*placements(calibration, session, evidence, outlying)]
    if len(pairs) < 3:
        return Markup("")
    joints_deg = np.rad2deg([joints for joints, _ in pairs])
    low, high = joints_deg.min(axis=0), joints_deg.max(axis=0)
    # Each joint has a part of the width of its own, from its smallest to its largest angle.
    centres = _places(len(low))
    part = 0.8 * (WIDTH - _LEFT - _RIGHT) / len(low)
    places = centres + part * ((joints_deg - low) / np.maximum(high - low, 1e-9) - 0.5)
    twists, drawing = log(np.array([placed for _, placed in pairs])), Drawing()
    for index, (values, label) in enumerate(
        ((1e3 * twists[:, 3:], "position [mm]"), (np.rad2deg(twists[:, :3]), "rotation [deg]"))
    ):
        # A few large points would compress the others.
        reach = 1.3 * float(np.percentile(np.abs(values), 95.0)) or 1.0
        panel = Panel(drawing, index * _PANEL + 24.0, -reach, reach)
        panel.draw_scale(label)
        for colour, column in zip(_COLOURS, np.clip(values, -reach, reach).T, strict=True):
            heights = np.broadcast_to(panel.y(column)[:, None], places.shape)
            drawing.path(colour, 3.5, dots(places.ravel(), heights.ravel()), _ROUND)
    for joint, (x, start, end) in enumerate(zip(centres, low, high, strict=True), 1):
        drawing.text(x, 2 * _PANEL + 14.0, f"q{joint}")
        drawing.text(x, 2 * _PANEL + 30.0, f"{start:.0f} to {end:.0f} deg")
    for index, (name, colour) in enumerate(zip("xyz", _COLOURS, strict=True)):
        x = WIDTH - _RIGHT - 60.0 * (2 - index)
        drawing.text(x, 12.0, f"target {name}", "end", f'fill="var(--{colour})"')
    return drawing.svg("Residuals of the used views over each joint's angle", 2 * _PANEL + 36.0)


def placements(
    calibration: Calibration,
    session: Session,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int],
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Joint angles (n,) [rad] of each used view, and the target's pose (4, 4) by it.

    The pose is relative to the result's, in the target's frame [m].
    """
    rows = {view.number: view for view in session.views}
    used = {view.view for view in calibration.views if view.used and view.view not in outlying}
    cell = CellPoses.of(session, calibration, {view.view: view for view in evidence})
    sensor, *placed = (name.rpartition("_from_")[2] for name in calibration.edges)
    for seen in evidence:
        row, pose = rows.get(seen.view), seen.cam_from_target
        if seen.view not in used or row is None or row.joints_rad is None or pose is None:
            continue
        named = session.board_frames.get(session.board_of(row), "")
        target = cell.in_cell(named if named in placed else placed[0], seen.view)
        eye = cell.in_cell(sensor, seen.view)
        if target is not None and eye is not None:
            yield row.joints_rad, invert(target) @ eye @ pose

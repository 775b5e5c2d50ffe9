"""Plots of the report: residuals by view and joint angle, coverage, tools and fixtures."""

import base64
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import significant
from visioncal.core.transforms import log, nearest_rotation
from visioncal.core.types import FloatArray, IntArray
from visioncal.present.advice import contradicts
from visioncal.present.coverage import directions_chart
from visioncal.present.placements import placement, target_frames
from visioncal.present.report import svg
from visioncal.present.report.axes import Box, Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.svg import Figure
from visioncal.results import Calibration, Frame, Observation, Rms, ViewResult
from visioncal.results.evidence import ViewEvidence
from visioncal.results.views import rms_of
from visioncal.session import Session

# Above this number of marks a bitmap is smaller than vectors.
_MANY_MARKS = 2500
# Widths of figures at which their text matches the page's.
_WIDE_IN, _SMALL_IN = 9.2, 3.7
# Number of colours for errors; size of dots [points]; pixels per point and dot radius in bitmaps.
_SHADES, _DOT_PT, _DOTS_A_POINT, _DOT_REACH = 24, 2.2, 2.0, 2
_AXES = (("x", svg.ACCENT), ("y", svg.CHECK), ("z", svg.GOOD))
_WIDTH_IN, _ROW_IN = 9.2, 1.25
# Scales ignore the few largest points, which would compress the others.
_ROOM, _KEPT_PERCENT = 1.3, 95.0
# Width of a mark.
_DASH_PT = 2.4

_FRAME_WIDTH_IN, _FRAME_HEIGHT_IN = 5.0, 1.7
# Labels with more characters in total are vertical; longest label.
_MOST_CHARACTERS, _LONGEST = 36, 12
_MOST_LABELS = 24
# Mean width of a letter.
_LETTER_IN = 0.068

_HEADROOM, _WIDTH = 1.25, 0.7


@dataclass(frozen=True)
class Bar:
    """One bar of a bar chart.

    Attributes:
        label: Axis label.
        value: Height; None where unknown.
        used: Whether it was used; used bars define the scale.
        colour: Colour of the bar and its mark.
    """

    label: str
    value: float | None
    used: bool
    colour: str


def draw_bars(
    figure: Figure,
    box: Box,
    bars: Sequence[Bar],
    rms: float | None,
    most_labels: int = 25,
    limit: float | None = None,
    *,
    titles: tuple[str, str] = ("", ""),
    labelled: bool = True,
    turned: bool = False,
) -> None:
    """Draws a bar chart, clipped to the scale of the used bars.

    Args:
        figure: Figure to draw in.
        box: Box of the chart.
        bars: Bars from left to right.
        rms: Root mean square of the used bars, drawn as a line; None for no line.
        most_labels: Largest number of labels below the bars.
        limit: Value where doubt begins: a line if the scale contains it, else a text. None for
            neither.
        titles: Titles of the horizontal and the vertical axis.
        labelled: Whether bars have labels.
        turned: Whether labels are vertical.
    """
    valued = [
        (position, bar, bar.value) for position, bar in enumerate(bars) if bar.value is not None
    ]
    used = [value for _, bar, value in valued if bar.used]
    top = _HEADROOM * max(used or [value for _, _, value in valued], default=1.0) or 1.0
    panel = Panel(figure, box, Scale(-0.7, len(bars) - 0.3), Scale(0.0, 1.2 * top))
    step = max(1, -(-len(bars) // most_labels))
    ticks = [(float(position), bars[position].label) for position in range(0, len(bars), step)]
    panel.x_axis(titles[0], ticks, grid=False, words=labelled, turned=turned)
    panel.y_axis(titles[1])
    for colour in dict.fromkeys(bar.colour for _, bar, _ in valued):
        shown = [(position, value) for position, bar, value in valued if bar.colour == colour]
        panel.bars(
            [index for index, _ in shown], [min(value, top) for _, value in shown], _WIDTH, colour
        )
    for position, bar, value in valued:
        if not bar.used:
            _mark_unused(panel, position, bar, value, top)
    for position, bar in enumerate(bars):
        if bar.value is None and not bar.used:
            panel.marks([position], [0.05 * top], "x", bar.colour, 5.0)
    if rms is not None:
        panel.level(rms, svg.INK, dash=svg.DASHED)
        label, height = f"rms {significant(rms)}", float(panel.y_at(rms))
        figure.text(box.right + 4.0, height, label, size=svg.SMALL, rise="middle")
    if limit is not None:
        _draw_limit(panel, limit, top)


def _draw_limit(panel: Panel, limit: float, top: float) -> None:
    words, box = f"doubt from {limit:g}", panel.box
    if limit < top * 1.1:
        panel.level(limit, svg.BAD, dash=svg.DOTTED)
        above = float(panel.y_at(limit)) - 2.0
        panel.figure.text(box.left + 4.0, above, words, size=svg.SMALL, colour=svg.BAD)
        return
    panel.figure.text(
        box.right, box.top + 2.0, f"{words} \N{UPWARDS ARROW}", size=svg.SMALL, colour=svg.MUTED,
        anchor="end", rise="top",
    )  # fmt: skip


def _mark_unused(panel: Panel, position: int, bar: Bar, value: float, top: float) -> None:
    """Marks an unused bar, with its value if it exceeds the scale."""
    clipped = value > top
    panel.marks([position], [min(value, top)], "^" if clipped else "x", bar.colour, 5.0)
    if clipped:
        x, y = float(panel.x_at(position)), float(panel.y_at(top)) - 5.0
        panel.figure.text(x, y, significant(value), size=svg.SMALL, colour=bar.colour,
                          anchor="middle")  # fmt: skip


@dataclass(frozen=True)
class _Measure:
    """A kind of residual: its label, its value for a view and for many, and where doubt begins."""

    label: str
    value_of: Callable[[ViewResult], float | None]
    rms_of: Callable[[Rms], float | None]
    limit: float | None


_MEASURES = (
    _Measure(
        "position [mm]",
        lambda view: view.residual_mm,
        lambda rms: rms.mm,
        CalibrationLimits().scatter_mm[0],
    ),
    _Measure(
        "orientation [deg]",
        lambda view: view.residual_deg,
        lambda rms: rms.deg,
        CalibrationLimits().scatter_deg[0],
    ),
    _Measure("reprojection [px]", lambda view: view.rms_px, lambda rms: rms.px, None),
)


def residuals(calibration: Calibration, outlying: Collection[int] = ()) -> Markup:
    """Residuals of all views: every kind for one camera, positions by camera for a cell.

    Args:
        calibration: The result.
        outlying: Numbers of used views to highlight, beside the unused ones.

    Returns:
        The figure; empty without residuals.
    """
    measures: tuple[_Measure, ...] = _MEASURES
    if calibration.cell is not None:
        measures = (replace(_MEASURES[0], limit=None),)
    by_seer: dict[str, list[ViewResult]] = {}
    for view in calibration.views:
        by_seer.setdefault(view.seer, []).append(view)
    shown = [
        (seer, seer_views, measure)
        for seer, seer_views in by_seer.items()
        for measure in measures
        if any(measure.value_of(view) is not None for view in seer_views)
    ]
    if not shown:
        return Markup("")
    header_in = 0.3 if calibration.cell is not None else 0.0
    figure = Figure(_WIDE_IN, (1.3 + header_in) * len(shown) + 0.25)
    rows = boxes(
        figure, len(shown), 1, Margins(0.75, 0.75, top=0.1 + header_in), (0.0, 0.15 + header_in)
    )
    for (box,), (seer, seer_views, measure) in zip(rows, shown, strict=True):
        is_last = box is rows[-1][0]
        bars = [Bar(str(view.view), measure.value_of(view), view.used, _colour(view, outlying))
                  for view in seer_views]  # fmt: skip
        # With several cameras, each panel has other views.
        labelled = is_last or calibration.cell is not None
        draw_bars(figure, box, bars, measure.rms_of(rms_of(seer_views)), limit=measure.limit,
                  labelled=labelled, titles=("view" if is_last else "", measure.label))  # fmt: skip
        figure.text(box.left, box.top - 5.0, seer)
    return figure.inline("Bars: residuals of each view")


def _colour(view: ViewResult, outlying: Collection[int]) -> str:
    if view.used:
        return svg.CHECK if view.view in outlying else svg.ACCENT
    return svg.BAD if contradicts(view) else svg.MUTED


def image_coverage(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """Corners of the used views over the image, coloured by reprojection error."""
    used = {view.view for view in calibration.views if view.used}
    seen = [view for view in evidence if view.corners is not None and view.view in used]
    if not seen or calibration.camera is None:
        return Markup("")
    px = np.concatenate([view.corners.px for view in seen if view.corners is not None])
    errors = np.concatenate([_corner_errors(view) for view in seen])
    with_error = np.isfinite(errors)
    width, height = calibration.camera.camera.resolution
    errors_known = bool(with_error.any())
    margins = Margins(right=0.85 if errors_known else 0.15)
    width_in = _SMALL_IN - margins.left - margins.right
    figure = Figure(_SMALL_IN, margins.top + width_in * height / width + margins.bottom)
    ((box,),) = boxes(figure, 1, 1, margins)
    scale_x, scale_y = Scale(-0.5, width - 0.5), Scale(height - 0.5, -0.5)
    panel = Panel(figure, box.shaped(height / width), scale_x, scale_y)
    panel.x_axis("image x [px]", 4)
    panel.y_axis("image y [px]", 5)
    panel.frame()
    top = float(np.percentile(errors[with_error], 98)) if errors_known else 1.0
    steps, colours = svg.shades(errors[with_error], 0.0, top, svg.PLASMA, _SHADES)
    layers = [(px[~with_error], svg.ACCENT), *((px[with_error][steps == index], colours[index])
                                          for index in range(_SHADES))]  # fmt: skip
    if len(px) > _MANY_MARKS and errors_known:
        _draw_bitmap(panel, px[with_error], steps, colours)
    else:
        for positions, colour in layers:
            panel.marks(positions[:, 0], positions[:, 1], "dot", colour, _DOT_PT)
    if errors_known:
        panel.colour_bar(Scale(0.0, top), svg.PLASMA, "reprojection error [px]")
    return figure.inline("Corners of all used views over the image")


def _draw_bitmap(panel: Panel, px: FloatArray, steps: IntArray, colours: Sequence[str]) -> None:
    box: Box = panel.box
    size = np.array([box.right - box.left, box.bottom - box.top]) * _DOTS_A_POINT
    image = np.zeros((int(size[1]) + 1, int(size[0]) + 1, 4), np.uint8)
    shades = np.array([[int(colour[k : k + 2], 16) for k in (5, 3, 1)] for colour in colours])
    shares = np.stack([panel.x.shares(px[:, 0]), 1.0 - panel.y.shares(px[:, 1])], axis=1)
    centres = np.round(shares * size - 0.5).astype(int)
    reach = range(-_DOT_REACH, _DOT_REACH + 1)
    for shift in ((i, j) for i in reach for j in reach if abs(i) + abs(j) < 2 * _DOT_REACH):
        x, y = np.clip(centres + shift, 0, size.astype(int)).T
        image[y, x, :3], image[y, x, 3] = shades[steps], 255
    encoded = cv2.imencode(".png", image)[1].tobytes()
    uri = "data:image/png;base64," + base64.b64encode(encoded).decode("ascii")
    panel.figure.image(box.left, box.top, box.right - box.left, box.bottom - box.top, uri)


def _corner_errors(evidence: ViewEvidence) -> FloatArray:
    """Reprojection errors of a view's corners [px]; NaN without predictions."""
    if evidence.corners is None:
        return np.zeros(0)
    if evidence.predicted_px is None:
        return np.full(len(evidence.corners.px), np.nan)
    return np.asarray(np.linalg.norm(evidence.corners.px - evidence.predicted_px, axis=1))


def viewing_directions(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """Viewing directions towards the target: tilt against its normal, and azimuth."""
    chart = directions_chart({view.view: view for view in evidence})
    if chart is None or calibration.mount == "instrument":
        return Markup("")
    used = {view.view for view in calibration.views if view.used}
    seen = [
        (mark, colour, label, np.vstack(shown))
        for is_used, mark, colour, label in (
            (True, "dot", svg.ACCENT, "used"),
            (False, "x", svg.BAD, "not used"),
        )
        if (
            shown := [
                positions for view, positions in chart.points.items() if (view in used) is is_used
            ]
        )
    ]
    farthest_deg = max(float(np.linalg.norm(positions, axis=1).max()) for *_, positions in seen)
    top = max(45.0, 5.0 + farthest_deg)
    figure = Figure(_SMALL_IN, 3.0)
    centre_x, radius = 0.5 * figure.width, 0.5 * figure.height - 24.0
    box = Box(centre_x - radius, 24.0, centre_x + radius, 24.0 + 2.0 * radius)
    panel = Panel(figure, box, Scale(-top, top), Scale(top, -top))
    _draw_rings(panel, [tick for tick in Scale(0.0, top).ticks(4, whole=True) if tick > 0.0], top)
    for mark, colour, _, positions in seen:
        panel.marks(positions[:, 0], positions[:, 1], mark, colour)
    if len(seen) > 1:
        signs = {"dot": "\N{BLACK CIRCLE}", "x": "\N{MULTIPLICATION SIGN}"}
        entries = [(signs[mark], colour, label) for mark, colour, label, *_ in seen]
        figure.legend(4.0, figure.height - 4.0, entries, anchor="start")
    return figure.inline("Where the camera looked from")


def _draw_rings(panel: Panel, rings_deg: Sequence[float], top_deg: float) -> None:
    """Draws circles of equal tilt with labels, and the target's axes."""
    figure, box = panel.figure, panel.box
    x, y = 0.5 * (box.left + box.right), 0.5 * (box.top + box.bottom)
    radius = 0.5 * (box.right - box.left)
    for tilt_deg in (*rings_deg, top_deg):
        r = radius * tilt_deg / top_deg
        ring = f"a{r:.1f} {r:.1f} 0 1 0 {2 * r:.1f} 0a{r:.1f} {r:.1f} 0 1 0 -{2 * r:.1f} 0z"
        figure.path(f"M{x - r:.1f} {y:.1f}{ring}", stroke=svg.LINE, width=0.6)
    cross = f"M{box.left:.1f} {y:.1f}H{box.right:.1f}M{x:.1f} {box.top:.1f}V{box.bottom:.1f}"
    figure.path(cross, stroke=svg.LINE, width=0.6)
    for tilt_deg in rings_deg:
        # Labels lie along a line between two axes.
        r_label = radius * tilt_deg / top_deg
        label = f"{tilt_deg:.0f}\N{DEGREE SIGN}"
        figure.text(x + 0.92 * r_label, y - 0.38 * r_label, label, colour=svg.MUTED)
    for label, dx, dy, anchor in (
        ("x", radius + 6.0, 0.0, "start"),
        ("y", 0.0, radius + 9.0, "middle"),
        ("-x", -radius - 6.0, 0.0, "end"),
        ("-y", 0.0, -radius - 9.0, "middle"),
    ):
        figure.text(x + dx, y + dy, label, colour=svg.MUTED, anchor=anchor, rise="middle")


def flange_rotations(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """Rotation of the flange from its mean orientation, about each of its axes."""
    used = {view.view for view in calibration.views if view.used}
    poses = [
        view.base_from_flange
        for view in evidence
        if view.base_from_flange is not None and view.view in used
    ]
    if len(poses) < 2:
        return Markup("")
    rotations = np.stack(poses)[:, :3, :3]
    base_from_mean = nearest_rotation(rotations.mean(axis=0))
    rotvecs_deg = np.rad2deg(Rotation.from_matrix(base_from_mean.T @ rotations).as_rotvec())
    reach = max(10.0, 1.1 * float(np.abs(rotvecs_deg).max()))
    figure = Figure(_SMALL_IN, 2.0)
    ((box,),) = boxes(figure, 1, 1, Margins(left=0.5))
    panel = Panel(figure, box, Scale(-reach, reach), Scale(2.6, -0.6))
    panel.x_axis("rotation from the mean orientation [deg]")
    panel.y_axis("flange axis", [(0.0, "x"), (1.0, "y"), (2.0, "z")])
    for row in range(3):
        panel.marks(rotvecs_deg[:, row], np.full(len(rotvecs_deg), row), "|", svg.ACCENT, 17.0)
    return figure.inline("Rotations of the flange in the used views")


def residuals_over_joints(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int] = (),
) -> Markup:
    """Residuals of the used views along the target's axes, one column per joint.

    Args:
        calibration: The result.
        session: Session with the joint angles.
        evidence: Poses of the views.
        outlying: Numbers of used views to leave out, as they would compress the scale.

    Returns:
        The figure; empty without joint angles.
    """
    if session is None or not evidence:
        return Markup("")
    joints_rad = {view.number: view.joints_rad for view in session.views}
    shown = {view.view for view in calibration.views if view.used and view.view not in outlying}
    frames = target_frames(calibration, session)
    pairs = [
        (joints, log(placed))
        for view in evidence
        if view.view in shown
        and (joints := joints_rad.get(view.view)) is not None
        and (placed := placement(calibration, view, frames.get(view.view))) is not None
    ]
    if len(pairs) < 3:
        return Markup("")
    joints_deg = np.rad2deg([joints for joints, _ in pairs])
    twists = np.array([residual for _, residual in pairs])
    return _joint_figure(joints_deg, 1e3 * twists[:, 3:], np.rad2deg(twists[:, :3]))


def _joint_figure(
    joints_deg: FloatArray, residuals_mm: FloatArray, residuals_deg: FloatArray
) -> Markup:
    """Plots (m, 3) position and orientation residuals against (m, n) joint angles."""
    count = joints_deg.shape[1]
    figure = Figure(_WIDTH_IN, 2 * _ROW_IN + 0.5)
    upper, lower = boxes(figure, 2, count, Margins(0.85, top=0.3))
    for row, values, label in (
        (upper, residuals_mm, "position [mm]"),
        (lower, residuals_deg, "rotation [deg]"),
    ):
        reach = _ROOM * float(np.percentile(np.abs(values), _KEPT_PERCENT)) or 1.0
        shown, is_lower = np.clip(values, -reach, reach), row is lower
        for joint, box in enumerate(row):
            angles_deg = joints_deg[:, joint]
            panel = Panel(figure, box, spanning(angles_deg), Scale(-1.1 * reach, 1.1 * reach))
            title = f"q{joint + 1} [deg]" if is_lower else ""
            panel.x_axis(title, 3, words=is_lower, whole=True)
            panel.y_axis("" if joint else label, words=joint == 0)
            panel.level(0.0, svg.INK, 0.7)
            for column, (_, colour) in enumerate(_AXES):
                panel.marks(angles_deg, shown[:, column], "-", colour, _DASH_PT)
    sign = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}"
    entries = [(sign, colour, f"target {name}") for name, colour in _AXES]
    figure.legend(upper[-1].right, 12.0, entries)
    return figure.inline("Residuals of the used views over each joint's angle")


def frame_plot(name: str, frame: Frame) -> Markup:
    """Residual of each observation of a tool or a fixture; outliers in red."""
    if all(observation.residual_mm is None for observation in frame.observations):
        return Markup("")
    names = [observation.name for observation in frame.observations]
    labels = [
        name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}\N{HORIZONTAL ELLIPSIS}"
        for name in names
    ]
    vertical = sum(map(len, labels)) > _MOST_CHARACTERS
    shown = [
        Bar(label, observation.residual_mm, observation.used, _observation_colour(observation))
        for label, observation in zip(labels, frame.observations, strict=True)
    ]
    bottom_in = 0.25 + _LETTER_IN * max(map(len, labels)) if vertical else 0.3
    figure = Figure(_FRAME_WIDTH_IN, _FRAME_HEIGHT_IN + (0.4 if vertical else 0.0))
    ((box,),) = boxes(figure, 1, 1, Margins(0.65, 0.65, bottom_in))
    draw_bars(figure, box, shown, frame.rms_mm, _MOST_LABELS, titles=("", "off by [mm]"),
              turned=vertical)  # fmt: skip
    return figure.inline(f"Bars: what each observation of {name} is off")


def _observation_colour(observation: Observation) -> str:
    if not observation.used:
        return svg.BAD
    return svg.CHECK if observation.reason else svg.ACCENT

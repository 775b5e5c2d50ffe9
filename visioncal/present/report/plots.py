"""The report's plots: residuals by view and by joint angle, coverage; frames."""

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

# Beyond this many marks a bitmap is smaller than the vectors.
_MANY_MARKS = 2500
# Widths of figures, such that their text is as large as the page's.
_WIDE_IN, _SMALL_IN = 9.2, 3.7
# Colours that errors have, and how large dots are: in points, and of a bitmap in its pixels.
_SHADES, _DOT_PT, _DOTS_A_POINT, _DOT_REACH = 24, 2.2, 2.0, 2
_AXES = (("x", svg.ACCENT), ("y", svg.CHECK), ("z", svg.GOOD))
_WIDTH_IN, _ROW_IN = 9.2, 1.25
# Few points beyond the scale do not flatten the cloud of the others.
_ROOM, _KEPT_PERCENT = 1.3, 95.0
# How wide a point is.
_DASH_PT = 2.4

_FRAME_WIDTH_IN, _FRAME_HEIGHT_IN = 5.0, 1.7
# More characters than this below the bars run into each other, so their labels stand upright.
_MOST_CHARACTERS, _LONGEST = 36, 12
_MOST_LABELS = 24
# Mean width of a letter.
_LETTER_IN = 0.068

_HEADROOM, _WIDTH = 1.25, 0.7


@dataclass(frozen=True)
class Bar:
    """One of them.

    Attributes:
        label: What it is, for the axis.
        value: Its height; None where that is unknown.
        used: Whether it was used; the scale is that of the used ones.
        colour: Of the bar and its mark.
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
    """Draws bars side by side; what exceeds the used ones' scale is clipped.

    Args:
        figure: Where to.
        box: Where in it.
        bars: From left to right.
        rms: Root mean square over the used ones, drawn as a line; None draws none.
        most_labels: How many labels have room below them.
        limit: Where doubt begins; a line where the scale holds it, else words. None for nothing.
        titles: Of the axis below and of that at the left.
        labelled: Whether bars have labels.
        turned: Whether these stand upright.
    """
    known = [(place, bar, bar.value) for place, bar in enumerate(bars) if bar.value is not None]
    used = [value for _, bar, value in known if bar.used]
    top = _HEADROOM * max(used or [value for _, _, value in known], default=1.0) or 1.0
    panel = Panel(figure, box, Scale(-0.7, len(bars) - 0.3), Scale(0.0, 1.2 * top))
    step = max(1, -(-len(bars) // most_labels))
    ticks = [(float(place), bars[place].label) for place in range(0, len(bars), step)]
    panel.x_axis(titles[0], ticks, grid=False, words=labelled, turned=turned)
    panel.y_axis(titles[1])
    for colour in dict.fromkeys(bar.colour for _, bar, _ in known):
        shown = [(place, value) for place, bar, value in known if bar.colour == colour]
        panel.bars(
            [index for index, _ in shown], [min(value, top) for _, value in shown], _WIDTH, colour
        )
    for place, bar, value in known:
        if not bar.used:
            _mark(panel, place, bar, value, top)
    for place, bar in enumerate(bars):
        if bar.value is None and not bar.used:
            panel.marks([place], [0.05 * top], "x", bar.colour, 5.0)
    if rms is not None:
        panel.level(rms, svg.INK, dash=svg.DASHED)
        words, at = f"rms {significant(rms)}", float(panel.y_at(rms))
        figure.text(box.right + 4.0, at, words, size=svg.SMALL, rise="middle")
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


def _mark(panel: Panel, place: int, bar: Bar, value: float, top: float) -> None:
    """Marks one that was not used, with its value where that lies beyond the scale."""
    clipped = value > top
    panel.marks([place], [min(value, top)], "^" if clipped else "x", bar.colour, 5.0)
    if clipped:
        x, y = float(panel.x_at(place)), float(panel.y_at(top)) - 5.0
        panel.figure.text(x, y, significant(value), size=svg.SMALL, colour=bar.colour,
                          anchor="middle")  # fmt: skip


@dataclass(frozen=True)
class _Measure:
    """A kind of residual: its label, its value of a view and of many, and where doubt begins."""

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
    """Residuals of every view: of one camera all, of a whole cell its positions by camera.

    Args:
        calibration: The result.
        outlying: Numbers of used views that are marked, beside those that were not used.

    Returns:
        The figure; empty where there are no residuals.
    """
    measures: tuple[_Measure, ...] = _MEASURES
    if calibration.cell is not None:
        measures = (replace(_MEASURES[0], limit=None),)
    by_seer: dict[str, list[ViewResult]] = {}
    for view in calibration.views:
        by_seer.setdefault(view.seer, []).append(view)
    shown = [
        (seer, mine, measure)
        for seer, mine in by_seer.items()
        for measure in measures
        if any(measure.value_of(view) is not None for view in mine)
    ]
    if not shown:
        return Markup("")
    named = 0.3 if calibration.cell is not None else 0.0
    figure = Figure(_WIDE_IN, (1.3 + named) * len(shown) + 0.25)
    rows = boxes(figure, len(shown), 1, Margins(0.75, 0.75, top=0.1 + named), (0.0, 0.15 + named))
    for (box,), (seer, mine, measure) in zip(rows, shown, strict=True):
        last = box is rows[-1][0]
        marked = [Bar(str(view.view), measure.value_of(view), view.used, _colour(view, outlying))
                  for view in mine]  # fmt: skip
        # Views of several cameras are other ones in each panel.
        labelled = last or calibration.cell is not None
        draw_bars(figure, box, marked, measure.rms_of(rms_of(mine)), limit=measure.limit,
                  labelled=labelled, titles=("view" if last else "", measure.label))  # fmt: skip
        figure.text(box.left, box.top - 5.0, seer)
    return figure.inline("Bars: residuals of each view")


def _colour(view: ViewResult, outlying: Collection[int]) -> str:
    if view.used:
        return svg.CHECK if view.view in outlying else svg.ACCENT
    return svg.BAD if contradicts(view) else svg.MUTED


def image_coverage(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """All corners of the used views over the image frame, coloured by reprojection error."""
    used = {view.view for view in calibration.views if view.used}
    seen = [view for view in evidence if view.corners is not None and view.view in used]
    if not seen or calibration.camera is None:
        return Markup("")
    px = np.concatenate([view.corners.px for view in seen if view.corners is not None])
    errors = np.concatenate([_corner_errors(view) for view in seen])
    known = np.isfinite(errors)
    width, height = calibration.camera.camera.resolution
    errors_known = bool(known.any())
    margins = Margins(right=0.85 if errors_known else 0.15)
    wide = _SMALL_IN - margins.left - margins.right
    figure = Figure(_SMALL_IN, margins.top + wide * height / width + margins.bottom)
    ((box,),) = boxes(figure, 1, 1, margins)
    across, down = Scale(-0.5, width - 0.5), Scale(height - 0.5, -0.5)
    panel = Panel(figure, box.shaped(height / width), across, down)
    panel.x_axis("image x [px]", 4)
    panel.y_axis("image y [px]", 5)
    panel.frame()
    top = float(np.percentile(errors[known], 98)) if errors_known else 1.0
    steps, colours = svg.shades(errors[known], 0.0, top, svg.PLASMA, _SHADES)
    layers = [(px[~known], svg.ACCENT), *((px[known][steps == index], colours[index])
                                          for index in range(_SHADES))]  # fmt: skip
    if len(px) > _MANY_MARKS and errors_known:
        _draw_bitmap(panel, px[known], steps, colours)
    else:
        for places, colour in layers:
            panel.marks(places[:, 0], places[:, 1], "dot", colour, _DOT_PT)
    if errors_known:
        panel.colour_bar(Scale(0.0, top), svg.PLASMA, "reprojection error [px]")
    return figure.inline("Corners of all used views over the image")


def _draw_bitmap(panel: Panel, px: FloatArray, steps: IntArray, colours: Sequence[str]) -> None:
    """Draws coloured dots as pixels."""
    box: Box = panel.box
    size = np.array([box.right - box.left, box.bottom - box.top]) * _DOTS_A_POINT
    image = np.zeros((int(size[1]) + 1, int(size[0]) + 1, 4), np.uint8)
    shades = np.array([[int(colour[k : k + 2], 16) for k in (5, 3, 1)] for colour in colours])
    shares = np.stack([panel.x.shares(px[:, 0]), 1.0 - panel.y.shares(px[:, 1])], axis=1)
    middle = np.round(shares * size - 0.5).astype(int)
    reach = range(-_DOT_REACH, _DOT_REACH + 1)
    for shift in ((i, j) for i in reach for j in reach if abs(i) + abs(j) < 2 * _DOT_REACH):
        x, y = np.clip(middle + shift, 0, size.astype(int)).T
        image[y, x, :3], image[y, x, 3] = shades[steps], 255
    encoded = cv2.imencode(".png", image)[1].tobytes()
    uri = "data:image/png;base64," + base64.b64encode(encoded).decode("ascii")
    panel.figure.image(box.left, box.top, box.right - box.left, box.bottom - box.top, uri)


def _corner_errors(evidence: ViewEvidence) -> FloatArray:
    """Distances [px] of a view's corners from their predictions; NaN where there is none."""
    if evidence.corners is None:
        return np.zeros(0)
    if evidence.predicted_px is None:
        return np.full(len(evidence.corners.px), np.nan)
    return np.asarray(np.linalg.norm(evidence.corners.px - evidence.predicted_px, axis=1))


def viewing_directions(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """Where the camera looked at the target from: tilt against its normal, and azimuth."""
    chart = directions_chart({view.view: view for view in evidence})
    if chart is None or calibration.mount == "instrument":
        return Markup("")
    used = {view.view for view in calibration.views if view.used}
    seen = [
        (mark, colour, words, np.vstack(some))
        for is_used, mark, colour, words in (
            (True, "dot", svg.ACCENT, "used"),
            (False, "x", svg.BAD, "not used"),
        )
        if (some := [places for view, places in chart.points.items() if (view in used) is is_used])
    ]
    farthest_deg = max(float(np.linalg.norm(places, axis=1).max()) for *_, places in seen)
    top = max(45.0, 5.0 + farthest_deg)
    figure = Figure(_SMALL_IN, 3.0)
    middle, radius = 0.5 * figure.width, 0.5 * figure.height - 24.0
    box = Box(middle - radius, 24.0, middle + radius, 24.0 + 2.0 * radius)
    panel = Panel(figure, box, Scale(-top, top), Scale(top, -top))
    _draw_rings(panel, [tick for tick in Scale(0.0, top).ticks(4, whole=True) if tick > 0.0], top)
    for mark, colour, _, places in seen:
        panel.marks(places[:, 0], places[:, 1], mark, colour)
    if len(seen) > 1:
        signs = {"dot": "\N{BLACK CIRCLE}", "x": "\N{MULTIPLICATION SIGN}"}
        entries = [(signs[mark], colour, words) for mark, colour, words, *_ in seen]
        figure.legend(4.0, figure.height - 4.0, entries, anchor="start")
    return figure.inline("Where the camera looked from")


def _draw_rings(panel: Panel, rings_deg: Sequence[float], top_deg: float) -> None:
    """Draws the lines of equal tilt with their degrees, and the target's axes."""
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
        # Along a line between two axes.
        at = radius * tilt_deg / top_deg
        words = f"{tilt_deg:.0f}\N{DEGREE SIGN}"
        figure.text(x + 0.92 * at, y - 0.38 * at, words, colour=svg.MUTED)
    for words, across, down, anchor in (
        ("x", radius + 6.0, 0.0, "start"),
        ("y", 0.0, radius + 9.0, "middle"),
        ("-x", -radius - 6.0, 0.0, "end"),
        ("-y", 0.0, -radius - 9.0, "middle"),
    ):
        figure.text(x + across, y + down, words, colour=svg.MUTED, anchor=anchor, rise="middle")


def flange_rotations(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> Markup:
    """How far the flange turned from its mean orientation, about each of its own axes."""
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
    turns_deg = np.rad2deg(Rotation.from_matrix(base_from_mean.T @ rotations).as_rotvec())
    reach = max(10.0, 1.1 * float(np.abs(turns_deg).max()))
    figure = Figure(_SMALL_IN, 2.0)
    ((box,),) = boxes(figure, 1, 1, Margins(left=0.5))
    panel = Panel(figure, box, Scale(-reach, reach), Scale(2.6, -0.6))
    panel.x_axis("rotation from the mean orientation [deg]")
    panel.y_axis("flange axis", [(0.0, "x"), (1.0, "y"), (2.0, "z")])
    for row in range(3):
        panel.marks(turns_deg[:, row], np.full(len(turns_deg), row), "|", svg.ACCENT, 17.0)
    return figure.inline("Rotations of the flange in the used views")


def residuals_over_joints(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int] = (),
) -> Markup:
    """Residuals of the used views along the target's axes, one column a joint.

    Args:
        calibration: The result.
        session: Where the joint angles are.
        evidence: The views' poses.
        outlying: Numbers of used views to leave out, which would hide the others.

    Returns:
        The figure; empty where there are no joint angles.
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
    return _figure(joints_deg, 1e3 * twists[:, 3:], np.rad2deg(twists[:, :3]))


def _figure(joints_deg: FloatArray, away_mm: FloatArray, away_deg: FloatArray) -> Markup:
    """Draws (m, n) joint angles against (m, 3) residuals of position and of orientation."""
    count = joints_deg.shape[1]
    figure = Figure(_WIDTH_IN, 2 * _ROW_IN + 0.5)
    upper, lower = boxes(figure, 2, count, Margins(0.85, top=0.3))
    for row, values, label in (
        (upper, away_mm, "position [mm]"),
        (lower, away_deg, "rotation [deg]"),
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
    """Bars of what each observation is off; the wrong ones in red."""
    if all(observation.residual_mm is None for observation in frame.observations):
        return Markup("")
    labels = [_short(observation.name) for observation in frame.observations]
    upright = sum(map(len, labels)) > _MOST_CHARACTERS
    shown = [
        Bar(label, observation.residual_mm, observation.used, _colour_of_thing(observation))
        for label, observation in zip(labels, frame.observations, strict=True)
    ]
    below_in = 0.25 + _LETTER_IN * max(map(len, labels)) if upright else 0.3
    figure = Figure(_FRAME_WIDTH_IN, _FRAME_HEIGHT_IN + (0.4 if upright else 0.0))
    ((box,),) = boxes(figure, 1, 1, Margins(0.65, 0.65, below_in))
    draw_bars(figure, box, shown, frame.rms_mm, _MOST_LABELS, titles=("", "off by [mm]"),
              turned=upright)  # fmt: skip
    return figure.inline(f"Bars: what each observation of {name} is off")


def _colour_of_thing(observation: Observation) -> str:
    if not observation.used:
        return svg.BAD
    return svg.CHECK if observation.reason else svg.ACCENT


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}\N{HORIZONTAL ELLIPSIS}"

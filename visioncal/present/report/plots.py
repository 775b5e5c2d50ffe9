"""Plots of the report: residuals, coverage, tools and fixtures, uncertainty, the board's shape."""

from collections.abc import Collection, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import significant
from visioncal.core.transforms import log, nearest_rotation
from visioncal.core.types import Target
from visioncal.present.advice import contradicts
from visioncal.present.coverage import directions_chart
from visioncal.present.facts import SOURCES
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    CHECK,
    GOOD,
    INK,
    MIDDLE_IN,
    MUTED,
    NARROW_IN,
    SMALL,
    WIDE_IN,
    beside,
    colour_bar,
    dots,
    drawn,
    few_ticks,
    label_x,
    legend,
    logarithmic,
    panels,
)
from visioncal.present.result_parts import placement, target_frames
from visioncal.results import Calibration, Frame, ViewResult
from visioncal.results.evidence import ViewEvidence
from visioncal.results.sections import BoardResult, UncertaintyResult
from visioncal.results.views import rms_of
from visioncal.session import Session

_AXES = (("x", ACCENT), ("y", CHECK), ("z", GOOD))
# Scales ignore the few largest points, which would compress the others.
_ROOM, _KEPT_PERCENT = 1.3, 95.0
# Labels with more characters in total are vertical; longest label; most labels.
_MOST_CHARACTERS, _LONGEST, _MOST_LABELS = 36, 12, 24
# Height of a bar chart over its largest used bar.
_HEADROOM = 1.25
# Smaller depths are rounding errors.
_LEAST_DEPTH_MM = 1e-6


def draw_bars(
    axes: Axes,
    heights: Sequence[float | None],
    used: Sequence[bool],
    colours: Sequence[str],
    rms: float | None,
    limit: float | None = None,
) -> None:
    """Draws a bar chart, clipped to the scale of the used bars.

    Args:
        axes: Axes to draw in.
        heights: Heights of the bars from left to right; None where unknown.
        used: Whether each was used.
        colours: Colour of each bar and its mark.
        rms: Root mean square of the used bars, drawn as a line; None for no line.
        limit: Value where doubt begins: a line if the scale contains it, else a text. None for
            neither.
    """
    values, is_used = np.array(heights, dtype=float), np.array(used, dtype=bool)
    shown = values[is_used] if is_used.any() else values
    shown = shown[np.isfinite(shown)]
    top = _HEADROOM * float(shown.max(initial=0.0)) or 1.0
    places = np.arange(len(values))
    axes.bar(places, np.minimum(np.nan_to_num(values), top), 0.7, color=colours, alpha=0.9)
    axes.set_ylim(0.0, 1.2 * top)
    few_ticks(axes, y=4)
    for place in places[~is_used]:
        value, colour = values[place], colours[place]
        clipped = bool(value > top)
        height = 0.05 * top if np.isnan(value) else min(value, top)
        axes.plot([place], [height], marker="^" if clipped else "x", color=colour, markersize=5.0)
        if clipped:
            axes.annotate(significant(value), (place, top), xytext=(0.0, 5.0), ha="center",
                          textcoords="offset points", fontsize=SMALL, color=colour)  # fmt: skip
    if rms is not None:
        axes.axhline(rms, color=INK, linewidth=0.9, linestyle="--")
        beside(axes, rms, f"rms {significant(rms)}")
    if limit is None:
        return
    words = f"doubt from {limit:g}"
    if limit < top * 1.1:
        axes.axhline(limit, color=BAD, linewidth=0.9, linestyle=":")
        axes.annotate(words, (0.0, limit), xycoords=("axes fraction", "data"), xytext=(4.0, 2.0),
                      textcoords="offset points", fontsize=SMALL, color=BAD)  # fmt: skip
    else:
        axes.text(1.0, 0.99, f"{words} \N{UPWARDS ARROW}", fontsize=SMALL, color=MUTED, ha="right",
                  va="top", transform=axes.transAxes)  # fmt: skip


_LIMITS = CalibrationLimits()
# Kinds of residuals: label, attributes of a view and of `Rms`, and where doubt begins.
_MEASURES: tuple[tuple[str, str, str, float | None], ...] = (
    ("position [mm]", "residual_mm", "mm", _LIMITS.scatter_mm[0]),
    ("orientation [deg]", "residual_deg", "deg", _LIMITS.scatter_deg[0]),
    ("reprojection [px]", "rms_px", "px", None),
)


@drawn
def residuals(
    calibration: Calibration, outlying: Collection[int] = ()
) -> tuple[Figure, str] | None:
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
        return None
    margins_in = None if is_cell else (0.8, 0.45, 0.75, 0.06)
    height_in = (1.6 if is_cell else 1.3) * len(shown) + 0.25
    figure, grid = panels(WIDE_IN, height_in, len(shown), 1, margins_in)
    for axes, (seer, views, (label, name, unit, limit)) in zip(grid[:, 0], shown, strict=True):
        draw_bars(
            axes,
            [getattr(view, name) for view in views],
            [view.used for view in views],
            [_colour(view, outlying) for view in views],
            getattr(rms_of(views), unit),
            None if is_cell else limit,
        )
        is_last = axes is grid[-1, 0]
        label_x(axes, [str(view.view) for view in views], 25, "view" if is_last else "")
        # With several cameras, each panel has other views.
        axes.tick_params(labelbottom=is_last or is_cell)
        axes.set_ylabel(label)
        axes.set_title(seer, loc="left")
    return figure, "Bars: residuals of each view"


def _colour(view: ViewResult, outlying: Collection[int]) -> str:
    if view.used:
        return CHECK if view.view in outlying else ACCENT
    return BAD if contradicts(view) else MUTED


@drawn
def image_coverage(
    calibration: Calibration, evidence: Sequence[ViewEvidence]
) -> tuple[Figure, str] | None:
    """Corners of the used views over the image, coloured by reprojection error."""
    used = {view.view for view in calibration.views if view.used}
    seen = [view for view in evidence if view.corners is not None and view.view in used]
    if not seen or calibration.camera is None:
        return None
    pairs = [(view.corners.px, view.predicted_px) for view in seen if view.corners is not None]
    px = np.concatenate([detected for detected, _ in pairs])
    # NaN without predictions.
    predicted_px = np.concatenate(
        [
            np.full_like(detected, np.nan) if predicted is None else predicted
            for detected, predicted in pairs
        ]
    )
    errors = np.linalg.norm(px - predicted_px, axis=1)
    known = np.isfinite(errors)
    width, height = calibration.camera.camera.resolution
    figure, ((axes,),) = panels(NARROW_IN, 0.6 + 0.75 * NARROW_IN * height / width)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set(xlabel="image x [px]", ylabel="image y [px]")
    axes.spines[:].set_visible(True)
    few_ticks(axes, 4, 5)
    dots(axes, px[~known], color=ACCENT, s=4.0)
    if known.any():
        top = float(np.percentile(errors[known], 98))
        shown = dots(axes, px[known], errors[known], vmin=0.0, vmax=top, s=4.0)
        colour_bar(axes, shown, "reprojection error [px]")
    return figure, "Corners of all used views over the image"


@drawn
def viewing_directions(
    calibration: Calibration, evidence: Sequence[ViewEvidence]
) -> tuple[Figure, str] | None:
    """Viewing directions towards the target: tilt against its normal, and azimuth."""
    chart = directions_chart({view.view: view for view in evidence})
    if chart is None or calibration.mount == "instrument":
        return None
    used = {view.view for view in calibration.views if view.used}
    figure, ((axes,),) = panels(NARROW_IN, 3.0, subplot_kw={"projection": "polar"})
    # The target's y points down, as on the printed page.
    axes.set_theta_direction(-1)
    axes.set_xticks(np.deg2rad([0.0, 90.0, 180.0, 270.0]), ["x", "y", "-x", "-y"])
    entries = []
    for is_used, marker, colour, label in (
        (True, "o", ACCENT, "used"),
        (False, "x", BAD, "not used"),
    ):
        points = [xy for view, xy in chart.points.items() if (view in used) is is_used]
        if points:
            x, y = np.vstack(points).T
            axes.plot(np.arctan2(y, x), np.hypot(x, y), marker, color=colour, markersize=4.5)
            entries.append((marker, colour, label))
    axes.set_rlim(0.0, max(45.0, 5.0 + max(np.hypot(*xy.T).max() for xy in chart.points.values())))
    few_ticks(axes, y=4)
    axes.yaxis.set_major_formatter("{x:.0f}\N{DEGREE SIGN}")
    if len(entries) > 1:
        legend(figure, entries, "left")
    return figure, "Where the camera looked from"


@drawn
def flange_rotations(
    calibration: Calibration, evidence: Sequence[ViewEvidence]
) -> tuple[Figure, str] | None:
    """Rotation of the flange from its mean orientation, about each of its axes."""
    used = {view.view for view in calibration.views if view.used}
    poses = [
        view.base_from_flange
        for view in evidence
        if view.base_from_flange is not None and view.view in used
    ]
    if len(poses) < 2:
        return None
    rotations = np.stack(poses)[:, :3, :3]
    base_from_mean = nearest_rotation(rotations.mean(axis=0))
    rotvecs_deg = np.rad2deg(Rotation.from_matrix(base_from_mean.T @ rotations).as_rotvec())
    reach = max(10.0, 1.1 * float(np.abs(rotvecs_deg).max()))
    figure, ((axes,),) = panels(NARROW_IN, 2.0)
    axes.set(xlim=(-reach, reach), ylim=(2.6, -0.6), ylabel="flange axis")
    axes.set_xlabel("rotation from the mean orientation [deg]")
    axes.set_yticks([0, 1, 2], ["x", "y", "z"])
    rows = np.broadcast_to(np.arange(3), rotvecs_deg.shape)
    axes.plot(rotvecs_deg.ravel(), rows.ravel(), "|", color=ACCENT, markersize=17.0)
    return figure, "Rotations of the flange in the used views"


@drawn
def residuals_over_joints(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int] = (),
) -> tuple[Figure, str] | None:
    """Residuals of the used views along the target's axes, one column per joint.

    Args:
        calibration: The result.
        session: Session with the joint angles.
        evidence: Poses of the views.
        outlying: Numbers of used views to leave out, as they would compress the scale.
    """
    if session is None or not evidence:
        return None
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
        return None
    joints_deg = np.rad2deg([joints for joints, _ in pairs])
    twists = np.array([residual for _, residual in pairs])
    margins_in, joints = (0.8, 0.45, 0.06, 0.3), joints_deg.shape[1]
    figure, grid = panels(WIDE_IN, 3.0, 2, joints, margins_in, sharex="col", sharey="row")
    rows = (
        (grid[0], 1e3 * twists[:, 3:], "position [mm]"),
        (grid[1], np.rad2deg(twists[:, :3]), "rotation [deg]"),
    )
    for row, values, label in rows:
        reach = _ROOM * float(np.percentile(np.abs(values), _KEPT_PERCENT)) or 1.0
        row[0].set(ylim=(-1.1 * reach, 1.1 * reach), ylabel=label)
        for axes, angles_deg in zip(row, joints_deg.T, strict=True):
            axes.axhline(0.0, color=INK, linewidth=0.7)
            few_ticks(axes, 2, 4)
            for column, (_, colour) in enumerate(_AXES):
                shown_values = np.clip(values[:, column], -reach, reach)
                axes.plot(angles_deg, shown_values, "_", color=colour, markersize=4.0)
    for joint, axes in enumerate(grid[1]):
        axes.set_xlabel(f"q{joint + 1} [deg]")
    legend(figure, [("_", colour, f"target {name}") for name, colour in _AXES])
    return figure, "Residuals of the used views over each joint's angle"


@drawn
def frame_plot(name: str, frame: Frame) -> tuple[Figure, str] | None:
    """Residual of each observation of a tool or a fixture; outliers in red."""
    heights = [seen.residual_mm for seen in frame.observations]
    if all(height is None for height in heights):
        return None
    labels = [
        seen.name
        if len(seen.name) <= _LONGEST
        else f"{seen.name[: _LONGEST - 1]}\N{HORIZONTAL ELLIPSIS}"
        for seen in frame.observations
    ]
    vertical = sum(map(len, labels)) > _MOST_CHARACTERS
    used = [seen.used for seen in frame.observations]
    colours = [
        BAD if not seen.used else CHECK if seen.reason else ACCENT for seen in frame.observations
    ]
    figure, ((axes,),) = panels(MIDDLE_IN, 2.1 if vertical else 1.7)
    draw_bars(axes, heights, used, colours, frame.rms_mm)
    label_x(axes, labels, _MOST_LABELS, "", vertical=vertical)
    axes.set_ylabel("off by [mm]")
    return figure, f"Bars: what each observation of {name} is off"


@drawn
def budget(uncertainty: UncertaintyResult) -> tuple[Figure, str]:
    """Standard deviation by source, of a point where the views look."""
    parts = uncertainty.parts_mm
    labels = [f"{significant(mm)} ({uncertainty.percent(name)})" for name, mm in parts.items()]
    labels.append(significant(uncertainty.total_mm))
    values = [*parts.values(), uncertainty.total_mm]
    names = [*(SOURCES.get(name, name) for name in parts), "total"]
    figure, ((axes,),) = panels(MIDDLE_IN, 0.32 * len(names) + 0.6)
    colours = [ACCENT] * len(parts) + [INK]
    bars = axes.barh(range(len(names)), values, 0.6, color=colours, alpha=0.9)
    axes.bar_label(bars, labels, padding=4.0, fontsize=SMALL)
    # Room for the labels beside the longest bar.
    axes.set(xlim=(0.0, 1.55 * max(values) or 1.0), ylim=(len(names) - 0.5, -0.5))
    axes.set_yticks(range(len(names)), names)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("sigma of the point's place [mm]")
    few_ticks(axes, 4)
    return figure, "Bars: standard deviation by source"


@drawn
def directions(uncertainty: UncertaintyResult) -> tuple[Figure, str] | None:
    """Standard deviations of the edges' principal directions, relative to the limit."""
    values = uncertainty.spectrum[uncertainty.spectrum > 0.0]
    if not len(values):
        return None
    low, high = min(1e-2, 0.5 * float(values.min())), max(2.5, 1.5 * float(values.max()))
    figure, ((axes,),) = panels(MIDDLE_IN, 1.0)
    logarithmic(axes.xaxis)
    axes.set(xlim=(low, high), ylim=(-1.0, 1.0), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("sigma / largest accepted")
    axes.plot(values, np.zeros(len(values)), "|", color=ACCENT, markersize=18.0)
    axes.axvline(1.0, color=BAD, linewidth=1.4)
    axes.annotate("limit", (1.0, 0.6), xytext=(4.0, 0.0), textcoords="offset points",
                  fontsize=SMALL, color=BAD)  # fmt: skip
    return figure, "Sigmas of the directions, and the limit"


@drawn
def board_shape(board: BoardResult, target: Target, name: str = "") -> tuple[Figure, str] | None:
    """Depth of a board behind its mean plane; None for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    reach = float(np.abs(depth_mm).max())
    if not board.is_bent or reach < _LEAST_DEPTH_MM:
        return None
    figure, ((axes,),) = panels(MIDDLE_IN, 0.7 * MIDDLE_IN)
    levels = np.linspace(-reach, reach, 14)
    shown = axes.tricontourf(x_mm, y_mm, depth_mm, levels, cmap="coolwarm")
    axes.plot(x_mm, y_mm, "o", color="#202020", markersize=1.4)
    # y points down on the printed page.
    axes.invert_yaxis()
    axes.set(xlabel="target x [mm]", ylabel="target y [mm]", aspect="equal")
    axes.grid(visible=False)
    colour_bar(axes, shown, "depth [mm]")
    return figure, f"Depth of the board {name}".strip() + " over its plane"

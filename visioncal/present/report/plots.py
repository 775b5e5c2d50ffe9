"""Plots of the report: residuals by view and over joints, coverage, the board's shape."""

from collections.abc import Collection, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import significant
from visioncal.core.transforms import log
from visioncal.core.types import Target
from visioncal.present.advice import contradicts
from visioncal.present.coverage import coverage_charts
from visioncal.present.report.plotting import (
    ACCENT,
    BAD,
    CHECK,
    GOOD,
    INK,
    LINE,
    MIDDLE_IN,
    MUTED,
    SMALL,
    WIDE_IN,
    bars,
    beside,
    colour_bar,
    drawn,
    few_ticks,
    label_x,
    legend,
    panels,
    strokes,
)
from visioncal.present.result_parts import placement, target_frames
from visioncal.results import Calibration, ViewResult
from visioncal.results.evidence import ViewEvidence
from visioncal.results.sections import BoardResult
from visioncal.results.views import rms_of
from visioncal.session import Session

_AXES = (("x", ACCENT), ("y", CHECK), ("z", GOOD))
# Scales ignore the few largest points, which would compress the others.
_ROOM, _KEPT_PERCENT = 1.3, 95.0
# Height of a bar chart over its largest used bar.
_HEADROOM = 1.25
# Smaller depths are rounding errors.
_LEAST_DEPTH_MM = 1e-6
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
    height_in, room = (1.9, 0.45) if is_cell else (1.3, 0.16)
    figure, grid = panels(
        WIDE_IN, height_in * len(shown) + 0.5, len(shown), 1, (0.8, 0.45, 0.75, 0.25)
    )
    figure.subplots_adjust(hspace=room)
    for axes, (seer, views, (label, name, unit, limit)) in zip(grid[:, 0], shown, strict=True):
        # With several cameras, each panel has other views.
        is_labelled = is_cell or axes is grid[-1, 0]
        label_x(axes, [str(view.view) for view in views] if is_labelled else [], "")
        axes.set_xlim(-0.7, len(views) - 0.3)
        _draw_views(
            axes,
            views,
            np.array([getattr(view, name) for view in views], dtype=float),
            outlying,
            getattr(rms_of(views), unit),
        )
        if limit is not None and not is_cell:
            _draw_limit(axes, limit)
        axes.set_ylabel(label)
        axes.set_title(seer, loc="left")
    grid[-1, 0].set_xlabel("view")
    return figure, "Bars: residuals of each view"


def _draw_views(
    axes: Axes,
    views: Sequence[ViewResult],
    values: np.ndarray,
    outlying: Collection[int],
    rms: float | None,
) -> None:
    """Draws a bar a view, clipped to the scale of the used ones, and a mark for each other one."""
    colours = [
        (CHECK if view.view in outlying else ACCENT)
        if view.used
        else BAD
        if contradicts(view)
        else MUTED
        for view in views
    ]
    is_used = np.array([view.used for view in views])
    shown = values[is_used] if is_used.any() else values
    top = _HEADROOM * float(shown[np.isfinite(shown)].max(initial=0.0)) or 1.0
    places = np.arange(len(values))
    bars(axes, places, np.minimum(np.nan_to_num(values), top), colours, 0.7)
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


def _draw_limit(axes: Axes, limit: float) -> None:
    """A line where doubt begins, if the scale contains it, else a text."""
    words, top = f"doubt from {limit:g}", axes.get_ylim()[1]
    if limit < 0.92 * top:
        axes.axhline(limit, color=BAD, linewidth=0.9, linestyle=":")
        axes.annotate(words, (0.0, limit), xycoords=("axes fraction", "data"), xytext=(4.0, 2.0),
                      textcoords="offset points", fontsize=SMALL, color=BAD)  # fmt: skip
    else:
        axes.text(1.0, 1.02, f"{words} \N{UPWARDS ARROW}", fontsize=SMALL, color=MUTED, ha="right",
                  va="bottom", transform=axes.transAxes)  # fmt: skip


# What each chart of the coverage shows.
_CHARTS = {
    "image": "corners in the image",
    "directions": "viewing directions",
    "rotation_axes": "rotation axes of the flange",
}


@drawn
def coverage(
    calibration: Calibration, evidence: Sequence[ViewEvidence]
) -> tuple[Figure, str] | None:
    """Coverage of the image, of viewing directions and of rotation axes, side by side."""
    charts = coverage_charts(calibration, evidence)
    if not charts:
        return None
    used = {view.view for view in calibration.views if view.used}
    figure, grid = panels(WIDE_IN, 3.1, 1, len(charts), (0.05, 0.05, 0.05, 0.3))
    for axes, chart in zip(grid[0], charts, strict=True):
        axes.set(title=_CHARTS[chart.name], aspect="equal")
        axes.set_axis_off()
        axes.invert_yaxis()
        axes.add_collection(LineCollection(chart.lines, colors=LINE, linewidths=0.7))
        for place, words in chart.words:
            axes.text(*place, words, color=MUTED, fontsize=SMALL, ha="center", va="center")
        width = 2.0 if chart.name == "image" else 4.5
        for is_used, colour in ((True, ACCENT), (False, BAD)):
            points = [xy for view, xy in chart.points.items() if (view in used) is is_used]
            if points:
                strokes(axes, *np.vstack(points).T, colour, width)
    return figure, "Coverage: corners, viewing directions, rotation axes"


@drawn
def residuals_over_joints(
    calibration: Calibration,
    session: Session | None,
    evidence: Sequence[ViewEvidence],
    outlying: Collection[int] = (),
) -> tuple[Figure, str] | None:
    """Residuals of the used views along the target's axes, over each joint's angle in turn.

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
    low, high = joints_deg.min(axis=0), joints_deg.max(axis=0)
    # Each joint has a part of the axis of its own, from its smallest to its largest angle.
    places = np.arange(len(low)) + 0.8 * (joints_deg - low) / np.maximum(high - low, 1e-9)
    twists = np.array([residual for _, residual in pairs])
    figure, grid = panels(WIDE_IN, 3.2, 2, 1, (0.8, 0.5, 0.06, 0.3), sharex=True)
    rows = (
        (grid[0, 0], 1e3 * twists[:, 3:], "position [mm]"),
        (grid[1, 0], np.rad2deg(twists[:, :3]), "rotation [deg]"),
    )
    for axes, values, label in rows:
        reach = _ROOM * float(np.percentile(np.abs(values), _KEPT_PERCENT)) or 1.0
        axes.set(ylim=(-1.1 * reach, 1.1 * reach), ylabel=label)
        axes.axhline(0.0, color=INK, linewidth=0.7)
        axes.grid(visible=False, axis="x")
        few_ticks(axes, y=4)
        for column, (_, colour) in enumerate(_AXES):
            heights = np.clip(values[:, column], -reach, reach)
            repeated = np.broadcast_to(heights[:, None], places.shape)
            strokes(axes, places.ravel(), repeated.ravel(), colour, 1.2, 0.05)
    grid[1, 0].set_xticks(
        np.arange(len(low)) + 0.4,
        [f"q{joint + 1}\n{a:.0f} to {b:.0f} deg"
         for joint, (a, b) in enumerate(zip(low, high, strict=True))],
    )  # fmt: skip
    legend(figure, [("line", colour, f"target {name}") for name, colour in _AXES])
    return figure, "Residuals of the used views over each joint's angle"


@drawn
def board_shape(board: BoardResult, target: Target, name: str = "") -> tuple[Figure, str] | None:
    """Depth of a board behind its mean plane; None for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    reach = float(np.abs(depth_mm).max())
    if not board.is_bent or reach < _LEAST_DEPTH_MM:
        return None
    figure, ((axes,),) = panels(MIDDLE_IN, 0.7 * MIDDLE_IN, 1, 1, (0.6, 0.45, 0.3, 0.06))
    levels = np.linspace(-reach, reach, 14)
    shown = axes.tricontourf(x_mm, y_mm, depth_mm, levels, cmap="coolwarm")
    axes.plot(x_mm, y_mm, "o", color="#202020", markersize=1.4)
    # y points down on the printed page.
    axes.invert_yaxis()
    axes.set(xlabel="target x [mm]", ylabel="target y [mm]", aspect="equal")
    axes.grid(visible=False)
    colour_bar(axes, shown, "depth [mm]")
    return figure, f"Depth of the board {name}".strip() + " over its plane"

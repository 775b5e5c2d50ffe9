"""Figures of arms and boards: residuals before and after, uncertainty, drift, a board's shape."""

from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray, Target
from visioncal.present.arms import hours
from visioncal.present.report.plotting import (
    ACCENT,
    CHECK,
    INK,
    LINE,
    MIDDLE_IN,
    WIDE_IN,
    colour_bar,
    drawn,
    legend,
    logarithmic,
    panels,
    right_label,
    scattered,
)
from visioncal.results.arm import ArmResult, ThermalResult
from visioncal.results.sections import BoardResult

_BEFORE, _AFTER = CHECK, ACCENT


@drawn
def before_and_after(arm: ArmResult) -> tuple[Figure, str] | None:
    """Residuals of views that the fit did not use, by the nominal and the calibrated arm."""
    if not arm.left_out:
        return None
    views, positions = arm.left_out, np.arange(float(len(arm.left_out)))
    kinds = [("position [mm]", "nominal_mm", "mm"), ("orientation [deg]", "nominal_deg", "deg")]
    kinds = kinds if all(view.deg is not None for view in views) else kinds[:1]
    figure, grid = panels(
        WIDE_IN, 1.7 * len(kinds) + 0.4, len(kinds), 1, (0.8, 0.45, 0.75, 0.4), sharex=True
    )
    for axes, (label, *names) in zip(grid[:, 0], kinds, strict=True):
        pairs = np.maximum([[getattr(view, name) for name in names] for view in views], 1e-6)
        logarithmic(axes.yaxis)
        axes.set_ylabel(label)
        axes.grid(visible=False, axis="x")
        axes.vlines(positions, pairs.min(axis=1), pairs.max(axis=1), color=LINE, linewidth=1.6)
        axes.plot(positions, pairs[:, 0], "o", color=_BEFORE, fillstyle="none", markersize=5.5)
        axes.plot(positions, pairs[:, 1], "o", color=_AFTER, markersize=5.5)
        # Above and below, so that similar values do not overlap.
        rms = np.sqrt(np.mean(pairs**2, axis=0)).tolist()
        for value, colour, rise in zip(rms, (_BEFORE, _AFTER), ("bottom", "top"), strict=True):
            right_label(axes, value, f"rms {significant(value)}", colour, rise)
    step = max(1, -(-len(views) // 25))
    grid[-1, 0].set_xticks(positions[::step], [str(view.view) for view in views][::step])
    grid[-1, 0].set_xlabel("view")
    entries = [("ring", _BEFORE, "arm as stated"), ("o", _AFTER, "calibrated arm")]
    legend(figure, entries)
    words = "Residuals of each view that was left out, before and after the arm was calibrated"
    return figure, words


@drawn
def workspace(
    arm: ArmResult, stops_m: FloatArray, side: Literal["side", "top"]
) -> tuple[Figure, str]:
    """Map of the workspace with the largest sigmas on top, and the stops as crosses.

    Args:
        arm: The arm.
        stops_m: (m, 3) flange positions of the stops [m].
        side: Seen from the side, by distance from the base's axis and height; or from the top.
    """

    def seen(places_m: FloatArray) -> FloatArray:
        if side == "top":
            return places_m[:, :2]
        return np.stack([np.hypot(places_m[:, 0], places_m[:, 1]), places_m[:, 2]], axis=1)

    order, stops = np.argsort(arm.map_sigmas_mm), seen(stops_m)
    # Few places at the rim would dominate the colour scale.
    low, high = np.percentile(arm.map_sigmas_mm, [1.0, 98.0])
    figure, ((axes,),) = panels(MIDDLE_IN, 0.8 * MIDDLE_IN, 1, 1, (0.6, 0.45, 0.3, 0.06))
    labels = ("base x [m]", "base y [m]")
    labels = labels if side == "top" else ("distance from the base's axis [m]", "base z [m]")
    axes.set(xlabel=labels[0], ylabel=labels[1], aspect="equal")
    places_m = np.array([(place.x_m, place.y_m, place.z_m) for place in arm.workspace_map])
    places, sigmas_mm = seen(places_m)[order], arm.map_sigmas_mm[order]
    shown = scattered(axes, places, sigmas_mm, vmin=low, vmax=high, s=26.0)
    axes.plot(stops[:, 0], stops[:, 1], "x", color=INK, markersize=4.5)
    axes.plot([0.0], [0.0], "s", color=INK, markersize=6.0)
    colour_bar(axes, shown, "sigma [mm]")
    sigmas = f"{significant(low)} to {significant(high)} mm"
    return figure, f"The workspace from the {side}, sigma {sigmas}"


@drawn
def course(thermal: ThermalResult) -> tuple[Figure, str]:
    """Drift over time, with its 95 % band."""
    times_h = [hours(thermal, point.stamp_s) for point in thermal.course]
    drift_mm = np.array([point.drift_mm for point in thermal.course])
    # A band of 95 %.
    band_mm = 1.96 * np.array([point.sigma_mm for point in thermal.course])
    figure, ((axes,),) = panels(WIDE_IN, 2.6)
    axes.set(xlabel="time since the start [h]", ylabel="drift of the flange [mm]")
    axes.fill_between(times_h, drift_mm - band_mm, drift_mm + band_mm, color=ACCENT, alpha=0.2,
                      linewidth=0.0)  # fmt: skip
    axes.plot(times_h, drift_mm, color=ACCENT, linewidth=1.6)
    return figure, "Drift of the flange against time, with its 95 % band"


@drawn
def board_shape(board: BoardResult, target: Target, name: str = "") -> tuple[Figure, str] | None:
    """Depth of a board behind its mean plane; None for a flat one."""
    x_mm, y_mm, depth_mm = 1e3 * board.corners(target).T
    reach = float(np.abs(depth_mm).max())
    # Smaller depths are rounding errors.
    if not board.is_bent or reach < 1e-6:
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

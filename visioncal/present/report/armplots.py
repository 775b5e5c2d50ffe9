"""The arm's plots: before and after it was calibrated, and its uncertainty over the workspace."""

from collections.abc import Callable

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray
from visioncal.present.report import svg
from visioncal.results.arm import ArmResult, UnseenView

_WIDE_IN, _MAP_IN = 9.2, 5.0
# Places left free between the views that were left out in turn and those that are held back.
_GAP = 1.5
# Many views have room for so many labels.
_MOST_LABELS = 25
# Colours end here, that a few places at the rim do not take all of them.
_LOW_PERCENT, _HIGH_PERCENT = 1.0, 98.0
# A scale of decades has no room for zero [mm, deg].
_LEAST = 1e-6
# A map is no taller than this many times its width.
_TALLEST = 1.0

_BEFORE, _AFTER = svg.CHECK, svg.ACCENT

_Pair = Callable[[UnseenView], tuple[float | None, float | None]]


def before_and_after(found: ArmResult) -> Markup:
    """Residuals of views that the fit had not seen, by the arm as stated and as calibrated.

    Returns:
        The figure; empty where these residuals are not known.
    """
    if not found.left_out:
        return Markup("")
    views = [*found.left_out, *found.holdout]
    places = np.arange(float(len(views)))
    places[len(found.left_out) :] += _GAP
    panels: list[tuple[str, _Pair]] = [("position [mm]", lambda it: (it.nominal_mm, it.mm))]
    if all(it.deg is not None for it in views):
        panels.append(("orientation [deg]", lambda it: (it.nominal_deg, it.deg)))
    with svg.style():
        figure = svg.new_figure(_WIDE_IN, 1.7 * len(panels))
        rows = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
        for axes, (label, pair) in zip(rows, panels, strict=True):
            pairs = np.array([pair(it) for it in views], dtype=float)
            _dumbbells(axes, places, pairs)
            _mark_rms(axes, pairs[: len(found.left_out)])
            axes.set_ylabel(label)
            if found.holdout:
                axes.axvline(len(found.left_out) - 0.5 + 0.5 * _GAP, color=svg.MUTED, linewidth=0.9)
        if found.holdout:
            _name_sets(rows[0], places[len(found.left_out)])
        step = max(1, -(-len(views) // _MOST_LABELS))
        rows[-1].set_xticks(places[::step], [str(it.view) for it in views[::step]])
        rows[-1].set_xlabel("view")
        handles, labels = rows[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=2)
        words = "Residuals of each view that was left out, before and after the arm was calibrated"
        return svg.inline(figure, "unseen", words)


def _dumbbells(axes: Axes, places: FloatArray, values: FloatArray) -> None:
    """Draws (m, 2) residuals, before and after, one above the other on a logarithmic scale."""
    shown = np.maximum(values, _LEAST)
    axes.set_yscale("log")
    axes.vlines(places, shown.min(axis=1), shown.max(axis=1), color=svg.LINE, linewidth=1.6)
    for column, colour, face, label in (
        (0, _BEFORE, "none", "arm as stated"),
        (1, _AFTER, _AFTER, "calibrated arm"),
    ):
        axes.plot(
            places, shown[:, column], "o", color=colour, markerfacecolor=face, markersize=4.5,
            label=label,
        )  # fmt: skip
    axes.set_xlim(places[0] - 0.8, places[-1] + 0.8)
    axes.grid(visible=False, axis="x")
    axes.yaxis.set_major_locator(LogLocator(numticks=5))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _mark_rms(axes: Axes, values: FloatArray) -> None:
    """Writes the root mean squares of (m, 2) residuals beside the panel."""
    # Apart from each other where both are alike.
    marks = ((_BEFORE, "bottom"), (_AFTER, "top"))
    for rms, (colour, side) in zip(np.sqrt(np.mean(values**2, axis=0)), marks, strict=True):
        axes.annotate(
            f"rms {significant(float(rms))}", (1.0, max(float(rms), _LEAST)), (6, 0), fontsize=8,
            va=side, xycoords=("axes fraction", "data"), textcoords="offset points", color=colour,
        )  # fmt: skip


def _name_sets(axes: Axes, first_held: float) -> None:
    """Says above the panels which views are which."""
    for words, place in (("left out in turn", -0.4), ("held back by the session", first_held)):
        axes.annotate(
            words, (place, 1.0), (0, 4), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8, color=svg.MUTED,
        )  # fmt: skip


def side_map(found: ArmResult, stops_m: FloatArray) -> Markup:
    """The map seen from the side: height over the distance from the base's axis.

    Args:
        found: The arm, with a map of its workspace.
        stops_m: (m, 3) where the flange was when the arm was measured; may be empty [m].
    """
    return _map(
        found,
        _from_the_side(found.map_places_m),
        _from_the_side(stops_m),
        ("distance from the base's axis [m]", "base z [m]"),
        "side",
    )


def top_map(found: ArmResult, stops_m: FloatArray) -> Markup:
    """The map seen from above; see `side_map`."""
    return _map(
        found, found.map_places_m[:, :2], stops_m[:, :2], ("base x [m]", "base y [m]"), "top"
    )


def _from_the_side(places_m: FloatArray) -> FloatArray:
    return np.stack([np.hypot(places_m[:, 0], places_m[:, 1]), places_m[:, 2]], axis=1)


def _map(
    found: ArmResult,
    places_m: FloatArray,
    stops_m: FloatArray,
    labels: tuple[str, str],
    name: str,
) -> Markup:
    """Draws (k, 2) places, the worst ones on top, and the stops as crosses."""
    order = np.argsort(found.map_sigmas_mm)
    low, high = np.percentile(found.map_sigmas_mm, [_LOW_PERCENT, _HIGH_PERCENT])
    ends = np.vstack([places_m, stops_m, np.zeros((1, 2))])
    width, height = np.ptp(ends, axis=0)
    share = min(height / max(width, 1e-9), _TALLEST)
    with svg.style():
        figure = svg.new_figure(_MAP_IN, 0.7 + 0.72 * _MAP_IN * share)
        axes = figure.subplots()
        coloured = axes.scatter(
            places_m[order, 0], places_m[order, 1], c=found.map_sigmas_mm[order], cmap="plasma",
            vmin=low, vmax=high, s=26, linewidths=0,
        )  # fmt: skip
        axes.plot(*stops_m.T, "x", color=svg.INK, markersize=4.5, markeredgewidth=0.9)
        axes.plot(0.0, 0.0, "s", color=svg.INK, markersize=6)
        bar = figure.colorbar(coloured, ax=axes, shrink=0.85, extend="both")
        bar.locator = MaxNLocator(5)
        bar.update_ticks()
        bar.set_label("sigma [mm]")
        bar.outline.set_visible(False)
        axes.set_aspect("equal")
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        sigmas = f"{significant(low)} to {significant(high)} mm"
        return svg.inline(
            figure, f"workspace-{name}", f"The workspace from the {name}, sigma {sigmas}"
        )

"""Plots of an arm: residuals before and after calibration, uncertainty, springs and drift."""

from collections.abc import Callable

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.core.types import FloatArray
from visioncal.present.arms import hours, joint_words
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.svg import Figure
from visioncal.results.arm import ArmResult, ElasticResult, ThermalResult, UnseenView

_WIDE_IN, _MAP_IN = 9.2, 5.0
# Gap between cross-validation views and hold-out views, in views.
_GAP = 1.5
# Largest number of labelled views.
_MOST_LABELS = 25
# Percentiles at the ends of the colour scale, as few places at the rim would dominate it.
_LOW_PERCENT, _HIGH_PERCENT = 1.0, 98.0
# Smallest value on a logarithmic scale [mm, deg].
_LEAST = 1e-6
# Largest height over width of a map, and its number of colours.
_TALLEST, _SHADES = 1.0, 32
# Room above and below marks on a logarithmic scale, as a factor.
_SPARE = 1.25

# Height of the drift plot, and half width of its 95 % band in sigmas.
_DRIFT_IN, _BAND = 2.6, 1.96
# Panels side by side, their height, and the gaps between them.
_PANELS, _PANEL_IN, _ACROSS_IN, _DOWN_IN = 3, 2.3, 0.75, 0.75

_BEFORE, _AFTER = svg.CHECK, svg.ACCENT

_Pair = Callable[[UnseenView], tuple[float | None, float | None]]


def before_and_after(arm: ArmResult) -> Markup:
    """Residuals of views that the fit did not use, by the nominal and the calibrated arm.

    Returns:
        The figure; empty if these residuals are unknown.
    """
    if not arm.left_out:
        return Markup("")
    views = [*arm.left_out, *arm.holdout]
    positions = np.arange(float(len(views)))
    positions[len(arm.left_out) :] += _GAP
    panels: list[tuple[str, _Pair]] = [("position [mm]", lambda view: (view.nominal_mm, view.mm))]
    if all(view.deg is not None for view in views):
        panels.append(("orientation [deg]", lambda view: (view.nominal_deg, view.deg)))
    step = max(1, -(-len(views) // _MOST_LABELS))
    ticks = [
        (float(position), str(view.view)) for position, view in zip(positions, views, strict=True)
    ][::step]
    figure = Figure(_WIDE_IN, 1.7 * len(panels) + 0.2)
    rows = boxes(figure, len(panels), 1, Margins(0.75, 0.75, top=0.45), (0.0, 0.2))
    for (box,), (label, pair) in zip(rows, panels, strict=True):
        is_last = box is rows[-1][0]
        pairs = np.maximum(np.array([pair(view) for view in views], dtype=float), _LEAST)
        heights = Scale(float(pairs.min()) / _SPARE, float(pairs.max()) * _SPARE, decades=True)
        panel = Panel(figure, box, Scale(positions[0] - 0.8, positions[-1] + 0.8), heights)
        panel.x_axis("view" if is_last else "", ticks, grid=False, words=is_last)
        panel.y_axis(label)
        _dumbbells(panel, positions, pairs)
        _mark_rms(panel, pairs[: len(arm.left_out)])
        if arm.holdout:
            panel.post(len(arm.left_out) - 0.5 + 0.5 * _GAP, svg.MUTED)
            if box is rows[0][0]:
                _name_sets(panel, positions[len(arm.left_out)])
    entries = [
        ("\N{WHITE CIRCLE}", _BEFORE, "arm as stated"),
        ("\N{BLACK CIRCLE}", _AFTER, "calibrated arm"),
    ]
    figure.legend(rows[0][0].right, 10.0, entries)
    return figure.inline(
        "Residuals of each view that was left out, before and after the arm was calibrated"
    )


def _dumbbells(panel: Panel, places: FloatArray, values: FloatArray) -> None:
    """Draws (m, 2) residuals, before and after, joined by a line."""
    breaks = np.full(len(places), np.nan)
    stems = np.stack([places, places, breaks], axis=1).ravel()
    heights = np.stack([values[:, 0], values[:, 1], breaks], axis=1).ravel()
    panel.line(stems, heights, svg.LINE)
    panel.marks(places, values[:, 0], "ring", _BEFORE)
    panel.marks(places, values[:, 1], "dot", _AFTER)


def _mark_rms(panel: Panel, values: FloatArray) -> None:
    """Writes the root mean squares of (m, 2) residuals beside the panel."""
    # Above and below, so that similar values do not overlap.
    marks = ((_BEFORE, "bottom"), (_AFTER, "top"))
    for rms, (colour, side) in zip(np.sqrt(np.mean(values**2, axis=0)), marks, strict=True):
        x, y = panel.box.right + 6.0, float(panel.y_at(float(rms)))
        words = f"rms {significant(float(rms))}"
        panel.figure.text(x, y, words, size=svg.SMALL, colour=colour, rise=side)


def _name_sets(panel: Panel, first_held: float) -> None:
    for words, position in (("left out in turn", -0.4), ("held back by the session", first_held)):
        x, y = float(panel.x_at(position)), panel.box.top - 4.0
        panel.figure.text(x, y, words, size=svg.SMALL, colour=svg.MUTED)


def side_map(arm: ArmResult, stops_m: FloatArray) -> Markup:
    """Map of the workspace from the side, with the stops' (m, 3) flange positions [m]."""
    return _map(
        arm,
        _from_the_side(arm.map_places_m),
        _from_the_side(stops_m),
        ("distance from the base's axis [m]", "base z [m]"),
        "side",
    )


def top_map(arm: ArmResult, stops_m: FloatArray) -> Markup:
    """Map of the workspace from above; see `side_map`."""
    return _map(arm, arm.map_places_m[:, :2], stops_m[:, :2], ("base x [m]", "base y [m]"), "top")


def _from_the_side(places_m: FloatArray) -> FloatArray:
    return np.stack([np.hypot(places_m[:, 0], places_m[:, 1]), places_m[:, 2]], axis=1)


def _map(
    arm: ArmResult, places_m: FloatArray, stops_m: FloatArray, labels: tuple[str, str], name: str
) -> Markup:
    """Draws (k, 2) places with the largest sigmas on top, and the stops as crosses."""
    order = np.argsort(arm.map_sigmas_mm)
    low, high = np.percentile(arm.map_sigmas_mm, [_LOW_PERCENT, _HIGH_PERCENT])
    ends = np.vstack([places_m, stops_m, np.zeros((1, 2))])
    start, end = ends.min(axis=0), ends.max(axis=0)
    spare = 0.05 * np.maximum(end - start, 1e-3)
    start, end = start - spare, end + spare
    share = min(float((end - start)[1] / (end - start)[0]), _TALLEST)
    # A map that is too tall is drawn at the height limit, and narrower.
    figure = Figure(_MAP_IN, 0.6 + (_MAP_IN - 1.5) * share)
    ((box,),) = boxes(figure, 1, 1, Margins(right=0.9))
    box = box.shaped(float((end - start)[1] / (end - start)[0]))
    panel = Panel(figure, box, Scale(start[0], end[0]), Scale(start[1], end[1]))
    panel.x_axis(labels[0], 6)
    panel.y_axis(labels[1], 6)
    steps, colours = svg.shades(arm.map_sigmas_mm[order], low, high, svg.PLASMA, _SHADES)
    for step, colour in enumerate(colours):
        places = places_m[order][steps == step]
        panel.marks(places[:, 0], places[:, 1], "dot", colour, 5.1)
    panel.marks(stops_m[:, 0], stops_m[:, 1], "x", svg.INK, 4.5)
    panel.marks([0.0], [0.0], "square", svg.INK, 6.0)
    panel.colour_bar(Scale(low, high), svg.PLASMA, "sigma [mm]")
    sigmas = f"{significant(low)} to {significant(high)} mm"
    return figure.inline(f"The workspace from the {name}, sigma {sigmas}")


def course(thermal: ThermalResult) -> Markup:
    """Drift over time, with its 95 % band."""
    times_h = [hours(thermal, point.stamp_s) for point in thermal.course]
    drift_mm = np.array([point.drift_mm for point in thermal.course])
    band_mm = _BAND * np.array([point.sigma_mm for point in thermal.course])
    low, high = drift_mm - band_mm, drift_mm + band_mm
    seen = [
        (hours(thermal, observation.stamp_s), observation.drift_mm)
        for observation in thermal.seen or ()
    ]
    values_mm = np.concatenate([low, high, [mm for _, mm in seen]])
    least, most = 1.1 * min(0.0, float(values_mm.min())), float(values_mm.max())
    figure = Figure(_WIDE_IN, _DRIFT_IN)
    ((box,),) = boxes(figure, 1, 1, Margins())
    scale = Scale(least, most + 0.05 * (most - least))
    panel = Panel(figure, box, Scale(times_h[0], times_h[-1]), scale)
    panel.x_axis("time since the start [h]")
    panel.y_axis("drift of the flange [mm]", 6)
    panel.band(np.array(times_h), low, high, svg.ACCENT)
    panel.line(times_h, drift_mm, svg.ACCENT)
    if seen:
        panel.marks([time_h for time_h, _ in seen], [mm for _, mm in seen], "dot", svg.INK)
        line, dot = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}", "\N{BLACK CIRCLE}"
        entries = [(line, svg.ACCENT, "the model"), (dot, svg.INK, "seen by the stops")]
        figure.legend(box.right - 6.0, box.bottom - 6.0, entries)
    return figure.inline("Drift of the flange against time, with its 95 % band")


def deflection_against_load(elastic: ElasticResult) -> Markup:
    """Deflection of each determined joint at each stop, against the torque on it.

    Returns:
        The figure; empty if no joint is determined.
    """
    bending = {
        spring: np.array(deflections)
        for index, spring in enumerate(elastic.joints)
        if spring.stiffness_nm_per_rad is not None and (deflections := elastic.bends(index))
    }
    if not bending:
        return Markup("")
    rows = -(-len(bending) // _PANELS)
    figure = Figure(_WIDE_IN, _PANEL_IN * rows)
    gaps_in = (_ACROSS_IN, _DOWN_IN)
    grid = boxes(figure, rows, _PANELS, Margins(top=0.25), gaps_in)
    panels = (box for row in grid for box in row)
    for box, (spring, points) in zip(panels, bending.items(), strict=False):
        torques_nm, bends_mrad = points.T
        ends = np.array([min(torques_nm.min(), 0.0), max(torques_nm.max(), 0.0)])
        line = 1e3 * spring.compliance_rad_per_nm * ends
        heights = spanning(np.concatenate([bends_mrad, line]))
        panel = Panel(figure, box, spanning(ends), heights)
        panel.x_axis("torque [N m]", 5)
        panel.y_axis("bend [mrad]", 5)
        panel.title(joint_words(spring.joint))
        panel.line(ends, line, svg.LINE)
        panel.marks(torques_nm, bends_mrad, "dot", svg.ACCENT, 4.0)
    return figure.inline("How far each joint bends over the torque on it")

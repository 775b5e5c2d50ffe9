"""An arm's plots: before and after it was calibrated, its uncertainty, its springs and drift."""

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
# Places left free between the views that were left out in turn and those that are held back.
_GAP = 1.5
# Many views have room for so many labels.
_MOST_LABELS = 25
# Colours end here, that a few places at the rim do not take all of them.
_LOW_PERCENT, _HIGH_PERCENT = 1.0, 98.0
# A scale of decades has no room for zero [mm, deg].
_LEAST = 1e-6
# A map is no taller than this many times its width; its steps of colour.
_TALLEST, _SHADES = 1.0, 32
# Above and below marks on a scale of decades, as a factor.
_SPARE = 1.25

# Height of the drift's figure, and how wide its band is: it holds 95 % of cases.
_DRIFT_IN, _BAND = 2.6, 1.96
# Panels side by side, their height, and room between them for their labels.
_PANELS, _PANEL_IN, _ACROSS_IN, _DOWN_IN = 3, 2.3, 0.75, 0.75

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
    panels: list[tuple[str, _Pair]] = [("position [mm]", lambda view: (view.nominal_mm, view.mm))]
    if all(view.deg is not None for view in views):
        panels.append(("orientation [deg]", lambda view: (view.nominal_deg, view.deg)))
    step = max(1, -(-len(views) // _MOST_LABELS))
    ticks = [(float(place), str(view.view)) for place, view in zip(places, views, strict=True)][
        ::step
    ]
    figure = Figure(_WIDE_IN, 1.7 * len(panels) + 0.2)
    rows = boxes(figure, len(panels), 1, Margins(0.75, 0.75, top=0.45), (0.0, 0.2))
    for (box,), (label, pair) in zip(rows, panels, strict=True):
        last = box is rows[-1][0]
        pairs = np.maximum(np.array([pair(view) for view in views], dtype=float), _LEAST)
        heights = Scale(float(pairs.min()) / _SPARE, float(pairs.max()) * _SPARE, decades=True)
        panel = Panel(figure, box, Scale(places[0] - 0.8, places[-1] + 0.8), heights)
        panel.x_axis("view" if last else "", ticks, grid=False, words=last)
        panel.y_axis(label)
        _dumbbells(panel, places, pairs)
        _mark_rms(panel, pairs[: len(found.left_out)])
        if found.holdout:
            panel.post(len(found.left_out) - 0.5 + 0.5 * _GAP, svg.MUTED)
            if box is rows[0][0]:
                _name_sets(panel, places[len(found.left_out)])
    entries = [
        ("\N{WHITE CIRCLE}", _BEFORE, "arm as stated"),
        ("\N{BLACK CIRCLE}", _AFTER, "calibrated arm"),
    ]
    figure.legend(rows[0][0].right, 10.0, entries)
    return figure.inline(
        "Residuals of each view that was left out, before and after the arm was calibrated"
    )


def _dumbbells(panel: Panel, places: FloatArray, values: FloatArray) -> None:
    """Draws (m, 2) residuals, before and after, one above the other."""
    gap = np.full(len(places), np.nan)
    stems = np.stack([places, places, gap], axis=1).ravel()
    heights = np.stack([values[:, 0], values[:, 1], gap], axis=1).ravel()
    panel.line(stems, heights, svg.LINE)
    panel.marks(places, values[:, 0], "ring", _BEFORE)
    panel.marks(places, values[:, 1], "dot", _AFTER)


def _mark_rms(panel: Panel, values: FloatArray) -> None:
    """Writes the root mean squares of (m, 2) residuals beside the panel."""
    # Apart from each other where both are alike.
    marks = ((_BEFORE, "bottom"), (_AFTER, "top"))
    for rms, (colour, side) in zip(np.sqrt(np.mean(values**2, axis=0)), marks, strict=True):
        x, y = panel.box.right + 6.0, float(panel.y_at(float(rms)))
        words = f"rms {significant(float(rms))}"
        panel.figure.text(x, y, words, size=svg.SMALL, colour=colour, rise=side)


def _name_sets(panel: Panel, first_held: float) -> None:
    """Says above the panels which views are which."""
    for words, place in (("left out in turn", -0.4), ("held back by the session", first_held)):
        x, y = float(panel.x_at(place)), panel.box.top - 4.0
        panel.figure.text(x, y, words, size=svg.SMALL, colour=svg.MUTED)


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
    start, end = ends.min(axis=0), ends.max(axis=0)
    spare = 0.05 * np.maximum(end - start, 1e-3)
    start, end = start - spare, end + spare
    share = min(float((end - start)[1] / (end - start)[0]), _TALLEST)
    # A map that is too tall for the room is as high as that, and less wide.
    figure = Figure(_MAP_IN, 0.6 + (_MAP_IN - 1.5) * share)
    ((box,),) = boxes(figure, 1, 1, Margins(right=0.9))
    box = box.shaped(float((end - start)[1] / (end - start)[0]))
    panel = Panel(figure, box, Scale(start[0], end[0]), Scale(start[1], end[1]))
    panel.x_axis(labels[0], 6)
    panel.y_axis(labels[1], 6)
    steps, colours = svg.shades(found.map_sigmas_mm[order], low, high, svg.PLASMA, _SHADES)
    for step, colour in enumerate(colours):
        some = places_m[order][steps == step]
        panel.marks(some[:, 0], some[:, 1], "dot", colour, 5.1)
    panel.marks(stops_m[:, 0], stops_m[:, 1], "x", svg.INK, 4.5)
    panel.marks([0.0], [0.0], "square", svg.INK, 6.0)
    panel.colour_bar(Scale(low, high), svg.PLASMA, "sigma [mm]")
    sigmas = f"{significant(low)} to {significant(high)} mm"
    return figure.inline(f"The workspace from the {name}, sigma {sigmas}")


def course(found: ThermalResult) -> Markup:
    """The drift over time, with the band in which it is predicted to lie."""
    times_h = [hours(found, point.stamp_s) for point in found.course]
    drift_mm = np.array([point.drift_mm for point in found.course])
    band_mm = _BAND * np.array([point.sigma_mm for point in found.course])
    low, high = drift_mm - band_mm, drift_mm + band_mm
    seen = [
        (hours(found, observed_drift.stamp_s), observed_drift.drift_mm)
        for observed_drift in found.seen or ()
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
        panel.marks([at for at, _ in seen], [mm for _, mm in seen], "dot", svg.INK)
        line, dot = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}", "\N{BLACK CIRCLE}"
        entries = [(line, svg.ACCENT, "the model"), (dot, svg.INK, "seen by the stops")]
        figure.legend(box.right - 6.0, box.bottom - 6.0, entries)
    return figure.inline("Drift of the flange against time, with its 95 % band")


def deflection_against_load(elastic: ElasticResult) -> Markup:
    """How far each stop sees each determined joint bend, over the torque on it.

    Returns:
        The figure; empty where no joint is determined.
    """
    bending = {
        spring: np.array(seen)
        for at, spring in enumerate(elastic.joints)
        if spring.stiffness_nm_per_rad is not None and (seen := elastic.bends(at))
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

"""How the arm drifts with its temperature: a table and a plot."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes
from visioncal.present.report.svg import Figure
from visioncal.results.arm import JointDrift, ThermalResult

_WIDE_IN, _HIGH_IN = 9.2, 2.6
# The band holds 95 % of cases.
_BAND = 1.96


@dataclass(frozen=True)
class JointRow:
    """A joint and its link, as text."""

    name: str
    growth: str
    drift: str
    tau: str
    note: str


@dataclass(frozen=True)
class DriftCard:
    """What is said of the drift: a sentence, and a row a joint."""

    sentence: str
    rows: tuple[JointRow, ...]


def drift_card(found: ThermalResult) -> DriftCard:
    """Writes what was found."""
    source = "measured temperatures" if found.heated_by == "temperatures" else "motor currents"
    last, residual = found.course[-1], found.residual_mm
    return DriftCard(
        f"By {source}, the flange had moved by {significant(last.drift_mm)} mm at the end, "
        f"{significant(_hours(found, last.stamp_s))} h after the start. Counted with, it takes the "
        f"views' residuals from {significant(residual.without)} to "
        f"{significant(residual.with_drift)} mm.",
        tuple(_row(it, found.not_determined) for it in found.joints),
    )


def _row(it: JointDrift, names: Sequence[str]) -> JointRow:
    return JointRow(
        it.joint,
        _with_sigma(1e6 * it.growth_per_k, 1e6 * it.growth_sigma_per_k),
        _with_sigma(1e6 * it.drift_rad_per_k, 1e6 * it.drift_sigma_rad_per_k),
        significant(it.tau_s / 60.0),
        "growth as known before" if f"growth of {it.joint}" in names else "",
    )


def _hours(found: ThermalResult, stamp_s: float) -> float:
    """Since the start of the course."""
    return (stamp_s - found.course[0].stamp_s) / 3600.0


def course(found: ThermalResult) -> Markup:
    """The drift over time, with the band in which it is predicted to lie."""
    hours = [_hours(found, it.stamp_s) for it in found.course]
    drift_mm = np.array([it.drift_mm for it in found.course])
    band_mm = _BAND * np.array([it.sigma_mm for it in found.course])
    low, high = drift_mm - band_mm, drift_mm + band_mm
    seen = [(_hours(found, it.stamp_s), it.drift_mm) for it in found.seen or ()]
    values_mm = np.concatenate([low, high, [mm for _, mm in seen]])
    least, most = 1.1 * min(0.0, float(values_mm.min())), float(values_mm.max())
    figure = Figure(_WIDE_IN, _HIGH_IN)
    ((box,),) = boxes(figure, 1, 1, Margins())
    scale = Scale(least, most + 0.05 * (most - least))
    panel = Panel(figure, box, Scale(hours[0], hours[-1]), scale)
    panel.x_axis("time since the start [h]")
    panel.y_axis("drift of the flange [mm]", 6)
    panel.band(np.array(hours), low, high, svg.ACCENT)
    panel.line(hours, drift_mm, svg.ACCENT)
    if seen:
        panel.marks([at for at, _ in seen], [mm for _, mm in seen], "dot", svg.INK)
        line, dot = 2 * "\N{BOX DRAWINGS HEAVY HORIZONTAL}", "\N{BLACK CIRCLE}"
        entries = [(line, svg.ACCENT, "the model"), (dot, svg.INK, "seen by the stops")]
        figure.legend(box.right - 6.0, box.bottom - 6.0, entries)
    return figure.inline("Drift of the flange against time, with its 95 % band")


def _with_sigma(value: float, sigma: float) -> str:
    return f"{value:.1f} \N{PLUS-MINUS SIGN} {sigma:.1f}"

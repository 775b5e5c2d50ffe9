"""What the report says of the calibrated arm: its errors, its springs and its drift."""

from collections.abc import Iterator

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.estimation.arm import SIGNIFICANT
from visioncal.present.facts import Fact, arm_sentences, identifiability_facts
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.svg import Figure
from visioncal.present.words import (
    by_joint,
    joint_words,
)
from visioncal.results.arm import (
    ArmResult,
    ElasticResult,
    ThermalResult,
)

_CONVENTIONS = {
    "standard": "Denavit and Hartenberg's form, each joint's link behind it",
    "modified": "Craig's modified form, each joint's link before it",
    "hayati": "Hayati's form, which has no leap where axes are parallel",
}
_INDICES = (
    ("o1", "O1", "geometric mean, over the root of the number of stops (Borm and Menq 1991)"),
    ("o2", "O2", "smallest over largest (Driels and Pathre 1990)"),
    ("o3", "O3", "smallest (Nahvi, Hollerbach and Hayward 1994)"),
    ("o4", "O4", "square of the smallest over the largest (Nahvi and Hollerbach 1996)"),
    ("o5", "O5", "inverse of the sum of their inverses (Sun and Hollerbach 2008)"),
)
_WIDE_IN, _HIGH_IN = 9.2, 2.6
# The band holds 95 % of cases.
_BAND = 1.96
_PANELS, _PANEL_HIGH_IN = 3, 2.3
# Between the panels, for their labels.
_ACROSS_IN, _DOWN_IN = 0.75, 0.75


def arm_words(found: ArmResult) -> dict[str, object]:
    """What the page's template says of the arm beside the numbers of its result."""
    known = [it for it in found.parameters if it.sigma is not None]
    sure = sum(it.is_sure for it in known)
    return {
        "arm_sentences": arm_sentences(found),
        "by_chance": f"{SIGNIFICANT:.0f}",
        "convention": _CONVENTIONS.get(found.convention or "", ""),
        "sure_changes": f"{sure} of {len(found.parameters)}" if known else "",
        "parameters": list(by_joint(found).items()),
        "identifiability": list(identifiability_facts(found)),
        "indices": list(_details(found)),
    }


def _details(found: ArmResult) -> Iterator[Fact]:
    known = found.observability
    if known is not None:
        note = "both transforms' and the arm's, redundant ones among them"
        yield Fact("values carried", str(known.columns), note)
        for name, label, note in _INDICES:
            value = getattr(known, name)
            if value is not None:
                yield Fact(label, f"{value:.3g}", note)


def drift_sentence(found: ThermalResult) -> str:
    """How far the flange drifted, and what it brings to count that."""
    source = "measured temperatures" if found.heated_by == "temperatures" else "motor currents"
    last, residual = found.course[-1], found.residual_mm
    return (
        f"By {source}, the flange had moved by {significant(last.drift_mm)} mm at the end, "
        f"{significant(_hours(found, last.stamp_s))} h after the start. Counted with, it takes the "
        f"views' residuals from {significant(residual.without)} to "
        f"{significant(residual.with_drift)} mm."
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
    figure = Figure(_WIDE_IN, _PANEL_HIGH_IN * rows)
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

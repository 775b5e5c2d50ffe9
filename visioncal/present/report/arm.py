"""What the report says of the calibrated arm: its errors, its springs and its drift."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.estimation.arm import SIGNIFICANT
from visioncal.present.report import svg
from visioncal.present.report.axes import Margins, Panel, Scale, boxes, spanning
from visioncal.present.report.content import Fact
from visioncal.present.report.svg import Figure
from visioncal.present.words import (
    ParameterRow,
    by_joint,
    joint_words,
    level_reason,
    level_words,
    parameter_row,
    spring_words,
)
from visioncal.results.arm import (
    NOMINAL,
    ArmLevel,
    ArmResult,
    ElasticResult,
    JointDrift,
    ThermalResult,
)

_COLUMNS = 2
_MOST_INFLUENTIAL = 5
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


@dataclass(frozen=True)
class LevelRow:
    """A level of the arm's model, as text."""

    words: str
    taken: bool
    unknowns: str
    rms_mm: str
    rms_deg: str
    held_out_mm: str
    held_out_deg: str
    likelihood_ratio: str


@dataclass(frozen=True)
class InfluenceRow:
    """A stop, and by how much the variance over the workspace would grow without it, in words."""

    view: str
    growth: str


@dataclass(frozen=True)
class ArmCard:
    """All that is said of the arm.

    Attributes:
        sentences: Which level was taken and why, and how accurate the arm is.
        levels: What was tried; empty where that was the arm as stated alone.
        significant: What the likelihood ratio stays under by chance.
        convention: The form of the parameters, in words.
        sure: How many changes are beyond chance, in words; empty where no sigma is known.
        joints: The parameters by joint, in columns that stand side by side.
        identifiability: What the stops determine.
        details: Further figures of that.
        not_determined: What they do not determine.
        most_influential: The most influential stops.
        least_influential: The least influential one; empty where all are among the former.
    """

    sentences: tuple[str, ...]
    levels: tuple[LevelRow, ...]
    significant: str
    convention: str
    sure: str
    joints: tuple[tuple[tuple[str, tuple[ParameterRow, ...]], ...], ...]
    identifiability: tuple[Fact, ...]
    details: tuple[Fact, ...]
    not_determined: tuple[str, ...]
    most_influential: tuple[InfluenceRow, ...]
    least_influential: tuple[InfluenceRow, ...]


def arm_card(found: ArmResult) -> ArmCard:
    """Writes what was found of the arm as text."""
    sentences, sigma = [level_reason(found)], found.workspace_sigma_mm
    if sigma is not None:
        median, p95 = significant(sigma.median), significant(sigma.p95)
        sentences.append(
            f"All over the workspace, a tool's place is predicted with a sigma of {median} mm "
            f"(median; 95 % of the places: under {p95} mm)."
        )
    if found.carries_over is not None:
        sentences.append(found.carries_over.words)
    stops = [InfluenceRow(f"view {it.view}", _percent(it.influence)) for it in found.stops]
    return ArmCard(
        tuple(sentences),
        tuple(_level(it, it.level == found.level) for it in found.levels[: _tried(found)]),
        f"{SIGNIFICANT:.0f}",
        _CONVENTIONS.get(found.convention or "", ""),
        _sure(found),
        _columns(found),
        _identifiability(found),
        tuple(_details(found)),
        found.not_determined or (),
        tuple(stops[:_MOST_INFLUENTIAL]),
        tuple(stops[_MOST_INFLUENTIAL:][-1:]),
    )


def _tried(found: ArmResult) -> int:
    return len(found.levels) if len(found.levels) > 1 else 0


def _level(level: ArmLevel, taken: bool) -> LevelRow:
    return LevelRow(
        level_words(level.level),
        taken,
        str(level.unknowns),
        significant(level.rms_mm),
        significant(level.rms_deg),
        significant(level.held_out_mm),
        significant(level.held_out_deg),
        significant(None) if level.level == NOMINAL else f"{level.likelihood_ratio:.0f}",
    )


def _sure(found: ArmResult) -> str:
    known = [it for it in found.parameters if it.sigma is not None]
    sure = sum(it.is_sure for it in known)
    return f"{sure} of {len(found.parameters)}" if known else ""


def _columns(
    found: ArmResult,
) -> tuple[tuple[tuple[str, tuple[ParameterRow, ...]], ...], ...]:
    """Joints with their parameters, half of them in each column."""
    joints = [
        (joint_words(name), tuple(parameter_row(it) for it in them))
        for name, them in by_joint(found).items()
    ]
    height = max(-(-len(joints) // _COLUMNS), 1)
    return tuple(tuple(joints[start : start + height]) for start in range(0, len(joints), height))


def _identifiability(found: ArmResult) -> tuple[Fact, ...]:
    known = found.observability
    if known is None:
        return ()
    count = f"{known.determined} of {known.identifiable}"
    facts = [Fact("directions determined", count, "that any stops could determine")]
    if known.condition is not None:
        note = "best over worst determined, scaled"
        facts.append(Fact("condition", significant(known.condition), note))
    return tuple(facts)


def _details(found: ArmResult) -> list[Fact]:
    known = found.observability
    if known is None:
        return []
    note = "both transforms' and the arm's, redundant ones among them"
    facts = [Fact("values carried", str(known.columns), note)]
    for name, label, note in _INDICES:
        value = getattr(known, name)
        if value is not None:
            facts.append(Fact(label, f"{value:.3g}", note))
    return facts


def _percent(share: float) -> str:
    return f"{significant(100 * max(share, 0.0))} %"


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


@dataclass(frozen=True)
class SpringRow:
    """A joint as text."""

    joint: str
    stiffness: str
    sigma: str
    torque: str


def spring_rows(elastic: ElasticResult) -> tuple[SpringRow, ...]:
    """The table of the joints."""
    return tuple(SpringRow(joint_words(it.joint), *spring_words(it)) for it in elastic.joints)


def spring_facts(elastic: ElasticResult) -> Iterator[Fact]:
    """What the loads of the stops do."""
    median, most = significant(elastic.sag_mm.median), significant(elastic.sag_mm.most)
    yield Fact("the flange gives way by", f"{median} mm", f"median; at most {most} mm")
    low, high = map(significant, elastic.payload_kg)
    if elastic.payload_kg[1] > 0.0:
        yield Fact("payload", f"{low} to {high} kg")
    if elastic.payload_factor is not None:
        factor = elastic.payload_factor
        note = f"\N{PLUS-MINUS SIGN} {significant(factor.sigma)}; 1 where load and bend fit"
        yield Fact("load as stated, times", f"{factor.value:.2f}", note)


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

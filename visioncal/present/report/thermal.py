"""How the arm drifts with its temperature: a table and a plot."""

from dataclasses import dataclass

from markupsafe import Markup

from visioncal.core.number_format import significant
from visioncal.present.recording.thermal import Drift
from visioncal.present.report import svg

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


def drift_card(found: Drift) -> DriftCard:
    """Writes what was found."""
    told = "measured temperatures" if found.heated_by == "temperatures" else "motor currents"
    return DriftCard(
        f"By {told}, the flange had moved by {significant(float(found.drift_mm[-1]))} mm at the "
        f"end, {significant(float(found.hours[-1]))} h after the start. Counted with, it takes the "
        f"views' residuals from {significant(found.before_mm)} to {significant(found.after_mm)} "
        "mm.",
        tuple(
            JointRow(
                it.name,
                _with_sigma(*it.growth_um),
                _with_sigma(*it.drift_urad),
                significant(it.tau_min),
                "growth as known before" if it.not_told else "",
            )
            for it in found.joints
        ),
    )


def course(found: Drift) -> Markup:
    """The drift over time, with the band in which it is predicted to lie."""
    low = found.drift_mm - _BAND * found.sigma_mm
    high = found.drift_mm + _BAND * found.sigma_mm
    with svg.style():
        figure = svg.new_figure(_WIDE_IN, _HIGH_IN)
        axes = figure.subplots()
        axes.fill_between(found.hours, low, high, color=svg.ACCENT, alpha=0.2, linewidth=0.0)
        axes.plot(found.hours, found.drift_mm, color=svg.ACCENT, linewidth=1.6, label="the model")
        if len(found.seen):
            axes.plot(*found.seen.T, "o", color=svg.INK, markersize=3.5, label="seen by the stops")
            axes.legend(loc="lower right")
        axes.set_xlim(float(found.hours[0]), float(found.hours[-1]))
        least = min(0.0, float(low.min()), float(found.seen[:, 1].min(initial=0.0)))
        axes.set_ylim(bottom=1.1 * least)
        axes.set_xlabel("time since the start [h]")
        axes.set_ylabel("drift of the flange [mm]")
        return svg.inline(figure, "drift", "Drift of the flange against time, with its 95 % band")


def _with_sigma(value: float, sigma: float) -> str:
    return f"{value:.1f} \N{PLUS-MINUS SIGN} {sigma:.1f}"
